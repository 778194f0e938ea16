"""Sources to a compiled extension: cffi's wrapper, two compilations, a link, a trial."""

from __future__ import annotations

import importlib.util
import os
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eomc.toolchain.compiler import STANDARD, Compiler, binding_flags, flags, standard
from eomc.toolchain.running import run, try_out

if TYPE_CHECKING:
    from eomc.emit.render import Sources

_UNASSERTED = ("-DNDEBUG",)  # cffi asserts its own tables at each call: a seventh of the time


def build(
    made: Sources, extension: str, folder: Path, library: str, compiler: Compiler, form: str,
    optimised: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Compile the sources that lie in `folder` and link `library` there; it can be loaded then.

    optimised: other flags than those of the form.
    Raises EomcError where the compiler fails, with its own words.
    """
    import cffi

    name = made.name
    ffi = cffi.FFI()
    ffi.cdef(made.cdef)
    ffi.set_source(extension, made.binding, compiler_verbose=0)
    at = "fast/" if form == "fast" else ""  # where the header lies that the binding includes
    try:
        ffi.emit_c_code(str(folder / f"{at}binding.c"))
    except FileNotFoundError as fault:  # of what cffi removes once it could not rename its file
        first = fault.__context__
        raise first if isinstance(first, OSError) else fault from None
    include = [f"-I{p}" for p in {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}]
    common = [*compiler.command, "-fPIC", "-fvisibility=hidden"]
    bound = [*common, STANDARD, *_UNASSERTED, *binding_flags(), *include]
    scene_flags = optimised or flags(form)
    jobs = [
        [*common, standard(form), *scene_flags, "-c", f"{at}{name}.c", "-o", "scene.o"],
        [*bound, "-c", f"{at}binding.c", "-o", "binding.o"],
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
    given = (os.path.dirname(backend.origin), extension, str((folder / library).resolve()))
    # before it replaces another
    try_out(name, compiler.command, _TRIAL, given, "; the last build stays")


def python_library(library: str) -> str:
    """What extensions are linked with on Windows, of their own Python or, abi3, of any Python 3."""
    version = f"{sys.version_info[0]}{sys.version_info[1]}"
    name = f"python{version if version in library else 3}.lib"
    return str(Path(sys.base_prefix, "libs", name))


# imports an extension from a file, with nothing of Python's own start-up but cffi's backend
_TRIAL = """
import sys
sys.path.append(sys.argv[1])
from importlib.machinery import ExtensionFileLoader, ModuleSpec
loader = ExtensionFileLoader(sys.argv[2], sys.argv[3])
loader.exec_module(loader.create_module(ModuleSpec(sys.argv[2], loader, origin=sys.argv[3])))
"""
