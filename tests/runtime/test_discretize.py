"""Derivatives of a step, against differences of 55 digits and sequences of single steps."""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from support.session import Modules, tiers

import eomc
from eomc.base.errors import EomcError
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify import equations, symbolic
from eomc.verify.comparison import Comparison

HEAD = """eomc = 1
name = "NAME"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad", start = 0.3 }
[parameters]
k = 4.0
[inputs]
"""
LOOP = (
    HEAD.replace("NAME", "stepped")
    + """force = { unit = "N", signal = "k*theta + 3*lean*theta_dot - x_dot**2", limits = [-9, 9] }
push = { unit = "N m", signal = "sin(30*t)" }
[definitions]
lean = "sin(theta + x)"
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "9.81*cos(theta) + k*x**2"
dissipation = "k*theta_dot**2/20"
[forces]
x = "force"
theta = "push*cos(x)"
[run]
h = 0.02
"""
)
DERIVATIVES = 'discretize = true\nlinearize = "parameters"\n'
EXPLICIT = LOOP + DERIVATIVES + 'method = ["rk4", "dp8", "euler"]\nbatch = true\n'
IMPLICIT = LOOP + DERIVATIVES + 'method = ["gauss4", "gauss6", "gauss8", "gauss16"]\n'
NYSTROM = (
    HEAD.replace("NAME", "nystrom")
    + """force = { unit = "N", signal = "k*theta - x**3" }
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot/2 + theta_dot**2"
potential = "9.81*cos(theta - x)"
[forces]
x = "force*cos(x + t)"
[run]
h = 0.02
discretize = true
method = ["verlet", "euler"]
"""
)
CASES = [
    *((EXPLICIT, m) for m in ("rk4", "dp8", "euler")),
    *((IMPLICIT, m) for m in ("gauss4", "gauss6", "gauss8", "gauss16")),
    (NYSTROM, "verlet"),
]
Q, QD = np.array([0.2, 0.4]), np.array([-0.3, 0.7])
INPUTS = {"signals": None, "held": [0.6, -0.4], "beyond": [40.0, 0.3]}


class ExactStepper:
    """Steps of a scene in many digits, by the equations of the reference."""

    def __init__(self, system: System) -> None:
        r, self.n, self.m = symbolic.derive(system), len(system.q), len(system.u)
        parameters = [p.symbol for p in system.parameters]
        self.values = [mpmath.mpf(p.value) for p in system.parameters]
        symbols = [*system.q, *system.qd, sympy.Symbol("t", real=True), *system.u, *parameters]
        modules = [{"Min": min, "Max": max}, "mpmath"]
        self.motion, self.signals = (
            sympy.lambdify(symbols, list(expressions), modules=modules)
            for expressions in (r.motion, r.signals)
        )

    def acceleration(self, q: Any, qd: Any, t: Any, u: Any, added: Any, p: Any) -> Any:
        """Return the acceleration; u is constant, or None for the signals, plus `added`."""
        n = self.n
        if u is None:
            u = self.signals(*q, *qd, t, *[0] * self.m, *p)
        values = self.motion(*q, *qd, t, *(a + b for a, b in zip(u, added, strict=True)), *p)
        D, bias, tau = values[: n * n], values[n * n : -n], values[-n:]
        matrix = mpmath.matrix([D[n * i : n * i + n] for i in range(n)])
        force = mpmath.matrix([a - b for a, b in zip(tau, bias, strict=True)])
        return np.array(mpmath.lu_solve(matrix, force))

    def step(self, method: str, z: Any, h: Any, t: Any, u: Any) -> Any:
        """Return the state a step after z = [q, qd, added, p]; stages by fixed-point iteration."""
        m, n = METHODS[method], self.n
        q, qd, added, p = np.split(z, [n, 2 * n, 2 * n + self.m])
        number = lambda f: mpmath.mpf(f.numerator) / f.denominator  # noqa: E731
        square = [[[number(x) for x in row] for row in rows] for rows in (m.a, m.a_squared)]
        a = np.array([[mpmath.mpf(0)] * n] * m.stages)
        for _ in range(60 if m.implicit else 1):
            previous = a.copy()
            for i in range(m.stages):
                v, r = (sum((x * a[j] for j, x in enumerate(rows[i])), 0 * q) for rows in square)
                c = number(m.c[i])
                a[i] = self.acceleration(
                    q + c * h * qd + h**2 * r, qd + h * v, t + c * h, u, added, p
                )
            if m.implicit and max(abs(x) for x in (a - previous).ravel()) < mpmath.mpf(10) ** -52:
                break
        else:
            assert not m.implicit, "the stages are not found"
        r, v = (sum(number(x) * a[j] for j, x in enumerate(row)) for row in (m.b_a, m.b))
        return np.concatenate([q + h * qd + h**2 * r, qd + h * v])

    def derivative(self, method: str, z: Any, h: float, t: float, u: Any) -> Any:
        """Return d step/dz by central differences in 55 digits, 18 of which are the width."""
        with mpmath.workdps(55):
            z, width = np.array([mpmath.mpf(float(x)) for x in z]), mpmath.mpf(10) ** -18
            h, t = mpmath.mpf(h), mpmath.mpf(t)
            columns = []
            for k in range(len(z)):
                ends = []
                for sign in (1, -1):
                    shifted = z.copy()
                    shifted[k] += sign * width
                    ends.append(self.step(method, shifted, h, t, u))
                columns.append([float(x) for x in (ends[0] - ends[1]) / (2 * width)])
        return np.array(columns).T


