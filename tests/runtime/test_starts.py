"""Initial states: formulas of the parameters passed to a run, and values by name."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import sympy
from support.session import Modules

import eomc
from eomc.base.errors import EomcError
from eomc.runtime import requests
from eomc.scene import formulas
from eomc.scene.read import parse
from eomc.scene.scene import Scene

TEXT = """eomc = 1
name = "hangs"
[coordinates]
r = { start = "l0 - sag*m*g/k + below", rate = "min(v, 2, 1 + v)*heaviside(k)/abs(below)" }
theta = { start = "atan2(v, k) + max(sin(pi*v), -l0)**2", rate = 0.2 }
x = { start = "2*l0" }
[constants]
below = -0.25
sag = "-1"
[parameters]
m = 1
k = 30
l0 = 1
g = 9.81
v = 0.5
load = 2
[energy]
kinetic = "(m + load)*(r_dot**2 + r**2*theta_dot**2 + x_dot**2)/2"
potential = "k*(r - l0)**2/2 - m*g*r*cos(theta) + x**2"
[[event]]
name = "drops"
when = "t - 5"
action = "jump"
load = "m"
[run]
h = 0.01
duration = 0.1
tolerance = 1e-9
batch = true
"""
BATCH_PARAMS = {"k": np.array([30.0, 20.0, 50.0]), "v": np.array([0.5, 0.0, -1.0])}


@pytest.fixture(scope="module")
def hangs(modules: Modules) -> ModuleType:
    return modules.unoptimised(TEXT)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return parse(TEXT, "hangs.toml")


@pytest.mark.parametrize("options", [{}, {"h": 0.01}])
def test_run_starts_at_the_values_of_its_parameters(
    hangs: ModuleType, scene: Scene, options: dict
) -> None:
    for params in ({"k": 60.0}, {"v": -3.0, "l0": 2.0}, {"m": 2.0, "load": 3.0}, {}):
        constants = {k: x for k, x in params.items() if k != "load"}  # a jump sets it: it is in q0
        q, qd = scene.start(params)
        for values in (constants, hangs.Params(**constants)):
            run = hangs.simulate(params=values, **options)
            np.testing.assert_allclose(run.q[0, :3], q, rtol=1e-15)
            np.testing.assert_allclose(run.qd[0, :3], qd, rtol=1e-15)
    start = [0.1, 0.2, 0.3, 2]
    run = hangs.simulate(start, params={"k": 60.0, "v": 1.0}, **options)
    assert run.q[0].tolist() == start and run.qd[0, 0] == scene.start({"v": 1.0})[1][0]


@pytest.mark.parametrize("options", [{}, {"h": 0.01}])
def test_each_instance_starts_at_the_values_of_its_parameters(
    hangs: ModuleType, scene: Scene, options: dict
) -> None:
    runs = hangs.simulate_batch(params=BATCH_PARAMS, **options)
    for k in range(3):
        q, qd = scene.start({name: float(values[k]) for name, values in BATCH_PARAMS.items()})
        np.testing.assert_allclose(runs.q[k, 0, :3], q, rtol=1e-15)
        np.testing.assert_allclose(runs.qd[k, 0, :3], qd, rtol=1e-15)
    # its parameters are those of the scene: equal bit for bit
    assert (runs.q[0, 0] == hangs.start[0]).all()


# --- by name --------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"h": 0.01}, {"h": 0.01, "times": [0.0, 0.05]}])
def test_values_by_name_leave_the_others_at_those_of_the_scene(
    hangs: ModuleType, scene: Scene, options: dict
) -> None:
    params = {"k": 60.0, "v": 1.5}
    q, qd = scene.start(params)
    run = hangs.simulate({"x": 0.5}, {"theta": 0.7, "r_dot": 0.1}, params=params, **options)
    assert run.q[0] == pytest.approx([*q[:2], 0.5, 2.0], rel=1e-15)  # a jump sets the last one
    assert run.qd[0] == pytest.approx([0.1, 0.7, *qd[2:], 0.0], rel=1e-15)
    run = hangs.simulate({sympy.Symbol("load"): 3.0, "r": 2}, **options)
    assert run.q[0].tolist() == [2.0, *hangs.start[0][1:3], 3.0]
    assert run.qd[0].tolist() == hangs.start[1].tolist()


@pytest.mark.parametrize("options", [{}, {"h": 0.01}])
def test_values_by_name_for_each_instance(hangs: ModuleType, scene: Scene, options: dict) -> None:
    runs = hangs.simulate_batch({"x": [1.0, 2.0, 3.0]}, {"x": 0.5}, params=BATCH_PARAMS, **options)
    for k in range(3):
        q, qd = scene.start({name: float(values[k]) for name, values in BATCH_PARAMS.items()})
        assert runs.q[k, 0] == pytest.approx([*q[:2], k + 1.0, 2.0], rel=1e-15)
        assert runs.qd[k, 0] == pytest.approx([*qd[:2], 0.5, 0.0], rel=1e-15)
    runs = hangs.simulate_batch({"x": 4.0}, {"theta": np.array([0.1, 0.2])}, **options)
    assert runs.q[:, 0, 2].tolist() == [4.0, 4.0] and runs.qd[:, 0, 1].tolist() == [0.1, 0.2]
    assert len(hangs.simulate_batch({"x": 4.0}, **options)) == 1


def test_formula_is_not_evaluated_for_a_value_passed_by_name(hangs: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"params: the start of r, .* is not finite"):
        hangs.simulate({"x": 1.0}, params={"k": 0.0}, steps=1, h=0.01)
    assert hangs.simulate({"r": 1.0}, params={"k": 0.0}, steps=1, h=0.01).q[0, 0] == 1.0


def test_other_functions_accept_starts_by_name(hangs: ModuleType) -> None:
    q, qd = hangs.start
    q[2], qd[1] = 0.5, 0.7
    assert hangs.advice({"x": 0.5}, {"theta": 0.7}, h=10.0) == hangs.advice(q, qd, h=10.0)
    equilibrium = hangs.equilibrium({"x": 0.0, "theta": 0.0}, {"theta": 0.7}, free=["r"])
    assert equilibrium.q[1:].tolist() == [0.0, 0.0, 2.0] and equilibrium.qd.tolist() == [
        0.0,
        0.7,
        0.0,
        0.0,
    ]
    # k (r - l0) - m g - (m + load) r theta_dot^2 = 0
    assert equilibrium.q[0] == pytest.approx((30 + 9.81) / (30 - 3 * 0.49), rel=1e-12)


@pytest.mark.parametrize(
    ("q0", "qd0", "message"),
    [
        ({"z": 1.0}, None, r"^q0: 'z' is not one of r, theta, x, load"),
        ({"Theta": 1.0}, None, r"^q0: .*did you mean 'theta'"),
        ({"x_dot": 1.0}, None, r"^q0: 'x_dot' is a velocity: give it in qd0"),
        (None, {"load": 1.0}, r"^qd0: 'load' is not one of r, theta, x$"),
        (None, {"x": 1.0, "x_dot": 1.0}, r"^qd0: 'x' is given twice, as 'x' and as 'x_dot'"),
        ({"x": "1"}, None, r"^q0: x: '1' is not a number"),
        ({"x": float("nan")}, None, r"^q0: x: nan is not a finite number"),
        ({"x": [1.0, 2.0]}, None, r"^q0: x: \[1.0, 2.0\] is not a number"),
    ],
)
def test_invalid_names_and_values_are_refused(
    hangs: ModuleType, q0: dict, qd0: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        hangs.simulate(q0, qd0, steps=1)


@pytest.mark.parametrize(
    ("q0", "qd0", "params", "message"),
    [
        ({"x": [1.0, 2.0]}, {"x": [1.0, 2.0, 3.0]}, None, "qd0: x: 3 .* where q0: x has 2"),
        ({"x": [1.0, 2.0]}, None, BATCH_PARAMS, "q0: x: 2 instances where params has 3"),
        ({"x": [1.0, np.inf]}, None, None, "q0: x: not all numbers are finite"),
        ({"x": [[1.0]]}, None, None, "q0: x: .* is not a number"),
        ({"x": [1.0, 2.0]}, np.zeros((3, 4)), None, "qd0: 3 instances where q0 has 2"),
    ],
)
def test_values_of_other_batch_sizes_are_refused(
    hangs: ModuleType, q0: dict, qd0: object, params: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        hangs.simulate_batch(q0, qd0, params=params, steps=1, h=0.01)


def test_start_by_name_is_assembled(modules: Modules) -> None:
    rod = modules("pendulum_xy")
    by_name, array = rod.simulate({"x": 0.6}, steps=1), rod.start[0]
    array[0] = 0.6
    assert by_name == rod.simulate(array, rod.start[1], steps=1)


# --- formulas without a value ---------------------------------------------------------------------


def test_start_that_is_not_finite_is_refused(hangs: ModuleType, scene: Scene) -> None:
    with pytest.raises(EomcError):
        scene.start({"k": 0.0})
    for simulate in (hangs.simulate, hangs.simulate_batch):
        with pytest.raises(ValueError, match=r"the start of r, .*, is not finite there: give q0"):
            simulate(params={"k": 0.0})
        assert simulate([1.0, 0.0, 0.0], params={"k": 0.0}).qd.flat[0] == 1.0


def test_start_under_constraints_is_assembled(modules: Modules) -> None:
    bob = modules("pendulum_xy")
    run = bob.simulate(params={"l": 1.5}, steps=2)
    assert run["y"][0] == -1.5 and bob.simulate(steps=2)["y"][0] == -0.8


@pytest.mark.usefixtures("quickly_compiled")
def test_starts_of_a_system_from_python(tmp_path: Path) -> None:
    r, lam, k = sympy.Symbol("r"), sympy.Symbol("lambda"), sympy.Symbol("k")
    system = eomc.System.make(
        "made_hangs",
        {"x": ("1 - k/lambda_1", "-k"), r: sympy.Max(lam, k) / sympy.sec(k) + sympy.E, "y": "pi/2"},
        "(x_dot**2 + r_dot**2 + y_dot**2)/2",
        k * r**2 + sympy.Symbol("load"),
        parameters={lam: 4, k: 2, "load": 3},
        events={"drops": {"when": "y - 9", "action": "jump", "load": 1}},
    )
    module = eomc.load(system, tmp_path)
    e, half = np.e, np.pi / 2
    assert module.start[0] == pytest.approx([0.5, 4 * np.cos(2) + e, half, 3], rel=1e-15)
    run = module.simulate(steps=1, params={"k": 8.0})
    assert run.q[0] == pytest.approx([-1, 8 * np.cos(8) + e, half, 3], rel=1e-15)
    assert run.qd[0].tolist() == [-8, 0, 0, 0]


def test_starts_support_all_functions_of_formulas() -> None:
    """A built module imports nothing of eomc, so it has its own table of functions."""
    assert {*requests._FUNCTIONS} == {*formulas.FUNCTIONS} - {"dot"}
