"""eomc export: a scene for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from eomc import pipeline
from eomc.cli import files, options
from eomc.cli.terminal import say, shown, status_line, warn


@click.group("export")
def command() -> None:
    """Write a scene for other programs.

    \b
    eomc export fmu scenes/cartpole.toml
    """


@command.command("fmu")
@options.SCENE
@click.option(
    "--fmi", type=click.Choice(["2", "3"]), default="2", show_default=True,
    help="Version 2.0, which most tools read, or 3.0.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="The file, by default NAME.fmu.")
@click.option("--sources", is_flag=True, help="Sources only, no binary.")
@options.QUIET
def fmu(scene: Path, fmi: str, out: Path | None, sources: bool, quiet: bool) -> None:
    """Write a unit of FMI: co-simulation and model exchange, binary and source.

    \b
    eomc export fmu scenes/cartpole.toml
    eomc export fmu scenes/cartpole.toml --fmi 3 --out cartpole3.fmu
    """
    files.check_target(out, (".fmu",), "--out")
    with status_line("exporting", quiet):
        exported = pipeline.export_fmu(scene, out, int(fmi), binary=not sources, warn=warn)
    if exported.why:
        say(f"sources only: {exported.why}", err=True)
    if not quiet:
        inside = f"sources and a binary for {exported.binary}" if exported.binary else "sources"
        say(f"{shown(exported.file)}: FMI {fmi}.0, {inside}")
