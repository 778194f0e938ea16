"""Checks of adaptive steps: bounded if events accumulate, stiff steps where they are expected."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system
from support.session import Modules
from support.template_checks.adaptive import BATCH_LIMIT, AdaptiveBatchChecks, AdaptiveRefusalChecks
from support.template_checks.refusals import RefusalChecks

from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import runs
from eomc.verify.comparison import Comparison, Measurement

# the intervals between jumps shrink: they accumulate before 0.17 s
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


# steps of 1e-5 s, which single precision cannot resolve at a time of 15 s
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
def endless(modules: Modules) -> Comparison:
    system = from_scene(parse(ENDLESS, "test.toml"))
    return Comparison(system, modules.unoptimised(ENDLESS), np.random.default_rng(1), None)


@pytest.fixture
def bounded() -> Iterator[None]:
    def late(*_: Any) -> None:
        pytest.fail("no end in sight")  # not an Exception, which checks would catch

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("bounded")
def test_accumulating_events_are_not_simulated_beyond_the_compared_time(
    endless: Comparison,
) -> None:
    """A full run of 5 s would need memory as long as it continued."""
    results = endless.report(runs.adaptive_checks)
    assert [row.passed for row in results] == [True] * 3, results


def test_check_of_stiff_steps_takes_stiff_steps(endless: Comparison) -> None:
    """All runs are stiff except the reference's."""
    stiff = list[bool]()

    class RecordingModule:
        Interrupted = endless.module.Interrupted

        def simulate(self, *args: Any, **how: Any) -> Any:
            run = module.simulate(*args, **how)
            stiff.append(run.stiff_steps == run.steps)
            return run

    module, endless.module = endless.module, RecordingModule()
    runs.adaptive_error(1e-6, True, endless, endless.expected[0])
    assert stiff.count(True) >= 3 and stiff.count(False) == 1


def test_constant_inputs_apply_to_all_stages(modules: Modules) -> None:
    """If steps are too long for fixed-point iteration, Newton's method solves all stages at
    once.
    """
    system = scene_system("cartpole_driven")
    driven = Comparison(system, modules("cartpole_driven"), np.random.default_rng(1), 4)
    s = replace(driven.expected[0].state, u=np.array([0.5]))
    times = np.array([2.5])
    rows, _ = runs.accurate_states(driven, s, times, times)
    assert np.isfinite(rows).all()


@pytest.fixture(scope="module")
def stiff(modules: Modules) -> Comparison:
    system = from_scene(parse(STIFF, "test.toml"))
    comparison = Comparison(system, modules.unoptimised(STIFF), np.random.default_rng(0), 2)
    late = replace(comparison.expected[-1].state, t=300.0)
    comparison.expected[-1] = replace(comparison.expected[-1], state=late)
    return comparison


def test_steps_are_judged_if_time_resolves_them(
    stiff: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks, drive = AdaptiveRefusalChecks(stiff, RefusalChecks(stiff)), AdaptiveRefusalChecks.drive
    assert checks.step_limit_violations() == 0
    start, late = (e.state for e in stiff.expected)
    assert checks.step_limit_errors(start) == 0 and checks.step_limit_errors(late) is None

    def refuse_without_limit(
        self: AdaptiveRefusalChecks, *args: Any, max_step: float = 0.0, **how: Any
    ) -> Any:
        return drive(self, *args, **how)

    monkeypatch.setattr(AdaptiveRefusalChecks, "drive", refuse_without_limit)
    assert checks.step_limit_violations() == 1
    monkeypatch.setattr(stiff, "expected", stiff.expected[1:])
    assert isinstance(checks.step_limit_violations(), Measurement)


def test_batch_steps_are_judged_if_time_resolves_them(stiff: Comparison) -> None:
    many = AdaptiveBatchChecks(stiff, [])
    assert many.state is stiff.expected[0].state
    right = many.compare_with_single_runs()
    assert isinstance(right, float) and right < BATCH_LIMIT

    class PerturbedBatch:
        simulate = staticmethod(stiff.module.simulate)

        def simulate_batch(self, *args: Any, **how: Any) -> Any:
            run = stiff.module.simulate_batch(*args, **how)
            return SimpleNamespace(q=run.q * 1.01, qd=run.qd)

    many.module = PerturbedBatch()
    wrong = many.compare_with_single_runs()
    assert isinstance(wrong, float) and wrong > BATCH_LIMIT
