"""Checks of steps and runs: with fixed steps, with adaptive steps, and with events.

A step of any method is compared with a step of its tableau on the reference's accelerations,
and a run row by row: each row must be one such step from the row before. A run may compute a step
in other ways than `step` does, with predicted sines and compensated sums.

Each adaptive step may have an error of the tolerance, times the growth of a difference of the
initial state. The expected states are those of two steps of the tableau for each step of a run with
a tighter tolerance.

Event functions and jumps are compared with the formulas of the scene at any states; events of
stick-slip friction are left out. In a run with fixed steps, each row and the state at each event
must be one step from the previous row; and where an event function changes its sign, an event must
be recorded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import GAUSS16, METHODS
from eomc.model.symbols import Output
from eomc.runtime.package import model_of
from eomc.verify import reference
from eomc.verify.comparison import LIMIT, Check, Comparison
from eomc.verify.equations import (
    SLOPE_LIMIT,
    UNIT,
    WIDTHS,
    Formulas,
    output_error,
    relative_differences,
)
from eomc.verify.reference import Vector, differences
from eomc.verify.sampling import (
    MAX_DISTANCE,
    NUDGE,
    Expected,
    State,
    simulate,
    states_of_run,
)

GROWTH_LIMIT = 1e4  # an adaptive run is compared until a difference has grown by this factor
REFUSED = (None, math.inf)  # errors of a step that is not made or not comparable
MAX_STEP_ERROR = 0.1  # of a step under constraints that is compared, relative to the motion
STEP_FACTORS = (1.0, 16.0)  # of h; in long steps, terms of high order exceed rounding


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of steps and runs."""
    few = comparison.few(4)
    for method in comparison.methods:
        name = "one step" + f" of {method}" * (method != "rk4")
        yield Check(
            name, partial(_largest_step_error, method), states=few, portable=True,
            why="no step is finite",
        )  # fmt: skip
    if comparison.compiled or comparison.methods[0] == "rk4":
        for method in comparison.methods:
            name = "run" + f" by {method}" * (method != "rk4")
            yield Check(
                name, partial(largest_run_error, method), states=comparison.few(2), portable=True,
                why="no step is finite, or all are too long",
            )  # fmt: skip
    yield Check("energy of the run", _energy_error, states=comparison.few(2)[-1:])
    if comparison.compiled:
        yield from adaptive_checks(comparison)
        yield from event_checks(comparison)


# --- fixed steps ----------------------------------------------------------------------------------


def expected_step(of: Comparison, method: str, e: Expected, h: float) -> tuple[Vector, Vector]:
    """Return q and q̇ after one step of a method from the state of `e`, and their sizes.

    Both are (2, nq); an error of eps times the size is one rounding. h: step size, s. The states
    are nan if the iteration for the stages of an implicit method does not converge.
    """
    s, m = e.state, METHODS[method]

    def step(q: Vector, qd: Vector, t: Vector, **arguments: Any) -> Vector:
        def acceleration(q: Vector, qd: Vector, t: Vector) -> Vector:
            return of.reference.acceleration(q, qd, t, **arguments)

        ends = reference.runge_kutta_step(m, acceleration, q, qd, t, h)
        if of.system.constraints:
            ends = np.array(
                of.reference.corrected(ends[0], ends[1], t + h, arguments.get("params"))
            )
        return np.moveaxis(ends, 0, 1)

    with np.errstate(all="ignore"):
        expected, size = of.sampler.value_and_size(step, s)
    gain = h * e.size["acceleration"]
    size = size + np.array([h * (np.abs(s.qd) + gain), gain])
    size = size + e.size.get("place", 0.0)  # rounding errors of constraints
    if m.newton:  # rounding of q limits the accuracy of stages
        size[1] += np.abs(s.q) / h
    return expected, size


def _largest_step_error(method: str, of: Comparison, e: Expected) -> float | None:
    """Return the largest error of one step of the module, in units of rounding."""
    errors = [step_error(of, method, e, x * of.system.run.h) for x in STEP_FACTORS]
    return max((x for x in errors if x is not None), default=None)


