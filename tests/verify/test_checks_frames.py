"""The check composes frames of quaternions along a curve, and detects errors in frames."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from runtime.test_frames import SPACE
from support.session import Modules, tiers

from eomc.model.system import from_scene
from eomc.runtime.frames import Momentum, Pose
from eomc.scene.read import parse
from eomc.verify import bodies
from eomc.verify.comparison import CheckResult, Comparison

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


def results_of_frames(comparison: Comparison) -> list[CheckResult]:
    """Return the results of all checks of bodies except those of energies."""
    return [row for row in comparison.report(bodies.checks) if not row.name.endswith("of bodies")]


def failed_checks(comparison: Comparison, module: Any) -> set[str]:
    """Return the names of the checks that fail for a module."""
    right, comparison.module = comparison.module, module
    try:
        results = results_of_frames(comparison)
    finally:
        comparison.module = right
    assert sorted(row.name for row in results) == sorted(ROWS.values())
    return {row.name for row in results if not row.passed}


@pytest.mark.parametrize("name", ["", *ROWS])
def test_wrong_functions_fail(comparison: Comparison, name: str) -> None:
    failures = failed_checks(comparison, Wrong(comparison.module, name))
    # forces are compared with the Jacobians
    also = {"forces at frames"} if name == "jacobian" else set()
    assert failures == ({ROWS[name], *also} if name else set())


@pytest.fixture(scope="module")
def stiff(comparison: Comparison) -> Comparison:
    """Two of the coordinates move as if on stiff springs."""
    of = Comparison(comparison.system, comparison.module, np.random.default_rng(0), 4)
    for sizes, hardly in ((of.sampler.spread, 1e-7), (of.sampler.speed, 1e-4)):
        sizes[[0, -1]] = hardly
    of.expected = of.sampler.states(4)
    return of


@pytest.mark.parametrize("name", tiers(["", "frame_acceleration", "jacobian"], ""))
def test_differences_along_stiff_coordinates_are_not_hidden_by_rounding(
    stiff: Comparison, name: str
) -> None:
    """Lines for differences used to be shorter than the range of such a coordinate."""
    also = {"forces at frames"} if name == "jacobian" else set()
    failures = failed_checks(stiff, Wrong(stiff.module, name))
    assert failures == ({ROWS[name], *also} if name else set())


@pytest.mark.slow
def test_coupled_joints(modules: Modules) -> None:
    """Formulas of coordinates give rates and accelerations with slopes and drift."""
    text = SPACE.replace(
        'coordinates = ["phi", "psi"]', 'coordinates = ["phi*psi", "sin(psi) - x"]'
    )
    module = modules.unoptimised(text.replace("crane3", "crane4"))
    system = from_scene(parse(text.replace("crane3", "crane4"), "test.toml"))
    comparison = Comparison(system, module, np.random.default_rng(0), 6)
    results = results_of_frames(comparison)
    assert len(results) == len(ROWS)
    assert all(row.passed for row in results), results
