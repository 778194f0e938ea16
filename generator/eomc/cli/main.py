"""The command: eomc new, import, build, check, run, report, show, dof, list.

Exit status: 0, 1 where a check failed or a run could not go on, 2 for bad input. What takes time
to import (SymPy, pydantic, rich) is imported where it is needed: `eomc build` with nothing to do
is over in a tenth of a second.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError, FolderError, SceneError
from eomc.base.version import __version__
from eomc.cli import terminal

if TYPE_CHECKING:
    from eomc.base.errors import Problem
    from eomc.runtime.estimate import Estimate
    from eomc.runtime.runtime import Run

_SCENE = click.argument("scene", type=click.Path(path_type=Path))
_SCENES = click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
_BUILD = click.option(
    "--build", "root", default="build", show_default=True, type=click.Path(path_type=Path),
    help="Where built modules lie.",
)  # fmt: skip
_QUIET = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


class _Group(terminal.Group):
    """Errors that are the user's to mend are printed as they are, with status 2."""

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except SceneError as fault:
            count = sum(p.severity == "error" for p in fault.problems)
            _say(str(fault), err=True)
            _fail(f"eomc: {count} error{'s' if count != 1 else ''}, nothing was built or changed")
        except FolderError as fault:
            _fail(f"eomc: {fault.what}: choose another place with --build DIR")
        except EomcError as fault:
            _fail(f"eomc: {fault}")
        except MemoryError as fault:
            _fail(f"eomc: {fault}" if str(fault) else "eomc: not enough memory")
        except KeyboardInterrupt:
            _say("eomc: interrupted", err=True)
            sys.exit(130)


def _fail(message: str) -> NoReturn:
    _say(message, err=True)
    sys.exit(2)


def _say(words: str = "", err: bool = False) -> None:
    """Print; what a terminal would take for a command is shown escaped."""
    click.echo(texts.lines(words), err=err)


def _shown(path: object) -> str:
    """The name of a file in one line."""
    return texts.line(str(path))


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="eomc")
def main() -> None:
    """The equations-of-motion compiler: from energies to fast, checked C.

    \b
    eomc new pendulum              write a scene to start from
    eomc import robot.urdf         write the scene of a robot file
    eomc run pendulum.toml         derive, compile and simulate it
    eomc check pendulum.toml       hold it against the independent reference
    """


@main.command()
@click.argument("name")
def new(name: str) -> None:
    """Write a scene to start from: scenes/NAME.toml, or NAME.toml where there is no scenes/.

    \b
    eomc new crane
    """
    from eomc.base import names
    from eomc.emit.render import environment

    if why := names.module_fault(name):
        raise EomcError(why)
    text = (
        environment()
        .get_template("scene/scene.toml.jinja")
        .render(name=name, title=name.replace("_", " ").capitalize())
    )
    path = _scene_path(name)
    _write_new(path, text)
    _say(f"wrote {_shown(path)}; try: eomc run {texts.command(str(path))}")


def _scene_path(name: str) -> Path:
    """Where a new scene goes: into scenes/ where there is one."""
    return (Path("scenes") if Path("scenes").is_dir() else Path()) / f"{name}.toml"


def _write_new(path: Path, text: str) -> None:
    """Write a file that must not be there yet."""
    made = False
    try:
        with path.open("x", encoding="utf-8") as file:
            made = True
            file.write(text)
    except FileExistsError:
        raise EomcError(f"{_shown(path)}: is there already, and stays as it is") from None
    except OSError as fault:
        if made:  # and not whole
            path.unlink(missing_ok=True)
        raise EomcError(f"{_shown(path)}: can't be written ({fault.strerror})") from None


