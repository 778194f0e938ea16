"""Engines of sweeps: executors, processes, Dask; lost workers, and what users are told."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sweep_scene import SCENE, SWEEP, are_equal

from eomc.base.errors import EomcError
from eomc.sweeps.store import NOT_RUN, Store
from eomc.sweeps.sweep import sweep

pytest.importorskip("zarr")
pytest.importorskip("xarray")


class KilledWorker(Exception):  # noqa: N818 - the name that Dask uses
    """The name of the error that Dask raises after four losses of a worker."""


class InlineExecutor(Executor):
    """Runs each task at once; raises an error for the tasks that `fault` names."""

    def __init__(self, fault: Callable[[int], Exception | None] = lambda number: None) -> None:
        self.fault, self.numbers = fault, list[int]()

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = Future()
        (task,) = arguments
        self.numbers.append(task.number)
        if fault := self.fault(task.number):
            future.set_exception(fault)
        else:
            future.set_result(function(pickle.loads(pickle.dumps(task))))
        return future


def ends(runs: Any) -> dict[str, Any]:
    return {"theta": runs["theta"][:, -1], "theta_dot": runs["theta_dot"][:, -1]}


def ends_or_kill(runs: Any) -> dict[str, Any]:
    """Kill the process at the last point of the axis m."""
    if runs.request.p[-1, 0] == 8.0:
        os.kill(os.getpid(), signal.SIGKILL)
    return ends(runs)


def test_an_executor_gives_the_same_bits(reference: Any, scene: Path, tmp_path: Path) -> None:
    executor = InlineExecutor()
    dataset = sweep(scene, **SWEEP, block=256, client=executor, out=tmp_path / "a.zarr")
    assert are_equal(reference, dataset) and executor.numbers == [0, 1, 2, 3, 4]


def test_a_block_that_kills_its_workers_is_left_out(scene: Path, tmp_path: Path) -> None:
    executor = InlineExecutor(lambda number: KilledWorker() if number == 1 else None)
    arguments = SWEEP | {"block": 256, "client": executor, "out": tmp_path / "a.zarr"}
    with (
        pytest.warns(RuntimeWarning, match="block 1 was left out: it ended its worker 4 times"),
        pytest.warns(RuntimeWarning, match="4 of 5 blocks are finished"),
    ):
        dataset = sweep(scene, **arguments)
    assert np.flatnonzero(dataset["status"] == NOT_RUN).tolist() == [*range(256, 512)]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (BrokenExecutor(), "a worker process ended: 3 of 5 blocks are finished: run the same"),
        (OSError(28, "No space"), "no room left on the disc: 3 of 5 blocks are finished"),
        (pickle.PicklingError("Can't pickle <lambda>"), "write a function into a file"),
        (ConnectionError("no route"), "no route"),
    ],
)
def test_what_ends_a_sweep_is_told_with_the_remedy(
    fault: Exception, message: str, scene: Path, tmp_path: Path
) -> None:
    executor = InlineExecutor(lambda number: fault if number == 2 else None)
    error = EomcError if "no route" not in message else ConnectionError
    with pytest.raises(error, match=message):
        sweep(
            scene, draws=SWEEP["draws"], n=1100, outputs=ends, block=256, client=executor,
            out=tmp_path / "a.zarr",
        )  # fmt: skip


def test_an_error_of_a_worker_names_it(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: str) -> None:
        raise EomcError("no C compiler found")

    with monkeypatch.context() as patch:
        patch.setattr("eomc.sweeps.block.load_module", fail)
        patch.setattr("eomc.sweeps.sweep.process_name", lambda: ("elsewhere", 1))
        with pytest.raises(EomcError, match=rf"worker .*:{os.getpid()}: no C compiler found"):
            sweep(scene, over={"m": [1, 2]}, client=InlineExecutor(), out=tmp_path / "a.zarr")


def test_dask_in_this_process(reference: Any, scene: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False}
    with (
        distributed.LocalCluster(**options, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        dataset = sweep(scene, **SWEEP, block=256, client=client, out=tmp_path / "a.zarr")
    assert are_equal(reference, dataset)


def test_missing_scheduler_is_reported(scene: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(EomcError, match="no Dask scheduler at nowhere"):
        sweep(scene, over={"m": [1]}, client="nowhere", out=tmp_path / "a.zarr")


def test_missing_package_of_dask_is_named(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    with pytest.raises(EomcError, match="pip install distributed"):
        sweep(scene, over={"m": [1]}, client="tcp://host:1", out=tmp_path / "a.zarr")


# --- processes ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_processes_give_the_same_bits_and_a_poisoned_block_is_left_out(
    reference: Any, scene: Path, tmp_path: Path
) -> None:
    dataset = sweep(scene, **SWEEP, block=256, client=2, out=tmp_path / "a.zarr")
    assert are_equal(reference, dataset)
    arguments: dict[str, Any] = {"over": {"m": range(1, 13)}, "draws": SWEEP["draws"], "n": 256}
    arguments["draws"] = {"theta": SWEEP["draws"]["theta"]}
    with pytest.warns(RuntimeWarning, match="block 7 was left out: it ended its process twice"):
        dataset = sweep(
            scene, **arguments, block=256, client=2, outputs=ends_or_kill, out=tmp_path / "b.zarr"
        )
    not_run = (dataset["status"] == NOT_RUN).all("draw")
    assert not_run.values.tolist() == [m == 8 for m in range(1, 13)]


@pytest.mark.slow
def test_a_lambda_for_a_pool_is_refused(scene: Path, tmp_path: Path) -> None:
    with (
        ProcessPoolExecutor(1, get_context("spawn")) as pool,
        pytest.raises(EomcError, match="write a function into a file, or use Dask"),
    ):
        sweep(
            scene, over={"m": [1, 2]}, client=pool, out=tmp_path / "a.zarr",
            outputs=lambda runs: {"a": runs["theta"][:, -1]},
        )  # fmt: skip


CLIENT = """
import sys
from eomc.sweeps.sweep import sweep
if __name__ == "__main__":
    scene, out, workers = sys.argv[1:]
    sweep(scene, draws={draws!r}, n=4000, duration=20.0, threads=1, block=256,
          client=int(workers) or None, out=out, progress=lambda state: print("block", flush=True))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "workers"),
    [(signal.SIGKILL, 0), (signal.SIGKILL, 2), (signal.SIGINT, 0), (signal.SIGINT, 2)],
)
def test_a_client_that_is_killed_goes_on(
    number: signal.Signals, workers: int, scene: Path, tmp_path: Path
) -> None:
    script, out = tmp_path / "client.py", tmp_path / "a.zarr"
    script.write_text(CLIENT.format(draws=SWEEP["draws"]))
    command = [sys.executable, str(script), str(scene), str(out), str(workers)]
    for _ in range(2):
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            started_at = time.monotonic()
            process.send_signal(number)
            process.communicate(timeout=60)  # until its workers have ended too
            assert time.monotonic() - started_at < 10
        store = Store(out)
        assert 0 < store.finished().sum() < store.blocks
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0
    again = sweep(scene, draws=SWEEP["draws"], n=4000, duration=20.0, out=out)
    whole = sweep(scene, draws=SWEEP["draws"], n=4000, duration=20.0, out=tmp_path / "b.zarr")
    assert are_equal(again, whole)
    assert not [*out.rglob("*.partial")]


