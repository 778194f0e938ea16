"""Numbers of bodies as exact fractions: vectors, rotations and axes of length one."""

from __future__ import annotations

from collections.abc import Sequence

import mpmath
import sympy
from sympy import Expr, Rational, S

from eomc.base import spatial
from eomc.base.spatial import cross, matrix, transposed

Vector = spatial.Vector[Expr]
Matrix = spatial.Matrix[Expr]

DIGITS = 50  # of numbers that are folded
TINY = 10**40  # what is nearer than one part in that many to a whole number is it

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
ONE: Matrix = ((S.One, S.Zero, S.Zero), (S.Zero, S.One, S.Zero), (S.Zero, S.Zero, S.One))


def numeric_entry(e: Expr) -> Expr:
    """Numbers as fractions of at most DIGITS digits; what is all but whole is whole."""
    if not e.is_number:
        return e
    if not e.is_Rational:
        e = Rational(str(e.evalf(DIGITS + 5)))
    whole = (2 * e.p + e.q) // (2 * e.q)  # the nearest
    if abs(e.p - whole * e.q) * TINY < e.q:
        return S(whole)
    if e.q > 10**DIGITS:
        with mpmath.workdps(DIGITS):
            e = Rational(mpmath.nstr(mpmath.mpf(e.p) / e.q, DIGITS))
    return e


def numeric(v: Vector) -> Vector:
    """A vector with its numbers as fractions."""
    x, y, z = map(numeric_entry, v)
    return (x, y, z)


def clean(matrix: Matrix) -> Matrix:
    """A matrix with its numbers as fractions."""
    one, two, three = map(numeric, matrix)
    return (one, two, three)


def unit(axis: Sequence[float]) -> list[Expr]:
    """The axis as fractions, of length one in DIGITS digits."""
    given = [Rational(str(x)) for x in axis]
    with mpmath.workdps(DIGITS + 5):
        long = [mpmath.mpf(x.p) / x.q for x in given]
        size = mpmath.sqrt(sum(x * x for x in long))
        return [numeric_entry(Rational(mpmath.nstr(x / size, DIGITS + 5))) for x in long]


def aligned_with(axis: Sequence[float]) -> tuple[int, Matrix]:
    """(k, R) with R e_k = axis: frames are rotated so that every joint has a coordinate axis."""
    along = unit(axis)
    for k, x in enumerate(along):
        if abs(x) == 1:
            half_turn = spatial.about_axis((k + 1) % 3, S.NegativeOne, S.Zero)
            return k, ONE if x == 1 else half_turn
    # Gram and Schmidt, from the coordinate axis that is farthest from it
    far = min(range(3), key=lambda i: (abs(along[i]), i))
    first = [-along[far] * x for x in along]
    first[far] += 1
    size = sympy.sqrt(sum(x * x for x in first))
    a = [numeric_entry((x / size).evalf(DIGITS + 5)) if x != 0 else S.Zero for x in first]
    return 2, transposed(matrix((a, numeric(cross(along, a)), along)))
