"""Checks of events: event functions, states after jumps, and runs by fixed steps with events.

Event functions and jumps are compared with the formulas of the scene, evaluated with many digits at
any states; events of stick-slip friction are left out. In a run by fixed steps, each stored state
must be one step from the previous one, as must the state at each event; and where an event function
changes its sign, an event must be recorded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.model.symbols import Output
from eomc.model.system import System
from eomc.runtime.package import model_of
from eomc.verify.checks_inputs_outputs import Formulas, compare_outputs
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import State, simulate


def report_functions(check: Comparison) -> None:
    """Append checks of event functions and jumps to the report, if the scene defines events.

    An event is detected at a root of its event function; a jump then changes the state.
    """
    system = check.system
    events = system.own_events
    groups = {"events": [Output(e.name, e.when) for e in events]}
    names = [*(str(q) for q in system.q), *(str(qd) for qd in system.qd)]
    states = dict(zip(names, (*system.q, *system.qd), strict=True))
    if any(e.action == "jump" for e in events):
        groups["jumps"] = [
            Output(name, (states | dict(e.jump))[name]) for e in events for name in names
        ]
    for name, formulas in groups.items():
        if formulas:
            for module, form in check.forms:
                find = partial(
                    _function_error, check, module, name, replace(system, outputs=tuple(formulas))
                )
                check.add_check(f"{form}{name}", LIMIT, "units of rounding", find)


def _function_error(check: Comparison, module: Any, name: str, system: System) -> float:
    """Return the largest error of event functions or jumps, in units of rounding."""
    model = model_of(module)

    def module_values(s: State) -> Vector:
        values = model.functions.evaluate(name, s.q, s.qd, s.t, s.u, s.params)
        return np.asarray(values, float).ravel()[: len(system.outputs)]

    return compare_outputs(check, module, Formulas(system), module_values)


def report_fixed_steps(check: Comparison) -> None:
    """Append checks of events in fixed steps to the report of `eomc check`, for each method."""
    for module, form in check.forms:
        for method in check.methods:
            check.add_check(
                f"{form}events in steps of {method}", LIMIT, "units of rounding",
                partial(_largest_error, check, module, method),
            )  # fmt: skip


def _largest_error(check: Comparison, module: Any, method: str) -> float | Measurement:
    model, passed = model_of(module), model_of(module).integrator.ignores_events
    model.integrator.ignores_events = False
    try:
        errors = [_run_error(check, module, method, e.state) for e in check.few(4)]
    finally:
        model.integrator.ignores_events = passed
    return largest(errors, "no step can be made")


def _run_error(check: Comparison, module: Any, method: str, s: State) -> float | None:
    """Return the largest error of a run from one state; inf if an event is missing."""
    run = simulate(module, s, t0=s.t, h=check.system.run.h, steps=250, method=method)
    if len(run) < 2:
        return None
    if _misses_event(check, module, run, s):
        return math.inf
    scale = check.sampler.scale.ravel()
    worst = 0.0
    for k, t, end in _steps(run):
        h, size = t - run.t[k], np.abs(run.x[k]) + scale
        if (np.abs(end - run.x[k]) > 10 * size).any():  # the run diverges, and rounding with it
            continue
        try:
            step_end = module.step(run.q[k], run.qd[k], h, run.t[k], s.u, s.params, method)
        except module.MotionError:
            return math.inf
        # effect of the rounding of t
        moved = np.abs(np.concatenate(step_end) - run.x[k]) * (abs(t) + abs(h)) / h
        off = np.abs(np.concatenate(step_end) - end) / (check.eps * (size + moved))
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


def _misses_event(check: Comparison, module: Any, run: Any, s: State) -> bool:
    """Return whether an event function changes sign clearly without a detected event."""
    events = check.system.events
    signs_after = {"falling": (-1,), "rising": (1,), "both": (-1, 1)}
    values = model_of(module).functions.evaluate("events", run.q, run.qd, run.t, s.u, s.params)
    for event, g in zip(events, values.T, strict=True):
        sides = np.where(np.abs(g) > 1e-6 * np.abs(g).max(), np.sign(g), 0)  # 0 if not clear
        recorded = run.events[event.name].t
        for k in np.flatnonzero((sides[1:] * sides[:-1] < 0) & (np.diff(run.t) > 0)):
            here = (recorded > run.t[k]) & (recorded <= run.t[k + 1])
            if sides[k + 1] in signs_after[event.direction] and not here.any():
                return True
    return False
