"""Outputs of runs and states: by name, under any inputs, including the last row."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules, tiers

from eomc.runtime.package import model_of

SCENE = """eomc = 1
name = "crane"
[coordinates]
x = { unit = "m", start = 0.1 }
theta = { unit = "rad", start = 0.5, rate = 0.2 }
[parameters]
m = 1.0
M = 2.0
l = 0.7
g = 9.81
[inputs]
F = { unit = "N", signal = "sin(3*t) - x_dot/5" }
[definitions]
px = "x + l*sin(theta)"
py = "-l*cos(theta)"
[energy]
kinetic = "M*x_dot**2/2 + m*(dot(px)**2 + dot(py)**2)/2"
potential = "m*g*py"
[forces]
x = "F"
[outputs]
tip_x = { formula = "px", unit = "m", note = "of the load" }
speed = "sqrt(dot(px)**2 + dot(py)**2)"
pull = { formula = "m*(cos(theta)*(dot(dot(py)) + g) - sin(theta)*dot(dot(px)))", unit = "N" }
E = "energy"
push = "F*(1 + t)"
cart = "x_ddot"
[run]
linearize = true
batch = true
h = 0.01
duration = 1.0
"""
TABLE = np.linspace(-1, 1, 100)[:, None]
INPUTS = {
    "signals": None,
    "held": [0.3],
    "a row a step": TABLE,
    "a function": lambda t, q, qd: [np.cos(t)],
}


@pytest.fixture(scope="module")
def crane(modules: Modules) -> ModuleType:
    return modules.unoptimised(SCENE)


def evaluate_by_hand(crane: ModuleType, run: Any) -> dict[str, Any]:
    """Return the outputs from hand-written formulas."""
    rows = zip(run.q, run.qd, run.t.tolist(), run.u, strict=True)
    qdd = np.array([crane.acceleration(*row) for row in rows])
    m, length, g = (crane.defaults[name] for name in "mlg")
    (x, theta), (v, w), (a, alpha) = run.q.T, run.qd.T, qdd.T
    dx, dy = length * np.sin(theta), length * np.cos(theta)
    ax, ay = a + dy * alpha - dx * w**2, dx * alpha + dy * w**2
    return {
        "tip_x": x + dx,
        "speed": np.hypot(v + dy * w, dx * w),
        "pull": m * (np.cos(theta) * (ay + g) - np.sin(theta) * ax),
        "E": run.energy,
        "push": run.u[:, 0] * (1 + run.t),
        "cart": a,
    }


@pytest.mark.parametrize("every", tiers([1, 7], 7))
@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.filterwarnings("ignore:.*Python function")
def test_run_has_outputs_by_name(crane: ModuleType, inputs: str, every: int) -> None:
    run = crane.simulate(u=INPUTS[inputs], every=every)
    assert list(run.outputs) == list(crane.outputs)
    for name, values in evaluate_by_hand(crane, run).items():
        assert run.outputs[name].shape == run.t.shape
        assert run.outputs[name] == pytest.approx(values, rel=1e-12, abs=1e-12), name


@pytest.mark.filterwarnings("ignore:.*Python function")
def test_inputs_of_a_run_are_those_applied(crane: ModuleType) -> None:
    rows = np.minimum(7 * np.arange(16), 99)
    run = crane.simulate(u=TABLE, every=7)
    assert np.array_equal(run.u, TABLE[rows])
    run = crane.simulate(u=INPUTS["a function"], every=7)
    assert run.u[:-1, 0] == pytest.approx(np.cos(run.t[:-1]), abs=1e-15)
    assert run.u[-1, 0] == pytest.approx(np.cos(0.99))  # during the last step
    loaded = pickle.loads(pickle.dumps(run))
    assert np.array_equal(loaded.u, run.u) and np.array_equal(
        loaded.outputs["pull"], run.outputs["pull"]
    )
    run = crane.simulate()
    signals = np.sin(3 * run.t) - run.qd[:, 0] / 5
    assert run.u[:, 0] == pytest.approx(signals, abs=1e-15)
    assert np.array_equal(crane.simulate(u=[0.3]).u, np.full((101, 1), 0.3))


@pytest.mark.parametrize("u", [None, [0.3], np.linspace(-1, 1, 60).reshape(3, 20, 1)])
def test_batch_has_outputs(crane: ModuleType, u: Any) -> None:
    length = np.array([0.7, 0.8, 0.0])  # the last instance has no acceleration
    q0, qd0 = (np.tile(x, (3, 1)) for x in crane.start)
    runs = crane.simulate_batch(q0, qd0, steps=20, every=3, params={"l": length}, u=u)
    for k in range(2):
        row = u[k] if isinstance(u, np.ndarray) else u
        run = crane.simulate(steps=20, every=3, params={"l": length[k]}, u=row)
        for name, values in run.outputs.items():
            assert runs.outputs[name][k] == pytest.approx(values, rel=1e-9, abs=1e-12), name
    assert np.isnan(runs.outputs["pull"][2]).all() and np.isnan(runs["tip_x"][2, 1:]).all()


def test_outputs_are_columns_of_a_run(crane: ModuleType, tmp_path: Path) -> None:
    run = crane.simulate(steps=10)
    assert np.array_equal(run["pull"], run.outputs["pull"]) and run.E is run.outputs["E"]
    assert list(run.to_dict())[-7:] == [*crane.outputs, "energy"]
    run.save(tmp_path / "run.csv")
    header, first, *_ = (tmp_path / "run.csv").read_text(encoding="utf-8").splitlines()
    columns = dict(zip(header.split(","), map(float, first.split(",")), strict=True))
    assert columns["cart"] == run.outputs["cart"][0]
    run.save(tmp_path / "run.npz")
    loaded = crane.load_run(tmp_path / "run.npz")
    assert np.array_equal(loaded.outputs["pull"], run.outputs["pull"])


def test_outputs_of_one_state_and_of_many(crane: ModuleType) -> None:
    q, qd = crane.start
    single = crane.output(q, qd, 0.3, [0.2], {"l": 0.9})
    several = crane.output(np.array([q, 2 * q]), np.array([qd, qd]), 0.3, [0.2], {"l": 0.9})
    assert np.array_equal(several[0], single) and not np.array_equal(several[1], single)
    assert single[0] == pytest.approx(0.1 + 0.9 * np.sin(0.5)) and single[4] == pytest.approx(0.26)
    assert crane.units["tip_x"] == "m" and crane.units["pull"] == "N"


def test_outputs_are_nan_without_acceleration(crane: ModuleType) -> None:
    outputs = dict(
        zip(crane.outputs, crane.output(*crane.start, 0, [0.0], {"l": 0.0}), strict=True)
    )
    assert np.isnan(outputs["pull"]) and np.isnan(outputs["cart"])
    assert outputs["tip_x"] == pytest.approx(0.1) and outputs["push"] == 0


def test_linearized_outputs_equal_difference_quotients(crane: ModuleType) -> None:
    q, qd = (np.array(x) for x in crane.start)
    A, B, C, D = crane.linearize(q, qd, u=[0.4], outputs=True)
    assert C.shape == (6, 4) and D.shape == (6, 1)
    x, e = np.hstack([q, qd]), 1e-6

    def difference_quotient(function: Any) -> Any:
        return (function(e) - function(-e)) / (2 * e)

    for k in range(4):
        expected = difference_quotient(
            lambda d, k=k: crane.output(*np.split(x + d * np.eye(4)[k], 2), u=[0.4])
        )
        assert C[:, k] == pytest.approx(expected, abs=1e-7)
    assert D[:, 0] == pytest.approx(
        difference_quotient(lambda d: crane.output(q, qd, u=[0.4 + d])), abs=1e-7
    )
    assert all(
        np.array_equal(a, b) for a, b in zip((A, B), crane.linearize(q, qd, u=[0.4]), strict=True)
    )


@pytest.mark.parametrize("options", [{"outputs": "tip_x"}, {"outputs": ["E"]}, {"closed": "no"}])
def test_name_is_not_accepted_as_true(crane: ModuleType, options: Any) -> None:
    with pytest.raises(ValueError, match=r"(outputs|closed): .* is not True or False"):
        crane.linearize(*crane.start, **options)


def test_scene_without_outputs_has_none_of_their_code(
    cartpole: ModuleType, crane: ModuleType
) -> None:
    assert cartpole.outputs == () and cartpole.simulate(steps=3).outputs == {}
    assert not hasattr(model_of(cartpole).c.lib, "outputs") and hasattr(
        model_of(crane).c.lib, "outputs"
    )
    with pytest.raises(ValueError, match=r"name them in \[outputs\]"):
        cartpole.output(*cartpole.start)


def test_states_of_a_run_have_their_own_times_inputs_and_parameters(crane: ModuleType) -> None:
    run = crane.simulate(u=TABLE)
    states = (run.q, run.qd, run.t, run.u)
    values = crane.output(*states)
    assert np.array_equal(values, np.column_stack([*run.outputs.values()]))
    assert np.array_equal(crane.acceleration(*states)[:, 0], run["cart"])
    assert np.array_equal(crane.tau(*states)[:, 0], run["F"])
    assert np.array_equal(crane.power(*states), run["F"] * run["x_dot"])
    assert np.array_equal(crane.applied(*states), run.u)
    lengths = np.linspace(0.5, 1.0, len(run))
    values_by_length = crane.output(run.q, run.qd, run.t, {"F": run["F"]}, params={"l": lengths})
    single = crane.output(*(x[-1] for x in states), params={"l": lengths[-1]})
    assert np.array_equal(values_by_length[-1], single) and not np.array_equal(
        values_by_length[0], values[0]
    )
    np.testing.assert_allclose(
        crane.potential_energy(run.q, params={"l": lengths}),
        -9.81 * lengths * np.cos(run["theta"]),
        rtol=1e-15,
    )
    assert crane.output(*(x[:0] for x in states)).shape == (0, 6)
    with pytest.raises(ValueError, match=r"u: shape \(100, 1\), expected \(101, 1\) for 101 st"):
        crane.power(run.q, run.qd, run.t, TABLE)
