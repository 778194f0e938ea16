"""The symbolic reference is compared with reference data, the tutorial and laws of mechanics."""

from __future__ import annotations

import math
import time
from itertools import pairwise

import numpy as np
import pytest
import sympy
from support.cases import ALIKE, FEW_ALIKE, SCENES, case_system, cases, error_of, scene_system
from support.fake_module import simplify_reference
from support.session import tiers
from sympy import cos, sin

from eomc.base.errors import EomcError
from eomc.model.system import System, symbol, t
from eomc.verify.symbolic import SymbolicReference, derive

MEASURED = [
    "cartpole_drop_tutorialP",
    "cartpole_drop_physicalP",
    "cartpole_drop_printed",
    "cartpole_torque_tutorialP",
    "cartpole_torque_physicalP",
    "cartpole_torque_printed",
    "cartpole_upright_escape",
    "pendulum_large_swing",
    "iftomm_A02_four_bar_N2",
    "double_pendulum_regular",
    "double_pendulum_light_tip",
    "n_pendulum_5",
    "spring_pendulum_resonant",
    "kapitza_pendulum",
    "swinging_atwood_mu3",
    "furuta_pendulum",
    "acrobot_torque",
    "lagrange_top_nutation",
    "coulomb_friction",
    "slider_crank_near_changepoint",
]

x, v = symbol("x"), symbol("x_dot")


