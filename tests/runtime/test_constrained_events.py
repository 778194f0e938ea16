"""Events under constraints: a jump map sets some velocities, constraint impulses the rest."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.compilation import STRICT, compiled

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "constrained_events"
# x hits a wall and rebounds at half its speed, and y with it
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
tolerance = 1e-9
friction = "stick"
duration = 4
"""
# a slide that a crank moves to and fro; at its ends it exerts no force on the crank
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
# two bobs on rods, in x and y; the lower hits a wall, later a jump contradicts the constraints
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


def test_event_functions_use_the_state_after_projection(pulley: ModuleType) -> None:
    """Regression: y was extrapolated from before the jump, so its turning point was missed."""
    run = pulley.simulate(u=2.0)
    speed = math.sqrt(5.0)
    hit_time = 2 * (speed - 2)
    assert run.events["wall"].t[0] == pytest.approx(hit_time, abs=1e-12)
    assert run.events["turn"].t[0] == pytest.approx(hit_time + speed, abs=1e-12)


def test_friction_reverses_where_constraints_reverse_a_velocity(pulley: ModuleType) -> None:
    """Regression: friction kept its direction across the jump and drove the motion."""
    run = pulley.simulate(params={"rub": 4.0}, duration=3.0)
    hit_time = 2 - math.sqrt(2.0)
    assert run.events["wall"].t == pytest.approx([hit_time], abs=1e-12)
    speed = (2 - hit_time) / 2
    assert run.events["y_stops"].t == pytest.approx([hit_time + speed], abs=1e-12)
    assert run["x"][-1] == pytest.approx(1 - speed**2 / 2, abs=1e-12)
    assert run["y_slides"][-1] == 0


def test_velocity_set_by_a_jump_stays_and_the_rest_follows_by_one_impulse() -> None:
    """Regression: the impulse also changed x2_dot, which rebounded slower than the scene says."""
    bobs = eomc.load(from_scene(parse(BOBS, "bobs.toml")), BUILDS)
    run = bobs.simulate()
    row_before, row_after = np.flatnonzero(run.t == run.events["wall"].t[0])
    q, qd_before, qd_after = run.q[row_before], run.qd[row_before], run.qd[row_after]
    assert qd_after[2] == pytest.approx(-0.8 * qd_before[2], rel=1e-14)
    A = np.vstack([bobs.constraint_jacobian(q), [0, 0, 1, 0]])  # rods and wall
    impulse = bobs.D(q) @ (qd_after - qd_before)
    expected = A.T @ np.linalg.lstsq(A.T, impulse, rcond=None)[0]
    assert impulse == pytest.approx(expected, abs=1e-12) and np.linalg.norm(impulse) > 1
    row_before, row_after = np.flatnonzero(run.t == 0.5)
    D, A, qd_jump = (
        bobs.D(q := run.q[row_before]),
        bobs.constraint_jacobian(q),
        np.array([1, 1, 1, -1]),
    )
    multipliers = np.linalg.solve(A @ np.linalg.solve(D, A.T), A @ qd_jump)
    assert run.qd[row_after] == pytest.approx(
        qd_jump - np.linalg.solve(D, A.T @ multipliers), abs=1e-12
    )
    assert run.status == "ok" and max(abs(run.constraints["lower"])) < 1e-13


def test_sudden_input_moves_a_sticking_body(pulley: ModuleType) -> None:
    """Regression: it stuck for ever: a force that steps past the friction limit is no crossing."""
    options = {"params": {"rub": 1.0}, "control_period": 0.5, "duration": 1.5}
    run = pulley.simulate([0, 0], [0, 0], u=[[0.0], [3.0], [3.0]], **options)
    assert run.events["y_slips"].t.tolist() == [0.5]
    assert run["x"][-1] == pytest.approx(0.25, abs=1e-12)


def test_event_function_crossed_by_an_input_step_can_cross_again(pulley: ModuleType) -> None:
    """Regression: the side of the event function was that of the previous input."""
    run = pulley.simulate([0, 0], [0, 0], u=[[4.0]] + 7 * [[-4.0]], control_period=0.5)
    expected = 1 + math.sqrt(0.25 + 2 * 1.125)
    assert run.events["behind"].t == pytest.approx([expected], abs=1e-12)


