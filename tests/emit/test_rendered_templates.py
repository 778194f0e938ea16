"""Templates get the variables and attributes that they read; modules that fill them have no C."""

from __future__ import annotations

import ast
import dataclasses
import re
import types
from functools import cached_property
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import jinja2.meta
import pytest
from support.cases import SCENES
from support.session import tiers

import eomc
from eomc.base import resources
from eomc.derive import lagrange
from eomc.emit import render
from eomc.emit.common import templates
from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.public import Public
from eomc.emit.package import Form
from eomc.model.system import System, from_scene
from eomc.pipeline import assemble
from eomc.program import program
from eomc.scene.read import parse

EMIT = Path(render.__file__).parent
MODULES = sorted(p.relative_to(EMIT).as_posix() for p in EMIT.rglob("*.py"))
INCLUDED = {
    "c/evaluations.c",  # included by the sources of both forms
    "c/linearization.c",
    "c/options.h",
    "c/output.h",
    "c/optimised/two_point.c",  # included by lane.c
}
# objects that every template of a scene gets
SHARED = {"functions", "public", "target", "run", "comments", "prefix", "PREFIX", "real"}
MAX_OBJECTS = 94  # of all templates
SCENE = SCENES / "cartpole.toml"
# modules that contain or read C
MAY = tuple(f"common/{name}.py" for name in ("amalgamate", "c_function", "c_expression"))


ROOT = resources.folder("templates")
TEMPLATES = sorted(
    p.relative_to(ROOT).as_posix().removesuffix(".jinja")
    for part in ("c", "python", "fmu")
    for p in (ROOT / part).rglob("*.jinja")
)
EVENTS = '[[event]]\nname = "low"\nwhen = "theta - 0.1"\naction = "record"\n'
# scenes, and settings of [run] or further tables, that together use every template
RENDERED = {
    "cartpole": '[run]\nreal = "float"\nbatch = true\ntolerance = 1e-4\nlinearize = "products"\n',
    "cartpole_driven": '[run]\nmethod = ["rk4", "dp8", "gauss4", "gauss16"]\ndiscretize = true\n',
    "bead_on_hoop": EVENTS,
    "four_bar": "[run]\nbatch = true\n",
    "chain": "",
}
UNITS = ("cartpole", "cartpole_driven", "bead_on_hoop")  # of which FMUs are made as well


def _type_of(value: Any) -> Any:
    """Return the type of a variable, with that of the elements of a list; None if it is unknown."""
    if isinstance(value, list | tuple):
        return tuple[type(value[0]), ...] if value else None  # type: ignore[misc]
    return None if value is None else type(value)


@pytest.fixture(scope="module")
def observed() -> dict[str, list[dict[str, Any]]]:
    """The types of the variables that each template has got, by the template's name."""
    forms = {"prefix": str, "version": str, "forms": tuple[Form, ...]}  # of a wheel
    seen: dict[str, list[dict[str, Any]]] = {"python/compiled.py": [forms]}
    wrapped = jinja2.Template.render

    def record(self: jinja2.Template, variables: dict[str, Any]) -> str:
        types_of = {name: _type_of(value) for name, value in variables.items()}
        seen.setdefault(str(self.name).removesuffix(".jinja"), []).append(types_of)
        return wrapped(self, variables)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jinja2.Template, "render", record)
        for name, settings in RENDERED.items():
            text = (SCENES / f"{name}.toml").read_text()
            more = settings if settings.startswith("[run]") else f"{settings}[run]\n"
            parsed = parse(text.replace("[run]\n", more), f"{name}.toml")
            system = assemble(from_scene(parsed))
            eomc.sources(system)
            for version in (2, 3) if name in UNITS else ():
                eomc.pipeline.unit(system, version)
    return seen


def variables_of(template: str) -> set[str]:
    """Return the variables that a template and the templates that it includes use."""
    source = resources.text("templates", f"{template}.jinja")
    tree = templates.environment().parse(source)
    variables = jinja2.meta.find_undeclared_variables(tree)
    for name in jinja2.meta.find_referenced_templates(tree):
        assert name is not None
        variables |= variables_of(name.removesuffix(".jinja"))
    return variables


@pytest.mark.slow
@pytest.mark.parametrize("template", sorted({*TEMPLATES} - INCLUDED))
def test_template_gets_the_variables_that_it_reads(
    template: str, observed: dict[str, list[dict[str, Any]]]
) -> None:
    shared = set() if template == "python/compiled.py" else SHARED
    for variables in observed[template]:
        assert {*variables} - shared <= variables_of(template) <= {*variables}


