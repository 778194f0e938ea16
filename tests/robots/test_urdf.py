"""URDF files: what is read, what is reported, what is refused."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import eomc
from eomc.base.errors import EomcError
from eomc.cli.main import main
from eomc.model import kinematics
from eomc.model.system import from_scene
from eomc.robots import edit, geometry, scene_text, urdf
from eomc.robots.robot import Robot, body_pose
from eomc.scene import read as scene
from eomc.scene.read import parse

INERTIAL = (
    '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)
ARM = f"""<?xml version="1.0"?>
<robot name="crane">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base">{INERTIAL}</link>
  <link name="upper-arm">
    <inertial>
      <origin xyz="0.1 0.2 0.3" rpy="0 0 1.5707963267948966"/>
      <mass value="2"/>
      <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0.02" iyz="0.03"/>
    </inertial>
    <visual><geometry><mesh filename="package://crane/../../etc/passwd"/></geometry></visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision>
  </link>
  <link name="slide">{INERTIAL}</link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.5" rpy="0.1 0.2 0.3"/>
    <parent link="base"/><child link="upper-arm"/>
    <axis xyz="0 3 4"/>
    <limit lower="0.2" upper="1.5" effort="40" velocity="2"/>
    <dynamics damping="0.4" friction="0.3"/>
    <safety_controller k_velocity="1"/>
  </joint>
  <joint name="extend" type="prismatic">
    <parent link="upper-arm"/><child link="slide"/>
    <limit lower="-1" upper="1" effort="0" velocity="0"/>
  </joint>
  <joint name="tool_mount" type="fixed">
    <parent link="slide"/><child link="tool"/><axis xyz="0 0 0"/>
  </joint>
  <transmission name="t"/>
  <gazebo/>
