"""Vectors, rotations and inertias, generic in their scalars: floats or SymPy's expressions.

A vector has three entries, a matrix three rows, an inertia six entries: Ixx, Iyy, Izz, Ixy, Ixz,
Iyz, those off the diagonal being the tensor's, -sum m x y. Products with an exact zero are left
out, which keeps expressions short and changes no number but the sign of a zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, TypeVar

T = TypeVar("T")
Vector = tuple[T, T, T]
Matrix = tuple[Vector[T], Vector[T], Vector[T]]
Inertia = tuple[T, T, T, T, T, T]

ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of a tensor, in an inertia's order


def plus(a: Sequence[T], b: Sequence[T]) -> Vector[T]:
    """Return the sum a + b of two vectors."""
    x, y, z = (_sum(p, q) for p, q in zip(a, b, strict=True))
    return x, y, z


def scaled(a: Sequence[T], factor: T) -> Vector[T]:
    """Return the vector `a` multiplied by the scalar `factor`."""
    x, y, z = (_product(p, factor) for p in a)
    return x, y, z


def dot(a: Sequence[T], b: Sequence[T]) -> T:
    """Return the scalar product a . b of two vectors."""
    terms: list[T] = [_product(p, q) for p, q in zip(a, b, strict=True) if p and q]
    return reduce(_sum, terms) if terms else _product(a[0], b[0])


def cross(a: Sequence[Any], b: Sequence[Any]) -> Vector[Any]:
    """Return the vector product a x b."""
    (x, y, z), (u, v, w) = a, b
    return y * w - z * v, z * u - x * w, x * v - y * u


def apply(R: Matrix[T], v: Sequence[T]) -> Vector[T]:
    """Return the product R v of a matrix and a vector."""
    x, y, z = (dot(row, v) for row in R)
    return x, y, z


def transposed(R: Matrix[T]) -> Matrix[T]:
    """Return the transpose of a matrix."""
    one, two, three = zip(*R, strict=True)
    return one, two, three


def product(A: Matrix[T], B: Matrix[T]) -> Matrix[T]:
    """Return the product A B of two matrices."""
    return transposed(matrix(apply(A, column) for column in transposed(B)))


def matrix(rows: Any) -> Matrix[Any]:
    """Return a matrix, a tuple of three rows, from an iterable of three rows."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return (a, b, c), (d, e, f), (g, h, i)


def elementary_rotation(k: int, cosine: Any, sine: Any) -> Matrix[Any]:
    """Return the matrix of a rotation about the coordinate axis `k` (0, 1 or 2).

    The matrix transforms the components of a vector from the rotated frame to the original one.
    cosine, sine: cosine and sine of the rotation angle.
    """
    zero = 0 * cosine
    i, j = (k + 1) % 3, (k + 2) % 3
    rows = [[zero] * 3 for _ in range(3)]
    rows[k][k] = zero + 1
    rows[i][i], rows[i][j], rows[j][i], rows[j][j] = cosine, -sine, sine, cosine
    return matrix(rows)


def axis_angle_rotation(axis: Sequence[Any], cosine: Any, sine: Any) -> Matrix[Any]:
    """Return the matrix of a rotation about a unit vector `axis`, by the formula of Rodrigues.

    The matrix transforms the components of a vector from the rotated frame to the original one.
    cosine, sine: cosine and sine of the rotation angle.
    """
    x, y, z = axis
    c, s = cosine, sine
    r = 1 - c
    return (
        (c + x * x * r, x * y * r - z * s, x * z * r + y * s),
        (y * x * r + z * s, c + y * y * r, y * z * r - x * s),
        (z * x * r - y * s, z * y * r + x * s, c + z * z * r),
    )


def tensor(inertia: Sequence[T]) -> Matrix[T]:
    """Return the inertia tensor as a symmetric matrix, from its six entries.

    inertia: Ixx, Iyy, Izz, Ixy, Ixz, Iyz.
    """
    xx, yy, zz, xy, xz, yz = inertia
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def rotated_inertia(R: Matrix[T], inertia: Sequence[T]) -> Inertia[T]:
    """Return the inertia R I R^T of a body with respect to rotated axes.

    inertia: the inertia I in the original axes. R: rotation matrix that transforms the components
    of a vector from the original axes to the other axes. Inertias are tuples of the six entries
    Ixx, Iyy, Izz, Ixy, Ixz, Iyz.
    """
    rotated = product(product(R, tensor(inertia)), transposed(R))
    return as_inertia(rotated[i][j] for i, j in ENTRIES)


def point_inertia(mass: Any, at: Sequence[Any]) -> Inertia[Any]:
    """Return the inertia (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) of a point mass about the origin.

    at: position of the mass.
    """
    x, y, z = at
    return (
        mass * (y * y + z * z), mass * (x * x + z * z), mass * (x * x + y * y),
        -mass * x * y, -mass * x * z, -mass * y * z,
    )  # fmt: skip


def moved_inertia(inertia: Sequence[Any], mass: Any, center: Sequence[Any]) -> Inertia[Any]:
    """Return the inertia of a body about the origin, by the parallel axis theorem.

    inertia: Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass. center: position of the centre
    of mass relative to the origin. The result has the same six entries.
    """
    return as_inertia(a + b for a, b in zip(inertia, point_inertia(mass, center), strict=True))


def as_inertia(values: Any) -> Inertia[Any]:
    """Return an inertia, a tuple of six entries, from an iterable of six values."""
    xx, yy, zz, xy, xz, yz = values
    return xx, yy, zz, xy, xz, yz


def _sum(p: T, q: T) -> T:
    return p + q if p and q else p or q  # type: ignore[operator]


def _product(p: T, q: T) -> T:
    return q if p == 1 else p * q  # type: ignore[operator]
