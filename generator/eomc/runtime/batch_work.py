"""Simulation of groups of instances in threads, in chunks between checks of Ctrl-C."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numpy as np

from .arguments import Array, as_count
from .c_library import next_chunk
from .stability import LinearizationState

_GROUP_SIZE = 128  # instances of the smallest group (a tile)
_MAX_TILES_PER_GROUP = 64  # larger groups save calls
_GROUPS_PER_THREAD = 8  # so that all threads end at about the same time
MIN_STEPS_FOR_THREADS = 20_000  # steps of all instances; fewer are faster in one thread
_DEFAULT_STEP_SECONDS = 1.5e-6  # per instance and coordinate, until a step was timed
_POLL_SECONDS = 0.05  # between checks of Ctrl-C and updates of the progress bar
_FIRST_POLL_SECONDS = 0.02  # before the first check


class Instances(NamedTuple):
    """Checked arguments of a batch that may differ between its instances.

    Attributes
    ----------
    starts : pair of (batch, nq) arrays or None
        Initial states, which may be the caller's arrays: they must not be changed, and may contain
        numbers that are not finite. None if they are already in the arrays of the current states.
    parameters : (batch or 1, np) array
        Parameters; a single row applies to all instances.
    inputs : (batch or 1, steps or 1, nu) array or None
        Inputs; None: the scene's signals.
    codes : (batch,) array or None
        Status number of each instance before the first step: 0, or the number of the failure if its
        initial state cannot be moved onto the constraints. None if all are 0.
    """

    starts: tuple[Array, Array] | None
    parameters: Array
    inputs: Array | None
    codes: Array | None = None

    def first_state(self, t0: float) -> LinearizationState:
        """Return the state, inputs and parameters of the first instance at time t0, s."""
        assert self.starts is not None
        u = None if self.inputs is None else self.inputs[0, 0]
        return LinearizationState(self.starts[0][0], self.starts[1][0], t0, u, self.parameters[0])


class BatchSteps(NamedTuple):
    """Fixed steps of a batch.

    Attributes
    ----------
    method : str or None
        Name of the method; None: the first of the scene.
    h : float
        Step size, s.
    t0 : float or (batch,) array
        Start time, s, of all instances or of each.
    steps, every : int
        Numbers of steps, and of steps between two rows (0: no rows).
    """

    method: str | None
    h: float
    t0: Any
    steps: int
    every: int = 0


class Work:
    """Simulation of a batch with fixed steps, by threads that process groups of instances.

    Each group advances in chunks of steps, so that Ctrl-C is handled between two calls of C.

    Parameters
    ----------
    plan : BatchSteps
        Method, step size and number of steps.
    state : pair of (batch, nq) arrays
        Current positions and velocities, which are overwritten.
    instances : Instances
        Initial states, parameters, inputs and status numbers.
    rows : pair of (batch, n, nq) arrays, optional
        Memory for the rows.

    Attributes
    ----------
    completed, status : (batch,) arrays of int
        Number of completed steps and status of each instance.
    """

    def __init__(
        self, model: Any, plan: BatchSteps, state: tuple[Array, Array], instances: Instances,
        rows: tuple[Array, Array] | None = None,
    ) -> None:  # fmt: skip
        q, qd = state
        self.model, self.count = model, len(q)
        self.step = model.integrator.c_function(plan.method, "batch")
        _, self.h, self.t0, self.steps, self.every = plan
        # start time of all or of each
        self.begin = np.atleast_1d(np.asarray(plan.t0, model.info.dtype))
        self.first = 0  # the step that `run` begins with
        self.inputs, self.table, self.starts = (
            instances.inputs, instances.parameters, instances.starts,
        )  # fmt: skip
        q_rows, qd_rows = (None, None) if rows is None else rows
        self.rows = 0 if q_rows is None else q_rows.shape[1]
        self.completed, self.status = np.zeros(self.count, "l"), np.zeros(self.count, "i")
        address, (long, integer) = model.c.tools[0], model.batch.count_types
        self.ends = address(long, self.completed), address(integer, self.status)
        self.at = tuple(model.c.pointer(x) for x in (q, qd, q_rows, qd_rows))
        self.failed = self.stop = False
        self.moved = 0
        if instances.codes is not None:  # the others make no step
            self.status[:], self.failed = instances.codes, bool(instances.codes.any())

    def _places(self, at: int) -> tuple[Any, ...]:
        """Return the pointers to q, qd and their rows of instance `at`."""
        first = self.model.info.nq * at
        q, qd, q_rows, qd_rows = self.at
        if not self.rows:
            return q + first, qd + first, q_rows, qd_rows
        row = first * self.rows
        return q + first, qd + first, q_rows + row, qd_rows + row

    def run(self, threads: int | None, progress: Callable[[int, int], None] | None) -> bool:
        """Simulate all instances through all steps; return False if Ctrl-C interrupted the run.

        threads: number of threads; None: one for each processor. progress: called with the numbers
        of completed and of all steps, each summed over all instances.
        """
        count = self.count
        threads = as_threads(threads)
        if count * (self.steps - self.first) < MIN_STEPS_FOR_THREADS:
            threads = 1
        tiles = -(-count // _GROUP_SIZE)
        size = _GROUP_SIZE * max(
            1,
            min(
                _MAX_TILES_PER_GROUP,
                tiles // (_GROUPS_PER_THREAD * threads) if threads > 1 else tiles,
            ),
        )
        groups = [(at, min(size, count - at)) for at in range(0, count, size)]
        self._copy_all_starts(threads if len(groups) > 1 else 1)
        total = count * self.steps
        return run_groups(self, groups, threads, lambda: progress and progress(self.moved, total))

    def _copy_all_starts(self, threads: int) -> None:
        """Copy the initial states to the current states and the first rows.

        Raises ValueError before any step if one is not finite.
        """
        if self.starts is None:
            return
        share = -(-self.count // threads)
        parts = [(at, min(share, self.count - at)) for at in range(0, self.count, share)]
        if len(parts) == 1:
            self._copy_starts(*parts[0])
        else:
            for future in [_pool(threads).submit(self._copy_starts, *part) for part in parts]:
                future.result()
        self.starts = None  # copied only once

    def _copy_starts(self, at: int, count: int) -> None:
        assert self.starts is not None
        q, qd, q_rows, qd_rows = self._places(at)
        names = ("q0", q, q_rows), ("qd0", qd, qd_rows)
        for start, (name, x, rows) in zip(self.starts, names, strict=True):
            (far, across), wide = start.strides, start.dtype.itemsize == 8
            first = start.__array_interface__["data"][0] + at * far
            if not self.model.c.lib.batch_start(
                count, first, wide, far, across, x, rows, self.rows
            ):
                self.model.arguments.array(
                    start, name, self.model.info.nq
                )  # raises, and says where

    def run_group(self, at: int, count: int, look: Callable[[], object] = lambda: None) -> None:
        """Simulate instances at, ..., at + count - 1 through all steps, in chunks."""
        model = self.model
        pointer, null = model.c.pointer, model.c.tools[2]
        end = at + count
        q, qd, q_rows, qd_rows = self._places(at)
        completed, status = (x + at for x in self.ends)
        each, times = len(self.table) > 1, len(self.begin) > 1
        begin = pointer(self.begin[at:end] if times else self.begin)
        table = pointer(self.table[at:end] if each else self.table)
        u, u_instance, u_step = null, 0, 0
        if self.inputs is not None:
            _, many, width = self.inputs.shape
            u = pointer(self.inputs[at:end] if len(self.inputs) > 1 else self.inputs)
            u_instance = many * width if len(self.inputs) > 1 else 0
            u_step = width if many > 1 else 0
        first, kind = self.first, (self.step, count.bit_length())
        # the first chunk is short: the measured speed may be that of an easier batch
        many = max(
            1,
            int(
                _FIRST_POLL_SECONDS
                / (
                    model.batch.step_seconds.get(kind, _DEFAULT_STEP_SECONDS * model.info.nq)
                    * count
                )
            ),
        )
        while first < self.steps and not self.stop:
            many = min(many, self.steps - first)
            call_start = perf_counter()
            failed = self.step(
                count, q, qd, begin, int(times), self.h, first, many,
                u + first * u_step if u_step else u, u_instance, u_step, self.every,
                q_rows, qd_rows, self.rows, table, 1 if each else 0, completed, status,
            )  # fmt: skip
            duration = perf_counter() - call_start
            self.failed |= failed
            first += many
            # for the progress bar only: not synchronised between threads
            self.moved += many * count
            model.batch.step_seconds[kind] = max(1e-10, duration / (many * count))
            many = next_chunk(many, duration, _POLL_SECONDS)
            look()


class BatchStepper:
    """Compute the states of a batch at any times, by whole steps and one shorter last step.

    plan: method, step size and start time, and the number of steps from there to the current
    states. state: current positions and velocities, (batch, nq) each, which are overwritten.
    instances: the other arguments; `starts`, if given, are copied to `state`.
    """

    def __init__(self, model: Any, plan: BatchSteps, state: Any, instances: Instances) -> None:
        self.model, self.method, self.state = model, plan.method, state
        self.work = Work(model, plan._replace(every=0), state, instances)

    def rows(
        self, places: tuple[Array, Array], into: Any, threads: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> bool:  # fmt: skip
        """Advance the batch to n times and write its states there into arrays.

        Return False if Ctrl-C interrupted the computation, else True. Rows that are not reached are
        set to nan.

        places: for each time the number of whole steps before it (n,), ascending, and the remaining
        time (n,), s. into: arrays for q and qd, (batch, n, nq) each. threads: number of threads;
        None: one for each processor. progress: called with the numbers of completed and of all
        steps, summed over all instances.
        """
        work, (whole, rest) = self.work, places
        last = work.count * int(whole[-1])
        look = progress and (lambda count, _: progress(count, last))
        for k, (n, left) in enumerate(zip(whole.tolist(), rest.tolist(), strict=True)):
            work.first, work.steps = work.steps, n
            if not work.run(threads, look):
                for rows in into:
                    rows[:, k:] = np.nan
                return False
            into[0][:, k], into[1][:, k] = self._between(left)
        return True

    def _between(self, rest: float) -> tuple[Array, Array]:
        """Return the states `rest` seconds after the last step; nan for failed instances."""
        work, (q, qd) = self.work, np.array(self.state)
        good, inputs = work.status == 0, work.inputs
        if not rest and not work.steps:
            return q, qd  # initial states, also those that cannot be assembled
        if rest:
            n = work.steps
            u = None if inputs is None else inputs[:, min(n, inputs.shape[1] - 1)]
            t, p, method = work.t0 + n * work.h, work.table, self.method
            good &= self.model.batch.step_batch(q, qd, rest, t, u, p, method=method) == 0
        q[~good] = qd[~good] = np.nan
        return q, qd


class Grouped(Protocol):
    """Interface of a computation on many instances that `run_groups` distributes over threads.

    The method `run_group` processes one group of instances. It returns early if `stop` is set.
    """

    stop: bool

    def run_group(self, at: int, count: int, look: Callable[[], object] = ...) -> None:
        """Process the group of `count` instances that begins with instance `at`."""


def run_groups(
    work: Grouped, groups: list[tuple[int, int]], threads: int, look: Callable[[], object]
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
            finished, waiting = wait(waiting, timeout=_POLL_SECONDS, return_when=FIRST_EXCEPTION)
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
