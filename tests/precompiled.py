"""What saves time where modules are compiled for tests: headers compiled once, nothing inlined."""

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
# what cffi writes for each argument that is an array; of one function for all of them half the time
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
# functions that only call another one of the same arguments, whose address serves as well
DIRECT = re.compile(
    r"^static [^\n;]*?_cffi_d_(\w+)\([^\n]*\)\n\{\n  (?:return )?\1\([^\n]*\);\n\}\n", re.M
)
# a call from Python, which differs from those of functions of one type by the name alone
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


def shortened(binding: str) -> str:
    """What cffi has written, which does the same, compiled in two thirds of the time at -O0."""
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
    """With one function for all wrappers that do the same by another name."""
    made: dict[str, str] = {}

    def short(found: re.Match[str]) -> str:
        name, body = found.groups()
        body = body.replace(f'args, "{name}", ', "args, name, ")
        body = re.sub(rf"(\{{ (?:result = )?){name}\(", r"\1function(", body)
        new = body not in made
        shared = made.setdefault(body, f"wrapper_{len(made)}")
        wrapper = SHORT.format(name=name, shared=shared)
        return SHARED.format(name=name, shared=shared, body=body) + wrapper if new else wrapper

    return WRAPPER.sub(short, functions)


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
