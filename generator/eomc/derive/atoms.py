"""Atoms, which a tape's definitions are made of: a number, a name, or a number times a name."""

from __future__ import annotations

from typing import Any, Protocol

from sympy import Expr, Mul, S, Symbol


def split(atom: Expr) -> tuple[Expr, Symbol | None]:
    """(number, name) of what `define` returned; the name is None where it is a number."""
    if atom.is_Symbol:
        return S.One, atom
    if atom.is_number:
        return atom, None
    if len(atom.args) == 2 and atom.args[1].is_Symbol:
        return atom.args[0], atom.args[1]
    symbol = next(iter(atom.free_symbols))
    return Mul(*(f for f in atom.args if f is not symbol)), symbol


def is_negative(number: Expr) -> bool:
    """Whether a number is below zero; of fractions without asking SymPy, which takes long."""
    return bool(number.p < 0 if number.is_Rational else number.is_negative)


class Sums(Protocol):
    """Where sums are kept: their weights and constants by name, and which names are no sums."""

    leaves: dict[Symbol, Any]
    weights: dict[Symbol, dict[Symbol, Expr]]
    constant: dict[Symbol, Expr]


def written_out(
    weights: dict[Symbol, Expr], constant: Expr, sums: Sums
) -> tuple[dict[Symbol, Expr], Expr]:
    """A sum with sums of leaves in it written out where it gets shorter: q1 + (q2 - q1) = q2.

    Far out it would be off by roundings that q2 has not.
    """
    for symbol, weight in weights.items():
        inner = sums.weights.get(symbol)
        if not inner or inner.keys().isdisjoint(weights) or inner.keys() - sums.leaves.keys():
            continue
        found = {name: w for name, w in weights.items() if name is not symbol}
        for name, w in inner.items():
            found[name] = found.get(name, S.Zero) + weight * w
        found = {name: w for name, w in found.items() if w != 0}
        rest = constant + weight * sums.constant[symbol]
        if len(found) + (rest != 0) < len(weights) + (constant != 0):
            return written_out(found, S.Zero if rest == 0 else rest, sums)
    return weights, constant
