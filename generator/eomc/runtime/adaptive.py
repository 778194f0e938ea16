"""Simulation with adaptive step-size control, which `[run] tolerance` adds to a module.

The method is that of Gauss and Legendre with eight stages (order 16). The step-size control itself
is in the generated C.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_end, as_limits, as_times, as_tolerance
from .adaptive_error import error_by_tighter_tolerance
from .adaptive_memory import RowBuffer, StepCounters
from .adaptive_trajectory import AdaptiveTrajectory
from .arguments import Array, as_number, check_time
from .balance import with_jumps
from .dense import within
from .estimate import Estimate
from .events import EventBuffer
from .input_schedule import InputSchedule, ZeroOrderHold, input_schedule
from .section import crossings
from .slices import next_chunk
from .status import FULL, STATUS
from .stepping import Stepping
from .trajectory import Run

_FIRST_CALL_STEPS = 48  # accepted steps in the first call of C
_FIRST_CALL_NUMBERS = 2048  # limit of steps times coordinates in the first call
_MAX_STEPS_PER_CALL = 2**20
_MIN_CURVE_ROWS = 1_000  # in a plot
_ROWS_PER_STEP = 8  # equidistant rows for each step


class AdaptiveRun(AdaptiveTrajectory):
    """Run with adaptive step-size control: one row after each step, or at each requested time.

    A row consists of a time, the positions q and the velocities qd.

    Attributes
    ----------
    h : float
        Mean step size, s.
    rejected : int
        Number of rejected steps.
    stiff_steps : int
        Number of steps that were solved by Newton's method because the motion is stiff.
    events : dict of EventLog
        Times t (n,) and states q, qd (n, nq) of the occurrences of each event, by the event's name.
    stopped : str
        Name of the event that ended the run, or "".
    limit : float
        Time at which events accumulate (Zeno behaviour), s; nan unless the status is
        "accumulated".

    The other attributes are those of `Run`.
    """

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the positions and velocities at any times within the run.

        The run is repeated with rows at these times, so the states are as accurate as the run.

        Parameters
        ----------
        t : array_like, (...)
            Times, s.

        Returns
        -------
        q, qd : (..., nq) arrays
            At a state jump, the state before the jump.

        Raises
        ------
        ValueError
            If a time is outside of the run.
        """
        times = within(self, t)
        sorted_times, place = np.unique(times, return_inverse=True)
        q, qd = self._begin
        rows = np.empty((2, len(sorted_times), len(q)), self._model.dtype)
        first = int(bool(len(sorted_times)) and sorted_times[0] <= self.t0)
        rows[:, :first] = [[q], [qd]]
        if len(sorted_times) > first:
            rows[:, first:] = self._rerun(sorted_times[first:], self._t_end)._rows
        both = rows[:, place.ravel()].reshape(2, *times.shape, len(q))
        return both[0], both[1]

    def _rerun(self, times: Array | None, end: float) -> AdaptiveRun:
        """Repeat the run with rows at `times`; None: after each step and on both sides of jumps."""
        q, qd = self._begin
        inputs = self._period_inputs
        return run(
            self._model, q, qd, self.t0, end, self.tol, times,
            self._u if inputs is None else ZeroOrderHold(inputs, self._period, self._periods),
            self._params, self._h_most, None, self._stiff, method=self._by,
        )  # fmt: skip

    @property
    def _drawn(self) -> Run:
        """The run for plots: with additional rows if it has fewer than _MIN_CURVE_ROWS."""
        if len(self) < 2 or len(self) >= _MIN_CURVE_ROWS:
            return self
        return self._insert_rows(np.linspace(self.t[0], self.t[-1], _MIN_CURVE_ROWS + 1)[1:-1])

    def _evenly(self, count: int) -> AdaptiveRun:
        """Interpolate the run at `count` equidistant times, with both rows of each jump."""
        steps: AdaptiveRun = with_jumps(self)
        jumps = np.flatnonzero(np.diff(steps.t) == 0)
        own = np.unique(np.concatenate([[0], jumps, jumps + 1, [len(steps) - 1]]))
        times = np.linspace(steps.t[0], steps.t[-1], count)
        times = times[~np.isin(times, steps.t[own])]
        whole = np.concatenate([steps.t[own], times])
        order = np.argsort(whole, kind="stable")
        both = zip((steps.q[own], steps.qd[own]), self(times), strict=True)
        return self._with_rows(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def _insert_rows(self, times: Array) -> AdaptiveRun:
        """Return a copy of the run with additional rows at `times`."""
        whole = np.concatenate([self.t, times])
        order = np.argsort(whole, kind="stable")
        both = zip((self.q, self.qd), self(times), strict=True)
        return self._with_rows(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def _crossings(
        self, name: str, value: float, rising: bool | None, period: float | None
    ) -> dict[str, Array]:
        steps: AdaptiveRun = with_jumps(self)
        t, parts = steps.t[:, None], np.arange(1, _ROWS_PER_STEP) / _ROWS_PER_STEP
        between = (t[:-1] + np.diff(t, axis=0) * parts).astype(t.dtype)
        is_inside = (t[:-1] < between) & (between < t[1:])
        columns = crossings(
            steps._insert_rows(between[is_inside]).to_dict(), name, value, rising, period
        )
        in_run = columns["t"] >= self.t[0]
        times, by = columns["t"][in_run], 1e-6 * float(np.max(np.diff(steps.t)))
        turns = (
            0.0 if period is None else period * np.round((columns[name][in_run] - value) / period)
        )
        jumps = np.unique(steps.t[1:][np.diff(steps.t) == 0])
        piece = np.searchsorted(jumps, times)  # a state at a jump is that before it
        ends = (
            np.array([steps.t[0], *np.nextafter(jumps, np.inf)])[piece],
            np.array([*jumps, steps.t[-1]])[piece],
        )
        for _ in range(2):  # Newton's method
            places = times, np.clip(times - by, *ends), np.clip(times + by, *ends)
            here, one, other = (self._with_rows(x, np.array(self(x)))[name] for x in places)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = (here - value - turns) / (other - one) * (places[2] - places[1])
            times = np.clip(np.where(np.isfinite(step), times - step, times), *ends)
        return self._with_rows(times, np.array(self(times))).to_dict()

    def _equidistant(self) -> Run:
        if (np.diff(self.t) == 0).any() or len(self) < 2:
            return self
        times = np.linspace(self.t[0], self.t[-1], _ROWS_PER_STEP * (self.steps + 1))
        return self._with_rows(times, np.array(self(times)))

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        return error_by_tighter_tolerance(self, run, progress)


class SteppedRun(AdaptiveRun):
    """Run with fixed steps of a scene that has events.

    There is one row after each step and two rows at each state jump, before and after it. A step
    that reaches a state jump ends there. The next step is shorter and leads to the next multiple of
    the step size h. The attributes `events`, `stopped` and `limit` have the same meaning as in
    `AdaptiveRun`. `evaluations` is the number of evaluations of the accelerations; an iteration of
    an implicit method counts once for each stage.
    """

    @property
    def description(self) -> str:
        """Return the step size as text for messages, such as "h = 0.01 s"."""
        return f"h = {self.h:g} s"

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps of {self.h:g} s>"


def simulate(
    model: Stepping, q0: Any, qd0: Any, duration: float | None, u: Any,
    params: Any, t0: float, progress: Callable[[int, int], None] | None, times: ArrayLike | None,
    control_period: float | None, tol: float | None, h_most: float | None, stiff: bool,
    fixed: tuple[Any, ...],
) -> AdaptiveRun:  # fmt: skip
    """Check the arguments of `Model.simulate`, simulate with adaptive steps and return the run.

    Parameters
    ----------
    fixed : tuple
        The values that the caller gave for the arguments that only fixed steps use, in the order of
        `FIXED_STEP_DEFAULTS`. Each must have its default value.

    The other arguments are those of `Model.simulate`.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    tol, most = as_limits(model, tol, h_most, stiff, fixed)
    q, qd = model._start
    if q0 is not None or qd0 is not None:
        q, qd = model._one(q if q0 is None else q0, qd if qd0 is None else qd0)
    t0 = as_number(t0, "t0")
    p = model._p0 if params is None else model._parameters(params).copy()
    rows, first = None, 0
    if times is None:
        end = as_end(model, t0, duration)
    else:
        rows = as_times(times, t0, model.dtype, duration)
        first, end = int(rows[0] == t0), float(rows[-1])
        check_time(model.dtype, t0, end - t0)
    inputs = input_schedule(model, u, control_period, end - t0, params, duration)
    later_times = None if rows is None else rows[first:]
    trajectory = run(model, q, qd, t0, end, tol, later_times, inputs, p, most, progress, stiff)
    if first:
        both = np.concatenate([np.array([[q], [qd]]), trajectory._rows], axis=1)
        return trajectory._with_rows(rows[: both.shape[1]], both)  # type: ignore[index]
    return trajectory


def simulate_short_run(
    model: Stepping, q0: Any, qd0: Any, duration: float | None, u: Any,
    params: Any, t0: float, tol: float | None, count: int,
) -> AdaptiveRun | None:  # fmt: skip
    """Simulate a short run with adaptive steps by a single call of the C function.

    Only for scenes without events and constraints. Return None in three cases, in which the caller
    has to use `simulate` instead: the run does not reach its end within `count` rows; the run
    fails; u is neither None, nor a float, nor an array (nu,) of the module's number type.

    q0, qd0: initial state (nq,), or None for that of the scene. duration: in s. tol: tolerance, or
    None for that of the scene.
    """
    (from_q, from_qd, at_p), p, (address, real, null) = model._at, model._p0, model._c
    inputs, at_u = None, null
    if u is not None:
        inputs = np.array([u], model.dtype) if type(u) is float else u
        if (at_u := model._listed(inputs, (model.nu or None,))) is None:
            return None
        inputs = inputs.copy()
    if q0 is not None:
        from_q = model._checked_half(q0, "q0")[1]
    if qd0 is not None:
        from_qd = model._checked_half(qd0, "qd0")[1]
    if params is not None:
        p = model._parameters(params).copy()
        at_p = model._pointer(p)
    tol = as_tolerance(model.tolerance if tol is None else tol, model.dtype)
    end = as_end(model, t0, duration)
    nq = model.nq
    work, whole = model._ffi.new("adaptive_work *"), np.empty(count * (1 + 2 * nq), model.dtype)
    to_t = address(real, whole)
    to_q = to_t + count
    code = model._lib.adaptive_begin(
        from_q, from_qd, t0, end, tol, 0.0, at_u, count - 1, null, 0,
        to_t, to_q, to_q + nq * count, at_p, work,
    )  # fmt: skip
    if code or work.t < end:
        model._room = 0
        return None
    steps, filled = work.steps, work.rows
    both = whole[count:].reshape(2, count, nq)[:, :filled]
    return AdaptiveRun(
        model, t0, both, (end - t0) / steps if steps else 0.0, steps, "ok", p, 1, inputs, "gauss16",
        work.evaluations, tol=tol, rejected=work.rejected, stiff_steps=work.stiff_steps,
        _times=whole[:filled], _t_end=end,
    )  # fmt: skip


def run(
    model: Stepping, q: Array, qd: Array, t0: float, t_end: float, tol: float, times: Array | None,
    u: Array | ZeroOrderHold | None, p: Array, h_most: float,
    progress: Callable[[int, int], None] | None, stiff: bool = False, enough: float = inf,
    method: str = "",
) -> AdaptiveRun:  # fmt: skip
    """Simulate with adaptive steps, or with fixed steps and events, from checked arguments.

    The run is returned even if it failed; its attribute `status` is then the reason.

    Parameters
    ----------
    q, qd : (nq,) arrays
        Initial state.
    t0, t_end : float
        Start and end time, s.
    tol : float
        Tolerance of adaptive steps.
    times : (n,) array or None
        Times of the rows, s, later than t0. None: a row at t0 and after each step.
    u : (nu,) array, ZeroOrderHold or None
        Constant inputs, inputs that are held over control periods, or the scene's signals (None).
    p : (np,) array
        Parameters.
    h_most : float
        Longest adaptive step, s (0: no limit), or the size of fixed steps.
    progress : callable or None
        Called with (simulated thousandths of the run, 1000).
    stiff : bool
        Whether the run begins with Newton's method.
    enough : float
        Number of steps after which the run ends early. It is checked between calls of C, so the
        run may have more steps.
    method : str
        Name of the method of fixed steps of size h_most; "": adaptive steps.
    """
    (address, real, _), nq = model._c, model.nq
    work = model._ffi.new("adaptive_work *")
    if stiff:
        work.stiff = 1
    if method:
        work.fixed = 1 + model.methods.index(method)
    acting = InputSchedule(model, u, t0, t_end, q, qd)
    at_p = model._at[2] if p is model._p0 else address(real, p)
    events = EventBuffer(model) if model.events else None
    rows_per_step = 2 if events else 1  # a jump adds a row
    room = max(_FIRST_CALL_STEPS, min(model._room, _FIRST_CALL_NUMBERS // nq))
    rows = RowBuffer(model, times, 1 + rows_per_step * room)
    call = model._lib.adaptive_begin
    place: tuple[Any, ...] = address(real, q), address(real, qd), t0
    status, counters = "ok", StepCounters(model)
    try:
        while True:
            call_start = perf_counter()
            most, *to = rows.c_arguments(room, rows_per_step)
            code = call(
                *place, acting.stop, tol, h_most, acting.address, most, *to,
                *(events.room() if events else ()), at_p, work,
            )  # fmt: skip
            counters.add(work, bool(events))
            rows.filled += _take_rows(work, events)
            status = STATUS[code]
            ended, cut = code or (events and work.stopped), work.t < acting.stop
            if ended or work.steps >= enough or not acting.advance(work):
                break
            if progress is not None:
                progress(round(1000 * (work.t - t0) / (t_end - t0)), 1000)
            room = (
                min(next_chunk(room, perf_counter() - call_start), _MAX_STEPS_PER_CALL)
                if cut
                else room
            )
            call, place = model._lib.adaptive, (work.x, model._ffi.addressof(work, "t"))
            if not (room := counters.limit_steps(room, rows_per_step)):
                status = FULL
                break
            rows.reserve(room, rows_per_step)
        if progress is not None and status == "ok":
            progress(1000, 1000)
    except KeyboardInterrupt:
        rows.filled += _take_rows(work, events)
        status = "interrupted"
    stamps, both = rows.concatenate()
    steps = work.steps
    is_unusual = events or model.constraint_names or nq * steps > _FIRST_CALL_NUMBERS
    model._room = 0 if is_unusual else steps + _FIRST_CALL_STEPS
    h = h_most if method else (work.t - t0) / steps if steps else t_end - t0
    called = model._called(method, steps, work.evaluations) if method else work.evaluations
    trajectory = (SteppedRun if method else AdaptiveRun)(
        model, t0, both, h, steps, status, p, 1, acting.u, method or "gauss16",
        called, tol=tol,
        rejected=work.rejected, stiff_steps=work.stiff_steps, _times=stamps, _t_end=t_end,
    )  # fmt: skip
    trajectory._h_most, trajectory._stiff, trajectory._by = h_most, bool(stiff), method
    if times is not None:
        trajectory._begin = np.array([q, qd])
    if times is not None:
        trajectory._last = work.t, np.frombuffer(model._ffi.buffer(work.x), model.dtype).copy()
    if acting.periods:
        trajectory._period, trajectory._period_inputs = (
            acting.periods.period,
            np.array(acting.values),
        )
        trajectory._periods = acting.periods.count
        trajectory._update_applied_inputs()
    if events:
        trajectory._event_data = events.all()
        trajectory.stopped = model.events[work.stopped - 1] if work.stopped else ""
        trajectory.limit = work.limit if status == "accumulated" else trajectory.limit
    if model.constraint_names:
        trajectory.singular_steps = work.singular
        trajectory.first_singular = work.first if work.singular else trajectory.first_singular
    return trajectory


def _take_rows(work: Any, events: EventBuffer | None) -> int:
    """Store the events of the last call and return the number of its rows."""
    rows, work.rows = work.rows, 0
    if events:
        events.keep(work)
    return int(rows)
