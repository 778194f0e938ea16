"""eomc check: the compiled module compared with the reference."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from eomc import pipeline
from eomc.cli import options
from eomc.cli.terminal import progress_bar, say, warn


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
