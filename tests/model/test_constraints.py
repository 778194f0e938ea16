"""Constraints of a System: holonomic and nonholonomic rows, fixed and free initial values."""

import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

from eomc.base.errors import EomcError
from eomc.model.constraints import VelocityDegree
from eomc.model.symbols import Coordinate, dot, symbol, t
from eomc.model.system import System, from_scene
from eomc.scene.read import parse

SCENE = """
eomc = 1
name = "rows"

[constants]
n = 2

[coordinates]
a    = { start = 0.1, rate = 0.2 }
b    = { start = 0.1, rate = 0.2, guess = true }
c    = { unit = "m" }
d    = { start = "l/2" }
"e[i]" = { repeat = "i = 1..n", start = "0.1*i", guess = true }

[parameters]
l = 1.0

[definitions]
y = "l*sin(a)"
w = "dot(y)*cos(b) - c_dot"

[energy]
kinetic = "(a_dot**2 + b_dot**2 + c_dot**2 + d_dot**2 + e1_dot**2 + e2_dot**2)/2"
"""
ROWS = """
[constraints]
first  = "y - c*t"
blade  = { formula = "w*b - l", unit = "m/s", note = "no slip" }
second = { formula = "a - b", unit = "rad" }
"third[i]" = { repeat = "i = 1..n", formula = "e[i] - i*a" }
"""


def test_holonomic_constraints_come_first_in_their_order():
    system = from_scene(parse(SCENE + ROWS))
    assert [(c.name, c.holonomic) for c in system.constraints] == [
        ("first", True), ("second", True), ("third1", True), ("third2", True), ("blade", False),
    ]  # fmt: skip
    blade = system.constraints[-1]
    assert (blade.unit, blade.note, blade.loop) == ("m/s", "no slip", "")
    assert blade.formula == symbol("w") * symbol("b") - symbol("l")
    assert system.constraints[3].formula == symbol("e2") - 2 * symbol("a")
    assert not system.warnings


def test_stated_initial_values_are_fixed_and_guesses_are_free():
    fixed = {
        c.name: (c.start_fixed, c.rate_fixed) for c in from_scene(parse(SCENE + ROWS)).coordinates
    }
    assert fixed == {
        "a": (True, True), "b": (False, False), "c": (False, False), "d": (True, False),
        "e1": (False, False), "e2": (False, False),
    }  # fmt: skip


def test_all_initial_values_are_fixed_without_constraints():
    assert all(c.start_fixed and c.rate_fixed for c in from_scene(parse(SCENE)).coordinates)


def test_velocity_degree_follows_definitions():
    x, y = Coordinate("x"), Coordinate("y")
    p, v = symbol("p"), symbol("v")
    degree_of = VelocityDegree([x, y], [(p, x.q * 2), (v, dot(p) * sympy.cos(y.q))]).degree

    def degree_and_moves(e):
        rates = degree_of(e)
        return rates.degree, rates.moves, rates.exact

    m = symbol("m")
    assert degree_and_moves(m * t) == (0, 1, False)
    assert degree_and_moves(p**2) == (0, 2, False)
    assert degree_and_moves(v) == (1, 2, False)
    assert degree_and_moves(v * m - x.qd) == (1, 2, False)
    assert degree_and_moves(m * dot(p) + sympy.sin(t) - y.qd / 3) == (1, 2, True)
    assert degree_and_moves(m * dot(p) + p) == (1, 2, False)
    assert degree_and_moves(t * x.qd) == (1, 2, False)
    for e in (v**2, v * x.qd, sympy.sin(x.qd), 1 / x.qd, sympy.Abs(v), 2**v, sympy.sqrt(v)):
        assert degree_of(e).degree == 2


def make_pendulum(**options):
    x, y, u = sympy.symbols("x y u")
    arguments = {
        "coordinates": {x: 0.6, y: (-0.8, 1.0)},
        "kinetic": "(x_dot**2 + y_dot**2)/2",
        "parameters": {"l": 1.0},
        "inputs": [u],
        "definitions": {"s": "x + u", "r": "x**2 + y**2"},
        "constraints": {"rod": "r - l**2"},
    }
    return System.make("pendulum", **{**arguments, **options})


