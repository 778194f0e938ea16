"""Sizes of code and stack of each function of the portable C, read from compiler output.

gcc writes a call graph with stack sizes (-fcallgraph-info=su), clang stack sizes only
(-fstack-usage). Sizes of functions and sections are read from the object file, which must be ELF.
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
from eomc.toolchain.compiler import PLAIN_STANDARD, Compiler, run, user_flags

DEFAULT_FLAGS = ("-Os",)  # without EOMC_CFLAGS
# small machines have no unwind tables for debuggers
NO_UNWIND_TABLES = ("-fno-asynchronous-unwind-tables", "-fno-unwind-tables")
# flags that report stack sizes, the most informative first; ziglang's clang needs the file name
_STACK_FLAGS = (
    ("-fstack-usage", "-fcallgraph-info=su"),
    ("-fstack-usage", "-Xclang", "-stack-usage-file", "-Xclang", "{name}.su"),
    ("-fstack-usage",),
    (),
)
_ELF = b"\x7fELF"
_SYMBOLS, _WRITE, _ALLOCATED, _EXECUTED, _FUNCTION = 2, 1, 2, 4, 2  # constants of the ELF format


@dataclass(frozen=True)
class FunctionSize:
    """Size of the machine code and of the stack of a compiled C function, in bytes.

    Attributes
    ----------
    name
        Name of the function.
    code
        Size of the machine code.
    stack, total_stack
        Size of the stack of the function itself, and of this together with the functions that it
        calls; None if the compiler does not report the size, or if the size has no bound.
    calls
        Names of the functions that it calls, including library functions, whose stack is unknown
        and counts as 0.
    """

    name: str
    code: int
    stack: int | None = None
    total_stack: int | None = None
    calls: frozenset[str] = frozenset()


@dataclass(frozen=True)
class ObjectSizes:
    """Sizes of a compiled C source.

    Attributes
    ----------
    command
        The compiler's command.
    functions
        Sizes of each function.
    code, constants, writable
        Bytes of machine code, of constant data and of writable data.
    faults
        Messages on functions that call themselves or whose stack has no bound.
    """

    command: tuple[str, ...]
    functions: tuple[FunctionSize, ...]
    code: int
    constants: int
    writable: int
    faults: tuple[str, ...]  # recursion and unbounded stack frames


@dataclass
class _Graph:
    """Call graph: stack frames by function, functions with unbounded frames, and calls."""

    frames: dict[str, int] = field(default_factory=dict)
    unbounded: set[str] = field(default_factory=set)
    calls: dict[str, set[str]] = field(default_factory=dict)
    has_calls: bool = False  # True if `calls` is complete


def measure(files: Mapping[str, str], name: str, compiler: Compiler) -> ObjectSizes:
    """Compile the portable C of a scene, and return the sizes of its code, data and stack.

    The object file is not linked. files: the text of each file by its name; they include the source
    and the header, `name` + ".c" and `name` + ".h". Raises EomcError if the compiler fails, or if
    it does not write an object file in the ELF format.
    """
    chosen = user_flags()
    flags = (
        PLAIN_STANDARD,
        *(DEFAULT_FLAGS if chosen is None else chosen),
        *NO_UNWIND_TABLES,
        "-c",
        f"{name}.c",
    )
    with tempfile.TemporaryDirectory(prefix="eomc-sizes-") as place:
        folder = Path(place)
        for end in "hc":
            (folder / f"{name}.{end}").write_text(files[f"{name}.{end}"], encoding="utf-8")
        _compile(name, (*compiler.command, *flags, "-o", f"{name}.o"), folder)
        return _read_sizes(name, (*compiler.command, *flags[:-2]), folder)


def _compile(name: str, command: tuple[str, ...], folder: Path) -> None:
    """Compile with the first set of stack flags that the compiler accepts."""
    *others, last = (
        [*command, *(word.format(name=name) for word in extra)] for extra in _STACK_FLAGS
    )
    for command_with_stack in others:
        with contextlib.suppress(EomcError):
            return run(name, folder, command_with_stack)
    run(name, folder, last)


def _read_sizes(name: str, command: tuple[str, ...], folder: Path) -> ObjectSizes:
    """Return the sizes of the object that was compiled in `folder`."""
    object_file = folder / f"{name}.o"
    elf = object_file.read_bytes() if object_file.is_file() else b""
    if not elf.startswith(_ELF):
        raise EomcError(
            f"{' '.join(command)}: makes no ELF object, and sizes are read from those alone: "
            "set CC to a gcc or clang for Linux or a bare machine"
        )
    graph, loops = _graph(folder), set[str]()
    functions = tuple(
        FunctionSize(
            called, size, graph.frames.get(called),
            _total_stack(graph, called, (), loops) if graph.has_calls else None,
            frozenset(graph.calls.get(called, ())),
        )
        for called, size in sorted(_functions(elf))
    )  # fmt: skip
    faults = [f"{f}: calls itself, by itself or others" for f in sorted(loops)]
    faults += [f"{f}: its stack has no bound" for f in sorted(graph.unbounded)]
    kinds = list(_sections(elf))
    return ObjectSizes(
        command,
        functions,
        sum(size for kind, size in kinds if kind & _EXECUTED),
        sum(size for kind, size in kinds if not kind & (_EXECUTED | _WRITE)),
        sum(size for kind, size in kinds if kind & _WRITE),
        tuple(faults),
    )


def _total_stack(graph: _Graph, name: str, callers: tuple[str, ...], loops: set[str]) -> int | None:
    """Return the stack of a function and its callees, or None if it has no bound.

    Recursive functions are added to `loops`.
    """
    if name in callers:
        loops.add(name)
        return None
    if name not in graph.frames:
        return 0  # library function
    stacks = [
        _total_stack(graph, f, (*callers, name), loops) for f in sorted(graph.calls.get(name, ()))
    ]
    if name in graph.unbounded or None in stacks:
        return None
    return graph.frames[name] + max((x for x in stacks if x is not None), default=0)


# --- what compilers write -------------------------------------------------------------------------

_NODE = re.compile(r'^node: \{ title: "([^"]*)" label: "[^"]*?\\n(\d+) bytes \((\w[\w,]*)\)', re.M)
_EDGE = re.compile(r'^edge: \{ sourcename: "([^"]*)" targetname: "([^"]*)"', re.M)
_FRAME = re.compile(r"^.*:(\w[\w.]*)\t(\d+)\t(\S+)$", re.M)


def _graph(folder: Path) -> _Graph:
    """Return the call graph from gcc's output, or stack frames alone."""
    graph = _Graph()
    for file in folder.glob("*.su"):
        for name, size, kind in _FRAME.findall(file.read_text(encoding="utf-8")):
            _frame(graph, name, size, kind)
    for file in folder.glob("*.ci"):
        graph, text = _Graph(has_calls=True), file.read_text(encoding="utf-8")
        for title, size, kind in _NODE.findall(text):
            _frame(graph, _without_file(title), size, kind)
        for caller, callee in _EDGE.findall(text):
            graph.calls.setdefault(_without_file(caller), set()).add(_without_file(callee))
    return graph


def _frame(graph: _Graph, name: str, size: str, kind: str) -> None:
    graph.frames[name] = int(size)
    if kind == "dynamic":  # and not bounded
        graph.unbounded.add(name)


def _without_file(title: str) -> str:
    """Return a function's name; titles of static functions begin with their file."""
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
    """Yield the section headers of a 32-bit or 64-bit object of either byte order."""
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
    """Yield (flags, bytes) of all loaded sections except processor-specific unwind tables."""
    notes = 0x70000000  # and beyond
    for s in _headers(elf):
        if s.flags & _ALLOCATED and s.size and s.kind < notes:
            yield s.flags, s.size


def _functions(elf: bytes) -> Iterator[tuple[str, int]]:
    """Yield (name, bytes) of every function in the symbol table."""
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
