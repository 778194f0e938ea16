"""Runs with adaptive step-size control, and runs with fixed steps and events.

The adaptive method is that of Gauss and Legendre with eight stages (order 16). The step-size
control itself, and the detection of events, are in the generated C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, ByName, as_number, as_step_size, check_time, machine_memory
from .c_library import next_chunk
from .estimate import Estimate
from .events import EventBuffer, EventLog
from .inputs import (
    InputSchedule,
    ZeroOrderHold,
    input_schedule,
    sample_zero_order_hold,
    warn_called_each_step,
)
from .interfaces import CompiledModel
from .package import is_built_from_system, option
from .requests import AdaptiveRequest, SimulationArguments, as_end, as_times, as_tolerance
from .stability import MIN_STEPS, LinearizationState
from .status import FULL, PART, STATUS, STATUS_MESSAGES, state_text
from .trajectory import Run
from .trajectory_data import LEFT_OUT, infinite_at_start, within

_FIRST_CALL_STEPS = 48  # accepted steps in the first call of C
_FIRST_CALL_NUMBERS = 2048  # limit of steps times coordinates in the first call
_MAX_STEPS_PER_CALL = 2**20
_MIN_CURVE_ROWS = 1_000  # in a plot
_ROWS_PER_STEP = 8  # equidistant rows for each step
_NONE = (np.empty(0, np.intc), np.empty((0, 1)))  # events
STEP_TOO_SHORT = (
    "no step is short enough to go on: forces grow without end there, as in a fall into a centre, "
    "or keep jumping: for friction by sign(x_dot) that sticks {}, or let events switch it; else a "
    "looser tolerance"
)
FRICTION_REMEDIES = (
    "take {}",
    "give its coordinate friction = in place of the force",  # where the scene has that
)


@dataclass(eq=False, repr=False)
class AdaptiveRun(Run):
    """Run with adaptive step-size control, or with fixed steps of a scene that has events.

    A row consists of a time, the positions q and the velocities qd. There is a row after each step,
    or at each requested time. With events there are two rows at each state jump, before and after
    it. A fixed step that reaches a state jump ends there; the next step is shorter and leads to the
    next multiple of the step size h.

    Attributes
    ----------
    h : float
        Mean size of adaptive steps, or the size of fixed steps, s.
    fixed_method : str
        Name of the method of fixed steps; "" for adaptive steps.
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

    tol: float = field(kw_only=True)
    rejected: int = field(kw_only=True)
    stiff_steps: int = field(kw_only=True)
    _times: Array = field(kw_only=True)
    _t_end: float = field(kw_only=True)
    # rarely used fields are set after construction, whose time dominates that of short runs
    max_step: float = field(default=0.0, init=False)
    fixed_method: str = field(default="", init=False)  # the method of fixed steps
    last_state: tuple[float, Array] = field(
        default=(0.0, _NONE[1]), init=False
    )  # t, [q; qd] reached
    stiff: bool = field(default=False, init=False)
    # event indices (n,), rows of t, q, qd
    event_data: tuple[Array, Array] = field(default=_NONE, init=False)
    stopped: str = field(default="", init=False)
    limit: float = field(default=float("nan"), init=False)
    _period: float = field(default=0.0, init=False)  # control period, s; 0 without one
    _period_inputs: Array | None = field(default=None, init=False)  # inputs of the periods, (n, nu)
    _periods: int = field(default=0, init=False)  # number of control periods in the run

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s."""
        return self._times

    @cached_property
    def initial_state(self) -> Array:
        """q and qd at t0, (2, nq); by default the first row."""
        return np.array([self.rows[0][0], self.rows[1][0]])

    @property
    def message(self) -> str:
        """Return a sentence on the result of the run; for a failed run it states the reason."""
        progress = f"{self.steps} steps, {self.description}"
        if self.status == "ok":
            return progress
        if self.status == "not finite" and self.stopped:
            return f"event '{self.stopped}' jumps to no finite state at t = {self.t[-1]:.9g} s"
        if self.status == "accumulated":
            return (
                f"jumps follow one another ever sooner, up to t = {self.limit:.15g} s: there the "
                f"run ends, after {progress}"
            )
        why = infinite_at_start(self) or failure_message(self.model, self.status, self.fixed_method)
        where = state_text(self.q[-1], self.qd[-1]) if len(self) else ""
        end = self.t[-1] if len(self) else self.t0
        return f"stopped at t = {end:.9g} after {progress}, {where}: {why}"

    @cached_property
    def events(self) -> dict[str, EventLog]:
        """Return the occurrences of each event of the scene as a dict from name to `EventLog`.

        An `EventLog` has the times t (n,), s, and the states q, qd (n, nq) at the occurrences. At a
        state jump, the state is that before the jump.
        """
        which, rows = self.event_data
        nq, names = self.model.info.nq, self.model.info.events
        each = (rows[which == k] for k in range(len(names)))
        logs = (EventLog(x[:, 0], x[:, 1 : 1 + nq], x[:, 1 + nq :]) for x in each)
        return ByName("events", names, logs)

    @property
    def description(self) -> str:
        """The choice of steps as text: numbers of rejected and Newton steps, or the step size."""
        if self.fixed_method:
            return f"h = {self.h:g} s"
        stiff = f", {self.stiff_steps} by Newton's method" if self.stiff_steps else ""
        return f"{self.rejected} rejected{stiff}, tolerance {self.tol:g}"

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        steps = f" of {self.h:g} s" if self.fixed_method else f", tolerance {self.tol:g}"
        return f"<Run of {self.model.info.name}: {how}{self.steps} steps{steps}>"

    def with_rows(self, times: Array, rows: Array) -> Self:
        """Return a copy of the run with other times (n,) and rows (2, n, nq)."""
        run = copy(self)
        run.initial_state = self.initial_state
        for name in ("q", "qd", "outputs"):  # cached properties
            run.__dict__.pop(name, None)
        run.rows, run._times, run._energy = rows, times, None
        run.update_applied_inputs()
        return run

    def update_applied_inputs(self) -> None:
        """Set the inputs that are applied at each row (zero-order hold)."""
        if self._period_inputs is not None:
            self.applied_inputs = sample_zero_order_hold(
                self._times, self.t0, self._period, self._period_inputs
            )

    def repeat(self, parts: int, every: int, nudge: Array | None, progress: Any) -> Run:
        """Raise ValueError: the steps of an adaptive run have no common size."""
        raise ValueError("an adaptive run has no steps of one size")

    def to_arrays(self) -> dict[str, Any]:
        """Return the arrays and numbers that a file of the run contains, by name."""
        own = {
            "tol": self.tol, "rejected": self.rejected, "stiff_steps": self.stiff_steps,
            "times": self.t, "h_most": self.max_step, "stiff": self.stiff,
            "begin": self.initial_state,
            "t_end": self._t_end, "which": self.event_data[0],
            "event_rows": self.event_data[1], "stopped": self.stopped, "limit": self.limit,
            "period": self._period, "values": self._period_inputs, "by": self.fixed_method,
            "periods": self._periods,
        }  # fmt: skip
        return super().to_arrays() | own

    @classmethod
    def from_arrays(cls, model: CompiledModel, arrays: Mapping[str, Any], **own: Any) -> Self:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        constant, values = arrays.get("held"), arrays.get("values")
        u = constant if values is None or constant is not None else LEFT_OUT
        run = cls(
            model, arrays["t0"], (arrays["q"], arrays["qd"]), arrays["h"], arrays["steps"],
            arrays["status"], arrays["params"], 1, u, arrays["method"], arrays["evaluations"],
            tol=arrays["tol"], rejected=arrays["rejected"],
            stiff_steps=arrays.get("stiff_steps", 0), _times=arrays["times"],
            _t_end=arrays["t_end"],
        )  # fmt: skip
        run.max_step, run.stiff = arrays["h_most"], bool(arrays.get("stiff", False))
        run.fixed_method = arrays.get("by", "")
        run.initial_state, run.event_data = arrays["begin"], (arrays["which"], arrays["event_rows"])
        run.stopped, run.limit = arrays["stopped"], arrays["limit"]
        run._period, run._period_inputs = arrays.get("period", 0.0), values
        run._periods = arrays.get("periods", 0 if values is None else len(values))
        run.update_applied_inputs()
        return run

    def _state(self) -> dict[str, Any]:
        state = super()._state() | {"_times": self._times}
        state.pop("events", None)
        return state

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        return (*super().settings(), self.tol, self._times.tolist())

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
        q, qd = self.initial_state
        rows = np.empty((2, len(sorted_times), len(q)), self.model.info.dtype)
        first = int(bool(len(sorted_times)) and sorted_times[0] <= self.t0)
        rows[:, :first] = [[q], [qd]]
        if len(sorted_times) > first:
            rows[:, first:] = self.rerun(sorted_times[first:], self._t_end).rows
        both = rows[:, place.ravel()].reshape(2, *times.shape, len(q))
        return both[0], both[1]

    def rerun(self, times: Array | None, end: float) -> AdaptiveRun:
        """Repeat the run with rows at `times`; None: after each step and on both sides of jumps."""
        q, qd = self.initial_state
        u, inputs = self.input_source, self._period_inputs
        if inputs is not None:
            u = ZeroOrderHold(inputs, self._period, self._periods)
        request = AdaptiveRequest(
            q, qd, self.t0, end, self.tol, times, u, self.parameter_values, self.max_step,
            self.stiff, self.fixed_method,
        )  # fmt: skip
        return run(self.model, request)

    @property
    def curve_run(self) -> Run:
        """The run for plots: with additional rows if it has fewer than _MIN_CURVE_ROWS."""
        if len(self) < 2 or len(self) >= _MIN_CURVE_ROWS:
            return self
        return self.insert_rows(np.linspace(self.t[0], self.t[-1], _MIN_CURVE_ROWS + 1)[1:-1])

    def resample(self, count: int) -> AdaptiveRun:
        """Interpolate the run at `count` equidistant times, with both rows of each jump."""
        from .balance import with_jumps

        steps: AdaptiveRun = with_jumps(self)
        jumps = np.flatnonzero(np.diff(steps.t) == 0)
        own = np.unique(np.concatenate([[0], jumps, jumps + 1, [len(steps) - 1]]))
        times = np.linspace(steps.t[0], steps.t[-1], count)
        times = times[~np.isin(times, steps.t[own])]
        whole = np.concatenate([steps.t[own], times])
        order = np.argsort(whole, kind="stable")
        both = zip((steps.q[own], steps.qd[own]), self(times), strict=True)
        return self.with_rows(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def insert_rows(self, times: Array) -> AdaptiveRun:
        """Return a copy of the run with additional rows at `times`."""
        whole = np.concatenate([self.t, times])
        order = np.argsort(whole, kind="stable")
        both = zip((self.q, self.qd), self(times), strict=True)
        return self.with_rows(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def _crossings(
        self, name: str, value: float, rising: bool | None, period: float | None
    ) -> dict[str, Array]:
        from .balance import with_jumps
        from .section import crossings

        steps: AdaptiveRun = with_jumps(self)
        t, parts = steps.t[:, None], np.arange(1, _ROWS_PER_STEP) / _ROWS_PER_STEP
        between = (t[:-1] + np.diff(t, axis=0) * parts).astype(t.dtype)
        is_inside = (t[:-1] < between) & (between < t[1:])
        columns = crossings(
            steps.insert_rows(between[is_inside]).to_dict(), name, value, rising, period
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
            here, one, other = (self.with_rows(x, np.array(self(x)))[name] for x in places)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = (here - value - turns) / (other - one) * (places[2] - places[1])
            times = np.clip(np.where(np.isfinite(step), times - step, times), *ends)
        return self.with_rows(times, np.array(self(times))).to_dict()

    def equidistant(self) -> Run:
        """Return a run with equidistant rows, one for each step, or enough for a picture."""
        if (np.diff(self.t) == 0).any() or len(self) < 2:
            return self
        times = np.linspace(self.t[0], self.t[-1], _ROWS_PER_STEP * (self.steps + 1))
        return self.with_rows(times, np.array(self(times)))

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        from .adaptive_error import error_by_tighter_tolerance

        return error_by_tighter_tolerance(self, run, progress)


def simulate(model: CompiledModel, options: SimulationArguments) -> AdaptiveRun:
    """Check the arguments of `Integrator.simulate`, simulate with adaptive steps; return the run.

    Raises ValueError if an argument is invalid.
    """
    info = model.info
    tol, most = options.adaptive_limits(info)
    q, qd, p = _initial(model, options)
    t0, rows, first = as_number(options.t0, "t0"), None, 0
    if options.times is None:
        end = as_end(info, t0, options.duration)
    else:
        rows = as_times(options.times, t0, info.dtype, options.duration)
        first, end = int(rows[0] == t0), float(rows[-1])
        check_time(info.dtype, t0, end - t0)
    inputs = input_schedule(model, options, options.control_period, end - t0)
    later_times = None if rows is None else rows[first:]
    request = AdaptiveRequest(
        q, qd, t0, end, tol, later_times, inputs, p, most, options.stiff, progress=options.progress
    )
    trajectory = run(model, request)
    if first:
        both = np.concatenate([np.array([[q], [qd]]), trajectory.rows], axis=1)
        return trajectory.with_rows(rows[: both.shape[1]], both)  # type: ignore[index]
    return trajectory


def simulate_fixed_steps(model: CompiledModel, options: SimulationArguments) -> AdaptiveRun:
    """Check the arguments of `Integrator.simulate`, simulate with fixed steps and events.

    Raises ValueError if an argument is invalid.
    """
    info = model.info
    if options.out is not None:
        raise ValueError("out: events add rows, and no one knows how many: leave it out")
    q, qd, p = _initial(model, options)
    method, t0 = info.method_name(options.method), as_number(options.t0, "t0")
    h = info.h if options.h is None else as_step_size(options.h, info.dtype)
    rows, span = options.event_rows(info, t0, h)
    end = float(info.dtype.type(t0 + span))
    hold = options.input_period(h)
    if callable(options.u) and hold == h:
        warn_called_each_step(model)
    schedule = input_schedule(model, options, hold, span)
    if span >= MIN_STEPS * h and (method, h) not in model.integrator.warned:
        constant = schedule if isinstance(schedule, np.ndarray) else None
        model.integrator.check_step_size(LinearizationState(q, qd, t0, constant, p), h, method)
    first = 0 if rows is None else int(rows[0] == t0)
    request = AdaptiveRequest(
        q, qd, t0, end, 0.0, None if rows is None else rows[first:], schedule, p, h,
        method=method, progress=options.progress,
    )  # fmt: skip
    result = run(model, request)
    if rows is None:
        return result
    both = np.concatenate([np.array([[q], [qd]])[:, :first], result.rows], axis=1)
    stamps, (t, x) = rows[: both.shape[1]], result.last_state
    if options.times is None and t > stamps[-1]:  # an event stopped the run between two rows
        both, stamps = np.append(both, x.reshape(2, 1, -1), axis=1), np.append(stamps, t)
    return result.with_rows(stamps, both)


def _initial(model: CompiledModel, options: SimulationArguments) -> tuple[Array, Array, Array]:
    """Return q, qd and the parameters at the start of a run."""
    q, qd = model.info.initial_state
    if options.q0 is not None or options.qd0 is not None:
        q, qd = model.arguments.one_state(
            q if options.q0 is None else options.q0, qd if options.qd0 is None else options.qd0
        )
    p = model.info.p0
    return q, qd, p if options.params is None else model.arguments.parameters(options.params).copy()


def simulate_short_run(
    model: CompiledModel, start: tuple[Any, Any], duration: float | None, u: Any, params: Any,
    t0: float, tol: float | None, count: int,
) -> AdaptiveRun | None:  # fmt: skip
    """Simulate a short run with adaptive steps by a single call of the C function.

    Only for scenes without events and constraints. Return None in three cases, in which the caller
    has to use `simulate` instead: the run does not reach its end within `count` rows; the run
    fails; u is neither None, nor a float, nor an array (nu,) of the module's number type.

    start: initial positions and velocities, (nq,) each, or None for those of the scene. count:
    number of rows, for which there is memory. The other arguments are those of
    `Integrator.simulate`.
    """
    info, arguments = model.info, model.arguments
    (from_q, from_qd, at_p), p = arguments.default_pointers, info.p0
    (address, real, null), (q0, qd0) = model.c.tools, start
    inputs, at_u = None, null
    if u is not None:
        inputs = np.array([u], info.dtype) if type(u) is float else u
        if (at_u := arguments.as_list(inputs, (info.nu or None,))) is None:
            return None
        inputs = inputs.copy()
    if q0 is not None:
        from_q = arguments.initial_half(q0, "q0")[1]
    if qd0 is not None:
        from_qd = arguments.initial_half(qd0, "qd0")[1]
    if params is not None:
        p = arguments.parameters(params).copy()
        at_p = model.c.pointer(p)
    tol = as_tolerance(info.tolerance if tol is None else tol, info.dtype)
    end = as_end(info, t0, duration)
    nq = info.nq
    work, whole = model.c.ffi.new("adaptive_work *"), np.empty(count * (1 + 2 * nq), info.dtype)
    to_t = address(real, whole)
    to_q = to_t + count
    code = model.c.lib.adaptive_begin(
        from_q, from_qd, t0, end, tol, 0.0, at_u, count - 1, null, 0,
        to_t, to_q, to_q + nq * count, at_p, work,
    )  # fmt: skip
    if code or work.t < end:
        model.integrator.room = 0
        return None
    steps, filled = work.steps, work.rows
    both = whole[count:].reshape(2, count, nq)[:, :filled]
    return AdaptiveRun(
        model, t0, both, (end - t0) / steps if steps else 0.0, steps, "ok", p, 1, inputs, "gauss16",
        work.evaluations, tol=tol, rejected=work.rejected, stiff_steps=work.stiff_steps,
        _times=whole[:filled], _t_end=end,
    )  # fmt: skip


def run(model: CompiledModel, request: AdaptiveRequest) -> AdaptiveRun:
    """Simulate with adaptive steps, or with fixed steps and events, from checked arguments.

    The run is returned even if it failed; its attribute `status` is then the reason.
    """
    q, qd, t0, t_end, tol, times, u, p, max_step, stiff, method, max_steps, progress = request
    (address, real, _), nq = model.c.tools, model.info.nq
    work = model.c.ffi.new("adaptive_work *")
    if stiff:
        work.stiff = 1
    if method:
        work.fixed = 1 + model.info.methods.index(method)
    acting = InputSchedule(model, u, t0, t_end, q, qd)
    at_p = model.arguments.default_pointers[2] if p is model.info.p0 else address(real, p)
    events = EventBuffer(model) if model.info.events else None
    rows_per_step = 2 if events else 1  # a jump adds a row
    room = max(_FIRST_CALL_STEPS, min(model.integrator.room, _FIRST_CALL_NUMBERS // nq))
    rows = RowBuffer(model, times, 1 + rows_per_step * room)
    call = model.c.lib.adaptive_begin
    place: tuple[Any, ...] = address(real, q), address(real, qd), t0
    status, counters = "ok", StepCounters(model)
    try:
        while True:
            call_start = perf_counter()
            most, *to = rows.c_arguments(room, rows_per_step)
            code = call(
                *place, acting.stop, tol, max_step, acting.address, most, *to,
                *(events.room() if events else ()), at_p, work,
            )  # fmt: skip
            counters.add(work, bool(events))
            rows.filled += _take_rows(work, events)
            status = STATUS[code]
            ended, cut = code or (events and work.stopped), work.t < acting.stop
            if ended or work.steps >= max_steps or not acting.advance(work):
                break
            if progress is not None:
                progress(round(1000 * (work.t - t0) / (t_end - t0)), 1000)
            room = (
                min(next_chunk(room, perf_counter() - call_start), _MAX_STEPS_PER_CALL)
                if cut
                else room
            )
            call, place = model.c.lib.adaptive, (work.x, model.c.ffi.addressof(work, "t"))
            if not (room := counters.limit_steps(room, rows_per_step)):
                status = FULL
                break
            rows.reserve(room, rows_per_step)
        if progress is not None and status == "ok":
            progress(1000, 1000)
    except KeyboardInterrupt:
        rows.filled += _take_rows(work, events)
        status = "interrupted"
    return _completed_run(model, request, work, status, rows.concatenate(), acting, events)


def _completed_run(
    model: CompiledModel, request: AdaptiveRequest, work: Any, status: str,
    rows: tuple[Array, Array], acting: InputSchedule, events: EventBuffer | None,
) -> AdaptiveRun:  # fmt: skip
    """Return the run with the rows (times, states), inputs and events of a simulation.

    work: workspace of the C function at the end.
    """
    info, method, t0, steps = model.info, request.method, request.t0, work.steps
    stamps, both = rows
    is_unusual = events or info.constraints.names or info.nq * steps > _FIRST_CALL_NUMBERS
    model.integrator.room = 0 if is_unusual else steps + _FIRST_CALL_STEPS
    h, evaluations = request.t_end - t0, work.evaluations
    if method:
        h, evaluations = request.max_step, info.count_evaluations(method, steps, evaluations)
    elif steps:
        h = (work.t - t0) / steps
    trajectory = AdaptiveRun(
        model, t0, both, h, steps, status, request.p, 1, acting.u, method or "gauss16",
        evaluations, tol=request.tol, rejected=work.rejected, stiff_steps=work.stiff_steps,
        _times=stamps, _t_end=request.t_end,
    )  # fmt: skip
    trajectory.max_step, trajectory.stiff = request.max_step, bool(request.stiff)
    trajectory.fixed_method = method
    if request.times is not None:
        trajectory.initial_state = np.array([request.q, request.qd])
        x = np.frombuffer(model.c.ffi.buffer(work.x), info.dtype).copy()
        trajectory.last_state = work.t, x
    if acting.periods:
        trajectory._period = acting.periods.period
        trajectory._period_inputs = np.array(acting.values)
        trajectory._periods = acting.periods.count
        trajectory.update_applied_inputs()
    if events:
        trajectory.event_data = events.all()
        trajectory.stopped = info.events[work.stopped - 1] if work.stopped else ""
        trajectory.limit = work.limit if status == "accumulated" else trajectory.limit
    if info.constraints.names:
        trajectory.singular_steps = work.singular
        trajectory.first_singular = work.first if work.singular else trajectory.first_singular
    return trajectory


def _take_rows(work: Any, events: EventBuffer | None) -> int:
    """Store the events of the last call and return the number of its rows."""
    rows, work.rows = work.rows, 0
    if events:
        events.keep(work)
    return int(rows)


def _friction() -> str:
    """The option of a scene that adds Coulomb friction with sticking."""
    return (
        "System.make(..., friction={...})"
        if is_built_from_system()
        else option("friction", '"stick"')
    )


def failure_message(model: CompiledModel, status: str, fixed: str) -> str:
    """Return a sentence with the reason why a run ended with this status, and with a remedy.

    status: such as "singular". fixed: name of the method of fixed steps; "": adaptive steps.
    """
    if status == "no convergence" and not fixed:
        return STEP_TOO_SHORT.format(
            FRICTION_REMEDIES[bool(model.info.constraints.modes)].format(_friction())
        )
    return STATUS_MESSAGES[status]


class StepCounters:
    """Count the stored rows and events of a run to keep the run within the machine's memory."""

    def __init__(self, model: CompiledModel) -> None:
        self.rows, self.most = 0, room_for(model)

    def add(self, work: Any, events: bool) -> None:
        """Add the number of rows, and if `events` is True the number of events, of the last C call.

        work: the C struct of the run, of type adaptive_work.
        """
        self.rows += work.rows + (work.events if events else 0)

    def limit_steps(self, steps: int, each: int) -> int:
        """Return how many steps the next call of C may make so that its rows fit in memory.

        steps: upper limit of the result. each: maximum number of rows that a step stores.
        """
        return int(min(steps, max(0.0, self.most - self.rows) // each))


class RowBuffer:
    """Memory that C fills with the rows (t, q, qd) of a run.

    times: requested times of the rows (n,), s; None: a row after each step. Without requested times
    the number of rows is not known in advance. Several arrays ("pieces") are then allocated one
    after the other, and `count` is the number of rows of the first piece.
    """

    def __init__(self, model: CompiledModel, times: Array | None, count: int) -> None:
        self.model, self.own = model, times is None
        self.times = None if times is None else np.ascontiguousarray(times, model.info.dtype)
        self.pieces: list[tuple[Array, Array]] = []
        self._piece(count if times is None else len(times))

    def _piece(self, count: int) -> None:
        address, real, _ = self.model.c.tools
        self.whole, self.count, self.filled = rows_for(self.model, count), count, 0
        self.to = address(real, self.whole)
        self.to_t = self.to if self.times is None else address(real, self.times)

    def reserve(self, steps: int, each: int) -> None:
        """Allocate a new piece (array) for `steps` steps if the current one is full.

        A piece is full if it cannot store the rows of another step. each: maximum number of rows
        that a step stores. With requested times there is only one piece.
        """
        if self.own and self.count - self.filled < each:
            self.pieces.append(self._filled())
            self._piece(1 + each * steps)

    def c_arguments(self, steps: int, each: int) -> tuple[Any, ...]:
        """Return the arguments about rows that the next call of the C function receives.

        steps: maximum number of steps of the call. each: maximum number of rows that a step stores.
        The result is (maximum number of steps, pointer to the requested times, number of these
        times, pointers to the buffers for t, q and qd).
        """
        null, nq, left = self.model.c.tools[2], self.model.info.nq, self.count - self.filled
        to_q = self.to + (self.count + nq * self.filled)
        at = to_q, to_q + nq * self.count
        if self.own:
            return (left - (not self.filled)) // each, null, 0, self.to_t + self.filled, *at
        return steps, self.to_t + self.filled, left, null, *at

    def concatenate(self) -> tuple[Array, Array]:
        """Return the times (n,), s, and the states [q, qd], (2, n, nq), of all stored rows."""
        times, rows = self._filled()
        if self.pieces:
            times = np.concatenate([*(t for t, _ in self.pieces), times])
            rows = np.concatenate([*(rows for _, rows in self.pieces), rows], axis=1)
        return times, rows

    def _filled(self) -> tuple[Array, Array]:
        """Return the times and rows of the last piece."""
        times = self.whole if self.times is None else self.times
        rows = self.whole[self.count :].reshape(2, self.count, self.model.info.nq)
        return times[: self.filled], rows[:, : self.filled]


def room_for(model: CompiledModel) -> float:
    """Return the largest number of rows and events, counted together, that a run may store.

    The number follows from the memory of the machine.
    """
    return PART * machine_memory() / _row(model)


def rows_for(model: CompiledModel, count: int) -> Array:
    """Allocate a flat array for `count` rows (t, q, qd), which has count * (1 + 2 nq) numbers.

    Raises MemoryError if the array does not fit in the machine's memory.
    """
    try:
        if count * _row(model) > machine_memory():
            raise MemoryError
        return np.empty(count * (1 + 2 * model.info.nq), model.info.dtype)
    except MemoryError:
        raise MemoryError(
            f"{count} rows of {1 + 2 * model.info.nq} numbers don't fit in memory: give fewer "
            "times="
        ) from None


def _row(model: CompiledModel) -> int:
    """Size of a row (t, q, qd) in bytes."""
    return (1 + 2 * model.info.nq) * model.info.dtype.itemsize
