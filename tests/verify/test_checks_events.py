"""Checks of events detect a wrong formula."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from support.session import Modules

from eomc.model.system import System, from_scene, symbol
from eomc.scene.read import parse
from eomc.verify import equations, runs
from eomc.verify.check import check
from eomc.verify.comparison import Comparison

BALL = from_scene(
    parse("""eomc = 1
name = "struck_ball"
[coordinates]
y = { start = 1 }
z = { rate = 0.3 }
[parameters]
e = 0.7
[inputs]
push = {}
[definitions]
height = "y - push/9"
[energy]
kinetic = "(y_dot**2 + z_dot**2)/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "height"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot + dot(y**2)/8 - push"
z = "z + cos(y)"
[[event]]
name = "top"
when = "y_dot*exp(z) - t"
[run]
tolerance = 1e-9
""")
)


@pytest.fixture(scope="module")
def ball(modules: Modules) -> ModuleType:
    return modules.unoptimised(BALL)


def failed_checks(system: System, ball: ModuleType) -> set[str]:
    comparison = Comparison(system, ball, np.random.default_rng(0), 4)
    results = comparison.report(runs.event_function_checks)
    return {row.name for row in results if not row.passed}


def test_correct_module_passes(ball: ModuleType) -> None:
    rows = check(BALL, ball, states=4).results
    assert {"events", "jumps"} <= {row.name for row in rows}
    assert all(row.passed for row in rows)


def test_wrong_event_function_or_jump_fails(ball: ModuleType) -> None:
    impact, top = BALL.events
    later = replace(top, when=top.when + symbol("z") * 1e-9)
    assert failed_checks(replace(BALL, events=(impact, later)), ball) == {"events"}
    (name, speed), place = impact.jump
    harder = replace(impact, jump=((name, -speed), place))
    assert failed_checks(replace(BALL, events=(harder, top)), ball) == {"jumps"}
    other = replace(impact, jump=(place,))  # the velocity is unchanged
    assert failed_checks(replace(BALL, events=(other, top)), ball) == {"jumps"}


ODD = """eomc = 1
name = "odd_places"
[coordinates]
x = { start = 1, rate = 0.3 }
y = { start = 0.5 }
[parameters]
a = 0.3
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "x**2 + 2*y**2"
[[event]]
name = "power"
when = "x**a - 0.8"
action = "jump"
y_dot = "sqrt(y) + 1/y_dot"
[[event]]
name = "logarithm"
when = "log(x)"
[outputs]
r = "sqrt(x)"
[run]
tolerance = 1e-9
"""


def test_complex_values_of_formulas_are_not_compared(modules: Modules) -> None:
    system = from_scene(parse(ODD))
    comparison = Comparison(system, modules.unoptimised(system), np.random.default_rng(0), 8)
    tables = (runs.event_function_checks, equations.output_and_limit_checks)
    results = [row for table in tables for row in comparison.report(table)]
    assert {"events", "jumps", "outputs"} <= {row.name for row in results}
    assert all(row.passed for row in results)