@cache
def exact_stepper(text: str) -> ExactStepper:
    return ExactStepper(from_scene(parse(text, "test.toml")))


def derivative(text: str, method: str, h: float, t: float, u: Any) -> Any:
    """Return [Phi, Gamma, E], accurate to all digits of a double."""
    stepper = exact_stepper(text)
    inputs = None if u is None else [mpmath.mpf(x) for x in u[: stepper.m]]
    J = stepper.derivative(method, [*Q, *QD, *[0] * stepper.m, *stepper.values], h, t, inputs)
    return np.split(J, [4, 4 + stepper.m], axis=1)


def is_quick(method: str, inputs: str) -> bool:
    """Return True if other cases do not cover this one."""
    return method in ("rk4", "euler")


@pytest.mark.parametrize(
    ("text", "method", "inputs"),
    [
        pytest.param(
            text, method, inputs, id=f"{method}-{inputs}",
            marks=() if is_quick(method, inputs) else pytest.mark.slow,
        )
        for text, method in CASES
        for inputs in INPUTS
    ],
)  # fmt: skip
def test_derivatives_equal_differences_in_many_digits(
    modules: Modules, text: str, method: str, inputs: str
) -> None:
    """All digits are right, except the last two of the largest entry."""
    m, u = modules.unoptimised(text), INPUTS[inputs]
    u_scene = None if u is None else u[: len(m.inputs)]
    by_parameters = {"parameters": True} if text is not NYSTROM else {}
    Phi, Gamma, *E = m.discretize(Q, QD, 0.03, 0.4, u_scene, method=method, **by_parameters)
    expected, expected_u, expected_p = derivative(text, method, 0.03, 0.4, u)
    assert np.max(np.abs(Phi - expected)) < 4e-15 * np.max(np.abs(expected))
    assert np.max(np.abs(Gamma - expected_u)) < 4e-15 * max(np.max(np.abs(expected_u)), 0.01)
    assert np.any(expected_u) or inputs == "beyond"
    for by_p in E:
        assert np.max(np.abs(by_p - expected_p)) < 4e-15 * max(np.max(np.abs(expected_p)), 0.01)


