"""Coefficients of integration methods as C literals."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from functools import cache

from sympy import Rational

from eomc.emit.common import c_expression, c_function
from eomc.emit.common.c_expression import Real
from eomc.integrators.tableaux import Row


@cache
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


def c_vector(name: str, row: Row, real: Real, comment: str = "") -> str:
    """Return the C definition of a constant vector of coefficients under the library's names.

    comment: text of the comment above the definition; "" for none.
    """
    return c_function.define_table(name, [len(row)], [", ".join(literals(row, real))], comment)


def c_matrix(name: str, rows: Sequence[Row], real: Real) -> str:
    """Return the C definition of a constant matrix; short rows are padded with zeros."""
    width = max(map(len, rows))
    padded = ((*row, *[Fraction(0)] * (width - len(row))) for row in rows)
    lines = c_function.initialiser_rows(literals(row, real) for row in padded)
    return c_function.define_table(name, [len(rows), width], lines)
