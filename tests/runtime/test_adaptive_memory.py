"""Adaptive runs use no more memory than the machine has, also under endless jumps."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest
from support.session import Modules

# jumps follow ever faster: the n-th comes 0.1/(1 + n^2) s after the one before
ENDLESS = """eomc = 1
name = "endless_jumps"
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
duration = 5.0
tolerance = 1e-6
"""
MEMORY = 5_000_000  # bytes, replaces the machine's
ROW = 5 * 8
CALL = 3 * 1024 * ROW  # two rows and an event each, of one call of C
# s, the accumulation point, which no jump reaches
ACCUMULATION_TIME = 0.05 * (1 + np.pi / np.tanh(np.pi))


@pytest.fixture(scope="module")
def endless(modules: Modules) -> ModuleType:
    return modules.unoptimised(ENDLESS)


@pytest.fixture(autouse=True)
def limit_memory(endless: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pretend that the machine has 5 MB."""
    memory = sys.modules[f"{endless.__name__}._runtime.integration"]
    monkeypatch.setattr(memory, "machine_memory", lambda: MEMORY)


def test_endless_jumps_end_the_run_when_memory_is_full(endless: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match=r"\d+ steps, .* 40 % .* memory.*times=.*duration="):
        run = endless.simulate()
    events = run.events["again"]
    assert run.status == "out of memory" and run.stopped == ""
    assert 0.39 * MEMORY < (len(run) + len(events)) * ROW < 0.4 * MEMORY + CALL
    assert len(events) > 10_000
    gaps = 0.1 / (1 + np.arange(1.0, 50) ** 2)
    np.testing.assert_allclose(np.diff(events.t[:50]), gaps, rtol=1e-9)
    assert events.t[-1] <= run.t[-1] < ACCUMULATION_TIME
    with pytest.raises(MemoryError, match=r"estimate: rows and events fill 40 %.*times="):
        run.estimate()


def test_endless_jumps_with_few_rows_end_the_run(endless: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match="duration="):
        run = endless.simulate(times=[0.1, 0.2, 0.3])
    assert run.status == "out of memory" and run.t.tolist() == [0.1, 0.2]
    assert 0.39 * MEMORY < len(run.events["again"]) * ROW < 0.4 * MEMORY + CALL


def test_run_that_fits_into_memory_completes(endless: ModuleType) -> None:
    assert endless.simulate(duration=0.2075).status == "ok"


def test_more_output_times_than_memory_are_refused(endless: ModuleType) -> None:
    with pytest.raises(MemoryError, match=r"200001 rows of 5 numbers don't fit.*fewer times="):
        endless.simulate(times=np.linspace(0.0, 0.1, 200_001))
