"""Where a motion rests: Newton's method on the forces, over coordinates and inputs.

Constraints bear forces: what their multipliers can't is what has to vanish.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import Array, not_one_of
from .trajectory import MotionError, state_text

if TYPE_CHECKING:
    from .constrained import Constrained

_MOST = 100  # steps of Newton's method
_RANK_TOLERANCE = 1e-9  # of the largest singular value of A: a row that is none here
_SHORTEST = 2.0**-20  # part of a step that is tried


def equilibrium(
    model: Constrained, q: Array, qd: Array, u: Array | None, free: Collection[str], t: float,
    params: Any,
) -> tuple[Array, Array | None]:  # fmt: skip
    """(q, u) near a guess where tau + A^T lambda = C qd + g, what is not `free` as it was.

    Forces, not accelerations: D couples these, and may be singular. Their slopes are differences,
    which cost a step some digits and the result none. Where more is free than they determine, each
    step is the shortest. u None: the signals, also where they depend on q. Under constraints what
    multipliers can't bear counts, and steps are along the rows.
    """
    n, known = model.nq, (*model.coordinates, *model.inputs)
    if strange := [name for name in free if name not in known]:
        raise ValueError(not_one_of("free", strange[0], known))
    moved = np.array([name in free for name in known])
    if u is None and np.any(moved[n:]):
        u = np.asarray(model.signal(q, qd, t, params))
    z = np.concatenate([q, np.empty(0) if u is None else u]).astype(float)
    moved = moved[: len(z)]
    rows = _Rows(model, moved, t, params) if model.constraint_names else None

    def whole(z: Array) -> Array:
        held = None if u is None else z[n:]
        tau = model.tau(z[:n], qd, t, held, params)
        found: Array = tau.astype(float) - model.bias(z[:n], qd, t=t, params=params)
        return found

    def forces(z: Array) -> Array:
        return rows.unborne(z[:n], whole(z)) if rows else whole(z)

    eps = float(np.finfo(model.dtype).eps)
    onto = rows.onto if rows else lambda z: z
    z = onto(z)
    now, size = forces(z), np.inf
    for _ in range(_MOST):
        ways = rows.along(z) if rows else np.eye(len(z))[moved]  # (k, len(z))
        reach = np.maximum(1.0, np.abs(ways) @ np.abs(z))
        near = np.cbrt(eps) * reach[:, None] * ways
        columns = [forces(onto(z + e)) - forces(onto(z - e)) for e in near]
        slope = np.reshape(columns, (-1, n)).T / (2 * np.cbrt(eps) * reach)
        size = float(np.max(np.abs(slope) @ reach, initial=0))
        if not np.isfinite(size + now @ now) or not len(ways):
            break
        along = -np.linalg.lstsq(slope, now, rcond=1e-11)[0]
        step = along @ ways
        fall = 1e-3 * (now @ slope @ along)  # what is asked for of one that is taken whole
        # a coordinate by 1, or its own size, at most: angles come round
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > _SHORTEST:
            there = _tried(onto, z + part * step)
            left = None if there is None else forces(there)
            if left is not None and left @ left < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        assert there is not None and left is not None
        z, now = there, left
    size += float(np.max(np.abs(whole(z)))) if rows else 0.0
    largest = int(np.argmax(np.abs(now)))
    if not np.abs(now[largest]) <= np.sqrt(eps) * size:  # rounding leaves less
        raise MotionError(
            f"no equilibrium found from {state_text(q, qd)}: the search ends at "
            f"q = {np.array2string(z[:n], precision=6, threshold=12)}, where a force of "
            f"{now[largest]:.3g} is left on {model.coordinates[largest]}; start elsewhere, or let "
            "another coordinate or input be free",
            "no convergence",
        )
    at = z[:n].astype(model.dtype)
    if u is None:
        return at, np.asarray(model.signal(at, qd, t, params)) if model.nu else None
    return at, z[n:].astype(model.dtype)


def _tried(onto: Callable[[Array], Array], z: Array) -> Array | None:
    """`onto` of a state; None where the rows have none near."""
    try:
        return onto(z)
    except MotionError:
        return None


@dataclass(frozen=True)
class _Rows:
    """Constraints of a model around coordinates and inputs z, of which `moved` (len(z),) may."""

    model: Constrained
    moved: Array
    t: float
    params: Any

    def onto(self, z: Array) -> Array:
        """z with its free coordinates moved onto the rows. Raises MotionError."""
        n = self.model.nq
        held = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model._projected(z[:n], np.zeros(n), self.t, self.params, held)
        return np.concatenate([q, z[n:]])

    def along(self, z: Array) -> Array:
        """(k, len(z)): the ways that the rows leave to what is free, orthonormal."""
        n, moved = self.model.nq, np.flatnonzero(self.moved[: self.model.nq])
        A = self.model.constraint_jacobian(z[:n], t=self.t, params=self.params)[:, moved]
        _, s, V = np.linalg.svd(A.astype(float))
        rank = int(np.sum(s > _RANK_TOLERANCE * np.max(s, initial=0)))
        ways = np.zeros((len(moved) - rank, len(z)))
        ways[:, moved] = V[rank:]
        return np.concatenate([ways, np.eye(len(z))[n:][self.moved[n:]]])

    def unborne(self, q: Array, forces: Array) -> Array:
        """What of the forces (nq,) no multipliers can bear."""
        A = self.model.constraint_jacobian(q, t=self.t, params=self.params).astype(float)
        left: Array = forces - A.T @ np.linalg.lstsq(A.T, forces, rcond=_RANK_TOLERANCE)[0]
        return left
