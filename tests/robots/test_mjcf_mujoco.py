"""MJCF read by eomc and by MuJoCo: masses, inertias, poses, axes and joint parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from eomc.robots import mjcf
from eomc.robots.robot import Robot, RobotBody
from eomc.scene.joints import JOINTS
from eomc.scene.scene import WORLD

MUJOCO_REQUIRED = "MuJoCo is what these tests compare with: pip install '.[robots]'"
mujoco = pytest.importorskip("mujoco", reason=MUJOCO_REQUIRED)
pytestmark = pytest.mark.slow  # runs in the tier that installs MuJoCo

Array = NDArray[np.float64]

# Relative to the largest compared number; both sides round a few times per body.
CLOSE = 1e-12


def shipped() -> list[Path]:
    """Return the MJCF files that gymnasium ships."""
    gymnasium = pytest.importorskip("gymnasium", reason=MUJOCO_REQUIRED)
    folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    return sorted(folder.glob("*.xml"))


# --- a Robot, evaluated independently -----


def rotation_about_axis(axis: Sequence[float], angle: float) -> Array:
    """Return the rotation about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)


X, Y, Z = np.eye(3)


def axes(body: RobotBody) -> list[Sequence[float]]:
    """Return the axis of each motion, in the frame that the preceding motions have moved."""
    return {
        "fixed": [],
        "spherical": [Z, Y, X],
        "free": [X, Y, Z, Z, Y, X],
    }.get(body.joint, list(body.axes))


