"""Simulation of many instances with adaptive step-size control for each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_end, as_limits, as_times
from .adaptive_memory import room_for
from .adaptive_trajectory import failure_message
from .arguments import Array, Start, as_count, as_number, as_step_size, check_time, cut_table
from .batch_instances import Instances
from .batch_run import BatchRun, initial_failures
from .batch_work import as_threads, run_groups
from .by_name import ByName
from .events import BatchEventBuffer, BatchEventLog
from .fixed_step_events import as_hold, as_rows
from .input_schedule import count_periods, period_end, sample_zero_order_hold
from .metadata import SOME
from .slices import next_chunk
from .status import FULL, STATUS

# instances that a thread simulates at once, of many and of few
_GROUP_SIZE, _SMALL_GROUP_SIZE = 128, 16
_COUNTERS = ("steps", "evaluations", "rejected", "stiff_steps")
MAX_EVALUATIONS = 2**31 - 1  # of an instance; fits in long on every machine
_EVALUATIONS_PER_STATE = 8 * 64  # for a state between two steps: stages times iterations, at most
_FIRST_CHUNK_STEPS = 64  # steps of an instance before the first check of Ctrl-C
_NAMES = (
    "tol", "evaluations", "rejected", "stiff_steps", "reached", "_times", "_begin", "_h_most",
    "_stiff", "_period", "_by", "_max_evaluations",
)  # fmt: skip
_EVENT_FIELDS = ("event_instances", "which", "event_rows")  # of a saved run
_ENDS = np.array([*STATUS, FULL])


@dataclass(eq=False, repr=False)
class AdaptiveBatchRun(BatchRun):
    """Trajectories of many instances with adaptive steps, or with fixed steps and events.

    All instances have rows at the same times. The attributes are those of `BatchRun` and:

    Attributes
    ----------
    tol : float
        Tolerance of adaptive steps; 0 for fixed steps.
    evaluations, rejected, stiff_steps : (batch,) arrays of int
        Numbers of evaluations of the accelerations, of rejected steps, and of steps by Newton's
        method of each instance.
    reached : (batch,) array
        Time that each instance reached, s. Rows at later times are nan. An instance ends early
        after a failure, at an event that stops it, or after `max_evaluations` (status "too long").
    events : dict of BatchEventLog
        Occurrences of each event, by the event's name: times t, states q, qd and instances, sorted
        by instance.
    """

    tol: float = field(kw_only=True)
    evaluations: Array = field(kw_only=True)
    rejected: Array = field(kw_only=True)
    stiff_steps: Array = field(kw_only=True)
    reached: Array = field(kw_only=True)
    _times: Array = field(kw_only=True)
    _begin: Array = field(kw_only=True)  # q and qd at t0, (2, batch, nq)
    _h_most: float = field(kw_only=True)
    _stiff: bool = field(kw_only=True)
    _period: float = field(default=0.0, kw_only=True)  # control period, s; 0 without one
    _by: str = field(default="", kw_only=True)  # the method of fixed steps
    _max_evaluations: int = field(default=0, kw_only=True)  # 0: no limit
    _event_data: tuple[Array, Array, Array] | None = field(default=None, kw_only=True)
    _stopped: Array | None = field(default=None, kw_only=True)  # 1 + index of the event, or 0
    _limit: Array | None = field(default=None, kw_only=True)

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        return self._times

    @cached_property
    def status(self) -> Array:
        """Return the status of each instance as text, (batch,), such as "ok" or "singular"."""
        return np.asarray(_ENDS[self._codes])

    @cached_property
    def events(self) -> dict[str, BatchEventLog]:
        """Return the occurrences of each event of the scene as a dict from name to `BatchEventLog`.

        A log has the times t (m,), s, the states q, qd (m, nq) and the indices of the instances
        (m,).
        """
        if self._event_data is None:
            return ByName("events", (), ())
        nq, (instances, which, rows) = self._model.nq, self._event_data
        logs = []
        for k in range(len(self._model.events)):
            own = which == k
            t, q, qd = np.split(rows[own], [1, 1 + nq], axis=1)
            logs.append(BatchEventLog(t[:, 0], q, qd, instances[own], len(self)))
        return ByName("events", self._model.events, logs)

    def _states(self, times: Array) -> Array:
        model: Any = self._model
        p, limits = self._params, (float(self._times[-1]), self.tol, self._h_most)
        inputs = self._row_inputs if self._u is None else self._u
        work = _Work(
            model, self._begin.copy(), self.t0, times.astype(model.dtype), limits,
            (inputs, self._period), p, self._stiff, self._by,
        )  # fmt: skip
        work.leave(initial_failures(self))
        if self._max_evaluations:  # without those of states between steps
            each = _EVALUATIONS_PER_STATE + 2 * model.nq + 1
            work.limit(self._max_evaluations + each * (len(times) + len(self.t)))
        if len(times) and not work.run(None, None):
            raise KeyboardInterrupt
        work.rows[:, self._late(times)] = np.nan
        return work.rows

    def _late(self, times: Array) -> Array:
        """True at times after the end of instances with status "too long", (batch, n)."""
        ended = np.where(self._codes == STATUS.index("too long"), self.reached, np.inf)
        return np.asarray(times > ended[:, None])

    @property
    def stopped(self) -> Array:
        """Return the name of the event that ended each instance, (batch,); "" if none did."""
        codes = np.zeros(len(self), int) if self._stopped is None else self._stopped
        return np.asarray(np.array(["", *self._model.events])[codes])

    @property
    def limit(self) -> Array:
        """Return the time at which the events of each instance accumulate, (batch,), s.

        Events accumulate if they follow one another ever sooner (Zeno behaviour); the status of
        such an instance is "accumulated". The time is nan for all other instances.
        """
        return np.full(len(self), np.nan) if self._limit is None else self._limit

    @property
    def message(self) -> str:
        """Return a sentence with the numbers of instances, of steps and of instances by status."""
        names, counts = np.unique(self.status, return_counts=True)
        statuses = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        step_count = int(self.steps.sum())
        names, counts = np.unique(self.stopped, return_counts=True)
        ends = zip(counts, names, strict=True)
        stops = "".join(f", {c} stopped by '{n}'" for c, n in ends if n)
        how = f" of {self.h:g} s" if self._by else f", tolerance {self.tol:g}"
        return f"{len(self)} instances, {step_count} steps{how}: {statuses}{stops}"

    def _end(self, k: int) -> float:
        return float(self.reached[k])

    def _why(self, k: int) -> str:
        status, event = str(_ENDS[self._codes[k]]), self.stopped[k]
        if status == "not finite" and event:
            return f"event '{event}' jumps to no finite state"
        if status == "accumulated":
            return f"jumps follow one another ever sooner, up to t = {self.limit[k]:.15g} s"
        return failure_message(self._model, status, self._by)

    def _all(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(BatchRun))

    def _to_arrays(self) -> dict[str, Any]:
        arrays = super()._to_arrays() | {name: getattr(self, name) for name in _NAMES}
        if self._event_data is not None:
            arrays |= zip(_EVENT_FIELDS, self._event_data, strict=True)
            arrays |= {"stopped": self._stopped, "limit": self._limit}
        return arrays

    @classmethod
    def _from_arrays(cls, model: Any, arrays: Mapping[str, Any]) -> AdaptiveBatchRun:
        fields_of_batch = BatchRun._from_arrays(model, arrays)._all()
        run = cls(*fields_of_batch, **{name: arrays[name] for name in _NAMES if name in arrays})
        if "which" in arrays:
            run._event_data = tuple(arrays[name] for name in _EVENT_FIELDS)
            run._stopped, run._limit = arrays["stopped"], arrays["limit"]
        return run

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self.tol, self._times.tolist())


def simulate(
    model: Instances, q0: Start, qd0: Start, duration: float | None,
    params: Any, u: ArrayLike | None, threads: int | None, t0: float,
    progress: Callable[[int, int], None] | None, tol: float | None, times: ArrayLike | None,
    h_most: float | None, stiff: bool, control_period: float | None, fixed: tuple[Any, ...],
    max_evaluations: int | None,
) -> tuple[AdaptiveBatchRun, bool]:  # fmt: skip
    """Check the arguments of `BatchModel.simulate_batch` and simulate with adaptive steps.

    Parameters
    ----------
    fixed : tuple
        The values that the caller gave for the arguments in `FIXED_STEP_DEFAULTS`, which only fixed
        steps use. Each must have its default value.

    The other arguments are those of `simulate_batch`.

    Returns
    -------
    run : AdaptiveBatchRun
    completed : bool
        False if Ctrl-C interrupted the run.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    tol, most = as_limits(model, tol, h_most, stiff, fixed)
    limit = 0
    if max_evaluations is not None:
        limit = min(as_count(max_evaluations, "max_evaluations", 1), MAX_EVALUATIONS)
    t0 = as_number(t0, "t0")
    length = duration
    if times is None:
        end = as_end(model, t0, duration)
        times, duration = [t0, end] if end > t0 else [t0], None
    rows = as_times(times, t0, model.dtype, duration)
    period = 0.0
    if control_period is not None:
        period = as_step_size(control_period, model.dtype, "control_period")
    span = float(rows[-1]) - t0
    check_time(model.dtype, t0, span)
    if period and length is not None:
        u = cut_table(u, model.nu, count_periods(length, period), count_periods(span, period), 1)
    return _run(
        model,
        q0,
        qd0,
        params,
        u,
        threads,
        t0,
        progress,
        tol,
        rows,
        most,
        stiff,
        period,
        span,
        limit=limit,
    )


