"""Jumps in quick succession: moving tables, walls with corners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import eomc

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "tables"
TABLE = """eomc = 1
name = "table"
[coordinates]
y = { unit = "m", start = 1 }
[parameters]
A = 0.005
w = 30
e = 0.5
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "y - A*sin(w*t)"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot + (1 + e)*A*w*cos(w*t)"
[run]
tolerance = 1e-9
duration = 20
batch = true
"""
STADIUM = """eomc = 1
name = "stadium"
[coordinates]
x = { unit = "m", start = 0.1, rate = 0.7 }
y = { unit = "m", start = 0.2, rate = 0.4 }
[definitions]
xs = "x - min(max(x, -1), 1)"
r2 = "xs**2 + y**2"
vn = "(xs*x_dot + y*y_dot)/r2"
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
[[event]]
name = "wall"
when = "1 - r2"
direction = "falling"
action = "jump"
x_dot = "x_dot - 2*vn*xs"
y_dot = "y_dot - 2*vn*y"
[run]
tolerance = 1e-9
duration = 100
batch = true
"""


@pytest.mark.slow
@pytest.mark.parametrize("e", [0.3, 0.5, 0.9])
def test_ball_does_not_fall_through_a_moving_table(tmp_path: Path, e: float) -> None:
    """The ball comes to rest on the table, or is thrown up again for ever."""
    file = tmp_path / "table.toml"
    file.write_text(TABLE, encoding="utf-8")
    A = np.linspace(0.002, 0.05, 100)
    runs = eomc.load(file, BUILDS).simulate_batch(params={"A": A, "e": e})
    assert not (runs.q[:, :, 0] < -1.001 * A[:, None]).any()  # rows after the end are NaN
    assert set(runs.status) <= {"ok", "accumulated"}
    flights = runs.events["impact"].for_instance(90)
    assert len(flights) > 10
    # free flight from the first impact to the second, in closed form
    t, v = flights.t[:2], -e * flights.qd[0, 0] + (1 + e) * A[90] * 30 * np.cos(30 * flights.t[0])
    height = A[90] * np.sin(30 * t[0]) + v * (t[1] - t[0]) - 9.81 * (t[1] - t[0]) ** 2 / 2
    assert abs(height - A[90] * np.sin(30 * t[1])) < 1e-10


@pytest.mark.slow
def test_ball_stays_inside_walls_with_corners_in_their_formula(tmp_path: Path) -> None:
    """Chords near the corners of the wall may be as short as rounding."""
    file = tmp_path / "stadium.toml"
    file.write_text(STADIUM, encoding="utf-8")
    y = np.linspace(-0.9, 0.9, 100)
    runs = eomc.load(file, BUILDS).simulate_batch(np.column_stack([0.1 + 0 * y, y]))
    x, y = np.moveaxis(runs.q, 2, 0)
    distance_x = x - np.clip(x, -1, 1)
    assert not (distance_x**2 + y**2 > 1 + 1e-9).any()  # rows after the end are NaN
    assert set(runs.status) <= {"ok", "accumulated"}
    completed = np.array(runs.status) == "ok"
    speed = np.hypot(*runs.qd[completed, -1].T)
    np.testing.assert_allclose(speed, np.hypot(0.7, 0.4), rtol=1e-9)
    assert completed.mean() > 0.9


def test_error_estimate_includes_the_amplification_of_rounding_by_jumps(tmp_path: Path) -> None:
    """Flights are exact at any tolerance: finer steps alone show no error."""
    file = tmp_path / "stadium.toml"
    file.write_text(STADIUM, encoding="utf-8")
    stadium = eomc.load(file, BUILDS)
    for options in ({}, {"times": [50.0]}):
        run = stadium.simulate(**options or {"duration": 50.0}, estimate=True)
        # about 7 digits are left; rounding errors of a run change its difference by half
        starts = [[0.1 + by, 0.2] for by in (-2e-15, -1e-15, 1e-15, 2e-15)]
        ends = [stadium.simulate(start, duration=50.0).q[-1] for start in starts]
        difference = np.median(np.abs(np.array(ends) - run.q[-1]), axis=0) / 1.5
        assert run.error.resolved and (run.error.q[-1] > 0.1 * difference).all()
        assert (run.error.q[-1] < 10 * difference).all() and max(run.error.digits.values()) < 10
    with pytest.warns(RuntimeWarning, match="chaotic: a difference at the start grows"):
        chaotic = stadium.simulate(estimate=True)
    assert chaotic.error.amplification > 1e14 and max(chaotic.error.digits.values()) < 3


def test_detection_of_a_root_takes_few_evaluations(tmp_path: Path) -> None:
    """An adaptive step takes 16 evaluations here, and so does each shorter step to a root."""
    file = tmp_path / "stadium.toml"
    file.write_text(STADIUM, encoding="utf-8")
    run = eomc.load(file, BUILDS).simulate(duration=10.0)
    assert run.steps == 10 and len(run.events["wall"].t) == 4
    assert run.evaluations <= 150
