"""A program as files: header, source, example, self-test and Python face, by Jinja templates.

The only file that knows Jinja. What the templates are given is made in context.py.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from importlib.util import cache_from_source
from pathlib import Path

import jinja2

from eomc import plain_steppers
from eomc.ccode import REALS
from eomc.context import resource, values
from eomc.pieces import weight
from eomc.plain_views import View
from eomc.program import Program
from eomc.target import Target

FAST = "fast"  # the folder of the form of C that the Python module is compiled from


@dataclass(frozen=True)
class Sources:
    """The text of the generated files by name, and what the extension is made of besides.

    binding: C between the scene's functions and Python, with its cdef. operations: how many all
    functions have together, which tells how long a compiler takes.
    """

    name: str
    files: Mapping[str, str]
    binding: str
    cdef: str
    operations: int


def environment() -> jinja2.Environment:
    """Jinja as it is used here: a missing variable stops the build."""
    loader = jinja2.FunctionLoader(lambda name: resource("templates", name))
    return jinja2.Environment(
        loader=loader,
        bytecode_cache=_bytecode(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # the output is C and Python, no HTML
    )


def _bytecode() -> jinja2.BytecodeCache | None:
    """Templates compiled to Python, kept where this module's own bytecode is, if it may be.

    Compiling them takes a fifth of a second, a third of what a small scene takes to be derived.
    """
    folder = Path(cache_from_source(__file__)).parent
    if sys.dont_write_bytecode or not os.access(folder, os.W_OK):
        return None
    return jinja2.FileSystemBytecodeCache(str(folder), "eomc-template-%s.cache")


def render(program: Program, extension: str) -> Sources:
    """The generated files of a program, its Python face importing `extension`.

    Same program, same text.
    """
    target = Target(program, REALS[program.system.run.real])
    context = {**values(target), "extension": extension}
    jinja = environment()
    name = program.system.name
    parts = ["runtime.py", "estimate.py", *(["batch.py"] if program.system.run.batch else [])]

    def text(template: str) -> str:
        return jinja.get_template(template + ".jinja").render(context)

    def show(view: View) -> str:
        given = {field.name: getattr(view, field.name) for field in fields(view)}
        return jinja.get_template(view.TEMPLATE + ".jinja").render(given)

    return Sources(
        name=name,
        files={
            **plain_steppers.files(program, show),
            f"{FAST}/{name}.h": text("header.h"),
            f"{FAST}/{name}.c": text("source.c"),
            "main.c": text("main.c"),
            "selftest.c": text("selftest.c"),
            "__init__.py": text("face.py"),
            **{part: (files("eomc") / part).read_text(encoding="utf-8") for part in parts},
        },
        binding=text("binding.c"),
        cdef=text("binding.cdef"),
        operations=sum(map(weight, program.functions.values())),
    )