@main.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="The scene; by default as eomc new has it."
)
@click.option("--name", help="Of the scene, instead of the robot's.")
@click.option(
    "--lock", "locks", multiple=True, metavar="JOINT=VALUE", help="Freeze a joint, at rad or m."
)
@click.option("--root", metavar="LINK", default="", help="Keep what this link carries, fix it.")
@click.option("--tip", metavar="LINK", default="", help="Keep the chain that ends in this link.")
@click.option(
    "--base", type=click.Choice(["fixed", "free"]), help="Of the root, instead of the file's."
)
@click.option("--no-drives", is_flag=True, help="No input for each joint.")
@click.option(
    "--mend-inertias", is_flag=True, help="Take the nearest inertia for one that no body can have."
)
@click.option("--include", is_flag=True, help="Open what <include> names, in the file's folder.")
def import_(
    file: Path, out: Path | None, name: str | None, locks: Sequence[str], root: str, tip: str,
    base: str | None, no_drives: bool, mend_inertias: bool, include: bool,
) -> None:  # fmt: skip
    """Write the scene of a robot file, URDF or MJCF, and say what it leaves out.

    \b
    eomc import panda.urdf --lock panda_finger_joint1=0.04 --lock panda_finger_joint2=0.04
    eomc import humanoid.urdf --root torso --tip left_hand
    """
    from dataclasses import replace

    from eomc.base import names
    from eomc.robots import edit, scene_text, urdf, xml
    from eomc.robots.mjcf import read
    from eomc.scene.toml_text import MAX_BYTES

    element = xml.root(file).tag
    if element == "mujoco":
        robot = read.read(file, include)
    elif include:
        raise EomcError(f"--include is for MJCF files, and {_shown(file)} is none")
    else:
        robot = urdf.read(file)
    robot = edit.lock(robot, dict(_pairs(locks, "--lock", {})))
    robot = edit.cut(robot, root, tip)
    if base:
        robot = edit.based(robot, free=base == "free")
    if no_drives:
        robot = replace(robot, drives=())
    if mend_inertias:
        robot = edit.mended(robot)
    if name is not None:
        if why := names.module_fault(name):
            raise EomcError(f"--name: {why}")
        robot = replace(robot, name=name)
    robot = scene_text.finished(robot)
    path = out or _scene_path(robot.name)
    text = scene_text.scene_text(robot)
    if len(text.encode()) > MAX_BYTES:
        raise EomcError(
            f"{_shown(file)}: its scene would have {len(text.encode())} bytes, and a scene has at "
            f"most {MAX_BYTES}: cut out a part with --root and --tip"
        )
    _write_new(path, text)
    called = "" if path.stem == robot.name else f"; its module is called {robot.name}"
    _say(
        f"wrote {_shown(path)}: bodies {len(robot.bodies)}, coordinates {len(robot.motions)}, "
        f"inputs {len(robot.drives)}{called}"
    )
    if robot.left_out:
        _say("not modelled, or to be looked at:")
        for words in robot.left_out:
            _say(f"  - {_shown(words)}")
    typed = texts.command(str(path))
    _say(f"try: eomc dof {typed}; eomc run {typed}")


@main.command()
@_SCENE
@_JSON
def dof(scene: Path, as_json: bool) -> None:
    """Count a scene's freedoms, from its bodies and joints, and say which are redundant.

    \b
    eomc dof scenes/arm.toml
    """
    from eomc.model import mobility
    from eomc.scene import read as scenes

    counted = mobility.count(scenes.read(scene))
    _say(json.dumps(counted.as_dict(), indent=1) if as_json else counted.table())


@main.command()
@_SCENES
@_BUILD
@_QUIET
@_JSON
def build(scenes: Sequence[Path], root: Path, quiet: bool, as_json: bool) -> None:
    """Derive, generate and compile: a package and embeddable C in build/NAME/.

    \b
    eomc build scenes/cartpole.toml
    PYTHONPATH=build python -c "import cartpole; print(cartpole.simulate())"
    cd build/cartpole && cc -std=c99 -O2 -I. main.c cartpole.c -lm && ./a.out
    """
    named: dict[str, Path] = {}
    for scene in scenes:
        name = pipeline.name_and_digest(scene)[0]
        if name and (other := named.setdefault(name, scene)) != scene:
            raise EomcError(
                f"{_shown(other)} and {_shown(scene)} are both named '{name}': one would replace "
                "the other"
            )
    told = []
    with _progress("building", quiet or as_json) as progress:
        for k, scene in enumerate(scenes):
            begun = time.perf_counter()
            built = pipeline.build(scene, root, warn=_warn)
            spent = time.perf_counter() - begun
            progress(k + 1, len(scenes))
            told.append(
                {"scene": str(scene), "name": built.name, "folder": str(built.folder),
                 "fresh": built.fresh, "seconds": round(spent, 3)}
            )  # fmt: skip
            if not quiet and not as_json:
                done = f"built in {spent:.1f} s" if built.fresh else "is up to date"
                _say(f"{_shown(built.folder)}/: {done}")
    if as_json:
        _say(json.dumps(told, indent=1))


