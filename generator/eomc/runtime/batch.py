"""Simulation of many instances of a scene, which `batch = true` adds to a module.

Instances run in the lanes of vector registers and in threads; no result depends on either. One
request gives one batch of trajectories, and the loops are in C: groups of instances are simulated
in threads, in chunks of steps between checks of Ctrl-C.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from functools import cached_property
from time import perf_counter
from typing import Any, Never, cast

import numpy as np
from numpy import empty, ndarray
from numpy.typing import ArrayLike

from .arguments import (
    Array,
    Start,
    as_count,
    as_number,
    as_step_size,
    machine_memory,
    row_times,
    without_mask,
)
from .batch_trajectory import COUNTERS, BatchTrajectory
from .columns import BatchEventBuffer
from .info import next_chunk
from .integration import MIN_CHECKED_NUMBERS, new_options, room_for
from .interfaces import CompiledBatchModel
from .model import Model
from .package import Component, warn, with_events
from .requests import (
    FIRST_CALL_NUMBERS,
    MIN_CHECKED_STEPS,
    Progress,
    Request,
    SimulationArguments,
    StepChoice,
    as_progress,
    count_input_periods,
    cut_to_periods,
    named_initial_state,
    period_end,
    table_of_steps,
)
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

    Attributes
    ----------
    starts : (batch,) array, optional
        Start time of each instance, s, if they differ.
    results : structured array (batch,)
        Counters and status of each instance, where C writes them.
    """

    starts: Array | None = None

    def __init__(
        self, model: CompiledBatchModel, request: Request, state: Any, rows: Array | None = None,
        times: Array | None = None, codes: Array | None = None, *, first: int = 0,
    ) -> None:  # fmt: skip
        self.model, self.request, self.state, self.rows = model, request, state, rows
        self.times, self.first = times, first
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


class BatchModel(Model):
    """Compiled scene that simulates many instances (independent copies) at once.

    Attributes
    ----------
    batch : Batch
        Steps and runs of many instances. The other attributes are those of `Model`.
    """

    def __init__(self, extension: Any, **scene: Any) -> None:
        super().__init__(extension, **scene)
        self.batch = Batch(self)

    @property
    def trajectory_classes(self) -> dict[str, Any]:
        """The classes of runs and batches by their names."""
        return super().trajectory_classes | {"BatchTrajectory": BatchTrajectory}


