"""Detection and times of zero crossings: pairs in one step, dips, tangential zeros, rounding."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest
from support.event_scenes import ADAPTIVE, FREE, built, event
from support.session import tiers

import eomc

pytestmark = pytest.mark.usefixtures("unoptimised_file")
TWO_SPRINGS = """eomc = 1
name = "two_springs"
[coordinates]
x = { start = 1, rate = 0 }
y = { start = 1, rate = 0 }
[parameters]
k = 2
a = 1
b = 1
c = 0
d = 0.1
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "(x**2 + k*y**2)/2"
[[event]]
name = "line"
when = "a*x + b*y - c"
[[event]]
name = "curve"
when = "x*y_dot - d"
[run]
tolerance = 1e-9
"""


@pytest.fixture(scope="module")
def springs() -> ModuleType:
    """Two oscillators of frequencies 1 and sqrt(k), with two events."""
    return built(TWO_SPRINGS)


def test_close_crossings_in_one_long_step_are_detected(free: ModuleType) -> None:
    for w in (0.3, 1e-2, 1e-4):
        run = free.simulate(duration=4.0, params={"first": 1.0, "second": 1 + w})
        assert run.events["pair"].t == pytest.approx([1, 1 + w], abs=1e-13)
        assert run.events["three"].t == pytest.approx([2, 3], abs=1e-13)
    assert run.steps < 20


@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-9])
def test_dip_between_two_evaluations_is_detected(springs: ModuleType, tol: float) -> None:
    """-sin(2 t)/2 + 1/2 - 1e-3; a cubic through two evaluations errs by some percent."""
    run = springs.simulate(tol=tol, duration=30.0, params={"k": 1.0, "d": 1e-3 - 0.5})
    offset = math.asin(1 - 2e-3) / 2
    expected = [t + math.pi * k for k in range(10) for t in (offset, math.pi / 2 - offset)]
    assert run.events["curve"].t == pytest.approx(expected, abs=100 * tol)


FAST = (
    TWO_SPRINGS.replace("two_springs", "fast_events")
    .replace('"x*y_dot - d"', '"cos(w*x - d)"')
    .replace('"a*x + b*y - c"', '"sin(w*t)"')
    .replace("k = 2", "w = 50\nk = 2")
)


@pytest.mark.parametrize("tol", [1e-3, 1e-12])
def test_events_faster_than_the_motion_are_detected(tol: float) -> None:
    """Regression: with steps of a second, two thirds of a stroboscope's flashes were missed."""
    fast = built(FAST)
    for w in (50.0, 7.0, 301.0):
        run = fast.simulate(tol=tol, duration=10.0, params={"w": w})
        expected = math.pi / w * np.arange(1, int(10 * w / math.pi) + 1)
        assert run.events["line"].t == pytest.approx(expected, abs=1e-11)
        phase = w * np.cos(np.linspace(0, 10, 1_000_001)) - 0.1  # x = cos t, over half turns
        crossings = np.abs(np.diff(np.floor(phase / math.pi + 0.5))).sum()
        assert len(run.events["curve"]) == crossings
    slow = fast.simulate(tol=tol, duration=10.0, params={"w": 0.1})
    assert slow.steps < 20 and slow.rejected < 5


ROUNDED = (
    TWO_SPRINGS.replace("two_springs", "rounded_events")
    .replace('"a*x + b*y - c"', '"x**2 + x_dot**2 - 1"')
    .replace('"x*y_dot - d"', '"min(x, 0.5 - x)"')
)


def test_steps_are_not_halved_for_rounding_and_kinks() -> None:
    """Regression: a conserved quantity is rounding in steps of any size: endless halving."""
    module = built(ROUNDED)
    for duration in (1e-6, 1e-3, 20.0):
        run = module.simulate(tol=1e-9, duration=duration)
        assert run.status == "ok" and run.steps + run.rejected < 150
    third, turn = math.pi / 3, 2 * math.pi
    expected = [
        a + turn * k for k in range(4) for a in (third, 1.5 * third, 4.5 * third, 5 * third)
    ]
    assert run.events["curve"].t == pytest.approx([t for t in expected if t < 20], abs=1e-8)


def roots(f, t_end: float) -> list[float]:
    """Return all zeros in (0, t_end], by fine sampling and bisection in 30 digits."""
    times = np.linspace(0, t_end, 4001).tolist()
    values = [f(t, math) for t in times]
    zeros = []
    with mpmath.workdps(30):
        for a, b, fa, fb in zip(times, times[1:], values, values[1:], strict=False):
            if fa * fb < 0:
                zeros.append(float(mpmath.findroot(f, (a, b), solver="anderson", tol=1e-40)))
    return zeros


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 100))]
)
def test_random_events_equal_those_of_the_exact_motion(springs: ModuleType, seed: int) -> None:
    random = np.random.default_rng(seed)
    k, a, b, c, d = random.uniform([0.5, -1, -1, -1, -1], [9, 1, 1, 1, 1])
    q0, qd0 = random.normal(size=(2, 2))
    run = springs.simulate(
        q0, qd0, tol=1e-13, duration=12.0, params=dict(zip("kabcd", (k, a, b, c, d), strict=True))
    )

    def motion(t, functions):
        w = functions.sqrt(k)
        x = q0[0] * functions.cos(t) + qd0[0] * functions.sin(t)
        y = q0[1] * functions.cos(w * t) + qd0[1] / w * functions.sin(w * t)
        return x, y, -q0[1] * w * functions.sin(w * t) + qd0[1] * functions.cos(w * t)

    def line(t, functions=mpmath):
        x, y, _ = motion(t, functions)
        return a * x + b * y - c

    def curve(t, functions=mpmath):
        x, _, rate = motion(t, functions)
        return x * rate - d

    for name, f in (("line", line), ("curve", curve)):
        expected, times = roots(f, 12.0), run.events[name].t
        assert len(times) == len(expected), name
        assert times == pytest.approx(expected, abs=1e-11)


