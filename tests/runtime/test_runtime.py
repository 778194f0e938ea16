"""The compiled module, as a person meets it in Python: values, runs, and what it refuses."""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES, scene_system
from conftest import EVERYTHING, MODULES, Modules
from scipy.integrate import solve_ivp

import eomc
from eomc.model.system import System, symbol, t
from eomc.verify.symbolic import derive

Q, QD = [0.3, 1.1], [-0.4, 0.7]  # a state of the cart-pole

PENDULUM = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")


def same(run: Any, other: Any) -> bool:
    """Whether two runs agree to the last bit."""
    pairs = ((run.t, other.t), (run.q, other.q), (run.qd, other.qd), (run.energy, other.energy))
    return all(np.array_equal(a, b) for a, b in pairs)


def close(found: Any, expected: Any) -> None:
    """To the rounding of some hundred steps."""
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


# --- names and constants ---------------------------------------------------------------------


def test_says_what_it_is(cartpole: ModuleType, driven: ModuleType) -> None:
    assert cartpole.coordinates == ("x", "theta")
    assert cartpole.parameters == ("m_c", "m_p", "l", "g")
    assert cartpole.inputs == ()
    assert driven.inputs == ("force",)
    assert cartpole.defaults == {"m_c": 2.0, "m_p": 2.0, "l": 2.0, "g": 9.8}
    assert cartpole.units["theta"] == "rad"
    assert driven.units["force"] == "N"
    assert cartpole.title == "Cart-pole"
    assert "m_c = 2.0: kg, mass of the cart" in cartpole.__doc__
    assert set(cartpole.__all__) >= {"D", "C", "g", "bias", "acceleration", "step", "simulate"}


def test_start_is_the_scenes_whatever_is_done_to_it(cartpole: ModuleType) -> None:
    q, qd = cartpole.start
    assert q.tolist() == [0, math.pi / 2]
    assert qd.tolist() == [0, 0]
    with contextlib.suppress(ValueError):  # it may be read-only
        q[0] = 7
    try:
        assert cartpole.start[0].tolist() == [0, math.pi / 2]
        assert cartpole.simulate(steps=0).q.tolist() == [[0, math.pi / 2]]
    finally:
        if q.flags.writeable:
            q[0] = 0


def test_params_know_their_names(cartpole: ModuleType) -> None:
    p = cartpole.Params(m_c=3.0)
    assert p.m_c == 3.0
    assert p.m_p == 2.0
    p.m_p = 5
    assert repr(p) == "Params(m_c=3, m_p=5, l=2, g=9.8)"
    assert list(p) == list(cartpole.parameters)
    with pytest.raises(ValueError, match=r"params: 'mass' is not one of m_c, m_p, l, g"):
        p.mass = 1.0
    with pytest.raises(ValueError, match=r"params: m_c: nan is not a finite number"):
        p.m_c = math.nan


def test_a_parameter_may_have_any_name_that_a_scene_may_use(everything: ModuleType) -> None:
    """`values`, `h`, `I`: what they mean is what the scene says, in Params too."""
    p = everything.Params()
    assert {n: getattr(p, n) for n in everything.parameters} == everything.defaults
    for name in everything.parameters:
        given = everything.Params(**{name: 2.5})
        assert getattr(given, name) == 2.5, name


# --- values ------------------------------------------------------------------------------------


def test_values_are_those_of_the_textbook(cartpole: ModuleType) -> None:
    """D = [[4, -2 c], [-2 c, 8/3]], C = [[0, 2 s theta'], [0, 0]], g = [0, -2 * 9.8 s]."""
    c, s = math.cos(Q[1]), math.sin(Q[1])
    D, C = [[4, -2 * c], [-2 * c, 8 / 3]], [[0, 2 * s * QD[1]], [0, 0]]
    near = {"rtol": 1e-14, "atol": 1e-15}
    np.testing.assert_allclose(cartpole.D(Q), D, **near)
    np.testing.assert_allclose(cartpole.C(Q, QD), C, **near)
    np.testing.assert_allclose(cartpole.g(Q), [0, -2 * 9.8 * s], **near)
    np.testing.assert_allclose(cartpole.bias(Q, QD), C @ np.array(QD) + cartpole.g(Q), **near)
    np.testing.assert_allclose(cartpole.tau(Q, QD), [0, 0])
    qdd = np.linalg.solve(D, -cartpole.bias(Q, QD))
    np.testing.assert_allclose(cartpole.acceleration(Q, QD), qdd, **near)
    K, P = 0.5 * np.array(QD) @ D @ QD, 2 * 9.8 * c
    assert cartpole.kinetic_energy(Q, QD) == pytest.approx(K, rel=1e-14)
    assert cartpole.potential_energy(Q) == pytest.approx(P, rel=1e-14)
    assert cartpole.energy(Q, QD) == pytest.approx(K + P, rel=1e-14)
    assert cartpole.jacobi(Q, QD) == cartpole.energy(Q, QD)
    assert cartpole.power(Q, QD) == 0


