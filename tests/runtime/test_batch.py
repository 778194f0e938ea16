"""Batches: what `batch = true` in a scene promises."""

from __future__ import annotations

import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from support.session import Modules, tiers
from support.trajectories import STEPS, module, starts

NAMES = ["cartpole", "cartpole_driven", "furuta_pendulum", "kapitza_pendulum", "foucault_pendulum"]


@pytest.mark.parametrize("name", tiers(NAMES, "cartpole_driven"))
def test_instance_equals_single_run(name: str) -> None:
    m = module(name)
    q0, qd0 = starts(m, 130)
    runs = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    for k in (0, 63, 64, 129):
        single = m.simulate(q0[k], qd0[k], steps=STEPS, every=7)
        assert np.array_equal(runs.t, single.t)
        # the same operations, contracted to FMA at other places
        scale = 1 + np.max(np.abs(single.q))
        assert np.max(np.abs(runs.q[k] - single.q)) < 1e-13 * scale
        assert np.max(np.abs(runs.qd[k] - single.qd)) < 1e-11 * (1 + np.max(np.abs(single.qd)))
    assert set(runs.status) == {"ok"} and set(runs.steps) == {STEPS}


def test_order_and_threads_change_no_bit() -> None:
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 1000)
    one_thread = m.simulate_batch(q0, qd0, steps=STEPS, threads=1)
    three_threads = m.simulate_batch(q0, qd0, steps=STEPS, threads=3)
    assert np.array_equal(one_thread.q, three_threads.q) and np.array_equal(
        one_thread.qd, three_threads.qd
    )
    part = m.simulate_batch(q0[501:540], qd0[501:540], steps=STEPS)
    assert np.array_equal(part.q, one_thread.q[501:540])
    reversed_runs = m.simulate_batch(q0[::-1], qd0[::-1], steps=STEPS)
    assert np.array_equal(reversed_runs.q, one_thread.q[::-1])


@pytest.mark.parametrize("real", tiers(["double", "float"], "double"))
@pytest.mark.parametrize("name", tiers(("cartpole", "cartpole_driven", "tumbling_box"), "cartpole"))
def test_batch_size_changes_no_bit(name: str, real: str) -> None:
    """Partly filled tiles are computed block by block; results equal those of a larger batch."""
    m = module(name, real=f'"{real}"')
    q0, qd0 = starts(m, 300)
    all_runs = m.simulate_batch(q0, qd0, steps=5, every=2)
    assert (all_runs.steps == 5).all()
    for count in (*range(1, 40), 56, 57, 63, 64, 65, 71, 127, 129):
        few = m.simulate_batch(q0[-count:], qd0[-count:], steps=5, every=2)
        assert np.array_equal(few.q, all_runs.q[-count:])
        assert np.array_equal(few.qd, all_runs.qd[-count:])
        assert (few.steps == 5).all() and set(few.status) == {"ok"}


def test_instances_have_their_own_parameters_and_inputs() -> None:
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 70)
    masses = np.linspace(0.5, 4.0, 70)
    table = np.random.default_rng(2).standard_normal((70, STEPS, 1))
    runs = m.simulate_batch(q0, qd0, steps=STEPS, params={"m_c": masses, "l": 1.5}, u=table)
    k = 69
    single = m.simulate(q0[k], qd0[k], steps=STEPS, params={"m_c": masses[k], "l": 1.5}, u=table[k])
    assert np.max(np.abs(runs.q[k] - single.q)) < 1e-12
    constant = m.simulate_batch(q0, qd0, steps=STEPS, u=[3.0])
    single = m.simulate(q0[k], qd0[k], steps=STEPS, u=[3.0])
    assert np.max(np.abs(constant.q[k] - single.q)) < 1e-12


