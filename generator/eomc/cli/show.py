"""eomc show: the equations as text."""

from __future__ import annotations

from pathlib import Path

import click

from eomc import pipeline
from eomc.cli import options
from eomc.cli.terminal import say, status_line, warn


@click.command("show")
@options.SCENE
@click.option("--latex", "form", flag_value="latex", help="LaTeX.")
@click.option(
    "--python", "form", flag_value="python", help="Python source that makes the matrices."
)
@click.option("--cost", "form", flag_value="cost", help="Operations of each generated function.")
def command(scene: Path, form: str | None) -> None:
    """Print D, C, g and the rest, as text for a terminal.

    \b
    eomc show scenes/cartpole.toml
    eomc show scenes/cartpole.toml --latex
    """
    from eomc.report import equations_text as shown

    system = pipeline.read(scene)
    for problem in system.warnings:
        warn(problem)
    with status_line("deriving", False):
        text = shown.cost(system) if form == "cost" else shown.equations(system, form or "text")
    say(text)
