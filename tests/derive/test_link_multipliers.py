"""Accelerations by link multipliers: the same as by D, at the promised cost, refused elsewhere.

In 40 digits the route must be Lagrange's to the last bit of a double; in doubles it is held
against verify/taylor.py, which shares nothing with it. Nothing is compiled but in the last tests.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import sympy
import trees
from cases import scene_system
from conftest import Modules, tiers
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eomc.derive import lagrange, link_multipliers
from eomc.derive.ldl import Solution
from eomc.model.from_scene import from_scene
from eomc.model.system import System, dot, symbol, t
from eomc.program import program
from eomc.program.interpret import evaluate
from eomc.program.ir import Call, Function
from eomc.program.lower import lower
from eomc.scene.read import parse
from eomc.verify.taylor import Jets

EPS = 2.0**-52
sin, cos = sympy.sin, sympy.cos

FEW = settings(
    derandomize=True, deadline=None, max_examples=4, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
MANY = settings(FEW, max_examples=24)


def made_of(text: str) -> System:
    return from_scene(parse(text, "links.toml"))


def by_multipliers(made: System) -> Function:
    """The acceleration by this route, whichever is the cheapest."""
    found = link_multipliers.solution(made)
    return lower("acceleration", found.tape, found.acceleration, found.pivots, ())


def by_lagrange(made: System) -> Function:
    _, found, _ = lagrange._by_lagrange(made)
    assert isinstance(found, Solution)
    return lower("acceleration", found.tape, found.acceleration, found.pivots, ())


def states(made: System, count: int = 3) -> list[dict[str, float]]:
    """Coordinates, velocities, parameters, inputs and time by name, at random."""
    random = np.random.default_rng(11)
    out = []
    for _ in range(count):
        state = {x.name: random.uniform(-1.5, 1.5) for x in made.q}
        state |= {x.name: random.uniform(-2, 2) for x in made.qd}
        state |= {p.name: p.value * random.uniform(0.7, 1.5) for p in made.parameters}
        state |= {x.name: random.uniform(-1, 1) for x in made.u}
        out.append({**state, "t": random.uniform(0, 3)})
    return out


def independent(made: System, state: Mapping[str, float]) -> tuple[np.ndarray, float]:
    """The acceleration from the energies' Taylor series, and the condition of D."""
    q, qd, u = ([state[x.name] for x in xs] for xs in (made.q, made.qd, made.u))
    params = {p.name: state[p.name] for p in made.parameters}
    answer = Jets(made)
    D = answer.evaluate("D", q, qd, state["t"], u, params)
    return answer.acceleration(q, qd, state["t"], u, params), float(np.linalg.cond(D))


def assert_right(made: System) -> Function:
    """In 40 digits the route is Lagrange's, in doubles as near to jets as D's condition lets be."""
    ours, theirs = by_multipliers(made), by_lagrange(made)
    for state in states(made):
        exact, regular = evaluate(ours, state, exact=True)
        other, _ = evaluate(theirs, state, exact=True)
        assert regular
        size = np.max(np.abs(other))
        # 40 digits less those that two eliminations lose, rounded to doubles
        np.testing.assert_allclose(exact, other, rtol=4 * EPS, atol=4 * EPS * size)
        right, condition = independent(made, state)
        found, regular = evaluate(ours, state)
        assert regular
        scale = (1 + np.max(np.abs(right))) * min(40 * condition * EPS, 1e-9)
        assert np.max(np.abs(np.subtract(found, right))) <= scale
    return ours


# --- links ---------------------------------------------------------------------------------------


