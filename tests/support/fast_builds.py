"""Faster builds in tests: precompiled headers, no inlining, the same C compiled once."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Sequence
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import TYPE_CHECKING, Any

from eomc.toolchain import compiler, extension
from eomc.verify.sampling import Sampler

if TYPE_CHECKING:
    from eomc.emit.render import Sources
    from eomc.toolchain.compiler import Compiler
    from eomc.verify.reference import ReferenceModel, Vector
    from eomc.verify.sampling import SampleBudget
from support.cases import SCENES

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


# Runtime files are identical in all built modules: compile them to bytecode once.
_get_code = SourceFileLoader.get_code
_codes: dict[bytes, CodeType] = {}


def _code_once(loader: SourceFileLoader, name: str) -> CodeType | None:
    path = Path(loader.get_filename(name))
    folder = path.parent.parent if path.parent.name == "_runtime" else path.parent
    if not (folder / "build.json").exists():
        return _get_code(loader, name)
    text = path.read_bytes()
    if text not in _codes:
        _codes[text] = loader.source_to_code(text, str(path))
    return _codes[text]


def _binding_flags() -> tuple[str, ...]:
    """Compile the binding without optimisation, in half the time; its speed does not matter."""
    flags = compiler.user_flags()
    if os.environ.get("CC") or (flags is not None and flags != ("-O0",)):
        return flags or ("-O0",)
    return ("-O0", *precompiled_header_flags())


_run, _build, _try = extension.run, extension.build, extension.try_load
_copy, _replace = shutil.copyfile, os.replace  # a test may replace them
# Compiled libraries, shared by the processes of a session and reused in later sessions.
LIBRARIES = SCENES.parent / "build" / "tests" / "libraries"
MAX_UNUSED_SECONDS = 3 * 86400


def _build_once(
    sources: Sources, name: str, folder: Path, library: str, by: Compiler, *how: Any
) -> None:
    """Reuse the result for the same C and compiler, unless a test sets one."""
    if os.environ.get("CC"):
        _build(sources, name, folder, library, by, *how)
        return
    if len(how) == 1 and compiler.user_flags() == ("-O0",):
        how = (*how, UNOPTIMISED)
    form = str(how[0])
    kernel = {file: text for file, text in sources.files.items() if file.endswith((".c", ".h"))}
    flags = (
        compiler.flags(form),
        compiler.standard(form),
        _binding_flags(),
        _builders(),
        compiler.processor(),
    )
    parts = (kernel, sources.binding, sources.cdef, name, library, by, how, flags, sys.version)
    key = hashlib.sha256(repr(parts).encode()).hexdigest()
    compiled = LIBRARIES / f"{key[:32]}.so"
    with contextlib.suppress(FileNotFoundError):
        _copy(compiled, folder / library)
        os.utime(compiled)
        return
    _build(sources, name, folder, library, by, *how)
    copy = LIBRARIES / f"{key[:32]}.{os.getpid()}"
    LIBRARIES.mkdir(parents=True, exist_ok=True)
    _copy(folder / library, copy)
    _replace(copy, compiled)


@cache
def _builders() -> tuple[str, ...]:
    """Return the source of what determines how libraries are compiled and linked."""
    return tuple(Path(str(file)).read_text("utf-8") for file in (extension.__file__, __file__))


def _remove_unused_libraries() -> None:
    """Remove libraries that no session has used for days."""
    now = time.time()
    for file in LIBRARIES.glob("*"):
        with contextlib.suppress(FileNotFoundError):
            if now - file.stat().st_mtime > MAX_UNUSED_SECONDS:
                file.unlink()


def _link(name: str, folder: Path, *commands: Sequence[str]) -> None:
    """Omit startup files when linking a library that Python loads; this saves time."""
    if not os.environ.get("CC"):
        for words in commands:
            if words[-3].endswith("binding.c") and words[-1] == "binding.o" and "-O0" in words:
                file = folder / words[-3]
                file.write_text(shorten_binding(file.read_text("utf-8")), "utf-8")
    plain = os.environ.get("CC") or sys.platform != "linux" or "-shared" not in commands[0]
    _run(name, folder, *commands if plain else [[*commands[0], "-nostdlib"]])


def _trial(*what: Any) -> None:
    """Skip the trial for the default compiler, because its library is loaded next."""
    if os.environ.get("CC"):
        _try(*what)


_original_ranges = Sampler.predicted_ranges
_cached_ranges: dict[tuple[int, SampleBudget], tuple[ReferenceModel, Vector]] = {}


def _predicted_ranges_once(sampler: Sampler, effort: SampleBudget) -> Vector:
    """Cache the predicted ranges, which take most of the time of drawing a few states."""
    key = (id(sampler.reference), effort)
    if key not in _cached_ranges:
        # The stored reference keeps its id valid.
        _cached_ranges[key] = (sampler.reference, _original_ranges(sampler, effort))
    return _cached_ranges[key][1]


def install() -> None:
    """Let all builds of this process use these."""
    _remove_unused_libraries()
    SourceFileLoader.get_code = _code_once  # type: ignore[method-assign]
    extension.binding_flags = _binding_flags
    extension.build, extension.run, extension.try_load = _build_once, _link, _trial
    Sampler.predicted_ranges = _predicted_ranges_once  # type: ignore[method-assign]
