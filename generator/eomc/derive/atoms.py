"""Atoms, which a tape's definitions are made of: a number, a name, or a number times a name."""

from __future__ import annotations

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
