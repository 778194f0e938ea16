"""Integration of batches: one request in, one batch of trajectories out; the loops are in C.

Groups of instances are simulated in threads, in chunks of steps between checks of Ctrl-C.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from time import perf_counter
from typing import Any

import numpy as np
from numpy import empty, ndarray

from .arguments import Array, as_count, machine_memory
from .batch_trajectory import COUNTERS, BatchTrajectory
from .events import BatchEventBuffer
from .info import next_chunk
from .integration import MIN_CHECKED_NUMBERS, new_options, room_for
from .interfaces import CompiledBatchModel
from .requests import FIRST_CALL_NUMBERS, Progress, Request, StepChoice, period_end, table_of_steps
from .status import STATUS, Interrupted

MIN_STEPS_FOR_THREADS = 20_000  # steps of all instances; fewer are faster in one thread
_GROUP_SIZE, SMALL_GROUP_SIZE = 128, 16  # instances of a group (a tile), of many and of few
_MAX_TILES_PER_GROUP = 64  # larger groups save calls
_GROUPS_PER_THREAD = 8  # so that all threads end at about the same time
FIRST_CHUNK_STEPS = 64  # steps of various sizes of an instance before the first check of Ctrl-C
_DEFAULT_STEP_SECONDS = 1.5e-6  # per instance and coordinate, until a step was timed
POLL_SECONDS = 0.05  # between checks of Ctrl-C and updates of the progress bar
FIRST_POLL_SECONDS = 0.02  # before the first check
_INTERRUPTED = STATUS.index("interrupted")


def integrate_batch(
    model: CompiledBatchModel, request: Request, codes: Array | None = None,
    threads: int | None = None, progress: Progress = None,
) -> BatchTrajectory:  # fmt: skip
    """Make a batch from checked arguments and return it, whatever its statuses.

    codes: status number of each instance before the first step, if some cannot start. threads:
    number of threads; None: one for each processor. progress: called with the numbers of completed
    and of all steps, summed over all instances, or with numbers of instances if those are unknown.
    Raises Interrupted on Ctrl-C, with the batch up to there.
    """
    is_plain = codes is None and progress is None and request.has_equal_steps
    if is_plain and request.hold == 1:
        start, choice = (request.q, request.qd), StepChoice.from_request(request)
        run = batch_at_once(model, choice, start, request.t0, request.u, request.p)
        if run is not None:
            return run
    times = request.times if request.has_equal_steps else _row_times(model, request)
    n = 1 - -request.steps // request.every if times is None else len(times)
    state, rows = _state_and_rows(model, len(request.q), n)
    work = BatchWork(model, request, state, rows, times, codes)
    work.copy_starts(threads)
    if times is None:
        request = request.replace(q=rows[0, :, 0], qd=rows[1, :, 0])
    else:
        request = request.replace(q=state[0].copy(), qd=state[1].copy())
    is_whole = work.run(threads, progress)
    runs = work.trajectory(request)
    if not is_whole:
        raise Interrupted(runs)
    return runs


def batch_at_once(
    model: CompiledBatchModel, choice: StepChoice, start: tuple[Any, Any], t0: float, u: Any,
    params: Any,
) -> BatchTrajectory | None:  # fmt: skip
    """Make few steps of equal size of few instances by a single call of C in this thread.

    start: (q0, qd0), t0, u, params: arguments of `simulate_batch`. C checks that all numbers are
    finite. Return None if there are many, if an array is not in the form for C, or if an
    instance does not reach its end.
    """
    _, _, h, steps, every, times, method, tol = choice[:8]
    if tol or times is not None or choice.detects_events:
        return None
    (q, qd), info, (address, real, null) = start, model.info, model.c.tools
    number = model.integrator.short_methods[method][1]
    dtype, n, at_u, u_instance, u_step = info.dtype, 1 - -steps // every, null, 0, 0
    if not (type(q) is type(qd) is ndarray and q.dtype is qd.dtype is dtype and q.ndim == 2):
        return None
    (count, nq), u_shape = q.shape, (1, 1, info.nu)
    size = count * (steps + n) * nq
    if qd.shape != q.shape or nq != info.nq or not 0 < size <= FIRST_CALL_NUMBERS:
        return None
    p, at_p, p_instance = info.p0, model.arguments.default_pointers[2], 0
    if params is not None:
        p = model.arguments.parameter_rows(params).copy()
        at_p, p_instance = address(real, p), int(len(p) > 1)
        if len(p) not in (1, count):
            return None
    if t0 and abs(t0) > 1e6 * h:
        return None
    if u is not None:
        if type(u) is not ndarray or u.dtype is not dtype:
            return None
        u_shape = u.shape if u.ndim == 3 else (count, 1, info.nu)
        if (u.ndim == 2 and u.shape != (count, info.nu)) or u.ndim < 2 or u_shape[2] != info.nu:
            return None
        if u_shape[0] not in (1, count) or u_shape[1] not in (1, steps) or not info.nu:
            return None
        u_step = info.nu if u_shape[1] > 1 else 0
        u_instance = u_shape[1] * info.nu if u_shape[0] > 1 else 0
        at_u = u = u.tobytes()
    numbers = q.tobytes() + qd.tobytes()
    rows, counts = empty((2, count, n, nq), dtype), empty((len(COUNTERS), count), "l")
    if model.c.lib.integrate_batch_at_once(
        number, count, numbers, t0, h, steps, every, at_u, u_instance, u_step, at_p, p_instance,
        address(real, rows), n, address(model.batch.count_type, counts),
    ):  # fmt: skip
        return None
    run = BatchTrajectory.__new__(BatchTrajectory)
    run.model, run.rows, run.counts = model, rows, counts
    run.origin = choice, numbers, u, u_shape, p, (t0, t0 + steps * h, steps, None)
    return run


def batch_options(model: CompiledBatchModel, request: Request, u: Array | None) -> Any:
    """Return a C struct with the options of a batch, whose rows are after steps of equal size.

    u: inputs, with a row for each step.
    """
    options, nu = new_options(model, request), model.info.nu
    options.rows = 1 + request.steps // request.every
    if u is not None:
        periods = u.shape[1]
        options.u_instance = periods * nu if len(u) > 1 else 0
        options.u_step = nu if periods > 1 and request.has_equal_steps else 0
    if model.batch.has_own_parameters:
        options.p_instance = int(len(request.p) > 1)
    return options


def _state_and_rows(model: CompiledBatchModel, count: int, n: int) -> tuple[Array, Array]:
    """Allocate the states, (2, batch, nq), and the rows, (2, batch, n, nq)."""
    nq, dtype = model.info.nq, model.info.dtype
    try:
        if (
            count * n * nq > MIN_CHECKED_NUMBERS
            and model.info.row_bytes(count * n) > machine_memory()
        ):
            raise MemoryError
        return np.empty((2, count, nq), dtype), np.empty((2, count, n, nq), dtype)
    except MemoryError:
        raise MemoryError(
            f"{count} times {n} rows of {2 * nq} numbers don't fit in memory: "
            "keep fewer with every="
        ) from None


def _row_times(model: CompiledBatchModel, request: Request) -> Array:
    """Return the times of the rows, s: without request the ends, or those of fixed steps."""
    t0, t_end, h, steps, every = request[2:7]
    if request.times is not None:
        return request.times
    ends = [t0, t_end] if t_end > t0 else [t0]
    times = t0 + h * np.append(np.arange(0, steps, every), steps) if h else np.array(ends)
    return np.asarray(times, model.info.dtype)


class BatchWork:
    """Steps of all instances of a batch in progress: their states, results and rows.

    Parameters
    ----------
    request : Request
        Method, steps, parameters and inputs; the initial states are copied by `copy_starts`.
    state : (2, batch, nq) array, or pair of (batch, nq) arrays
        Current positions and velocities, which are overwritten.
    rows : (2, batch, n, nq) array, optional
        Memory for the rows.
    times : (n,) array, optional
        Times of the rows, s; None: after each `every` steps of equal size, and after the last one.
    codes : (batch,) array, optional
        Status number of each instance before the first step: 0, or the number of the failure if its
        initial state cannot be moved onto the constraints.
    first : int
        Number of steps from the start of the request to these states.
    starts : (batch,) array, optional
        Start time of each instance, s, if they differ.

    Attributes
    ----------
    results : structured array (batch,)
        Counters and status of each instance, where C writes them.
    """

    def __init__(
        self, model: CompiledBatchModel, request: Request, state: Any, rows: Array | None = None,
        times: Array | None = None, codes: Array | None = None, *, first: int = 0,
        starts: Array | None = None,
    ) -> None:  # fmt: skip
        self.model, self.request, self.state, self.rows = model, request, state, rows
        self.times, self.starts, self.first = times, starts, first
        self.count, self.is_equal, ffi = len(state[0]), request.has_equal_steps, model.c.ffi
        self.u = request.u
        if self.is_equal and self.u is not None and self.u.shape[1] > 1:
            self.u = table_of_steps(request)
        self.options = options = batch_options(model, request, self.u)
        if rows is None:
            options.rows = 0
        elif times is not None:
            self.at_times = np.asarray(times, model.info.dtype)
            options.times, options.rows = model.c.pointer(self.at_times), len(times)
        self.outputs = ffi.new(model.batch.outputs_type, self.count)
        self.results: Any = np.frombuffer(ffi.buffer(self.outputs), model.batch.result_type)
        self.memory = ffi.new("run_memory[]", self.count) if model.batch.has_memory else None
        self.results["steps"] = first
        if codes is not None:  # instances with a code other than 0 make no step
            self.results["status"] = codes
        self.events = None
        if model.info.events and not self.is_equal:
            stored = 0 if rows is None else self.count * rows.shape[2]
            self.events = BatchEventBuffer(model, room_for(model) - stored)
        self.is_open = np.ones(self.count, bool)  # whether an instance is not finished
        self.stop, self.ended = False, 0  # Ctrl-C; number of finished instances, or steps

    @property
    def is_full(self) -> bool:
        """Whether there is no memory for more events."""
        return self.events is not None and self.events.full

    def copy_starts(self, threads: int | None) -> None:
        """Copy the initial states of the request, which may be the caller's arrays.

        Raises ValueError if one is not finite.
        """
        count, threads = self.count, as_threads(threads) if self.count > _GROUP_SIZE else 1
        share = -(-count // threads)
        parts = [(at, min(share, count - at)) for at in range(0, count, share)]
        if len(parts) == 1:
            self._copy_part(*parts[0])
        else:
            for future in [_pool(threads).submit(self._copy_part, *part) for part in parts]:
                future.result()
        if self.rows is not None and self.times is None:
            self.rows[:, :, 0] = self.state

    def _copy_part(self, at: int, count: int) -> None:
        model, request = self.model, self.request
        for start, name, x in zip((request.q, request.qd), ("q0", "qd0"), self.state, strict=True):
            (far, across), wide = start.strides, start.dtype.itemsize == 8
            first = start.__array_interface__["data"][0] + at * far
            to = model.c.pointer(x) + model.info.nq * at
            if not model.c.lib.batch_start(count, first, wide, far, across, to):
                model.arguments.array(start, name, model.info.nq)  # raises, and says where

    def run(self, threads: int | None, progress: Progress) -> bool:
        """Simulate all instances to their end; return False if Ctrl-C interrupted the run.

        threads: number of threads; None: one for each processor. progress: as in `integrate_batch`.
        """
        count = self.count
        if self.is_equal:
            threads = (
                as_threads(threads) if count * self.request.steps >= MIN_STEPS_FOR_THREADS else 1
            )
            tiles = share = -(-count // _GROUP_SIZE)
            if threads > 1:
                share = tiles // (_GROUPS_PER_THREAD * threads)
            size = _GROUP_SIZE * max(1, min(_MAX_TILES_PER_GROUP, share))
            total = count * self.request.steps
        else:
            size = _GROUP_SIZE if count > 8 * _GROUP_SIZE else SMALL_GROUP_SIZE
            threads, total = 1 if threads is None and count <= size else as_threads(threads), count
        groups = [(at, min(size, count - at)) for at in range(0, count, size)]
        return run_groups(self, groups, threads, lambda: progress and progress(self.ended, total))

    def run_group(self, at: int, count: int, look: Callable[[], object] = lambda: None) -> None:
        """Simulate instances at, ..., at + count - 1 to the end, in chunks of steps."""
        model, pointer, nq = self.model, self.model.c.pointer, self.model.info.nq
        options = model.c.ffi.new("run_options *", self.options[0])
        row_count, rows = 0, (model.c.null, model.c.null)
        if self.rows is not None:
            row_count = self.rows.shape[2]
            rows = pointer(self.rows[0, at:]), pointer(self.rows[1, at:])
        events = self.events.room(count) if self.events else None
        none = model.integrator.no_events
        outputs = self.outputs + at
        memory = () if self.memory is None else (self.memory + at,)
        model.c.lib.begin_batch(
            count, *rows, row_count, *(events.c_arguments if events else none), *memory, outputs
        )
        u, p = self.u, self.request.p
        places = (
            pointer(self.state[0]) + nq * at, pointer(self.state[1]) + nq * at,
            pointer(None if self.starts is None else self.starts[at:]),
            pointer(None if u is None else u[at if len(u) > 1 else 0 :]),
            pointer(p[at if len(p) > 1 else 0 :]), outputs,
        )  # fmt: skip
        advance = self._equal_steps if self.is_equal else self._steps_to_periods
        if advance(options, places, (at, count), events, look):
            self.is_open[at : at + count] = False

    def _equal_steps(
        self, options: Any, places: Any, group: tuple[int, int], _: Any, look: Callable[[], object]
    ) -> bool:
        """Make all steps of equal size of a group; return False if interrupted."""
        model, (_, count) = self.model, group
        # rows between steps belong to the step that follows
        left = self.request.steps - self.first + (self.times is not None)
        kind, known = (self.request.method, count.bit_length()), model.batch.step_seconds
        # the first chunk is short: the measured speed may be that of an easier batch
        seconds = known.get(kind, _DEFAULT_STEP_SECONDS * model.info.nq) * count
        chunk = max(1, int(FIRST_POLL_SECONDS / seconds))
        while left > 0 and not self.stop:
            options.steps = chunk = min(chunk, left)
            call_start = perf_counter()
            model.c.lib.integrate_batch(options, count, *places)
            duration = perf_counter() - call_start
            left -= chunk
            # for the progress bar only: not synchronised between threads
            self.ended += min(chunk, chunk + left - (self.times is not None)) * count
            known[kind] = max(1e-10, duration / (chunk * count))
            chunk = next_chunk(chunk, duration, POLL_SECONDS)
            look()
        return left <= 0

    def _steps_to_periods(
        self, options: Any, places: Any, group: tuple[int, int], events: Any,
        look: Callable[[], object],
    ) -> bool:  # fmt: skip
        """Make all steps of various sizes of a group, one control period at a time.

        Return False if interrupted.
        """
        request, (at, count) = self.request, group
        periods, chunk, (q, qd, t, u, p, outputs) = 1, FIRST_CHUNK_STEPS, places
        if self.u is not None:
            periods = self.u.shape[1]
        for k in range(periods):
            if k + 1 < periods:
                dtype = self.model.info.dtype
                options.t_end = period_end(k, request.t0, request.period, dtype)
            else:
                options.t_end = request.t_end
            more = True
            while more:
                if self.stop or self.is_full:
                    return False
                call_start = perf_counter()
                options.steps = chunk
                more = self.model.c.lib.integrate_batch(
                    options, count, q, qd, t, u + k * self.model.info.nu if k else u, p, outputs
                )
                if self.events:
                    self.events.keep(events, self.results["events"][at : at + count], at)
                chunk = min(next_chunk(chunk, perf_counter() - call_start), 2**40)
                look()
            chunk = FIRST_CHUNK_STEPS
        self.ended += count  # for the progress bar only: not synchronised between threads
        look()
        return True

    def finish_rows(self) -> None:
        """Fill the rows that C did not: at the end, and nan at those that were not reached."""
        results, rows = self.results, self.rows
        if rows is None:
            return
        n, filled = rows.shape[2], results["rows"].copy()
        has_start = self.times is None or self.times[0] == self.request.t0
        if has_start and not self.first and np.count_nonzero(locked := filled == 0):
            filled[locked] = 1
            rows[:, locked, 0] = np.asarray(self.state)[:, locked]
        if self.times is None and self.request.steps % self.request.every:
            rows[:, :, -1] = self.state
            filled += results["steps"] >= self.request.steps
        if np.count_nonzero(filled < n):
            rows[:, np.arange(n) >= filled[:, None]] = np.nan

    def trajectory(self, request: Request) -> BatchTrajectory:
        """Return the batch. request: as in its attribute."""
        model, results = self.model, self.results
        self.finish_rows()
        rows: Any = self.rows
        status, steps = results["status"].copy(), results["steps"].astype(int)
        is_open = (status == 0) & self.is_open
        if np.count_nonzero(is_open):
            if self.is_equal:
                is_open &= results["steps"] < request.steps
            status[is_open] = len(STATUS) if self.is_full else _INTERRUPTED
        evaluations = results["evaluations"].astype(int)
        if self.events and not request.tol:
            evaluations = model.info.count_evaluations(request.method, steps, evaluations)
        is_adaptive, none = model.info.tolerance is not None, np.zeros(len(steps), int)
        run = BatchTrajectory(
            model, request, (rows[0], rows[1]), steps, status, evaluations,
            *(results[k].astype(int) if is_adaptive else none for k in ("rejected", "stiff_steps")),
        )  # fmt: skip
        run.times = self.times
        if not self.is_equal:
            run.end_time = np.where(results["has_started"], results["t"], request.t0)
        if self.events:
            run.event_data, run.stopped_codes = self.events.all(), results["stopped"].copy()
            run.limits = np.where(status == STATUS.index("accumulated"), results["limit"], np.nan)
        return run


def run_groups(
    work: BatchWork, groups: list[tuple[int, int]], threads: int, look: Callable[[], object]
) -> bool:
    """Process all groups of instances in threads; return False if Ctrl-C interrupted them.

    work: the computation, whose method `run_group` processes a group. groups: (index of the first
    instance, number of instances) of each group. threads: number of threads. look: function
    without arguments that is called at regular intervals, for example to update a progress bar.
    """
    if threads == 1 or len(groups) == 1:
        try:
            for group in groups:
                work.run_group(*group, look)
        except KeyboardInterrupt:
            return False
        return True
    pool = _pool(threads)
    waiting: set[Future[None]] = {pool.submit(work.run_group, *group) for group in groups}
    try:
        while waiting:
            finished, waiting = wait(waiting, timeout=POLL_SECONDS, return_when=FIRST_EXCEPTION)
            for future in finished:
                future.result()
            look()
    except BaseException as fault:
        work.stop = True
        for future in waiting:
            future.cancel()
        wait(waiting)
        if isinstance(fault, KeyboardInterrupt):
            return False
        raise
    return True


def as_threads(threads: Any) -> int:
    """Return the number of threads; if `threads` is None, the number of available processors.

    Raises ValueError unless it is a whole number >= 1.
    """
    if threads is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return as_count(threads, "threads", 1)


_pools: dict[int, ThreadPoolExecutor] = {}
if hasattr(os, "register_at_fork"):  # a forked process has no threads of the pools
    os.register_at_fork(after_in_child=_pools.clear)


def _pool(threads: int) -> ThreadPoolExecutor:
    """Return a pool of threads, which is reused since starting threads is slow."""
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="eomc")
    return _pools[threads]
