"""URDF joints with <mimic>: driven by another coordinate, refused, or fixed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from eomc.base.errors import EomcError
from eomc.derive import lagrange
from eomc.model.system import from_scene
from eomc.program import program
from eomc.program.ir import evaluate
from eomc.robots import edit, scene_text, urdf
from eomc.robots.robot import Robot
from eomc.scene.read import parse

LINK = """<link name="{}"><inertial><origin xyz="0.1 {} 0.05"/><mass value="{}"/>
<inertia ixx=".1" iyy=".12" izz=".15" ixy="0.01" ixz="0" iyz="0"/></inertial></link>"""
MIMICS = {
    "far": '<mimic joint="near" multiplier="0.5" offset="0.1"/>',
    "thumb": '<mimic joint="far" multiplier="-2"/>',  # -near - 0.2
    "tendon": '<mimic joint="near" multiplier="0.04"/>',
}


def hand(**mimics: str) -> str:
    """Return a URDF with a wrist, two finger joints, a thumb and a slide, each with its <mimic>."""
    joints = [
        ("wrist", "revolute", "base", "palm", "0 0 1"),
        ("near", "revolute", "palm", "finger", "0 1 0"),
        ("far", "revolute", "finger", "tip", "0 3 4"),
        ("thumb", "revolute", "palm", "thumb", "1 0 0"),
        ("tendon", "prismatic", "palm", "tendon", "1 0 0"),
    ]
    links = ("base", "palm", "finger", "tip", "thumb", "tendon")
    return "\n".join([
        '<robot name="hand">', *(LINK.format(n, k / 50, 1 + k / 4) for k, n in enumerate(links)),
        *(f'<joint name="{name}" type="{kind}"><origin xyz="0.2 0 0.1" rpy="0.3 0 0.1"/>'
          f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
          f'<limit lower="-3" upper="3" effort="9" velocity="1"/>'
          f'<dynamics damping="0.{k}" friction="0.2"/>{mimics.get(name, "")}</joint>'
          for k, (name, kind, parent, child, axis) in enumerate(joints)),
        "</robot>",
    ])  # fmt: skip


def read(text: str, folder: Path) -> Robot:
    (folder / "hand.urdf").write_text(text, encoding="utf-8")
    return urdf.read(folder / "hand.urdf")


def coordinates_of_bodies(robot: Robot) -> dict[str, list[str]]:
    """Return the coordinates of each body's joint in the scene."""
    scene = parse(scene_text.scene_text(robot), "hand.toml")
    assert scene.assembly and not scene.warnings
    return {b.name: [f.text for f in b.coordinates] for b in scene.assembly.bodies}


def test_mimic_joint_has_no_coordinate_and_no_drive(tmp_path: Path) -> None:
    robot = read(hand(**MIMICS), tmp_path)
    assert [m.name for m in robot.motions] == ["wrist", "near"]
    assert [d.coordinate for d in robot.drives] == ["wrist", "near"]
    assert not any("mimic" in words for words in robot.left_out)
    assert "thumb mimics near; -3 to 3" in robot.bodies[4].note
    assert coordinates_of_bodies(robot) == {
        "base": [], "palm": ["wrist"], "finger": ["near"], "tip": ["0.5*near + 0.1"],
        "thumb": ["-near - 0.2"], "tendon": ["0.04*near"],
    }  # fmt: skip


def test_equations_are_projections_of_those_of_free_joints(tmp_path: Path) -> None:
    """D = G^T D' G, and so for bias, g and tau, with q' = G q + c and constant G."""
    G = np.array([[1, 0], [0, 1], [0, 0.5], [0, -1], [0, 0.04]])
    c = np.array([0, 0, 0.1, -0.2, 0])
    q, qd = np.array([0.4, 0.7]), np.array([-0.8, 1.3])
    projected, free = (
        evaluate_equations(read(hand(**mimics), tmp_path), *state)
        for mimics, state in ((MIMICS, (q, qd)), ({}, (G @ q + c, G @ qd)))
    )
    for name, right in {
        "D": G.T @ free["D"] @ G,
        **{name: G.T @ free[name] for name in ("bias", "g", "tau")},
        "kinetic_energy": free["kinetic_energy"],
        "potential_energy": free["potential_energy"],
    }.items():
        np.testing.assert_allclose(projected[name], right, rtol=1e-13, err_msg=name)