def step_error(of: Comparison, method: str, e: Expected, longest: float) -> float | None:
    """Return the error of one step of the module from the state of `e`, in units of rounding.

    longest: the largest step size to be tried, s. It is reduced until the reference's step stays
    near the state and the module's step succeeds. The result is None if there is no such step. It
    is inf if the module's stages do not converge for two step sizes, or if the module refuses the
    shortest step.
    """
    s, failures, refused = e.state, 0, False
    how: dict[str, Any] = {"t": s.t, "u": s.u, "params": s.params}
    if method != of.methods[0]:
        how["method"] = method
    for h in (longest * 4.0**-k for k in range(7)):
        refused = False
        expected, size = expected_step(of, method, e, h)
        most = of.sampler.scale * (1 if h > of.system.run.h else MAX_DISTANCE)
        if not np.all(np.abs(expected - [s.q, s.qd]) < most):
            continue
        try:
            step = of.module.step(s.q, s.qd, h=h, **how)
        except ArithmeticError as fault:
            refused, failures = True, failures + (getattr(fault, "status", "") == "no convergence")
            if failures == 2:
                break
            continue
        return of.units(step, expected, size)
    return math.inf if failures == 2 or refused else None


def largest_run_error(method: str, of: Comparison, e: Expected) -> float | None:
    """Return the largest error of the rows of a run, in steps that are short enough."""
    least = None
    # with a fixed number of iterations, shorter steps reduce their error to rounding
    for part in (1, 16, 64, 256) if METHODS[method].sweeps else (1,):
        error = run_error(of, method, e, of.system.run.h / part)
        least = error if least is None or (error is not None and error < least) else least
        if least is not None and least <= 1:
            break
    return least


