"""eomc list: scenes, and whether they are built."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from eomc import pipeline
from eomc.base import resources
from eomc.base.errors import EomcError, NoCompilerError
from eomc.cli import options
from eomc.cli.terminal import say, shown

Row = dict[str, Any]


@click.command("list")
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path))
@options.BUILD
@options.JSON
def command(folders: Sequence[Path], root: Path, as_json: bool) -> None:
    """List the scenes in scenes/, or in the given folders, and whether they are built.

    Without a folder, those that come with eomc follow: 'eomc new --from NAME' writes one here.

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
        raise EomcError(f"{shown(folder)}: is not a folder")
    for path in sorted(folder.glob("*.toml")):
        if row := _row(path, root):
            yield row


def _row(path: Path, root: Path) -> Row | None:
    """Return the row of a scene; None if the file is not a scene."""
    from eomc.scene.toml_text import tree_and_digest
    from eomc.toolchain import cache

    try:
        text, _ = tree_and_digest(path)
    except (OSError, ValueError):
        text = {"eomc": 0, "name": path.stem, "title": "(can't be read: eomc build says why)"}
    if "eomc" not in text or not isinstance(text.get("name"), str):
        return None
    name, digest = pipeline.name_and_digest(path)
    try:
        built = bool(name) and cache.is_built(root / name, cache.key(digest))
    except NoCompilerError:
        built = bool(cache.key_there(root / name, digest))
    return {
        "scene": str(path), "name": text["name"], "title": str(text.get("title", "")),
        "coordinates": _keys(text, "coordinates"), "inputs": _keys(text, "inputs"),
        "built": built,
    }  # fmt: skip


def _print(rows: Sequence[Row]) -> None:
    """Print one line per scene, in columns."""
    rows = [
        row
        | {key: shown(row[key]) for key in ("scene", "title")}
        | {key: list(map(shown, row[key])) for key in ("coordinates", "inputs")}
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
