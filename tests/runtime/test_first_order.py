"""First-order states as in docs/scenes.md: a motor's current, a controller's integral."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.session import Modules

PAGE = Path(__file__).parents[2] / "docs" / "scenes.md"


@pytest.fixture(scope="module")
def positioned(modules: Modules) -> ModuleType:
    text = PAGE.read_text(encoding="utf-8").split("### States of first order")[1]
    return modules.unoptimised(text.split("```toml\n")[1].split("```")[0])


def rates(t: float, x: Any) -> list[float]:
    """Return the derivatives of the angle, its velocity, the current and the integral."""
    phi, rate, current, total = x
    voltage = np.clip(6 * (1 - phi) + 4 * total - 0.6 * rate, -12, 12)
    push = 0.5 * current - 0.3
    return [rate, push / 0.02, (voltage - 2 * current - 0.5 * rate) / 0.01, 1 - phi]


def test_first_order_states_follow_their_equations(positioned: ModuleType) -> None:
    run = positioned.simulate()
    solution = solve_ivp(rates, (0, 8), [0.2, 0, 0, 0], method="DOP853", rtol=1e-12, atol=1e-12)
    final = [run["phi"][-1], run["phi_dot"][-1], run["charge_dot"][-1], run["sum"][-1]]
    np.testing.assert_allclose(final, solution.y[:, -1], atol=1e-9)
    assert abs(final[0] - 1) < 1e-3 and np.abs(run.multipliers["error"]).max() < 1e-12


def test_steady_current_holds_the_load(positioned: ModuleType) -> None:
    """0.6 A against 0.3 N m, by 1.2 V, which comes from the integral alone."""
    current = [0.0, 0.6, 0.0]
    q, _, u = positioned.equilibrium([1.0, 0.0, 0.0], current)
    assert q == pytest.approx([1.0, 0.0, 0.3], abs=1e-12) and u == pytest.approx([1.2], abs=1e-12)
    A, _ = positioned.linearize(q, current, closed=True)
    T = positioned.tangent(q, current)
    closed = [[0, 1, 0, 0], [0, 0, 25, 0], [-600, -110, -200, 400], [-1, 0, 0, 0]]
    expected = np.append(np.linalg.eigvals(closed), 0)  # the charge itself acts on nothing
    eigenvalues = (
        np.sort_complex(np.round(x, 6) + 0) for x in (np.linalg.eigvals(T.T @ A @ T), expected)
    )
    np.testing.assert_allclose(*eigenvalues, atol=1e-5)
