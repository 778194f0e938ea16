"""Rows of `check` about adaptive steps: final states, and states within steps, from the reference.

The reference's states follow from steps of the tableau on its own accelerations, half as long as
those of a tighter tolerance. Each adaptive step may have an error of the tolerance, times the
growth of a difference of the initial state.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import GAUSS16
from eomc.verify import one_step
from eomc.verify.comparison import GROWTH_LIMIT, Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import Measurement, largest
from eomc.verify.sampling import NUDGE, State, simulate

LIMIT, UNIT = 0.1, "tolerances a step, times growth"
STEPS = (12, 6, 3)  # of a run that is compared, the first in which a difference grows little
MIN_TOLERANCE = {"float64": 1e-15, "float32": 5e-7}  # tolerance
TIME_ROUNDINGS = 4  # roundings of a time
MIN_STEP_ROUNDINGS = (
    16 * TIME_ROUNDINGS
)  # in a step: C refuses those of TICKS, and begins with parts of what it takes
ROUNDING = 1e3  # in a tolerance's place, where that is smaller


def report(check: Comparison) -> None:
    """Append checks of adaptive steps to the report, if the scene has a tolerance."""
    if check.system.run.tolerance is None:
        return
    tight = 1e-13 if check.dtype == np.float64 else 1e-6
    for module, form in check.forms:
        for tol, stiff in ((10 * tight**0.5, False), (tight, False), (tight**0.5, True)):
            measure = partial(_worst, check, module, tol, stiff)
            how = "stiff" if stiff else f"{tol:g}"
            check.row(f"{form}adaptive steps, {how}", LIMIT, UNIT, measure)


def resolves_steps(check: Comparison, s: State, h: float) -> bool:
    """Return whether times near s.t are precise enough for steps of h seconds.

    In single precision, for instance, times have only 7 digits.
    """
    return h > MIN_STEP_ROUNDINGS * check.eps * (abs(s.t) + h)


def _worst(check: Comparison, module: Any, tol: float, stiff: bool) -> float | Measurement:
    errors = (_error(check, module, max(tol, 8 * check.eps), stiff, e.state) for e in check.few(3))
    return largest(errors, "a difference grows too much in a few steps")


def _adaptive(module: Any, s: State, x: Vector, T: float, tol: float, **how: Any) -> Any:
    n = len(s.q)
    span = how if "times" in how else {"duration": T, **how}
    return simulate(module, replace(s, q=x[:n], qd=x[n:]), tol=tol, t0=s.t, **span)


def _start_run(module: Any, s: State, x: Vector, T: float, tol: float, stiff: bool) -> Any:
    """Return the run, or its part in the first call of C, which has more steps than are compared.

    Jumps that add energy may follow one another without end, in less and less time.
    """

    def stop_early(completed: int, total: int) -> None:
        if completed < total:
            raise KeyboardInterrupt

    try:
        return _adaptive(module, s, x, T, tol, stiff=stiff, progress=stop_early)
    except module.Interrupted as stop:
        return stop.run


def _error(check: Comparison, module: Any, tol: float, stiff: bool, s: State) -> float | None:
    """Return the error at the end and at times within steps of a run from one state.

    The unit is the tolerance times steps and growth. None if nothing can be compared.
    """
    x = np.concatenate([s.q, s.qd])
    spread = check.sampler.scale.ravel()
    first = _start_run(module, s, x, check.system.run.duration, tol, stiff)
    if len(first) < 2:  # not a single step
        begins = np.isfinite(check.reference.acceleration(s.q, s.qd, s.t, s.u, s.params)).all()
        return math.inf if first.status == "not finite" and begins else None
    ends = [first.events[e.name].t for e in check.system.events if e.action != "record"]
    first_end = min((float(t[0]) for t in ends if len(t)), default=math.inf)
    if first_end <= s.t:  # the state jumps at once
        return None
    moved = x + NUDGE * spread
    neighbour = check.sampler.project(replace(s, q=moved[: len(s.q)], qd=moved[len(s.q) :]))
    nudged = np.concatenate([neighbour.q, neighbour.qd])
    for steps in STEPS:
        T = min(float(first.t[min(steps, len(first) - 1)]), first_end) - s.t
        T *= 1 if s.t + T < first_end else 0.9  # the reference knows of no events
        run = _adaptive(module, s, x, T, tol, stiff=stiff)
        near = _adaptive(module, s, nudged, T, tol, stiff=stiff)
        if run.status != "ok" or near.status != "ok":
            continue
        growth = float(np.max(np.abs(near.x[-1] - run.x[-1]) / spread)) / NUDGE
        if not growth < GROWTH_LIMIT:
            continue
        times = s.t + T * np.array([0.31, 0.77, 1.0])
        rows = _adaptive(module, s, x, T, tol, times=times, stiff=stiff)
        finer = _adaptive(module, s, x, T, max(tol / 1000, MIN_TOLERANCE[check.dtype.name]))
        expected, rates = _reference(check, s, x, times, finer.t)
        if not np.isfinite(expected).all():
            continue
        late = (
            TIME_ROUNDINGS * check.eps * (abs(s.t) + T) * np.abs(rates)
        )  # by what rounding of t makes of it
        off = np.abs(np.vstack([rows.x - expected, run.x[-1:] - expected[-1:]]).astype(float))
        off = np.maximum(0.0, off - np.vstack([late, late[-1:]]))
        off /= np.abs(expected).max(axis=0) + max(growth, 1.0) * spread
        allowed = (tol + ROUNDING * check.eps) * (run.steps + 1)
        return float(np.nan_to_num(off.max(), nan=math.inf) / allowed)
    return None


def _reference(
    check: Comparison, s: State, x: Vector, times: Vector, grid: Vector
) -> tuple[Vector, Vector]:
    """Return the reference's states and their rates at some times, both (n, 2 nq).

    It makes two fixed steps between successive times of `grid` and `times`.
    """
    n, rows, rates = len(s.q), [], []
    acceleration = check.accelerations(s)
    q, qd, t = x[:n], x[n:], s.t
    with np.errstate(all="ignore"):
        for end in np.union1d(grid[grid > s.t], times):
            h = (end - t) / 2
            for k in range(2):
                state = q, qd, t + k * h, h
                end_state = one_step.step(GAUSS16, acceleration, *state)
                if not np.isfinite(end_state).all():  # too long for sweeps
                    end_state, _ = one_step.step_by_newton(GAUSS16, acceleration, *state)
                q, qd = end_state
            t = float(end)
            if end in times:
                rows.append(np.concatenate([q, qd]))
                rates.append(np.concatenate([qd, acceleration(q, qd, t)]))
    return np.array(rows), np.array(rates)