def test_sticking_at_a_dead_point_does_not_lock_the_mechanism(yoke: ModuleType) -> None:
    """Regression: the constraint of the sticking slide displaced that of the pin."""
    run = yoke.simulate()
    assert run.stopped == "middle" and len(run.events["s_stops"]) == 1
    mass = 1 + 3 * 0.5**2
    assert run["phi_dot"][-1] == pytest.approx(math.sqrt(9 - 2 * 0.5 * 2 / mass), rel=1e-11)


@pytest.mark.parametrize("angle", [0.3, 0.8, 1.2, 2.0, 2.9])
@pytest.mark.parametrize("options", [{"duration": 50.0}, {"h": 0.005, "steps": 800}])
def test_joint_balanced_by_another_stays_at_rest(
    yoke: ModuleType, angle: float, options: dict
) -> None:
    """Regression: by rounding it stopped and slipped until its jumps seemed to accumulate.

    Fixed steps compare velocities with the change that accelerations make.
    """
    start = yoke.project([0, angle, 0, 0], [0, 0, 0, 0], fixed=["phi"])
    for bearing, rub, torque in ((0.1, 10.0, 1.0), (2.0, 1e-3, 1.0), (0.0, 9.0, -0.7)):
        params = {"bearing": bearing, "rub": rub}
        run = yoke.simulate(*start, params=params, u=torque, **options)
        assert run.status == "ok" and run["phi"][-1] == pytest.approx(angle, abs=1e-14)
        assert len(run.events["phi_stops"]) <= 1 and len(run.events["s_stops"]) <= 1


def test_joint_can_stop_before_and_after_a_rest(yoke: ModuleType) -> None:
    """Regression: since it had not moved in between, its stops seemed to accumulate."""
    for angle, table in ((2.0, (0, 0, 3, 0, -3)), (1.0, (1, -1, 4, 0, 2))):
        u = [[float(torque)] for torque in table]
        options = {"params": {"bearing": 0.01, "rub": 3.0}, "control_period": 1.0, "duration": 5.0}
        assert yoke.simulate([0, angle], [0, 0.5], u=u, **options).status == "ok"


def test_jump_moves_a_sticking_body(pulley: ModuleType) -> None:
    """Regression: the friction force of 1 N absorbed the whole impulse."""
    run = pulley.simulate([0, 0], [0, 0], params={"rub": 1.0}, duration=4.0)
    assert run.events["y_slips"].t.tolist() == [] and run["y_slides"][-1] == 1
    assert run["x"][-1] == pytest.approx(-3 * 0.5 + 0.5 * 0.25 / 4, abs=1e-12)


def test_start_whose_velocities_follow_from_constraints_slides(yoke: ModuleType) -> None:
    """Regression: without an initial velocity of its own the slide was taken to stick."""
    run = yoke.simulate(q0=[0, 1.0], qd0=[0, -2.0], duration=0.1)
    assert run["s_dot"][0] == pytest.approx(math.sin(1.0), rel=1e-14)
    assert run.q[0, 2:].tolist() == [1, -1] and run.status == "ok"
    batch = yoke.simulate_batch(q0=[[0, 1.0]], qd0=[[0, -2.0]], duration=0.1, tol=1e-11)
    assert batch.q[0, -1].tolist() == run.q[-1].tolist()
    with pytest.raises(yoke.MotionError, match="with s, phi as given"):
        yoke.project([1, 1, 1, 1], [0, 0, 0, 0], fixed=["s", "phi", "s_slides"])


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_c_of_sticking_joints_compiles_without_warnings(tmp_path: Path, real: str) -> None:
    text = YOKE.replace("tolerance = 1e-11", f'tolerance = 1e-5\nreal = "{real}"')
    sources = eomc.sources(from_scene(parse(text, "yoke.toml"))).files
    for name in ("yoke.h", "yoke.c"):
        (tmp_path / name).write_text(sources[name], encoding="utf-8")
    compiled("cc", *STRICT, "-c", "yoke.c", cwd=tmp_path)
