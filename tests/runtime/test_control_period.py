"""Control periods: an input held over several steps equals a table with one row per step."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules, tiers

SCENE = """eomc = 1
name = "balanced"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad", start = 0.1 }
[parameters]
k = 60.0
[inputs]
force = { unit = "N", signal = "k*theta + 12*theta_dot", limits = [-9, 9] }
wind = { unit = "N m", signal = "sin(3*t)/10" }
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "9.81*cos(theta)"
[forces]
x = "force"
theta = "wind"
[run]
batch = true
method = ["rk4", "dp8"]
h = 0.005
"""
PLAIN = SCENE.replace("batch = true\n", "").replace('"dp8"', '"gauss4"')


@pytest.fixture(scope="module")
def balanced(modules: Modules) -> ModuleType:
    return modules.unoptimised(SCENE)


def law(t: float, q: Any, qd: Any) -> list[float]:
    return [60 * q[1] + 12 * qd[1] + q[0], np.sin(3 * t) / 10]


@pytest.mark.parametrize(("steps", "every"), [(40, 1), (41, 3), (43, 7), (2, 5)])
@pytest.mark.parametrize("text", tiers([SCENE, PLAIN], SCENE))
def test_feedback_law_is_called_once_per_control_period(
    modules: Modules, text: str, steps: int, every: int
) -> None:
    module = modules.unoptimised(text)
    for method in module.methods:
        options: dict[str, Any] = {"steps": steps, "method": method}
        calls: list[float] = []

        def counting_law(t: float, q: Any, qd: Any, calls: list[float] = calls) -> list[float]:
            calls.append(t)
            return law(t, q, qd)

        run = module.simulate(u=counting_law, control_period=0.02, every=every, **options)
        assert calls == pytest.approx(np.arange(-(-steps // 4)) * 0.02)
        # the expected table: one row per step, computed four steps at a time
        table = np.empty((steps, 2))
        for k in range(0, steps, 4):
            table[k:] = law(k * 0.005, *(x[-1] for x in state_after(module, table[:k], method)))
        expected = module.simulate(u=table, every=every, **options)
        assert np.array_equal(run.x, expected.x), method
        assert np.array_equal(run.u, expected.u) and np.array_equal(
            run.saturated, expected.saturated
        )
        periodic = module.simulate(u=table[::4], control_period=0.02, every=every, **options)
        assert periodic == expected and np.array_equal(periodic.u, expected.u)


def state_after(module: ModuleType, table: Any, method: str) -> tuple[Any, Any]:
    run = module.simulate(u=table if len(table) else None, steps=len(table), method=method)
    return run.q, run.qd


def test_signals_are_evaluated_once_per_control_period(balanced: ModuleType) -> None:
    params = {"k": 55.0}
    run = balanced.simulate(control_period=0.02, steps=40, params=params)
    expected = balanced.simulate(
        u=lambda t, q, qd: balanced.signal(q, qd, t, params), control_period=0.02, steps=40,
        params=params,
    )  # fmt: skip
    assert np.array_equal(run.x, expected.x) and np.array_equal(run.u, expected.u)
    assert not np.array_equal(run.x, balanced.simulate(steps=40, params=params).x)
    assert balanced.simulate(u=[1, 0], control_period=0.1, steps=40) == balanced.simulate(
        u=[1, 0], steps=40
    )


def test_batch_takes_one_input_row_per_control_period(balanced: ModuleType) -> None:
    table = np.random.default_rng(2).normal(size=(3, 11, 2))
    runs = balanced.simulate_batch(u=table, steps=41, every=3, control_period=0.02)
    for k in range(3):
        run = balanced.simulate(u=table[k], steps=41, every=3, control_period=0.02)
        assert runs.q[k] == pytest.approx(run.q, rel=1e-11, abs=1e-12)
        assert np.array_equal(runs.u[k], run.u)
    for u in ([1.0, 0.0], table[:, 0], {"force": table[:, :, 0], "wind": 0.5}):
        balanced.simulate_batch(u=u, steps=41, control_period=0.02)


def test_error_estimate_includes_the_control_period(balanced: ModuleType) -> None:
    """Finer runs have the same control periods: the rest is the error of the method, of order 4."""
    with warnings.catch_warnings(action="error"):
        run = balanced.simulate(u=law, control_period=0.02, duration=1.0, estimate=True)
    exact = balanced.simulate(u=law, control_period=0.02, duration=1.0, h=0.02 / 64)
    true_error = np.abs(run.q[-1] - exact.q[-1])
    assert np.all(true_error < 3 * run.error.q[-1]) and np.all(
        run.error.q[-1] < 30 * true_error + 1e-13
    )
    assert run.error.observed == pytest.approx(4, abs=0.5)


@pytest.mark.parametrize(
    ("period", "message"),
    [
        (0.012, r"0.012 s is 2.4 steps of h = 0.005 s: give a whole number of steps, such as 0.01"),
        (0.001, "0.2 steps.*such as 0.005"),
        (0, "0 steps"),
        (-0.02, "such as 0.005"),
        ("soon", "control_period: 'soon' is not a number"),
        (np.inf, "not a finite number"),
    ],
)
def test_control_period_must_be_a_whole_number_of_steps(
    balanced: ModuleType, period: Any, message: str
) -> None:
    for call in (balanced.simulate, balanced.simulate_batch):
        with pytest.raises(ValueError, match=message):
            call(steps=8, control_period=period)


def test_batch_cannot_evaluate_signals_once_per_control_period(balanced: ModuleType) -> None:
    with pytest.raises(ValueError, match="a batch follows the signals: give u, a row a period"):
        balanced.simulate_batch(steps=40, control_period=0.02)


def test_too_few_input_rows_are_refused(balanced: ModuleType) -> None:
    with pytest.raises(ValueError, match="9 rows for 40 steps: give one row a control period of 4"):
        balanced.simulate(u=np.zeros((9, 2)), steps=40, control_period=0.02)
    with pytest.raises(ValueError, match=r"expected \(2,\), \(batch, 2\) or \(batch, 10, 2\)"):
        balanced.simulate_batch(u=np.zeros((3, 9, 2)), steps=40, control_period=0.02)


@pytest.mark.parametrize("period", [1e12, 1e300])
def test_control_period_can_exceed_the_run(balanced: ModuleType, period: float) -> None:
    with warnings.catch_warnings(action="ignore"):
        run = balanced.simulate(steps=7, u=law, control_period=period)
    assert np.all(run.u == run.u[0]) and run.u.shape == (8, 2)
    assert balanced.simulate(steps=7, control_period=period).steps == 7
    runs = balanced.simulate_batch(np.zeros((3, 2)), steps=7, u=[[1.0, 0.0]], control_period=period)
    assert np.all(runs.steps == 7)


def test_feedback_law_that_is_not_deterministic_has_no_error_estimate(balanced: ModuleType) -> None:
    draw = np.random.default_rng(3)

    def noisy_law(t: float, q: Any, qd: Any) -> Any:
        return np.array(law(t, q, qd)) + 1e-3 * draw.normal(size=2)

    run = balanced.simulate(u=noisy_law, control_period=0.02, steps=40)
    with pytest.raises(ValueError, match="other values at the start"):
        run.estimate()
    with pytest.warns(RuntimeWarning, match="other values at the start"):
        estimated = balanced.simulate(u=noisy_law, control_period=0.02, steps=40, estimate=True)
    assert estimated.error is None and len(estimated) == 41