@main.command()
@_SCENES
@_BUILD
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the random states."
)
@_QUIET
@_JSON
def check(scenes: Sequence[Path], root: Path, seed: int, quiet: bool, as_json: bool) -> None:
    """Compare the compiled module with the pure-Python reference, and test what must hold.

    So too the plain form of C, compiled for this; the first time in some seconds.

    \b
    eomc check scenes/*.toml
    """
    from eomc.verify.check import check as checked

    reports = []
    with _progress("checking", quiet or as_json) as progress:
        for k, scene in enumerate(scenes):
            system = pipeline.read(scene)
            module, plain = (
                pipeline.load(scene, root, warn=_warn),
                pipeline.load(scene, root, form="plain"),
            )
            report = checked(system, module, plain=plain, seed=seed)
            progress(k + 1, len(scenes))
            reports.append(report)
            if not as_json and not (quiet and report.passed):
                _say(report.table())
                _say()
    failed = [r.scene for r in reports if not r.passed]
    if as_json:
        _say(json.dumps([r.as_dict() for r in reports], indent=1))
    elif failed:
        _say(f"FAILED: {', '.join(failed)}")
    elif not quiet:
        _say(f"all {len(reports)} passed" if len(reports) > 1 else "passed")
    sys.exit(1 if failed else 0)


@main.command()
@_SCENE
@_BUILD
@click.option("--set", "parameters", multiple=True, metavar="NAME=VALUE", help="A parameter.")
@click.option("--start", multiple=True, metavar="NAME=VALUE", help="A coordinate, or its velocity.")
@click.option("--h", "h", type=float, help="Step size in s, instead of the scene's.")
@click.option("--duration", type=float, help="In s, instead of the scene's.")
@click.option("--method", help="A stepper that the scene asks for; its first where not given.")
@click.option("--every", type=click.IntRange(1), default=1, help="Keep every so many steps.")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Write the rows: FILE.csv or FILE.npz."
)
@click.option("--plot", type=click.Path(path_type=Path), help="Draw them: FILE.png, .svg or .pdf.")
@_QUIET
@_JSON
def run(
    scene: Path, root: Path, parameters: Sequence[str], start: Sequence[str], h: float | None,
    duration: float | None, method: str | None, every: int, out: Path | None,
    plot: Path | None, quiet: bool, as_json: bool,
) -> None:  # fmt: skip
    """Simulate a scene; print the end, the error and the speed.

    \b
    eomc run scenes/cartpole.toml --plot cartpole.png
    eomc run scenes/cartpole.toml --set m_c=3 --start theta=pi/3 --out run.csv
    """
    _known_suffix(out, (".csv", ".npz"), "--out")
    _known_suffix(plot, (".png", ".svg", ".pdf"), "--plot")
    with _status(f"building {scene.stem}", quiet or as_json):
        module = pipeline.load(scene, root, warn=_warn)
    values, q0, qd0 = _overrides(scene, module, parameters, start)
    options: dict[str, Any] = {"h": h, "duration": duration, "params": values, "method": method}
    try:
        unstable = module.advice(q0, qd0, h, params=values, method=method)
        with _progress("running", quiet or as_json) as progress:
            begun = time.perf_counter()
            done = _simulated(module, q0, qd0, every=every, progress=progress, **options)
            seconds = time.perf_counter() - begun
    except module.Interrupted as stop:  # what was done is kept
        done, seconds = stop.run, time.perf_counter() - begun
    except (ValueError, MemoryError) as fault:
        raise EomcError(str(fault).replace("every=", "--every")) from None
    stopped = done.status == "interrupted"
    if done.status == "ok" and seconds < 2:
        try:
            with _progress("finding its error", quiet or as_json) as progress:
                done.estimate(progress)
        except module.Interrupted:  # the run itself is whole
            stopped = True
    if out:
        _write(out, module, done)
    if plot:
        from eomc.report import plot as plots

        plots.draw(pipeline.read(scene).at(values), done.t, done.q, done.qd, done.energy, plot)
    summary = _summary(module, done, seconds, unstable, plot=plot, out=out)
    if as_json:
        _say(json.dumps(summary, indent=1))
    elif not quiet:
        _print_summary(module, done, summary)
    if done.status != "ok":
        _say(f"eomc: {done.message}", err=True)
    if stopped or done.status != "ok":
        sys.exit(130 if stopped else 1)


