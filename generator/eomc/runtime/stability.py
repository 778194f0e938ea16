"""Check the step size against the stability limit of the method and the duration."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array
from .interfaces import CompiledModel

MIN_STEPS = 20  # runs of fewer steps are not checked


class LinearizationState(NamedTuple):
    """State at which the motion is linearised.

    Attributes
    ----------
    q, qd : (nq,) arrays
        Positions and velocities.
    t : float
        Time, s.
    u : (nu,) array or None
        Inputs; None: the scene's signals.
    params
        Parameters.
    """

    q: Array
    qd: Array
    t: float
    u: Any
    params: Any


def advice(model: CompiledModel, state: LinearizationState, h: float, method: str) -> str | None:
    """Return a message if the step size h is too large for a stable run from a state, else None.

    h: step size, s. method: name of the method.

    The motion is linearised at the state. The largest |imaginary part| and the fastest decay of its
    eigenvalues are compared with the two stability limits of the method. A mode whose speed depends
    on the width of the finite differences comes from a discontinuity of the forces and is ignored.
    """
    limits = model.info.method_table[method]
    undamped, decaying = limits.oscillation_limit, limits.decay_limit
    modes = _fastest_modes(model, state, 1.0)
    if modes is None:
        return None
    turning, decay = modes
    longest = min(
        undamped / turning if turning else math.inf, decaying / decay if decay else math.inf
    )
    if not 0 < longest < abs(h):
        return None
    if (again := _fastest_modes(model, state, 100.0)) is None:
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


def _fastest_modes(
    model: CompiledModel, state: LinearizationState, wide: float
) -> tuple[float, float] | None:
    """Return (largest |Im|, fastest decay) of the eigenvalues at a state, 1/s, or None.

    The linearisation is the module's own where available, else a finite difference of the
    acceleration, whose width is `wide` times the usual one. With constraints there are two
    spectra, of all perturbations and of those tangent to the constraints; the slower one counts.
    """
    q, qd, t, u, params = state
    n, x = model.info.nq, np.concatenate([q, qd]).astype(float)
    near = wide * math.sqrt(float(np.finfo(model.info.dtype).eps)) * np.maximum(1.0, np.abs(x))

    def spectrum(ways: Array) -> tuple[float, float]:
        """Return (largest |Im|, fastest decay) of the linearised motion's eigenvalues, 1/s.

        ways: (2 nq, k), orthonormal columns; the motion is linearised in these directions only.
        """
        moved = near[:, None] * ways
        if model.functions.has_slopes and (
            u is not None or not model.info.nu
        ):  # signals may depend on the state
            rates = (
                model.functions.linearize(q, qd, t=t, u=u, params=params)[0].astype(float) @ moved
            )
        else:
            states = np.vstack([x, x + moved.T]).astype(model.info.dtype)
            a = model.functions.acceleration(states[:, :n], states[:, n:], t, u, params).astype(
                float
            )
            rates = np.vstack([moved[n:], (a[1:] - a[0]).T])
        values = np.linalg.eigvals(ways.T @ (rates / near[:, None]))
        turning, decay = np.max(np.abs(values.imag), initial=0), np.max(-values.real, initial=0)
        return float(turning), float(decay)

    modes: list[tuple[float, float]] = []  # if empty, the run itself reports the error
    with suppress(ArithmeticError, np.linalg.LinAlgError):
        modes.append(spectrum(np.eye(2 * n)))
    if model.info.constraints.names:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            modes.append(spectrum(_tangent_basis(model, x, t, params, near)))
    return min(modes, key=max, default=None)


def _tangent_basis(model: CompiledModel, x: Array, t: float, params: Any, near: Array) -> Array:
    """Return an orthonormal basis (2 nq, k) of the tangent space of the constraints.

    Perturbations of x = [q; qd] are in units of `near`.
    """
    n, holonomic = model.info.nq, model.info.constraints.holonomic
    least = math.sqrt(float(np.finfo(model.info.dtype).eps))
    q, qd = (half.astype(model.info.dtype) for half in (x[:n], x[n:]))
    A = model.constraints.constraint_jacobian(q, t=t, params=params).astype(float)
    sizes = np.maximum(np.linalg.norm(A * near[n:], axis=1), 1e-300)  # rows have units of their own
    back = A * near[n:] / sizes[:, None]
    of_q = _null_space((A * near[:n] / sizes[:, None])[:holonomic], least)
    places = np.vstack([q, x[:n] + (near[:n, None] * of_q).T]).astype(model.info.dtype)
    rates = model.constraints.constraint_rates(
        places, np.tile(qd, (len(places), 1)), t, params
    ).astype(float)
    follow = -np.linalg.pinv(back, rcond=least) @ ((rates[1:] - rates[0]) / sizes).T
    of_qd = _null_space(back, least)
    whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
    return np.asarray(np.linalg.qr(whole)[0])


def _null_space(A: Array, least: float) -> Array:
    """Return an orthonormal basis (n, k) of the null space; `least`: relative tolerance."""
    _, sizes, rows = np.linalg.svd(A)
    return np.asarray(rows[np.sum(sizes > least * np.max(sizes, initial=0)) :].T)