</robot>
"""

Reader = Callable[[str], Robot]


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    def reads(text: str) -> Robot:
        path = tmp_path / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        return urdf.read(path)

    return reads


def test_arm_is_read(read: Reader) -> None:
    robot = read(ARM)
    assert robot.name == "crane" and robot.gravity == (0, 0, -9.81)
    base, arm, slide, tool = robot.bodies
    assert (base.joint, base.parent, tool.joint) == ("fixed", "world", "fixed")
    assert arm.joint == "revolute" and arm.axes == ((0, 0.6, 0.8),) and arm.offset == (0, 0, 0.5)
    assert arm.rotation == geometry.from_rpy(0.1, 0.2, 0.3)
    assert (arm.mass, arm.center) == (2, (0.1, 0.2, 0.3))
    # Rotated by a quarter turn about z: x' = y, y' = -x.
    assert np.allclose(arm.inertia, (0.2, 0.1, 0.25, -0.01, -0.03, 0.02), rtol=0, atol=1e-16)
    (shoulder,) = arm.motions
    assert (shoulder.name, shoulder.unit, shoulder.start) == ("shoulder", "rad", 0.2)
    assert (shoulder.damping, shoulder.friction, shoulder.note) == (
        0.4,
        0.3,
        "0.2 to 1.5; at most 2 rad/s",
    )
    assert slide.joint == "prismatic" and slide.axes == ((1, 0, 0),)  # default of URDF
    assert [(d.name, d.coordinate) for d in robot.drives] == [
        ("shoulder_torque", "shoulder"),
        ("extend_force", "extend"),
    ]
    assert "at most 40 N m" in robot.drives[0].note


def test_ignored_elements_are_reported(read: Reader) -> None:
    reported = "\n".join(scene_text.prepare_for_scene(read(ARM)).left_out)
    for words in (
        "1 mesh (not opened)", "1 box",
        "limits of 2 joints", "<safety_controller>", "<transmission>", "<gazebo>", "<material>",
    ):  # fmt: skip
        assert words in reported


def test_frames_without_mass_are_points(read: Reader) -> None:
    robot = scene_text.prepare_for_scene(read(ARM))
    (tool,) = [body for body in robot.bodies if body.point]
    text = scene_text.scene_text(read(ARM))
    assert text.endswith(f'[[point]]\nname = "{tool.name}"\nbody = "{tool.parent}"\n')
    frames = {f.name: f for f in from_scene(parse(text, "arm.toml")).frames}
    assert frames[tool.name].link == frames[tool.parent].link


def test_ignored_attributes_are_reported(read: Reader) -> None:
    """A stiffness in <dynamics>, a misspelt axis: without them the robot would be different."""
    text = ARM.replace('damping="0.4"', 'damping="0.4" K="30"').replace("<axis xyz", "<axis xzy")
    reported = read(text).left_out
    assert any('K of dynamics in joint "shoulder"' in words for words in reported)
    assert any('xzy of axis in joint "shoulder"' in words for words in reported)
    assert not any("attributes" in words for words in read(ARM).left_out)
    floats = ARM.replace('type="revolute"', 'type="floating"')
    assert "<dynamics> of floating joints: shoulder" in read(floats).left_out


def test_referenced_files_are_not_opened(read: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    plain = Path.open
    monkeypatch.setattr(
        Path, "open", lambda self, *a, **k: (opened.append(self.name), plain(self, *a, **k))[1]
    )
    read(ARM)
    assert set(opened) == {"robot.urdf"}


def test_continuous_and_floating_joints(read: Reader) -> None:
    text = ARM.replace('"revolute"', '"continuous"').replace('"prismatic"', '"floating"')
    robot = read(text)
    assert robot.bodies[1].joint == "revolute" and "without end" in robot.bodies[1].motions[0].note
    assert robot.bodies[1].motions[0].start == 0
    assert robot.bodies[2].joint == "free" and len(robot.bodies[2].motions) == 6
    assert [d.name for d in robot.drives] == ["shoulder_torque"]


@pytest.mark.parametrize("axis", ["0 0 1", "1 0 0", "1 2 -2", "0 0 -1"])
def test_planar_joint_moves_perpendicular_to_its_axis(read: Reader, axis: str) -> None:
    text = ARM.replace('"revolute"', '"planar"').replace('"0 3 4"', f'"{axis}"')
    robot = read(text)
    normal = np.array([float(word) for word in axis.split()])
    normal /= np.linalg.norm(normal)
    by_name = {body.name: body for body in robot.bodies}

    def place(q: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the arm's frame in the frame of the joint in the file."""
        at, turned, name = np.zeros(3), np.eye(3), "upper-arm"
        while name != "base":
            body = by_name[name]
            offset, rotation = body_pose(body, q if body.motions else ())
            at, turned = np.array(offset) + np.array(rotation) @ at, np.array(rotation) @ turned
            name = body.parent
        joint = np.array(geometry.from_rpy(0.1, 0.2, 0.3))
        return joint.T @ (at - [0, 0, 0.5]), joint.T @ turned

    at, turned = place((0, 0, 0))
    assert np.allclose(at, 0, atol=1e-15) and np.allclose(turned, np.eye(3), atol=1e-11)
    at, turned = place((0.3, -0.4, 0.7))
    assert abs(at @ normal) < 1e-11 and np.isclose(np.linalg.norm(at), 0.5, rtol=1e-11)
    assert np.allclose(turned, geometry.from_axis_angle(tuple(normal), 0.7), atol=1e-11)  # type: ignore[arg-type]


def test_root_named_world_is_the_world(read: Reader) -> None:
    text = ARM.replace(f'<link name="base">{INERTIAL}</link>', '<link name="world"/>')
    robot = read(text.replace('"base"', '"world"'))
    assert robot.bodies[0].name == "upper-arm" and robot.bodies[0].parent == "world"