def run_error(of: Comparison, method: str, e: Expected, h: float, steps: int = 0) -> float | None:
    """Return the largest error of rows of a run from the state of `e`, in units of rounding.

    The run has `steps` steps of h seconds; 0 stands for a default number. A row is compared with
    one step of the reference from the row before it. The result is None if there is no such step.
    It is inf if the run ends early although the reference's next step converges and the module
    makes this step or no shorter one, and if its status does not say whether it ends early.
    """
    steps = steps or min(of.effort.run, max(1, round(of.system.run.duration / h)))
    run = of.simulate(e.state, method, h=h, steps=steps)
    states, t0, errors = states_of_run(run, e.state), float(run.t[0]), list[float]()
    if (run.status == "ok") != (len(states) > steps):
        return math.inf
    for k in sorted(
        {0, 1, steps // 2, steps - 1, len(states) - 1} & {*range(min(steps, len(states)))}
    ):
        s = states[k]
        here = of.sampler.regular_expected(s)
        far = np.abs([s.q - e.state.q, s.qd - e.state.qd]) >= MAX_DISTANCE * of.sampler.scale
        if here is None or np.any(far):
            break
        expected, size = expected_step(of, method, here, h)
        if not np.all(np.abs(expected - [s.q, s.qd]) < MAX_DISTANCE * of.sampler.scale):
            continue
        if k + 1 == len(states):
            if _accepts_step(of, method, s, h) or step_error(of, method, here, h / 4) in REFUSED:
                return math.inf
            continue  # only long steps are refused
        end = states[k + 1]
        error = of.units([end.q, end.qd], expected, size)
        if error > LIMIT and of.system.constraints and _is_too_long(of, method, here, h, expected):
            continue
        errors.append(error)
        errors.append(of.units(end.t, t0 + (k + 1) * h, abs(end.t) + h))
    return max(errors, default=None)


def _accepts_step(of: Comparison, method: str, s: State, h: float) -> bool:
    """Return whether the module makes a step of h seconds from a state."""
    how = {"method": method} if method != of.methods[0] else {}
    try:
        of.module.step(s.q, s.qd, h=h, t=s.t, u=s.u, params=s.params, **how)
    except ArithmeticError:
        return False
    return True


def _is_too_long(of: Comparison, method: str, e: Expected, h: float, end: Vector) -> bool:
    """Return whether two steps of half the size end far from `end`, both by the reference.

    The projection onto the constraints then leads to another assembly of the mechanism, or close
    to a singular position. end (2, nq): q and q̇ after one step of h seconds.
    """
    halfway, _ = expected_step(of, method, e, h / 2)
    s = replace(e.state, q=halfway[0], qd=halfway[1], t=e.state.t + h / 2)
    here = of.sampler.regular_expected(s) if np.all(np.isfinite(halfway)) else None
    if here is None:
        return True
    finer, _ = expected_step(of, method, here, h / 2)
    return not np.all(np.abs(finer - end) < MAX_STEP_ERROR * of.sampler.scale)


def _energy_error(of: Comparison, e: Expected) -> float:
    """Return the largest error of the energies stored in a run, in units of rounding.

    They are compared with the reference's energies at the states stored in the same run.
    """
    s, errors = e.state, []
    run = of.simulate(s, steps=2)
    for row, energy_of_run in zip(states_of_run(run, s), run.energy, strict=True):
        if np.all(np.abs([row.q - s.q, row.qd - s.qd]) < MAX_DISTANCE * of.sampler.scale):
            if (here := of.sampler.regular_expected(row)) is not None:
                errors.append(of.units(energy_of_run, here.value["energy"], here.size["energy"]))
    return float(np.max(errors, initial=0))


# --- adaptive steps -------------------------------------------------------------------------------

TIME_ROUNDINGS = 4  # error of the time of a stored state, in units of rounding
TOLERANCE_ROUNDINGS = 1e3  # error in units of rounding that is permitted besides the tolerance


def adaptive_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of adaptive steps, if the scene has a tolerance."""
    if comparison.system.run.tolerance is None:
        return
    tight = 1e-13 if comparison.dtype == np.float64 else 1e-6
    for tol, stiff in ((10 * tight**0.5, False), (tight, False), (tight**0.5, True)):
        yield Check(
            f"adaptive steps, {'stiff' if stiff else f'{tol:g}'}",
            partial(adaptive_error, max(tol, 8 * comparison.eps), stiff), tolerance=0.1,
            states=comparison.few(3), unit="tolerances per step, times growth", portable=True,
            why="a difference grows too much in a few steps",
        )  # fmt: skip


def adaptive_error(tol: float, stiff: bool, of: Comparison, e: Expected) -> float | None:
    """Return the error at the end and at times within steps of an adaptive run from one state.

    The unit is the tolerance times steps and growth. stiff: whether the run begins with Newton's
    method. None if nothing can be compared.
    """
    s = e.state
    x, spread = np.concatenate([s.q, s.qd]), of.sampler.scale.ravel()
    first = _first_steps(of, s, tol, stiff)
    if len(first) < 2:  # no step
        begins = np.isfinite(of.reference.acceleration(s.q, s.qd, s.t, s.u, s.params)).all()
        return math.inf if first.status == "not finite" and begins else None
    ends = [first.events[event.name].t for event in of.system.events if event.action != "record"]
    first_end = min((float(t[0]) for t in ends if len(t)), default=math.inf)
    if first_end <= s.t:  # the state jumps at once
        return None
    moved = x + NUDGE * spread
    neighbour = of.sampler.project(replace(s, q=moved[: len(s.q)], qd=moved[len(s.q) :]))
    run_of = partial(simulate, of.module, t0=s.t, stiff=stiff, tol=tol)
    for steps in (12, 6, 3):  # fewer if a difference grows too much
        T = min(float(first.t[min(steps, len(first) - 1)]), first_end) - s.t
        T *= 1 if s.t + T < first_end else 0.9  # the reference has no events
        run, near = run_of(s, duration=T), run_of(neighbour, duration=T)
        if run.status != "ok" or near.status != "ok":
            continue
        growth = float(np.max(np.abs(near.x[-1] - run.x[-1]) / spread)) / NUDGE
        if not growth < GROWTH_LIMIT:
            continue
        times = s.t + T * np.array([0.31, 0.77, 1.0])
        rows = run_of(s, times=times)
        tighter = max(tol / 1000, 1e-15 if of.dtype == np.float64 else 5e-7)
        finer = run_of(s, duration=T, tol=tighter, stiff=False)
        expected, rates = accurate_states(of, s, times, finer.t)
        if not np.isfinite(expected).all():
            continue
        # effect of the rounding of times
        late = TIME_ROUNDINGS * of.eps * (abs(s.t) + T) * np.abs(rates)
        off = np.abs(np.vstack([rows.x - expected, run.x[-1:] - expected[-1:]]).astype(float))
        off = np.maximum(0.0, off - np.vstack([late, late[-1:]]))
        off /= np.abs(expected).max(axis=0) + max(growth, 1.0) * spread
        allowed = (tol + TOLERANCE_ROUNDINGS * of.eps) * (run.steps + 1)
        return float(np.nan_to_num(off.max(), nan=math.inf) / allowed)
    return None


def _first_steps(of: Comparison, s: State, tol: float, stiff: bool) -> Any:
    """Return a run, or its part in the first call of C, which has more steps than are compared.

    Jumps that add energy may follow one another without end, in less and less time.
    """

    def stop_early(completed: int, total: int) -> None:
        if completed < total:
            raise KeyboardInterrupt

    how = {"duration": of.system.run.duration, "t0": s.t, "stiff": stiff, "tol": tol}
    try:
        return simulate(of.module, s, progress=stop_early, **how)
    except of.module.Interrupted as stop:
        return stop.run


def accurate_states(of: Comparison, s: State, times: Vector, grid: Vector) -> tuple[Vector, Vector]:
    """Return the reference's states and their rates at some times, both (n, 2 nq).

    It makes two fixed steps between successive times of `grid` and `times`.
    """
    rows, rates = [], []
    acceleration = of.accelerations(s)
    q, qd, t = s.q, s.qd, s.t
    with np.errstate(all="ignore"):
        for end in np.union1d(grid[grid > s.t], times):
            h = (end - t) / 2
            for k in range(2):
                state = q, qd, t + k * h, h
                end_state = reference.runge_kutta_step(GAUSS16, acceleration, *state)
                if not np.isfinite(end_state).all():  # fixed-point iteration diverges
                    end_state, _ = reference.step_by_newton(GAUSS16, acceleration, *state)
                q, qd = end_state
            t = float(end)
            if end in times:
                rows.append(np.concatenate([q, qd]))
                rates.append(np.concatenate([qd, acceleration(q, qd, t)]))
    return np.array(rows), np.array(rates)


# --- events ---------------------------------------------------------------------------------------


def event_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of event functions, jumps and their detection, if the scene has events.

    An event is detected at a root of its event function; a jump then changes the state.
    """
    system = comparison.system
    if not system.events:
        return
    yield from event_function_checks(comparison)
    for method in comparison.methods:
        yield Check(
            f"events in steps of {method}", partial(detection_error, method),
            states=comparison.few(4), portable=True, why="no step can be made",
        )  # fmt: skip


def event_function_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of event functions and of the states after jumps."""
    system = comparison.system
    events, states = (
        system.own_events,
        dict(zip(map(str, system.q + system.qd), system.q + system.qd, strict=True)),
    )
    groups = {"events": [Output(e.name, e.when) for e in events]}
    if any(e.action == "jump" for e in events):
        groups["jumps"] = [
            Output(name, (states | dict(e.jump))[name]) for e in events for name in states
        ]
    for name, outputs in groups.items():
        if outputs:
            formulas = Formulas(replace(system, outputs=tuple(outputs)))
            yield Check(
                name, partial(output_error, formulas, partial(_event_values, name, len(outputs))),
                states=comparison.few(4), portable=True,
            )  # fmt: skip

    if system.run.linearize == "products" and not system.constraints:
        yield Check(
            "derivatives of events", event_slope_error, states=comparison.few(4), unit=UNIT,
            tolerance=max(SLOPE_LIMIT, LIMIT * comparison.eps),
            why="no state has finite differences",
        )  # fmt: skip


def event_slope_error(of: Comparison, e: Expected) -> float | None:
    """Return the largest error of the derivatives of event functions and jumps at a state.

    They are compared with differences of the module's functions, of several widths, by [q, qd, u,
    p, t]. None if the differences are not finite or contain a jump.
    """
    functions, s = model_of(of.module).functions, e.state
    n, m, params = 2 * len(s.q), len(of.system.inputs), dict(s.params or of.sampler.defaults)
    x = np.concatenate([s.q, s.qd, np.ones(m) if s.u is None else s.u, [*params.values()], [s.t]])
    scales = np.concatenate([of.sampler.scale.ravel(), np.maximum(1.0, np.abs(x[n:]))])
    names = ["events", *(["jumps"] if any(e.action == "jump" for e in of.system.events) else [])]

    def values(rows: Vector) -> Vector:
        q, qd, u, p, t = np.split(rows, [n // 2, n, n + m, len(x) - 1], axis=1)
        here = t[:, 0], u if m else None, dict(zip(params, p.T, strict=True))
        parts = [functions.evaluate(name, q, qd, *here) for name in names]
        return np.hstack([np.reshape(part, (len(rows), -1)) for part in parts])

    here = s.t, x[n : n + m] if m else None, params
    slopes = [functions.evaluate("event_slopes", s.q, s.qd, *here)]
    if "jumps" in names:
        q, qd = (np.tile(half, (n, 1)) for half in (s.q, s.qd))
        count, along = len(of.system.events), np.eye(n, len(x) - 1).astype(of.dtype)
        rows = functions.product("jump_vjp", q, qd, along, count * len(x), here)
        slopes.append(rows.reshape(n, count, -1).swapaxes(0, 1).reshape(n * count, -1))
    size = np.abs(values(x[None])[0])
    with np.errstate(all="ignore"):
        near = [differences(values, x, width * scales) for width in WIDTHS]
        off = [relative_differences(np.vstack(slopes), J, scales, size) for J in near]
        first, last = (np.abs(near[k]) * scales * WIDTHS[k] for k in (0, -1))
        if (last > 0.1 * first + 1e-9 * np.max(size)).any():  # a jump map jumps at the state
            return None
    least = np.fmin.reduce(off)
    return float(np.max(least, initial=0)) if np.all(least >= 0) else None


def _event_values(name: str, count: int, of: Comparison, s: State) -> Vector:
    """Return the first `count` values of the module's event functions or jumps at a state."""
    values = model_of(of.module).functions.evaluate(name, s.q, s.qd, s.t, s.u, s.params)
    return np.asarray(values, float).ravel()[:count]