def poses(robot: Robot, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return the origin and the axes (columns) of every body in the world."""
    out = {WORLD: (np.zeros(3), np.eye(3))}
    values = iter(q)
    for body in robot.bodies:
        place, turn = out[body.parent]
        place, turn = place + turn @ body.offset, turn @ np.array(body.rotation)
        for motion, axis in zip(JOINTS[body.joint].motions, axes(body), strict=True):
            value = next(values)
            if motion == "t":
                place = place + turn @ np.asarray(axis) * value
            else:
                turn = turn @ rotation_about_axis(axis, value)
        out[body.name] = place, turn
    return out


def tensor(inertia: Sequence[float]) -> Array:
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def quaternion(yaw: float, pitch: float, roll: float) -> Array:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((Z, yaw), (Y, pitch), (X, roll)):
        out = np.zeros(4)
        mujoco.mju_mulQuat(out, q, np.r_[math.cos(angle / 2), math.sin(angle / 2) * axis])
        q = out
    return q


def qpos(model: mujoco.MjModel, q: Array) -> Array:
    """Return MuJoCo's coordinates for those of eomc."""
    out: list[float] = []
    at = 0
    for kind in model.jnt_type:
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out += [*q[at : at + 3], *quaternion(*q[at + 3 : at + 6])]
            at += 6
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            out += [*quaternion(*q[at : at + 3])]
            at += 3
        else:
            out.append(q[at])
            at += 1
    assert at == len(q)
    return np.array(out)


def near(a: object, b: object, size: float, what: str) -> None:
    difference = np.abs(np.asarray(a, float) - np.asarray(b, float)).max(initial=0.0)
    assert difference <= CLOSE * size, f"{what}: {a} is not {b}, off by {difference}"


def compare(path: Path, seed: int = 1) -> Robot:
    """Compare all numbers that both have, and all poses at random coordinates and at the initial
    state.
    """
    robot = mjcf.read(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    near(robot.gravity, model.opt.gravity, 10.0, "gravity")
    scalar = [
        j
        for j in range(model.njnt)
        if model.jnt_type[j] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    ]
    moving = [body for body in robot.bodies if body.joint != "fixed"]
    assert len(moving) == model.njnt
    for j in scalar:
        (motion,) = moving[j].motions
        dof = model.jnt_dofadr[j]
        assert motion.name == (model.joint(j).name or motion.name)
        near(motion.start, model.qpos0[model.jnt_qposadr[j]], 1.0, f"start of {motion.name}")
        near(motion.stiffness, model.jnt_stiffness[j], 1.0, f"stiffness of {motion.name}")
        near(motion.damping, model.dof_damping[dof], 1.0, f"damping of {motion.name}")
        near(motion.armature, model.dof_armature[dof], 1.0, f"armature of {motion.name}")
        near(motion.friction, model.dof_frictionloss[dof], 1.0, f"friction of {motion.name}")
        if motion.stiffness:
            near(motion.rest, model.qpos_spring[model.jnt_qposadr[j]], 1.0, "rest")
    at_start = np.array([m.start for m in robot.motions])
    random = np.random.default_rng(seed)
    own = [b for b in robot.bodies if not b.note.startswith("between the joints")]
    assert len(own) == model.nbody - 1
    for q in (at_start, *random.uniform(-3.0, 3.0, (5, len(at_start)))):
        data.qpos[:] = qpos(model, q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        if q is at_start:
            near(np.abs(data.qpos), np.abs(model.qpos0), 1.0, "qpos0")  # a quaternion has two signs
        world = poses(robot, q)
        size = 1.0 + float(np.abs(data.xpos).max())
        for i, body in enumerate(own, start=1):
            place, turn = world[body.name]
            near(turn, data.xmat[i].reshape(3, 3), 1.0, f"axes of {body.name}")
            near(body.mass, model.body_mass[i], 1e-9 + body.mass, f"mass of {body.name}")
            if not body.mass:
                continue
            near(place + turn @ body.center, data.xipos[i], size, f"centre of {body.name}")
            around = data.ximat[i].reshape(3, 3)
            if "armature" not in body.note:
                theirs = around @ np.diag(model.body_inertia[i]) @ around.T
                biggest = float(model.body_inertia[i].max())
                near(turn @ tensor(body.inertia) @ turn.T, theirs, biggest, f"inertia {body.name}")
        for j, body in enumerate(moving):
            place, turn = world[body.name]
            if j in scalar:
                near(turn @ body.axes[0], data.xaxis[j], 1.0, f"axis of joint {j}")
            if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_SLIDE:
                near(place, data.xanchor[j], size, f"anchor of joint {j}")
    return robot


@pytest.fixture(autouse=True)
def _working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the working folder, because MuJoCo writes MUJOCO_LOG.TXT there."""
    monkeypatch.chdir(tmp_path)


def test_gymnasium_models_are_read_as_by_mujoco() -> None:
    files = shipped()
    assert len(files) >= 10
    for file in files:
        robot = compare(file)
        assert robot.motions, file.name


TEXTS = {
    "default classes": """<mujoco>
  <compiler angle="radian"/>
  <default>
    <geom type="capsule" size="0.1 0.4" density="500"/>
    <default class="heavy">
      <geom density="5000" euler="0.3 0.2 0.1"/>
      <default class="slim"><geom size="0.02"/><joint frictionloss="0.2"/></default>
    </default>
    <joint damping="0.5" armature="0.1" stiffness="3" springref="0.25"/>
  </default>
  <worldbody>
    <body name="a" pos="0 0 1" childclass="heavy">
      <joint name="j1" axis="1 2 3"/><geom/>
      <body name="b" pos="0.1 0.2 0.3">
        <joint name="j2" class="slim" axis="0 1 0" damping="0.7"/>
        <geom class="slim" quat="1 1 0 0"/><geom class="main" pos="0.1 0 0"/>
        <body name="c" childclass="slim">
          <joint name="j3" pos="0.1 0 0"/><geom type="box" size="0.1 0.2 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <default><joint ref="0.3"/></default>
</mujoco>""",
    "frames in frames": """<mujoco>
  <compiler eulerseq="zYx"/>
  <worldbody>
    <frame pos="1 2 3" euler="10 20 30">
      <body name="a" pos="0.1 0 0" axisangle="1 1 0 40">
        <frame pos="0 0.3 0" xyaxes="1 1 0 0 1 1">
          <joint name="j" pos="0.1 0.2 0.3" axis="1 0 1"/>
          <geom size="0.1 0.2 0.3" type="ellipsoid" zaxis="1 1 1"/>
          <frame euler="0 90 0">
            <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0.4 0.5"/>
            <body name="b" pos="1 0 0" zaxis="0 0 -1">
              <joint name="k" type="slide" axis="0 1 1" ref="0.4"/>
              <inertial pos="0.1 0.2 0.3" quat="1 2 3 4" mass="2" diaginertia="0.3 0.2 0.15"/>
            </body>
          </frame>
          <body name="c"><geom size="0.1"/></body>
        </frame>
        <body name="d" pos="0 0 1">
          <joint name="m"/><geom type="cylinder" size="0.1 0.2" pos="0.1 0 0"/>
        </body>
      </body>
    </frame>
  </worldbody>
</mujoco>""",
    "several joints in a body": """<mujoco>
  <worldbody>
    <body name="a" pos="0.3 0.2 0.1" quat="0.9 0.1 0.2 0.3">
      <joint name="s1" type="slide" axis="1 1 0" ref="0.7" pos="1 2 3"/>
      <joint name="h1" axis="0 1 1" pos="0.1 0.2 0.3" ref="25" springref="-10" stiffness="2"/>
      <joint name="h2" axis="1 0 0" pos="0.3 0 0.1" ref="-70"/>
      <joint name="s2" type="slide" axis="0 0 1" ref="-0.2"/>
      <joint name="h3" axis="0 0 -2" pos="0 0.4 0" ref="5"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.1 0.1 0" euler="20 0 30" mass="3"/>
      <body name="b" pos="0 0.5 0" euler="0 0 45">
        <joint name="s3" type="slide" pos="0 0 3" axis="1 0 0"/>
        <joint name="ball" type="ball" pos="0.1 0.2 0.3"/>
        <geom type="cylinder" size="0.1" fromto="0 0 0 0 0 -1"/>
        <body name="c" pos="0 0 -1">
          <joint name="ball2" type="ball"/><geom size="0.2" pos="0.3 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>""",
    "free bodies": """<mujoco>
  <option gravity="1 -2 3"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <frame euler="0 0 90">
      <body name="a" pos="1 2 3" quat="0.5 0.1 -0.7 0.3">
        <freejoint name="root"/><geom size="0.1 0.1 0.4" type="box"/>
        <body name="b" pos="0 0 1" euler="90 0 0">
          <joint pos="0 0 0.1"/><geom size="0.1 0.3" type="capsule"/>
        </body>
      </body>
    </frame>
    <body name="c" pos="0 0 5"><joint type="free" pos="1 1 1"/><geom size="0.1"/></body>
    <body name="d" mocap="true" pos="0 0 1"><geom size="0.1"/></body>
    <body pos="0 0 1">
      <geom size="0.1"/>
      <body pos="1 0 0"><joint/><geom size="0.1" pos="1 0 0"/></body>
    </body>
  </worldbody>
</mujoco>""",
    "bounds, balance and total mass": """<mujoco>
  <compiler boundmass="0.5" boundinertia="0.02" balanceinertia="true" settotalmass="11"/>
  <worldbody>
    <body name="a">
      <joint/><inertial pos="1 0 0" mass="0.1" diaginertia="0.01 0.01 0.3" euler="10 20 30"/>
    </body>
    <body name="b">
      <joint/><geom size="9"/>
      <inertial pos="1 0 0" mass="2" fullinertia="0.3 0.2 0.25 0.01 0.02 -0.03"/>
    </body>
    <body name="c"><joint/><geom size="0.01" pos="1 2 3"/></body>
  </worldbody>
</mujoco>""",
    "inertia from geoms all the same": """<mujoco>
  <compiler inertiafromgeom="true" inertiagrouprange="1 2"/>
  <default><geom group="1"/></default>
  <worldbody>
    <body name="a"><joint/><inertial pos="1 0 0" mass="7" diaginertia="1 1 1"/>
      <geom size="0.1 0.2 0.3" group="3" type="box"/><geom mass="0" size="5"/>
      <geom size="0.1" pos="1 0 0"/>
      <geom type="capsule" size="0.1 0.3" shellinertia="true" group="2" euler="1 2 3"/>
      <geom type="cylinder" size="0.1 0.3" shellinertia="true" density="30" pos="0 1 0"/>
      <geom type="box" size="0.1 0.3 0.2" shellinertia="true" mass="3"/>
      <geom type="sphere" size="0.2" shellinertia="true" mass="3"/>
      <geom type="box" size="0.1" fromto="0 0 0 1 2 0" mass="3"/>
      <geom type="ellipsoid" size="0.1" fromto="0 0 1 1 2 0" mass="2"/>
    </body>
    <body name="b"><joint/><inertial pos="1 0 0" mass="7" diaginertia="1 1 1"/></body>
  </worldbody>
</mujoco>""",
    "fixed axes of euler": """<mujoco>
  <compiler eulerseq="XYZ" angle="radian"/>
  <worldbody>
    <body euler="0.3 0.4 0.5"><joint axis="3 4 0"/><geom size="0.1" pos="1 2 3"/>
      <body euler="-1 2 3" pos="1 2 3">
        <joint pos="3 2 1"/><geom size="0.1 0.2" type="capsule" zaxis="0 -1 0"/>
        <body quat="1 2 3 4"><geom size="0.1" pos="1 2 3"/><geom size="0.2" pos="-1 2 3"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>""",
}


@pytest.mark.parametrize("name", TEXTS)
def test_ambiguous_elements_are_read_as_by_mujoco(name: str, tmp_path: Path) -> None:
    file = tmp_path / "model.xml"
    file.write_text(TEXTS[name])
    compare(file)
