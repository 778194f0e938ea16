"""Products of the accelerations' Jacobian with vectors, compared with 40-digit differences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from support.cases import SCENES, text_of, variant
from support.session import MODULES, Modules, tiers

import eomc
from eomc.derive import lagrange
from eomc.model.system import System, from_scene
from eomc.pipeline import assemble
from eomc.program import program
from eomc.program.ir import Function, Sum, evaluator, nearby
from eomc.program.program import Program
from eomc.program.routes import weight
from eomc.scene.read import parse
from eomc.verify import equations, symbolic
from eomc.verify.comparison import Comparison

PRODUCTS = ("acceleration_jvp", "acceleration_vjp")
ALL_SCENES = tuple(sorted(path.stem for path in SCENES.glob("*.toml")))
QUICK = ("cartpole_driven", "four_bar")


def with_products(scene: str) -> str:
    """Return the text of a scene that requests products."""
    lines = text_of(scene, 'linearize = "products"').splitlines()
    return "\n".join(line for line in lines if line != "linearize = true")


def build(text: str) -> Program:
    return program.build(lagrange.derive(assemble(from_scene(parse(text, "test.toml")))))


def jacobian(system: System, q: Any, qd: Any, t: float, u: Any, p: Any) -> Any:
    """Return d(qdd)/d[q, qd, u, p], (nq, 2 nq + nu + np), by differences with 50 digits."""
    motion = symbolic.derive(system).motion
    n, parameters = len(q), [x.symbol for x in system.parameters]
    symbols = (*system.q, *system.qd, *system.u, *parameters, sympy.Symbol("t", real=True))
    evaluate = sympy.lambdify(symbols, list(motion), "mpmath")

    def acceleration(x: Any) -> Any:
        values = [mpmath.mpf(number) for number in evaluate(*x, mpmath.mpf(t))]
        D = mpmath.matrix(n, n)
        for k in range(n * n):
            D[k // n, k % n] = values[k]
        forces = [values[n * n + n + k] - values[n * n + k] for k in range(n)]
        return mpmath.lu_solve(D, mpmath.matrix(forces))

    with mpmath.workdps(50):
        x, h = [mpmath.mpf(float(v)) for v in (*q, *qd, *u, *p)], mpmath.mpf(10) ** -20
        columns = []
        for k in range(len(x)):
            up, down = (
                acceleration([v + s * h * (i == k) for i, v in enumerate(x)]) for s in (1, -1)
            )
            columns.append([float(d) for d in (up - down) / (2 * h)])
    return np.array(columns).T


@pytest.mark.parametrize(
    "scene",
    tiers(
        ("cartpole_driven", "double_pendulum", "furuta_pendulum", "kapitza_pendulum", "acrobot"),
        "cartpole_driven",
    ),
)
@pytest.mark.usefixtures("quickly_compiled")
def test_products_agree_with_differences_of_fifty_digits(scene: str) -> None:
    text = with_products(scene)
    m: Any = eomc.load(variant(scene, f"prod_{scene}", linearize='"products"'), MODULES)
    system, random = from_scene(parse(text, "test.toml")), np.random.default_rng(1)
    n, nu, parameters = m.nq, m.nu, np.array(list(m.defaults.values()))
    q, qd, u, t = m.start[0] + 0.3, m.start[1] + 0.7, random.standard_normal(nu), 0.3
    p = parameters * (1 + 0.1 * random.standard_normal(len(parameters)))
    J = jacobian(system, q, qd, t, u, p)
    limit = 1e-13 * np.max(np.abs(J))
    inputs = {"t": t, "u": u if nu else None, "params": dict(zip(m.parameters, p, strict=True))}
    w, v = random.standard_normal(n), random.standard_normal(2 * n + nu + len(p))
    parts = m.acceleration_vjp(q, qd, w, **inputs)
    assert [len(x) for x in parts] == [n, n, nu, len(p)]
    assert np.max(np.abs(np.concatenate(parts) - w @ J)) < limit * np.sum(np.abs(w))
    along = np.split(v, [n, 2 * n, 2 * n + nu])
    rates = m.acceleration_jvp(q, qd, along, **inputs)
    assert np.max(np.abs(rates - J @ v)) < limit * np.sum(np.abs(v))


@pytest.mark.parametrize("scene", tiers(ALL_SCENES, *QUICK))
def test_products_are_those_of_the_jacobian_and_cost_few_accelerations(scene: str) -> None:
    """The operations are weighted as for the choice of a route: a division 8, a sincos 25."""
    built = build(with_products(scene))
    s, one = built.system, weight(built["acceleration"].cost)
    assert weight(built["acceleration_vjp"].cost) <= 5 * one
    assert weight(built["acceleration_jvp"].cost) <= 6 * one
    values, n = states(built), len(s.q)
    by_rows = [
        evaluator(built[name])(values)[0]
        for name in ("linearization", "sensitivity")
        if name in built
    ]
    J = np.hstack([np.reshape(rows, (n, -1)) for rows in by_rows])
    w, v = (np.array([values[f"{x}_along_"] for x in names]) for names in variables(s))
    rates, bar = (np.array(evaluator(built[name])(values)[0]) for name in PRODUCTS)
    np.testing.assert_allclose(bar, w @ J, rtol=1e-10, atol=1e-10 * np.max(np.abs(J)))
    np.testing.assert_allclose(rates, J @ v, rtol=1e-10, atol=1e-10 * np.max(np.abs(J)))


def variables(s: System) -> tuple[list[str], list[str]]:
    """Return the names of the accelerations, and those of [q, qd, u, p]."""
    parameters = [p.symbol for p in s.parameters]
    return [x.name for x in s.qdd], [x.name for x in (*s.q, *s.qd, *s.u, *parameters)]


def states(built: Program) -> dict[str, float]:
    """Return values of all variables near the start, and entries of both vectors."""
    s, random = built.system, np.random.default_rng(2)
    values = {**nearby(s, 1), "t": 0.4, **{x.name: float(random.standard_normal()) for x in s.u}}
    names = [name for names in variables(s) for name in names]
    return values | {f"{name}_along_": float(random.standard_normal()) for name in names}


TURN = """eomc = 1
name = "turn"
[coordinates]
theta = { start = 0.3 }
x = { start = 0.1 }
[parameters]
m = 2.0
k = 4.0
[inputs]
force = { signal = "k*theta*sin(t)", limits = [-9, 9] }
[energy]
kinetic = "m*theta_dot**2 + x_dot**2 + theta_dot*x_dot*cos(theta)"
potential = "m*9.81*cos(theta) + k*x**2"
[forces]
theta = "force*(1 + heaviside(t - 0.5))"
[run]
linearize = "products"
"""


def test_products_of_many_states_agree_with_single_states(modules: Modules) -> None:
    m, random = modules.unoptimised(TURN), np.random.default_rng(5)
    q, qd, w = random.standard_normal((3, 6, 2))
    t, u = np.linspace(0, 1, 6), random.standard_normal((6, 1))
    k = np.linspace(1, 2, 6)
    along = (q + 1, None, u - 1, [0.3, 0.4])
    for inputs in ({}, {"u": u}):
        bars = m.acceleration_vjp(q, qd, w, t=t, params={"k": k}, **inputs)
        rates = m.acceleration_jvp(q, qd, along, t=t, params={"k": k}, **inputs)
        assert [x.shape for x in bars] == [(6, 2), (6, 2), (6, 1), (6, 2)]
        for i in range(6):
            own = {"t": t[i], "params": {"k": k[i]}} | {n: x[i] for n, x in inputs.items()}
            one = m.acceleration_vjp(q[i], qd[i], w[i], **own)
            assert all(np.array_equal(a[i], b) for a, b in zip(bars, one, strict=True))
            direction = (q[i] + 1, np.zeros(2), u[i] - 1, [0.3, 0.4])
            assert np.array_equal(m.acceleration_jvp(q[i], qd[i], direction, **own), rates[i])
    assert np.array_equal(
        m.acceleration_jvp(q, qd, (q,)), m.acceleration_jvp(q, qd, (q, None, None, np.zeros(2)))
    )


def test_invalid_arguments_of_products_are_named(modules: Modules) -> None:
    m, q = modules.unoptimised(TURN), np.ones(2)
    for words, call in (
        (r"qdd_bar: shape \(3,\), expected \(2,\)", lambda: m.acceleration_vjp(q, q, np.ones(3))),
        (r"along\[2\]: shape \(2,\)", lambda: m.acceleration_jvp(q, q, (q, q, q))),
        ("along: 5 entries", lambda: m.acceleration_jvp(q, q, (None,) * 5)),
        (r"along\[0\]: not all", lambda: m.acceleration_jvp(q, q, (q * np.nan,))),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    polar = 'eomc = 1\nname = "polar"\n[coordinates]\nr = { start = 1 }\nphi = {}\n[energy]\n'
    polar += 'kinetic = "(r_dot**2 + r**2*phi_dot**2)/2"\n[run]\nlinearize = "products"\n'
    singular = modules.unoptimised(polar)
    at = np.array([[1.0, 0], [0, 3]])
    with pytest.raises(singular.MotionError, match=r"at q = \[0. 3.\].*positive definite"):
        singular.acceleration_vjp(at, 0 * at, at)
    with pytest.raises(singular.MotionError, match=r"at q = \[0. 3.\].*positive definite"):
        singular.acceleration_jvp(at, 0 * at, (at,))
    with pytest.raises(
        AttributeError, match=r'acceleration_vjp: not built.*linearize = "products"'
    ):
        _ = modules("cartpole").acceleration_vjp
    with pytest.raises(eomc.SceneError, match="accelerations jump"):
        build(TURN.replace("t - 0.5", "theta_dot"))


def mutants(function: Function) -> Iterator[Function]:
    """Yield the function with the sign of each term of each sum changed, one at a time."""
    for k, a in enumerate(function.body):
        if isinstance(a.value, Sum):
            for i, (factor, name) in enumerate(a.value.terms):
                terms = list(a.value.terms)
                terms[i] = (-factor, name)
                value = Sum(tuple(terms), a.value.constant)
                body = [*function.body]
                body[k] = dataclasses.replace(a, value=value)
                yield dataclasses.replace(function, body=tuple(body))


class Interpreted:
    """A module whose products are evaluated in Python, by a function of the program."""

    def __init__(self, module: ModuleType, system: System, function: Function) -> None:
        self.module, self.system, self.function = module, system, evaluator(function)
        self.name = function.name

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def product(self, q: Any, qd: Any, vectors: Any, t: float, u: Any, params: Any) -> Any:
        s, rows = self.system, []
        u = self.module.signal(q[0], qd[0], t, params) if u is None and s.u else u
        names = variables(s)[self.name == "acceleration_jvp"]
        for position, velocity, vector in zip(q, qd, vectors, strict=True):
            values = dict(zip((x.name for x in (*s.q, *s.qd)), (*position, *velocity), strict=True))
            values |= {**self.module.defaults, **(params or {}), "t": t}
            values |= {
                x.name: number for x, number in zip(s.u, () if u is None else u, strict=True)
            }
            values |= dict(zip((f"{name}_along_" for name in names), vector, strict=True))
            rows.append(self.function({name: float(x) for name, x in values.items()})[0])
        return np.array(rows)

    def acceleration_vjp(self, q: Any, qd: Any, qdd_bar: Any, **how: Any) -> Any:
        if self.name != "acceleration_vjp":
            return self.module.acceleration_vjp(q, qd, qdd_bar, **how)
        n, m = len(self.system.q), len(self.system.u)
        return np.split(self.product(q, qd, qdd_bar, **how), [n, 2 * n, 2 * n + m], axis=1)

    def acceleration_jvp(self, q: Any, qd: Any, along: Any, **how: Any) -> Any:
        if self.name != "acceleration_jvp":
            return self.module.acceleration_jvp(q, qd, along, **how)
        return self.product(q, qd, np.hstack(along), **how)


@pytest.mark.parametrize("name", tiers(PRODUCTS, "acceleration_vjp"))
def test_check_detects_every_wrong_sign_in_a_product(modules: Modules, name: str) -> None:
    text = TURN.replace("*(1 + heaviside(t - 0.5))", "").replace(", limits = [-9, 9]", "")
    module, built = modules.unoptimised(text), build(text)
    system, right = built.system, built[name]
    functions, point = [right, *mutants(right)], states(built)
    assert len(functions) > 10
    for function in functions:
        wrong = Interpreted(module, system, function)
        comparison = Comparison(system, wrong, np.random.default_rng(0), 2)
        results = {r.name: r.passed for r in comparison.report(equations.derivative_checks)}
        expected, values = (np.array(evaluator(f)(point)[0]) for f in (right, function))
        assert np.allclose(values, expected, rtol=1e-9) == (function is right)
        assert results.pop(name) == (function is right)
        assert all(results.values())
