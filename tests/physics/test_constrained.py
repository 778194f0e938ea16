"""Compiled scenes with constraints against reference solutions (data/constrained.json).

`projected` are the errors of an independent RK4 that projects each step onto the constraints. Ours
may be at most half as large again, or twice as large where constraints become dependent on the way.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import constraint_cases
from support.session import ROOT, tiers

import eomc
from eomc.mechanism.assembly import assembled

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILT = ROOT / "build" / "tests" / "constrained"
NAMES = list(constraint_cases.cases())
MEASURED = [name for name in NAMES if constraint_cases.cases()[name]["rk4_measured"]]
QUICK = ("pendulum_over_the_top",)
FLAT = ("iftomm_A02_four_bar_N1", "iftomm_A02_four_bar_N2", "parallelogram_redundant_bar")
ALIKE = 1.5  # times the error of the independent RK4


@cache
def module(name: str) -> ModuleType:
    """Load a case from its guessed initial values, with rk4 and dp8."""
    system = constraint_cases.system(name, "guess", redundant=False)
    run = replace(system.run, methods=("rk4", "dp8"))
    system = replace(system, name=f"case_{name.lower()}", run=run, digest=f"constrained {name}")
    return eomc.load(assembled(system), BUILT)


def simulate(name: str, **how: Any) -> Any:
    with warnings.catch_warnings(
        action="ignore", category=RuntimeWarning
    ):  # other tests below check singular steps
        return module(name).simulate(**how)


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_error_of_rk4_is_that_of_an_independent_rk4(name: str) -> None:
    case = constraint_cases.cases()[name]
    for measured in case["rk4_measured"]:
        steps = measured["steps"]
        run = simulate(name, h=measured["h"], steps=steps, every=steps)
        assert run.status == "ok"
        error = constraint_cases.error_of(name, run.q[-1])
        limit = (2 if name in FLAT else ALIKE) * measured["projected"]["err_q"]
        assert error <= limit, (measured["h"], error / measured["projected"]["err_q"])


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_constraints_are_satisfied_at_every_output(name: str) -> None:
    measured = constraint_cases.cases()[name]["rk4_measured"][-1]
    run = simulate(name, h=measured["h"], steps=measured["steps"], every=5)
    own = module(name)
    scale = np.max(np.abs(run.q)) + 1
    rows = len(constraint_cases.cases()[name]["constraints"])
    off = own.constraints(run.q, run.qd, run.t)[:, :rows]
    assert np.max(np.abs(off), initial=0) <= 1e-13 * scale
    rates = own.constraint_rates(run.q, run.qd, run.t)
    assert np.max(np.abs(rates)) <= 1e-12 * (np.max(np.abs(run.qd)) + 1)


@pytest.mark.parametrize("name", tiers(NAMES, *QUICK))
def test_accelerations_and_multipliers_at_reference_states(name: str) -> None:
    """Compare A^T lambda where constraints are redundant, because the multipliers are not
    unique.
    """
    own = module(name)
    q, qd, a, multipliers = constraint_cases.ends(name, "q_ref", "qd_ref", "qdd_ref", "lambda_ref")
    t = float(constraint_cases.cases()[name]["t_end"])
    off = np.max(np.abs(own.acceleration(q, qd, t) - a)) / np.max(np.abs(a))
    assert off < 1e-10
    A = own.constraint_jacobian(q, t=t)
    computed, expected = own.multipliers(q, qd, t), multipliers
    if constraint_cases.cases()[name]["redundant"]:
        computed, expected = computed @ A, expected @ A
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_dp8_reaches_eleven_digits(name: str) -> None:
    """The step size is a quarter of the smallest one of RK4."""
    measured = constraint_cases.cases()[name]["rk4_measured"][-1]
    steps = 4 * measured["steps"]
    how = {"h": measured["h"] / 4, "steps": steps, "every": steps, "method": "dp8"}
    run = simulate(name, **how)
    moved = simulate(name, **how, q0=module(name).start[0] * (1 + 2.0**-52))
    floor = np.max(np.abs(moved.q[-1] - run.q[-1]))  # effect of rounding the initial state
    assert constraint_cases.error_of(name, run.q[-1]) <= 1e-11 + 30 * floor


@pytest.mark.slow
def test_steps_that_end_near_the_singular_position_of_a_four_bar() -> None:
    """Thirty step sizes end just behind the singular position; singular steps are reported."""
    name = "iftomm_A02_four_bar_N1"
    fine = simulate(name, h=1e-4, steps=7200)
    y = fine.q[:, 1]
    k = int(np.argmax(y < 0))
    flat = float(fine.t[k - 1] + 1e-4 * y[k - 1] / (y[k - 1] - y[k]))
    assert flat == pytest.approx(0.7085, abs=1e-3)
    energy, reported = [], 0
    for steps in range(20, 50):
        h = flat / steps
        run = simulate(name, h=h, steps=int(3 / h))
        assert run.status == "ok"
        energy.append(np.ptp(run.energy) / h**4)
        reported += run.singular_steps > 0
    assert max(energy) < 2.5e3 * 1.5
    print("told", reported)


@pytest.mark.parametrize(
    ("method", "counts", "most"),
    tiers([("dp8", [529, *range(660, 671), 515], 1e-6), ("rk4", [1036, 1109, 1113, 1125], 2e-5)]),
)
def test_stages_near_a_singular_position_keep_the_run_accurate(
    method: str, counts: list[int], most: float
) -> None:
    """Runs with some of these step sizes failed when constraints were dropped too far from the
    state.
    """
    name = "iftomm_A02_four_bar_N2"
    for steps in counts:
        run = simulate(name, h=10 / steps, steps=steps, every=steps, method=method)
        assert run.status == "ok" and constraint_cases.error_of(name, run.q[-1]) < most, steps


@pytest.mark.parametrize("h", tiers([0.05, 0.04, 0.02, 0.01]))
def test_bricard_linkage_turns_for_ten_seconds(h: float) -> None:
    """The fifth constraint depends on the others on the manifold only."""
    run = simulate("bricard_cube", h=h, duration=10.0)
    assert run.status == "ok" and run.singular_steps == 0
    limit = {0.05: 2.9e-2, 0.04: 1.3e-2, 0.02: 8.2e-4, 0.01: 5.2e-5}[h]
    assert np.max(np.abs(run.energy - run.energy[0])) <= 1.5 * limit
