"""`[run] friction = "stick"`: exact Coulomb friction, against closed forms and SciPy's events."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from support import cases
from support.point_masses import read_system
from support.session import Modules

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify.check import check

BLOCK = """eomc = 1
name = "dry_block"
[coordinates]
x = { start = 1.0, friction = "mu*m*g" }
[parameters]
m  = 1.0
k  = 10.0
mu = 0.1
g  = 9.81
[energy]
kinetic = "m*x_dot**2/2"
potential = "k*x**2/2"
[run]
friction = "stick"
tolerance = 1e-12
batch = true
"""

CART = """eomc = 1
name = "dry_cart"
[coordinates]
x     = { unit = "m", friction = "F" }
theta = { unit = "rad", start = 0.5 }
[parameters]
M = 1.0
m = 0.3
l = 0.5
g = 9.81
F = 0.4
[energy]
kinetic = "M*x_dot**2/2 + m*((x_dot + l*theta_dot*cos(theta))**2 + (l*theta_dot*sin(theta))**2)/2"
potential = "-m*g*l*cos(theta)"
[run]
tolerance = 1e-9
friction = "stick"
duration = 5.0
"""

ARM = """eomc = 1
name = "dry_arm"
gravity = [0, -9.81]
[coordinates]
q1 = { unit = "rad", start = 0.3 }
q2 = { unit = "rad", start = 0.5 }
q3 = { unit = "rad", start = -0.2 }
[parameters]
F = 2.0
""" + "".join(f"""[[body]]
name = "b{k}"
mass = 1.0
center = [0.25, 0]
inertia = 0.02
joint = "revolute"
coordinates = "q{k}"
friction = "F/{k}"
{f'parent = "b{k - 1}"' if k > 1 else ""}
{"offset = [0.5, 0]" if k > 1 else ""}
""" for k in (1, 2, 3)) + """[run]
friction = "stick"
tolerance = 1e-10
duration = 20.0
"""  # fmt: skip

FOUR_BAR = ((cases.SCENES / "four_bar.toml").read_text(encoding="utf-8")
            .replace('note = "crank" }', 'friction = 0.6, note = "crank" }')
            .replace('coordinates = "q3"\n', 'coordinates = "q3"\nfriction = 0.3\n')
            .replace("[run]", '[run]\nfriction = "stick"\ntolerance = 1e-10'))  # fmt: skip


@pytest.fixture(scope="module")
def block(modules: Modules) -> ModuleType:
    return modules.unoptimised(BLOCK)


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
def test_block_comes_to_rest_at_the_closed_form(block: ModuleType, tol: float) -> None:
    run = cases.block_at_rest(block, tol)
    friction_force = run.multipliers["x_sticks"][-1]
    assert friction_force == pytest.approx(10 * run.q[-1, 0], abs=1e-12)
    assert len(run.events["x_slips"]) == len(run.events["x_stops"]) == 5


def test_starts_need_no_modes_and_batches_equal_single_runs(block: ModuleType) -> None:
    starts, rates = np.array([[1.0], [0.05], [-0.7]]), np.array([[0.0], [0.0], [2.0]])
    batch = block.simulate_batch(starts, rates, tol=1e-10, times=[0.0, 1.0, 5.0])
    for q, qd, rows in zip(starts, rates, batch.q, strict=True):
        run = block.simulate(q, qd, tol=1e-10, times=[0.0, 1.0, 5.0])
        assert run.q.tolist() == rows.tolist()
        expected = block.simulate([*q, 1.0], [*qd, 0.0], tol=1e-10, times=[0.0, 1.0, 5.0])
        # the velocity determines the direction of sliding
        assert expected.q.tolist() == run.q.tolist()
    assert batch.q[1, -1].tolist() == [0.05, 0.0]  # friction holds it at its start
    half = block.simulate(tol=1e-12, duration=2.5)
    second_half = block.simulate(half.q[-1], half.qd[-1], tol=1e-12, t0=2.5, duration=3.5)
    expected = block.simulate(tol=1e-12, duration=6.0)
    np.testing.assert_allclose(second_half.q[-1], expected.q[-1], rtol=0, atol=1e-13)


def test_block_never_sticks_without_friction(block: ModuleType) -> None:
    run = block.simulate(tol=1e-12, duration=6.0, params={"mu": 0.0})
    assert run.q[-1, 0] == pytest.approx(math.cos(6 * math.sqrt(10.0)), abs=1e-10)


def solve_with_scipy(F: float, duration: float) -> tuple[list[float], list[tuple[str, float]]]:
    """Solve the cart piecewise with SciPy; return its final state and the events."""
    M, m, length, g = 1.0, 0.3, 0.5, 9.81

    def friction_force(y: Any) -> Any:
        a = -g / length * np.sin(y[1])
        return m * length * (np.cos(y[1]) * a - np.sin(y[1]) * y[3] ** 2)

    def rhs(t: float, y: Any, s: float) -> list[float]:
        if s == 0:
            return [0, y[3], 0, -g / length * np.sin(y[1])]
        coupling = m * length * np.cos(y[1])
        D = [[M + m, coupling], [coupling, m * length**2]]
        b = [m * length * np.sin(y[1]) * y[3] ** 2 - F * s, -m * g * length * np.sin(y[1])]
        return [y[2], y[3], *np.linalg.solve(D, b)]

    def stopping_event(t: float, y: Any, s: float) -> Any:
        return s * y[2]

    def slipping_event(t: float, y: Any, s: float) -> Any:
        return F - abs(friction_force(y))

    for event in (stopping_event, slipping_event):
        event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
    t, y, s, events = 0.0, np.array([0, 0.5, 0, 0]), 0.0, []
    while t < duration:
        if s == 0 and slipping_event(t, y, s) < 1e-12:
            s = -np.sign(friction_force(y))
            events.append(("x_slips", t))
        solution = solve_ivp(
            rhs, (t, duration), y, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.02, args=(s,),
            events=slipping_event if s == 0 else stopping_event,
        )  # fmt: skip
        t, y = solution.t[-1], solution.y[:, -1]
        if solution.status == 1 and s:
            s, y[2] = 0.0, 0.0
            events.append(("x_stops", t))
    return y.tolist(), events


@pytest.mark.slow
@pytest.mark.parametrize("F", [0.15, 0.4, 0.6])
def test_cart_agrees_with_scipy(modules: Modules, F: float) -> None:
    run = modules.unoptimised(CART).simulate(params={"F": F})
    end, events = solve_with_scipy(F, 5.0)
    np.testing.assert_allclose([*run.q[-1, :2], *run.qd[-1, :2]], end, rtol=0, atol=1e-8)
    for name in ("x_stops", "x_slips"):
        times = [t for event_name, t in events if event_name == name]
        np.testing.assert_allclose(run.events[name].t, times, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_arm_comes_to_rest(modules: Modules) -> None:
    arm = modules.unoptimised(ARM)
    random = np.random.default_rng(0)
    for _ in range(6):
        q, qd = random.normal(size=(2, 3)) * [[2], [4]]
        run, fine = (arm.simulate(q, qd, tol=tol) for tol in (1e-10, 1e-13))
        assert run.status == "ok" and np.all(np.diff(run.energy) < 1e-8)
        np.testing.assert_allclose(run.q[-1], fine.q[-1], rtol=0, atol=1e-8)
        counts = [[len(e) for e in r.events.values()] for r in (run, fine)]
        assert counts[0] == counts[1] and min(counts[0]) > 0
        assert np.all(np.abs(run.qd[-1]) < 1e-20)
        for k in (1, 2, 3):
            assert np.all(np.abs(run.multipliers[f"q{k}_sticks"]) <= 2 / k * (1 + 1e-9))


@pytest.mark.slow
def test_friction_never_acts_along_the_velocity(modules: Modules) -> None:
    """In some of these runs a joint slips, and another drives it back immediately."""
    arm, random = modules.unoptimised(ARM), np.random.default_rng(5)
    for _ in range(165):
        q, qd = random.normal(size=(2, 3)) * [[2], [4]]
        run = arm.simulate(q, qd, tol=1e-9)
        assert run.status == "ok" and run.singular_steps == 0
        assert np.all(run.q[:, 3:] * run.qd[:, :3] > -1e-9) and np.all(np.diff(run.energy) < 1e-7)


def test_rounding_of_a_velocity_at_rest_does_not_move_a_block(block: ModuleType) -> None:
    rest = block.simulate().q[-1, :1]
    for rate in (3e-31, -1e-32):
        run = block.simulate(rest, [rate], duration=1.0)
        assert not any(len(e) for e in run.events.values()) and run.q[-1, 1:].tolist() == [0]
        assert run.q[-1, 0] == rest[0]


@pytest.mark.slow
def test_rounding_of_velocities_at_rest_does_not_move_an_arm(modules: Modules) -> None:
    arm = modules.unoptimised(ARM)
    rest = arm.simulate(tol=1e-10).q[-1, :3]
    for rates in ([3e-31, -2e-31, 0], [1e-31, 1e-30, 1e-32]):
        run = arm.simulate(rest, rates, tol=1e-10, duration=1.0)
        assert not any(len(e) for e in run.events.values()) and run.q[-1, 3:].tolist() == [0, 0, 0]
        assert run.estimate().amplification < 2


@pytest.mark.slow
def test_mechanism_does_not_stick_at_a_dead_point(modules: Modules) -> None:
    """The rocker reverses while the crank moves on; finally both rest, with the loop closed."""
    bar = modules.unoptimised(FOUR_BAR)
    run = bar.simulate(tol=1e-10)
    assert run.status == "ok" and run.steps < 300
    assert np.abs(bar.constraints(run.q, run.qd)).max() < 1e-9
    turns = run.events["q3_stops"]
    assert np.sum(np.abs(turns.qd[:, 0]) > 0.5) > 3  # the crank moves on
    assert np.all(np.diff(run.energy) < 1e-8) and np.all(np.abs(run.qd[-1]) < 1e-20)
    assert not run.estimate().verdict


@pytest.mark.slow
def test_jump_sets_the_mode_of_the_velocity_that_it_reverses(modules: Modules) -> None:
    """A thrown block rebounds from a wall: v^2 falls by 2 mu g per metre, by e^2 at the wall."""
    text = BLOCK.replace('potential = "k*x**2/2"', "").replace("start = 1.0,", "rate = 2.0,")
    text = text.replace("k  = 10.0\n", "e  = 0.9\n").replace("dry_block", "thrown_block")
    wall = (
        '[[event]]\nname = "wall"\nwhen = "x - 1"\ndirection = "rising"\naction = "jump"\n'
        'x_dot = "-e*x_dot"\n'
    )
    run = modules.unoptimised(text + wall).simulate(duration=8.0)
    speed_squared = 0.81 * (4 - 2 * 0.981)
    assert run.status == "ok" and len(run.events["wall"]) == len(run.events["x_stops"]) == 1
    assert run.q[-1].tolist() == [pytest.approx(1 - speed_squared / (2 * 0.981), abs=1e-12), 0]


def test_systems_from_python_can_stick() -> None:
    x, F, m = sympy.symbols("x F m")
    v = sympy.Symbol("x_dot")
    system = System.make(
        "slab",
        {x: (0, 1)},
        m * v**2 / 2,
        parameters={m: 2, F: 1},
        friction={x: F},
        tolerance=1e-9,
    )
    assert [c.name for c in system.coordinates] == ["x", "x_slides"]
    assert system.coordinates[1].start == 1 and system.run.tolerance == 1e-9
    for invalid, message in (
        ({v: F}, "'x_dot' is not among the coordinates"),
        ({x: v}, "friction.x: 'x_dot' can't be used here: 'friction' is made of numbers"),
        ({x: -F}, "is -1, and can't be negative"),
    ):
        with pytest.raises(EomcError, match=message):
            System.make("slab", {x: 0}, m * v**2 / 2, parameters={m: 2, F: 1}, friction=invalid)


def test_assembly_of_a_start_is_reported() -> None:
    messages = [str(w) for w in assembled(read_system(FOUR_BAR)).warnings]
    assert any("the start is assembled: q2 = " in text for text in messages)


def test_names_of_modes_are_reserved() -> None:
    text = BLOCK.replace("k  = 10.0", "k  = 10.0\nx_slides = 1.0")
    with pytest.raises(SceneError, match=r"needs the name 'x_slides': rename yours"):
        read_system(text)


@pytest.mark.slow
@pytest.mark.parametrize(("text", "factor"), [(CART, 5), (ARM, 8)], ids=["cart", "arm"])
def test_sticking_takes_fewer_steps_than_smoothed_friction(
    text: str, factor: float, modules: Modules
) -> None:
    """The numbers of docs/adaptive.md: pytest -s tests/runtime/test_sticking.py -k fewer."""
    smooth = text.replace('friction = "stick"', 'friction = "smooth"').replace("dry_", "rubbed_")
    smooth = smooth.replace('friction = "F" }', 'friction = "F", friction_width = 0.001 }')
    smooth = smooth.replace('friction = "F/', 'friction_width = 0.001\nfriction = "F/')
    exact, smoothed = (
        modules.unoptimised(x).simulate(tol=1e-9, duration=5.0).steps for x in (text, smooth)
    )
    print(f"{exact} steps, smoothed by tanh(v/0.001) {smoothed}")
    assert factor * exact < smoothed


@pytest.mark.slow
@pytest.mark.parametrize("text", [BLOCK, CART, ARM, FOUR_BAR], ids=["block", "cart", "arm", "bar"])
def test_check_passes(text: str, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    system = eomc.read(tmp_path / "scene.toml")
    report = check(system, eomc.load(system, tmp_path / "build"))
    assert report.passed, str(report)


@pytest.mark.parametrize("method", ["gauss8", "gauss16"])
def test_implicit_methods_are_refused_and_the_key_is_named(method: str) -> None:
    text = BLOCK.replace("[run]\n", f'[run]\nmethod = "{method}"\n')
    with pytest.raises(EomcError, match=r'friction = "stick".*: write friction = "smooth", or '):
        eomc.sources(from_scene(parse(text, "test.toml")))
