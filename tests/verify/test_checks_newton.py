"""Steps that are long relative to the fastest mode: Newton's method is needed and must be right."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.compilation import Shipped
from support.forks import in_a_fork
from support.mutants import variant
from support.session import tiers
from support.template_checks.newton import MAX_EXTRA_SWEEPS, NewtonChecks

from eomc.integrators.tableaux import METHODS
from eomc.verify import reference, symbolic
from eomc.verify.comparison import Comparison

SYSTEM = variant("pendulum_dp8_gauss8")

# The C text, and its wrong replacement.
WRONG = {
    "the diagonal of the substitution": ("x[i] *= M[n*i + i];", "x[i] *= M[n*i - i];"),
    "a sum of the substitution": (
        "for (int j = i + 1; j < n; j++)\n            x[i] -=",
        "for (int j = i + 1; j < n; j++)\n            x[i] +=",
    ),
    "no derivatives": ("for (int l = 0; l < NQ; l++)", "for (int l = 0; l >= NQ; l++)"),
    "their weights": ("+ h*AA[i][j]*", "+ h*AA[j][i]*"),
    "the exchange of rows": ("x[row[k]] = x[k];", "x[k] = x[row[k]];"),
    "a factor": ("M[n*i + j] -= factor*M[n*k + j];", "M[n*i + j] += factor*M[n*k + j];"),
}


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Shipped:
    """The C of the double pendulum."""
    # Derive the reference once for all forked processes.
    symbolic.reference_for(SYSTEM).acceleration(*np.zeros((2, len(SYSTEM.q))))
    return Shipped(SYSTEM, tmp_path_factory.mktemp("newton"))


def extra_iterations(shipped: Shipped, source: str) -> float:
    """Return the result of the check for changed C; a large number if it diverges."""

    def measure() -> float:
        comparison = Comparison(SYSTEM, shipped.load(), np.random.default_rng(0), 4)
        result = NewtonChecks(comparison).extra_sweeps("gauss8")
        assert isinstance(result, float)
        return result if math.isfinite(result) else 1e9

    assert shipped.compile(("-O0", "-march=native"), source) is None
    kind, value = in_a_fork(measure, 60)
    assert kind == "done" and isinstance(value, float), value
    return value


def test_correct_derivatives_need_few_iterations(shipped: Shipped) -> None:
    assert -1 <= extra_iterations(shipped, shipped.source) < 3


@pytest.mark.parametrize("what", tiers(WRONG, "the diagonal of the substitution"))
def test_wrong_derivatives_need_many_iterations(shipped: Shipped, what: str) -> None:
    right, wrong = WRONG[what]
    assert shipped.source.count(right) == 1
    assert extra_iterations(shipped, shipped.source.replace(right, wrong)) > MAX_EXTRA_SWEEPS


def test_newton_and_fixed_point_iteration_give_the_same_step() -> None:
    def a(q: Any, qd: Any, t: Any) -> Any:
        return -np.sin(q) - qd**3 / 5 + np.cos(3 * t)[..., None]

    q, qd, m = np.array([0.5, -0.3]), np.array([0.2, 0.7]), METHODS["gauss6"]
    extra_iterations = reference.runge_kutta_step(
        m, lambda q, qd, t: a(q, qd, np.asarray(t)), q, qd, 0.2, 0.3
    )
    ends, count = reference.step_by_newton(m, a, q, qd, 0.2, 0.3)
    assert np.allclose(ends, extra_iterations, rtol=0, atol=1e-14)
    assert 1 < count < 10


def test_contraction_rate_of_fixed_point_iteration() -> None:
    """For an oscillator it is h^2 w^2 times the largest eigenvalue of A A, which is 1/12 for
    gauss4.
    """
    slopes = np.array([[-9.0, 0.0]])
    assert reference.contraction_factor(METHODS["gauss4"], slopes, 0.5) == pytest.approx(9 / 48)


def test_overflow_of_one_state_invalidates_the_step() -> None:
    """The values of a diverging iteration are no result for the other states either."""

    def acceleration(q: Any, qd: Any, t: Any) -> Any:
        return -1e13 * qd

    qd = np.array([[1e200], [1.0]])
    with np.errstate(all="ignore"):
        ends = reference.runge_kutta_step(METHODS["gauss4"], acceleration, 0 * qd, qd, 0.0, 1e-2)
    assert np.all(np.isnan(ends))


def test_stages_of_one_state_are_evaluated_in_one_call() -> None:
    calls = 0

    def a(q: Any, qd: Any, t: Any) -> Any:
        nonlocal calls
        calls += 1
        return -np.sin(q) - qd**3 / 5 + np.cos(3 * np.asarray(t))[..., None]

    q, qd, m = np.array([0.5, -0.3]), np.array([0.2, 0.7]), METHODS["gauss6"]
    one = reference.runge_kutta_step(m, a, q, qd, 0.2, 0.3)
    assert calls <= 1 + reference.MAX_SWEEPS
    of_many = reference.runge_kutta_step(m, a, q[None], qd[None], np.array([0.2]), 0.3)
    assert np.allclose(one, of_many[:, 0], rtol=0, atol=1e-15)
