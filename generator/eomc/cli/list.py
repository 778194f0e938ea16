"""eomc list: scenes, and whether they are built."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.cli import options
from eomc.cli.terminal import say, shown


@click.command("list")
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path))
@options.BUILD
@options.JSON
def command(folders: Sequence[Path], root: Path, as_json: bool) -> None:
    """List the scenes in scenes/, or in the given folders, and whether they are built.

    \b
    eomc list
    """
    from eomc.scene.toml_text import tree_and_digest
    from eomc.toolchain import cache

    rows = []
    default = Path("scenes") if Path("scenes").is_dir() else Path()
    for folder in folders or [default]:
        if not folder.is_dir():
            raise EomcError(f"{shown(folder)}: is not a folder")
        for path in sorted(folder.glob("*.toml")):
            try:
                text, _ = tree_and_digest(path)
            except (OSError, ValueError):
                text = {
                    "eomc": 0,
                    "name": path.stem,
                    "title": "(can't be read: eomc build says why)",
                }
            if "eomc" not in text or not isinstance(text.get("name"), str):
                continue
            name, digest = pipeline.name_and_digest(path)
            built = bool(name) and cache.found(root / name, cache.key(digest))
            rows.append(
                {"scene": str(path), "name": text["name"], "title": str(text.get("title", "")),
                 "coordinates": _keys(text, "coordinates"), "inputs": _keys(text, "inputs"),
                 "built": built}
            )  # fmt: skip
    if as_json:
        say(json.dumps(rows, indent=1))
        return
    if not rows:
        say("no scenes here: 'eomc new NAME' writes one")
    for row in rows:
        row |= {key: shown(row[key]) for key in ("scene", "title")}
        row |= {key: list(map(shown, row[key])) for key in ("coordinates", "inputs")}
    wide = max((len(row["scene"]) for row in rows), default=0)
    titles = max((len(row["title"]) for row in rows), default=0)
    for row in rows:
        moved = f"({', '.join(row['inputs'])})" if row["inputs"] else ""
        mark = "built" if row["built"] else "     "
        say(
            f"{row['scene']:{wide}}  {row['title']:{titles}}  "
            f"{mark}  {', '.join(row['coordinates'])} {moved}".rstrip()
        )


def _keys(text: Mapping[str, Any], table: str) -> list[str]:
    """The names in a table of a scene that nobody has checked."""
    found = text.get(table)
    return list(found) if isinstance(found, dict) else []
