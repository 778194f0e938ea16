"""Instances of a batch that end early, and Ctrl-C."""

from __future__ import annotations

import _thread
import threading
import time
from warnings import catch_warnings, simplefilter

import numpy as np
import pytest
from support.session import Modules, tiers
from support.trajectories import STEPS, module, starts


def test_failed_instance_leaves_the_others_unchanged() -> None:
    m = module("kepler_orbit")
    q0, qd0 = np.tile(m.start[0], (100, 1)), np.tile(m.start[1], (100, 1))
    good = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    q0[41] = 0.0  # at the centre, where the force is infinite
    runs = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    assert runs.status[41] == "not finite" and runs.steps[41] == 0
    assert np.array_equal(runs.q[41, 0], q0[41]) and np.isnan(runs.q[41, 1:]).all()
    others = np.arange(100) != 41
    assert set(runs.status[others]) == {"ok"}
    assert np.array_equal(runs.q[others], good.q[others])


@pytest.mark.parametrize("m_c", [-1.0, -3.0])
def test_singular_instance_is_reported_though_its_numbers_are_finite(m_c: float) -> None:
    """A cart of -1 kg and a pole of 2 kg: D is indefinite, yet elimination completes.

    With -3 kg the first pivot is negative in every state, and the second one positive.
    """
    m = module("cartpole")
    q0, qd0 = starts(m, 70)
    masses = np.full(70, m.defaults["m_c"])
    q0[41, 1], masses[41] = 0.3, m_c
    with pytest.warns(RuntimeWarning, match="D is not positive definite"):
        single = m.simulate(q0[41], qd0[41], steps=STEPS, params={"m_c": masses[41]})
    runs = m.simulate_batch(q0, qd0, steps=STEPS, params={"m_c": masses})
    assert (runs.status[41], runs.steps[41]) == (single.status, single.steps) == ("singular", 0)
    assert np.array_equal(runs.q[41, 0], q0[41]) and np.isnan(runs.q[41, 1:]).all()
    others = np.arange(70) != 41
    separate = m.simulate_batch(
        q0[others], qd0[others], steps=STEPS, params={"m_c": masses[others]}
    )
    assert set(runs.status[others]) == {"ok"}
    assert np.array_equal(runs.q[others], separate.q) and np.array_equal(
        runs.qd[others], separate.qd
    )
    shared = m.simulate_batch(q0[41], qd0[40:43], steps=STEPS, params={"m_c": m_c})
    assert shared.status[1] == "singular" and not shared.steps[1]
    assert m_c > -2 or (set(shared.status), shared.steps.any()) == ({"singular"}, False)


@pytest.mark.parametrize("method", tiers(["rk4", "dp8"], "dp8"))
def test_overflow_of_one_instance_leaves_the_others_unchanged(
    method: str, modules: Modules
) -> None:
    """Positions or velocities near the largest double overflow under a force; others don't."""
    m = modules.unoptimised(
        "eomc = 1\nname = 'push'\n[coordinates]\nx = {}\n[parameters]\nf = 1e299\n[energy]\n"
        "kinetic = 'x_dot**2/2'\npotential = '-f*x'\n"
        f"[run]\nh = 0.01\nbatch = true\nmethod = '{method}'\n"
    )
    largest = np.finfo(float).max
    q0, qd0 = np.zeros((9, 1)), np.zeros((9, 1))
    qd0[2] = largest
    q0[5], qd0[5] = largest, 1e300
    runs = m.simulate_batch(q0, qd0, steps=3)
    assert runs.steps.tolist() == [3, 3, 0, 3, 3, 0, 3, 3, 3]
    pair = m.simulate_batch(q0[2:4], qd0[2:4], steps=3)
    assert pair.status.tolist() == ["not finite", "ok"]
    assert np.isnan(pair.q[0, 1:]).all() and np.isfinite(pair.q[1]).all()
    for k in (2, 5):
        with pytest.warns(RuntimeWarning, match="not finite at the start|no longer be finite"):
            single = m.simulate(q0[k], qd0[k], steps=3)
        assert runs.status[k] == single.status == "not finite"
        assert runs.q[k, 0] == q0[k] and runs.qd[k, 0] == qd0[k] and np.isnan(runs.q[k, 1:]).all()


