"""Test the cost of accelerations by link multipliers, and which systems are unsuitable for them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from support.cases import scene_system
from support.point_masses import (
    A_DOT,
    B_DOT,
    CHAIN,
    PARAMETERS,
    L,
    R,
    a,
    b,
    by_multipliers,
    c,
    cheapest,
    cos,
    independent,
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
from support.session import Modules, tiers

from eomc.derive import ldl, link_multipliers
from eomc.model.system import System, dot
from eomc.program.ir import Call, evaluate

EPS = 2.0**-52

# --- what it costs -------------------------------------------------------------------------------


BATCH = "\n[run]\nbatch = true\n"


@pytest.mark.parametrize(
    "n, equal, unequal", tiers([(5, 82, 104), (10, 177, 224), (20, 367, 464)], 10)
)
def test_flops_per_link_of_a_chain(n: int, equal: int, unequal: int) -> None:
    """19 a link; 24 with unequal masses and lengths, or with short dependency chains."""
    chain = [k - 1 for k in range(n)]
    assert by_multipliers(read_system(links(chain) + BATCH)).cost.flops <= equal
    assert by_multipliers(read_system(links(chain, equal=False) + BATCH)).cost.flops <= unequal
    prompt = by_multipliers(read_system(links(chain))).cost
    assert prompt.flops <= 24 * n
    assert prompt.divisions <= n // 2


def test_chain_is_eliminated_from_both_ends() -> None:
    """Then only half of its divisions depend on one another."""
    order = link_multipliers.solution(read_system(links([k - 1 for k in range(9)]) + BATCH)).order
    assert [order.index(k) for k in range(4)] == sorted(order.index(k) for k in range(4))
    assert [order.index(k) for k in (8, 7, 6, 5)] == sorted(order.index(k) for k in (5, 6, 7, 8))
    assert order[-1] == 4


@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
def test_order_gives_the_last_coordinate_of_each_angle(relative: bool) -> None:
    """It is the link's own coordinate, whatever the angle is measured from."""
    order = link_multipliers.solution(read_system(links(CHAIN, relative=relative))).order
    assert sorted(order) == [0, 1, 2, 3, 4]


def test_alternate_links_are_eliminated_first_for_one_trajectory() -> None:
    """Their pivots depend on parameters only; the other links follow from both ends."""
    order = link_multipliers.solution(read_system(links([k - 1 for k in range(9)]))).order
    assert set(order[:5]) == {0, 2, 4, 6, 8}
    assert set(order[5:7]) == {1, 7}


def test_divisions_do_not_depend_on_one_another() -> None:
    """No reciprocal that depends on the position enters another one."""
    function = by_multipliers(read_system(links([k - 1 for k in range(12)])))
    values = {a.name: a.value for a in function.body}

    def sequential_divisions(name: str) -> int:
        value = values.get(name)
        if value is None:
            return 0
        before = max(map(sequential_divisions, value.names), default=0)
        return before + (isinstance(value, Call) and value.function == "reciprocal")

    reciprocals = [
        n for n, v in values.items() if isinstance(v, Call) and v.function == "reciprocal"
    ]
    assert len(reciprocals) >= 5
    assert max(map(sequential_divisions, reciprocals)) == 1