def joint(name: str, parent: str, child: str, rest: str = "") -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f"{rest}</joint>"
    )


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        ("</robot>", joint("back", "slide", "upper-arm") + "</robot>",
         "joint back: its child link 'upper-arm' is held by joint 'shoulder' already: bodies"),
        ('<parent link="base"/>', '<parent link="tool"/>',
         "the links hold one another in a loop (upper-arm on slide on upper-arm)"),
        ("</robot>", '<link name="lonely"/></robot>', "2 links have no parent (base, lonely)"),
        ('<parent link="base"/>', '<parent link="bass"/>', "did you mean 'base'?"),
        ('<child link="slide"/>', "", "joint extend: it has no child link"),
        ('"0 3 4"', '"0 0 0"', "joint shoulder: its axis has length zero"),
        ('"prismatic"', '"prismatik"', "joint extend: unknown type 'prismatik'; did you mean"),
        ('"prismatic"', '"ball"', "known are revolute, continuous"),
        ('<mass value="2"/>', "", "link upper-arm: its <inertial> has no mass"),
        ('<mass value="2"/>', '<mass value="-2"/>', "link upper-arm: its mass is negative (-2 kg)"),
        ('<mass value="2"/>', '<mass value="nan"/>', "'nan' is not a finite number"),
        ('<mass value="2"/>', '<mass value="1e300"/>', "'1e300' is more than 1e+100"),
        ('<mass value="2"/>', '<mass value="${m}"/>', "run xacro first"),
        ('<mass value="2"/>', '<mass value="2 kg"/>', "of <mass>: 'kg' is not a number"),
        ('izz="0.25"', "", "link upper-arm: <inertia> has no izz"),
        ('xyz="0 0 0.5"', 'xyz="0 0.5"', 'xyz="0 0.5" of <origin> has 2 numbers; it takes 3'),
        ('damping="0.4"', 'damping="-0.4"', "joint shoulder: its damping is negative"),
        ('name="slide"', 'name="base"', "link base: a second link has this name"),
        ('name="extend"', "", "joint 2: it has no name"),
        ('<mass value="2"/>', '<mass value="1_0"/>', "'1_0' is not a number"),
        ('<mass value="2"/>', '<mass value="२"/>', "'२' is not a number"),
        ('<mass value="2"/>', '<mass value="2"/><mass value="3"/>',
         "link upper-arm: it has 2 <mass>: leave the one that is meant"),
        ('<parent link="base"/>', '<parent link="base"/><parent link="slide"/>',
         "joint shoulder: it has 2 <parent>"),
        ('xyz="0 0 0.5"', 'xyz="$(arg x) 0 0"', "it holds xacro macros"),
    ],
)  # fmt: skip
def test_faults_name_the_link_or_joint_and_the_remedy(
    read: Reader, old: str, new: str, reported: str
) -> None:
    assert old in ARM
    text = ARM.replace(old, new, 1)
    if "tool" in new:  # a loop in addition to a root
        text = text.replace('<parent link="tool"/>', '<parent link="slide"/>')
    with pytest.raises(EomcError) as fault:
        read(text)
    assert reported in str(fault.value)


def test_all_faults_are_reported_with_their_lines(read: Reader) -> None:
    text = ARM.replace('"0 3 4"', '"0 0 0"').replace('value="2"', 'value="-2"')
    with pytest.raises(EomcError) as fault:
        read(text)
    for of, name, why in (("joint", "shoulder", "axis has"), ("link", "upper-arm", "mass is")):
        line = text[: text.index(f'<{of} name="{name}"')].count("\n") + 1
        assert f":{line}: error: {of} {name}: its {why}" in str(fault.value)


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>'
OUTSIDE = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;"/>'


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", "the file is empty"),
        ("<robot", "not XML"),
        ("<robot>\n<link></robot>", "robot.urdf:2:"),
        ('\n<?xml version="1.0"?><robot/>', "remove what stands before <?xml"),
        ('<?xml version="1.0" encoding="klingon"?><robot/>', "not XML"),
        ("\x00\x01", "not XML"),
        ("<sdf/>", "not a URDF: its root element is <sdf>"),
        ("<robot/>", "the robot has no <link>"),
        (BOMB, "declares a document type or entities"),
        (OUTSIDE, "declares a document type or entities"),
        ('<!DOCTYPE robot SYSTEM "http://localhost/robot.dtd"><robot/>', "a document type"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro/></robot>', "run xacro"),
        ("<robot><xacro:macro/></robot>", "run xacro first"),
    ],
)
def test_other_files_are_refused(read: Reader, text: str, reported: str) -> None:
    with pytest.raises(EomcError) as fault:
        read(text)
    assert reported in str(fault.value)


