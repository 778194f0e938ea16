"""Derivatives of steps that end on constraints: against differences and minimal coordinates."""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules, tiers

import eomc
from eomc.model.system import from_scene
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify import equations
from eomc.verify.comparison import Comparison

WINCH = """eomc = 1
name = "winch_stepped"
[coordinates]
x = { unit = "m", start = 0.6, rate = 0.5 }
y = { unit = "m", start = -0.8, guess = true }
[parameters]
m = 1.3
k = 0.2
[inputs]
push = { unit = "N", signal = "3*sin(4*t) - x_dot - 2*x*y" }
[constraints]
rope = "x**2 + y**2 - (1 + k*sin(3*t))**2"
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "9.81*m*y"
[forces]
x = "push"
y = "-y_dot*x"
[run]
h = 0.02
discretize = true
linearize = "parameters"
method = ["rk4", "dp8", "gauss4", "gauss16"]
"""
SLEIGH = """eomc = 1
name = "sleigh_stepped"
[coordinates]
x = { start = 0.2, rate = 0.3 }
y = { start = 0.1, guess = true }
psi = { start = 0.4, rate = 2.0 }
[inputs]
turn = {}
[constraints]
blade = "x_dot*sin(psi) - y_dot*cos(psi) - 0.3*psi_dot*(1 + sin(x)/5)"
[energy]
kinetic = "x_dot**2 + y_dot**2 + psi_dot**2/5 + x_dot*psi_dot*sin(psi)/4"
potential = "sin(x) + y**2"
[forces]
psi = "turn"
[run]
h = 0.02
discretize = true
"""
RUBBED = """eomc = 1
name = "rubbed_rod"
[coordinates]
x = { start = 0.6, friction = 0.1, friction_width = 1e-4 }
y = { start = -0.8, guess = true }
[constraints]
rod = "x**2 + y**2 - 1"
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[run]
discretize = true
"""
ROPE = """eomc = 1
name = "rope_stepped"
[coordinates]
x = { start = 1.1, rate = 0.3 }
s = { start = 0.4, guess = true }
r = { start = 0.5, guess = true }
[constraints]
rope = "x + s + r**2/2 - 2"
pulley = "x*r - s"
[energy]
kinetic = "x_dot**2 + (x_dot + s_dot)**2/3"
potential = "9.81*x + s**2"
[run]
h = 0.02
discretize = true
"""
METHODS = [(WINCH, m) for m in ("rk4", "dp8", "gauss4", "gauss16")]
CASES = [*METHODS, (SLEIGH, "rk4"), (ROPE, "rk4")]
STENCIL = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
INPUTS: dict[str, Any] = {"signals": None, "held": [0.7]}


def difference_quotients(step: Any, x: Any, width: float = 2e-3) -> Any:
    """Return the derivatives of step by central differences of order 8."""
    return np.array(
        [
            sum(w * (step(x + k * offset) - step(x - k * offset)) for k, w in STENCIL) / width
            for offset in width * np.eye(len(x))
        ]
    ).T


def compose(outer: Any, inner: Any) -> Any:
    return lambda x: outer(inner(x))


@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.parametrize(
    ("text", "method"), tiers(CASES, CASES[0], *CASES[-2:]), ids=lambda x: x[-9:].strip()
)
def test_derivatives_equal_differences_of_steps(
    modules: Modules, text: str, method: str, inputs: str
) -> None:
    """The state before a step may violate the constraints: a step projects any state onto them."""
    m, t, h = modules.unoptimised(text), 0.4, 0.02
    u = INPUTS[inputs] if m.inputs else None
    q, qd = m.project(*m.start, t=t)
    for violation in (0.0, 0.01):
        x = np.hstack([q, qd]) + violation * np.arange(2 * model_of(m).info.nq)

        def final_state(x: Any) -> Any:
            return np.hstack(m.step(*np.split(x, 2), h, t, u, method=method))

        Phi, Gamma = m.discretize(*np.split(x, 2), h, t, u, method=method)
        np.testing.assert_allclose(Phi, difference_quotients(final_state, x), rtol=0, atol=2e-11)
        if u is not None:
            expected = difference_quotients(
                lambda u: np.hstack(m.step(q, qd, h, t, u, method=method)), np.array(u)
            )
            _, Gamma = m.discretize(q, qd, h, t, u, method=method)
            np.testing.assert_allclose(Gamma, expected, rtol=0, atol=2e-12)
            assert np.abs(Gamma).max() > 1e-3
        if m.parameters:
            start = np.split(x, 2)
            step = partial(m.step, *start, h, t, u, method=method)
            expected = difference_quotients(compose(np.hstack, step), model_of(m).info.p0)
            E = m.discretize(*start, h, t, u, method=method, parameters=True)[-1]
            np.testing.assert_allclose(E, expected, rtol=0, atol=2e-11)
            assert np.abs(E[:, 1]).max() > 0.1


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(WINCH, id="winch", marks=pytest.mark.slow),
        pytest.param(SLEIGH, id="sleigh"),
        pytest.param(ROPE, id="rope", marks=pytest.mark.slow),
    ],
)
def test_derivatives_stay_in_the_tangent_space(modules: Modules, text: str) -> None:
    """After a step, any change of the initial state satisfies the constraints, to rounding."""
    m, t, h = modules.unoptimised(text), 0.4, 0.02
    q, qd = m.project(*m.start, t=t)
    Phi, Gamma = m.discretize(q, qd, h, t)
    T = m.tangent(*m.step(q, qd, h, t), t + h)
    normal_projector = np.eye(2 * len(q)) - T @ T.T
    assert np.abs(normal_projector @ Phi).max() < 1e-14 * np.abs(Phi).max()
    assert not Gamma.size or np.abs(normal_projector @ Gamma).max() < 1e-15
    assert np.linalg.matrix_rank(Phi, 1e-9) == T.shape[1]


