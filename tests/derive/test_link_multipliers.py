"""Test accelerations by link multipliers: values, cost, and systems that are refused.

In 40 digits the route agrees with Lagrange's equations to the last bit of a double. In doubles it
is compared with verify/taylor.py, which shares no code with it. Only the last tests compile C.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import trees
from support.point_masses import (
    A_DOT,
    B_DOT,
    C_DOT,
    CHAIN,
    L,
    R,
    a,
    b,
    by_multipliers,
    c,
    cheapest,
    cos,
    independent,
    k,
    link_end,
    links,
    m,
    moving,
    read_system,
    sin,
    states,
    x,
    y,
)
from support.session import tiers

from eomc.derive import lagrange
from eomc.derive.ldl import Solution
from eomc.model.system import System, dot, t
from eomc.program.ir import Function, evaluate
from eomc.program.lower import lower

EPS = 2.0**-52

FEW = settings(
    derandomize=True, deadline=None, max_examples=4, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
MANY = settings(FEW, max_examples=24)


def by_lagrange(system: System) -> Function:
    _, function, _ = lagrange._by_lagrange(system)
    assert isinstance(function, Solution)
    return lower("acceleration", function.tape, function.acceleration, checks=function.pivots)


def assert_agrees_with_lagrange(system: System) -> Function:
    """Assert agreement with Lagrange's equations in 40 digits, and with jets in doubles."""
    function, lagrange_function = by_multipliers(system), by_lagrange(system)
    for state in states(system):
        exact, regular = evaluate(function, state, exact=True)
        other, _ = evaluate(lagrange_function, state, exact=True)
        assert regular
        size = np.max(np.abs(other))
        # 40 digits less the digits lost by two eliminations, rounded to doubles
        np.testing.assert_allclose(exact, other, rtol=4 * EPS, atol=4 * EPS * size)
        reference, condition = independent(system, state)
        result, regular = evaluate(function, state)
        assert regular
        scale = (1 + np.max(np.abs(reference))) * min(40 * condition * EPS, 1e-9)
        assert np.max(np.abs(np.subtract(result, reference))) <= scale
    return function


# --- links ---------------------------------------------------------------------------------------


SHAPES = {
    "pendulum": [-1],
    "chain": CHAIN,
    "two chains": [-1, 0, -1, 2],
    "fork": [-1, 0, 0, 1, 2],
    "broom": [-1, 0, 1, 1, 1],
}


# the quick tier takes two of the four ways to write a tree
WAYS = pytest.mark.parametrize(
    "equal, relative",
    [
        pytest.param(True, False, id="equal-absolute"),
        pytest.param(False, True, id="unequal-relative"),
        pytest.param(True, True, id="equal-relative", marks=pytest.mark.slow),
        pytest.param(False, False, id="unequal-absolute", marks=pytest.mark.slow),
    ],
)


@pytest.mark.slow
@pytest.mark.parametrize("shape", tiers(SHAPES, "pendulum", "fork"))
@WAYS
def test_masses_on_links_agree_with_lagrange(shape: str, equal: bool, relative: bool) -> None:
    assert_agrees_with_lagrange(read_system(links(SHAPES[shape], equal, relative)))


EVERYTHING = """potential = "m1*g*y1 + s*(x2 - 0.3)**2/2 + s*(q1 - q0)**2/2 + s*sin(q2)*y0*x1"
dissipation = "b*(q1_dot - q0_dot)**2/2 + b*q2_dot**2/2 + b*dot(x1)**2 + b*(dot(y2) - dot(y1))**2"
[forces]
q0 = "u*cos(q2) - b*q0_dot*q1_dot"
q2 = "sin(2*t) + u*x1" """


@WAYS
def test_forces_inputs_and_a_driven_pivot_agree_with_lagrange(equal: bool, relative: bool) -> None:
    more = EVERYTHING.replace("m1*", "m*") if equal else EVERYTHING
    assert_agrees_with_lagrange(
        read_system(links([-1, 0, 1], equal, relative, pivot="b*sin(3*t)", more=more))
    )


