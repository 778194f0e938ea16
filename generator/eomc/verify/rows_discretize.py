"""Rows of `check` about derivatives of steps, compared with differences of steps by the tableau.

The steps are those of `one_step`, on the reference's accelerations; under constraints the reference
projects their ends onto the constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify import one_step
from eomc.verify.comparison import Comparison
from eomc.verify.derivatives import WIDTHS, relative_differences
from eomc.verify.reference import STENCIL, Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import MAX_DISTANCE, State

SLOPE_LIMIT = 1e-6  # of the largest derivative
SMALL = 1e-4  # what inputs do to a coordinate in a step may be so little, and less is not seen
SHORTER = (1.0, 0.1, 0.01)  # of the scene's h, until the stages of an implicit method are found

Differences = Callable[[str, int, float], list[Vector]]  # of a method, state and step


def report(check: Comparison) -> None:
    """Append checks of `discretize` to the report of `eomc check`, one for each method.

    There are none if the scene does not require this function, which linearises one step.
    """
    if not check.system.run.discretize:
        return
    limit = max(SLOPE_LIMIT, LIMIT * check.eps)
    few = [e.state for e in check.few(4)]

    @cache
    def exact(method: str, k: int, h: float) -> list[Vector]:
        with np.errstate(all="ignore"):
            scales = _scales(check, few[k])
            return [_differences(check, method, few[k], h, width * scales) for width in WIDTHS]

    for module, form in check.forms:
        for method in check.methods:
            measure = partial(_worst, check, module, method, few, exact)
            check.row(f"{form}discretize by {method}", limit, "of the largest derivative", measure)


def _worst(
    check: Comparison, module: Any, method: str, few: list[State], exact: Differences
) -> float | Measurement:
    errors = (
        _error(check, module, method, s, partial(exact, method, k)) for k, s in enumerate(few)
    )
    return largest(errors, "no state has finite differences")


def _scales(check: Comparison, s: State) -> Vector:
    """Return typical sizes of q, q̇ and u, (2 nq + nu,)."""
    n, nu = len(s.q), len(check.system.inputs)
    scales = np.concatenate([check.sampler.spread, check.sampler.speed, np.ones(nu)])
    if s.u is not None:
        scales[2 * n :] = np.maximum(1.0, np.abs(s.u))
    return scales


def _error(
    check: Comparison, module: Any, method: str, s: State, exact: Callable[[float], list[Vector]]
) -> float | None:
    """Return the largest error at a state, the best of some widths for each entry.

    None if there are no finite differences.
    """
    n, scales = len(s.q), _scales(check, s)
    for h in (part * check.system.run.h for part in SHORTER):
        near = exact(h)
        if not any(np.isfinite(J).all() for J in near) or _moves_far(check, method, s, h):
            continue
        arguments = {"h": h, "t": s.t, "u": s.u, "params": s.params, "method": method}
        derivatives_ = [np.asarray(x, float) for x in module.discretize(s.q, s.qd, **arguments)]
        parts, size = (slice(0, 2 * n), slice(2 * n, None)), SMALL * scales[: 2 * n]
        off = [
            np.hstack(
                [
                    relative_differences(x, J[:, i], scales[i], size)
                    for x, i in zip(derivatives_, parts, strict=True)
                ]
            )
            for J in near
        ]
        return float(np.nan_to_num(np.max(np.fmin.reduce(off)), nan=math.inf))
    return None


def _moves_far(check: Comparison, method: str, s: State, h: float) -> bool:
    """Return whether a step moves the state so far that no width of differences is suitable."""
    run = check.simulate(s, method=method, h=h, steps=1, t0=s.t)
    moved = np.abs(np.subtract([run.q[-1], run.qd[-1]], [s.q, s.qd]))
    return not bool(np.all(moved < MAX_DISTANCE * check.sampler.scale))


def _differences(check: Comparison, method: str, s: State, h: float, by: Vector) -> Vector:
    """Return derivatives of a step's end with respect to q, q̇ and u, (2 nq, 2 nq + nu).

    They are differences of the reference's steps. Changes of u are added to the signals if the
    state has no inputs.
    """
    n, nu = len(s.q), len(check.system.inputs)
    moved = np.concatenate([k * np.diag(by) for m, _ in STENCIL for k in (m, -m)])
    x = moved + np.concatenate([s.q, s.qd, np.zeros(nu)])

    def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
        u, now = None, np.full(len(q), t)
        if nu:
            own = check.reference.evaluate("signals", q, qd, now, None, s.params)
            u = x[:, 2 * n :] + (own if s.u is None else s.u)
        return check.reference.acceleration(q, qd, now, u, s.params)

    ends = one_step.step(METHODS[method], acceleration, x[:, :n], x[:, n : 2 * n], s.t, h)
    if check.system.constraints:
        ends = np.array(check.reference.corrected(ends[0], ends[1], s.t + h, s.params))
    rows = np.moveaxis(ends, 0, 1).reshape(len(STENCIL), 2, len(by), 2 * n)
    forward, back = np.moveaxis(rows, 1, 0)
    weights = np.array([w for _, w in STENCIL])
    return np.asarray((np.tensordot(weights, forward - back, 1) / by[:, None]).T)
