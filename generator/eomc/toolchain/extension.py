"""Compile sources to an extension module: cffi binding, two compilations, linking, load test."""

from __future__ import annotations

import importlib.util
import os
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eomc.toolchain.compiler import (
    STANDARD,
    Compiler,
    binding_flags,
    flags,
    run,
    standard,
    try_load,
)

if TYPE_CHECKING:
    from eomc.emit.render import Sources

_NO_ASSERTIONS = ("-DNDEBUG",)  # cffi's own assertions take a seventh of a call's time


def build(
    sources: Sources, extension: str, folder: Path, library: str, compiler: Compiler, form: str,
    optimised: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Compile sources to an extension module for Python, and test that it can be loaded.

    Parameters
    ----------
    sources
        The generated C, and the C that connects it with Python.
    extension, library
        Name of the module, and name of the file in `folder` to be written.
    folder
        Folder in which the generated C has been written.
    compiler
        The C compiler.
    form
        "fast" to compile the optimised C, "plain" for the portable C.
    optimised
        Optimisation flags of the compiler for the generated C; by default those of `form`.

    Raises
    ------
    EomcError
        With the compiler's message if it fails, or if the module can't be loaded.
    """
    import cffi

    name = sources.name
    ffi = cffi.FFI()
    ffi.cdef(sources.cdef)
    ffi.set_source(extension, sources.binding, compiler_verbose=0)
    subfolder = "fast/" if form == "fast" else ""  # folder of the header that the binding includes
    try:
        ffi.emit_c_code(str(folder / f"{subfolder}binding.c"))
    except FileNotFoundError as fault:  # cffi's clean-up hides why renaming its file failed
        first = fault.__context__
        raise first if isinstance(first, OSError) else fault from None
    include = [f"-I{p}" for p in {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}]
    common = [*compiler.command, "-fPIC", "-fvisibility=hidden"]
    binding_command = [*common, STANDARD, *_NO_ASSERTIONS, *binding_flags(), *include]
    scene_flags = optimised or flags(form)
    jobs = [
        [*common, standard(form), *scene_flags, "-c", f"{subfolder}{name}.c", "-o", "scene.o"],
        [*binding_command, "-c", f"{subfolder}binding.c", "-o", "binding.o"],
    ]
    run(name, folder, *jobs)
    link = [*compiler.command, "-shared", "scene.o", "binding.o", "-lm", "-o", library]
    if sys.platform == "darwin":
        link.insert(1, "-undefined")
        link.insert(2, "dynamic_lookup")
    if sys.platform == "win32":
        link.insert(link.index("-lm"), python_library(library))
    run(name, folder, link)
    backend = importlib.util.find_spec("_cffi_backend")
    assert backend is not None and backend.origin is not None
    arguments = (os.path.dirname(backend.origin), extension, str((folder / library).resolve()))
    # before it replaces another
    try_load(name, compiler.command, _LOAD_TEST, arguments, "; the last build stays")


def python_library(library: str) -> str:
    """Return the path of the Python library that an extension module is linked with on Windows.

    library: file name of the extension module. If it contains the version of the running Python,
    such as "311", the library is the one of that version; otherwise it is the one for all versions
    of Python 3 (stable ABI).
    """
    version = f"{sys.version_info[0]}{sys.version_info[1]}"
    name = f"python{version if version in library else 3}.lib"
    return str(Path(sys.base_prefix, "libs", name))


# imports an extension from a file, in a Python without site packages except cffi's backend
_LOAD_TEST = """
import sys
sys.path.append(sys.argv[1])
from importlib.machinery import ExtensionFileLoader, ModuleSpec
loader = ExtensionFileLoader(sys.argv[2], sys.argv[3])
loader.exec_module(loader.create_module(ModuleSpec(sys.argv[2], loader, origin=sys.argv[3])))
"""
