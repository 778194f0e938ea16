"""The robot model: rotations and inertia tensors, editing, and the scene that is written."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eomc.base import names
from eomc.base.errors import EomcError
from eomc.robots import edit, geometry, scene_text
from eomc.robots.geometry import Inertia
from eomc.robots.robot import Drive, JointMotion, Robot, RobotBody, body_pose
from eomc.scene.read import parse

angles = st.one_of(
    st.floats(-math.pi, math.pi),
    st.sampled_from([k * math.pi / 12 for k in range(-12, 13)]),
    st.sampled_from([1.5707963, 1.57079632679, -1.5708, 3.1415926]),
)

R_X = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # a quarter turn about x


def rotation_matrix(axis: str, by: float) -> np.ndarray:
    """Return the rotation matrix about an axis, as textbooks print it."""
    c, s = math.cos(by), math.sin(by)
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


@given(angles, angles, angles)
def test_rpy_is_the_product_of_elementary_rotations(roll: float, pitch: float, yaw: float) -> None:
    expected = rotation_matrix("z", yaw) @ rotation_matrix("y", pitch) @ rotation_matrix("x", roll)
    # Entries within 1e-12 of 0 and 1 are rounded to these, in each factor.
    assert np.allclose(geometry.from_rpy(roll, pitch, yaw), expected, atol=4e-12, rtol=0)


@given(angles, angles, angles)
def test_decomposed_rotation_is_reproduced_also_at_gimbal_lock(
    a: float, b: float, c: float
) -> None:
    rotation = geometry.from_rpy(a, b, c)
    turns = geometry.axis_rotations(rotation)
    again = geometry.from_euler("".join(x for x, _ in turns), [angle for _, angle in turns])
    # rotations below 1e-10 are dropped
    assert np.allclose(again, rotation, atol=3e-10, rtol=0)


def test_decomposition_uses_the_fewest_rotations() -> None:
    quarter = math.pi / 2
    assert geometry.axis_rotations(geometry.from_rpy(quarter, 0, 0)) == (("x", quarter),)
    assert geometry.axis_rotations(geometry.from_rpy(0, math.pi, 0)) == (("y", math.pi),)
    assert geometry.axis_rotations(geometry.from_rpy(math.pi, 0.3, math.pi)) == (
        ("y", pytest.approx(math.pi - 0.3)),
    )
    assert geometry.axis_rotations(geometry.IDENTITY) == ()


@given(angles, angles, angles)
def test_quaternions_and_euler_angles_agree(a: float, b: float, c: float) -> None:
    w, x = math.cos(a / 2), math.sin(a / 2)
    assert np.allclose(
        geometry.from_quaternion(2 * w, 2 * x, 0, 0), rotation_matrix("x", a), atol=4e-12
    )
    small = rotation_matrix("x", a) @ rotation_matrix("y", b) @ rotation_matrix("z", c)
    assert np.allclose(geometry.from_euler("xyz", (a, b, c)), small, atol=4e-12)
    capitals = rotation_matrix("z", c) @ rotation_matrix("y", b) @ rotation_matrix("x", a)
    assert np.allclose(geometry.from_euler("XYZ", (a, b, c)), capitals, atol=4e-12)


def test_quarter_turn_has_exact_zeros() -> None:
    assert np.array_equal(geometry.from_rpy(math.pi / 2, 0, 0), R_X)


def test_rotated_tensor_gives_the_same_energy() -> None:
    inertia = (1.0, 2.0, 2.5, 0.1, -0.2, 0.3)
    rotation = geometry.from_rpy(0.3, -0.4, 1.1)
    old = np.array([[1.0, 0.1, -0.2], [0.1, 2.0, 0.3], [-0.2, 0.3, 2.5]])
    expected = np.array(rotation) @ old @ np.array(rotation).T
    xx, yy, zz, xy, xz, yz = geometry.rotated_inertia(inertia, rotation)
    # some rounding errors
    assert np.allclose([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], expected, rtol=0, atol=1e-15)


def test_invalid_tensors_are_reported_with_a_valid_one() -> None:
    assert not geometry.triangle_message((1.0, 1.0, 2.0, 0, 0, 0))
    assert not geometry.indefinite_message((0.0, 0.0, 0.0, 0, 0, 0))
    reported = geometry.triangle_message((1.0, 1.0, 2.1, 0, 0, 0))
    assert (
        "1, 1, 2.1 break the triangle inequality" in reported
        and "[1.0333333, 1.0333333, 2.0666667, 0, 0, 0] would do" in reported
    )
    assert "-1" in geometry.indefinite_message((1.0, 1.0, -1.0, 0, 0, 0))


@pytest.mark.parametrize(
    "inertia",
    [(0.001, 0.002, 0.006, 0.0003, -0.0002, 0.0004), (1.0, 1.0, -1.0, 0, 0, 0),
     (1e-8, 2e-8, 4e-8, 6e-8, 1e-8, 1e-8), (-1.0, -2.0, -0.5, 0.1, 0, 0)],
)  # fmt: skip
def test_nearest_valid_tensor_is_valid_and_nearest(inertia: Inertia) -> None:
    near = geometry.nearest_valid(inertia)
    assert not geometry.indefinite_message(near) and not geometry.triangle_message(near)

    def distance(other: Inertia) -> float:
        """Return the Frobenius distance, over all nine entries."""
        difference = np.array(other) - inertia
        return float(difference**2 @ [1, 1, 1, 2, 2, 2])

    random = np.random.default_rng(2)
    for k in range(300):  # others, at distances from large to small
        points = random.normal(size=(4, 3))
        m = np.abs(random.normal(size=4)) * max(map(abs, inertia)) / 3
        x, y, z = (points - m @ points / m.sum()).T
        bodys = np.array([m @ (y * y + z * z), m @ (x * x + z * z), m @ (x * x + y * y),
                          -m @ (x * y), -m @ (x * z), -m @ (y * z)])  # fmt: skip
        part = 10.0 ** -(k % 5)  # the valid tensors are a convex set
        other = tuple(part * bodys + (1 - part) * np.array(near))
        assert distance(near) <= distance(other) + 1e-12 * distance((0, 0, 0, 0, 0, 0))
    good = (1.0, 1.1, 1.2, 0.1, 0, 0)
    assert geometry.nearest_valid(good) == pytest.approx(good, rel=1e-14)


@pytest.mark.parametrize(
    "tensor",
    [
        (-1.2, -1.1, 0.3, 0, 0, 0),
        (-1.2, -1.1, -0.3, 0, 0, 0),
        (-1, 0, 0, 0, 0, 0),
        (0, 0, 0, 1, 1, 1),
    ],
)
def test_no_replacement_is_proposed_for_tensors_with_wrong_signs(tensor: Inertia) -> None:
    """The nearest valid tensor is zero there, or very different."""
    base, body, *rest = arm().bodies
    robot = replace(arm(), bodies=(base, replace(body, inertia=tensor), *rest))
    assert edit.with_nearest_inertias(robot) == robot
    with pytest.raises(EomcError) as fault:
        scene_text.prepare_for_scene(robot)
    assert "check the signs of the tensor" in str(fault.value)
    assert "would do" not in str(fault.value) and "--mend-inertias" not in str(fault.value)


def test_invalid_tensors_are_replaced_on_request() -> None:
    bad = replace(arm().bodies[2], inertia=(0.1, 0.1, 0.3, 0.0, 0.0, 0.0))
    worse = replace(arm().bodies[1], inertia=(0.1, -0.1, 0.3, 0.0, 0.0, 0.0))
    bodies = tuple({"boom": bad, "column": worse}.get(b.name, b) for b in arm().bodies)
    mended = edit.with_nearest_inertias(replace(arm(), bodies=bodies))
    text = scene_text.scene_text(mended)
    assert "# - body column: its inertia [0.1, -0.1, 0.3, 0, 0, 0] is that of no body" in text
    assert "# - body boom: its inertia [0.1, 0.1, 0.3, 0, 0, 0] is that of no body" in text
    inertias = [b["inertia"] for b in tomllib.loads(text)["body"] if "inertia" in b]
    assert inertias[1] == pytest.approx([0.4 / 3, 0.4 / 3, 0.8 / 3])
    parse(text)
    assert edit.with_nearest_inertias(arm()) == arm()


# --- a robot ------------------------------------------------------------------------------------


def arm() -> Robot:
    """Return a column that turns about z, a boom about y, a slide along x and a fixed hook."""
    inertia = (0.1, 0.2, 0.2, 0.0, 0.0, 0.0)
    return Robot(
        "arm",
        "Arm",
        (0.0, 0.0, -9.81),
        (
            RobotBody("base"),
            RobotBody("column", "base", "revolute", (JointMotion("pan", "rad", start=0.5),),
                      ((0.0, 0.0, 1.0),), (0.0, 0.0, 0.4), mass=2.0, inertia=inertia),
            RobotBody("boom", "column", "revolute", (JointMotion("lift", "rad", damping=0.1),),
                      ((0.0, 1.0, 0.0),), (0.1, 0.0, 0.0), geometry.from_rpy(0, 0, math.pi / 2),
                      mass=1.0, center=(0.5, 0.0, 0.0), inertia=inertia),
            RobotBody("lamp", "column", mass=0.1),
            RobotBody("trolley", "boom", "prismatic", (JointMotion("reach", "m", note="0 to 1"),),
                      ((1.0, 0.0, 0.0),), mass=0.5, inertia=inertia),
            RobotBody("hook", "trolley", offset=(0.2, 0.0, 0.0), mass=0.2),
            RobotBody("tip frame", "hook", offset=(0.1, 0.0, 0.0)),
        ),
        (Drive("pan_torque", "pan"), Drive("reach_force", "reach", 20.0)),
    )  # fmt: skip


def pose_in_world(
    robot: Robot, body_name: str, q: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a body's frame in the world."""
    by_name = {body.name: body for body in robot.bodies}
    at, turned = np.zeros(3), np.eye(3)
    while body_name != "world":
        body = by_name[body_name]
        offset, rotation = body_pose(body, [q[m.name] for m in body.motions])
        at, turned = np.array(offset) + np.array(rotation) @ at, np.array(rotation) @ turned
        body_name = body.parent
    return at, turned


