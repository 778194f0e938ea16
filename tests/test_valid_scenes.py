"""Valid scenes build and are right; what has no meaning is refused at its line, with a remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from eomc import check, scene, system
from eomc.problems import SceneError

BUILDS = Path(__file__).parent.parent / "build" / "tests" / "valid"


def text(
    name: str,
    coordinates: str = "x = { start = 0.3 }",
    parameters: str = "m = 1.25",
    inputs: str = "",
    definitions: str = "",
    kinetic: str = "m*x_dot**2/2",
    potential: str = "x**2/2",
    forces: str = "",
    run: str = "",
) -> str:
    """A scene of one mass on a spring, but for what is given."""
    return f"""eomc = 1
name = "{name}"
[coordinates]
{coordinates}
[parameters]
{parameters}
[inputs]
{inputs}
[definitions]
{definitions}
[energy]
kinetic = "{kinetic}"
potential = "{potential}"
[forces]
{forces}
[run]
duration = 0.2
{run}
"""


def assert_checks(scene_text: str) -> None:
    """It builds, and every row of eomc check passes."""
    made = system.from_scene(scene.parse(scene_text, "valid.toml"))
    rows = check.rows(made, BUILDS)
    assert [row for row in rows if not row.passed] == []