def test_equal_parameters_per_instance_change_no_bit() -> None:
    """Shared parameters and parameters per instance are compiled separately."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 130)
    for u in (None, [0.5]):
        shared = m.simulate_batch(q0, qd0, steps=STEPS, params={"l": 1.5}, u=u)
        per_instance = m.simulate_batch(q0, qd0, steps=STEPS, params={"l": np.full(130, 1.5)}, u=u)
        assert np.array_equal(shared.q, per_instance.q) and np.array_equal(
            shared.qd, per_instance.qd
        )


def test_groups_have_their_own_parameters_and_inputs() -> None:
    """One thread takes all 600 at once, three take 128 each time; one table may serve all."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 600)
    params = np.tile(list(m.defaults.values()), (600, 1))
    params[:, m.parameters.index("m_c")] = np.linspace(0.5, 4.0, 600)
    table = np.random.default_rng(4).standard_normal((600, STEPS, 1))
    for u in (table, table[:, 0], table[:1]):
        one_thread, three_threads = (
            m.simulate_batch(q0, qd0, steps=STEPS, params=params, u=u, threads=threads)
            for threads in (1, 3)
        )
        assert np.array_equal(one_thread.q, three_threads.q) and np.array_equal(
            one_thread.qd, three_threads.qd
        )
        k = 599
        inputs = np.broadcast_to(u if u.ndim == 3 else u[:, None], table.shape)[k]
        single = m.simulate(q0[k], qd0[k], steps=STEPS, params=params[k], u=inputs)
        assert np.max(np.abs(three_threads.q[k] - single.q)) < 1e-12


