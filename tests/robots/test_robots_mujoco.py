"""D, bias and accelerations of real robot files at random states, compared with MuJoCo.

MuJoCo writes the velocity v of a free or ball joint as (velocity in the world, angular velocity in
body axes); eomc uses the rates of yaw, pitch and roll. With v = T(q) qd,

    D = T^T M T,    bias = T^T (M dT/dt qd + MuJoCo's bias),    v' = T qdd + dT/dt qd.

Contacts, limits, dry friction, air drag and equality constraints are disabled on both sides;
masses, springs, damping, armatures and motors are as in the files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray
from support.session import Modules

from eomc.derive.lagrange import derive
from eomc.model.system import from_scene
from eomc.program import program
from eomc.program.ir import evaluate
from eomc.robots import edit, mjcf, scene_text, urdf
from eomc.robots.robot import Robot
from eomc.scene.read import parse

MUJOCO_REQUIRED = "robots are compared with MuJoCo where it is there: pip install '.[robots]'"
mujoco = pytest.importorskip("mujoco", reason=MUJOCO_REQUIRED)
pytestmark = pytest.mark.slow  # runs in the tier that installs MuJoCo

Array = NDArray[np.float64]

# Relative to the largest entry. Both sides round to 2e-15 for D and bias, 2e-14 for accelerations;
# scenes round angles within 1e-10 of a quarter turn to it, which makes up to 1e-11 on the UR5.
CLOSE = 1e-10
STATES = 3


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the working folder, because MuJoCo writes its warnings there."""
    monkeypatch.chdir(tmp_path)


# --- files ----------------------------------------------------------------------------------------


@cache
def robot_data(name: str) -> Path:
    """Return a URDF of example-robot-data, which has no Python module."""
    try:
        candidates = [f for f in files("example-robot-data") or () if str(f).endswith(name)]
    except PackageNotFoundError:
        pytest.skip(f"example-robot-data is not there: {MUJOCO_REQUIRED}")
    return Path(str(candidates[0].locate()))


def gymnasium_model(name: str) -> Path:
    gymnasium = pytest.importorskip("gymnasium", reason=MUJOCO_REQUIRED)
    return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / name


def without_meshes(urdf_file: Path, folder: Path, coupled: bool = False) -> Path:
    """Copy the file without meshes and, unless `coupled`, without <mimic>.

    MuJoCo would couple mimic joints. Invalid inertia tensors, which both sides refuse, become those
    of balls with the same trace.
    """
    tree = ElementTree.parse(urdf_file)
    root = tree.getroot()
    for parent, tags in (("link", ("visual", "collision")), ("joint", ("mimic",) * (not coupled))):
        for element in root.findall(parent):
            for tag in tags:
                for part in element.findall(tag):
                    element.remove(part)
    for tag in ("gazebo", "transmission", "mujoco"):
        for part in root.findall(tag):
            root.remove(part)
    for tensor in root.iter("inertia"):
        six = [float(tensor.get(key, "0")) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
        xx, yy, zz, xy, xz, yz = six
        low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if low <= 1e-6 * high or low + middle < high:
            for key in ("ixx", "iyy", "izz"):
                tensor.set(key, repr((xx + yy + zz) / 3))
            for key in ("ixy", "ixz", "iyz"):
                tensor.set(key, "0")
    out = folder / urdf_file.name
    tree.write(out)
    return out


# --- one robot, read by both ----------------------------------------------------------------------


@dataclass(frozen=True)
class Pair:
    """A robot as read by eomc and by MuJoCo, with coordinates in the same order."""

    robot: Robot  # with the names of the file
    model: Any

    def text(self) -> str:
        return scene_text.scene_text(self.robot)


def from_urdf(
    name: str, folder: Path, free: bool = False, locked: Mapping[str, float] | None = None,
    fuse: bool = True,
) -> Pair:  # fmt: skip
    file = without_meshes(robot_data(name), folder)
    robot = edit.lock(urdf.read(file), locked or {})
    if free:
        robot = edit.with_base(robot, free=True)
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic = fuse
    for joint, value in (locked or {}).items():
        assert value == 0.0
        spec.delete(spec.joint(joint))
    if free:
        spec.compiler.fusestatic = False  # otherwise the base would be merged with the world
        spec.bodies[1].add_freejoint()
    return pair(robot, spec.compile())


def from_mjcf(name: str) -> Pair:
    file = gymnasium_model(name)
    return pair(mjcf.read(file), mujoco.MjModel.from_xml_path(str(file)))


def disable_other_forces(model: Any) -> Any:
    """Disable contacts, limits and air drag in MuJoCo's model."""
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_CLAMPCTRL
    model.opt.density = model.opt.viscosity = 0.0
    return model


def pair(robot: Robot, model: Any) -> Pair:
    """Pair both models, without what eomc does not model or models differently."""
    disable_other_forces(model)
    bodies = tuple(
        replace(b, motions=tuple(replace(m, friction=0.0) for m in b.motions)) for b in robot.bodies
    )
    assert len(robot.motions) == model.nv
    scalar = {m.name for m in robot.motions}
    for j in range(model.njnt):  # in the same order
        if model.jnt_type[j] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            name = model.joint(j).name
            at = robot.motions[model.jnt_dofadr[j]]
            assert at.name == name or name not in scalar
            assert at.damping == model.dof_damping[model.jnt_dofadr[j]]
    return Pair(replace(robot, bodies=bodies), model)


# --- coordinates of MuJoCo ------------------------------------------------------------------------


def quaternion(yaw: float, pitch: float, roll: float) -> list[float]:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw, pitch, roll))
    return [
        cz * cy * cx + sz * sy * sx,
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
    ]


