"""Derivatives in single precision are allowed what rounding makes of them, and no more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cases import scene_system
from stand_in import StandIn

from eomc.verify import checks_derivatives, symbolic
from eomc.verify.comparison import Comparison
from eomc.verify.sampling import State


@pytest.mark.parametrize("lost", [0.0, 3.0, 500.0])
def test_what_accelerations_lose_is_allowed_to_derivatives(
    monkeypatch: pytest.MonkeyPatch, lost: float
) -> None:
    """In roundings of the acceleration; derivatives that no rounding moves add nothing."""
    system = scene_system("mass_spring")
    module: Any = StandIn(symbolic.reference_for(system))
    module.dtype = "float32"
    made = Comparison(system, module, np.random.default_rng(0), 4)
    e = next(e for e in made.expected if np.all(e.value["acceleration"]))
    monkeypatch.setattr(checks_derivatives, "module_derivatives", lambda *_: np.ones((1, 2)))
    monkeypatch.setattr(
        module, "acceleration", lambda *_, **__: e.value["acceleration"] * (1 + lost * made.eps)
    )
    found = checks_derivatives._rounding_growth(made, "linearize", e, np.ones((1, 2)))
    assert found == pytest.approx(lost, rel=1e-6, abs=1e-6)


def test_what_a_rounding_of_the_state_moves_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs are changed one after the other, and what each moves is added."""
    system = scene_system("mass_spring")
    made = Comparison(system, StandIn(symbolic.reference_for(system)), np.random.default_rng(0), 4)
    e = made.expected[-1]
    e = replace(e, value={**e.value, "acceleration": made.module_value("acceleration", e.state)})

    def powers(_: Comparison, __: str, s: State) -> Any:
        return np.array([[s.q[0] ** 3 * s.qd[0] ** 2]])

    monkeypatch.setattr(checks_derivatives, "module_derivatives", powers)
    found = checks_derivatives._rounding_growth(made, "linearize", e, powers(made, "", e.state))
    assert found == pytest.approx(5, rel=1e-3)
