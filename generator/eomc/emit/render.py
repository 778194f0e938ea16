"""Rendering of a program to files by Jinja templates: header, source, example, self-test, package.

This is the only module that uses Jinja for C. Each template gets its data as one frozen dataclass.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from importlib.util import cache_from_source
from pathlib import Path

import jinja2

from eomc.base import resources
from eomc.base.texts import docstring
from eomc.base.texts import name as plain
from eomc.emit import embedding, package, portable, selftest
from eomc.emit.c_expression import REALS, indent
from eomc.emit.c_function import break_comments
from eomc.emit.c_names import Target, rename_for_c
from eomc.emit.fmu.unit import Unit, render_unit
from eomc.emit.optimised import files as optimised
from eomc.emit.views import View
from eomc.program.outline import weight
from eomc.program.program import Program

FAST = "fast"  # the folder of optimised C, from which the Python module is compiled


@dataclass(frozen=True)
class Sources:
    """The generated files, and the sources of the compiled extension of the Python package.

    Attributes
    ----------
    name
        Name of the scene.
    files
        Text of each generated file by its path.
    binding, cdef
        C code between the scene's C functions and Python, and its declarations for cffi.
    stub
        Type stubs of the Python package.
    operations
        Total number of operations of all functions, a measure of compile time.
    """

    name: str
    files: Mapping[str, str]
    binding: str
    cdef: str
    stub: str
    operations: int

    @property
    def embeddable(self) -> dict[str, str]:
        """The files for use from C, by path, without the Python package."""
        return {file: text for file, text in self.files.items() if not file.endswith(".py")}


@cache
def environment() -> jinja2.Environment:
    """Return the Jinja environment, in which undefined variables are errors.

    Text is inserted into templates unchanged, except that it is escaped in HTML pages. The filter
    `docstring` escapes text for docstrings, and `block` indents C statements.
    """
    loader = jinja2.FunctionLoader(lambda name: resources.text("templates", name))
    result = jinja2.Environment(
        loader=loader,
        bytecode_cache=_bytecode(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=lambda name: (name or "").endswith(".html.jinja"),
    )
    result.filters["docstring"] = docstring
    result.filters["block"] = indent
    return result


def _bytecode() -> jinja2.BytecodeCache | None:
    """Return a cache for compiled templates next to this module's bytecode, if it is writable.

    Compiling the templates takes 0.2 s, a third of the derivation of a small scene.
    """
    folder = Path(cache_from_source(__file__)).parent
    if sys.dont_write_bytecode or not os.access(folder, os.W_OK):
        return None
    return jinja2.FileSystemBytecodeCache(str(folder), "eomc-template-%s.cache")


def show(view: View) -> str:
    """Return the text of a generated file.

    `view` has the data of the file. Its class attribute TEMPLATE names the Jinja template.
    """
    context = {field.name: getattr(view, field.name) for field in fields(view)}
    return environment().get_template(view.TEMPLATE + ".jinja").render(context)


def _plain_names(program: Program) -> None:
    """Raise ValueError if a name of the program is not plain, so that it cannot stand in code."""
    s = program.system
    for item in (*s.coordinates, *s.parameters, *s.inputs, *(d for d, _ in s.definitions), s):
        plain(item.name)


def render(program: Program, extension: str) -> Sources:
    """Return all generated files of a program, the list of functions derived from a scene.

    The same program always gives the same text. extension: name of the compiled extension module,
    which the Python package imports.
    """
    _plain_names(program)
    program, written = rename_for_c(program)
    run = program.system.run
    target = Target(program, REALS[run.real], written)
    binding = package.binding_view(target)
    name = program.system.name
    methods = optimised.steppers(target)
    return Sources(
        name=name,
        files={
            **portable.files(program, show, written=written),
            **{f"{FAST}/{file}": text for file, text in optimised.files(methods, show).items()},
            "main.c": break_comments(show(embedding.main_view(target))),
            "selftest.c": break_comments(show(selftest.selftest_view(target))),
            "CMakeLists.txt": show(embedding.cmake_view(target)),
            f"{name}.pc.in": show(embedding.pkg_config_view(target)),
            "costs.txt": show(embedding.costs_view(target)),
            "__init__.py": show(package.face_view(target, extension)),
            **resources.runtime(run.batch),
        },
        binding=show(binding),
        cdef=show(package.declarations_view(binding)),
        stub=show(package.stub_view(target)),
        operations=sum(map(weight, program.functions.values())),
    )


def unit(program: Program, version: int) -> Unit:
    """Return the functional mock-up unit (FMU) of a program: its C code and model description.

    version: version of the FMI standard, 2 or 3.
    """
    _plain_names(program)
    return render_unit(program, version, show)
