"""eomc report: what every digit costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click

from eomc import pipeline
from eomc.base.errors import SceneError
from eomc.cli import files, options
from eomc.cli.terminal import escape_line, progress_bar, say, status_line


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
    from eomc.report import cost_of_digits, overview
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
            text = pages.write_page(measurement, overview.describe_scene(system, measurement, root))
        files.write_text(page, text)
        if not quiet:
            say(f"\nwrote {escape_line(page)}\n")
            if missing_pictures := without_pictures():
                say(f"{missing_pictures}\n")
    if file is not None:
        files.write_text(file, json.dumps(measured, indent=1) + "\n")
