"""Exact conversion of SymPy functions to those of the formula language."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.core.relational import GreaterThan, LessThan, StrictGreaterThan, StrictLessThan

_AS: Mapping[Any, Callable[[Expr], Expr]] = {
    sympy.UnevaluatedExpr: lambda x: x,
    sympy.sec: lambda x: 1 / sympy.cos(x),
    sympy.csc: lambda x: 1 / sympy.sin(x),
    sympy.cot: lambda x: sympy.cos(x) / sympy.sin(x),
    sympy.sech: lambda x: 1 / sympy.cosh(x),
    sympy.csch: lambda x: 1 / sympy.sinh(x),
    sympy.coth: lambda x: 1 / sympy.tanh(x),
    sympy.asec: lambda x: sympy.acos(1 / x),
    sympy.acsc: lambda x: sympy.asin(1 / x),
}
_ORDERS = (GreaterThan, LessThan, StrictGreaterThan, StrictLessThan)


class JumpError(ValueError):
    """Error for a SymPy Piecewise that is discontinuous or whose continuity is undecided."""


def rewritten(expr: Expr, fixed: Mapping[Symbol, bool]) -> Expr:
    """Return an equal expression without Piecewise and without functions such as sec and coth.

    The result uses only functions that formulas of scenes can use. fixed: dict from each constant
    symbol to True if it is known to be nonnegative, else False. Raises JumpError for a Piecewise
    that is discontinuous, or whose continuity cannot be decided.
    """
    expr = expr.replace(lambda e: type(e) in _AS, lambda e: _AS[type(e)](*e.args))
    return expr.replace(lambda e: isinstance(e, sympy.Piecewise), lambda e: _continuous(e, fixed))


def _continuous(piecewise: sympy.Piecewise, fixed: Mapping[Symbol, bool]) -> Expr:
    """Return a continuous Piecewise as a sum of products with Max.

    Starts from the last piece. Where d > 0 a piece replaces another; if their difference is q d
    with finite q, the term q Max(d, 0) is added.
    """
    *pieces, (result, last) = piecewise.args
    if last != sympy.true:
        raise JumpError(f"{piecewise} has no last piece: give one for all else, (0, True)")
    last_piece = result
    for k in reversed(range(len(pieces))):
        piece, condition = pieces[k]
        if not isinstance(condition, _ORDERS):
            raise JumpError(f"{condition} in a Piecewise can't be used: write x > a or x < a")
        d = condition.gts - condition.lts
        other = _applicable_piece(condition, piecewise.args[k + 1 :], fixed)
        q = sympy.cancel((piece - other) / d) if other is not None else sympy.zoo
        if q.has(sympy.zoo, sympy.nan) or not sympy.fraction(q)[1].free_symbols <= fixed.keys():
            unknown = [str(s) for s in fixed if s in condition.free_symbols and not fixed[s]]
            order = f"; Symbol('{unknown[0]}', positive=True) tells an order" if unknown else ""
            jump = sympy.Heaviside(d)
            if len(pieces) == 1:
                jump = last_piece + (piece - last_piece) * jump
            raise JumpError(
                f"{piecewise} jumps where {d} = 0, or can't be seen not to: write {jump}, whose "
                f"Heaviside is 1/2 there, or Max, Min or a smooth tanh{order}"
            )
        result += q * sympy.Max(d, 0)
    return result


def _applicable_piece(condition: Any, later: Any, fixed: Mapping[Symbol, bool]) -> Expr | None:
    """Return the later piece that applies where a condition holds; None if undecided."""
    for piece, other in later:
        if _never_both(condition, sympy.Not(other), fixed):
            return piece
        if not _never_both(condition, other, fixed):
            return None
    return None


def _never_both(one: Any, other: Any, fixed: Mapping[Symbol, bool]) -> bool:
    """Return True if two conditions exclude each other: d > 0 and e > 0 if d + s e <= 0, s > 0."""
    if isinstance(one, _ORDERS) and isinstance(other, _ORDERS):
        (d, varying), (e, against) = (
            (x.gts - x.lts).expand().as_independent(*x.free_symbols - fixed.keys(), as_Add=True)
            for x in (one, other)
        )
        s = -sympy.cancel(varying / against) if against != 0 else sympy.S.Zero
        known = {x: sympy.Dummy(x.name, nonnegative=True) for x in fixed if fixed[x]}
        if s.is_positive and sympy.expand(d + s * e).xreplace(known).is_nonpositive:
            return True
    return bool(sympy.And(one, other).simplify() == sympy.false)
