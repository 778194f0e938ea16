"""Compare recursive routes of trees of bodies with Taylor series of the energies.

verify/taylor.py starts from the energies in world coordinates and shares no other code with
newton_euler.py and articulated_body.py. Programs are evaluated in Python; nothing is compiled here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, note, settings
from hypothesis import strategies as st
from support import point_masses, trees
from support.session import tiers

from eomc.base.errors import EomcError
from eomc.derive import lagrange
from eomc.derive.newton_euler import TreeDynamics, Vectors
from eomc.model.symbols import ALONG
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.program.ir import Function, evaluate
from eomc.program.program import Program
from eomc.program.routes import RouteInputs
from eomc.scene.read import parse
from eomc.verify import symbolic
from eomc.verify.reference import ReferenceModel
from eomc.verify.sampling import VALUES as QUANTITIES
from eomc.verify.taylor import TaylorReference

FEW = settings(
    derandomize=True, deadline=None, max_examples=1, database=None,
    suppress_health_check=list(HealthCheck), phases=(Phase.generate,),  # shrinking takes minutes
)  # fmt: skip
MANY = settings(FEW, max_examples=25)

VALUES = {**QUANTITIES, "signal": "signals"}  # names in the program and in the reference
EPS = 2.0**-52
WORST = 1e5  # condition of D beyond which rounding alone may cause an error of 1e-9


def system_from(text: str) -> System:
    return from_scene(parse(text, "tree.toml"))


def build_program(system: System) -> Program:
    return program.build(lagrange.derive(system))


@cache
def program_from(text: str) -> Program:
    return build_program(system_from(text))


def accelerations(system: System) -> Function:
    """Build only the accelerations, by their cheapest route."""
    return program.accelerations(RouteInputs(lagrange.derive(system)))[0]


@cache
def acceleration_of(text: str) -> Function:
    return accelerations(system_from(text))


def every_route(
    system: System, build: Callable[[System], object] = build_program
) -> dict[tuple[str, str], Function]:
    """Return each function by each of its routes, keyed by (name, route)."""
    functions: dict[tuple[str, str], Function] = {}
    cheapest = program.cheapest

    def build_all_routes(name: str, of_system: System, routes: Mapping[str, Any]) -> Function:
        for route, inputs in routes.items():
            functions[name, route] = cheapest(name, of_system, {route: inputs})
        return functions[name, next(iter(routes))]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "cheapest", build_all_routes)
        build(system)
    return functions


# --- states and what is asked there ---------------------------------------------------------------


states = partial(point_masses.states, count=2, seed=7, reach=1.2)


class ReferenceState:
    """Values of an independent reference at a state."""

    def __init__(self, reference: ReferenceModel, state: Mapping[str, float]) -> None:
        system = self.system = reference.system
        self.reference = reference
        self.q, self.qd, self.u = (
            np.array([state[x.name] for x in xs]) for xs in (system.q, system.qd, system.u)
        )
        self.t = state["t"]
        self.params = {p.name: state[p.name] for p in system.parameters}

    def __getitem__(self, name: str) -> np.ndarray:
        source = self.reference
        if name == "acceleration":
            return source.acceleration(self.q, self.qd, self.t, self.u, self.params)
        result = source.evaluate(name, self.q, self.qd, self.t, self.u, self.params)
        return np.atleast_1d(np.asarray(result))


def evaluate_whole(function: Function, state: Mapping[str, float], system: System) -> np.ndarray:
    """Return the values of a function; a matrix given by columns is assembled."""
    if not function.name.endswith("_column"):
        result, regular = evaluate(function, state)
        assert regular, function.route
        return np.array(result)
    names = [c.name for c in system.coordinates]
    columns = [
        evaluate(function, {**state, **{f"{n}{ALONG}": float(n == column_name) for n in names}})
        for column_name in names
    ]
    return np.array([column for column, _ in columns]).T.ravel()


def assert_every_route_agrees(system: System, reference: ReferenceModel, some: bool = True) -> None:
    """Compare all values of the reference with every route, within rounding.

    Energies and forces are sums of some hundred terms that may cancel: 1e-12 of the largest value
    of the state. The error of a solution of D x = b grows with the condition number of D. With
    `some`, D must be positive definite at one state at least.
    """
    routes = every_route(system)
    positive = 0
    for state in states(system):
        expected = ReferenceState(reference, state)
        condition = np.linalg.cond(expected["D"])
        if not condition < WORST:
            continue
        positive += 1
        size = 1 + max(np.max(np.abs(expected[n])) for n in ("D", "bias", "tau", "energy"))
        for (name, route), function in routes.items():
            expected_values = expected[VALUES.get(name.removesuffix("_column"), name)].ravel()
            scale, rounding = size * (1 + np.max(np.abs(expected_values))), 1e-13
            if name == "acceleration":
                scale, rounding = np.max(np.abs(expected_values)) + 1, 40 * EPS * condition
                assert rounding < 1e-9
            error = np.max(np.abs(evaluate_whole(function, state, system) - expected_values))
            assert error <= rounding * scale, (
                f"{name} by {route} is off by {error:.1e} of {scale:.1e}"
            )
    assert positive or not some


# --- every tree of up to three joints -------------------------------------------------------------


def check_text(text: str) -> None:
    note(text)
    system = system_from(text)
    reference = TaylorReference(system)
    try:
        assert_every_route_agrees(system, reference, some=False)
    except EomcError as error:  # correct if D is singular everywhere
        assert "inertia" in str(error)
        for state in states(system):
            assert not np.linalg.cond(ReferenceState(reference, state)["D"]) < 1e12


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
def test_trees_of_up_to_three_joints_agree_with_reference(
    shape: tuple[int, ...], plane: bool, data: Any
) -> None:
    check_text(data.draw(trees.trees(shape, plane)))


@pytest.mark.slow
@EVERY_SHAPE
@SPACES
@MANY
@given(data=st.data())
def test_many_trees_of_up_to_three_joints_agree_with_reference(
    shape: tuple[int, ...], plane: bool, data: Any
) -> None:
    check_text(data.draw(trees.trees(shape, plane)))


def two_bodies_with(joint: str, number: int, **more: Any) -> str:
    """Return a body with general inertia on that joint, attached to a body on a revolute joint."""
    inertia = {"mass": "m", "center": [0.1, -0.2, "l/3"], "inertia": [0.05, "J", 0.04, 0.004, 0, 0]}
    first = {"name": "b0", "joint": "revolute", "coordinates": "a", "axis": [1, 2, -2], **inertia}
    place = {"parent": "b0", "offset": ["l", 0.1, 0], "rotation": [["y", 0.4], ["x", "alpha"]]}
    names = [f"q{k}" for k in range(number)]
    last = {"name": "b1", "joint": joint, "coordinates": names, **place, **inertia, **more}
    return trees.text([first, last], [0, 1, "-g"], trees.PARAMETERS)


AXES = {"cylindrical": [2, -1, 2], "universal": [[1, 0, 0], [0.6, 0, 0.8]]}


@pytest.mark.slow
@pytest.mark.parametrize(
    "joint, number",
    tiers(
        [("cylindrical", 2), ("universal", 2), ("planar", 3), ("spherical", 3), ("free", 6)],
        "spherical",
    ),
)
def test_joints_with_several_coordinates_agree_with_reference(joint: str, number: int) -> None:
    more = {"axis": AXES[joint]} if joint in AXES else {}
    system = system_from(two_bodies_with(joint, number, damping="c", armature=0.01, **more))
    assert_every_route_agrees(system, TaylorReference(system))


@pytest.mark.slow
def test_lagrange_in_world_coordinates_agrees_with_reference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That route is not tried for many coordinates, since it costs more."""
    monkeypatch.setattr(lagrange, "MAX_LAGRANGE_DEFINITIONS", 1000)
    for joint in ("cylindrical", "universal"):
        system = system_from(two_bodies_with(joint, 2, axis=AXES[joint], damping="c"))
        assert lagrange.derive(system).lagrange
        assert_every_route_agrees(system, TaylorReference(system))


