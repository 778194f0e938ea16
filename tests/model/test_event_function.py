"""Events whose formulas jump over zero are refused: they would never happen."""

from __future__ import annotations

import pytest
import sympy

from eomc.base.errors import SceneError
from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.scene.read import parse

BALL = """eomc = 1
name = "ball"
[coordinates]
y = {{ start = 1 }}
[parameters]
m = 1.0
[definitions]
side = "sign(y - 0.5)"
[energy]
kinetic = "m*y_dot**2/2"
potential = "m*9.81*y"
[[event]]
name = "impact"
when = "{}"
"""


def refusal(when: str) -> str:
    with pytest.raises(SceneError) as fault:
        from_scene(parse(BALL.format(when)))
    return str(fault.value)


@pytest.mark.parametrize(
    ("when", "remedy"),
    [
        ("heaviside(y) - 0.5", 'write when = "y"'),
        ("m*sign(y - t)", 'write when = "-t + y"'),
        ("side", 'write when = "y - 1/2"'),
        ("y > 0.9", 'write "y - 0.9"'),
        ("y_dot <= m*t + 1", 'write "y_dot - (m*t + 1)"'),
    ],
)
def test_what_it_should_watch_is_told(when: str, remedy: str) -> None:
    text = refusal(when)
    assert "event.1.when" in text and remedy in text


def test_what_jumps_and_moves_may_be_watched() -> None:
    assert from_scene(parse(BALL.format("y*sign(y_dot) - 0.1"))).events
    assert from_scene(parse(BALL.format("y + heaviside(y - 0.5)"))).events


def test_of_sympy_too() -> None:
    y, v = sympy.symbols("y y_dot")
    with pytest.raises(SceneError, match="jumps over zero"):
        System.make("ball", {y: 1.0}, v**2 / 2, events={"impact": sympy.sign(y)})
