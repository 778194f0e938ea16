"""One step of any Runge-Kutta method by its tableau, on accelerations that are given.

The formulas of `steppers`, in NumPy, with all stages kept: what a generated stepper is compared
with. Nothing is shared with the templates but the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eomc.integrators.tableaux import Method
from eomc.verify.oracle import Vector

SWEEPS = 20  # over the stages of an implicit method: they are to contract to a seventh
SETTLED = 4 * 2.0**-52  # of a velocity: the stages are found

Acceleration = Callable[[Vector, Vector, Any], Vector]


def step(m: Method, acceleration: Acceleration, q: Vector, qd: Vector, t: Any, h: float) -> Vector:
    """(2, ..., nq): q and qd at t + h; q, qd (..., nq), t a number or (...,).

    acceleration: a(q, qd, t), of that shape. nan where the stages of an implicit method are not
    found by plain sweeps: h is too long for them.
    """
    q, qd = np.asarray(q, float), np.asarray(qd, float)
    A, AA = (_square(rows, m.stages) for rows in (m.a, m.a_squared))
    b, b_a, c = (np.array([float(x) for x in row]) for row in (m.b, m.b_a, m.c))

    def at_stage(i: int, a: Vector) -> Vector:
        place = q + c[i] * h * qd + h**2 * np.tensordot(AA[i], a, 1)
        return acceleration(place, qd + h * np.tensordot(A[i], a, 1), t + c[i] * h)

    a = np.zeros((m.stages, *q.shape))
    if not m.implicit:
        for i in range(m.stages):
            a[i] = at_stage(i, a)
    else:
        a[:] = acceleration(q, qd, t)
        for _ in range(SWEEPS):
            new = np.array([at_stage(i, a) for i in range(m.stages)])
            change = float(np.max(np.abs(new - a)))
            size = np.abs(qd) / h + np.max(np.abs(new), axis=0)
            a = new
            if not np.isfinite(change) or change <= SETTLED * float(np.max(size)):
                break
        else:
            a = np.full_like(a, np.nan)
    return np.array([q + h * qd + h**2 * np.tensordot(b_a, a, 1), qd + h * np.tensordot(b, a, 1)])


def _square(rows: tuple[tuple[Any, ...], ...], n: int) -> Vector:
    """The rows of a triangle or a square as an (n, n) array."""
    full = np.zeros((n, n))
    for i, row in enumerate(rows):
        full[i, : len(row)] = [float(x) for x in row]
    return full
