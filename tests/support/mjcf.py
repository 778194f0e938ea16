"""MJCF models from text."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from click.testing import CliRunner

from eomc.base.errors import SceneError
from eomc.cli.main import main
from eomc.robots import mjcf
from eomc.robots.robot import Robot

PI = math.pi
CLOSE = 1e-14  # relative; the compared numbers need a few operations each


def model(tmp_path: Path, inside: str, before: str = "", after: str = "") -> Robot:
    """Return the robot of a text: `inside` <worldbody>, `before` and `after` it."""
    file = tmp_path / "model.xml"
    file.write_text(f"<mujoco>{before}\n<worldbody>{inside}</worldbody>\n{after}</mujoco>")
    return mjcf.read(file)


def import_robot(folder: Path, text: str, *words: str) -> tuple[str, str]:
    """Import a robot file; return the command's output and the scene ("" if there is none)."""
    file, scene = folder / "robot.xml", folder / "robot.toml"
    file.write_text(text, encoding="utf-8")
    result = CliRunner().invoke(main, ["import", str(file), "--out", str(scene), *words])
    assert result.exit_code == (0 if scene.exists() else 2), result.output
    return result.output, scene.read_text(encoding="utf-8") if scene.exists() else ""


def refused(tmp_path: Path, inside: str, before: str = "", after: str = "") -> str:
    with pytest.raises(SceneError) as fault:
        model(tmp_path, inside, before, after)
    return str(fault.value)


BALL = '<geom size="0.1"/>'
BODY = f'<body name="a"><joint name="j"/>{BALL}</body>'


def reported(robot: Robot, *words: str) -> bool:
    """Return True if one line of the report contains all the words."""
    return any(all(word in line for word in words) for line in robot.left_out)
