"""Drawings show what the scene declares, at the positions that its mechanics computes."""

import json
from pathlib import Path

import numpy as np
import pytest
import sympy
from report.pictures import FREE, OWN, ROBOTS, SCENES, chain, humanoid, motion, scene, system
from scipy.spatial.transform import Rotation

from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene, symbol
from eomc.report.drawing import draw_mechanism
from eomc.scene import formulas
from eomc.scene.joints import JOINTS
from eomc.scene.read import parse

GOLDEN = Path(__file__).parent / "drawings.json"
DRAWN = [
    *sorted(p.stem for p in SCENES.glob("*.toml")),
    *sorted(p.stem for p in OWN.iterdir()),
]


def draw(model, rows=121):
    run = motion(model, rows=rows)
    return draw_mechanism(system(model), run.t, run.q)


def marks(drawing, kind):
    return [drawing.points[:, m.points] for m in drawing.marks if m.kind == kind]


def summary(name):
    """Return marks and paths in numbers, at the initial and at a later time."""
    drawing = draw(scene(name), 3)
    rows = [
        [mark.kind, *np.round(drawing.points[row][list(mark.points)], 4).tolist()]
        for row in (0, 2)
        for mark in drawing.marks
    ]
    return {"axes": drawing.axes, "marks": rows, "paths": [p.name for p in drawing.paths]}


@pytest.mark.parametrize("name", DRAWN)
def test_drawings_agree_with_accepted_ones(name):
    """Each was inspected by eye when it was accepted: python tests/report/test_drawing.py."""
    accepted, current = json.loads(GOLDEN.read_text())[name], summary(name)
    assert current["axes"] == accepted["axes"] and current["paths"] == accepted["paths"]
    assert [m[0] for m in current["marks"]] == [m[0] for m in accepted["marks"]]
    for mark, accepted_mark in zip(current["marks"], accepted["marks"], strict=True):
        assert np.allclose(mark[1:], accepted_mark[1:], atol=2e-4), mark[0]


def poses_by_rotation_vectors(model, q):
    """Return position and rotation of each body at time 0, computed by SciPy for one state."""
    values = {p.name: p.value for p in (*model.constants, *model.parameters)}
    values |= dict(zip([c.name for c in model.coordinates], map(float, q), strict=True)) | {"t": 0}
    definitions, poses = dict(model.definitions), {"world": (np.zeros(3), Rotation.identity())}

    def number(formula):
        return formulas.evaluate(formula, formulas.NUMERIC, lookup)

    def lookup(name):
        return values[name] if name in values else number(definitions[name])

    def turned(body):
        letters = "".join(turn.axis for turn in body.rotation).upper()
        angles = [number(turn.angle) for turn in body.rotation]
        return Rotation.from_euler(letters, angles) if letters else Rotation.identity()

    for body in (b for b in model.assembly.bodies if b.joint):
        at, R = poses[body.parent]
        at, R = at + R.apply([number(x) for x in body.offset]), R * turned(body)
        subspaces = JOINTS[body.joint].subspaces(body.axes, 0.0)
        for (axis, angular, linear), by in zip(subspaces, body.coordinates, strict=True):
            unit = np.array(axis) / np.linalg.norm(axis)
            at = at + R.apply(linear * number(by) * unit)
            R = R * Rotation.from_rotvec(angular * number(by) * unit)
        poses[body.name] = at, R
        center = at + R.apply([number(x) for x in body.center])
        values |= {f"{body.name}_{x}": c for x, c in zip("xyz", center, strict=True)}
    for body in (b for b in model.assembly.bodies if not b.joint):
        poses[body.name] = np.array([number(x) for x in body.position]), turned(body)
    return poses, number


@pytest.mark.parametrize("model", [chain, humanoid, *(lambda n=n: scene(n) for n in ("satellite",
    "slung_load", "crane", "suspension", "tumbling_box", "chain"))])  # fmt: skip
def test_frames_agree_with_other_kinematics(model):
    model = model()
    run = motion(model, rows=3)
    drawing = draw_mechanism(system(model), run.t, run.q)
    axis_indices = ["xyz".index(axis) for axis in drawing.axes]
    for row in range(3):
        poses, number = poses_by_rotation_vectors(model, run.q[row])
        masses = [drawing.points[row, m.points[0]] for m in drawing.marks if m.kind == "mass"]
        for body in model.assembly.bodies:
            at, R = poses[body.name]
            if number(body.mass):
                center = (at + R.apply([number(x) for x in body.center]))[axis_indices]
                assert min(np.abs(m - center).max() for m in masses) < 1e-12, body.name