def test_templates_get_few_objects(observed: dict[str, list[dict[str, Any]]]) -> None:
    """Templates read attributes of few objects. The limit may be lowered."""
    assert sum(len({*variables} - SHARED) for (variables, *_) in observed.values()) <= MAX_OBJECTS


@dataclasses.dataclass(frozen=True)
class Method:
    """The type of a method: of what it returns."""

    returned: Any


def type_of_attribute(owner: Any, name: str) -> Any:
    """Return the declared type of an attribute; None if it is not known."""
    options = [t for t in get_args(owner) if t is not type(None)]
    if get_origin(owner) in (Union, types.UnionType) and len(options) == 1:
        owner = options[0]
    if not isinstance(owner, type) or not owner.__module__.startswith("eomc."):
        return None
    hints = get_type_hints(owner)
    if name in hints:
        return hints[name]
    value = getattr(owner, name, None)
    assert value is not None, f"{owner.__name__} has no attribute {name}"
    if isinstance(value, property):
        return get_type_hints(value.fget).get("return")
    if isinstance(value, cached_property):
        return get_type_hints(value.func).get("return")
    return Method(get_type_hints(value).get("return"))


def type_of_element(container: Any) -> Any:
    """Return the declared type of the elements of a tuple or list; None if it is not known."""
    elements = get_args(container) if get_origin(container) in (tuple, list) else ()
    return elements[0] if elements else None


def check_types(node: jinja2.nodes.Node, scope: dict[str, Any]) -> Any:
    """Check that the attributes that a template reads exist; return the type of an expression.

    scope: types of variables by name; None for those that are not known.
    """
    if isinstance(node, jinja2.nodes.Include):
        assert isinstance(node.template, jinja2.nodes.Const)
        source = resources.text("templates", node.template.value)
        return check_types(templates.environment().parse(source), scope)
    if isinstance(node, jinja2.nodes.Name):
        return scope.get(node.name)
    if isinstance(node, jinja2.nodes.For):
        assigned = type_of_element(check_types(node.iter, scope))
        names = [name.name for name in node.target.find_all(jinja2.nodes.Name)]
        names += [node.target.name] if isinstance(node.target, jinja2.nodes.Name) else []
        scope = scope | dict.fromkeys(names, assigned if len(names) == 1 else None)
    if isinstance(node, jinja2.nodes.Assign) and isinstance(node.target, jinja2.nodes.Name):
        scope[node.target.name] = check_types(node.node, scope)
        return None
    types_of_children = [check_types(child, scope) for child in node.iter_child_nodes()]
    if isinstance(node, jinja2.nodes.Getattr):
        return type_of_attribute(types_of_children[0], node.attr)
    if isinstance(node, jinja2.nodes.Getitem):
        return type_of_element(types_of_children[0])
    if isinstance(node, jinja2.nodes.Call):
        function = types_of_children[0]
        return function.returned if isinstance(function, Method) else None
    return None


@pytest.mark.parametrize("template", sorted({*TEMPLATES} - INCLUDED))
def test_template_reads_existing_attributes(
    template: str, observed: dict[str, list[dict[str, Any]]]
) -> None:
    """Also in branches that no scene of the tests takes."""
    tree = templates.environment().parse(resources.text("templates", f"{template}.jinja"))
    for variables in observed[template]:
        check_types(tree, dict(variables))


def test_attributes_that_do_not_exist_are_found() -> None:
    for text in (
        "{{ target.inputs[0].nme }}",
        "{% for x in target.inputs %}{{ x.nme }}{% endfor %}",
        '{{ functions.public.step("rk4").nme }}',
        "{% set x = target %}{{ x.nme }}",
    ):
        with pytest.raises(AssertionError, match="nme"):
            types_of = {"functions": SceneFunctions, "target": Target}
            check_types(templates.environment().parse(text), types_of)


def test_templates_do_not_read_the_system() -> None:
    """It contains free text, which templates get in escaped form only."""
    functions = SceneFunctions(Target(program.build(lagrange.derive(eomc.read(SCENE))), DOUBLE))
    for text in ("{{ f.target.system.title }}", "{{ f.target.program.system }}"):
        with pytest.raises(TypeError, match="templates do not read"):
            templates.environment().from_string(text).render(f=functions)


@pytest.mark.parametrize("module", MODULES)
def test_python_modules_contain_no_c_syntax(module: str) -> None:
    """Only these modules contain semicolons, arrows, braces and const in texts."""
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
    expected += [*map(public.step, methods), public.integrate]
    expected += [public.integrate_batch] if functions_of_scene.system.run.batch else []
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
