"""States of many at any time: `run(t)` of batches, and rows of fixed steps at times."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import Modules
from eventful import BALL, built

SPRINGS = """eomc = 1
name = "many_springs"
[coordinates]
x = { unit = "m", start = 1 }
[parameters]
k = 4
[inputs]
push = { unit = "N", signal = "sin(3*t)" }
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "push"
[run]
method = ["rk4", "dp8"]
batch = true
duration = 1
"""
X0 = np.linspace(-1, 1, 5)[:, None]
TIMES = np.array([0.0, 0.013, 0.1, 0.1234, 0.98, 1.0])
TABLE = np.cos(np.arange(100) / 30)[None, :, None]  # of steps of 0.01 s
HELD = {
    "signal": None,
    "constant": [0.3],
    "each": 0.1 * X0,
    "table": TABLE,
    "tables": X0[:, None] * TABLE,
}


@pytest.fixture(scope="module")
def springs(modules: Modules) -> ModuleType:
    return modules.unoptimised(SPRINGS)


def alone(module: ModuleType, name: str, k: int, **how: object) -> object:
    """The run of instance k by itself."""
    u = HELD[name]
    if u is not None and np.ndim(u) > 1:
        u = np.broadcast_to(u, (5, *np.shape(u)[1:]))[k]
    return module.simulate(X0[k], u=u, h=0.01, **how)


@pytest.mark.parametrize("method", ["rk4", "dp8"])
@pytest.mark.parametrize("name", HELD)
def test_rows_are_where_they_are_asked_for(springs: ModuleType, name: str, method: str) -> None:
    run = springs.simulate_batch(X0, u=HELD[name], h=0.01, times=TIMES, method=method)
    assert run.t.tolist() == TIMES.tolist() and run.q.shape == (5, 6, 1)
    assert run.steps.tolist() == [100] * 5 and set(run.status.tolist()) == {"ok"}
    for k in range(5):
        one = alone(springs, name, k, times=TIMES, method=method)
        np.testing.assert_allclose(run.q[k], one.q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(run.qd[k], one.qd, rtol=0, atol=1e-14)
        np.testing.assert_allclose(run.u[k], one.u, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", HELD)
def test_states_between_rows_are_found(springs: ModuleType, name: str) -> None:
    """Of rows at each step and of rows at times, at the same times."""
    each = springs.simulate_batch(X0, u=HELD[name], h=0.01, steps=100)
    few = springs.simulate_batch(X0, u=HELD[name], h=0.01, times=[0.5, 1.0])
    asked = springs.simulate_batch(X0, u=HELD[name], h=0.01, times=TIMES)
    for run in (each, few):
        q, qd = run(TIMES[::-1].reshape(2, 3))
        assert q.shape == qd.shape == (5, 2, 3, 1)
        assert np.array_equal(q.reshape(5, 6, 1)[:, ::-1], asked.q)
        assert np.array_equal(qd.reshape(5, 6, 1)[:, ::-1], asked.qd)
    assert each(0.5)[0].shape == (5, 1) and np.array_equal(each(0.5)[0], each.q[:, 50])


def test_rows_apart_do_too(springs: ModuleType) -> None:
    each, some = (springs.simulate_batch(X0, h=0.01, steps=100, every=n) for n in (1, 30))
    assert np.array_equal(some(TIMES), each(TIMES)) and np.array_equal(some(1.0)[0], some.q[:, -1])
    each, some = (springs.simulate_batch(X0, h=0.01, steps=100, every=n, u=TABLE) for n in (1, 30))
    for run in (some, pickle.loads(pickle.dumps(some))):  # which keep the whole table
        assert np.array_equal(run(TIMES), each(TIMES))
    for t in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="the run goes from 0 s to 1 s"):
            each(t)


def test_who_ends_is_nan_from_there_on(modules: Modules) -> None:
    """x'' = 6 x^2 from x = 1, x' = 2 is infinite at t = 1."""
    text = SPRINGS.replace("many_springs", "many_gone").replace("k*x**2/2", "-k*x**3")
    module = modules.unoptimised(text)
    how = {"q0": X0[3:] * 2, "qd0": [[0.0], [4.0]], "params": {"k": [0.0, 2.0]}, "u": [0.0]}
    for run in (
        module.simulate_batch(**how, h=0.01, duration=1.0),
        module.simulate_batch(**how, h=0.01, times=[0.5, 1.0]),
        module.simulate_batch(**how, h=0.01, duration=1.0, every=7),
    ):
        assert run.status.tolist() == ["ok", "not finite"] and 10 < run.steps[1] < 100
        end = 0.01 * run.steps[1]
        q, _ = run([end - 0.015, end, end + 0.02, 1.0])
        assert np.isfinite(q[0]).all() and np.isfinite(q[1, :2]).all()
        assert np.isnan(q[1, 2:]).all()


def test_they_are_kept(springs: ModuleType, tmp_path: Path) -> None:
    run = springs.simulate_batch(X0, h=0.01, times=TIMES, u=TABLE)
    run.save(tmp_path / "springs.npz")
    for again in (springs.load_run(tmp_path / "springs.npz"), pickle.loads(pickle.dumps(run))):
        assert again == run and type(again) is type(run)
        assert np.array_equal(again(0.333), run(0.333))


@pytest.mark.usefixtures("quickly_compiled")
def test_a_batch_by_a_tolerance_has_them_too() -> None:
    balls = built(BALL)
    e = np.array([0.8, 0.5, 0.9])
    how = {"params": {"e": e, "far": [1e9, 1e9, 0.7]}, "duration": 1.5}
    run = balls.simulate_batch(**how)
    times = np.array([0.0, 0.3, 0.69, 0.9, 1.5])
    q, qd = run(times)
    asked = balls.simulate_batch(params=how["params"], times=times)
    assert np.array_equal(q, asked.q, equal_nan=True) and np.array_equal(
        qd, asked.qd, equal_nan=True
    )
    one = balls.simulate(params={"e": 0.8}, duration=1.5)
    assert np.array_equal(q[0], one(times)[0])
    assert np.isnan(q[2, 3:]).all() and np.isfinite(q[2, :3]).all()  # stopped at 0.7 s
    assert run(0.3)[0].shape == (3, 2)
    again = pickle.loads(pickle.dumps(run))
    assert np.array_equal(again(times)[0], q, equal_nan=True)


def test_what_does_not_go_together_is_refused(springs: ModuleType) -> None:
    for given, name in (
        ({"steps": 3}, "steps"),
        ({"every": 2}, "every"),
        ({"duration": 0.9}, "times: 1 s is behind the end"),
    ):
        with pytest.raises(ValueError, match=name):
            springs.simulate_batch(X0, h=0.01, times=TIMES, **given)
    with pytest.raises(ValueError, match="ascending"):
        springs.simulate_batch(X0, h=0.01, times=[1.0, 0.5])
