"""Derivatives in single precision may have rounding errors, and no larger ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system
from support.fake_module import FakeModule

from eomc.verify import equations, symbolic
from eomc.verify.comparison import Comparison
from eomc.verify.sampling import State


@pytest.mark.parametrize("rounding", [0.0, 3.0, 500.0])
def test_tolerance_of_derivatives_includes_rounding_of_accelerations(
    monkeypatch: pytest.MonkeyPatch, rounding: float
) -> None:
    """In roundings of the acceleration; derivatives that no rounding changes add nothing."""
    system = scene_system("mass_spring")
    module: Any = FakeModule(symbolic.reference_for(system))
    module.dtype = "float32"
    comparison = Comparison(system, module, np.random.default_rng(0), 4)
    e = next(e for e in comparison.expected if np.all(e.value["acceleration"]))
    monkeypatch.setattr(equations, "module_derivatives", lambda *_: np.ones((1, 2)))
    monkeypatch.setattr(
        module,
        "acceleration",
        lambda *_, **__: e.value["acceleration"] * (1 + rounding * comparison.eps),
    )
    growth = equations.rounding_growth(comparison, "linearize", e, np.ones((1, 2)))
    assert growth == pytest.approx(rounding, rel=1e-6, abs=1e-6)


def test_tolerance_of_derivatives_includes_rounding_of_the_state(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Inputs are changed one after the other, and the effects are added."""
    system = scene_system("mass_spring")
    comparison = Comparison(
        system, FakeModule(symbolic.reference_for(system)), np.random.default_rng(0), 4
    )
    e = comparison.expected[-1]
    e = replace(
        e, value={**e.value, "acceleration": comparison.module_value("acceleration", e.state)}
    )

    def powers(_: Comparison, __: str, s: State) -> Any:
        return np.array([[s.q[0] ** 3 * s.qd[0] ** 2]])

    monkeypatch.setattr(equations, "module_derivatives", powers)
    growth = equations.rounding_growth(comparison, "linearize", e, powers(comparison, "", e.state))
    assert growth == pytest.approx(5, rel=1e-3)
