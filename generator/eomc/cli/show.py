"""eomc show: the equations as text."""

from __future__ import annotations

from pathlib import Path

import click

from eomc import pipeline
from eomc.cli import options
from eomc.cli.terminal import say, status_line
from eomc.toolchain import kept


@click.command("show")
@options.SCENE
@options.BUILD
@click.option("--latex", "form", flag_value="latex", help="LaTeX, for amsmath.")
@click.option(
    "--python", "form", flag_value="python", help="Python source that makes the matrices."
)
@click.option("--cost", "form", flag_value="cost", help="Operations of each generated function.")
def command(scene: Path, root: Path, form: str | None) -> None:
    """Print the equations of motion, L, D, C, g and the rest, as text for a terminal.

    \b
    eomc show scenes/cartpole.toml
    eomc show scenes/cartpole.toml --latex
    """
    name, digest = pipeline.name_and_digest(scene)

    def made() -> dict[str, str]:
        from eomc.report import equations, equations_text

        system = pipeline.read(scene)
        if form == "cost":
            text = equations_text.cost(system)
        else:
            text = equations.written(system, form or "text")
        return {"text": text, "warnings": "\n".join(map(str, system.warnings))}

    with status_line("deriving", False):
        found = kept.texts(root, name, form or "text", digest, made)
    if found["warnings"]:
        say(found["warnings"], err=True)
    say(found["text"])
