"""Events in fixed steps, located by shorter steps of the same method; their runs when saved."""

from __future__ import annotations

import math
import pickle
import re
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.compilation import STRICT, compiled
from support.event_scenes import BALL, FREE, G, event, impacts
from support.session import Modules

import eomc
from eomc.model.system import from_scene
from eomc.runtime import trajectory
from eomc.runtime.package import model_of
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")
METHODS = '["rk4", "dp8"]'


@pytest.fixture(scope="module")
def ball(modules: Modules) -> ModuleType:
    """A ball that falls from 1 m, moves along at 1 m/s, and bounces off floor and wall."""
    text = BALL.replace("bouncing", "stepped_ball")
    return modules.unoptimised(text.replace("[run]", f"[run]\nmethod = {METHODS}\nh = 0.01"))


SWING = """eomc = 1
name = "stepped_swing"
[coordinates]
theta = { unit = "rad", start = 1.0 }
[inputs]
torque = { signal = "0.3*sin(t)" }
[energy]
kinetic = "theta_dot**2/2"
potential = "-9.81*cos(theta)"
[forces]
theta = "torque"
[[event]]
name = "below"
when = "theta"
[[event]]
name = "wall"
when = "theta + 0.8"
direction = "falling"
action = "jump"
theta_dot = "-0.9*theta_dot"
[run]
tolerance = 1e-9
h = 0.01
method = ["rk4", "dp8", "euler"]
batch = true
duration = 4.0
"""


@pytest.fixture(scope="module")
def swing(modules: Modules) -> ModuleType:
    """A driven pendulum next to a wall."""
    return modules.unoptimised(SWING)


@pytest.mark.parametrize("h", [0.01, 0.25, 2.0])
@pytest.mark.parametrize("method", ["rk4", "dp8"])
def test_ball_bounces_at_the_right_times(ball: ModuleType, h: float, method: str) -> None:
    """Both methods are exact for parabolas, whatever the step size."""
    run = ball.simulate(h=h, method=method, duration=2.0)
    assert run.events["impact"].t == pytest.approx(impacts(0.8, 3), rel=1e-13)
    tops = run.events["top"]
    times = impacts(0.8, 4)
    assert tops.t == pytest.approx((times[1:] + times[:-1]) / 2, rel=1e-12)
    assert tops.q[:, 1] == pytest.approx([0.8**2, 0.8**4, 0.8**6], rel=1e-12)
    assert run.method == method and run.h == h and run.status == "ok" and run.t[-1] == 2.0


@pytest.mark.parametrize("h", [0.001, 0.5])
def test_ball_comes_to_rest(ball: ModuleType, h: float) -> None:
    """The last flights take a millionth of a step."""
    with pytest.warns(RuntimeWarning, match="jumps follow one another ever sooner"):
        run = ball.simulate(h=h, duration=20.0)
    times = impacts(0.8, len(run.events["impact"]))
    assert len(times) >= 50 and np.max(np.abs(run.events["impact"].t - times) / times) < 1e-12
    assert run.status == "accumulated"
    assert run.limit == pytest.approx(9 * math.sqrt(2 / G), rel=1e-10)


def test_rows_are_multiples_of_h_and_both_sides_of_each_jump(ball: ModuleType) -> None:
    run = ball.simulate(h=0.1, duration=1.0, t0=0.7)
    (jump,) = run.events["impact"].t
    grid = 0.7 + 0.1 * np.arange(11)
    assert run.t.tolist() == np.sort([*grid, jump, jump]).tolist()
    row = run.t.tolist().index(jump)
    assert run.qd[row, 1] < 0 < run.qd[row + 1, 1] == pytest.approx(-0.8 * run.qd[row, 1])
    assert run.steps == 11 and run.q[row].tolist() == run.events["impact"].q[0].tolist()