def test_pose_of_a_body_follows_from_its_joints() -> None:
    at, turned = pose_in_world(arm(), "hook", {"pan": 0.3, "lift": -0.2, "reach": 0.7})
    rotation = (
        rotation_matrix("z", 0.3) @ rotation_matrix("z", math.pi / 2) @ rotation_matrix("y", -0.2)
    )
    expected = [0, 0, 0.4] + rotation_matrix("z", 0.3) @ [0.1, 0, 0] + rotation @ [0.9, 0, 0]
    assert np.allclose(at, expected, atol=1e-15) and np.allclose(turned, rotation, atol=1e-15)


@pytest.mark.parametrize("name", ["pan", "lift", "reach"])
def test_locked_joint_keeps_its_value(name: str) -> None:
    q = {"pan": 0.3, "lift": -0.2, "reach": 0.7}
    locked = edit.lock(arm(), {name: q[name]})
    assert [m.name for m in locked.motions] == [n for n in q if n != name]
    for ours, theirs in zip(
        pose_in_world(locked, "hook", q), pose_in_world(arm(), "hook", q), strict=True
    ):
        assert np.allclose(ours, theirs, atol=1e-15)
    assert name not in [drive.coordinate for drive in locked.drives]
    assert f"joint {name} stands at {q[name]}" in scene_text.scene_text(locked)


