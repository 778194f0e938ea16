"""Taylor arithmetic is compared with written-out equations, closed forms and mpmath."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st
from support.cases import ALIKE, FEW_ALIKE, scene_system
from support.session import EVERYTHING, tiers
from sympy import atan2, cos, sin

from eomc.base.errors import EomcError
from eomc.model import algebra
from eomc.model.system import Coordinate, Parameter, System, dot, from_scene, symbol, t
from eomc.runtime import mathematics
from eomc.scene.read import parse
from eomc.verify import symbolic, taylor
from eomc.verify.symbolic import SymbolicReference, derive
from eomc.verify.taylor import Dual, StateVariables, TaylorReference

NAMES = (
    *("D", "C", "g", "bias", "tau", "kinetic", "potential", "energy", "jacobi", "power"),
    "signals",
)

x, v = symbol("x"), symbol("x_dot")


def states(system: System, rows: int = 4, seed: int = 0) -> dict[str, Any]:
    """Return random states as rows, with parameters around their defaults."""
    random = np.random.default_rng(seed)
    return {
        "q": random.uniform(0.2, 1.2, (rows, len(system.q))),
        "qd": random.uniform(-2, 2, (rows, len(system.q))),
        "t": random.uniform(0, 3, rows),
        "params": {p.name: p.value * random.uniform(0.8, 1.3, rows) for p in system.parameters},
    }


def assert_alike(system: System, tolerance: float = 1e-12, rows: int = 4) -> None:
    """Compare every value within a few thousand roundings of its terms.

    The terms of C and of the forces are as large as D times rates, even if they cancel.
    """
    plain, quick = derive(system), TaylorReference(system)
    at = states(system, rows)
    sizes = {name: np.max(np.abs(plain.evaluate(name, **at)), initial=0) for name in NAMES}
    assert np.isfinite(list(sizes.values())).all()
    speed = 1 + np.max(np.abs(at["qd"]))
    sizes["C"] += sizes["D"] * speed
    force = sizes["bias"] + sizes["tau"] + sizes["C"] * speed
    sizes |= dict.fromkeys(("g", "bias", "tau"), force)
    energy = sizes["kinetic"] + sizes["potential"]
    sizes |= dict.fromkeys(("energy", "jacobi"), energy) | {"power": force * speed}
    for name in NAMES:
        expected, computed = plain.evaluate(name, **at), quick.evaluate(name, **at)
        assert computed.shape == expected.shape, name
        assert computed.dtype == expected.dtype
        np.testing.assert_allclose(
            computed, expected, rtol=0, atol=tolerance * sizes[name], err_msg=name
        )


def everything() -> System:
    return from_scene(parse(EVERYTHING, "everything.toml"))


def chain(links: int) -> System:
    """Return point masses on rods in relative angles: positions as definitions, K from their
    rates.
    """
    q = [symbol(f"q{k}") for k in range(1, links + 1)]
    g, m, length = symbol("g"), symbol("m"), symbol("l")
    definitions: dict[Any, Any] = {}
    a = px = py = kinetic = potential = sympy.S.Zero
    for k in range(links):
        names = [symbol(f"{name}{k + 1}") for name in ("a", "px", "py")]
        bodies = (a + q[k], px + length * sin(names[0]), py - length * cos(names[0]))
        definitions |= dict(zip(names, bodies, strict=True))
        a, px, py = names
        kinetic += m * (dot(px) ** 2 + dot(py) ** 2) / 2
        potential += m * g * py
    return System.make(
        f"chain_{links}", q, kinetic, potential, definitions=definitions,
        parameters={g: 9.81, m: 0.7, length: 1.3},
    )  # fmt: skip


# --- comparison with written-out equations --------------------------------------------------------


@pytest.mark.parametrize("name", tiers(ALIKE, *FEW_ALIKE))
def test_every_value_of_every_scene(name: str) -> None:
    assert_alike(scene_system(name))


def test_every_function_of_the_formula_language() -> None:
    assert_alike(everything())


@pytest.mark.slow
@pytest.mark.parametrize("links", [2, 3])
def test_chains(links: int) -> None:
    assert_alike(chain(links), rows=2)


def test_all_terms_of_a_general_kinetic_energy() -> None:
    """Gyroscopic terms, a part without velocities, explicit time in D and in a definition."""
    y, w, k, u = symbol("y"), symbol("y_dot"), symbol("k"), symbol("u")
    point = symbol("point")
    kinetic = (1 + dot(t**3 + k)) * v**2 / 2 + x**2 * t * w * y + x**3 * v * y + w**2 * (2 + x**2)
    system = System.make(
        "general", [x, y], kinetic + (dot(point) + k * w) ** 2 + x**3 * sin(t) * y, k * x**2 * t,
        parameters={k: 3}, definitions={point: (x + y**2) * cos(t * x)},
        dissipation=sympy.sqrt(1 + v**2) * y, forces={x: u * x}, inputs={u: 5 * t + v},
    )  # fmt: skip
    assert_alike(system)


FUNCTIONS = [
    sin,
    cos,
    sympy.tanh,
    sympy.atan,
    lambda e: sympy.exp(-(e**2)),
    lambda e: 1 / (2 + e * e),
]


@st.composite
def expressions(draw: st.DrawFn, leaves: tuple[Any, ...], depth: int = 3) -> Any:
    """Draw sums, products, powers and smooth functions of the leaves."""
    if depth == 0 or draw(st.integers(0, 4)) == 0:
        return draw(st.sampled_from(leaves))
    inner = expressions(leaves, depth - 1)
    kind = draw(st.sampled_from(["sum", "product", "function", "power"]))
    if kind == "sum":
        return draw(inner) + draw(st.sampled_from([-2, -0.5, 1, 3])) * draw(inner)
    if kind == "product":
        return draw(inner) * draw(inner)
    if kind == "power":
        return sympy.sqrt(2 + draw(inner) ** 2)
    return draw(st.sampled_from(FUNCTIONS))(draw(inner))


MANY = settings(max_examples=20, deadline=None, derandomize=True)


@pytest.mark.slow
@MANY
@drawn(st.data())
def test_many_random_systems(data: st.DataObject) -> None:
    compare_a_random_system(data)


def compare_a_random_system(data: st.DataObject) -> None:
    """Compare points at random formulas of two coordinates, the time and each other."""
    y, (a, b) = symbol("y"), (symbol("a"), symbol("b"))
    first = data.draw(expressions((x, y, t, sympy.Rational(1, 3))))
    second = data.draw(expressions((x, y, a), 2))
    system = System.make(
        "at_random", [x, y], dot(a) ** 2 + dot(a) * dot(b) * cos(y) + (v + symbol("y_dot")) ** 2,
        data.draw(expressions((x, y, a, b), 2)), definitions={a: first, b: second},
        dissipation=dot(b) ** 2 + v**2 / 7,
    )  # fmt: skip
    assert_alike(system, tolerance=1e-11, rows=2)


# --- comparison with closed forms and mpmath ------------------------------------------------------


def absolute_chain(n: int) -> System:
    """Return n point masses on massless rods, in the absolute angles of the rods."""
    q = [symbol(f"q{k}") for k in range(n)]
    masses = [Parameter(f"m{k}", 1 + 0.1 * k) for k in range(n)]
    lengths = [Parameter(f"l{k}", 0.5 + 0.03 * k) for k in range(n)]
    definitions: list[Any] = []
    px = py = kinetic = potential = sympy.S.Zero
    for k in range(n):
        names = symbol(f"px{k}"), symbol(f"py{k}")
        length, m = lengths[k].symbol, masses[k].symbol
        definitions += zip(names, (px + length * sin(q[k]), py - length * cos(q[k])), strict=True)
        px, py = names
        kinetic += m * (dot(px) ** 2 + dot(py) ** 2) / 2
        potential += 9.81 * m * py
    coordinates = tuple(Coordinate(str(s), "rad") for s in q)
    return System(
        "absolute", coordinates, kinetic, potential,
        parameters=(*masses, *lengths), definitions=tuple(definitions),
    )  # fmt: skip


def test_chain_of_20_masses_agrees_with_the_closed_form() -> None:
    """D_ij = mu_ij l_i l_j cos(q_i - q_j), C_ij = mu_ij l_i l_j sin(q_i - q_j) qd_j.

    mu_ij is the mass that hangs below both; bias = C qd + g.
    """
    n = 20
    reference, random = TaylorReference(absolute_chain(n)), np.random.default_rng(3)
    m, length = 1 + 0.1 * np.arange(n), 0.5 + 0.03 * np.arange(n)
    below = np.cumsum(m[::-1])[::-1]
    i = np.arange(n)
    mu = below[np.maximum.outer(i, i)] * np.outer(length, length)
    for _ in range(3):
        q, qd = random.uniform(-3, 3, (2, n))
        D, sines = (mu * f(np.subtract.outer(q, q)) for f in (np.cos, np.sin))
        g = 9.81 * below * length * np.sin(q)
        close = {"rtol": 0, "atol": 1e-13 * np.max(mu) * n}
        np.testing.assert_allclose(reference.evaluate("D", q), D, **close)
        np.testing.assert_allclose(reference.evaluate("C", q, qd), sines * qd, **close)
        np.testing.assert_allclose(reference.evaluate("g", q), g, rtol=1e-13)
        np.testing.assert_allclose(reference.evaluate("bias", q, qd), sines @ qd**2 + g, **close)
        np.testing.assert_allclose(
            reference.acceleration(q, qd), np.linalg.solve(D, -sines @ qd**2 - g), rtol=1e-10
        )
        energy = qd @ D @ qd / 2 - 9.81 * below * length @ np.cos(q)
        assert reference.evaluate("energy", q, qd) == pytest.approx(energy, rel=1e-13)


ANALYTIC = tuple(f.name for f in mathematics.ANALYTIC if len(f.arguments) == 1)
# a formula of x, and the same with mpmath
FORMULAS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    **{
        name: (algebra.CLASSES[name](x), algebra.mpmath_functions(mpmath)[name])
        for name in ANALYTIC
        if name not in ("acosh", "sqrt")
    },
    "acosh": (sympy.acosh(x + 1), lambda z: mpmath.acosh(z + 1)),
    "hypot": (algebra.hypot(x, 2 - x), lambda z: mpmath.hypot(z, 2 - z)),
    "sqrt": (sympy.sqrt(x), mpmath.sqrt),
    "abs": (sympy.Abs(x * x - 2) * x, lambda z: abs(z * z - 2) * z),
    "sign": (sympy.sign(x - 2) * x**3, lambda z: -(z**3)),
    "heaviside": (sympy.Heaviside(2 - x) * x**3, lambda z: z**3),
    "square": (x**2, lambda z: z**2),
    "cube": (x**3, lambda z: z**3),
    "inverse": (1 / x, lambda z: 1 / z),
    "inverse square": (x**-2, lambda z: z**-2),
    "fifth of a third": (x ** sympy.Rational(5, 3), lambda z: z ** (mpmath.mpf(5) / 3)),
    "decimal power": (x**sympy.Float(1.3), lambda z: z ** mpmath.mpf(1.3)),
    "power of a parameter": (symbol("p") ** x, lambda z: mpmath.mpf(1.7) ** z),
    "to a parameter": (x ** symbol("p"), lambda z: z ** mpmath.mpf(1.7)),
    "to itself": ((1 + x) ** (2 * x), lambda z: (1 + z) ** (2 * z)),
    "atan2": (atan2(x**2 - 1, sin(x) - 2), lambda z: mpmath.atan2(z**2 - 1, mpmath.sin(z) - 2)),
    "atan2 of a number": (atan2(x, -3), lambda z: mpmath.atan2(z, -3)),
    "atan2 at 0": (atan2(1, x - x**2 * 2 + 0.4), lambda z: mpmath.atan2(1, z - z * z * 2 + 0.4)),
    "min": (sympy.Min(x**2, x + 1, 3 - x), lambda z: z**2),
    "max": (sympy.Max(x**2 - 5, x**3 + 1, x), lambda z: z**3 + 1),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_first_and_second_derivatives(name: str) -> None:
    """K = ydot^2/2 and P = y of y(x): D = y'^2, g = y', bias = y' y'' v^2 + y', C = y' y'' v."""
    formula, exact = FORMULAS[name]
    y, p = symbol("y"), symbol("p")
    system = System.make("free", [x], dot(y) ** 2 / 2, y, definitions={y: x}, parameters={p: 1.7})
    # Without validation: energies refuse discontinuous functions, whose rules are used in forces.
    reference = TaylorReference(
        replace(system, definitions=tuple((name, formula) for name, _ in system.definitions))
    )
    for at in (0.3, 0.9):
        with mpmath.workdps(40):
            value, slope, bend = (float(mpmath.diff(exact, mpmath.mpf(at), n)) for n in range(3))
        for name, expected in {
            "potential": value, "D": slope**2, "g": slope, "C": slope * bend * 2,
            "bias": slope * bend * 4 + slope, "kinetic": 2 * slope**2,
        }.items():  # fmt: skip
            size = abs(value) + slope**2 + abs(slope) * (1 + abs(bend))
            assert np.ravel(reference.evaluate(name, [at], [2.0])) == pytest.approx(
                expected, rel=1e-13, abs=1e-14 * size
            ), name


