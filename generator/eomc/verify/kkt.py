"""Accelerations under constraints, and projection onto constraints, by a dense KKT matrix in NumPy.

    [D  -A^T] [  qdd   ]   [tau - bias]
    [A    0 ] [ lambda ] = [ - gamma  ]

The rows of A belong to the constraint equations that are not redundant. gamma is the part without
qdd of the second time derivative of a holonomic equation, or of the first time derivative of a
nonholonomic one. The matrix is scaled and solved directly. At positions where equations depend on
one another, the result is the least-squares solution with the smallest scaled lambda. The singular
values of the scaled matrix are about 1; for an equation whose row of A vanishes at a position, they
are the squares of those of A.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from eomc.runtime import rank

Vector = NDArray[np.float64]

EIGENVALUE_TOLERANCE = 1e-6  # smaller eigenvalues of the scaled D may have either sign
RANK_TOLERANCE = 1e-9  # relative to the largest singular value: a smaller one is zero
CONVERGENCE_TOLERANCE = 16 * 2.0**-52  # relative size of a correction that is rounding only


def solve(D: Vector, A: Vector, force: Vector, level: Vector) -> tuple[Vector, Vector]:
    """Return x and λ with D x - Aᵀλ = force and A x = level, at one or many states.

    D (..., n, n) is the mass matrix and A (..., m, n) the constraint Jacobian. force is (..., n),
    level (..., m), x (..., n) and λ (..., m). The results are nan for a state with an argument that
    is not finite.
    """
    n, m = D.shape[-1], A.shape[-2]
    shape = np.broadcast_shapes(D.shape[:-2], A.shape[:-2], force.shape[:-1], level.shape[:-1])
    x, multipliers = np.full((*shape, n), np.nan), np.full((*shape, m), np.nan)
    parts = (
        np.broadcast_to(D, (*shape, n, n)), np.broadcast_to(A, (*shape, m, n)),
        np.broadcast_to(force, (*shape, n)), np.broadcast_to(level, (*shape, m)),
    )  # fmt: skip
    for k in np.ndindex(shape):
        here = [part[k] for part in parts]
        if all(np.all(np.isfinite(part)) for part in here):
            x[k], multipliers[k] = _solve(*here)
    return x, multipliers


def _solve(D: Vector, A: Vector, force: Vector, level: Vector) -> tuple[Vector, Vector]:
    """Return x and λ at one state; the multiplier of a zero row of A is 0."""
    multipliers, nonzero = np.zeros(len(A)), A.any(axis=1)
    A, level = A[nonzero], level[nonzero]
    n, m = len(D), len(A)
    scale = scales(D, A)
    matrix = _scaled(D, A, np.zeros((m, m)), scale)
    right = scale * np.concatenate([force, level])
    sizes = np.linalg.svd(matrix, compute_uv=False)
    if sizes[-1] > RANK_TOLERANCE * sizes[0]:
        solution = np.linalg.solve(matrix, right)
        solution += np.linalg.solve(matrix, right - matrix @ solution)
    else:
        solution = np.linalg.lstsq(matrix, right, rcond=RANK_TOLERANCE)[0]
    solution *= scale
    multipliers[nonzero] = solution[n:]
    return solution[:n], multipliers


def with_fixed_coordinates(D: Vector, A: Vector, fixed: tuple[int, ...]) -> tuple[Vector, Vector]:
    """Return copies of D and A for which the coordinates with indices `fixed` do not move.

    D is the mass matrix (n, n) and A the constraint Jacobian (m, n).
    """
    D, A = D.copy(), A.copy()
    for i in fixed:
        D[i] = D[:, i] = A[:, i] = 0
        D[i, i] = 1
    return D, A


def absolute_inverse(D: Vector, A: Vector) -> Vector:
    """Return the absolute values of the inverse of the KKT matrix of D and A, (n + m, n + m).

    The KKT matrix belongs to the equations D x - Aᵀλ = force, A x = level. The result bounds the
    effect of rounding errors of the right-hand side. For a row of A that is zero, the equation of
    the multiplier is replaced by λ = 0.
    """
    scale, none = scales(D, A), np.diag((~A.any(axis=1)).astype(float))
    matrix = _scaled(D, A, none, scale)
    return np.asarray(np.abs(scale[:, None] * np.linalg.inv(matrix) * scale))


def is_regular(D: Vector, A: Vector, least: float) -> bool:
    """Return whether the KKT matrix of D and A is regular after scaling.

    Its least singular value must exceed `least` times the largest one. Singular values that belong
    to A grow with the square of those of A.
    """
    matrix = _scaled(D, A, np.zeros((len(A), len(A))), scales(D, A))
    if not np.all(np.isfinite(matrix)):
        return False
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return bool(sizes[-1] > least * sizes[0])


def _scaled(D: Vector, A: Vector, corner: Vector, scale: Vector) -> Vector:
    return np.asarray(scale[:, None] * np.block([[D, -A.T], [A, corner]]) * scale)


def scales(D: Vector, A: Vector) -> Vector:
    """Return factors for the rows and columns of the KKT matrix of D and A, (n + m,).

    With them the diagonal of D and the norms of the rows of A become 1. For a coordinate without
    inertia, an inertia is estimated from the coordinate's entries in A.
    """
    inertia = np.abs(np.diag(D))
    known = inertia > 0
    mass = float(np.mean(inertia[known])) if np.any(known) else 1.0
    size = np.sqrt(np.sum(A**2, axis=1))
    part = np.max(np.abs(A) / np.where(size > 0, size, 1)[:, None], axis=0, initial=0)
    inertia = np.where(known, inertia, mass * np.where(part > 0, part, 1) ** 2)
    coordinates = 1 / np.sqrt(inertia)
    rows = np.sqrt(np.sum((A * coordinates) ** 2, axis=1))
    return np.concatenate([coordinates, 1 / np.where(rows > 0, rows, 1)])


def is_nonnegative(D: Vector, A: Vector) -> bool:
    """Return whether vᵀ D v >= 0 for all v with A v = 0; True if that can't be decided.

    D (n, n) is the mass matrix, scaled here to a unit diagonal, and v are the velocities that the
    constraints permit. If rows of A are zero or linearly dependent, the result is True.
    """
    if not (np.all(np.isfinite(D)) and np.all(np.isfinite(A))):
        return True
    size = np.sqrt(np.abs(np.diag(D)))
    size = np.where(size > 0, size, 1.0)
    N = rank.null_space(A / size)
    if N.shape[1] != D.shape[0] - len(A):
        return True
    values = np.linalg.eigvalsh(N.T @ (D / np.outer(size, size)) @ N)
    return not np.any(values < -EIGENVALUE_TOLERANCE)


def project_to_nearest(
    q: Vector, rows: Callable[[Vector], tuple[Vector, Vector, Vector]]
) -> tuple[Vector, float]:
    """Return the x nearest to q on the constraints, and the size of the last correction.

    Distances are in the metric of D. rows: a function of x that returns D, A and the residual of
    the constraint equations. The size is relative to x. It is of the order of rounding if the
    iteration has converged, and inf otherwise.
    """
    x, last = project(q, rows)
    part, before = 1.0, np.inf
    if not last < 1e-10:
        return x, last
    for _ in range(200):
        D, A, residual = rows(x)
        correction, _ = solve(D, A, np.zeros(len(q)), -(residual + A @ (q - x)))
        correction += q - x
        size = float(np.max(np.abs(correction) / (np.abs(x) + np.max(np.abs(x)) + 1), initial=0))
        if not np.isfinite(size) or part < 1e-2:
            return x, np.inf
        x = x + part * correction
        if size <= CONVERGENCE_TOLERANCE or (size < 1e-12 and size > before / 2):
            return project(x, rows)
        part /= 1 + (size > before / 2)
        before = size
    return x, np.inf


def project(
    q: Vector, rows: Callable[[Vector], tuple[Vector, Vector, Vector]]
) -> tuple[Vector, float]:
    """Return an x near q that satisfies the constraints, and the size of the last correction.

    Newton's method starts at q. Each correction is the shortest in the metric of D; a long one is
    halved until it reduces the residual. rows: a function of x that returns D, A (constraint
    Jacobian) and the residual of the constraint equations. The size is relative to x. It is of the
    order of rounding if the iteration has converged, and inf if x does not satisfy the constraints.
    """
    D, A, residual = rows(q)
    last = np.inf
    for _ in range(60):
        correction, _ = solve(D, A, np.zeros(len(q)), -residual)
        size = float(np.max(np.abs(correction) / (np.abs(q) + np.max(np.abs(q)) + 1), initial=0))
        if not np.isfinite(size):
            return q, np.inf
        if size <= CONVERGENCE_TOLERANCE or (size < 1e-12 and size > last / 2):
            level = np.abs(A) @ (np.abs(q) + np.max(np.abs(q)) + 1)
            return q + correction, size if np.all(np.abs(residual) <= 1e-10 * level) else np.inf
        last, part = size, 1.0
        weight = scales(D, A)[len(q) :]
        before = np.linalg.norm(weight * residual)
        while part > 1e-3 and size >= 1e-6:
            after = np.linalg.norm(weight * rows(q + part * correction)[2])
            if after <= (1 - part / 4) * before:
                break
            part /= 2
        q = q + part * correction
        D, A, residual = rows(q)
    return q, last
