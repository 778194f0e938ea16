"""The algebra in which formula text becomes a SymPy expression."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy
from sympy import Expr

from eomc.model.symbols import dot
from eomc.scene import formulas
from eomc.scene.formulas import Formula, FormulaError


def _number(text: str) -> Expr:
    whole = text[:2].lower() in ("0x", "0o", "0b")
    return sympy.Integer(int(text, 0)) if whole else sympy.Rational(text)


ALGEBRA: Mapping[str, Any] = {
    "number": _number,
    "pi": sympy.pi,
    **{name: getattr(sympy, name) for name in (*formulas.ELEMENTARY, "sign")},
    "abs": sympy.Abs,
    "heaviside": lambda x: sympy.Heaviside(x),
    "min": sympy.Min,
    "max": sympy.Max,
    "dot": dot,
}
UNDEFINED = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


def expression(formula: Formula, known: Mapping[str, Expr]) -> Expr:
    """Convert a parsed formula to a SymPy expression and return it.

    known: dict from each name that the formula may use to its SymPy expression. Raises
    FormulaError if the value is not real or not finite.
    """
    try:
        value = sympy.sympify(formulas.evaluate(formula, ALGEBRA, known.__getitem__))
    except (ArithmeticError, ValueError, TypeError) as fault:
        raise FormulaError(str(fault)) from None
    if value.has(*UNDEFINED):
        raise FormulaError("divides by zero")
    if value.has(sympy.I):
        raise FormulaError("has no real value")
    return value
