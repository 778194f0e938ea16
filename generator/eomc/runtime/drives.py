"""Actuator forces that a motion requires, separated from the constraint forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, not_one_of
from .constrained import Constrained
from .status import MotionError, state_text

# relative to the largest singular value: rows below it are linearly dependent
_DEPENDENT = {"float64": 1e-9, "float32": 1e-4}
# largest residual of the force balance and of the constraint rows, relative to their terms
_RESIDUAL = {"float64": 1e-6, "float32": 1e-3}


def actuated_coordinates(model: Constrained, drives: Sequence[str] | None) -> list[int]:
    """Return the sorted indices of the coordinates along which actuators act.

    drives: names of these coordinates; None: all coordinates. Raises ValueError for unknown names.
    """
    if drives is None:
        return [*range(model.nq)]
    names = (drives,) if isinstance(drives, str) else tuple(drives)
    for name in names:
        if name not in model.coordinates:
            raise ValueError(not_one_of("drives", str(name), model.coordinates))
    return sorted({model.coordinates.index(name) for name in names})


class Motion(NamedTuple):
    """States of a motion and the generalized forces that it requires.

    The shapes are those for one state; for n states all arrays have a first axis n. All arrays but
    q and qd are of type float64.

    Attributes
    ----------
    q, qd, qdd : (nq,) arrays
        Positions, velocities and accelerations.
    force : (nq,) array
        Required sum of the actuator forces and the constraint forces.
    D : (nq, nq) array
        Mass matrix.
    A : (nc, nq) array
        Jacobian of the constraint equations; (0, nq) without constraints.
    free : (nq,) array
        The accelerations that `Constrained.acceleration` computes at the states; they satisfy the
        constraint equations. For scenes without constraints they are qdd.
    """

    q: Array
    qd: Array
    qdd: Array
    force: Array
    D: Array
    A: Array
    free: Array

    @classmethod
    def from_states(
        cls, model: Constrained, q: Array, qd: Array, qdd: Array, force: Array, t: Any, params: Any
    ) -> Motion:
        """Evaluate D, A and the accelerations `free` at the states, and return the motion.

        q, qd, qdd: (nq,) or (n, nq), positions, velocities and accelerations. force: required sum
        of actuator and constraint forces, of the same shape. t: time, s. params: parameters. Raises
        MotionError if an acceleration does not exist.
        """
        D, A, free = model.D(q, t=t, params=params), np.zeros((*q.shape[:-1], 0, model.nq)), qdd
        if len(model._rows.names) > len(model._rows.redundant):
            A = model.constraint_jacobian(q, t=t, params=params)
            free = model.acceleration(q, qd, t, params=params)
        return cls(q, qd, *(np.asarray(x, float) for x in (qdd, force, D, A, free)))

    def state(self, k: tuple[int, ...]) -> Motion:
        """Return the motion at the single state with index k, such as (3,); () for one state."""
        return Motion(*(x[k] for x in self))


def drive_forces(model: Constrained, which: list[int], motion: Motion) -> tuple[Array, Array]:
    """Separate the forces that a motion requires into actuator and constraint forces.

    The solution (tau, lambda) satisfies tau + A^T lambda = force at one state. If it is not unique,
    the one with the smallest tau^T D^-1 tau is returned, which does not depend on the units of the
    coordinates.

    Parameters
    ----------
    which : list of int
        Indices of the coordinates along which actuators act.
    motion : Motion
        Motion at one state.

    Returns
    -------
    tau : (nq,) array
        Actuator forces; 0 for the other coordinates.
    lambda : (nc,) array
        Lagrange multipliers; 0 for redundant constraints.

    Raises
    ------
    ValueError
        If there is no solution, or the accelerations violate a constraint.
    MotionError
        If D is not positive definite or a value is not finite.
    """
    kind, force, D = str(model.dtype), motion.force, motion.D
    rows, least = model._rows, _DEPENDENT[kind]
    solved = [k for k in range(len(rows.names)) if k not in rows.redundant]
    A = motion.A[solved] if solved else motion.A
    if solved:
        _check_constraints(A, [rows.names[k] for k in solved], motion, _RESIDUAL[kind])
    if not all(np.isfinite(x).all() for x in (D, A, force)):
        words = "D, a force or a constraint's slope is not finite there"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "not finite")
    tangent = _null_space(A, least)
    B, right = tangent.T[:, which], tangent.T @ force
    try:
        L = np.linalg.cholesky(np.linalg.inv(_regularised(D, A))[np.ix_(which, which)])
    except np.linalg.LinAlgError:
        words = "D is not positive definite there, so no force is the least"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "singular") from None
    solution = np.linalg.lstsq(np.linalg.solve(L, B.T).T, right, rcond=least)[0]
    tau = np.zeros(model.nq)
    tau[which] = np.linalg.solve(L.T, solution)
    if np.any(np.abs(B @ tau[which] - right) > _RESIDUAL[kind] * np.max(np.abs(force), initial=0)):
        names = ", ".join(model.coordinates[k] for k in which) or "nothing"
        where = state_text(motion.q, motion.qd)
        raise ValueError(
            f"drives: forces along {names} can't give this motion at {where}: name"
            f" others, or more; there are {len(right)} freedoms"
        )
    multipliers = np.zeros(len(rows.names))
    multipliers[solved] = np.linalg.lstsq(A.T, force - tau, rcond=least)[0]
    return tau, multipliers


def _check_constraints(A: Array, names: list[str], motion: Motion, tolerance: float) -> None:
    """Raise ValueError if the accelerations violate the constraints."""
    qdd, free = motion.qdd, motion.free
    actual, required = A @ qdd, A @ free
    residual = np.abs(actual - required)
    limit = np.abs(A) @ (np.abs(qdd) + np.abs(free))
    worst = int(np.argmax(residual / np.maximum(limit, 1e-300)))
    if residual[worst] > tolerance * limit[worst]:
        raise ValueError(
            f"qdd: leaves the constraint {names[worst]}: its row of A qdd, of "
            f"constraint_jacobian(q), is {actual[worst]:.6g} and has to be {required[worst]:.6g}"
        )


def _null_space(A: Array, least: float) -> Array:
    """Return an orthonormal basis (nq, k) of the null space of A."""
    if not len(A):
        return np.eye(A.shape[1])
    _, sizes, directions = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=1)[:, None], 1e-300))
    return np.asarray(directions[int((sizes > least * sizes[0]).sum()) :].T)


def _regularised(D: Array, A: Array) -> Array:
    """Return D, plus a multiple of A^T A if D is singular."""
    if np.linalg.cond(D) < 1e12:
        return D
    return np.asarray(D + A.T @ A * (np.trace(D) / np.sum(A**2)))
