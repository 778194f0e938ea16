"""The views of the templates beside both forms of C, and the calls in them."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jinja2.meta
import pytest
from cases import SCENES

import eomc
from eomc.base import resources
from eomc.derive import lagrange
from eomc.emit import render, views
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.emit.public import Public
from eomc.program import program

VIEWS = [v for v in vars(views).values() if dataclasses.is_dataclass(v) and hasattr(v, "TEMPLATE")]


@pytest.mark.parametrize("view", VIEWS)
def test_a_view_has_what_its_template_asks_for(view: Any) -> None:
    source = resources.text("templates", f"{view.TEMPLATE}.jinja")
    asked = jinja2.meta.find_undeclared_variables(render.environment().parse(source))
    assert asked == {field.name for field in dataclasses.fields(view)}
    assert view.__dataclass_params__.frozen


def test_every_template_beside_the_forms_has_a_view() -> None:
    root = resources.folder("templates")
    there = [*(root / "python").iterdir(), *(root / "c").glob("*.jinja")]
    names = {p.relative_to(root).as_posix().removesuffix(".jinja") for p in there}
    assert names == {view.TEMPLATE for view in VIEWS}


@pytest.mark.parametrize("name", ["cartpole", "cartpole_driven", "chain", "suspension"])
def test_public_functions_are_those_of_the_header(name: str) -> None:
    """Each is declared there once, with these arguments."""
    made = program.build(lagrange.derive(eomc.read(SCENES / f"{name}.toml")))
    public, methods = Public(Target(made, DOUBLE)), made.system.run.methods
    expected = [*public.evaluations(), public.acceleration]
    for method in methods:
        expected += [public.step(method), public.run(method)]
        expected += [public.batch(method)] if made.system.run.batch else []
    header = render.render(made, "_x").files[f"fast/{name}.h"]
    bare = re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
    declared = re.findall(r"^\w[\w *]*\b\w+\([^;{]*\);", bare, re.MULTILINE)
    told = [re.sub(r"\s+", " ", text).removesuffix(";") for text in declared]
    assert [f.prototype for f in expected] == [t.replace("( ", "(") for t in told]
