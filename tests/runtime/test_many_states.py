"""Functions of many states with inputs, times and parameters per state: one call of C."""

from __future__ import annotations

import inspect
from collections import Counter
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.runtime.package import model_of

SCENE = """
eomc = 1
name = "crank"
gravity = [0, "-g"]
[coordinates]
q1 = { unit = "rad", start = 0.5, rate = 2.0 }
q2 = { unit = "rad", start = 0.7, guess = true }
q3 = { unit = "rad", start = 1.6, guess = true }
[parameters]
a = 0.4
m = 0.6
most = 0.5
g = 9.81
[[body]]
name = "crank"
joint = "revolute"
coordinates = "q1"
mass = "m"
center = ["a/2", 0]
inertia = "m*a**2/12"
[[body]]
name = "coupler"
parent = "crank"
joint = "revolute"
coordinates = "q2 - q1"
offset = ["a", 0]
mass = 1.5
center = [0.5, 0]
inertia = 0.125
[[body]]
name = "rocker"
joint = "revolute"
coordinates = "q3"
offset = [0.9, 0]
mass = 1.1
center = [0.4, 0]
inertia = 0.06
[[loop]]
name = "pin"
joint = "revolute"
bodies = ["coupler", "rocker"]
points = [[1, 0], [0.8, 0]]
[inputs]
push = { signal = "sin(2*t) - 0.1*q1_dot", limits = ["-most", "most"] }
[forces]
q1 = "push - 0.1*q1_dot"
[outputs]
rate = "q1_ddot + push"
height = "a*sin(q1)*t"
[run]
h = 0.005
frames = true
inverse_dynamics = true
momentum = true
linearize = "parameters"
discretize = true
batch = true
"""
FUNCTIONS = (
    "D C g bias tau kinetic_energy potential_energy energy jacobi power signal applied output "
    "acceleration linearize sensitivity discretize pose frame_velocity frame_acceleration jacobian "
    "frame_forces inverse_dynamics momentum drive_forces constraints constraint_rates "
    "constraint_jacobian tangent multipliers reactions project"
).split()
COUNT = 5


@pytest.fixture(
    scope="module",
    params=["double", pytest.param("float", marks=pytest.mark.slow)],
)
def crank(request: pytest.FixtureRequest, modules: Modules) -> ModuleType:
    real = f'real = "{request.param}"\n' if request.param != "double" else ""
    return modules.unoptimised(SCENE + real)


class CountedCalls:
    """The C functions of a module, which count the calls of each."""

    def __init__(self, lib: Any) -> None:
        self._lib, self.counts = lib, Counter[str]()

    def __getattr__(self, name: str) -> Any:
        return partial(self._called, name, getattr(self._lib, name))

    def _called(self, name: str, function: Any, *arguments: Any) -> Any:
        self.counts[name] += 1
        return function(*arguments)


@pytest.fixture
def calls(crank: ModuleType, monkeypatch: pytest.MonkeyPatch) -> CountedCalls:
    model: Any = model_of(crank)
    counted = CountedCalls(model.c.lib)
    monkeypatch.setattr(model.c, "lib", counted)
    monkeypatch.setattr(model.functions, "c_functions", {})
    return counted


