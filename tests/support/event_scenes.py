"""Scenes with events that several test files use."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse
from support.cases import SCENES

BUILDS = SCENES.parent / "build" / "tests" / "events"
G = 9.81
BALL = """eomc = 1
name = "bouncing"
[coordinates]
x = { unit = "m", rate = 1 }
y = { unit = "m", start = 1 }
[parameters]
e = 0.8
wall = 100
far = 1e9
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[[event]]
name = "top"
when = "y_dot"
direction = "falling"
[[event]]
name = "corner"
when = "wall - x"
action = "jump"
x_dot = "-x_dot"
[[event]]
name = "away"
when = "x - far"
action = "stop"
[run]
tolerance = 1e-9
duration = 3
batch = true
"""


def built(text: str) -> ModuleType:
    return eomc.load(from_scene(parse(text, "events.toml")), BUILDS)


ADAPTIVE = "[run]\ntolerance = 1e-9\n"
FREE = """eomc = 1
name = "{name}"
[coordinates]
x = {{ rate = 1 }}
[parameters]
a = 0
first = 1e9
second = 1e9
wall = 1e9
gap = 1e9
[energy]
kinetic = "x_dot**2/2"
potential = "-a*x"
{events}
"""


def event(name: str, when: str, *lines: str) -> str:
    return "\n".join(["[[event]]", f'name = "{name}"', f'when = "{when}"', *lines])


def impacts(e: float, count: int) -> np.ndarray:
    """Return the times of the first impacts, by the formula."""
    times = [math.sqrt(2 / G)]
    for k in range(1, count):
        times.append(times[-1] + 2 * math.sqrt(2 * G) * e**k / G)
    return np.array(times)
