"""eomc dof, show, check and report: what a scene is, whether it is right, how fast its runs are."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from eomc import pipeline
from eomc.base.errors import SceneError
from eomc.cli import options
from eomc.cli.options import escape_line, progress_bar, say, status_line, warn
from eomc.toolchain import cache


@click.command("dof")
@options.SCENE
@options.JSON
def dof_command(scene: Path, as_json: bool) -> None:
    """Count degrees of freedom of bodies and joints, and report redundant coordinates.

    For constraints and loops: their rank, redundant equations, the remaining degrees of freedom,
    the assembled initial state, and the distance to singular positions.

    \b
    eomc dof scenes/arm.toml
    eomc dof scenes/slider_crank.toml
    """
    from eomc.mechanism import mobility
    from eomc.scene import read as scenes

    checked_scene = scenes.read(scene)
    counted: dict[str, Any] = {"scene": checked_scene.name}
    lines = []
    if not checked_scene.constrained or (checked_scene.assembly and checked_scene.assembly.bodies):
        mobility_count = mobility.compute_mobility(checked_scene)
        counted, lines = mobility_count.as_dict(), [mobility_count.table()]
    if checked_scene.constrained:
        from eomc import pipeline
        from eomc.mechanism import ranks

        system = pipeline.read(scene)
        assert system.closure is not None
        counted["constraints"] = {
            **system.closure.as_dict(),
            "q": {c.name: c.start for c in system.coordinates},
            "qd": {f"{c.name}_dot": c.rate for c in system.coordinates},
        }
        lines.append(system.closure.table())
        if closest_singularity := ranks.closest_singularity(system):
            counted["constraints"]["nearest_singular"] = vars(closest_singularity)
            lines.append(str(closest_singularity))
        start = (f"{c.name} = {c.start:.9g}" for c in system.coordinates)
        lines.append(f"  assembled initial state: {', '.join(start)}")
    say(json.dumps(counted, indent=1) if as_json else "\n".join(lines))


# --- show -----------------------------------------------------------------------------------------


@click.command("show")
@options.SCENE
@options.BUILD
@click.option("--latex", "form", flag_value="latex", help="Print LaTeX for amsmath.")
@click.option(
    "--python",
    "form",
    flag_value="python",
    help="Print Python source that defines the SymPy matrices.",
)
@click.option(
    "--cost", "form", flag_value="cost", help="Print the operations of each generated function."
)
@click.option(
    "--sizes", "form", flag_value="sizes",
    help="Print bytes of code and stack of the portable C, compiled by $CC with -Os.",
)  # fmt: skip
def show_command(scene: Path, root: Path, form: str | None) -> None:
    """Print the equations of motion, L, D, C and g as text.

    \b
    eomc show scenes/cartpole.toml
    eomc show scenes/cartpole.toml --latex
    """
    if form == "sizes":
        say(_sizes(scene))
        return
    name, digest = pipeline.name_and_digest(scene)

    def make() -> dict[str, str]:
        from eomc.report import equations_text

        system = pipeline.read(scene)
        if form == "cost":
            text = equations_text.write_costs(system)
        else:
            text = equations_text.write_equations(system, form or "text")
        return {"text": text, "warnings": "\n".join(map(str, system.warnings))}

    with status_line("deriving", False):
        stored = cache.cache_texts(root, name, form or "text", digest, make)
    if stored["warnings"]:
        say(stored["warnings"], err=True)
    say(stored["text"])


def _sizes(scene: Path) -> str:
    """Return a table of the sizes of the compiled portable C."""
    import shlex

    from eomc.toolchain import sizes
    from eomc.toolchain.compiler import find_compiler

    compiler = find_compiler()
    with status_line("deriving", False):
        sources = pipeline.sources(pipeline.read(scene), warn=warn)
        measured = sizes.measure(sources.files, sources.name, compiler)
    rows: list[tuple[str, ...]] = [("function", "code", "stack", "with calls")]
    for f in measured.functions:
        numbers = (f.code, f.stack, f.total_stack)
        rows.append((f.name, *("-" if n is None else str(n) for n in numbers)))
    width = max(len(row[0]) for row in rows)
    library = sorted(
        {x for f in measured.functions for x in f.calls} - {f.name for f in measured.functions}
    )
    lines = [
        f"{sources.name}.c: bytes of code and stack, by {shlex.join(measured.command)}", "",
        *(f"{name:{width}}  {code:>6}  {stack:>6}  {deep:>10}" for name, code, stack, deep in rows),
        "",
        f"in all {measured.code} of code, {measured.constants} of constants, "
        f"{measured.writable} writable",
    ]  # fmt: skip
    lines += [f"stack of libraries left out: {', '.join(library)}"] if library else []
    return "\n".join((*lines, *measured.faults))


@click.command("check")
@options.SCENES
@options.BUILD
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of the random states.",
)
@options.QUIET
@options.JSON
def check_command(
    scenes: Sequence[Path], root: Path, seed: int, quiet: bool, as_json: bool
) -> None:
    """Compare the compiled code with a pure-Python reference, and test laws of mechanics.

    The portable form of C is compiled and compared too.

    \b
    eomc check scenes/*.toml
    """
    from eomc.verify.check import check as run_checks

    reports = []
    with progress_bar("checking", quiet or as_json) as progress:
        for k, scene in enumerate(scenes):
            system = pipeline.read(scene)
            module = pipeline.load(scene, root, warn=warn)
            plain = pipeline.load(scene, root, form="plain")
            report = run_checks(system, module, plain=plain, seed=seed)
            progress(k + 1, len(scenes))
            reports.append(report)
            if not as_json and not (quiet and report.passed):
                say(report.table())
                say()
    failed = [r.scene for r in reports if not r.passed]
    if as_json:
        say(json.dumps([r.as_dict() for r in reports], indent=1))
    elif failed:
        say(f"FAILED: {', '.join(failed)}")
    elif not quiet:
        say(f"all {len(reports)} passed" if len(reports) > 1 else "passed")
    sys.exit(1 if failed else 0)


@click.command("report")
@options.SCENES
@options.BUILD
@click.option(
    "--digits",
    type=click.IntRange(1, 17),
    help="Recommend a method and h for this number of digits only.",
)
@click.option("--json", "file", type=options.PATH, help="Write all results to FILE.")
@options.QUIET
def report_command(
    scenes: Sequence[Path], root: Path, digits: int | None, file: Path | None, quiet: bool
) -> None:
    """Measure error and time of each integration method over a range of h.

    Writes a page, build/NAME/report.html, with the scene, its equations and motion, and a table of
    error and time. Errors are measured with a reference solution of 25 digits or more.

    \b
    eomc report scenes/cartpole.toml
    eomc report scenes/cartpole.toml --digits 8
    """
    from eomc.report import cost_of_digits
    from eomc.report import page as pages
    from eomc.report.plot import without_pictures

    options.check_target(file, (".json",), "--json")
    measured = []
    for scene in scenes:
        system = pipeline.read(scene)
        if system.modes:
            why = (
                'a report compares motions without events, and friction = "stick" is made of '
                'these: report on friction = "smooth", or run it by several tolerances'
            )
            raise SceneError([system.problem("run.friction", why)])
        with progress_bar(f"measuring {scene.stem}", quiet, after=0.0) as progress:
            measurement = cost_of_digits.measure(system, root, progress=progress)
        measured.append(pages.as_dict(measurement))
        if digits is not None:
            say(f"{measurement.scene}: {pages.recommendation(measurement, digits)}")
            continue
        if not quiet:
            say(pages.write_table(measurement))
        page = root / measurement.scene / "report.html"
        with status_line(f"writing {escape_line(page)}", quiet):
            text = pages.write_page(measurement, pages.describe_scene(system, measurement, root))
        options.write_text(page, text)
        if not quiet:
            say(f"\nwrote {escape_line(page)}\n")
            if missing_pictures := without_pictures():
                say(f"{missing_pictures}\n")
    if file is not None:
        options.write_text(file, json.dumps(measured, indent=1) + "\n")