def links(
    parents: list[int], equal: bool = True, relative: bool = False, written: bool = False,
    pivot: str = "", more: str = "",
) -> str:  # fmt: skip
    """Point masses on massless links, parents[k] < k the one that link k hangs on, -1: the pivot.

    equal: one mass and one length for all. relative: angles against the parent's link. written:
    positions without the parents' names. pivot: where it is, a function of t.
    """
    n = len(parents)
    names = [""] if equal else [str(k) for k in range(n)]
    lines = ["eomc = 1", 'name = "links"', "[coordinates]"]
    lines += [f"q{k} = {{ start = {0.3 + 0.1 * k:.1f} }}" for k in range(n)]
    lines += ["[parameters]", "g = 9.81", "b = 0.3", "s = 4.0"]
    lines += [
        f"m{x} = {1.0 + 0.25 * k}\nl{x} = {1.0 - 0.125 * (k % 4)}" for k, x in enumerate(names)
    ]
    lines += ["[inputs]", 'u = { signal = "sin(t)" }', "[definitions]"]
    x, y, a = ([""] * n for _ in range(3))
    for k, p in enumerate(parents):
        size = "l" if equal else f"l{k}"
        a[k] = f"{a[p]} + q{k}" if relative and p >= 0 else f"q{k}"
        before = (f"x{p} + ", f"y{p} ") if p >= 0 else (pivot and f"{pivot} + ", "")
        if written:
            before = (f"{x[p]} + ", f"{y[p]} ") if p >= 0 else (pivot and f"{pivot} + ", "")
        x[k], y[k] = f"{before[0]}{size}*sin({a[k]})", f"{before[1]}- {size}*cos({a[k]})"
        lines += [f'x{k} = "{x[k]}"', f'y{k} = "{y[k]}"']
    masses = ["m" if equal else f"m{k}" for k in range(n)]
    kinetic = " + ".join(f"{m}*(dot(x{k})**2 + dot(y{k})**2)/2" for k, m in enumerate(masses))
    heights = " + ".join(f"{m}*g*y{k}" for k, m in enumerate(masses))
    lines += ["[energy]", f'kinetic = "{kinetic}"', more or f'potential = "{heights}"']
    return "\n".join(lines)


CHAIN = [-1, 0, 1, 2, 3]
SHAPES = {
    "pendulum": [-1],
    "chain": CHAIN,
    "two chains": [-1, 0, -1, 2],
    "fork": [-1, 0, 0, 1, 2],
    "broom": [-1, 0, 1, 1, 1],
}


@pytest.mark.parametrize("shape", tiers(SHAPES, "pendulum", "fork"))
@pytest.mark.parametrize("equal", [True, False], ids=["equal", "unequal"])
@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
def test_masses_on_links(shape: str, equal: bool, relative: bool) -> None:
    assert_right(made_of(links(SHAPES[shape], equal, relative)))


EVERYTHING = """potential = "m1*g*y1 + s*(x2 - 0.3)**2/2 + s*(q1 - q0)**2/2 + s*sin(q2)*y0*x1"
dissipation = "b*(q1_dot - q0_dot)**2/2 + b*q2_dot**2/2 + b*dot(x1)**2 + b*(dot(y2) - dot(y1))**2"
[forces]
q0 = "u*cos(q2) - b*q0_dot*q1_dot"
q2 = "sin(2*t) + u*x1" """


@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
@pytest.mark.parametrize("equal", [True, False], ids=["equal", "unequal"])
def test_springs_dampers_forces_inputs_and_a_driven_pivot(relative: bool, equal: bool) -> None:
    more = EVERYTHING.replace("m1*", "m*") if equal else EVERYTHING
    assert_right(made_of(links([-1, 0, 1], equal, relative, pivot="b*sin(3*t)", more=more)))


@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
def test_positions_may_be_written_out(relative: bool) -> None:
    costs = {
        by_multipliers(made_of(links(CHAIN, relative=relative, written=written))).cost
        for written in (False, True)
    }
    assert len(costs) == 1
    assert_right(made_of(links([-1, 0, 0, 2], False, relative, written=True)))


@FEW
@given(st.data())
def test_any_tree_of_links(data: Any) -> None:
    look_at_a_tree(data)


@pytest.mark.slow
@MANY
@given(st.data())
def test_many_trees_of_links(data: Any) -> None:
    look_at_a_tree(data)


def look_at_a_tree(data: Any) -> None:
    n = data.draw(st.integers(1, 6))
    parents = [data.draw(st.integers(-1, k - 1)) for k in range(n)]
    equal, relative, written = (data.draw(st.booleans()) for _ in range(3))
    assert_right(made_of(links(parents, equal, relative, written)))


# --- what else is of this kind --------------------------------------------------------------------

a, b, c, x, y = (symbol(name) for name in "abcxy")
m, L, R, k = (symbol(name) for name in "mlrk")
A_DOT, B_DOT, C_DOT = (symbol(f"{name}_dot") for name in "abc")
PARAMETERS = {m: 1.3, L: 0.6, R: 0.4, k: 2.0}


