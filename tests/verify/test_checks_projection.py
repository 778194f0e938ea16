"""Checks of `project`, with no coordinates fixed and with some fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from cases import scene_system
from stand_in import StandIn

from eomc.verify import symbolic
from eomc.verify.checks_constraints import ProjectionChecks, report_projection
from eomc.verify.comparison import Comparison
from eomc.verify.report import CheckResult

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


def rows(monkeypatch: pytest.MonkeyPatch, module: Projecting) -> dict[str, CheckResult]:
    monkeypatch.setattr(ProjectionChecks, "wrong_refusals", lambda _: 0.0)  # they call a C function
    random = np.random.default_rng(0)
    comparison = Comparison(SYSTEM, StandIn(symbolic.reference_for(SYSTEM)), random, 4)
    report_projection(comparison, module, "")
    return {row.name: row for row in comparison.results}


@pytest.mark.slow
def test_project_is_checked_without_and_with_fixed_coordinates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = Projecting()
    results = rows(monkeypatch, right)
    assert all(row.passed and row.error < 2 for row in results.values())
    assert {len(names) for names in right.fixed_names} == {0, 2}
    for count, fails in ((0, "project"), (2, "project, held")):
        results = rows(monkeypatch, Projecting((count,)))
        assert [name for name, row in results.items() if not row.passed] == [fails]


def test_change_of_a_fixed_coordinate_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    class ChangesFixed(Projecting):
        def project(self, q: Any, qd: Any, **how: Any) -> Any:
            result = super().project(q, qd, **how)
            return result * (1 + 4e-16) if how["fixed"] else result

    results = rows(monkeypatch, ChangesFixed())
    assert [name for name, row in results.items() if not row.passed] == ["project, held"]
    assert np.isinf(results["project, held"].error)
