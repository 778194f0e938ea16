"""Parameters that jumps set (discrete variables), against SciPy between the jumps."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from support.session import Modules, tiers

import eomc
from eomc.base.errors import SceneError
from eomc.mechanism.assembly import assembled
from eomc.model.hybrid import with_constant_parameters
from eomc.model.system import System, from_scene
from eomc.report.equations_text import write_equations
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify.check import check
from eomc.verify.reference import MATRICES, VECTORS
from eomc.verify.symbolic import reference_for
from eomc.verify.taylor import TaylorReference

GRIPPER = """eomc = 1
name = "gripper"
[coordinates]
x = { rate = 1.0 }
theta = { start = 0.3 }
[parameters]
m = { value = 1.0, unit = "kg", note = "of the cart, and what it has gripped" }
m_p = 0.3
l = 0.5
g = 9.81
k = 4.0
on = 1.0
[inputs]
u = { unit = "N", signal = "2*sin(3*t)" }
[definitions]
px = "x + l*sin(theta)"
py = "-l*cos(theta)"
[energy]
kinetic = "m*x_dot**2/2 + m_p*(dot(px)**2 + dot(py)**2)/2"
potential = "m_p*g*py + k*x**2/2"
[forces]
x = "on*u"
[outputs]
ax = "dot(dot(px))"
stored = "k*x**2/2"
[[event]]
name = "grips"
when = "x - 0.2"
direction = "rising"
action = "jump"
m = "m + 0.5"
x_dot = "x_dot*m/(m + 0.5)"
[[event]]
name = "cutoff"
when = "t - 3"
action = "jump"
on = 0
k = "2*k"
l = "0.9*l"
[run]
tolerance = 1e-12
duration = 5.0
h = 0.01
linearize = true
batch = true
"""
CUTOFF = 3.0


@pytest.fixture(scope="module")
def gripper(modules: Modules) -> ModuleType:
    return modules.unoptimised(GRIPPER)


def state_derivative(
    t: float, x: np.ndarray, m: float, rod: float, k: float, on: float
) -> list[float]:
    """Equations of the gripper, derived by hand."""
    x_cart, angle, v, w = x
    c, s = np.cos(angle), np.sin(angle)
    D = np.array([[m + 0.3, 0.3 * rod * c], [0.3 * rod * c, 0.3 * rod * rod]])
    b = [on * 2 * np.sin(3 * t) - k * x_cart + 0.3 * rod * s * w * w, -0.3 * 9.81 * rod * s]
    return [v, w, *np.linalg.solve(D, b)]


def gripping_event(t: float, x: np.ndarray, *_: float) -> float:
    return float(x[0] - 0.2)


gripping_event.direction, gripping_event.terminal = 1, True  # type: ignore[attr-defined]


def solve_with_scipy(m: float) -> tuple[np.ndarray, list[float]]:
    """Return x, theta and their velocities at 5 s, and the times of gripping."""
    t, x, times = 0.0, np.array([0.0, 0.3, 1.0, 0.0]), list[float]()
    values = [m, 0.5, 4.0, 1.0]

    def integrate(end: float, **options: object) -> object:
        return solve_ivp(
            state_derivative, (t, end), x, "DOP853", args=values, rtol=1e-12, atol=1e-13, **options
        )

    while t < 5:
        solution = integrate(CUTOFF if t < CUTOFF else 5.0, events=gripping_event)
        t, x = solution.t[-1], solution.y[:, -1]
        if solution.status == 1:
            times.append(t)
            x = x * [1, 1, values[0] / (values[0] + 0.5), 1]
            values[0] += 0.5
            solution = integrate(t + 1e-3)  # off the zero
            t, x = solution.t[-1], solution.y[:, -1]
        elif t == CUTOFF:
            values[1:] = [0.9 * 0.5, 8.0, 0.0]
    return x, times


@pytest.mark.parametrize("m", [1.0, 2.3])
def test_mass_length_stiffness_and_drive_change_as_in_scipy(gripper: ModuleType, m: float) -> None:
    x, times = solve_with_scipy(m)
    run = gripper.simulate(q0=[0, 0.3, m, 0.5, 4, 1])
    indices = [0, 1, 6, 7]
    assert run.status == "ok" and len(times) >= 1
    np.testing.assert_allclose(run.x[-1][indices], x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.events["grips"].t, times, rtol=0, atol=1e-11)
    assert run.q[-1, 2:].tolist() == [m + 0.5 * len(times), 0.45, 8, 0]
    assert not run.qd[:, 2:].any()


def test_discrete_values_are_columns_of_the_run(gripper: ModuleType) -> None:
    run = gripper.simulate()
    assert gripper.coordinates == ("x", "theta", "m", "l", "k", "on")
    assert model_of(gripper).info.discrete_coordinates == ("m", "l", "k", "on")
    assert gripper.parameters == ("m_p", "g") and gripper.units["m"] == "kg"
    before_cutoff = run.t < CUTOFF
    assert set(run["k"][before_cutoff]) == {4.0} and run["k"][-1] == 8.0
    np.testing.assert_allclose(run["stored"], run["k"] * run["x"] ** 2 / 2, rtol=1e-15)
    times = np.array([0, 2.0, 4.0])
    assert gripper.simulate(times=times)["on"].tolist() == [1, 1, 0]


def test_starts_without_discrete_values_use_those_of_the_scene(gripper: ModuleType) -> None:
    run = gripper.simulate(q0=[0, 0.3], qd0=[1, 0])
    assert np.array_equal(run.q, gripper.simulate().q)
    q0 = np.tile([0, 0.3], (3, 1))
    batch = gripper.simulate_batch(q0, np.tile([1.0, 0], (3, 1)), tol=1e-12)
    assert np.array_equal(batch.q[:, -1], np.tile(run.q[-1], (3, 1)))
    message = r"a jump sets 'm', so it is a state .*: give it in q0, \[x, theta, m, l, k, on\], or"
    for simulate in (gripper.simulate, gripper.simulate_batch):
        with pytest.raises(ValueError, match=f"params: {message}"):
            simulate(params={"m": 2.0})
    with pytest.raises(TypeError, match=f"no argument 'm': {message}"):
        gripper.simulate(m=2.0)


def test_discrete_values_have_no_dynamics(gripper: ModuleType) -> None:
    """D, C, g and accelerations equal those of a system in which they are parameters."""
    random = np.random.default_rng(5)
    system = from_scene(parse(GRIPPER, "gripper.toml"))
    q, qd = random.uniform(0.5, 1.5, (2, 6))
    D, C = gripper.D(q), gripper.C(q, qd)
    assert np.array_equal(D[2:, 2:], np.eye(4)) and not D[:2, 2:].any() and not D[2:, :2].any()
    assert not C[2:].any() and not C[:, 2:].any() and not gripper.g(q)[2:].any()
    assert not gripper.acceleration(q, qd)[2:].any()
    A = gripper.linearize(q, qd)[0]
    assert A[6, 2] != 0 and not A[8:].any()  # they affect others, and nothing affects them
    core = with_constant_parameters(system)
    assert [c.name for c in core.coordinates] == ["x", "theta"]
    assert {p.name: p.value for p in core.parameters}["l"] == 0.5
    assert "q = (x, theta)" in write_equations(system)


MARKED = """eomc = 1
name = "arm_drop"
gravity = [0, -9.81, 0]
[coordinates]
a = { unit = "rad", start = 0.5 }
b = { unit = "rad", start = 0.2 }
[parameters]
l = 0.5
load = 2.0
[[body]]
name = "one"
joint = "revolute"
coordinates = "a"
axis = [0, 0, 1]
mass = 1
center = ["l/2", 0, 0]
inertia = [0.001, 0.02, 0.02]
[[body]]
name = "two"
parent = "one"
joint = "revolute"
coordinates = "b"
axis = [0, 1, 0]
offset = ["l", 0, 0]
mass = "0.4 + load"
center = ["l/3", 0, 0]
inertia = [0.01, "0.01 + load*l**2/100", 0.02]
[[event]]
name = "drop"
when = "t - 1"
action = "jump"
load = 0.0
l = "l*1.1"
[run]
tolerance = 1e-9
duration = 3.0
momentum = true
inverse_dynamics = true
frames = true
"""
ROD = """eomc = 1
name = "reeled"
[coordinates]
x = { start = 0.0, rate = 4.0 }
y = { start = "-l", guess = true }
[parameters]
m = 1.3
l = 0.8
mu = 0.2
[constraints]
rod = "x**2 + y**2 - l**2"
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "m*9.81*y"
[forces]
x = "-mu*x_dot"
[[event]]
name = "reels"
when = "t - 1"
action = "jump"
l = "0.9*l"
x = "0.9*x"
y = "0.9*y"
[run]
tolerance = 1e-10
duration = 2.0
"""
GREASED = """eomc = 1
name = "greased"
[coordinates]
x = { rate = 1.0, friction = "mu*m*9.81" }
th = { start = 0.5 }
[parameters]
m = 1.0
mu = 0.3
l = 0.4
[energy]
kinetic = "m*x_dot**2/2 + 0.1*(x_dot**2 + 2*x_dot*l*th_dot*cos(th) + l**2*th_dot**2)"
potential = "10*x**2 - 0.2*9.81*l*cos(th)"
[[event]]
name = "grease"
when = "t - 0.7"
action = "jump"
mu = "mu/4"
[run]
friction = "stick"
tolerance = 1e-9
duration = 3.0
"""


@pytest.mark.slow
@pytest.mark.parametrize("text", [GRIPPER, MARKED, ROD, GREASED], ids=lambda x: x.split('"')[1])
def test_check_compares_discrete_values_with_constants(text: str, tmp_path: Path) -> None:
    system = assembled(from_scene(parse(text, "test.toml")))
    portable = eomc.load(system, tmp_path, form="plain")
    report = check(system, eomc.load(system, tmp_path), plain=portable)
    assert report.passed, str(report)


@pytest.mark.parametrize("text", tiers([MARKED, ROD], ROD), ids=["arm_drop", "reeled"])
def test_both_references_treat_discrete_values_as_constants(text: str) -> None:
    system = assembled(from_scene(parse(text, "test.toml")))
    n = len(system.q)
    q, qd = np.random.default_rng(2).uniform(0.3, 0.9, (2, 5, n))
    moving = np.array([c.name not in system.discrete for c in system.coordinates])
    params = {c.name: x for c, x in zip(system.coordinates, q.T, strict=True)}
    core = TaylorReference(with_constant_parameters(system))
    at_core = q[:, moving], qd[:, moving], 0.0, None, {n: params[n] for n in system.discrete}
    names = ["D", "C", "g", "bias", "tau", "kinetic", "potential", "energy", "power"]
    names += ["constraint_jacobian", "gamma"] if system.constraints else []
    for reference in (reference_for(system), TaylorReference(system)):
        for name in names:
            result, expected = reference.evaluate(name, q, qd), core.evaluate(name, *at_core)
            if name in ("D", "C"):
                assert (result[:, ~moving] == float(name == "D") * np.eye(n)[~moving]).all()
                result = result[:, moving]
            if name in (*MATRICES, *VECTORS):
                assert not result[..., ~moving].any()
                result = result[..., moving]
            if name in ("kinetic", "energy"):
                result = result - np.sum(qd[:, ~moving] ** 2, axis=1) / 2
            np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12, err_msg=name)
        accelerations = reference.acceleration(q, qd)
        assert not accelerations[:, ~moving].any()
        expected = core.acceleration(*at_core)
        np.testing.assert_allclose(accelerations[:, moving], expected, rtol=1e-9)
    kinetic = reference_for(system).evaluate("kinetic", q[0], qd[0])
    terms = reference_for(system).terms("energy", {"q": q[0], "qd": qd[0]})
    assert terms >= abs(kinetic) * (1 - 1e-12)


@pytest.mark.slow
def test_rod_that_is_reeled_in_stays_tight(modules: Modules) -> None:
    run = modules.unoptimised(ROD).simulate()
    distance = np.hypot(run["x"], run["y"])
    np.testing.assert_allclose(distance, run["l"], rtol=1e-14)
    assert run["l"][-1] == 0.9 * 0.8 and run.status == "ok"


@pytest.mark.slow
def test_stick_friction_changes_with_a_discrete_coefficient(modules: Modules) -> None:
    module = modules.unoptimised(GREASED)
    run = module.simulate(q0=[0, 0.5], qd0=[1, 0])
    assert run["mu"][-1] == 0.075 and run.status == "ok"
    q, qd = (x[run.t == 0.7][-1].copy() for x in (run.q, run.qd))
    assert q[2] == 0.075
    continued = module.simulate(q0=q, qd0=qd, t0=0.7, duration=2.3)
    np.testing.assert_allclose(continued.q[-1], run.q[-1], rtol=0, atol=1e-8)
    q[2] = 0.3  # without the grease
    assert abs(module.simulate(q0=q, qd0=qd, t0=0.7, duration=2.3).q[-1] - run.q[-1])[0] > 1e-3


@pytest.mark.slow
def test_system_from_python_has_discrete_values(tmp_path: Path) -> None:
    x, m, k, factor = sympy.symbols("x m k lambda")
    system = System.make(
        "osc", {x: (0, 1.0)}, "m*x_dot**2/2", k * x**2 / 2,
        parameters={m: 1, k: 4, factor: 0.5}, tolerance=1e-10,
        events={"soft": {
            "when": x - 0.3, "direction": "rising", "action": "jump",
            k: factor * k, "lambda": 1,
        }},
    )  # fmt: skip
    run = eomc.load(system, tmp_path).simulate(duration=3)
    assert run["k"][-1] == 2 and run.q[-1].tolist()[1:] == [2, 1]


@pytest.mark.parametrize(
    ("name", "message"),
    [("k_dot", "needs the name 'k_dot'"), ("k_ddot", "needs the name 'k_ddot'")],
)
def test_names_of_velocities_of_discrete_values_are_reserved(name: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        System.make(
            "osc", ["x"], "m*x_dot**2/2", "k*x**2/2", parameters={"m": 1, "k": 4, name: 3},
            events={"soft": {"when": "x - 0.3", "action": "jump", "k": "k/2"}},
        )  # fmt: skip


@pytest.mark.usefixtures("quickly_compiled")
def test_stop_event_can_depend_on_a_time_set_by_jumps(tmp_path: Path) -> None:
    system = System.make(
        "counted", {"y": 1.0}, "y_dot**2/2", "9.81*y",
        parameters={"e": 0.8, "count": 0, "until": 1e9}, tolerance=1e-10,
        events={
            "impact": {
                "when": "y", "direction": "falling", "action": "jump", "y_dot": "-e*y_dot",
                "count": "count + 1", "until": "t + 1e-6 + 1e9*heaviside(1.5 - count)",
            },
            "third": {"when": "t - until", "action": "stop"},
        },
    )  # fmt: skip
    run = eomc.load(system, tmp_path).simulate(duration=10)
    fall_time = (2 / 9.81) ** 0.5
    assert run.stopped == "third" and run["count"][-1] == 3
    assert run.t[-1] == pytest.approx(fall_time * (1 + 2 * 0.8 + 2 * 0.64) + 1e-6, rel=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
def test_mass_that_is_not_finite_can_lock_the_constraints(tmp_path: Path) -> None:
    """Accelerations on a rod don't depend on it; projections refuse it with the status LOCKED."""
    system = System.make(
        "rod", {"x": 0.6, "y": -0.8}, "m*(x_dot**2 + y_dot**2)/2", "9.81*m*y",
        constraints={"rod": "x**2 + y**2 - 1"}, parameters={"m": 1.0}, tolerance=1e-9, h=0.01,
        events={"drops": {"when": "x", "action": "jump", "m": "m/2"}},
    )  # fmt: skip
    report = check(system, eomc.load(system, tmp_path))
    assert report.passed, str(report)