def test_every_value_agrees_with_the_reference(everything: ModuleType) -> None:
    reference = derive(scene_of_everything())
    q, qd, at, u = [0.2, -0.5, 0.4], [0.3, 0.6, -0.2], 1.7, [0.5, -0.25]
    params = {"m": 2.5, "values": 0.9, "h": 0.1}
    names = {"kinetic_energy": "kinetic", "potential_energy": "potential"}
    for name in ("D", "g", "potential_energy", "C", "bias", "kinetic_energy", "energy", "jacobi"):
        state = (q,) if name in ("D", "g", "potential_energy") else (q, qd)
        found = getattr(everything, name)(*state, t=at, params=params)
        expected = reference.evaluate(names.get(name, name), q, qd, at, None, params)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13, err_msg=name)
    for inputs in (None, u):
        for name in ("tau", "power"):
            found = getattr(everything, name)(q, qd, at, inputs, params)
            expected = reference.evaluate(name, q, qd, at, inputs, params)
            np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(
            everything.acceleration(q, qd, at, inputs, params),
            reference.acceleration(q, qd, at, inputs, params),
            rtol=1e-12,
        )
    signals = reference.evaluate("signals", q, qd, at)
    np.testing.assert_allclose(everything.signal(q, qd, at), signals, rtol=1e-14, atol=0)


def scene_of_everything() -> System:
    from eomc.model import from_scene as system
    from eomc.scene import read as scene

    return system.from_scene(scene.parse(EVERYTHING, "everything.toml"))


@pytest.mark.parametrize(
    "name",
    "D C g bias tau kinetic_energy potential_energy energy jacobi power acceleration".split(),
)
def test_many_states_at_once_are_the_same_one_by_one(driven: ModuleType, name: str) -> None:
    random = np.random.default_rng(2)
    q, qd = random.normal(size=(2, 7, 2))
    function = getattr(driven, name)

    def value(k: Any) -> Any:
        return function(*((q[k],) if name in ("D", "g", "potential_energy") else (q[k], qd[k])))

    many = value(slice(None))
    assert np.array_equal(many, np.array([value(k) for k in range(7)]))
    assert many.shape[0] == 7
    assert value(slice(0)).shape == (0, *many.shape[1:])


@pytest.mark.parametrize(
    "given",
    [
        (1, 2),
        [1, np.float32(2)],
        np.array([1, 2]),
        np.array([1, 2], np.float32),
        np.array([1, 2], np.uint8),
        np.array([1.0, 9, 2, 9])[::2],
        np.array([2.0, 1.0])[::-1],
        np.array([1, 2], dtype=object),
        np.array([1.0, 2.0], ">f8"),
        np.ma.array([1.0, 2.0], mask=False),
    ],
)
def test_takes_whatever_looks_like_an_array(cartpole: ModuleType, given: Any) -> None:
    assert np.array_equal(cartpole.D(given), cartpole.D(np.array([1.0, 2.0])))
    ours, plain = (cartpole.simulate(x, x, steps=3) for x in (given, np.array([1.0, 2.0])))
    assert same(ours, plain)


def test_numbers_whose_sum_overflows_are_finite(cartpole: ModuleType) -> None:
    large = np.array([1e308, 1e308])
    assert np.isfinite(cartpole.D(large)).all()
    assert cartpole.simulate(large, steps=0).q.tolist() == [large.tolist()]
    with pytest.raises(ValueError, match=r"q: .*inf.* is not finite"):
        cartpole.D([math.inf, -math.inf])


def test_a_run_may_go_on_in_the_arrays_it_is_given(driven: ModuleType) -> None:
    """Its start a row of them; `u` a table, `every` one that leaves a last row of its own."""
    u = np.sin(np.arange(10.0))
    rows = np.empty((5, 2)), np.empty((5, 2))
    first = driven.simulate(Q, QD, steps=10, every=3, u=u, out=rows)
    plain = driven.simulate(first.q[-1].copy(), first.qd[-1].copy(), steps=10, every=3, u=u)
    again = driven.simulate(rows[0][-1], rows[1][-1], steps=10, every=3, u=u, out=rows)
    assert again.q is rows[0]
    assert same(plain, again)


def test_rows_of_a_larger_array(cartpole: ModuleType) -> None:
    wide = np.random.default_rng(3).normal(size=(5, 4))
    q, qd = wide[:, :2], wide[:, 2:]  # not contiguous
    assert np.array_equal(cartpole.bias(q, qd), cartpole.bias(q.copy(), qd.copy()))
    assert np.array_equal(cartpole.D(q.copy("F")), cartpole.D(q.copy("C")))


def test_arguments_are_never_written_to(driven: ModuleType) -> None:
    q, qd, u = np.array(Q), np.array(QD), np.ones((4, 1))
    params = driven.Params(l=1.5)
    for array in (q, qd, u):
        array.flags.writeable = False
    driven.step(q, qd, params=params)
    driven.acceleration(q, qd, params=params)
    driven.simulate(q, qd, steps=4, u=u, params=params)
    assert (q.tolist(), qd.tolist(), params.l) == (Q, QD, 1.5)


