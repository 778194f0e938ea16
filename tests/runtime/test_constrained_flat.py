"""A parallelogram goes through the position where it lies flat and its rows fade."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from cases import SCENES
from conftest import MODULES, Modules, tiers
from test_constrained_runs import four_bars

import eomc

pytestmark = pytest.mark.usefixtures("quickly_compiled")


FLAT = {
    "h": 0.005, "duration": 0.2, "params": {"r": 0.4, "s": 1.0, "l": -0.4},
}  # fmt: skip


@pytest.fixture(scope="module", params=tiers(["plain", "fast"], "fast"))
def module(request: pytest.FixtureRequest, modules: Modules, unoptimised_file: None) -> ModuleType:
    """One bar along the frame, and two of 0.4 that turn as one."""
    if request.param == "fast":
        return modules.unoptimised(four_bars())
    return eomc.load(four_bars(), MODULES.parent / "flat", form="plain")


@pytest.mark.parametrize("start", [0.05, 0.0503, 0.0471, 0.05 + 1e-5])
def test_a_parallelogram_goes_on_through_the_flat_position(
    module: ModuleType, start: float
) -> None:
    """Rounding in a correction is more than that of a coordinate near zero there."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0], **FLAT)
    assert run.status == "ok" and run.q[-1, 0] < -0.5
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.q[:, 1]).max() < 1e-9
    assert np.ptp(run.energy) < 1e-9


@pytest.mark.parametrize("start", [0.3, 0.06, 0.0375])
def test_a_stage_where_rows_have_no_slope_throws_nothing_out(
    module: ModuleType, start: float
) -> None:
    """At 0 to a rounding, at a step's end or amid one: a row that is rounding holds nothing."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0], **FLAT)
    assert run.status == "ok"
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.qd[:, 0] + 3.0).max() < 1e-6


def test_steps_near_the_flat_position_are_as_long_as_elsewhere(module: ModuleType) -> None:
    """What leaves the rows there decays by qd/q, and each step puts it back: 200 1/s here."""
    near = {"q0": [-0.015, 0.0, -0.015], "qd0": [-3.0, 0.0, -3.0]}
    assert module.advice(**near, h=0.1, params=FLAT["params"]) is None
    # two bars that turn as one, held by a spring of 2 k: w^2 = k
    stiff = {"q0": [0.9, 0.0, 0.9], "qd0": [0.0] * 3, "params": {**FLAT["params"], "k": 1e4}}
    assert "limit of about 0.028 s here (fastest mode 100 rad/s" in module.advice(**stiff, h=0.029)
    assert module.advice(**stiff, h=0.028) is None


@pytest.mark.slow
def test_rows_that_turn_with_a_fast_motion_shorten_no_step() -> None:
    """Andrews' squeezer: by changes along its rows alone 0.6 ms, where 2.6 ms are right."""
    andrews = eomc.load(SCENES / "andrews_squeezer.toml", MODULES.parent / "flat")
    run = andrews.simulate(method="rk4", h=5e-5, steps=600, every=20)
    assert all(andrews.advice(q, qd, 2e-3) is None for q, qd in zip(run.q, run.qd, strict=True))
    assert any(andrews.advice(q, qd, 4e-3) for q, qd in zip(run.q, run.qd, strict=True))
