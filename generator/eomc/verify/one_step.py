"""One step of any Runge-Kutta method by its tableau, for a given acceleration function.

Generated steppers are compared with it. It is written in NumPy, stores all stages, and has nothing
in common with the templates except the coefficients of the methods.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eomc.integrators.tableaux import Method
from eomc.verify.kkt import Vector

MAX_SWEEPS = 20  # iterations for the stages of an implicit method, with a contraction by 1/7
CONVERGENCE_TOLERANCE = 4 * 2.0**-52  # relative change of the stages by the last iteration

Acceleration = Callable[[Vector, Vector, Any], Vector]


def step(m: Method, acceleration: Acceleration, q: Vector, qd: Vector, t: Any, h: float) -> Vector:
    """Return q and q̇ at t + h by one step of the Runge-Kutta method `m`, (2, ..., nq).

    q and qd are (..., nq), t is a number or (...,). acceleration: a function of q, q̇ and t that
    returns q̈ of the same shape. For a single state and an implicit method, it is also called with
    all stages at once, (stages, nq) and t (stages,). The result is nan if h is so long that the
    fixed-point iteration for the stages does not converge.
    """
    q, qd = np.asarray(q, float), np.asarray(qd, float)
    A, AA = (_square(rows, m.stages) for rows in (m.a, m.a_squared))
    b, b_a, c = (np.array([float(x) for x in row]) for row in (m.b, m.b_a, m.c))

    def at_stage(i: int, a: Vector) -> Vector:
        place = q + c[i] * h * qd + h**2 * np.tensordot(AA[i], a, 1)
        return acceleration(place, qd + h * np.tensordot(A[i], a, 1), t + c[i] * h)

    def at_stages(a: Vector) -> Vector:
        if q.ndim > 1:
            return np.array([at_stage(i, a) for i in range(m.stages)])
        return acceleration(q + h * np.outer(c, qd) + h**2 * AA @ a, qd + h * A @ a, t + c * h)

    a = np.zeros((m.stages, *q.shape))
    if not m.implicit:
        for i in range(m.stages):
            a[i] = at_stage(i, a)
    else:
        a[:] = acceleration(q, qd, t)
        for _ in range(MAX_SWEEPS):
            new = at_stages(a)
            change = float(np.max(np.abs(new - a)))
            size = np.abs(qd) / h + np.max(np.abs(new), axis=0)
            a = new
            if not np.isfinite(change):  # one stage has overflowed, and others may follow
                a[:] = np.nan
            if not change > CONVERGENCE_TOLERANCE * float(np.max(size)):
                break
        else:
            a[:] = np.nan
    return np.array([q + h * qd + h**2 * np.tensordot(b_a, a, 1), qd + h * np.tensordot(b, a, 1)])


def slopes(a: Acceleration, q: Vector, qd: Vector, t: float, scale: Vector) -> Vector:
    """Return the derivatives of the accelerations with respect to q and q̇ at one state, (nq, 2 nq).

    a: a function of q, q̇ and t that returns the accelerations. The derivatives are central
    differences with steps of 1e-5 times `scale` (2, nq), the typical sizes of q and q̇.
    """
    n = len(q)
    by = np.diag(1e-5 * np.ravel(scale))
    moved = np.concatenate([by, -by]) + np.concatenate([q, qd])
    f = a(moved[:, :n], moved[:, n:], np.full(4 * n, t))
    return np.asarray(((f[: 2 * n] - f[2 * n :]) / (2 * np.diag(by)[:, None])).T)


def contraction_factor(m: Method, slopes: Vector, h: float) -> float:
    """Return the factor by which one fixed-point iteration for implicit stages reduces their error.

    m: the implicit method. slopes: the derivatives of the accelerations with respect to q and q̇,
    (nq, 2 nq). h: step size, s. The iteration converges if the factor is below 1.
    """
    return float(np.max(np.abs(np.linalg.eigvals(_sweep(m, slopes, h)))))


def _sweep(m: Method, slopes: Vector, h: float) -> Vector:
    """Return the matrix (S nq, S nq) of fixed-point iteration of the stages' accelerations."""
    A, AA = (_square(rows, m.stages) for rows in (m.a, m.a_squared))
    n = len(slopes)
    return np.asarray(h * np.kron(A, slopes[:, n:]) + h**2 * np.kron(AA, slopes[:, :n]))


def step_by_newton(
    m: Method, acceleration: Acceleration, q: Vector, qd: Vector, t: float, h: float
) -> tuple[Vector, int]:
    """Return q and q̇ at t + h by one implicit step, (2, nq), and the number of Newton iterations.

    m: the implicit method. acceleration: a function of q, q̇ and t that returns q̈. Newton's method
    for the stages uses the derivatives at the start of the step, and the acceleration there as
    first guess. The state is nan if the method has not converged after MAX_SWEEPS iterations.
    """
    n, S = len(q), m.stages
    A, AA = (_square(rows, S) for rows in (m.a, m.a_squared))
    b, b_a, c = (np.array([float(x) for x in row]) for row in (m.b, m.b_a, m.c))
    first = acceleration(q[None], qd[None], np.array([t]))[0]
    scale = np.array([np.abs(q) + 1, np.abs(qd) + 1])
    J = slopes(acceleration, q, qd, t, scale)
    M = np.eye(S * n) - _sweep(m, J, h)
    a, count, last = np.tile(first, (S, 1)), 0, np.inf
    while count < MAX_SWEEPS:
        places = q + h * np.outer(c, qd) + h**2 * AA @ a
        f = acceleration(places, qd + h * A @ a, t + c * h)
        if not np.all(np.isfinite(f)):
            break
        d = np.linalg.solve(M, np.ravel(f - a)).reshape(S, n)
        a, count = a + d, count + 1
        change = float(np.max(np.abs(d)))
        size = np.max(np.abs(qd)) / h + np.max(np.abs(q)) / h**2 + np.max(np.abs(a))
        if change <= CONVERGENCE_TOLERANCE * float(size) or (
            change <= 1e-10 * float(size) and change > last / 2  # rounding only
        ):
            ends = [q + h * qd + h**2 * b_a @ a, qd + h * b @ a]
            return np.array(ends), count
        last = change
    return np.full((2, n), np.nan), MAX_SWEEPS


def _square(rows: tuple[tuple[Any, ...], ...], n: int) -> Vector:
    """Return the rows of a triangular or square tableau as an (n, n) array."""
    full = np.zeros((n, n))
    for i, row in enumerate(rows):
        full[i, : len(row)] = [float(x) for x in row]
    return full
