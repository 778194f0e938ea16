"""Runs: their steps, rows, times and inputs."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES, scene_system
from conftest import MODULES, Modules
from scipy.integrate import solve_ivp
from states import QD, Q, close, same

import eomc
from eomc.verify.symbolic import derive


def test_a_run_may_go_on_in_the_arrays_it_is_given(driven: ModuleType) -> None:
    """Its start a row of them; `u` a table, `every` one that leaves a last row of its own."""
    u = np.sin(np.arange(10.0))
    rows = np.empty((5, 2)), np.empty((5, 2))
    first = driven.simulate(Q, QD, steps=10, every=3, u=u, out=rows)
    plain = driven.simulate(first.q[-1].copy(), first.qd[-1].copy(), steps=10, every=3, u=u)
    again = driven.simulate(rows[0][-1], rows[1][-1], steps=10, every=3, u=u, out=rows)
    assert again.q is rows[0]
    assert same(plain, again)


@pytest.mark.parametrize("steps", [0, 1, 9, 10])
@pytest.mark.parametrize("how", [{}, {"q0": np.array(Q), "params": {"m_c": 3.0}, "h": 0.01}])
def test_a_few_steps_by_the_short_way_are_those_by_the_long(
    driven: ModuleType, monkeypatch: pytest.MonkeyPatch, how: Any, steps: int
) -> None:
    """Arguments that are all plain go straight into C; with one more they are looked at."""
    asked = {"steps": steps, "every": 3, "t0": 0.5, **how}
    long = driven.simulate(progress=lambda done, of: None, **asked)
    monkeypatch.setattr(driven._model.integrator, "run", None)
    short = driven.simulate(**asked)
    assert same(long, short)
    for name in ("h", "steps", "status", "every", "method", "evaluations", "message"):
        assert getattr(long, name) == getattr(short, name)
    assert short.q is short.q
    assert short.q.flags.c_contiguous
    assert len(short.q) == len(short.qd) == 1 + -(-steps // 3)


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
    held = solve_ivp(driven.rhs, (0, 1), x0, args=(0.5, {"m_c": 3.0}), rtol=1e-12, atol=1e-12)
    run = driven.simulate(h=1e-3, duration=1, u=0.5, params={"m_c": 3.0})
    np.testing.assert_allclose(run.x[-1], held.y[:, -1], rtol=0, atol=1e-10)


def test_a_step_is_the_classical_one(driven: ModuleType) -> None:
    """x + h/6 (k1 + 2 k2 + 2 k3 + k4), signals followed through the step."""
    x, at = np.array([Q, QD]).ravel(), 0.7
    for h in (0.01, 0.02):
        k1 = driven.rhs(at, x)
        k2 = driven.rhs(at + h / 2, x + h / 2 * k1)
        k3 = driven.rhs(at + h / 2, x + h / 2 * k2)
        k4 = driven.rhs(at + h, x + h * k3)
        expected = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        found = np.concatenate(driven.step(Q, QD, h, at))
        np.testing.assert_allclose(found, expected, rtol=1e-15, atol=1e-15)


def test_without_arguments_the_scenes_run(cartpole: ModuleType) -> None:
    run = cartpole.simulate()
    assert (run.status, run.steps, run.h, len(run)) == ("ok", 2000, 0.005, 2001)
    assert run.t[-1] == 10.0
    assert run.q.shape == run.qd.shape == (2001, 2)
    assert run.energy.shape == run.jacobi.shape == (2001,)
    assert run.x.shape == (2001, 4)
    np.testing.assert_allclose(run.energy, 0, atol=1e-6)
    assert repr(run) == "<Run of cartpole: 2000 steps of 0.005 s>"


@pytest.mark.parametrize(
    ("h", "duration", "steps"),
    [
        (0.1, 0.3, 3), (0.1, 1.0, 10), (0.3, 1.0, 4), (0.01, 20, 2000), (0.1, 0, 0),
        (0.01, 0.07, 7),  # 7.000000000000001 of them
    ],
)  # fmt: skip
def test_a_duration_is_covered_by_whole_steps(
    cartpole: ModuleType, h: float, duration: float, steps: int
) -> None:
    run = cartpole.simulate(h=h, duration=duration)
    assert run.steps == steps
    assert run.t[-1] >= duration * (1 - 1e-12)


@pytest.mark.parametrize("t0", [0.0, 0.1, -3.7])
@pytest.mark.parametrize("every", [1, 7])
def test_time_is_counted_not_summed(driven: ModuleType, t0: float, every: int) -> None:
    """t = t0 + n h exactly; adding h again and again would be off by hundreds of roundings."""
    run = driven.simulate(h=0.001, steps=10_000, every=every, t0=t0)
    n = [*range(0, 10_000, every), 10_000] if every > 1 else range(10_001)
    assert run.t.tolist() == [t0 + k * 0.001 for k in n]


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 6, 7, 20, 9000])
@pytest.mark.parametrize("every", [1, 2, 3, 7, 10_000])
def test_rows_are_those_of_every_step(cartpole: ModuleType, steps: int, every: int) -> None:
    """First and last state always, and in between every so many."""
    whole, run = cartpole.simulate(steps=steps), cartpole.simulate(steps=steps, every=every)
    kept = sorted({*range(0, steps, every), steps})
    assert run.t.tolist() == whole.t[kept].tolist()
    assert np.array_equal(run.q, whole.q[kept])
    assert np.array_equal(run.qd, whole.qd[kept])
    assert run.steps == steps


@pytest.mark.parametrize("name", ["cartpole", "cartpole_driven", "kapitza_pendulum", "heavy_top"])
def test_a_run_is_its_steps(modules: Modules, name: str) -> None:
    """The loop in C does what `step` does, again and again; its sums lose less to rounding."""
    module = modules(name)
    run = module.simulate(steps=300)
    q, qd = module.start
    for k in range(300):
        q, qd = module.step(q, qd, t=run.t[k])
        close(q, run.q[k + 1])
        close(qd, run.qd[k + 1])


def test_a_run_is_its_steps_under_inputs(driven: ModuleType) -> None:
    table = np.sin(np.arange(50.0))
    run = driven.simulate(Q, QD, steps=50, u=table, params={"l": 1.5})
    q, qd = np.array(Q), np.array(QD)
    for k in range(50):
        q, qd = driven.step(q, qd, t=run.t[k], u=table[k], params={"l": 1.5})
    close([q, qd], [run.q[-1], run.qd[-1]])


def test_a_run_from_a_later_time_is_its_steps(driven: ModuleType) -> None:
    """To rounding: the loop has t0 + n h with one rounding where the processor has FMA."""
    run = driven.simulate(h=0.003, steps=200, t0=0.1)
    q, qd = driven.start
    for k in range(200):
        q, qd = driven.step(q, qd, 0.003, t=run.t[k])
    close([q, qd], [run.q[-1], run.qd[-1]])


def test_a_long_run_is_the_same_in_pieces(cartpole: ModuleType) -> None:
    """The loop looks up now and then; that leaves no trace, and a new start half way little."""
    whole = cartpole.simulate(steps=30_000, every=100)
    piece = cartpole.simulate(steps=10_000, every=100)
    rows = [piece.q]
    for _ in range(2):
        piece = cartpole.simulate(piece.q[-1], piece.qd[-1], steps=10_000, every=100)
        rows.append(piece.q[1:])
    np.testing.assert_allclose(np.vstack(rows), whole.q, rtol=0, atol=1e-11)
    assert np.array_equal(cartpole.simulate(steps=30_000, every=100).q, whole.q)


def test_looking_up_leaves_no_trace(driven: ModuleType) -> None:
    """However the loop is cut, with a table and with rows that do not fit the cuts."""
    steps = 40_003
    table = np.cos(np.arange(steps))
    seen: list[tuple[int, int]] = []
    run = driven.simulate(
        steps=steps, every=7, u=table, progress=lambda *done: seen.append(done)
    )  # fmt: skip
    assert len(seen) > 1
    assert [n for n, _ in seen] == sorted({n for n, _ in seen})
    assert {total for _, total in seen} == {steps}
    assert seen[-1][0] == steps
    values = iter(table)
    with warnings.catch_warnings(action="ignore"):
        one_by_one = driven.simulate(steps=steps, every=7, u=lambda t, q, qd: next(values))
    assert same(run, one_by_one)


def test_an_input_that_is_constant_tabulated_or_called(driven: ModuleType) -> None:
    """All three hold u over each step."""
    h, steps = 0.01, 200
    constant = driven.simulate(h=h, steps=steps, u=0.5)
    assert same(constant, driven.simulate(h=h, steps=steps, u=[0.5]))
    assert same(constant, driven.simulate(h=h, steps=steps, u=np.full(steps, 0.5)))
    assert same(constant, driven.simulate(h=h, steps=steps, u=np.full((steps, 1), 0.5)))
    table = driven.simulate(h=h, steps=steps, u=np.sin(h * np.arange(steps)))
    with warnings.catch_warnings(action="ignore"):
        called = driven.simulate(h=h, steps=steps, u=lambda t, q, qd: np.sin(t))
    assert same(table, called)
    assert not np.array_equal(table.q, constant.q)


def test_the_signal_is_followed_through_the_step(driven: ModuleType) -> None:
    """Fourth order in h, which an input held over each step is not."""
    exact = driven.simulate(h=1e-3, duration=2).q[-1]
    errors = [np.max(np.abs(driven.simulate(h=h, duration=2).q[-1] - exact)) for h in (0.1, 0.05)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)
    held = driven.simulate(h=0.05, u=0.01 * np.sin(0.05 * np.arange(40)), steps=40).q[-1]
    assert np.max(np.abs(held - exact)) > 100 * errors[1]


@pytest.mark.parametrize("every", [1, 7])
def test_a_function_sees_time_and_state_and_may_keep_them(driven: ModuleType, every: int) -> None:
    """Those of each step, whichever rows are kept."""
    seen: list[tuple[float, np.ndarray, np.ndarray]] = []
    given: list[float] = []

    def law(t: float, q: np.ndarray, qd: np.ndarray) -> float:
        seen.append((t, q, qd))
        given.append(float(-10 * q[0] - qd[0]))
        return given[-1]

    how = {"h": 0.01, "steps": 20, "t0": 2.0}
    with warnings.catch_warnings(action="ignore"):
        called = driven.simulate([0.1, 3.0], u=law, every=every, **how)
    run = driven.simulate([0.1, 3.0], u=given, **how)
    assert [at for at, _, _ in seen] == run.t[:-1].tolist()
    assert np.array_equal([q for _, q, _ in seen], run.q[:-1])
    assert np.array_equal([qd for _, _, qd in seen], run.qd[:-1])
    assert np.array_equal(called.x[-1], run.x[-1])


def test_a_function_is_said_to_be_slow_once(tmp_path: Path) -> None:
    driven = eomc.load(SCENES / "cartpole_driven.toml", MODULES)
    driven._model.integrator.warned.discard("u")
    with pytest.warns(RuntimeWarning, match=r"cartpole_driven: u is a Python function.*slower"):
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)
    with warnings.catch_warnings(action="error"):
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)


def test_an_error_in_a_function_comes_through(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        raise ZeroDivisionError("mine")

    with warnings.catch_warnings(action="ignore"), pytest.raises(ZeroDivisionError, match="mine"):
        driven.simulate(steps=5, u=law)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ([1, 2], r"^u: what the function returned: shape \(2,\), expected \(1,\): force"),
        (math.nan, "^u: .*nan.* not finite"),
        (None, "^u: "),  # a forgotten return is no wish for the scene's signal
    ],
)
def test_a_functions_result_is_looked_at(driven: ModuleType, result: Any, words: str) -> None:
    with warnings.catch_warnings(action="ignore"), pytest.raises(ValueError, match=words):
        driven.simulate(steps=5, u=lambda t, q, qd: result)


def test_energy_of_a_run_is_that_of_its_rows(everything: ModuleType) -> None:
    run = everything.simulate(steps=20, every=3, params={"m": 2.0})
    for k, at in enumerate(run.t):
        state = (run.q[k], run.qd[k])
        assert run.energy[k] == everything.energy(*state, t=at, params={"m": 2.0})
        assert run.jacobi[k] == everything.jacobi(*state, t=at, params={"m": 2.0})


def test_reference_and_module_run_alike(cartpole: ModuleType) -> None:
    """As far as a hundred steps of different rounding let them."""
    reference = derive(scene_system("cartpole"))
    _, q, qd = reference.simulate(steps=100)
    run = cartpole.simulate(steps=100)
    np.testing.assert_allclose(run.q, q, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.qd, qd, rtol=1e-13, atol=1e-13)
