"""Where a motion rests: Newton's method on the forces, over coordinates and inputs."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import Array, not_one_of
from .trajectory import MotionError, state_text

if TYPE_CHECKING:
    from .model import Model

_MOST = 100  # steps of Newton's method
_SHORTEST = 2.0**-20  # part of a step that is tried


def equilibrium(
    model: Model, q: Array, qd: Array, u: Array | None, free: Collection[str], t: float, params: Any
) -> tuple[Array, Array | None]:
    """(q, u) near a guess where tau = C qd + g, what is not `free` as it was.

    Forces, not accelerations: D couples these, and may be singular. Their slopes are differences,
    which cost a step some digits and the result none. Where more is free than they determine, each
    step is the shortest. u None: the signals, also where they depend on q.
    """
    if model.constraint_names:
        raise ValueError(
            "equilibrium: is not for scenes with constraints, whose forces it does not know: let "
            "the motion come to rest by damping"
        )
    n, known = model.nq, (*model.coordinates, *model.inputs)
    if strange := [name for name in free if name not in known]:
        raise ValueError(not_one_of("free", strange[0], known))
    moved = [k for k, name in enumerate(known) if name in free]
    if u is None and any(k >= n for k in moved):
        u = np.asarray(model.signal(q, qd, t, params))
    z = np.concatenate([q, np.empty(0) if u is None else u]).astype(float)

    def forces(z: Array) -> Array:
        held = None if u is None else z[n:]
        tau = model.tau(z[:n], qd, t, held, params)
        found: Array = tau.astype(float) - model.bias(z[:n], qd, t=t, params=params)
        return found

    eps = float(np.finfo(model.dtype).eps)
    now, size = forces(z), np.inf
    for _ in range(_MOST):
        near = np.cbrt(eps) * np.maximum(1.0, np.abs(z))
        columns = [(forces(z + e) - forces(z - e)) for e in np.diag(near)[moved]]
        slope = np.reshape(columns, (-1, n)).T / (2 * near[moved])
        size = float(np.max(np.abs(slope) @ np.maximum(1.0, np.abs(z[moved]))))
        if not np.isfinite(size + now @ now):
            break
        step = np.zeros_like(z)
        step[moved] = -np.linalg.lstsq(slope, now, rcond=1e-11)[0]
        fall = 1e-3 * (now @ slope @ step[moved])  # what is asked for of one that is taken whole
        # a coordinate by 1, or its own size, at most: angles come round
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > _SHORTEST:
            there = forces(z + part * step)
            if there @ there < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        z, now = z + part * step, there
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
