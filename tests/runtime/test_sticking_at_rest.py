"""Friction that sticks from the start, at zero, while forces grow: steps follow no rounding."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import Modules, tiers
from links import made_of

import eomc

BOTH = ", friction = 0.02"
SLIPS = math.asin(0.4) / 3  # where 0.05 sin(3 t) exceeds 0.02

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

# the drive psi turns phi by a gear: what holds one holds the other by a row that rounds
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

BESIDE = JOINT.replace("[parameters]", "y = { unit = 'm' }\n[parameters]").replace(
    "J*phi_dot**2/2", "J*phi_dot**2/2 + y_dot**2/2"
).replace("phi = \"0.05*sin(3*t)\"", 'phi = "0.05*sin(3*t)"\ny = "1e-3*cos(2*t)"').replace(
    "stuck_joint", "stuck_beside"
)  # fmt: skip


@pytest.fixture(scope="module")
def joint(modules: Modules) -> ModuleType:
    return modules.unoptimised(JOINT)


def turned(t: float, J: float) -> float:
    """phi at t, from J phi_ddot = 0.05 sin(3 t) - 0.02 after it slips."""
    s = t - SLIPS
    swung = math.cos(3 * SLIPS) * s / 3 - (math.sin(3 * t) - math.sin(3 * SLIPS)) / 9
    return (0.05 * swung - 0.01 * s**2) / J


def held(run: object, name: str = "phi") -> None:
    """It rests at 0 to the last bit until it slips, once."""
    t, q = run.t, run[name]  # type: ignore[attr-defined, index]
    slips = run.events[f"{name}_slips"].t  # type: ignore[attr-defined]
    assert slips.tolist() == [pytest.approx(SLIPS, abs=1e-14)]
    assert not np.any(q[t < SLIPS])


@pytest.mark.parametrize("stiff", [False, True])
@pytest.mark.parametrize("J", [0.003, 0.01, 0.3, 0.7, 1.0, 3.0, 10.0])
def test_a_joint_at_zero_rests_until_it_slips(joint: ModuleType, J: float, stiff: bool) -> None:
    for tol in (1e-3, 1e-6, 1e-9, 1e-10, 1e-12, 1e-15):
        run = joint.simulate(tol=tol, params={"J": J}, stiff=stiff)
        held(run)
        assert run.status == "ok" and run.steps < 30
        assert run.q[-1, 0] == pytest.approx(turned(1.0, J), rel=max(tol, 1e-14))


def test_where_it_starts_does_not_matter(joint: ModuleType) -> None:
    starts = np.array([[0.0], [1e-300], [-1e-20], [1e-6], [0.3]])
    many = joint.simulate_batch(starts, np.zeros_like(starts), times=[0.0, 0.1, 1.0])
    assert many.q[:, 1, 0].tolist() == starts[:, 0].tolist()
    np.testing.assert_allclose(many.q[:, 2, 0] - starts[:, 0], turned(1.0, 0.003), rtol=1e-13)
    for duration in (10.0, 1000.0):
        run = joint.simulate(duration=duration)
        assert run.events["phi_slips"].t[0] == pytest.approx(SLIPS, abs=1e-14)
        assert run.steps < 3 * duration + 10


@pytest.mark.parametrize("text", tiers([BOUNDED, LIMITED], BOUNDED), ids=["bounded", "limited"])
def test_forces_with_corners_hold_it_too(modules: Modules, text: str) -> None:
    made = modules.unoptimised(text)
    bend = math.asin(0.8) / 3
    speed = (0.05 * (math.cos(3 * SLIPS) - 0.6) / 3 - 0.02 * (bend - SLIPS)) / 0.003
    out = math.pi / 3 - bend
    at_out = speed + 0.02 * (out - bend) / 0.003
    end = turned(bend, 0.003) + speed * (out - bend) + 0.01 * (out - bend) ** 2 / 0.003
    s = 1 - out
    swung = math.cos(3 * out) * s / 3 - (math.sin(3) - math.sin(3 * out)) / 9
    end += at_out * s + (0.05 * swung - 0.01 * s**2) / 0.003
    for tol in (1e-3, 1e-6, 1e-9, 1e-12):
        for stiff in (False, True):
            run = made.simulate(tol=tol, stiff=stiff)
            held(run)
            assert run.status == "ok" and run.steps < 120
            assert run.q[-1, 0] == pytest.approx(end, rel=max(10 * tol, 1e-12))


@pytest.mark.parametrize("friction", tiers(["", BOTH], BOTH), ids=["one", "both"])
@pytest.mark.parametrize("bounded", tiers([False, True], True), ids=["smooth", "bounded"])
def test_what_hangs_on_it_rests_too(modules: Modules, friction: str, bounded: bool) -> None:
    """psi turns phi/0.3: J = 0.0007 + 0.003/0.09, and the friction of phi counts 1/0.3."""
    text = GEAR.replace(" FRICTION", friction)
    if bounded:
        text = text.replace("0.05*sin(3*t)", "min(max(0.05*sin(3*t), -0.04), 0.04)")
    made = modules.unoptimised(text)
    for q0 in ([0.0, 0.0], [0.5, 0.15]):
        for tol in (1e-4, 1e-7, 1e-10, 1e-13):
            run = made.simulate(q0, tol=tol)
            assert run.status == "ok" and run.steps < 250
            rest = run.t < (2 if friction else SLIPS)
            np.testing.assert_allclose(run.q[rest, :2], [q0] * np.sum(rest), rtol=0, atol=1e-14)
            if not friction:
                assert run.events["psi_slips"].t.tolist() == [pytest.approx(SLIPS, abs=1e-11)]
            if not friction and not bounded:
                end = turned(1.0, 0.0007 + 0.003 / 0.09)
                assert run["psi"][-1] - q0[1] == pytest.approx(end, rel=max(tol, 1e-11))


def test_one_rests_while_another_moves(modules: Modules) -> None:
    made = modules.unoptimised(BESIDE)
    for tol in (1e-3, 1e-6, 1e-9, 1e-12):
        run = made.simulate(tol=tol)
        held(run)
        assert run.status == "ok" and run.steps < 40
        assert run["y"][-1] == pytest.approx(2.5e-4 * (1 - math.cos(2)), rel=max(tol, 1e-13))


@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize("text", tiers([JOINT, BOUNDED], BOUNDED), ids=["smooth", "bounded"])
def test_the_plain_form_does_the_same(modules: Modules, text: str, tmp_path: Path) -> None:
    fast, plain = modules.unoptimised(text), eomc.load(made_of(text), tmp_path, form="plain")
    for tol in (1e-3, 1e-10):
        run, other = fast.simulate(tol=tol), plain.simulate(tol=tol)
        held(other)
        assert other.status == "ok" and other.steps < 80
        np.testing.assert_allclose(other.q[-1], run.q[-1], rtol=max(10 * tol, 1e-12))


def test_a_force_by_sign_is_told_what_to_be(modules: Modules) -> None:
    """Where the scene says \"stick\" already, that is no remedy."""
    text = BESIDE.replace("y = {", "y = { rate = 0.01,").replace(
        "1e-3*cos(2*t)", "-0.1*sign(y_dot)"
    )
    with pytest.warns(RuntimeWarning, match="give its coordinate friction = in place of"):
        run = modules.unoptimised(text.replace("stuck_beside", "stuck_by_sign")).simulate()
    assert run.status == "no convergence" and 'take friction = "stick"' not in run.message
