"""Views have exactly the variables of their templates; modules that fill them contain no C."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jinja2.meta
import pytest
from cases import SCENES
from conftest import tiers

import eomc
from eomc.base import resources
from eomc.derive import lagrange
from eomc.emit import render
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.emit.public import Public
from eomc.model.system import System
from eomc.program import program

EMIT = Path(render.__file__).parent
MODULES = sorted(p.relative_to(EMIT).as_posix() for p in EMIT.rglob("*.py"))
INCLUDED = {
    "c/evaluations.c",  # included by the sources of both forms
    *(f"c/adaptive_{part}.c" for part in ("measures", "newton", "stages", "corners")),
}
# modules that contain C
MAY = ("c_function.py", "c_expression.py")


def _views() -> Iterator[Any]:
    """Yield the class of every view of a template."""
    names = [f"eomc.emit.{m.removesuffix('.py').replace('/', '.')}" for m in MODULES]
    for name in (*names, "eomc.report.reference_solution"):
        for value in vars(importlib.import_module(name)).values():
            if dataclasses.is_dataclass(value) and value.__module__ == name:
                if hasattr(value, "TEMPLATE"):
                    yield value


VIEWS = sorted(_views(), key=lambda v: str(v.TEMPLATE))


def variables_of(template: str) -> set[str]:
    """Return the variables that a template and the templates that it includes use."""
    source = resources.text("templates", f"{template}.jinja")
    tree = render.environment().parse(source)
    variables = jinja2.meta.find_undeclared_variables(tree)
    for name in jinja2.meta.find_referenced_templates(tree):
        assert name is not None
        variables |= variables_of(name.removesuffix(".jinja"))
    return variables


@pytest.mark.parametrize("view", VIEWS, ids=lambda v: str(v.TEMPLATE))
def test_view_has_the_variables_of_its_template(view: Any) -> None:
    assert variables_of(view.TEMPLATE) == {field.name for field in dataclasses.fields(view)}
    assert view.__dataclass_params__.frozen


def test_every_code_template_has_a_view() -> None:
    root = resources.folder("templates")
    templates = [p for part in ("c", "python", "fmu") for p in (root / part).rglob("*.jinja")]
    names = {p.relative_to(root).as_posix().removesuffix(".jinja") for p in templates}
    shown = {view.TEMPLATE for view in VIEWS if not view.TEMPLATE.startswith("report/")}
    assert names == shown | INCLUDED


@pytest.mark.parametrize("module", MODULES)
def test_python_modules_contain_no_c_syntax(module: str) -> None:
    """Only two modules contain semicolons, arrows, braces and const in texts."""
    if module in MAY:
        return
    tree = ast.parse((EMIT / module).read_text(encoding="utf-8"))
    prose = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and isinstance(node.body[0], ast.Expr)
    }
    texts = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose
    ]
    assert not [t for t in texts if re.search(r"->|\bconst\b|;$|\{$", t)]


@pytest.mark.parametrize(
    "name",
    tiers(["cartpole", "cartpole_driven", "chain", "suspension"], "cartpole", "cartpole_driven"),
)
def test_public_functions_agree_with_the_header(name: str) -> None:
    """The header declares each of them once, with these arguments."""
    functions_of_scene = program.build(lagrange.derive(eomc.read(SCENES / f"{name}.toml")))
    public, methods = (
        Public(Target(functions_of_scene, DOUBLE)),
        functions_of_scene.system.run.methods,
    )
    expected = [*public.evaluations(), public.acceleration]
    for method in methods:
        expected += [public.step(method), public.run(method)]
        expected += [public.batch(method)] if functions_of_scene.system.run.batch else []
    header = render.render(functions_of_scene, "_x").files[f"fast/{name}.h"]
    bare = re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
    declared = re.findall(r"^\w[\w *]*\b\w+\([^;{]*\);", bare, re.MULTILINE)
    prototypes = [re.sub(r"\s+", " ", text).removesuffix(";") for text in declared]
    assert [f.prototype for f in expected] == [t.replace("( ", "(") for t in prototypes]


def test_constants_are_computed_only_where_needed() -> None:
    system = System.make("free", ["x"], "x_dot**2/2", "x**2/2")
    assert "compute_constants" not in eomc.sources(system).files["fast/free.c"]
    system = System.make("free", ["x"], "m*x_dot**2/2", "x**2/2", parameters={"m": 1.0})
    assert "free_compute_constants(" in eomc.sources(system).files["fast/free.c"]
