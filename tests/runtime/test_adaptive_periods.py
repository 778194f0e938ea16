"""Adaptive steps under inputs that are set anew at each control period."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from conftest import Modules

SCENE = """eomc = 1
name = "sampled"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad", start = 0.1 }
[parameters]
k = 60.0
[inputs]
force = { unit = "N", signal = "k*theta + 12*theta_dot", limits = [-9, 9] }
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "9.81*cos(theta)"
[forces]
x = "force"
[[event]]
name = "upright"
when = "theta"
[[event]]
name = "noon"
when = "t - 0.5"
[outputs]
push = "force*x_dot"
[run]
h = 0.0025
method = "dp8"
tolerance = 1e-10
duration = 2.0
batch = true
"""


@pytest.fixture(scope="module")
def sampled(modules: Modules) -> ModuleType:
    return modules.unoptimised(SCENE)


def law(t: float, q: Any, qd: Any) -> list[float]:
    return [60 * q[1] + 12 * qd[1] + q[0] + math.sin(3 * t)]


@pytest.mark.parametrize("u", [law, None])
def test_it_ends_where_short_fixed_steps_do(sampled: ModuleType, u: Any) -> None:
    run = sampled.simulate(u=u, control_period=0.05, tol=1e-11)
    fixed = sampled.simulate(u=u, control_period=0.05, h=0.0025)
    np.testing.assert_allclose(run.x[-1], fixed.x[-1], atol=1e-9)
    assert run.status == "ok" and run.t[-1] == 2.0
    calm = sampled.simulate(u=u, control_period=0.05, tol=1e-5)
    assert calm.steps < 60 and calm.rejected < 6  # one a period, but for the first


def test_a_function_is_asked_at_the_start_of_each_period(sampled: ModuleType) -> None:
    asked: list[Any] = []

    def kept(t: float, q: Any, qd: Any) -> list[float]:
        asked.append((t, q, qd))
        return law(t, q, qd)

    run = sampled.simulate(u=kept, control_period=0.3, t0=1.0)  # the last of 0.2 s
    assert [t for t, _, _ in asked] == [1.0 + 0.3 * k for k in range(7)]
    for t, q, qd in asked:
        row = int(np.flatnonzero(run.t == t)[-1])
        assert (run.q[row] == q).all() and (run.qd[row] == qd).all()
        assert run.u[row] == np.clip(law(t, q, qd), -9, 9)
    assert (run.u[-1] == run.u[-2]).all()  # what was held last
    np.testing.assert_array_equal(run.outputs["push"], run.u[:, 0] * run.qd[:, 0])


def test_rows_at_times_and_between_them_are_those_of_the_run(sampled: ModuleType) -> None:
    times = np.array([0.0, 0.11, 0.2, 0.20001, 1.0, 1.7])
    run = sampled.simulate(u=law, control_period=0.1)
    rows = sampled.simulate(u=law, control_period=0.1, times=times)
    q, qd = run(times)
    assert (rows.q[:-1] == q[:-1]).all() and (rows.qd[:-1] == qd[:-1]).all()
    np.testing.assert_allclose(rows.q[-1], q[-1], atol=1e-13)  # a step ends there
    whole = np.searchsorted(run.t, [0.2, 1.0])
    assert (rows.u[[2, 4]] == run.u[whole]).all() and (rows.u[3] == rows.u[2]).all()
    assert (rows(1.7)[0] == rows.q[-1]).all()


def test_a_table_of_what_a_function_gave_makes_the_same_run(
    sampled: ModuleType, tmp_path: Path
) -> None:
    given: list[float] = []

    def kept(t: float, q: Any, qd: Any) -> list[float]:
        given.extend(law(t, q, qd))
        return given[-1:]

    run = sampled.simulate(u=kept, control_period=0.15)
    for u in (given, np.array(given)[:, None], {"force": given}):
        again = sampled.simulate(u=u, control_period=0.15)
        assert again == run and (again.u == run.u).all()
    run.save(tmp_path / "run.npz")
    again.save(tmp_path / "again.npz")
    for kept_run in (
        pickle.loads(pickle.dumps(run)),
        sampled.load_run(tmp_path / "run.npz"),
        sampled.load_run(tmp_path / "again.npz"),
    ):
        assert kept_run == run and (kept_run.u == run.u).all()
        assert (kept_run(1.234)[0] == run(1.234)[0]).all()
    with pytest.raises(ValueError, match="u was a function"):
        sampled.load_run(tmp_path / "run.npz").estimate()
    assert sampled.load_run(tmp_path / "again.npz").estimate().end == again.estimate().end


def test_its_own_error_is_that_of_the_closed_loop(sampled: ModuleType) -> None:
    run = sampled.simulate(u=law, control_period=0.1, tol=1e-6)
    fine = sampled.simulate(u=law, control_period=0.1, tol=1e-13)
    error = abs(run["theta"][-1] - fine["theta"][-1])
    assert 0.5 * error < run.estimate().end["theta"] < 2 * error + 1e-15


def test_a_batch_by_tables_is_each_alone_with_its_events(sampled: ModuleType) -> None:
    tables = 12 * np.cos(np.arange(40) * np.array([[0.3], [0.7], [1.1]]))[..., None]
    starts = [[0, 0.1], [0, 0.2], [0, 0.3]]
    run = sampled.simulate_batch(starts, u=tables, control_period=0.05)
    for k, table in enumerate(tables):
        alone = sampled.simulate(starts[k], u=table, control_period=0.05)
        assert (run.q[k, -1] == alone.q[-1]).all() and (run.u[k] == alone.u[[0, -1]]).all()
        assert (run.saturated[k] == alone.saturated[[0, -1]]).all()
        for name in ("upright", "noon"):
            assert run.events[name].for_instance(k).t.tolist() == alone.events[name].t.tolist()


def test_events_at_and_between_the_periods_happen_once(sampled: ModuleType) -> None:
    run = sampled.simulate(u=law, control_period=0.05)
    assert run.events["noon"].t.tolist() == [0.5]  # where the tenth period ends
    times = run.events["upright"].t
    assert len(times) > 1
    np.testing.assert_allclose(run(times)[0][:, 1], 0, atol=1e-14)
    crossed = np.count_nonzero(np.diff(np.sign(run["theta"])))
    assert len(times) == crossed


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"u": law}, "a function is asked once a control period, .*: give control_period="),
        ({"u": np.ones((4, 1))}, r"u: shape \(4, 1\), expected \(1,\).* take control_period="),
        ({"u": [1.0, 2.0]}, r"u: shape \(2,\), expected \(1,\)"),
        ({"u": np.ones((4, 1)), "control_period": 0.1}, "4 rows for 20 control periods of 0.1 s"),
        ({"u": law, "control_period": 0.0}, "control_period: 0 is not a period"),
        ({"u": law, "control_period": math.nan}, "control_period: nan is not a finite number"),
        ({"u": lambda t, q, qd: None, "control_period": 0.1}, "the function returned None"),
        ({"u": lambda t, q, qd: [1, 2], "control_period": 0.1}, r"returned: shape \(2,\)"),
        ({"u": np.full((20, 1), math.inf), "control_period": 0.1}, r"u\[0, 0\]: inf"),
    ],
)
def test_what_can_not_be_held_is_refused(
    sampled: ModuleType, how: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        sampled.simulate(tol=1e-9, **how)


def test_what_a_function_raises_says_when(sampled: ModuleType) -> None:
    def bad(t: float, q: Any, qd: Any) -> list[float]:
        return [math.nan if t > 0.25 else 0.0]

    for how in ({"tol": 1e-9}, {"h": 0.0025}):
        with pytest.raises(ValueError, match="is not finite") as raised:
            sampled.simulate(u=bad, control_period=0.1, **how)
        assert "u was asked at t = 0.3 s, q = [" in raised.value.__notes__[0]


def test_more_periods_than_memory_has_room_for_are_refused(sampled: ModuleType) -> None:
    with pytest.raises(MemoryError, match="take a longer one, or a shorter duration"):
        sampled.simulate(u=law, control_period=1e-12, duration=1e3)


def test_ctrl_c_in_the_function_keeps_what_was_done(sampled: ModuleType) -> None:
    def stops(t: float, q: Any, qd: Any) -> list[float]:
        if t > 0.45:
            raise KeyboardInterrupt
        return law(t, q, qd)

    with pytest.raises(sampled.Interrupted) as stopped:
        sampled.simulate(u=stops, control_period=0.1)
    run = stopped.value.run
    assert run.t[-1] == 0.5 and len(run.u) == len(run)


def test_a_period_below_a_step_and_one_beyond_the_run(sampled: ModuleType) -> None:
    short = sampled.simulate(u=law, control_period=1e-4, duration=0.05, tol=1e-9)
    assert 500 <= short.steps < 510 and short.rejected == 0
    assert short.evaluations < 4 * 8 * short.steps  # some three sweeps each
    held = sampled.simulate(u=law, control_period=1e9)
    assert held == sampled.simulate(u=law(0.0, *sampled.start))
