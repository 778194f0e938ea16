"""A program as files: header, source, example, self-test and Python face, by Jinja templates.

The only file that knows Jinja for C. What each template is given is a view.
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
from eomc.emit import embedding, package, selftest, views
from eomc.emit.c_expression import REALS, indent
from eomc.emit.c_function import narrowed
from eomc.emit.c_names import Target
from eomc.emit.c_safe_names import borne
from eomc.emit.fast import files as fast
from eomc.emit.fast import views as fast_views
from eomc.emit.fmu import files as fmu
from eomc.emit.fmu import views as fmu_views
from eomc.emit.plain import steppers
from eomc.emit.plain import views as plain_views
from eomc.program.outline import weight
from eomc.program.program import Program

FAST = "fast"  # the folder of the form of C that the Python module is compiled from


@dataclass(frozen=True)
class Sources:
    """The text of the generated files by name, and what the extension is made of besides.

    binding: C between the scene's functions and Python, with its cdef. stub: the package's types.
    operations: how many all functions have together, which tells how long a compiler takes.
    """

    name: str
    files: Mapping[str, str]
    binding: str
    cdef: str
    stub: str
    operations: int

    @property
    def embeddable(self) -> dict[str, str]:
        """The files that a C program may need, without those of the Python package."""
        return {file: text for file, text in self.files.items() if not file.endswith(".py")}


@cache
def environment() -> jinja2.Environment:
    """Jinja as it is used here: a missing variable stops the build, free text as it stands too.

    Pages are escaped by themselves; a Python face escapes its docstring as a whole.
    """
    loader = jinja2.FunctionLoader(lambda name: resources.text("templates", name))
    made = jinja2.Environment(
        loader=loader,
        bytecode_cache=_bytecode(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=lambda name: (name or "").endswith(".html.jinja"),
    )
    made.filters["docstring"] = docstring
    made.filters["block"] = indent
    return made


def _bytecode() -> jinja2.BytecodeCache | None:
    """Templates compiled to Python, kept where this module's own bytecode is, if it may be.

    Compiling them takes a fifth of a second, a third of what a small scene takes to be derived.
    """
    folder = Path(cache_from_source(__file__)).parent
    if sys.dont_write_bytecode or not os.access(folder, os.W_OK):
        return None
    return jinja2.FileSystemBytecodeCache(str(folder), "eomc-template-%s.cache")


def show(view: views.View | plain_views.View | fast_views.View | fmu_views.View) -> str:
    """A view by its template."""
    given = {field.name: getattr(view, field.name) for field in fields(view)}
    return environment().get_template(view.TEMPLATE + ".jinja").render(given)


def _plain_names(program: Program) -> None:
    """Raise ValueError where a name could not stand in code."""
    s = program.system
    for given in (*s.coordinates, *s.parameters, *s.inputs, *(d for d, _ in s.definitions), s):
        plain(given.name)


def render(program: Program, extension: str) -> Sources:
    """The generated files of a program, its Python face importing `extension`.

    Same program, same text.
    """
    _plain_names(program)
    program, written = borne(program)
    run = program.system.run
    target = Target(program, REALS[run.real], written)
    binding = package.binding(target)
    name = program.system.name
    made = fast.steppers(target)
    return Sources(
        name=name,
        files={
            **steppers.files(program, show, rooms=fast.rooms(made)),
            **{f"{FAST}/{file}": text for file, text in fast.files(made, show).items()},
            "main.c": narrowed(show(package.main(target))),
            "selftest.c": narrowed(show(selftest.view(target))),
            "CMakeLists.txt": show(embedding.cmake(target)),
            f"{name}.pc.in": show(embedding.pkg_config(target)),
            "costs.txt": show(embedding.costs(target)),
            "__init__.py": show(package.face(target, extension)),
            **resources.runtime(run.batch),
        },
        binding=show(binding),
        cdef=show(package.declarations(binding)),
        stub=show(package.stub(target)),
        operations=sum(map(weight, program.functions.values())),
    )


def unit(program: Program, version: int) -> fmu.Unit:
    """The unit of FMI 2 or 3 of a program."""
    _plain_names(program)
    return fmu.unit(program, version, show, show)
