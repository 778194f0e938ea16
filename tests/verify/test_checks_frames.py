"""The check composes frames of quaternions along a curve, and detects errors in frames."""

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
    """The module with the last number of one function slightly changed."""

    def __init__(self, module: ModuleType, name: str) -> None:
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        whole = getattr(self._module, name)
        if name != self._name:
            return whole

        def changed(*state: Any, **how: Any) -> Any:
            result = whole(*state, **how)
            last = np.array(result[-1] if isinstance(result, tuple) else result)
            last.flat[-1] += 1e-6 * (1 + np.max(np.abs(last)))
            if isinstance(result, (Pose, Momentum)):
                return type(result)(*result[:-1], last)
            return last

        return changed


@pytest.fixture(scope="module")
def comparison(modules: Modules) -> Comparison:
    system = from_scene(parse(SPACE, "test.toml"))
    return Comparison(system, modules.unoptimised(SPACE), np.random.default_rng(0), 6)


def failed_checks(comparison: Comparison, module: Any) -> set[str]:
    """Return the names of the checks that fail for a module."""
    right, comparison.results, comparison.module = comparison.module, [], module
    try:
        checks_bodies.report_frames(comparison, comparison.system.scene)
        checks_bodies.report_inverse_dynamics(comparison)
    finally:
        comparison.module = right
    return {row.name for row in comparison.results if not row.passed}


@pytest.mark.parametrize("name", ["", *ROWS])
def test_wrong_functions_fail(comparison: Comparison, name: str) -> None:
    failures = failed_checks(comparison, Wrong(comparison.module, name))
    assert sorted(row.name for row in comparison.results) == sorted(ROWS.values())
    # forces are compared with the Jacobians
    also = {"forces at frames"} if name == "jacobian" else set()
    assert failures == ({ROWS[name], *also} if name else set()), comparison.results


@pytest.fixture(scope="module")
def stiff(comparison: Comparison) -> Comparison:
    """Two of the coordinates move as if on stiff springs."""
    of = Comparison(comparison.system, comparison.module, np.random.default_rng(0), 4)
    for sizes, hardly in ((of.sampler.spread, 1e-7), (of.sampler.speed, 1e-4)):
        sizes[[0, -1]] = hardly
    of.expected = of.sampler.states(4)
    return of


@pytest.mark.parametrize("name", ["", "frame_acceleration", "jacobian"])
def test_differences_along_stiff_coordinates_are_not_hidden_by_rounding(
    stiff: Comparison, name: str
) -> None:
    """Lines for differences used to be shorter than the range of such a coordinate."""
    also = {"forces at frames"} if name == "jacobian" else set()
    failures = failed_checks(stiff, Wrong(stiff.module, name))
    assert failures == ({ROWS[name], *also} if name else set()), stiff.results


@pytest.mark.slow
def test_coupled_joints(modules: Modules) -> None:
    """Formulas of coordinates give rates and accelerations with slopes and drift."""
    text = SPACE.replace(
        'coordinates = ["phi", "psi"]', 'coordinates = ["phi*psi", "sin(psi) - x"]'
    )
    module = modules.unoptimised(text.replace("crane3", "crane4"))
    system = from_scene(parse(text.replace("crane3", "crane4"), "test.toml"))
    comparison = Comparison(system, module, np.random.default_rng(0), 6)
    checks_bodies.report_frames(comparison, system.scene)
    checks_bodies.report_inverse_dynamics(comparison)
    assert len(comparison.results) == len(ROWS)
    assert all(row.passed for row in comparison.results), comparison.results
