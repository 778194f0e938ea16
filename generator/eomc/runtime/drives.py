"""The forces of drives that a motion takes, parted from those of constraints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, not_one_of
from .constrained import Constrained
from .status import MotionError, state_text

_DEPENDENT = {"float64": 1e-9, "float32": 1e-4}  # of the largest singular value
_LEFT = {"float64": 1e-6, "float32": 1e-3}  # of the terms: what drives or rows may leave


def actuated_coordinates(model: Constrained, drives: Sequence[str] | None) -> list[int]:
    """Which coordinates have drives, all where None. Raises ValueError for unknown names."""
    if drives is None:
        return [*range(model.nq)]
    names = (drives,) if isinstance(drives, str) else tuple(drives)
    for name in names:
        if name not in model.coordinates:
            raise ValueError(not_one_of("drives", str(name), model.coordinates))
    return sorted({model.coordinates.index(name) for name in names})


class Motion(NamedTuple):
    """Where a motion is and what it takes, of one state or (n, ...) of many; doubles but q, qd.

    force: what drives and constraints give together. A: the rows of constraints. free: the
    accelerations without drives, of scenes with constraints alone.
    """

    q: Array
    qd: Array
    qdd: Array
    force: Array
    D: Array
    A: Array
    free: Array

    @classmethod
    def of(
        cls, model: Constrained, q: Array, qd: Array, qdd: Array, force: Array, t: Any, params: Any
    ) -> Motion:
        """The motion at states q, qd (..., nq). Raises MotionError."""
        D, A, free = model.D(q, t=t, params=params), np.zeros((*q.shape[:-1], 0, model.nq)), qdd
        if len(model._rows.names) > len(model._rows.redundant):
            A = model.constraint_jacobian(q, t=t, params=params)
            free = model.acceleration(q, qd, t, params=params)
        return cls(q, qd, *(np.asarray(x, float) for x in (qdd, force, D, A, free)))

    def at(self, k: tuple[int, ...]) -> Motion:
        """That of state k."""
        return Motion(*(x[k] for x in self))


def drive_forces(model: Constrained, which: list[int], motion: Motion) -> tuple[Array, Array]:
    """(tau, lambda) of one state, with tau + A^T lambda = force.

    tau is along the coordinates `which`. Where several are right, it is that of the least
    tau^T D^-1 tau, which has no units to choose. Raises ValueError where none is, MotionError where
    D is not positive definite, or something not finite.
    """
    kind, force, D = str(model.dtype), motion.force, motion.D
    rows, least = model._rows, _DEPENDENT[kind]
    solved = [k for k in range(len(rows.names)) if k not in rows.redundant]
    A = motion.A[solved] if solved else motion.A
    if solved:
        _rows_keep(A, [rows.names[k] for k in solved], motion, _LEFT[kind])
    if not all(np.isfinite(x).all() for x in (D, A, force)):
        words = "D, a force or a constraint's slope is not finite there"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "not finite")
    along = _along(A, least)
    B, right = along.T[:, which], along.T @ force
    try:
        L = np.linalg.cholesky(np.linalg.inv(_regular(D, A))[np.ix_(which, which)])
    except np.linalg.LinAlgError:
        words = "D is not positive definite there, so no force is the least"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "singular") from None
    found = np.linalg.lstsq(np.linalg.solve(L, B.T).T, right, rcond=least)[0]
    tau = np.zeros(model.nq)
    tau[which] = np.linalg.solve(L.T, found)
    if np.any(np.abs(B @ tau[which] - right) > _LEFT[kind] * np.max(np.abs(force), initial=0)):
        names = ", ".join(model.coordinates[k] for k in which) or "nothing"
        where = state_text(motion.q, motion.qd)
        raise ValueError(
            f"drives: forces along {names} can't give this motion at {where}: name"
            f" others, or more; there are {len(right)} freedoms"
        )
    multipliers = np.zeros(len(rows.names))
    multipliers[solved] = np.linalg.lstsq(A.T, force - tau, rcond=least)[0]
    return tau, multipliers


def _rows_keep(A: Array, names: list[str], motion: Motion, left: float) -> None:
    """Raise ValueError where rows don't allow the accelerations."""
    qdd, free = motion.qdd, motion.free
    given, wanted = A @ qdd, A @ free
    off = np.abs(given - wanted)
    limit = np.abs(A) @ (np.abs(qdd) + np.abs(free))
    worst = int(np.argmax(off / np.maximum(limit, 1e-300)))
    if off[worst] > left * limit[worst]:
        raise ValueError(
            f"qdd: leaves the constraint {names[worst]}: its row of A qdd, of "
            f"constraint_jacobian(q), is {given[worst]:.6g} and has to be {wanted[worst]:.6g}"
        )


def _along(A: Array, least: float) -> Array:
    """(nq, k): the directions in which no row changes, orthonormal."""
    if not len(A):
        return np.eye(A.shape[1])
    _, sizes, directions = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=1)[:, None], 1e-300))
    return np.asarray(directions[int((sizes > least * sizes[0]).sum()) :].T)


def _regular(D: Array, A: Array) -> Array:
    """D, with the rows' weight where it has no inverse by itself."""
    if np.linalg.cond(D) < 1e12:
        return D
    return np.asarray(D + A.T @ A * (np.trace(D) / np.sum(A**2)))
