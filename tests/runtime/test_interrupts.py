"""Concurrent threads and Ctrl-C during a run."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest
from support.session import tiers
from support.trajectories import QD, Q, runs_are_equal


def test_gil_is_released_during_a_run(cartpole: ModuleType) -> None:
    """A clock in another thread ticks about every millisecond.

    Were the GIL not released, it would tick only between two calls of C, each 50 ms long.
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


def test_threads_do_not_affect_each_other(driven: ModuleType) -> None:
    starts = [[0.1 * k, 3.0] for k in range(4)]
    sequential = [driven.simulate(q, steps=20_000) for q in starts]
    concurrent: list[Any] = [None] * 4

    def work(k: int) -> None:
        concurrent[k] = driven.simulate(starts[k], steps=20_000)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(runs_are_equal(a, b) for a, b in zip(sequential, concurrent, strict=True))


@contextlib.contextmanager
def ctrl_c_after(seconds: float) -> Iterator[None]:
    """Simulate a Ctrl-C after so many seconds of computing time of all threads."""

    def press(*_: Any) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGPROF, press)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)


@pytest.mark.parametrize("every", tiers([1, 7, 100_003], 7, 100_003))
@pytest.mark.parametrize("delay", tiers([0.13, 0.17], 0.13))
def test_ctrl_c_returns_the_run_so_far(cartpole: ModuleType, every: int, delay: float) -> None:
    """The interrupted run equals a run of as many steps."""
    with pytest.raises(KeyboardInterrupt) as interruption, ctrl_c_after(delay):
        cartpole.simulate(steps=20_000_000 if every > 1 else 8_000_000, every=every)
    run = interruption.value.run
    assert run.status == "interrupted"
    assert 0 < run.steps < 20_000_000
    assert "interrupted" in run.message
    assert runs_are_equal(run, cartpole.simulate(steps=run.steps, every=every))


def test_ctrl_c_is_handled_soon(cartpole: ModuleType) -> None:
    with pytest.raises(KeyboardInterrupt), ctrl_c_after(0.1):
        start = time.process_time()
        cartpole.simulate(steps=10**9, every=10**6)
    assert time.process_time() - start < 2


def test_ctrl_c_in_the_progress_callback(driven: ModuleType) -> None:
    def stop(finished: int, steps: int) -> None:
        if finished > 10_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as interruption:
        driven.simulate(steps=10**6, every=9, progress=stop)
    run = interruption.value.run
    assert 10_000 < run.steps < 10**6
    assert runs_are_equal(run, driven.simulate(steps=run.steps, every=9))


@pytest.mark.parametrize("steps", [10, 10**6])
def test_ctrl_c_in_the_first_poll_leaves_completed_steps(cartpole: ModuleType, steps: int) -> None:
    """In a run of a single call of C and in one of many calls."""

    def stop(finished: int, steps: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as interruption:
        cartpole.simulate(steps=steps, every=3, progress=stop)
    run = interruption.value.run
    assert (run.status, 0 < run.steps <= steps) == ("interrupted", True)
    assert runs_are_equal(run, cartpole.simulate(steps=run.steps, every=3))


def test_ctrl_c_before_the_first_step_leaves_the_start(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        raise KeyboardInterrupt

    with warnings.catch_warnings(action="ignore"), pytest.raises(KeyboardInterrupt) as interruption:
        driven.simulate(Q, QD, steps=9, u=law)
    run = interruption.value.run
    assert (run.status, run.steps, run.evaluations) == ("interrupted", 0, 0)
    assert (run.q.tolist(), run.qd.tolist()) == ([Q], [QD])


def test_ctrl_c_in_an_input_function(driven: ModuleType) -> None:
    def law(t: float, q: Any, qd: Any) -> float:
        if t > 0.5:
            raise KeyboardInterrupt
        return 0.1

    with warnings.catch_warnings(action="ignore"), pytest.raises(KeyboardInterrupt) as interruption:
        driven.simulate(h=0.01, steps=1000, every=4, u=law)
    run = interruption.value.run
    assert run.steps == 51
    assert runs_are_equal(run, driven.simulate(h=0.01, steps=51, every=4, u=0.1))
