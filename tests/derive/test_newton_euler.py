"""Trees of bodies by the recursive routes, against the energies differentiated as Taylor series.

verify/taylor.py starts from the energies over world coordinates and shares nothing else with
newton_euler.py and articulated_body.py. Programs are evaluated in Python: nothing is compiled here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import links
import numpy as np
import pytest
import trees
from conftest import tiers
from hypothesis import HealthCheck, Phase, given, note, settings
from hypothesis import strategies as st

from eomc.base.errors import EomcError
from eomc.derive import lagrange
from eomc.derive.links import Vectors
from eomc.derive.newton_euler import TreeDynamics
from eomc.model.from_scene import from_scene
from eomc.model.symbols import ALONG
from eomc.model.system import System
from eomc.program import program
from eomc.program.interpret import evaluate
from eomc.program.ir import Function
from eomc.program.program import Program
from eomc.program.routes import RouteInputs
from eomc.scene.read import parse
from eomc.verify import check, symbolic
from eomc.verify.reference import ReferenceModel
from eomc.verify.taylor import TaylorReference

FEW = settings(
    derandomize=True, deadline=None, max_examples=1, database=None,
    suppress_health_check=list(HealthCheck), phases=(Phase.generate,),  # to shrink takes minutes
)  # fmt: skip
MANY = settings(FEW, max_examples=25)

VALUES = {**check.VALUES, "signal": "signals"}  # the program's names and the answer's
EPS = 2.0**-52
WORST = 1e5  # condition of D beyond which a state tells little: rounding alone may be 1e-9


def made_of(text: str) -> System:
    return from_scene(parse(text, "tree.toml"))


def built(made: System) -> Program:
    return program.build(lagrange.derive(made))


@cache
def built_from(text: str) -> Program:
    return built(made_of(text))


def accelerations(made: System) -> Function:
    """By their cheapest route; nothing else is made."""
    return program.accelerations(RouteInputs(lagrange.derive(made)))[0]


@cache
def acceleration_of(text: str) -> Function:
    return accelerations(made_of(text))


def every_route(
    made: System, make: Callable[[System], object] = built
) -> dict[tuple[str, str], Function]:
    """Each function by each of its routes, by (name, route); make: the accelerations, or all."""
    found: dict[tuple[str, str], Function] = {}
    right = program.cheapest

    def all_of_them(name: str, of: System, routes: Mapping[str, Any]) -> Function:
        for route, way in routes.items():
            found[name, route] = right(name, of, {route: way})
        return found[name, next(iter(routes))]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "cheapest", all_of_them)
        make(made)
    return found


# --- states and what is asked there ---------------------------------------------------------------


states = partial(links.states, count=2, seed=7, reach=1.2)


class Asked:
    """An independent answer at a state."""

    def __init__(self, answer: ReferenceModel, state: Mapping[str, float]) -> None:
        made = self.made = answer.system
        self.answer = answer
        self.q, self.qd, self.u = (
            np.array([state[x.name] for x in xs]) for xs in (made.q, made.qd, made.u)
        )
        self.t = state["t"]
        self.params = {p.name: state[p.name] for p in made.parameters}

    def __getitem__(self, name: str) -> np.ndarray:
        of = self.answer
        if name == "acceleration":
            return of.acceleration(self.q, self.qd, self.t, self.u, self.params)
        found = of.evaluate(name, self.q, self.qd, self.t, self.u, self.params)
        return np.atleast_1d(np.asarray(found))


def value(function: Function, state: Mapping[str, float], made: System) -> np.ndarray:
    """What a function gives; a matrix that it has by columns, whole."""
    if not function.name.endswith("_column"):
        found, regular = evaluate(function, state)
        assert regular, function.route
        return np.array(found)
    names = [c.name for c in made.coordinates]
    columns = [
        evaluate(function, {**state, **{f"{n}{ALONG}": float(n == one) for n in names}})
        for one in names
    ]
    return np.array([column for column, _ in columns]).T.ravel()


def assert_every_route_agrees(made: System, answer: ReferenceModel, some: bool = True) -> None:
    """All that the answer knows, by every route, within rounding; some: at one state at least.

    Energies and forces are sums of some hundred terms that may cancel: 1e-12 of the largest that
    belongs to the state. What a solution of D x = b may be off grows with D's condition.
    """
    routes = every_route(made)
    positive = 0
    for state in states(made):
        right = Asked(answer, state)
        condition = np.linalg.cond(right["D"])
        if not condition < WORST:
            continue
        positive += 1
        size = 1 + max(np.max(np.abs(right[n])) for n in ("D", "bias", "tau", "energy"))
        for (name, route), function in routes.items():
            theirs = right[VALUES.get(name.removesuffix("_column"), name)].ravel()
            scale, rounding = size * (1 + np.max(np.abs(theirs))), 1e-13
            if name == "acceleration":
                scale, rounding = np.max(np.abs(theirs)) + 1, 40 * EPS * condition
                assert rounding < 1e-9
            off = np.max(np.abs(value(function, state, made) - theirs))
            assert off <= rounding * scale, f"{name} by {route} is off by {off:.1e} of {scale:.1e}"
    assert positive or not some


# --- every tree of up to three joints -------------------------------------------------------------


def look_at(text: str) -> None:
    note(text)
    made = made_of(text)
    answer = TaylorReference(made)
    try:
        assert_every_route_agrees(made, answer, some=False)
    except EomcError as fault:  # rightly so where D is singular everywhere
        assert "inertia" in str(fault)
        for state in states(made):
            assert not np.linalg.cond(Asked(answer, state)["D"]) < 1e12


SPACES = pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
EVERY_SHAPE = pytest.mark.parametrize("shape", trees.SHAPES, ids=str)


# all shapes in the plane; in space a chain, a fork and a star
SPACE = ((-1, 0, 1), (-1, 0, 0), (-1, -1, -1))


@pytest.mark.parametrize(
    "shape, plane",
    [
        *(pytest.param(shape, True, id=f"plane-{shape}") for shape in trees.SHAPES),
        *(
            pytest.param(shape, False, id=f"space-{shape}", marks=() if k else pytest.mark.slow)
            for k, shape in enumerate(SPACE)
        ),
    ],
)
@FEW
@given(data=st.data())
def test_every_tree_of_up_to_three_joints(shape: tuple[int, ...], plane: bool, data: Any) -> None:
    look_at(data.draw(trees.trees(shape, plane)))


@pytest.mark.slow
@EVERY_SHAPE
@SPACES
@MANY
@given(data=st.data())
def test_many_trees_of_up_to_three_joints(shape: tuple[int, ...], plane: bool, data: Any) -> None:
    look_at(data.draw(trees.trees(shape, plane)))


def held(joint: str, number: int, **more: Any) -> str:
    """A body on that joint, on one that turns; all inertias general."""
    given = {"mass": "m", "center": [0.1, -0.2, "l/3"], "inertia": [0.05, "J", 0.04, 0.004, 0, 0]}
    first = {"name": "b0", "joint": "revolute", "coordinates": "a", "axis": [1, 2, -2], **given}
    place = {"parent": "b0", "offset": ["l", 0.1, 0], "rotation": [["y", 0.4], ["x", "alpha"]]}
    names = [f"q{k}" for k in range(number)]
    last = {"name": "b1", "joint": joint, "coordinates": names, **place, **given, **more}
    return trees.text([first, last], [0, 1, "-g"], trees.PARAMETERS)


AXES = {"cylindrical": [2, -1, 2], "universal": [[1, 0, 0], [0.6, 0, 0.8]]}


@pytest.mark.parametrize(
    "joint, number",
    tiers(
        [("cylindrical", 2), ("universal", 2), ("planar", 3), ("spherical", 3), ("free", 6)],
        "spherical",
    ),
)
def test_joints_with_several_coordinates(joint: str, number: int) -> None:
    more = {"axis": AXES[joint]} if joint in AXES else {}
    made = made_of(held(joint, number, damping="c", armature=0.01, **more))
    assert_every_route_agrees(made, TaylorReference(made))


@pytest.mark.slow
def test_lagrange_over_world_coordinates_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """That route is not tried where there are many of them, since it costs more."""
    monkeypatch.setattr(lagrange, "MAX_LAGRANGE_DEFINITIONS", 1000)
    for joint in ("cylindrical", "universal"):
        made = made_of(held(joint, 2, axis=AXES[joint], damping="c"))
        assert lagrange.derive(made).lagrange
        assert_every_route_agrees(made, TaylorReference(made))


@pytest.mark.slow
def test_a_planar_joint_in_a_plane_scene() -> None:
    names = ["x", "y", "turn"]
    body = {"name": "b", "joint": "planar", "coordinates": names, "mass": "m",
            "center": ["l", 0.1], "inertia": "J", "rotation": 0.3}  # fmt: skip
    arm = {"name": "tail", "parent": "b", "joint": "revolute", "coordinates": "tail",
           "offset": [0.2, "l"], "mass": 0.5, "center": ["l", 0]}  # fmt: skip
    made = made_of(trees.text([body, arm], [0, "-g"], trees.PARAMETERS))
    assert_every_route_agrees(made, TaylorReference(made))


@pytest.mark.parametrize(
    "wheel, slide",
    tiers(
        [("-alpha*a + 0.1", "l*a + c*sin(2*b)"), ("-a", "a"), ("a*b", "sqrt(1 + b**2)")],
        "-alpha*a + 0.1",
    ),
)
def test_joints_that_move_together(wheel: str, slide: str) -> None:
    made = made_of(trees.geared(wheel, slide))
    assert [c.name for c in made.coordinates] == ["a", "b"]
    assert_every_route_agrees(made, TaylorReference(made))


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [trees.chain(2), trees.arm(2, numbers=True, straight=True)],
    ids=["chain", "arm"],
)  # fmt: skip
def test_the_reference_written_out_says_the_same(text: str) -> None:
    """Once against expressions in SymPy too, which share nothing with the jets but the system."""
    made = made_of(text)
    assert_every_route_agrees(made, symbolic.derive(made))


@pytest.mark.parametrize(
    "joint, number", [("spherical", 3), pytest.param("free", 6, marks=pytest.mark.slow)]
)
def test_where_angles_are_singular_no_acceleration_is_given(joint: str, number: int) -> None:
    made = made_of(held(joint, number))
    pitch = f"q{number - 2}"
    state = states(made, count=1)[0]
    for (_, route), function in every_route(made, accelerations).items():
        for off, regular in ((0.0, False), (1e-9, False), (1e-3, True)):
            try:
                _, positive = evaluate(function, {**state, pitch: np.pi / 2 - off})
            except ArithmeticError:  # a pivot that is zero, or no finite result
                positive = False
            assert positive is regular, (route, off)


@pytest.mark.slow
def test_a_compiled_module_refuses_where_angles_are_singular(modules: Any) -> None:
    module = modules.unoptimised(held("spherical", 3))
    q = np.array([0.1, 0.2, np.pi / 2, 0.3])
    with pytest.raises(ArithmeticError, match=r"singular|definite"):
        module.acceleration(q, np.ones(4))
    q[2] = 1.0
    assert np.all(np.isfinite(module.acceleration(q, np.ones(4))))


def test_a_joint_that_nothing_resists_is_refused_by_name() -> None:
    """Two slides along one line, nothing that weighs between them."""
    bodies: list[dict[str, Any]] = [
        {"name": "b0", "joint": "prismatic", "coordinates": "first", "axis": [1, 0]},
        {"name": "b1", "parent": "b0", "joint": "prismatic", "coordinates": "second",
         "axis": [1, 0], "mass": 1.0},
    ]  # fmt: skip
    made = made_of(trees.text(bodies, [0, "-g"], trees.PARAMETERS))
    with pytest.raises(EomcError, match=r"nothing resists first, second .* 'b0' has no inertia"):
        built(made)


@pytest.mark.parametrize("count", [3, 9])  # by Lagrange too, and by Newton and Euler alone
@pytest.mark.parametrize(
    ("joint", "axes", "together"),
    [
        ("revolute", [[0, 1, 0], [0, 1, 0]], "a0, a1"),
        ("prismatic", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], "a0, a1, a3"),
    ],
)
def test_joints_that_move_nothing_together_are_named(
    joint: str, axes: list[list[float]], together: str, count: int
) -> None:
    """Massless bodies between joints, behind a chain of heavy links and at its end."""
    heavy = {"mass": "m", "center": [0.3, 0.1, 0], "inertia": [0.1, 0.2, 0.25]}
    bodies: list[dict[str, Any]] = [
        {
            "name": f"h{k}",
            "joint": "revolute",
            "coordinates": f"q{k}",
            "axis": [0, k % 2, 1],
            **heavy,
        }
        | ({"parent": f"h{k - 1}"} if k else {})
        for k in range(count)
    ]
    for k, axis in enumerate(axes):
        parent = f"b{k - 1}" if k else f"h{count - 1}"
        bodies.append(
            {"name": f"b{k}", "parent": parent, "joint": joint, "coordinates": f"a{k}",
             "axis": axis} | (heavy if k == len(axes) - 1 else {})
        )  # fmt: skip
    made = made_of(trees.text(bodies, [0, 0, "-g"], trees.PARAMETERS))
    with pytest.raises(EomcError, match=f"nothing resists {together} as they move together"):
        built(made)


def test_a_coordinate_that_no_joint_has_is_refused_at_its_line() -> None:
    bodies = [{"name": "b0", "joint": "revolute", "coordinates": "turn", "mass": 1.0, "inertia": 1}]
    text = trees.text(bodies, [0, "-g"], trees.PARAMETERS)
    text = text.replace("[coordinates]\n", "[coordinates]\nidle = {}\n")
    with pytest.raises(EomcError, match=r"coordinates\.idle: .*name it in a body's joint") as fault:
        program.inertia(built(made_of(text)))
    line = text.splitlines().index("idle = {}") + 1
    assert f":{line}:1: error" in str(fault.value)


# --- chains, by their closed form -----------------------------------------------------------------


def hanging(n: int, m: float, l: float, g: float, q: np.ndarray, qd: np.ndarray) -> tuple[Any, Any]:  # noqa: E741
    """D and bias of point masses m on rods l, in relative angles q; gravity along -y.

    In angles phi to the x axis D_ij = m l^2 w_ij cos(phi_i - phi_j) with w_ij masses from the
    later of i and j on, and bias_i = m l^2 sum_j w_ij sin(phi_i - phi_j) phi_j'^2
    + m g l w_ii cos(phi_i); phi = L q with L of ones on and below the diagonal.
    """
    L = np.tril(np.ones((n, n)))
    phi, rate = L @ q, L @ qd
    w = n - np.maximum.outer(np.arange(n), np.arange(n))
    apart = np.subtract.outer(phi, phi)
    D = m * l**2 * w * np.cos(apart)
    bias = m * l**2 * (w * np.sin(apart)) @ rate**2 + m * g * l * np.diag(w) * np.cos(phi)
    return L.T @ D @ L, L.T @ bias


@pytest.mark.parametrize("n", [5, *(pytest.param(n, marks=pytest.mark.slow) for n in (20, 50))])
def test_a_chain_is_its_closed_form(n: int) -> None:
    text = trees.chain(n, points=True)
    made, quick = made_of(text), built_from(text)
    for state in states(made):
        q, qd = (np.array([state[x.name] for x in xs]) for xs in (made.q, made.qd))
        D, bias = hanging(n, state["m"], state["l"], state["g"], q, qd)
        found = np.array(program.matrix(quick, "D", state))
        np.testing.assert_allclose(found, D, rtol=0, atol=1e-13 * np.max(D))
        np.testing.assert_allclose(
            evaluate(quick["bias"], state)[0], bias, rtol=0, atol=1e-12 * np.max(np.abs(bias))
        )
        expected = np.linalg.solve(D, -bias)
        found, regular = evaluate(quick["acceleration"], state)
        assert regular
        off = np.max(np.abs(found - expected)) / np.max(np.abs(expected))
        assert off <= min(1e-9, 4 * EPS * np.linalg.cond(D))


# --- what it costs --------------------------------------------------------------------------------


def flops(text: str) -> int:
    return acceleration_of(text).cost.flops


@pytest.mark.parametrize("arms", tiers([2, 6], 2))
def test_what_is_zero_between_branches_is_not_computed(arms: int) -> None:
    """Side by side the arms of a star cost what they cost alone."""
    one, many = built_from(trees.star(1, 2)), built_from(trees.star(arms, 2))
    for name in ("acceleration", "D", "bias", "g"):
        assert abs(many[name].cost.flops - arms * one[name].cost.flops) <= arms, name
    n = 2 * arms
    D = np.array([o.coefficient != 0 for o in many["D"].outputs]).reshape(n, n)
    assert not np.any(D & ~np.kron(np.eye(arms, dtype=bool), np.ones((2, 2), bool)))


@pytest.mark.parametrize(
    "links, most",
    [(10, 1050), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((20, 2300), (50, 6000)))],
)
def test_a_plane_chain_costs_so_much_a_link(links: int, most: int) -> None:
    assert flops(trees.chain(links)) <= most


@pytest.mark.slow
def test_a_link_more_costs_the_same_wherever_it_hangs() -> None:
    """The first and the last two are cheaper; between them every link is like the other."""
    ten, twenty, fifty = (flops(trees.chain(n)) for n in (10, 20, 50))
    assert (fifty - twenty) / 30 == pytest.approx((twenty - ten) / 10, rel=0.02)
    assert fifty / 50 == pytest.approx(twenty / 20, rel=0.06)


@pytest.mark.slow
def test_an_arm_of_seven_joints_costs_at_most_1650() -> None:
    assert flops(trees.arm()) <= 1650


@pytest.mark.slow
def test_numbers_fold_away() -> None:
    """Nothing is left to be prepared, and what is zero costs nothing."""
    numbers, parameters = (acceleration_of(trees.arm(3, numbers=x)) for x in (True, False))
    assert parameters.early and all("g" in a.value.names for a in numbers.early)
    assert numbers.cost.flops <= 1.01 * parameters.cost.flops
    straight = trees.arm(3, numbers=True, straight=True)
    assert flops(straight) < 0.7 * numbers.cost.flops


@pytest.mark.slow
def test_grouping_inertias_saves_work_and_changes_no_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = made_of(trees.arm(3))
    grouped = every_route(made, accelerations)
    monkeypatch.setattr(
        TreeDynamics, "_grouped", lambda r: [r._link_inertia(link) for link in r.links]
    )
    plain = every_route(made, accelerations)
    for route in ("composite", "articulated"):
        one, other = (found["acceleration", route] for found in (grouped, plain))
        assert one.cost.flops < other.cost.flops
        for state in states(made):
            (a, _), (b, _) = evaluate(one, state), evaluate(other, state)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.max(np.abs(b)))


def test_a_wrong_recursion_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    made = made_of(trees.arm(2))
    answer = TaylorReference(made)
    assert_every_route_agrees(made, answer)
    right = Vectors.cross
    monkeypatch.setattr(Vectors, "cross", lambda r, a, b: right(r, b, a))
    with pytest.raises(AssertionError, match="is off by"):
        assert_every_route_agrees(made, answer)