@main.command()
@_SCENES
@_BUILD
@click.option("--digits", type=click.IntRange(1, 17), help="Answer for so many digits only.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Write all figures to FILE.")
@_QUIET
def report(
    scenes: Sequence[Path], root: Path, digits: int | None, file: Path | None, quiet: bool
) -> None:
    """Measure what every digit costs: each stepper over a range of h, against 25 digits or more.

    Writes a page with pictures, build/NAME/report.html.

    \b
    eomc report scenes/cartpole.toml
    eomc report scenes/cartpole.toml --digits 8
    """
    from eomc.report import report as reports

    told = []
    for scene in scenes:
        with _progress(f"measuring {scene.stem}", quiet) as progress:
            made = reports.report(scene, root, progress=progress)
        told.append(made.as_dict())
        if digits is not None:
            _say(f"{made.scene}: {made.recommendation(digits)}")
            continue
        if not quiet:
            _say(made.table())
        page = root / made.scene / "report.html"
        _write_text(page, reports.page(made))
        if not quiet:
            _say(f"\nwrote {_shown(page)}\n")
    if file is not None:
        _write_text(file, json.dumps(told, indent=1) + "\n")


@main.command()
@_SCENE
@click.option("--latex", "form", flag_value="latex", help="LaTeX.")
@click.option(
    "--python", "form", flag_value="python", help="Python source that makes the matrices."
)
@click.option("--cost", "form", flag_value="cost", help="Operations of each generated function.")
def show(scene: Path, form: str | None) -> None:
    """Print D, C, g and the rest, as text for a terminal.

    \b
    eomc show scenes/cartpole.toml
    eomc show scenes/cartpole.toml --latex
    """
    from eomc.report import equations_text as shown

    system = pipeline.read(scene)
    for problem in system.warnings:
        _warn(problem)
    with _status("deriving", False):
        text = shown.cost(system) if form == "cost" else shown.equations(system, form or "text")
    _say(text)


@main.command("list")
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path))
@_BUILD
@_JSON
def list_(folders: Sequence[Path], root: Path, as_json: bool) -> None:
    """List the scenes in scenes/, or in the given folders, and whether they are built.

    \b
    eomc list
    """
    from eomc.scene.toml_text import tree_and_digest
    from eomc.toolchain import compiler as compiler

    rows = []
    default = Path("scenes") if Path("scenes").is_dir() else Path()
    for folder in folders or [default]:
        if not folder.is_dir():
            raise EomcError(f"{_shown(folder)}: is not a folder")
        for path in sorted(folder.glob("*.toml")):
            try:
                text, _ = tree_and_digest(path)
            except (OSError, ValueError):
                text = {"eomc": 0, "name": path.stem, "title": "(can't be read: eomc build tells)"}
            if "eomc" not in text or not isinstance(text.get("name"), str):
                continue
            name, digest = pipeline.name_and_digest(path)
            built = bool(name) and compiler.found(root / name, compiler.key(digest))
            rows.append(
                {"scene": str(path), "name": text["name"], "title": str(text.get("title", "")),
                 "coordinates": _keys(text, "coordinates"), "inputs": _keys(text, "inputs"),
                 "built": built}
            )  # fmt: skip
    if as_json:
        _say(json.dumps(rows, indent=1))
        return
    if not rows:
        _say("no scenes here: 'eomc new NAME' writes one")
    for row in rows:
        row |= {key: _shown(row[key]) for key in ("scene", "title")}
        row |= {key: list(map(_shown, row[key])) for key in ("coordinates", "inputs")}
    wide = max((len(row["scene"]) for row in rows), default=0)
    titles = max((len(row["title"]) for row in rows), default=0)
    for row in rows:
        moved = f"({', '.join(row['inputs'])})" if row["inputs"] else ""
        mark = "built" if row["built"] else "     "
        _say(
            f"{row['scene']:{wide}}  {row['title']:{titles}}  "
            f"{mark}  {', '.join(row['coordinates'])} {moved}".rstrip()
        )


def _keys(text: Mapping[str, Any], table: str) -> list[str]:
    """The names in a table of a scene that nobody has checked."""
    found = text.get(table)
    return list(found) if isinstance(found, dict) else []


