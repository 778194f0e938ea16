"""Where a motion rests: Newton's method on the forces, over coordinates and inputs.

Constraints bear forces: what their multipliers can't is what has to vanish, and rows of rates too.
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
    multipliers can't bear counts, steps are along rows of positions, and rows of rates hold at qd.
    """
    n, known = model.nq, (*model.coordinates, *model.inputs)
    if strange := [name for name in free if name not in known]:
        raise ValueError(not_one_of("free", strange[0], known))
    moved = np.array([name in free for name in known])
    if u is None and np.any(moved[n:]):
        u = np.asarray(model.signal(q, qd, t, params))
    z = np.concatenate([q, np.empty(0) if u is None else u]).astype(float)
    moved = moved[: len(z)]
    rows = _Rows(model, moved, qd, t, params) if model.constraint_names else None

    def held(z: Array) -> Array | None:
        return None if u is None else z[n:]

    def whole(z: Array) -> Array:
        tau = model.tau(z[:n], qd, t, held(z), params)
        found: Array = tau.astype(float) - model.bias(z[:n], qd, t=t, params=params)
        return found

    def rest(z: Array) -> Array:
        return rows.left(z[:n], whole(z)) if rows else whole(z)

    eps = float(np.finfo(model.dtype).eps)
    onto = rows.onto if rows else lambda z: z
    z = onto(z)
    now, sizes = rest(z), np.full(n, np.inf)
    for _ in range(_MOST):
        ways = rows.along(z) if rows else np.eye(len(z))[moved]  # (k, len(z))
        reach = np.maximum(1.0, np.abs(ways) @ np.abs(z))
        near = np.cbrt(eps) * reach[:, None] * ways
        columns = [rest(onto(z + e)) - rest(onto(z - e)) for e in near]
        slope = np.reshape(columns, (-1, len(now))).T / (2 * np.cbrt(eps) * reach)
        sizes = np.abs(slope) @ reach
        if not np.isfinite(sizes.sum() + now @ now) or not len(ways):
            break
        along = -np.linalg.lstsq(slope, now, rcond=1e-11)[0]
        step = along @ ways
        fall = 1e-3 * (now @ slope @ along)  # what is asked for of one that is taken whole
        # a coordinate by 1, or its own size, at most: angles come round
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > _SHORTEST:
            there = _tried(onto, z + part * step)
            left = None if there is None else rest(there)
            if left is not None and left @ left < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        assert there is not None and left is not None
        z, now = there, left
    sizes[:n] = np.max(sizes[:n], initial=0) + (np.max(np.abs(whole(z))) if rows else 0.0)
    if rows:
        sizes[n:] += rows.of_rates(z[:n])
    much = ~(np.abs(now) <= np.sqrt(eps) * sizes)  # rounding leaves less
    if much.any():
        raise MotionError(
            f"no equilibrium found from {state_text(q, qd)}: the search ends at "
            f"q = {np.array2string(z[:n], precision=6, threshold=12)}, where "
            f"{_too_much(model, now * much)}{_beyond(model, z[:n], qd, held(z), t, params)}; start "
            "elsewhere, or let another coordinate or input be free",
            "no convergence",
        )
    at = z[:n].astype(model.dtype)
    if u is None:
        return at, np.asarray(model.signal(at, qd, t, params)) if model.nu else None
    return at, z[n:].astype(model.dtype)


def _too_much(model: Constrained, left: Array) -> str:
    """What keeps a state from being an equilibrium: the largest force, or a row of rates."""
    n, rows = model.nq, model._rows
    worst = int(np.argmax(np.abs(left[:n])))
    if left[worst] != 0 or len(left) == n:
        return f"a force of {left[worst]:.3g} is left on {model.coordinates[worst]}"
    worst = int(np.argmax(np.abs(left[n:])))
    return f"the rates break {rows.names[rows.holonomic + worst]} by {left[n + worst]:.3g}"


def _beyond(model: Constrained, q: Array, qd: Array, u: Array | None, t: float, params: Any) -> str:
    """Which inputs ask for more than their limits let act, in words."""
    if not model.has_limits:
        return ""
    asked = model.signal(q, qd, t, params) if u is None else u
    cut = asked != model.applied(q, qd, t, u, params)
    names = [name for name, far in zip(model.inputs, cut, strict=True) if far]
    return f", with {', '.join(names)} beyond {'their' if names[1:] else 'its'} limits" * bool(
        names
    )


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
    qd: Array
    t: float
    params: Any

    def onto(self, z: Array) -> Array:
        """z with its free coordinates moved onto the rows. Raises MotionError."""
        n = self.model.nq
        held = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model._projected(z[:n], np.zeros(n), self.t, self.params, held)
        return np.concatenate([q, z[n:]])

    def along(self, z: Array) -> Array:
        """(k, len(z)): the ways that rows of positions leave to what is free, orthonormal."""
        n, moved = self.model.nq, np.flatnonzero(self.moved[: self.model.nq])
        _, s, V = np.linalg.svd(self._slopes(z[:n])[: self.model._rows.holonomic, moved])
        rank = int(np.sum(s > _RANK_TOLERANCE * np.max(s, initial=0)))
        ways = np.zeros((len(moved) - rank, len(z)))
        ways[:, moved] = V[rank:]
        return np.concatenate([ways, np.eye(len(z))[n:][self.moved[n:]]])

    def left(self, q: Array, forces: Array) -> Array:
        """What no multipliers can bear of the forces (nq,), then what rows of rates lack."""
        A = self._slopes(q)
        forces = forces - A.T @ np.linalg.lstsq(A.T, forces, rcond=_RANK_TOLERANCE)[0]
        lacking = self.model.constraint_rates(q, self.qd, self.t, self.params)
        return np.concatenate([forces, lacking[self.model._rows.holonomic :]]).astype(float)

    def of_rates(self, q: Array) -> Array:
        """The terms of each row of rates, in size, that are linear in them."""
        sizes: Array = (np.abs(self._slopes(q)) @ np.abs(self.qd))[self.model._rows.holonomic :]
        return sizes

    def _slopes(self, q: Array) -> Array:
        A: Array = self.model.constraint_jacobian(q, t=self.t, params=self.params).astype(float)
        return A