def test_out_is_written_to_and_returned(cartpole: ModuleType) -> None:
    D, a = np.empty((2, 2)), np.empty(2)
    assert cartpole.D(Q, out=D) is D
    assert np.array_equal(D, cartpole.D(Q))
    assert cartpole.acceleration(Q, QD, out=a) is a
    assert np.array_equal(a, cartpole.acceleration(Q, QD))
    q, qd = np.array(Q), np.array(QD)
    ends = cartpole.step(q, qd, out=(q, qd))  # in place
    assert ends[0] is q
    assert np.array_equal(ends, cartpole.step(Q, QD))
    rows = np.empty((6, 2)), np.empty((6, 2))
    run = cartpole.simulate(steps=5, out=rows)
    assert np.shares_memory(run.q, rows[0])
    assert np.array_equal(rows[1], cartpole.simulate(steps=5).qd)


@pytest.mark.parametrize("steps", [0, 1, 9, 10])
@pytest.mark.parametrize("how", [{}, {"q0": np.array(Q), "params": {"m_c": 3.0}, "h": 0.01}])
def test_a_few_steps_by_the_short_way_are_those_by_the_long(
    driven: ModuleType, monkeypatch: pytest.MonkeyPatch, how: Any, steps: int
) -> None:
    """Arguments that are all plain go straight into C; with one more they are looked at."""
    asked = {"steps": steps, "every": 3, "t0": 0.5, **how}
    long = driven.simulate(progress=lambda done, of: None, **asked)
    monkeypatch.setattr(driven._model, "_trajectory", None)
    short = driven.simulate(**asked)
    assert same(long, short)
    for name in ("h", "steps", "status", "every", "method", "evaluations", "message"):
        assert getattr(long, name) == getattr(short, name)
    assert short.q is short.q
    assert short.q.flags.c_contiguous
    assert len(short.q) == len(short.qd) == 1 + -(-steps // 3)


@pytest.mark.parametrize("params", [{"m_c": 3, "g": 1.5}, [3, 2, 2, 1.5], "Params"])
def test_parameters_by_name_in_order_or_in_params(cartpole: ModuleType, params: Any) -> None:
    if params == "Params":
        params = cartpole.Params(m_c=3, g=1.5)
    assert cartpole.D(Q, params=params)[0, 0] == 5
    assert cartpole.g(Q, params=params)[1] == pytest.approx(-2 * 1.5 * math.sin(Q[1]))
    ends = cartpole.simulate(Q, QD, steps=1, params=params)
    assert np.array_equal(cartpole.step(Q, QD, params=params), (ends.q[-1], ends.qd[-1]))
    assert ends.energy[0] == cartpole.energy(Q, QD, params=params)
    assert cartpole.D(Q)[0, 0] == 4  # and nothing stays


def test_params_changed_after_a_run_do_not_change_its_energy(cartpole: ModuleType) -> None:
    params = cartpole.Params()
    run = cartpole.simulate(steps=2, params=params)
    params.g = 0.0
    assert run.energy.tolist() == cartpole.simulate(steps=2).energy.tolist()


def test_inputs_are_the_signals_unless_given(driven: ModuleType) -> None:
    assert driven.signal(Q, QD, 2.0) == pytest.approx([0.01 * math.sin(2)], rel=1e-15)
    assert driven.tau(Q, QD, 2.0) == pytest.approx([0.01 * math.sin(2), 0], rel=1e-15)
    assert driven.tau(Q, QD, 2.0, u=7).tolist() == [7, 0]
    assert driven.tau(Q, QD, u=[7]).tolist() == [7, 0]
    assert driven.power(Q, QD, u=7) == pytest.approx(7 * QD[0])


# --- motion ------------------------------------------------------------------------------------


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
    steps = 100_003
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        called = driven.simulate([0.1, 3.0], u=law, every=every, **how)
    run = driven.simulate([0.1, 3.0], u=given, **how)
    assert [at for at, _, _ in seen] == run.t[:-1].tolist()
    assert np.array_equal([q for _, q, _ in seen], run.q[:-1])
    assert np.array_equal([qd for _, _, qd in seen], run.qd[:-1])
    assert np.array_equal(called.x[-1], run.x[-1])


def test_a_function_is_said_to_be_slow_once(tmp_path: Path) -> None:
    driven = eomc.load(SCENES / "cartpole_driven.toml", MODULES)
    driven._model._warned.discard("u")
    with pytest.warns(RuntimeWarning, match=r"cartpole_driven: u is a Python function.*slower"):
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        driven.simulate(steps=2, u=lambda t, q, qd: 0.0)


def test_an_error_in_a_function_comes_through(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        raise ZeroDivisionError("mine")

    with warnings.catch_warnings(), pytest.raises(ZeroDivisionError, match="mine"):
        warnings.simplefilter("ignore")
        driven.simulate(steps=5, u=law)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ([1, 2], r"^u: shape \(2,\), expected \(1,\)"),
        (math.nan, "^u: .*nan.* not finite"),
        (None, "^u: "),  # a forgotten return is no wish for the scene's signal
    ],
)
def test_a_functions_result_is_looked_at(driven: ModuleType, result: Any, words: str) -> None:
    with warnings.catch_warnings(), pytest.raises(ValueError, match=words):
        warnings.simplefilter("ignore")
        driven.simulate(steps=5, u=lambda t, q, qd: result)


