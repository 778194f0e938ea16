"""States of batches at any time: `run(t)`, and rows of fixed steps at output times."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.event_scenes import BALL, built
from support.session import Modules

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
TABLE = np.cos(np.arange(100) / 30)[None, :, None]  # for steps of 0.01 s
INPUTS = {
    "signal": None,
    "constant": [0.3],
    "each": 0.1 * X0,
    "table": TABLE,
    "tables": X0[:, None] * TABLE,
}


@pytest.fixture(scope="module")
def springs(modules: Modules) -> ModuleType:
    return modules.unoptimised(SPRINGS)


def simulate_alone(module: ModuleType, name: str, k: int, **options: object) -> object:
    """Return the single run of instance k."""
    u = INPUTS[name]
    if u is not None and np.ndim(u) > 1:
        u = np.broadcast_to(u, (5, *np.shape(u)[1:]))[k]
    return module.simulate(X0[k], u=u, h=0.01, **options)


@pytest.mark.parametrize("method", ["rk4", "dp8"])
@pytest.mark.parametrize("name", INPUTS)
def test_rows_are_at_the_output_times(springs: ModuleType, name: str, method: str) -> None:
    run = springs.simulate_batch(X0, u=INPUTS[name], h=0.01, times=TIMES, method=method)
    assert run.t.tolist() == TIMES.tolist() and run.q.shape == (5, 6, 1)
    assert run.steps.tolist() == [100] * 5 and set(run.status.tolist()) == {"ok"}
    for k in range(5):
        single = simulate_alone(springs, name, k, times=TIMES, method=method)
        np.testing.assert_allclose(run.q[k], single.q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(run.qd[k], single.qd, rtol=0, atol=1e-14)
        np.testing.assert_allclose(run.u[k], single.u, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", INPUTS)
def test_states_between_rows_equal_rows_at_output_times(springs: ModuleType, name: str) -> None:
    """Rows at each step and rows at few times, interpolated at the same times."""
    each = springs.simulate_batch(X0, u=INPUTS[name], h=0.01, steps=100)
    sparse = springs.simulate_batch(X0, u=INPUTS[name], h=0.01, times=[0.5, 1.0])
    expected = springs.simulate_batch(X0, u=INPUTS[name], h=0.01, times=TIMES)
    for run in (each, sparse):
        q, qd = run(TIMES[::-1].reshape(2, 3))
        assert q.shape == qd.shape == (5, 2, 3, 1)
        assert np.array_equal(q.reshape(5, 6, 1)[:, ::-1], expected.q)
        assert np.array_equal(qd.reshape(5, 6, 1)[:, ::-1], expected.qd)
    assert each(0.5)[0].shape == (5, 1) and np.array_equal(each(0.5)[0], each.q[:, 50])


def test_states_between_sparse_rows_equal_those_of_all_rows(springs: ModuleType) -> None:
    each, sparse = (springs.simulate_batch(X0, h=0.01, steps=100, every=n) for n in (1, 30))
    assert np.array_equal(sparse(TIMES), each(TIMES)) and np.array_equal(
        sparse(1.0)[0], sparse.q[:, -1]
    )
    each, sparse = (
        springs.simulate_batch(X0, h=0.01, steps=100, every=n, u=TABLE) for n in (1, 30)
    )
    for run in (sparse, pickle.loads(pickle.dumps(sparse))):  # both store the whole table
        assert np.array_equal(run(TIMES), each(TIMES))
    for t in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="the run goes from 0 s to 1 s"):
            each(t)


def test_instance_that_ends_early_is_nan_afterwards(modules: Modules) -> None:
    """x'' = 6 x^2 from x = 1, x' = 2 is infinite at t = 1."""
    text = SPRINGS.replace("many_springs", "many_gone").replace("k*x**2/2", "-k*x**3")
    module = modules.unoptimised(text)
    options = {"q0": X0[3:] * 2, "qd0": [[0.0], [4.0]], "params": {"k": [0.0, 2.0]}, "u": [0.0]}
    for run in (
        module.simulate_batch(**options, h=0.01, duration=1.0),
        module.simulate_batch(**options, h=0.01, times=[0.5, 1.0]),
        module.simulate_batch(**options, h=0.01, duration=1.0, every=7),
    ):
        assert run.status.tolist() == ["ok", "not finite"] and 10 < run.steps[1] < 100
        end = 0.01 * run.steps[1]
        q, _ = run([end - 0.015, end, end + 0.02, 1.0])
        assert np.isfinite(q[0]).all() and np.isfinite(q[1, :2]).all()
        assert np.isnan(q[1, 2:]).all()


def test_saved_or_pickled_batch_is_unchanged(springs: ModuleType, tmp_path: Path) -> None:
    run = springs.simulate_batch(X0, h=0.01, times=TIMES, u=TABLE)
    run.save(tmp_path / "springs.npz")
    for loaded in (springs.load_run(tmp_path / "springs.npz"), pickle.loads(pickle.dumps(run))):
        assert loaded == run and type(loaded) is type(run)
        assert np.array_equal(loaded(0.333), run(0.333))


@pytest.mark.usefixtures("quickly_compiled")
def test_adaptive_batch_can_be_interpolated_too() -> None:
    balls = built(BALL)
    e = np.array([0.8, 0.5, 0.9])
    options = {"params": {"e": e, "far": [1e9, 1e9, 0.7]}, "duration": 1.5}
    run = balls.simulate_batch(**options)
    times = np.array([0.0, 0.3, 0.69, 0.9, 1.5])
    q, qd = run(times)
    expected = balls.simulate_batch(params=options["params"], times=times)
    assert np.array_equal(q, expected.q, equal_nan=True) and np.array_equal(
        qd, expected.qd, equal_nan=True
    )
    single = balls.simulate(params={"e": 0.8}, duration=1.5)
    assert np.array_equal(q[0], single(times)[0])
    assert np.isnan(q[2, 3:]).all() and np.isfinite(q[2, :3]).all()  # stopped at 0.7 s
    assert run(0.3)[0].shape == (3, 2)
    loaded = pickle.loads(pickle.dumps(run))
    assert np.array_equal(loaded(times)[0], q, equal_nan=True)


def test_contradictory_arguments_are_refused(springs: ModuleType) -> None:
    for options, message in (
        ({"steps": 3}, "steps"),
        ({"every": 2}, "every"),
        ({"duration": 0.9}, "times: 1 s is behind the end"),
    ):
        with pytest.raises(ValueError, match=message):
            springs.simulate_batch(X0, h=0.01, times=TIMES, **options)
    with pytest.raises(ValueError, match="ascending"):
        springs.simulate_batch(X0, h=0.01, times=[1.0, 0.5])
