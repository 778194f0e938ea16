"""What batches have under constraints: as the runs of their instances have it."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES
from conftest import Modules

COUNT, STEPS, EVERY = 3, 20, 3
LENGTHS = np.array([0.4, 0.35, 0.3])
SHORT = {"steps": STEPS, "every": EVERY}
GIVEN: dict[str, Any] = {
    "signals": None,
    "constant": [0.7, 0.1],
    "each": np.array([[0.7, 0.1], [-0.2, 0.2], [0.1, 0.0]]),
    "tables": np.linspace(-1, 1, COUNT * STEPS * 2).reshape(COUNT, STEPS, 2),
    "a table": np.linspace(-1, 1, STEPS * 2).reshape(1, STEPS, 2),
}
# a four-bar with motors at the crank and the rocker, and friction in both and between
DRIVEN = (
    (SCENES / "four_bar.toml").read_text(encoding="utf-8").split("[picture]")[0]
    + """[inputs]
at_crank = { signal = "sin(5*t) - q1_dot/9", limits = [-0.6, 0.6] }
at_rocker = {}
[forces]
q1 = "at_crank - q1_dot/7"
q2 = "-q2_dot/9"
q3 = "at_rocker"
[run]
h = 0.01
batch = true
tolerance = 1e-9
inverse_dynamics = true
frames = true
"""
).replace('"four_bar"', '"driven_four_bar"')


@pytest.fixture(scope="module")
def linkage(modules: Modules) -> ModuleType:
    return modules.unoptimised(DRIVEN)


def starts(m: ModuleType) -> dict[str, Any]:
    """The crank at several angles and rates; what closes the loop follows."""
    q, qd = (np.tile(x, (COUNT, 1)) for x in m.start)
    q[:, 0] += [0.0, 0.3, -0.2]
    qd[:, 0] += [0.0, 1.0, -2.0]
    return {"q0": q, "qd0": qd}


def row_of(u: Any, k: int) -> Any:
    """The inputs of an instance."""
    if not isinstance(u, np.ndarray):
        return u
    return u[min(k, len(u) - 1)]


@pytest.mark.parametrize("how", GIVEN)
@pytest.mark.parametrize("params", [{"b": 1.02}, {"a": LENGTHS}], ids=["alike", "each its own"])
def test_each_has_what_it_has_alone(linkage: ModuleType, how: str, params: dict[str, Any]) -> None:
    u, at = GIVEN[how], starts(linkage)
    runs = linkage.simulate_batch(**at, **SHORT, u=u, params=params)
    rows = runs.q.shape[1]
    assert rows == 8 and (runs.status == "ok").all()
    for found in (runs.constraints, runs.multipliers):
        assert list(found) == ["pin_x", "pin_y"]
        assert all(x.shape == (COUNT, rows) for x in found.values())
    assert runs.reactions["pin"].shape == (COUNT, rows, 3)
    for k in range(COUNT):
        own = {name: np.broadcast_to(x, COUNT)[k] for name, x in params.items()}
        alone = linkage.simulate(at["q0"][k], at["qd0"][k], **SHORT, u=row_of(u, k), params=own)
        for name in ("multipliers", "reactions"):
            for row, values in getattr(alone, name).items():
                np.testing.assert_allclose(getattr(runs, name)[row][k], values, 1e-9, 1e-9)
        for values in runs.constraints.values():
            assert np.abs(values[k]).max() < 1e-14
        for j in range(rows):  # at its own rows, in all bits
            state = runs.q[k, j], runs.qd[k, j], runs.t[j]
            multipliers = linkage.multipliers(*state, u=runs.u[k, j], params=own)
            force = linkage.reactions(*state, u=runs.u[k, j], params=own)
            lack = linkage.constraints(*state, params=own)
            assert [x[k, j] for x in runs.multipliers.values()] == multipliers.tolist()
            assert [x[k, j] for x in runs.constraints.values()] == lack.tolist()
            assert np.array_equal(runs.reactions["pin"][k, j], force["pin"])


def test_so_have_adaptive_and_saved_ones(linkage: ModuleType, tmp_path: Path) -> None:
    times = [0.0, 0.05, 0.2]
    runs = linkage.simulate_batch(**starts(linkage), tol=1e-9, times=times, params={"a": LENGTHS})
    q0, qd0 = (x[1] for x in starts(linkage).values())
    alone = linkage.simulate(q0, qd0, tol=1e-9, times=times, params={"a": LENGTHS[1]})
    for name in ("constraints", "multipliers", "reactions"):
        for row, values in getattr(alone, name).items():
            assert np.array_equal(getattr(runs, name)[row][1], values), name
    runs.save(tmp_path / "runs.npz")
    for again in (linkage.load_run(tmp_path / "runs.npz"), pickle.loads(pickle.dumps(runs))):
        assert np.array_equal(again.multipliers["pin_y"], runs.multipliers["pin_y"])
        assert np.array_equal(again.reactions["pin"], runs.reactions["pin"])


def test_rows_behind_a_failure_are_nan(linkage: ModuleType) -> None:
    at = starts(linkage)
    at["qd0"][1, 0] = 1e200
    runs = linkage.simulate_batch(**at, **SHORT)
    assert (runs.status == "ok").tolist() == [True, False, True]
    for found in (*runs.constraints.values(), *runs.multipliers.values()):
        assert np.isnan(found[1, 1:]).all() and np.isfinite(found[[0, 2]]).all()
    assert np.isnan(runs.reactions["pin"][1, 1:]).all()


@pytest.mark.parametrize("how", [{"steps": 20, "h": 1e-3}, {"tol": 1e-9}], ids=["fixed", "tol"])
def test_a_start_that_can_not_be_assembled_is_locked_and_leaves_the_others_alone(
    linkage: ModuleType, how: dict[str, Any]
) -> None:
    at, lengths = starts(linkage), np.array([0.4, 3.0, 0.3])  # 3 m are out of reach
    how = how if "h" in how else {**how, "duration": 0.02}
    runs = linkage.simulate_batch(**at, **how, params={"a": lengths})
    assert runs.status.tolist() == ["ok", "locked", "ok"] and "1 locked" in runs.message
    assert runs.steps[1] == 0
    assert np.array_equal(runs.q[1, 0], at["q0"][1]) and np.isnan(runs.q[1, 1:]).all()
    both = {name: x[[0, 2]] for name, x in at.items()}
    others = linkage.simulate_batch(**both, **how, params={"a": lengths[[0, 2]]})
    assert np.array_equal(runs.q[[0, 2]], others.q)
    how = {name: x for name, x in how.items() if name in ("h", "tol")}
    timed = linkage.simulate_batch(**at, **how, times=[0.0, 0.02], params={"a": lengths})
    assert timed.status.tolist() == ["ok", "locked", "ok"]
    for run in (runs, timed):
        q, qd = run([0.0, 0.01])
        assert np.array_equal(q[1, 0], at["q0"][1])
        assert np.isnan(q[1, 1]).all() and np.isnan(qd[1, 1]).all()
        assert np.isfinite(q[[0, 2]]).all()
    alike = linkage.simulate_batch(**at, **how, duration=0.1, params={"a": 3.0})
    assert alike.status.tolist() == ["locked"] * 3


def test_of_unknown_names_those_that_there_are_are_told(linkage: ModuleType) -> None:
    runs = linkage.simulate_batch(steps=1)
    with pytest.raises(KeyError, match=r"multipliers: 'pin' is not one of pin_x, pin_y"):
        runs.multipliers["pin"]
    with pytest.raises(KeyError, match="reactions: 'pins' is not one of pin"):
        runs.reactions["pins"]


def test_without_constraints_there_are_none(modules: Modules) -> None:
    text = 'eomc = 1\nname = "loose"\n[coordinates]\nx = { start = 1 }\n[energy]\n'
    m: Any = modules.unoptimised(text + 'kinetic = "x_dot**2"\n[run]\nbatch = true\n')
    runs = m.simulate_batch(steps=1)
    assert runs.constraints == runs.multipliers == runs.reactions == {}
