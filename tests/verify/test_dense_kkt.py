"""The reference of constrained systems is compared with independent references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from support import constraint_cases
from support.session import tiers

from eomc.model.system import Constraint, System, symbol, t
from eomc.verify import kkt, symbolic
from eomc.verify.reference import ReferenceModel
from eomc.verify.taylor import TaylorReference

NAMES = list(constraint_cases.cases())
SMALL = [n for n in NAMES if n != "iftomm_A02_four_bar_N40"]
PLANE = [n for n in SMALL if n != "bricard_cube"]
QUICK = ("pendulum_on_a_winch", "chaplygin_sleigh")
RUNS = [n for n in SMALL if constraint_cases.cases()[n]["rk4_measured"]]


def answers(name: str) -> list[ReferenceModel]:
    system = constraint_cases.system(name)
    return [TaylorReference(system), *([symbolic.derive(system)] if name in SMALL else [])]


@pytest.mark.parametrize("name", tiers(NAMES, *PLANE))
def test_accelerations_and_multipliers_at_reference_states(name: str) -> None:
    q, qd, a, multipliers = constraint_cases.ends(name, "q_ref", "qd_ref", "qdd_ref", "lambda_ref")
    t_end = float(constraint_cases.cases()[name]["t_end"])
    for answer in answers(name):
        np.testing.assert_allclose(
            answer.acceleration(q, qd, t_end), a, rtol=0, atol=2e-11 * np.max(np.abs(a))
        )
        np.testing.assert_allclose(
            answer.multipliers(q, qd, t_end), multipliers, rtol=0,
            atol=2e-11 * np.max(np.abs(multipliers)),
        )  # fmt: skip


@pytest.mark.parametrize("name", tiers(SMALL, *PLANE))
def test_both_evaluations_of_constraints_agree(name: str) -> None:
    """Compare written-out equations with Taylor arithmetic, and all states at once with single
    states.
    """
    taylor, plain = answers(name)
    q0, qd0 = constraint_cases.ends(name, "q0", "qd0")
    random = np.random.default_rng(3)
    q, qd = q0 + random.normal(size=(5, len(q0))) / 5, qd0 + random.normal(size=(5, len(q0)))
    times = random.uniform(0, 3, 5)
    for what in ("constraints", "constraint_jacobian", "constraint_rates", "gamma"):
        computed = taylor.evaluate(what, q, qd, times)
        expected = plain.evaluate(what, q, qd, times)
        size = np.max(np.abs(expected)) + 1
        np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-14 * size)
        one = plain.evaluate(what, q[2], qd[2], times[2])
        np.testing.assert_array_equal(expected[2], one)


@pytest.mark.parametrize("name", tiers(SMALL, *PLANE))
def test_constraint_rates_are_derivatives(name: str) -> None:
    """Compare A, rates and gamma with differences along a line in time."""
    answer = TaylorReference(constraint_cases.system(name))
    q, qd = constraint_cases.ends(name, "q0", "qd0")
    q = q + 0.1 * np.cos(np.arange(len(q)))
    qd = qd + np.sin(np.arange(len(q)))
    qdd, h = np.cos(3.0 * np.arange(len(q))), 1e-4

    def value_at(what: str, s: float) -> np.ndarray:
        return answer.evaluate(what, q + s * qd + s**2 * qdd / 2, qd + s * qdd, 0.7 + s)

    n = len(constraint_cases.cases()[name]["constraints"])
    A, rates, gamma = (
        answer.evaluate(x, q, qd, 0.7) for x in ("constraint_jacobian", "constraint_rates", "gamma")
    )
    size = np.max(np.abs(A)) * (np.max(np.abs(qd)) + np.max(np.abs(qdd)))
    slope = (value_at("constraints", h) - value_at("constraints", -h))[:n] / (2 * h)
    np.testing.assert_allclose(rates[:n], slope, atol=1e-6 * size)
    bend = (value_at("constraint_rates", h) - value_at("constraint_rates", -h)) / (2 * h)
    np.testing.assert_allclose(A @ qdd + gamma, bend, atol=1e-6 * size)


@pytest.mark.parametrize("name", tiers(RUNS, "chaplygin_sleigh"))
def test_error_of_projected_rk4_is_that_of_an_independent_one(name: str) -> None:
    measured = constraint_cases.cases()[name]["rk4_measured"][0]
    answer = symbolic.reference_for(constraint_cases.system(name))
    steps = measured["steps"]
    rows = [*range(0, steps, 50), steps]
    times, q, qd = (x[rows] for x in answer.simulate(h=measured["h"], steps=steps))
    expected = measured["projected"]["err_q"]
    assert constraint_cases.error_of(name, q[-1]) == pytest.approx(expected, rel=0.05)
    n = len(constraint_cases.cases()[name]["constraints"])
    assert np.max(np.abs(answer.evaluate("constraints", q, qd, times)[:, :n]), initial=0) < 1e-13
    rates = answer.evaluate("constraint_rates", q, qd, times)
    assert np.max(np.abs(rates)) < 1e-12 * (1 + np.max(np.abs(qd)))


def double_pendulum() -> System:
    """Return a pendulum on a table, whose second constraint repeats the first."""
    x, y, m = (symbol(name) for name in ("x", "y", "m"))
    rates = symbol("x_dot") ** 2 + symbol("y_dot") ** 2
    system = System.make("twice", {x: 1.0, y: 0.0}, m * rates / 2, parameters={m: 2.0})
    rod = x**2 + y**2 - 1
    return replace(system, constraints=(Constraint("rod", rod), Constraint("again", 3 * rod)))


def test_repeated_constraint_shares_the_force() -> None:
    """The multipliers have minimum norm, with scaled constraints; accelerations are those of
    one.
    """
    answer = symbolic.derive(double_pendulum())
    q, qd = [0.6, 0.8], [-1.6, 1.2]
    np.testing.assert_allclose(answer.acceleration(q, qd), [-2.4, -3.2], rtol=1e-14)
    first, again = answer.multipliers(q, qd)
    assert first == pytest.approx(3 * again)
    assert first + 3 * again == pytest.approx(-4)


def test_massless_coordinate_is_solved_from_its_constraint() -> None:
    x, s = symbol("x"), symbol("s")
    system = System.make("massless", {x: 0.0, s: 0.0}, symbol("x_dot") ** 2, 9.81 * x)
    constrained_system = replace(system, constraints=(Constraint("drive", s - x - sympy.sin(t)),))
    answer = symbolic.derive(constrained_system)
    computed = answer.acceleration([0.2, 0.2 + np.sin(0.5)], [0.0, np.cos(0.5)], 0.5)
    np.testing.assert_allclose(computed, [-9.81 / 2, -9.81 / 2 - np.sin(0.5)], rtol=1e-14)
    assert answer.multipliers([0.2, 0.2], [0.0, 0.0])[0] == pytest.approx(0, abs=1e-12)


def test_project_returns_the_nearest_of_many_states() -> None:
    answer = symbolic.derive(double_pendulum())
    q, qd = answer.project([[1.2, 0.0], [0.3, -0.4]], [[0.1, 2.0], [1.0, 1.0]])
    np.testing.assert_allclose(q, [[1, 0], [0.6, -0.8]], atol=1e-15)
    np.testing.assert_allclose(qd, [[0, 2], [1.12, 0.84]], atol=1e-15)


def test_failed_projection_is_nan() -> None:
    system = double_pendulum()
    x = symbol("x")
    torn = replace(system, constraints=(Constraint("one", x - 1), Constraint("two", x - 2)))
    q, _ = symbolic.derive(torn).project([0.0, 0.0], [0.0, 0.0])
    assert np.all(np.isnan(q))


def test_scales_make_constraints_and_coordinates_comparable() -> None:
    D, A = np.diag([1e-6, 1e6]), np.array([[1e-3, 1e3], [2.0, 0.0]])
    s = kkt.scales(D, A)
    B = s[2:, None] * A * s[:2]
    np.testing.assert_allclose(np.sum(B**2, axis=1), 1)
    x, multipliers = kkt.solve(D, A, np.array([1.0, 2.0]), np.array([0.0, 4.0]))
    np.testing.assert_allclose(x, [2.0, -2e-6], rtol=1e-12)
    np.testing.assert_allclose(D @ x - A.T @ multipliers, [1.0, 2.0], rtol=1e-9)


def test_velocity_constraints_do_not_change_positions() -> None:
    """Positions are projected onto position constraints only."""
    xd, yd, zd = (symbol(f"{n}_dot") for n in "xyz")
    rows = {"line": symbol("y") - 2 * symbol("x"), "blade": zd - symbol("y") * xd}
    system = System.make("mixed", ["x", "y", "z"], (xd**2 + yd**2 + zd**2) / 2, constraints=rows)
    for answer in (TaylorReference(system), symbolic.derive(system)):
        q, qd = answer.project(np.array([1.0, 1.0, 5.0]), np.array([1.0, 1.0, 0.0]))
        np.testing.assert_allclose(q, [0.6, 1.2, 5.0], rtol=1e-15)
        np.testing.assert_allclose([qd[1] - 2 * qd[0], qd[2] - 1.2 * qd[0]], 0, atol=1e-15)


def test_states_are_corrected_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each result is that of a single state, also if others need more iterations or fail."""
    answer = TaylorReference(double_pendulum())
    q = np.array([[1.001, 0.0], [0.7, -0.7], [np.nan, 0.0], [0.6, -0.8]])
    qd = np.array([[0.1, 2.0], [1.0, 1.0], [0.0, 1.0], [0.8, 0.6]])
    calls: list[object] = []
    ask = answer.value
    monkeypatch.setattr(
        answer, "value", lambda *arguments: calls.append(arguments) or ask(*arguments)
    )
    single = [answer.corrected(*state, 0.0) for state in zip(q, qd, strict=True)]
    single_calls = len(calls)
    corrected = answer.corrected(q, qd, np.zeros(4))
    np.testing.assert_allclose(corrected, np.moveaxis(single, 0, 1), rtol=1e-15, atol=1e-15)
    assert np.isnan(corrected[0][2]).all() and np.isfinite(np.delete(corrected, 2, 1)).all()
    assert len(calls) - single_calls < 0.8 * single_calls


def test_sign_of_mass_matrices_on_constraints() -> None:
    D = np.diag([-1.0, 1.0])
    assert not kkt.is_nonnegative(D, np.array([[0.0, 1.0]]))
    assert kkt.is_nonnegative(D, np.array([[1.0, 0.0]]))
    assert kkt.is_nonnegative(np.eye(2), np.zeros((0, 2)))
    for undecided in ([[0.0, 1.0], [0.0, 1.0]], [[0.0, 0.0]], [[0.0, np.nan]]):
        assert kkt.is_nonnegative(D, np.array(undecided))
