"""Rows of `check` about what adaptive steps refuse, their longest step, and runs in several calls.

A run that can't go on returns a status, and the state is the last good one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import Measurement, largest
from eomc.verify.rows_adaptive import TIME_ROUNDINGS, resolves_steps
from eomc.verify.rows_refusals import OK, REFUSED, SINGULAR, Refusals, with_nonfinite_entries
from eomc.verify.rows_runs import parameters
from eomc.verify.sampling import State

SINGULAR_STATE_COUNT, MAX_STEPS = 8, 40  # states; steps of a run
PARTS = 7  # steps of a span in which one would do
COARSE_TOLERANCE = 1e-3  # tolerance
TURNS = 1e7  # rad: sines of several angles at once come to their limit before


@dataclass(frozen=True)
class _RunResult:
    """Results of an adaptive run by the C function.

    status: 0, or the code of the error. rows: states at the ends of steps, (n, 2 nq). times: their
    times, (n,), s. x: the last state, (2 nq,).
    """

    status: int
    rows: Vector
    times: Vector
    x: Vector

    @property
    def refuses_cleanly(self) -> bool:
        """Whether the run has returned an error and made no step."""
        return self.status != OK and not len(self.rows)


def report(check: Comparison, refusals: Refusals) -> None:
    """Append checks of adaptive runs to the report: refusals, and the limit of the step size.

    There are none if the scene has no tolerance. refusals: the checks of refusals by fixed steps,
    which have found states with a singular mass matrix D.
    """
    if check.system.run.tolerance is None:
        return
    rows = _Adaptive(check, refusals)
    check.row("adaptive steps: refusals", 0, "runs that end otherwise", rows.wrong_refusals)
    check.row("adaptive steps: longest", 0, "runs that end otherwise", rows.longest)


class _Adaptive:
    def __init__(self, check: Comparison, refusals: Refusals) -> None:
        self.check, self.model, self.refusals = check, check.module._model, refusals
        self.state = check.few(2)[-1].state

    def drive(
        self, s: State, span: float, tol: float, h_most: float = 0.0, stiff: bool = False,
        each: int = MAX_STEPS,
    ) -> _RunResult:  # fmt: skip
        """Return an adaptive run of `span` seconds by the C function, of at most MAX_STEPS steps.

        s: initial state. tol: tolerance. h_most: limit of the step size, s; 0 for none. stiff:
        whether to begin with Newton's method. each: number of steps per call of the C function.
        """
        model, many = self.model, 2 * MAX_STEPS
        x, t = np.array([s.q, s.qd], model.dtype).ravel(), np.array([s.t], model.dtype)
        rows, times = np.full((2, many, model.nq), np.nan, model.dtype), np.zeros(many, model.dtype)
        u = None if s.u is None else np.array(s.u, model.dtype)
        work, null, p = model._ffi.new("adaptive_work *"), model._c[2], parameters(model, s)
        work.stiff = stiff
        events = (0, model._ffi.NULL, null) if model.events else ()
        n, status, end = 0, OK, s.t + span
        for _ in range(0, MAX_STEPS, each):
            if status != OK or t[0] >= end or (model.events and work.stopped):
                break
            status = model._lib.adaptive(
                model._pointer(x), model._pointer(t), end, tol, h_most, model._pointer(u), each,
                null, many - n, model._pointer(times[n:]), model._pointer(rows[0, n:]),
                model._pointer(rows[1, n:]), *events, model._pointer(p), work,
            )  # fmt: skip
            n += work.rows
        return _RunResult(status, np.hstack([rows[0, :n], rows[1, :n]]), times[:n], x)

    def wrong_refusals(self) -> float:
        """Return the number of adaptive runs that are not refused correctly, or store nan or inf.

        Some runs start where the mass matrix D is singular or at nan or inf; they must return an
        error and make no step. Others start with numbers so large that a step overflows; they must
        store finite states only.
        """
        h, tol = self.check.system.run.h, COARSE_TOLERANCE
        wrong = 0
        for s in self.refusals.singular[
            :: max(1, len(self.refusals.singular) // SINGULAR_STATE_COUNT)
        ]:
            for stiff in (False, True):
                run = self.drive(s, 10 * h, tol, stiff=stiff)
                wrong += not (run.refuses_cleanly and run.status == SINGULAR)
                wrong += not np.array_equal(run.x, np.asarray([s.q, s.qd], run.x.dtype).ravel())
        for *_, odd in with_nonfinite_entries(self.state):
            run = self.drive(odd, 10 * h, tol)
            wrong += not run.refuses_cleanly or run.status not in REFUSED
        return float(wrong + self.overflow_errors())

    def overflow_errors(self) -> int:
        """Return the number of runs that store states that are not finite.

        Their initial states are so large that a step may overflow.
        """
        wrong, huge = 0, float(np.finfo(self.model.dtype).max) / 2
        for unit in np.eye(len(self.state.q)):
            for size in (TURNS, huge):
                for stiff in (False, True):
                    far = replace(self.state, q=size * unit, qd=1.01 * size * unit)
                    run = self.drive(far, 1.0, COARSE_TOLERANCE, stiff=stiff)
                    wrong += not (np.all(np.isfinite(run.rows)) and np.all(np.isfinite(run.x)))
        return wrong

    def longest(self) -> float | Measurement:
        """Return the number of errors in adaptive runs with a limit of the step size.

        No step may exceed the limit, the last step must end at the given time, and a run in several
        calls must equal the run in one call.
        """
        errors = (self.step_limit_errors(e.state) for e in self.check.few(2))
        return largest(errors, "time tells no parts of a first step")

    def step_limit_errors(self, s: State) -> float | None:
        """Return the number of errors in one adaptive run from `s` with a limit of the step size.

        The result is None if times are not precise enough for such steps.
        """
        first = self.drive(s, self.check.system.run.duration, COARSE_TOLERANCE)
        later = first.times[first.times > s.t]  # the state may jump at once
        span = float(later[0]) - s.t if len(later) else 0.0
        if not resolves_steps(self.check, s, span / PARTS):
            return None
        run, cut = (
            self.drive(s, span, COARSE_TOLERANCE, h_most=span / PARTS, each=n)
            for n in (MAX_STEPS, 1)
        )
        sizes = np.diff(np.concatenate([[s.t], run.times]))
        rounding = TIME_ROUNDINGS * self.check.eps * (abs(s.t) + span)
        late = bool(np.any(sizes > span / PARTS + rounding)) or len(run.times) < PARTS
        end = np.asarray(s.t + span, run.times.dtype)
        there = run.status == OK and run.times[-1] == end
        return float(late) + float(not there) + float(not np.array_equal(run.rows, cut.rows))
