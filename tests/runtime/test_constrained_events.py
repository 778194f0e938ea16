"""Events under constraints: what a jump's own formulas leave, the rows then move."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import pytest

import eomc
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "constrained_events"
# x hits a wall and would go back as fast; it drags y along, so it goes back half as fast
PULLEY = """eomc = 1
name = "pulley"
[coordinates]
x = { rate = 2 }
y = { friction = "rub" }
[parameters]
push = 0
rub  = 0
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
x_dot = "-x_dot"
[[event]]
name = "turn"
when = "y_dot"
[run]
friction = "stick"
duration = 4
"""


@pytest.fixture(scope="module")
def pulley() -> ModuleType:
    return eomc.load(from_scene(parse(PULLEY, "pulley.toml")), BUILDS)


def test_events_are_on_the_side_where_the_rows_leave_them(pulley: ModuleType) -> None:
    """y was thought to go on as before the jump, so where it turned was not seen."""
    run = pulley.simulate(params={"push": 2.0})
    speed = math.sqrt(5.0)
    hit = 2 * (speed - 2)
    assert run.events["wall"].t[0] == pytest.approx(hit, abs=1e-12)
    assert run.events["turn"].t[0] == pytest.approx(hit + speed, abs=1e-12)


def test_what_the_rows_turn_slides_the_other_way(pulley: ModuleType) -> None:
    """Friction went on as before the jump, and drove what it should have braked."""
    run = pulley.simulate(params={"rub": 4.0})
    hit = 2 - math.sqrt(2.0)
    assert run.events["wall"].t == pytest.approx([hit], abs=1e-12)
    speed = (2 - hit) / 2
    assert run.events["y_stops"].t == pytest.approx([hit + speed], abs=1e-12)
    assert run["x"][-1] == pytest.approx(1 - speed**2 / 2, abs=1e-12)
    assert run["y_slides"][-1] == 0