class Batch(Component):
    """Steps and simulations of many instances, which differ in states, parameters or inputs.

    Attributes
    ----------
    has_memory, has_own_parameters : bool
        Whether C keeps data of an instance between calls, and whether instances may differ in
        parameters.
    step_seconds : dict
        Measured seconds per step and instance, by function and log2 of the number of instances (few
        instances do not fill a register). They determine the size of chunks, no result.
    """

    path = "batch"

    def __init__(self, model: BatchModel) -> None:
        self.model, self.info, self.c, self.arguments = model, model.info, model.c, model.arguments
        self.has_memory = self.info.tolerance is not None or bool(self.info.events)
        names = dict(self.c.ffi.typeof("run_options").fields)
        self.has_own_parameters = "p_instance" in names
        self.count_type, self.status_type = map(self.c.ffi.typeof, ("long[]", "int[]"))
        self.outputs_type = self.c.ffi.typeof("run_output[]")
        self.step_seconds: dict[Any, float] = {}
        self.step_counts: dict[Any, int] = {}  # of step_batch, by method and step size

    @cached_property
    def result_type(self) -> np.dtype[Any]:
        """The type of the results of an instance, numbers of the C struct `run_output`."""
        ffi, kinds = self.c.ffi, {"long": "l", "int": "i", "double": "d", "float": "f"}
        members = {
            name: kinds[field.type.cname]
            for name, field in ffi.typeof("run_output").fields
            if field.type.cname in kinds
        }
        layout = {
            "names": list(members), "formats": list(members.values()),
            "offsets": [ffi.offsetof("run_output", name) for name in members],
            "itemsize": ffi.sizeof("run_output"),
        }  # fmt: skip
        result_type: np.dtype[Any] = np.dtype(layout)  # type: ignore[call-overload]
        return result_type

    def simulate_batch(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        params: Any = None, u: ArrayLike | None = None, threads: int | None = None,
        method: str | None = None, *, t0: float = 0.0, control_period: float | None = None,
        progress: Callable[[int, int], None] | None = None, tol: float | None = None,
        times: ArrayLike | None = None, max_step: float | None = None, stiff: bool = False,
        max_evaluations: int | None = None, events: Mapping[str, Any] | None = None,
        **unknown: Never,
    ) -> BatchTrajectory:  # fmt: skip
        """Simulate many instances of the scene and return their trajectories.

        An instance that cannot continue, or whose initial state cannot be moved onto the
        constraints, gets its own status and does not affect the others.

        Parameters
        ----------
        q0, qd0 : (batch, nq) or (nq,) array, or dict by name, optional
            Initial positions and velocities of each instance, or the same of all; by default those
            of the scene.
        h : float, optional
            Size of fixed steps, s; by default that of the scene.
        duration : float, optional
            Simulated time, s; by default that of the scene.
        steps : int, optional
            Number of fixed steps, instead of `duration`.
        every : int
            Number of fixed steps between two rows. The first and the last state also have a row.
        params : dict, Params or (batch, np) array, optional
            Parameters. The values of a dict are numbers, or arrays (batch,).
        u : array or dict, optional
            Inputs: (nu,) or (batch, nu), constant during the run; (batch, steps, nu) or
            (1, steps, nu), one row for each step or for each `control_period`, constant over it; or
            a dict of all inputs by name, whose values are numbers or have the shape (batch,),
            (batch, steps) or (1, steps). By default the scene's signals.
        threads : int, optional
            Number of threads; by default one for each processor.
        method : str, optional
            Name of the method of fixed steps, one of `methods`; "auto": adaptive steps.
        t0 : float
            Time of the initial states, s.
        control_period : float, optional
            Time over which each row of `u` is constant, s.
        progress : callable, optional
            Called repeatedly with (done, total): the steps of all instances, or with adaptive
            steps and with events the numbers of instances.
        tol : float, optional
            Tolerance of adaptive steps, whose sizes differ between instances. By default that of
            the scene, if none of h, steps and method is given.
        times : (n,) array, optional
            Ascending times of the rows, s, within the duration. By default adaptive steps have rows
            at the start and at the end only.
        max_step : float, optional
            Longest adaptive step, s.
        stiff : bool
            Begin adaptive steps with Newton's method.
        max_evaluations : int, optional
            Number of evaluations of the accelerations after which an instance with adaptive steps
            begins no further step. Its status is then "too long".
        events : dict, optional
            Additional events by name, as in `simulate`.

        Returns
        -------
        BatchTrajectory
            Trajectories with q and qd (batch, n, nq), and the status of each instance.

        Raises
        ------
        ValueError
            If an argument is invalid.
        Interrupted
            At Ctrl-C; its attribute `run` is the run up to that moment.
        """
        if events is not None or unknown:
            other, arguments = with_events(self.simulate_batch, dict(locals()))
            return cast(BatchTrajectory, other.batch.simulate_batch(**arguments))
        choice, integrator = None, self.model.integrator
        is_plain = max_step is control_period is None and max_evaluations is threads is None
        if is_plain and progress is None:
            key = h, duration, steps, every, method, tol, times is not None
            choice = integrator.plain_steps.find(key)
        is_short = integrator.has_plain_runs and times is None and stiff is False
        if choice is not None and is_short and type(t0) is float:
            run = batch_at_once(self.model, choice, (q0, qd0), t0, u, params)
            if run is not None:
                return run
        options = SimulationArguments(
            q0, qd0, h, duration, steps, every, u, params, method, t0, control_period, None,
            as_progress(progress), tol, times, max_step, stiff, threads, max_evaluations,
        )  # fmt: skip
        if threads is not None:
            as_count(threads, "threads", 1)
        request, codes = self._request(options, choice)
        run = self.integrate(request, codes, threads, options.progress)
        if np.count_nonzero(run.status_codes):
            warn(f"{self.info.name}: {run.failure_summary}")
        return run

    def integrate(
        self, request: Request, codes: Array | None = None, threads: int | None = None,
        progress: Progress = None,
    ) -> BatchTrajectory:  # fmt: skip
        """Make a batch from checked arguments and return it, as `integrate_batch`."""
        return integrate_batch(self.model, request, codes, threads, progress)

    def states_from(
        self, request: Request, state: Array, first: int, codes: Array, rows: Array
    ) -> None:
        """Compute states of a batch at the times of the request, from those after `first` steps.

        state: [q, qd] after these steps, (2, batch, nq), which is overwritten. codes: status number
        of each instance; others than 0 make no step. rows: the states, (2, batch, n, nq).
        """
        work = BatchWork(self.model, request, state, rows, request.times, codes, first=first)
        work.run(None, None)
        work.finish_rows()

    def _request(
        self, options: SimulationArguments, choice: StepChoice | None
    ) -> tuple[Request, Array | None]:
        """Check the arguments of `simulate_batch`; warn of a step size that is too large.

        choice: checked steps from t = 0, if known. Return the request, and the status numbers of
        instances that cannot start, or None. Raises ValueError if an argument is invalid.
        """
        info, integrator = self.info, self.model.integrator
        steps = integrator.checked_steps(options, choice)
        hold = count_input_periods(info, steps, options.control_period)
        if options.u is None and options.control_period is not None and info.nu:
            raise ValueError("control_period: a batch follows the signals: give u, a row a period")
        u = cut_to_periods(info, options, steps, hold, 1)
        q, qd, p, inputs, codes = self.instances(options, u, hold[1] or None, steps.t0)
        inputs = None if inputs is None else inputs.copy()
        request = steps.request(q, qd, (inputs, *hold), p.copy())
        integrator.check_step_size(request, "the first instance: ")
        return request, codes

    def step_batch(
        self, q: Array, qd: Array, h: float | None = None, t: ArrayLike = 0.0,
        u: ArrayLike | None = None, params: Any = None,
        out: tuple[Array, Array] | None = None, threads: int | None = None,
        method: str | None = None, *, steps: int = 1,
    ) -> Array:  # fmt: skip
        """Advance many instances by one or more steps of size h, in place.

        Parameters
        ----------
        q, qd : (batch, nq) arrays
            States of the instances, which are overwritten unless `out` is given.
        h : float, optional
            Step size, s; by default that of the scene.
        t : float or (batch,) array
            Time before the first step, s, of all instances or of each.
        u : (nu,) or (batch, nu) array, or dict, optional
            Inputs, constant over all steps; by default the scene's signals.
        params : optional
            As in `simulate_batch`.
        out : pair of (batch, nq) arrays, optional
            Arrays into which the new states are written instead.
        threads : int, optional
            Number of threads; by default one for each processor.
        method : str, optional
            Name of the method, one of `methods`; by default the first of the scene.
        steps : int
            Number of steps. They have the fixed size h in scenes with adaptive steps, too. After 20
            steps of a method and a size, a warning is issued if the size exceeds the stability
            limit at the state of the first instance.

        Returns
        -------
        (batch,) array of integers
            Status of each instance: 0 if all steps succeeded, else an index into the module's tuple
            `STATUS`, whose text is the reason of the failure; the state is then that before the
            failed step.

        Raises
        ------
        ValueError
            If an argument is invalid, or q and qd are not writeable, C-contiguous arrays of the
            module's number type.
        KeyboardInterrupt
            At Ctrl-C.
        """
        if method is not None:
            self.info.method_name(method)  # raises, with those there are
        if out is not None:
            into = self.arguments.output_pair(out, np.shape(q))
            into[0][...], into[1][...] = without_mask(q, "q"), without_mask(qd, "qd")
            q, qd = into
        self.arguments.check_writable(q, "q")
        self.arguments.check_writable(qd, "qd")
        count = len(q)
        if count != len(qd):
            raise ValueError(f"qd: {len(qd)} instances where q has {count}")
        views = q.base is not None or qd.base is not None
        if count and (q is qd or (views and np.may_share_memory(q, qd))):
            raise ValueError("qd: lies in the memory of q, where q is to be written")
        h, steps = (
            self.info.h if h is None else as_step_size(h, self.info.dtype),
            as_count(steps, "steps", 0),
        )
        times = row_times(self.arguments, t, (count,))
        if times is None:
            t = as_number(t, "t")
        inputs = None if u is None else self.input_rows(u, 1)
        table = None if params is None else self.arguments.parameter_rows(params)
        for name, rows in (("params", table), ("u", inputs)):
            if rows is not None and len(rows) not in (1, count):
                raise ValueError(f"{name}: {len(rows)} instances where q has {count}")
        if threads is not None:
            as_count(threads, "threads", 1)
        key = method or self.info.methods[0], h
        if key not in self.model.integrator.warned and count:
            self.step_counts[key] = self.step_counts.get(key, 0) + steps
            if self.step_counts[key] >= MIN_CHECKED_STEPS:
                t0 = as_number(t, "t") if times is None else float(times[0])
                rows = self.arguments.parameter_rows(params)
                choice = h, MIN_CHECKED_STEPS, 1, None, inputs, 0.0, 0, rows, key[0]
                self.model.integrator.check_step_size(
                    Request(q, qd, t0, 0.0, *choice), "the first instance: "
                )
        if (
            count * steps >= MIN_STEPS_FOR_THREADS
            or count * steps * self.info.nq > 8 * MIN_STEPS_FOR_THREADS
        ):
            table, method = self.arguments.parameter_rows(params), method or self.info.methods[0]
            t0 = as_number(t, "t") if times is None else 0.0
            inputs_and_method = (inputs, 0.0, 0, table, method)
            request = Request(q, qd, t0, 0.0, h, steps, 1, None, *inputs_and_method)
            work = BatchWork(self.model, request, (q, qd))
            work.starts = times
            if not work.run(threads, None):
                raise KeyboardInterrupt
            return np.array(work.results["status"])
        # too few steps for threads and for checks of Ctrl-C: call C directly
        address, real, null = self.c.tools
        status = np.empty(count, "i")
        self.c.lib.step_batch(
            0 if method is None else self.info.methods.index(method), count, address(real, q),
            address(real, qd), null if times is None else address(real, times),
            t if times is None else 0.0, h, steps, 1,
            null if inputs is None else address(real, inputs),
            self.info.nu if inputs is not None and len(inputs) > 1 else 0, 0,
            self.arguments.default_pointers[2] if table is None else address(real, table),
            1 if table is not None and len(table) > 1 else 0, null, 0, null,
            address(self.status_type, status),
        )  # fmt: skip
        return status

    def instances(
        self, options: SimulationArguments, u: Any, steps: int | None, t0: float
    ) -> tuple[Array, Array, Array, Array | None, Array | None]:
        """Check the initial states, parameters and inputs of a batch.

        Return positions and velocities, (batch, nq) each; parameters, (batch or 1, np); inputs,
        (batch or 1, steps or 1, nu), or None for the scene's signals; and status numbers, or None
        if all instances can start. Initial states may be the caller's arrays, and contain numbers
        that are not finite.

        u: inputs, cut to the steps of the run. steps: number of rows of a table of inputs. t0:
        time, s, at which the initial states are assembled on the constraints.
        """
        q0, qd0, params = options.q0, options.qd0, options.params
        start, table = self.info.initial_state, self.arguments.parameter_rows(params)
        q0, qd0 = named_initial_state(self.model, q0, qd0, params, many=True)
        q = self._state_rows(start[0] if q0 is None else self.info.with_discrete(q0, 0), "q0")
        qd = self._state_rows(start[1] if qd0 is None else self.info.with_discrete(qd0, 1), "qd0")
        inputs = self.input_rows(u, steps)
        sizes = {
            "q0": 1 if q.ndim == 1 else len(q),
            "qd0": 1 if qd.ndim == 1 else len(qd),
            "params": len(table),
            "u": 1 if inputs is None else len(inputs),
        }
        if empty := [name for name, size in sizes.items() if not size]:
            raise ValueError(f"{empty[0]}: no instances")
        whose, count = next((x for x in sizes.items() if x[1] > 1), ("q0", 1))
        for name, size in sizes.items():
            if size not in (1, count):
                hint = ": a table over time for all is (1, steps, nu)" if name == "u" else ""
                raise ValueError(f"{name}: {size} instances where {whose} has {count}{hint}")

        if whose == "u" and inputs is not None and np.ndim(u) == 2 and len(inputs) == steps:
            one, each = f"(1, {steps}, {self.info.nu})", f"({steps}, 1, {self.info.nu})"
            raise ValueError(
                f"u: shape {np.shape(u)} may be a table over time or one row an instance: give "
                f"{one} for a table, {each} for as many instances"
            )

        whole = (count, self.info.nq)  # broadcast_to is slow even without effect
        q, qd = (x if x.shape == whole else np.broadcast_to(x, whole) for x in (q, qd))
        q, qd, codes = self.model.constraints.assemble_rows(q, qd, table, t0)
        return q, qd, table, inputs, codes

    def _state_rows(self, values: ArrayLike, name: str) -> Array:
        """Return states (nq,) or (n, nq); an array (n, nq) is returned without further checks."""
        if isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == self.info.nq:
            without_mask(values, name)
            if values.dtype in (self.info.dtype, np.float64) and values.flags.aligned:
                return values
        return self.arguments.array(values, name, self.info.nq)

    def input_rows(self, u: Any, steps: int | None) -> Array | None:
        """Return inputs (batch or 1, steps or 1, nu); steps None: constant during the run."""
        if u is None:
            return None
        if not self.info.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            raise ValueError(
                "u: a Python function can't be called for many at once: give a table, or step all "
                "instances by step_batch in a loop that computes u from their states"
            )
        if type(u) is not np.ndarray and isinstance(u, Mapping):
            u = self.arguments.inputs_by_name(u)
        if type(u) is np.ndarray and u.dtype is self.info.dtype and u.flags.carray:
            array = u
        else:
            array = self.arguments.numbers(u, "u")
        if array.ndim < 3:
            array = array[:, None] if array.ndim == 2 else array.reshape(1, 1, -1)
        if array.ndim != 3 or array.shape[2] != self.info.nu or array.shape[1] not in (1, steps):
            shapes, wide = (
                f"({self.info.nu},), (batch, {self.info.nu})",
                f"(batch, {steps}, {self.info.nu})",
            )
            table = ": rows, each constant over a control period, take control_period=, in s"
            rows = ", a row for each step or control period of duration="
            over = f" or {wide}{rows}" if steps else table
            raise ValueError(f"u: shape {np.shape(u)}, expected {shapes}{over}")
        at = self.c.pointer(array)
        for k in range(0, array.size, MIN_CHECKED_NUMBERS):
            if not self.c.lib.all_finite(min(MIN_CHECKED_NUMBERS, array.size - k), at + k):
                raise ValueError("u: not all numbers are finite")
        return array
