"""Bodies, joints, springs, dampers and repetitions of a scene become an Assembly."""

import math
from pathlib import Path

import pytest
from support.session import tiers

from eomc.base.errors import SceneError
from eomc.scene import formulas
from eomc.scene import read as scene
from eomc.scene.joints import JOINTS
from eomc.scene.scene import Turn
from eomc.scene.validate_tables import MOMENT_TOLERANCE

SCENES = Path(__file__).parents[2] / "scenes"
HEAD = 'eomc = 1\nname = "made"\n'
NAMES = ("p", "q", "r", "s", "u", "w")


def read(text):
    return scene.parse(HEAD + text)


def coordinates(count):
    return "[coordinates]\n" + "".join(f"{name} = {{}}\n" for name in NAMES[:count])


def scene_with_joint(kind, gravity, more="", count=None):
    """Write a scene of one body on a joint of the kind."""
    coordinate_count = len(JOINTS[kind].motions) if count is None else count
    names = ", ".join(f'"{name}"' for name in NAMES[:coordinate_count])
    text = (
        f"gravity = {gravity}\n" + coordinates(max(coordinate_count, 1)) + "[parameters]\nk = 2.0\n"
    )
    coordinate_key = f"coordinates = [{names}]\n" if coordinate_count else ""
    return text + f'[[body]]\nname = "link"\njoint = "{kind}"\nmass = "k"\n' + coordinate_key + more


def texts(entries):
    return [formula.text for formula in entries]


# keys that a joint requires
REQUIRED = {"prismatic": "axis = [0, 3, 4]\n", "screw": 'pitch = "k/(2*pi)"\n'}


@pytest.mark.parametrize("kind", JOINTS)
def test_each_joint_is_read_in_space(kind):
    assembly = read(scene_with_joint(kind, "[0, 0, -9.81]", REQUIRED.get(kind, "")))
    (body,) = assembly.assembly.bodies
    assert not assembly.assembly.plane
    assert body.joint == kind
    assert body.parent == "world"
    names = NAMES[: len(JOINTS[kind].motions)]
    assert tuple(formula.text for formula in body.coordinates) == names
    assert len(body.axes) == JOINTS[kind].axis_count
    assert body.axes == (((0, 0.6, 0.8),) if kind == "prismatic" else JOINTS[kind].defaults)
    assert body.mass.text == "k"
    assert texts(body.inertia) == ["0"] * 6


@pytest.mark.parametrize("kind", [kind for kind, joint in JOINTS.items() if joint.plane])
def test_each_joint_is_read_in_the_plane(kind):
    assembly = read(
        scene_with_joint(kind, "[0, -9.81]", "axis = [3, -4]\n" * (kind == "prismatic"))
    )
    (body,) = assembly.assembly.bodies
    assert assembly.assembly.plane
    assert texts(assembly.assembly.gravity) == ["0.0", "-9.81", "0"]
    expected = {"prismatic": ((0.6, -0.8, 0.0),), "revolute": ((0.0, 0.0, 1.0),)}
    assert body.axes == expected.get(kind, ())


@pytest.mark.parametrize("kind", [kind for kind, joint in JOINTS.items() if not joint.plane])
def test_spatial_joints_are_refused_in_the_plane(kind):
    with pytest.raises(SceneError, match=f"a {kind} joint moves a body in space"):
        read(scene_with_joint(kind, "[0, -9.81]"))


@pytest.mark.parametrize("kind", JOINTS)
def test_wrong_number_of_coordinates_is_refused(kind):
    expected_count = len(JOINTS[kind].motions)
    axis = REQUIRED.get(kind, "")
    with pytest.raises(SceneError, match=rf"body\.link\.coordinates: a {kind} joint has"):
        read(
            scene_with_joint(
                kind,
                "[0, 0, 0]",
                axis,
                expected_count - 1 if expected_count == 6 else expected_count + 1,
            )
        )


