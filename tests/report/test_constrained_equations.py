"""Equations and reference solutions of scenes with constraints."""

from __future__ import annotations

from pathlib import Path

import pytest
import sympy

import eomc
from eomc import pipeline
from eomc.report import equations, reference_solution
from eomc.report.equations_text import write_equations

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
    m, x, y, rod = sympy.symbols("m x y lambda_rod")
    by_hand = sympy.Eq(m * sympy.Symbol("x_ddot"), 2 * x * rod)
    assert found.scalar[0] == by_hand
    assert found.scalar[1].rhs == 2 * y * rod
    assert sympy.ImmutableMatrix([[2 * x, 2 * y]]) == found.A
    text = str(found)
    assert "D q̈ + C q̇ + g = Aᵀλ" in text and "= 2⋅λ_rod⋅x" in text
    assert "rod: of positions" in text
    namespace: dict[str, object] = {}
    exec(write_equations(found.system, "python"), namespace)  # our own text
    assert namespace["scalar"][0] == equations.derive(found.system).scalar[0]  # type: ignore[index]
    assert r"\lambda_{\mathrm{rod}} x" in write_equations(found.system, "latex")


def test_multipliers_are_shown_by_their_rows_names(winch: Path) -> None:
    """Letters such as y have no subscript, others have: neither is made one."""
    text = winch.read_text(encoding="utf-8").replace("rod =", "pin_x =")
    text = text.replace("start = 0.3", "guess = true, start = 0.3")
    winch.write_text(text + 'pin_y = "y - x/2"\n', encoding="utf-8")
    found = str(eomc.equations(winch))
    assert "λ_pin_x⋅x" in found and "λ_pin_y" in found and "λₚ" not in found


def test_what_is_generated_says_that_constraints_have_forces(winch: Path) -> None:
    files = pipeline.sources(eomc.read(winch)).files
    made = [t for t in files.values() if "D(q) qdd + C(q, qd) qd + g(q) = tau" in t]
    assert len(made) > 2
    assert all("g(q) = tau + A^T lambda" in text for text in made)
    assert "qdd from D qdd + C qd + g = tau + A^T lambda." in files["winch.h"]


@pytest.mark.slow
def test_a_reference_solution_is_that_of_the_plain_equations(winch: Path, tmp_path: Path) -> None:
    found = reference_solution.solve(eomc.read(winch), 0.5, 4, tmp_path)
    assert found.plain is not None
    accelerations, motion, until = found.plain
    assert accelerations > 30 and motion > 24 and until > 0
