"""Fixed steps with rows at output times: rows of the steps, or of a shorter step between two."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.session import MODULES, Modules
from test_ends import finite_time_escape, vanishing_mass

import eomc

TIMES = np.array([0.0, 0.0123, 0.1, 0.1 + 0.005 / 3, 0.5, 1.0001])


@pytest.fixture(scope="module")
def steppers(modules: Modules) -> ModuleType:
    text = (SCENES / "cartpole_driven.toml").read_text(encoding="utf-8")
    methods = '["rk4", "dp8", "gauss6", "gauss16"]'
    lines = [line for line in text.splitlines() if not line.startswith("method")]
    scene_text = "\n".join(lines).replace("[run]", f"[run]\nmethod = {methods}\ntolerance = 1e-9")
    return modules.unoptimised(scene_text)


@pytest.mark.parametrize("method", ["rk4", "dp8", "gauss6", "gauss16"])
def test_rows_are_the_states_of_the_run(steppers: ModuleType, method: str) -> None:
    run = steppers.simulate(h=0.005, times=TIMES, method=method)
    full_run = steppers.simulate(h=0.005, duration=1.005, method=method)
    assert np.array_equal(run.t, TIMES) and (run.steps, run.h) == (200, 0.005)
    q, qd = full_run(TIMES)
    assert np.array_equal(run.q, q) and np.array_equal(run.qd, qd)
    assert np.array_equal(run.q[[0, 2, 4]], full_run.q[[0, 20, 100]])  # at steps
    assert np.ptp(run.q[:, 1]) > 1e-12
    expected = steppers.step(
        *(x[2] for x in (full_run.q, full_run.qd)), 0.0123 - 0.01, 0.01, method=method
    )
    assert np.array_equal(run.q[1], expected[0])
    assert run.evaluations >= steppers.simulate(h=0.005, steps=200, method=method).evaluations


def test_scene_with_a_tolerance_takes_fixed_steps_on_request(
    steppers: ModuleType, driven: ModuleType
) -> None:
    assert steppers.simulate(times=TIMES).tol == 1e-9
    for options in ({"h": 0.01}, {"method": "dp8"}):
        assert steppers.simulate(times=TIMES, **options).tol == 0
    assert driven.simulate(times=TIMES).h == driven.simulate(steps=1).h  # there are no others


def test_inputs_are_those_of_the_steps(driven: ModuleType) -> None:
    table = np.linspace(-1, 1, 201)[:, None]
    run = driven.simulate(h=0.005, times=TIMES, u=table)
    full_run = driven.simulate(h=0.005, steps=201, u=table)
    assert np.array_equal(run.q, full_run(TIMES)[0])
    assert np.array_equal(run.u, table[[0, 2, 20, 20, 100, 200]])
    table[:] = 0  # the caller's table
    assert np.array_equal(run(TIMES)[0], run.q) and run.u[0] == -1
    assert np.array_equal(run(0.0123)[0], run.q[1])
    constant = driven.simulate(h=0.005, times=TIMES, u=0.5)
    assert np.array_equal(constant.u, np.full((6, 1), 0.5))
    assert np.array_equal(constant.q, driven.simulate(h=0.005, duration=1.005, u=0.5)(TIMES)[0])
    with pytest.raises(ValueError, match="200 rows for 201 steps"):
        driven.simulate(h=0.005, times=TIMES, u=table[:200])


@pytest.mark.parametrize("period", [0.005, 0.02])
def test_feedback_law_is_called_as_in_any_run(driven: ModuleType, period: float) -> None:
    def law(t: float, q: Any, qd: Any) -> list[float]:
        calls.append(t)
        return [np.sin(9 * t) - qd[0]]

    calls: list[float] = []
    run = driven.simulate(h=0.005, times=TIMES, u=law, control_period=period)
    call_times, calls = calls, []
    full_run = driven.simulate(h=0.005, steps=201, u=law, control_period=period)
    assert call_times == calls
    assert np.array_equal(run.q[[0, 2, 4]], full_run.q[[0, 20, 100]])
    assert np.array_equal(run.u, full_run.u[[0, 2, 20, 20, 100, 200]])
    # stored inputs, without further calls of the law
    for copied in (run, pickle.loads(pickle.dumps(run))):
        assert np.array_equal(copied(TIMES)[0], run.q)
        assert np.array_equal(copied([0.0, 0.3, 0.3001])[0], full_run([0.0, 0.3, 0.3001])[0])
    assert call_times == calls
    sampled = driven.simulate(h=0.005, times=TIMES, control_period=0.02)
    exact = driven.simulate(h=0.005, steps=201, control_period=0.02)
    assert np.array_equal(sampled.u, exact.u[[0, 2, 20, 20, 100, 200]])


def test_saved_or_pickled_run_is_unchanged(driven: ModuleType, tmp_path: Path) -> None:
    run = driven.simulate(times=TIMES, params={"m_c": 2.0})
    run.save(tmp_path / "run.npz")
    for loaded in (
        pickle.loads(pickle.dumps(run)), copy.copy(run), copy.deepcopy(run),
        driven.load_run(tmp_path / "run.npz"),
    ):  # fmt: skip
        assert loaded == run and type(loaded) is type(run)
        assert np.array_equal(loaded.t, TIMES) and np.array_equal(loaded(0.0123)[0], run.q[1])
    assert run != driven.simulate(times=[*TIMES[:-1], 1.0002], params={"m_c": 2.0})
    frame = run.to_dict()
    assert np.array_equal(frame["t"], TIMES) and len(frame["energy"]) == len(run) == 6


def test_error_and_balance_are_estimated(cartpole: ModuleType) -> None:
    times = np.array([0.0, 0.503, 2.0])
    run = cartpole.simulate(h=0.01, times=times, estimate=True)
    exact = cartpole.simulate(h=0.0005, duration=2.0)(times)[0]
    true_error = np.abs(run.q - exact)
    assert np.all(run.error.q[1:] > 0.5 * true_error[1:]) and np.all(
        run.error.q < 5 * true_error + 1e-15
    )
    balance = cartpole.simulate(h=0.01, duration=2.0).balance()
    assert run.balance().error == balance.error  # of all steps, not of three rows


def test_failed_run_ends_with_its_last_valid_state() -> None:
    module = eomc.load(finite_time_escape(), MODULES)
    with pytest.warns(RuntimeWarning, match=r"escape: stopped at t = 1\.\d+ after 1\d\d steps"):
        run = module.simulate(times=[0.5, 0.905, 1.5, 1.9])
    assert run.status == "not finite" and len(run) == 3 and run.t.tolist()[:2] == [0.5, 0.905]
    with pytest.warns(RuntimeWarning):
        full_run = module.simulate()
    assert run.t[-1] == full_run.t[-1] and np.array_equal(run.q[-1], full_run.q[-1])
    singular_module = eomc.load(vanishing_mass(), MODULES)
    with pytest.warns(RuntimeWarning, match="D is not positive definite"):
        run = singular_module.simulate(q0=[0.0], times=[1.0])
    assert (run.status, run.steps, run.t.tolist(), run.q.tolist()) == (
        "singular",
        0,
        [0.0],
        [[0.0]],
    )


def test_ctrl_c_leaves_completed_rows(cartpole: ModuleType) -> None:
    def interrupt(finished: int, steps: int) -> None:
        calls.append((finished, steps))
        if finished >= 60:
            raise KeyboardInterrupt

    calls: list[tuple[int, int]] = []
    with pytest.raises(cartpole.Interrupted) as interruption:
        cartpole.simulate(h=0.01, times=[0.2, 0.405, 0.6, 0.7], progress=interrupt)
    run = interruption.value.run
    assert calls == [(20, 70), (40, 70), (60, 70)]
    assert run.status == "interrupted" and run.t.tolist() == [0.2, 0.405, 0.6] and run.steps == 60


@pytest.mark.slow
def test_rows_are_on_the_constraints(modules: Modules) -> None:
    linkage = modules("four_bar")
    times = np.linspace(0, 1, 7)
    run = linkage.simulate(h=0.01, times=times)
    assert max(np.abs(x).max() for x in run.constraints.values()) < 1e-14
    assert np.array_equal(run.q, linkage.simulate(h=0.01, duration=1)(times)[0])


def test_many_steps_take_no_memory(cartpole: ModuleType) -> None:
    """A run of 10^12 steps stores only the requested rows; Ctrl-C stops it."""

    def interrupt(finished: int, steps: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(cartpole.Interrupted):
        cartpole.simulate(h=1e-9, times=[1e3], progress=interrupt)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"times": []}, "times: expected a row of finite numbers"),
        ({"times": [1, 0]}, "expected ascending times from t0 = 0 s on; times.1. is 0, after 1"),
        ({"times": [0.5], "t0": 1.0}, "times: expected .* from t0 = 1 s on; times.0. is 0.5"),
        ({"times": "x"}, "times: 'x' is not an array of numbers"),
        ({"times": "1"}, "times: '1' is not an array of numbers"),
        ({"times": [[1], [2, 3]]}, "times: .* is not an array of numbers"),
        ({"times": np.ma.masked_equal([1, 2], 2)}, "times: 1 of 2 numbers are masked"),
        ({"times": [1e30]}, "steps: .* are more than a run can count"),
        ({"times": [1], "duration": 0.9}, "times: 1 s is behind the end of the duration, 0.9 s"),
        ({"times": [1], "duration": "x"}, "duration: 'x' is not a number"),
        ({"times": [1], "steps": 3}, "steps: times say where rows are"),
        ({"times": [1], "every": 2}, "every: times say where rows are"),
        ({"times": [1], "out": (1, 2)}, "out: times say where rows are"),
        ({"times": [1], "tol": 1e-9}, "was built without adaptive steps"),
        ({"times": [1], "h": 0}, "h: 0 is not a step size"),
    ],
)
def test_contradictory_arguments_are_refused(
    driven: ModuleType, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        driven.simulate(**arguments)


def test_duration_may_exceed_the_output_times(modules: Modules) -> None:
    """A duration that is shorter than the last time by a rounding is accepted too."""
    kepler = modules("kepler_orbit")
    run = kepler.simulate(times=[0, 0.3], duration=1.0, h=0.01)
    assert run == kepler.simulate(times=[0, 0.3], h=0.01)
    assert kepler.simulate(times=[0.1 + 0.2], duration=0.3, h=0.01).t[-1] == 0.1 + 0.2


LATE = """eomc = 1
name = "late"
[coordinates]
x = { start = 1.0 }
[inputs]
force = {}
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
[forces]
x = "force"
[[event]]
name = "up"
when = "x_dot"
direction = "rising"
[run]
h = 0.01
duration = 1.0
tolerance = 1e-9
batch = true
"""
OPTIONS = [{"h": 0.01}, {"tol": 1e-9}]


@pytest.fixture(scope="module")
def late(modules: Modules) -> dict[bool, Any]:
    """An oscillator under a force, with events and without."""
    event = LATE.index("[[event]]"), LATE.index("[run]")
    plain = LATE[: event[0]] + LATE[event[1] :].replace("late", "late_plain")
    return {True: modules.unoptimised(LATE), False: modules.unoptimised(plain)}


@pytest.mark.parametrize("events", [False, True])
def test_start_time_too_large_for_the_step_size_is_refused(
    late: dict[bool, Any], events: bool
) -> None:
    m, q = late[events], [[1.0], [2.0]]
    for t0 in (1e16, -1e16, 1e300):
        with pytest.raises(ValueError, match=r"^h: 0\.01 s is less than what time resolves at "):
            m.simulate(t0=t0, h=0.01)
        with pytest.raises(ValueError, match=r"^h: 0\.01 s is less than what time resolves at "):
            m.simulate(t0=t0, h=0.01, steps=5)
        with pytest.raises(ValueError, match=r"^h: 0\.01 s is less than what time resolves at "):
            m.simulate_batch(q, [[0.0], [0.0]], t0=t0, h=0.01)
        with pytest.raises(ValueError, match=r"^t0: time resolves .* too coarse for steps within "):
            m.simulate(t0=t0, tol=1e-9)
        with pytest.raises(ValueError, match=r"^t0: time resolves .* too coarse for steps within "):
            m.simulate_batch(q, [[0.0], [0.0]], t0=t0, tol=1e-9)
    for options in OPTIONS:
        run = m.simulate(t0=1e9, **options)
        assert run.status == "ok" and run.q[-1, 0] == pytest.approx(np.cos(1.0), abs=1e-6)


@pytest.mark.parametrize("events", [False, True])
@pytest.mark.parametrize("options", OPTIONS)
def test_table_for_the_full_duration_is_accepted_with_earlier_output_times(
    late: dict[bool, Any], events: bool, options: dict[str, float]
) -> None:
    """Rows after the last output time are not needed; other numbers of rows are refused."""
    m, u = late[events], np.linspace(-1, 1, 20)[:, None]
    arguments = {**options, "duration": 0.4, "control_period": 0.02}
    expected = m.simulate(u=u, **arguments)(0.33)[0]
    arguments_with_times = {**arguments, "times": [0.1, 0.33]}
    for table in (u, u[:17], u.ravel(), u.tolist(), {"force": u[:, 0]}):
        np.testing.assert_allclose(
            m.simulate(u=table, **arguments_with_times).q[-1], expected, atol=1e-12
        )
    for table in (u[:12], u[:18]):
        with pytest.raises(ValueError, match=r"^u: 1[28] rows for .*duration="):
            m.simulate(u=table, **arguments_with_times)
    q, qd = [[1.0]] * 3, [[0.0]] * 3
    for table in (u[None], u[None, :17], np.tile(u, (3, 1, 1)), {"force": u[None, :, 0]}):
        runs = m.simulate_batch(q, qd, u=table, **arguments_with_times)
        np.testing.assert_allclose(runs.q[:, -1], [expected] * 3, atol=1e-12)
    with pytest.raises(ValueError, match=r"^u: shape \(1, 12, 1\), expected .*duration="):
        m.simulate_batch(q, qd, u=u[None, :12], **arguments_with_times)