def detection_error(method: str, of: Comparison, e: Expected) -> float | None:
    """Return the largest error of a run with events from one state; inf if an event is missing."""
    model, s = model_of(of.module), e.state
    ignored, model.integrator.ignores_events = model.integrator.ignores_events, False
    try:
        run = simulate(of.module, s, t0=s.t, h=of.system.run.h, steps=250, method=method)
    finally:
        model.integrator.ignores_events = ignored
    if len(run) < 2:
        return None
    if _misses_event(of, run, s):
        return math.inf
    scale, worst = of.sampler.scale.ravel(), 0.0
    for k, t, end in _steps(run):
        h, size = t - run.t[k], np.abs(run.x[k]) + scale
        if (np.abs(end - run.x[k]) > 10 * size).any():  # the run diverges, and rounding with it
            continue
        try:
            step_end = of.module.step(run.q[k], run.qd[k], h, run.t[k], s.u, s.params, method)
        except of.module.MotionError:
            return math.inf
        # effect of the rounding of t
        moved = np.abs(np.concatenate(step_end) - run.x[k]) * (abs(t) + abs(h)) / h
        off = np.abs(np.concatenate(step_end) - end) / (of.eps * (size + moved))
        worst = max(worst, float(np.nan_to_num(off.max(), nan=math.inf)))
    return worst