def pendulum(modules: Modules, form: str) -> ModuleType:
    """A pendulum with a horizontal force, in x and y or by its angle."""
    if form == "angle":
        text = '[coordinates]\na = {}\n[energy]\nkinetic = "m*(l*a_dot)**2/2"\n'
        text += 'potential = "-9.81*m*l*cos(a)"\n[forces]\na = "push*l*cos(a) - a_dot/5"\n'
    else:
        text = '[coordinates]\nx = {}\ny = { start = "-l" }\n[energy]\n'
        text += 'kinetic = "m*(x_dot**2 + y_dot**2)/2"\npotential = "9.81*m*y"\n'
        text += '[forces]\nx = "push - x_dot/5/l**2"\n[constraints]\nrod = "x**2 + y**2 - l**2"\n'
    head = f'eomc = 1\nname = "hanging_{form}"\n[parameters]\nm = 1.3\nl = 0.5\n'
    run = '[run]\nh = 0.01\ndiscretize = true\nmethod = "dp8"\n'
    return modules.unoptimised(head + "[inputs]\npush = {}\n" + text + run)


@pytest.mark.slow
def test_reduced_derivatives_equal_those_of_minimal_coordinates(modules: Modules) -> None:
    """At the equilibrium T^T Phi T is the step of the angle, over steps and control periods."""
    xy, angle = (pendulum(modules, form) for form in ("xy", "angle"))
    q, _, u = xy.equilibrium(u=[0.0])
    T = xy.tangent(q, 0 * q)
    for period in (None, 0.05):
        Phi, Gamma = xy.discretize(q, 0 * q, u=u, control_period=period)
        expected, expected_u = angle.discretize([0.0], [0.0], u=[0.0], control_period=period)
        # T consists of unit vectors: arc lengths, up to order and sign
        S = T.T @ np.array([[0.5, 0], [0, 0], [0, 0.5], [0, 0]])
        np.testing.assert_allclose(T.T @ Phi @ T @ S, S @ expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(T.T @ Gamma, S @ expected_u, rtol=0, atol=1e-14)


@pytest.mark.parametrize("text", tiers([WINCH, SLEIGH], SLEIGH), ids=lambda t: t[16:22])
@pytest.mark.usefixtures("quickly_compiled")
def test_portable_c_has_the_same_derivatives(modules: Modules, text: str, tmp_path: Any) -> None:
    fast: Any = modules.unoptimised(text)
    portable = eomc.load(from_scene(parse(text, "test.toml")), tmp_path, form="plain")
    q, qd = fast.project(*fast.start, t=0.4)
    for method in fast.methods:
        results = [m.discretize(q, qd, t=0.4, method=method) for m in (fast, portable)]
        for a, b in zip(*results, strict=True):
            assert a == pytest.approx(b, rel=1e-12, abs=1e-13)


@pytest.mark.slow
def test_step_that_fails_has_no_derivative(modules: Modules) -> None:
    m = modules.unoptimised(WINCH)
    with pytest.raises(m.MotionError, match="no derivative of a step") as error:
        m.discretize([0.6, -0.8], [1e3, 1e3], h=1.0, u=[0.0], params={"k": 1.0})
    assert error.value.status in ("locked", "singular", "not finite")


@pytest.mark.slow
def test_wrong_derivative_fails_the_check(modules: Modules) -> None:
    class PerturbedModule:
        """Wrap the module; perturb its derivatives slightly."""

        def __getattr__(self, name: str) -> Any:
            return getattr(m, name)

        def discretize(self, *state: Any, **options: Any) -> Any:
            Phi, Gamma = m.discretize(*state, **options)
            return Phi + 1e-5 * np.abs(Phi).max(), Gamma

    m, scene_system = modules.unoptimised(SLEIGH), from_scene(parse(SLEIGH, "test.toml"))
    for module, passed in ((m, True), (PerturbedModule(), False)):
        comparison = Comparison(scene_system, module, np.random.default_rng(0), 4)
        results = comparison.report(equations.step_derivative_checks)
        assert [row.passed for row in results] == [passed], results


@pytest.mark.slow
def test_steep_velocity_dependence_passes_the_check(modules: Modules) -> None:
    """Friction is smoothed over a small part of the velocity range: narrow differences."""
    m, scene_system = modules.unoptimised(RUBBED), from_scene(parse(RUBBED, "test.toml"))
    comparison = Comparison(scene_system, m, np.random.default_rng(0), 4)
    results = comparison.report(equations.step_derivative_checks)
    assert [row.passed for row in results] == [True], results