def test_rod_ends_at_the_centre_of_mass_without_a_picture():
    """The pole of cartpole_bodies without its picture extends only to its centre of mass."""
    text = (SCENES / "cartpole_bodies.toml").read_text()
    model = parse(text[: text.index("[[point]]")])
    drawing = draw(model)
    assert {m.kind for m in drawing.marks} == {"rail", "arm", "joint", "slide", "mass"}
    (arm,) = marks(drawing, "arm")
    assert np.allclose(np.linalg.norm(arm[:, 0] - arm[:, 1], axis=1), 1.0)  # l/2
    assert not marks(drawing, "rod")


def drawing_of_closed_loop(joint):
    """Draw the assembled four-bar without its picture, closed by another joint."""
    text = (SCENES / "four_bar.toml").read_text()
    text = text[: text.index("[picture]")] + text[text.index("[run]") :]
    model = assembled(from_scene(parse(text.replace('joint  = "revolute"', joint))))
    return draw_mechanism(model, np.zeros(1), np.array([[c.start for c in model.coordinates]]))


def test_loop_is_drawn_as_a_joint_connected_to_its_bodies():
    drawing = drawing_of_closed_loop('joint  = "revolute"')
    pins, rods = marks(drawing, "joint"), marks(drawing, "rod")
    assert len(pins) == 4 and len(rods) == 3  # one from the crank to the coupler, two to the pin
    ends = [rod[:, 1] for rod in rods[1:]]
    assert np.allclose(ends[0], ends[1], atol=1e-12) and len(marks(drawing, "ground")) == 2
    assert any(np.array_equal(pin[:, 0], ends[0]) for pin in pins)


def test_sliding_loops_have_rails_and_distances_have_rods():
    drawing = drawing_of_closed_loop('joint = "point-on-line"\naxis = [1, 0]')
    (slide,) = marks(drawing, "slide")
    assert any(np.allclose(rod[:, 1], slide[:, 0]) for rod in marks(drawing, "rod"))
    rods = marks(drawing_of_closed_loop('joint = "distance"\nlength = 0.2'), "rod")
    lengths = [np.linalg.norm(rod[:, 1] - rod[:, 0], axis=1) for rod in rods]
    assert len(rods) == 4 and any(np.allclose(x, 0.2, atol=1e-9) for x in lengths)


def test_rail_is_as_long_as_the_travel():
    drawing, run = draw(scene("crane")), motion(scene("crane"))
    (rail,) = marks(drawing, "rail")
    assert np.allclose(rail[0], [[run.q[:, 0].min(), 5], [run.q[:, 0].max(), 5]])


def test_planar_motion_in_space_is_drawn_in_its_plane():
    assert draw(scene("crane")).axes == "xz"
    assert draw(scene("slung_load")).axes == "xyz"


def test_gravity_determines_the_vertical():
    text = (OWN / "slung_load.toml").read_text()
    assert draw(parse(text)).up == 2
    assert draw(parse(text.replace('[0, 0, "-9.81"]', '[0, "-9.81", 0]'))).up == 1


def test_free_body_is_drawn_as_the_box_of_its_inertia():
    """The tumbling box has the edges a, b and c from which its scene computes its inertia."""
    (box,) = marks(draw(scene("tumbling_box")), "inertia")
    halves = np.linalg.norm(box[:, 1:] - box[:, :1], axis=2)
    assert np.allclose(np.sort(halves, axis=1), [[0.05, 0.1, 0.15]])


def test_wheels_are_drawn_where_no_line_shows_their_rotation():
    assert len(marks(draw(scene("satellite")), "inertia")) == 3
    assert len(marks(draw(scene("slung_load")), "inertia")) == 1  # not the load on its rope


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


def test_rigidly_connected_bodies_have_one_box():
    """A frame of nearly no mass, as in robot files, has no box some metres wide."""
    (box,) = marks(draw(parse(TWINS)), "inertia")
    halves = np.sort(np.linalg.norm(box[:, 1:] - box[:, :1], axis=2), axis=1)
    # the y axis of the left body lies along the z axis of the right one; parallel-axis terms are of
    # x and z
    moments = np.array([0.04 + 2 * 0.3**2, 0.07, 0.07 + 2 * 0.3**2])
    known = np.sort(np.sqrt(3 * (moments.sum() / 2 - moments) / 2))
    assert np.allclose(halves, known, rtol=1e-4)
    assert np.allclose(box[:, 0], motion(parse(TWINS)).q[:, :3], atol=1e-5)