@pytest.mark.slow
def test_planar_joint_in_a_planar_scene_agrees_with_reference() -> None:
    names = ["x", "y", "turn"]
    body = {"name": "b", "joint": "planar", "coordinates": names, "mass": "m",
            "center": ["l", 0.1], "inertia": "J", "rotation": 0.3}  # fmt: skip
    arm = {"name": "tail", "parent": "b", "joint": "revolute", "coordinates": "tail",
           "offset": [0.2, "l"], "mass": 0.5, "center": ["l", 0]}  # fmt: skip
    system = system_from(trees.text([body, arm], [0, "-g"], trees.PARAMETERS))
    assert_every_route_agrees(system, TaylorReference(system))


@pytest.mark.parametrize(
    "wheel, slide",
    tiers(
        [("-alpha*a + 0.1", "l*a + c*sin(2*b)"), ("-a", "a"), ("a*b", "sqrt(1 + b**2)")],
        "-alpha*a + 0.1",
    ),
)
def test_coupled_joints_agree_with_reference(wheel: str, slide: str) -> None:
    system = system_from(trees.geared(wheel, slide))
    assert [c.name for c in system.coordinates] == ["a", "b"]
    assert_every_route_agrees(system, TaylorReference(system))


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [trees.chain(2), trees.arm(2, numbers=True, straight=True)],
    ids=["chain", "arm"],
)  # fmt: skip
def test_symbolic_reference_agrees_with_every_route(text: str) -> None:
    """SymPy expressions share only the system with the Taylor series."""
    system = system_from(text)
    assert_every_route_agrees(system, symbolic.derive(system))


