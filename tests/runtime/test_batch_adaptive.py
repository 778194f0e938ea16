"""Batches by a tolerance: each instance equals its single run, in any order and any threads."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.event_scenes import BALL, built
from support.session import Modules, tiers
from test_adaptive import KEPLER

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

BUILDS = Path(__file__).parents[2] / "build" / "tests" / "adaptive"
BATCH_RUN = "[run]\nbatch = true\n"


@pytest.fixture(scope="module")
def orbits(unoptimised_file: None) -> ModuleType:
    """Orbits about the origin."""
    text = KEPLER.replace("eccentric", "many_orbits").replace("[run]\n", BATCH_RUN)
    return eomc.load(from_scene(parse(text, "orbits.toml")), BUILDS)


def starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Orbits of eccentricities from 0 to 0.95, at their pericentres."""
    e = np.linspace(0, 0.95, count)
    zero = np.zeros(count)
    return np.column_stack([1 - e, zero]), np.column_stack([zero, np.sqrt((1 + e) / (1 - e))])


def equal_runs(first: object, second: object) -> bool:
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("q", "qd", "steps", "evaluations", "rejected", "stiff_steps", "reached")
    )


@pytest.mark.parametrize("threads", tiers([1, 2], 2))
def test_instance_is_independent_of_batch_order_and_threads(
    orbits: ModuleType, threads: int
) -> None:
    q0, qd0 = starts(50)
    times = np.array([0.0, 0.7, 2.0, 2 * np.pi])
    options = {"tol": 1e-9, "times": times}
    run = orbits.simulate_batch(q0, qd0, **options, threads=threads)
    assert run.q.shape == (50, 4, 2) and run.t.tolist() == times.tolist()
    assert set(run.status.tolist()) == {"ok"} and np.all(run.reached == times[-1])
    reversed_run = orbits.simulate_batch(q0[::-1], qd0[::-1], **options, threads=threads)
    assert np.array_equal(reversed_run.q[::-1], run.q) and np.array_equal(
        reversed_run.steps[::-1], run.steps
    )
    for k in (0, 1, 17, 49):
        separate = orbits.simulate_batch(q0[k : k + 1], qd0[k : k + 1], **options)
        assert (
            np.array_equal(run.q[k], separate.q[0])
            and run.evaluations[k] == separate.evaluations[0]
        )
        single = orbits.simulate(q0[k], qd0[k], **options)
        # the same steps, with sums in another order
        assert single.steps == run.steps[k] and single.rejected == run.rejected[k]
        assert np.abs(run.q[k] - single.q).max() < 1e-10
    assert np.abs(run.q[:, -1] - q0).max() < 1e-7
    assert run.steps[-1] > 2 * run.steps[0]
    assert pickle.loads(pickle.dumps(run)) == run
    assert "50 instances" in run.message and "tolerance 1e-09" in run.message