@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize("text", tiers([EXPLICIT, IMPLICIT], EXPLICIT), ids=lambda t: t[-20:-1])
def test_portable_c_has_the_same_derivatives(modules: Modules, text: str, tmp_path: Any) -> None:
    fast = modules.unoptimised(text)
    portable = eomc.load(from_scene(parse(text, "test.toml")), tmp_path, form="plain")
    for method in fast.methods:
        for u in (None, [0.6, -0.4]):
            options = {"method": method, "parameters": True}
            results = [m.discretize(Q, QD, 0.03, 0.4, u, **options) for m in (fast, portable)]
            for a, b in zip(*results, strict=True):
                assert a == pytest.approx(b, rel=1e-13, abs=1e-14)


@pytest.mark.parametrize("t", [0.3, np.linspace(0, 1, 3)])
@pytest.mark.parametrize("period", [None, 0.06])
def test_derivatives_at_many_states_equal_single_ones(
    modules: Modules, t: Any, period: float | None
) -> None:
    m, options = modules.unoptimised(EXPLICIT), {"params": {"k": 3.0}, "control_period": period}
    q, qd = np.array([Q, 2 * Q, -Q]), np.array([QD, -QD, QD])
    results = m.discretize(q, qd, t=t, parameters=True, **options)
    assert [x.shape for x in results] == [(3, 4, 4), (3, 4, 2), (3, 4, 1)]
    for k in range(3):
        own_t = float(np.broadcast_to(t, 3)[k])
        single = m.discretize(q[k], qd[k], t=own_t, parameters=True, **options)
        assert all(np.array_equal(x[k], y) for x, y in zip(results, single, strict=True))


@pytest.mark.parametrize("inputs", ["signals", "held"])
@pytest.mark.parametrize("method", ["rk4", "euler"])
def test_derivative_over_a_control_period_equals_differences_of_runs(
    modules: Modules, method: str, inputs: str
) -> None:
    """Against differences of runs with that period, accurate to about 1e-10."""
    m, u = modules.unoptimised(EXPLICIT), INPUTS[inputs]
    x, options = np.hstack([Q, QD]), {"h": 0.02, "control_period": 0.1, "method": method}
    Phi, Gamma, E = m.discretize(Q, QD, u=u, parameters=True, **options)

    def final_state(x: Any, u: Any, k: float = 4.0) -> Any:
        run = m.simulate(*np.split(x, 2), steps=5, u=u, params={"k": k}, **options)
        return run.x[-1]

    stencil, width = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280)), 4e-3
    for k, offset in enumerate(width * np.eye(4)):
        expected = (
            sum(
                w * (final_state(x + j * offset, u) - final_state(x - j * offset, u))
                for j, w in stencil
            )
            / width
        )
        assert Phi[:, k] == pytest.approx(expected, abs=1e-9)
    ends = (w * (final_state(x, u, 4 + j * width) - final_state(x, u, 4 - j * width))
            for j, w in stencil)  # fmt: skip
    assert E[:, 0] == pytest.approx(sum(ends) / width, abs=1e-9)
    start = m.signal(Q, QD) if u is None else np.array(u)
    for k, offset in enumerate(width * np.eye(2)):
        ends = (
            (w, final_state(x, start + j * offset) - final_state(x, start - j * offset))
            for j, w in stencil
        )
        assert Gamma[:, k] == pytest.approx(sum(w * d for w, d in ends) / width, abs=1e-9)


