"""The derivatives of the reference's accelerations, by differences of order 8.

What a module's `linearize` and `sensitivity` are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from eomc.verify.reference import STENCIL, Reference, Vector
from eomc.verify.sampling import State

WIDTHS = (0.03, 0.003, 3e-4, 3e-5, 3e-6)  # of the scale of each variable


def differentiate(
    reference: Reference, s: State, scale: Vector, defaults: Mapping[str, float],
    name: str = "acceleration",
) -> Iterator[tuple[Vector, Vector]]:  # fmt: skip
    """Yield derivatives of the reference's accelerations at a state, as difference quotients.

    Each item is a pair (J, scales), one for each step width in WIDTHS. J (nq, 2 nq + nu + np)
    contains the derivatives with respect to q, q̇, the inputs u and the parameters p. scales are
    typical sizes of these variables; the steps are WIDTHS times these. Inputs are constant: those
    of the state or, if it has none, the values of the scene's signals.

    Parameters
    ----------
    reference : Reference
        The independent evaluation of the system in Python.
    s : State
        The state.
    scale : (2, nq) array
        Typical sizes of q and q̇.
    defaults : mapping
        Parameter values, used if the state has none.
    name : str
        Method of the reference to be differentiated in place of `acceleration`.
    """
    n, params = len(s.q), dict(s.params or defaults)
    u = np.zeros(0)
    if reference.system.inputs:
        u = np.asarray(reference.evaluate("signals", s.q, s.qd, s.t, None, s.params), float)
        u = u if s.u is None else s.u
    x = np.concatenate([s.q, s.qd, u, list(params.values())])
    scales = np.concatenate(
        [scale.ravel(), np.maximum(1.0, np.abs(u)), np.abs(x[2 * n + len(u) :])]
    )
    scales = np.where(scales > 0, scales, 1.0)
    for width in WIDTHS:
        steps = np.concatenate([k * np.diag(width * scales) for m, _ in STENCIL for k in (m, -m)])
        rows = x + steps
        arguments: dict[str, Any] = {
            "u": rows[:, 2 * n : 2 * n + len(u)] if len(u) else None,
            "params": dict(zip(params, rows[:, 2 * n + len(u) :].T, strict=True)),
        }
        t = np.full(len(rows), s.t)
        a = getattr(reference, name)(rows[:, :n], rows[:, n : 2 * n], t, **arguments)
        forward, back = np.moveaxis(a.reshape(len(STENCIL), 2, len(x), -1), 1, 0)
        weights = np.array([w for _, w in STENCIL])
        yield np.tensordot(weights, forward - back, 1).T / (width * scales), scales


def relative_differences(values: Vector, exact: Vector, scales: Vector, size: Vector) -> Vector:
    """Return |values - exact|, (nq, k), relative to the largest scaled entry in each matrix row.

    Scaled means that column j of both matrices is multiplied by scales[j]. `size` (nq,) is the size
    of the terms that add up to each acceleration: 1e-4 of it is added to the divisor, since
    difference quotients lose digits. An entry is nan if `exact` is not finite there, and inf if
    only `values` is not.
    """
    largest = np.max(np.abs(exact) * scales, axis=1, initial=0) + 1e-4 * size
    with np.errstate(all="ignore"):
        difference = np.abs(values - exact) * scales / largest[:, None]
    difference = np.where(values == exact, 0, difference)
    return np.asarray(
        np.where(np.isfinite(exact), np.where(np.isfinite(values), difference, np.inf), np.nan)
    )
