"""Systems defined in Python by plain symbols or dynamicsymbols equal those of scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from support.session import Modules
from sympy.physics.mechanics import dynamicsymbols

import eomc
from eomc.base.errors import EomcError
from eomc.model.from_sympy import as_formula
from eomc.model.system import System, dot, from_scene
from eomc.scene.formulas import NUMERIC, evaluate
from eomc.scene.read import parse

SCENES = Path(__file__).parents[2] / "scenes"

m_c, m_p, l, g = sympy.symbols("m_c m_p l g", positive=True)  # noqa: E741 - the scene's name
VALUES = {m_c: 2.0, m_p: 2.0, l: 2.0, g: 9.8}


def cartpole_by_dynamicsymbols() -> System:
    x, theta = dynamicsymbols("x theta")
    t = dynamicsymbols._t
    x_p, y_p = x - l / 2 * sympy.sin(theta), l / 2 * sympy.cos(theta)
    K = m_c * x.diff(t) ** 2 / 2 + m_p * (x_p.diff(t) ** 2 + y_p.diff(t) ** 2) / 2
    K += m_p * l**2 / 12 * theta.diff(t) ** 2 / 2
    start = {x: 0.0, theta: np.pi / 2}
    return System.make("made_cartpole", start, K, m_p * g * y_p, parameters=VALUES)


def cartpole_by_symbols() -> System:
    x, theta, x_dot, theta_dot = sympy.symbols("x theta x_dot theta_dot")
    x_p, y_p = sympy.symbols("x_p y_p")
    K = m_c * x_dot**2 / 2 + m_p * (dot(x_p) ** 2 + dot(y_p) ** 2) / 2
    K += m_p * l**2 / 12 * theta_dot**2 / 2
    return System.make(
        "named_cartpole", {x: 0.0, theta: np.pi / 2}, K, m_p * g * y_p, parameters=VALUES,
        definitions={x_p: x - l / 2 * sympy.sin(theta), y_p: l / 2 * sympy.cos(theta)},
    )  # fmt: skip


@pytest.mark.parametrize("make", [cartpole_by_dynamicsymbols, cartpole_by_symbols])
def test_python_cartpole_moves_as_the_scene(make: object, modules: Modules) -> None:
    assert callable(make)
    run = modules.unoptimised(make()).simulate(h=0.005, duration=10.0)
    scene = modules("cartpole").simulate(h=0.005, duration=10.0)
    assert np.max(np.abs(run.q - scene.q)) < 1e-12


def test_inputs_forces_dissipation_and_units_are_accepted(modules: Modules) -> None:
    theta = dynamicsymbols("theta")
    m, b, torque = sympy.symbols("m b torque")
    system = System.make(
        "wheel", {theta: (0.5, 1.0)}, m * theta.diff() ** 2 / 2, parameters={m: 2.0, b: 0.3},
        dissipation=b * theta.diff() ** 2 / 2, inputs={torque: sympy.cos(dynamicsymbols._t)},
        forces={theta: torque}, units={theta: "rad", m: "kg m^2"}, h=0.01, duration=1.0,
    )  # fmt: skip
    wheel = modules.unoptimised(system)
    assert wheel.units == {"theta": "rad", "m": "kg m^2"}
    assert wheel.acceleration([0.0], [2.0], t=0.0) == pytest.approx([(1.0 - 0.6) / 2])
    assert wheel.acceleration([0.0], [2.0], u=[3.0]) == pytest.approx([(3.0 - 0.6) / 2])


def test_names_invalid_in_c_are_mapped_and_reported() -> None:
    theta = dynamicsymbols(r"\theta_{1}")
    double = sympy.Symbol("lambda")
    system = System.make("mapped", [theta], double * theta.diff() ** 2 / 2, parameters={double: 1})
    assert dict(system.renamed) == {r"\theta_{1}": "theta_1", "lambda": "lambda_1"}
    header = eomc.sources(system).files["mapped.h"]
    assert r"\theta_{1} is theta_1" in header and "lambda is lambda_1" in header


def test_same_system_is_built_once(tmp_path: Path, quickly_compiled: None) -> None:
    assert eomc.load(cartpole_by_symbols(), tmp_path) is eomc.load(cartpole_by_symbols(), tmp_path)


x, x_dot, u = sympy.symbols("x x_dot u")


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (
            ("a", [x], sympy.Symbol("M") * x_dot**2),
            {},
            "kinetic: 'M' is not declared: add it to parameters, inputs or definitions",
        ),
        (("a", [], x_dot**2), {}, "at least one coordinate"),
        (("class", [x], x_dot**2), {}, "class"),
        (("a", [x], x_dot**2), {"parameters": {x: 1.0}}, "'x' stands in coordinates already"),
        (("a", [x], x_dot**2), {"forces": {u: 1}}, "'u' is not a coordinate"),
        (("a", [x], sympy.I * x_dot**2), {}, "has no real value"),
        ((3, [x], x_dot**2), {}, "name: must be text"),
        (("a", x, x_dot**2), {}, "coordinates: give a list or dict"),
        (("a", [x**2], x_dot**2), {}, r"x\*\*2 is not a symbol"),
        (("a", {x: (1, 2, 3)}, x_dot**2), {}, r"pair \(start, rate\)"),
        (("a", {x: np.nan}, x_dot**2), {}, r"coordinates\.x\.start: must be a finite number"),
        (
            ("a", [x], None),
            {},
            "kinetic: missing: add kinetic; give L = K - P as kinetic = K and potential = P",
        ),
        (("a", [x], x_dot**2, x > 0), {}, "potential: x > 0 is not an expression"),
        (
            ("a", [x], x_dot**2, sympy.gamma(x)),
            {},
            "potential: 'gamma' is not used in formulas: formulas have no special functions",
        ),
        (
            ("a", [x], x_dot**2, u * x),
            {"inputs": [u]},
            "potential: an energy can't depend on inputs",
        ),
        (("a", [x], u * x_dot**2), {"inputs": [u]}, "kinetic: an energy can't depend on inputs"),
        (
            ("a", [x], "d*x_dot**2"),
            {"inputs": [u], "definitions": {"c": 2 * u, "d": "1 + c"}},
            "kinetic: an energy can't depend on inputs",
        ),
        (
            ("a", [x], x_dot**2),
            {"inputs": [u], "dissipation": u * x_dot**2},
            "dissipation: an energy can't depend on inputs",
        ),
        (
            ("a", [x], x_dot**2),
            {"inputs": {"F": "c", "u": 1}, "definitions": {"c": "2*u"}},
            r"inputs\.F: 'c' can't be used here: a signal can't depend on inputs",
        ),
        (
            ("a", [x], x_dot**2),
            {"inputs": {"F": "F"}},
            r"inputs\.F: 'F' can't be used here: a signal can't depend on inputs",
        ),
        (("a", [x], x_dot**2, sympy.besselj(0, x)), {}, "'besselj' is not used in formulas"),
        (
            ("a", [x], x_dot**2),
            {"forces": {x: sympy.ceiling(x)}},
            r"forces\.x: 'ceiling' is not used .*: it jumps",
        ),
        (("a", [x], x_dot**2), {"forces": {x: sympy.Symbol("t")}}, r"not the time: write eomc\."),
        (("a", [x], x_dot**2), {"parameters": [u]}, "parameters: give a dict"),
        (
            ("a", [x], x_dot**2),
            {"parameters": {u: x}},
            r"parameters\.u: 'x' can't be .* definition",
        ),
        (
            ("a", [x], x_dot**2),
            {"parameters": {u: 1, "b": "2*u"}},
            r"parameters\.b: 'u' can't be used",
        ),
        (("a", [x], x_dot**2), {"h": "2*u"}, r"h: must be a number, here '2\*u'"),
        (("a", [x], x_dot**2), {"inputs": "u"}, "inputs: give a list or dict of symbols"),
        (
            ("a", [x], "x_dot^2"),
            {},
            r"kinetic: '\^' is not a power here.*\n  \| x_dot\^2\n  \|      \^$",
        ),
        (
            ("a", [x], "m_1*x_dot**2"),
            {"parameters": {"m1": 1}},
            r"'m_1' is not .*did you mean 'm1'\?",
        ),
        (("a", ["x"], "Piecewise((x, 1))"), {}, r"kinetic: 'Piecewise' is not used in formulas"),
        (("a", {x: "pi/y"}, x_dot**2), {}, r"\.x\.start: 'y' is not declared"),
        (
            ("a", {x: (0, u)}, x_dot**2),
            {"inputs": [u]},
            r"\.x\.rate: 'u' can't be used here: 'rate' is made of",
        ),
        (
            ("a", {x: "u"}, x_dot**2),
            {"parameters": {"u0": 1}},
            "'u' is not declared; did you mean 'u0'",
        ),
        (
            ("a", {x: "1/u"}, x_dot**2),
            {"parameters": {u: 0}},
            r"\.x\.start: '1/u' divides by zero at u = 0",
        ),
        (("a", {x: "dot(u)"}, x_dot**2), {"parameters": {u: 1}}, r"start: dot\(...\) can't be"),
        (("a", [x], x_dot**2, "1/0"), {}, r"potential: divides by zero\n  \| 1/0"),
        (("a", [x], sympy.Symbol("x", positive=True)), {}, "the 'x' declared .* is another symbol"),
        (("a", [[x]], x_dot**2), {}, r"coordinates: \[x\] is not a symbol"),
        (("a", np.array(1.0), x_dot**2), {}, "coordinates: give a list or dict of symbols"),
        (("a", [x], x_dot**2), {"parameters": np.ones(2)}, "parameters: give a dict"),
        (("a", [x], x_dot**2), {"methods": x}, "methods: unknown method .*: known are rk4"),
        (("a", [x], x_dot**2), {"forces": {x: sympy.Heaviside(x, 1)}}, "Heaviside.x. is 1/2 at 0"),
        (("a", [x], x_dot**2), {"forces": {"y": 1}}, "forces.y: 'y' is not a coordinate"),
        (("a", [x], x_dot**2), {"units": {"X": "m"}}, "units: 'X' is no coord.*did you mean 'x'"),
        (("a", [x], x_dot**2), {"units": {"x": "deg"}}, "units.x: angles are in radians"),
        (
            ("a", [x], x_dot**2),
            {"outputs": {"o": x}, "units": {"o": "deg"}},
            r"units.o: angles are in radians, .* give \"x\*180/pi\"",
        ),
        (("a", [x], x_dot**2), {"h": -0.1}, "h: must be greater than zero"),
        (("a", [x], x_dot**2), {"methods": ["ode45"]}, "methods: unknown method .*: known are rk4"),
        (
            ("a", [x], x_dot**2),
            {"real": "quad"},
            "real: unknown type 'quad': known are double, float",
        ),
        (("a", [x], x_dot**2), {"batch": "yes"}, "batch: must be True or False, here 'yes'"),
        (("a", [x], x_dot**2), {"linearize": "all"}, "linearize: unknown value"),
        (
            ("a", [x], x_dot**2),
            {"tolerance": 0.1},
            "tolerance: must be a number from 1e-15 to 1e-2",
        ),
        (
            ("a", [x], x_dot**2),
            {"tolerance": 1e-9, "real": "float"},
            "tolerance: a float can keep 5e-07",
        ),
        (("a", [x], x_dot**2), {"events": [x]}, 'events: give a dict, such as {"impact": y}'),
        (("a", [x], x_dot**2), {"events": {"at": 3}}, r"events\.at\.when: never crosses zero"),
        (
            ("a", [x], x_dot**2),
            {"events": {"at": {"action": "stop"}}},
            r"events\.at\.when: missing: add when, whose",
        ),
        (
            ("a", [x], x_dot**2),
            {"events": {"at": {"when": x, "direction": "up"}}},
            r"events\.at\.direction: unknown direction 'up': known are both, rising, falling",
        ),
        (
            ("a", [x], x_dot**2),
            {"events": {"at": {"when": x, "y": 1}}},
            "'y' is no coordinate, velocity or parameter",
        ),
        (
            ("a", [x], x_dot**2),
            {"events": {"at": {"when": x, "action": "jump"}}},
            r"events\.at\.action: a jump sets something: add x_dot$",
        ),
    ],
)
def test_invalid_arguments_are_refused_with_a_message(
    arguments: tuple[object, ...], options: dict[str, object], message: str
) -> None:
    with pytest.raises(EomcError, match=message):
        System.make(*arguments, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("method", "did you mean 'methods'"),
        ("V", "did you mean 'potential'"),
        ("lagrangian", "kinetic = K and potential = P"),
        ("input", "did you mean 'inputs'"),
        ("gravity", "it has name, coordinates, kinetic, potential, parameters, .*, friction$"),
    ],
)
def test_unknown_argument_suggests_the_right_one(name: str, message: str) -> None:
    with pytest.raises(TypeError, match=f"^System.make has no argument '{name}'.*{message}"):
        System.make("a", [x], x_dot**2, **{name: 1})  # type: ignore[arg-type]


def test_names_and_formulas_are_accepted_as_text() -> None:
    """Text gives the same system as symbols, and both may be mixed."""
    system = System.make(
        "texts", {"x": ("pi/2", 0.1), "theta": 0}, "m*x_dot**2/2 + m*dot(y)**2/2", "m*g*y + m*z",
        parameters={"m": "1/2", "g": 9.81, "l": 2},
        definitions={"y": "l*cos(theta)", "z": "abs(x)"},
        inputs={"F": "sin(2*t)"}, forces={"x": "F - max(x, 0)", "theta": 0},
        units={"x": "m"}, dissipation="x_dot**2",
    )  # fmt: skip
    x, theta, m, g, y, z, F, l = sympy.symbols("x theta m g y z F l")  # noqa: E741
    x_dot, t = sympy.Symbol("x_dot"), sympy.Symbol("t", real=True)
    same = System.make(
        "texts", {x: (sympy.pi / 2, 0.1), theta: 0}, m * x_dot**2 / 2 + m * dot(y) ** 2 / 2,
        m * g * y + m * z, parameters={m: 0.5, g: 9.81, l: 2},
        definitions={y: l * sympy.cos(theta), z: sympy.Abs(x)}, inputs={F: sympy.sin(2 * t)},
        forces={x: F - sympy.Max(x, 0)}, units={x: "m"}, dissipation=x_dot**2,
    )  # fmt: skip
    assert system == same and system.digest == same.digest
    mixed = System.make("m", ["x"], x_dot**2 / 2, x * m, parameters={"m": 1}, forces={x: "-x"})
    assert mixed == System.make("m", [x], x_dot**2 / 2, "x*m", parameters={m: 1}, forces={"x": -x})
    q = dynamicsymbols("x")
    by_time = System.make("m", [q], "x_dot**2/2", q * m, parameters={m: 1}, forces={"x": -q})
    assert by_time == mixed


def value(expr: sympy.Expr, at: float) -> float:
    (free,) = expr.free_symbols
    return float(expr.subs(free, sympy.Float(at, 30)))


@pytest.mark.parametrize(
    "function",
    [sympy.sec, sympy.csc, sympy.cot, sympy.sech, sympy.csch, sympy.coth, sympy.asec, sympy.acsc],
)
def test_functions_are_rewritten_in_supported_ones(function: Any) -> None:
    potential = System.make("a", [x], x_dot**2 / 2, function(2 * x + 1)).potential
    assert not potential.has(function)
    for at in (-1.7, 0.3, 2.0):
        assert value(potential, at) == pytest.approx(float(function(2 * at + 1)), rel=1e-14)


PIECES = {
    "ramp": ((x, x > 0), (0, True)),
    "stop": ((0, x <= 0.5), (3 * (x - 0.5) ** 2 / 2, True)),
    "dead band": ((x + 1, x < -1), (x - 1, x > 1), (0, True)),
    "saturation": ((-1, x < -1), (1, x >= 1), (x, True)),
    "first that holds": ((0, x < 0), (x, x < 1), (1, True)),
    "size": ((-x, x < 0), (x, True)),
    "cubic": ((x**3, x > 0), (sympy.sin(3 * x) * x, True)),
}


@pytest.mark.parametrize("pieces", PIECES.values(), ids=list(PIECES))
def test_continuous_piecewise_becomes_sums_of_max(pieces: Any) -> None:
    piecewise = sympy.Piecewise(*pieces)
    potential = System.make("a", [x], x_dot**2 / 2, piecewise).potential
    assert not potential.has(sympy.Piecewise, sympy.Heaviside)
    for at in (-3.0, -1.0, -0.4, 0.0, 0.3, 0.5, 0.7, 1.0, 2.5):
        assert value(potential, at) == pytest.approx(
            float(piecewise.subs(x, at)), rel=1e-14, abs=1e-14
        )


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        (
            ((1, x > 0), (0, True)),
            r"jumps where x = 0, .* write Heaviside\(x\), whose Heaviside is 1/2",
        ),
        (((0, x < 1), (2, True)), r"write 2 - 2\*Heaviside\(1 - x\), whose Heaviside is 1/2"),
        (((sympy.sqrt(x), x > 0), (0, True)), "jumps where x = 0"),
        (((1 / x, x > 1), (x, True)), "can't be seen not to"),
        (((x, x > 0),), "has no last piece"),
        (((1, sympy.Eq(x, 0)), (x, True)), r"Eq\(x, 0\) in a Piecewise can't be used: write x > a"),
        (((x, x > 1), (u * x, u > 0), (0, True)), "can't be seen not to"),
    ],
)
def test_discontinuous_piecewise_is_refused(pieces: Any, message: str) -> None:
    with pytest.raises(EomcError, match=rf"forces\.x: .*{message}"):
        System.make("a", [x], x_dot**2 / 2, inputs=[u], forces={x: sympy.Piecewise(*pieces)})


a, b, k = sympy.Symbol("a", positive=True), sympy.Symbol("b", nonnegative=True), sympy.Symbol("k")
BETWEEN = {
    "dead band": ((k * (x + a), x < -a), (k * (x - a), x > a), (0, True)),
    "from above": ((k * (x - a), x > a), (k * (x + a), x < -a), (0, True)),
    "saturation": ((-k * a, x < -a), (k * x, x < a), (k * a, True)),
    "apart": ((k * (x + b), x <= -b), (k * (x - a), x >= a), (0, True)),
    "stretched": ((x + a, 2 * x < -2 * a), (x - b, 3 * x > 3 * b), (0, True)),
    "shifted": ((0, x < k), (x - k, x < k + a), (a, True)),
}


@pytest.mark.parametrize("pieces", BETWEEN.values(), ids=list(BETWEEN))
def test_piecewise_with_thresholds_of_known_order(pieces: Any) -> None:
    """-a < a holds for a positive symbol a."""
    piecewise = sympy.Piecewise(*pieces)
    potential = System.make(
        "a", [x], x_dot**2 / 2, piecewise, parameters={a: 0.5, b: 0.25, k: 3}
    ).potential
    assert not potential.has(sympy.Piecewise, sympy.Heaviside)
    for at in (-3.0, -0.5, -0.4, 0.0, 0.1, 0.25, 0.5, 0.7, 1.0, 2.5, 3.1, 3.5, 8.0):
        values = {"x": at, "a": 0.5, "b": 0.25, "k": 3.0}
        expected = float(piecewise.subs({a: 0.5, b: 0.25, k: 3.0}).subs(x, at))
        result = float(potential.subs({s: values[s.name] for s in potential.free_symbols}))
        assert result == pytest.approx(expected, rel=1e-14, abs=1e-14)


def test_thresholds_of_unknown_order_are_refused_with_the_remedy() -> None:
    free = sympy.Symbol("a", real=True)
    dead = sympy.Piecewise((x + free, x < -free), (x - free, x > free), (0, True))
    with pytest.raises(EomcError, match=r"; Symbol\('a', positive=True\) tells an order"):
        System.make("a", [x], x_dot**2 / 2, dead, parameters={free: 1})
    with pytest.raises(EomcError, match=r"parameters\.a: its symbol can't be negative, here -1"):
        System.make("a", [x], x_dot**2 / 2, a * x, parameters={a: -1})


def test_unevaluated_derivative_is_evaluated() -> None:
    q, t = dynamicsymbols("x"), dynamicsymbols._t
    system = System.make("a", [q], sympy.Derivative(q**2, t) ** 2)
    at = system.coordinates[0]
    assert system.kinetic == (2 * at.q * at.qd) ** 2


@pytest.mark.parametrize("inside", [x_dot, dot(x), u * x])
def test_unknown_derivatives_are_refused(inside: sympy.Expr) -> None:
    with pytest.raises(EomcError, match=r"forces\.x: dot\(...\) can't be used here: .* rate"):
        System.make("a", [x], x_dot**2 / 2, inputs=[u], forces={x: dot(inside)})


@pytest.mark.parametrize("jump", [sympy.sign(x), sympy.Heaviside(x)])
def test_discontinuous_energy_is_refused_by_name(jump: sympy.Expr) -> None:
    with pytest.raises(EomcError, match=r"potential: (sign|heaviside)\(...\) jumps"):
        System.make("a", [x], x_dot**2 / 2, x * jump)
    y = sympy.Symbol("y")
    with pytest.raises(EomcError, match=r"definitions\.y: .* jumps, and kinetic that uses it"):
        System.make("a", [x], x_dot**2 * (2 + y), definitions={y: jump})
    assert System.make("a", [x], x_dot**2 / 2, forces={x: jump}).forces[0] != 0


def test_discontinuous_functions_of_parameters_are_accepted() -> None:
    a = sympy.Symbol("a")
    system = System.make("s", [x], x_dot**2 / 2, sympy.sign(a) * x**2, parameters={a: 1})
    assert system.potential.has(sympy.sign)


def test_step_functions_and_matrices_are_refused() -> None:
    with pytest.raises(EomcError, match="h: must be greater than zero, here -1"):
        System.make("a", [x], x_dot**2 / 2, h=-1)
    with pytest.raises(EomcError, match="kinetic: give one expression, not a matrix of 1 by 1"):
        System.make("a", [x], sympy.Matrix([x_dot**2 / 2]))


@pytest.mark.parametrize(
    ("key", "more"),
    [
        ("error: h", {"h": 1e-60}),
        ("error: potential", {"potential": sympy.Float("1e300") * x**2}),
        ("parameters.m", {"parameters": {sympy.Symbol("m"): 1e39}}),
    ],
)
def test_numbers_beyond_single_precision_are_refused(key: str, more: dict[str, Any]) -> None:
    assert System.make("a", [x], x_dot**2 / 2, **more)
    with pytest.raises(EomcError, match=f"{key}: .* a float can be"):
        System.make("a", [x], x_dot**2 / 2, real="float", **more)


def test_too_large_number_in_a_float_scene_is_located() -> None:
    text = """eomc = 1
