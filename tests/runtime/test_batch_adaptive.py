"""Many trajectories by a tolerance: each is as it is alone, whatever its place and the threads."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from test_adaptive import KEPLER
from test_events import BALL

import eomc
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse

BUILDS = Path(__file__).parents[2] / "build" / "tests" / "adaptive"
MANY = "[run]\nbatch = true\n"


@pytest.fixture(scope="module")
def orbits() -> ModuleType:
    """Orbits about the origin."""
    text = KEPLER.replace("eccentric", "many_orbits").replace("[run]\n", MANY)
    return eomc.load(from_scene(parse(text, "orbits.toml")), BUILDS)


def starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Orbits of eccentricities from 0 to 0.95, at their nearest points."""
    e = np.linspace(0, 0.95, count)
    zero = np.zeros(count)
    return np.column_stack([1 - e, zero]), np.column_stack([zero, np.sqrt((1 + e) / (1 - e))])


@pytest.mark.parametrize("threads", [1, 2])
def test_each_is_as_it_is_alone(orbits: ModuleType, threads: int) -> None:
    q0, qd0 = starts(50)
    times = np.array([0.0, 0.7, 2.0, 2 * np.pi])
    run = orbits.simulate_batch(q0, qd0, tol=1e-9, times=times, threads=threads)
    assert run.q.shape == (50, 4, 2) and run.t.tolist() == times.tolist()
    assert set(run.status.tolist()) == {"ok"} and np.all(run.reached == times[-1])
    for k in (0, 1, 17, 49):
        alone = orbits.simulate(q0[k], qd0[k], tol=1e-9, times=times)
        assert np.array_equal(run.q[k], alone.q) and run.steps[k] == alone.steps
    assert np.abs(run.q[:, -1] - q0).max() < 1e-7
    assert run.steps[-1] > 2 * run.steps[0]
    assert pickle.loads(pickle.dumps(run)) == run
    assert "50 instances" in run.message and "tolerance 1e-09" in run.message


def test_rows_are_start_and_end_where_no_times_are_asked_for(orbits: ModuleType) -> None:
    q0, qd0 = starts(3)
    mu = np.array([1.0, 1.5, 2.0])
    run = orbits.simulate_batch(q0, qd0, duration=1.0, params={"mu": mu}, u=[[0.0], [0.1], [0.2]])
    assert run.t.tolist() == [0, 1] and np.array_equal(run.q[:, 0], q0) and run.tol == 1e-9
    alone = orbits.simulate(q0[2], qd0[2], duration=1.0, params={"mu": 2.0}, u=[0.2])
    assert np.array_equal(run.q[2, -1], alone.q[-1])
    assert run.energy.shape == (3, 2) and run["x"].shape == (3, 2)


def test_jumps_and_stops_act_in_each() -> None:
    text = BALL.replace("bouncing", "many_balls").replace("[run]\n", MANY)
    balls = eomc.load(from_scene(parse(text, "balls.toml")), BUILDS)
    far = np.array([1e9, 0.7, 1e9])
    run = balls.simulate_batch(params={"far": far, "e": [0.8, 0.8, 0.5]}, duration=2.0)
    assert run.status.tolist() == ["ok", "ok", "accumulated"]
    assert run.reached[0] == 2 and run.reached[1] == pytest.approx(0.7) and run.reached[2] < 1.4
    assert np.isnan(run.q[1:, 1]).all() and np.array_equal(
        run.q[0, -1], balls.simulate(duration=2.0).q[-1]
    )


def test_a_saved_batch_is_read_again(orbits: ModuleType, tmp_path: Path) -> None:
    run = orbits.simulate_batch(*starts(4), duration=0.5)
    run.save(tmp_path / "orbits.npz")
    again = orbits.load_run(tmp_path / "orbits.npz")
    assert again == run and again.tol == run.tol
    with pytest.raises(ValueError, match="h: belongs to fixed steps"):
        orbits.simulate_batch(*starts(4), h=0.1, tol=1e-6)
