"""Systems made in Python: plain symbols and dynamicsymbols give what a scene gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

import eomc
from eomc.problems import EomcError
from eomc.system import System, dot

SCENES = Path(__file__).parent.parent / "scenes"
MODULES = Path("build/tests/modules")

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
def test_it_moves_as_the_scene_does(make: object) -> None:
    assert callable(make)
    made = eomc.load(make(), MODULES).simulate(h=0.005, duration=10.0)
    scene = eomc.load(SCENES / "cartpole.toml", MODULES).simulate(h=0.005, duration=10.0)
    assert np.max(np.abs(made.q - scene.q)) < 1e-12


def test_inputs_forces_dissipation_and_units() -> None:
    theta = dynamicsymbols("theta")
    m, b, torque = sympy.symbols("m b torque")
    system = System.make(
        "wheel", {theta: (0.5, 1.0)}, m * theta.diff() ** 2 / 2, parameters={m: 2.0, b: 0.3},
        dissipation=b * theta.diff() ** 2 / 2, inputs={torque: sympy.cos(dynamicsymbols._t)},
        forces={theta: torque}, units={theta: "rad", m: "kg m^2"}, h=0.01, duration=1.0,
    )  # fmt: skip
    wheel = eomc.load(system, MODULES)
    assert wheel.units == {"theta": "rad", "m": "kg m^2"}
    assert wheel.acceleration([0.0], [2.0], t=0.0) == pytest.approx([(1.0 - 0.6) / 2])
    assert wheel.acceleration([0.0], [2.0], u=[3.0]) == pytest.approx([(3.0 - 0.6) / 2])


def test_names_that_c_cannot_bear_are_mapped_and_told() -> None:
    theta = dynamicsymbols(r"\theta_{1}")
    double = sympy.Symbol("lambda")
    system = System.make("mapped", [theta], double * theta.diff() ** 2 / 2, parameters={double: 1})
    assert dict(system.renamed) == {r"\theta_{1}": "theta_1", "lambda": "lambda_1"}
    header = eomc.sources(system).files["mapped.h"]
    assert r"\theta_{1} is theta_1" in header and "lambda is lambda_1" in header


def test_the_same_system_is_not_built_twice() -> None:
    assert eomc.load(cartpole_by_symbols(), MODULES) is eomc.load(cartpole_by_symbols(), MODULES)


x, x_dot, u = sympy.symbols("x x_dot u")


@pytest.mark.parametrize(
    ("arguments", "options", "said"),
    [
        (("a", [x], sympy.Symbol("M") * x_dot**2), {}, "M not declared"),
        (("a", [x], "x_dot**2"), {}, "SymPy expression, not the text"),
        (("a", [], x_dot**2), {}, "at least one coordinate"),
        (("class", [x], x_dot**2), {}, "class"),
        (("a", [x], x_dot**2), {"parameters": {x: 1.0}}, "'x' is taken already"),
        (("a", [x], x_dot**2), {"forces": {u: 1}}, "not among the coordinates"),
        (("a", [x], sympy.I * x_dot**2), {}, "not a real, finite expression"),
    ],
)
def test_what_is_wrong_is_said(
    arguments: tuple[object, ...], options: dict[str, object], said: str
) -> None:
    with pytest.raises(EomcError, match=said):
        System.make(*arguments, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("inside", [x_dot, dot(x), u * x])
def test_rates_that_nobody_knows_are_refused(inside: sympy.Expr) -> None:
    system = System.make("a", [x], x_dot**2 / 2, inputs=[u], forces={x: dot(inside)})
    with pytest.raises(EomcError, match=r"rate|accelerations"):
        eomc.sources(system)


def test_jumps_in_energies_are_refused() -> None:
    system = System.make("a", [x], x_dot**2 / 2, x * sympy.sign(x))
    with pytest.raises(EomcError, match="jumps"):
        eomc.sources(system)


@pytest.mark.parametrize("more", [sympy.Abs(x_dot) ** 3, sympy.sqrt(x_dot**2)])
def test_a_kinetic_energy_that_is_not_quadratic_is_named(more: sympy.Expr) -> None:
    system = System.make("a", [x], x_dot**2 / 2 + more)
    with pytest.raises(EomcError, match=r"energy\.kinetic: .* (quadratic|jumps)"):
        eomc.sources(system)
