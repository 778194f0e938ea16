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
from eomc.verify import checks_bodies
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


def failed(of: Comparison, module: Any) -> set[str]:
    """The rows that do not pass of a module in the comparison's place."""
    right, of.results, of.module = of.module, [], module
    try:
        checks_bodies.report_frames(of, of.system.scene)
        checks_bodies.report_inverse_dynamics(of)
    finally:
        of.module = right
    return {row.name for row in of.results if not row.passed}


@pytest.mark.parametrize("name", ["", *ROWS])
def test_wrong_ones_fail(comparison: Comparison, name: str) -> None:
    found = failed(comparison, Wrong(comparison.module, name))
    assert sorted(row.name for row in comparison.results) == sorted(ROWS.values())
    # forces are held against the Jacobians
    also = {"forces at frames"} if name == "jacobian" else set()
    assert found == ({ROWS[name], *also} if name else set()), comparison.results


@pytest.fixture(scope="module")
def stiff(comparison: Comparison) -> Comparison:
    """Two of the coordinates move as on stiff springs."""
    of = Comparison(comparison.system, comparison.module, np.random.default_rng(0), 4)
    for sizes, hardly in ((of.sampler.spread, 1e-7), (of.sampler.speed, 1e-4)):
        sizes[[0, -1]] = hardly
    of.expected = of.sampler.states(4)
    return of


@pytest.mark.parametrize("name", ["", "frame_acceleration", "jacobian"])
def test_of_what_hardly_moves_differences_are_no_rounding(stiff: Comparison, name: str) -> None:
    """They were, along lines no longer than such a coordinate's way."""
    also = {"forces at frames"} if name == "jacobian" else set()
    found = failed(stiff, Wrong(stiff.module, name))
    assert found == ({ROWS[name], *also} if name else set()), stiff.results


@pytest.mark.slow
def test_joints_that_move_together(modules: Modules) -> None:
    """By formulas of coordinates: rates and accelerations have slopes and drift."""
    text = SPACE.replace(
        'coordinates = ["phi", "psi"]', 'coordinates = ["phi*psi", "sin(psi) - x"]'
    )
    module = modules.unoptimised(text.replace("crane3", "crane4"))
    made = from_scene(parse(text.replace("crane3", "crane4"), "test.toml"))
    comparison = Comparison(made, module, np.random.default_rng(0), 6)
    checks_bodies.report_frames(comparison, made.scene)
    checks_bodies.report_inverse_dynamics(comparison)
    assert len(comparison.results) == len(ROWS)
    assert all(row.passed for row in comparison.results), comparison.results
