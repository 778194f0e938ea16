"""Coefficients of methods of integration as they are written in C."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from typing import TypedDict

from sympy import Rational

from eomc.emit import c_expression, c_function
from eomc.emit.c_expression import Real
from eomc.integrators.tableaux import Method, Row


def literal(x: Fraction, real: Real) -> str:
    """A coefficient as it is written in C."""
    return c_expression.number(Rational(x.numerator, x.denominator), real)


def _nearest(x: Fraction, real: Real) -> Fraction:
    """The double nearest to x, or the float nearest to that."""
    form = {"float64": "d", "float32": "f"}[real.dtype]
    return Fraction(*struct.unpack(form, struct.pack(form, float(x))))


def rounded(weights: Row, real: Real) -> Row:
    """The weights as they are in C, with their sum as it is: what it lacks would add up over steps.

    The smallest one takes what rounding left of the sum; of a symmetric method both of a pair.
    """
    if not real.dtype:  # 113 bits, for references
        return weights
    rounded = [_nearest(x, real) for x in weights]
    lack = Fraction(round(sum(weights, Fraction(0)))) - sum(rounded, Fraction(0))
    symmetric = weights == weights[::-1] and len(weights) > 1
    for k in sorted(range(len(rounded)), key=lambda k: abs(rounded[k])):
        places = {k, len(rounded) - 1 - k} if symmetric else {k}
        wished = rounded[k] + lack / len(places)
        if rounded[k] and _nearest(wished, real) == wished:
            return tuple(wished if n in places else x for n, x in enumerate(rounded))
    return tuple(rounded)


def numbers(row: Row, real: Real) -> tuple[str, ...]:
    """A row of coefficients."""
    return tuple(literal(x, real) for x in row)


def matrix(rows: Sequence[Row], real: Real) -> tuple[str, ...]:
    """The rows of a square matrix, zeros where a triangle ends."""
    whole = [(*row, *[Fraction(0)] * (len(rows) - len(row))) for row in rows]
    return c_function.in_braces(numbers(row, real) for row in whole)


class Tableau(TypedDict):
    """Of a method for second-order equations: times, A and A A by row, b and b A."""

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


def tableau(m: Method, real: Real) -> Tableau:
    """The coefficients of a method as they are written in C."""
    return Tableau(
        c=numbers(m.c, real),
        A=matrix(m.a, real),
        AA=matrix(m.a_squared, real),
        b=numbers(rounded(m.b, real), real),
        bA=numbers(m.b_a, real),
    )
