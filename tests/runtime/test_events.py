"""Events in adaptive steps: detection, order and actions."""

from __future__ import annotations

import math
import pickle
import subprocess
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import sympy.physics.vector
from support.compilation import STRICT, compiled
from support.event_scenes import BALL, BUILDS, FREE, G, built, event, impacts
from support.session import tiers

import eomc
from eomc.base.errors import SceneError
from eomc.model.system import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")


@pytest.fixture(scope="module")
def ball() -> ModuleType:
    """A ball that falls from 1 m, moves along at 1 m/s, and bounces off floor and wall."""
    return built(BALL)


@pytest.mark.parametrize("e", [0.55, 0.8, 0.95])
def test_ball_bounces_at_the_right_times_and_comes_to_rest(ball: ModuleType, e: float) -> None:
    with pytest.warns(RuntimeWarning, match="jumps follow one another ever sooner"):
        run = ball.simulate(tol=1e-12, duration=1e3, params={"e": e, "wall": 1e4})
    impact_events = run.events["impact"]
    times = impacts(e, len(impact_events))
    assert len(impact_events) >= 50 and np.max(np.abs(impact_events.t - times) / times) < 1e-13
    assert run.status == "accumulated" and f"t = {run.limit:.15g}" in run.message
    assert run.limit == pytest.approx(times[0] * (1 + e) / (1 - e), rel=1e-10)
    tops = run.events["top"]
    assert tops.q[:20, 1] == pytest.approx(e ** (2.0 * np.arange(1, 21)), rel=1e-9)
    assert np.array_equal(run.events["impact"].q[:, 0] > 0, np.ones(len(impact_events), bool))
    assert pickle.loads(pickle.dumps(run)).events["impact"].t.tolist() == impact_events.t.tolist()


def test_rows_exist_on_both_sides_of_a_jump(ball: ModuleType) -> None:
    run = ball.simulate(duration=1.0)
    row = int(np.flatnonzero(np.diff(run.t) == 0)[0])
    assert run.qd[row, 1] < 0 < run.qd[row + 1, 1] == pytest.approx(-0.8 * run.qd[row, 1])
    assert np.array_equal(run.q[row], run.q[row + 1]) and run.t[row] == run.events["impact"].t[0]


def test_rows_at_output_times_follow_the_jumps(ball: ModuleType) -> None:
    times = np.linspace(0, 2.5, 41)
    run = ball.simulate(times=times, tol=1e-12)
    impact_times = impacts(0.8, 9)
    k = np.searchsorted(impact_times, times)
    speed = math.sqrt(2 * G) * 0.8**k
    elapsed = times - np.where(k > 0, impact_times[k - 1], 0)
    y = np.where(k > 0, speed * elapsed, 1) - G * elapsed**2 / 2
    assert run.q[:, 1] == pytest.approx(y, abs=1e-12)
    assert len(run.events["impact"]) == np.sum(impact_times < 2.5)


def test_stop_event_ends_the_run(ball: ModuleType) -> None:
    run = ball.simulate(params={"far": 0.7}, duration=5.0)
    assert run.status == "ok" and run.stopped == "away"
    assert run.t[-1] == pytest.approx(0.7, abs=1e-14) and run.q[-1, 0] == pytest.approx(0.7)
    assert run.events["away"].t.tolist() == [run.t[-1]]
    assert ball.simulate(params={"far": 7.0}, duration=1.0).stopped == ""


def test_simultaneous_events_are_both_detected(ball: ModuleType) -> None:
    corner = math.sqrt(2 / G)
    run = ball.simulate(params={"wall": corner}, duration=0.6)
    assert run.events["impact"].t == pytest.approx([corner], abs=1e-14)
    assert run.events["corner"].t == pytest.approx([corner], abs=1e-14)
    up = 0.8 * math.sqrt(2 * G) - G * (0.6 - corner)
    assert run.qd[-1] == pytest.approx([-1, up])


def test_simultaneous_events_act_in_the_order_of_the_scene(ball: ModuleType) -> None:
    """Regression: a rounding apart, the other came first as often, and some were lost."""
    rng = np.random.default_rng(3)
    for height, speed in rng.uniform(0.1, 3.0, (200, 2)):
        time = math.sqrt(2 * height / G)
        run = ball.simulate(
            [0, height], [speed, 0], params={"wall": speed * time}, duration=1.2 * time
        )
        indices, rows = run.event_data
        assert indices.tolist() == [0, 2], (height, speed)
        assert rows[:, 0] == pytest.approx([time, time], abs=1e-14)