@pytest.mark.slow
def test_dask_goes_on_without_killed_workers(reference: Any, scene: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    killed: list[int] = []

    def kill_a_worker(state: Any) -> None:
        if len(killed) < 2:
            killed.append(processes.pop())
            os.kill(killed[-1], signal.SIGKILL)

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as c,
        distributed.Client(c) as client,
    ):
        processes = [*client.run(os.getpid).values()]
        arguments = SWEEP | {"block": 256, "client": client, "progress": kill_a_worker}
        dataset = sweep(scene, **arguments, out=tmp_path / "a.zarr")
        assert len(killed) == 2 and are_equal(reference, dataset)
        over: dict[str, Any] = {"m": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]}
        draws = {"theta": SWEEP["draws"]["theta"]}
        with pytest.warns(RuntimeWarning, match="block 7 was left out: it ended its worker"):
            dataset = sweep(
                scene, over=over, draws=draws, n=256, block=256, client=client,
                outputs=ends_or_kill, out=tmp_path / "b.zarr",
            )  # fmt: skip
    assert int((dataset["status"] == NOT_RUN).sum()) == 256


@pytest.mark.slow
def test_a_sweep_goes_on_after_the_loss_of_the_scheduler(
    reference: Any, scene: Path, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    address, out = tmp_path / "scheduler.json", tmp_path / "a.zarr"
    run = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0"]
    options = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(address)]
    with subprocess.Popen([*run, *options], stderr=subprocess.DEVNULL) as scheduler:
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny"]
        worker += ["--scheduler-file", str(address), "--death-timeout", "5"]
        with subprocess.Popen(worker, stderr=subprocess.DEVNULL) as process:
            client = distributed.Client(scheduler_file=str(address), timeout=60)
            client.wait_for_workers(1, timeout=60)
            arguments = SWEEP | {"block": 256, "client": client}
            with pytest.raises(EomcError, match=r"the scheduler was lost: .*run the same again"):
                sweep(scene, **arguments, out=out, progress=lambda state: scheduler.kill())
            client.close(timeout=1)
            process.terminate()
    assert Store(out).finished().any()
    assert are_equal(reference, sweep(scene, **SWEEP, out=out))


def test_the_scene_of_these_tests_has_the_parameter_m_first() -> None:
    """`ends_or_kill` reads it."""
    assert SCENE.index("m = 1.0") < SCENE.index("l = 1.0")
