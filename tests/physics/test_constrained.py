"""Compiled scenes with constraints against trusted answers (data/constrained.json).

An independent RK4 that put each step back onto the rows made the errors `projected`: ours are to be
no more than half as large again, twice where rows depend on each other on the way.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any

import constrained
import numpy as np
import pytest
from conftest import ROOT, tiers

import eomc
from eomc.program.assembly import assembled

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILT = ROOT / "build" / "tests" / "constrained"
NAMES = list(constrained.cases())
MEASURED = [name for name in NAMES if constrained.cases()[name]["rk4_measured"]]
QUICK = ("pendulum_over_the_top",)
FLAT = ("iftomm_A02_four_bar_N1", "iftomm_A02_four_bar_N2", "parallelogram_redundant_bar")
ALIKE = 1.5  # times the error of the independent RK4


@cache
def module(name: str) -> ModuleType:
    """A case from its guess, with rk4 and dp8."""
    made = constrained.system(name, "guess", redundant=False)
    run = replace(made.run, methods=("rk4", "dp8"))
    made = replace(made, name=f"case_{name.lower()}", run=run, digest=f"constrained {name}")
    return eomc.load(assembled(made), BUILT)


def simulate(name: str, **how: Any) -> Any:
    with warnings.catch_warnings(
        action="ignore", category=RuntimeWarning
    ):  # singular steps are looked at below
        return module(name).simulate(**how)


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_rk4_is_as_good_as_an_independent_one(name: str) -> None:
    case = constrained.cases()[name]
    for measured in case["rk4_measured"]:
        steps = measured["steps"]
        run = simulate(name, h=measured["h"], steps=steps, every=steps)
        assert run.status == "ok"
        error = constrained.error_of(name, run.q[-1])
        limit = (2 if name in FLAT else ALIKE) * measured["projected"]["err_q"]
        assert error <= limit, (measured["h"], error / measured["projected"]["err_q"])


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_rows_and_rates_hold_at_every_output(name: str) -> None:
    measured = constrained.cases()[name]["rk4_measured"][-1]
    run = simulate(name, h=measured["h"], steps=measured["steps"], every=5)
    own = module(name)
    scale = np.max(np.abs(run.q)) + 1
    off = own.constraints(run.q, run.qd, run.t)[:, : len(constrained.cases()[name]["constraints"])]
    assert np.max(np.abs(off), initial=0) <= 1e-13 * scale
    rates = own.constraint_rates(run.q, run.qd, run.t)
    assert np.max(np.abs(rates)) <= 1e-12 * (np.max(np.abs(run.qd)) + 1)


@pytest.mark.parametrize("name", tiers(NAMES, *QUICK))
def test_accelerations_and_multipliers_at_trusted_states(name: str) -> None:
    """A^T lambda where rows are redundant: other rows may bear what these do."""
    own = module(name)
    q, qd, a, multipliers = constrained.ends(name, "q_ref", "qd_ref", "qdd_ref", "lambda_ref")
    t = float(constrained.cases()[name]["t_end"])
    off = np.max(np.abs(own.acceleration(q, qd, t) - a)) / np.max(np.abs(a))
    assert off < 1e-10
    A = own.constraint_jacobian(q, t=t)
    found, expected = own.multipliers(q, qd, t), multipliers
    if constrained.cases()[name]["redundant"]:
        found, expected = found @ A, expected @ A
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", tiers(MEASURED, *QUICK))
def test_dp8_comes_down_to_eleven_digits(name: str) -> None:
    """In steps of a quarter of the finest of RK4."""
    measured = constrained.cases()[name]["rk4_measured"][-1]
    steps = 4 * measured["steps"]
    how = {"h": measured["h"] / 4, "steps": steps, "every": steps, "method": "dp8"}
    run = simulate(name, **how)
    moved = simulate(name, **how, q0=module(name).start[0] * (1 + 2.0**-52))
    floor = np.max(np.abs(moved.q[-1] - run.q[-1]))  # what a rounding of the start makes
    assert constrained.error_of(name, run.q[-1]) <= 1e-11 + 30 * floor


@pytest.mark.slow
def test_steps_that_end_where_a_four_bar_lies_flat() -> None:
    """Thirty step sizes: right behind the singular position, and told."""
    name = "iftomm_A02_four_bar_N1"
    fine = simulate(name, h=1e-4, steps=7200)
    y = fine.q[:, 1]
    k = int(np.argmax(y < 0))
    flat = float(fine.t[k - 1] + 1e-4 * y[k - 1] / (y[k - 1] - y[k]))
    assert flat == pytest.approx(0.7085, abs=1e-3)
    energy, told = [], 0
    for steps in range(20, 50):
        h = flat / steps
        run = simulate(name, h=h, steps=int(3 / h))
        assert run.status == "ok"
        energy.append(np.ptp(run.energy) / h**4)
        told += run.singular_steps > 0
    assert max(energy) < 2.5e3 * 1.5
    print("told", told)


@pytest.mark.parametrize(
    ("method", "counts", "most"),
    tiers([("dp8", [529, *range(660, 671), 515], 1e-6), ("rk4", [1036, 1109, 1113, 1125], 2e-5)]),
)
def test_stages_near_a_flat_position_do_no_harm(
    method: str, counts: list[int], most: float
) -> None:
    """Step sizes of which some lost the run where rows were left out too far from where it is."""
    name = "iftomm_A02_four_bar_N2"
    for steps in counts:
        run = simulate(name, h=10 / steps, steps=steps, every=steps, method=method)
        assert run.status == "ok" and constrained.error_of(name, run.q[-1]) < most, steps


@pytest.mark.parametrize("h", tiers([0.05, 0.04, 0.02, 0.01]))
def test_bricard_s_cube_turns_for_ten_seconds(h: float) -> None:
    """Its fifth row depends on the others on the manifold, and on none off it."""
    run = simulate("bricard_cube", h=h, duration=10.0)
    assert run.status == "ok" and run.singular_steps == 0
    limit = {0.05: 2.9e-2, 0.04: 1.3e-2, 0.02: 8.2e-4, 0.01: 5.2e-5}[h]
    assert np.max(np.abs(run.energy - run.energy[0])) <= 1.5 * limit