def test_event_at_zero_at_the_start_is_not_detected(ball: ModuleType) -> None:
    up = ball.simulate(q0=[0, 0], qd0=[0, 2.0], duration=0.5)
    assert up.events["impact"].t == pytest.approx([4 / G], abs=1e-14)
    assert up.events["top"].t == pytest.approx([2 / G], abs=1e-14)
    down = ball.simulate(q0=[0, 0], qd0=[0, -1.0], duration=0.5)  # it is below the floor already
    assert len(down.events["impact"]) == 0 and down.q[-1, 1] < 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('when = "y"', 'when = "z"', "'z' is not declared"),
        ('when = "y"', 'when = "1"', "never crosses zero: it has no names"),
        ('direction = "falling"', 'direction = "down"', "unknown direction"),
        ('action = "stop"', 'action = "halt"', "unknown action"),
        ('name = "top"', 'name = "impact"', "is an event already"),
        ('y_dot = "-e*y_dot"', "", "a jump sets something"),
        ('y_dot = "-e*y_dot"', 'z_dot = "1"', "'z_dot' is no coordinate, velocity or parameter"),
        ('y_dot = "-e*y_dot"', "y_dot = true", "must be a number or a formula"),
        ('name = "away"', 'name = "away"\nx = 0', "only a jump sets 'x'"),
        ('name = "away"', 'nam = "away"', "nam"),
    ],
)
def test_invalid_event_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(SceneError) as error:
        parse(BALL.replace(old, new, 1), "events.toml")
    assert message in str(error.value)


def test_names_that_a_jump_may_set_are_listed_in_part() -> None:
    parameters = "".join(f"p{k} = 1.0\n" for k in range(9))
    text = BALL.replace("[parameters]\n", f"[parameters]\n{parameters}", 1)
    with pytest.raises(SceneError, match=r": a jump sets x, x_dot, .*, p\d and \d+ more"):
        parse(text.replace('y_dot = "-e*y_dot"', 'zzz = "1"', 1), "events.toml")


def test_stopped_run_has_an_error_and_jumping_run_a_balance(ball: ModuleType) -> None:
    run = ball.simulate(params={"far": 0.7}, duration=5.0, estimate=True)
    assert run.stopped == "away" and max(run.error.end.values()) < 1e-9 and run.error.resolved
    assert ball.simulate(duration=1.0).balance().jumps == pytest.approx(-0.36 * G, rel=1e-8)
    assert ball.simulate(duration=0.3).balance().error < 1e-9
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        resting = ball.simulate(duration=10.0)
    assert resting.estimate().resolved


def test_arguments_of_fixed_and_adaptive_steps_exclude_each_other(ball: ModuleType) -> None:
    with pytest.raises(ValueError, match="h: belongs to fixed steps"):
        ball.simulate(h=0.01, max_step=0.1)