@pytest.mark.parametrize("period", [None, 0.04])
def test_inputs_and_parameters_per_state(modules: Modules, period: float | None) -> None:
    m = modules.unoptimised(EXPLICIT)
    q, qd = np.array([Q, 2 * Q, -Q]), np.array([QD, -QD, QD])
    u, k = np.array([[0.0, 0.1], [1.0, 0.2], [-2.0, 0.3]]), np.array([4.0, 5.0, 6.0])
    by_name, t = {"force": u[:, 0], "push": 0.2}, np.array([0.0, 0.1, 0.2])
    period_options = {"control_period": period, "parameters": True}
    options_by_name: dict[str, Any] = {"discretize": period_options, "linearize": {}}
    for u_all, params in (
        (u, None),
        (u.tolist(), {"k": k}),
        (by_name, k[:, None]),
        (None, {"k": k}),
    ):
        for name, options in options_by_name.items():
            results = getattr(m, name)(q, qd, u=u_all, t=t, params=params, **options)
            for j in range(3):
                u_own = [u[j, 0], 0.2] if u_all is by_name else None if u_all is None else u[j]
                p = None if params is None else {"k": k[j]}
                single = getattr(m, name)(q[j], qd[j], u=u_own, t=t[j], params=p, **options)
                assert all(np.array_equal(a[j], b) for a, b in zip(results, single, strict=True))
    A, B = m.linearize(np.empty((0, 2)), np.empty((0, 2)), u=np.empty((0, 2)))
    assert A.shape == (0, 4, 4) and B.shape == (0, 4, 2)
    for name in ("discretize", "linearize"):
        with pytest.raises(ValueError, match=r"u: shape \(2, 2\), expected \(3, 2\) for 3 states"):
            getattr(m, name)(q, qd, u=u[:2])
        with pytest.raises(ValueError, match=r"params: k: shape \(2,\), expected \(3,\) for 3 st"):
            getattr(m, name)(q, qd, params={"k": k[:2]})
        with pytest.raises(ValueError, match=r"u: shape \(3, 2\), expected \(2,\): force"):
            getattr(m, name)(Q, QD, u=u)


@pytest.mark.parametrize(
    ("text", "method"), [(EXPLICIT, "rk4"), (EXPLICIT, "dp8"), (NYSTROM, "verlet")]
)
def test_steps_in_registers_equal_single_ones(modules: Modules, text: str, method: str) -> None:
    """Of five states; an angle is beyond 2^20 rad, where sines in registers are wrong."""
    m, random = modules.unoptimised(text), np.random.default_rng(2)
    q, qd = random.uniform(-1, 1, (2, 5, 2))
    q[2, 1] = 3e9
    u, t, k = random.uniform(-1, 1, (5, m.nu)), np.linspace(0, 1, 5), np.linspace(3, 4, 5)
    options: dict[str, Any] = {"h": 0.1, "method": method, "parameters": text is EXPLICIT}
    many = m.discretize(q, qd, t=t, u=u, params={"k": k}, **options)
    for j in range(5):
        one = m.discretize(q[j], qd[j], t=t[j], u=u[j], params={"k": k[j]}, **options)
        for a, b in zip(many, one, strict=True):
            np.testing.assert_allclose(a[j], b, rtol=0, atol=8 * np.finfo(float).eps)


@pytest.mark.parametrize("count", [None, 3])
def test_matrices_are_written_into_out(modules: Modules, count: int | None) -> None:
    m = modules.unoptimised(EXPLICIT)
    rows = () if count is None else (count,)
    q, qd = (np.broadcast_to(np.array(x, float), (*rows, 2)) for x in (Q, QD))
    for compute, options in (
        (m.linearize, {}), (m.linearize, {"closed": True}),
        (m.discretize, {}), (m.discretize, {"control_period": 0.06}),
    ):  # fmt: skip
        out = np.empty((*rows, 4, 4)), np.empty((*rows, 4, 2))
        result = compute(q, qd, out=out, **options)
        for into, given, expected in zip(result, out, compute(q, qd, **options), strict=True):
            assert into is given and np.array_equal(into, expected)
        with pytest.raises(ValueError, match="out: expected a pair of arrays"):
            compute(q, qd, out=out[0], **options)
        with pytest.raises(ValueError, match=r"out\[1\]: expected a writeable"):
            compute(q, qd, out=(out[0], out[0]), **options)
        memory = np.ones(24 * (count or 1))
        A, B = memory[: out[0].size].reshape(out[0].shape), out[1]
        overlapping = memory[: q.size].reshape(q.shape)
        with pytest.raises(ValueError, match="overlap"):
            compute(overlapping, qd, out=(A, B), **options)