def test_constraints_defined_in_python():
    system = make_pendulum(units={"rod": "m^2"})
    (rod,) = system.constraints
    assert rod.formula == symbol("r") - symbol("l") ** 2
    assert (rod.name, rod.unit, rod.holonomic) == ("rod", "m^2", True)
    assert [(c.start_fixed, c.rate_fixed) for c in system.coordinates] == [
        (True, False),
        (True, True),
    ]


def test_guesses_defined_in_python():
    x, y = sympy.symbols("x y")
    system = make_pendulum(coordinates={x: None, y: -0.8}, guess=[y])
    assert [(c.start, c.start_fixed) for c in system.coordinates] == [(0.0, False), (-0.8, False)]
    system = make_pendulum(coordinates={x: (None, 2.0), y: -0.8}, guess=["x"])
    assert [(c.rate, c.rate_fixed) for c in system.coordinates] == [(2.0, False), (0.0, False)]
    (warning,) = make_pendulum(
        guess=["x"], constraints={}, parameters={}, inputs={}, definitions={}
    ).warnings
    assert str(warning).startswith("System pendulum: warning: guess.x: changes nothing")
    free = make_pendulum(coordinates=[x, y], constraints=None)
    assert all(c.start_fixed and c.rate_fixed for c in free.coordinates)
    assert not free.constraints


def test_dynamicsymbols_in_constraints():
    x, psi = dynamicsymbols("x psi")
    length, time = sympy.Symbol("l"), dynamicsymbols._t
    system = System.make(
        "blade", {x: 0.0, psi: 0.1}, x.diff() ** 2 + psi.diff() ** 2, parameters={length: 1.0},
        constraints={"skate": x.diff() * sympy.sin(psi), "rail": x - length * sympy.cos(time)},
    )  # fmt: skip
    rail, skate = system.constraints
    assert rail.formula == symbol("x") - symbol("l") * sympy.cos(t)
    assert skate.formula == symbol("x_dot") * sympy.sin(symbol("psi"))
    assert not system.warnings


def test_velocity_form_of_a_position_constraint_is_warned_of():
    *_, warning = make_pendulum(constraints={"roll": "x_dot - l*y_dot"}).warnings
    assert warning.severity == "warning"
    assert "write the position itself, -l*y + x, less its value at the start" in warning.message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"constraints": ["x"]}, "constraints: give a dict"),
        ({"constraints": {3: "x"}}, "'3' is not a plain name"),
        ({"constraints": {"lambda": "x"}}, "'lambda' is a Python keyword"),
        ({"constraints": {"l": "x"}}, "constraints.l: 'l' stands in parameters already"),
        ({"constraints": {"s": "x"}}, "constraints.s: 's' stands in definitions already"),
        ({"constraints": {"rod": "z"}}, "constraints.rod: 'z' is not declared"),
        ({"constraints": {"rod": "x_ddot"}}, "'x_ddot' is not declared: accelerations are"),
        ({"constraints": {"rod": "s - y"}}, "constraints.rod: a constraint can't depend on inputs"),
        ({"constraints": {"rod": "u - y"}}, "constraints.rod: a constraint can't depend on inputs"),
        ({"constraints": {"rod": "l - t"}}, "has no coordinates or rates"),
        ({"constraints": {"rod": "x_dot**2 - l"}}, "is not linear in the rates"),
        ({"constraints": {"rod": "sign(x) - l"}}, "constraints.rod: sign(...) jumps, and constr"),
        ({"constraints": {"x_dot": "x - y"}}, "x_dot: 'x_dot' is the velocity of 'x'"),
        ({"constraints": {"energy": "x - y"}}, "constraints.energy: 'energy' is K + P"),
        ({"outputs": {"rod": "x"}}, "constraints.rod: 'rod' stands in outputs already"),
        ({"guess": "x"}, "guess: give a list of coordinates"),
        ({"guess": ["z"]}, "guess: 'z' is not among the coordinates"),
        ({"coordinates": {"x": (1, 2, 3), "y": 0}}, "give a start, or a pair"),
    ],
)  # fmt: skip
def test_invalid_constraints_in_python_are_refused(options, message):
    with pytest.raises(EomcError) as error:
        make_pendulum(**options)
    assert message in str(error.value)
