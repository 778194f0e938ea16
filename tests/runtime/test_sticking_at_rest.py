"""Stick friction at rest at zero under growing forces: steps do not follow rounding."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.point_masses import read_system
from support.session import Modules, tiers

import eomc

PHI_FRICTION = ", friction = 0.02"
SLIP_TIME = math.asin(0.4) / 3  # where 0.05 sin(3 t) exceeds 0.02

JOINT = """eomc = 1
name = "stuck_joint"
[coordinates]
phi = { unit = "rad", friction = 0.02 }
[parameters]
J = 0.003
[energy]
kinetic = "J*phi_dot**2/2"
[forces]
phi = "0.05*sin(3*t)"
[run]
friction = "stick"
tolerance = 1e-10
duration = 1
batch = true
"""

BOUNDED = (JOINT.replace("0.05*sin(3*t)", "min(max(0.05*sin(3*t), -0.04), 0.04)")
           .replace("stuck_joint", "stuck_bounded"))  # fmt: skip

INPUT = '[inputs]\nu = { signal = "0.05*sin(3*t)", limits = [-0.04, 0.04] }\n[energy]'
LIMITED = (JOINT.replace("[energy]", INPUT).replace('phi = "0.05*sin(3*t)"', 'phi = "u"')
           .replace("stuck_joint", "stuck_limited"))  # fmt: skip

# psi drives phi through a gear: one holds the other through a constraint, which rounds
GEAR = """eomc = 1
name = "stuck_gear"
[coordinates]
phi = { unit = "rad" FRICTION }
psi = { unit = "rad", friction = 0.02 }
[energy]
kinetic = "0.003*phi_dot**2/2 + 0.0007*psi_dot**2/2"
[forces]
psi = "0.05*sin(3*t)"
[constraints]
gear = "psi - 0.3*phi"
[run]
friction = "stick"
tolerance = 1e-10
duration = 1
"""

TWO_BODIES = JOINT.replace("[parameters]", "y = { unit = 'm' }\n[parameters]").replace(
    "J*phi_dot**2/2", "J*phi_dot**2/2 + y_dot**2/2"
).replace("phi = \"0.05*sin(3*t)\"", 'phi = "0.05*sin(3*t)"\ny = "1e-3*cos(2*t)"').replace(
    "stuck_joint", "stuck_beside"
)  # fmt: skip


@pytest.fixture(scope="module")
def joint(modules: Modules) -> ModuleType:
    return modules.unoptimised(JOINT)


def sliding_angle(t: float, J: float) -> float:
    """Return phi at t, from J phi_ddot = 0.05 sin(3 t) - 0.02 after it slips."""
    s = t - SLIP_TIME
    integral = math.cos(3 * SLIP_TIME) * s / 3 - (math.sin(3 * t) - math.sin(3 * SLIP_TIME)) / 9
    return (0.05 * integral - 0.01 * s**2) / J


def assert_rests_until_slip(run: object, name: str = "phi") -> None:
    """Assert that it rests at 0 bit for bit until it slips, once."""
    t, q = run.t, run[name]  # type: ignore[attr-defined, index]
    slips = run.events[f"{name}_slips"].t  # type: ignore[attr-defined]
    assert slips.tolist() == [pytest.approx(SLIP_TIME, abs=1e-14)]
    assert not np.any(q[t < SLIP_TIME])


@pytest.mark.parametrize("stiff", [False, True])
@pytest.mark.parametrize("J", [0.003, 0.01, 0.3, 0.7, 1.0, 3.0, 10.0])
def test_joint_at_zero_rests_until_it_slips(joint: ModuleType, J: float, stiff: bool) -> None:
    for tol in (1e-3, 1e-6, 1e-9, 1e-10, 1e-12, 1e-15):
        run = joint.simulate(tol=tol, params={"J": J}, stiff=stiff)
        assert_rests_until_slip(run)
        assert run.status == "ok" and run.steps < 30
        assert run.q[-1, 0] == pytest.approx(sliding_angle(1.0, J), rel=max(tol, 1e-14))


def test_initial_position_does_not_matter(joint: ModuleType) -> None:
    starts = np.array([[0.0], [1e-300], [-1e-20], [1e-6], [0.3]])
    batch = joint.simulate_batch(starts, np.zeros_like(starts), times=[0.0, 0.1, 1.0])
    assert batch.q[:, 1, 0].tolist() == starts[:, 0].tolist()
    np.testing.assert_allclose(
        batch.q[:, 2, 0] - starts[:, 0], sliding_angle(1.0, 0.003), rtol=1e-13
    )
    for duration in (10.0, 1000.0):
        run = joint.simulate(duration=duration)
        assert run.events["phi_slips"].t[0] == pytest.approx(SLIP_TIME, abs=1e-14)
        assert run.steps < 3 * duration + 10


@pytest.mark.parametrize("text", tiers([BOUNDED, LIMITED], BOUNDED), ids=["bounded", "limited"])
def test_joint_rests_under_forces_with_kinks(modules: Modules, text: str) -> None:
    module = modules.unoptimised(text)
    kink_time = math.asin(0.8) / 3
    speed = (0.05 * (math.cos(3 * SLIP_TIME) - 0.6) / 3 - 0.02 * (kink_time - SLIP_TIME)) / 0.003
    release_time = math.pi / 3 - kink_time
    release_speed = speed + 0.02 * (release_time - kink_time) / 0.003
    end = (
        sliding_angle(kink_time, 0.003)
        + speed * (release_time - kink_time)
        + 0.01 * (release_time - kink_time) ** 2 / 0.003
    )
    s = 1 - release_time
    integral = math.cos(3 * release_time) * s / 3 - (math.sin(3) - math.sin(3 * release_time)) / 9
    end += release_speed * s + (0.05 * integral - 0.01 * s**2) / 0.003
    for tol in (1e-3, 1e-6, 1e-9, 1e-12):
        for stiff in (False, True):
            run = module.simulate(tol=tol, stiff=stiff)
            assert_rests_until_slip(run)
            assert run.status == "ok" and run.steps < 120
            assert run.q[-1, 0] == pytest.approx(end, rel=max(10 * tol, 1e-12))


@pytest.mark.parametrize("friction", tiers(["", PHI_FRICTION], PHI_FRICTION), ids=["one", "both"])
@pytest.mark.parametrize("bounded", tiers([False, True], True), ids=["smooth", "bounded"])
def test_coupled_bodies_rest_too(modules: Modules, friction: str, bounded: bool) -> None:
    """psi = 0.3 phi: J = 0.0007 + 0.003/0.09, and the friction of phi counts 1/0.3."""
    text = GEAR.replace(" FRICTION", friction)
    if bounded:
        text = text.replace("0.05*sin(3*t)", "min(max(0.05*sin(3*t), -0.04), 0.04)")
    module = modules.unoptimised(text)
    for q0 in ([0.0, 0.0], [0.5, 0.15]):
        for tol in (1e-4, 1e-7, 1e-10, 1e-13):
            run = module.simulate(q0, tol=tol)
            assert run.status == "ok" and run.steps < 250
            rest = run.t < (2 if friction else SLIP_TIME)
            np.testing.assert_allclose(run.q[rest, :2], [q0] * np.sum(rest), rtol=0, atol=1e-14)
            if not friction:
                assert run.events["psi_slips"].t.tolist() == [pytest.approx(SLIP_TIME, abs=1e-11)]
            if not friction and not bounded:
                end = sliding_angle(1.0, 0.0007 + 0.003 / 0.09)
                assert run["psi"][-1] - q0[1] == pytest.approx(end, rel=max(tol, 1e-11))


def test_one_body_rests_while_another_moves(modules: Modules) -> None:
    module = modules.unoptimised(TWO_BODIES)
    for tol in (1e-3, 1e-6, 1e-9, 1e-12):
        run = module.simulate(tol=tol)
        assert_rests_until_slip(run)
        assert run.status == "ok" and run.steps < 40
        assert run["y"][-1] == pytest.approx(2.5e-4 * (1 - math.cos(2)), rel=max(tol, 1e-13))


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize("text", tiers([JOINT, BOUNDED], BOUNDED), ids=["smooth", "bounded"])
def test_portable_form_rests_too(modules: Modules, text: str, tmp_path: Path) -> None:
    fast, portable = modules.unoptimised(text), eomc.load(read_system(text), tmp_path, form="plain")
    for tol in (1e-3, 1e-10):
        run, portable_run = fast.simulate(tol=tol), portable.simulate(tol=tol)
        assert_rests_until_slip(portable_run)
        assert portable_run.status == "ok" and portable_run.steps < 80
        np.testing.assert_allclose(portable_run.q[-1], run.q[-1], rtol=max(10 * tol, 1e-12))


def test_force_by_sign_is_reported_with_advice(modules: Modules) -> None:
    """The advice is not friction = "stick", which the scene has already."""
    text = TWO_BODIES.replace("y = {", "y = { rate = 0.01,").replace(
        "1e-3*cos(2*t)", "-0.1*sign(y_dot)"
    )
    with pytest.warns(RuntimeWarning, match="give its coordinate friction = in place of"):
        run = modules.unoptimised(text.replace("stuck_beside", "stuck_by_sign")).simulate()
    assert run.status == "no convergence" and 'take friction = "stick"' not in run.message