def angular_velocity_map(angles: Array, rates: Array) -> tuple[Array, Array]:
    """Return E and dE/dt, where E (yaw', pitch', roll') is the angular velocity in body axes."""
    _, p, r = angles
    _, pd, rd = rates
    sp, cp, sr, cr = math.sin(p), math.cos(p), math.sin(r), math.cos(r)
    E = np.array([[-sp, 0, 1], [cp * sr, cr, 0], [cp * cr, -sr, 0]])
    E_dot = np.array(
        [
            [-cp * pd, 0, 0],
            [-sp * sr * pd + cp * cr * rd, -sr * rd, 0],
            [-sp * cr * pd - cp * sr * rd, -cr * rd, 0],
        ]
    )
    return E, E_dot


def indices_of_euler_angles(model: Any) -> list[int]:
    """Return the first index of each triple of angles among the coordinates."""
    kinds = mujoco.mjtJoint
    more = {int(kinds.mjJNT_FREE): 3, int(kinds.mjJNT_BALL): 0}
    joints = zip(model.jnt_type.tolist(), model.jnt_dofadr.tolist(), strict=True)
    return [at + more[kind] for kind, at in joints if kind in more]


def positions(model: Any, q: Array) -> Array:
    """Return qpos: quaternions in place of angles."""
    out: list[float] = list(q)
    for at in reversed(indices_of_euler_angles(model)):
        out[at : at + 3] = quaternion(*q[at : at + 3])
    return np.array(out)


@dataclass(frozen=True)
class Theirs:
    """Results of MuJoCo: D and bias in the coordinates of eomc, v', and T, dT/dt."""

    D: Array
    bias: Array
    rates: Array  # v'
    T: Array
    T_dot: Array


def theirs(model: Any, q: Array, qd: Array, u: Array, applied: Array) -> Theirs:
    data = mujoco.MjData(model)
    T, T_dot = np.eye(model.nv), np.zeros((model.nv, model.nv))
    for at in indices_of_euler_angles(model):
        three = slice(at, at + 3)
        T[three, three], T_dot[three, three] = angular_velocity_map(q[three], qd[three])
    data.qpos[:] = positions(model, q)
    data.qvel[:] = T @ qd
    data.ctrl[:] = u
    data.qfrc_applied[:] = applied
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    bias = data.qfrc_bias - data.qfrc_spring  # springs have a potential: in eomc they are part of g
    return Theirs(
        D=T.T @ M @ T,
        bias=T.T @ (M @ T_dot @ qd + bias),
        rates=np.array(data.qacc),
        T=T,
        T_dot=T_dot,
    )


# --- results of eomc ------------------------------------------------------------------------------

Ask = Callable[[str, Array, Array, Array], Array]


def in_python(text: str) -> Ask:
    """Return functions that evaluate the program without a compiler."""
    system = from_scene(parse(text, "robot.toml"))
    quick = program.build(derive(system))

    def ask(name: str, q: Array, qd: Array, u: Array) -> Array:
        state = {x.name: float(v) for x, v in zip(system.q, q, strict=True)}
        state |= {x.name: float(v) for x, v in zip(system.qd, qd, strict=True)}
        state |= {x.name: float(v) for x, v in zip(system.u, u, strict=True)}
        state |= {p.name: p.value for p in system.parameters} | {"t": 0.0}
        if name == "D":
            return np.array(program.matrix(quick, "D", state))
        result, regular = evaluate(quick[name], state)
        assert regular
        return np.array(result)

    return ask


def in_c(module: ModuleType) -> Ask:
    """Return functions of the compiled module."""

    def ask(name: str, q: Array, qd: Array, u: Array) -> Array:
        if name == "D":
            return np.array(module.D(q))
        if name == "bias":
            return np.array(module.bias(q, qd))
        return np.array(module.acceleration(q, qd, 0.0, u))

    return ask