def test_stop_event_ends_the_run(ball: ModuleType) -> None:
    run = ball.simulate(h=0.1, params={"far": 0.44}, duration=5.0)
    assert run.status == "ok" and run.stopped == "away"
    assert run.t[-1] == pytest.approx(0.44, abs=1e-15) == run.events["away"].t[0]
    at_multiple = ball.simulate(h=0.1, params={"far": 0.4}, duration=5.0)
    assert at_multiple.t[-1] == pytest.approx(0.4, abs=1e-15) and len(at_multiple) in (5, 6)


def test_steps_between_events_are_those_of_the_method(swing: ModuleType) -> None:
    for method in swing.methods:
        run = swing.simulate(method=method, duration=3.9)
        for k in range(len(run) - 1):
            if h := run.t[k + 1] - run.t[k]:
                q, qd = swing.step(run.q[k], run.qd[k], h, run.t[k], method=method)
                np.testing.assert_allclose(run.x[k + 1], [*q, *qd], rtol=1e-13, atol=1e-14)
    assert len(run.events["wall"]) == 2 and len(run.events["below"]) == 4


@pytest.mark.parametrize(
    ("method", "order", "h"), [("rk4", 4, 0.05), ("dp8", 8, 0.2), ("euler", 1, 0.01)]
)
def test_event_times_have_the_order_of_the_method(
    swing: ModuleType, method: str, order: int, h: float
) -> None:
    reference = swing.simulate(tol=1e-14, duration=4.0).events["wall"]
    errors = []
    for parts in (1, 2):
        events = swing.simulate(h=h / parts, method=method, duration=4.0).events["wall"]
        assert len(events) == len(reference) > 1
        errors.append(np.max(np.abs(events.t - reference.t)))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.9)
    assert errors[1] < (0.1 if order == 1 else 1e-6)


