"""What is drawn is what the scene declares, where its own mechanics says that it is."""

import json
from pathlib import Path

import numpy as np
import pytest
import sympy
from report.pictures import FREE, OWN, ROBOTS, SCENES, chain, humanoid, motion, scene, system

from eomc.model.from_scene import from_scene
from eomc.model.kinematics import Kinematics
from eomc.model.system import System, symbol
from eomc.program.assembly import assembled
from eomc.report.drawing import draw_mechanism
from eomc.scene.read import parse

GOLDEN = Path(__file__).parent / "drawings.json"
DRAWN = [
    *sorted(p.stem for p in SCENES.glob("*.toml")),
    *sorted(p.stem for p in OWN.iterdir()),
]


def drawn(made, rows=121):
    run = motion(made, rows=rows)
    return draw_mechanism(system(made), run.t, run.q)


def marks(found, kind):
    return [found.points[:, m.points] for m in found.marks if m.kind == kind]


def summary(name):
    """Marks and paths in numbers, at the start and at a later time."""
    found = drawn(scene(name), 3)
    rows = [
        [mark.kind, *np.round(found.points[row][list(mark.points)], 4).tolist()]
        for row in (0, 2)
        for mark in found.marks
    ]
    return {"axes": found.axes, "marks": rows, "paths": [p.name for p in found.paths]}


@pytest.mark.parametrize("name", DRAWN)
def test_drawings_are_as_they_were_read(name):
    """Each was read with the eyes when it was accepted: python tests/report/test_drawing.py."""
    was, now = json.loads(GOLDEN.read_text())[name], summary(name)
    assert now["axes"] == was["axes"] and now["paths"] == was["paths"]
    assert [m[0] for m in now["marks"]] == [m[0] for m in was["marks"]]
    for mine, other in zip(now["marks"], was["marks"], strict=True):
        assert np.allclose(mine[1:], other[1:], atol=2e-4), mine[0]


@pytest.mark.parametrize("made", [chain, humanoid, *(lambda n=n: scene(n) for n in ("satellite",
    "slung_load", "crane", "suspension", "tumbling_box", "chain"))])  # fmt: skip
def test_frames_are_where_the_other_kinematics_has_them(made):
    made = made()
    run = motion(made, rows=3)
    found = draw_mechanism(system(made), run.t, run.q)
    other = Kinematics(made, made.assembly)
    kept = ["xyz".index(axis) for axis in found.axes]
    for row in range(3):
        poses = other.poses(run.q[row])
        masses = [found.points[row, m.points[0]] for m in found.marks if m.kind == "mass"]
        for body in made.assembly.bodies:
            at, R = poses[body.name]
            if other.roots[body.name][0]:
                center = (at + R @ other.centers[body.name])[kept]
                assert min(np.abs(m - center).max() for m in masses) < 1e-12, body.name


def test_a_body_without_more_has_no_rod():
    """The pole of cartpole_bodies without its picture: to its centre of mass, no further."""
    text = (SCENES / "cartpole_bodies.toml").read_text()
    made = parse(text[: text.index("[[point]]")])
    found = drawn(made)
    assert {m.kind for m in found.marks} == {"rail", "arm", "joint", "slide", "mass"}
    (arm,) = marks(found, "arm")
    assert np.allclose(np.linalg.norm(arm[:, 0] - arm[:, 1], axis=1), 1.0)  # l/2
    assert not marks(found, "rod")


def closed(joint):
    """The drawing of the assembled four-bar without its picture, closed by another joint."""
    text = (SCENES / "four_bar.toml").read_text()
    text = text[: text.index("[picture]")] + text[text.index("[run]") :]
    made = assembled(from_scene(parse(text.replace('joint  = "revolute"', joint))))
    return draw_mechanism(made, np.zeros(1), np.array([[c.start for c in made.coordinates]]))


def test_a_loop_is_drawn_as_a_joint_that_its_bodies_reach():
    found = closed('joint  = "revolute"')
    pins, rods = marks(found, "joint"), marks(found, "rod")
    assert len(pins) == 4 and len(rods) == 3  # the crank to the coupler, two to the pin
    ends = [rod[:, 1] for rod in rods[1:]]
    assert np.allclose(ends[0], ends[1], atol=1e-12) and len(marks(found, "ground")) == 2
    assert any(np.array_equal(pin[:, 0], ends[0]) for pin in pins)


