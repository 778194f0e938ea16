"""Rows of `check` about adaptive steps: bounded where events are not, stiff where they say so."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import scene_system
from conftest import Modules

from eomc.model.from_scene import from_scene
from eomc.scene.read import parse
from eomc.verify import checks_adaptive
from eomc.verify.checks_adaptive import BATCH_LIMIT, AdaptiveBatchChecks, AdaptiveRefusalChecks
from eomc.verify.checks_refusals import RefusalChecks
from eomc.verify.comparison import Comparison
from eomc.verify.report import Measurement

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


# steps of 1e-5 s, which a time of 15 s has no digits for in single precision
STIFF = """eomc = 1
name = "stiff_single"
[coordinates]
x = { start = 1.0 }
y = {}
[energy]
kinetic = "x_dot**2/2 + 0.01*y_dot**2/2"
potential = "2*x**2 + 1e4*(y - x**2)**2/2"
dissipation = "50*y_dot**2 + 0.05*x_dot**2"
[run]
tolerance = 1e-4
real = "float"
duration = 20
batch = true
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
    checks_adaptive.report_runs(of)
    assert [row.passed for row in of.results] == [True] * 3, of.results


def test_a_row_of_stiff_steps_takes_them(of: Comparison) -> None:
    """All but those that the reference goes by."""
    stiff = list[bool]()

    class Told:
        Interrupted = of.module.Interrupted

        def simulate(self, *args: Any, **how: Any) -> Any:
            run = of.module.simulate(*args, **how)
            stiff.append(run.stiff_steps == run.steps)
            return run

    checks_adaptive._run_error(of, Told(), 1e-6, True, of.expected[0].state)
    assert stiff.count(True) >= 3 and stiff.count(False) == 1


def test_inputs_that_are_held_are_those_of_all_stages(modules: Modules) -> None:
    """Where steps are too long for sweeps, stages are found by Newton's method, all at once."""
    made = scene_system("cartpole_driven")
    driven = Comparison(made, modules("cartpole_driven"), np.random.default_rng(1), 4)
    s = replace(driven.expected[0].state, u=np.array([0.5]))
    x, times = np.array([*s.q, *s.qd]), np.array([2.5])
    rows, _ = checks_adaptive._reference_states(driven, s, x, times, times)
    assert np.isfinite(rows).all()


@pytest.fixture(scope="module")
def stiff(modules: Modules) -> Comparison:
    made = from_scene(parse(STIFF, "test.toml"))
    of = Comparison(made, modules.unoptimised(STIFF), np.random.default_rng(0), 2)
    late = replace(of.expected[-1].state, t=14.64)
    of.expected[-1] = replace(of.expected[-1], state=late)
    return of


def test_steps_are_judged_where_time_tells_them(
    stiff: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, drive = AdaptiveRefusalChecks(stiff, RefusalChecks(stiff)), AdaptiveRefusalChecks.drive
    assert made.step_limit_violations() == 0
    start, late = (e.state for e in stiff.expected)
    assert made.step_limit_errors(start) == 0 and made.step_limit_errors(late) is None

    def unheard(self: AdaptiveRefusalChecks, *of: Any, h_most: float = 0.0, **how: Any) -> Any:
        return drive(self, *of, **how)

    monkeypatch.setattr(AdaptiveRefusalChecks, "drive", unheard)
    assert made.step_limit_violations() == 1
    monkeypatch.setattr(stiff, "expected", stiff.expected[1:])
    assert isinstance(
        made.step_limit_violations(), Measurement
    )  # nothing is judged, and it says so


def test_steps_of_many_are_judged_where_time_tells_them(stiff: Comparison) -> None:
    many = AdaptiveBatchChecks(stiff, [])
    assert many.state is stiff.expected[0].state
    right = many.compare_with_single_runs()
    assert isinstance(right, float) and right < BATCH_LIMIT

    class Off:
        simulate = staticmethod(stiff.module.simulate)

        def simulate_batch(self, *args: Any, **how: Any) -> Any:
            run = stiff.module.simulate_batch(*args, **how)
            return SimpleNamespace(q=run.q * 1.01, qd=run.qd)

    many.module = Off()
    wrong = many.compare_with_single_runs()
    assert isinstance(wrong, float) and wrong > BATCH_LIMIT