def test_undetected_events_change_nothing(
    swing: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = swing.simulate(q0=[0.5], h=0.01, duration=0.3)
    assert not any(map(len, run.events.values()))
    monkeypatch.setattr(model_of(swing).integrator, "ignores_events", True)
    without_events = swing.simulate(q0=[0.5], h=0.01, duration=0.3)
    np.testing.assert_allclose(run.x, without_events.x, rtol=1e-14, atol=1e-15)
    assert run.t.tolist() == without_events.t.tolist()


def law(t: float, q: Any, qd: Any) -> list[float]:
    return [-2 * q[0] - math.sin(3 * t) * (qd[0] > 0)]


def test_feedback_law_is_called_at_each_step_or_period(swing: ModuleType) -> None:
    """No call follows a jump: inputs are held constant until the next multiple of h."""
    call_times: list[float] = []

    def recording_law(t: float, q: Any, qd: Any) -> list[float]:
        call_times.append(t)
        return law(t, q, qd)

    with pytest.warns(RuntimeWarning, match="called before each step"):
        run = swing.simulate(h=0.01, u=recording_law, duration=2.0)
    assert len(run.events["wall"]) == 1
    assert call_times == pytest.approx(0.01 * np.arange(200), abs=1e-12)
    for period in (0.01, 0.05):
        run = swing.simulate(u=law, method="dp8", control_period=period, duration=2.0)
        adaptive = swing.simulate(u=law, tol=1e-12, control_period=period, duration=2.0)
        np.testing.assert_allclose(run.x[-1], adaptive.x[-1], atol=1e-10)
        table = run.u[np.searchsorted(run.t, period * np.arange(round(2 / period)) - 1e-9)]
        rows = swing.simulate(u=table, method="dp8", control_period=period, duration=2.0)
        assert np.array_equal(rows.x, run.x) and np.array_equal(rows.u, run.u)
    with pytest.raises(ValueError, match="3 rows for 200 steps"):
        swing.simulate(h=0.01, u=np.zeros((3, 1)), duration=2.0)


def test_rows_at_output_times_equal_interpolated_states(swing: ModuleType) -> None:
    run = swing.simulate(h=0.01, duration=2.0)
    times = np.array([0.0, 0.015, 0.83, 1.9999])
    rows = swing.simulate(h=0.01, times=times)
    assert rows.t.tolist() == times.tolist()
    q, qd = run(times)
    np.testing.assert_allclose(rows.q, q, atol=1e-15)
    np.testing.assert_allclose(rows.qd, qd, atol=1e-15)
    sparse = swing.simulate(h=0.01, duration=2.0, every=30)
    assert sparse.t == pytest.approx([*0.3 * np.arange(7), 2.0])
    np.testing.assert_allclose(sparse.q, run(sparse.t)[0], atol=1e-15)
    for conflicting in ({"every": 2}, {"steps": 3}):
        with pytest.raises(ValueError, match="times say where rows are"):
            swing.simulate(times=times, h=0.01, **conflicting)
    with pytest.raises(ValueError, match="out: events add rows"):
        swing.simulate(h=0.01, steps=3, out=(np.empty((4, 1)), np.empty((4, 1))))


def test_run_ends_with_a_row_at_its_stop_event(ball: ModuleType) -> None:
    run = ball.simulate(h=0.1, every=100, params={"far": 0.317}, duration=20.0)
    assert run.stopped == "away" and run.t == pytest.approx([0, 0.317])
    assert run.q[-1] == pytest.approx([0.317, 1 - G / 2 * 0.317**2])
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        run = ball.simulate(h=0.1, every=10, duration=20.0)
    assert run.t[-1] == pytest.approx(9 * math.sqrt(2 / G)) and run.q[-1, 1] == pytest.approx(0)


def test_instance_of_a_batch_equals_its_single_run(swing: ModuleType) -> None:
    starts = np.linspace(0.2, 1.4, 7)[:, None]
    runs = swing.simulate_batch(starts, duration=2.0, method="dp8")
    one_thread = swing.simulate_batch(starts, duration=2.0, method="dp8", threads=1)
    assert runs == one_thread and runs.q.shape == (7, 201, 1) and runs.method == "dp8"
    assert "of 0.01 s" in runs.message
    for k, start in enumerate(starts):
        single = swing.simulate(start, duration=2.0, method="dp8")
        for name in ("below", "wall"):
            expected, actual = single.events[name], runs.events[name].for_instance(k)
            assert (
                actual.t.tolist() == expected.t.tolist()
                and actual.q.tolist() == expected.q.tolist()
            )
        assert runs.q[k, -1].tolist() == single.q[-1].tolist()
        assert runs.evaluations[k] >= single.evaluations > 14 * single.steps
    q, _ = runs([0.305])
    assert q[3, 0] == pytest.approx(swing.simulate(starts[3], method="dp8")(0.305)[0], abs=1e-15)
    table = np.full((1, 200, 1), 0.2)
    by_table = swing.simulate_batch(starts, h=0.01, duration=2.0, u=table)
    constant = swing.simulate_batch(starts, h=0.01, duration=2.0, u=[0.2])
    np.testing.assert_allclose(by_table.q, constant.q, atol=1e-14)


def test_error_is_estimated_among_events(swing: ModuleType) -> None:
    reference = swing.simulate(tol=1e-14)
    for h in (0.01, 0.02):
        run = swing.simulate(h=h)
        estimate = run.estimate()
        error = abs(run.q[-1, 0] - reference.q[-1, 0])
        assert estimate.order == 4 and estimate.end["theta"] == pytest.approx(error, rel=0.2)
        assert estimate.resolved


def test_saved_or_pickled_run_is_unchanged(swing: ModuleType, tmp_path: Path) -> None:
    run = swing.simulate(h=0.01, duration=1.0)
    run.save(tmp_path / "one.npz")
    for loaded in (swing.load_run(tmp_path / "one.npz"), pickle.loads(pickle.dumps(run))):
        assert loaded == run and loaded.events["wall"].t.tolist() == run.events["wall"].t.tolist()
        assert loaded(0.777)[0] == run(0.777)[0] and "steps of 0.01 s" in repr(loaded)
        assert loaded.estimate().end == run.estimate().end
    runs = swing.simulate_batch([[0.5], [1.2]], h=0.01, duration=1.0)
    runs.save(tmp_path / "many.npz")
    loaded = swing.load_run(tmp_path / "many.npz")
    assert loaded == runs and np.array_equal(loaded([0.31])[0], runs([0.31])[0])


@pytest.mark.parametrize(("t0", "h"), [(1e6, 1e-9), (1.7e9, 2e-5), (1e3, 1e-4)])
def test_steps_near_the_resolution_of_time_have_full_length(
    ball: ModuleType, t0: float, h: float
) -> None:
    """Regression: the state advanced by h per step, the time by 2h."""
    run = ball.simulate(t0=t0, h=h, steps=500)
    np.testing.assert_allclose(run.q[-1], [500 * h, 1 - G / 2 * (500 * h) ** 2], rtol=1e-12)
    assert run.steps == 500 and run.status == "ok" and run.t[-1] == t0 + 500 * h


def test_tolerance_is_refused_without_adaptive_steps(modules: Modules) -> None:
    """A scene with events and no tolerance has fixed steps only, and its C no adaptive ones."""
    text = BALL.replace("tolerance = 1e-9\n", "").replace("bouncing", "fixed_ball")
    module = modules.unoptimised(text)
    for arguments in ({}, {"duration": 1.0}, {"times": [0.1, 0.5]}, {"h": 0.01}):
        with pytest.raises(ValueError, match=r"fixed_ball was built without adaptive steps"):
            module.simulate(tol=1e-9, **arguments)
    run = module.simulate()
    impacts_until_end = [t for t in impacts(0.8, 20) if t < run.t[-1]]
    assert run.events["impact"].t == pytest.approx(impacts_until_end, abs=1e-12)
    assert run.tol == 0 and run.rejected == 0
    sources = eomc.sources(from_scene(parse(text, "fixed.toml"))).files
    for name in ("fixed_ball.c", "fast/fixed_ball.c", "fixed_ball.h"):
        assert not re.search("newton|gauss|roughness|tol\\b", sources[name]), name


def test_step_size_below_the_resolution_of_time_is_refused(ball: ModuleType) -> None:
    for simulate in (ball.simulate, ball.simulate_batch):
        with pytest.raises(ValueError, match=r"h: 1e-09 s .* at 1.7e\+09 s, .* smaller t0"):
            simulate(t0=1.7e9, h=1e-9, steps=1000)


@pytest.mark.parametrize("h", [0.1, 0.05, 0.01])
@pytest.mark.parametrize("options", [{}, {"u": "table"}, {"tol": 1e-9, "control_period": 0.1}])
def test_jumps_at_multiples_of_h_act_once(
    clock: ModuleType, h: float, options: dict[str, Any]
) -> None:
    """Regression: a rounding before the end of a step they acted twice and seemed to accumulate."""
    for strike_time in (0.3, 0.5, 0.7, 0.9, round(7 * h, 6), 9 * h):
        arguments = dict(options)
        if arguments.get("u"):
            arguments["u"] = np.zeros((round(1 / h), 1))
        elif not arguments:
            arguments["control_period"] = h
        if "tol" not in arguments:
            arguments["h"] = h
        run = clock.simulate(params={"at": strike_time}, duration=1.0, **arguments)
        assert run.status == "ok" and run.events["strike"].t == pytest.approx(
            [strike_time], abs=1e-15
        )
        assert run.q[-1, 0] == pytest.approx(2 - strike_time, abs=1e-12)
        # the last at the end of the run, or not at all
        ticks = clock.simulate(h=h, duration=1.0).events["tick"].t
        assert ticks == pytest.approx(0.1 * np.arange(1, len(ticks) + 1), abs=1e-14)
        assert len(ticks) in (9, 10)


@pytest.mark.parametrize("case", ["fixed", "tol", "period"])
def test_jumps_some_roundings_before_an_end_act_once(clock: ModuleType, case: str) -> None:
    """Regression: they acted again in the rest of the step or of the run."""
    options = {
        "fixed": {"h": 0.1, "duration": 1.0},
        "tol": {"tol": 1e-9},
        "period": {
            "tol": 1e-9,
            "control_period": 0.1,
            "u": lambda t, q, qd: [0.0],
            "duration": 1.0,
        },
    }
    for k in (3, 7, 9):
        for roundings in (-40, -17, -5, -1, 0, 2, 30):
            strike_time = 0.1 * k * (1 + roundings * 2.0**-53)
            end = {"duration": 0.1 * k} if case == "tol" else {}
            run = clock.simulate(params={"at": strike_time}, **options[case], **end)
            assert run.status == "ok" and len(run.events["strike"]) <= 1
            if case != "tol":
                assert run.q[-1, 0] == pytest.approx(2 - strike_time, abs=1e-12)
            q, _ = run([0.05, run.t[-1]])
            assert q[0] == pytest.approx([0.05]) and q[1] == pytest.approx(run.q[-1], abs=1e-14)
            rows = clock.simulate(params={"at": strike_time}, times=[0, 0.15, 0.1 * k], tol=1e-9)
            assert len(rows) == 3


@pytest.fixture(scope="module")
def clock(modules: Modules) -> ModuleType:
    """A body that is struck at a given time."""
    return modules.unoptimised(CLOCK)


CLOCK = """eomc = 1
name = "struck"
[coordinates]
x = { rate = 1 }
[parameters]
at = 9.0
[inputs]
push = {}
[energy]
kinetic = "x_dot**2/2"
[forces]
x = "push"
[[event]]
name = "strike"
when = "t - at"
action = "jump"
x_dot = "x_dot + 1"
[[event]]
name = "tick"
when = "sin(10*pi*t)"
[run]
tolerance = 1e-9
h = 0.01
"""


def test_events_passed_to_a_call_are_detected_in_fixed_steps(tmp_path: Path) -> None:
    scene = tmp_path / "asked_stepped.toml"
    scene.write_text(FREE.format(name="asked_stepped", events="[run]\nduration = 1"))
    module = eomc.load(scene, tmp_path / "build")
    run = module.simulate(events={"third": "x - 1/3"}, h=0.1)
    assert run.events["third"].t == pytest.approx([1 / 3], rel=1e-14)


STICKING = """eomc = 1
name = "stepped_stick"
[coordinates]
x = { unit = "m", start = 1.0, friction = 1.7 }
[energy]
kinetic = "x_dot**2/2"
potential = "5*x**2"
[run]
tolerance = 1e-9
h = 0.02
duration = 5.0
friction = "stick"
"""


@pytest.mark.slow
def test_steps_at_rest_under_friction_cost_no_search_of_events(modules: Modules) -> None:
    """Regression: velocities of rounding size were searched for the end of the sliding."""
    text = """eomc = 1
name = "resting"
[coordinates]
x = { rate = 1.0, friction = "6.0" }
[energy]
kinetic = "x_dot**2"
[run]
friction = "stick"
h = 0.01
duration = 1
"""
    run = modules.unoptimised(text).simulate()
    assert run.events["x_stops"].t == pytest.approx([1 / 3], abs=1e-13)
    assert run.q[-1, 0] == pytest.approx(1 / 6, abs=1e-13)
    assert run.evaluations < 10 * run.steps


def test_friction_sticks_in_fixed_steps(modules: Modules) -> None:
    """Each half period is centred at +-0.17: it stops at -0.66, 0.32 and 0.02, where it stays."""
    run = modules.unoptimised(STICKING).simulate(h=0.02)
    half = math.pi / math.sqrt(10)
    assert run.events["x_stops"].t == pytest.approx(half * np.arange(1, 4), rel=1e-6)
    assert run.events["x_slips"].t == pytest.approx(half * np.arange(3), abs=1e-6)
    assert run.q[-1] == pytest.approx([0.34 - 0.32, 0], abs=1e-6) and run.qd[-1, 0] == 0


RAIL = """eomc = 1
name = "stepped_rod"
[coordinates]
x = { start = 0.6, unit = "m" }
y = { start = -0.8, unit = "m" }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[constraints]
rod = "x**2 + y**2 - 1"
[[event]]
name = "wall"
when = "x + 0.3"
direction = "falling"
action = "jump"
x_dot = "-0.5*x_dot"
[run]
tolerance = 1e-9
h = 0.01
duration = 4.0
"""


def test_jumps_stay_on_constraints(modules: Modules) -> None:
    module = modules.unoptimised(RAIL)
    run, fine = module.simulate(h=0.01), module.simulate(tol=1e-12)
    assert len(run.events["wall"]) == len(fine.events["wall"]) == 3
    np.testing.assert_allclose(run.events["wall"].t, fine.events["wall"].t, atol=1e-7)
    assert np.max(np.abs(np.sum(run.q**2, axis=1) - 1)) < 1e-14
    assert np.max(np.abs(np.sum(run.q * run.qd, axis=1))) < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("folder", ["", "fast"])
def test_c_program_takes_fixed_steps_with_events(folder: str, real: str, tmp_path: Path) -> None:
    run = f'[run]\nmethod = {METHODS}\nreal = "{real}"'
    text = BALL.replace("bouncing", "embedded").replace("[run]", run)
    text = text.replace("1e-9", "1e-5") if real == "float" else text
    sources = eomc.sources(from_scene(parse(text, "c.toml"))).files
    for suffix in "hc":
        file = tmp_path / f"embedded.{suffix}"
        file.write_text(sources[f"{folder}/embedded.{suffix}".lstrip("/")], encoding="utf-8")
    (tmp_path / "main.c").write_text(
        f"""#include "embedded.h"
#include <stdio.h>
int main(void)
{{
    {real} q[EMBEDDED_NQ] = {{ 0, 1 }}, qd[EMBEDDED_NQ] = {{ 1, 0 }};
    {real} h = ({real})0.01, rows[EMBEDDED_NE_ROOM*(1 + 2*EMBEDDED_NQ)];
    embedded_memory memory = {{ 0 }};
    embedded_options options = {{ EMBEDDED_METHOD_RK4 }};
    embedded_output output = {{ 0 }};
    embedded_status status = EMBEDDED_OK;
    int which[EMBEDDED_NE_ROOM];

    options.h = h;
    options.steps = 10;
    output.room = EMBEDDED_NE_ROOM;
    output.which = which;
    output.event_rows = rows;
    output.memory = &memory;
    for (int k = 1; k <= 200 && !status; k++) {{
        options.t_end = k*h;
        status = embedded_integrate(q, qd, &embedded_defaults, &options, &output);
        for (long i = 0; i < output.events; i++)
            if (which[i] == EMBEDDED_EVENT_IMPACT)
                printf("%.17g\\n", (double)rows[(1 + 2*EMBEDDED_NQ)*i]);
    }}
    return (int)status + (output.steps > 204);
}}
""",
        encoding="utf-8",
    )
    flags = ["-Wall", "-Wextra", "-Werror"] if folder else STRICT
    compiled("cc", *flags, "-O2", "-c", "embedded.c", "-o", "scene.o", cwd=tmp_path)
    compiled("cc", "main.c", "scene.o", "-O1", "-o", "a", "-lm", cwd=tmp_path)
    process = subprocess.run([str(tmp_path / "a")], capture_output=True, text=True)
    times = [float(line) for line in process.stdout.split()]
    assert process.returncode == 0
    assert times == pytest.approx(impacts(0.8, 3), rel=1e-13 if real == "double" else 3e-6)


@pytest.mark.parametrize("options", [{}, {"h": 0.1}])
def test_recording_event_detects_a_zero_once_if_another_jumps_back(
    recorded: ModuleType, options: dict[str, float]
) -> None:
    run = recorded.simulate(**options)
    assert run.events["low"].t.tolist() == run.events["impact"].t.tolist()
    assert len(run.events["impact"]) == 3


@pytest.fixture(scope="module")
def recorded(modules: Modules) -> ModuleType:
    """A ball whose impacts another event records, in both directions."""
    text = BALL.replace("bouncing", "recorded_ball").replace("duration = 3", "duration = 2")
    low = event("low", "y")
    return modules.unoptimised(
        text.replace('[[event]]\nname = "impact"', f'{low}\n[[event]]\nname = "impact"')
    )


@pytest.mark.parametrize("steps", [{"h": 0.01}, {"tol": 1e-9}, {"times": [0.0, 3.0]}])
def test_section_is_crossed_between_jumps(ball: ModuleType, steps: dict[str, Any]) -> None:
    """The floor is touched but not crossed, and an impact carries the velocity across zero."""
    run = ball.simulate(**steps)
    impact_times, e = impacts(0.8, 6), 0.8 ** np.arange(1, 7)
    tops = run.section("y_dot")
    assert tops["t"] == pytest.approx(impact_times + math.sqrt(2 / G) * e, rel=1e-12)
    assert tops["y"] == pytest.approx(e**2, rel=1e-12)
    assert not len(run.section("y")["t"]) and not len(run.section("y_dot", rising=True)["t"])
    rising = run.section("y", 0.25, rising=True)
    speed = np.sqrt(2 * G * (e[:3] ** 2 - 0.25))
    assert rising["y_dot"] == pytest.approx(speed, rel=1e-12)
    assert run.section("t", 0.1, period=0.5)["t"] == pytest.approx(0.1 + 0.5 * np.arange(6))
    with pytest.raises(KeyError, match="did you mean 'y_dot'"):
        run.section("y_dott")


@pytest.mark.slow
def test_section_where_a_jump_changes_the_forces(modules: Modules) -> None:
    """x crosses 0 there; s jumps back from 1 to 0, where it starts."""
    events = (
        event("turn", "x", 'action = "jump"', 'a = "-a"'),
        event("back", "s - 1", 'action = "jump"', "s = 0"),
    )
    text = FREE.format(name="section_switch", events="\n".join(events))
    text = text.replace("x = { rate = 1 }", "x = { rate = 1 }\ns = { rate = 1 }")
    text = text.replace("[energy]", '[outputs]\nlate = "a*t"\n[energy]')
    text = text.replace("a = 0", "a = -1").replace('"x_dot**2/2"', '"(x_dot**2 + s_dot**2)/2"')
    run = modules.unoptimised(text).simulate(duration=9.5, h=0.1)
    assert run.events["turn"].t == pytest.approx([2, 4, 6, 8])
    assert run.section("x")["t"] == pytest.approx([0, 2, 4, 6, 8], abs=1e-12)
    assert run.section("x", rising=True)["t"] == pytest.approx([0, 4, 8], abs=1e-12)
    assert run.section("s", 0.25)["t"] == pytest.approx(0.25 + np.arange(10))
    assert run.section("s", 0)["t"].tolist() == [0]
    assert not len(run.section("s", 1.0)["t"]) and not len(run.section("s", 5.0)["late"])


@pytest.mark.parametrize("slope", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 1e-17, -1e-17])
def test_section_at_rest_is_crossed_once_when_left_to_the_other_side(
    slope: float, noise: float
) -> None:
    """The value falls to 0, stays there until t = 2, and moves on."""
    piece = np.linspace(0.0, 1.0, 9)
    rest = noise * (-1.0) ** np.arange(9)
    columns = {
        "t": np.concatenate([piece, 1 + piece, 2 + piece]),
        "v": np.concatenate([1 - piece + rest, rest, slope * piece]),
    }
    for level, period in ((0.0, None), (0.0, 10.0), (-10.0, 10.0)):
        crossings = trajectory.crossings(columns, "v", level, None, period)
        assert crossings["t"] == pytest.approx([2.0] if slope < 0 else [])
    with_nan = columns | {"v": np.where(columns["t"] < 0.5, np.nan, columns["v"] - 0.3)}
    assert len(trajectory.crossings(with_nan, "v", 0.0, False, None)["t"]) == 1