def test_unreadable_files_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "crane.urdf").write_text(ARM, encoding="utf-8")
    with pytest.raises(EomcError, match="did you mean 'crane"):
        urdf.read(tmp_path / "crain.urdf")
    with pytest.raises(EomcError, match="can't be read \\(it is a folder"):
        urdf.read(tmp_path)
    os.mkfifo(tmp_path / "pipe.urdf")
    with pytest.raises(EomcError, match="can't be read \\(it is a pipe"):  # without waiting for it
        urdf.read(tmp_path / "pipe.urdf")
    (tmp_path / "gone.urdf").symlink_to(tmp_path / "nothing")
    with pytest.raises(EomcError, match="no such file; did you mean 'crane"):
        urdf.read(tmp_path / "gone.urdf")
    monkeypatch.setattr("eomc.robots.xml.MAX_BYTES", 100)
    with pytest.raises(EomcError, match="more than the 100"):
        urdf.read(tmp_path / "crane.urdf")


def test_free_root_without_inertia_is_reported(read: Reader) -> None:
    """Only for a root with one joint: several joints with different axes make D regular."""
    robot = edit.with_base(read(ARM), free=True)
    root = robot.bodies[0]
    light = replace(root, mass=0.0, inertia=(0.0,) * 6)
    robot_of_light = replace(robot, bodies=(light, *robot.bodies[1:]))
    line = scene_text.prepare_for_scene(robot_of_light).left_out[-1]
    assert line.startswith(f"body {root.name}: it is free and has neither mass nor inertia")
    assert "--base fixed" in line
    heavy = replace(root, mass=1.0)
    for bodies in ((heavy, *robot.bodies[1:]), read(ARM).bodies):
        lines = scene_text.prepare_for_scene(replace(robot, bodies=bodies)).left_out
        assert not any("free" in words for words in lines)
    with pytest.raises(EomcError, match=r"body\.base: D is not .* 'base' has no inertia"):
        eomc.sources(from_scene(parse(scene_text.scene_text(robot_of_light), "crane.toml")))