def test_energy_of_a_run_is_that_of_its_rows(everything: ModuleType) -> None:
    run = everything.simulate(steps=20, every=3, params={"m": 2.0})
    for k, at in enumerate(run.t):
        state = (run.q[k], run.qd[k])
        assert run.energy[k] == everything.energy(*state, t=at, params={"m": 2.0})
        assert run.jacobi[k] == everything.jacobi(*state, t=at, params={"m": 2.0})


# --- what is refused ----------------------------------------------------------------------------

NAN = math.nan
MASKED = np.ma.array([0.3, 1.1], mask=[0, 1])
BAD_VALUES = [
    ("D", ([1],), {}, r"q: shape \(1,\), expected \(2,\) or \(n, 2\): x, theta"),
    ("D", ([[[1, 2]]],), {}, r"q: shape \(1, 1, 2\)"),
    ("D", (5,), {}, r"q: shape \(\)"),
    ("D", (None,), {}, r"q: "),
    ("D", (["a", "b"],), {}, r"q: .*not an array of numbers"),
    ("D", ([1 + 2j, 0],), {}, r"q: "),
    ("D", (np.array([1 + 2j, 0]),), {}, r"q: .*not an array of numbers"),
    ("D", ([[1, 2], [3]],), {}, r"q: "),
    ("D", ([1, NAN],), {}, r"q: .*nan.* is not finite"),
    ("D", ([1, math.inf],), {}, r"q: .*inf.* is not finite"),
    ("C", (Q, [1, 2, 3]), {}, r"qd: shape \(3,\)"),
    ("C", ([Q, Q], QD), {}, r"qd: shape \(2,\) beside q of shape \(2, 2\)"),
    ("bias", (Q, [NAN, 0]), {}, r"qd: .*nan.* is not finite"),
    ("acceleration", (Q, None), {}, r"qd: "),
    ("step", (Q, None), {}, r"qd: "),
    ("step", ([Q, Q], [QD, QD]), {}, r"q: shape \(2, 2\), expected \(2,\)"),
    ("acceleration", (Q, QD), {"t": NAN}, r"t: nan is not a finite number"),
    ("acceleration", (Q, QD), {"t": "now"}, r"t: "),
    ("tau", (Q, QD), {"t": None}, r"t: "),
    ("acceleration", (Q, QD), {"u": [1, 2]}, r"u: shape \(2,\), expected \(1,\)"),
    ("acceleration", (Q, QD), {"u": [[1.0]]}, r"u: shape \(1, 1\), expected \(1,\)"),
    ("tau", (Q, QD), {"u": NAN}, r"u: .*nan.* is not finite"),
    ("D", (Q,), {"params": {"mc": 1}}, r"params: 'mc' is not one of m_c, m_p, l, g"),
    ("D", (Q,), {"params": {"m_c": NAN}}, r"params: m_c: nan is not a finite number"),
    ("D", (Q,), {"params": {"m_c": "two"}}, r"params: m_c"),
    ("D", (Q,), {"params": {"m_c": None}}, r"params: m_c"),
    ("D", (Q,), {"params": {"self": 1.0}}, r"params: 'self' is not one of"),
    ("D", (Q,), {"params": {1: 1.0}}, r"params: "),
    ("D", (Q,), {"params": [1, 2]}, r"params: expected .*4 finite numbers.*m_c, m_p, l, g"),
    ("D", (Q,), {"params": [1, 2, 3, NAN]}, r"params: expected .*finite"),
    ("D", (Q,), {"params": "heavy"}, r"params: "),
    ("D", (Q,), {"out": np.zeros(4)}, r"out: .*shape \(2, 2\)"),
    ("D", (Q,), {"out": np.zeros((2, 2), np.float32)}, r"out: .*float64"),
    ("D", (Q,), {"out": [[0, 0], [0, 0]]}, r"out: "),
    ("step", (Q, QD), {"out": 3}, r"out"),
    ("step", (Q, QD), {"out": (np.zeros(2),)}, r"out"),
    ("step", (Q, QD), {"out": (np.zeros(2), np.zeros(3))}, r"out.*shape \(2,\)"),
    ("step", (Q, QD), {"h": 0}, r"h: 0 is not a step size"),
    ("step", (Q, QD), {"h": -0.01}, r"h: -0.01 is not a step size: .*greater than 0"),
    ("step", (Q, QD), {"h": -1}, r"h: -1 is not a step size"),
    ("advice", (Q, QD), {"h": -0.01}, r"h: -0.01 is not a step size"),
    ("step", (Q, QD), {"h": NAN}, r"h: nan"),
    ("step", (Q, QD), {"h": "small"}, r"h: "),
    ("D", (MASKED,), {}, r"q: 1 of 2 numbers are masked: fill them in first, with .filled"),
    ("acceleration", ([MASKED.data] * 2, np.ma.array([QD] * 2, mask=True)), {}, r"qd: 4 of 4 num"),
    ("step", (Q, QD), {"u": np.ma.array([1.0], mask=True)}, r"u: 1 of 1 numbers are masked"),
    ("D", ([Q, Q],), {"t": MASKED}, r"t: 1 of 2 numbers are masked"),
    ("D", ([Q, Q],), {"t": [0.0]}, r"t: shape \(1,\), expected one number or \(2,\)"),
    (
        "D",
        (Q,),
        {"params": np.ma.array([2.0, 2, 2, 9.8], mask=[0, 0, 1, 0])},
        r"params: 1 of 4 num",
    ),
    ("acceleration", (Q, QD), {"out": MASKED.copy()}, r"out: 1 of 2 numbers are masked"),
    ("rhs", (0, np.ma.array([*Q, *QD], mask=[0, 0, 0, 1])), {}, r"x: 1 of 4 numbers are masked"),
    ("rhs", (0, [1, 2]), {}, r"x: shape \(2,\), expected \(4,\): q, then qd"),
    ("rhs", (0, None), {}, r"x: "),
]