def states(
    reference: SymbolicReference, count: int = 5
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return random q, qd and t."""
    random = np.random.default_rng(1)
    n = len(reference.system.q)
    return [(*random.uniform(0.3, 2.0, (2, n)), random.uniform(0, 3)) for _ in range(count)]


FEW_MEASURED = ("cartpole_drop_tutorialP", "double_pendulum_regular", "coulomb_friction")


@pytest.mark.parametrize("name", tiers(MEASURED, *FEW_MEASURED))
def test_error_of_rk4_is_that_of_an_independent_rk4(name: str) -> None:
    measured = cases()[name]["rk4_measured"][0]
    steps = measured["steps"]
    _, q, _ = derive(case_system(name)).simulate(h=measured["h"], steps=steps)
    assert error_of(name, q[-1]) == pytest.approx(measured["err_q"], rel=0.01)


def test_rk4_converges_with_order_4() -> None:
    name = "cartpole_torque_physicalP"
    reference, finer = derive(case_system(name)), cases()[name]["rk4_measured"][:2]
    errors = [error_of(name, reference.simulate(h=m["h"])[1][-1]) for m in finer]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.1)


@pytest.mark.parametrize(("name", "case"), tiers(ALIKE.items(), *FEW_ALIKE))
def test_scene_has_the_equations_of_the_case(name: str, case: str) -> None:
    scene, trusted = scene_system(name), case_system(case)
    mine, theirs = derive(scene), derive(trusted)
    assert [(c.start, c.rate) for c in scene.coordinates] == [
        (pytest.approx(c.start, rel=1e-15), pytest.approx(c.rate, rel=1e-15))
        for c in trusted.coordinates
    ]
    for q, qd, at in states(mine):
        np.testing.assert_allclose(
            mine.acceleration(q, qd, at), theirs.acceleration(q, qd, at), rtol=1e-12, atol=1e-12
        )


def test_every_scene_has_a_case_or_bodies() -> None:
    """Those with constraints are compared in test_constrained_scenes.py."""
    for file in SCENES.glob("*.toml"):
        text = file.read_text(encoding="utf-8")
        assert file.stem in ALIKE or "[[body]]" in text or "[constraints]" in text


@pytest.mark.parametrize("name", tiers(ALIKE, *FEW_ALIKE))
def test_properties_of_the_equations_of_motion(name: str) -> None:
    """D = D^T > 0; bias = C qd + g; Ddot - 2C + dD/dt is skew; d jacobi/dt = power."""
    reference = derive(scene_system(name))
    system = reference.system
    D_dot = reference.D.diff(t)
    for q, qd in zip(system.q, system.qd, strict=True):
        D_dot += reference.D.diff(q) * qd
    values = {p.symbol: p.value for p in system.parameters}
    for q, qd, at in states(reference, 2):
        D, C, g, bias, tau, power = (
            reference.evaluate(n, q, qd, at) for n in ("D", "C", "g", "bias", "tau", "power")
        )
        np.testing.assert_allclose(D, D.T, rtol=1e-15)
        assert np.all(np.linalg.eigvalsh(D) > 0)
        np.testing.assert_allclose(bias, C @ qd + g, rtol=1e-12, atol=1e-12 * np.abs(bias).max())
        here = values | dict(zip((*system.q, *system.qd, t), (*q, *qd, at), strict=True))
        rates = np.array((D_dot + reference.D.diff(t)).subs(here), float)
        np.testing.assert_allclose(rates - 2 * C, -(rates - 2 * C).T, atol=1e-12)
        # Along the motion, from half a small step before to half a step after, by RK4.
        h, qdd = 1e-4, reference.acceleration(q, qd, at)
        np.testing.assert_allclose(D @ qdd + bias, tau, atol=1e-11 * max(1, np.abs(bias).max()))
        after, before = (reference.step(q, qd, s * h / 2, at) for s in (1, -1))
        rate = (
            reference.evaluate("jacobi", *after, at + h / 2)
            - reference.evaluate("jacobi", *before, at - h / 2)
        ) / h
        scale = abs(power) + abs(reference.evaluate("energy", q, qd, at)) + 1
        assert rate == pytest.approx(power, abs=1e-5 * scale)


@pytest.mark.slow
def test_values_of_the_tutorial() -> None:
    """D = [[4, -2 cos q2], [-2 cos q2, 8/3]], C = [[0, 2 sin(q2) q2_dot], [0, 0]], g = ..."""
    system = scene_system("cartpole_tutorial")
    numbers = {p.symbol: sympy.Rational(str(p.value)) for p in system.parameters}
    q2, q2_dot, gravity = symbol("q2"), symbol("q2_dot"), symbol("g")
    del numbers[gravity]
    reference = derive(system)
    for equations in (reference, simplify_reference(reference)):
        D, C, g = (
            m.subs(numbers).applyfunc(sympy.simplify)
            for m in (equations.D, equations.C, equations.g)
        )
        assert D.tolist() == [[4, -2 * cos(q2)], [-2 * cos(q2), sympy.Rational(8, 3)]]
        assert C.tolist() == [[0, 2 * sin(q2) * q2_dot], [0, 0]]
        assert g.tolist() == [[0], [-4 * gravity * sin(q2)]]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kapitza_pendulum", "cartpole_driven"])
def test_simplified_equations_have_the_same_values(name: str) -> None:
    reference = derive(scene_system(name))
    short = simplify_reference(reference)
    for name in ("D", "C", "g", "bias", "tau", "kinetic", "energy", "jacobi", "power"):
        for q, qd, at in states(reference, 2):
            np.testing.assert_allclose(
                short.evaluate(name, q, qd, at), reference.evaluate(name, q, qd, at), rtol=1e-12
            )
    if name == "kapitza_pendulum":
        assert short.D[0] == symbol("m") * symbol("l") ** 2


def test_all_terms_of_a_general_kinetic_energy() -> None:
    """K = m(t) v^2/2 + a(x, t) v + b(x): compare every term with d/dt dK/dv - dK/dx by hand."""
    k, c, u = symbol("k"), symbol("c"), symbol("u")
    system = System.make(
        "general", [x], (1 + t) * v**2 / 2 + x**2 * t * v + x**3, k * x**2 / 2,
        parameters={k: 3, c: 2}, dissipation=c * v**2 / 2, forces={x: u * x}, inputs={u: 5 * t},
    )  # fmt: skip
    reference = derive(system)
    # p = (1 + t) v + x^2 t, dp/dt = (1 + t) a + v + 2 x v t + x^2, dK/dx = 2 x t v + 3 x^2
    assert reference.D[0] == 1 + t
    assert reference.C[0] == 1
    assert sympy.expand(reference.g[0] - (x**2 - 3 * x**2 + k * x)) == 0
    assert sympy.expand(reference.bias[0] - reference.C[0] * v - reference.g[0]) == 0
    assert sympy.expand(reference.tau[0] - (u * x - c * v)) == 0
    assert sympy.expand(reference.jacobi - ((1 + t) * v**2 / 2 - x**3 + k * x**2 / 2)) == 0
    assert sympy.expand(reference.power - ((u * x - c * v) * v - v**2 / 2 - x**2 * v)) == 0


def test_inputs_parameters_and_batches() -> None:
    reference = derive(scene_system("cartpole_driven"))
    q, qd = [0.0, 3.0], [0.1, 0.2]
    assert reference.evaluate("signals", q, qd, 2.0) == pytest.approx([0.01 * math.sin(2)])
    assert reference.evaluate("tau", q, qd, 2.0)[0] == pytest.approx(0.01 * math.sin(2))
    assert reference.evaluate("tau", q, qd, 2.0, u=[7.0])[0] == 7
    assert reference.evaluate("D", q, params={"m_c": 5.0})[0, 0] == 7
    with pytest.raises(EomcError, match="'mc' is not a parameter; did you mean 'm_c'"):
        reference.evaluate("D", q, params={"mc": 5.0})
    times, qs, qds = reference.simulate(h=0.1, steps=3)
    assert times == pytest.approx([0, 0.1, 0.2, 0.3])
    assert qs.shape == qds.shape == (4, 2)
    assert all(later > sooner for sooner, later in pairwise(times))


def test_complex_values_are_nan() -> None:
    reference = derive(System.make("fall", [x], v**2 / 2, 1 / x + sympy.log(x)))
    assert math.isnan(reference.evaluate("potential", [0.0]))
    assert np.isnan(reference.evaluate("g", [0.0])).all()
    assert math.isnan(reference.evaluate("potential", [-1.0]))
    power = derive(System.make("power", [x], v**2, x ** sympy.Rational(3, 2)))
    assert math.isnan(power.evaluate("potential", [-1.0]))
    np.testing.assert_array_equal(power.evaluate("potential", [[-1.0], [4.0]]), [math.nan, 8.0])


def test_quadratic_energy_in_disguise_is_accepted() -> None:
    hidden = (v**4 - x**4) / (v**2 + x**2) / 2 + (sin(v) ** 2 + cos(v) ** 2)
    assert derive(System.make("hidden", [x], hidden)).D[0] == 1


def test_derivation_is_quick() -> None:
    system = scene_system("cartpole")
    start = time.process_time()
    derive(system).acceleration([0.0, 1.0], [0.0, 0.0])
    assert time.process_time() - start < 1


def test_terms_are_expanded() -> None:
    q, qd = symbol("q"), symbol("q_dot")
    s = System.make("shallow", {q: 1e-3}, qd**2 / 2 - qd * sin(q), 2e4 * (1 - cos(q)) - q / 7)
    answer = derive(s)
    at = {"q": np.array([1e-3]), "qd": np.array([0.5]), "t": 0.0, "u": None, "params": None}
    terms = 2e4 * (1 + math.cos(1e-3)) + 1e-3 / 7 + 0.125 + 0.5 * math.sin(1e-3)
    assert answer.terms("energy", at) == pytest.approx(terms, rel=1e-14)
    assert abs(answer.evaluate("potential", at["q"])) < 1e-6 * terms


def test_cancelling_power_has_terms() -> None:
    """A bead on a hoop with prescribed rotation: its energy does not depend on time."""
    q, qd, w = symbol("q"), symbol("q_dot"), 6.0
    at = (sin(q) * cos(w * t), sin(q) * sin(w * t), -cos(q))
    K = sum((x.diff(q) * qd + x.diff(t)) ** 2 for x in at) / 2
    answer = derive(System.make("hoop", {q: 0.3}, K, at[2]))
    s = {"q": np.array([1.0]), "qd": np.array([0.0]), "t": 200.0, "u": None, "params": None}
    terms = w**3 * math.sin(1.0) ** 2 * abs(math.sin(w * 200) * math.cos(w * 200))
    assert abs(answer.evaluate("power", s["q"], s["qd"], 200.0)) < 1e-12 * terms
    assert answer.terms("power", s) > terms


def test_acceleration_is_nan_if_D_is_singular() -> None:
    """For one state, and for one of several."""
    reference = derive(System.make("pole", {x: 1.0}, x**2 * v**2 / 2, x**3))
    assert math.isnan(reference.acceleration([0.0], [1.0])[0])
    accelerations = reference.acceleration([[0.0], [2.0]], [[1.0], [1.0]], params={})
    assert np.isnan(accelerations[0, 0]) and accelerations[1, 0] == pytest.approx(-3.5)
