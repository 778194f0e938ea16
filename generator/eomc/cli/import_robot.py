"""eomc import: the scene of a robot file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.cli import files
from eomc.cli.pairs import parse_pairs
from eomc.cli.terminal import say, shown


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="The scene; by default as eomc new has it."
)
@click.option("--name", help="Of the scene, instead of the robot's.")
@click.option(
    "--lock", "locks", multiple=True, metavar="JOINT=VALUE", help="Freeze a joint, at rad or m."
)
@click.option("--root", metavar="LINK", default="", help="Keep what this link carries, fix it.")
@click.option("--tip", metavar="LINK", default="", help="Keep the chain that ends in this link.")
@click.option(
    "--base", type=click.Choice(["fixed", "free"]), help="Of the root, instead of the file's."
)
@click.option("--no-drives", is_flag=True, help="No input for each joint.")
@click.option(
    "--mend-inertias", is_flag=True, help="Take the nearest inertia for one that no body can have."
)
@click.option("--stops", is_flag=True, help="Let limits of joints push back, as stops do.")
@click.option("--limits", is_flag=True, help="Let limits of drives act, as limits of inputs.")
@click.option(
    "--parameters", type=click.Choice(["masses"]),
    help="Make the masses parameters, with a payload at each tip.",
)  # fmt: skip
@click.option("--include", is_flag=True, help="Open what <include> names, in the file's folder.")
def command(
    file: Path, out: Path | None, name: str | None, locks: Sequence[str], root: str, tip: str,
    base: str | None, no_drives: bool, mend_inertias: bool, stops: bool, limits: bool,
    parameters: str | None, include: bool,
) -> None:  # fmt: skip
    """Write the scene of a robot file, URDF or MJCF, and say what it leaves out.

    \b
    eomc import panda.urdf --lock panda_finger_joint1=0.04
    eomc import humanoid.urdf --root torso --tip left_hand
    """
    from dataclasses import replace

    from eomc.base import names
    from eomc.robots import edit, preparation, scene_text, urdf, xml
    from eomc.robots.edit import with_masses
    from eomc.robots.limits import with_input_limits
    from eomc.robots.mjcf import read
    from eomc.robots.robot import with_left_out_note
    from eomc.scene.toml_text import MAX_BYTES

    element = xml.root(file).kind
    if element.startswith("mujoco"):  # mujocoinclude is a part, which is refused
        robot = read.read(file, include)
    elif include:
        raise EomcError(f"--include is for MJCF files, and {shown(file)} is none")
    else:
        robot = urdf.read(file)
    if name is not None:
        if why := names.module_fault(name):
            raise EomcError(f"--name: {why}")
        robot = replace(robot, name=name)
    values = dict(parse_pairs(locks, "--lock", {}))
    try:
        robot = edit.lock(robot, values)
        robot = edit.cut(robot, root, tip)
        if base:
            robot = edit.with_base(robot, free=base == "free")
        if no_drives:
            robot = replace(robot, drives=())
        if mend_inertias:
            robot = edit.with_nearest_inertias(robot)
        if stops:
            robot = edit.with_joint_stops(robot)
        if limits:
            robot = with_input_limits(robot)
        if parameters:
            robot = with_masses(robot, tip)
        robot = preparation.prepared_for_scene(robot)
    except EomcError as fault:
        raise with_left_out_note(fault, robot.left_out) from None
    path = out or files.scene_path(robot.name)
    text = scene_text.scene_text(robot)
    if len(text.encode()) > MAX_BYTES:
        raise EomcError(
            f"{shown(file)}: its scene would have {len(text.encode())} bytes, and a scene has at "
            f"most {MAX_BYTES}: cut out a part with --root and --tip"
        )
    files.write_new(path, text)
    called = "" if path.stem == robot.name else f"; its module is called {robot.name}"
    points = sum(body.point for body in robot.bodies)
    marks = f"points {points}, " if points else ""
    say(
        f"wrote {shown(path)}: bodies {len(robot.bodies) - points}, {marks}"
        f"coordinates {len(robot.motions)}, inputs {len(robot.drives)}{called}"
    )
    if robot.left_out:
        say("not modelled, or to be looked at:")
        for words in robot.left_out:
            say(f"  - {shown(words)}")
    typed = texts.command(str(path))
    say(f"try: eomc dof {typed}; eomc run {typed}")