def identify(value: Any) -> str | None:
    return value if isinstance(value, str) and value.isidentifier() else None


@pytest.mark.parametrize(("name", "place", "how", "words"), BAD_VALUES, ids=identify)
def test_a_wrong_argument_is_named(
    driven: ModuleType, name: str, place: Any, how: Any, words: str
) -> None:
    with pytest.raises(ValueError, match="(?s)^" + words):
        getattr(driven, name)(*place, **how)


BAD_RUNS = [
    ({"q0": [1]}, r"q0: shape \(1,\), expected \(2,\)"),
    ({"q0": [[1, 2]]}, r"q0.*: expected one state, \(2,\)"),
    ({"qd0": [NAN, 0]}, r"qd0: .*nan.* is not finite"),
    ({"q0": MASKED, "steps": 1}, r"q0: 1 of 2 numbers are masked: fill them in"),
    ({"u": np.ma.masked_less([0.0, 1.0], 0.5), "steps": 2}, r"u: 1 of 2 numbers are masked"),
    ({"u": lambda t, q, qd: MASKED[1:], "steps": 2}, r"u: 1 of 1 numbers are masked"),
    ({"h": 0}, r"h: 0 is not a step size: give a number of seconds greater than 0"),
    ({"h": -0.1}, r"h: -0.1 is not a step size: give a number of seconds greater than 0"),
    ({"h": math.inf}, r"h: inf"),
    ({"h": 10**400}, r"h: 1000.* is not a finite number"),
    ({"h": 1e-300, "duration": 1e300}, r"duration: 1e\+300 s are more steps .*take a larger h"),
    ({"h": 1e-300, "duration": 1}, r"duration: 1 s are more steps"),
    ({"steps": 10**30}, r"steps: 1e\+30 are more than a run can count"),
    ({"q0": [0.0, 10**400]}, r"q0: .*is not an array of numbers"),
    ({"params": [10**400, 1, 1, 1]}, r"params: expected"),
    ({"h": "a"}, r"h: "),
    ({"h": "0.1"}, r"h: '0.1' is not a number"),
    ({"duration": -1}, r"duration: -1 is not a time"),
    ({"duration": NAN}, r"duration: nan"),
    ({"duration": "long"}, r"duration: "),
    ({"steps": 1, "duration": 1}, r"steps: give steps or duration, not both"),
    ({"steps": -1}, r"steps: -1 is not a whole number, "),
    ({"steps": 1.5}, r"steps: 1.5 is not a whole number, "),
    ({"steps": NAN}, r"steps: nan"),
    ({"steps": "a"}, r"steps: "),
    ({"every": 0}, r"every: 0 is not a whole number, "),
    ({"every": -3}, r"every: -3"),
    ({"every": 2.5}, r"every: 2.5"),
    ({"every": NAN}, r"every: nan"),
    ({"every": None}, r"every: None"),
    ({"t0": NAN}, r"t0: nan is not a finite number"),
    ({"t0": "a"}, r"t0: "),
    ({"method": "euler"}, r"method: 'euler' is not in this module"),
    ({"params": {"x": 1}}, r"params: 'x' is not one of"),
    ({"u": [1, 2, 3], "steps": 2}, r"u: 3 rows for 2 steps: give one row a step"),
    ({"u": np.ones((3, 2)), "steps": 3}, r"u: shape \(3, 2\), expected \(1,\) or \(n, 1\)"),
    ({"u": [1, NAN], "steps": 2}, r"u\[1, 0\]: nan in float64 is not finite"),
    ({"u": []}, r"u: "),
    ({"u": "push"}, r"u: .* not an array of numbers"),
    ({"out": 3}, r"out"),
    ({"out": (np.zeros((3, 2)),)}, r"out"),
    ({"out": (np.zeros((3, 2)), np.zeros((3, 2)))}, r"out\[0\]: .*shape \(2001, 2\)"),
]