# --- pieces ---------------------------------------------------------------------------------------


def _warn(problem: Problem) -> None:
    _say(str(problem), err=True)


def _known_suffix(path: Path | None, known: Sequence[str], option: str) -> None:
    if path is not None and path.suffix not in known:
        raise EomcError(f"{option} {_shown(path)}: give a name that ends in {' or '.join(known)}")


def _overrides(
    scene: Path, module: Any, parameters: Sequence[str], start: Sequence[str]
) -> tuple[dict[str, float], Any, Any]:
    """Parameters and start from NAME=VALUE pairs; a value may be a formula such as pi/3."""
    from eomc.scene.formulas import suggest

    values: dict[str, float] = {}
    for name, value in _pairs(parameters, "--set", module.defaults):
        if name not in module.defaults:
            raise EomcError(f"--set: '{name}' is not a parameter{suggest(name, module.defaults)}")
        values[name] = value
    q0, qd0 = module.start
    if values:  # the start may be a formula in the parameters
        from eomc.scene import read as scenes

        q0[:], qd0[:] = scenes.read(scene, values).start()  # and may be bad for a body
    states = {name: (q0, k) for k, name in enumerate(module.coordinates)}
    states |= {f"{name}_dot": (qd0, k) for k, name in enumerate(module.coordinates)}
    for name, value in _pairs(start, "--start", {**module.defaults, **values}):
        if name not in states:
            raise EomcError(
                f"--start: '{name}' is not a coordinate or velocity{suggest(name, states)}"
            )
        array, k = states[name]
        array[k] = value
    return values, q0, qd0


def _pairs(
    given: Sequence[str], option: str, known: Mapping[str, float]
) -> Iterator[tuple[str, float]]:
    import math

    from eomc.scene import formulas

    seen: set[str] = set()
    for pair in given:
        name, equals, text = pair.partition("=")
        name = name.strip()
        if not equals:
            raise EomcError(f"{option} {pair}: write {option} NAME=VALUE")
        if name in seen:
            raise EomcError(f"{option} {pair}: '{name}' has a value already: give it once")
        seen.add(name)
        try:
            value = float(
                formulas.evaluate(formulas.parse(text), formulas.NUMERIC, known.__getitem__)
            )
        except KeyError as fault:
            raise EomcError(f"{option} {pair}: {fault} is not a number or parameter") from None
        except (ValueError, ArithmeticError, TypeError) as fault:
            raise EomcError(f"{option} {pair}: {fault}") from None
        if not math.isfinite(value):
            raise EomcError(f"{option} {pair}: not a finite number")
        yield name, value


def _simulated(module: Any, q0: Any, qd0: Any, **options: Any) -> Run:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # told by the caller
        done: Run = module.simulate(q0, qd0, **options)
        return done


def _error(done: Run) -> dict[str, Any] | None:
    """A run's own error for JSON, which has no inf and no nan."""
    error = done.error
    if error is None:
        return None

    def said(x: float) -> float | None:
        return x if abs(x) < float("inf") else None

    return {
        "q": said(float(error.q[-1].max())),
        "qd": said(float(error.qd[-1].max())),
        "end": {name: said(x) for name, x in error.end.items()},
        "digits": error.digits,
        "order": error.order,
        "observed_order": said(error.observed),
        "amplification": said(error.amplification),
        "verdict": error.verdict,
    }


def _summary(
    module: Any, done: Run, seconds: float, unstable: str | None, **files: Path | None
) -> dict[str, Any]:
    import numpy as np

    energy, jacobi = done.energy, done.jacobi
    return {
        "scene": module._model.name,
        "status": done.status,
        "message": done.message,
        "method": done.method,
        "h": done.h,
        "steps": done.steps,
        "t": float(done.t[-1]),
        "q": dict(zip(module.coordinates, map(float, done.q[-1]), strict=True)),
        "qd": dict(zip(module.coordinates, map(float, done.qd[-1]), strict=True)),
        "energy": {
            "start": float(energy[0]),
            "end": float(energy[-1]),
            "largest_change": float(np.max(np.abs(energy - energy[0]))),
        },
        "jacobi_change": None
        if np.array_equal(energy, jacobi)
        else float(np.max(np.abs(jacobi - jacobi[0]))),
        "error_estimate": _error(done),
        "beyond_stability": unstable,
        "seconds": seconds,
        "steps_per_second": done.steps / seconds if seconds else None,
        "files": [str(path) for path in files.values() if path],
    }


