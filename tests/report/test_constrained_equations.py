"""Equations and reference solutions of scenes with constraints."""

from __future__ import annotations

from pathlib import Path

import pytest
import sympy

import eomc
from eomc.model.symbols import symbol
from eomc.report import equations, reference_solution

WINCH = """
eomc = 1
name = "winch"
[coordinates]
x = { start = 0.3 }
y = { start = -0.95, guess = true }
[parameters]
m = 1.0
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "9.81*m*y"
[constraints]
rod = "x**2 + y**2 - (1 + t/10)**2"
"""


@pytest.fixture
def winch(tmp_path: Path) -> Path:
    """A pendulum whose rod grows."""
    (tmp_path / "winch.toml").write_text(WINCH, encoding="utf-8")
    return tmp_path / "winch.toml"


def test_equations_have_the_force_of_the_constraint_and_the_constraint(winch: Path) -> None:
    found = eomc.equations(winch)
    m, x, y, rod = map(symbol, ("m", "x", "y", "lambda_rod"))
    by_hand = sympy.Eq(m * symbol("x_ddot"), 2 * x * rod)
    assert found.scalar[0] == by_hand
    assert found.scalar[1].rhs == 2 * y * rod
    assert sympy.ImmutableMatrix([[2 * x, 2 * y]]) == found.A
    text = str(found)
    assert "D q̈ + C q̇ + g = Aᵀλ" in text and "= 2⋅λ_rod⋅x" in text
    assert "rod: of positions" in text
    namespace: dict[str, object] = {}
    exec(equations.written(found.system, "python"), namespace)  # our own text
    assert namespace["scalar"][0] == found.scalar[0]  # type: ignore[index]
    assert r"\lambda_{\mathrm{rod}} x" in equations.written(found.system, "latex")


@pytest.mark.slow
def test_a_reference_solution_is_that_of_the_plain_equations(winch: Path, tmp_path: Path) -> None:
    found = reference_solution.of(eomc.read(winch), 0.5, 4, tmp_path)
    assert found.plain is not None
    accelerations, motion, until = found.plain
    assert accelerations > 30 and motion > 24 and until > 0