@pytest.mark.slow
def test_single_precision_has_a_reachable_tolerance() -> None:
    text = BALL.replace("bouncing", "float_ball").replace("[run]", '[run]\nreal = "float"')
    text = text.replace("batch = true", "").replace("tolerance = 1e-9\n", "")
    run = built(text).simulate(duration=1.0)
    assert run.events["impact"].t == pytest.approx([impacts(0.8, 1)[0]], rel=1e-5)
    with pytest.raises(SceneError, match="a float can keep 5e-07 at best"):
        parse(text.replace("[run]", "[run]\ntolerance = 1e-9"), "float.toml")


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_c_compiles_without_warnings_and_agrees_with_python(
    ball: ModuleType, real: str, tmp_path: Path
) -> None:
    text = BALL.replace("bouncing", f"ball_{real}").replace("[run]", f'[run]\nreal = "{real}"')
    text = text.replace("1e-9", "1e-5") if real == "float" else text
    sources = eomc.sources(from_scene(parse(text, "c.toml")))
    name, P = sources.name, sources.name.upper()
    for folder in ("", "fast"):
        (tmp_path / folder).mkdir(exist_ok=True)
        for suffix in "hc":
            file = f"{folder}/{name}.{suffix}".lstrip("/")
            (tmp_path / file).write_text(sources.files[file], encoding="utf-8")
    (tmp_path / "main.c").write_text(
        f"""#include "{name}.h"
#include <stdio.h>
int main(void)
{{
    {real} q[{P}_NQ] = {{ 0, 1 }}, qd[{P}_NQ] = {{ 1, 0 }}, rows[64*(1 + 2*{P}_NQ)];
    {name}_memory memory = {{ 0 }};
    {name}_options options = {{ 0 }};
    {name}_output output = {{ 0 }};
    {name}_status status;
    int which[64];

    options.t_end = 2;
    options.tol = ({real})1e-5;
    options.steps = 1000;
    output.room = 64;
    output.which = which;
    output.event_rows = rows;
    output.memory = &memory;
    status = {name}_integrate(q, qd, &{name}_defaults, &options, &output);
    for (long k = 0; k < output.events; k++)
        printf("%d %.17g\\n", which[k], (double)rows[(1 + 2*{P}_NQ)*k]);
    return (int)status;
}}
""",
        encoding="utf-8",
    )
    module = ball if real == "double" else built(text)
    run = module.simulate(tol=1e-5, duration=2.0)
    for folder, flags in (("", STRICT), ("fast", ["-Wall", "-Wextra", "-Werror"])):
        source = tmp_path / folder / f"{name}.c"
        options = ["-O1", f"-I{tmp_path / folder}", "-o", f"a{folder}"]
        compiled("cc", *flags, "-O1", "-c", str(source), "-o", "scene.o", cwd=tmp_path)
        compiled("cc", "main.c", "scene.o", *options, "-lm", cwd=tmp_path)
        process = subprocess.run([str(tmp_path / f"a{folder}")], capture_output=True, text=True)
        lines = [line.split() for line in process.stdout.splitlines()]
        assert process.returncode == 0
        for k, event_name in enumerate(("impact", "top")):
            times = [float(t) for number, t in lines if int(number) == k]
            tolerance = 1e-12 if real == "double" else 1e-4
            assert times == pytest.approx(run.events[event_name].t, rel=tolerance)


@pytest.mark.parametrize("action", tiers(["record", "stop"], "record"))
def test_c_without_jumps_compiles_without_warnings(tmp_path: Path, action: str) -> None:
    events = event("top", "x", f'action = "{action}"')
    text = FREE.format(name="no_jumps", events=events)
    sources = eomc.sources(from_scene(parse(text, "no_jumps.toml"))).files
    for folder, flags in (("", STRICT), ("fast", ["-Wall", "-Wextra", "-Werror"])):
        path = tmp_path / folder
        path.mkdir(exist_ok=True)
        for name in ("no_jumps.h", "no_jumps.c"):
            (path / name).write_text(sources[f"{folder}/{name}".lstrip("/")], encoding="utf-8")
        compiled("cc", *flags, "-c", "no_jumps.c", cwd=path)


@pytest.mark.usefixtures("quickly_compiled")
def test_events_and_tolerance_of_a_system_from_python() -> None:
    """Events work as in a scene; targets of a jump are symbols, dynamicsymbols or strings."""
    x, y = sympy.physics.vector.dynamicsymbols("x y")
    system = eomc.System.make(
        "thrown", {x: (0, 1), y: 1.0}, (x.diff() ** 2 + y.diff() ** 2) / 2, G * y,
        parameters={"e": 0.8}, duration=1.5, tolerance=1e-9,
        events={
            "impact": {
                "when": y, "direction": "falling", "action": "jump",
                y.diff(): "-e*y_dot", "x": "x + 1",
            },
            "top": {"when": "y_dot", "direction": "falling"},
            "middle": x - 0.25,
        },
    )  # fmt: skip
    assert system.run.tolerance == 1e-9
    run = eomc.load(system, BUILDS / "made").simulate(tol=1e-13)
    fall_time = math.sqrt(2 / G)
    np.testing.assert_allclose(run.events["impact"].t[0], fall_time, rtol=1e-13)
    np.testing.assert_allclose(run.events["top"].t[0], fall_time * 1.8, rtol=1e-12)
    np.testing.assert_allclose(run.events["middle"].t, [0.25], rtol=1e-13)
    assert run.q[-1, 0] == pytest.approx(1.5 + len(run.events["impact"]))
