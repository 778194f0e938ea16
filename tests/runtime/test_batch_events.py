"""Events of many trajectories: each instance has those of its run alone, in their order."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import Modules
from eventful import BALL, G, built
from test_adaptive_memory import ENDLESS

pytestmark = pytest.mark.usefixtures("unoptimised_file")
FAR = np.array([1e9, 0.7, 1e9, 1e9])
E = np.array([0.8, 0.8, 0.5, 0.9])
HOW = {"params": {"far": FAR, "e": E}, "duration": 2.0}
ARRAYS = ("t", "q", "qd", "instance")


@pytest.fixture(scope="module")
def balls() -> ModuleType:
    return built(BALL)


def own(module: ModuleType, name: str) -> ModuleType:
    """A file of those beside a module."""
    return sys.modules[f"{module.__name__}._runtime.{name}"]


@pytest.mark.filterwarnings("ignore:.*jumps follow one another")
def test_each_has_those_of_its_run_alone(balls: ModuleType) -> None:
    run = balls.simulate_batch(**HOW)
    assert list(run.events) == ["impact", "top", "corner", "away"]
    for k in range(4):
        alone = balls.simulate(params={"far": FAR[k], "e": E[k]}, duration=2.0)
        for name, found in run.events.items():
            mine, expected = found.for_instance(k), alone.events[name]
            for what in ("t", "q", "qd"):
                assert np.array_equal(getattr(mine, what), getattr(expected, what)), (k, name)
        assert run.stopped[k] == alone.stopped
        assert np.array_equal(run.limit[k], alone.limit, equal_nan=True)
    impacts = run.events["impact"]
    assert len(impacts) == len(impacts.instance) > 50 and np.all(np.diff(impacts.instance) >= 0)
    assert impacts.q.shape == (len(impacts), 2)


def test_impacts_are_where_the_closed_form_has_them(balls: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match=r"instance 2, .* jumps follow .* up to t = 1\.35"):
        run = balls.simulate_batch(**HOW)
    first = np.sqrt(2 / G)
    for k in (0, 3):
        flights = 2 * first * E[k] ** np.arange(1, 5)
        exact = first + np.concatenate([[0], np.cumsum(flights)])
        found = run.events["impact"].for_instance(k).t
        assert found == pytest.approx(exact[: len(found)], rel=1e-13) and len(found) >= 2
    assert run.limit[2] == pytest.approx(first * (1 + 0.5) / (1 - 0.5), rel=1e-10)
    assert np.isnan(run.limit[[0, 1, 3]]).all()
    assert run.stopped.tolist() == ["", "away", "", ""]
    assert run.events["away"].t == pytest.approx([0.7]) and run.events["away"].instance == [1]
    assert "3 ok" in run.message and "1 stopped by 'away'" in run.message


def test_an_instance_that_there_is_not_is_refused(balls: ModuleType) -> None:
    """Also by a name, or as an array; -1 is the last, as of a list."""
    impacts = balls.simulate_batch(**HOW).events["impact"]
    assert np.array_equal(impacts.for_instance(-1).t, impacts.for_instance(np.int64(3)).t)
    for k in (4, -5):
        with pytest.raises(IndexError, match=f"there is no instance {k}: they are 0 to 3"):
            impacts.for_instance(k)
    for k in ("impact", 1.0, None):
        with pytest.raises(TypeError, match=r"of: .* is no number of an instance"):
            impacts.for_instance(k)


def test_events_are_told_in_words_and_by_their_names(balls: ModuleType) -> None:
    runs, run = balls.simulate_batch(**HOW), balls.simulate(duration=2.0, params={"far": 0.7})
    told = "'impact': <once, at 0.451524 s>, 'top': <never>, 'corner': <never>"
    assert repr(run.events).startswith(f"{{{told}")
    impacts = runs.events["impact"]
    told = f"{len(impacts)} times, 0.451524 s to {impacts.t.max():.6g} s, in 4 of 4 instances"
    assert repr(impacts) == f"<{told}>" and repr(runs.events["corner"]) == "<never>"
    for found in (run.events, runs.events):
        with pytest.raises(KeyError, match=r"'impat' is not one of .*; did you mean 'impact'"):
            found["impat"]


def test_they_are_the_same_in_pieces(balls: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """However little room a call has for them, and however instances go to threads."""
    many = np.linspace(0.3, 0.9, 40)
    how = {"params": {"e": many}, "duration": 1.9}
    run = balls.simulate_batch(**how, threads=1)
    monkeypatch.setattr(own(balls, "events"), "_EVENTS_EACH", 32)
    monkeypatch.setattr(own(balls, "batch_adaptive"), "_SMALL_GROUP_SIZE", 3)
    again = balls.simulate_batch(**how, threads=2)
    for name, found in run.events.items():
        for what in ARRAYS:
            assert np.array_equal(getattr(found, what), getattr(again.events[name], what))
    assert len(run.events["impact"]) > 200 and np.array_equal(run.q, again.q, equal_nan=True)


def test_they_are_kept(balls: ModuleType, tmp_path: Path) -> None:
    run = balls.simulate_batch(**HOW)
    run.save(tmp_path / "balls.npz")
    for again in (balls.load_run(tmp_path / "balls.npz"), pickle.loads(pickle.dumps(run))):
        for name, found in run.events.items():
            for what in ARRAYS:
                assert np.array_equal(getattr(found, what), getattr(again.events[name], what))
        assert again.stopped.tolist() == run.stopped.tolist()
        assert np.array_equal(again.limit, run.limit, equal_nan=True)


def test_without_events_there_are_none(modules: Modules) -> None:
    text = ENDLESS.split("[[event]]")[0].replace("endless_jumps", "no_jumps")
    text += "[run]\nduration = 1.0\ntolerance = 1e-6\nbatch = true\n"
    run = modules.unoptimised(text).simulate_batch([[0.1, 0.0], [0.2, 0.0]])
    assert run.events == {} and run.stopped.tolist() == ["", ""] and np.isnan(run.limit).all()


def test_jumps_for_ever_end_with_what_there_is_memory_for(
    modules: Modules, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = ENDLESS.replace("endless_jumps", "endless_batch").replace("[run]", "[run]\nbatch = true")
    endless = modules.unoptimised(text)
    monkeypatch.setattr(own(endless, "adaptive"), "machine_memory", lambda: 1_000_000)
    run = endless.simulate_batch([[0.1, 0.0], [0.2, 0.0]], threads=1)
    assert set(run.status.tolist()) == {"out of memory"} and "2 out of memory" in run.message
    kept = len(run.events["again"]) * 5 * 8
    assert 0.39e6 < kept < 0.4e6 + 2 * 65 * 5 * 8