@pytest.mark.parametrize("every", [1, 5, 7, 400])
def test_rows_after_a_failure_are_nan(every: int) -> None:
    """A row exists only where the instance completed the steps to its time."""
    m = module("mass_spring")
    k = np.full(9, m.defaults["k"])
    k[4] *= 1e6  # far beyond the stability limit: it grows until it overflows
    with pytest.warns(RuntimeWarning, match="not finite|no longer be finite"):
        single = m.simulate(steps=400, every=every, params={"k": k[4]})
    message = (
        r"9 instances, \d+ of 3600 steps of [\d.]+ s: 1 not finite, 8 ok; .* go on, instance 4,"
    )
    with pytest.warns(RuntimeWarning, match=message) as warnings:
        runs = m.simulate_batch(steps=400, every=every, params={"k": k})
    (warning,) = warnings
    position = f"at t = {runs.h * runs.steps[4]:.9g}: the state would no longer be finite: the step"
    assert warning.filename == __file__ and position in str(warning.message)
    assert 5 < single.steps < 400 and runs.status[4] == single.status == "not finite"
    assert runs.steps[4] == single.steps
    rows = 1 + runs.steps[4] // every
    assert np.allclose(runs.q[4, :rows], single.q[:rows], rtol=1e-9)
    assert np.array_equal(runs.t[:rows], single.t[:rows])
    assert np.isnan(runs.q[4, rows:]).all() and np.isfinite(runs.q[5]).all()


def test_step_beyond_the_stability_limit_of_the_first_instance_is_reported() -> None:
    m = module("mass_spring")
    message = (
        "^many_mass_spring: the first instance: h = 0.012 s is beyond rk4's stability limit of"
    )
    with pytest.warns(RuntimeWarning, match=message) as warnings:
        m.simulate_batch(h=0.012, steps=20, params={"k": [1e6, 1.0]})
    assert warnings[0].filename == __file__


def test_many_calls_of_few_steps_beyond_the_stability_limit_are_reported_once() -> None:
    m = module("mass_spring")
    q, qd = np.ones((2, 1)), np.zeros((2, 1))
    stiff = {"params": {"k": np.array([1e6, 1.0])}, "steps": 6}
    with catch_warnings():
        simplefilter("error")
        for _ in range(3):
            m.step_batch(q, qd, h=0.0125, **stiff)
    with pytest.warns(RuntimeWarning, match="first instance: h = 0.0125 s is beyond rk4's"):
        m.step_batch(q, qd, h=0.0125, **stiff)
    with catch_warnings():
        simplefilter("error")
        m.step_batch(q, qd, h=0.0125, **stiff)
        for _ in range(9):
            m.step_batch(np.ones((2, 1)), np.zeros((2, 1)), h=0.0013, **stiff)


def test_ctrl_c_stops_within_a_second_and_leaves_completed_steps() -> None:
    m = module("kepler_orbit")
    q0, qd0 = np.tile(m.start[0], (300, 1)), np.tile(m.start[1], (300, 1))
    threading.Timer(0.3, _thread.interrupt_main).start()
    start = time.process_time()
    with pytest.raises(m.Interrupted) as interruption:
        m.simulate_batch(q0, qd0, steps=10**9, every=10**8)
    assert time.process_time() - start < 1.3
    assert (
        interruption.value.run.steps.sum() > 0 and "interrupted" in interruption.value.run.message
    )


@pytest.mark.parametrize("threads", tiers([1, 2], 2))
def test_instances_not_started_before_ctrl_c_are_at_their_start(threads: int) -> None:
    m = module("kepler_orbit")
    count = 30_000  # more than a thread takes at once
    q0 = np.tile(m.start[0], (count, 1)) * np.linspace(0.9, 1.1, count)[:, None]
    qd0 = np.tile(m.start[1], (count, 1))
    threading.Timer(0.3, _thread.interrupt_main).start()
    with pytest.raises(m.Interrupted) as interruption:
        m.simulate_batch(q0, qd0, steps=10**6, every=10**6, threads=threads)
    run = interruption.value.run
    assert run.steps[0] > 0 and run.steps[-1] == 0
    assert np.array_equal(run.q[-1, 0], q0[-1]) and np.isnan(run.q[-1, 1]).all()
    assert np.array_equal(run.qd[:, 0], qd0)


def test_instances_that_end_one_after_another_leave_the_last_unchanged() -> None:
    """Copies replace the instances that ended, and may have to be replaced themselves."""
    m = module("mass_spring")
    k = np.full(70, m.defaults["k"])
    k[:63] *= np.geomspace(
        1e6, 1e9, 63
    )  # the stiffer, the sooner it overflows; one instance of a tile survives
    k[66] *= 1e8
    runs = m.simulate_batch(steps=400, every=5, params={"k": k})
    survivors = np.setdiff1d(np.arange(63, 70), [66])
    assert set(runs.status[survivors]) == {"ok"} and len(set(runs.steps[:63])) > 10
    for index in (0, 31, 62, 66):
        with pytest.warns(RuntimeWarning):
            single = m.simulate(steps=400, every=5, params={"k": k[index]})
        assert (runs.status[index], runs.steps[index]) == (single.status, single.steps)
        rows = 1 + single.steps // 5
        assert np.allclose(runs.q[index, :rows], single.q[:rows], rtol=1e-9)
        assert np.isnan(runs.q[index, rows:]).all()
    separate = m.simulate_batch(steps=400, every=5, params={"k": k[survivors]})
    assert np.array_equal(runs.q[survivors], separate.q)
