"""Poses, velocities, Jacobians and inverse dynamics of robot files, compared with Pinocchio.

These tests need Pinocchio (pip install pin), which the test environment does not include: there
test_frames_mujoco.py compares with MuJoCo.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pinocchio = pytest.importorskip("pinocchio", reason="Pinocchio is not installed")
from robots.test_frames_mujoco import FIXED, Ours, near  # noqa: E402
from robots.test_robots_mujoco import (  # noqa: E402
    Array,
    Pair,
    from_urdf,
    robot_data,
    without_meshes,
    working_folder,  # noqa: F401 - a fixture, for all tests here
)

import eomc  # noqa: E402
from eomc.derive.lagrange import inverse_dynamics  # noqa: E402
from eomc.robots.scene_text import prepare_for_scene  # noqa: E402

pytestmark = pytest.mark.slow


MORE = """
    ur3_gripper ur5_gripper ur3_joint_limited_robot ur5_joint_limited_robot
    ur10_joint_limited_robot tiago_dual talos_full_v2 talos_full_v2_box centauro
""".split()


def pinocchio_state(
    both: Pair, model: Any, q: Array, qd: Array, qdd: Array
) -> tuple[tuple[Array, Array, Array], list[int]]:
    """Return a state in Pinocchio's order, and the places of our coordinates in its velocities."""
    at, v, a, places = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv), []
    for k, motion in enumerate(both.robot.motions):
        joint = model.joints[model.getJointId(motion.name)]
        places.append(joint.idx_v)
        v[joint.idx_v], a[joint.idx_v] = qd[k], qdd[k]
        turns = [math.cos(q[k]), math.sin(q[k])] if joint.nq == 2 else [q[k]]
        at[joint.idx_q : joint.idx_q + joint.nq] = turns
    return (at, v, a), places


@pytest.mark.parametrize("name", [*FIXED, *MORE])
def test_robots_agree_with_pinocchio(name: str, tmp_path: Path) -> None:
    both = from_urdf(f"/{name}.urdf", tmp_path, fuse=False)
    ours, bodies = Ours(both.text()), prepare_for_scene(both.robot).bodies
    order = sorted(range(len(bodies)), key=lambda k: bodies[k].point)
    model = pinocchio.buildModelFromUrdf(str(without_meshes(robot_data(f"/{name}.urdf"), tmp_path)))
    data, n = model.createData(), model.nv
    q, qd, qdd = np.random.default_rng(7).uniform(-1, 1, (3, n))
    (at, v, a), places = pinocchio_state(both, model, q, qd, qdd)
    computed = ours.values(*inverse_dynamics(ours.system), q, qd, qdd)
    near(computed, pinocchio.rnea(model, data, at, v, a)[places], "inverse dynamics")

    pinocchio.forwardKinematics(model, data, at, v, a)
    pinocchio.computeJointJacobians(model, data, at)
    pinocchio.updateFramePlacements(model, data)
    poses, velocities = ours.frames("poses", q), ours.frames("velocities", q, qd)
    accelerations = ours.frames("accelerations", q, qd, qdd)
    jacobians = ours.frames("jacobians", q).reshape(len(order), 6, n)
    world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for row, k in enumerate(order):
        body = both.robot.bodies[k].name
        frame = model.getFrameId(body, pinocchio.FrameType.BODY)
        pose = data.oMf[frame]
        near(poses[row], np.hstack([pose.translation, pose.rotation.ravel()]), body, 1.0)
        there = pinocchio.getFrameVelocity(model, data, frame, world).vector
        near(velocities[row], there, body, 1.0)
        there = pinocchio.getFrameClassicalAcceleration(model, data, frame, world).vector
        near(accelerations[row], there, body, 1.0)
        J = pinocchio.getFrameJacobian(model, data, frame, world)
        near(jacobians[row], J[:, places], body, 1.0)


@pytest.mark.parametrize("name", ["panda", "ur10_robot", "double_pendulum", "tiago"])
def test_regressors_agree_with_pinocchio(name: str, tmp_path: Path) -> None:
    """Pinocchio has the same ten parameters of each joint, and no columns of the joints."""
    both = from_urdf(f"/{name}.urdf", tmp_path, fuse=False)
    scene = tmp_path / "robot.toml"
    scene.write_text(both.text(), encoding="utf-8")
    ours = eomc.regressor(scene, tmp_path)
    model = pinocchio.buildModelFromUrdf(str(without_meshes(robot_data(f"/{name}.urdf"), tmp_path)))
    data, n = model.createData(), model.nv
    q, qd, qdd = np.random.default_rng(7).uniform(-1, 1, (3, n))
    state, places = pinocchio_state(both, model, q, qd, qdd)
    Y = pinocchio.computeJointTorqueRegressor(model, data, *state)
    moving = [b.name for b in both.robot.bodies if b.joint != "fixed"]
    frames = [model.frames[model.getFrameId(b, pinocchio.FrameType.BODY)] for b in moving]
    columns = [10 * (frame.parentJoint - 1) + k for frame in frames for k in range(10)]
    near(ours.Y(q, qd, qdd)[:, : 10 * n], Y[np.ix_(places, columns)], "regressor")
    values = np.hstack([model.inertias[f.parentJoint].toDynamicParameters() for f in frames])
    near(ours.parameters[: 10 * n], values, "parameters")
