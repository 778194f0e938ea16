"""Checks of `project`, with no coordinates fixed and with some fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system

from eomc.verify import symbolic
from eomc.verify.comparison import CheckResult, Comparison
from eomc.verify.constraints import projection_checks

SYSTEM = scene_system("pendulum_xy")


@dataclass
class Projecting:
    """The reference's `project`, wrong if the number of fixed names is in `wrong`."""

    wrong: tuple[int, ...] = ()
    fixed_names: list[Sequence[str]] = field(default_factory=list)

    def project(self, q: Any, qd: Any, *, t: float, params: Any, fixed: Sequence[str]) -> Any:
        names = [c.name for c in SYSTEM.coordinates]
        indices = tuple(k for k, name in enumerate(names) if name in fixed)
        result = np.array(symbolic.reference_for(SYSTEM).project(q, qd, t, params, indices))
        self.fixed_names.append(fixed)
        free = [k for k in range(len(names)) if k not in indices]
        result[:, free] *= 1 + 1e-9 * (len(fixed) in self.wrong)
        return result


def rows(module: Projecting) -> dict[str, CheckResult]:
    comparison = Comparison(SYSTEM, module, np.random.default_rng(0), 4)
    return {row.name: row for row in comparison.report(projection_checks)}


@pytest.mark.slow
def test_project_is_checked_without_and_with_fixed_coordinates() -> None:
    right = Projecting()
    results = rows(right)
    assert all(row.passed and row.error < 2 for row in results.values())
    assert {len(names) for names in right.fixed_names} == {0, 2}
    for count, fails in ((0, "project"), (2, "project, fixed values")):
        results = rows(Projecting((count,)))
        assert [name for name, row in results.items() if not row.passed] == [fails]


def test_change_of_a_fixed_coordinate_fails() -> None:
    class ChangesFixed(Projecting):
        def project(self, q: Any, qd: Any, **how: Any) -> Any:
            result = super().project(q, qd, **how)
            return result * (1 + 4e-16) if how["fixed"] else result

    results = rows(ChangesFixed())
    assert [name for name, row in results.items() if not row.passed] == ["project, fixed values"]
    assert np.isinf(results["project, fixed values"].error)
