"""Coefficients of integration methods as C literals."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from sympy import Rational

from eomc.emit import c_expression, c_function
from eomc.emit.c_expression import Real
from eomc.integrators.tableaux import Method, Row


@dataclass(frozen=True)
class TableauFields:
    """Fields of a view: the coefficients of a Runge-Kutta method for second-order equations.

    c: the nodes. A, AA: the rows of the matrices A and A A. b, bA: the weights b and b A. All are
    C literals or initialisers; `tableau` returns them.
    """

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


def literal(x: Fraction, real: Real) -> str:
    """Return the fraction x as a C literal of the type `real`."""
    return c_expression.number(Rational(x.numerator, x.denominator), real)


def _nearest(x: Fraction, real: Real) -> Fraction:
    """Return the nearest double, or the float nearest to it."""
    form = {"float64": "d", "float32": "f"}[real.dtype]
    return Fraction(*struct.unpack(form, struct.pack(form, float(x))))


def round_weights(weights: Row, real: Real) -> Row:
    """Return the weights of a method rounded to the type `real` such that their sum stays exact.

    An error of the sum would accumulate over steps. It is therefore corrected in the smallest
    weight for which this is exact, or in two equal weights if the method is symmetric.
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


def literals(row: Row, real: Real) -> tuple[str, ...]:
    """Return each coefficient of a row as a C literal of the type `real`."""
    return tuple(literal(x, real) for x in row)


def matrix_rows(rows: Sequence[Row], real: Real) -> tuple[str, ...]:
    """Return the lines of a C initialiser for a square matrix, one line for each row.

    Rows shorter than the matrix are padded with zeros.
    """
    padded = [(*row, *[Fraction(0)] * (len(rows) - len(row))) for row in rows]
    return c_function.initialiser_rows(literals(row, real) for row in padded)


def tableau(m: Method, real: Real) -> dict[str, Any]:
    """Return the fields c, A, AA, b and bA of `TableauFields` for the integration method `m`.

    real: the C type of the literals.
    """
    return {
        "c": literals(m.c, real),
        "A": matrix_rows(m.a, real),
        "AA": matrix_rows(m.a_squared, real),
        "b": literals(round_weights(m.b, real), real),
        "bA": literals(m.b_a, real),
    }