def test_invalid_locks_are_refused() -> None:
    with pytest.raises(EomcError, match="did you mean 'lift'"):
        edit.lock(arm(), {"lif": 0.0})
    with pytest.raises(EomcError, match="only a joint with one coordinate"):
        edit.lock(edit.with_base(arm(), free=True), {"yaw": 0.0})


def test_cut_keeps_the_initial_pose_of_the_root() -> None:
    whole = arm()
    part = edit.cut(whole, "boom")
    assert [b.name for b in part.bodies] == ["boom", "trolley", "hook", "tip frame"]
    assert part.bodies[0].joint == "fixed" and part.bodies[0].parent == "world"
    q = {"pan": 0.5, "lift": 0.0, "reach": 0.7}  # pan at its initial value
    for ours, theirs in zip(
        pose_in_world(part, "hook", q), pose_in_world(whole, "hook", q), strict=True
    ):
        assert np.allclose(ours, theirs, atol=1e-15)
    assert "cut off: base, column, lamp" in part.left_out
    assert [drive.name for drive in part.drives] == ["reach_force"]


def test_chain_keeps_fixed_bodies_but_not_those_beyond_the_tip() -> None:
    chain = edit.cut(arm(), tip="boom")
    assert [b.name for b in chain.bodies] == ["base", "column", "boom", "lamp"]
    assert [m.name for m in chain.motions] == ["pan", "lift"]
    with pytest.raises(EomcError, match="'lamp' is not behind 'boom'"):
        edit.cut(arm(), "boom", "lamp")
    with pytest.raises(EomcError, match="did you mean 'boom'"):
        edit.cut(arm(), "bom")