def test_batch_split_into_several_calls_is_identical(
    orbits: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any number of steps per call and any group size per thread."""
    options = {"tol": 1e-10, "times": np.linspace(0.1, 40.0, 30)}
    run = orbits.simulate_batch(*starts(21), **options)
    module = __import__(f"{orbits.__name__}._runtime.batch", fromlist=["batch"])
    monkeypatch.setattr(module, "next_chunk", lambda many, spent: many)
    for chunk_steps, group in ((1, 16), (7, 5), (64, 128)):
        monkeypatch.setattr(module, "FIRST_CHUNK_STEPS", chunk_steps)
        monkeypatch.setattr(module, "SMALL_GROUP_SIZE", group)
        assert equal_runs(orbits.simulate_batch(*starts(21), **options), run)


def test_maximum_step_size_holds_for_each_instance(orbits: ModuleType) -> None:
    run = orbits.simulate_batch(*starts(9), tol=1e-4, duration=6.0, max_step=0.05)
    assert np.all(run.steps >= 120)
    unlimited = orbits.simulate_batch(*starts(9), tol=1e-4, duration=6.0)
    assert unlimited.steps[0] < 20 and np.abs(run.q - unlimited.q).max() < 1e-2


def test_failed_instance_leaves_the_others_unchanged(orbits: ModuleType) -> None:
    q0, qd0 = starts(20)
    q0[3] = qd0[3] = 0  # at the centre there is no acceleration
    run = orbits.simulate_batch(q0, qd0, duration=3.0, tol=1e-8)
    rest = np.delete(np.arange(20), 3)
    assert run.status[3] == "not finite" and set(run.status[rest]) == {"ok"}
    assert run.reached[3] == 0 and np.isnan(run.q[3, -1]).all()
    separate = orbits.simulate_batch(q0[rest], qd0[rest], duration=3.0, tol=1e-8)
    assert np.array_equal(run.q[rest], separate.q)


@pytest.mark.slow
def test_instance_that_ends_early_reports_its_time() -> None:
    """x'' = k x^2 from x = 1, v = sqrt(2 k/3) goes to infinity: x = 1/(1 - t sqrt(k/6))^2."""
    text = STIFF.replace("many_stiff", "many_far").replace("k*x**2/2", "-k*x**3/3")
    module = eomc.load(from_scene(parse(text, "far.toml")), BUILDS)
    k = np.array([0.1, 6.0, 0.2, 24.0, 0.3])
    run = module.simulate_batch(
        qd0=np.sqrt(2 * k / 3)[:, None], params={"k": k, "c": 0.0}, duration=2.0, tol=1e-10
    )
    assert run.reached == pytest.approx([2, 1, 2, 0.5, 2], abs=1e-6)
    assert [status == "ok" for status in run.status] == [True, False, True, False, True]
    exact = (1 - 2 * np.sqrt(k / 6)) ** -2.0
    assert run.q[::2, -1, 0] == pytest.approx(exact[::2], rel=1e-8)
    assert np.isnan(run.q[1::2, -1]).all()


STIFF = """eomc = 1
name = "many_stiff"
[coordinates]
x = { unit = "m", start = 1 }
[parameters]
k = 1e4
c = 1e4
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "-c*x_dot"
[run]
batch = true
tolerance = 1e-9
"""


@pytest.mark.parametrize("stiff", [False, True])
def test_stiff_instances_take_newton_steps(modules: Modules, stiff: bool) -> None:
    """x = exp(-t) after the transient of 1e-4 s where c = k is large; the others oscillate."""
    springs = modules.unoptimised(STIFF)
    c = np.array([1e4, 0.0, 1e4, 0.1, 1e5])
    params = {"c": c, "k": np.where(c > 1, c, 1.0)}
    run = springs.simulate_batch(params=params, times=[1.0, 5.0], stiff=stiff)
    assert set(run.status.tolist()) == {"ok"}
    assert np.all(run.stiff_steps[[0, 2, 4]] > 5) and np.array_equal(run.q[0], run.q[2])
    for k, rate in ((0, 1e4), (4, 1e5)):
        slow = (rate - np.sqrt(rate**2 - 4 * rate)) / 2
        fast = rate - slow
        exact = (fast * np.exp(-slow * run.t) - slow * np.exp(-fast * run.t)) / (fast - slow)
        assert run.q[k, :, 0] == pytest.approx(exact, abs=1e-8)
    assert run.q[1, :, 0] == pytest.approx(np.cos(run.t), abs=1e-8)
    if not stiff:
        assert run.stiff_steps[1] == 0


@pytest.mark.slow
def test_signals_and_single_precision_in_a_batch() -> None:
    text = KEPLER.replace("eccentric", "many_single").replace("[run]\n", BATCH_RUN)
    text = text.replace('push = { unit = "N" }', 'push = { unit = "N", signal = "0.1*sin(3*t)" }')
    text = text.replace("tolerance = 1e-9", 'tolerance = 1e-4\nreal = "float"')
    module = eomc.load(from_scene(parse(text, "single.toml")), BUILDS)
    q0, qd0 = starts(30)
    run = module.simulate_batch(q0[:15], qd0[:15], times=[1.0, 4.0])
    assert run.q.dtype == np.float32 and set(run.status.tolist()) == {"ok"}
    for k in (0, 7, 14):
        single = module.simulate(q0[k], qd0[k], times=[1.0, 4.0])
        assert np.abs(run.q[k] - single.q).max() < 1e-3


def test_rows_are_start_and_end_without_output_times(orbits: ModuleType) -> None:
    q0, qd0 = starts(3)
    mu = np.array([1.0, 1.5, 2.0])
    run = orbits.simulate_batch(q0, qd0, duration=1.0, params={"mu": mu}, u=[[0.0], [0.1], [0.2]])
    assert run.t.tolist() == [0, 1] and np.array_equal(run.q[:, 0], q0) and run.tol == 1e-9
    single = orbits.simulate(q0[2], qd0[2], duration=1.0, params={"mu": 2.0}, u=[0.2])
    assert np.abs(run.q[2, -1] - single.q[-1]).max() < 1e-12
    assert run.energy.shape == (3, 2) and run["x"].shape == (3, 2)


@pytest.mark.usefixtures("quickly_compiled")
def test_jumps_and_stops_act_in_each_instance() -> None:
    balls = built(BALL)
    stop_times = np.array([1e9, 0.7, 1e9])
    run = balls.simulate_batch(params={"far": stop_times, "e": [0.8, 0.8, 0.5]}, duration=2.0)
    assert run.status.tolist() == ["ok", "ok", "accumulated"]
    assert run.reached[0] == 2 and run.reached[1] == pytest.approx(0.7) and run.reached[2] < 1.4
    assert np.isnan(run.q[1:, 1]).all() and np.array_equal(
        run.q[0, -1], balls.simulate(duration=2.0).q[-1]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"u": np.ones((1, 5, 1)), "control_period": 0.1}, r"or \(batch, [0-9]{3}, 1\), a row"),
        ({"control_period": 0.1, "tol": 1e-6}, "a batch follows the signals: give u, a row a"),
        ({"control_period": 0.0, "u": 1.0}, "control_period: 0 is not a period"),
        ({"u": np.ones((1, 5, 1))}, r"u: shape \(1, 5, 1\).*take control_period=, in s"),
        ({"u": {"push": np.ones((4, 5))}}, r"u: shape \(4, 5, 1\), .*take control_period="),
        ({"every": 5}, "many_orbits goes by its tolerance, 1e-09, .*give h too, such as h=0.001"),
    ],
)
def test_arguments_that_do_not_fit_a_tolerance_are_refused_with_advice(
    orbits: ModuleType, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        orbits.simulate_batch(*starts(4), **options)


def test_saved_batch_is_loaded_unchanged(orbits: ModuleType, tmp_path: Path) -> None:
    run = orbits.simulate_batch(*starts(4), duration=0.5)
    run.save(tmp_path / "orbits.npz")
    loaded = orbits.load_run(tmp_path / "orbits.npz")
    assert loaded == run and loaded.tol == run.tol
    with pytest.raises(ValueError, match="h: belongs to fixed steps"):
        orbits.simulate_batch(*starts(4), h=0.1, tol=1e-6)


@pytest.mark.parametrize("shared", [True, False])
def test_input_tables_are_applied_over_control_periods_as_in_single_runs(
    orbits: ModuleType, shared: bool, tmp_path: Path
) -> None:
    """The last period is cut short by the run; one or two threads, and states between rows."""
    tables, times = (
        np.random.default_rng(1).normal(0, 0.1, (1 if shared else 20, 8, 1)),
        [0, 0.5, 2.0],
    )
    options: dict[str, Any] = {"times": times, "control_period": 0.27, "tol": 1e-10}
    q0, qd0 = starts(20)
    run = orbits.simulate_batch(q0, qd0, u=tables, threads=2, **options)
    assert equal_runs(
        orbits.simulate_batch(q0, qd0, u={"push": tables[..., 0]}, threads=1, **options), run
    )
    for k in (0, 9, 19):
        single = orbits.simulate(q0[k], qd0[k], u=tables[0 if shared else k], **options)
        assert single.steps == run.steps[k] and np.abs(run.q[k] - single.q).max() < 1e-9
        assert np.array_equal(run.u[k], single.u)
    run.save(tmp_path / "orbits.npz")
    for loaded in (orbits.load_run(tmp_path / "orbits.npz"), pickle.loads(pickle.dumps(run))):
        assert loaded == run and np.array_equal(loaded.u, run.u)
        assert np.array_equal(loaded([0.5, 2.0])[0], run.q[:, 1:])


def test_batch_stores_a_copy_of_its_inputs(orbits: ModuleType) -> None:
    u = np.full((4, 1), 0.1)
    runs = [orbits.simulate_batch(*starts(4), u=u, **h) for h in ({"h": 0.1}, {"tol": 1e-6})]
    runs.append(orbits.simulate_batch(*starts(4), u=u, h=0.1, times=[0.5]))
    u[:] = 3.0
    assert all((run.u == 0.1).all() for run in runs)


def test_ambiguous_table_of_times_or_instances_is_refused(orbits: ModuleType) -> None:
    u, message = (
        np.ones((4, 1)),
        r"u: shape \(4, 1\) may be .*: give \(1, 4, 1\) for a table, \(4, 1",
    )
    for options in ({"control_period": 0.25, "duration": 1.0}, {"h": 0.01, "steps": 4}):
        with pytest.raises(ValueError, match=message):
            orbits.simulate_batch(u=u, **options)
        assert len(orbits.simulate_batch(u=u[None], **options)) == 1
        assert len(orbits.simulate_batch(u=u[:, None], **options)) == 4
        assert len(orbits.simulate_batch(*starts(4), u=u, **options)) == 4


@pytest.mark.parametrize("threads", [1, 2])
def test_evaluation_limit_ends_only_one_instance(orbits: ModuleType, threads: int) -> None:
    """The second instance falls towards the centre, with 30 times the steps of the others."""
    q0, qd0 = starts(9)
    q0[1], qd0[1] = [1.0, 0.0], [0.0, 1e-3]
    options = {"tol": 1e-9, "times": np.linspace(0, 20, 9)}
    unlimited = orbits.simulate_batch(q0, qd0, **options)
    limit = int(np.delete(unlimited.evaluations, 1).max()) + 1
    assert unlimited.evaluations[1] > 2 * limit
    with pytest.warns(RuntimeWarning, match=r"1 too long; .*instance 1,.*max_evaluations="):
        runs = orbits.simulate_batch(q0, qd0, **options, max_evaluations=limit, threads=threads)
    others = np.arange(9) != 1
    assert runs.status[1] == "too long" and set(runs.status[others].tolist()) == {"ok"}
    assert np.array_equal(runs.q[others], unlimited.q[others])
    assert limit <= runs.evaluations[1] < limit + 1000
    rows = int(np.sum(runs.t <= runs.reached[1]))
    assert 0 < rows < 9 and np.isnan(runs.q[1, rows:]).all()
    assert np.array_equal(runs.q[1, :rows], unlimited.q[1, :rows])
    with pytest.warns(RuntimeWarning, match="too long"):
        separate = orbits.simulate_batch(q0[1:2], qd0[1:2], **options, max_evaluations=limit)
    assert separate.reached[0] == runs.reached[1] and separate.evaluations[0] == runs.evaluations[1]
    earlier, later = 0.9 * runs.reached[1], 1.1 * runs.reached[1]
    assert np.array_equal(runs([earlier])[0][1], unlimited([earlier])[0][1])
    assert np.isnan(runs([later])[0][1]).all() and np.isfinite(runs([later])[0][others]).all()
    loaded = pickle.loads(pickle.dumps(runs))
    assert loaded.status[1] == "too long" and np.isnan(loaded([later])[0][1]).all()


@pytest.mark.slow
def test_evaluation_limit_ends_instances_with_events(modules: Modules) -> None:
    """Instances with events run one after another in C, by the steps of a single run."""
    balls = modules.unoptimised(BALL.replace("bouncing", "limited_balls"))
    options = {"tol": 1e-9, "duration": 3.0, "params": {"e": [0.5, 0.9]}}
    unlimited = balls.simulate_batch(**options)
    limit = int(unlimited.evaluations.min()) + 1
    assert unlimited.evaluations.max() > limit + 100
    with pytest.warns(RuntimeWarning, match="1 too long"):
        runs = balls.simulate_batch(**options, max_evaluations=limit)
    k = int(np.argmax(unlimited.evaluations))
    assert runs.status[k] == "too long" and runs.status[1 - k] == unlimited.status[1 - k]
    assert runs.reached[k] < unlimited.reached[k]
    with pytest.raises(ValueError, match=r"^max_evaluations: belongs to adaptive steps"):
        balls.simulate_batch(h=0.01, max_evaluations=5)
    for invalid in (0, -1, 2.5, "many"):
        with pytest.raises(ValueError, match=r"^max_evaluations: "):
            balls.simulate_batch(tol=1e-9, max_evaluations=invalid)
