"""Forces of drives in a given motion, separate from the constraint forces."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.session import Modules
from test_constrained_batch import DRIVEN
from test_constrained_discretize import ROPE, SLEIGH

ASK = "[run]\ninverse_dynamics = true\nframes = true\n"


@pytest.fixture(scope="module")
def linkage(modules: Modules) -> ModuleType:
    return modules.unoptimised(DRIVEN)


def motion(m: ModuleType, u: Any) -> tuple[Any, Any, Any]:
    """Return (q, qd, qdd) along a run under constant inputs."""
    run = m.simulate(h=0.01, steps=20, every=5, u=u)
    return run.q, run.qd, m.acceleration(run.q, run.qd, u=u)


def test_force_of_a_single_drive_equals_the_applied_one(linkage: ModuleType) -> None:
    for u, drive in (([0.6, 0.0], "q1"), ([0.0, -0.7], "q3")):
        q, qd, qdd = motion(linkage, u)
        tau, multipliers = linkage.drive_forces(q, qd, qdd, [drive])
        expected = np.zeros_like(q)
        expected[:, linkage.coordinates.index(drive)] = sum(u)
        np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-11)
        np.testing.assert_allclose(multipliers, linkage.multipliers(q, qd, u=u), rtol=0, atol=1e-10)
        single = linkage.drive_forces(q[2], qd[2], qdd[2], drive)
        assert np.array_equal(single[0], tau[2]) and np.array_equal(single[1], multipliers[2])


@pytest.mark.parametrize("drives", [None, ["q1", "q3"], ["q2", "q3"]])
def test_force_of_redundant_drives_is_the_smallest(linkage: ModuleType, drives: Any) -> None:
    q, qd, qdd = (x[3] for x in motion(linkage, [0.6, -0.2]))
    tau, multipliers = linkage.drive_forces(q, qd, qdd, drives)
    A, D = linkage.constraint_jacobian(q), linkage.D(q)
    total = linkage.inverse_dynamics(q, qd, qdd)
    np.testing.assert_allclose(total, D @ qdd + linkage.bias(q, qd), rtol=1e-12, atol=1e-12)
    friction = linkage.tau(q, qd, u=[0.0, 0.0])
    np.testing.assert_allclose(tau + friction + A.T @ multipliers, total, rtol=0, atol=1e-11)
    indices = [linkage.coordinates.index(name) for name in drives or linkage.coordinates]
    assert not np.delete(tau, indices).any()
    # other solutions are larger: tau has no component that drives and constraints balance alone
    null_space = np.linalg.svd(np.hstack([np.eye(3)[:, indices], -A.T]))[2][3:]
    for direction in null_space:
        self_stress = np.zeros(3)
        self_stress[indices] = direction[: len(indices)]
        assert abs(self_stress @ np.linalg.solve(D, tau)) < 1e-10 * np.abs(tau).max()
        assert np.abs(self_stress).max() > 0.1


def test_external_forces_are_balanced_too(linkage: ModuleType) -> None:
    q, qd, qdd = (x[1] for x in motion(linkage, [0.4, 0.0]))
    push = {"coupler": [3.0, -1.0, 0.5]}
    tau, _ = linkage.drive_forces(q, qd, qdd, ["q1"], push)
    without_push, _ = linkage.drive_forces(q, qd, qdd, ["q1"])
    direction = np.linalg.svd(linkage.constraint_jacobian(q))[2][-1]
    work = direction @ linkage.frame_forces(q, push)
    assert (tau - without_push)[0] * direction[0] == pytest.approx(-work, rel=1e-12)
    assert abs(work) > 0.1


@pytest.mark.slow
def test_nonholonomic_and_massless_systems_have_drive_forces(modules: Modules) -> None:
    sleigh: Any = modules.unoptimised(SLEIGH + "inverse_dynamics = true\n")
    q, qd = sleigh.start
    qdd = sleigh.acceleration(q, qd, u=[0.6])
    tau, blade = sleigh.drive_forces(q, qd, qdd, ["x", "psi"])
    np.testing.assert_allclose(tau, [0, 0, 0.6], rtol=0, atol=1e-12)
    np.testing.assert_allclose(blade, sleigh.multipliers(q, qd, u=[0.6]), rtol=1e-11)
    rope: Any = modules.unoptimised(ROPE + "inverse_dynamics = true\n")
    q, qd = rope.start
    qdd = rope.acceleration(q, qd)
    tau, multipliers = rope.drive_forces(q, qd, qdd, ["x"])
    np.testing.assert_allclose(tau, 0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(multipliers, rope.multipliers(q, qd), rtol=1e-10)


def test_without_constraints_drive_forces_equal_inverse_dynamics(modules: Modules) -> None:
    text = 'eomc = 1\nname = "cart_drives"\n[coordinates]\nx = {}\na = { start = 0.4 }\n[energy]\n'
    text += (
        'kinetic = "x_dot**2 + x_dot*a_dot*cos(a) + m*a_dot**2"\npotential = "9*cos(a) + x**3"\n'
    )
    m: Any = modules.unoptimised(text + "[parameters]\nm = 1\n[run]\ninverse_dynamics = true\n")
    q, qd = np.array([0.0, 0.4]), np.array([0.1, 0.2])
    tau, multipliers = m.drive_forces(q, qd, [1.0, 2.0])
    assert multipliers.shape == (0,)
    np.testing.assert_allclose(tau, m.inverse_dynamics(q, qd, [1.0, 2.0]), rtol=1e-13)
    with pytest.raises(
        ValueError, match=r"forces along x can't give .*: name others.* 2 degrees of freedom"
    ):
        m.drive_forces(q, qd, [1.0, 2.0], ["x"])
    with pytest.raises(m.MotionError, match=r"at .*a force .* is not finite there"):
        m.drive_forces([1e200, 0.4], qd, [1.0, 2.0])
    with pytest.raises(m.MotionError, match="D is not positive definite there"):
        m.drive_forces(q, qd, [1.0, 2.0], params={"m": -1.0})


def test_invalid_arguments_are_refused(linkage: ModuleType) -> None:
    q, qd, qdd = (x[1] for x in motion(linkage, [0.4, 0.0]))
    with pytest.raises(ValueError, match="drives: 'crank' is not one of q1, q2, q3"):
        linkage.drive_forces(q, qd, qdd, ["crank"])
    with pytest.raises(ValueError, match="forces along nothing can't give this motion"):
        linkage.drive_forces(q, qd, qdd, [])
    qdd_invalid = qdd + np.array([0.0, 0.0, 0.5])
    row = linkage.constraint_jacobian(q)
    message = r"qdd: leaves the constraint pin_[xy]: its row of A qdd, .* is .* and has to be"
    with pytest.raises(ValueError, match=message) as error:
        linkage.drive_forces(q, qd, qdd_invalid, ["q1"])
    k = ["pin_x" in str(error.value), "pin_y" in str(error.value)].index(True)
    assert f"{(row @ qdd_invalid)[k]:.6g} and has to be {(row @ qdd)[k]:.6g}" in str(error.value)
    tangent = np.linalg.svd(row)[2][-1]
    # accelerations within the constraints are accepted
    linkage.drive_forces(q, qd, qdd + 3 * tangent, ["q1"])


@pytest.mark.slow
def test_redundant_constraints_have_zero_multipliers(modules: Modules) -> None:
    text = (SCENES / "bricard.toml").read_text(encoding="utf-8").split("[picture]")[0]
    text = text.replace('name    = "bricard"', 'name = "bricard_drives"')
    m: Any = modules.unoptimised(text.replace("[run]", ASK) if "[run]" in text else text + ASK)
    q, qd = m.start
    qdd = m.acceleration(q, qd)
    tau, multipliers = m.drive_forces(q, qd, qdd, [m.coordinates[0]])
    np.testing.assert_allclose(tau, 0, rtol=0, atol=1e-10)
    expected = m.multipliers(q, qd)
    assert (expected == 0).any()
    np.testing.assert_allclose(multipliers, expected, rtol=1e-9, atol=1e-10)
