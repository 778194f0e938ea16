"""eomc new, import, schema and list: write scene files and their JSON Schema, and list scenes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from eomc import pipeline
from eomc.base import resources, texts
from eomc.base.errors import EomcError, NoCompilerError
from eomc.cli import options
from eomc.cli.options import escape_line, parse_pairs, say

if TYPE_CHECKING:
    from eomc.robots.robot import Robot

# --- new ------------------------------------------------------------------------------------------

DEFAULT = "pendulum"  # name of the template's scene


@click.command("new")
@click.argument("name", required=False)
@click.option(
    "--from", "source", metavar="SCENE",
    help="A scene listed by 'eomc list'; by default a driven pendulum.",
)  # fmt: skip
def new_command(name: str | None, source: str | None) -> None:
    """Write a scene to start from: scenes/NAME.toml, or NAME.toml if there is no scenes/.

    NAME is by default the name of the copied scene.

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
    path = options.scene_path(name)
    options.write_new(path, _driven_pendulum(name) if copied is None else copied)
    say(f"wrote {escape_line(path)}; try: eomc run {texts.command(str(path))}")


def _driven_pendulum(name: str) -> str:
    """Return the driven pendulum under this name."""
    from eomc.emit.common.templates import environment

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
            f"--from {escape_line(source)}: is no scene that comes with eomc; {hint}they are "
            + ", ".join(known)
        )
    text = known[source].read_text(encoding="utf-8")
    return re.sub(rf'^(name *= *)"{source}"', rf'\1"{name}"', text, count=1, flags=re.MULTILINE)


# --- import ---------------------------------------------------------------------------------------


@click.command("import")
@click.argument("file", type=options.PATH)
@click.option(
    "--out",
    type=options.PATH,
    help="The scene; by default scenes/NAME.toml, or NAME.toml if there is no scenes/.",
)
@click.option("--name", help="Name of the scene, instead of the robot's.")
@click.option(
    "--lock",
    "locks",
    multiple=True,
    metavar="JOINT=VALUE",
    help="Fix a joint at a value in rad or m.",
)
@click.option(
    "--root",
    metavar="LINK",
    default="",
    help="Keep this link, fixed to the world, and the links that it carries.",
)
@click.option("--tip", metavar="LINK", default="", help="Keep the chain that ends in this link.")
@click.option(
    "--base",
    type=click.Choice(["fixed", "free"]),
    help="Base of the robot: free (floating) or fixed, instead of the file's.",
)
@click.option("--no-drives", is_flag=True, help="Write no inputs.")
@click.option(
    "--mend-inertias",
    is_flag=True,
    help="Replace impossible inertia tensors by the nearest possible ones.",
)
@click.option("--stops", is_flag=True, help="Position limits of joints become stops.")
@click.option("--limits", is_flag=True, help="Limits of drives become limits of inputs.")
@click.option(
    "--parameters", type=click.Choice(["masses"]),
    help="masses: masses become parameters, with a payload at each tip.",
)  # fmt: skip
@click.option(
    "--include", is_flag=True, help="Open the files that <include> names, in the file's folder."
)
@options.as_namespace
def import_command(arguments: SimpleNamespace) -> None:
    """Write the scene of a robot file, URDF or MJCF, and report what is left out.

    \b
    eomc import panda.urdf --lock panda_finger_joint1=0.04
    eomc import humanoid.urdf --root torso --tip left_hand
    """
    from eomc.robots import scene_text
    from eomc.scene.toml_text import MAX_BYTES

    robot = _edit_robot(_read_robot(arguments), arguments)
    path = arguments.out or options.scene_path(robot.name)
    text = scene_text.scene_text(robot)
    if len(text.encode()) > MAX_BYTES:
        raise EomcError(
            f"{escape_line(arguments.file)}: its scene would have {len(text.encode())} bytes, and "
            f"a scene has at most {MAX_BYTES}: cut out a part with --root and --tip"
        )
    options.write_new(path, text)
    called = "" if path.stem == robot.name else f"; its module is called {robot.name}"
    points = sum(body.point for body in robot.bodies)
    marks = f"points {points}, " if points else ""
    say(
        f"wrote {escape_line(path)}: bodies {len(robot.bodies) - points}, {marks}"
        f"coordinates {len(robot.motions)}, inputs {len(robot.drives)}{called}"
    )
    if robot.left_out:
        say("not modelled, or to be looked at:")
        for words in robot.left_out:
            say(f"  - {escape_line(words)}")
    typed = texts.command(str(path))
    say(f"try: eomc dof {typed}; eomc run {typed}")


def _read_robot(arguments: SimpleNamespace) -> Robot:
    """Read the robot file, and give the robot the requested name."""
    from eomc.base import names
    from eomc.robots import mjcf, urdf, xml

    file, name = arguments.file, arguments.name
    if xml.root(file).kind.startswith("mujoco"):  # mujocoinclude is a part, which is refused
        robot = mjcf.read(file, arguments.include)
    elif arguments.include:
        raise EomcError(f"--include is for MJCF files, and {escape_line(file)} is none")
    else:
        robot = urdf.read(file)
    if name is None:
        return robot
    if why := names.module_fault(name):
        raise EomcError(f"--name: {why}")
    return replace(robot, name=name)