def stepped(
    model: Instances, q0: Start, qd0: Start, h: float | None,
    duration: float | None, steps: int | None, every: int, params: Any, u: ArrayLike | None,
    threads: int | None, method: str | None, t0: float,
    progress: Callable[[int, int], None] | None, times: ArrayLike | None,
    control_period: float | None,
) -> tuple[AdaptiveBatchRun, bool]:  # fmt: skip
    """Check the arguments of `BatchModel.simulate_batch`; simulate with fixed steps and events.

    Return (run, completed); completed is False if Ctrl-C interrupted the run. The arguments are
    those of `simulate_batch`. Raises ValueError if an argument is invalid.
    """
    h = model.h if h is None else as_step_size(h, model.dtype)
    method, t0 = model._method(method), as_number(t0, "t0")
    rows, span = as_rows(model, times, t0, h, duration, steps, every, listed=True)
    period = as_hold(u, control_period, h) or 0.0
    if period and duration is not None:
        u = cut_table(u, model.nu, count_periods(duration, period), count_periods(span, period), 1)
    return _run(
        model, q0, qd0, params, u, threads, t0, progress, 0.0, rows, h, False, period, span, method
    )


def _run(
    model: Instances, q0: Start, qd0: Start, params: Any,
    u: ArrayLike | None, threads: int | None, t0: float,
    progress: Callable[[int, int], None] | None, tol: float, rows: Any, most: float,
    stiff: bool, period: float, span: float, method: str = "", limit: int = 0,
) -> tuple[AdaptiveBatchRun, bool]:  # fmt: skip
    """Simulate from checked arguments.

    period: control period of the rows of u, s; 0: none. span: duration, s. method: method of fixed
    steps of size `most`; "": adaptive steps. limit: maximum of evaluations of an instance; 0: none.
    """
    no_signals(model, u, period or None)
    count = count_periods(span, period) if period else None
    starts, table, inputs, codes = model._instances(q0, qd0, params, u, count, t0)
    q, qd = (model._array(x, name, model.nq) for x, name in zip(starts, ("q0", "qd0"), strict=True))
    begin = np.array([q, qd])
    limits, over = (float(rows[-1]), tol, most), inputs is not None and inputs.shape[1] > 1
    if method and span >= SOME * most and (method, most) not in model._warned:
        first = None if inputs is None else inputs[0, 0]
        model._look(q[0], qd[0], most, t0, first, table[0], method, "the first instance: ")
    work = _Work(model, begin.copy(), t0, rows, limits, (inputs, period), table, stiff, method)
    work.limit(limit)
    work.leave(codes)
    whole = work.run(threads, progress)
    counts = work.counts
    cut = len(STATUS) if work.full else STATUS.index("interrupted")
    codes = np.where((work.status == 0) & work.open, cut, work.status).astype("i")
    row_inputs = None if inputs is None else inputs.copy()
    if inputs is not None and over:
        row_inputs = sample_zero_order_hold(rows, t0, period, inputs)
    h, evaluations = span / max(1.0, float(counts["steps"].mean())), counts["evaluations"]
    if method:
        h, evaluations = most, model._called(method, counts["steps"], evaluations)
    batch = AdaptiveBatchRun(
        model, t0, work.rows[0], work.rows[1], h, counts["steps"], codes, 1, 0, table.copy(),
        row_inputs, method or "gauss16", inputs.copy() if inputs is not None and over else None,
        tol=tol, evaluations=evaluations, rejected=counts["rejected"],
        stiff_steps=counts["stiff_steps"],
        reached=work.t, _times=rows, _begin=begin, _h_most=most, _stiff=bool(stiff),
        _period=period, _by=method, _max_evaluations=limit,
    )  # fmt: skip
    if work.events:
        batch._event_data = work.events.all()
        batch._stopped = work.counts["stopped"]
        at_limit = codes == STATUS.index("accumulated")
        batch._limit = np.where(at_limit, work.counts["limit"], np.nan)
    return batch, whole


