"""Fixed steps with rows at given times: those of the steps, and of one shorter step between two."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES
from conftest import MODULES, Modules
from test_ends import finite_time_escape, vanishing_mass

import eomc

TIMES = np.array([0.0, 0.0123, 0.1, 0.1 + 0.005 / 3, 0.5, 1.0001])


@pytest.fixture(scope="module")
def steppers(modules: Modules) -> ModuleType:
    text = (SCENES / "cartpole_driven.toml").read_text(encoding="utf-8")
    methods = '["rk4", "dp8", "gauss6", "gauss16"]'
    lines = [line for line in text.splitlines() if not line.startswith("method")]
    whole = "\n".join(lines).replace("[run]", f"[run]\nmethod = {methods}\ntolerance = 1e-9")
    return modules.unoptimised(whole)


@pytest.mark.parametrize("method", ["rk4", "dp8", "gauss6", "gauss16"])
def test_rows_are_the_states_of_the_run(steppers: ModuleType, method: str) -> None:
    run = steppers.simulate(h=0.005, times=TIMES, method=method)
    whole = steppers.simulate(h=0.005, duration=1.005, method=method)
    assert np.array_equal(run.t, TIMES) and (run.steps, run.h) == (200, 0.005)
    q, qd = whole(TIMES)
    assert np.array_equal(run.q, q) and np.array_equal(run.qd, qd)
    assert np.array_equal(run.q[[0, 2, 4]], whole.q[[0, 20, 100]])  # at steps
    assert np.ptp(run.q[:, 1]) > 1e-12
    between = steppers.step(
        *(x[2] for x in (whole.q, whole.qd)), 0.0123 - 0.01, 0.01, method=method
    )
    assert np.array_equal(run.q[1], between[0])
    assert run.evaluations >= steppers.simulate(h=0.005, steps=200, method=method).evaluations


def test_a_scene_with_a_tolerance_takes_fixed_steps_where_they_are_asked_for(
    steppers: ModuleType, driven: ModuleType
) -> None:
    assert type(steppers.simulate(times=TIMES)).__name__ == "AdaptiveRun"
    for given in ({"h": 0.01}, {"method": "dp8"}):
        assert type(steppers.simulate(times=TIMES, **given)).__name__ == "TimedRun"
    assert driven.simulate(times=TIMES).h == driven.simulate(steps=1).h  # there are no others


def test_inputs_are_those_of_the_steps(driven: ModuleType) -> None:
    table = np.linspace(-1, 1, 201)[:, None]
    run = driven.simulate(h=0.005, times=TIMES, u=table)
    whole = driven.simulate(h=0.005, steps=201, u=table)
    assert np.array_equal(run.q, whole(TIMES)[0])
    assert np.array_equal(run.u, table[[0, 2, 20, 20, 100, 200]])
    table[:] = 0  # the caller's
    assert np.array_equal(run(TIMES)[0], run.q) and run.u[0] == -1
    assert np.array_equal(run(0.0123)[0], run.q[1])
    held = driven.simulate(h=0.005, times=TIMES, u=0.5)
    assert np.array_equal(held.u, np.full((6, 1), 0.5))
    assert np.array_equal(held.q, driven.simulate(h=0.005, duration=1.005, u=0.5)(TIMES)[0])
    with pytest.raises(ValueError, match="200 rows for 201 steps"):
        driven.simulate(h=0.005, times=TIMES, u=table[:200])


@pytest.mark.parametrize("period", [0.005, 0.02])
def test_a_law_is_called_as_in_any_run(driven: ModuleType, period: float) -> None:
    def law(t: float, q: Any, qd: Any) -> list[float]:
        calls.append(t)
        return [np.sin(9 * t) - qd[0]]

    calls: list[float] = []
    run = driven.simulate(h=0.005, times=TIMES, u=law, control_period=period)
    found, calls = calls, []
    whole = driven.simulate(h=0.005, steps=201, u=law, control_period=period)
    assert found == calls
    assert np.array_equal(run.q[[0, 2, 4]], whole.q[[0, 20, 100]])
    assert np.array_equal(run.u, whole.u[[0, 2, 20, 20, 100, 200]])
    for kept in (run, pickle.loads(pickle.dumps(run))):  # what it gave, not the function again
        assert np.array_equal(kept(TIMES)[0], run.q)
        assert np.array_equal(kept([0.0, 0.3, 0.3001])[0], whole([0.0, 0.3, 0.3001])[0])
    assert found == calls
    sampled = driven.simulate(h=0.005, times=TIMES, control_period=0.02)
    exact = driven.simulate(h=0.005, steps=201, control_period=0.02)
    assert np.array_equal(sampled.u, exact.u[[0, 2, 20, 20, 100, 200]])


def test_it_is_kept_like_any_run(driven: ModuleType, tmp_path: Path) -> None:
    run = driven.simulate(times=TIMES, params={"m_c": 2.0})
    run.save(tmp_path / "run.npz")
    for again in (
        pickle.loads(pickle.dumps(run)), copy.copy(run), copy.deepcopy(run),
        driven.load_run(tmp_path / "run.npz"),
    ):  # fmt: skip
        assert again == run and type(again) is type(run)
        assert np.array_equal(again.t, TIMES) and np.array_equal(again(0.0123)[0], run.q[1])
    assert run != driven.simulate(times=[*TIMES[:-1], 1.0002], params={"m_c": 2.0})
    frame = run.to_dict()
    assert np.array_equal(frame["t"], TIMES) and len(frame["energy"]) == len(run) == 6


def test_its_error_is_estimated(cartpole: ModuleType) -> None:
    times = np.array([0.0, 0.503, 2.0])
    run = cartpole.simulate(h=0.01, times=times, estimate=True)
    exact = cartpole.simulate(h=0.0005, duration=2.0)(times)[0]
    off = np.abs(run.q - exact)
    assert np.all(run.error.q[1:] > 0.5 * off[1:]) and np.all(run.error.q < 5 * off + 1e-15)
    balance = cartpole.simulate(h=0.01, duration=2.0).balance()
    assert run.balance().error == balance.error  # of all steps, not of three rows


def test_one_that_cannot_go_on_ends_with_its_last_good_state() -> None:
    module = eomc.load(finite_time_escape(), MODULES)
    with pytest.warns(RuntimeWarning, match=r"escape: stopped at t = 1\.\d+ after 1\d\d steps"):
        run = module.simulate(times=[0.5, 0.905, 1.5, 1.9])
    assert run.status == "not finite" and len(run) == 3 and run.t.tolist()[:2] == [0.5, 0.905]
    with pytest.warns(RuntimeWarning):
        whole = module.simulate()
    assert run.t[-1] == whole.t[-1] and np.array_equal(run.q[-1], whole.q[-1])
    faded = eomc.load(vanishing_mass(), MODULES)
    with pytest.warns(RuntimeWarning, match="D is not positive definite"):
        run = faded.simulate(q0=[0.0], times=[1.0])
    assert (run.status, run.steps, run.t.tolist(), run.q.tolist()) == (
        "singular",
        0,
        [0.0],
        [[0.0]],
    )


def test_ctrl_c_keeps_the_rows_that_were_made(cartpole: ModuleType) -> None:
    def stop(done: int, steps: int) -> None:
        seen.append((done, steps))
        if done >= 60:
            raise KeyboardInterrupt

    seen: list[tuple[int, int]] = []
    with pytest.raises(cartpole.Interrupted) as caught:
        cartpole.simulate(h=0.01, times=[0.2, 0.405, 0.6, 0.7], progress=stop)
    run = caught.value.run
    assert seen == [(20, 70), (40, 70), (60, 70)]
    assert run.status == "interrupted" and run.t.tolist() == [0.2, 0.405, 0.6] and run.steps == 60


@pytest.mark.slow
def test_rows_are_on_the_constraints(modules: Modules) -> None:
    linkage = modules("four_bar")
    times = np.linspace(0, 1, 7)
    run = linkage.simulate(h=0.01, times=times)
    assert max(np.abs(x).max() for x in run.constraints.values()) < 1e-14
    assert np.array_equal(run.q, linkage.simulate(h=0.01, duration=1)(times)[0])


def test_many_steps_take_no_memory(cartpole: ModuleType) -> None:
    """Of 10^12 steps no row is kept but those asked for; Ctrl-C stops them."""

    def stop(done: int, steps: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(cartpole.Interrupted):
        cartpole.simulate(h=1e-9, times=[1e3], progress=stop)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"times": []}, "times: expected a row of finite numbers"),
        ({"times": [1, 0]}, "times: expected ascending times from t0 = 0 s on"),
        ({"times": [0.5], "t0": 1.0}, "times: expected ascending times from t0 = 1 s on"),
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
def test_what_contradicts_is_told(driven: ModuleType, given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        driven.simulate(**given)


def test_a_duration_beside_them_may_be_longer(modules: Modules) -> None:
    """Also by sums of its steps that rounding has made longer."""
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
HOW = [{"h": 0.01}, {"tol": 1e-9}]


@pytest.fixture(scope="module")
def late(modules: Modules) -> dict[bool, Any]:
    """An oscillator under a force, with events and without."""
    event = LATE.index("[[event]]"), LATE.index("[run]")
    plain = LATE[: event[0]] + LATE[event[1] :].replace("late", "late_plain")
    return {True: modules.unoptimised(LATE), False: modules.unoptimised(plain)}


@pytest.mark.parametrize("events", [False, True])
def test_a_start_so_late_that_time_does_not_resolve_the_steps_is_refused(
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
    for how in HOW:
        run = m.simulate(t0=1e9, **how)
        assert run.status == "ok" and run.q[-1, 0] == pytest.approx(np.cos(1.0), abs=1e-6)


@pytest.mark.parametrize("events", [False, True])
@pytest.mark.parametrize("how", HOW)
def test_a_table_for_the_duration_beside_times_that_end_earlier_is_taken(
    late: dict[bool, Any], events: bool, how: dict[str, float]
) -> None:
    """Rows of the table behind the last of the times are not needed; other numbers are refused."""
    m, u = late[events], np.linspace(-1, 1, 20)[:, None]
    whole = {**how, "duration": 0.4, "control_period": 0.02}
    exact = m.simulate(u=u, **whole)(0.33)[0]
    cut = {**whole, "times": [0.1, 0.33]}
    for table in (u, u[:17], u.ravel(), u.tolist(), {"force": u[:, 0]}):
        np.testing.assert_allclose(m.simulate(u=table, **cut).q[-1], exact, atol=1e-12)
    for table in (u[:12], u[:18]):
        with pytest.raises(ValueError, match=r"^u: 1[28] rows for .*duration="):
            m.simulate(u=table, **cut)
    q, qd = [[1.0]] * 3, [[0.0]] * 3
    for table in (u[None], u[None, :17], np.tile(u, (3, 1, 1)), {"force": u[None, :, 0]}):
        runs = m.simulate_batch(q, qd, u=table, **cut)
        np.testing.assert_allclose(runs.q[:, -1], [exact] * 3, atol=1e-12)
    with pytest.raises(ValueError, match=r"^u: shape \(1, 12, 1\), expected .*duration="):
        m.simulate_batch(q, qd, u=u[None, :12], **cut)
