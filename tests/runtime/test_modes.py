"""What events alone change, as coordinates of their own: friction that sticks, by closed forms."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import ModuleType

import cases
import numpy as np
import pytest
from conftest import Modules

PAGE = Path(__file__).parents[2] / "docs" / "adaptive.md"
RUBBED = """eomc = 1
name = "rubbed_block"
[coordinates]
x = { start = 1.0 }
s = { start = -1 }
[parameters]
m  = 1.0
k  = 10.0
mu = 0.1
g  = 9.81
[energy]
kinetic = "m*x_dot**2/2 + s_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "-mu*m*g*s + k*x*(1 - s**2)"
[outputs]
slides = "sign(x_dot)"
[[event]]
name = "turns"
when = "x_dot*s"
direction = "falling"
action = "jump"
x_dot = "0"
s = "-sign(x)*heaviside(k*abs(x) - mu*m*g)"
[run]
tolerance = 1e-12
"""


@pytest.fixture(scope="module")
def block(modules: Modules) -> ModuleType:
    return modules.unoptimised(RUBBED)


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
def test_a_block_comes_to_rest_where_it_should(block: ModuleType, tol: float) -> None:
    run = cases.block_at_rest(block, tol)
    assert run.qd[-1].tolist() == [0, 0] and run.slides[1] == -1 and run.slides[-1] == 0


def test_a_block_on_a_belt_sticks_and_slides(modules: Modules) -> None:
    """The scene of the page."""
    text = re.search(r"```toml\n(eomc = 1\nname = \"on_a_belt\".*?)```", PAGE.read_text(), re.S)
    assert text
    run = modules.unoptimised(text[1]).simulate()
    rate, speed = math.sqrt(10.0), 0.1
    far, middle = 0.4 * 9.81 / 10, 0.3 * 9.81 / 10  # it starts to slide; slides about
    slides = 2 * (math.pi - math.atan(rate * (far - middle) / speed)) / rate
    starts, stops = run.events["starts"].t, run.events["stops"].t
    assert run.status == "ok" and len(starts) == len(stops) == 18
    assert starts[0] == pytest.approx(far / speed, rel=1e-13)
    np.testing.assert_allclose(stops - starts, slides, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.diff(starts), slides + 2 * (far - middle) / speed, atol=1e-12)