def test_pitch_belongs_to_screws_alone():
    (body,) = read(scene_with_joint("screw", "[0, 0, 0]", REQUIRED["screw"])).assembly.bodies
    assert body.pitch.text == "k/(2*pi)"
    for kind, more, why in (
        ("screw", "", "missing: a screw joint has one"),
        ("revolute", "pitch = 0.1\n", "a revolute joint has no pitch: remove it"),
    ):
        with pytest.raises(SceneError, match=rf"body\.link\.pitch: {why}"):
            read(scene_with_joint(kind, "[0, 0, 0]", more))


def test_values_of_a_joint_are_one_per_coordinate():
    one = 'damping = "k"\nfriction = 0.1\narmature = [1, 2, 3]\nactuator = [0, "-p_dot", "q*k"]\n'
    (body,) = read(scene_with_joint("planar", "[0, 0]", one)).assembly.bodies
    assert texts(body.damping) == ["k", "k", "k"]
    assert texts(body.friction) == ["0.1"] * 3
    assert body.friction_width.text == "0.01"
    assert texts(body.armature) == ["1.0", "2.0", "3.0"]
    assert texts(body.actuator) == ["0.0", "-p_dot", "q*k"]


def test_omitted_keys_are_empty():
    (body,) = read(scene_with_joint("planar", "[0, 0]")).assembly.bodies
    assert body.friction_width is None
    assert (body.damping, body.friction, body.armature, body.actuator) == ((), (), (), ())
    assert body.rotation == ()
    assert texts(body.offset) == texts(body.center) == ["0"] * 3


def test_rotations_are_read():
    plane = read(scene_with_joint("revolute", "[0, 0]", 'rotation = "pi/2"\n')).assembly.bodies[0]
    assert [(turn.axis, turn.angle.text) for turn in plane.rotation] == [("z", "pi/2")]
    turns = 'rotation = [["z", "pi/2"], ["x", "k"]]\n'
    space = read(scene_with_joint("revolute", "[0, 0, 0]", turns)).assembly.bodies[0]
    assert [(turn.axis, turn.angle.text) for turn in space.rotation] == [("z", "pi/2"), ("x", "k")]
    assert isinstance(space.rotation[0], Turn)


@pytest.mark.parametrize(
    ("moments", "message"),
    [
        ((1, 1, 2), ""),
        ((1, 1, 2 + MOMENT_TOLERANCE), ""),  # within rounding
        ((1, 1, 2 + 1e4 * MOMENT_TOLERANCE), "one is larger than the two others"),
        ((0, 0, 0), ""),
        ((0, 2, 2), ""),  # a rod
        ((2, 2, 2, 1, 1, 1), "one is larger than the two others"),  # 1, 1 and 4
        ((2, 2, 2, -0.5, -0.5, -0.5), ""),  # 1, 2.5 and 2.5
        ((2, 2, 2, 3, 0, 0), "none can be negative"),
    ],
)
def test_inertias_of_no_body_are_refused(moments, message):
    text = scene_with_joint("revolute", "[0, 0, 0]", f"inertia = {list(map(float, moments))}\n")
    if message:
        with pytest.raises(SceneError, match=message):
            read(text)
    else:
        read(text)


def test_parents_must_precede_children():
    def body(name, parent, coordinate):
        return (
            f'[[body]]\nname = "{name}"\nparent = "{parent}"\njoint = "revolute"\n'
            f'coordinates = "{coordinate}"\nmass = 1\ninertia = 1\n'
        )

    assembly = read(
        "gravity = [0, 0]\n" + coordinates(4)
        + body("hand", "arm", "p") + body("arm", "trunk", "q")
        + body("trunk", "world", "r") + body("leg", "trunk", "s")
    )  # fmt: skip
    assert [body.name for body in assembly.assembly.bodies] == ["trunk", "arm", "hand", "leg"]