def test_equilibrium_leaves_discrete_values_unchanged(gripper: ModuleType) -> None:
    """Jumped parameters are no unknowns: a missing force does not change a stiffness."""
    q, _, u = gripper.equilibrium([0.1, 0.2], [0.0, 0.0], u=1.0)
    set_by_jumps = gripper.start[0][2:]
    assert q[:2] == pytest.approx([0.25, 0.0], abs=1e-12) and (q[2:] == set_by_jumps).all()
    assert u == [1.0]


FAR = """eomc = 1
name = "far_{}"
[coordinates]
x = {{ start = 1.0 }}
y = {{ start = 0.5 }}
[parameters]
until = {}
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "x**2*y**2 + x**2 + 2*y**2"
[[event]]
name = "after"
when = "t - until"
action = "jump"
until = "2*until"
[run]
tolerance = 1e-12
duration = 20
batch = true
"""


@pytest.mark.slow
def test_size_of_discrete_values_does_not_affect_steps_and_errors(modules: Modules) -> None:
    """Regression: a distant time was the largest coordinate, relative to which errors counted."""
    small, large = (
        modules.unoptimised(from_scene(parse(FAR.format(*x)))) for x in (("3", "1e3"), ("9", "1e9"))
    )
    small_run, large_run = small.simulate(), large.simulate()
    assert np.array_equal(small_run.q[:, :2], large_run.q[:, :2])
    a, b = (m.simulate_batch(np.tile([1.0, 0.5], (9, 1))).q[0, -1, :2] for m in (small, large))
    assert np.array_equal(a, b)
    estimates = [run.estimate() for run in (small_run, large_run)]
    assert estimates[0].amplification == pytest.approx(estimates[1].amplification, rel=1e-6)
    fixed_estimates = [m.simulate(h=0.01, steps=500).estimate() for m in (small, large)]
    assert fixed_estimates[0].digits == pytest.approx(fixed_estimates[1].digits, rel=1e-6)
