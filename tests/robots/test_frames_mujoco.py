"""Poses, Jacobians, inverse dynamics and momenta of real robot files, compared with MuJoCo.

The program is evaluated in Python; other tests compare it with the generated C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots.test_robots_mujoco import (
    Array,
    angular_velocity_map,
    from_urdf,
    indices_of_euler_angles,
    mujoco,
    positions,
    working_folder,  # noqa: F401 - a fixture, for all tests here
)

import eomc
from eomc.derive.frames import momentum, motions, wrenches
from eomc.derive.lagrange import inverse_dynamics
from eomc.derive.tape import Tape
from eomc.model.system import System, from_scene
from eomc.program.ir import evaluate
from eomc.program.lower import lower
from eomc.robots.scene_text import prepare_for_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.slow

CLOSE = 1e-10  # relative to the largest number
FIXED = """
    ur3_robot ur5_robot ur10_robot panda kinova xarm7 z1 so100 so101 TwoDofs finger_edu
    double_pendulum double_pendulum_simple double_pendulum_continuous allegro_right_hand
    allegro_left_hand talos_left_arm simple_humanoid baxter tiago_no_hand tiago_pro romeo_small
    talos_reduced pr2
""".split()
FREE = "solo12 solo go1 go2 a1 b1 laikago bolt hyq_no_sensors anymal iris quadrotor_base".split()


class Ours:
    """Functions of a scene, evaluated at a state."""

    def __init__(self, text: str) -> None:
        system = from_scene(parse(text, "robot.toml"))
        run = replace(system.run, frames=True)
        self.system = replace(system, run=run)
        self.motions = motions(self.system)

    def values(self, tape: Tape, outputs: Sequence[object], *arguments: Array) -> Array:
        system: System = self.system
        function = lower("values", tape, outputs, system.names)
        leaves = [system.q, system.qd, system.qdd, wrenches(system)]
        state = {p.name: p.value for p in system.parameters} | {"t": 0.0}
        for symbols, numbers in zip(leaves, arguments, strict=False):
            state |= {x.name: float(v) for x, v in zip(symbols, numbers, strict=True)}
        result, _ = evaluate(function, state)
        return np.array(result)

    def frames(self, what: str, *arguments: Array) -> Array:
        motions_of_system = self.motions
        result = self.values(motions_of_system.tape, getattr(motions_of_system, what), *arguments)
        return result if what == "forces" else result.reshape(len(self.system.output_frames), -1)


def near(computed: Array, expected: Array, what: str, scale: float = 0.0) -> None:
    size = max(float(np.max(np.abs(expected))), scale)
    off = float(np.max(np.abs(computed - expected))) / size
    assert off <= CLOSE, f"{what} is off by {off:.1e} of its largest number"


@pytest.mark.parametrize(("name", "free"), [(n, False) for n in FIXED] + [(n, True) for n in FREE])
def test_robots_agree_with_mujoco(name: str, free: bool, tmp_path: Path) -> None:
    both = from_urdf(f"/{name}.urdf", tmp_path, free, fuse=False)
    model, n = both.model, both.model.nv
    robot = prepare_for_scene(both.robot)
    ours = Ours(both.text())
    names = [b.name for b in sorted(robot.bodies, key=lambda b: b.point)]
    assert [f.name for f in ours.system.output_frames] == names
    inside = {b.name: k for k, b in enumerate(robot.bodies)}
    # The bodies in the order of the file.
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, both.robot.bodies[inside[x]].name)
           for x in names]  # fmt: skip
    random = np.random.default_rng(5)
    q, qd, qdd = random.uniform(-1, 1, (3, n))
    w = random.uniform(-1, 1, 6 * len(ids))
    data = mujoco.MjData(model)
    T, T_dot = np.eye(n), np.zeros((n, n))
    for at in indices_of_euler_angles(model):
        three = slice(at, at + 3)
        T[three, three], T_dot[three, three] = angular_velocity_map(q[three], qd[three])
    data.qpos[:], data.qvel[:], data.qacc[:] = positions(model, q), T @ qd, T @ qdd + T_dot @ qd
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_subtreeVel(model, data)

    poses = ours.frames("poses", q)
    velocities = ours.frames("velocities", q, qd)
    accelerations = ours.frames("accelerations", q, qd, qdd)
    jacobians = ours.frames("jacobians", q).reshape(len(ids), 6, n)
    total = np.zeros(n)
    for k, body in enumerate(i for i in ids if i >= 0):
        assert body > 0
        near(poses[k], np.hstack([data.xpos[body], data.xmat[body]]), f"pose of {names[k]}", 1.0)
        J, J_dot = np.zeros((2, 6, n))
        mujoco.mj_jacBody(model, data, J[:3], J[3:], body)
        mujoco.mj_jacDot(model, data, J_dot[:3], J_dot[3:], data.xpos[body], body)
        near(jacobians[k], J @ T, f"Jacobian of {names[k]}", 1.0)
        near(velocities[k], J @ T @ qd, f"velocity of {names[k]}", 1.0)
        exact = J @ data.qacc + J_dot @ data.qvel
        near(accelerations[k], exact, f"acceleration of {names[k]}", 1.0)
        total += (J @ T).T @ w[6 * k : 6 * k + 6]
    near(ours.frames("forces", q, qd, qdd, w), total, "forces")

    tau = np.zeros(n)
    mujoco.mj_rne(model, data, 1, tau)
    tau += model.dof_armature * data.qacc
    computed = ours.values(*inverse_dynamics(ours.system), q, qd, qdd)
    near(computed, T.T @ tau, "inverse dynamics")

    if free:
        computed = ours.values(*momentum(ours.system), q, qd)
        mass = model.body_subtreemass[0]
        linear, angular = mass * data.subtree_linvel[0], data.subtree_angmom[0]
        near(computed, np.hstack([mass, data.subtree_com[0], linear, angular]), "momentum")


@pytest.mark.parametrize(
    ("name", "locked", "count"),
    [
        ("ur10_robot", {}, 36),
        ("panda", {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}, 43),
    ],
)
def test_number_of_base_parameters_of_robots(
    name: str, locked: dict[str, float], count: int, tmp_path: Path
) -> None:
    """7 n - 4 - 2 with a vertical first axis and a second one across it (Mayeda et al., 1990)."""
    scene = tmp_path / "robot.toml"
    scene.write_text(from_urdf(f"/{name}.urdf", tmp_path, locked=locked).text(), encoding="utf-8")
    regressor = eomc.regressor(scene, tmp_path)
    module, n = regressor.module, len(regressor.module.coordinates)
    q, qd, qdd = np.random.default_rng(2).uniform(-3, 3, (3, 500, n))
    Y = regressor.Y(q, qd, qdd)
    drives = module.inverse_dynamics(q, qd, qdd) - module.tau(q, qd, u=np.zeros((500, n)))
    assert np.abs(Y @ regressor.parameters - drives).max() < 1e-12 * np.abs(drives).max()
    columns = regressor.base_parameters().columns
    assert sum(k < 10 * n for k in columns) == count == 7 * n - 6
    assert np.linalg.matrix_rank(Y[..., : 10 * n].reshape(-1, 10 * n)) == count
