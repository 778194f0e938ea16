"""Bytes of code and stack of each function of the plain C, read from what a compiler makes of it.

gcc writes a graph of calls with the stack of each function (-fcallgraph-info=su), clang the stack
alone (-fstack-usage). Sizes of functions and sections stand in the object, which must be ELF.
"""

from __future__ import annotations

import contextlib
import re
import struct
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from eomc.base.errors import EomcError
from eomc.toolchain.compiler import PLAIN_STANDARD, Compiler, given_flags
from eomc.toolchain.running import run

SMALL = ("-Os",)  # where EOMC_CFLAGS says nothing
# tables by which debuggers unwind are in no small machine
BARE = ("-fno-asynchronous-unwind-tables", "-fno-unwind-tables")
# how stacks are asked for, first what tells most; ziglang's clang has to be told the file
_STACKS = (
    ("-fstack-usage", "-fcallgraph-info=su"),
    ("-fstack-usage", "-Xclang", "-stack-usage-file", "-Xclang", "{name}.su"),
    ("-fstack-usage",),
    (),
)
_ELF = b"\x7fELF"
_SYMBOLS, _WRITE, _ALLOCATED, _EXECUTED, _FUNCTION = 2, 1, 2, 4, 2  # ELF's own numbers


@dataclass(frozen=True)
class Size:
    """A function: bytes of code, and of stack alone and with all that it calls.

    stack, deepest: None where the compiler does not say, or there is no bound. calls: by name,
    those of libraries too, whose stack is not known.
    """

    name: str
    code: int
    stack: int | None = None
    deepest: int | None = None
    calls: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Object:
    """A compiled source: its functions, and the bytes of all code, constants and writable data."""

    command: tuple[str, ...]
    functions: tuple[Size, ...]
    code: int
    constants: int
    writable: int
    faults: tuple[str, ...]  # of its stack: recursion, frames without a bound


@dataclass
class _Graph:
    """Frames by function, which of them have no bound, and who calls whom."""

    frames: dict[str, int] = field(default_factory=dict)
    unbounded: set[str] = field(default_factory=set)
    calls: dict[str, set[str]] = field(default_factory=dict)
    whole: bool = False  # whether calls are known


def measure(files: Mapping[str, str], name: str, compiler: Compiler) -> Object:
    """The sizes of name.c, compiled by itself. Raises EomcError where it can't be, or is no ELF."""
    given = given_flags()
    flags = (PLAIN_STANDARD, *(SMALL if given is None else given), *BARE, "-c", f"{name}.c")
    with tempfile.TemporaryDirectory(prefix="eomc-sizes-") as place:
        folder = Path(place)
        for end in "hc":
            (folder / f"{name}.{end}").write_text(files[f"{name}.{end}"], encoding="utf-8")
        _compile(name, (*compiler.command, *flags, "-o", f"{name}.o"), folder)
        return _object(name, (*compiler.command, *flags[:-2]), folder)


def _compile(name: str, command: tuple[str, ...], folder: Path) -> None:
    """By the first way of asking for stacks that the compiler takes."""
    *others, last = ([*command, *(word.format(name=name) for word in more)] for more in _STACKS)
    for asked in others:
        with contextlib.suppress(EomcError):
            return run(name, folder, asked)
    run(name, folder, last)


def _object(name: str, command: tuple[str, ...], folder: Path) -> Object:
    """What was compiled in a folder."""
    made = folder / f"{name}.o"
    elf = made.read_bytes() if made.is_file() else b""
    if not elf.startswith(_ELF):
        raise EomcError(
            f"{' '.join(command)}: makes no ELF object, and sizes are read from those alone: "
            "set CC to a gcc or clang for Linux or a bare machine"
        )
    graph, loops = _graph(folder), set[str]()
    functions = tuple(
        Size(
            called, size, graph.frames.get(called),
            _deepest(graph, called, (), loops) if graph.whole else None,
            frozenset(graph.calls.get(called, ())),
        )
        for called, size in sorted(_functions(elf))
    )  # fmt: skip
    faults = [f"{f}: calls itself, by itself or others" for f in sorted(loops)]
    faults += [f"{f}: its stack has no bound" for f in sorted(graph.unbounded)]
    kinds = list(_sections(elf))
    return Object(
        command,
        functions,
        sum(size for kind, size in kinds if kind & _EXECUTED),
        sum(size for kind, size in kinds if not kind & (_EXECUTED | _WRITE)),
        sum(size for kind, size in kinds if kind & _WRITE),
        tuple(faults),
    )


