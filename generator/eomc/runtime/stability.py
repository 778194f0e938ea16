"""The step size against the stability limit of its method, and against the run."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import numpy as np

from .arguments import Array
from .metadata import ModelInfo


def beyond_end(h: float, duration: float) -> str | None:
    """A sentence where one step is longer than the whole run is to be."""
    if not 0 < duration < h * (1 - 1e-12):
        return None
    return (
        f"h = {h:g} s is longer than the duration, {duration:g} s: the run is one step of {h:g} s"
    )


def advice(
    model: ModelInfo, q: Array, qd: Array, h: float, t: float, u: Any, params: Any, method: str
) -> str | None:
    """A sentence where h is beyond the stability limit of the method at a state, else None.

    The limit is that of the eigenvalues of the linearised motion: largest |imaginary part| and
    fastest decay against the method's two limits. A mode that is as fast as the differences are
    short comes from a jump of the forces, and is not counted.
    """
    undamped, decaying = model.stability_limits[method]
    found = _modes(model, q, qd, t, u, params, 1.0)
    if found is None:
        return None
    turning, decay = found
    longest = min(
        undamped / turning if turning else math.inf, decaying / decay if decay else math.inf
    )
    if not 0 < longest < abs(h):
        return None
    if (again := _modes(model, q, qd, t, u, params, 100.0)) is None:
        return None
    if max(again) < max(turning, decay) / 2:
        return None
    if undamped * decay > decaying * turning:
        mode = f"fastest decay {decay:.3g} 1/s"
    else:
        mode = f"fastest mode {turning:.3g} rad/s"
    return (
        f"h = {abs(h):g} s is beyond {method}'s stability limit of about {longest:.2g} s here "
        f"({mode} at the start)"
    )


def _modes(
    model: ModelInfo, q: Array, qd: Array, t: float, u: Any, params: Any, wide: float
) -> tuple[float, float] | None:
    """(largest |Im|, fastest decay) of the eigenvalues at a state, 1/s; None where there are none.

    From the module's own derivatives where they are the motion's, else from differences of the
    acceleration, `wide` times the usual distance apart. Under constraints the slower of two: of
    all changes, some of which every step takes back, and of those that rows allow, which turn with
    the motion.
    """
    n, x = model.nq, np.concatenate([q, qd]).astype(float)
    near = wide * math.sqrt(float(np.finfo(model.dtype).eps)) * np.maximum(1.0, np.abs(x))

    def spectrum(ways: Array) -> tuple[float, float]:
        moved = near[:, None] * ways
        if model.has_slopes and (u is not None or not model.nu):  # signals may depend on the state
            rates = model.linearize(q, qd, t=t, u=u, params=params)[0].astype(float) @ moved
        else:
            states = np.vstack([x, x + moved.T]).astype(model.dtype)
            a = model.acceleration(states[:, :n], states[:, n:], t, u, params).astype(float)
            rates = np.vstack([moved[n:], (a[1:] - a[0]).T])
        values = np.linalg.eigvals(ways.T @ (rates / near[:, None]))
        turning, decay = np.max(np.abs(values.imag), initial=0), np.max(-values.real, initial=0)
        return float(turning), float(decay)

    found: list[tuple[float, float]] = []  # where there are none the run itself reports it
    with suppress(ArithmeticError, np.linalg.LinAlgError):
        found.append(spectrum(np.eye(2 * n)))
    if model.constraint_names:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            found.append(spectrum(_allowed(model, x, t, params, near)))
    return min(found, key=max, default=None)


def _allowed(model: ModelInfo, x: Array, t: float, params: Any, near: Array) -> Array:
    """Changes of x = [q; qd], in units of `near`, that keep constraints: (2 nq, k), orthonormal."""
    n, holonomic = model.nq, model._rows.holonomic
    least = math.sqrt(float(np.finfo(model.dtype).eps))
    q, qd = (half.astype(model.dtype) for half in (x[:n], x[n:]))
    A = model.constraint_jacobian(q, t=t, params=params).astype(float)
    sizes = np.maximum(np.linalg.norm(A * near[n:], axis=1), 1e-300)  # rows have units of their own
    back = A * near[n:] / sizes[:, None]
    of_q = _kernel((A * near[:n] / sizes[:, None])[:holonomic], least)
    places = np.vstack([q, x[:n] + (near[:n, None] * of_q).T]).astype(model.dtype)
    rates = model.constraint_rates(places, np.tile(qd, (len(places), 1)), t, params).astype(float)
    follow = -np.linalg.pinv(back, rcond=least) @ ((rates[1:] - rates[0]) / sizes).T
    of_qd = _kernel(back, least)
    whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
    return np.asarray(np.linalg.qr(whole)[0])


def _kernel(A: Array, least: float) -> Array:
    """What A makes zero, (n, k), orthonormal: to `least` of its largest singular value."""
    _, sizes, rows = np.linalg.svd(A)
    return np.asarray(rows[np.sum(sizes > least * np.max(sizes, initial=0)) :].T)