def _steps(run: Any) -> Iterator[tuple[int, float, Vector]]:
    """Yield for each row and event the index of the previous row, its time and its state.

    The states at the start before a jump, and between jumps at one time, are in no row.
    """
    _, recorded = run.event_data
    first = int(len(recorded) > 0 and recorded[0, 0] <= run.t[0])
    for k in range(first, len(run) - 1):
        if run.t[k + 1] > run.t[k]:
            yield k, float(run.t[k + 1]), run.x[k + 1]
    for t, *x in recorded[np.diff(recorded[:, 0], prepend=-np.inf) > 0]:
        if (k := int(np.searchsorted(run.t, t)) - 1) >= first:
            yield k, float(t), np.array(x)


def _misses_event(of: Comparison, run: Any, s: State) -> bool:
    """Return whether an event function changes sign clearly without a detected event."""
    signs_after = {"falling": (-1,), "rising": (1,), "both": (-1, 1)}
    values = model_of(of.module).functions.evaluate("events", run.q, run.qd, run.t, s.u, s.params)
    for event, g in zip(of.system.events, values.T, strict=True):
        sides = np.where(np.abs(g) > 1e-6 * np.abs(g).max(), np.sign(g), 0)  # 0 if not clear
        recorded = run.events[event.name].t
        for k in np.flatnonzero((sides[1:] * sides[:-1] < 0) & (np.diff(run.t) > 0)):
            here = (recorded > run.t[k]) & (recorded <= run.t[k + 1])
            if sides[k + 1] in signs_after[event.direction] and not here.any():
                return True
    return False