def _print_summary(module: Any, done: Run, summary: Mapping[str, Any]) -> None:
    _say(
        f"{_shown(module.title)}: {done.steps} steps of {summary['method']}, h = {done.h:g} s, "
        f"to t = {done.t[-1]:g} s"
    )
    wide = max(map(len, module.coordinates))
    for name, q, qd in zip(module.coordinates, done.q[-1], done.qd[-1], strict=True):
        unit = texts.line(module.units.get(name, ""))
        rate = f"{unit}/s" if unit else ""
        _say(f"  {name:{wide}} {q: .9g} {unit}   {name}_dot {qd: .9g} {rate}".rstrip())
    change, jacobi = summary["energy"]["largest_change"], summary["jacobi_change"]
    beside = "" if jacobi is None else f"; Jacobi's integral by {jacobi:.2g} J"
    end = summary["energy"]["end"]
    _say(f"  energy K + P {end:.9g} J, changed by at most {change:.2g} J{beside}")
    if summary["beyond_stability"]:
        _say(f"  {summary['beyond_stability']}")
    if done.error is not None:
        _print_error(module, done.error)
    speed = summary["steps_per_second"] or 0.0
    _say(f"  {summary['seconds'] * 1e3:.3g} ms, {speed:.3g} steps a second")
    for file in summary["files"]:
        _say(f"  wrote {_shown(file)}")


def _print_error(module: Any, error: Estimate) -> None:
    import math

    q, qd = float(error.q[-1].max()), float(error.qd[-1].max())
    seen = "only rounding seen" if math.isnan(error.observed) else f"seen: {error.observed:.1f}"
    _say(
        f"  error at the end about {q:.1g} in q, {qd:.1g} in qd "
        f"(from the same run in shorter steps; order {error.order}, {seen})"
    )
    digits = ", ".join(f"{name} {error.digits[name]:.0f}" for name in module.coordinates)
    _say(
        f"  right digits: {digits}; a difference at the start has become "
        f"{error.amplification:.2g} times as large"
    )
    if not error.resolved:
        _say(f"  this motion is not resolved: {error.verdict}")


def _write(path: Path, module: Any, done: Run) -> None:
    """The rows as CSV (17 digits, so that they read back as they were) or as NPZ arrays."""
    import numpy as np

    names = [*module.coordinates, *(f"{c}_dot" for c in module.coordinates)]
    try:
        if path.suffix == ".npz":
            np.savez(
                path, t=done.t, q=done.q, qd=done.qd, energy=done.energy,
                coordinates=np.array(module.coordinates),
            )  # fmt: skip
            return
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["t", *names, "energy"])
            writer.writerows(
                [repr(float(x)) for x in row]
                for row in np.column_stack([done.t, done.q, done.qd, done.energy])
            )
    except OSError as fault:
        raise EomcError(f"{_shown(path)}: can't be written ({fault.strerror})") from None


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as fault:
        raise EomcError(f"{_shown(path)}: can't be written ({fault.strerror})") from None


def _watched(silent: bool) -> bool:
    return not silent and sys.stderr.isatty()


@contextmanager
def _progress(what: str, silent: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar for what takes longer than a second, where a person is watching."""
    if not _watched(silent):
        yield lambda done, total: None
        return
    begun = time.monotonic()
    bar: list[Any] = []

    def update(done: int, total: int) -> None:
        if not bar and time.monotonic() - begun > 1 and done < total:
            from rich.console import Console
            from rich.progress import Progress, TextColumn

            said = TextColumn("{task.description}", markup=False)
            columns = (said, *Progress.get_default_columns()[1:])
            progress = Progress(*columns, console=Console(stderr=True), transient=True)
            progress.start()
            bar.extend([progress, progress.add_task(_shown(what), total=total)])
        if bar:
            bar[0].update(bar[1], completed=done)

    try:
        yield update
    finally:
        if bar:
            bar[0].stop()


@contextmanager
def _status(what: str, silent: bool) -> Iterator[None]:
    """A line that says what is going on, where a person is watching."""
    if not _watched(silent):
        yield
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(Text(f"{_shown(what)} ...")):  # no str, which has markup
        yield


if __name__ == "__main__":
    main()
