"""Constraints, multipliers and reactions of batches, compared with single runs."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.session import Modules

COUNT, STEPS, EVERY = 3, 20, 3
LENGTHS = np.array([0.4, 0.35, 0.3])
SHORT_RUN = {"steps": STEPS, "every": EVERY}
INPUTS: dict[str, Any] = {
    "signals": None,
    "constant": [0.7, 0.1],
    "each": np.array([[0.7, 0.1], [-0.2, 0.2], [0.1, 0.0]]),
    "tables": np.linspace(-1, 1, COUNT * STEPS * 2).reshape(COUNT, STEPS, 2),
    "a table": np.linspace(-1, 1, STEPS * 2).reshape(1, STEPS, 2),
}
# a four-bar with motors at the crank and the rocker, and with friction in these and between them
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
    """Crank at several angles and rates; the other coordinates close the loop."""
    q, qd = (np.tile(x, (COUNT, 1)) for x in m.start)
    q[:, 0] += [0.0, 0.3, -0.2]
    qd[:, 0] += [0.0, 1.0, -2.0]
    return {"q0": q, "qd0": qd}


def inputs_of_instance(u: Any, k: int) -> Any:
    """Return the inputs of instance k."""
    if not isinstance(u, np.ndarray):
        return u
    return u[min(k, len(u) - 1)]


@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.parametrize("params", [{"b": 1.02}, {"a": LENGTHS}], ids=["alike", "each its own"])
def test_instance_has_the_constraint_forces_of_its_single_run(
    linkage: ModuleType, inputs: str, params: dict[str, Any]
) -> None:
    u, initial = INPUTS[inputs], starts(linkage)
    runs = linkage.simulate_batch(**initial, **SHORT_RUN, u=u, params=params)
    rows = runs.q.shape[1]
    assert rows == 8 and (runs.status == "ok").all()
    for columns in (runs.constraints, runs.multipliers):
        assert list(columns) == ["pin_x", "pin_y"]
        assert all(x.shape == (COUNT, rows) for x in columns.values())
    assert runs.reactions["pin"].shape == (COUNT, rows, 3)
    for k in range(COUNT):
        own_params = {name: np.broadcast_to(x, COUNT)[k] for name, x in params.items()}
        single = linkage.simulate(
            initial["q0"][k],
            initial["qd0"][k],
            **SHORT_RUN,
            u=inputs_of_instance(u, k),
            params=own_params,
        )
        for name in ("multipliers", "reactions"):
            for row, values in getattr(single, name).items():
                np.testing.assert_allclose(getattr(runs, name)[row][k], values, 1e-9, 1e-9)
        for values in runs.constraints.values():
            assert np.abs(values[k]).max() < 1e-14
        for j in range(rows):  # at the same rows, bit for bit
            state = runs.q[k, j], runs.qd[k, j], runs.t[j]
            multipliers = linkage.multipliers(*state, u=runs.u[k, j], params=own_params)
            force = linkage.reactions(*state, u=runs.u[k, j], params=own_params)
            residuals = linkage.constraints(*state, params=own_params)
            assert [x[k, j] for x in runs.multipliers.values()] == multipliers.tolist()
            assert [x[k, j] for x in runs.constraints.values()] == residuals.tolist()
            assert np.array_equal(runs.reactions["pin"][k, j], force["pin"])


def test_adaptive_and_saved_batches_have_constraint_forces(
    linkage: ModuleType, tmp_path: Path
) -> None:
    times = [0.0, 0.05, 0.2]
    runs = linkage.simulate_batch(**starts(linkage), tol=1e-9, times=times, params={"a": LENGTHS})
    q0, qd0 = (x[1] for x in starts(linkage).values())
    single = linkage.simulate(q0, qd0, tol=1e-9, times=times, params={"a": LENGTHS[1]})
    for name in ("constraints", "multipliers", "reactions"):
        for row, values in getattr(single, name).items():
            assert np.array_equal(getattr(runs, name)[row][1], values), name
    runs.save(tmp_path / "runs.npz")
    for loaded in (linkage.load_run(tmp_path / "runs.npz"), pickle.loads(pickle.dumps(runs))):
        assert np.array_equal(loaded.multipliers["pin_y"], runs.multipliers["pin_y"])
        assert np.array_equal(loaded.reactions["pin"], runs.reactions["pin"])


def test_rows_after_a_failure_are_nan(linkage: ModuleType) -> None:
    initial = starts(linkage)
    initial["qd0"][1, 0] = 1e200
    runs = linkage.simulate_batch(**initial, **SHORT_RUN)
    assert (runs.status == "ok").tolist() == [True, False, True]
    for column in (*runs.constraints.values(), *runs.multipliers.values()):
        assert np.isnan(column[1, 1:]).all() and np.isfinite(column[[0, 2]]).all()
    assert np.isnan(runs.reactions["pin"][1, 1:]).all()


@pytest.mark.parametrize("options", [{"steps": 20, "h": 1e-3}, {"tol": 1e-9}], ids=["fixed", "tol"])
def test_start_that_cannot_be_assembled_is_locked_and_leaves_the_others_unchanged(
    linkage: ModuleType, options: dict[str, Any]
) -> None:
    initial, lengths = starts(linkage), np.array([0.4, 3.0, 0.3])  # 3 m are out of reach
    options = options if "h" in options else {**options, "duration": 0.02}
    runs = linkage.simulate_batch(**initial, **options, params={"a": lengths})
    assert runs.status.tolist() == ["ok", "locked", "ok"] and "1 locked" in runs.message
    assert runs.steps[1] == 0
    assert np.array_equal(runs.q[1, 0], initial["q0"][1]) and np.isnan(runs.q[1, 1:]).all()
    remaining = {name: x[[0, 2]] for name, x in initial.items()}
    others = linkage.simulate_batch(**remaining, **options, params={"a": lengths[[0, 2]]})
    assert np.array_equal(runs.q[[0, 2]], others.q)
    options = {name: x for name, x in options.items() if name in ("h", "tol")}
    timed = linkage.simulate_batch(**initial, **options, times=[0.0, 0.02], params={"a": lengths})
    assert timed.status.tolist() == ["ok", "locked", "ok"]
    for run in (runs, timed):
        q, qd = run([0.0, 0.01])
        assert np.array_equal(q[1, 0], initial["q0"][1])
        assert np.isnan(q[1, 1]).all() and np.isnan(qd[1, 1]).all()
        assert np.isfinite(q[[0, 2]]).all()
    all_locked = linkage.simulate_batch(**initial, **options, duration=0.1, params={"a": 3.0})
    assert all_locked.status.tolist() == ["locked"] * 3


def test_unknown_names_are_refused_with_the_known_ones(linkage: ModuleType) -> None:
    runs = linkage.simulate_batch(steps=1)
    with pytest.raises(KeyError, match=r"multipliers: 'pin' is not one of pin_x, pin_y"):
        runs.multipliers["pin"]
    with pytest.raises(KeyError, match="reactions: 'pins' is not one of pin"):
        runs.reactions["pins"]


def test_batch_without_constraints_has_none(modules: Modules) -> None:
    text = 'eomc = 1\nname = "loose"\n[coordinates]\nx = { start = 1 }\n[energy]\n'
    m: Any = modules.unoptimised(text + 'kinetic = "x_dot**2"\n[run]\nbatch = true\n')
    runs = m.simulate_batch(steps=1)
    assert runs.constraints == runs.multipliers == runs.reactions == {}