def test_batch_split_into_several_calls_is_identical(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poll Ctrl-C after each step: time, rows and inputs go on; stopped instances stay stopped."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 70)
    table = np.random.default_rng(5).standard_normal((70, STEPS, 1))
    table[41, 33] = 1e300  # too large for the square of the resulting theta_dot

    def simulate_all() -> list[Any]:
        options = {"steps": STEPS, "every": 7, "t0": 0.5}
        return [m.simulate_batch(q0, qd0, u=u, **options) for u in (None, table, table[:1])]

    reference = simulate_all()
    for name in ("FIRST_POLL_SECONDS", "POLL_SECONDS"):
        monkeypatch.setattr(sys.modules[f"{m.__name__}._runtime.batch"], name, 0.0)
    for expected, actual in zip(reference, simulate_all(), strict=True):
        for name in ("t", "q", "qd", "steps"):
            assert np.array_equal(getattr(expected, name), getattr(actual, name), equal_nan=True)
        assert np.array_equal(expected.status, actual.status)
    assert (reference[1].status[41], reference[1].status[40]) == ("not finite", "ok")
    assert 33 <= reference[1].steps[41] < STEPS
    single = m.simulate(q0[3], qd0[3], steps=STEPS, every=7, t0=0.5)
    assert np.array_equal(reference[0].t, single.t) and single.t[0] == 0.5
    assert np.max(np.abs(reference[0].q[3] - single.q)) < 1e-12


def test_starts_of_any_memory_layout_are_read_and_unchanged() -> None:
    m = module("cartpole")
    q0, qd0 = starts(m, 300)
    expected = m.simulate_batch(q0, qd0, steps=STEPS)
    wide = np.empty((2, 2, 600))
    wide[0, :, ::2], wide[1, :, ::2] = q0.T, qd0.T
    strided = wide[0, :, ::2].T, wide[1, :, ::2].T
    runs = m.simulate_batch(*strided, steps=STEPS)
    assert np.array_equal(runs.q, expected.q) and np.array_equal(runs.qd, expected.qd)
    assert np.array_equal(strided[0], q0) and np.array_equal(strided[1], qd0)
    broadcast = m.simulate_batch(q0[0], qd0, steps=STEPS)
    assert np.array_equal(broadcast.q[:, 0], np.tile(q0[0], (300, 1)))
    table = np.zeros(300, [("q", float, 2), ("one", "b"), ("qd", float, 2)])  # unaligned numbers
    table["q"], table["qd"] = q0, qd0
    for q, qd in ((table["q"], table["qd"]), (q0[::-1].copy()[::-1], qd0.astype(">f8"))):
        runs = m.simulate_batch(q, qd, steps=STEPS)
        assert np.array_equal(runs.q, expected.q) and np.array_equal(runs.qd, expected.qd)


def test_rows_of_many_coordinates_start_at_the_initial_state(modules: Modules) -> None:
    """Nine masses in a row, coupled by springs."""
    names = [f"x{k}" for k in range(9)]
    springs = " + ".join(f"({a} - {b})**2" for a, b in pairwise(["1", *names, "2"]))
    lines = ["eomc = 1", 'name = "row"', "[coordinates]", *(f"{x} = {{}}" for x in names)]
    lines += ["[energy]", f'kinetic = "{" + ".join(f"{x}_dot**2" for x in names)}"']
    lines += [f'potential = "{springs}"', "[run]", "batch = true"]
    m = modules.unoptimised("\n".join(lines))
    q0, qd0 = starts(m, 20)
    for positions in (q0, q0.astype(np.float32)):
        runs = m.simulate_batch(positions, qd0, h=0.01, steps=3)
        assert np.array_equal(runs.q[:, 0], positions) and np.array_equal(runs.qd[:, 0], qd0)
        for k in (0, 7, 19):
            single = m.simulate(positions[k], qd0[k], h=0.01, steps=3)
            np.testing.assert_allclose(runs.q[k], single.q, rtol=0, atol=1e-15)


def test_step_batch_in_place_and_into_out() -> None:
    m = module("cartpole")
    q0, qd0 = starts(m, 80)
    q, qd = q0.copy(), qd0.copy()
    for _ in range(3):
        assert not m.step_batch(q, qd, h=0.01).any()
    runs = m.simulate_batch(q0, qd0, h=0.01, steps=3)
    assert np.array_equal(q, runs.q[:, -1]) and np.array_equal(qd, runs.qd[:, -1])
    out = np.empty_like(q0), np.empty_like(qd0)
    m.step_batch(q0, qd0, h=0.01, out=out)
    assert np.array_equal(out[0], runs.q[:, 1])
    with pytest.raises(ValueError, match="qd: lies in the memory of q"):
        m.step_batch(q, q, h=0.01)


@pytest.mark.parametrize("count", [5, 2500])
def test_step_batch_equals_first_step_of_a_run(count: int) -> None:
    """Parameters and inputs per instance, and shared ones; C takes 1,024 instances at once."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, count)
    masses, forces = np.linspace(1.0, 3.0, count), np.linspace(-1.0, 1.0, count)[:, None]
    for options in (
        {},
        {"params": {"m_c": masses}},
        {"u": forces},
        {"u": 0.5, "params": {"l": 1.5}},
    ):
        q, qd = q0.copy(), qd0.copy()
        status = m.step_batch(q, qd, **options)
        assert status.shape == (count,) and not status.any()
        runs = m.simulate_batch(q0, qd0, steps=1, **options)
        assert np.array_equal(q, runs.q[:, 1])
        assert np.array_equal(qd, runs.qd[:, 1])


@pytest.mark.parametrize("count", [5, 2500])
def test_several_steps_in_one_call_equal_a_run(count: int) -> None:
    """Inputs are held constant; large batches use threads."""
    m = module("cartpole_driven")
    q, qd = starts(m, count)
    u = np.linspace(-1, 1, count)[:, None]
    runs = m.simulate_batch(q, qd, steps=12, every=4, u=u, t0=0.3)
    for row in (1, 2, 3):
        assert not m.step_batch(q, qd, t=0.3, u=u, steps=4).any()
        assert np.array_equal(q, runs.q[:, row]) and np.array_equal(qd, runs.qd[:, row])
    assert not m.step_batch(q, qd, steps=0).any() and np.array_equal(q, runs.q[:, 3])


def test_step_batch_leaves_the_state_before_the_failed_step() -> None:
    m = module("cartpole")
    q, qd = np.array([[0.0, 0.1], [0.0, 0.4]]), np.array([[0.0, 0.0], [0.0, 0.4]])
    with pytest.warns(RuntimeWarning):
        run = m.simulate(q[1], qd[1], h=3.0, steps=300)
    assert run.status == "not finite" and 0 < run.steps < 300
    failed = m.step_batch(q, qd, 3.0, steps=300)
    assert m.STATUS[failed[1]] == "not finite" and np.isfinite(q).all()


@pytest.mark.parametrize("count", [3, 25_000])
@pytest.mark.parametrize("name", tiers(["kapitza_pendulum", "cartpole"], "cartpole"))
def test_instances_can_have_their_own_times(name: str, count: int) -> None:
    """Each is stepped from its own time; a scene without explicit time accepts any."""
    m = module(name)
    q, qd = starts(m, count)
    times = np.random.default_rng(2).uniform(0, 3, count)
    times[1::2] = times[0]  # some instances share a time
    expected = [m.simulate(q[k], qd[k], 0.001, steps=2, t0=times[k]) for k in range(3)]
    failed = m.step_batch(q, qd, 0.001, times, steps=2)
    assert not failed.any()
    for k in range(3):
        np.testing.assert_allclose(q[k], expected[k].q[-1], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(qd[k], expected[k].qd[-1], rtol=1e-12, atol=1e-13)
    q, qd = starts(m, count)
    m.step_batch(q, qd, 0.001, 0.7, steps=2)
    other_q, other_qd = starts(m, count)
    m.step_batch(other_q, other_qd, 0.001, np.full(count, 0.7), steps=2)
    assert np.array_equal(q, other_q) and np.array_equal(qd, other_qd)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"t": [0.0, 1.0]}, r"t: shape \(2,\), expected one number or \(3,\)"),
        ({"t": [0.0, 1.0, np.nan]}, "t: nan is not a finite number, at .2."),
        ({"t": "x"}, "t: 'x' is not a number"),
        ({"steps": -1}, "steps: -1 is not a whole number"),
        ({"steps": 1.5}, "steps: 1.5 is not a whole number"),
    ],
)
def test_invalid_times_and_step_counts_are_refused(options: dict[str, Any], message: str) -> None:
    m = module("cartpole")
    q, qd = starts(m, 3)
    initial = q.copy()
    with pytest.raises(ValueError, match=message):
        m.step_batch(q, qd, **options)
    assert np.array_equal(q, initial)


def test_step_of_a_large_batch_equals_that_of_a_part() -> None:
    """From 20,000 instances on, threads are used and Ctrl-C is polled; failed ones do not move."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 20_000)
    masses = np.full(20_000, m.defaults["m_c"])
    masses[12_345] = -3.0
    q, qd = q0.copy(), qd0.copy()
    status = m.step_batch(q, qd, t=0.5, params={"m_c": masses})
    assert status.nonzero()[0].tolist() == [12_345]
    assert m.STATUS[status[12_345]] == "singular" and m.STATUS[0] == "ok"
    assert np.array_equal(q[12_345], q0[12_345]) and np.array_equal(qd[12_345], qd0[12_345])
    part = slice(12_300, 12_400)
    q_part, qd_part = q0[part].copy(), qd0[part].copy()
    assert np.array_equal(
        m.step_batch(q_part, qd_part, t=0.5, params={"m_c": masses[part]}), status[part]
    )
    assert np.array_equal(q_part, q[part]) and np.array_equal(qd_part, qd[part])


def test_progress_reaches_the_end() -> None:
    m = module("cartpole")
    calls: list[tuple[int, int]] = []
    q0, qd0 = starts(m, 64)
    m.simulate_batch(
        q0, qd0, steps=STEPS, progress=lambda finished, total: calls.append((finished, total))
    )
    assert calls[-1] == (64 * STEPS, 64 * STEPS)


def test_single_precision() -> None:
    m = module("cartpole", real='"float"')
    assert m.dtype == np.float32
    q0, qd0 = starts(m, 10)
    runs = m.simulate_batch(q0, qd0, steps=STEPS)
    assert runs.q.dtype == np.float32
    exact = module("cartpole").simulate_batch(q0, qd0, steps=STEPS)
    error = np.max(np.abs(runs.q - exact.q))
    assert 1e-9 < error < 1e-4  # the error of single precision


@pytest.mark.parametrize("inputs", [True, False])
def test_scene_without_parameters_can_be_a_batch(modules: Modules, inputs: bool) -> None:
    input_text = "[inputs]\nf = { signal = 0.5 }\n[forces]\nx = 'f'\n" if inputs else ""
    bare = modules.unoptimised(
        "eomc = 1\nname = 'bare'\n[coordinates]\nx = { start = 1.0 }\n"
        f"{input_text}[energy]\nkinetic = 'x_dot**2/2'\npotential = 'x**2/2'\n[run]\nbatch = true\n"
    )
    runs = bare.simulate_batch([[1.0], [2.0]], [[0.0], [0.0]], h=0.01, steps=100, every=100)
    single = bare.simulate([2.0], [0.0], h=0.01, steps=100, every=100)
    np.testing.assert_allclose(runs.q[1, -1], single.q[-1], rtol=1e-14)