def test_base_is_freed_and_fixed_again() -> None:
    free = edit.with_base(arm(), free=True)
    assert [m.name for m in free.motions][:6] == ["x", "y", "z", "yaw", "pitch", "roll"]
    assert edit.with_base(free, free=False) == arm()
    root = replace(
        arm().bodies[0], offset=(1.0, 2.0, 3.0), rotation=geometry.from_rpy(0.1, 0.2, 0.3)
    )
    stood = replace(arm(), bodies=(root, *arm().bodies[1:]))
    free = edit.with_base(stood, free=True)
    assert [m.start for m in free.motions[:6]] == pytest.approx([1, 2, 3, 0.3, 0.2, 0.1])
    at_start = {m.name: m.start for m in free.motions}
    hooks = pose_in_world(free, "hook", at_start), pose_in_world(stood, "hook", at_start)
    for ours, theirs in zip(*hooks, strict=True):
        assert np.allclose(ours, theirs, atol=1e-15)
    crowd = replace(arm(), bodies=(*arm().bodies, RobotBody("other")))
    with pytest.raises(EomcError, match="2 bodies stand on the world"):
        edit.with_base(crowd, free=True)


# --- the scene ------------------------------------------------------------------------------------


def test_scene_contains_only_what_differs_from_the_defaults() -> None:
    tree = tomllib.loads(scene_text.scene_text(arm()))
    assert tree["gravity"] == [0, 0, -9.81]
    assert tree["coordinates"]["pan"] == {"unit": "rad", "start": 0.5}
    assert tree["coordinates"]["reach"] == {"unit": "m", "note": "0 to 1"}
    bodies = {body["name"]: body for body in tree["body"]}
    assert "tip_frame" not in bodies and "tip frame" in scene_text.scene_text(arm())
    assert bodies["base"] == {"name": "base", "joint": "fixed"}
    assert bodies["column"] == {
        "name": "column", "parent": "base", "joint": "revolute", "coordinates": "pan",
        "offset": [0, 0, 0.4], "mass": 2, "inertia": [0.1, 0.2, 0.2], "actuator": "pan_torque",
    }  # fmt: skip
    assert bodies["boom"]["axis"] == [0, 1, 0] and bodies["boom"]["damping"] == 0.1
    assert bodies["boom"]["rotation"] == [["z", "pi/2"]]
    assert bodies["trolley"]["actuator"] == "20*reach_force"


def test_springs_of_joints() -> None:
    motion = JointMotion("pan", "rad", stiffness=3.0, rest=math.pi / 4, armature=0.02, friction=0.1)
    body = replace(arm().bodies[1], motions=(motion,))
    robot = replace(arm(), bodies=(RobotBody("base"), body), drives=())
    tree = tomllib.loads(scene_text.scene_text(robot))
    assert tree["spring"] == [{"coordinate": "pan", "stiffness": 3, "length": "pi/4"}]
    assert (tree["body"][1]["armature"], tree["body"][1]["friction"]) == (0.02, 0.1)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_survive_writing_and_reading(x: float) -> None:
    assert tomllib.loads(f"x = {scene_text.number(x)}")["x"] == x


