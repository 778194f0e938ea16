"""Checks of events with fixed steps detect errors."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.model.system import from_scene
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify import runs
from eomc.verify.check import check
from eomc.verify.comparison import Comparison

SCENE = """eomc = 1
name = "told_swing"
[coordinates]
theta = { unit = "rad", start = 1.0 }
[energy]
kinetic = "theta_dot**2/2"
potential = "-9.81*cos(theta)"
[[event]]
name = "below"
when = "theta"
[[event]]
name = "wall"
when = "theta + 0.8"
direction = "falling"
action = "jump"
theta_dot = "-0.9*theta_dot"
[run]
tolerance = 1e-9
h = 0.05
"""
SWING = from_scene(parse(SCENE))


@pytest.fixture(scope="module")
def swing(modules: Modules) -> ModuleType:
    return modules.unoptimised(SWING)


class ModuleWithChangedRuns:
    """A module whose runs are changed before they are returned."""

    def __init__(self, module: Any, change: Any) -> None:
        self.module, self.change = module, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def simulate(self, *args: Any, **how: Any) -> Any:
        run = self.module.simulate(*args, **how)
        self.change(run)
        return run


def without_one_event(run: Any) -> None:
    """Remove one event from the results."""
    which, rows = run.event_data
    run.event_data = which[which != 0], rows[which != 0]


def late(run: Any) -> None:
    """Replace the state at each event by that of a moment later."""
    which, rows = run.event_data
    run.event_data = which, rows + np.array([0, 1e-9, 0])


def perturbed_row(run: Any) -> None:
    """Perturb one row."""
    run.rows[1][len(run) // 2] += 1e-9


def check_events(module: Any) -> Any:
    comparison = Comparison(SWING, module, np.random.default_rng(0), 4, None)
    results = comparison.report(runs.event_checks)
    (result,) = (row for row in results if row.name not in ("events", "jumps"))
    assert result.name == "events in steps of rk4"
    assert not model_of(module).integrator.ignores_events
    return result


def test_correct_module_passes(swing: ModuleType) -> None:
    check(SWING, swing, states=4)
    assert swing.simulate(h=0.05, duration=2.0).events["wall"]  # confirms that there are events
    result = check_events(swing)
    assert result.passed and result.judged and result.error < 10


@pytest.mark.parametrize("change", [without_one_event, late, perturbed_row])
def test_wrong_module_fails(swing: ModuleType, change: Any) -> None:
    assert not check_events(ModuleWithChangedRuns(swing, change)).passed
