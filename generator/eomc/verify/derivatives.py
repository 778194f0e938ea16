"""The derivatives of the reference's accelerations, by differences of order 8.

What a module's `linearize` and `sensitivity` are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from eomc.verify.oracle import STENCIL, Answer, Vector
from eomc.verify.sampling import State

WIDTHS = (0.03, 0.003, 3e-4, 3e-5, 3e-6)  # of the scale of each variable


def by_differences(
    reference: Answer, s: State, scale: Vector, defaults: Mapping[str, float],
    of: str = "acceleration",
) -> Iterator[tuple[Vector, Vector]]:  # fmt: skip
    """dqdd/d[q, qd, u, p] (nq, 2 nq + nu + np) and the scales of these, for each of WIDTHS.

    scale: (2, nq), of q and qd. u: held, at the signals where the state has none. of: what else the
    reference has of a state, (m,), in place of qdd.
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
        given: dict[str, Any] = {
            "u": rows[:, 2 * n : 2 * n + len(u)] if len(u) else None,
            "params": dict(zip(params, rows[:, 2 * n + len(u) :].T, strict=True)),
        }
        t = np.full(len(rows), s.t)
        a = getattr(reference, of)(rows[:, :n], rows[:, n : 2 * n], t, **given)
        forward, back = np.moveaxis(a.reshape(len(STENCIL), 2, len(x), -1), 1, 0)
        weights = np.array([w for _, w in STENCIL])
        yield np.tensordot(weights, forward - back, 1).T / (width * scales), scales


def apart(found: Vector, exact: Vector, scales: Vector, size: Vector) -> Vector:
    """The differences of two (nq, k), relative to each row's largest in those scales.

    size: (nq,), of the sums that the accelerations are: differences lose 1e-10 of it.
    nan where `exact` is not finite, inf where `found` alone is not.
    """
    largest = np.max(np.abs(exact) * scales, axis=1, initial=0) + 1e-4 * size
    with np.errstate(all="ignore"):
        off = np.abs(found - exact) * scales / largest[:, None]
    off = np.where(found == exact, 0, off)
    return np.asarray(
        np.where(np.isfinite(exact), np.where(np.isfinite(found), off, np.inf), np.nan)
    )
