"""Integration of single runs: one request in, one trajectory out; the loops are in C.

The C function makes fixed steps by any method, adaptive steps (Gauss and Legendre's method with
eight stages, order 16), and steps between which events are detected.
"""

from __future__ import annotations

from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from numpy import empty, ndarray

from .arguments import Array, machine_memory
from .columns import EventBuffer
from .info import next_chunk
from .interfaces import CompiledModel
from .requests import (
    FIRST_CALL_NUMBERS,
    MIN_CHECKED_STEPS,
    InputSchedule,
    Progress,
    Request,
    StepChoice,
    as_end,
    named_initial_state,
    split_times,
    table_of_steps,
    whole_steps,
)
from .status import FULL, PART, STATUS
from .trajectory import Trajectory

MIN_CHECKED_NUMBERS = 2**24  # positions; larger runs are checked against the memory
FIRST_CALL_STEPS = 48  # steps of various sizes in the first call of C
_FIRST_CALL_NUMBERS = 2048  # limit of such steps times coordinates
MAX_STEPS_PER_CALL = 2**20
_DOUBLE = np.dtype(float)

Rows = tuple[Array, Array]  # q and qd, (n, nq) each


def integrate(
    model: CompiledModel, request: Request, progress: Progress = None, out: Rows | None = None
) -> Trajectory:
    """Make a run from checked arguments and return it, whatever its status.

    progress: function that is called with (completed steps, all steps), or with (simulated
    thousandths of the run, 1000) if the number of steps is unknown. out: arrays for the rows of
    steps of equal size.
    """
    is_plain = model.integrator.has_short_runs and request.max_steps == inf
    if progress is None and out is None and is_plain and not (request.max_step or request.stiff):
        values = request.q, request.qd, request.u, request.p
        choice = StepChoice.from_request(request)
        run = run_at_once(model, choice, request.t0, request.times, values)
        if run is not None:
            run.request = request
            return run
    work = _LongRun(model, request, progress, out)
    try:
        status = work.advance()
    except KeyboardInterrupt:
        status = "interrupted"
    return work.trajectory(status)


def new_options(model: CompiledModel, request: Request) -> Any:
    """Return a C struct with the options of a run or a batch, without its rows and their times."""
    info, options = model.info, model.c.ffi.new("run_options *")
    options.h, options.t0, options.every = request.h, request.t0, request.every
    options.steps = request.steps
    if len(info.methods) > 1 and request.h:
        options.method = info.methods.index(request.method)
    if info.tolerance is not None:
        options.tol, options.max_step, options.stiff = request.tol, request.max_step, request.stiff
    if info.tolerance is not None or info.events:
        options.t_end, options.max_evaluations = request.t_end, request.max_evaluations
    if info.events:
        options.ignores_events = not (request.detects_events or request.tol)
    return options