@pytest.mark.parametrize(
    "joint, number", [("spherical", 3), pytest.param("free", 6, marks=pytest.mark.slow)]
)
def test_singular_angles_give_no_acceleration(joint: str, number: int) -> None:
    system = system_from(two_bodies_with(joint, number))
    pitch = f"q{number - 2}"
    state = states(system, count=1)[0]
    for (_, route), function in every_route(system, accelerations).items():
        for error, regular in ((0.0, False), (1e-9, False), (1e-3, True)):
            try:
                _, positive = evaluate(function, {**state, pitch: np.pi / 2 - error})
            except ArithmeticError:  # a zero pivot, or no finite result
                positive = False
            assert positive is regular, (route, error)


@pytest.mark.slow
def test_compiled_module_refuses_singular_angles(modules: Any) -> None:
    module = modules.unoptimised(two_bodies_with("spherical", 3))
    q = np.array([0.1, 0.2, np.pi / 2, 0.3])
    with pytest.raises(ArithmeticError, match=r"singular|definite"):
        module.acceleration(q, np.ones(4))
    q[2] = 1.0
    assert np.all(np.isfinite(module.acceleration(q, np.ones(4))))


def test_joint_without_inertia_is_refused_by_name() -> None:
    """Two slides along one line with no mass between them."""
    bodies: list[dict[str, Any]] = [
        {"name": "b0", "joint": "prismatic", "coordinates": "first", "axis": [1, 0]},
        {"name": "b1", "parent": "b0", "joint": "prismatic", "coordinates": "second",
         "axis": [1, 0], "mass": 1.0},
    ]  # fmt: skip
    system = system_from(trees.text(bodies, [0, "-g"], trees.PARAMETERS))
    with pytest.raises(EomcError, match=r"nothing resists first, second .* 'b0' has no inertia"):
        build_program(system)


