"""Coefficients of integration methods as C literals."""

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
    """Return a coefficient as a C literal in the type of numbers."""
    return c_expression.number(Rational(x.numerator, x.denominator), real)


def _nearest(x: Fraction, real: Real) -> Fraction:
    """Return the nearest double, or the float nearest to it."""
    form = {"float64": "d", "float32": "f"}[real.dtype]
    return Fraction(*struct.unpack(form, struct.pack(form, float(x))))


def rounded(weights: Row, real: Real) -> Row:
    """Return weights rounded to the type of numbers, such that their sum is exact.

    An error of the sum would accumulate over steps. The smallest weight takes the rounding error of
    the sum; for symmetric methods, two equal weights share it.
    """
    if not real.dtype:  # 113 bits, for references
        return weights
    values = [_nearest(x, real) for x in weights]
    error = Fraction(round(sum(weights, Fraction(0)))) - sum(values, Fraction(0))
    symmetric = weights == weights[::-1] and len(weights) > 1
    for k in sorted(range(len(values)), key=lambda k: abs(values[k])):
        indices = {k, len(values) - 1 - k} if symmetric else {k}
        corrected = values[k] + error / len(indices)
        if values[k] and _nearest(corrected, real) == corrected:
            return tuple(corrected if n in indices else x for n, x in enumerate(values))
    return tuple(values)


def numbers(row: Row, real: Real) -> tuple[str, ...]:
    """Return a row of coefficients as C literals."""
    return tuple(literal(x, real) for x in row)


def matrix(rows: Sequence[Row], real: Real) -> tuple[str, ...]:
    """Return the rows of a square matrix as lines of a C initialiser; short rows are padded with
    zeros.
    """
    padded = [(*row, *[Fraction(0)] * (len(rows) - len(row))) for row in rows]
    return c_function.in_braces(numbers(row, real) for row in padded)


class Tableau(TypedDict):
    """Coefficients of a Runge-Kutta method for second-order equations, as C literals.

    They are the nodes c, the matrices A and A A by rows (lines of C initialisers), and the weights
    b and b A.
    """

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


def tableau(m: Method, real: Real) -> Tableau:
    """Return the coefficients of a method as C literals in the type of numbers."""
    return Tableau(
        c=numbers(m.c, real),
        A=matrix(m.a, real),
        AA=matrix(m.a_squared, real),
        b=numbers(rounded(m.b, real), real),
        bA=numbers(m.b_a, real),
    )