def run_at_once(
    model: CompiledModel, choice: StepChoice, t0: float, times: Any, values: tuple[Any, ...]
) -> Trajectory | None:  # fmt: skip
    """Make a run by a single call of C, which also checks that all numbers are finite.

    t0, times, values: arguments of `simulate`, the last (q0, qd0, u, params). Return None if one of
    them needs further checks, or if the run may be long or does not reach its end.
    """
    own_t0, own_end, h, steps, every, _, method, tol = choice[:8]
    integrator, info, (address, real, null) = model.integrator, model.info, model.c.tools
    most, number, stages = integrator.short_methods[method]
    (q, qd, u, params), dtype, at_times = values, info.dtype, null
    at_t, counts, at_u, room = null, null, null, integrator.room
    u_step, u_shape, p, at_p = 0, (), info.p0, model.arguments.default_pointers[2]
    if t0 and not (abs(t0) <= 1e6 * h if h else times is None and abs(t0) < inf):
        return None  # the resolution of time has to be checked
    if t0 != own_t0 and not h and dtype is not _DOUBLE:
        return None  # the end is rounded
    if times is not None:
        if (grid := _short_times(model, choice, t0, times)) is None:
            return None
        t_end, steps, times = grid
        count = rows = len(times)
        at_times = (times if times.dtype is dtype else times.astype(dtype)).tobytes()
    elif h:
        count, rows, t_end = 1 - -steps // every, 1 + steps // every, t0 + steps * h
    else:
        count = rows = room
        t_end = own_end if t0 == own_t0 else as_end(info, t0, own_end - own_t0)
        times = empty(count, dtype)
        at_t = address(real, times)
    if count * info.nq > FIRST_CALL_NUMBERS or not (every <= most >= steps if h else room):
        return None
    if q is qd is None:
        numbers = integrator.start_bytes
    elif (numbers := _short_start(model, q, qd, params)) is None:
        return None
    if u is not None:
        if type(u) is not ndarray:
            if type(u) is not float and type(u) is not list:
                return None
            u = model.arguments.numbers((u,) if type(u) is float else u, "u")
        if u.dtype is not dtype:
            return None
        u_shape = u.shape
        if u_shape != integrator.input_shape:
            if not (h and steps and u_shape == (steps, info.nu)):
                return None
            u_step = info.nu
        at_u = u = u.tobytes()
    if params is not None and params is not p:
        if info.start_formulas and (q is None or qd is None):
            return None
        if type(params) is ndarray and params.dtype is dtype and params.shape == p.shape:
            p = params.copy()
        else:
            p = model.arguments.parameters(params)
            p = p if type(params) is dict else p.copy()
        at_p = address(real, p)
    if not stages or at_times:
        spare = integrator.spare_counts
        counts = spare.pop() if spare else model.c.ffi.new("long[3]")
    x = empty((2, count, info.nq), dtype)
    n_steps = model.c.lib.integrate_at_once(
        counts, number, t0, t_end, h, tol, steps if h else room - 1, every, numbers,
        at_times, rows, at_u, u_step, at_p, at_t, address(real, x),
    )  # fmt: skip
    if n_steps < 0:
        if tol:
            integrator.room = 0
        return None
    run = Trajectory.__new__(Trajectory)
    run.model, run.rows, run.steps, run.status = model, x, n_steps, "ok"
    if not counts:
        run.evaluations = stages * n_steps
    else:
        run.evaluations, run.times = counts[0], times
        if tol:
            run.end_time, run.rejected, run.stiff_steps = t_end, counts[1], counts[2]
            if at_t:
                n = n_steps + 1
                run.rows, run.times = x[:, :n], times[:n]
        spare.append(counts)
    row_times = None if at_t else times
    run.origin = choice, numbers, u, u_shape, p, (t0, t_end, steps, row_times)
    return run


def _short_times(
    model: CompiledModel, choice: StepChoice, t0: float, times: Any
) -> tuple[float, int, Array] | None:
    """Return the end time, s, the number of fixed steps and a copy of requested times.

    Return None if they need further checks. C checks that they ascend. choice: the steps, with
    these times, or for any times up to its end.
    """
    _, own_end, h, _, _, own_times, method, _ = choice[:8]
    if not (type(times) is ndarray and times.dtype is (_DOUBLE if h else model.info.dtype)):
        return None
    if times.ndim != 1 or not len(times) or not t0 < (end := times.item(-1)) < inf:
        return None
    span, is_checked, integrator = end - t0, times is own_times, model.integrator
    if span > own_end and not is_checked:
        return None
    if not h:
        return (max(end, own_end) if is_checked else end), 0, times.copy()
    if span > h * integrator.short_methods[method][0]:
        return None
    steps = whole_steps(span, h)
    if steps >= MIN_CHECKED_STEPS and not is_checked and (method, h) not in integrator.warned:
        return None
    return t0 + steps * h, steps, times.copy()


def _short_start(model: CompiledModel, q: Any, qd: Any, params: Any) -> Any:
    """Return the bytes of an initial state, of which a half may be None.

    Return None if it is not in the form for C.
    """
    dtype, (own_q, own_qd) = model.info.dtype, model.info.initial_state
    if type(q) is dict or type(qd) is dict:
        q, qd = named_initial_state(model, q, qd, params)
    q, qd = own_q if q is None else q, own_qd if qd is None else qd
    if type(q) is list:
        q = model.arguments.initial_half(q, "q0")
    if type(qd) is list:
        qd = model.arguments.initial_half(qd, "qd0")
    is_plain = type(q) is type(qd) is ndarray and q.dtype is qd.dtype is dtype
    if not is_plain or not q.shape == qd.shape == own_q.shape:
        return None
    return q.tobytes() + qd.tobytes()