@pytest.mark.parametrize("count", tiers([3, 9], 3))  # by Lagrange too; by Newton and Euler only
@pytest.mark.parametrize(
    ("joint", "axes", "dependent"),
    [
        ("revolute", [[0, 1, 0], [0, 1, 0]], "a0, a1"),
        ("prismatic", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], "a0, a1, a3"),
    ],
)
def test_joints_that_together_move_no_mass_are_named(
    joint: str, axes: list[list[float]], dependent: str, count: int
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
    system = system_from(trees.text(bodies, [0, 0, "-g"], trees.PARAMETERS))
    with pytest.raises(EomcError, match=f"nothing resists {dependent} as they move together"):
        build_program(system)


def test_coordinate_of_no_joint_is_refused_at_its_line() -> None:
    bodies = [{"name": "b0", "joint": "revolute", "coordinates": "turn", "mass": 1.0, "inertia": 1}]
    text = trees.text(bodies, [0, "-g"], trees.PARAMETERS)
    text = text.replace("[coordinates]\n", "[coordinates]\nidle = {}\n")
    with pytest.raises(EomcError, match=r"coordinates\.idle: .*name it in a body's joint") as error:
        program.inertia(build_program(system_from(text)))
    line = text.splitlines().index("idle = {}") + 1
    assert f":{line}:1: error" in str(error.value)


# --- chains, by their closed form -----------------------------------------------------------------


def closed_form_of_chain(
    n: int,
    m: float,
    l: float,  # noqa: E741
    g: float,
    q: np.ndarray,
    qd: np.ndarray,
) -> tuple[Any, Any]:
    """Return D and the bias of point masses m on rods l, in relative angles q.

    Gravity acts along -y. In angles phi to the x axis D_ij = m l^2 w_ij cos(phi_i - phi_j), where
    w_ij counts the masses from the later of i and j on, and bias_i = m l^2 sum_j w_ij sin(phi_i -
    phi_j) phi_j'^2 + m g l w_ii cos(phi_i); phi = L q, where L has ones on and below the diagonal.
    """
    L = np.tril(np.ones((n, n)))
    phi, rate = L @ q, L @ qd
    w = n - np.maximum.outer(np.arange(n), np.arange(n))
    angle_differences = np.subtract.outer(phi, phi)
    D = m * l**2 * w * np.cos(angle_differences)
    bias = m * l**2 * (w * np.sin(angle_differences)) @ rate**2 + m * g * l * np.diag(w) * np.cos(
        phi
    )
    return L.T @ D @ L, L.T @ bias


@pytest.mark.parametrize("n", [5, *(pytest.param(n, marks=pytest.mark.slow) for n in (20, 50))])
def test_chain_agrees_with_closed_form(n: int) -> None:
    text = trees.chain(n, points=True)
    system, functions = system_from(text), program_from(text)
    for state in states(system):
        q, qd = (np.array([state[x.name] for x in xs]) for xs in (system.q, system.qd))
        D, bias = closed_form_of_chain(n, state["m"], state["l"], state["g"], q, qd)
        matrix = np.array(program.matrix(functions, "D", state))
        np.testing.assert_allclose(matrix, D, rtol=0, atol=1e-13 * np.max(D))
        np.testing.assert_allclose(
            evaluate(functions["bias"], state)[0], bias, rtol=0, atol=1e-12 * np.max(np.abs(bias))
        )
        expected = np.linalg.solve(D, -bias)
        matrix, regular = evaluate(functions["acceleration"], state)
        assert regular
        error = np.max(np.abs(matrix - expected)) / np.max(np.abs(expected))
        assert error <= min(1e-9, 4 * EPS * np.linalg.cond(D))


# --- what it costs --------------------------------------------------------------------------------


def flops(text: str) -> int:
    return acceleration_of(text).cost.flops


@pytest.mark.parametrize("arms", tiers([2, 6], 2))
def test_zero_blocks_between_branches_are_not_computed(arms: int) -> None:
    """The arms of a star cost as much together as they cost one by one."""
    single, many = program_from(trees.star(1, 2)), program_from(trees.star(arms, 2))
    for name in ("acceleration", "D", "bias", "g"):
        assert abs(many[name].cost.flops - arms * single[name].cost.flops) <= arms, name
    n = 2 * arms
    D = np.array([o.coefficient != 0 for o in many["D"].outputs]).reshape(n, n)
    assert not np.any(D & ~np.kron(np.eye(arms, dtype=bool), np.ones((2, 2), bool)))


@pytest.mark.parametrize(
    "links, max_flops",
    [(10, 1050), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((20, 2300), (50, 6000)))],
)
def test_flops_per_link_of_a_planar_chain(links: int, max_flops: int) -> None:
    assert flops(trees.chain(links)) <= max_flops


@pytest.mark.slow
def test_every_further_link_costs_the_same() -> None:
    """The first and the last two links are cheaper; the links between them cost the same."""
    ten, twenty, fifty = (flops(trees.chain(n)) for n in (10, 20, 50))
    assert (fifty - twenty) / 30 == pytest.approx((twenty - ten) / 10, rel=0.02)
    assert fifty / 50 == pytest.approx(twenty / 20, rel=0.06)


@pytest.mark.slow
def test_an_arm_of_seven_joints_costs_at_most_1650() -> None:
    assert flops(trees.arm()) <= 1650


@pytest.mark.slow
def test_numeric_parameters_are_folded() -> None:
    """Nothing remains to be precomputed, and zeros cost nothing."""
    numbers, parameters = (acceleration_of(trees.arm(3, numbers=x)) for x in (True, False))
    assert parameters.early and all("g" in a.value.names for a in numbers.early)
    assert numbers.cost.flops <= 1.01 * parameters.cost.flops
    straight = trees.arm(3, numbers=True, straight=True)
    assert flops(straight) < 0.7 * numbers.cost.flops


@pytest.mark.slow
def test_grouped_inertias_save_flops_and_preserve_the_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = system_from(trees.arm(3))
    grouped = every_route(system, accelerations)
    monkeypatch.setattr(
        TreeDynamics, "group_inertias", lambda r: [r.link_inertia(link) for link in r.links]
    )
    plain = every_route(system, accelerations)
    for route in ("composite", "articulated"):
        one, other = (functions["acceleration", route] for functions in (grouped, plain))
        assert one.cost.flops < other.cost.flops
        for state in states(system):
            (a, _), (b, _) = evaluate(one, state), evaluate(other, state)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.max(np.abs(b)))


def test_comparison_detects_a_wrong_recursion(monkeypatch: pytest.MonkeyPatch) -> None:
    system = system_from(trees.arm(2))
    reference = TaylorReference(system)
    assert_every_route_agrees(system, reference)
    original = Vectors.cross
    monkeypatch.setattr(Vectors, "cross", lambda r, a, b: original(r, b, a))
    with pytest.raises(AssertionError, match="is off by"):
        assert_every_route_agrees(system, reference)
