"""What saves time where modules are compiled for tests: headers compiled once, nothing inlined."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import sysconfig
from functools import cache
from pathlib import Path

from cases import SCENES

from eomc.toolchain import compiler

# what cffi's text has before its own, which then finds all of it there
HEADER = """
#define _CFFI_
#include <pyconfig.h>
#if !defined(Py_DEBUG) && !defined(Py_TRACE_REFS) && !defined(Py_GIL_DISABLED)
#define Py_LIMITED_API
#endif
#include <Python.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <stdint.h>
#include <assert.h>
#undef _CFFI_
#undef Py_LIMITED_API
"""
# a third of the time goes into functions that have to be inlined: to compilers they have not
UNOPTIMISED = ("-O0", "-Dalways_inline=unused")
FLAGS = ("-fPIC", "-fvisibility=hidden", compiler.STANDARD, "-DNDEBUG", "-O0")


@cache
def included() -> tuple[str, ...]:
    """Flags of gcc that take a third from the compilation of a binding at -O0; none of others."""
    if os.environ.get("CC") or sys.platform != "linux":
        return ()
    found = compiler.find_compiler()
    if "gcc" not in Path(found.command[0]).resolve().name:
        return ()
    parts = (HEADER, *FLAGS, found.identity, sys.version, sys.prefix)
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    folder = SCENES.parent / "build" / "tests" / "precompiled"
    header, made = folder / f"{name}.h", folder / f"{name}.h.gch"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        new = folder / f"{name}.{os.getpid()}"
        new.write_text(HEADER, encoding="utf-8")
        os.replace(new, header)
        include = {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}
        words = [*FLAGS, *(f"-I{p}" for p in include), "-x", "c-header", str(header)]
        subprocess.run([*found.command, *words, "-o", str(new)], check=True)
        os.replace(new, made)
    return ("-include", str(header))