# --- detection of errors --------------------------------------------------------------------------


def without_tangent(method: str) -> tuple[type, str, Callable[..., Any]]:
    """Return a breakage of dual numbers: results of a method are constant."""
    right = getattr(Dual, method)
    return Dual, method, lambda *args: Dual(right(*args).value)


def at_fixed_time(x: StateVariables) -> StateVariables:
    return x.with_tangents(q=x.qd)


BREAKAGES: dict[str, tuple[type, str, Any]] = {
    "tangents of sums": without_tangent("__add__"),
    "tangents of products": without_tangent("__mul__"),
    "tangents of powers": without_tangent("__pow__"),
    "tangents of quotients": without_tangent("__rtruediv__"),
    "tangents of differences": without_tangent("__neg__"),
    "the time's share": (StateVariables, "in_time", property(at_fixed_time)),
}


@pytest.mark.parametrize("what", BREAKAGES)
def test_missing_rule_is_detected(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*BREAKAGES[what])
    with pytest.raises(AssertionError):
        assert_alike(everything())


@pytest.mark.parametrize("name", ANALYTIC)
@pytest.mark.parametrize("part", ["value", "tangent"])
def test_wrong_sign_in_a_function_is_detected(
    name: str, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = taylor.FUNCTIONS[name]

    def wrong(x: Any) -> Any:
        y = right(x)
        if not isinstance(y, Dual):
            return -y if part == "value" else y
        return replace(y, **{part: -getattr(y, part)}) if y.tangent is not None else y

    monkeypatch.setitem(taylor.COMPILED, name, wrong)
    with pytest.raises(AssertionError):
        test_first_and_second_derivatives(name)


def test_complex_value_is_nan_in_its_row_only() -> None:
    reference = TaylorReference(System.make("fall", [x], v**2 / 2, 1 / x + sympy.log(x)))
    values = reference.evaluate("g", [[0.0], [-1.0], [2.0]])
    assert np.isnan(values[0]).all()
    assert values[2] == pytest.approx(-1 / 4 + 1 / 2)
    assert np.isnan(reference.evaluate("potential", [-1.0]))
    edge = TaylorReference(System.make("edge", [x], dot(abs(x)) ** 2 + v**2, 0))
    assert np.isnan(edge.evaluate("bias", [0.0], [1.0])).all()
    edge = TaylorReference(System.make("edge", [x], v**2, abs(x)))
    assert edge.evaluate("g", [0.0]) == 0


def test_division_by_zero_parameters_issues_no_warnings() -> None:
    k = symbol("k")
    reference = TaylorReference(
        System.make("zero", [x], v**2, x / k + sympy.log(k) + x**k, parameters={k: 0})
    )
    assert np.isnan(reference.evaluate("g", [1.0])).all()
    assert reference.evaluate("D", [1.0]) == 2


# --- interface ------------------------------------------------------------------------------------


def test_rows_are_states() -> None:
    """Compare many states, states in blocks, single states, and rows of the symbolic reference."""
    system = scene_system("cartpole_driven")
    plain, quick = derive(system), TaylorReference(system)
    at = states(system, 7)
    u = np.linspace(-1, 1, 7)[:, None]
    for inputs in (None, u):
        for name in NAMES:
            rows = quick.evaluate(name, **at, u=inputs)
            for i in (0, 6):
                q, qd, when = at["q"][i], at["qd"][i], at["t"][i]
                params = {p: values[i] for p, values in at["params"].items()}
                one = (q, qd, when, None if inputs is None else inputs[i], params)
                np.testing.assert_allclose(quick.evaluate(name, *one), rows[i], rtol=1e-14)
                np.testing.assert_array_equal(
                    plain.evaluate(name, *one), plain.evaluate(name, **at, u=inputs)[i]
                )
    many = states(system, 40_000)
    np.testing.assert_array_equal(
        quick.evaluate("C", **many)[:7], quick.evaluate("C", **states(system, 40_000))[:7]
    )
    last = {"q": many["q"][-3:], "qd": many["qd"][-3:], "t": many["t"][-3:]}
    params = {p: values[-3:] for p, values in many["params"].items()}
    np.testing.assert_allclose(
        quick.evaluate("C", **last, params=params), quick.evaluate("C", **many)[-3:], rtol=1e-13
    )
    with pytest.raises(EomcError, match="'mc' is not a parameter"):
        quick.evaluate("D", at["q"][0], params={"mc": 5.0})


def test_runs_equal_those_of_the_symbolic_reference() -> None:
    system = scene_system("cartpole_driven")
    plain, quick = derive(system), TaylorReference(system)
    for one, other in zip(plain.simulate(steps=20), quick.simulate(steps=20), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    times, q, qd = quick.simulate([[0.1, 3], [0.2, 2]], [[0, 1], [1, 0]], steps=3)
    assert times.shape == (4,)
    assert q.shape == qd.shape == (4, 2, 2)
    _, alone, _ = quick.simulate([0.2, 2], [1, 0], steps=3)
    np.testing.assert_allclose(q[:, 1], alone, rtol=1e-14)


def test_size_selects_the_reference() -> None:
    assert isinstance(symbolic.reference_for(scene_system("heavy_top")), SymbolicReference)
    assert isinstance(symbolic.reference_for(chain(2)), SymbolicReference)
    assert symbolic.is_small(chain(3))
    assert isinstance(symbolic.reference_for(chain(8)), TaylorReference)


@pytest.mark.slow
def test_fifty_links_are_quick() -> None:
    system = chain(50)
    start_time = time.process_time()
    reference = TaylorReference(system)
    q = np.full(50, 0.1)
    reference.acceleration(q, q)  # D, bias and tau: about 0.02 s
    assert time.process_time() - start_time < 1
    D, C = reference.evaluate("D", q), reference.evaluate("C", q, q)
    assert np.all(np.linalg.eigvalsh(D) > 0)
    balance = C @ q + reference.evaluate("g", q) - reference.evaluate("bias", q, q)
    assert np.max(np.abs(balance)) < 1e-13 * np.max(np.abs(reference.evaluate("bias", q, q))) * 50
    assert math.isfinite(reference.evaluate("jacobi", q, q))
