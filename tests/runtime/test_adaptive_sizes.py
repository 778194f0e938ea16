"""Adaptive steps where one coordinate is much larger than the others."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.session import tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify.check import check

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "adaptive"
END = 60.0
# an orbit in m, and two arms, each on a spring, pulled by the gravity gradient
SATELLITE = """eomc = 1
name = "satellite"
[coordinates]
x = { unit = "m", start = 7e6 }
y = { unit = "m", rate = 7500 }
arm = { unit = "rad", start = 0.5, rate = 0.001 }
tip = { unit = "rad", start = 0.1, rate = 0.3 }
[parameters]
mu = { value = 3.986e14, unit = "m**3/s**2" }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2 + (arm_dot**2 + arm_dot*tip_dot*cos(arm - tip) + tip_dot**2)/2"
potential = "-mu/r - mu/2*(x*cos(arm) + y*sin(arm))**2/r**5 - cos(arm) - cos(tip)"
[definitions]
r = "sqrt(x**2 + y**2)"
[run]
method = "dp8"
tolerance = 1e-9
duration = 60
batch = true
"""
# a stiff, damped spring to a point FAR m away: its force is a difference of large numbers
ANCHORED = """eomc = 1
name = "anchored"
[coordinates]
base = { start = FAR }
arm = { start = 0.1 }
[energy]
kinetic = "(1000*base_dot**2 + (base_dot + arm_dot)**2)/2"
potential = "10000*(base + arm - FAR)**2/2 + 100*arm**4"
[forces]
arm = "-200*arm_dot"
[run]
tolerance = 1e-9
duration = 5
"""


def build(text: str) -> ModuleType:
    return eomc.load(from_scene(parse(text, "sizes.toml")), BUILDS)


@pytest.fixture(scope="module")
def satellite() -> ModuleType:
    return build(SATELLITE)


@pytest.fixture(scope="module")
def reference_end(satellite: ModuleType) -> np.ndarray:
    """Final coordinates, by fixed steps of two lengths."""
    coarse, fine = (
        satellite.simulate(h=END / steps, steps=steps, every=steps).q[-1]
        for steps in (16000, 24000)
    )
    assert np.max(np.abs(coarse - fine) / [7e6, 7e6, 1, 1]) < 1e-13
    return fine


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
def test_small_angles_are_accurate_despite_large_positions(
    satellite: ModuleType, reference_end: np.ndarray, tol: float
) -> None:
    run = satellite.simulate(tol=tol, duration=END)
    batch = satellite.simulate_batch(run.q[[0, 0]], run.qd[[0, 0]], tol=tol, duration=END)
    for q in (run.q[-1], *batch.q[:, -1]):
        assert np.max(np.abs(q - reference_end)[2:]) < 10 * tol
        assert np.max(np.abs(q - reference_end)[:2]) < 10 * tol * 7e6


@pytest.mark.slow
def test_check_of_module_with_metres_and_angles_passes(satellite: ModuleType) -> None:
    report = check(from_scene(parse(SATELLITE, "sizes.toml")), satellite, states=20)
    assert report.passed, report.table()


@pytest.mark.parametrize("far", tiers(["1000", "1000000"], "1000"))
def test_rounding_of_large_coordinates_costs_no_steps(far: str) -> None:
    """The residual motion is 1e-13 m of 1000 m; the stiff spring turns it into forces."""
    small = build(ANCHORED.replace("FAR", "1").replace('"anchored"', '"anchored_1"'))
    large = build(ANCHORED.replace("FAR", far).replace('"anchored"', f'"anchored_{far}"'))
    for tol in (1e-6, 1e-12):
        small_run, large_run = small.simulate(tol=tol), large.simulate(tol=tol)
        assert large_run.status == "ok" and large_run.steps < 10 * small_run.steps
        assert abs(large_run.q[-1, 1] - small_run.q[-1, 1]) < 10 * tol + 1e-14 * float(far)


OSCILLATOR = """eomc = 1
name = "late"
[coordinates]
x = { start = 1 }
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
[run]
tolerance = 1e-13
batch = true
"""


def test_large_start_time_costs_no_digits() -> None:
    """Rounding of times is compensated: 2.4e-7 s at 1.7e9 s had changed the state by 5e-8."""
    late, t0 = build(OSCILLATOR), 1.7e9
    elapsed = np.array([0.0, 1, 5, 10.5, 20])
    for run in (late.simulate(times=t0 + elapsed, t0=t0), late.simulate(duration=20, t0=t0)):
        np.testing.assert_allclose(run.q[:, 0][run.t == t0 + 20], np.cos(20), atol=1e-13)
    runs = late.simulate_batch(times=t0 + elapsed, t0=t0)
    for q in (runs.q[0], late.simulate(times=t0 + elapsed, t0=t0).q):
        np.testing.assert_allclose(q[:, 0], np.cos(elapsed), atol=1e-13)
