"""Expanded powers in constraint rows are recognised without factorisation."""

from __future__ import annotations

import pytest
from sympy import Expr, cos, expand, sin, symbols

from eomc.mechanism.inconsistency import has_only_repeated_factors

x, y, length = symbols("x y l")


@pytest.mark.parametrize(
    "formula",
    [
        (x - y) ** 2,
        -3 * length * (x - y) ** 2,
        (x - y) ** 2 * (x + length) ** 3,
        (x**2 + y**2 - length**2) ** 2,
        (sin(x) - cos(y)) ** 2,
    ],
)
def test_expanded_product_of_powers_is_recognised(formula: Expr) -> None:
    assert has_only_repeated_factors(expand(formula), {x, y})


@pytest.mark.parametrize(
    "formula",
    [
        length**2 * (x - y),
        (x - y) ** 2 * (x + length),
        (x - y) ** 2 - length**2,
        x**2 + y**2,
        x - x,
        x**100000 - y,
        (x**50 + y) ** 50,
    ],
)
def test_other_formulas_are_not_recognised_as_powers(formula: Expr) -> None:
    """A factor occurs once, or a parameter is squared; long rows are not examined."""
    assert not has_only_repeated_factors(formula, {x, y})