def test_mesh_is_refused_only_where_a_joint_needs_inertia(read: Reader) -> None:
    text = ARM.replace(
        f'<link name="slide">{INERTIAL}</link>',
        '<link name="slide"><visual><geometry><mesh filename="s.stl"/></geometry></visual></link>',
    )
    with pytest.raises(EomcError) as fault:
        scene_text.prepare_for_scene(read(text))
    assert "joint extend: it moves nothing that has mass" in str(fault.value)
    assert "slide (a mesh only, no <inertial>)" in str(fault.value)
    assert "--lock extend=0" in str(fault.value)


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "crane.urdf").write_text(ARM, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_imported_scene_is_read_without_warnings(folder: Path) -> None:
    result = CliRunner().invoke(main, ["import", "crane.urdf"])
    assert result.exit_code == 0, result.output
    assert "wrote crane.toml: bodies 3, points 1, coordinates 2, inputs 2" in result.output
    assert "eomc dof crane.toml" in result.output
    imported_scene = scene.read("crane.toml")
    assert not imported_scene.warnings
    assert [c.name for c in imported_scene.coordinates] == ["shoulder", "extend"]
    assert imported_scene.start()[0] == [0.2, 0.0]
    assembly = imported_scene.assembly
    assert assembly and not assembly.plane
    arm = assembly.bodies[1]
    assert arm.name == "upper_arm" and arm.joint == "revolute" and arm.axes == ((0, 0.6, 0.8),)
    again = CliRunner().invoke(main, ["import", "crane.urdf"])
    assert again.exit_code == 2 and "stays as it is" in again.output


def test_import_replaces_invalid_inertias_on_request(folder: Path) -> None:
    text = ARM.replace('izz="0.25"', 'izz="25"')
    assert text != ARM
    (folder / "crane.urdf").write_text(text, encoding="utf-8")
    result = CliRunner().invoke(main, ["import", "crane.urdf", "--out", "bad.toml"])
    assert "as --mend-inertias writes" in result.output
    with pytest.raises(EomcError, match="larger than the two others"):
        scene.read("bad.toml")
    words = ["import", "crane.urdf", "--out", "good.toml", "--mend-inertias"]
    result = CliRunner().invoke(main, words)
    assert "body upper-arm: its inertia" in result.output and "is in its place" in result.output
    scene.read("good.toml")


def test_import_writes_into_an_existing_scenes_folder(folder: Path) -> None:
    (folder / "scenes").mkdir()
    result = CliRunner().invoke(main, ["import", "crane.urdf", "--name", "lift"])
    assert result.exit_code == 0 and (folder / "scenes" / "lift.toml").exists()


def test_root_element_selects_the_reader(folder: Path) -> None:
    (folder / "swing.xml").write_text(
        '<mujoco model="swing"><worldbody><body name="bob"><joint name="q" axis="0 1 0"/>'
        '<geom size="0.1" pos="0 0 -1" mass="1"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    result = CliRunner().invoke(main, ["import", "swing.xml"])
    assert result.exit_code == 0, result.output
    assert [c.name for c in scene.read("swing.toml").coordinates] == ["q"]


def test_mass_matrix_of_the_scene_is_that_of_the_file(folder: Path) -> None:
    """Compute D of the two joints by hand, as J^T M J with the numbers of the file."""
    CliRunner().invoke(main, ["import", "crane.urdf"])
    imported_scene = scene.read("crane.toml")
    assert imported_scene.assembly
    at = kinematics.Kinematics(imported_scene, imported_scene.assembly).jacobian(
        np.array([0.7, 0.3]), 0.0
    )
    assert at is not None
    axis, slide = np.array([0, 0.6, 0.8]), np.array([1, 0, 0])
    turned = np.array([[0.2, -0.01, -0.03], [-0.01, 0.1, 0.02], [-0.03, 0.02, 0.25]])
    D = np.zeros((2, 2))
    for mass, center, inertia in (
        (2, np.array([0.1, 0.2, 0.3]), turned), (1, 0.3 * slide, 0.1 * np.eye(3)),
    ):  # fmt: skip
        D[0, 0] += mass * np.sum(np.cross(axis, center) ** 2) + axis @ inertia @ axis
    D[0, 1] = D[1, 0] = np.cross(axis, 0.3 * slide) @ slide
    D[1, 1] = 1
    # some rounding errors
    assert np.allclose(at.weighs.T @ at.weighs, D, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("words", "coordinates", "inputs"),
    [
        (["--lock", "extend=0.1", "--lock", "shoulder=pi/4", "--base", "free"], 6, 0),
        (["--base", "free"], 8, 2),
        (["--root", "upper-arm"], 1, 1),
        (["--tip", "upper-arm"], 1, 1),
        (["--no-drives"], 2, 0),
    ],
)
def test_options_of_import(folder: Path, words: list[str], coordinates: int, inputs: int) -> None:
    result = CliRunner().invoke(main, ["import", "crane.urdf", "--out", "made.toml", *words])
    assert result.exit_code == 0, result.output
    imported_scene = scene.read("made.toml")
    assert (len(imported_scene.coordinates), len(imported_scene.inputs)) == (coordinates, inputs)


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--lock", "extent=0"], "did you mean 'extend'?"),
        (["--lock", "extend"], "write --lock NAME=VALUE"),
        (
            ["--lock", "extend=0", "--lock", "extend=1"],
            "'extend' has a value already: give it once",
        ),
        (["--root", "nowhere"], "no body is called 'nowhere'"),
        (["--name", "class"], "Python keyword"),
        (["--include"], "--include is for MJCF"),
        (["--out", "no/such/folder.toml"], "can't be written"),
    ],
)
def test_invalid_options_write_no_file(folder: Path, words: list[str], reported: str) -> None:
    result = CliRunner().invoke(main, ["import", "crane.urdf", *words])
    assert result.exit_code == 2 and reported in result.output, result.output
    assert not list(folder.glob("*.toml"))


def test_quarter_turns_are_written_exactly(read: Reader) -> None:
    text = ARM.replace('rpy="0.1 0.2 0.3"', 'rpy="1.57079632679 0 -3.14159265359"')
    written = scene_text.scene_text(read(text))
    assert 'rotation    = [["z", "pi"], ["x", "pi/2"]]' in written
    rough = scene_text.scene_text(read(ARM.replace('rpy="0.1 0.2 0.3"', 'rpy="1.5708 0 0"')))
    assert '["x", 1.5708]' in rough and "as 1.5708" in rough
    assert math.isclose(1.5708, math.pi / 2, rel_tol=1e-5)
