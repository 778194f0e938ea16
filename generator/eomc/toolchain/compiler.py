"""The C compiler: which one, and with which flags."""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from eomc.base.errors import EomcError, NoCompilerError

# no -ffast-math: it breaks the reduction of angles and the checks for singular D
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize")
STANDARD = "-std=gnu99"  # c99 would forbid the contraction to FMA
# the plain one as it is embedded: any compiler, no processor of its own
PLAIN_STANDARD, PLAIN_FLAGS = "-std=c99", ("-O2",)
# operations over which gcc takes some twenty seconds (0.3 ms each, in pieces) and clang two thirds
MANY = 60_000


@dataclass(frozen=True)
class Compiler:
    """A C compiler: the command, and what identifies it."""

    command: tuple[str, ...]
    identity: str


def find_compiler() -> Compiler:
    """$CC, cc, gcc, clang or the pip-installable ziglang, in this order. Raises EomcError."""
    wish = os.environ.get("CC")
    for candidate in [wish] if wish else ["cc", "gcc", "clang"]:
        words = _words("CC", candidate)
        if words and (path := shutil.which(words[0])):
            return Compiler((path, *words[1:]), _identity(path) + " ".join(words[1:]))
    if wish:
        raise EomcError(f"the C compiler CC={wish!r} is not there: correct or unset CC")
    if importlib.util.find_spec("ziglang") is not None:
        import ziglang

        return Compiler((sys.executable, "-m", "ziglang", "cc"), f"ziglang {ziglang.__file__}")
    raise NoCompilerError(
        "no C compiler found: install gcc or clang (Debian: apt install gcc), "
        "or 'pip install ziglang', which brings one"
    )


def preparing() -> str:
    """What there is to say before ziglang's first call, which takes a minute; "" otherwise."""
    if not find_compiler().identity.startswith("ziglang"):
        return ""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    kept = Path(os.environ.get("ZIG_GLOBAL_CACHE_DIR") or Path(home) / "zig")
    if (kept / "o").is_dir():
        return ""
    return "ziglang prepares its libraries: the first build takes a minute or two, others seconds"


def _words(variable: str, text: str) -> list[str]:
    """The words of a variable of the environment, as a shell divides them. Raises EomcError."""
    try:
        return shlex.split(text)
    except ValueError as fault:  # an open quote, a backslash at the end
        said = str(fault).lower()
        raise EomcError(f"{variable}={text!r}: {said}: close it, or unset {variable}") from None


def compiler_for(operations: int) -> Compiler:
    """The compiler for a scene of that size: find_compiler's; clang, where it is there, for many.

    $CC is always obeyed. Raises EomcError.
    """
    found = find_compiler()
    if operations > MANY and not os.environ.get("CC") and (clang := shutil.which("clang")):
        return Compiler((clang,), _identity(clang))
    return found


def _identity(path: str) -> str:
    real = Path(path).resolve()
    state = real.stat()
    return f"{real} {state.st_size} {state.st_mtime_ns}"


def flags(form: str = "fast") -> tuple[str, ...]:
    """The optimisation flags: $EOMC_CFLAGS where it is set, else those of the form of C.

    Vector registers that the C asks for are as wide as there are; what compilers put into some by
    themselves is quicker in half of AVX-512's: a chain of five takes 0.85 of the time.
    """
    given = given_flags()
    if given is not None:
        return given
    if form == "plain":
        return PLAIN_FLAGS
    return (*FLAGS, "-mprefer-vector-width=256") if "avx512f" in processor() else FLAGS


def binding_flags() -> tuple[str, ...]:
    """Those of the binding: $EOMC_CFLAGS or -O1, since its speed is that of the calls in it."""
    return given_flags() or ("-O1",)


def given_flags() -> tuple[str, ...] | None:
    """The words of $EOMC_CFLAGS; None where it is not set."""
    given = os.environ.get("EOMC_CFLAGS")
    return None if given is None else tuple(_words("EOMC_CFLAGS", given))


def standard(form: str) -> str:
    """The language of a form of C."""
    return PLAIN_STANDARD if form == "plain" else STANDARD


@lru_cache(maxsize=1)
def processor() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        kept = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        return platform.machine() + " " + " ".join(sorted(kept))
    except OSError:
        return platform.machine() + " " + platform.processor()
