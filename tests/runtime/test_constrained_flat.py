"""A parallelogram passes the flat position, where its constraint gradients vanish."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from support.cases import SCENES
from support.session import MODULES, Modules, tiers
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
def test_parallelogram_passes_the_flat_position(module: ModuleType, start: float) -> None:
    """There the rounding of a correction exceeds that of a coordinate near zero."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0], **FLAT)
    assert run.status == "ok" and run.q[-1, 0] < -0.5
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.q[:, 1]).max() < 1e-9
    assert np.ptp(run.energy) < 1e-9


@pytest.mark.parametrize("start", [0.3, 0.06, 0.0375])
def test_stage_with_vanishing_constraint_gradient_does_not_diverge(
    module: ModuleType, start: float
) -> None:
    """At 0 to rounding, at a step's end or within it: a gradient of rounding is no constraint."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0], **FLAT)
    assert run.status == "ok"
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.qd[:, 0] + 3.0).max() < 1e-6


def test_step_limit_near_the_flat_position_is_the_usual_one(module: ModuleType) -> None:
    """Deviations normal to the constraints decay by qd/q = 200 1/s; steps project them away."""
    state = {"q0": [-0.015, 0.0, -0.015], "qd0": [-3.0, 0.0, -3.0]}
    assert module.advice(**state, h=0.1, params=FLAT["params"]) is None
    # two bars that turn as one, on a spring of 2 k: w^2 = k
    stiff = {"q0": [0.9, 0.0, 0.9], "qd0": [0.0] * 3, "params": {**FLAT["params"], "k": 1e4}}
    assert "limit of about 0.028 s here (fastest mode 100 rad/s" in module.advice(**stiff, h=0.029)
    assert module.advice(**stiff, h=0.028) is None


@pytest.mark.slow
def test_constraints_that_rotate_with_a_fast_motion_do_not_limit_steps() -> None:
    """Andrews' squeezer: changes within the constraints alone gave 0.6 ms; 2.6 ms are right."""
    andrews = eomc.load(SCENES / "andrews_squeezer.toml", MODULES.parent / "flat")
    run = andrews.simulate(method="rk4", h=5e-5, steps=600, every=20)
    assert all(andrews.advice(q, qd, 2e-3) is None for q, qd in zip(run.q, run.qd, strict=True))
    assert any(andrews.advice(q, qd, 4e-3) for q, qd in zip(run.q, run.qd, strict=True))
