"""Discrete coordinates that only events change: stick-slip friction, by closed forms."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import CliRunner
from support import cases
from support.session import Modules

from eomc.cli.main import main

PAGE = Path(__file__).parents[2] / "docs" / "adaptive.md"
RUBBED = """eomc = 1
name = "rubbed_block"
[coordinates]
x = { start = 1.0 }
s = { start = -1 }
[parameters]
m  = 1.0
k  = 10.0
mu = 0.1
g  = 9.81
[energy]
kinetic = "m*x_dot**2/2 + s_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "-mu*m*g*s + k*x*(1 - s**2)"
[outputs]
slides = "sign(x_dot)"
[[event]]
name = "turns"
when = "x_dot*s"
direction = "falling"
action = "jump"
x_dot = "0"
s = "-sign(x)*heaviside(k*abs(x) - mu*m*g)"
[run]
tolerance = 1e-12
"""


@pytest.fixture(scope="module")
def block(modules: Modules) -> ModuleType:
    return modules.unoptimised(RUBBED)


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
def test_block_comes_to_rest_at_the_closed_form(block: ModuleType, tol: float) -> None:
    run = cases.block_at_rest(block, tol)
    assert run.qd[-1].tolist() == [0, 0] and run.slides[1] == -1 and run.slides[-1] == 0


@pytest.mark.slow
def test_block_on_a_belt_sticks_and_slides(modules: Modules) -> None:
    """The scene of docs/adaptive.md."""
    text = re.search(r"```toml\n(eomc = 1\nname = \"on_a_belt\".*?)```", PAGE.read_text(), re.S)
    assert text
    run = modules.unoptimised(text[1]).simulate()
    rate, speed = math.sqrt(10.0), 0.1
    # the block slips at this position, and slides about that one
    slip_position, middle = 0.4 * 9.81 / 10, 0.3 * 9.81 / 10
    slides = 2 * (math.pi - math.atan(rate * (slip_position - middle) / speed)) / rate
    starts, stops = run.events["starts"].t, run.events["stops"].t
    assert run.status == "ok" and len(starts) == len(stops) == 18
    assert starts[0] == pytest.approx(slip_position / speed, rel=1e-13)
    np.testing.assert_allclose(stops - starts, slides, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        np.diff(starts), slides + 2 * (slip_position - middle) / speed, atol=1e-12
    )


@pytest.mark.slow
def test_ball_rests_after_its_last_bounce(modules: Modules, tmp_path: Path) -> None:
    """The scenes and the session of docs/adaptive.md."""
    section = re.search(r"### After the last bounce\n(.*?)\n## ", PAGE.read_text(), re.S)
    assert section
    (text, event), (session,) = (
        re.findall(rf"```{language}\n(.*?)```", section[1], re.S) for language in ("toml", "python")
    )
    names = {"ball": modules.unoptimised(text)}
    with pytest.warns(RuntimeWarning, match="jumps follow one another ever sooner"):
        exec(session, names)
    bounces, lies = (names[name] for name in ("bounces", "lies"))
    fall_time = math.sqrt(2 / 9.81)
    assert bounces.status == "accumulated" and bounces.limit == pytest.approx(
        9 * fall_time, rel=1e-10
    )
    assert lies.status == "ok" and lies.t[0] == bounces.limit and lies.t[-1] == 10.0
    assert lies.q[-1] == pytest.approx([10, 0], abs=1e-12) and not lies.events["impact"]
    at_rest = re.sub(r"\[\[event\]\].*?\n\n", event + "\n", text, flags=re.S)
    at_rest = at_rest.replace("[parameters]\n", "[parameters]\nv_rest = 1e-3\n")
    run = modules.unoptimised(at_rest.replace('"ball"', '"ball_rests"')).simulate()
    last = run.events["impact"]
    early = bounces.limit - last.t[-1]
    assert run.status == "ok" and run.t[-1] == 10.0 and run["air"][-1] == 0
    assert 0 < early < 2 * 0.8 * 1e-3 / (9.81 * 0.2) < 0.82e-3 and -1e-3 < last.qd[-1, 1] < 0
    assert run.q[-1, :2] == pytest.approx([10, 0], abs=1e-12)
    file = tmp_path / "ball.toml"
    file.write_text(text, encoding="utf-8")
    result = CliRunner().invoke(main, ["run", str(file)])
    assert result.exit_code == 0 and "jumps follow one another ever sooner" in result.output
