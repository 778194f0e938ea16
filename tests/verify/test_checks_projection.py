"""Rows about `project`: each of what it is named for, nothing held or something."""

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
    """The reference's `project`, wrong by a part where as many names are held as are said."""

    wrong: tuple[int, ...] = ()
    asked: list[Sequence[str]] = field(default_factory=list)

    def project(self, q: Any, qd: Any, *, t: float, params: Any, fixed: Sequence[str]) -> Any:
        names = [c.name for c in SYSTEM.coordinates]
        of = tuple(k for k, name in enumerate(names) if name in fixed)
        found = np.array(symbolic.reference_for(SYSTEM).project(q, qd, t, params, of))
        self.asked.append(fixed)
        free = [k for k in range(len(names)) if k not in of]
        found[:, free] *= 1 + 1e-9 * (len(fixed) in self.wrong)
        return found


def rows(monkeypatch: pytest.MonkeyPatch, module: Projecting) -> dict[str, CheckResult]:
    monkeypatch.setattr(ProjectionChecks, "wrong_refusals", lambda _: 0.0)  # which ask a C function
    random = np.random.default_rng(0)
    made = Comparison(SYSTEM, StandIn(symbolic.reference_for(SYSTEM)), random, 4)
    report_projection(made, module, "")
    return {row.name: row for row in made.results}


@pytest.mark.slow
def test_states_are_put_back_with_nothing_held_and_with_one_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = Projecting()
    found = rows(monkeypatch, right)
    assert all(row.passed and row.error < 2 for row in found.values())
    assert {len(held) for held in right.asked} == {0, 2}
    for count, fails in ((0, "project"), (2, "project, held")):
        found = rows(monkeypatch, Projecting((count,)))
        assert [name for name, row in found.items() if not row.passed] == [fails]


def test_what_is_held_and_moves_all_the_same_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    class Loose(Projecting):
        def project(self, q: Any, qd: Any, **how: Any) -> Any:
            found = super().project(q, qd, **how)
            return found * (1 + 4e-16) if how["fixed"] else found

    found = rows(monkeypatch, Loose())
    assert [name for name, row in found.items() if not row.passed] == ["project, held"]
    assert np.isinf(found["project, held"].error)
