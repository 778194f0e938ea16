"""The picture of a system defined in Python is drawn and checked as the [picture] of a scene."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import numpy as np
import pytest
import sympy
from support.session import Modules
from sympy.physics.mechanics import dynamicsymbols

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.model.algebra import CONSTRUCTORS
from eomc.model.from_sympy import as_formula
from eomc.model.system import from_scene
from eomc.report.drawing import draw_mechanism
from eomc.scene import formulas
from eomc.scene.read import parse
from eomc.scene.toml_text import in_python

SCENE = """
eomc = 1
name = "crane"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad" }
[parameters]
m = 2.0
l = { value = 1.5, unit = "m" }
[inputs]
F = {}
[definitions]
x_p = "x - l*sin(theta)"
y_p = "l*cos(theta)"
[energy]
kinetic = "m*x_dot**2/2 + m*(dot(x_p)**2 + dot(y_p)**2)/2"
potential = "9.81*m*y_p"
[forces]
x = "F"
"""
PICTURE = """
[picture]
points = { cart = ["x", 0], load = ["x_p", "y_p"] }
lines = [["cart", "load"], ["world", [0, -0.2]]]
boxes = [{ at = "cart", size = [0.5, "l/8"], rotation = "theta/10" }]
circles = [{ at = "load", radius = "0.1*l" }]
springs = [[[-2, 0], "cart"]]
dots = ["load"]
paths = ["load"]
axes = "xz"
"""
T = np.array([0.0, 0.5])
Q = np.array([[0.1, 0.2], [-0.4, 1.3]])


def crane_with(picture: Any) -> eomc.System:
    """Return the crane of the scene."""
    return eomc.System.make(
        "crane", ["x", "theta"], "m*x_dot**2/2 + m*(dot(x_p)**2 + dot(y_p)**2)/2", "9.81*m*y_p",
        parameters={"m": 2.0, "l": 1.5}, definitions={"x_p": "x - l*sin(theta)",
        "y_p": "l*cos(theta)"}, inputs=["F"], forces={"x": "F"}, units={"x": "m", "l": "m"},
        picture=picture,
    )  # fmt: skip


def are_equal(one: Any, other: Any) -> None:
    assert (one.marks, one.paths, one.axes) == (other.marks, other.paths, other.axes)
    assert one.unit == other.unit and np.allclose(one.points, other.points, atol=1e-15)


def test_python_picture_is_drawn_as_that_of_a_scene() -> None:
    scene = from_scene(parse(SCENE + PICTURE))
    system = crane_with(tomllib.loads(PICTURE)["picture"])
    are_equal(draw_mechanism(system, T, Q), draw_mechanism(scene, T, Q))
    longer = draw_mechanism(system.with_parameters({"l": 3.0}), T, Q)
    are_equal(longer, draw_mechanism(scene.with_parameters({"l": 3.0}), T, Q))


def test_expressions_are_written_as_formulas() -> None:
    q, theta = dynamicsymbols("x theta")
    m, l, g = sympy.symbols("m l g", positive=True)  # noqa: E741 - the scene's name
    at = sympy.Matrix([q - l * sympy.sin(theta), l * sympy.cos(theta)])
    t = dynamicsymbols._t
    v = at.diff(t)
    system = eomc.System.make(
        "crane", [q, theta], m * q.diff(t) ** 2 / 2 + m * v.dot(v) / 2, g * m * at[1],
        parameters={m: 2, l: 1.5, g: 9.81}, units={q: "m"},
        picture={
            "points": {"cart": (q, np.float64(0)), "load": at},
            "lines": [("cart", "load"), ("world", (0, -0.2))],
            "boxes": [{"at": "cart", "size": [0.5, l / 8], "rotation": theta / 10}],
            "circles": [{"at": "load", "radius": l / 10}],
            "springs": [[(-2, 0), "cart"]],
            "dots": ["load"],
            "paths": ["load"],
            "axes": "xz",
        },
    )  # fmt: skip
    are_equal(
        draw_mechanism(system, T, Q), draw_mechanism(from_scene(parse(SCENE + PICTURE)), T, Q)
    )


@pytest.mark.parametrize(
    "picture",
    [
        "",
        'lines = [["cart", "tip"]]',
        "line = []",
        'dots = [["F", 0]]',
        'dots = [["x_dot", 0]]',
        'dots = [["dot(x_p)", 0]]',
        'dots = [["xx", 0]]',
        'dots = [["x^2", 0]]',
        'paths = "tip"',
        'boxes = [{ at = ["x", 0], size = ["x", 1] }]',
        'circles = [{ at = ["x", 0], radius = -1 }]',
        "dots = [[0, 0, 0], [0, 0]]",
        "springs = [[[0, 0], [1, 0], [2, 0]]]",
        'points = { world = ["x", 0] }',
        'dots = [["x", 0]]\naxes = "zx"',
    ],
)
def test_invalid_picture_gives_the_message_of_a_scene(picture: str) -> None:
    with pytest.raises(SceneError) as of_scene:
        parse(SCENE + "[picture]\n" + picture)
    with pytest.raises(SceneError, match=r"System crane: error: picture") as of_python:
        crane_with(tomllib.loads(picture))
    messages = [
        (p.key, in_python(p.message)) for p in of_scene.value.problems if p.severity == "error"
    ]
    assert messages == [
        (p.key, p.message) for p in of_python.value.problems if p.severity == "error"
    ]


@pytest.mark.parametrize(
    ("picture", "advice"),
    [
        ({}, 'such as "lines": [["cart", "tip"]]'),
        ({"paths": ["tip"]}, 'add it to "points", such as "tip": ["x", "l*cos(theta)"]'),
        ({"points": [1]}, 'a dict, such as {"tip": ["x", "l*cos(theta)"]}, here [1]'),
        ({"points": {"a": {}}}, "such as [0, 1.5], here a dict"),
        ({"boxes": [{}]}, 'such as [{"at": "cart", "size": [0.4, 0.2]}], here a dict'),
        ({"circles": [1]}, 'such as [{"at": "wheel", "radius": 0.1}], here 1'),
        ({"lines": [["world"]]}, 'such as [["cart", "tip"]], each through two points or more'),
        ({"dots": [[True, False]]}, "must be a number or a formula, here True"),
    ],
)
def test_advice_uses_the_terms_of_python(picture: Any, advice: str) -> None:
    with pytest.raises(SceneError) as error:
        crane_with(picture)
    (problem,) = error.value.problems[:1]
    assert advice in problem.message
    assert not re.search(r"\w = |table|\[picture|{ | }", problem.message), problem.message


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        ([1], r"picture: give a dict, such as .*\[1\]"),
        ({"dots": [[sympy.Symbol("zz"), 0]]}, "picture.dots: 'zz' is not declared"),
        (
            {"dots": [[sympy.gamma(sympy.Symbol("x")), 0]]},
            "picture: 'gamma' is not used in formulas",
        ),
        ({"dots": [[sympy.Symbol("x_dot"), 0]]}, "picture.dots: a picture can't depend on velo"),
    ],
)
def test_invalid_python_pictures_are_refused(picture: Any, message: str) -> None:
    with pytest.raises(EomcError, match=message):
        crane_with(picture)


def test_module_is_rebuilt_when_its_picture_changes() -> None:
    bare, one, other = (crane_with(p) for p in (None, {"dots": [["x", 0]]}, {"dots": [["x", 1]]}))
    assert len({bare.digest, one.digest, other.digest}) == 3
    assert crane_with({"dots": [["x", 0]]}).digest == one.digest


@pytest.mark.parametrize("name", sorted({*formulas.FUNCTIONS} - {"dot"}))
def test_every_function_is_written_in_formula_syntax(name: str) -> None:
    fewest, _ = formulas.FUNCTIONS[name]
    known = {"x": 1.3 if name == "acosh" else 0.3, "y": 0.7}
    written = f"{name}(x, y)" if fewest == 2 else f"{name}(x)"
    expr = sympy.sympify(written, {**CONSTRUCTORS})
    again = as_formula(expr + sympy.E - sympy.Rational(1, 7) + sympy.Float("0.1"))
    value = formulas.evaluate(again, formulas.NUMERIC, known.__getitem__)
    direct = formulas.evaluate(formulas.parse(written), formulas.NUMERIC, known.__getitem__)
    assert np.isclose(value, direct + np.e - 1 / 7 + 0.1, rtol=1e-14)


def test_runs_are_animated_in_pages(modules: Modules) -> None:
    drawn = modules.unoptimised(
        crane_with({"lines": [[["x", 0], ["x_p", "y_p"]]], "paths": [["x", 0]]})
    )
    assert 'class="stage"' in drawn.simulate(steps=20).animate().page
