"""eomc new: a scene to start from."""

from __future__ import annotations

import click

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.cli import files
from eomc.cli.terminal import say, shown


@click.command("new")
@click.argument("name")
def command(name: str) -> None:
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
    path = files.scene_path(name)
    files.write_new(path, text)
    say(f"wrote {shown(path)}; try: eomc run {texts.command(str(path))}")
