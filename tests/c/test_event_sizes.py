"""The portable C of a small scene with an event and fixed steps: lines and bytes."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.compilation import compiled, run
from support.session import needs

import eomc
from eomc.emit.common.amalgamate import COMMENT, paragraphs
from eomc.model.system import System, from_scene
from eomc.scene.read import parse

MAX_LINES = 900  # of the source
MAX_FUNCTION_LINES = 60
MAX_BYTES = 9000  # of the code in single precision for a Cortex-M4F
CORTEX_M4F = "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard -mthumb -Os".split()
BALL = """eomc = 1
name = "ball"
[coordinates]
y = { start = 1.0 }
[parameters]
e = 0.8
g = 9.81
[energy]
kinetic = "y_dot**2/2"
potential = "g*y"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[run]
duration = 3.0
"""


def ball(text: str = BALL) -> System:
    """Return a ball that bounces."""
    return from_scene(parse(text, "ball.toml"))


def test_source_of_a_ball_is_short() -> None:
    source = eomc.sources(ball()).files["ball.c"]
    assert len(source.splitlines()) <= MAX_LINES
    for part in paragraphs(source):
        code = COMMENT.sub("", part).strip()
        assert len(code.splitlines()) <= MAX_FUNCTION_LINES, code[:200]


@pytest.mark.slow
def test_code_of_a_ball_fits_a_small_processor(tmp_path: Path) -> None:
    compiler, size = needs("arm-none-eabi-gcc"), needs("arm-none-eabi-size")
    files = eomc.sources(ball(BALL + 'real = "float"\n')).files
    for name in ("ball.h", "ball.c"):
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    compiled(compiler, *CORTEX_M4F, "-c", "ball.c", "-o", "ball.o", cwd=tmp_path)
    sections = run(size, "ball.o", cwd=tmp_path).stdout.splitlines()[1].split()
    assert int(sections[0]) <= MAX_BYTES
    assert sections[1:3] == ["0", "0"]  # data that are written