# the words as names: a function's own differ from process to process
@pytest.mark.parametrize(("how", "words"), BAD_RUNS, ids=[words for _, words in BAD_RUNS])
def test_a_wrong_argument_of_a_run_is_named(driven: ModuleType, how: Any, words: str) -> None:
    with pytest.raises(ValueError, match="(?s)^" + words):
        driven.simulate(**how)


@pytest.mark.parametrize("u", [1.0, [], lambda t, q, qd: 0.0])
def test_a_scene_without_inputs_takes_none(cartpole: ModuleType, u: Any) -> None:
    for call in (cartpole.tau, cartpole.acceleration, cartpole.step):
        with pytest.raises(ValueError, match=r"^u: this scene has no inputs"):
            call(Q, QD, u=u)
    with pytest.raises(ValueError, match=r"^u: this scene has no inputs"):
        cartpole.simulate(u=u)


def test_another_scenes_params_are_refused(cartpole: ModuleType, modules: Modules) -> None:
    with pytest.raises(ValueError, match=r"^params: these are another scene's: m, l, g"):
        cartpole.D(Q, params=modules("simple_pendulum").Params())


def test_velocities_left_out_are_refused_not_read_from_nowhere() -> None:
    """In a process of its own: a null pointer would end this one."""
    tries = "\n".join(
        f"try: m.{name}([0.0, 1.0], None)\n"
        "except ValueError as e: assert str(e).startswith('qd:')\n"
        f"else: raise SystemExit('{name} took None')"
        for name in ("C", "bias", "tau", "kinetic_energy", "energy", "jacobi", "power", "signal")
    )
    code = f"import eomc\nm = eomc.load({str(SCENES / 'cartpole_driven.toml')!r}, {str(MODULES)!r})"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{tries}"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr or f"ended by signal {-done.returncode}"


def test_too_many_rows_are_told_before_the_run(cartpole: ModuleType) -> None:
    with pytest.raises(MemoryError, match=r"rows of 4 numbers don't fit in memory.*every="):
        cartpole.simulate(steps=10**15)


# --- where it ends -------------------------------------------------------------------------------


def fader() -> System:
    """K = x x'^2/2 under the force x'^2/2 moves evenly, x'' = 0, until D = x is 0."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("fader", {x: 1.0}, x * v**2 / 2, forces={x: v**2 / 2}, h=1 / 8, duration=10)


def escape() -> System:
    """x'' = 2 x^3 from x = 1, x' = 1 is x = 1/(1 - t): infinite at t = 1."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("escape", {x: (1.0, 1.0)}, v**2 / 2, -(x**4) / 2, h=0.01, duration=2)


def test_a_motion_that_runs_away_keeps_what_it_had() -> None:
    module = eomc.load(escape(), MODULES)
    with pytest.warns(RuntimeWarning, match=r"escape: stopped at t = 1\.\d+ after 1\d\d steps"):
        run = module.simulate()
    assert run.status == "not finite"
    assert np.isfinite(run.q).all()
    assert np.isfinite(run.qd).all()
    assert len(run) == run.steps + 1
    assert run.t[-1] == run.steps * 0.01
    assert 1.0 <= run.t[-1] < 1.2
    for words in (f"t = {run.t[-1]:g}", "q = [", "qd = [", "no longer be finite"):
        assert words in run.message
    assert run.energy.shape == run.t.shape
    good = module.simulate(duration=0.9)  # what was kept is the motion up to there
    assert np.array_equal(run.q[:91], good.q)


@pytest.mark.parametrize("every", [1, 4, 1000])
def test_a_singular_mass_matrix_ends_a_run(every: int) -> None:
    """The last good state is kept, whatever rows were wanted."""
    module = eomc.load(fader(), MODULES)
    with pytest.raises(ArithmeticError, match="D is not positive") as fault:
        module.acceleration([0.0], [1.0])
    assert fault.value.status == "singular"
    with pytest.warns(RuntimeWarning, match=r"fader: stopped at t = 0\.75 .*D is not positive"):
        # the seventh step, from x = 1/8, would end at x = 0
        run = module.simulate([7 / 8], [-1.0], every=every)
    assert run.status == "singular"
    assert run.steps == 6
    assert run.t.tolist() == {1: [k / 8 for k in range(7)], 4: [0, 0.5, 0.75]}.get(every, [0, 0.75])
    assert np.array_equal(run.q[:, 0], 7 / 8 - run.t)