def test_bodies_placed_by_formulas_are_read():
    assembly = read(
        'gravity = [0, "-g"]\n' + coordinates(1) + "[parameters]\nl = 1.0\ng = 9.81\n"
        '[definitions]\nh = "l*p"\n'
        '[[body]]\nname = "bob"\nposition = ["h + sin(t)", 0]\nrotation = "p"\nmass = 1\n'
        "inertia = 2\n"
    )
    (body,) = assembly.assembly.bodies
    assert body.joint == ""
    assert texts(body.position) == ["h + sin(t)", "0.0", "0"]
    assert [(turn.axis, turn.angle.text) for turn in body.rotation] == [("z", "p")]
    assert texts(body.inertia) == ["0", "0", "2.0", "0", "0", "0"]


def test_energies_are_summed_and_centres_have_names():
    more = '[energy]\npotential = "k*link_y**2/2"\n[forces]\np = "-dot(link_x)"\n'
    assembly = read(scene_with_joint("revolute", "[0, 0]", 'center = ["k", 0]\n' + more))
    assert assembly.potential.text == "k*link_y**2/2"
    assert formulas.evaluate(assembly.kinetic, formulas.NUMERIC, {}.__getitem__) == 0
    with pytest.raises(SceneError, match="'link_z' is not declared"):
        read(scene_with_joint("revolute", "[0, 0]", more.replace("link_y", "link_z")))


def test_springs_and_dampers_are_read():
    assembly = read(
        scene_with_joint("planar", "[0, 0]", "")
        + '[[spring]]\ncoordinate = "r"\nstiffness = "k"\nlength = 1\n'
        '[[spring]]\nbodies = ["world", "link"]\npoints = [[0, 1], ["k", 0]]\nstiffness = 3\n'
        '[[spring]]\nbodies = ["link", "world"]\nturning = true\nstiffness = 4\n'
        '[[damper]]\nbodies = ["world", "link"]\ndamping = 5\n'
    )
    along, between, turning = assembly.assembly.springs
    (damper,) = assembly.assembly.dampers
    assert (along.coordinate, along.bodies, along.length.text) == ("r", None, "1.0")
    assert between.bodies == ("world", "link")
    assert [texts(point) for point in between.points] == [["0.0", "1.0", "0"], ["k", "0.0", "0"]]
    assert (turning.turning, turning.points, turning.bodies) == (True, None, ("link", "world"))
    assert damper.damping.text == "5.0"
    assert [texts(point) for point in damper.points] == [["0"] * 3] * 2


def test_springs_along_coordinates_need_no_bodies():
    assembly = read(
        coordinates(1) + '[energy]\nkinetic = "p_dot**2"\n'
        '[[spring]]\ncoordinate = "p"\nstiffness = 1\n'
    )
    assert assembly.assembly.bodies == ()
    assert len(assembly.assembly.springs) == 1
    assert read(coordinates(1) + '[energy]\nkinetic = "p_dot**2"\n').assembly is None


def test_every_kind_of_entry_can_be_repeated():
    assembly = read(
        """gravity = [0, 0]
[constants]
n = 3
"c[i]" = { repeat = "i = 1..n", value = "i/2" }
[parameters]
"m[i]" = { repeat = "i = 1..n", value = "c[i] + i**2" }
[coordinates]
"q[i]" = { repeat = "i = 1..n", start = "0.1*i*m[i]", unit = "rad" }
[inputs]
"f[k]" = { repeat = "k = 0..n-1" }
[definitions]
"s[1]" = "q[1]"
"s[i]" = { repeat = "i = 2..n", value = "s[i-1] + q[i]" }
[forces]
"q[i]" = { repeat = "i = 1..n", value = "-s[i] + f[i-1]" }
[[body]]
repeat = "i = -1+2..n"
name = "b[i]"
parent = "world"
joint = "revolute"
coordinates = "q[i]"
offset = ["i", "(2 - i)*c[n]"]
mass = "m[i]"
inertia = 1
[[spring]]
repeat = "i = 1..n-1"
bodies = ["b[i]", "b[i+1]"]
stiffness = "i"
[[damper]]
coordinate = "q[n]"
damping = 1
"""
    )
    assert assembly.warnings == ()
    assert [c.name for c in assembly.constants] == ["n", "c1", "c2", "c3"]
    assert [p.value for p in assembly.parameters] == [1.5, 5.0, 10.5]
    assert assembly.start()[0] == pytest.approx([0.15, 1.0, 3.15], rel=1e-15)
    assert [i.name for i in assembly.inputs] == ["f0", "f1", "f2"]
    assert [(name, f.text) for name, f in assembly.definitions][-1] == ("s3", "s2 + q3")
    assert {name: f.text for name, f in assembly.forces.items()}["q2"] == "-s2 + f1"
    assert [body.name for body in assembly.assembly.bodies] == ["b1", "b2", "b3"]
    assert texts(assembly.assembly.bodies[2].offset) == ["3", "(2 - 3)*c3", "0"]
    assert [s.bodies for s in assembly.assembly.springs] == [("b1", "b2"), ("b2", "b3")]
    assert [s.stiffness.text for s in assembly.assembly.springs] == ["1", "2"]
    assert assembly.assembly.dampers[0].coordinate == "q3"


