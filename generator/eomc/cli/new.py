"""eomc new: a scene to start from."""

from __future__ import annotations

import re

import click

from eomc.base import resources, texts
from eomc.base.errors import EomcError
from eomc.cli import files
from eomc.cli.terminal import say, shown

DEFAULT = "pendulum"  # name of the template's scene


@click.command("new")
@click.argument("name", required=False)
@click.option(
    "--from", "source", metavar="SCENE",
    help="A scene that comes with eomc, as 'eomc list' has them; by default a driven pendulum.",
)  # fmt: skip
def command(name: str | None, source: str | None) -> None:
    """Write a scene to start from: scenes/NAME.toml, or NAME.toml where there is no scenes/.

    NAME is by default what the scene is called that it starts from.

    \b
    eomc new crane
    eomc new --from cartpole
    eomc new crane --from cartpole
    """
    from eomc.base import names

    if name is None:
        name = source or DEFAULT
    copied = None if source is None else _copy_shipped(source, name)
    if why := names.module_fault(name):
        raise EomcError(why)
    path = files.scene_path(name)
    files.write_new(path, _driven_pendulum(name) if copied is None else copied)
    say(f"wrote {shown(path)}; try: eomc run {texts.command(str(path))}")


def _driven_pendulum(name: str) -> str:
    """Return the driven pendulum under this name."""
    from eomc.emit.render import environment

    title = name.replace("_", " ").capitalize()
    return environment().get_template("scene/scene.toml.jinja").render(name=name, title=title)


def _copy_shipped(source: str, name: str) -> str:
    """Return a scene that comes with eomc under this name. Raises EomcError if unknown."""
    known = resources.scenes()
    if source not in known:
        from eomc.scene.formulas import nearest

        near = nearest(source, known)
        hint = f"did you mean '{near}'? " if near else ""
        raise EomcError(
            f"--from {shown(source)}: is no scene that comes with eomc; {hint}they are "
            + ", ".join(known)
        )
    text = known[source].read_text(encoding="utf-8")
    return re.sub(rf'^(name *= *)"{source}"', rf'\1"{name}"', text, count=1, flags=re.MULTILINE)