def test_loops_that_slide_have_rails_and_distances_rods():
    found = closed('joint = "point-on-line"\naxis = [1, 0]')
    (slide,) = marks(found, "slide")
    assert any(np.allclose(rod[:, 1], slide[:, 0]) for rod in marks(found, "rod"))
    rods = marks(closed('joint = "distance"\nlength = 0.2'), "rod")
    lengths = [np.linalg.norm(rod[:, 1] - rod[:, 0], axis=1) for rod in rods]
    assert len(rods) == 4 and any(np.allclose(x, 0.2, atol=1e-9) for x in lengths)


def test_a_rail_is_as_long_as_the_travel():
    found, run = drawn(scene("crane")), motion(scene("crane"))
    (rail,) = marks(found, "rail")
    assert np.allclose(rail[0], [[run.q[:, 0].min(), 5], [run.q[:, 0].max(), 5]])


def test_a_scene_in_space_that_stays_in_a_plane_is_drawn_there():
    assert drawn(scene("crane")).axes == "xz"
    assert drawn(scene("slung_load")).axes == "xyz"


def test_gravity_says_what_is_up():
    text = (OWN / "slung_load.toml").read_text()
    assert drawn(parse(text)).up == 2
    assert drawn(parse(text.replace('[0, 0, "-9.81"]', '[0, "-9.81", 0]'))).up == 1


def test_a_free_body_is_the_box_of_its_inertia():
    """The tumbling box has the edges a, b and c that its scene computes its inertia from."""
    (box,) = marks(drawn(scene("tumbling_box")), "inertia")
    halves = np.linalg.norm(box[:, 1:] - box[:, :1], axis=2)
    assert np.allclose(np.sort(halves, axis=1), [[0.05, 0.1, 0.15]])


def test_wheels_are_drawn_where_no_line_shows_how_they_turn():
    assert len(marks(drawn(scene("satellite")), "inertia")) == 3
    assert len(marks(drawn(scene("slung_load")), "inertia")) == 1  # not the load on its rope


TWINS = """
eomc = 1
name = "twins"
gravity = [0, 0, -9.81]
[coordinates]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
a = { unit = "rad" }
b = { unit = "rad" }
c = { unit = "rad" }
[[body]]
name = "dummy"
joint = "free"
coordinates = ["x", "y", "z", "a", "b", "c"]
mass = 1e-6
inertia = [1e-6, 1e-6, 1e-6]
[[body]]
name = "left"
parent = "dummy"
joint = "fixed"
offset = [0, 0.3, 0]
rotation = [["x", "pi/2"]]
mass = 1.0
inertia = [0.02, 0.03, 0.04]
[[body]]
name = "right"
parent = "dummy"
joint = "fixed"
offset = [0, -0.3, 0]
mass = 1.0
inertia = [0.02, 0.03, 0.04]
"""


def test_bodies_that_are_fixed_together_have_one_box():
    """A frame with hardly a mass, as robot files have it, has none that is metres wide."""
    (box,) = marks(drawn(parse(TWINS)), "inertia")
    halves = np.sort(np.linalg.norm(box[:, 1:] - box[:, :1], axis=2), axis=1)
    # the left one's y is along the right one's z; Steiner's parts are of x and z
    moments = np.array([0.04 + 2 * 0.3**2, 0.07, 0.07 + 2 * 0.3**2])
    known = np.sort(np.sqrt(3 * (moments.sum() / 2 - moments) / 2))
    assert np.allclose(halves, known, rtol=1e-4)
    assert np.allclose(box[:, 0], motion(parse(TWINS)).q[:, :3], atol=1e-5)


