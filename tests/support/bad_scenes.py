"""Scenes with mistakes and the messages about them, in tests/scene/bad/*.toml.

    python tests/support/bad_scenes.py      accepts changed messages: read the diff

A table of these files is a case: `base` names a correct scene of bases.toml, and `change` shows how
the case differs from it, as in `diff -u`: lines that begin with "-" are replaced by those that
begin with "+", and lines that begin with a space say where, because removed lines and their context
occur once in the base. A line "@@" separates changes in two places. A case without a base has its
whole text in `scene`. `encoding` is that of the file; `repeat` lists texts whose only occurrence in
the scene is repeated. `message` is what the user of the scene reads.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from eomc.base.errors import Problem, SceneError
from eomc.model.system import from_scene
from eomc.scene.read import read

FOLDER = Path(__file__).parents[1] / "scene" / "bad"
BASES: dict[str, str] = tomllib.loads((FOLDER / "bases.toml").read_text(encoding="utf-8"))
FILES = sorted(file for file in FOLDER.glob("*.toml") if file.name != "bases.toml")


@dataclass(frozen=True)
class BadScene:
    """A scene with a mistake: its text as bytes of a file, and the accepted message."""

    name: str
    text: bytes
    message: str


@cache
def bad_scenes() -> tuple[BadScene, ...]:
    """Return all cases."""
    return tuple(
        BadScene(name, _text(name, case), case.get("message", ""))
        for file in FILES
        for name, case in tomllib.loads(file.read_text(encoding="utf-8")).items()
    )


def _text(name: str, case: dict[str, Any]) -> bytes:
    """Return the text of a case as bytes."""
    text = case["scene"] if "scene" in case else apply_change(BASES[case["base"]], case["change"])
    for part, count in case.get("repeat", {}).items():
        assert text.count(part) == 1, f"{name}: {part!r} occurs {text.count(part)} times"
        text = text.replace(part, part * count)
    return bytes(text.encode(case.get("encoding", "utf-8")))


def apply_change(base: str, change: str) -> str:
    """Return the text that a change makes of a base."""
    text = base
    for hunk in change.split("@@\n"):
        lines = hunk.splitlines(keepends=True)
        old = "".join(line[1:] for line in lines if line[0] in " -")
        new = "".join(line[1:] for line in lines if line[0] in " +")
        places = [m.start() for m in re.finditer(f"(?m)^{re.escape(old)}", text)] if old else [0]
        assert len(places) == 1, f"occurs {len(places)} times:\n{old}"
        text = text[: places[0]] + new + text[places[0] + len(old) :]
    return text


@cache
def diagnose(scene: BadScene) -> tuple[tuple[Problem, ...], str]:
    """Return the problems of a scene and the message that its user reads."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        file.write_bytes(scene.text)
        try:
            problems = from_scene(read(file)).warnings
            message = "\n".join(map(str, problems))
        except SceneError as error:
            problems, message = error.problems, str(error)
        problems = tuple(replace(problem, file=file.name) for problem in problems)
        return problems, message.replace(str(file), file.name) + "\n"


def accept_messages(text: str) -> str:
    """Return the text of a file of cases with the current messages."""
    current = {scene.name: diagnose(scene)[1] for scene in bad_scenes()}

    def renew(section: re.Match[str]) -> str:
        cause = re.sub(r"(?ms)^message = '''.*?'''\n", "", section[0]).rstrip("\n")
        assert "'''" not in current[section[1]]
        return f"{cause}\nmessage = '''\n{current[section[1]]}'''\n\n"

    head = r"^\[(\w+)\]\n(?:base|scene) = "
    return re.sub(rf"(?ms){head}.*?(?={head}|\Z)", renew, text).rstrip("\n") + "\n"


def main() -> None:
    """Write the current messages to all files."""
    for file in FILES:
        text = file.read_text(encoding="utf-8")
        file.write_text(accept_messages(text), encoding="utf-8")


if __name__ == "__main__":
    main()
