"""Atoms, from which the definitions of a tape are made: a number, a name, or a number times a
name.
"""

from __future__ import annotations

from typing import Any, Protocol

from sympy import Expr, Mul, S, Symbol


def split(atom: Expr) -> tuple[Expr, Symbol | None]:
    """Return the number and the name whose product is `atom`.

    An atom is a number, a name, or a number times a name. The number is 1 if `atom` is a name; the
    name is None if `atom` is a number.
    """
    if atom.is_Symbol:
        return S.One, atom
    if atom.is_number:
        return atom, None
    if len(atom.args) == 2 and atom.args[1].is_Symbol:
        return atom.args[0], atom.args[1]
    symbol = next(iter(atom.free_symbols))
    return Mul(*(f for f in atom.args if f is not symbol)), symbol


def is_negative(number: Expr) -> bool:
    """Return True if `number` is negative.

    Rational numbers are decided by their numerator, which is faster than SymPy's test.
    """
    return bool(number.p < 0 if number.is_Rational else number.is_negative)


class Sums(Protocol):
    """The attributes of a `Tape` that `expand_sums` reads.

    Attributes
    ----------
    leaves
        The symbols without definition.
    weights, constant
        For each name that is defined as a sum: the weight of each name in it, and its constant.
    """

    leaves: dict[Symbol, Any]
    weights: dict[Symbol, dict[Symbol, Expr]]
    constant: dict[Symbol, Expr]


def expand_sums(
    weights: dict[Symbol, Expr], constant: Expr, sums: Sums
) -> tuple[dict[Symbol, Expr], Expr]:
    """Return a sum in which nested sums of leaves are replaced by their terms if this shortens it.

    For example, q1 + (q2 - q1) becomes q2. This also avoids a rounding error that is large where
    q1 is large. A sum is given and returned as the weight of each name and a constant. `sums` is
    the tape on which the names are defined.
    """
    for symbol, weight in weights.items():
        inner = sums.weights.get(symbol)
        if not inner or inner.keys().isdisjoint(weights) or inner.keys() - sums.leaves.keys():
            continue
        expanded = {name: w for name, w in weights.items() if name is not symbol}
        for name, w in inner.items():
            expanded[name] = expanded.get(name, S.Zero) + weight * w
        expanded = {name: w for name, w in expanded.items() if w != 0}
        new_constant = constant + weight * sums.constant[symbol]
        if len(expanded) + (new_constant != 0) < len(weights) + (constant != 0):
            return expand_sums(expanded, S.Zero if new_constant == 0 else new_constant, sums)
    return weights, constant
