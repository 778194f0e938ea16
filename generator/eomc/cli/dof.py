"""eomc dof: a scene's freedoms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from eomc.cli import options
from eomc.cli.terminal import say


@click.command("dof")
@options.SCENE
@options.JSON
def command(scene: Path, as_json: bool) -> None:
    """Count a scene's freedoms, from its bodies and joints, and say which are redundant.

    Of a scene with constraints or loops also the rank of their rows and the freedoms that they
    leave, which rows are redundant, how near the start is to a singular position, and with one
    freedom its whole way, and where it is assembled.

    \b
    eomc dof scenes/arm.toml
    eomc dof scenes/slider_crank.toml
    """
    from eomc.model import mobility
    from eomc.scene import read as scenes

    checked_scene = scenes.read(scene)
    counted: dict[str, Any] = {"scene": checked_scene.name}
    lines = []
    if not checked_scene.constrained or (checked_scene.assembly and checked_scene.assembly.bodies):
        mobility_count = mobility.count(checked_scene)
        counted, lines = mobility_count.as_dict(), [mobility_count.table()]
    if checked_scene.constrained:
        from eomc import pipeline
        from eomc.program import singular

        system = pipeline.read(scene)
        assert system.closure is not None
        counted["constraints"] = {
            **system.closure.as_dict(),
            "q": {c.name: c.start for c in system.coordinates},
            "qd": {f"{c.name}_dot": c.rate for c in system.coordinates},
        }
        lines.append(system.closure.table())
        if closest_singularity := singular.closest_singularity(system):
            counted["constraints"]["nearest_singular"] = vars(closest_singularity)
            lines.append(str(closest_singularity))
        start = (f"{c.name} = {c.start:.9g}" for c in system.coordinates)
        lines.append(f"  assembled start: {', '.join(start)}")
    say(json.dumps(counted, indent=1) if as_json else "\n".join(lines))
