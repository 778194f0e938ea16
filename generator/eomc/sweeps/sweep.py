"""The function `eomc.sweep`: plan, store, blocks, Dataset; and the engines that compute the blocks.

The engines are threads, processes, Dask and any executor, all of them executors of
`concurrent.futures`. A window of a few blocks for each worker is submitted at a time. What stops a
sweep leaves the finished blocks in the store.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.sweeps.block import (
    BlockReport,
    Task,
    ignore_failures,
    load_module,
    probe,
    process_name,
    run_block,
)
from eomc.sweeps.plan import (
    OutputFunction,
    Plan,
    Policy,
    SweepArguments,
    SweepError,
    make_plan,
    read_scene,
)
from eomc.sweeps.store import (
    Store,
    choose_block_size,
    create_store,
    cut_block,
    hold_store,
    lay_out,
    open_dataset,
    read_plan,
)

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


def sweep(
    scene: Any, *, over: Mapping[str, Any] | None = None, draws: Mapping[str, Any] | None = None,
    n: int | None = None, sampler: str = "random", seed: int = 0,
    inputs: Mapping[str, float] | None = None, noise: Mapping[str, Any] | None = None,
    policy: Policy | None = None, outputs: Any = None,
    reduce: Mapping[str, Any] | None = None, keep_draws: bool | None = None, bits: str = "native",
    out: str | Path | None = None, client: Any = None, threads: int | None = None,
    block: int | None = None, part: tuple[int, int] | str | None = None,
    progress: Callable[[SweepProgress], object] | None = None, **run: Any,
) -> Any:  # fmt: skip
    """Simulate a scene for many values of its quantities, and return the results as a Dataset.

    The results are written block by block to a store on disk. The same call opens the store if it
    is complete, and goes on with it otherwise. No result depends on the client, the number of
    threads or the size of the blocks.

    Parameters
    ----------
    scene : path or module
        Scene file, or a module that `eomc.load` has loaded from one; with `batch = true`.
    over : dict, optional
        Grid: for each coordinate, rate (`theta_dot`), parameter or input a list of values, or
        {"from": 0, "to": 1, "n": 11, "scale": "log"}. Each is a dimension of the results.
    draws : dict, optional
        Distribution of each drawn quantity: a frozen distribution of scipy.stats, {"uniform": [low,
        high]}, {"normal": [mean, deviation]}, {"log_uniform": [low, high]} or {"truncated_normal":
        [mean, deviation, low, high]}. The draws are the same at every point of the grid.
    n : int, optional
        Number of draws, the dimension "draw". If a store holds the same sweep with fewer draws, the
        missing ones are added, except with the sampler "latin".
    sampler : str
        "random", "sobol" or "latin" (Latin hypercube).
    seed : int
        Seed of the draws.
    inputs : dict, optional
        Constant values of inputs, in place of the scene's signals.
    noise : dict, optional
        Distribution of the noise of inputs, as in `draws`. A new value in each `control_period` is
        added to the constant inputs, or to those of the policy.
    policy : callable, optional
        Function (t, q, qd) -> u of a batch, with q and qd (batch, nq) and u (batch, nu). It is
        called at the start of each `control_period` (by default of each step).
    outputs : list of str or callable, optional
        Columns of the run whose final values are stored, or whose values at `times`, if given;
        COLUMN.max and COLUMN.min are extremes over the run, EVENT.time and EVENT.COORDINATE belong
        to the first occurrence of an event, and EVENT.count is the number of its occurrences. By
        default all coordinates and rates. Or a function that receives a `BatchTrajectory`, and
        returns a dict of arrays (batch, ...).
    reduce : dict, optional
        Reductions over the draws, in place of the stored values: "mean" (and deviation),
        ("histogram", edges), ("quantile", probabilities), or a list of these.
    keep_draws : bool, optional
        Whether drawn values are stored; by default True without reductions.
    bits : str
        "portable" compiles without contraction to fused multiply-add, so that the results of scenes
        without functions of the C library do not depend on the processor; that takes a fifth more
        time. By default "native".
    out : path, optional
        Folder of the store, by default build/sweeps/NAME-DIGEST.zarr.
    client : optional
        None for threads of this process; a number of processes; an executor of
        `concurrent.futures`; a Dask client, or the address of its scheduler.
    threads : int, optional
        Number of threads of C for a block; by default all processors, or 1 with a client.
    block : int, optional
        Number of trajectories of a block, which is rounded to a power of two.
    part : (int, int), optional
        (k, n) with 1 <= k <= n: compute the k-th of n parts only.
    progress : callable, optional
        Called after each block with a `SweepProgress`, whose text is a line.
    **run
        Other arguments of `simulate_batch`: duration, h, steps, every, times, tol, control_period
        and others.

    Returns
    -------
    xarray.Dataset
        Read from the store when it is used. Its variable "status" is 0 for trajectories without
        failure, 255 for those that were not computed, and otherwise an index into the module's
        STATUS. The values of failed trajectories are nan.

    Raises
    ------
    SceneError
        If the scene is invalid.
    EomcError
        If an argument is wrong, the store belongs to another sweep, or the sweep can't go on.
    """
    arguments = SweepArguments(
        scene, over or {}, draws or {}, n, sampler, seed, inputs or {}, noise or {}, policy,
        outputs, reduce or {}, keep_draws, bits, run,
    )  # fmt: skip
    path, state = run_sweep(arguments, out, Execution(client, threads, block, part, progress))
    _warn(path, state, bool(reduce))
    return open_dataset(path)


@dataclass(frozen=True)
class PreparedSweep:
    """A checked sweep: its plan, the module of its scene, its functions and its folder."""

    plan: Plan
    model: Any
    function: OutputFunction | None
    policy: Policy | None
    path: Path

    @property
    def exists(self) -> bool:
        """True if the folder is the store of this sweep, False if it is missing or empty.

        Raises EomcError, with the differences, if it is the store of another sweep.
        """
        there = read_plan(self.path)
        if there is None:
            return False
        if lines := [*there.differences(self.plan)]:
            what = "holds another sweep: give another store, or delete it"
            raise EomcError("\n  ".join([f"{texts.line(str(self.path))}: {what}", *lines]))
        return True


def prepare_sweep(arguments: SweepArguments, out: str | Path | None) -> PreparedSweep:
    """Check the arguments of a sweep, and build the module of its scene."""
    _require_packages()
    scene = read_scene(arguments.scene)
    model = load_module(*scene, arguments.bits)
    plan = make_plan(arguments, model, scene)
    function = arguments.outputs if callable(arguments.outputs) else None
    path = Path(out or f"build/sweeps/{plan.name}-{plan.digest[:12]}.zarr").absolute()
    return PreparedSweep(plan, model, function, arguments.policy, path)


def run_sweep(
    arguments: SweepArguments, out: str | Path | None, execution: Execution,
    max_bytes: float = np.inf,
) -> tuple[Path, SweepProgress]:  # fmt: skip
    """Run a sweep; return the folder of its store, and its state at the end.

    max_bytes: size above which a store is not created without the option --yes.
    """
    part = _read_part(execution.part)
    _check_counts(execution)
    sweep = prepare_sweep(arguments, out)
    read_plan(sweep.path)  # raises an error before the lock file is created
    with writing(texts.line(str(sweep.path))):
        sweep.path.parent.mkdir(parents=True, exist_ok=True)
    with hold_store(sweep.path) if part is None else nullcontext():
        there = read_plan(sweep.path)
        if there is not None and part is None and there.can_grow_to(sweep.plan):
            Store(sweep.path).grow(sweep.plan)
        elif not sweep.exists:
            _create(sweep, execution, max_bytes)
        store = Store(sweep.path)
        numbers = [int(k) for k in np.flatnonzero(~store.finished())]
        if part is not None:
            numbers = [number for number in numbers if number % part[1] == part[0] - 1]
        state = compute_blocks(store, numbers, execution, (sweep.function, sweep.policy))
        # parts that run elsewhere included
        state.finished, state.processors = int(store.finished().sum()), store.count_processors()
        if part is None:
            store.remove_partial_files()
    return sweep.path, state


def _create(sweep: PreparedSweep, execution: Execution, max_bytes: float) -> None:
    """Create the store of a sweep, after a probe of its first trajectories."""
    plan, threads = sweep.plan, execution.threads_of_block
    probed = probe(sweep.model, plan, sweep.function, sweep.policy)
    size = execution.block or choose_block_size(plan, probed.seconds, threads, execution.workers)
    block = cut_block(plan, size)
    layouts = lay_out(plan, block, probed.quantities)
    if (size := sum(layout.bytes for layout in layouts.values())) > max_bytes:
        words = f"the store will have {size / 1e9:,.0f} GB"
        raise EomcError(f"{words}: reduce, or confirm it with --yes")
    facts = {"block": block, "rows": probed.rows, "status": sweep.model.STATUS}
    create_store(sweep.path, plan, layouts, facts)
    if not sweep.exists:
        raise EomcError(f"{texts.line(str(sweep.path))}: can't be written: give another folder")


def _require_packages() -> None:
    """Raise EomcError if a package that sweeps need is missing."""
    if missing := [name for name in ("scipy", "xarray", "zarr") if find_spec(name) is None]:
        raise EomcError(f"sweeps need more packages: pip install {' '.join(missing)}")


def _read_part(part: Any) -> tuple[int, int] | None:
    """Check the numbers (k, n) of a part, or its text "k/n"."""
    if part is None:
        return None
    with suppress(TypeError, ValueError):
        k, n = map(int, part.split("/") if isinstance(part, str) else part)
        if 1 <= k <= n:
            return k, n
    raise SweepError(("part",), f"give K/N with 1 <= K <= N, such as 3/100, here {part!r}")


def _check_counts(execution: Execution) -> None:
    """Raise SweepError for numbers of processes, threads or trajectories below 1."""
    for name in ("client", "threads", "block"):
        if isinstance(value := getattr(execution, name), int) and value < 1:
            raise SweepError((name,), f"give 1 or more, here {value}")


def _warn(path: Path, state: SweepProgress, reduces: bool) -> None:
    """Warn of failed trajectories, missing blocks and different processors."""
    lines = [f"block {k} was left out: {why}" for k, why in sorted(state.excluded.items())]
    if state.failures:
        kinds = ", ".join(f"{n:,} {status}" for status, n in sorted(state.failures.items()))
        failed = f"{sum(state.failures.values()):,} of {state.trajectories:,}"
        lines.append(f"{failed} trajectories failed ({kinds}): see ds.status")
    if state.processors > 1:
        lines.append("workers have different processors, so last digits may differ: see bits")
    if state.finished < state.blocks:
        what = "; reductions are of these alone" if reduces else ""
        there = f"{state.finished} of {state.blocks} blocks are finished{what}"
        lines.append(f"{texts.line(str(path))}: {there}")
    for line in lines:
        warnings.warn(line, RuntimeWarning, stacklevel=3)
