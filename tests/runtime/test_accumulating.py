"""Where jumps accumulate: from floors anywhere, and with other jumps between them."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import pytest

import eomc
from eomc.model.from_scene import from_scene
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
@pytest.mark.parametrize("apart", [0.0, 1e6])  # whether it is counted at the top, or never
def test_a_ball_does_not_fall_through_its_floor(
    ball: ModuleType, e: float, ground: float, apart: float
) -> None:
    """It did where rounding of `when` was not seen or another event jumped in between; or hung."""
    params = {"e": e, "ground": ground, "apart": apart}
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        run = ball.simulate([ground + 1.0, 0.0], [0.0, 0.0], duration=10.0, params=params)
    assert run.status == "accumulated" and run.steps < 700
    limit = math.sqrt(2 / 9.81) * (1 + e) / (1 - e)
    assert run.limit == pytest.approx(limit, rel=1e-8 if ground < 2 else 1e-6)
    assert (run["count"][-1] > 3) == (apart == 0)


def test_a_jump_at_zero_time_ends(ball: ModuleType) -> None:
    """Looks that are some roundings of the time apart were none apart there, for ever."""
    for before in (1.0, 0.3, 1e-3):
        start = 9.81 / 2 * before**2
        run = ball.simulate([start], [0.0], t0=-before, duration=2 * before)
        assert run.events["impact"].t[0] == pytest.approx(0, abs=1e-15)
        assert run.status == "ok"
