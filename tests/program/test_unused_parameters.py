"""Parameters of energies and forces that enter no equation of motion are warned of by name."""

from __future__ import annotations

import re

import sympy

from eomc import pipeline
from eomc.base.errors import Problem
from eomc.model.system import System, from_scene
from eomc.scene import read

SCENE = """eomc = 1
name = "m"
parameters = { M = 1, m = 1, I = 1, a = 1, shift = 1, none = 1, seen = 1, asked = 1, begun = 1 }
[coordinates]
x = { start = "begun" }
theta = {}
[definitions]
J = "2*I"
y = "x + asked"
z = "x + seen"
of_both = "asked*shift"
[energy]
kinetic = "M*x_dot/2 + m*theta_dot**2/2 + x_dot**2/2 + J*theta_dot + a*dot(z) + asked*x_dot"
potential = "cos(theta) + of_both + begun"
[forces]
x = "none - 2*none + none"
[outputs]
y = { formula = "y + energy" }
[picture]
dots = [["z", 0]]
"""


def warnings_of(system: System) -> list[Problem]:
    """Return the warnings of a build."""
    warnings: list[Problem] = []
    pipeline._program(system, warnings.append)
    return warnings


def test_parameters_in_no_equation_are_warned_of_at_their_line() -> None:
    """Use in outputs, pictures or initial values counts; use in energies as outputs does not."""
    problems = warnings_of(from_scene(read.parse(SCENE)))
    keys = {str(re.findall(r"'(\w+)'", p.message)[0]): p.key for p in problems}
    assert keys == {
        "M": "energy.kinetic", "I": "definitions.J", "a": "energy.kinetic",
        "shift": "definitions.of_both", "none": "forces.x",
    }  # fmt: skip
    assert all(p.severity == "warning" and p.line for p in problems)
    why = {p.key: p.message for p in problems if p.message[1] in "MI"}
    assert "has it with x_dot, but not its square; write x_dot**2" in why["energy.kinetic"]
    assert "has it with theta_dot, but not its square" in why["definitions.J"]


def test_parameters_of_bodies_are_not_warned_of() -> None:
    """The mass of a fixed body is no mistake."""
    text = """eomc = 1
name = "b"
gravity = [0, -9.81]
parameters = { m = 1, I = 1 }
coordinates.x = {}
[[body]]
name = "base"
joint = "fixed"
mass = "m"
inertia = "I"
[[body]]
name = "cart"
parent = "base"
joint = "prismatic"
axis = [1, 0]
coordinates = "x"
mass = 1
inertia = "I"
"""
    assert warnings_of(from_scene(read.parse(text))) == []


def test_systems_defined_in_python_warn_too() -> None:
    x, v, m, shift, offset = sympy.symbols("x x_dot m shift seen")
    system = System.make(
        "made", [x], m * v + v**2, shift + offset + x**2, parameters={m: 1, shift: 2, offset: 3},
        picture={"points": {"tip": [x + offset, 0]}, "dots": ["tip"]},
    )  # fmt: skip
    problems = warnings_of(system)
    assert [p.key for p in problems] == ["kinetic", "potential"]
    assert "'m' reaches no" in str(problems[0]) and "'shift' reaches no" in str(problems[1])
