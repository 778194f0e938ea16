"""eomc run: a simulation; eomc sweep: many trajectories; eomc fit: estimates from a log."""

from __future__ import annotations

import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.cli import options
from eomc.cli.options import escape_line, parse_pairs, progress_bar, say, status_line, warn
from eomc.runtime.package import model_of

if TYPE_CHECKING:
    from eomc.runtime.balance import Balance
    from eomc.runtime.estimate import Estimate
    from eomc.runtime.trajectory import Trajectory
    from eomc.sweeps.plan import SweepArguments
    from eomc.sweeps.sweep import SweepProgress


# hints for options of other programs
_OPTION_HINTS = {
    "--rate": "a velocity begins by --start NAME_dot=VALUE",
    "--param": "a parameter is --set NAME=VALUE",
    "--params": "a parameter is --set NAME=VALUE",
    "--dt": "the step size is --h",
}


class _RunCommand(click.Command):
    """The command, with hints for options of other names."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(context, args)
        except click.NoSuchOption as fault:
            if not (hint := _OPTION_HINTS.get(fault.option_name)):
                raise
            words = f"No such option '{fault.option_name}': {hint}"
            raise click.UsageError(words, context) from None


@dataclass(frozen=True)
class Simulation:
    """A run, the computing time in s, and remarks on its step size and its duration.

    beyond_stability: remark if the step size is beyond the stability limit; else None.
    beyond_duration: remark if the step size is longer than the duration; else None.
    """

    run: Trajectory
    seconds: float
    beyond_stability: str | None
    beyond_duration: str | None

    @property
    def is_short(self) -> bool:
        """True if an error estimate and an energy balance, which take longer, are affordable."""
        return self.seconds < 2


@click.command("run", cls=_RunCommand)
@options.SCENE
@options.BUILD
@options.SET
@options.START
@click.option(
    "--input", "inputs", multiple=True, metavar="NAME=VALUE",
    help="Constant value of an input; the others have the scene's signals.",
)  # fmt: skip
@click.option("--h", "h", type=float, help="Step size in s, instead of the scene's.")
@click.option("--duration", type=float, help="Duration in s, instead of the scene's.")
@click.option("--method", help="Integration method of the scene, or auto; by default its first.")
@click.option("--tol", type=float, help="Tolerance of adaptive steps, instead of the scene's.")
@click.option(
    "--event", multiple=True, metavar="NAME=FORMULA", help="Print when a formula crosses zero."
)
@click.option("--every", type=click.IntRange(1), default=1, help="Store every N-th step.")
@click.option("--out", type=options.PATH, help="Write the rows: FILE.csv or FILE.npz.")
@click.option("--plot", type=options.PATH, help="Plot them: FILE.png, .svg or .pdf.")
@click.option("--wrap", is_flag=True, help="Draw angles from -pi to pi in --plot.")
@click.option(
    "--animate",
    type=options.PATH,
    help="Animate them: FILE.html, a page; FILE.gif or .mp4, a film.",
)
@options.QUIET
@options.JSON
@options.as_namespace
def run_command(arguments: SimpleNamespace) -> None:
    """Simulate a scene; print the final state, its error and the speed.

    \b
    eomc run scenes/cartpole.toml --plot cartpole.png
    eomc run scenes/cartpole.toml --animate cartpole.html
    eomc run scenes/cartpole.toml --set m_c=3 --start theta=pi/3 --out run.csv
    """
    out, plot, animate = arguments.out, arguments.plot, arguments.animate
    options.check_target(out, (".csv", ".npz"), "--out")
    options.check_target(plot, (".png", ".svg", ".pdf"), "--plot")
    options.check_target(animate, (".html", ".gif", ".mp4"), "--animate")
    if arguments.wrap and not plot:
        raise EomcError("--wrap: says how --plot draws angles: give --plot FILE.png too")
    scene, silent = arguments.scene, arguments.silent
    with status_line(f"building {scene.stem}", silent):
        module = _with_events(pipeline.load(scene, arguments.root, warn=warn), arguments.event)
    parameters, q0, qd0 = _overrides(scene, module, arguments.parameters, arguments.start)
    u = _fixed_inputs(scene, module, arguments.inputs, parameters)
    simulation = _simulate(module, arguments, {"params": parameters, "q0": q0, "qd0": qd0, "u": u})
    run = simulation.run
    interrupted = run.status == "interrupted"
    if run.status == "ok" and simulation.is_short:
        try:
            with progress_bar("finding its error", silent) as progress, _without_warnings():
                run.estimate(progress)
        except module.Interrupted:  # the run itself is whole
            interrupted = True
    if out:
        with writing(escape_line(out)):
            run.save(out)
    has_work = model_of(module).functions.has_power or len(run.events) > 0  # forces, or jumps
    balance = run.balance() if has_work and simulation.is_short else None
    if plot:
        from eomc.report.plot import write_figure

        system = pipeline.read(scene).with_parameters(parameters)
        words = balance.words if balance else ""
        write_figure(system, run, plot, wrap=arguments.wrap, balance=words)
    if animate:
        with status_line(f"drawing {animate.name}", silent):
            run.animate(animate)
    files = [str(file) for file in (plot, animate, out) if file]
    summary = _summary(module, simulation, balance, files)
    if arguments.as_json:
        say(json.dumps(summary, indent=1))
    elif not arguments.quiet:
        _print_summary(module, run, balance, summary)
    complete = run.status in ("ok", "accumulated") and not run.broken_constraints
    if run.status != "ok":
        say(f"eomc: {run.message}", err=True)
    if interrupted or not complete:
        sys.exit(130 if interrupted else 1)


def _simulate(module: Any, arguments: SimpleNamespace, start: Mapping[str, Any]) -> Simulation:
    """Simulate, and note whether the step size and the duration are suitable.

    start: arguments of `simulate` for the parameters, the initial state and the inputs.
    """
    from eomc.runtime.requests import beyond_end

    h, method, tol, model = arguments.h, arguments.method, arguments.tol, model_of(module)
    beyond_stability = beyond_duration = None
    try:
        adaptive = model.info.tolerance and h is None and method is None
        if tol is None and method != "auto" and not adaptive:
            beyond_stability = module.advice(**start, h=h, method=method)
            span = model.info.duration if arguments.duration is None else arguments.duration
            beyond_duration = beyond_end(model.info.h if h is None else h, span)
        with progress_bar("running", arguments.silent) as progress:
            started_at = time.perf_counter()
            with _without_warnings():
                run = module.simulate(
                    **start, h=h, duration=arguments.duration, method=method, tol=tol,
                    every=arguments.every, progress=progress,
                )  # fmt: skip
            seconds = time.perf_counter() - started_at
    except module.Interrupted as stop:  # the rows so far are written
        run, seconds = stop.run, time.perf_counter() - started_at
    except (ValueError, MemoryError, module.MotionError) as fault:
        raise EomcError(str(fault).replace("every=", "--every")) from None
    return Simulation(run, seconds, beyond_stability, beyond_duration)


def _with_events(module: ModuleType, arguments: Sequence[str]) -> ModuleType:
    """Return the module of the scene with additional events NAME=FORMULA."""
    events: dict[str, str] = {}
    for pair in arguments:
        name, equals, formula = pair.partition("=")
        if not equals:
            raise EomcError(f"--event {pair}: write --event NAME=FORMULA, as in low=theta2")
        events[name.strip()] = formula.strip()
    if not events:
        return module
    try:
        return pipeline.with_events(model_of(module), events, Path(str(module.__file__)).parent)
    except EomcError as fault:
        raise EomcError(str(fault).replace("simulate(events=)", "--event")) from None


def _without_warnings() -> AbstractContextManager[Any]:
    """Suppress warnings, which are part of the summary."""
    return warnings.catch_warnings(action="ignore", category=RuntimeWarning)


def _overrides(
    scene: Path, module: Any, parameters: Sequence[str], start: Sequence[str]
) -> tuple[dict[str, float], Any, Any]:
    """Return the parameters and the initial state, given NAME=VALUE pairs."""
    from eomc.scene.formulas import suggest

    values: dict[str, float] = {}
    for name, value in parse_pairs(parameters, "--set", module.defaults):
        if name not in module.defaults:
            remedy = suggest(name, module.defaults) or _available(module.defaults)
            if name in module.inputs:
                remedy = f", but an input: --input {name}={value:g}"
            for kind, coordinate in (("coordinate", name), ("velocity", name.removesuffix("_dot"))):
                if coordinate in module.coordinates:
                    kind = (
                        "state that jumps set"
                        if coordinate in model_of(module).info.discrete_coordinates
                        else kind
                    )
                    remedy = f", but a {kind}: --start {name}={value:g}"
                    break
            raise EomcError(f"--set: '{name}' is not a parameter{remedy}")
        values[name] = value
    q0, qd0 = module.start
    if values:  # the start may be a formula in the parameters
        from eomc.scene import read as scenes

        for values_of_state, own in zip((q0, qd0), scenes.read(scene, values).start(), strict=True):
            values_of_state[: len(own)] = (
                own  # and may be bad for a body; behind them is what jumps set
            )
    states = {name: (q0, k) for k, name in enumerate(module.coordinates)}
    states |= {f"{name}_dot": (qd0, k) for k, name in enumerate(module.coordinates)}
    for name, value in parse_pairs(start, "--start", {**module.defaults, **values}):
        if name not in states:
            remedy = suggest(name, states) or _available(states)
            raise EomcError(f"--start: '{name}' is not a coordinate or velocity{remedy}")
        array, k = states[name]
        array[k] = value
    return values, q0, qd0


def _fixed_inputs(
    scene: Path, module: Any, arguments: Sequence[str], parameters: Mapping[str, float]
) -> dict[str, float] | None:
    """Return all inputs held constant over the run; None if signals are used.

    Inputs that are not given are held at their signals, which must be constant.
    """
    from eomc.scene.formulas import suggest

    values = dict(parse_pairs(arguments, "--input", {**module.defaults, **parameters}))
    for name in values:
        if name not in module.inputs:
            remedy = suggest(name, module.inputs)
            remedy = remedy or (_available(module.inputs) if module.inputs else ": there are none")
            raise EomcError(f"--input: '{name}' is not an input{remedy}")
    if not values or not (missing := [name for name in module.inputs if name not in values]):
        return values or None
    if moving := [name for name in _varying_inputs(scene) if name in missing]:
        names = texts.listed(moving)
        raise EomcError(
            f"--input: the scene's signal of {names} changes, and a run holds all inputs or none: "
            f"give {names} a value too"
        )
    signals = module.signal(*module.start, params=parameters).tolist()
    return {**dict(zip(module.inputs, signals, strict=True)), **values}


def _varying_inputs(scene: Path) -> Iterator[str]:
    """Return the inputs whose signals depend on more than parameters."""
    from eomc.model.symbols import resolve_definitions

    system = pipeline.read(scene)
    known, fixed = resolve_definitions(system.definitions), {p.symbol for p in system.parameters}
    return (i.name for i in system.inputs if i.signal.xreplace(known).free_symbols - fixed)


def _available(known: Iterable[str]) -> str:
    return f"; there are {texts.listed([*known])}"


def _finite(x: float) -> float | None:
    return x if abs(x) < float("inf") else None


def _change(energy: Any) -> float | None:
    """Return the largest change from the start; None if a value is not finite."""
    import numpy as np

    return float(np.max(np.abs(energy - energy[0]))) if np.isfinite(energy).all() else None


def _error(run: Trajectory) -> dict[str, Any] | None:
    """Return the error estimate of a run for JSON, without inf and nan."""
    error = run.error
    if error is None:
        return None

    return {
        "q": _finite(float(error.q[-1].max())),
        "qd": _finite(float(error.qd[-1].max())),
        "end": {name: _finite(x) for name, x in error.end.items()},
        "digits": error.digits,
        "order": error.order,
        "observed_order": _finite(error.observed),
        "amplification": _finite(error.amplification),
        "verdict": error.verdict,
        "events": {name: [*map(_finite, t.tolist())] for name, t in error.events.items()},
        "missed_events": {name: t.tolist() for name, t in error.missed.items()},
    }


def _summary(
    module: Any, simulation: Simulation, balance: Balance | None, files: Sequence[str]
) -> dict[str, Any]:
    """Return the results of a run for JSON. files: the files that were written."""
    import numpy as np

    run, seconds = simulation.run, simulation.seconds
    energy, jacobi = run.energy, run.jacobi
    q, qd = run.q[-1] + 0.0, run.qd[-1] + 0.0  # no -0
    return {
        "scene": model_of(module).info.name,
        "status": run.status,
        "message": run.message,
        "method": run.method,
        "h": run.h,
        "tolerance": getattr(run, "tol", None) or None,  # 0: of fixed steps
        "steps": run.steps,
        "t": float(run.t[-1]),
        "q": dict(zip(module.coordinates, map(float, q), strict=True)),
        "qd": dict(zip(module.coordinates, map(float, qd), strict=True)),
        "energy": {
            "start": _finite(float(energy[0])),
            "end": _finite(float(energy[-1])),
            "largest_change": _change(energy),
            "balance": asdict(balance) if balance else None,
        },
        "events": {name: e.t.tolist() for name, e in run.events.items()},
        "stopped_by": run.stopped or None,
        "saturated": _saturation(module, run),
        "jacobi_change": None if np.array_equal(energy, jacobi) else _change(jacobi),
        "error_estimate": _error(run),
        "beyond_stability": simulation.beyond_stability,
        "beyond_duration": simulation.beyond_duration,
        "remark": run.remark if run.status == "ok" else "",
        "seconds": seconds,
        "steps_per_second": run.steps / seconds if seconds else None,
        "files": files,
    }


def _saturation(module: Any, run: Trajectory) -> dict[str, float]:
    """Return the fraction of rows in which each input was beyond its limits, if there are any."""
    parts = zip(module.inputs, map(float, run.saturated.mean(axis=0)), strict=True)
    return {name: part for name, part in parts if part}


def _print_summary(
    module: Any, run: Trajectory, balance: Balance | None, summary: Mapping[str, Any]
) -> None:
    say(
        f"{escape_line(module.title)}: {run.steps} steps of {summary['method']}, "
        f"{run.description}, to t = {run.t[-1]:g} s"
    )
    wide = max(map(len, module.coordinates))
    ends = zip(module.coordinates, summary["q"].values(), summary["qd"].values(), strict=True)
    for name, q, qd in ends:
        unit = texts.line(module.units.get(name, ""))
        rate = f"{unit}/s" if unit else ""
        going = (
            ""
            if name in model_of(module).info.discrete_coordinates
            else f"   {name}_dot {qd: .9g} {rate}"
        )
        say(f"  {name:{wide}} {q: .9g} {unit}{going}".rstrip())
    _print_energy(run, balance, summary)
    for name, times in summary["events"].items():
        last = f", {'last ' if len(times) > 1 else ''}at t = {times[-1]:.9g} s" if times else ""
        over = ", which ends the run" if name == summary["stopped_by"] else ""
        say(f"  event {name}: {len(times)} {'time' if len(times) == 1 else 'times'}{last}{over}")
    for name, part in summary["saturated"].items():
        say(f"  {name} is saturated in {max(part, 0.001):.1%} of the rows")
    for words in (summary["beyond_stability"], summary["beyond_duration"], summary["remark"]):
        if words:
            say(f"  {words}")
    if run.error is not None:
        _print_error(module, run.error, run)
    speed = summary["steps_per_second"] or 0.0
    say(f"  {summary['seconds'] * 1e3:.3g} ms, {speed:.3g} steps per second")
    for file in summary["files"]:
        say(f"  wrote {escape_line(file)}")


def _print_energy(run: Trajectory, balance: Balance | None, summary: Mapping[str, Any]) -> None:
    """Print the conserved quantity or the energy balance, and K + P if it differs."""
    energy, jacobi = summary["energy"], summary["jacobi_change"]
    if energy["largest_change"] is None:
        say("  the energy is not finite")
        return
    end, change = energy["end"], energy["largest_change"]
    if jacobi is not None:
        say(f"  energy K + P {end:.9g} J, changed by at most {change:.2g} J; it is not conserved")
        end, change = float(run.jacobi[-1]), jacobi
    name = "energy K + P" if jacobi is None else "Jacobi's integral"
    how = f": {balance.words}" if balance else f", changed by at most {change:.2g} J"
    say(f"  {name} {end:.9g} J{how}")


def _print_error(module: Any, error: Estimate, run: Trajectory) -> None:
    import math

    q, qd = float(error.q[-1].max()), float(error.qd[-1].max())
    observed = "none above rounding" if math.isnan(error.observed) else f"{error.observed:.1f}"
    how = f"with smaller steps; order {error.order}, observed {observed}"
    if not run.request.has_equal_steps:
        how = "with a hundredth of the tolerance" if run.tol else "with a quarter of the step size"
    size = f"{q:.1g} in q, {qd:.1g} in qd" if max(q, qd) < math.inf else "unknown"
    say(f"  estimated error at the end: {size} (from the same run {how})")
    digits = ", ".join(f"{name} {error.digits[name]:.0f}" for name in module.coordinates)
    growth = f"; perturbations of the start grow by a factor of {error.amplification:.2g}"
    if max(error.digits.values()) < 0.5 or not math.isfinite(error.amplification):
        growth = ""  # the growth of another motion
    say(f"  correct digits: {digits}{growth}")
    if error.warning:
        say(f"  {error.warning}")


MAX_BYTES = 10 * 10**9  # of a store that is created without --yes


@click.command("sweep")
@click.argument("file", type=options.PATH)
@click.option("--over", multiple=True, metavar="NAME=A:B:N", help="A grid axis; or NAME=A,B,C.")
@click.option(
    "--draw", "draws", multiple=True, metavar="NAME=KIND:A,B",
    help="A random quantity, such as m=normal:2,0.1 or l=uniform:0,1.",
)  # fmt: skip
@click.option("--n", type=click.IntRange(1), help="Number of draws, such as 10_000.")
@click.option("--sampler", help="random, sobol or latin.")
@click.option("--seed", type=click.IntRange(0), help="Seed of the draws.")
@click.option("--keep", metavar="A,B", help="Stored columns, such as theta,x.max.")
@click.option("--duration", type=float, help="Simulated time, s.")
@click.option("--out", type=options.PATH, help="Folder of the store.")
@click.option("--workers", type=click.IntRange(1), help="Number of processes.")
@click.option(
    "--scheduler", metavar="ADDRESS", help="Address of Dask's scheduler, such as tcp://host:8786."
)
@click.option("--threads", type=click.IntRange(1), help="Number of threads for each block.")
@click.option("--part", metavar="K/N", help="Compute the K-th of N parts, for an array of jobs.")
@click.option(
    "--status", is_flag=True, help="Print the number of finished blocks, without computing."
)
@click.option("--plot", type=options.PATH, help="Plot the first quantity into FILE.")
@click.option("--parquet", type=options.PATH, help="Write Parquet files into DIR.")
@click.option("--yes", is_flag=True, help="Allow a store of more than 10 GB.")
@options.QUIET
@options.JSON
@options.as_namespace
def sweep_command(command: SimpleNamespace) -> None:
    """Simulate a scene for many values of its quantities; store the results on disk.

    FILE is the file of a sweep, or a scene with --over or --draw. The same command continues an
    interrupted sweep.

    \b
    eomc sweep basin.toml --plot basin.png
    eomc sweep scene.toml --over m_p=1:3:100 --draw l=normal:2,0.1 --n 10_000
    """
    from eomc.sweeps.plan import SweepError, place_error, read_file

    arguments, places = read_file(command.file)
    try:
        _run_sweep(command, _with_options(arguments, command))
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


def _run_sweep(command: SimpleNamespace, arguments: SweepArguments) -> None:
    """Run a sweep, or print its status; then draw, export and print what the options name."""
    from eomc.sweeps import store
    from eomc.sweeps.sweep import Execution, prepare_sweep, run_sweep

    options.check_target(command.plot, (".png", ".pdf", ".svg"), "--plot")
    if command.workers is not None and command.scheduler is not None:
        raise EomcError("--workers and --scheduler: choose one")
    if command.status:
        if command.plot or command.parquet:
            raise EomcError("--status computes and writes nothing: leave out --plot and --parquet")
        _print_sweep_status(command, prepare_sweep(arguments, command.out))
        return
    client = command.scheduler if command.workers is None else command.workers
    with progress_bar("sweep", command.silent) as update:
        progress = None if command.silent else _log_progress(update)
        execution = Execution(client, command.threads, None, command.part, progress)
        max_bytes = math.inf if command.yes else MAX_BYTES
        path, state = run_sweep(arguments, command.out, execution, max_bytes)
    if command.plot is not None:
        store.draw_plot(path, command.plot)
    if command.parquet is not None:
        store.write_parquet(path, command.parquet)
    _print_sweep_end(command, path, state)
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


def _print_sweep_status(command: SimpleNamespace, sweep: Any) -> None:
    """Print how many blocks of a sweep are finished."""
    from eomc.sweeps.store import Store

    store = Store(sweep.path) if sweep.exists else None
    blocks, finished = (store.blocks, int(store.finished().sum())) if store else (0, 0)
    values = {"store": str(sweep.path), "blocks": blocks, "finished": finished}
    state = f"{finished} of {blocks} blocks are finished" if store else "has not started"
    words = f"{escape_line(sweep.path)}: {state}, {sweep.plan.size:,} trajectories"
    say(json.dumps(values, indent=1) if command.as_json else words)


def _print_sweep_end(command: SimpleNamespace, path: Path, state: SweepProgress) -> None:
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


# --- eomc fit -------------------------------------------------------------------------------------


@click.command("fit")
@options.SCENE
@click.argument("log", type=options.PATH, nargs=-1, required=True)
@options.BUILD
@click.option(
    "--free", metavar="NAME,...",
    help="Values to estimate: parameters, and coordinates or velocities NAME_dot, whose initial "
    "values are estimated. By default all parameters.",
)  # fmt: skip
@options.SET
@options.START
@click.option(
    "--bounds", multiple=True, metavar="NAME=LOW:HIGH", help="Bounds of a free value; one may lack."
)
@click.option("--h", "h", type=float, help="Largest step size in s, instead of the scene's.")
@click.option("--plot", type=options.PATH, help="Plot the fit: FILE.png, .svg or .pdf.")
@options.QUIET
@options.JSON
@options.as_namespace
def fit_command(arguments: SimpleNamespace) -> None:
    """Estimate parameters from measured columns; each LOG is a CSV file, an experiment.

    The first line of LOG has the names of the columns: t, and coordinates, velocities (theta_dot),
    outputs or inputs of the scene.

    \b
    eomc fit pendulum.toml log.csv --free l,damping --plot fit.png
    eomc fit pendulum.toml log.csv --free l,theta,theta_dot --bounds l=0:2
    """
    from eomc.identification import fit

    options.check_target(arguments.plot, (".png", ".svg", ".pdf"), "--plot")
    system = pipeline.read(arguments.scene)
    known = {p.name: p.value for p in system.parameters}
    free = None if arguments.free is None else [n.strip() for n in arguments.free.split(",")]
    with status_line(f"fitting {arguments.scene.stem}", arguments.silent):
        result = fit(
            system, arguments.log, free=free,
            values={
                **dict(parse_pairs(arguments.parameters, "--set", known)),
                **dict(parse_pairs(arguments.start, "--start", known)),
            },
            bounds=dict(_parse_bounds(arguments.bounds)), h=arguments.h, root=arguments.root,
        )  # fmt: skip
    if arguments.plot:
        result.write_plot(arguments.plot)
    if arguments.as_json:
        names = ("values", "standard_errors", "correlation", "without_effect", "ambiguous", "rms",
                 "ignored", "success", "message", "evaluations")  # fmt: skip
        summary = {name: _json_value(getattr(result, name)) for name in names}
        say(json.dumps(summary, indent=1))
    elif not arguments.quiet:
        say(str(result))
        if arguments.plot:
            say(f"  wrote {escape_line(arguments.plot)}")
    sys.exit(1 if result.warnings else 0)


def _json_value(value: Any) -> Any:
    """Return a value for JSON, which has no nan: None in its place."""
    if isinstance(value, dict):
        return {name: _json_value(x) for name, x in value.items()}
    if hasattr(value, "tolist"):
        return [_json_value(x) for x in value.tolist()]
    if isinstance(value, list):
        return [*map(_json_value, value)]
    return None if isinstance(value, float) and math.isnan(value) else value


def _parse_bounds(arguments: Sequence[str]) -> Iterator[tuple[str, tuple[float, float]]]:
    """Parse arguments NAME=LOW:HIGH; a bound that is left out is infinite. Raises EomcError."""
    for text in arguments:
        name, _, pair = text.partition("=")
        low, colon, high = pair.partition(":")
        try:
            bounds = float(low or -math.inf), float(high or math.inf)
        except ValueError:
            colon = ""
        if not colon:
            raise EomcError(f"--bounds {text}: write --bounds NAME=LOW:HIGH, such as m=0:5")
        yield name.strip(), bounds
