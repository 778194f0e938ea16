"""Compare derivatives of accelerations from inverse dynamics with forward differentiation.

The latter differentiates the accelerations of the cheapest route. Both are evaluated in forty
digits, so that no difference is due to rounding. Nothing is compiled here.
"""

from __future__ import annotations

import inspect
import math
import re
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import point_masses, trees
from support.cases import SCENES
from support.session import Modules, tiers
from sympy import S
from test_newton_euler import FEW, MANY, SPACE, system_from, two_bodies_with

from eomc.base.errors import EomcError
from eomc.derive import inverse_dynamics_derivatives, lagrange
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.program.ir import Function, evaluate
from eomc.program.lower import lower
from eomc.program.routes import ROUTES, Candidate, RouteInputs, weight
from eomc.scene.read import parse

BODY = {
    "mass": "m",
    "center": [0.1, -0.2, "l/3"],
    "inertia": [0.05, "J", 0.04, 0.004, 0.003, 0.002],
}
TURN, SLIDE, SCREW = "revolute", "prismatic", "screw"
INPUTS = ("[inputs]", {"u": {"signal": "sin(t)"}})


def bodies_on(*joints: Any, gravity: Any = (0, 1, "-g"), more: Any = ()) -> str:
    """Return bodies on these joints, (kind, index of the parent, further keys) of each."""
    bodies = [
        {"name": f"b{k}", "joint": kind, "coordinates": f"q{k}", **BODY,
         **({"axis": [1, 2, -2]} if kind == SLIDE else {}), **keys,
         "offset": ["l", 0.1, -0.2], "rotation": [["y", 0.4 + k], ["x", "alpha"]],
         **({"parent": f"b{parent}"} if parent >= 0 else {})}
        for k, (kind, parent, keys) in enumerate(joints)
    ]  # fmt: skip
    return trees.text(bodies, gravity, trees.PARAMETERS, [INPUTS, *more])


PITCH = {"axis": [0, 1, 0], "pitch": 0.3}
MASSLESS = {"mass": 0, "center": [0, 0, 0], "inertia": [0, 0, 0]}
ENERGY = {"kinetic": "m*dot(b1_x)**2/3 + J*(1 + sin(q0)**2)*q0_dot**2", "potential": "k*q1**2/5"}
SPRING = {"bodies": ["world", "b1"], "points": [[0, 0.5, 0], [0.1, 0, "l"]]}
BESIDE = [
    ("[energy]", ENERGY),
    ("[forces]", {"q1": "u*cos(q0) - c*q1_dot*q0_dot"}),
    ("[[spring]]", {**SPRING, "stiffness": "k", "length": 0.2}),
    ("[[damper]]", {**SPRING, "damping": "c"}),
]
SLIDE_BETWEEN = bodies_on((TURN, -1, {}), (SLIDE, 0, {}), (TURN, 1, {}))
TEXTS = {
    "slide-between": SLIDE_BETWEEN,
    "screws": bodies_on((SCREW, -1, PITCH), (SCREW, 0, PITCH), (TURN, 1, {})),
    "branches": bodies_on((TURN, -1, {}), (TURN, 0, {}), (SLIDE, 0, {}), (SCREW, 2, PITCH)),
    "massless": bodies_on((TURN, -1, MASSLESS), (SLIDE, 0, MASSLESS), (TURN, 1, {}), (TURN, 2, {})),
    "armature": bodies_on(
        (TURN, -1, {"armature": 0.3, "damping": "c", "actuator": "u"}),
        (SLIDE, 0, {"armature": 0.2, "friction": "c", "friction_width": 0.5}),
        (TURN, 1, {}),
    ),
    "mimic": trees.geared("-alpha*a + 0.1", "2*b"),
    "coupled": trees.geared("a*b", "sqrt(1 + b**2)"),
    "beside": bodies_on((TURN, -1, {}), (TURN, 0, {}), (SLIDE, 1, {}), more=BESIDE),
    **{
        f"gravity-{axis}": bodies_on((TURN, -1, {}), (SLIDE, 0, {}), gravity=g)
        for axis, g in (("x", ["g", 0, 0]), ("y", [0, "g", 0]), ("z", [0, 0, "-g"]))
    },
    "box": (SCENES / "tumbling_box.toml").read_text(encoding="utf-8"),
    "suspension": (SCENES / "suspension.toml").read_text(encoding="utf-8"),
}

NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))
LARGE = (  # of both; they are compared in the slow tier
    "branches", "massless", "mimic", "beside", "slide-between", "armature", "screws", "coupled",
    "andrews_squeezer", "bricard", "chain", "delta_robot", "four_bar", "quadrotor", "rolling_disk",
    "slider_crank", "suspension", "tumbling_box",
)  # fmt: skip


def candidates(system: System) -> dict[str, Candidate]:
    """Return the derivatives of the accelerations by each route."""
    material = RouteInputs(lagrange.derive(system))
    taken = program.accelerations(material)[1]
    derived = {r.name: r.linearization(material, taken) for r in ROUTES.values()}
    return {route: d for route, d in derived.items() if d}


def functions(system: System) -> dict[str, Function]:
    return {
        route: lower("linearization", d.tape, d.outputs, system.names, checks=d.checks)
        for route, d in candidates(system).items()
    }


def by_tree(system: System, source: Any = inverse_dynamics_derivatives) -> Function:
    """Return the derivatives by the route of a tree, or by another version of its module."""
    derived = source.linearize(system, system.tree)
    entries = [x for row in derived.rows for x in row]
    return lower("linearization", derived.tape, entries, system.names, checks=derived.pivots)


def largest_difference(one: Function, other: Function, system: System) -> float:
    """Return the largest difference of two functions at two states, of the largest entry."""
    differences = []
    for state in point_masses.states(system, count=2, seed=7, reach=1.2):
        values = [evaluate(f, state, exact=True) for f in (one, other)]
        assert all(regular for _, regular in values)
        (first, _), (second, _) = values
        size = max(map(abs, first))
        differences += [abs(a - b) / size for a, b in zip(first, second, strict=True)]
    return float(max(differences))


def assert_routes_agree(system: System, routes: dict[str, Function]) -> None:
    assert {*routes} == {"forward", "tree"}
    assert largest_difference(*routes.values(), system) < 1e-25


@cache
def compared(name: str) -> tuple[System, dict[str, Function]]:
    system = system_from(TEXTS[name])
    return system, functions(system)


@pytest.mark.parametrize("name", tiers(TEXTS, *(name for name in TEXTS if name not in LARGE)))
def test_derivatives_of_inverse_dynamics_agree_with_forward_differentiation(name: str) -> None:
    assert_routes_agree(*compared(name))


@FEW
@given(data=st.data())
def test_derivatives_of_a_random_tree_agree(data: Any) -> None:
    check_text(data.draw(trees.trees((-1, 0, 0), plane=True)))


@pytest.mark.slow
@pytest.mark.parametrize("shape", SPACE, ids=str)
@MANY
@given(data=st.data())
def test_derivatives_of_many_random_trees_agree(shape: Any, data: Any) -> None:
    check_text(data.draw(trees.trees(shape, plane=False)))


def check_text(text: str) -> None:
    """Compare the routes of a scene, if the scene has accelerations."""
    system = system_from(text)
    try:
        program.build(lagrange.derive(system))
    except EomcError as error:
        assert "inertia" in str(error)
        return
    assert_routes_agree(system, functions(system))


# --- identities -----------------------------------------------------------------------------------


@cache
def robot() -> System:
    """Return an arm with a torque input at each joint and a vertical first axis."""
    text = trees.arm(3)
    inputs = "".join(f"u{k} = {{}}\n" for k in range(1, 4))
    text = text.replace("[[body]]", f"[inputs]\n{inputs}[[body]]", 1)
    for k in range(1, 4):
        text = text.replace(f'coordinates = "q{k}"', f'coordinates = "q{k}"\nactuator = "u{k}"')
    return system_from(text)


def values(function: Function, state: Any, system: System) -> np.ndarray:
    result, regular = evaluate(function, state)
    assert regular
    return np.reshape(result, (len(system.q), -1))


def test_mass_matrix_of_the_recursion_is_that_of_composite_bodies() -> None:
    system = robot()
    tape = lagrange.derive(system).newton_euler.tape
    dynamics = inverse_dynamics_derivatives.TreeDerivatives(tape, system.tree)
    derivatives = dynamics.derivatives([S.Zero] * dynamics.n)
    assert derivatives.acceleration == dynamics.mass_matrix()  # the same names on the tape
    assert all(x != 0 for row in derivatives.acceleration for x in row)


