"""The check composes frames of quaternions along a bent line, and finds what is wrong with them."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from conftest import Modules
from runtime.test_frames import SPACE

from eomc.model.from_scene import from_scene
from eomc.runtime.frames import Momentum, Pose
from eomc.scene.read import parse
from eomc.verify import rows_frames
from eomc.verify.comparison import Comparison

ROWS = {
    "pose": "poses of frames",
    "frame_velocity": "velocities of frames",
    "frame_acceleration": "accelerations of frames",
    "jacobian": "Jacobians of frames",
    "frame_forces": "forces at frames",
    "momentum": "momentum",
    "inverse_dynamics": "inverse dynamics",
}


class Wrong:
    """The module with one function's last number a little off."""

    def __init__(self, module: ModuleType, name: str) -> None:
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        whole = getattr(self._module, name)
        if name != self._name:
            return whole

        def off(*state: Any, **how: Any) -> Any:
            found = whole(*state, **how)
            last = np.array(found[-1] if isinstance(found, tuple) else found)
            last.flat[-1] += 1e-6 * (1 + np.max(np.abs(last)))
            if isinstance(found, (Pose, Momentum)):
                return type(found)(*found[:-1], last)
            return last

        return off


@pytest.fixture(scope="module")
def comparison(modules: Modules) -> Comparison:
    made = from_scene(parse(SPACE, "test.toml"))
    return Comparison(made, modules.unoptimised(SPACE), np.random.default_rng(0), 6)


@pytest.mark.parametrize("name", ["", *ROWS])
def test_wrong_ones_fail(comparison: Comparison, name: str) -> None:
    system, module = comparison.system, comparison.module
    comparison.rows = []
    made = Wrong(module, name)
    comparison.module = made
    try:
        rows_frames.report(comparison, system.scene)
        rows_frames.inverse_dynamics(comparison)
    finally:
        comparison.module = module
    assert sorted(row.name for row in comparison.rows) == sorted(ROWS.values())
    failed = {row.name for row in comparison.rows if not row.passed}
    # forces are held against the Jacobians
    also = {"forces at frames"} if name == "jacobian" else set()
    assert failed == ({ROWS[name], *also} if name else set()), comparison.rows


@pytest.mark.slow
def test_joints_that_move_together(modules: Modules) -> None:
    """By formulas of coordinates: rates and accelerations have slopes and drift."""
    text = SPACE.replace(
        'coordinates = ["phi", "psi"]', 'coordinates = ["phi*psi", "sin(psi) - x"]'
    )
    module = modules.unoptimised(text.replace("crane3", "crane4"))
    made = from_scene(parse(text.replace("crane3", "crane4"), "test.toml"))
    comparison = Comparison(made, module, np.random.default_rng(0), 6)
    rows_frames.report(comparison, made.scene)
    rows_frames.inverse_dynamics(comparison)
    assert len(comparison.rows) == len(ROWS)
    assert all(row.passed for row in comparison.rows), comparison.rows