def evaluate_equations(robot: Robot, q: np.ndarray, qd: np.ndarray) -> dict[str, np.ndarray]:
    """Evaluate the equations with zero inputs."""
    system = from_scene(parse(scene_text.scene_text(robot), "hand.toml"))
    state = {
        **dict(zip([x.name for x in (*system.q, *system.qd)], [*q, *qd], strict=True)),
        "t": 0.0,
    }
    state |= {x.name: 0.0 for x in system.u}
    functions = program.build(lagrange.derive(system)).functions
    out = {name: np.array(evaluate(functions[name], state)[0]) for name in functions}
    out["D"] = out["D"].reshape(len(q), -1)
    return out


def test_lock_fixes_mimic_joints_too(tmp_path: Path) -> None:
    robot = read(hand(**MIMICS), tmp_path)
    locked = edit.lock(robot, {"near": 0.4})
    assert [m.name for m in locked.motions] == ["wrist"]
    free = edit.lock(
        read(hand(), tmp_path), {"near": 0.4, "far": 0.3, "thumb": -0.6, "tendon": 0.016}
    )
    for one, other in zip(locked.bodies, free.bodies, strict=True):
        assert one.joint == other.joint
        np.testing.assert_allclose(one.offset, other.offset, atol=1e-15)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-15)
    assert "joint thumb stands at -0.6 rad" in locked.bodies[4].note
    with pytest.raises(EomcError, match="--lock far: it moves as 'near' does: lock that"):
        edit.lock(robot, {"far": 0.1})
    with pytest.raises(EomcError, match=r"--lock far: .* which puts it at 0.3 rad"):
        edit.lock(robot, {"near": 0.4, "far": 0.1})


def test_mimic_of_a_removed_joint_is_fixed_at_its_initial_value(tmp_path: Path) -> None:
    text = hand(**MIMICS).replace('limit lower="-3"', 'limit lower="0.2"')
    cut = edit.cut(read(text, tmp_path), tip="tendon")
    assert coordinates_of_bodies(cut) == {"base": [], "palm": ["wrist"], "tendon": []}
    assert cut.bodies[-1].offset[0] > 0.2  # near starts at 0.2, so the slide at 0.008


def test_mimic_of_a_fixed_joint_is_fixed(tmp_path: Path) -> None:
    text = hand(
        far='<mimic joint="thumb" offset="0.3"/>', tendon='<mimic joint="near" multiplier="0"/>'
    )
    robot = read(
        text.replace('name="thumb" type="revolute"', 'name="thumb" type="fixed"'), tmp_path
    )
    assert coordinates_of_bodies(robot) == {
        "base": [], "palm": ["wrist"], "finger": ["near"], "tip": [], "thumb": [], "tendon": [],
    }  # fmt: skip
    assert "stands at 0.3 rad" in robot.bodies[3].note


@pytest.mark.parametrize(
    ("mimics", "message"),
    [
        ({"far": '<mimic joint="naer"/>'}, "joint far: it mimics joint 'naer', which is not in the "
         "file; did you mean 'near'?"),
        ({"far": "<mimic/>"}, "joint far: its <mimic> names no joint"),
        ({"far": '<mimic joint="far"/>'}, "far: joints mimic one another in a ring: far -> far"),
        ({"far": '<mimic joint="thumb"/>', "thumb": '<mimic joint="far"/>'}, "in a ring: "),
        ({"far": '<mimic joint="near" multiplier="two"/>'}, "of <mimic>: 'two' is not"),
        ({"far": '<mimic joint="loose"/>'}, "'loose' is a floating joint, which has 6 coordinates"),
        ({"loose": '<mimic joint="near"/>'}, "loose: it mimics 'near'; 'loose' is a floating"),
    ],
)  # fmt: skip
def test_invalid_mimics_are_refused(mimics: dict[str, str], message: str, tmp_path: Path) -> None:
    text = hand(**mimics)
    if "loose" in str(mimics):
        floating_joint = (
            f'type="floating"><parent link="palm"/><child link="loose"/>{mimics.get("loose", "")}'
        )
        more = LINK.format("loose", 0, 1) + f'<joint name="loose" {floating_joint}</joint></robot>'
        text = text.replace("</robot>", more)
    with pytest.raises(EomcError) as fault:
        read(text, tmp_path)
    assert message in str(fault.value)
