"""Engines that compute the blocks of a sweep: threads, processes, Dask, and any executor.

All of them are executors of `concurrent.futures`. A window of a few blocks for each worker is
submitted at a time. What stops a sweep leaves the finished blocks in the store.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.sweeps.block import BlockReport, Task, ignore_failures, process_name, run_block
from eomc.sweeps.plan import OutputFunction, Policy, SweepError
from eomc.sweeps.store import Store

Functions = tuple[OutputFunction | None, Policy | None]
WINDOW = 4  # blocks for each worker that are submitted at a time


@dataclass(frozen=True)
class Execution:
    """How a sweep is computed; no result depends on it.

    Attributes
    ----------
    client
        None for threads of this process, a number of processes, an Executor, a Dask client, or the
        address of a Dask scheduler.
    threads
        Number of threads of C for a block; by default all processors for client=None, else 1.
    block
        Number of trajectories of a block, which is rounded.
    part
        (k, n) or "k/n" to compute the blocks k, k + n, k + 2 n and so on only.
    progress
        Called after each block with a `SweepProgress`.
    """

    client: Any = None
    threads: int | None = None
    block: int | None = None
    part: tuple[int, int] | str | None = None
    progress: Callable[[SweepProgress], object] | None = None

    @property
    def threads_of_block(self) -> int:
        """Number of threads of C for a block."""
        return self.threads or ((os.cpu_count() or 1) if self.client is None else 1)

    @property
    def workers(self) -> int:
        """Number of workers of the client; 1 if it does not have this attribute."""
        client: Any = self.client
        if hasattr(client, "nthreads"):  # a client of Dask
            return max(1, int(sum(client.nthreads().values())))
        return int(client if isinstance(client, int) else getattr(client, "_max_workers", 1))


@dataclass
class SweepProgress:
    """State of a running sweep; its text is a line for a terminal.

    Attributes
    ----------
    blocks, finished : int
        Number of blocks of the store, and of finished ones.
    remaining : int
        Number of blocks that this call has yet to compute.
    trajectories : int
        Number of trajectories that this call has computed.
    seconds : float
        Time since its start.
    worker_seconds, simulation_seconds : float
        Time of all blocks by the clocks of workers, and the part of it in simulate_batch.
    failures : Counter
        Number of failed trajectories by status.
    excluded : dict
        Reason by number of each block that was left out, since it ended its workers.
    processors : int
        Number of kinds of processors that have computed blocks of the store.
    """

    blocks: int
    finished: int
    remaining: int
    trajectories: int = 0
    seconds: float = 0.0
    worker_seconds: float = 0.0
    simulation_seconds: float = 0.0
    failures: Counter[str] = field(default_factory=Counter)
    excluded: dict[int, str] = field(default_factory=dict)
    processors: int = 0
    computed: int = 0

    def __str__(self) -> str:
        text = f"{self.finished} of {self.blocks} blocks"
        if self.computed:
            text += f", {self.trajectories / self.seconds:,.0f} trajectories/s"
        if self.remaining and self.computed:
            text += f", {self.seconds / self.computed * self.remaining:.0f} s left"
        if failed := sum(self.failures.values()):
            text += f", {failed:,} failed"
        return text


def compute_blocks(
    store: Store, numbers: Sequence[int], execution: Execution, functions: Functions
) -> SweepProgress:
    """Compute blocks of a store; return the state at the end.

    functions: that of the stored quantities and the policy, or None.

    Raises EomcError if the computation can't go on; finished blocks stay in the store.
    """
    window = _Window(store, numbers, execution, functions)
    client = execution.client
    if not window.waiting:
        return window.state
    with warnings.catch_warnings():
        ignore_failures()
        if client is None:
            window.compute_in_threads()
        elif isinstance(client, int):
            window.compute_in_processes(client)
        else:
            with _executor(client) as executor:
                window.compute(executor, WINDOW * execution.workers)
    return window.state


@contextmanager
def _executor(client: Any) -> Iterator[Executor]:
    """Yield the executor of a client; a client of an address is closed at the end."""
    if isinstance(client, str):
        try:
            from distributed import Client
        except ImportError:
            raise EomcError("Dask needs more packages: pip install distributed") from None
        try:
            own = Client(client, timeout=10)  # s
        except (OSError, ValueError) as fault:
            why = texts.line(str(fault))
            raise EomcError(f"no Dask scheduler at {texts.line(client)} ({why})") from None
        with own:
            yield own.get_executor(pure=False)
    elif hasattr(client, "get_executor"):
        yield client.get_executor(pure=False)
    elif hasattr(client, "submit"):
        yield client
    else:
        why = "give an Executor, a Dask client, its scheduler's address or a number"
        raise SweepError(("client",), f"{why}, here {client!r}")


class _Window:
    """The blocks that wait, those that are submitted, and the state of the sweep."""

    def __init__(
        self, store: Store, numbers: Sequence[int], execution: Execution, functions: Functions
    ) -> None:
        self.execution, self.started_at = execution, time.perf_counter()
        place, how = (str(store.path), store.stamp), (execution.threads_of_block, process_name())
        self.waiting = deque(Task(*place, k, *how, *functions) for k in numbers)
        self.running: dict[Future[BlockReport | None], Task] = {}
        self.state = SweepProgress(store.blocks, int(store.finished().sum()), len(numbers))

    def compute_in_threads(self) -> None:
        """Compute in two threads: one writes a block while the other is in C, without the GIL."""
        interrupted = threading.Event()
        with ThreadPoolExecutor(2) as executor:
            try:
                self.compute(executor, 2 * WINDOW, partial(run_block, cancelled=interrupted.is_set))
            except BaseException:
                interrupted.set()
                raise

    def compute_in_processes(self, count: int) -> None:
        """Compute in processes of this machine; leave out blocks that end their process.

        After the loss of a process its block is not known, so the submitted ones are computed one
        at a time.
        """
        suspects: deque[Task] = deque()
        while self.waiting or suspects:
            alone = bool(suspects)
            tasks, size = (suspects, 1) if alone else (self.waiting, WINDOW * count)
            options = (multiprocessing.get_context("spawn"), _prepare_worker)
            with ProcessPoolExecutor(1 if alone else count, *options) as pool:
                try:
                    self.compute(pool, size, tasks=tasks)
                except BrokenExecutor:
                    tasks_in_work = [*self.running.values()]
                    self.running.clear()
                    if alone:
                        self._exclude(tasks_in_work[0], "it ended its process twice")
                    else:
                        suspects.extend(tasks_in_work)

    def compute(
        self, executor: Executor, size: int, function: Callable[[Task], Any] = run_block,
        tasks: deque[Task] | None = None,
    ) -> None:  # fmt: skip
        """Submit tasks, at most `size` at a time, until all are finished.

        Raises BrokenExecutor if the client is a number of processes; `running` then contains the
        blocks that are lost.
        """
        waiting = self.waiting if tasks is None else tasks
        try:
            while waiting or self.running:
                while waiting and len(self.running) < size:
                    self.running[executor.submit(function, waiting[0])] = waiting[0]
                    waiting.popleft()
                ended, _ = wait(self.running, return_when=FIRST_COMPLETED)
                for future in sorted(
                    ended, key=lambda x: x.cancelled() or x.exception() is not None
                ):
                    self._collect(future)
        except BaseException:
            for future in self.running:
                future.cancel()
            raise

    def _collect(self, future: Future[BlockReport | None]) -> None:
        """Add the report of a block to the state, or raise the error that stops the sweep."""
        try:
            report = future.result()
        except Exception as fault:
            if type(fault).__name__ == "KilledWorker":  # Dask has tried it several times
                self._exclude(self.running.pop(future), "it ended its worker 4 times")
                return
            raise self._explain(fault) from fault
        del self.running[future]
        if report is None:
            return
        state = self.state
        state.finished += 1
        state.computed += 1
        state.trajectories += report.trajectories
        state.worker_seconds += report.seconds
        state.simulation_seconds += report.simulation_seconds
        state.failures.update(report.failures)
        self._report_progress()

    def _exclude(self, task: Task, why: str) -> None:
        self.state.excluded[task.number] = why
        self._report_progress()

    def _report_progress(self) -> None:
        self.state.remaining -= 1
        self.state.seconds = time.perf_counter() - self.started_at
        if self.execution.progress is not None:
            self.execution.progress(self.state)

    def _explain(self, fault: Exception) -> Exception:
        """Return the error for the user, with the remedy, for what ended a block."""
        there = f"{self.state.finished} of {self.state.blocks} blocks are finished"
        if isinstance(fault, OSError) and fault.errno == errno.ENOSPC:
            return EomcError(f"no room left on the disc: {there}: make room, then run it again")
        if isinstance(fault, BrokenExecutor) and not isinstance(self.execution.client, int):
            return EomcError(f"a worker process ended: {there}: run the same again")
        if type(fault).__name__ == "CommClosedError" or isinstance(fault, CancelledError):
            return EomcError(f"the scheduler was lost: {there}: run the same again")
        unsent = isinstance(fault, (pickle.PicklingError, AttributeError, TypeError))
        if unsent and "pickle" in str(fault):
            why = "a lambda or an inner function can't go to another process: "
            return SweepError(("outputs",), f"{why}write a function into a file, or use Dask")
        return fault


def _prepare_worker() -> None:
    """Let the client alone react to Ctrl-C, and end this process when the client is killed.

    A worker of a pool has both ends of its queue, and would wait for tasks for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_client, daemon=True).start()


def _end_with_client() -> None:
    if client := multiprocessing.parent_process():
        client.join()
        os._exit(1)
