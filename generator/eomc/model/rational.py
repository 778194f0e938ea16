"""Vectors, rotations and unit axes of bodies as exact fractions."""

from __future__ import annotations

from collections.abc import Sequence

import mpmath
import sympy
from sympy import Expr, Rational, S

from eomc.base import spatial
from eomc.base.spatial import cross, matrix, transposed

Vector = spatial.Vector[Expr]
Matrix = spatial.Matrix[Expr]

DIGITS = 50  # decimal digits to which numbers are rounded
INTEGER_TOLERANCE = 10**40  # numbers closer than 1e-40 to an integer are rounded to it

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
ONE: Matrix = ((S.One, S.Zero, S.Zero), (S.Zero, S.One, S.Zero), (S.Zero, S.Zero, S.One))


def rounded_number(e: Expr) -> Expr:
    """Return a number as a fraction that is rounded to 50 digits.

    A number within 1e-40 of an integer is rounded to that integer. An expression that is not a
    number is returned unchanged.
    """
    if not e.is_number:
        return e
    if not e.is_Rational:
        e = Rational(str(e.evalf(DIGITS + 5)))
    whole = (2 * e.p + e.q) // (2 * e.q)
    if abs(e.p - whole * e.q) * INTEGER_TOLERANCE < e.q:
        return S(whole)
    if e.q > 10**DIGITS:
        with mpmath.workdps(DIGITS):
            e = Rational(mpmath.nstr(mpmath.mpf(e.p) / e.q, DIGITS))
    return e


def rounded_vector(v: Vector) -> Vector:
    """Return a copy of a vector with its numbers rounded to fractions of 50 digits.

    Entries that are not numbers are unchanged.
    """
    x, y, z = map(rounded_number, v)
    return (x, y, z)


def rounded_matrix(matrix: Matrix) -> Matrix:
    """Return a copy of a matrix with its numbers rounded to fractions of 50 digits.

    Entries that are not numbers are unchanged.
    """
    one, two, three = map(rounded_vector, matrix)
    return (one, two, three)


def unit_vector(axis: Sequence[float]) -> list[Expr]:
    """Return the unit vector along `axis` as fractions, normalised to 50 digits."""
    entries = [Rational(str(x)) for x in axis]
    with mpmath.workdps(DIGITS + 5):
        long = [mpmath.mpf(x.p) / x.q for x in entries]
        size = mpmath.sqrt(sum(x * x for x in long))
        return [rounded_number(Rational(mpmath.nstr(x / size, DIGITS + 5))) for x in long]


def aligned_with(axis: Sequence[float]) -> tuple[int, Matrix]:
    """Return (k, R): a coordinate axis k (0, 1 or 2) and a rotation matrix R with R e_k = `axis`.

    e_k is the unit vector along the coordinate axis k, and `axis` is normalised. R is exact to 50
    digits. In the frame rotated by R, the direction `axis` is therefore the coordinate axis k.
    """
    along = unit_vector(axis)
    for k, x in enumerate(along):
        if abs(x) == 1:
            half_turn = spatial.elementary_rotation((k + 1) % 3, S.NegativeOne, S.Zero)
            return k, ONE if x == 1 else half_turn
    # Gram-Schmidt, from the coordinate axis that is farthest from the axis
    far = min(range(3), key=lambda i: (abs(along[i]), i))
    first = [-along[far] * x for x in along]
    first[far] += 1
    size = sympy.sqrt(sum(x * x for x in first))
    a = [rounded_number((x / size).evalf(DIGITS + 5)) if x != 0 else S.Zero for x in first]
    return 2, transposed(matrix((a, rounded_vector(cross(along, a)), along)))
