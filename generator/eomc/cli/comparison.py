"""eomc check and report: the compiled module compared with the reference; speed against error."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from eomc import pipeline
from eomc.base.errors import SceneError
from eomc.cli import options
from eomc.cli.terminal import escape_line, progress_bar, say, status_line, warn


@click.command("check")
@options.SCENES
@options.BUILD
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the random states."
)
@options.QUIET
@options.JSON
def check_command(
    scenes: Sequence[Path], root: Path, seed: int, quiet: bool, as_json: bool
) -> None:
    """Compare the compiled module with the pure-Python reference, and test what must hold.

    So too the portable form of C, compiled for this; the first time in some seconds.

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
@click.option("--digits", type=click.IntRange(1, 17), help="Recommend for so many digits only.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Write all figures to FILE.")
@options.QUIET
def report_command(
    scenes: Sequence[Path], root: Path, digits: int | None, file: Path | None, quiet: bool
) -> None:
    """Measure what every digit costs: each stepper over a range of h, against 25 digits or more.

    Writes a page, build/NAME/report.html: what the scene is, its equations and motion, then speed
    against error.

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