def test_a_fall_into_the_centre(modules: Modules) -> None:
    """Kepler's orbit without a sideways velocity ends at r = 0, or says that it can't go on."""
    kepler = modules("kepler_orbit")
    q, qd = kepler.start
    zero = np.zeros_like(q)
    with pytest.raises(ArithmeticError, match=r"at q = \[0\. 0\.\].*not finite") as fault:
        kepler.acceleration(zero, qd)
    assert fault.value.status == "not finite"
    with pytest.warns(RuntimeWarning, match=r"kepler_orbit: stopped at t = 0 "):
        run = kepler.simulate(zero, qd, steps=5)
    assert (run.status, run.steps, run.q.tolist()) == ("not finite", 0, [[0, 0]])


def test_the_pole_of_euler_angles(modules: Modules) -> None:
    """At theta = 0 the heavy top's D is singular: two of its angles turn about one axis."""
    top = modules("heavy_top")
    q, qd = (x.copy() for x in top.start)
    q[top.coordinates.index("theta")] = 0.0
    with pytest.raises(ArithmeticError, match="D is not positive definite") as fault:
        top.acceleration(q, qd)
    assert fault.value.status == "singular"
    with pytest.warns(RuntimeWarning, match="heavy_top: stopped at t = 0 .*D is not positive"):
        run = top.simulate(q, qd, steps=5)
    assert (run.status, run.steps, len(run)) == ("singular", 0, 1)
    with pytest.raises(ArithmeticError, match=r"no step from t = 1.5, q = \["):
        top.step(q, qd, t=1.5)


def test_a_failed_call_leaves_out_untouched(modules: Modules) -> None:
    top = modules("heavy_top")
    q, qd = top.start
    bad = q * 0
    out = np.full((3, 3), 7.0)
    with pytest.raises(ArithmeticError, match=re.escape(np.array2string(bad))):
        top.acceleration([q, bad, q], [qd, qd, qd], out=out)
    assert np.all(out == 7)
    ends = np.full(3, 7.0), np.full(3, 7.0)
    with pytest.raises(ArithmeticError):
        top.step(bad, qd, out=ends)
    assert np.all(np.array(ends) == 7)


def test_parameters_that_leave_no_inertia(cartpole: ModuleType) -> None:
    with pytest.raises(ArithmeticError, match="D is not positive definite"):
        cartpole.acceleration(Q, QD, params={"m_c": 0.0, "m_p": 0.0})
    with pytest.warns(RuntimeWarning, match="stopped at t = 0"):
        assert cartpole.simulate(steps=3, params={"m_p": -5.0}).steps == 0


# --- while it runs -------------------------------------------------------------------------------


def test_other_threads_go_on(cartpole: ModuleType) -> None:
    """The GIL is released: a clock beside the loop ticks every millisecond or so.

    Were it held, the clock would tick between two pieces of the loop only, each 50 ms long.
    """
    ticks, running = 0, True

    def clock() -> None:
        nonlocal ticks
        while running:
            time.sleep(0.001)
            ticks += 1

    thread = threading.Thread(target=clock)
    thread.start()
    try:
        cartpole.simulate(steps=5_000_000, every=10**6)
    finally:
        running = False
        thread.join()
    assert ticks > 40


def test_threads_do_not_disturb_one_another(driven: ModuleType) -> None:
    starts = [[0.1 * k, 3.0] for k in range(4)]
    alone = [driven.simulate(q, steps=20_000) for q in starts]
    together: list[Any] = [None] * 4

    def work(k: int) -> None:
        together[k] = driven.simulate(starts[k], steps=20_000)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(same(a, b) for a, b in zip(alone, together, strict=True))


@contextlib.contextmanager
def ctrl_c_after(seconds: float) -> Iterator[None]:
    """As if a person pressed Ctrl-C, so many seconds later."""

    def press(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, press)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("every", [1, 7, 100_003])
@pytest.mark.parametrize("after", [0.13, 0.17])
def test_ctrl_c_gives_the_run_so_far(cartpole: ModuleType, every: int, after: float) -> None:
    """What was done until then is right: it equals a run of that many steps."""
    with pytest.raises(KeyboardInterrupt) as caught, ctrl_c_after(after):
        cartpole.simulate(steps=20_000_000 if every > 1 else 8_000_000, every=every)
    run = caught.value.run
    assert run.status == "interrupted"
    assert 0 < run.steps < 20_000_000
    assert "interrupted" in run.message
    assert same(run, cartpole.simulate(steps=run.steps, every=every))


def test_ctrl_c_is_heard_soon(cartpole: ModuleType) -> None:
    with pytest.raises(KeyboardInterrupt), ctrl_c_after(0.1):
        begun = time.perf_counter()
        cartpole.simulate(steps=10**9, every=10**6)
    assert time.perf_counter() - begun < 2


def test_ctrl_c_in_the_progress_bar(driven: ModuleType) -> None:
    def stop(done: int, steps: int) -> None:
        if done > 10_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        driven.simulate(steps=10**6, every=9, progress=stop)
    run = caught.value.run
    assert 10_000 < run.steps < 10**6
    assert same(run, driven.simulate(steps=run.steps, every=9))