def test_derivatives_by_torques_are_the_inverse_of_the_mass_matrix() -> None:
    system = robot()
    functions_of_robot = program.build(lagrange.derive(system)).functions
    (state,) = point_masses.states(system, count=1)
    D = values(functions_of_robot["D"], state, system)
    B = values(by_tree(system), state, system)[:, 6:]
    np.testing.assert_allclose(D @ B, np.eye(3), atol=1e-12)


def test_turning_about_the_vertical_changes_no_acceleration() -> None:
    system = robot()
    rows = inverse_dynamics_derivatives.linearize(system, system.tree).rows
    assert [row[0] for row in rows] == [0, 0, 0]
    assert all(row[1] != 0 for row in rows)


def test_derivatives_by_velocities_vanish_at_rest_without_damping() -> None:
    system = robot()
    (state,) = point_masses.states(system, count=1)
    at_rest = state | {x.name: 0.0 for x in system.qd}
    assert not values(by_tree(system), at_rest, system)[:, 3:6].any()
    assert values(by_tree(system), state, system)[:, 3:6].any()


# --- refusals and costs ---------------------------------------------------------------------------


def test_singular_angles_have_no_derivatives() -> None:
    system = system_from(two_bodies_with("spherical", 3))
    function = by_tree(system)
    (state,) = point_masses.states(system, count=1)
    for error, expected in ((0.0, False), (1e-9, False), (1e-3, True)):
        try:
            _, regular = evaluate(function, {**state, "q1": math.pi / 2 - error})
        except ArithmeticError:
            regular = False
        assert regular is expected, error


@pytest.mark.slow
def test_compiled_module_has_derivatives_along_the_tree(modules: Modules) -> None:
    text = two_bodies_with("spherical", 3) + "\n[run]\nlinearize = true\n"
    built = program.build(lagrange.derive(system_from(text)))
    assert built["linearization"].route == "tree"
    module: Any = modules.unoptimised(text)
    q, qd, d = np.array([0.1, 0.2, 0.4, 0.3]), np.array([0.3, -0.5, 0.7, 0.2]), 1e-5
    x = np.concatenate([q, qd])
    slopes = [
        (module.rhs(0.0, x + e) - module.rhs(0.0, x - e)) / (2 * d) for e in d * np.eye(len(x))
    ]
    A, _ = module.linearize(q, qd)
    # differences over 2e-5 of values below 100: errors of d^2 and of rounding
    np.testing.assert_allclose(A, np.transpose(slopes), rtol=1e-6, atol=1e-6)
    q[2] = np.pi / 2
    with pytest.raises(ArithmeticError, match=r"singular|definite"):
        module.linearize(q, qd)


def test_long_chains_are_not_differentiated_along_the_tree() -> None:
    lengths = {n: system_from(trees.chain(n)) for n in (12, 40)}
    applies = {n: inverse_dynamics_derivatives.applies(s, s.tree) for n, s in lengths.items()}
    assert applies == {12: True, 40: False}


@pytest.mark.slow
def test_routes_that_lose_digits_are_not_selected() -> None:
    """D of a chain of rods in relative angles is ill-conditioned."""
    system = system_from(trees.chain(5))
    routes = candidates(system)
    best = program.cheapest("linearization", system, routes)
    assert dict(best.routes)["tree"].flops < dict(best.routes)["forward"].flops
    assert best.route == "forward"


