"""Events of batches: each instance has the events of its single run, in the same order."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.event_scenes import BALL, G, built
from support.session import Modules
from test_adaptive_memory import ENDLESS

pytestmark = pytest.mark.usefixtures("unoptimised_file")
FAR = np.array([1e9, 0.7, 1e9, 1e9])
E = np.array([0.8, 0.8, 0.5, 0.9])
OPTIONS = {"params": {"far": FAR, "e": E}, "duration": 2.0}
ARRAYS = ("t", "q", "qd", "instance")


@pytest.fixture(scope="module")
def balls() -> ModuleType:
    return built(BALL)


def runtime_module(module: ModuleType, name: str) -> ModuleType:
    """Return the runtime module `name` of a compiled module."""
    return sys.modules[f"{module.__name__}._runtime.{name}"]


@pytest.mark.filterwarnings("ignore:.*jumps follow one another")
def test_instance_has_the_events_of_its_single_run(balls: ModuleType) -> None:
    run = balls.simulate_batch(**OPTIONS)
    assert list(run.events) == ["impact", "top", "corner", "away"]
    for k in range(4):
        single = balls.simulate(params={"far": FAR[k], "e": E[k]}, duration=2.0)
        for name, events in run.events.items():
            actual, expected = events.for_instance(k), single.events[name]
            for field in ("t", "q", "qd"):
                assert np.array_equal(getattr(actual, field), getattr(expected, field)), (k, name)
        assert run.stopped[k] == single.stopped
        assert np.array_equal(run.limit[k], single.limit, equal_nan=True)
    impacts = run.events["impact"]
    assert len(impacts) == len(impacts.instance) > 50 and np.all(np.diff(impacts.instance) >= 0)
    assert impacts.q.shape == (len(impacts), 2)


def test_impact_times_equal_the_closed_form(balls: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match=r"instance 2, .* jumps follow .* up to t = 1\.35"):
        run = balls.simulate_batch(**OPTIONS)
    first = np.sqrt(2 / G)
    for k in (0, 3):
        flights = 2 * first * E[k] ** np.arange(1, 5)
        expected = first + np.concatenate([[0], np.cumsum(flights)])
        times = run.events["impact"].for_instance(k).t
        assert times == pytest.approx(expected[: len(times)], rel=1e-13) and len(times) >= 2
    assert run.limit[2] == pytest.approx(first * (1 + 0.5) / (1 - 0.5), rel=1e-10)
    assert np.isnan(run.limit[[0, 1, 3]]).all()
    assert run.stopped.tolist() == ["", "away", "", ""]
    assert run.events["away"].t == pytest.approx([0.7]) and run.events["away"].instance == [1]
    assert "3 ok" in run.message and "1 stopped by 'away'" in run.message


def test_instance_number_out_of_range_is_refused(balls: ModuleType) -> None:
    """A name or a number that is not an integer is refused too; -1 is the last, as in a list."""
    impacts = balls.simulate_batch(**OPTIONS).events["impact"]
    assert np.array_equal(impacts.for_instance(-1).t, impacts.for_instance(np.int64(3)).t)
    for k in (4, -5):
        with pytest.raises(IndexError, match=f"there is no instance {k}: they are 0 to 3"):
            impacts.for_instance(k)
    for k in ("impact", 1.0, None):
        with pytest.raises(TypeError, match=r"for_instance: .* is not the index"):
            impacts.for_instance(k)


def test_repr_of_events_lists_names_counts_and_times(balls: ModuleType) -> None:
    runs, run = balls.simulate_batch(**OPTIONS), balls.simulate(duration=2.0, params={"far": 0.7})
    expected = "'impact': <once, at 0.451524 s>, 'top': <never>, 'corner': <never>"
    assert repr(run.events).startswith(f"{{{expected}")
    impacts = runs.events["impact"]
    expected = f"{len(impacts)} times, 0.451524 s to {impacts.t.max():.6g} s, in 4 of 4 instances"
    assert repr(impacts) == f"<{expected}>" and repr(runs.events["corner"]) == "<never>"
    for events in (run.events, runs.events):
        with pytest.raises(KeyError, match=r"'impat' is not one of .*; did you mean 'impact'"):
            events["impat"]


def test_batch_split_into_several_calls_has_the_same_events(
    balls: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any buffer size of a call and any distribution of instances to threads."""
    restitution = np.linspace(0.3, 0.9, 40)
    options = {"params": {"e": restitution}, "duration": 1.9}
    run = balls.simulate_batch(**options, threads=1)
    monkeypatch.setattr(runtime_module(balls, "columns"), "EVENTS_EACH", 32)
    monkeypatch.setattr(runtime_module(balls, "batch"), "SMALL_GROUP_SIZE", 3)
    repeated = balls.simulate_batch(**options, threads=2)
    for name, events in run.events.items():
        for field in ARRAYS:
            assert np.array_equal(getattr(events, field), getattr(repeated.events[name], field))
    assert len(run.events["impact"]) > 200 and np.array_equal(run.q, repeated.q, equal_nan=True)


def test_events_of_a_saved_or_pickled_batch_are_unchanged(
    balls: ModuleType, tmp_path: Path
) -> None:
    run = balls.simulate_batch(**OPTIONS)
    run.save(tmp_path / "balls.npz")
    for loaded in (balls.load_run(tmp_path / "balls.npz"), pickle.loads(pickle.dumps(run))):
        for name, events in run.events.items():
            for field in ARRAYS:
                assert np.array_equal(getattr(events, field), getattr(loaded.events[name], field))
        assert loaded.stopped.tolist() == run.stopped.tolist()
        assert np.array_equal(loaded.limit, run.limit, equal_nan=True)


def test_batch_without_events_has_none(modules: Modules) -> None:
    text = ENDLESS.split("[[event]]")[0].replace("endless_jumps", "no_jumps")
    text += "[run]\nduration = 1.0\ntolerance = 1e-6\nbatch = true\n"
    run = modules.unoptimised(text).simulate_batch([[0.1, 0.0], [0.2, 0.0]])
    assert run.events == {} and run.stopped.tolist() == ["", ""] and np.isnan(run.limit).all()


def test_endless_jumps_end_the_batch_when_memory_is_full(
    modules: Modules, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = ENDLESS.replace("endless_jumps", "endless_batch").replace("[run]", "[run]\nbatch = true")
    endless = modules.unoptimised(text)
    monkeypatch.setattr(runtime_module(endless, "integration"), "machine_memory", lambda: 1_000_000)
    run = endless.simulate_batch([[0.1, 0.0], [0.2, 0.0]], threads=1)
    assert set(run.status.tolist()) == {"out of memory"} and "2 out of memory" in run.message
    event_bytes = len(run.events["again"]) * 5 * 8
    assert 0.39e6 < event_bytes < 0.4e6 + 2 * 65 * 5 * 8