@pytest.mark.parametrize("steps", [10, 10**6])
def test_ctrl_c_in_the_first_look_keeps_what_was_done(cartpole: ModuleType, steps: int) -> None:
    """In a run that is one call in C as in one that is many."""

    def stop(done: int, steps: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        cartpole.simulate(steps=steps, every=3, progress=stop)
    run = caught.value.run
    assert (run.status, 0 < run.steps <= steps) == ("interrupted", True)
    assert same(run, cartpole.simulate(steps=run.steps, every=3))


def test_ctrl_c_before_anything_was_done_leaves_the_start(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        raise KeyboardInterrupt

    with warnings.catch_warnings(), pytest.raises(KeyboardInterrupt) as caught:
        warnings.simplefilter("ignore")
        driven.simulate(Q, QD, steps=9, u=law)
    run = caught.value.run
    assert (run.status, run.steps, run.evaluations) == ("interrupted", 0, 0)
    assert (run.q.tolist(), run.qd.tolist()) == ([Q], [QD])


def test_ctrl_c_in_an_input(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        if t > 0.5:
            raise KeyboardInterrupt
        return 0.1

    with warnings.catch_warnings(), pytest.raises(KeyboardInterrupt) as caught:
        warnings.simplefilter("ignore")
        driven.simulate(h=0.01, steps=1000, every=4, u=law)
    run = caught.value.run
    assert run.steps == 51
    assert same(run, driven.simulate(h=0.01, steps=51, every=4, u=0.1))


# --- modules among themselves ------------------------------------------------------------------


def test_modules_side_by_side(cartpole: ModuleType, driven: ModuleType, modules: Modules) -> None:
    """Each keeps its own names, sizes and numbers, and loading again gives the same one."""
    spring = modules("mass_spring")
    assert [m.D(np.zeros(len(m.coordinates))).shape for m in (cartpole, spring)] == [(2, 2), (1, 1)]
    assert spring.simulate(h=0.01, duration=1).q[-1] == pytest.approx(math.cos(1), abs=1e-9)
    assert eomc.load(SCENES / "cartpole.toml", MODULES) is cartpole
    assert driven.Params is not cartpole.Params


def test_a_changed_scene_is_a_new_module_in_the_same_process(tmp_path: Path) -> None:
    """And the old one, still held, still works."""
    file = tmp_path / "simple_pendulum.toml"
    file.write_text(PENDULUM, encoding="utf-8")
    old = eomc.load(file, tmp_path / "build")
    file.write_text(PENDULUM.replace('"m*g*y"', '"2*m*g*y"'), encoding="utf-8")
    new = eomc.load(file, tmp_path / "build")
    assert new.g([1.0]) == 2 * old.g([1.0])
    assert new.simulate(steps=10).q[-1] != old.simulate(steps=10).q[-1]
    file.write_text(PENDULUM, encoding="utf-8")
    assert eomc.load(file, tmp_path / "build").g([1.0]) == old.g([1.0])


def test_the_folder_is_a_package_that_needs_numpy_and_cffi_alone(tmp_path: Path) -> None:
    """PYTHONPATH=build, `import cartpole`; neither the generator nor SymPy is there."""
    folder = eomc.build(SCENES / "cartpole.toml", MODULES).folder
    code = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("eomc", "sympy", "jinja2", "pydantic", "click", "rich"):
            raise ImportError(f"{name} is not for a compiled scene")
sys.meta_path.insert(0, Refuse())
import cartpole
assert cartpole.simulate().status == "ok"
assert cartpole.__name__ == "cartpole"
strange = {m.split(".")[0] for m in sys.modules} & {"eomc", "sympy", "scipy"}
assert not strange, strange
print(cartpole.__file__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(folder.parent)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).parent == folder


def test_a_module_from_sympy_expressions() -> None:
    """The same compiled face; time in K and an input beside it."""
    x, v, m, u = symbol("x"), symbol("x_dot"), symbol("m"), symbol("u")
    system = System.make(
        "rocket", {x: (0.0, 1.0)}, m * (2 - t) * v**2 / 2, parameters={m: 3}, inputs={u: t},
        forces={x: u}, h=0.1, duration=1,
    )  # fmt: skip
    rocket = eomc.load(system, MODULES)
    assert rocket.D([0.0], t=0.5) == pytest.approx(4.5)
    # d/dt (m (2 - t) v) = t: m (2 - t) v = 6 + t^2/2
    run = rocket.simulate(h=0.001, duration=1)
    assert run.qd[-1, 0] == pytest.approx(6.5 / 3, abs=1e-12)


def test_reference_and_module_run_alike(cartpole: ModuleType) -> None:
    """As far as a hundred steps of different rounding let them."""
    reference = derive(scene_system("cartpole"))
    _, q, qd = reference.simulate(steps=100)
    run = cartpole.simulate(steps=100)
    np.testing.assert_allclose(run.q, q, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.qd, qd, rtol=1e-13, atol=1e-13)
