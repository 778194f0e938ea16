"""Runs: their steps, rows, times and inputs."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.cases import SCENES, scene_system
from support.session import MODULES, Modules
from support.trajectories import QD, Q, assert_close, runs_are_equal

import eomc
from eomc.runtime.package import model_of
from eomc.verify.symbolic import derive


def test_run_can_continue_in_its_output_arrays(driven: ModuleType) -> None:
    """The start is a row of these arrays; `u` is a table, and `every` leaves an extra last row."""
    u = np.sin(np.arange(10.0))
    rows = np.empty((5, 2)), np.empty((5, 2))
    first = driven.simulate(Q, QD, steps=10, every=3, u=u, out=rows)
    expected = driven.simulate(first.q[-1].copy(), first.qd[-1].copy(), steps=10, every=3, u=u)
    continued = driven.simulate(rows[0][-1], rows[1][-1], steps=10, every=3, u=u, out=rows)
    assert continued.q is rows[0]
    assert runs_are_equal(expected, continued)


@pytest.mark.parametrize("steps", [0, 1, 9, 10])
@pytest.mark.parametrize("options", [{}, {"q0": np.array(Q), "params": {"m_c": 3.0}, "h": 0.01}])
def test_few_steps_by_the_fast_path_equal_those_by_the_general_path(
    driven: ModuleType, monkeypatch: pytest.MonkeyPatch, options: Any, steps: int
) -> None:
    """Plain arguments go directly into C; any other argument is checked first."""
    arguments = {"steps": steps, "every": 3, "t0": 0.5, **options}
    general = driven.simulate(progress=lambda finished, total: None, **arguments)
    monkeypatch.setattr(model_of(driven).integrator, "integrate", None)
    fast = driven.simulate(**arguments)
    assert runs_are_equal(general, fast)
    for name in ("h", "steps", "status", "every", "method", "evaluations", "message"):
        assert getattr(general, name) == getattr(fast, name)
    assert fast.q is fast.q
    assert fast.q.flags.c_contiguous
    assert len(fast.q) == len(fast.qd) == 1 + -(-steps // 3)


def test_params_changed_after_a_run_do_not_change_its_energy(cartpole: ModuleType) -> None:
    params = cartpole.Params()
    run = cartpole.simulate(steps=2, params=params)
    params.g = 0.0
    assert run.energy.tolist() == cartpole.simulate(steps=2).energy.tolist()


def test_scipy_solves_the_same_motion(driven: ModuleType) -> None:
    x0 = np.concatenate(driven.start)
    ivp = solve_ivp(driven.rhs, (0, 5), x0, method="DOP853", rtol=1e-12, atol=1e-12)
    run = driven.simulate(h=1e-3, duration=5)
    np.testing.assert_allclose(run.x[-1], ivp.y[:, -1], rtol=0, atol=1e-10)
    with_input = solve_ivp(driven.rhs, (0, 1), x0, args=(0.5, {"m_c": 3.0}), rtol=1e-12, atol=1e-12)
    run = driven.simulate(h=1e-3, duration=1, u=0.5, params={"m_c": 3.0})
    np.testing.assert_allclose(run.x[-1], with_input.y[:, -1], rtol=0, atol=1e-10)


def test_step_of_rk4_is_the_classical_one(driven: ModuleType) -> None:
    """x + h/6 (k1 + 2 k2 + 2 k3 + k4), with signals evaluated at each stage."""
    x, t = np.array([Q, QD]).ravel(), 0.7
    for h in (0.01, 0.02):
        k1 = driven.rhs(t, x)
        k2 = driven.rhs(t + h / 2, x + h / 2 * k1)
        k3 = driven.rhs(t + h / 2, x + h / 2 * k2)
        k4 = driven.rhs(t + h, x + h * k3)
        expected = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        result = np.concatenate(driven.step(Q, QD, h, t))
        np.testing.assert_allclose(result, expected, rtol=1e-15, atol=1e-15)


def test_defaults_of_a_run_are_those_of_the_scene(cartpole: ModuleType) -> None:
    run = cartpole.simulate()
    assert (run.status, run.steps, run.h, len(run)) == ("ok", 2000, 0.005, 2001)
    assert run.t[-1] == 10.0
    assert run.q.shape == run.qd.shape == (2001, 2)
    assert run.energy.shape == run.jacobi.shape == (2001,)
    assert run.x.shape == (2001, 4)
    np.testing.assert_allclose(run.energy, 0, atol=1e-6)
    assert repr(run) == "<Trajectory of cartpole: 2000 steps of 0.005 s>"


@pytest.mark.parametrize(
    ("h", "duration", "steps"),
    [
        (0.1, 0.3, 3), (0.1, 1.0, 10), (0.3, 1.0, 4), (0.01, 20, 2000), (0.1, 0, 0),
        (0.01, 0.07, 7),  # 7.000000000000001 of them
    ],
)  # fmt: skip
def test_duration_is_covered_by_whole_steps(
    cartpole: ModuleType, h: float, duration: float, steps: int
) -> None:
    run = cartpole.simulate(h=h, duration=duration)
    assert run.steps == steps
    assert run.t[-1] >= duration * (1 - 1e-12)


@pytest.mark.parametrize("t0", [0.0, 0.1, -3.7])
@pytest.mark.parametrize("every", [1, 7])
def test_time_is_computed_from_the_step_count(driven: ModuleType, t0: float, every: int) -> None:
    """t = t0 + n h exactly; repeated addition of h would err by hundreds of roundings."""
    run = driven.simulate(h=0.001, steps=10_000, every=every, t0=t0)
    n = [*range(0, 10_000, every), 10_000] if every > 1 else range(10_001)
    assert run.t.tolist() == [t0 + k * 0.001 for k in n]


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 6, 7, 20, 9000])
@pytest.mark.parametrize("every", [1, 2, 3, 7, 10_000])
def test_sparse_rows_are_those_of_every_step(cartpole: ModuleType, steps: int, every: int) -> None:
    """The first and the last state are always rows, and every n-th between them."""
    all_rows, run = cartpole.simulate(steps=steps), cartpole.simulate(steps=steps, every=every)
    indices = sorted({*range(0, steps, every), steps})
    assert run.t.tolist() == all_rows.t[indices].tolist()
    assert np.array_equal(run.q, all_rows.q[indices])
    assert np.array_equal(run.qd, all_rows.qd[indices])
    assert run.steps == steps


@pytest.mark.parametrize("name", ["cartpole", "cartpole_driven", "kapitza_pendulum", "heavy_top"])
def test_run_equals_repeated_steps(modules: Modules, name: str) -> None:
    """The loop in C repeats `step`; its compensated sums lose less to rounding."""
    module = modules(name)
    run = module.simulate(steps=300)
    q, qd = module.start
    for k in range(300):
        q, qd = module.step(q, qd, t=run.t[k])
        assert_close(q, run.q[k + 1])
        assert_close(qd, run.qd[k + 1])


def test_run_under_inputs_equals_repeated_steps(driven: ModuleType) -> None:
    table = np.sin(np.arange(50.0))
    run = driven.simulate(Q, QD, steps=50, u=table, params={"l": 1.5})
    q, qd = np.array(Q), np.array(QD)
    for k in range(50):
        q, qd = driven.step(q, qd, t=run.t[k], u=table[k], params={"l": 1.5})
    assert_close([q, qd], [run.q[-1], run.qd[-1]])


def test_run_from_a_later_time_equals_repeated_steps(driven: ModuleType) -> None:
    """To rounding: the loop computes t0 + n h with one rounding where the processor has FMA."""
    run = driven.simulate(h=0.003, steps=200, t0=0.1)
    q, qd = driven.start
    for k in range(200):
        q, qd = driven.step(q, qd, 0.003, t=run.t[k])
    assert_close([q, qd], [run.q[-1], run.qd[-1]])


def test_long_run_in_parts_is_the_same(cartpole: ModuleType) -> None:
    """Polling leaves no trace in the loop, and restarting in the middle only a little."""
    full_run = cartpole.simulate(steps=30_000, every=100)
    part = cartpole.simulate(steps=10_000, every=100)
    rows = [part.q]
    for _ in range(2):
        part = cartpole.simulate(part.q[-1], part.qd[-1], steps=10_000, every=100)
        rows.append(part.q[1:])
    np.testing.assert_allclose(np.vstack(rows), full_run.q, rtol=0, atol=1e-11)
    assert np.array_equal(cartpole.simulate(steps=30_000, every=100).q, full_run.q)


def test_polling_leaves_no_trace(driven: ModuleType) -> None:
    """Wherever the loop is interrupted, with a table and rows at other steps."""
    steps = 40_003
    table = np.cos(np.arange(steps))
    calls: list[tuple[int, int]] = []
    run = driven.simulate(
        steps=steps, every=7, u=table, progress=lambda *finished: calls.append(finished)
    )  # fmt: skip
    assert len(calls) > 1
    assert [n for n, _ in calls] == sorted({n for n, _ in calls})
    assert {total for _, total in calls} == {steps}
    assert calls[-1][0] == steps
    values = iter(table)
    with warnings.catch_warnings(action="ignore"):
        one_by_one = driven.simulate(steps=steps, every=7, u=lambda t, q, qd: next(values))
    assert runs_are_equal(run, one_by_one)


def test_input_can_be_constant_a_table_or_a_function(driven: ModuleType) -> None:
    """All three hold u constant over each step."""
    h, steps = 0.01, 200
    constant = driven.simulate(h=h, steps=steps, u=0.5)
    assert runs_are_equal(constant, driven.simulate(h=h, steps=steps, u=[0.5]))
    assert runs_are_equal(constant, driven.simulate(h=h, steps=steps, u=np.full(steps, 0.5)))
    assert runs_are_equal(constant, driven.simulate(h=h, steps=steps, u=np.full((steps, 1), 0.5)))
    table = driven.simulate(h=h, steps=steps, u=np.sin(h * np.arange(steps)))
    with warnings.catch_warnings(action="ignore"):
        by_function = driven.simulate(h=h, steps=steps, u=lambda t, q, qd: np.sin(t))
    assert runs_are_equal(table, by_function)
    assert not np.array_equal(table.q, constant.q)


def test_signal_is_evaluated_at_each_stage(driven: ModuleType) -> None:
    """Fourth order in h, which a zero-order hold is not."""
    expected = driven.simulate(h=1e-3, duration=2).q[-1]
    errors = [
        np.max(np.abs(driven.simulate(h=h, duration=2).q[-1] - expected)) for h in (0.1, 0.05)
    ]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)
    sampled = driven.simulate(h=0.05, u=0.01 * np.sin(0.05 * np.arange(40)), steps=40).q[-1]
    assert np.max(np.abs(sampled - expected)) > 100 * errors[1]


@pytest.mark.parametrize("every", [1, 7])
def test_function_receives_time_and_state_and_may_store_them(
    driven: ModuleType, every: int
) -> None:
    """The function receives them at each step, whichever rows are stored."""
    calls: list[tuple[float, np.ndarray, np.ndarray]] = []
    inputs: list[float] = []

    def law(t: float, q: np.ndarray, qd: np.ndarray) -> float:
        calls.append((t, q, qd))
        inputs.append(float(-10 * q[0] - qd[0]))
        return inputs[-1]

    options = {"h": 0.01, "steps": 20, "t0": 2.0}
    with warnings.catch_warnings(action="ignore"):
        by_function = driven.simulate([0.1, 3.0], u=law, every=every, **options)
    run = driven.simulate([0.1, 3.0], u=inputs, **options)
    assert [time for time, _, _ in calls] == run.t[:-1].tolist()
    assert np.array_equal([q for _, q, _ in calls], run.q[:-1])
    assert np.array_equal([qd for _, _, qd in calls], run.qd[:-1])
    assert np.array_equal(by_function.x[-1], run.x[-1])


def test_slow_python_function_is_reported_once(tmp_path: Path) -> None:
    driven = eomc.load(SCENES / "cartpole_driven.toml", MODULES)
    model_of(driven).integrator.warned.discard("u")
    with pytest.warns(RuntimeWarning, match=r"cartpole_driven: u is a Python function.*slower"):
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)
    with warnings.catch_warnings(action="error"):
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)


def test_error_in_a_function_is_raised_unchanged(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        raise ZeroDivisionError("mine")

    with warnings.catch_warnings(action="ignore"), pytest.raises(ZeroDivisionError, match="mine"):
        driven.simulate(steps=5, u=law)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        ([1, 2], r"^u: what the function returned: shape \(2,\), expected \(1,\): force"),
        (math.nan, "^u: .*nan.* not finite"),
        (None, "^u: "),  # a missing return statement does not select the scene's signal
    ],
)
def test_result_of_a_function_is_checked(driven: ModuleType, result: Any, message: str) -> None:
    with warnings.catch_warnings(action="ignore"), pytest.raises(ValueError, match=message):
        driven.simulate(steps=5, u=lambda t, q, qd: result)


def test_energy_of_a_run_is_that_of_its_rows(everything: ModuleType) -> None:
    run = everything.simulate(steps=20, every=3, params={"m": 2.0})
    for k, t in enumerate(run.t):
        state = (run.q[k], run.qd[k])
        assert run.energy[k] == everything.energy(*state, t=t, params={"m": 2.0})
        assert run.jacobi[k] == everything.jacobi(*state, t=t, params={"m": 2.0})


def test_reference_and_module_agree(cartpole: ModuleType) -> None:
    """To the rounding errors of a hundred steps."""
    reference = derive(scene_system("cartpole"))
    _, q, qd = reference.simulate(steps=100)
    run = cartpole.simulate(steps=100)
    np.testing.assert_allclose(run.q, q, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.qd, qd, rtol=1e-13, atol=1e-13)