def no_signals(model: Instances, u: Any, control_period: Any) -> None:
    """Raise ValueError if a batch has a control period, but no inputs u, for a scene with inputs.

    The scene's signals (formulas for the inputs) would then be the inputs. A batch cannot hold
    signals constant over control periods.
    """
    if u is None and control_period is not None and model.nu:
        raise ValueError("control_period: a batch follows the signals: give u, a row a period")


class _Work:
    """State of a simulation: times, states, workspaces and rows of all instances."""

    def __init__(
        self, model: Instances, begin: Array, t0: float, times: Array,
        limits: tuple[float, float, float], inputs: tuple[Array | None, float], table: Array,
        stiff: bool, method: str,
    ) -> None:  # fmt: skip
        """Initialise the simulation at t0.

        begin: initial [q, qd], (2, batch, nq). times: times of the rows, (n,). limits: end time,
        tolerance and longest step. inputs: inputs of the control periods, (batch or 1, periods or
        1, nu), or None for the signals, and the period. table: parameters, (batch or 1, np).
        method: name of the method of fixed steps; "": adaptive steps.
        """
        self.model, (self.q, self.qd), self.times = model, begin, times
        (self.inputs, self.period), self.table, self.limits = inputs, table, limits
        (count, _), n = self.q.shape, len(times)
        self.t0, self.t = t0, np.full(count, t0, model.dtype)
        self.rows = np.empty((2, count, n, model.nq), model.dtype)
        self.kept, self.status = np.zeros(count, "l"), np.zeros(count, "i")
        self.memory = model._ffi.new("adaptive_memory[]", count)
        for memory in self.memory if stiff else ():
            memory.stiff = 1
        if method:
            model._lib.adaptive_fixed(count, self.memory, 1 + model.methods.index(method))
        self.open, self.stop, self.ended = np.ones(count, bool), False, 0
        self.events = BatchEventBuffer(model, room_for(model) - count * n) if model.events else None
        if times[0] == t0:
            self.kept[:] = 1
            self.rows[:, :, 0] = begin

    def limit(self, evaluations: int) -> None:
        """Set the number of evaluations after which an instance begins no further step; 0: none."""
        for memory in self.memory if evaluations else ():
            memory.max_evaluations = evaluations

    def leave(self, codes: Array | None) -> None:
        """Set the status number of each instance before the simulation begins.

        codes: status numbers (batch,); None: leave them unchanged. Instances whose number is not 0
        make no step, since their initial state is already known to fail.
        """
        if codes is not None:
            self.status[:] = codes

    @property
    def counts(self) -> dict[str, Array]:
        """Return the counters of the simulation, such as "steps", for each instance.

        The result is a dict from the counter's name to an array (batch,). The names are those of
        the members of the C struct `adaptive_memory`.
        """
        ffi, memory = self.model._ffi, "adaptive_memory"
        kinds = dict.fromkeys(_COUNTERS, "l")
        if self.events:
            kinds |= {"stopped": "i", "limit": self.model.dtype.char}
        layout: Any = {
            "names": list(kinds), "formats": list(kinds.values()), "itemsize": ffi.sizeof(memory),
            "offsets": [ffi.offsetof(memory, name) for name in kinds],
        }  # fmt: skip
        counters: Any = np.frombuffer(ffi.buffer(self.memory), np.dtype(layout))
        return {name: counters[name].copy() for name in kinds}

    @property
    def full(self) -> bool:
        """Return True if there is no memory for more events."""
        return self.events is not None and self.events.full

    def run(self, threads: int | None, progress: Callable[[int, int], None] | None) -> bool:
        """Simulate all instances to their end; return False if Ctrl-C interrupted the run.

        threads: number of threads; None: one for each processor. progress: called with the number
        of instances that are finished and the number of all instances.
        """
        count = len(self.q)
        group = _GROUP_SIZE if count > 8 * _GROUP_SIZE else _SMALL_GROUP_SIZE
        groups = [(at, min(group, count - at)) for at in range(0, count, group)]
        whole = run_groups(
            self, groups, as_threads(threads), lambda: progress and progress(self.ended, count)
        )
        self.rows[:, np.arange(len(self.times)) >= self.kept[:, None]] = np.nan
        return whole

    def _group(self, at: int, count: int, look: Callable[[], object] = lambda: None) -> None:
        """Simulate instances at, ..., at + count - 1 to the end, one control period at a time."""
        model, inputs = self.model, self.inputs
        u, periods, each = model._c[2], 1, 0
        if inputs is not None:
            many, periods, _ = inputs.shape
            u, each = model._pointer(inputs), periods * model.nu if many > 1 else 0
            u += at * each
        for k in range(periods):
            end = self.limits[0]
            if k + 1 < periods:
                end = period_end(k, self.t0, self.period, model.dtype)
            if self._advance(at, count, end, u + k * model.nu if k else u, each, look):
                return  # interrupted
        self.open[at : at + count] = False
        self.ended += count  # for the progress bar only: not synchronised between threads
        look()

    def _advance(
        self, at: int, count: int, t_end: float, u: Any, u_instance: int,
        look: Callable[[], object],
    ) -> bool:  # fmt: skip
        """Simulate these instances to t_end in chunks of steps; return True if interrupted."""
        end = at + count
        model, pointer = self.model, self.model._pointer
        n, many = len(self.times), _FIRST_CHUNK_STEPS
        p_each = len(self.table) > 1
        address, (long, integer) = model._c[0], model._whole
        events = self.events.room(count) if self.events else None
        more = True
        while more and not self.stop and not self.full:
            call_start = perf_counter()
            more = model._lib.adaptive_batch(
                count, pointer(self.q[at:end]), pointer(self.qd[at:end]), pointer(self.t[at:end]),
                t_end, *self.limits[1:], u, u_instance, many, pointer(self.times), n,
                pointer(self.rows[0, at:end]), pointer(self.rows[1, at:end]),
                *(events.given if events else ()),
                pointer(self.table[at:end] if p_each else self.table), int(p_each),
                self.memory + at, address(long, self.kept[at:end]),
                address(integer, self.status[at:end]),
            )  # fmt: skip
            if self.events and events:
                self.events.keep(events, at)
            many = min(next_chunk(many, perf_counter() - call_start), 2**40)
            look()
        return bool(more)