PAIR = "(x - first)*(x - second)"
EVENTS = (
    event("pair", PAIR),
    event("up", PAIR, 'direction = "rising"'),
    event("three", "(x - first - 1)*(x - second - 1)*(x - 3)", 'direction = "rising"'),
    event("wall", "x - wall", 'action = "stop"'),
    event("gap", "x - gap", 'action = "jump"', 'x_dot = "sqrt(x - 10)"'),
)


@pytest.fixture(scope="module")
def free() -> ModuleType:
    """A body under a constant force, with events at positions given by parameters."""
    return built(FREE.format(name="free", events="\n".join((*EVENTS, ADAPTIVE))))


def test_close_pair_has_separate_times(free: ModuleType) -> None:
    params = {"a": -1.0, "first": 0.3, "second": 0.3001}
    run = free.simulate([1.0], [0.0], duration=2.0, params=params)
    expected = [math.sqrt(2 * (1 - x)) for x in (0.3001, 0.3)]
    assert run.events["pair"].t == pytest.approx(expected, abs=1e-12)


def test_tangential_zero_is_no_crossing(free: ModuleType) -> None:
    params = {"a": 2.0, "wall": 0.0}
    for tol in (1e-6, 1e-9, 1e-13):
        run = free.simulate([1.0], [-2.0], duration=2.0, tol=tol, params=params)
        assert run.t[-1] == 2.0 and len(run.events["wall"]) == 0
    low = free.simulate([1 - 1e-6], [-2.0], duration=2.0, params=params)
    assert low.stopped == "wall" and low.t[-1] == pytest.approx(1 - 1e-3, abs=1e-9)


def test_events_of_one_formula_have_the_same_crossings(free: ModuleType) -> None:
    run = free.simulate(duration=2.0, params={"first": 0.7, "second": 0.702})
    assert run.events["pair"].t == pytest.approx([0.7, 0.702], abs=1e-13)
    assert run.events["up"].t == pytest.approx([0.702], abs=1e-13)


def test_event_at_zero_at_the_start_is_not_detected_at_rest(free: ModuleType) -> None:
    run = free.simulate([1.0], [0.0], duration=1, params={"a": -1.0, "wall": 1.0})
    assert run.t[-1] == 1.0 and run.stopped == ""


def test_jump_to_a_non_finite_state_ends_the_run_and_names_the_event(free: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match="event 'gap' jumps to no finite state"):
        run = free.simulate(duration=2.0, params={"gap": 0.5})
    assert run.status == "not finite" and run.t[-1] == pytest.approx(0.5, abs=1e-13)
    assert run.q[-1, 0] == pytest.approx(0.5) and len(run.events["gap"]) == 1


def test_event_function_of_pure_rounding_costs_little_time() -> None:
    events = event("noise", "sin(x)**2 + cos(x)**2 - 1", 'action = "stop"')
    module = built(FREE.format(name="noisy", events=f"{events}\n{ADAPTIVE}"))
    start = time.process_time()
    assert module.simulate(duration=20.0, max_step=0.1).steps < 2000
    assert time.process_time() - start < 1.0


def test_two_jumps_a_rounding_from_each_other_do_not_accumulate(tmp_path: Path) -> None:
    """A wall is hit as a clock strikes: both events jump, one after the other."""
    scene = tmp_path / "walls.toml"
    scene.write_text(
        'eomc = 1\nname = "struck"\n[coordinates]\n'
        "x = { rate = 1.0 }\ny = { start = 0.25, rate = 1.0 }\n"
        '[energy]\nkinetic = "(x_dot**2 + y_dot**2)/2"\n[run]\ntolerance = 1e-12\nduration = 3\n'
        '[[event]]\nname = "wall"\nwhen = "1 - x**2"\naction = "jump"\nx_dot = "-0.5*x_dot"\n'
        '[[event]]\nname = "clock"\nwhen = "t - 1"\naction = "jump"\ny_dot = "2*y_dot"\n',
        encoding="utf-8",
    )
    run = eomc.load(scene, tmp_path).simulate()
    assert run.status == "ok"
    np.testing.assert_allclose(run.q[-1], [0.0, 5.25], atol=1e-12)
    np.testing.assert_allclose(run.qd[-1], [-0.5, 2.0], atol=1e-12)


@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize(
    ("real", "w", "t0"),
    tiers([("float", 1000.0, 300.0), ("double", 1e5, 1.7e9)], "double"),
    ids=["float", "double"],
)
def test_steps_of_few_time_roundings_separate_events(real: str, w: float, t0: float) -> None:
    """An event that is never detected comes before the others."""
    text = f"""
    eomc = 1
    name = "late_{real}"
    [coordinates]
    x = {{ start = 1.0, rate = 0.1 }}
    [parameters]
    w = {w}
    [energy]
    kinetic = "x_dot**2/2"
    potential = "w**2*x**2/2"
    [run]
    real = "{real}"
    tolerance = 1e-4
    """
    text += event("never", "x + 1000", 'direction = "rising"', "") + event("zero", "x")
    run = built(text).simulate(t0=t0, duration=60 * math.pi / w)
    assert {name: len(events.t) for name, events in run.events.items()} == {"never": 0, "zero": 60}