def linear_text(name: str) -> str:
    """Return a scene with linearize = true."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    head, _, tail = re.sub("linearize = .*\n", "", text).partition("[run]\n")
    return f"{head}\n[run]\nlinearize = true\n{tail}"


@pytest.mark.parametrize("name", tiers(NAMES, *(name for name in NAMES if name not in LARGE)))
def test_derivatives_are_never_dearer_than_one_sided_differences(name: str) -> None:
    """They would take one acceleration at the state, and one for each column."""
    system = from_scene(parse(linear_text(name), f"{name}.toml"))
    built = program.build(lagrange.derive(system)).functions
    columns = 2 * len(system.q) + len(system.u)
    calls = 1
    if "linearization" not in built:
        calls = columns
    derivatives = built["linearization" if calls == 1 else "linearization_column"]
    acceleration = built["acceleration"]
    for cost in (weight, lambda c: c.flops):
        assert calls * cost(derivatives.cost) <= (1 + columns) * cost(acceleration.cost)


LIMITS = {  # operations of the route; more mean that common subexpressions are lost
    "slide-between": 1352,
    "screws": 1915,
    "branches": 2136,
    "massless": 2769,
    "mimic": 2127,
}


@pytest.mark.parametrize("name", tiers(LIMITS, "slide-between", "screws"))
def test_operations_of_the_route_do_not_grow(name: str) -> None:
    assert compared(name)[1]["tree"].cost.flops <= LIMITS[name]


# --- mutants --------------------------------------------------------------------------------------

MUTANTS = (  # r1, r2, F1, F2, Psid, Psidd, G, its change of origin, couplings
    ("V.apply(list(zip(*G, strict=True)), turn)", "V.apply(G, turn)"),
    ("turn), V.cross(slide, p))", "turn), V.cross(p, slide))"),
    ("return V.scaled(across, minus_two)", "return V.scaled(across, S(2))"),
    ("self._inertia_times(inertia, (turn, slide))", "self._inertia_times(inertia, (turn, turn))"),
    ("self._inertia_times(inertia, psidd)", "self._inertia_times(inertia, psid)"),
    ("V.cross(turn, moment), V.cross(slide, force)", "V.cross(turn, moment)"),
    ("V.cross(slide, force)), V.cross(turn, force)", "V.cross(slide, force)), ZERO"),
    ("self._inertia_times(inertia, psidd), spun)", "self._inertia_times(inertia, psidd))"),
    ("F1 = self._add(coriolis_times(psid[0]), ", "F1 = self._add("),
    ("coriolis_times(turn), heavy, heavy)", "coriolis_times(turn), heavy)"),
    ("F2 = self._add(coriolis_times(turn), ", "F2 = self._add("),
    ("V.scaled(V.cross(p, w), minus_two)", "ZERO"),
    ("V.plus(V.cross(v, turn), slid)", "V.cross(v, turn)"),
    ("psid = turned, V.plus(V.cross(v, turn), slid)", "psid = turned, slid"),
    ("V.scaled(V.cross(v, turned), S(2))", "V.cross(v, turned)"),
    ("V.cross(alpha, slide), ", ""),
    ("V.cross(w, slid), ", ""),
    (", V.cross(a, turn))", ")"),
    ("(V.plus(V.cross(alpha, turn), V.cross(w, turned))", "(V.cross(alpha, turn)"),
    ("tape.scaled(S.Half, V.add", "tape.scaled(S.One, V.add"),
    ("columns = [V.cross(w, row)", "columns = [V.cross(row, w)"),
    ("self._product_of_skews(x.moment, v)", "self._product_of_skews(v, x.moment)"),
    ("return G, V.plus(V.scaled(v, x.mass), V.cross(w, x.moment))", "return G, ZERO"),
    ("_sum(V, first[0], G, moved)", "_sum(V, first[0], G)"),
    ("self._product_of_skews(self.tree.arm[k], p)", "self._product_of_skews(p, self.tree.arm[k])"),
    ("_sum(V, first[0], G, moved), V.plus(first[1], p)", "_sum(V, first[0], G, moved), first[1]"),
    ("self._double(self._power(r2, psid))", "self._power(r2, psid)"),
    ("self._project(j, (r1, ZERO)), ", ""),
    ("V.dot(r1, psid[0]), ", ""),
    ("D[k][k] = V.add(D[k][k], self.armature[k])", "pass"),
    ("V.times(self.armature[k], joint_accelerations[k])", "S.Zero"),
    ("by_coordinate(J.forces, slopes), changes)", "changes)"),
    ("tape.substitute(tangents, constant)", "tape.substitute(tangents, dict(zip(constant, q)))"),
    ("V.plus(moment, V.cross(tree.arm[k], force)), force", "moment, force"),
)  # fmt: skip
SENSITIVE = ("screws", "armature", "coupled", "slide-between")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        pytest.param(*mutant, marks=() if k % 12 == 6 else pytest.mark.slow)
        for k, mutant in enumerate(MUTANTS)
    ],
)
def test_each_term_of_the_derivatives_is_tested(old: str, new: str) -> None:
    """The comparison fails where a term is left out or has another sign or factor."""
    source = inspect.getsource(inverse_dynamics_derivatives)
    assert source.count(old) == 1
    mutant = ModuleType("mutant")
    mutant.__dict__["__name__"] = inverse_dynamics_derivatives.__name__
    exec(source.replace(old, new), mutant.__dict__)

    def differs(name: str) -> bool:
        system, routes = compared(name)
        return largest_difference(routes["forward"], by_tree(system, mutant), system) > 1e-6

    assert any(map(differs, SENSITIVE))