def arguments(m: ModuleType, function: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return arguments of a function for COUNT states: shared ones, and those per state."""
    random = np.random.default_rng(3)
    q, qd = (x + 0.05 * random.standard_normal((COUNT, 3)) for x in m.start)
    q, qd = m.project(q, qd, params={"a": 0.41})
    each = {
        "q": q, "qd": qd, "qdd": m.acceleration(q, qd),
        "t": np.linspace(0, 1, COUNT), "u": random.standard_normal((COUNT, 1)),
        "params": {"m": 0.5 + random.random(COUNT), "most": 0.1 + random.random(COUNT)},
    }  # fmt: skip
    shared = {"wrenches": np.ones((3, 3))}
    accepted = inspect.signature(getattr(m, function)).parameters
    return (
        {name: x for name, x in shared.items() if name in accepted},
        {name: x for name, x in each.items() if name in accepted},
    )


def as_list(result: Any) -> list[Any]:
    if isinstance(result, dict):
        return list(result.values())
    return list(result) if isinstance(result, tuple) else [result]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_each_state_has_the_values_of_a_single_call(crank: ModuleType, function: str) -> None:
    call, (shared, each) = getattr(crank, function), arguments(crank, function)
    for omitted in ((), ("u",), ("t", "params")):
        arguments_used = {name: x for name, x in each.items() if name not in omitted}
        values = as_list(call(**shared, **arguments_used))
        for k in range(COUNT):
            single = {
                name: {n: v[k] for n, v in x.items()} if name == "params" else x[k]
                for name, x in arguments_used.items()
            }
            # linear algebra may round differently for several matrices at once
            tolerance = 1e3 * np.finfo(crank.dtype).eps * (function in ("drive_forces", "tangent"))
            for a, b in zip(values, as_list(call(**shared, **single)), strict=True):
                np.testing.assert_allclose(a[k], b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_all_states_are_evaluated_in_one_call(
    crank: ModuleType, function: str, calls: CountedCalls
) -> None:
    shared, each = arguments(crank, function)
    calls.counts.clear()
    getattr(crank, function)(**shared, **each)
    assert set(calls.counts.values()) == {1}


def test_ten_steps_of_a_control_period_are_one_call(crank: ModuleType, calls: CountedCalls) -> None:
    _, each = arguments(crank, "discretize")
    calls.counts.clear()
    Phi, Gamma = crank.discretize(**each, h=1e-3, control_period=1e-2)
    assert calls.counts == {"rk4_derivative": 1}
    q, qd = each["q"], each["qd"]
    expected = np.broadcast_to(np.eye(6), (COUNT, 6, 6)), np.zeros((COUNT, 6, 1))
    for step in range(10):
        arguments_of_step = each | {"q": q, "qd": qd, "t": each["t"] + 1e-3 * step}
        A, B = crank.discretize(**arguments_of_step, h=1e-3)
        expected = A @ expected[0], A @ expected[1] + B
        crank.step_batch(q, qd, 1e-3, params=each["params"], u=each["u"])
    eps = float(np.finfo(crank.dtype).eps)
    np.testing.assert_allclose(Phi, expected[0], rtol=0, atol=1e3 * eps)
    np.testing.assert_allclose(Gamma, expected[1], rtol=0, atol=1e3 * eps)


def test_columns_of_a_batch_equal_those_of_its_runs(crank: ModuleType, calls: CountedCalls) -> None:
    q, qd = (np.tile(x, (3, 1)) for x in crank.start)
    u = 2 * np.random.default_rng(7).standard_normal((3, 8, 1))
    p = {"m": np.array([0.5, 0.6, 0.7]), "most": np.array([0.3, 0.6, 0.9])}
    for inputs in (u, None):
        batch = crank.simulate_batch(q, qd, steps=8, u=inputs, params=p)
        names = ("energy", "u", "saturated", "outputs", "constraints", "multipliers", "reactions")
        for name in names:
            calls.counts.clear()
            column = getattr(batch, name)
            assert max(calls.counts.values(), default=0) <= 2, name
            for k in range(3):
                params = {n: float(v[k]) for n, v in p.items()}
                run = crank.simulate(steps=8, u=None if inputs is None else u[k], params=params)
                pairs = zip(as_list(column), as_list(getattr(run, name)), strict=True)
                for a, b in pairs:
                    scale = np.max(np.abs(b), initial=1.0)
                    tolerance = 1e4 * float(np.finfo(crank.dtype).eps) * scale
                    np.testing.assert_allclose(a[k], b, rtol=0, atol=tolerance, err_msg=name)


def test_rows_of_a_run_are_evaluated_in_one_call(crank: ModuleType, calls: CountedCalls) -> None:
    run = crank.simulate(steps=8, u=np.linspace(-1, 1, 8)[:, None])
    for name in ("energy", "outputs", "multipliers", "saturated"):
        calls.counts.clear()
        getattr(run, name)
        assert max(calls.counts.values()) <= 2, name  # `applied` at both limits


def test_invalid_row_is_named(crank: ModuleType) -> None:
    q, qd = (np.tile(x, (3, 1)) for x in crank.start)
    invalid = np.array([1.0, 2.0, np.nan])
    with pytest.raises(ValueError, match=r"t: nan is not a finite number, at \[2\]"):
        crank.energy(q, qd, t=invalid)
    with pytest.raises(ValueError, match=r"params: m is not finite everywhere: nan, at \[2\]"):
        crank.D(q, params={"m": invalid})
    with pytest.raises(ValueError, match=r"u\[2, 0\]: nan in float"):
        crank.tau(q, qd, u=invalid[:, None])
    with pytest.raises(ValueError, match=r"params: m: shape \(2,\), expected \(3,\) for 3 states"):
        crank.D(q, params={"m": invalid[:2]})
    with pytest.raises(ValueError, match=r"t: shape \(2,\), expected one number or \(3,\)"):
        crank.project(q, qd, invalid[:2])


def test_zero_states_have_zero_values(crank: ModuleType) -> None:
    empty = np.empty((0, 3))
    assert crank.D(empty, t=np.empty(0), params={"m": np.empty(0)}).shape == (0, 3, 3)
    assert crank.acceleration(empty, empty, np.empty(0), np.empty((0, 1))).shape == (0, 3)


def test_outputs_with_accelerations_take_any_number_of_states(crank: ModuleType) -> None:
    """The accelerations are stored in an array for one state."""
    q, qd = (np.tile(x, (5_000, 1)) for x in crank.start)
    assert np.array_equal(crank.output(q, qd), np.tile(crank.output(*crank.start), (5_000, 1)))
