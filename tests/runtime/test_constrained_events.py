"""Events under constraints: what a jump's own formulas leave, the rows then move."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from compilers import STRICT, compiled

import eomc
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "constrained_events"
# x hits a wall and goes back half as fast, and y with it
PULLEY = """eomc = 1
name = "pulley"
[coordinates]
x = { rate = 2 }
y = { friction = "rub" }
[parameters]
rub = 0
[inputs]
push = {}
[energy]
kinetic = "3*x_dot**2/2 + y_dot**2/2"
[forces]
x = "push"
[constraints]
rope = "x + y"
[[event]]
name = "wall"
when = "x - 1"
direction = "rising"
action = "jump"
x_dot = "-x_dot/2"
[[event]]
name = "turn"
when = "y_dot"
[[event]]
name = "behind"
when = "x - push/4"
direction = "falling"
[[event]]
name = "stroke"
when = "t - 3.5"
action = "jump"
x_dot = "-3"
[run]
friction = "stick"
duration = 4
"""
# a slide that a crank moves to and fro, and that has no force on the crank at its ends
YOKE = """eomc = 1
name = "yoke"
[coordinates]
s   = { friction = "rub" }
phi = { start = "pi/2", rate = 3, friction = "bearing" }
[parameters]
r = 0.5
bearing = 0
rub = 1
[inputs]
torque = {}
[energy]
kinetic = "phi_dot**2/2 + 3*s_dot**2/2"
[forces]
phi = "torque"
[constraints]
pin = "s - r*cos(phi)"
[[event]]
name = "middle"
when = "phi - 3*pi/2"
action = "stop"
[run]
friction = "stick"
tolerance = 1e-11
duration = 4
batch = true
"""
# two bobs on rods in x and y; the lower one hits a wall, then both are stopped where they can't be
BOBS = """eomc = 1
name = "bobs"
[coordinates]
x1 = { start = 0.6, rate = 0.8 }
y1 = { start = -0.8, rate = 0.6 }
x2 = { start = 1.2, rate = 2.0 }
y2 = { start = -1.6, rate = 1.5 }
[parameters]
m1 = 1.0
m2 = 2.0
e = 0.8
[energy]
kinetic = "m1*(x1_dot**2 + y1_dot**2)/2 + m2*(x2_dot**2 + y2_dot**2)/2"
potential = "9.81*(m1*y1 + m2*y2)"
[constraints]
upper = "x1**2 + y1**2 - 1"
lower = "(x2 - x1)**2 + (y2 - y1)**2 - 1"
[[event]]
name = "wall"
when = "x2 - 1.3"
direction = "rising"
action = "jump"
x2_dot = "-e*x2_dot"
[[event]]
name = "contradicts"
when = "t - 0.5"
action = "jump"
x1_dot = 1
y1_dot = 1
x2_dot = 1
y2_dot = -1
[run]
tolerance = 1e-11
duration = 0.6
"""


@pytest.fixture(scope="module")
def yoke() -> ModuleType:
    return eomc.load(from_scene(parse(YOKE, "yoke.toml")), BUILDS)


@pytest.fixture(scope="module")
def pulley() -> ModuleType:
    return eomc.load(from_scene(parse(PULLEY, "pulley.toml")), BUILDS)


def test_events_are_on_the_side_where_the_rows_leave_them(pulley: ModuleType) -> None:
    """y was thought to go on as before the jump, so where it turned was not seen."""
    run = pulley.simulate(u=2.0)
    speed = math.sqrt(5.0)
    hit = 2 * (speed - 2)
    assert run.events["wall"].t[0] == pytest.approx(hit, abs=1e-12)
    assert run.events["turn"].t[0] == pytest.approx(hit + speed, abs=1e-12)


def test_what_the_rows_turn_slides_the_other_way(pulley: ModuleType) -> None:
    """Friction went on as before the jump, and drove what it should have braked."""
    run = pulley.simulate(params={"rub": 4.0}, duration=3.0)
    hit = 2 - math.sqrt(2.0)
    assert run.events["wall"].t == pytest.approx([hit], abs=1e-12)
    speed = (2 - hit) / 2
    assert run.events["y_stops"].t == pytest.approx([hit + speed], abs=1e-12)
    assert run["x"][-1] == pytest.approx(1 - speed**2 / 2, abs=1e-12)
    assert run["y_slides"][-1] == 0


def test_what_a_jump_sets_stays_and_the_rest_follows_by_one_impulse() -> None:
    """It was shared with the rest: x2 went back slower than the scene said."""
    bobs = eomc.load(from_scene(parse(BOBS, "bobs.toml")), BUILDS)
    run = bobs.simulate()
    before, behind = np.flatnonzero(run.t == run.events["wall"].t[0])
    q, one, other = run.q[before], run.qd[before], run.qd[behind]
    assert other[2] == pytest.approx(-0.8 * one[2], rel=1e-14)
    A = np.vstack([bobs.constraint_jacobian(q), [0, 0, 1, 0]])  # rods, and the wall
    impulse = bobs.D(q) @ (other - one)
    along = A.T @ np.linalg.lstsq(A.T, impulse, rcond=None)[0]
    assert impulse == pytest.approx(along, abs=1e-12) and np.linalg.norm(impulse) > 1
    before, behind = np.flatnonzero(run.t == 0.5)
    D, A, asked = bobs.D(q := run.q[before]), bobs.constraint_jacobian(q), np.array([1, 1, 1, -1])
    share = np.linalg.solve(A @ np.linalg.solve(D, A.T), A @ asked)
    assert run.qd[behind] == pytest.approx(asked - np.linalg.solve(D, A.T @ share), abs=1e-12)
    assert run.status == "ok" and max(abs(run.constraints["lower"])) < 1e-13


def test_inputs_that_grow_in_a_table_move_what_stuck(pulley: ModuleType) -> None:
    """It stuck for ever: that a force had jumped over what friction holds was no crossing."""
    how = {"params": {"rub": 1.0}, "control_period": 0.5, "duration": 1.5}
    run = pulley.simulate([0, 0], [0, 0], u=[[0.0], [3.0], [3.0]], **how)
    assert run.events["y_slips"].t.tolist() == [0.5]
    assert run["x"][-1] == pytest.approx(0.25, abs=1e-12)


def test_what_an_input_carries_over_zero_may_cross_it_later(pulley: ModuleType) -> None:
    """The event was thought to be still on the side where it was by the input before."""
    run = pulley.simulate([0, 0], [0, 0], u=[[4.0]] + 7 * [[-4.0]], control_period=0.5)
    at = 1 + math.sqrt(0.25 + 2 * 1.125)
    assert run.events["behind"].t == pytest.approx([at], abs=1e-12)


def test_what_turns_at_a_dead_point_does_not_lock_the_rest(yoke: ModuleType) -> None:
    """The row that held the slide came before the pin, which was left out in its place."""
    run = yoke.simulate()
    assert run.stopped == "middle" and len(run.events["s_stops"]) == 1
    mass = 1 + 3 * 0.5**2
    assert run["phi_dot"][-1] == pytest.approx(math.sqrt(9 - 2 * 0.5 * 2 / mass), rel=1e-11)


@pytest.mark.parametrize("at", [0.3, 0.8, 1.2, 2.0, 2.9])
@pytest.mark.parametrize("how", [{"duration": 50.0}, {"h": 0.005, "steps": 800}])
def test_a_joint_that_another_holds_rests(yoke: ModuleType, at: float, how: dict) -> None:
    """By rounding it stopped and slipped for ever, until its jumps were said to accumulate.

    In fixed steps velocities are compared with what accelerations make of them.
    """
    start = yoke.project([0, at, 0, 0], [0, 0, 0, 0], fixed=["phi"])
    for bearing, rub, torque in ((0.1, 10.0, 1.0), (2.0, 1e-3, 1.0), (0.0, 9.0, -0.7)):
        params = {"bearing": bearing, "rub": rub}
        run = yoke.simulate(*start, params=params, u=torque, **how)
        assert run.status == "ok" and run["phi"][-1] == pytest.approx(at, abs=1e-14)
        assert len(run.events["phi_stops"]) <= 1 and len(run.events["s_stops"]) <= 1


def test_what_stopped_before_a_rest_may_stop_behind_it(yoke: ModuleType) -> None:
    """As it had not moved in between, its stops were said to accumulate."""
    for at, table in ((2.0, (0, 0, 3, 0, -3)), (1.0, (1, -1, 4, 0, 2))):
        u = [[float(torque)] for torque in table]
        how = {"params": {"bearing": 0.01, "rub": 3.0}, "control_period": 1.0, "duration": 5.0}
        assert yoke.simulate([0, at], [0, 0.5], u=u, **how).status == "ok"


def test_a_stroke_moves_what_sticks(pulley: ModuleType) -> None:
    """What was held by 1 N took up all of it."""
    run = pulley.simulate([0, 0], [0, 0], params={"rub": 1.0}, duration=4.0)
    assert run.events["y_slips"].t.tolist() == [] and run["y_slides"][-1] == 1
    assert run["x"][-1] == pytest.approx(-3 * 0.5 + 0.5 * 0.25 / 4, abs=1e-12)


def test_a_start_whose_rates_the_rows_give_slides(yoke: ModuleType) -> None:
    """The slide was thought to stick, as no rate of it was given, and the start was refused."""
    run = yoke.simulate(q0=[0, 1.0], qd0=[0, -2.0], duration=0.1)
    assert run["s_dot"][0] == pytest.approx(math.sin(1.0), rel=1e-14)
    assert run.q[0, 2:].tolist() == [1, -1] and run.status == "ok"
    many = yoke.simulate_batch(q0=[[0, 1.0]], qd0=[[0, -2.0]], duration=0.1, tol=1e-11)
    assert many.q[0, -1].tolist() == run.q[-1].tolist()
    with pytest.raises(yoke.MotionError, match="with s, phi as given"):
        yoke.project([1, 1, 1, 1], [0, 0, 0, 0], fixed=["s", "phi", "s_slides"])


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_c_of_joints_that_stick_gives_no_warning(tmp_path: Path, real: str) -> None:
    text = YOKE.replace("tolerance = 1e-11", f'tolerance = 1e-5\nreal = "{real}"')
    made = eomc.sources(from_scene(parse(text, "yoke.toml"))).files
    for name in ("yoke.h", "yoke.c"):
        (tmp_path / name).write_text(made[name], encoding="utf-8")
    compiled("cc", *STRICT, "-c", "yoke.c", cwd=tmp_path)
