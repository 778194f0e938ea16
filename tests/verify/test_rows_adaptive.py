"""Rows of `check` about adaptive steps: bounded where events are not, stiff where they say so."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cases import scene_system
from conftest import Modules

from eomc.model.from_scene import from_scene
from eomc.scene.read import parse
from eomc.verify import rows_adaptive
from eomc.verify.comparison import Comparison

# the more it has jumped the sooner it jumps again: without end before 0.17 s
ENDLESS = """eomc = 1
name = "endless"
[coordinates]
x = { unit = "m", start = 0.1, rate = 0.1 }
y = { unit = "m" }
[energy]
kinetic = "x_dot**2/2 + y_dot**2/2"
[forces]
x = "-(1 + y_dot**2)"
[[event]]
name = "again"
when = "x_dot"
direction = "falling"
action = "jump"
x_dot = "x_dot + 0.1"
y_dot = "y_dot + 1"
[run]
h = 0.01
duration = 5.0
tolerance = 1e-6
"""


@pytest.fixture
def of(modules: Modules) -> Comparison:
    made = from_scene(parse(ENDLESS, "test.toml"))
    return Comparison(made, modules.unoptimised(ENDLESS), np.random.default_rng(1), None)


@pytest.fixture
def bounded() -> Iterator[None]:
    def late(*_: Any) -> None:
        pytest.fail("no end in sight")  # no Exception, which rows would keep

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("bounded")
def test_events_without_end_are_left_after_what_is_compared(of: Comparison) -> None:
    """Of a run of 5 s, which would take memory as long as it went on."""
    rows_adaptive.report(of)
    assert [row.passed for row in of.rows] == [True] * 3, of.rows


def test_a_row_of_stiff_steps_takes_them(of: Comparison) -> None:
    """All but those that the reference goes by."""
    stiff = list[bool]()

    class Told:
        Interrupted = of.module.Interrupted

        def simulate(self, *args: Any, **how: Any) -> Any:
            run = of.module.simulate(*args, **how)
            stiff.append(run.stiff_steps == run.steps)
            return run

    rows_adaptive._error(of, Told(), 1e-6, True, of.expected[0].state)
    assert stiff.count(True) >= 3 and stiff.count(False) == 1


def test_inputs_that_are_held_are_those_of_all_stages(modules: Modules) -> None:
    """Where steps are too long for sweeps, stages are found by Newton's method, all at once."""
    made = scene_system("cartpole_driven")
    driven = Comparison(made, modules("cartpole_driven"), np.random.default_rng(1), 4)
    s = replace(driven.expected[0].state, u=np.array([0.5]))
    x, times = np.array([*s.q, *s.qd]), np.array([2.5])
    rows, _ = rows_adaptive._reference(driven, s, x, times, times)
    assert np.isfinite(rows).all()
