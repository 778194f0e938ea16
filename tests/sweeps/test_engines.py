"""Engines of sweeps: executors, processes, Dask; lost workers, and what users are told."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
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


class CountingExecutor(ThreadPoolExecutor):
    """A pool of threads that counts the tasks in work."""

    most = 0

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        future = super().submit(function, *arguments, **options)
        self.futures = [f for f in (*getattr(self, "futures", ()), future) if not f.done()]
        self.most = max(self.most, len(self.futures))
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


def test_four_blocks_for_each_worker_are_submitted_at_a_time(scene: Path, tmp_path: Path) -> None:
    with CountingExecutor(1) as executor:
        sweep(scene, **SWEEP | {"n": 2000}, block=256, client=executor, out=tmp_path / "a.zarr")
    assert executor.most <= 4


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
        for name, engine in (("a", client), ("b", cluster.scheduler_address)):
            dataset = sweep(scene, **SWEEP, block=256, client=engine, out=tmp_path / name)
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


def start_executor(name: str) -> Any:
    """Return an executor of three processes."""
    if name == "concurrent.futures":
        return ProcessPoolExecutor(3, get_context("spawn"))
    if name == "loky":
        return pytest.importorskip("loky").get_reusable_executor(3)
    if name == "distributed":
        distributed = pytest.importorskip("distributed")
        options = {"n_workers": 3, "threads_per_worker": 1, "dashboard_address": None}
        return distributed.Client(**options).get_executor(pure=False)
    pytest.importorskip("mpi4py")
    try:
        from mpi4py.futures import MPIPoolExecutor
    except RuntimeError as fault:
        pytest.skip(f"needs an MPI library: {fault}")
    return MPIPoolExecutor(3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["concurrent.futures", "loky", "distributed", "mpi4py"])
def test_each_executor_gives_the_same_bits(
    name: str, reference: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All workers begin with a build, at the same time."""
    monkeypatch.setenv("EOMC_CACHE", str(tmp_path / "cache"))
    with start_executor(name) as executor:
        dataset = sweep(scene, **SWEEP, block=256, client=executor, out=tmp_path / "a.zarr")
    assert are_equal(reference, dataset)
    assert len([*tmp_path.glob("cache/sweeps/*/sweep_pendulum/build.json")]) == 1


def set_variables(values: dict[str, str]) -> None:
    os.environ.update(values)


@pytest.mark.slow
def test_a_worker_without_a_compiler_is_named(scene: Path, tmp_path: Path) -> None:
    environment = {"EOMC_CACHE": str(tmp_path / "cache"), "CC": "missing-compiler"}
    with (
        ProcessPoolExecutor(1, get_context("spawn"), set_variables, (environment,)) as pool,
        pytest.raises(EomcError, match=r"worker .*:\d+: .*missing-compiler"),
    ):
        sweep(scene, over={"m": [1, 2]}, client=pool, out=tmp_path / "a.zarr")


SMALL_DISC = """
import subprocess, sys
from pathlib import Path
from eomc.base.errors import EomcError
from eomc.sweeps.store import Store
from eomc.sweeps.sweep import sweep
scene, folder, copy = sys.argv[1:]
def mount(*options):
    subprocess.run(["mount", "-t", "tmpfs", *options, "none", folder], check=True)
def run():
    sweep(scene, draws={draws!r}, n=100_000, block=4096, threads=1, out=Path(folder, "a.zarr"))
mount("-o", "size=1m")
try:
    run()
except EomcError as fault:
    print(fault, int(Store(Path(folder, "a.zarr")).finished().sum()))
mount("-o", "remount,size=100m")
run()
subprocess.run(["cp", "-r", Path(folder, "a.zarr"), copy], check=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs the program unshare")
def test_a_sweep_goes_on_when_a_small_file_system_has_room(scene: Path, tmp_path: Path) -> None:
    own = ["unshare", "--map-root-user", "--mount"]
    (tmp_path / "disc").mkdir()
    if subprocess.run(
        [*own, "mount", "-t", "tmpfs", "none", tmp_path / "disc"], check=False
    ).returncode:
        pytest.skip("mounts no file system")
    run = [sys.executable, "-c", SMALL_DISC.format(draws=SWEEP["draws"])]
    folders = [str(scene), str(tmp_path / "disc"), str(tmp_path / "a.zarr")]
    result = subprocess.run([*own, *run, *folders], capture_output=True, text=True, check=False)
    match = re.match(r"no room left on the disc: (\d+) of 25 .* run it again (\d+)$", result.stdout)
    assert match and int(match[1]) <= int(match[2]) < 25, result  # other workers may finish theirs
    again, whole = (
        sweep(scene, **SWEEP | {"n": 100_000}, block=4096, out=tmp_path / name)
        for name in ("a.zarr", "b.zarr")
    )
    assert are_equal(again, whole)


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
