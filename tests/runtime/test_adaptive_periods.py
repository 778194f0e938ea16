"""Adaptive steps under inputs that are held constant over each control period."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

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
def test_end_equals_that_of_short_fixed_steps(sampled: ModuleType, u: Any) -> None:
    run = sampled.simulate(u=u, control_period=0.05, tol=1e-11)
    fixed = sampled.simulate(u=u, control_period=0.05, h=0.0025)
    np.testing.assert_allclose(run.x[-1], fixed.x[-1], atol=1e-9)
    assert run.status == "ok" and run.t[-1] == 2.0
    coarse = sampled.simulate(u=u, control_period=0.05, tol=1e-5)
    assert coarse.steps < 60 and coarse.rejected < 6  # one step a period, except in the first


def test_feedback_law_is_called_at_each_period_start(sampled: ModuleType) -> None:
    calls: list[Any] = []

    def record(t: float, q: Any, qd: Any) -> list[float]:
        calls.append((t, q, qd))
        return law(t, q, qd)

    run = sampled.simulate(u=record, control_period=0.3, t0=1.0)  # the last period has 0.2 s
    assert [t for t, _, _ in calls] == [1.0 + 0.3 * k for k in range(7)]
    for t, q, qd in calls:
        row = int(np.flatnonzero(run.t == t)[-1])
        assert (run.q[row] == q).all() and (run.qd[row] == qd).all()
        assert run.u[row] == np.clip(law(t, q, qd), -9, 9)
    assert (run.u[-1] == run.u[-2]).all()  # the input of the last period
    np.testing.assert_array_equal(run.outputs["push"], run.u[:, 0] * run.qd[:, 0])


def test_rows_at_output_times_equal_interpolated_states(sampled: ModuleType) -> None:
    times = np.array([0.0, 0.11, 0.2, 0.20001, 1.0, 1.7])
    run = sampled.simulate(u=law, control_period=0.1)
    rows = sampled.simulate(u=law, control_period=0.1, times=times)
    q, qd = run(times)
    assert (rows.q[:-1] == q[:-1]).all() and (rows.qd[:-1] == qd[:-1]).all()
    np.testing.assert_allclose(rows.q[-1], q[-1], atol=1e-13)  # there a step ends
    period_starts = np.searchsorted(run.t, [0.2, 1.0])
    assert (rows.u[[2, 4]] == run.u[period_starts]).all() and (rows.u[3] == rows.u[2]).all()
    assert (rows(1.7)[0] == rows.q[-1]).all()


def test_table_of_recorded_inputs_reproduces_the_run(sampled: ModuleType, tmp_path: Path) -> None:
    inputs: list[float] = []

    def record(t: float, q: Any, qd: Any) -> list[float]:
        inputs.extend(law(t, q, qd))
        return inputs[-1:]

    run = sampled.simulate(u=record, control_period=0.15)
    for u in (inputs, np.array(inputs)[:, None], {"force": inputs}):
        repeated = sampled.simulate(u=u, control_period=0.15)
        assert repeated == run and (repeated.u == run.u).all()
    run.save(tmp_path / "run.npz")
    repeated.save(tmp_path / "again.npz")
    for copied in (
        pickle.loads(pickle.dumps(run)),
        sampled.load_run(tmp_path / "run.npz"),
        sampled.load_run(tmp_path / "again.npz"),
    ):
        assert copied == run and (copied.u == run.u).all()
        assert (copied(1.234)[0] == run(1.234)[0]).all()
    with pytest.raises(ValueError, match="u was a function"):
        sampled.load_run(tmp_path / "run.npz").estimate()
    assert sampled.load_run(tmp_path / "again.npz").estimate().end == repeated.estimate().end


def test_error_estimate_is_that_of_the_closed_loop(sampled: ModuleType) -> None:
    run = sampled.simulate(u=law, control_period=0.1, tol=1e-6)
    fine = sampled.simulate(u=law, control_period=0.1, tol=1e-13)
    error = abs(run["theta"][-1] - fine["theta"][-1])
    assert 0.5 * error < run.estimate().end["theta"] < 2 * error + 1e-15


def test_batch_with_input_tables_equals_single_runs(sampled: ModuleType) -> None:
    tables = 12 * np.cos(np.arange(40) * np.array([[0.3], [0.7], [1.1]]))[..., None]
    starts = [[0, 0.1], [0, 0.2], [0, 0.3]]
    run = sampled.simulate_batch(starts, u=tables, control_period=0.05)
    for k, table in enumerate(tables):
        single = sampled.simulate(starts[k], u=table, control_period=0.05)
        assert (run.q[k, -1] == single.q[-1]).all() and (run.u[k] == single.u[[0, -1]]).all()
        assert (run.saturated[k] == single.saturated[[0, -1]]).all()
        for name in ("upright", "noon"):
            assert run.events[name].for_instance(k).t.tolist() == single.events[name].t.tolist()


def test_events_at_and_between_period_starts_are_detected_once(sampled: ModuleType) -> None:
    run = sampled.simulate(u=law, control_period=0.05)
    assert run.events["noon"].t.tolist() == [0.5]  # at the end of the tenth period
    times = run.events["upright"].t
    assert len(times) > 1
    np.testing.assert_allclose(run(times)[0][:, 1], 0, atol=1e-14)
    crossings = np.count_nonzero(np.diff(np.sign(run["theta"])))
    assert len(times) == crossings


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"u": law}, "a function is called once in each control period, .*: give control_period="),
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
def test_invalid_control_periods_and_inputs_are_refused(
    sampled: ModuleType, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        sampled.simulate(tol=1e-9, **options)


def test_error_in_feedback_law_reports_time_and_state(sampled: ModuleType) -> None:
    def invalid_law(t: float, q: Any, qd: Any) -> list[float]:
        return [math.nan if t > 0.25 else 0.0]

    for options in ({"tol": 1e-9}, {"h": 0.0025}):
        with pytest.raises(ValueError, match="is not finite") as error:
            sampled.simulate(u=invalid_law, control_period=0.1, **options)
        assert "u was called at t = 0.3 s, q = [" in error.value.__notes__[0]


def test_more_control_periods_than_memory_are_refused(sampled: ModuleType) -> None:
    with pytest.raises(MemoryError, match="take a longer one, or a shorter duration"):
        sampled.simulate(u=law, control_period=1e-12, duration=1e3)


def test_interrupt_in_feedback_law_keeps_completed_rows(sampled: ModuleType) -> None:
    def interrupting_law(t: float, q: Any, qd: Any) -> list[float]:
        if t > 0.45:
            raise KeyboardInterrupt
        return law(t, q, qd)

    with pytest.raises(sampled.Interrupted) as interruption:
        sampled.simulate(u=interrupting_law, control_period=0.1)
    run = interruption.value.run
    assert run.t[-1] == 0.5 and len(run.u) == len(run)


def test_period_shorter_than_a_step_and_longer_than_the_run(sampled: ModuleType) -> None:
    short = sampled.simulate(u=law, control_period=1e-4, duration=0.05, tol=1e-9)
    assert 500 <= short.steps < 510 and short.rejected == 0
    assert short.evaluations < 4 * 8 * short.steps  # about three sweeps each
    constant = sampled.simulate(u=law, control_period=1e9)
    assert constant == sampled.simulate(u=law(0.0, *sampled.start))
