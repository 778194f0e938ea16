"""Rows of `check` about derivatives of steps: beside differences of steps by the tableau.

The steps are those of `one_step`, on the reference's accelerations; under constraints the reference
puts their ends onto the rows.
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
from eomc.verify.derivatives import WIDTHS, apart
from eomc.verify.finding import Finding, largest
from eomc.verify.oracle import STENCIL, Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import FARTHEST, State

SLOPE_LIMIT = 1e-6  # of the largest derivative
SMALL = 1e-4  # what inputs do to a coordinate in a step may be so little, and less is not seen
SHORTER = (1.0, 0.1, 0.01)  # of the scene's h, until the stages of an implicit method are found

Differences = Callable[[str, int, float], list[Vector]]  # of a method, state and step


def report(of: Comparison) -> None:
    """Add the rows of a scene that asks for them."""
    if not of.system.run.discretize:
        return
    limit = max(SLOPE_LIMIT, LIMIT * of.eps)
    few = [e.state for e in of.few(4)]

    @cache
    def exact(method: str, k: int, h: float) -> list[Vector]:
        with np.errstate(all="ignore"):
            scales = _scales(of, few[k])
            return [_differences(of, method, few[k], h, width * scales) for width in WIDTHS]

    for module, form in of.forms:
        for method in of.methods:
            measure = partial(_worst, of, module, method, few, exact)
            of.row(f"{form}discretize by {method}", limit, "of the largest derivative", measure)


def _worst(
    of: Comparison, module: Any, method: str, few: list[State], exact: Differences
) -> float | Finding:
    errors = (_error(of, module, method, s, partial(exact, method, k)) for k, s in enumerate(few))
    return largest(errors, "no state has finite differences")


def _scales(of: Comparison, s: State) -> Vector:
    """(2 nq + nu,): what q, qd and u are of."""
    n, nu = len(s.q), len(of.system.inputs)
    scales = np.concatenate([of.sampler.spread, of.sampler.speed, np.ones(nu)])
    if s.u is not None:
        scales[2 * n :] = np.maximum(1.0, np.abs(s.u))
    return scales


def _error(
    of: Comparison, module: Any, method: str, s: State, exact: Callable[[float], list[Vector]]
) -> float | None:
    """The best of some widths for each entry; None where there are no finite differences."""
    n, scales = len(s.q), _scales(of, s)
    for h in (part * of.system.run.h for part in SHORTER):
        near = exact(h)
        if not any(np.isfinite(J).all() for J in near) or _thrown(of, method, s, h):
            continue
        held = {"h": h, "t": s.t, "u": s.u, "params": s.params, "method": method}
        found = [np.asarray(x, float) for x in module.discretize(s.q, s.qd, **held)]
        parts, size = (slice(0, 2 * n), slice(2 * n, None)), SMALL * scales[: 2 * n]
        off = [
            np.hstack(
                [apart(x, J[:, i], scales[i], size) for x, i in zip(found, parts, strict=True)]
            )
            for J in near
        ]
        return float(np.nan_to_num(np.max(np.fmin.reduce(off)), nan=math.inf))
    return None


def _thrown(of: Comparison, method: str, s: State, h: float) -> bool:
    """Whether a step throws the state so far that no width of differences fits."""
    run = of.simulate(s, method=method, h=h, steps=1, t0=s.t)
    moved = np.abs(np.subtract([run.q[-1], run.qd[-1]], [s.q, s.qd]))
    return not bool(np.all(moved < FARTHEST * of.sampler.scale))


def _differences(of: Comparison, method: str, s: State, h: float, by: Vector) -> Vector:
    """d[q; qd]'/d[q, qd, u] of a step, (2 nq, 2 nq + nu); u: added to signals, where not given."""
    n, nu = len(s.q), len(of.system.inputs)
    moved = np.concatenate([k * np.diag(by) for m, _ in STENCIL for k in (m, -m)])
    x = moved + np.concatenate([s.q, s.qd, np.zeros(nu)])

    def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
        u, now = None, np.full(len(q), t)
        if nu:
            own = of.reference.evaluate("signals", q, qd, now, None, s.params)
            u = x[:, 2 * n :] + (own if s.u is None else s.u)
        return of.reference.acceleration(q, qd, now, u, s.params)

    ends = one_step.step(METHODS[method], acceleration, x[:, :n], x[:, n : 2 * n], s.t, h)
    if of.system.constraints:
        ends = np.array(of.reference.corrected(ends[0], ends[1], s.t + h, s.params))
    rows = np.moveaxis(ends, 0, 1).reshape(len(STENCIL), 2, len(by), 2 * n)
    forward, back = np.moveaxis(rows, 1, 0)
    weights = np.array([w for _, w in STENCIL])
    return np.asarray((np.tensordot(weights, forward - back, 1) / by[:, None]).T)