name = "a"
[coordinates]
x = {}
[energy]
kinetic = "x_dot**2/2"
potential = "1e250*x**2"
[run]
real = "float"
h = 1e-60
"""
    with pytest.raises(EomcError, match=r"(?s)scene.toml:7.*1e\+250 is more.*:10.*is 1e-60, less"):
        from_scene(parse(text))


@pytest.mark.parametrize(
    "more",
    [
        sympy.Abs(x_dot) ** 3,
        sympy.sqrt(x_dot**2),
        x_dot**4,
        sympy.sqrt(1 - x_dot**2),
        x_dot**2 * sympy.tanh(x_dot),
        x_dot**2 * dot(sympy.sin(x)),
    ],
)
def test_kinetic_energy_not_quadratic_is_named(more: sympy.Expr) -> None:
    system = System.make("a", [x], x_dot**2 / 2 + more)
    with pytest.raises(EomcError, match=r"error: kinetic: .* (quadratic|jumps)"):
        eomc.sources(system)


def test_method_may_be_set_without_other_options() -> None:
    assert System.make("a", [x], x_dot**2 / 2, methods="dp8").run.methods == ("dp8",)
    assert System.make("a", {x: [0.1, 0.2]}, x_dot**2 / 2).coordinates[0].rate == 0.2


@pytest.mark.parametrize("argument", [3, None, {}, b"scene.toml", ["scene.toml"]])
def test_argument_that_is_no_scene_is_refused(argument: object) -> None:
    for function in (eomc.load, eomc.build, eomc.read):
        with pytest.raises(EomcError, match="give the path of a scene"):
            function(argument)  # type: ignore[operator]


def test_unsuitable_texts_and_paths_are_refused() -> None:
    with pytest.raises(EomcError, match="not its text"):
        eomc.load((SCENES / "cartpole.toml").read_text(encoding="utf-8"))
    with pytest.raises(EomcError, match="root: give the path of a folder, here 3"):
        eomc.load(SCENES / "cartpole.toml", 3)  # type: ignore[arg-type]
    with pytest.raises(EomcError, match=r"give a System, such as eomc\.read\('a\.toml'\)"):
        eomc.sources("a.toml")  # type: ignore[arg-type]
    with pytest.raises(EomcError, match="is a folder: name a scene"):
        eomc.read(SCENES)


@pytest.mark.parametrize("value", [-1.0, 0.0])
def test_mass_that_is_not_positive_is_named(value: float) -> None:
    m = sympy.Symbol("m")
    system = System.make("a", [x], m * x_dot**2 / 2, x**2, parameters={m: value})
    with pytest.raises(EomcError, match=rf"'x' has no inertia, at m = {value:g}: masses"):
        eomc.sources(system)


def test_scene_without_its_folder_is_suggested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "crane.toml").write_text("", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for name in ("crane", "crane.toml", "scenes/crane"):
        with pytest.raises(EomcError, match=r"did you mean 'scenes/crane\.toml'\?"):
            eomc.read(name)


def test_omitted_arguments_have_defaults() -> None:
    system = System.make("free", ["x"], "x_dot**2/2")
    assert (system.potential, system.dissipation, system.forces) == (0, 0, (0,))
    assert (system.inputs, system.outputs, system.constraints, system.events) == ((), (), (), ())
    assert (system.run.h, system.run.duration, system.run.methods) == (0.001, 10.0, ("rk4",))
    assert (system.run.real, system.run.batch, system.run.tolerance) == ("double", False, None)
    assert not system.run.linearize and not system.run.discretize
    (x,) = system.coordinates
    assert (x.start, x.rate) == (0, 0)


def test_accelerations_are_available_to_outputs_and_events() -> None:
    def make(**options: Any) -> System:
        return System.make("free", ["x"], "x_dot**2/2", **options)

    assert not make().reads_qdd
    assert make(outputs={"a": "x"}).reads_qdd
    assert make(events={"low": "x"}, tolerance=1e-6).reads_qdd


def test_step_size_is_in_the_normal_range_of_the_type() -> None:
    def make(h: float) -> System:
        return System.make("free", ["x"], "x_dot**2/2", real="float", h=h)

    assert make(2.0**-126).run.h == 2.0**-126
    with pytest.raises(EomcError, match="less than a float can be"):
        make(2.0**-126.5)


@pytest.mark.slow
def test_long_sums_and_products_are_accepted() -> None:
    """Beyond the limits of formulas that are written as text."""
    product = sympy.Mul(*(x + k for k in range(1500)), evaluate=False)
    total = sympy.Add(*(x**k for k in range(1500)))
    deep = x
    for _ in range(45):
        deep = sympy.sin(deep) + 1
    system = System.make("a", [x], x_dot**2 / 2, deep, forces={x: product + total})
    assert system.forces[0] == (product + total).xreplace({x: system.coordinates[0].q})
    factors = [1 + x / (k + 9) ** 2 for k in range(1, 200)]
    formula = as_formula(
        sympy.Mul(*factors, evaluate=False) / sympy.Add(*(x**k for k in range(99)))
    )
    direct = np.prod([float(e.subs(x, 0.3)) for e in factors]) / sum(0.3**k for k in range(99))
    assert evaluate(formula, NUMERIC, {"x": 0.3}.__getitem__) == pytest.approx(direct, rel=1e-13)