def _edit_robot(robot: Robot, arguments: SimpleNamespace) -> Robot:
    """Return the robot, prepared for a scene, with the changes that the options request."""
    from eomc.robots import edit, scene_text
    from eomc.robots.robot import with_left_out_note

    locked_values = dict(parse_pairs(arguments.locks, "--lock", {}))
    try:
        robot = edit.lock(robot, locked_values)
        robot = edit.cut(robot, arguments.root, arguments.tip)
        if arguments.base:
            robot = edit.with_base(robot, free=arguments.base == "free")
        if arguments.no_drives:
            robot = replace(robot, drives=())
        if arguments.mend_inertias:
            robot = edit.with_nearest_inertias(robot)
        if arguments.stops:
            robot = edit.with_joint_stops(robot)
        if arguments.limits:
            robot = edit.with_input_limits(robot)
        if arguments.parameters:
            robot = edit.with_masses(robot, arguments.tip)
        return scene_text.prepare_for_scene(robot)
    except EomcError as fault:
        raise with_left_out_note(fault, robot.left_out) from None


# --- schema ---------------------------------------------------------------------------------------


@click.command("schema")
@click.option("--out", type=options.PATH, help="Write the schema to this file.")
def schema_command(out: Path | None) -> None:
    """Print the JSON Schema of scenes, for completion and checks in editors.

    \b
    eomc schema --out scene.schema.json
    """
    from eomc.scene.schema import json_schema

    text = json.dumps(json_schema(), indent=1)
    if out is None:
        say(text)
        return
    options.check_target(out, [".json"], "--out")
    options.write_text(out, text + "\n")
    say(f"wrote {escape_line(out)}; in the first line of a scene: #:schema {escape_line(out)}")


# --- list -----------------------------------------------------------------------------------------

Row = dict[str, Any]


@click.command("list")
@click.argument("folders", nargs=-1, type=options.PATH)
@options.BUILD
@options.JSON
def list_command(folders: Sequence[Path], root: Path, as_json: bool) -> None:
    """List the scenes in scenes/, or in the given folders, and whether they are built.

    Without a folder, the scenes of eomc are listed too; 'eomc new --from NAME' copies one.

    \b
    eomc list
    """
    default = Path("scenes") if Path("scenes").is_dir() else Path()
    here = [row for folder in folders or [default] for row in _scenes_in(folder, root)]
    shipped: list[Row] = []
    if not folders and resources.folder("scenes").resolve() != default.resolve():
        shipped = [row for file in resources.scenes().values() if (row := _row(file, root))]
    if as_json:
        rows = [*(row | {"shipped": False} for row in here)]
        rows += [row | {"shipped": True, "built": False} for row in shipped]
        say(json.dumps(rows, indent=1))
        return
    if not here:
        say("no scenes here: 'eomc new NAME' writes one")
    _print(here)
    if shipped:
        say("\nwith eomc come, by 'eomc new --from NAME':")
        _print([row | {"scene": row["name"], "built": False} for row in shipped])


def _scenes_in(folder: Path, root: Path) -> Iterator[Row]:
    """Yield the rows of the scenes in a folder."""
    if not folder.is_dir():
        raise EomcError(f"{escape_line(folder)}: is not a folder")
    for path in sorted(folder.glob("*.toml")):
        if row := _row(path, root):
            yield row


def _row(path: Path, root: Path) -> Row | None:
    """Return the row of a scene; None if the file is not a scene."""
    from eomc.scene.toml_text import tree_and_digest
    from eomc.toolchain import cache

    try:
        text, _ = tree_and_digest(path)
    except (OSError, EomcError):
        text = {"eomc": 0, "name": path.stem, "title": "(can't be read: eomc build says why)"}
    if "eomc" not in text or not isinstance(text.get("name"), str):
        return None
    name, digest = pipeline.name_and_digest(path)
    try:
        built = bool(name) and cache.is_built(root / name, cache.key(digest))
    except NoCompilerError:
        built = bool(cache.find_valid_key(root / name, digest))
    return {
        "scene": str(path), "name": text["name"], "title": str(text.get("title", "")),
        "coordinates": _keys(text, "coordinates"), "inputs": _keys(text, "inputs"),
        "built": built,
    }  # fmt: skip


def _print(rows: Sequence[Row]) -> None:
    """Print one line per scene, in columns."""
    rows = [
        row
        | {key: escape_line(row[key]) for key in ("scene", "title")}
        | {key: list(map(escape_line, row[key])) for key in ("coordinates", "inputs")}
        for row in rows
    ]
    width = max((len(row["scene"]) for row in rows), default=0)
    titles = max((len(row["title"]) for row in rows), default=0)
    for row in rows:
        moved = f"({', '.join(row['inputs'])})" if row["inputs"] else ""
        mark = "built" if row["built"] else "     "
        say(
            f"{row['scene']:{width}}  {row['title']:{titles}}  "
            f"{mark}  {', '.join(row['coordinates'])} {moved}".rstrip()
        )


def _keys(text: Mapping[str, Any], table: str) -> list[str]:
    """Return the names in a table of an unchecked scene."""
    entries = text.get(table)
    return list(entries) if isinstance(entries, dict) else []