def compare(pair: Pair, ask: Ask, seed: int = 3) -> None:
    """Compare D, bias and accelerations at random states, with random forces at the joints."""
    model, robot = pair.model, pair.robot
    random = np.random.default_rng(seed)
    n = model.nv
    for _ in range(STATES):
        q, qd = random.uniform(-2, 2, n), random.uniform(-2, 2, n)
        for at in indices_of_euler_angles(model):
            q[at + 1] = random.uniform(-1, 1)  # away from a pitch of pi/2
        u = random.uniform(-1, 1, len(robot.drives))
        applied, control = np.zeros(n), np.zeros(model.nu)
        if model.nu:
            control[:] = u
        else:  # a URDF has no motors: the inputs of eomc act on the joints
            names = [m.name for m in robot.motions]
            for drive, value in zip(robot.drives, u, strict=True):
                applied[names.index(drive.coordinate)] += drive.gear * value
        right = theirs(model, q, qd, control, applied)
        near(ask("D", q, qd, u), right.D, "D")
        near(ask("bias", q, qd, u), right.bias, "bias")
        qdd = ask("acceleration", q, qd, u)
        near(right.T @ qdd + right.T_dot @ qd, right.rates, "accelerations")


def near(computed: Array, expected: Array, what: str) -> None:
    off = float(np.max(np.abs(computed - expected)) / np.max(np.abs(expected)))
    assert off <= CLOSE, f"{what} is off by {off:.1e} of its largest entry"


# --- robots ---------------------------------------------------------------------------------------

PANDA = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}


@pytest.mark.parametrize(
    "name",
    ["inverted_double_pendulum.xml", "hopper.xml", "swimmer.xml", "walker2d.xml",
     "half_cheetah.xml"],
)  # fmt: skip
def test_plane_mechanisms_of_gymnasium(name: str) -> None:
    both = from_mjcf(name)
    compare(both, in_python(both.text()))


def test_arm_in_compiled_c(tmp_path: Path, modules: Modules) -> None:
    both = from_urdf("ur5_robot.urdf", tmp_path)
    compare(both, in_c(modules.of_text(both.text())))


@pytest.mark.slow
def test_panda_with_locked_fingers(tmp_path: Path) -> None:
    both = from_urdf("panda_description/urdf/panda.urdf", tmp_path, locked=PANDA)
    compare(both, in_python(both.text()))


@pytest.mark.slow
def test_hand(tmp_path: Path) -> None:
    both = from_urdf("allegro_right_hand.urdf", tmp_path)
    compare(both, in_python(both.text()))


@pytest.mark.slow
def test_ant(tmp_path: Path) -> None:
    both = from_mjcf("ant.xml")
    compare(both, in_python(both.text()))


@pytest.mark.slow
def test_quadruped_with_a_free_base_in_compiled_c(tmp_path: Path, modules: Modules) -> None:
    both = from_urdf("solo12.urdf", tmp_path, free=True)
    compare(both, in_c(modules.of_text(both.text())))


@pytest.mark.slow
def test_humanoid_with_a_free_base_in_compiled_c(modules: Modules) -> None:
    both = from_mjcf("humanoid.xml")
    compare(both, in_c(modules.of_text(both.text())))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["talos_reduced.urdf", "simple_humanoid.urdf"])
def test_humanoid_with_a_fixed_base(name: str, tmp_path: Path) -> None:
    both = from_urdf(name, tmp_path)
    compare(both, in_python(both.text()))


@pytest.mark.parametrize(
    "name", ["panda_description/urdf/panda.urdf", "urdf/baxter.urdf", "urdf/pr2.urdf"]
)
def test_mimic_joints(name: str, tmp_path: Path) -> None:
    """D = G^T M G and bias = G^T bias', where MuJoCo's joints, all free, move by G q + c."""
    (tmp_path / "coupled").mkdir()
    robot = urdf.read(without_meshes(robot_data(name), tmp_path / "coupled", coupled=True))
    spec = mujoco.MjSpec.from_file(str(without_meshes(robot_data(name), tmp_path)))
    spec.compiler.fusestatic = True
    model = disable_other_forces(spec.compile())
    index = {m.name: k for k, m in enumerate(robot.motions)}
    G, c = np.zeros((model.nv, len(index))), np.zeros(model.nv)
    for motion in (m for body in robot.bodies for m in body.motions):
        row = model.joint(motion.name).dofadr[0]
        mimics = motion.mimics
        G[row, index[mimics.coordinate if mimics else motion.name]] = mimics.gear if mimics else 1.0
        c[row] = mimics.shift if mimics else 0.0
    assert np.sum(np.count_nonzero(G, axis=0) > 1), "nothing mimics"
    ask, random = in_python(scene_text.scene_text(robot)), np.random.default_rng(3)
    nothing = np.zeros(len(robot.drives))
    for _ in range(STATES):
        q, qd = random.uniform(-2, 2, (2, len(index)))
        right = theirs(model, G @ q + c, G @ qd, np.zeros(0), np.zeros(model.nv))
        near(ask("D", q, qd, nothing), G.T @ right.D @ G, "D")
        near(ask("bias", q, qd, nothing), G.T @ right.bias, "bias")


def test_comparison_detects_a_wrong_sign() -> None:
    pair_of_hopper = from_mjcf("hopper.xml")
    ask = in_python(pair_of_hopper.text())

    def wrong(name: str, q: Array, qd: Array, u: Array) -> Array:
        return ask(name, q, qd, -u)

    compare(pair_of_hopper, ask)
    with pytest.raises(AssertionError, match="accelerations"):
        compare(pair_of_hopper, wrong)