@pytest.mark.parametrize("name", ["arm", *ROBOTS])
def test_robot_has_its_joints_and_lines_to_all_bodies(name):
    """Joints are at the positions of another kinematics; sliding bodies are on their rails."""
    model = scene(name)
    drawing, run = draw(model), motion(model)
    poses, _ = poses_by_rotation_vectors(model, run.q[0])
    turning = [poses[b.name][0] for b in model.assembly.bodies if b.joint == "revolute"]
    shown = np.array([joint[0, 0] for joint in marks(drawing, "joint")])
    distances = np.linalg.norm(np.array(turning)[:, None] - shown, axis=2)
    assert distances.min(axis=0).max() < 1e-12 and distances.min(axis=1).max() < 1e-12
    assert len(marks(drawing, "ground")) == (name not in FREE)
    hung = {k: {k} for m in drawing.marks for k in m.points}
    for mark in drawing.marks:
        if mark.kind in ("rod", "arm"):
            joined = set().union(*(hung[k] for k in mark.points))
            hung |= dict.fromkeys(joined, joined)
    sliding = sum(b.joint == "prismatic" for b in model.assembly.bodies)
    ends = {
        frozenset(hung[m.points[0]]) for m in drawing.marks if m.kind in ("joint", "mass", "point")
    }
    assert len(ends) == 1 + sliding


def test_springs_and_dampers_are_drawn_where_declared():
    drawing = draw(scene("suspension"))
    kinds = [m.kind for m in drawing.marks]
    assert [kinds.count(k) for k in ("spring", "damper", "spiral")] == [1, 1, 1]
    (spring,), (damper,) = marks(drawing, "spring"), marks(drawing, "damper")
    assert np.array_equal(spring, damper)
    assert [m.kind for m in draw(scene("crane")).marks].count("spring") == 1  # along its slide


def test_without_a_picture_only_paths_of_named_points_are_drawn():
    """A ball on a beam has no rod."""
    text = (OWN / "ball_beam.toml").read_text()
    model = from_scene(parse(text[: text.index("[picture]")]))
    run = motion(model.scene)
    drawing = draw_mechanism(model, run.t, run.q)
    assert [m.kind for m in drawing.marks] == ["dot"]
    assert [p.name for p in drawing.paths] == ["(x_b, y_b)"] and drawing.labels == ("x_b", "y_b")
    assert drawing.unit == "m"


def test_values_set_by_jumps_are_drawn_as_of_their_time():
    x = symbol("x")
    model = System.make(
        "reach", [x], "m*x_dot**2/2", parameters={"m": 1, "l": 2},
        events={"grows": {"when": "t - 1", "action": "jump", "l": "3*l"}},
        picture={"lines": [[["x", 0], ["x", "l"]]]},
    )  # fmt: skip
    drawing = draw_mechanism(model, np.array([0.0, 2.0]), np.array([[0.0, 2.0], [0.5, 6.0]]))
    assert sorted(drawing.points[:, :, 1].tolist()) == [[0, 2], [0, 6]]


def test_system_without_positions_is_not_drawn():
    r, theta = symbol("r"), symbol("theta")
    model = System.make("polar", [r, theta], symbol("r_dot") ** 2 + symbol("theta_dot") ** 2)
    assert draw_mechanism(model, np.zeros(1), np.ones((1, 2))) is None
    pair = {symbol("x"): r * sympy.cos(theta), symbol("y"): symbol("r_dot")}
    with_definitions = System.make("rates", [r, theta], model.kinetic, definitions=pair)
    # y is not a position
    assert draw_mechanism(with_definitions, np.zeros(1), np.ones((1, 2))) is None


def test_parameters_of_the_run_are_used():
    model = from_scene(scene("simple_pendulum")).with_parameters({"l": 3.0})
    drawing = draw_mechanism(model, np.zeros(1), np.zeros((1, 1)))
    assert np.allclose(marks(drawing, "line")[0][0, 1], [0, -3])


def test_undefined_positions_are_omitted():
    model = scene("kepler_orbit")
    text = (SCENES / "kepler_orbit.toml").read_text().replace('["x", "y"]', '["sqrt(x)", "y"]')
    drawing = draw_mechanism(system(parse(text)), np.zeros(2), np.array([[-1.0, 0], [4, 1]]))
    assert np.isnan(drawing.points[0]).any() and np.allclose(drawing.points[1].max(axis=0), [2, 1])
    assert model.picture


def test_distant_travel_is_stated():
    model = scene("slung_load")
    run = motion(model)
    assert not draw_mechanism(system(model), run.t, run.q).travels
    run.q[:, 0] += 100 * run.t
    assert draw_mechanism(system(model), run.t, run.q).travels


if __name__ == "__main__":
    golden = {name: summary(name) for name in DRAWN}
    text = ",\n".join(f'"{name}": {json.dumps(golden[name])}' for name in golden)
    GOLDEN.write_text("{\n" + text + "\n}\n")