@pytest.mark.parametrize("relative", tiers([False, True], False), ids=["absolute", "relative"])
def test_explicit_positions_are_recognised(relative: bool) -> None:
    costs = {
        by_multipliers(read_system(links(CHAIN, relative=relative, written=written))).cost
        for written in (False, True)
    }
    assert len(costs) == 1
    assert_agrees_with_lagrange(read_system(links([-1, 0, 0, 2], False, relative, written=True)))


@pytest.mark.slow
@FEW
@given(st.data())
def test_random_tree_of_links_agrees_with_lagrange(data: Any) -> None:
    check_a_tree(data)


@pytest.mark.slow
@MANY
@given(st.data())
def test_many_random_trees_of_links_agree_with_lagrange(data: Any) -> None:
    check_a_tree(data)


def check_a_tree(data: Any) -> None:
    n = data.draw(st.integers(1, 6))
    parents = [data.draw(st.integers(-1, k - 1)) for k in range(n)]
    equal, relative, written = (data.draw(st.booleans()) for _ in range(3))
    assert_agrees_with_lagrange(read_system(links(parents, equal, relative, written)))


# --- what else is of this kind --------------------------------------------------------------------


def double_pendulum(first: tuple[Any, Any], q: list[Any], angle: Any = b, **others: Any) -> System:
    """Return a mass and a second one suspended from it."""
    return moving([first, link_end(first, R, angle)], q, **others)


O = (0, 0)  # noqa: E741 - the origin's name
ON_CART = link_end((x, 0), L, a)
SIDEWAYS = {x: L * sin(a), y: -L * cos(a), c: x + L * sin(b), R: y - L * cos(b)}

KINDS = {
    "cart and pendulum": moving([(x,), ON_CART], [x, a]),
    "a double pendulum on a cart": moving(
        [(x,), ON_CART, link_end(ON_CART, R, b)],
        [x, a, b],
        potential=k * (x**2 + cos(a) + 2 * cos(b) + x * b) / 3,
    ),
    "a wheel beside": moving([(x,), ON_CART], [x, a, b], m * B_DOT**2, potential=k * (x - b) ** 2),
    "rotors": double_pendulum(
        link_end(O, L, a),
        [a, b, c],
        more=(R * A_DOT**2 + k * C_DOT**2) / 2,
        potential=k * cos(a - c),
    ),
    "on a parabola": double_pendulum((a, a**2), [a, b]),
    "on an ellipse": moving([(2 * cos(a), sin(a)), (2 * cos(a) + b, sin(a))], [a, b]),
    "other axes": double_pendulum((L * cos(a), L * sin(a)), [a, b]),
    "from an angle": double_pendulum(link_end(O, L, a + k), [a, b], 2 * b),
    "in one factor": moving(
        [link_end(O, L, a), (L * (sin(a) + sin(b)), -L * (cos(a) + cos(b)))], [a, b]
    ),
    "halfway": moving([link_end(O, L / 2, a), link_end(link_end(O, L, a), R, b)], [a, b]),
    "growing": double_pendulum(link_end((0, t**2), t, a), [a, b], b - t),
    "sums and differences": double_pendulum(
        link_end(O, L, a - 2 * b), [a, b], a + b / 3, forces={a: A_DOT * k, b: a - 3 * b}
    ),
    "heavier sideways": System.make(
        "sideways",
        [a, b],
        m * (3 * dot(x) ** 2 + dot(y) ** 2) / 2 + m * (dot(c) ** 2 + dot(R) ** 2),
        k * y,
        parameters={m: 1.3, L: 0.6, k: 2.0},
        definitions=SIDEWAYS,
    ),
}


@pytest.mark.parametrize("kind", tiers(KINDS, *list(KINDS)[::3]))
def test_other_suitable_systems_agree_with_lagrange(kind: str) -> None:
    assert_agrees_with_lagrange(KINDS[kind])


@pytest.mark.slow
def test_point_bodies_in_relative_angles_agree_with_lagrange() -> None:
    """Their world coordinates depend on sums of angles."""
    system = read_system(trees.chain(4, points=True))
    assert system.tree is not None
    assert_agrees_with_lagrange(system)
    best, _ = cheapest(read_system(trees.chain(10, points=True)))
    assert best.route == "multipliers"
    assert {"articulated", "multipliers"} <= dict(best.routes).keys()
