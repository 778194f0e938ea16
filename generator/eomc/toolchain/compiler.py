"""Find the C compiler, choose its flags, run it, and report its messages if it fails."""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import FrameType

from eomc.base.errors import EomcError, NoCompilerError
from eomc.toolchain.files import write_files

# no -ffast-math, which breaks the reduction of angles and the checks for singular D
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize")
STANDARD = "-std=gnu99"  # c99 would forbid the contraction to FMA
# portable C as it is embedded: any compiler, no specific processor
PLAIN_STANDARD, PLAIN_FLAGS = "-std=c99", ("-O2",)
# above it gcc takes more than some twenty seconds (0.3 ms per operation), clang two thirds of that
MANY_OPERATIONS = 60_000
# of shared libraries on this system
SUFFIX = {"win32": ".dll", "cygwin": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


@dataclass(frozen=True)
class Compiler:
    """A C compiler.

    command: the words of the command that runs it. identity: text that changes if another compiler
    or version is installed.
    """

    command: tuple[str, ...]
    identity: str


def find_compiler() -> Compiler:
    """Return the C compiler in $CC, or if CC is not set, the first of the known ones that exists.

    The known ones are cc, gcc, clang, and the Python package ziglang. Raises EomcError if there is
    none, or if $CC does not exist.
    """
    requested = os.environ.get("CC")
    for candidate in [requested] if requested else ["cc", "gcc", "clang"]:
        words = _split_words("CC", candidate)
        if words and (path := shutil.which(words[0])):
            return Compiler((path, *words[1:]), _identity(path) + " ".join(words[1:]))
    if requested:
        raise EomcError(f"the C compiler CC={requested!r} is not there: correct or unset CC")
    if importlib.util.find_spec("ziglang") is not None:
        import ziglang

        return Compiler((sys.executable, "-m", "ziglang", "cc"), f"ziglang {ziglang.__file__}")
    raise NoCompilerError(
        "no C compiler found: install gcc or clang (Debian: apt install gcc), "
        "or 'pip install ziglang', which brings one"
    )


def first_call_note() -> str:
    """Return a message for the user if the first build will be slow; otherwise "".

    The first build takes a minute or two if the compiler is the Python package ziglang and has not
    been called before, since it prepares its libraries then.
    """
    if not find_compiler().identity.startswith("ziglang"):
        return ""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    cache_folder = Path(os.environ.get("ZIG_GLOBAL_CACHE_DIR") or Path(home) / "zig")
    if (cache_folder / "o").is_dir():
        return ""
    return "ziglang prepares its libraries: the first build takes a minute or two, others seconds"


def _split_words(variable: str, text: str) -> list[str]:
    """Split the value of an environment variable as a shell does. Raises EomcError."""
    try:
        return shlex.split(text)
    except ValueError as fault:  # an open quote, a backslash at the end
        reason = str(fault).lower()
        raise EomcError(f"{variable}={text!r}: {reason}: close it, or unset {variable}") from None


def compiler_for(operations: int) -> Compiler:
    """Return the C compiler for generated code with this number of arithmetic operations.

    It is clang if the code has more than MANY_OPERATIONS, clang exists and $CC is not set.
    Otherwise it is the compiler that `find_compiler` returns. Raises EomcError if there is none.
    """
    default = find_compiler()
    if (
        operations > MANY_OPERATIONS
        and not os.environ.get("CC")
        and (clang := shutil.which("clang"))
    ):
        return Compiler((clang,), _identity(clang))
    return default


def _identity(path: str) -> str:
    real = Path(path).resolve()
    state = real.stat()
    return f"{real} {state.st_size} {state.st_mtime_ns}"


def flags(form: str = "fast") -> tuple[str, ...]:
    """Return the compiler's optimisation flags for the generated C.

    They are the words of $EOMC_CFLAGS if it is set; otherwise they depend on `form`: "fast" for
    optimised C, "plain" for portable C.

    On processors with AVX-512, the flags for "fast" make compilers vectorise in registers of half
    width. This is faster: a chain of five links takes 0.85 of the time. Explicit vectors in the
    generated C still use the full width.
    """
    chosen = user_flags()
    if chosen is not None:
        return chosen
    if form == "plain":
        return PLAIN_FLAGS
    return (*FLAGS, "-mprefer-vector-width=256") if "avx512f" in processor() else FLAGS


def binding_flags() -> tuple[str, ...]:
    """Return the optimisation flags for the C that connects the module with Python.

    They are $EOMC_CFLAGS if set; otherwise -O1, since the speed of this code hardly matters.
    """
    return user_flags() or ("-O1",)


def user_flags() -> tuple[str, ...] | None:
    """Return the words of the environment variable EOMC_CFLAGS; None if it is not set."""
    value = os.environ.get("EOMC_CFLAGS")
    return None if value is None else tuple(_split_words("EOMC_CFLAGS", value))


def standard(form: str) -> str:
    """Return the compiler flag that selects the C standard, such as "-std=c99".

    form: "fast" for optimised C, "plain" for portable C.
    """
    return PLAIN_STANDARD if form == "plain" else STANDARD


@lru_cache(maxsize=1)
def processor() -> str:
    """Return a text with the processor's model and features, on which -march=native depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        identifying = {
            line for line in lines if line.startswith(("model name", "flags", "Features"))
        }
        return platform.machine() + " " + " ".join(sorted(identifying))
    except OSError:
        return platform.machine() + " " + platform.processor()


def run(name: str, folder: Path, *commands: Sequence[str]) -> None:
    """Run commands in parallel in `folder`, and wait until all have ended.

    If one command fails, or the user presses Ctrl-C, the others are terminated. name: the scene's
    name, for messages. commands: the words of each command. Raises EomcError with the output of the
    first command that fails, or if a command can't be started.
    """
    running: list[subprocess.Popen[str]] = []
    try:
        for command in commands:
            with _delayed_interrupt():
                running.append(_start(command, folder))
        for command, process in zip(commands, running, strict=True):
            _finish(name, command, process)
    finally:
        for process in running:
            _terminate(process)


def try_load(
    name: str, command: Sequence[str], code: str, arguments: Sequence[str], remedy: str
) -> None:
    """Test in a separate process that a compiled library can be loaded; this takes some 10 ms.

    Parameters
    ----------
    name
        The scene's name, for messages.
    command
        The compiler's command, for messages.
    code, arguments
        Python code that loads the library, and the command-line arguments of this code.
    remedy
        Text at the end of the error message, which says what the user can do.

    Raises
    ------
    EomcError
        If the code fails or crashes.
    """
    completed = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code, *arguments],
        stdin=subprocess.DEVNULL, capture_output=True, errors="backslashreplace",
    )  # fmt: skip
    if completed.returncode:
        last_line = [f"status {completed.returncode}", *completed.stderr.strip().splitlines()][-1]
        raise EomcError(
            f"{name}: the C compiler {shlex.join(command)} returned 0, but what it made can't be "
            f"loaded: correct CC and EOMC_CFLAGS{remedy}\n  {last_line}"
        )


def compile_library(
    compiler: Compiler, name: str, files: Mapping[str, str], sources: Sequence[str], symbol: str,
    remedy: str = "",
) -> bytes:  # fmt: skip
    """Compile portable C to a shared library in a temporary folder; return its bytes.

    Parameters
    ----------
    compiler, name
        The compiler; the scene's name, for messages.
    files, sources
        Texts by path, of which C sources and headers are used; paths of the sources to compile.
    symbol
        Function that the library must contain.
    remedy
        Text at the end of the error message if the library can't be loaded.
    """
    library = name + SUFFIX
    with tempfile.TemporaryDirectory(prefix="eomc-") as folder_name:
        folder = Path(folder_name)
        write_files({n: text for n, text in files.items() if n.endswith((".c", ".h"))}, folder)
        command = [
            *compiler.command, standard("plain"), *flags("plain"), "-fPIC", "-fvisibility=hidden",
            "-shared", *sources, "-lm", "-o", library,
        ]  # fmt: skip
        run(name, folder, command)
        load = f"import ctypes; ctypes.CDLL({str(folder / library)!r}).{symbol}"
        try_load(name, compiler.command, load, (), remedy)
        return (folder / library).read_bytes()


@contextmanager
def _delayed_interrupt() -> Iterator[None]:
    """Delay KeyboardInterrupt until the block has ended, so that a started process is not lost.

    This applies to the main thread only, and only if Python handles the signal.
    """
    handler, pending = signal.getsignal(signal.SIGINT), list[tuple[int, FrameType | None]]()
    try:
        if callable(handler):
            signal.signal(signal.SIGINT, lambda number, frame: pending.append((number, frame)))
    except ValueError:  # another thread
        handler = None
    try:
        yield
    finally:
        if callable(handler):
            signal.signal(signal.SIGINT, handler)
            for number, frame in pending[:1]:
                handler(number, frame)


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """Start a compiler. Raises EomcError if it can't be started."""
    try:
        return subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
    except OSError as fault:
        raise EomcError(f"{command[0]}: can't be run ({fault.strerror})") from None


def _finish(name: str, command: Sequence[str], process: subprocess.Popen[str]) -> None:
    """Wait for a compiler. Raises EomcError with its output if it fails."""
    words, _ = process.communicate()
    if process.returncode:
        raise EomcError(
            f"{name}: the C compiler failed (status {process.returncode}):\n"
            f"  {shlex.join(command)}\n{words.rstrip()}"
        )


def _terminate(process: subprocess.Popen[str]) -> None:
    """Terminate a compiler that may still run, and give it time to remove its temporary files."""
    process.terminate()
    try:
        process.wait(1)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
