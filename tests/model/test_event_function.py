"""Events whose formulas jump over zero are refused, because they could not be detected."""

from __future__ import annotations

import pytest
import sympy

from eomc.base.errors import SceneError
from eomc.model.system import System, from_scene
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
[run]
tolerance = 1e-9
"""


def refusal_of(when: str) -> str:
    with pytest.raises(SceneError) as error:
        from_scene(parse(BALL.format(when)))
    return str(error.value)


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
def test_refused_event_suggests_a_continuous_formula(when: str, remedy: str) -> None:
    text = refusal_of(when)
    assert "event.1.when" in text and remedy in text


def test_formulas_that_vary_between_jumps_are_accepted() -> None:
    assert from_scene(parse(BALL.format("y*sign(y_dot) - 0.1"))).events
    assert from_scene(parse(BALL.format("y + heaviside(y - 0.5)"))).events


def test_events_defined_in_sympy_are_checked() -> None:
    y, v = sympy.symbols("y y_dot")
    with pytest.raises(SceneError, match="jumps over zero"):
        System.make("ball", {y: 1.0}, v**2 / 2, events={"impact": sympy.sign(y)})
