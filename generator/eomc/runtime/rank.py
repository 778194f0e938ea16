"""The rank of a matrix: one test with one tolerance, for constraint equations and for motions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def tolerance(dtype: Any = "float64") -> float:
    """Return the ratio of a singular value to the largest one below which it counts as zero.

    The ratio is 8 sqrt(eps), 1.2e-7 in double precision. At a position that satisfies constraints
    up to rounding, residuals of the order eps leave the distance from a singular position
    undetermined by sqrt(eps), and the least singular value by as much. Rows or columns are to be
    scaled to the same length before the test, since they have different units. The test of
    `eom_choose_row` in csrc/solver/projection.c is the same: it compares squares, with the
    tolerance 64 eps.
    """
    return float(8 * np.sqrt(np.finfo(dtype).eps))


def count(singular_values: Array, dtype: Any = "float64") -> Any:
    """Return the rank of a matrix, or of many, from its singular values in descending order."""
    return (singular_values > tolerance(dtype) * singular_values[..., :1]).sum(axis=-1)


def unit_rows(A: Array) -> Array:
    """Return a matrix, or many, whose rows are scaled to length 1; rows of zeros are unchanged."""
    sizes = np.linalg.norm(A, axis=-1, keepdims=True)
    return np.asarray(A / np.where(sizes > 0, sizes, 1))


def null_space(A: Array, dtype: Any = "float64") -> Array:
    """Return an orthonormal basis of the null space of A (m, n), as the columns of a matrix."""
    _, sizes, directions = np.linalg.svd(unit_rows(A))
    return np.asarray(directions[int(count(sizes, dtype)) :].T)
