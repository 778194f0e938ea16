"""eomc dof: a scene's freedoms."""

from __future__ import annotations

import json
from pathlib import Path

import click

from eomc.cli import options
from eomc.cli.terminal import say


@click.command("dof")
@options.SCENE
@options.JSON
def command(scene: Path, as_json: bool) -> None:
    """Count a scene's freedoms, from its bodies and joints, and say which are redundant.

    \b
    eomc dof scenes/arm.toml
    """
    from eomc.model import mobility
    from eomc.scene import read as scenes

    counted = mobility.count(scenes.read(scene))
    say(json.dumps(counted.as_dict(), indent=1) if as_json else counted.table())
