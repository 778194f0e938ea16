"""Accumulating jumps (Zeno behaviour): floors at any height, other jumps between the impacts."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import pytest
from support.session import tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

RUNS = tiers(["", "tolerance = 1e-10"], "tolerance = 1e-10")
pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "accumulating"
BALL = """eomc = 1
name = "counted"
[coordinates]
y = {}
[parameters]
e = 0.8
ground = 0
count = 0
apart = 0
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "y - ground"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[[event]]
name = "top"
when = "y_dot + apart"
direction = "falling"
action = "jump"
count = "count + 1"
[run]
tolerance = 1e-10
"""


@pytest.fixture(scope="module")
def ball() -> ModuleType:
    return eomc.load(from_scene(parse(BALL, "counted.toml")), BUILDS)


@pytest.mark.parametrize("e", [0.05, 0.1, 0.28, 0.5, 0.7, 0.8, 0.9])
@pytest.mark.parametrize("ground", [0.0, 0.1, 1.6, 1234.56])
@pytest.mark.parametrize("offset", [0.0, 1e6])  # offset 1e6: the event at the top is never detected
def test_run_ends_where_impacts_on_floor_accumulate(
    ball: ModuleType, e: float, ground: float, offset: float
) -> None:
    """Regression: it fell through, or the run hung, if rounding hid `when` or jumps alternated."""
    params = {"e": e, "ground": ground, "apart": offset}
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        run = ball.simulate([ground + 1.0, 0.0], [0.0, 0.0], duration=10.0, params=params)
    assert run.status == "accumulated" and run.steps < 700
    expected = math.sqrt(2 / 9.81) * (1 + e) / (1 - e)
    assert run.limit == pytest.approx(expected, rel=1e-8 if ground < 2 else 1e-6)
    assert (run["count"][-1] > 3) == (offset == 0)


def test_jump_at_time_zero_is_detected_once(ball: ModuleType) -> None:
    """Regression: evaluations a few roundings before t = 0 coincided with it: an endless loop."""
    for lead_time in (1.0, 0.3, 1e-3):
        height = 9.81 / 2 * lead_time**2
        run = ball.simulate([height], [0.0], t0=-lead_time, duration=2 * lead_time)
        assert run.events["impact"].t[0] == pytest.approx(0, abs=1e-15)
        assert run.status == "ok"


FLOOR = """eomc = 1
name = "floored"
[coordinates]
y = {{ start = 1.0 }}
[parameters]
e = 0
count = 0
wet = 0
held = 0
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[forces]
y = "9.81*held - wet*y_dot"
[[event]]
name = "impact"
when = "{when}"
direction = "{direction}"
action = "jump"
{jump}
{other}
[run]
duration = 2.0
h = 0.01
{run}
"""
LANDS = """[[event]]
name = "lands"
when = "y"
action = "jump"
held = "1"
"""


def floor(
    jump: str = 'y_dot = "-e*y_dot"', run: str = "", when: str = "y", direction: str = "falling",
    other: str = "",
) -> ModuleType:  # fmt: skip
    """Return the module of a ball whose impact makes the state jump in a given way."""
    text = FLOOR.format(jump=jump, run=run, when=when, direction=direction, other=other)
    return eomc.load(from_scene(parse(text, "floor.toml")), BUILDS)


@pytest.mark.parametrize("run", RUNS)
def test_run_ends_where_accelerations_drive_a_ball_into_the_floor(run: str) -> None:
    """Regression: after an impact without restitution, the ball fell through the floor."""
    module = floor(run=f"batch = true\n{run}", jump='y_dot = "-e*y_dot"\ncount = "count + 1"')
    for e in (0.0, 1e-12, 1e-8, 1e-7, 3e-7, 1e-6):
        for height in (1e-3, 1.0, 10.0):
            fall = math.sqrt(2 * height / 9.81)
            with pytest.warns(RuntimeWarning, match="ever sooner"):
                bounces = module.simulate({"y": height}, params={"e": e})
            assert bounces.status == "accumulated" and len(bounces.events["impact"]) <= 3
            assert bounces["count"][-1] == len(bounces.events["impact"]) >= 1
            assert bounces.limit == pytest.approx(fall * (1 + 2 * e), rel=1e-13 + 2 * e)
            assert fall * (1 - 1e-13) <= bounces.t[-1] <= bounces.limit
            assert abs(bounces["y"][-1]) < 1e-12
    runs = module.simulate_batch(params={"e": [0, 1e-9, 0.9]})
    assert runs.status.tolist() == ["accumulated", "accumulated", "ok"]


def test_event_of_both_directions_ends_the_run_at_a_contact() -> None:
    bounces = floor(direction="both").simulate()
    assert bounces.status == "accumulated" and len(bounces.events["impact"]) == 1


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(
    "scene",
    [
        {"jump": 'y_dot = "0.001*y_dot"'},  # still the same direction
        {"jump": 'y_dot = "0"\nwet = "1"'},  # another mode
        {"when": "y**3", "jump": 'y_dot = "y_dot/2"'},  # has no rate where it crosses zero
        {"jump": 'count = "count + 1"'},
    ],
    ids=lambda scene: scene["jump"].split("\n")[-1],
)
def test_run_goes_on_where_an_event_function_passes_zero(scene: dict[str, str], run: str) -> None:
    passes = floor(**scene, run=run).simulate()
    assert passes.status == "ok" and len(passes.events["impact"]) == 1 and passes["y"][-1] < -1


@pytest.mark.parametrize("run", RUNS)
def test_another_event_at_the_same_time_may_switch_a_mode(run: str) -> None:
    lands = floor(other=LANDS, run=run).simulate()
    assert lands.status == "ok" and abs(lands["y"][-1]) < 1e-6 and lands["held"][-1] == 1


@pytest.mark.parametrize("run", RUNS)
def test_event_function_that_is_not_a_number_ends_the_run(run: str) -> None:
    """Regression: no event was detected, without a message."""
    module = floor(when="log(y) + 5", run=run)
    with pytest.warns(RuntimeWarning, match="'impact'.*finite"):
        below = module.simulate({"y": -1.0})
    assert below.status == "not finite" and below.stopped == "impact" and below.t.tolist() == [0]


def test_jump_to_no_finite_state_stores_the_state_once() -> None:
    """Regression: two rows at its time."""
    with pytest.warns(RuntimeWarning, match="'impact'.*finite"):
        ends = floor(jump='y_dot = "1/(e*y_dot)"').simulate()
    assert ends.status == "not finite" and (ends.t[1:] > ends.t[:-1]).all()
    assert ends.t[-1] == ends.events["impact"].t[-1]


@pytest.mark.parametrize("run", RUNS)
def test_time_of_an_event_is_that_of_its_rows(run: str) -> None:
    """Regression: an event at the end of a run had a time some roundings from the last row's."""
    module = floor(jump='y_dot = "-y_dot"', run=run)
    fall = math.sqrt(2 / 9.81)
    for roundings in range(-40, 41):
        bounces = module.simulate(duration=fall + roundings * math.ulp(fall))
        assert set(bounces.events["impact"].t) <= set(bounces.t)