def test_invalid_arguments_are_refused(modules: Modules, cartpole: ModuleType) -> None:
    m = modules.unoptimised(EXPLICIT)
    with pytest.raises(ValueError, match=r"cartpole was built without it.*discretize = true"):
        cartpole.discretize([0, 0], [0, 0])
    nystrom = modules.unoptimised(NYSTROM)
    with pytest.raises(ValueError, match=r"discretize: nystrom .*linearize = \"parameters\""):
        nystrom.discretize(Q, QD, parameters=True)
    with pytest.raises(ValueError, match="parameters: 1 is not True or False"):
        m.discretize(Q, QD, parameters=1)
    with pytest.raises(ValueError, match="'gauss4' is not in this module"):
        m.discretize(Q, QD, method="gauss4")
    with pytest.raises(ValueError, match="give a whole number of steps"):
        m.discretize(Q, QD, h=0.02, control_period=0.05)
    with pytest.raises(m.MotionError, match="not finite there") as error:
        m.discretize([Q, Q], [QD, 1e160 * QD], u=[0, 0])
    assert error.value.status == "not finite" and "e+159" in str(error.value)
    stiff = 'eomc = 1\nname = "stiff"\n[coordinates]\nx = { start = 1 }\n[energy]\n' + (
        'kinetic = "x_dot**2/2"\npotential = "1e4*x**4"\n[run]\ndiscretize = true\n'
    )
    gauss: Any = modules.unoptimised(stiff + 'method = "gauss4"\n')
    with pytest.raises(gauss.MotionError, match="does not converge") as error:
        gauss.discretize([1.0], [0.0], h=5.0)
    assert error.value.status == "no convergence"


def test_scene_without_discretize_has_none_of_its_code() -> None:
    for text in (LOOP, LOOP + "linearize = true\n"):
        for name, file in eomc.sources(from_scene(parse(text, "test.toml"))).files.items():
            if name.endswith((".c", ".h")):
                for fragment in ("derivative(", "Phi", "_eliminate(", "differentiate_"):
                    assert fragment not in file, name
    explicit = eomc.sources(from_scene(parse(EXPLICIT, "test.toml"))).files["stepped.c"]
    assert "rk4_derivative(" in explicit and "_eliminate(" not in explicit


@pytest.mark.parametrize(
    ("run", "signal", "message"),
    [
        ("discretize = true", "sign(theta)", "a signal jumps.*do without discretize"),
        ("discretize = 1", "theta", "run.discretize: must be true or false"),
    ],
)
def test_scenes_that_cannot_be_discretized_are_refused(run: str, signal: str, message: str) -> None:
    text = LOOP.replace("k*theta + 3*lean*theta_dot - x_dot**2", signal) + run
    with pytest.raises(EomcError, match=message):
        eomc.sources(from_scene(parse(text, "test.toml")))


def test_system_from_python_can_be_discretized(modules: Modules) -> None:
    scene_system = eomc.System.make(
        "slider", ["x"], "x_dot**2/2", "x**4", inputs={"F": 0}, forces={"x": "F"}, discretize=True
    )
    Phi, Gamma = modules.unoptimised(scene_system).discretize([0.0], [1.0], 0.1, u=[0.0])
    assert Phi.shape == (2, 2) and Gamma == pytest.approx(np.array([[0.005], [0.1]]), rel=1e-3)


@pytest.mark.slow
def test_wrong_derivative_fails_the_check(modules: Modules) -> None:
    class PerturbedModule:
        def __getattr__(self, name: str) -> Any:
            return getattr(m, name)

        def discretize(self, *state: Any, **options: Any) -> Any:
            matrices = [*m.discretize(*state, **options)]
            matrices[self.which] *= 1 + 1e-5
            return matrices

        def __init__(self, which: int) -> None:
            self.which = which

    m, scene_system = modules.unoptimised(EXPLICIT), from_scene(parse(EXPLICIT, "test.toml"))
    for module, passed in ((m, True), (PerturbedModule(1), False), (PerturbedModule(2), False)):
        comparison = Comparison(scene_system, module, np.random.default_rng(0), 4)
        results = comparison.report(equations.step_derivative_checks)
        assert [row.passed for row in results] == [passed] * 3, results
    assert [row.name for row in results] == [f"discretize by {x}" for x in m.methods]