def hung(from_: tuple[Any, Any], size: Any, angle: Any) -> tuple[Any, Any]:
    """The position at the end of a link."""
    return from_[0] + size * sin(angle), from_[1] - size * cos(angle)


def moving(points: list[tuple[Any, ...]], q: list[Any], more: Any = 0, **others: Any) -> System:
    """Masses m, 2m, ... with these positions; more: beside their kinetic energy."""
    kinetic = sum((j + 1) * m * sum(dot(e) ** 2 for e in p) / 2 for j, p in enumerate(points))
    potential = others.pop("potential", m * k * sum(p[-1] for p in points))
    return System.make("points", q, kinetic + more, potential, parameters=PARAMETERS, **others)


def two(first: tuple[Any, Any], q: list[Any], angle: Any = b, **others: Any) -> System:
    """A mass, and one that hangs on it."""
    return moving([first, hung(first, R, angle)], q, **others)


O = (0, 0)  # noqa: E741 - the origin's name
ON_CART = hung((x, 0), L, a)
SIDEWAYS = {x: L * sin(a), y: -L * cos(a), c: x + L * sin(b), R: y - L * cos(b)}

KINDS = {
    "cart and pendulum": moving([(x,), ON_CART], [x, a]),
    "a double pendulum on a cart": moving(
        [(x,), ON_CART, hung(ON_CART, R, b)],
        [x, a, b],
        potential=k * (x**2 + cos(a) + 2 * cos(b) + x * b) / 3,
    ),
    "a wheel beside": moving([(x,), ON_CART], [x, a, b], m * B_DOT**2, potential=k * (x - b) ** 2),
    "rotors": two(
        hung(O, L, a),
        [a, b, c],
        more=(R * A_DOT**2 + k * C_DOT**2) / 2,
        potential=k * cos(a - c),
    ),
    "on a parabola": two((a, a**2), [a, b]),
    "on an ellipse": moving([(2 * cos(a), sin(a)), (2 * cos(a) + b, sin(a))], [a, b]),
    "other axes": two((L * cos(a), L * sin(a)), [a, b]),
    "from an angle": two(hung(O, L, a + k), [a, b], 2 * b),
    "in one factor": moving(
        [hung(O, L, a), (L * (sin(a) + sin(b)), -L * (cos(a) + cos(b)))], [a, b]
    ),
    "halfway": moving([hung(O, L / 2, a), hung(hung(O, L, a), R, b)], [a, b]),
    "growing": two(hung((0, t**2), t, a), [a, b], b - t),
    "sums and differences": two(
        hung(O, L, a - 2 * b), [a, b], a + b / 3, forces={a: A_DOT * k, b: a - 3 * b}
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


@pytest.mark.parametrize("kind", KINDS)
def test_other_systems_of_the_kind(kind: str) -> None:
    assert_right(KINDS[kind])


def test_bodies_that_are_points_in_relative_angles() -> None:
    """Their world coordinates depend on sums of angles."""
    made = made_of(trees.chain(4, points=True))
    assert made.tree is not None
    assert_right(made)
    built = program.build(lagrange.derive(made_of(trees.chain(10, points=True))))
    assert built["acceleration"].route == "multipliers"
    assert {"articulated", "multipliers"} <= dict(built["acceleration"].routes).keys()


# --- what it costs -------------------------------------------------------------------------------


BATCH = "\n[run]\nbatch = true\n"


@pytest.mark.parametrize(
    "n, equal, unequal", tiers([(5, 82, 104), (10, 177, 224), (20, 367, 464)], 10)
)
def test_flops_of_a_chain(n: int, equal: int, unequal: int) -> None:
    """19 a link, and five more where masses and lengths differ; up to 24 where none is to wait."""
    chain = [k - 1 for k in range(n)]
    assert by_multipliers(made_of(links(chain) + BATCH)).cost.flops <= equal
    assert by_multipliers(made_of(links(chain, equal=False) + BATCH)).cost.flops <= unequal
    prompt = by_multipliers(made_of(links(chain))).cost
    assert prompt.flops <= 24 * n
    assert prompt.divisions <= n // 2


def test_a_chain_is_eliminated_from_both_ends() -> None:
    """So that only half of its divisions wait for one another."""
    order = link_multipliers.solution(made_of(links([k - 1 for k in range(9)]) + BATCH)).order
    assert [order.index(k) for k in range(4)] == sorted(order.index(k) for k in range(4))
    assert [order.index(k) for k in (8, 7, 6, 5)] == sorted(order.index(k) for k in (5, 6, 7, 8))
    assert order[-1] == 4


@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
def test_the_order_names_the_last_coordinate_of_each_angle(relative: bool) -> None:
    """That of the link itself, whatever it is measured from."""
    order = link_multipliers.solution(made_of(links(CHAIN, relative=relative))).order
    assert sorted(order) == [0, 1, 2, 3, 4]


def test_every_other_link_goes_first_where_one_trajectory_is_all() -> None:
    """Their pivots depend on parameters alone; the others then from both ends."""
    order = link_multipliers.solution(made_of(links([k - 1 for k in range(9)]))).order
    assert set(order[:5]) == {0, 2, 4, 6, 8}
    assert set(order[5:7]) == {1, 7}


def test_divisions_do_not_wait_for_one_another() -> None:
    """No reciprocal of what a place decides is made of another."""
    function = by_multipliers(made_of(links([k - 1 for k in range(12)])))
    values = {a.name: a.value for a in function.body}

    def divisions_in_a_row(name: str) -> int:
        value = values.get(name)
        if value is None:
            return 0
        before = max(map(divisions_in_a_row, value.names), default=0)
        return before + (isinstance(value, Call) and value.function == "reciprocal")

    made = [n for n, v in values.items() if isinstance(v, Call) and v.function == "reciprocal"]
    assert len(made) >= 5
    assert max(map(divisions_in_a_row, made)) == 1


@pytest.mark.parametrize("size", tiers([1e-34, 1e34], 1e-34))
def test_masses_of_any_size(size: float) -> None:
    """Products of pivots stay in the range of a double; only ratios of masses count."""
    n = 40
    made = made_of(links([k - 1 for k in range(n)], equal=False))
    ours, state = by_multipliers(made), states(made)[0] | {"b": 0.0, "s": 0.0, "u": 0.0}
    scaled = {**state, **{f"m{k}": size * state[f"m{k}"] for k in range(n)}}
    (expected, _), (found, regular) = evaluate(ours, state), evaluate(ours, scaled)
    assert regular
    np.testing.assert_allclose(found, expected, rtol=1e-11)


@pytest.mark.parametrize("n", tiers([9, 20], 9))
def test_products_of_pivots_lose_nothing(n: int) -> None:
    """In 40 digits; 20 links leave five products on one side of the last pivot, four on the other,
    more than there may be in one."""
    chain = links([k - 1 for k in range(n)], equal=False)
    made = made_of(chain)
    prompt, plain = by_multipliers(made), by_multipliers(made_of(chain + BATCH))
    assert prompt != plain
    for state in states(made, 2):
        (found, _), (expected, _) = (evaluate(f, state, exact=True) for f in (prompt, plain))
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(found, expected, rtol=4 * EPS, atol=4 * EPS * size)


def test_a_float_has_no_room_for_products_of_pivots() -> None:
    chain = links([k - 1 for k in range(9)])
    plain, many = (by_multipliers(made_of(f"{chain}\n[run]\n{run}\n")) for run in (
        'real = "float"', "batch = true",
    ))  # fmt: skip
    assert plain == many


@pytest.mark.parametrize("n", tiers((3, 5, 10), 5))
def test_it_is_taken_where_it_is_the_cheapest(n: int) -> None:
    made = made_of(links([k - 1 for k in range(n)]))
    assert program.build(lagrange.derive(made))["acceleration"].route == "multipliers"


# --- where it is not ------------------------------------------------------------------------------

FIRST = (L * sin(a), L * cos(a))
UNSUITED = {
    "otherwise than on a sum": moving([(x * sin(a), -x * cos(a))], [x, a]),
    "irrational": moving([(*FIRST, L * sin(a + sympy.sqrt(2) * b))], [a, b], m * B_DOT**2),
    "velocities in K, more than": scene_system("chain"),
    "depend on coordinates": moving([FIRST], [a, b], (2 + cos(a)) * B_DOT**2),
    "no sum of masses": moving([FIRST], [a, b], m * (B_DOT - A_DOT / 3) ** 2),
    "one direction": moving([FIRST[:1], (L * sin(a) + R * sin(b), L * cos(b))], [a, b]),
    "no links": moving([(x,), (y,)], [x, y]),
    "velocities in K, 3 increments": moving([FIRST, (R * sin(a), b)], [a, b]),
    "follow": moving([(sin(a) + cos(a), cos(a) - sin(a)), (sin(b), cos(b))], [a, b]),
    "on 3 angles, of 2 coordinates": moving([FIRST, (L * sin(b), cos(a - b))], [a, b]),
    "steady": moving([(*FIRST, sin(2 * a)), (x,)], [a, x]),
}


@pytest.mark.parametrize("why", UNSUITED)
def test_what_is_of_another_kind_is_passed_over_with_the_reason(why: str) -> None:
    with pytest.raises(link_multipliers.UnsuitedError, match=why):
        link_multipliers.solution(UNSUITED[why])
    built = program.build(lagrange.derive(UNSUITED[why]))
    assert "multipliers" not in dict(built["acceleration"].routes)
    assert why in built.passed_over["multipliers"]


def test_a_negative_mass_is_reported() -> None:
    """Where it is a number nothing is left of it to look at in a tape; D is indefinite."""
    made = System.make(
        "negative",
        [a, b],
        sum(dot(e) ** 2 for e in FIRST) - 2 * sum(dot(e) ** 2 for e in hung(FIRST, R, b)),
        0,
        parameters=PARAMETERS,
    )
    with pytest.raises(link_multipliers.UnsuitedError, match="no sum of masses"):
        link_multipliers.solution(made)
    acceleration = program.build(lagrange.derive(made))["acceleration"]
    for state in states(made):
        assert not evaluate(acceleration, state)[1]


def test_angles_that_do_not_determine_the_coordinates() -> None:
    points = [(L * sin(e), L * cos(e)) for e in (a, b, a - b)]
    with pytest.raises(link_multipliers.UnsuitedError, match="do not determine"):
        link_multipliers.solution(moving(points, [a, b, c]))


@pytest.mark.parametrize("gone", ["m", "l", "m1", "l1", "m0", "l0"])
def test_a_mass_or_link_of_nothing_is_singular(gone: str) -> None:
    """Even where all that is left of it cancels."""
    ours = by_multipliers(made_of(links([-1, 0, 1], equal=len(gone) == 1)))
    state = states(made_of(links([-1, 0, 1], equal=len(gone) == 1)))[0]
    assert evaluate(ours, state)[1]
    try:
        _, regular = evaluate(ours, {**state, gone: 0.0})
    except ArithmeticError:  # in C it is not finite
        return
    assert not regular


@pytest.mark.slow
def test_singular_and_regular_in_c(modules: Modules) -> None:
    made = modules.of_text(links([-1, 0, 1, 2], more='potential = "0"'))
    q, qd = np.array([0.1, 0.4, -0.3, 0.8]), np.array([1.0, -0.5, 0.7, 0.2])
    state = {f"q{k}": v for k, v in enumerate(q)} | {f"q{k}_dot": v for k, v in enumerate(qd)}
    text = made_of(links([-1, 0, 1, 2], more='potential = "0"'))
    right, _ = independent(
        text, {**{p.name: p.value for p in text.parameters}, **state, "u": 0, "t": 0}
    )
    np.testing.assert_allclose(made.acceleration(q, qd, t=0.0, u=[0.0]), right, rtol=1e-13)
    for gone in "ml":
        with pytest.raises(ArithmeticError):
            made.acceleration(q, qd, t=0.0, u=[0.0], params={gone: 0.0})


@pytest.mark.slow
def test_a_scene_with_a_massless_link_keeps_the_way_by_d() -> None:
    """D is regular with m0 = 0 where the links are not in line; 1/m0 is nothing to go by."""
    text = links([-1, 0, 1, 2], equal=False)
    assert program.build(lagrange.derive(made_of(text)))["acceleration"].route == "multipliers"
    made = made_of(text.replace("m0 = 1.0", "m0 = 0.0"))
    built = program.build(lagrange.derive(made))
    assert "multipliers" in dict(built["acceleration"].routes)
    assert built["acceleration"].route != "multipliers"
    values = {**states(made)[0], "m0": 0.0}
    right, _ = independent(made, values)
    np.testing.assert_allclose(evaluate(built["acceleration"], values)[0], right, rtol=1e-12)
