"""Share of the workers' time that a sweep spends in simulate_batch, by engine and size of blocks.

python benchmarks/sweep.py [--trajectories 1_000_000] [--workers 1] [--engine pool|dask]

Scene: a cart-pole of 10 s in 2,000 RK4 steps; two drawn quantities; four numbers and a status are
stored, without the draws. First, the engine's start and its rate of empty tasks are measured. The
share is measured by the clocks of the workers, since wall time on a shared machine says little. It
is at least 0.9 at blocks of 65,536 or the benchmark fails.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from eomc.sweeps.block import load_module
from eomc.sweeps.plan import SweepArguments
from eomc.sweeps.sweep import Execution, SweepProgress, run_sweep

SCENE = Path(__file__).parents[1] / "scenes" / "cartpole.toml"
DRAWS = {"theta": {"uniform": [-3, 3]}, "m_p": {"normal": [2, 0.1]}}
LEAST_SHARE, LARGE_BLOCK = 0.9, 65_536
TASKS = 1000


def raw_rate(model: Any, count: int = 1 << 16, batch: int = 4096) -> float:
    """Return trajectories a second of simulate_batch alone, in one thread."""
    q0 = np.column_stack([np.zeros(batch), np.random.default_rng(0).uniform(-3, 3, batch)])
    arguments = {"steps": 2000, "every": 2000, "params": {"m_p": np.full(batch, 2.0)}, "threads": 1}
    started_at = time.perf_counter()
    for _ in range(count // batch):
        model.simulate_batch(q0, np.zeros((batch, 2)), **arguments)
    return count / (time.perf_counter() - started_at)


def run(scene: Path, folder: Path, n: int, block: int | None, client: Any) -> SweepProgress:
    out = folder / "benchmark.zarr"
    shutil.rmtree(out, ignore_errors=True)
    arguments = SweepArguments(scene, draws=DRAWS, n=n, keep_draws=False)
    return run_sweep(arguments, out, Execution(client, 1, block))[1]


def report(name: str, raw: float, state: SweepProgress, workers: int) -> float:
    share = state.simulation_seconds / state.worker_seconds
    rate = state.trajectories / state.seconds
    print(
        f"{name:>16}: raw {raw:9,.0f}/s, sweep {rate:9,.0f}/s = {rate / raw / workers:5.3f}; "
        f"{share:5.3f} of the workers' time in simulate_batch",
        flush=True,
    )
    return share


@contextmanager
def start_engine(name: str, workers: int) -> Iterator[Any]:
    """Yield a pool of processes or a client of Dask; print its time to start and for a task."""
    started_at = time.perf_counter()
    engine: Any
    if name == "pool":
        engine = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    else:
        from distributed import Client

        engine = Client(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    with engine:
        executor = engine if name == "pool" else engine.get_executor(pure=False)
        executor.submit(abs, 0).result()
        ready_at = time.perf_counter()
        for future in [executor.submit(abs, k) for k in range(TASKS)]:
            future.result()
        rate = TASKS / (time.perf_counter() - ready_at)
        print(f"{name}: start {ready_at - started_at:.1f} s, {rate:,.0f} empty tasks/s")
        yield engine


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=1_000_000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--engine", choices=("pool", "dask"), default="pool")
    options = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = folder / "cartpole.toml"
        scene.write_text(SCENE.read_text().replace("[run]", "[run]\nbatch = true"))
        model = load_module("cartpole", scene.read_text())
        raw_rate(model)
        with start_engine(options.engine, options.workers) as engine:
            run(scene, folder, 4096, 256, engine)  # imports and builds on the workers
            for block in (4096, 16_384, LARGE_BLOCK, 2 * LARGE_BLOCK):
                n = max(1 << 17, 4 * block * options.workers)
                raw, state = raw_rate(model), run(scene, folder, n, block, engine)
                share = report(f"blocks of {block:,}", raw, state, options.workers)
                failed |= block == LARGE_BLOCK and share < LEAST_SHARE
            raw = raw_rate(model)
            state = run(scene, folder, options.trajectories, None, engine)
            report(f"{options.trajectories:,}", raw, state, options.workers)
        files = [file for file in folder.rglob("benchmark.zarr/**/*") if file.is_file()]
        size = sum(file.stat().st_size for file in files)
    memory = [resource.getrusage(who).ru_maxrss / 1024 for who in (0, resource.RUSAGE_CHILDREN)]
    print(f"{size / options.trajectories:.1f} bytes a trajectory in {len(files)} files")
    print(f"largest memory: {memory[0]:.0f} MB of the client, {memory[1]:.0f} MB of a worker")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
