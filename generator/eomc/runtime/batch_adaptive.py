"""Simulation of many instances with adaptive step-size control for each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .adaptive import failure_message, room_for
from .arguments import (
    Array,
    ByName,
    as_count,
    as_number,
    as_step_size,
    check_time,
    cut_table,
)
from .batch_trajectory import BatchRun, initial_failures
from .batch_work import Instances, as_threads, run_groups
from .c_library import next_chunk
from .events import BatchEventBuffer, BatchEventLog
from .inputs import count_periods, period_end, sample_zero_order_hold
from .interfaces import CompiledBatchModel
from .requests import SimulationArguments, as_end, as_times
from .stability import MIN_STEPS
from .status import FULL, STATUS

# instances that a thread simulates at once, of many and of few
_GROUP_SIZE, _SMALL_GROUP_SIZE = 128, 16
_COUNTERS = ("steps", "evaluations", "rejected", "stiff_steps")
MAX_EVALUATIONS = 2**31 - 1  # of an instance; fits in long on every machine
_EVALUATIONS_PER_STATE = 8 * 64  # for a state between two steps: stages times iterations, at most
_FIRST_CHUNK_STEPS = 64  # steps of an instance before the first check of Ctrl-C
_SAVED_FIELDS = {  # fields by the names that they have in files
    "tol": "tol", "evaluations": "evaluations", "rejected": "rejected",
    "stiff_steps": "stiff_steps", "reached": "reached", "_times": "_times",
    "_begin": "initial_state", "_h_most": "max_step", "_stiff": "stiff", "_period": "_period",
    "_by": "fixed_method", "_max_evaluations": "_max_evaluations",
}  # fmt: skip
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
    initial_state: Array = field(kw_only=True)  # q and qd at t0, (2, batch, nq)
    max_step: float = field(kw_only=True)
    stiff: bool = field(kw_only=True)
    _period: float = field(default=0.0, kw_only=True)  # control period, s; 0 without one
    fixed_method: str = field(default="", kw_only=True)  # the method of fixed steps
    _max_evaluations: int = field(default=0, kw_only=True)  # 0: no limit
    event_data: tuple[Array, Array, Array] | None = field(default=None, kw_only=True)
    _stopped: Array | None = field(default=None, kw_only=True)  # 1 + index of the event, or 0
    _limit: Array | None = field(default=None, kw_only=True)

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        return self._times

    @cached_property
    def status(self) -> Array:
        """Return the status of each instance as text, (batch,), such as "ok" or "singular"."""
        return np.asarray(_ENDS[self.status_codes])

    @cached_property
    def events(self) -> dict[str, BatchEventLog]:
        """Return the occurrences of each event of the scene as a dict from name to `BatchEventLog`.

        A log has the times t (m,), s, the states q, qd (m, nq) and the indices of the instances
        (m,).
        """
        if self.event_data is None:
            return ByName("events", (), ())
        nq, (instances, which, rows) = self.model.info.nq, self.event_data
        logs = []
        for k in range(len(self.model.info.events)):
            own = which == k
            t, q, qd = np.split(rows[own], [1, 1 + nq], axis=1)
            logs.append(BatchEventLog(t[:, 0], q, qd, instances[own], len(self)))
        return ByName("events", self.model.info.events, logs)

    def _states(self, times: Array) -> Array:
        inputs = self.row_inputs if self.input_source is None else self.input_source
        limit = self._max_evaluations
        if limit:  # without those of states between steps
            each = _EVALUATIONS_PER_STATE + 2 * self.model.info.nq + 1
            limit += each * (len(times) + len(self.t))
        # the end may be later than the last of the times
        plan = _Plan(
            self.t0, self.tol, times.astype(self.model.info.dtype), self.max_step, self.stiff,
            self._period, self.fixed_method, limit,
        )  # fmt: skip
        instances = Instances(None, self.parameter_values, inputs, initial_failures(self))
        work = _Work(self.model, self.initial_state.copy(), plan, instances)
        work.limits = float(self._times[-1]), self.tol, self.max_step
        if len(times) and not work.run(None, None):
            raise KeyboardInterrupt
        work.rows[:, self._late(times)] = np.nan
        return work.rows

    def _late(self, times: Array) -> Array:
        """True at times after the end of instances with status "too long", (batch, n)."""
        ended = np.where(self.status_codes == STATUS.index("too long"), self.reached, np.inf)
        return np.asarray(times > ended[:, None])

    @property
    def stopped(self) -> Array:
        """Return the name of the event that ended each instance, (batch,); "" if none did."""
        codes = np.zeros(len(self), int) if self._stopped is None else self._stopped
        return np.asarray(np.array(["", *self.model.info.events])[codes])

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
        how = f" of {self.h:g} s" if self.fixed_method else f", tolerance {self.tol:g}"
        return f"{len(self)} instances, {step_count} steps{how}: {statuses}{stops}"

    def _end(self, k: int) -> float:
        return float(self.reached[k])

    def _why(self, k: int) -> str:
        status, event = str(_ENDS[self.status_codes[k]]), self.stopped[k]
        if status == "not finite" and event:
            return f"event '{event}' jumps to no finite state"
        if status == "accumulated":
            return f"jumps follow one another ever sooner, up to t = {self.limit[k]:.15g} s"
        return failure_message(self.model, status, self.fixed_method)

    def field_values(self) -> tuple[Any, ...]:
        """Return the values of the fields that the base class `BatchRun` has, in order."""
        return tuple(getattr(self, each.name) for each in fields(BatchRun))

    def to_arrays(self) -> dict[str, Any]:
        """Return the arrays and numbers that a file of the run contains, by name."""
        arrays = super().to_arrays() | {
            key: getattr(self, name) for key, name in _SAVED_FIELDS.items()
        }
        if self.event_data is not None:
            arrays |= zip(_EVENT_FIELDS, self.event_data, strict=True)
            arrays |= {"stopped": self._stopped, "limit": self._limit}
        return arrays

    @classmethod
    def from_arrays(cls, model: Any, arrays: Mapping[str, Any]) -> AdaptiveBatchRun:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        fields_of_batch = BatchRun.from_arrays(model, arrays).field_values()
        own = {name: arrays[key] for key, name in _SAVED_FIELDS.items() if key in arrays}
        run = cls(*fields_of_batch, **own)
        if "which" in arrays:
            run.event_data = tuple(arrays[name] for name in _EVENT_FIELDS)
            run._stopped, run._limit = arrays["stopped"], arrays["limit"]
        return run

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        return (*super().settings(), self.tol, self._times.tolist())


class _Plan(NamedTuple):
    """Checked arguments of a batch that are the same for all instances.

    t0: start time, s. tol: tolerance. times: times of the rows, s. max_step: longest adaptive step,
    s, or size of fixed steps. stiff: whether to begin with Newton's method. period: control period
    of the inputs, s; 0: none. method: method of fixed steps; "": adaptive steps. max_evaluations:
    maximum of evaluations of an instance; 0: none.
    """

    t0: float
    tol: float
    times: Array
    max_step: float
    stiff: bool
    period: float
    method: str = ""
    max_evaluations: int = 0

    @property
    def duration(self) -> float:
        """Time from the start to the last row, s."""
        return float(self.times[-1]) - self.t0


def simulate(
    model: CompiledBatchModel, options: SimulationArguments
) -> tuple[AdaptiveBatchRun, bool]:
    """Check the arguments of `Batch.simulate_batch` and simulate with adaptive steps.

    Return the batch, and False if Ctrl-C interrupted it, else True. Raises ValueError if an
    argument is invalid.
    """
    info = model.info
    tol, most = options.adaptive_limits(info)
    limit = 0
    if options.max_evaluations is not None:
        limit = min(as_count(options.max_evaluations, "max_evaluations", 1), MAX_EVALUATIONS)
    t0, times, duration = as_number(options.t0, "t0"), options.times, options.duration
    if times is None:
        end = as_end(info, t0, duration)
        times, duration = [t0, end] if end > t0 else [t0], None
    rows = as_times(times, t0, info.dtype, duration)
    period = 0.0
    if options.control_period is not None:
        period = as_step_size(options.control_period, info.dtype, "control_period")
    check_time(info.dtype, t0, float(rows[-1]) - t0)
    return _run(model, options, _Plan(t0, tol, rows, most, options.stiff, period, "", limit))


def simulate_fixed_steps(
    model: CompiledBatchModel, options: SimulationArguments
) -> tuple[AdaptiveBatchRun, bool]:
    """Check the arguments of `Batch.simulate_batch`; simulate with fixed steps and events.

    Return the batch, and False if Ctrl-C interrupted it, else True. Raises ValueError if an
    argument is invalid.
    """
    info = model.info
    h = info.h if options.h is None else as_step_size(options.h, info.dtype)
    method, t0 = info.method_name(options.method), as_number(options.t0, "t0")
    rows, _ = options.event_rows(info, t0, h, listed=True)
    assert rows is not None
    period = options.input_period(h) or 0.0
    return _run(model, options, _Plan(t0, 0.0, rows, h, False, period, method))


def _run(
    model: CompiledBatchModel, options: SimulationArguments, plan: _Plan
) -> tuple[AdaptiveBatchRun, bool]:
    """Simulate from checked arguments."""
    u, span, method, h = options.u, plan.duration, plan.method, plan.max_step
    count = count_periods(span, plan.period) if plan.period else None
    if count is not None and options.duration is not None:
        u = cut_table(u, model.info.nu, count_periods(options.duration, plan.period), count, 1)
    no_signals(model, u, plan.period or None)
    instances = model.batch.instances(options, u, count, plan.t0)
    _, table, inputs, _ = instances
    q, qd = (
        model.arguments.array(x, name, model.info.nq)
        for x, name in zip(instances.starts, ("q0", "qd0"), strict=True)
    )
    begin, over = np.array([q, qd]), inputs is not None and inputs.shape[1] > 1
    instances = instances._replace(starts=(q, qd))
    if method and span >= MIN_STEPS * h and (method, h) not in model.integrator.warned:
        state = instances.first_state(plan.t0)
        model.integrator.check_step_size(state, h, method, "the first instance: ")
    work = _Work(model, begin.copy(), plan, instances)
    whole = work.run(options.threads, options.progress)
    counts = work.counts
    cut = len(STATUS) if work.full else STATUS.index("interrupted")
    codes = np.where((work.status == 0) & work.open, cut, work.status).astype("i")
    row_inputs = None if inputs is None else inputs.copy()
    if inputs is not None and over:
        row_inputs = sample_zero_order_hold(plan.times, plan.t0, plan.period, inputs)
    mean_step = span / max(1.0, float(counts["steps"].mean()))
    evaluations = counts["evaluations"]
    if method:
        mean_step = h
        evaluations = model.info.count_evaluations(method, counts["steps"], evaluations)
    batch = AdaptiveBatchRun(
        model, plan.t0, work.rows[0], work.rows[1], mean_step, counts["steps"], codes, 1, 0,
        table.copy(), row_inputs, method or "gauss16",
        inputs.copy() if inputs is not None and over else None,
        tol=plan.tol, evaluations=evaluations, rejected=counts["rejected"],
        stiff_steps=counts["stiff_steps"], reached=work.t, _times=plan.times, initial_state=begin,
        max_step=h, stiff=bool(plan.stiff), _period=plan.period, fixed_method=method,
        _max_evaluations=plan.max_evaluations,
    )  # fmt: skip
    if work.events:
        batch.event_data = work.events.all()
        batch._stopped = work.counts["stopped"]
        at_limit = codes == STATUS.index("accumulated")
        batch._limit = np.where(at_limit, work.counts["limit"], np.nan)
    return batch, whole


def no_signals(model: CompiledBatchModel, u: Any, control_period: Any) -> None:
    """Raise ValueError if a batch has a control period, but no inputs u, for a scene with inputs.

    The scene's signals (formulas for the inputs) would then be the inputs. A batch cannot hold
    signals constant over control periods.
    """
    if u is None and control_period is not None and model.info.nu:
        raise ValueError("control_period: a batch follows the signals: give u, a row a period")


class _Work:
    """State of a simulation: times, states, workspaces and rows of all instances."""

    def __init__(
        self, model: CompiledBatchModel, begin: Array, plan: _Plan, instances: Instances
    ) -> None:
        """Initialise the simulation.

        begin: initial [q, qd], (2, batch, nq), which are overwritten.
        """
        self.model, (self.q, self.qd), self.times = model, begin, plan.times
        self.inputs, self.table, self.period = instances.inputs, instances.parameters, plan.period
        # end time, tolerance and longest step
        self.limits = float(plan.times[-1]), plan.tol, plan.max_step
        (count, nq), n = self.q.shape, len(plan.times)
        self.t0, self.t = plan.t0, np.full(count, plan.t0, model.info.dtype)
        self.rows = np.empty((2, count, n, nq), model.info.dtype)
        self.kept, self.status = np.zeros(count, "l"), np.zeros(count, "i")
        if instances.codes is not None:  # the others make no step
            self.status[:] = instances.codes
        self.memory = model.c.ffi.new("adaptive_memory[]", count)
        for memory in self.memory if plan.stiff or plan.max_evaluations else ():
            memory.stiff, memory.max_evaluations = int(bool(plan.stiff)), plan.max_evaluations
        if plan.method:
            index = model.info.methods.index(plan.method)
            model.c.lib.adaptive_fixed(count, self.memory, 1 + index)
        self.open, self.stop, self.ended = np.ones(count, bool), False, 0
        self.events = None
        if model.info.events:
            self.events = BatchEventBuffer(model, room_for(model) - count * n)
        if plan.times[0] == plan.t0:
            self.kept[:] = 1
            self.rows[:, :, 0] = begin

    @property
    def counts(self) -> dict[str, Array]:
        """Return the counters of the simulation, such as "steps", for each instance.

        The result is a dict from the counter's name to an array (batch,). The names are those of
        the members of the C struct `adaptive_memory`.
        """
        ffi, memory = self.model.c.ffi, "adaptive_memory"
        kinds = dict.fromkeys(_COUNTERS, "l")
        if self.events:
            kinds |= {"stopped": "i", "limit": self.model.info.dtype.char}
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

    def run_group(self, at: int, count: int, look: Callable[[], object] = lambda: None) -> None:
        """Simulate instances at, ..., at + count - 1 to the end, one control period at a time."""
        model, inputs = self.model, self.inputs
        u, periods, each = model.c.tools[2], 1, 0
        if inputs is not None:
            many, periods, _ = inputs.shape
            u, each = model.c.pointer(inputs), periods * model.info.nu if many > 1 else 0
            u += at * each
        for k in range(periods):
            end = self.limits[0]
            if k + 1 < periods:
                end = period_end(k, self.t0, self.period, model.info.dtype)
            if self._advance(at, count, end, u + k * model.info.nu if k else u, each, look):
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
        model, pointer = self.model, self.model.c.pointer
        n, many = len(self.times), _FIRST_CHUNK_STEPS
        p_each = len(self.table) > 1
        address, (long, integer) = model.c.tools[0], model.batch.count_types
        events = self.events.room(count) if self.events else None
        more = True
        while more and not self.stop and not self.full:
            call_start = perf_counter()
            more = model.c.lib.adaptive_batch(
                count, pointer(self.q[at:end]), pointer(self.qd[at:end]), pointer(self.t[at:end]),
                t_end, *self.limits[1:], u, u_instance, many, pointer(self.times), n,
                pointer(self.rows[0, at:end]), pointer(self.rows[1, at:end]),
                *(events.c_arguments if events else ()),
                pointer(self.table[at:end] if p_each else self.table), int(p_each),
                self.memory + at, address(long, self.kept[at:end]),
                address(integer, self.status[at:end]),
            )  # fmt: skip
            if self.events and events:
                self.events.keep(events, at)
            many = min(next_chunk(many, perf_counter() - call_start), 2**40)
            look()
        return bool(more)