@pytest.mark.parametrize("name", ["arm", *ROBOTS])
def test_a_robot_has_its_joints_and_lines_to_all_of_it(name):
    """The joints stand where another kinematics has them; what slides hangs on its rail."""
    made = scene(name)
    found, run = drawn(made), motion(made)
    poses = Kinematics(made, made.assembly).poses(run.q[0])
    turning = [poses[b.name][0] for b in made.assembly.bodies if b.joint == "revolute"]
    shown = np.array([joint[0, 0] for joint in marks(found, "joint")])
    apart = np.linalg.norm(np.array(turning)[:, None] - shown, axis=2)
    assert apart.min(axis=0).max() < 1e-12 and apart.min(axis=1).max() < 1e-12
    assert len(marks(found, "ground")) == (name not in FREE)
    hung = {k: {k} for m in found.marks for k in m.points}
    for mark in found.marks:
        if mark.kind in ("rod", "arm"):
            joined = set().union(*(hung[k] for k in mark.points))
            hung |= dict.fromkeys(joined, joined)
    sliding = sum(b.joint == "prismatic" for b in made.assembly.bodies)
    ends = {
        frozenset(hung[m.points[0]]) for m in found.marks if m.kind in ("joint", "mass", "point")
    }
    assert len(ends) == 1 + sliding


def test_springs_and_dampers_are_where_they_are_declared():
    found = drawn(scene("suspension"))
    kinds = [m.kind for m in found.marks]
    assert [kinds.count(k) for k in ("spring", "damper", "spiral")] == [1, 1, 1]
    (spring,), (damper,) = marks(found, "spring"), marks(found, "damper")
    assert np.array_equal(spring, damper)
    assert [m.kind for m in drawn(scene("crane")).marks].count("spring") == 1  # along its slide


def test_without_a_picture_only_paths_of_named_points_are_drawn():
    """A ball on a beam has no rod."""
    text = (OWN / "ball_beam.toml").read_text()
    made = from_scene(parse(text[: text.index("[picture]")]))
    run = motion(made.scene)
    found = draw_mechanism(made, run.t, run.q)
    assert [m.kind for m in found.marks] == ["dot"]
    assert [p.name for p in found.paths] == ["(x_b, y_b)"] and found.labels == ("x_b", "y_b")
    assert found.unit == "m"


def test_what_jumps_set_is_drawn_as_it_is_then():
    x = symbol("x")
    made = System.make(
        "reach", [x], "m*x_dot**2/2", parameters={"m": 1, "l": 2},
        events={"grows": {"when": "t - 1", "action": "jump", "l": "3*l"}},
        picture={"lines": [[["x", 0], ["x", "l"]]]},
    )  # fmt: skip
    found = draw_mechanism(made, np.array([0.0, 2.0]), np.array([[0.0, 2.0], [0.5, 6.0]]))
    assert sorted(found.points[:, :, 1].tolist()) == [[0, 2], [0, 6]]


def test_what_has_no_place_is_not_drawn():
    r, theta = symbol("r"), symbol("theta")
    made = System.make("polar", [r, theta], symbol("r_dot") ** 2 + symbol("theta_dot") ** 2)
    assert draw_mechanism(made, np.zeros(1), np.ones((1, 2))) is None
    pair = {symbol("x"): r * sympy.cos(theta), symbol("y"): symbol("r_dot")}
    named = System.make("rates", [r, theta], made.kinetic, definitions=pair)
    assert draw_mechanism(named, np.zeros(1), np.ones((1, 2))) is None  # y is no place


def test_parameters_of_the_run_count():
    made = from_scene(scene("simple_pendulum")).with_parameters({"l": 3.0})
    found = draw_mechanism(made, np.zeros(1), np.zeros((1, 1)))
    assert np.allclose(marks(found, "line")[0][0, 1], [0, -3])


def test_what_has_no_value_is_left_out():
    made = scene("kepler_orbit")
    text = (SCENES / "kepler_orbit.toml").read_text().replace('["x", "y"]', '["sqrt(x)", "y"]')
    found = draw_mechanism(system(parse(text)), np.zeros(2), np.array([[-1.0, 0], [4, 1]]))
    assert np.isnan(found.points[0]).any() and np.allclose(found.points[1].max(axis=0), [2, 1])
    assert made.picture


def test_far_travel_is_told():
    made = scene("slung_load")
    run = motion(made)
    assert not draw_mechanism(system(made), run.t, run.q).travels
    run.q[:, 0] += 100 * run.t
    assert draw_mechanism(system(made), run.t, run.q).travels


if __name__ == "__main__":
    golden = {name: summary(name) for name in DRAWN}
    text = ",\n".join(f'"{name}": {json.dumps(golden[name])}' for name in golden)
    GOLDEN.write_text("{\n" + text + "\n}\n")