class _LongRun:
    """A run in progress, in chunks of steps between checks of Ctrl-C."""

    def __init__(
        self, model: CompiledModel, request: Request, progress: Progress, out: Rows | None
    ) -> None:
        self.model, self.request, self.progress = model, request, progress
        self.is_equal, pointer = request.has_equal_steps, model.c.pointer
        self.options, self.work = new_options(model, request), model.c.ffi.new("run_work *")
        self.output = model.c.ffi.addressof(self.work, "output")
        self.start, self.at_p = (pointer(request.q), pointer(request.qd)), pointer(request.p)
        self.events = EventBuffer(model) if model.info.events and not self.is_equal else None
        self.schedule, self.u, self.u_step = None, request.u, 0
        if callable(request.u) or (request.period and not self.is_equal):
            self.schedule, self.u = InputSchedule(model, request), None
        elif self.u is not None and self.u.ndim == 2:
            self.u, self.u_step = table_of_steps(request), model.info.nu
        self.rows = RowBuffer(model, request, out)

    @property
    def state(self) -> Array:
        """A copy of the state [q, qd] that the run has reached, (2, nq)."""
        if not self.rows.is_begun:
            return np.array([self.request.q, self.request.qd])
        x = np.frombuffer(self.model.c.ffi.buffer(self.work.x), self.model.info.dtype)
        return x.copy().reshape(2, -1)

    @property
    def time(self) -> float:
        """The time that the run has reached, s."""
        if self.is_equal or not self.rows.is_begun:
            return self.request.t0 + self.request.h * int(self.output.steps)
        return float(self.output.t)

    @property
    def is_complete(self) -> bool:
        """Whether the run has reached its end."""
        request, output = self.request, self.output
        if not self.is_equal:
            is_stopped = bool(self.events and output.stopped) or self.time >= request.t_end
            return is_stopped or output.steps >= request.max_steps
        if request.times is None:
            return bool(output.steps >= request.steps)
        return bool(output.rows >= len(request.times))

    def advance(self) -> str:
        """Make all steps; return "ok", or the reason if the run stops before its end."""
        c, options, rows, chunk = self.model.c, self.options, self.rows, self._first_chunk()
        none = self.model.integrator.no_events
        while True:
            options.steps = limit = self._begin_call(chunk)
            if not limit and not self.is_equal:
                return FULL
            start_time = perf_counter()
            code = c.lib.integrate(
                options, self.output, self.work, *self.start, *rows.requested, c.pointer(self.u),
                self.u_step, self.at_p, *(self.events.room() if self.events else none),
                *rows.pointers,
            )  # fmt: skip
            rows.take(self.output, self.events)
            if code & 7:
                return STATUS[code & 7]
            is_complete = self.is_complete
            self._show_progress(is_complete)
            if is_complete:
                return "ok"
            if limit == chunk:
                chunk = next_chunk(chunk, perf_counter() - start_time)

    def _first_chunk(self) -> int:
        """Return the number of steps of the first call of C."""
        nq = self.model.info.nq
        if self.is_equal:  # a step of an implicit method may solve for all its stages
            return max(1, FIRST_CALL_NUMBERS // nq**3)
        room: int = self.model.integrator.room
        return max(FIRST_CALL_STEPS, min(room, _FIRST_CALL_NUMBERS // nq))

    def _begin_call(self, chunk: int) -> int:
        """Set the inputs of the next steps; return how many steps the next call of C may make."""
        request, schedule, completed = self.request, self.schedule, int(self.output.steps)
        if not self.is_equal:
            if schedule and (not schedule.count or self.time >= schedule.end):
                self._begin_period()
                self.options.t_end = schedule.end
            return self.rows.limit_steps(self.output, min(chunk, MAX_STEPS_PER_CALL))
        # rows between steps belong to the step that follows
        limit: int = request.steps - completed + (request.times is not None)
        if schedule and limit:
            if schedule.count <= completed // request.hold and completed < request.steps:
                self._begin_period()
            limit = min(limit, request.hold - completed % request.hold)
        if self.progress and request.times is not None:
            limit = min(limit, self._steps_to_row(completed))
        return min(limit, chunk)

    def _steps_to_row(self, completed: int) -> int:
        """Return the number of steps to the next requested time after those completed."""
        request = self.request
        assert request.times is not None
        left = request.times[self.output.rows :]
        whole = split_times(left, request.t0, request.h, request.steps)[0]
        return int(min(whole[whole > completed], default=completed + 1)) - completed

    def _begin_period(self) -> None:
        """Set the inputs of the control period that begins."""
        assert self.schedule
        self.schedule.next(self.time, *self.state)
        self.u = self.schedule.current

    def _show_progress(self, is_complete: bool) -> None:
        """Call the function for progress bars."""
        request, completed = self.request, int(self.output.steps)
        if self.progress is None:
            return
        if not self.is_equal:
            share = 1.0
            if not is_complete:
                share = (self.time - request.t0) / (request.t_end - request.t0)
            self.progress(round(1000 * share), 1000)
        elif completed:
            self.progress(completed, request.steps)

    def trajectory(self, status: str) -> Trajectory:
        """Return the run with this status."""
        model, request, output, info = self.model, self.request, self.output, self.model.info
        steps, evaluations = int(output.steps), int(output.evaluations)
        if self.events and not request.tol:
            evaluations = info.count_evaluations(request.method, steps, evaluations)
        times, rows = self.rows.concatenate(steps)
        if times is not None and self._lacks_last_row(times, status):
            times = np.append(times, self.time)
            rows = np.append(rows, self.state[:, None], axis=1)
        run = Trajectory(model, request, rows, steps, status, evaluations)
        run.times = times
        if self.schedule:
            run.period_inputs = self.schedule.values
        if info.constraints.names and output.singular:
            run.singular_steps, run.first_singular = output.singular, output.first
        if self.is_equal:
            return run
        run.end_time = self.time
        if info.tolerance is not None:
            run.rejected, run.stiff_steps = output.rejected, output.stiff_steps
        if self.events:
            run.event_data = self.events.all()
            run.stopped = info.events[output.stopped - 1] if output.stopped else ""
            run.limit = output.limit if status == "accumulated" else run.limit
        is_unusual = info.events or info.constraints.names or info.nq * steps > _FIRST_CALL_NUMBERS
        model.integrator.room = 0 if is_unusual else steps + FIRST_CALL_STEPS
        return run

    def _lacks_last_row(self, times: Array, status: str) -> bool:
        """Return True if the last valid state needs a row besides those at given times."""
        if self.is_equal:
            return status != "ok" and (not len(times) or times[-1] < self.time)
        # an event stopped the run between two rows
        has_every = self.request.times is None and self.rows.times is not None
        return bool(has_every and self.time > times[-1])


class RowBuffer:
    """Memory that C fills with the rows (t, q, qd) of a run.

    The number of rows after steps of various sizes is not known in advance. Several arrays
    ("pieces") are then allocated one after the other. Their rows, and events, have to fit in a part
    of the machine's memory.

    Attributes
    ----------
    times : (n,) array or None
        Times of the rows, s; None for rows after steps.
    requested : tuple
        Arguments of C: pointer to the times, and largest number of rows.
    pointers : tuple
        Arguments of C: pointers to t, q and qd of the rows.
    is_begun : bool
        Whether C has made a call.
    """

    def __init__(self, model: CompiledModel, request: Request, out: Rows | None) -> None:
        self.model, self.request, self.is_begun = model, request, False
        self.times = request.times if request.has_equal_steps else requested_times(model, request)
        self.stored, self.most = 0, room_for(model)  # rows and events
        self.rows_per_step = 1 if request.has_equal_steps or not model.info.events else 2  # jumps
        self.pieces: list[tuple[Array | None, Any]] = []
        self.filled = self.size = 0
        if self.times is not None:
            self._piece(len(self.times), None)
        elif request.has_equal_steps:
            self._piece(1 - -request.steps // request.every, out)

    def _piece(self, count: int, out: Rows | None) -> None:
        """Allocate a new piece for `count` rows, or take the caller's arrays."""
        model, pointer, request = self.model, self.model.c.pointer, self.request
        self.filled, self.size, most, self.t = 0, count, count, None
        if self.times is None and request.has_equal_steps:
            self.rows = _equal_rows(model, count, out)
            most = 1 + request.steps // request.every  # besides that of the end
        else:
            self.rows = _varying_rows(model, count)
            self.t = empty(count, model.info.dtype) if self.times is None else None
        self.at_times = None if self.times is None else np.asarray(self.times, model.info.dtype)
        self.requested = pointer(self.at_times), most
        self.pointers = pointer(self.t), pointer(self.rows[0]), pointer(self.rows[1])

    def take(self, output: Any, events: EventBuffer | None) -> None:
        """Count the rows of the last call of C, and copy its events."""
        self.is_begun = True
        self.stored += output.rows - self.filled
        self.filled = output.rows
        if events:
            self.stored += output.events
            events.keep(output)

    def limit_steps(self, output: Any, steps: int) -> int:
        """Return how many steps of various sizes the next call of C may make.

        Their rows fit in memory; without requested times a new piece is allocated if the last one
        has no room for another step. steps: upper limit of the result.
        """
        each, first = self.rows_per_step, not self.is_begun
        steps = int(min(steps, max(0.0, self.most - self.stored) // each))
        if self.times is not None or not steps:
            return steps
        if self.size - self.filled < each + first:
            if self.size:
                self.pieces.append((self.t, self.rows[:, : self.filled]))
            self._piece(1 + each * steps, None)
            output.rows = 0
        return min(steps, (self.size - self.filled - first) // each)

    def concatenate(self, steps: int) -> tuple[Array | None, Any]:
        """Return the times (n,), s, or None for equal steps, and the states [q, qd] of all rows.

        steps: number of completed steps.
        """
        if self.request.has_equal_steps and self.times is None:
            count = 1 - -steps // self.request.every
            if not self.is_begun:
                self.rows[0][0], self.rows[1][0] = self.request.q, self.request.qd
            if count == self.size:
                return None, self.rows
            return None, (self.rows[0][:count], self.rows[1][:count])
        times = self.t if self.times is None else self.times
        if times is None:  # not even the start
            return empty(0, self.model.info.dtype), empty((2, 0, self.model.info.nq))
        pieces = [*self.pieces, (times, self.rows[:, : self.filled])]
        if len(pieces) == 1:
            return times[: self.filled], pieces[0][1]
        t, rows = zip(*((t[: x.shape[1]], x) for t, x in pieces if t is not None), strict=True)
        return np.concatenate(t), np.concatenate(rows, axis=1)


def requested_times(model: CompiledModel, request: Request) -> Array | None:
    """Return the times of the rows, s; None for a row after each step of various sizes."""
    t0, h, steps, every = request.t0, request.h, request.steps, request.every
    if request.times is not None or every == 1 or not h:
        return request.times
    times = t0 + h * np.append(np.arange(0, steps, every), steps)
    return np.asarray(times, model.info.dtype)


def room_for(model: CompiledModel) -> float:
    """Return the largest number of rows and events, counted together, that a run may store.

    The number follows from the memory of the machine.
    """
    return PART * machine_memory() / _row_bytes(model)


def _row_bytes(model: CompiledModel) -> int:
    """Return the size of a row (t, q, qd) in bytes."""
    return (1 + 2 * model.info.nq) * model.info.dtype.itemsize


def _equal_rows(model: CompiledModel, rows: int, out: Rows | None) -> Any:
    """Return q and qd of all rows of steps of equal size: those of the caller, or new ones."""
    info = model.info
    try:
        if out is not None:
            return model.arguments.output_pair(out, (rows, info.nq))
        if rows * info.nq > MIN_CHECKED_NUMBERS and info.row_bytes(rows) > machine_memory():
            raise MemoryError
        return empty((2, rows, info.nq), info.dtype)
    except MemoryError:
        raise MemoryError(
            f"{rows} rows of {2 * info.nq} numbers don't fit in memory: keep fewer with every="
        ) from None


def _varying_rows(model: CompiledModel, rows: int) -> Array:
    """Return memory for q and qd of rows at given times, or after steps of various sizes."""
    nq, dtype = model.info.nq, model.info.dtype
    try:
        if rows * _row_bytes(model) > machine_memory():
            raise MemoryError
        return empty((2, rows, nq), dtype)
    except MemoryError:
        raise MemoryError(
            f"{rows} rows of {1 + 2 * nq} numbers don't fit in memory: give fewer times="
        ) from None