def test_run_that_ends_before_its_first_row_has_no_values(ball: ModuleType) -> None:
    run = ball.simulate(times=[3.0], params={"far": 0.5})
    assert run.stopped == "away" and {len(x) for x in run.to_dict().values()} == {0}


@pytest.mark.slow
def test_single_precision_has_a_row_per_step(modules: Modules) -> None:
    """Regression: with h near the resolution of time, a row was missing and time ran ahead."""
    module = modules.unoptimised(
        CLOCK.replace("struck", "struck_float").replace("1e-9", "1e-5") + 'real = "float"\n'
    )
    for t0, h, steps in ((0.0, 0.003, 777), (0.1, 0.01, 2000), (123.4, 0.0007, 999)):
        run = module.simulate(
            t0=t0, h=h, steps=steps, u=np.full((steps, 1), 1.0), params={"at": 1e4}
        )
        T = steps * h
        assert run.steps == steps and run.q[-1, 0] == pytest.approx(T + T**2 / 2, rel=1e-4)


TOPS = """eomc = 1
name = "tops"
[coordinates]
x = { rate = 1.0 }
[parameters]
ends = 9
marks = 9
turns = 9
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
[[event]]
name = "end"
when = "x - ends"
direction = "rising"
action = "stop"
[[event]]
name = "mark"
when = "x - marks"
direction = "rising"
[[event]]
name = "turn"
when = "x - turns"
direction = "rising"
action = "jump"
x_dot = "-x_dot/2"
[run]
h = 0.05
duration = 20
tolerance = 1e-9
"""
MISSED = (
    r"tops: this motion is not resolved: event '{}' at t = 1\.526\d+ s.*shorter steps, was missed"
)