@given(angles)
def test_angles_survive_writing_and_reading_within_rounding(x: float) -> None:
    angle = scene_text.angle(x)
    value = eval(str(angle), {"pi": math.pi})
    assert abs(value - x) <= (1e-10 if isinstance(angle, str) or angle == 0 else 4e-16)


def test_names_become_valid_in_a_scene() -> None:
    body = arm().bodies[1]
    bodies = (
        RobotBody("lambda"),
        replace(body, name="a-b", parent="lambda", motions=(JointMotion("a.b", "rad"),)),
        replace(body, name="a b", parent="a-b", motions=(JointMotion("a_b_dot", "rad"),)),
        replace(body, name="x" * 60, parent="a b", motions=(JointMotion("while", "rad"),)),
        replace(body, name="y", parent="x" * 60, motions=(JointMotion("y_x", "rad"),)),
    )
    drives = (Drive("a.b", "a.b"), Drive("a_b", "while"))
    robot = scene_text.prepare_for_scene(replace(arm(), name="math", bodies=bodies, drives=drives))
    coordinates = [m.name for m in robot.motions]
    taken = [*coordinates, *(f"{c}_dot" for c in coordinates), *(d.name for d in robot.drives)]
    taken += [f"{b.name}_{letter}" for b in robot.bodies for letter in "xyz"]
    assert len(set(taken)) == len(taken)
    assert not [names.fault(name) for name in taken if names.fault(name)]
    assert names.module_fault(robot.name) is None
    assert "'a.b' in the file" in robot.motions[0].note
    assert [d.coordinate for d in robot.drives] == [coordinates[0], coordinates[2]]
    assert scene_text.prepare_for_scene(robot) == robot


def test_foreign_texts_are_escaped() -> None:
    wild = 'x"""\n\x7f\x00 = [[body]] \\'
    robot = replace(arm(), title=wild, left_out=(wild,))
    tree = tomllib.loads(scene_text.scene_text(robot))
    assert tree["title"] == 'x"""\\n\\x7f\\x00 = [[body]] \\' and tree["name"] == "arm"


def test_joints_without_mass_are_refused_with_the_remedy() -> None:
    finger = RobotBody(
        "finger", "hook", "revolute", (JointMotion("f-1", "rad"),), ((1.0, 0.0, 0.0),),
        note="a mesh only",
    )  # fmt: skip
    bodies = (*arm().bodies[:6], finger)
    with pytest.raises(EomcError) as fault:
        scene_text.prepare_for_scene(replace(arm(), bodies=bodies))
    assert "joint f-1: it moves nothing that has inertia, only finger (a mesh only)" in str(
        fault.value
    )
    assert "--lock f-1=0" in str(fault.value)
    locked = edit.lock(replace(arm(), bodies=bodies), {"f-1": 0.0})
    assert len(scene_text.prepare_for_scene(locked).motions) == 3
    with pytest.raises(EomcError, match="nothing moves"):
        scene_text.prepare_for_scene(replace(arm(), bodies=arm().bodies[:1]))


def test_invalid_inertias_are_refused() -> None:
    broken = replace(arm().bodies[1], inertia=(0.1, 0.1, 0.3, 0.0, 0.0, 0.0))
    robot = replace(arm(), bodies=(RobotBody("base"), broken), drives=())
    assert any(
        "body column: its principal moments" in w
        for w in scene_text.prepare_for_scene(robot).left_out
    )
    negative = replace(broken, inertia=(0.1, 0.1, -0.1, 0.0, 0.0, 0.0))
    with pytest.raises(EomcError, match="body column: its smallest principal moment"):
        scene_text.prepare_for_scene(replace(robot, bodies=(RobotBody("base"), negative)))