def _deepest(graph: _Graph, name: str, above: tuple[str, ...], loops: set[str]) -> int | None:
    """The stack of a function and of all that it calls here; functions that call themselves into
    `loops`. None where there is no bound.
    """
    if name in above:
        loops.add(name)
        return None
    if name not in graph.frames:
        return 0  # of a library
    below = [_deepest(graph, f, (*above, name), loops) for f in sorted(graph.calls.get(name, ()))]
    if name in graph.unbounded or None in below:
        return None
    return graph.frames[name] + max((x for x in below if x is not None), default=0)


# --- what compilers write -------------------------------------------------------------------------

_NODE = re.compile(r'^node: \{ title: "([^"]*)" label: "[^"]*?\\n(\d+) bytes \((\w[\w,]*)\)', re.M)
_EDGE = re.compile(r'^edge: \{ sourcename: "([^"]*)" targetname: "([^"]*)"', re.M)
_FRAME = re.compile(r"^.*:(\w[\w.]*)\t(\d+)\t(\S+)$", re.M)


def _graph(folder: Path) -> _Graph:
    """From gcc's graph of calls, else from frames alone."""
    graph = _Graph()
    for file in folder.glob("*.su"):
        for name, size, kind in _FRAME.findall(file.read_text(encoding="utf-8")):
            _frame(graph, name, size, kind)
    for file in folder.glob("*.ci"):
        graph, text = _Graph(whole=True), file.read_text(encoding="utf-8")
        for title, size, kind in _NODE.findall(text):
            _frame(graph, _bare(title), size, kind)
        for caller, callee in _EDGE.findall(text):
            graph.calls.setdefault(_bare(caller), set()).add(_bare(callee))
    return graph


def _frame(graph: _Graph, name: str, size: str, kind: str) -> None:
    graph.frames[name] = int(size)
    if kind == "dynamic":  # and not bounded
        graph.unbounded.add(name)


def _bare(title: str) -> str:
    """A static function's title begins with its file."""
    return title.rsplit(":", 1)[-1]


# --- ELF ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Section:
    kind: int
    flags: int
    offset: int
    size: int
    link: int
    each: int


def _headers(elf: bytes) -> Iterator[_Section]:
    """The section headers of an object of 32 or 64 bits, in either order of bytes."""
    wide, order = elf[4] == 2, "<" if elf[5] == 1 else ">"
    at = struct.unpack_from(f"{order}{'Q' if wide else 'I'}", elf, 0x28 if wide else 0x20)[0]
    size, count = struct.unpack_from(f"{order}HH", elf, 0x3A if wide else 0x2E)
    shape = f"{order}II{'QQQQ' if wide else 'IIII'}II{'QQ' if wide else 'II'}"
    for k in range(count):
        _, kind, flags, _, offset, length, link, _, _, each = struct.unpack_from(
            shape, elf, at + k * size
        )
        yield _Section(kind, flags, offset, length, link, each)


def _sections(elf: bytes) -> Iterator[tuple[int, int]]:
    """(flags, bytes) of what is loaded; a processor's own tables aside, for unwinding."""
    notes = 0x70000000  # and beyond
    for s in _headers(elf):
        if s.flags & _ALLOCATED and s.size and s.kind < notes:
            yield s.flags, s.size


def _functions(elf: bytes) -> Iterator[tuple[str, int]]:
    """(name, bytes) of every function of an object's table of symbols."""
    wide, order = elf[4] == 2, "<" if elf[5] == 1 else ">"
    sections = list(_headers(elf))
    for s in sections:
        if s.kind != _SYMBOLS:
            continue
        names = sections[s.link].offset
        for at in range(s.offset, s.offset + s.size, s.each):
            if wide:
                name, info, _, _, _, size = struct.unpack_from(f"{order}IBBHQQ", elf, at)
            else:
                name, _, size, info, _, _ = struct.unpack_from(f"{order}IIIBBH", elf, at)
            if info & 15 == _FUNCTION and size:
                end = elf.index(b"\0", names + name)
                yield elf[names + name : end].decode("ascii", "backslashreplace"), size
