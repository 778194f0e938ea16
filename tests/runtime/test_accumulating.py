"""Accumulating jumps (Zeno behaviour): floors at any height, other jumps between the impacts."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import pytest

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

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
