"""Faster compilation of modules for tests: precompiled headers, no inlining."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import sysconfig
from functools import cache
from pathlib import Path

from cases import SCENES

from eomc.toolchain import compiler

# The beginning of cffi's text, which then finds all of it precompiled.
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
# A third of the time is spent on functions that compilers are required to inline.
UNOPTIMISED = ("-O0", "-Dalways_inline=unused")
# The code of cffi for each array argument; one function for all of them takes half the time.
ARRAY = re.compile(
    r"""  datasize = _cffi_prepare_pointer_call_argument\(
      (_cffi_type\(\d+\)), (arg\d+), \(char \*\*\)&(x\d+)\);
  if \(datasize != 0\) \{
    \3 = \(\(size_t\)datasize\) <= 640 \? \([^)]*\)alloca\(\(size_t\)datasize\) : NULL;
    if \(_cffi_convert_array_argument\(\1, \2, \(char \*\*\)&\3,
            datasize, &large_args_free\) < 0\)
      return NULL;
  \}
"""
)
CALL = r"""  if (array_argument(\1, \2, (char **)&\3, &large_args_free) < 0)
    return NULL;
"""
FUNCTION = """
static int array_argument(struct _cffi_ctypedescr *type, PyObject *given, char **x,
                          struct _cffi_freeme_s **to_free)
{
  Py_ssize_t datasize = _cffi_prepare_pointer_call_argument(type, given, x);
  if (datasize == 0)
    return 0;
  *x = NULL;  /* it allocates what it then frees */
  return _cffi_convert_array_argument(type, given, x, datasize, to_free);
}
"""
# Functions that only call another one with the same arguments, whose address can be used instead.
DIRECT = re.compile(
    r"^static [^\n;]*?_cffi_d_(\w+)\([^\n]*\)\n\{\n  (?:return )?\1\([^\n]*\);\n\}\n", re.M
)
# A call from Python, which differs only by the name from that of functions of the same type.
WRAPPER = re.compile(
    r"^static PyObject \*\n_cffi_f_(\w+)\(PyObject \*self, PyObject \*args\)\n\{\n(.*?)^\}\n",
    re.M | re.S,
)
SHARED = """static PyObject *
{shared}(PyObject *self, PyObject *args, const char *name, __typeof__({name}) *function)
{{
{body}}}
"""
SHORT = """static PyObject *
_cffi_f_{name}(PyObject *self, PyObject *args)
{{
  return {shared}(self, args, "{name}", {name});
}}
"""
FLAGS = ("-fPIC", "-fvisibility=hidden", compiler.STANDARD, "-DNDEBUG", "-O0")


def shorten_binding(binding: str) -> str:
    """Return an equivalent of cffi's binding that compiles in two thirds of the time at -O0."""
    first = DIRECT.search(binding)
    if first is None:
        return binding
    head, functions = binding[: first.start()], binding[first.start() :]
    direct = set(DIRECT.findall(functions))
    functions = ARRAY.sub(CALL, DIRECT.sub("", functions))
    for name in direct:
        functions = functions.replace(f"(void *)_cffi_d_{name} ", f"(void *){name} ")
    return head + FUNCTION + _shared(functions)


def _shared(functions: str) -> str:
    """Merge all wrappers that differ by the name only into one function."""
    shared_names: dict[str, str] = {}

    def short(match: re.Match[str]) -> str:
        name, body = match.groups()
        body = body.replace(f'args, "{name}", ', "args, name, ")
        body = re.sub(rf"(\{{ (?:result = )?){name}\(", r"\1function(", body)
        new = body not in shared_names
        shared = shared_names.setdefault(body, f"wrapper_{len(shared_names)}")
        wrapper = SHORT.format(name=name, shared=shared)
        return SHARED.format(name=name, shared=shared, body=body) + wrapper if new else wrapper

    return WRAPPER.sub(short, functions)


@cache
def precompiled_header_flags() -> tuple[str, ...]:
    """Return gcc flags that save a third of a binding's compilation at -O0; none for others."""
    if os.environ.get("CC") or sys.platform != "linux":
        return ()
    c_compiler = compiler.find_compiler()
    if "gcc" not in Path(c_compiler.command[0]).resolve().name:
        return ()
    parts = (HEADER, *FLAGS, c_compiler.identity, sys.version, sys.prefix)
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    folder = SCENES.parent / "build" / "tests" / "precompiled"
    header, precompiled = folder / f"{name}.h", folder / f"{name}.h.gch"
    if not precompiled.exists():
        folder.mkdir(parents=True, exist_ok=True)
        new = folder / f"{name}.{os.getpid()}"
        new.write_text(HEADER, encoding="utf-8")
        os.replace(new, header)
        include = {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}
        words = [*FLAGS, *(f"-I{p}" for p in include), "-x", "c-header", str(header)]
        subprocess.run([*c_compiler.command, *words, "-o", str(new)], check=True)
        os.replace(new, precompiled)
    return ("-include", str(header))
