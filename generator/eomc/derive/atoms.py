"""Atoms, from which the definitions of a tape are made: a number, a name, or a number times a
name.
"""

from __future__ import annotations

from typing import Any, Protocol

from sympy import Expr, Mul, S, Symbol


def split(atom: Expr) -> tuple[Expr, Symbol | None]:
    """Return the pair (number, name) whose product is `atom`.

    An atom is a number, a symbol (the name of a value), or a number times a symbol. The returned
    number is 1 if `atom` is a symbol. The returned name is None if `atom` is a number.
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
    """Return True if `number`, a SymPy number, is negative.

    For a rational number the sign of its numerator is tested, which is faster than SymPy's test.
    """
    return bool(number.p < 0 if number.is_Rational else number.is_negative)


class Sums(Protocol):
    """The attributes of a `Tape` (list of named operations) that `expand_sums` reads.

    Attributes
    ----------
    leaves
        The symbols without definition, such as coordinates and parameters.
    weights
        For each name that is defined as a sum: the weight of each name in the sum.
    constant
        For each name that is defined as a sum: the constant term of the sum.
    """

    leaves: dict[Symbol, Any]
    weights: dict[Symbol, dict[Symbol, Expr]]
    constant: dict[Symbol, Expr]


def expand_sums(
    weights: dict[Symbol, Expr], constant: Expr, sums: Sums
) -> tuple[dict[Symbol, Expr], Expr]:
    """Return the sum sum_k weights[k] k + constant, simplified, as the pair (weights, constant).

    A name in the sum may itself be defined as a sum of leaves (symbols without definition). It is
    replaced by its terms if the result is then shorter. For example, q1 + (q2 - q1) becomes q2,
    which also avoids a large rounding error for large q1. The names are defined on the tape `sums`.
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
