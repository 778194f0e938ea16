"""The function `eomc.sweep`: plan, store, blocks, Dataset."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.sweeps.block import load_module, probe
from eomc.sweeps.engines import Execution, SweepProgress, compute_blocks
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