def test_empty_repetition_is_accepted():
    text = (SCENES / "chain.toml").read_text(encoding="utf-8")
    assert "value = 5" in text
    assert len(scene.parse(text.replace("value = 5", "value = 1")).assembly.bodies) == 1
    assert len(scene.parse(text.replace("value = 5", "value = 50")).assembly.bodies) == 50


def test_problems_are_reported_at_the_repeated_entry():
    assembly = scene.read(SCENES / "chain.toml")
    lines = (SCENES / "chain.toml").read_text(encoding="utf-8").split("\n")
    third = assembly.assembly.bodies[2]
    for key, formula, line in (
        ("body.link3.inertia", third.inertia[2], "inertia "),
        ("body.link3.offset", third.offset[0], "offset "),
        ("body.link3", None, "name "),
        ("coordinates.theta4", None, '"theta[i]"'),
        ("gravity", None, "gravity "),
    ):
        problem = assembly.problem(key, "is odd", formula)
        assert problem.key == key
        assert lines[problem.line - 1].startswith(line)
        assert problem.column >= 0
    second = assembly.problem("body.link2.mass", "is odd").line
    assert second == assembly.problem("body.link5.mass", "is odd").line
    assert second > assembly.problem("body.link1.mass", "is odd").line


@pytest.mark.parametrize("name", ["chain", "cartpole_bodies", "tumbling_box", "suspension"])
def test_scenes_of_bodies_give_no_warnings(name):
    assembly = scene.read(SCENES / f"{name}.toml")
    assert assembly.warnings == ()
    assert assembly.assembly.bodies


def test_values_are_checked_when_a_parameter_is_set():
    text = """
eomc = 1
name = "swing"
gravity = [0, "-g"]
[coordinates]
q = { start = "w" }
[parameters]
g = 9.81
m = 1
w = 0.1
[[body]]
name = "bob"
joint = "revolute"
coordinates = "q"
mass = "m"
center = [0, -1]
friction = 0.2
friction_width = "w"
"""
    assert scene.parse(text, parameters={"w": 0.3}).start()[0] == [0.3]
    for values, reported in (
        ({"w": 0}, "body.bob.friction_width: is 0, and must be greater than zero"),
        ({"w": -1}, "body.bob.friction_width: is -1"),
        ({"m": -2}, "body.bob.mass: is -2, and"),
    ):
        with pytest.raises(SceneError, match=reported):
            scene.parse(text, parameters=values)


@pytest.mark.parametrize("number", tiers([1000, 4000], 1000))
def test_thousands_of_bodies_are_read(number):
    text = (SCENES / "chain.toml").read_text(encoding="utf-8")
    # and the same number of coordinates
    assembly = scene.parse(text.replace("value = 5", f"value = {number}"))
    assert len(assembly.assembly.bodies) == number
    assert math.isclose(assembly.start()[0][-1], number / 10)
