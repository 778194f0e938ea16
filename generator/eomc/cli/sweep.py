"""eomc sweep: many trajectories of a scene, on one machine or a cluster."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from eomc.base.errors import EomcError
from eomc.cli import options
from eomc.cli.options import escape_line, progress_bar, say

if TYPE_CHECKING:
    from eomc.sweeps.engines import SweepProgress
    from eomc.sweeps.plan import SweepArguments

MAX_BYTES = 10 * 10**9  # of a store that is created without --yes


@click.command("sweep")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--over", multiple=True, metavar="NAME=A:B:N", help="An axis; or NAME=A,B,C.")
@click.option(
    "--draw", "draws", multiple=True, metavar="NAME=KIND:A,B",
    help="A drawn quantity, such as m=normal:2,0.1 or l=uniform:0,1.",
)  # fmt: skip
@click.option("--n", type=click.IntRange(1), help="Number of draws, such as 10_000.")
@click.option("--sampler", help="random, sobol or latin.")
@click.option("--seed", type=click.IntRange(0), help="Seed of the draws.")
@click.option("--keep", metavar="A,B", help="Stored columns, such as theta,x.max.")
@click.option("--duration", type=float, help="Simulated time, s.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the store.")
@click.option("--workers", type=click.IntRange(1), help="Number of processes.")
@click.option("--scheduler", metavar="ADDRESS", help="Dask's scheduler, such as tcp://host:8786.")
@click.option("--threads", type=click.IntRange(1), help="Threads of C for a block.")
@click.option("--part", metavar="K/N", help="Compute the K-th of N parts, for an array of jobs.")
@click.option("--status", is_flag=True, help="Print what is finished, and compute nothing.")
@click.option("--plot", type=click.Path(path_type=Path), help="Draw the first quantity into FILE.")
@click.option("--parquet", type=click.Path(path_type=Path), help="Write the values into DIR.")
@click.option("--yes", is_flag=True, help="Create a store of more than 10 GB.")
@options.QUIET
@options.JSON
@options.parse_into(SimpleNamespace)
def sweep_command(command: SimpleNamespace) -> None:
    """Simulate a scene for many values of its quantities, into a store on disk.

    FILE is the file of a sweep, or a scene with --over or --draw. The same command goes on with a
    sweep that was interrupted.

    \b
    eomc sweep basin.toml --plot basin.png
    eomc sweep scene.toml --over m_p=1:3:100 --draw l=normal:2,0.1 --n 10_000
    """
    from eomc.sweeps.plan import SweepError, place_error, read_file

    arguments, places = read_file(command.file)
    try:
        _run(command, _with_options(arguments, command))
    except SweepError as fault:
        if places.source(fault.path):
            raise place_error(fault, places) from None
        raise
    except KeyboardInterrupt:
        say("eomc: interrupted: what is finished stays, and the same command goes on", err=True)
        sys.exit(130)


def _with_options(arguments: SweepArguments, command: SimpleNamespace) -> SweepArguments:
    """Return the arguments in the file, with those of the command line in their place."""
    changes: dict[str, Any] = {
        "over": {**arguments.over, **dict(map(_read_axis, command.over))},
        "draws": {**arguments.draws, **dict(map(_read_draw, command.draws))},
    }
    values = {name: x for name, x in vars(command).items() if x is not None}
    changes |= {name: values[name] for name in ("n", "sampler", "seed") if name in values}
    if "keep" in values:
        changes["outputs"] = command.keep.split(",")
    if "duration" in values:
        changes["run"] = {**arguments.run, "duration": command.duration}
    return replace(arguments, **changes)


def _read_axis(option: str) -> tuple[str, Any]:
    """Return the name and the axis of NAME=A:B:N or NAME=A,B,C."""
    name, _, text = option.partition("=")
    try:
        if ":" not in text:
            return name.strip(), [float(x) for x in text.split(",")]
        low, high, n = text.split(":")
        return name.strip(), {"from": float(low), "to": float(high), "n": int(n)}
    except ValueError:
        what = "NAME=FROM:TO:N, such as l=0:1:11, or NAME=A,B,C, such as l=1,2,4"
        raise EomcError(f"--over {option}: write {what}") from None


def _read_draw(option: str) -> tuple[str, dict[str, list[float]]]:
    """Return the name and the distribution of NAME=KIND:A,B."""
    name, _, text = option.partition("=")
    kind, _, numbers = text.partition(":")
    try:
        return name.strip(), {kind: [float(x) for x in numbers.split(",")]}
    except ValueError:
        what = "NAME=KIND:A,B, such as m=normal:2,0.1"
        raise EomcError(f"--draw {option}: write {what}") from None


def _run(command: SimpleNamespace, arguments: SweepArguments) -> None:
    """Run a sweep, or print its status; then draw, export and print what the options name."""
    from eomc.sweeps import store
    from eomc.sweeps.engines import Execution
    from eomc.sweeps.sweep import prepare_sweep, run_sweep

    options.check_target(command.plot, (".png", ".pdf", ".svg"), "--plot")
    if command.workers is not None and command.scheduler is not None:
        raise EomcError("--workers and --scheduler: choose one")
    if command.status:
        if command.plot or command.parquet:
            raise EomcError("--status computes and writes nothing: leave out --plot and --parquet")
        _print_status(command, prepare_sweep(arguments, command.out))
        return
    client = command.scheduler if command.workers is None else command.workers
    silent = command.quiet or command.as_json
    with progress_bar("sweep", silent) as update:
        progress = None if silent else _log_progress(update)
        execution = Execution(client, command.threads, None, command.part, progress)
        max_bytes = math.inf if command.yes else MAX_BYTES
        path, state = run_sweep(arguments, command.out, execution, max_bytes)
    if command.plot is not None:
        store.draw_plot(path, command.plot)
    if command.parquet is not None:
        store.write_parquet(path, command.parquet)
    _print_end(command, path, state)
    sys.exit(1 if state.excluded else 0)


def _log_progress(update: Callable[..., None]) -> Callable[[SweepProgress], None]:
    """Return a function that shows the progress: in a bar, and elsewhere in a line every 30 s."""
    next_time = time.monotonic() + 30.0

    def show(state: SweepProgress) -> None:
        nonlocal next_time
        update(state.finished, state.blocks, str(state))
        if not sys.stderr.isatty() and time.monotonic() >= next_time:
            next_time += 30.0
            say(str(state), err=True)

    return show


def _print_status(command: SimpleNamespace, sweep: Any) -> None:
    """Print how many blocks of a sweep are finished."""
    from eomc.sweeps.store import Store

    store = Store(sweep.path) if sweep.exists else None
    blocks, finished = (store.blocks, int(store.finished().sum())) if store else (0, 0)
    values = {"store": str(sweep.path), "blocks": blocks, "finished": finished}
    state = f"{finished} of {blocks} blocks are finished" if store else "has not started"
    words = f"{escape_line(sweep.path)}: {state}, {sweep.plan.size:,} trajectories"
    say(json.dumps(values, indent=1) if command.as_json else words)


def _print_end(command: SimpleNamespace, path: Path, state: SweepProgress) -> None:
    """Print what a sweep has computed."""
    if command.as_json:
        names = ("blocks", "finished", "trajectories", "seconds", "failures", "excluded")
        values = {name: getattr(state, name) for name in names}
        say(json.dumps({"store": str(path), **values}, indent=1))
        return
    for number, why in sorted(state.excluded.items()):
        say(f"block {number} was left out: {why}", err=True)
    if not command.quiet:
        say(f"{escape_line(path)}: {state}")
        for status, count in sorted(state.failures.items()):
            say(f"  {count:,} failed: {status}")
        for file in filter(None, (command.plot, command.parquet)):
            say(f"wrote {escape_line(file)}")