@pytest.fixture(scope="module")
def tops(modules: Modules) -> ModuleType:
    """x = sin t, with events at heights given by parameters."""
    return modules.unoptimised(TOPS)


@pytest.mark.parametrize("h", [0.7, 0.8])
@pytest.mark.parametrize(
    ("height", "name"), [("ends", "end"), ("marks", "mark"), ("turns", "turn")]
)
def test_event_passed_over_by_steps_is_reported(
    tops: ModuleType, h: float, height: str, name: str
) -> None:
    """x exceeds 0.999 from t = 1.526 to 1.616, between two steps."""
    run = tops.simulate(h=h, params={height: 0.999})
    with pytest.warns(RuntimeWarning, match=MISSED.format(name)):
        error = run.estimate()
    assert not error.resolved and list(error.missed) == [name] and not len(run.events[name].t)
    assert error.missed[name][0] == pytest.approx(math.asin(0.999), abs=1e-3)
    if height == "ends":  # the motion ends before the run does
        assert np.isinf(error.q[-1]).all() and error.digits["x"] == 0


@pytest.mark.parametrize(
    "options", [{"h": 0.05}, {"h": 0.05, "times": [0.5, 1.0, 9.0]}, {"tol": 1e-6}]
)
def test_detected_events_are_resolved(tops: ModuleType, options: dict[str, Any]) -> None:
    expected = math.asin(0.999)
    for height, name in (("ends", "end"), ("marks", "mark"), ("turns", "turn")):
        run = tops.simulate(params={height: 0.999}, **options)
        error = run.estimate()
        assert error.resolved and not error.missed and np.max(error.q) < 1e-4
        time_error = abs(run.events[name].t[0] - expected)
        assert error.events[name][0] == pytest.approx(time_error, rel=0.1, abs=1e-11)


def test_event_at_the_end_is_not_missed(tops: ModuleType) -> None:
    """One of two runs may end a rounding before it."""
    end = math.asin(0.5)
    for rounding in (0.0, 1e-15, -1e-15):
        for height in ("ends", "marks"):
            options = {"duration": end + rounding, "tol": 1e-9}
            error = tops.simulate(params={height: 0.5}, estimate=True, **options).error
            assert error.resolved and np.max(error.q) < 1e-9