@pytest.mark.parametrize(
    "size, n, longest", tiers([(1e-150, 12, 2), (1e-34, 40, 8), (1e34, 40, 8)], 1e-150)
)
def test_scaled_masses_give_the_same_accelerations(
    size: float, n: int, longest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Products of pivots stay in the range of a double; only mass ratios matter."""
    monkeypatch.setattr(ldl, "MAX_PIVOTS_PER_PRODUCT", longest)
    system = read_system(links([k - 1 for k in range(n)], equal=False))
    function, state = by_multipliers(system), states(system)[0] | {"b": 0.0, "s": 0.0, "u": 0.0}
    scaled = {**state, **{f"m{k}": size * state[f"m{k}"] for k in range(n)}}
    (expected, _), (result, regular) = evaluate(function, state), evaluate(function, scaled)
    assert regular
    np.testing.assert_allclose(result, expected, rtol=1e-11)


@pytest.mark.parametrize("n", tiers([9, 20], 9))
def test_products_of_pivots_are_accurate(n: int) -> None:
    """Compare in 40 digits.

    20 links leave five products on one side of the last pivot and four on the other, more than one
    product may contain.
    """
    chain = links([k - 1 for k in range(n)], equal=False)
    system = read_system(chain)
    prompt, plain = by_multipliers(system), by_multipliers(read_system(chain + BATCH))
    assert prompt != plain
    for state in states(system, 2):
        (result, _), (expected, _) = (evaluate(f, state, exact=True) for f in (prompt, plain))
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(result, expected, rtol=4 * EPS, atol=4 * EPS * size)


def test_single_precision_has_no_range_for_products_of_pivots() -> None:
    chain = links([k - 1 for k in range(9)])
    plain, many = (by_multipliers(read_system(f"{chain}\n[run]\n{run}\n")) for run in (
        'real = "float"', "batch = true",
    ))  # fmt: skip
    assert plain == many


@pytest.mark.parametrize("n", tiers((3, 5, 10), 3))
def test_route_is_chosen_where_it_is_the_cheapest(n: int) -> None:
    system = read_system(links([k - 1 for k in range(n)]))
    assert cheapest(system)[0].route == "multipliers"


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


@pytest.mark.parametrize("reason", UNSUITED)
def test_unsuitable_system_is_refused_with_the_reason(reason: str) -> None:
    with pytest.raises(link_multipliers.UnsuitedError, match=reason):
        link_multipliers.solution(UNSUITED[reason])
    best, passed_over = cheapest(UNSUITED[reason])
    assert "multipliers" not in dict(best.routes)
    assert reason in passed_over["multipliers"]


def test_negative_mass_is_reported() -> None:
    """A constant mass leaves nothing to examine in a tape; D is indefinite."""
    system = System.make(
        "negative",
        [a, b],
        sum(dot(e) ** 2 for e in FIRST) - 2 * sum(dot(e) ** 2 for e in link_end(FIRST, R, b)),
        0,
        parameters=PARAMETERS,
    )
    with pytest.raises(link_multipliers.UnsuitedError, match="no sum of masses"):
        link_multipliers.solution(system)
    acceleration, _ = cheapest(system)
    for state in states(system):
        assert not evaluate(acceleration, state)[1]


def test_angles_that_do_not_determine_the_coordinates() -> None:
    points = [(L * sin(e), L * cos(e)) for e in (a, b, a - b)]
    with pytest.raises(link_multipliers.UnsuitedError, match="do not determine"):
        link_multipliers.solution(moving(points, [a, b, c]))


@pytest.mark.parametrize("name", ["m", "l", "m1", "l1", "m0", "l0"])
def test_zero_mass_or_length_is_singular(name: str) -> None:
    """Even where all terms that contain it cancel."""
    function = by_multipliers(read_system(links([-1, 0, 1], equal=len(name) == 1)))
    state = states(read_system(links([-1, 0, 1], equal=len(name) == 1)))[0]
    assert evaluate(function, state)[1]
    try:
        _, regular = evaluate(function, {**state, name: 0.0})
    except ArithmeticError:  # the C result is not finite
        return
    assert not regular


@pytest.mark.slow
def test_singular_and_regular_states_in_c(modules: Modules) -> None:
    module = modules.unoptimised(links([-1, 0, 1, 2], more='potential = "0"'))
    q, qd = np.array([0.1, 0.4, -0.3, 0.8]), np.array([1.0, -0.5, 0.7, 0.2])
    state = {f"q{k}": v for k, v in enumerate(q)} | {f"q{k}_dot": v for k, v in enumerate(qd)}
    text = read_system(links([-1, 0, 1, 2], more='potential = "0"'))
    reference, _ = independent(
        text, {**{p.name: p.value for p in text.parameters}, **state, "u": 0, "t": 0}
    )
    np.testing.assert_allclose(module.acceleration(q, qd, t=0.0, u=[0.0]), reference, rtol=1e-13)
    for name in "ml":
        with pytest.raises(ArithmeticError):
            module.acceleration(q, qd, t=0.0, u=[0.0], params={name: 0.0})


@pytest.mark.slow
def test_massless_link_uses_the_route_by_the_mass_matrix() -> None:
    """D is regular with m0 = 0 if the links are not collinear, but 1/m0 does not exist."""
    text = links([-1, 0, 1, 2], equal=False)
    assert cheapest(read_system(text))[0].route == "multipliers"
    system = read_system(text.replace("m0 = 1.0", "m0 = 0.0"))
    best, _ = cheapest(system)
    assert "multipliers" in dict(best.routes)
    assert best.route != "multipliers"
    values = {**states(system)[0], "m0": 0.0}
    reference, _ = independent(system, values)
    np.testing.assert_allclose(evaluate(best, values)[0], reference, rtol=1e-12)
