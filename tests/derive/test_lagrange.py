"""Compare the fast derivation of Lagrange's equations with the plain reference.

Random small systems have every term that a kinetic energy may contain. Python evaluates the
program, and nothing is compiled here; tests/runtime and `eomc check` compare the C with it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest
import sympy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import point_masses
from support.cases import scene_system
from support.session import tiers

from eomc.base.errors import EomcError, SceneError
from eomc.derive.lagrange import derive
from eomc.derive.ldl import Solution
from eomc.model.system import System, dot, from_scene, symbol, t
from eomc.program import program
from eomc.program.ir import Call, evaluate
from eomc.program.program import Program
from eomc.program.routes import RouteInputs
from eomc.scene.read import parse
from eomc.verify.sampling import VALUES as QUANTITIES
from eomc.verify.symbolic import SymbolicReference
from eomc.verify.symbolic import derive as plainly

FEW = settings(
    derandomize=True, deadline=None, max_examples=2, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
MANY = settings(FEW, max_examples=48)

A, B = symbol("a"), symbol("b")  # parameters
U = symbol("u")  # an input
NAMES = ("x", "theta", "phi")

# the name of a value in the program and in the reference
VALUES = {**QUANTITIES, "signal": "signals"}


# --- random systems ------------------------------------------------------------------------------


@st.composite
def expressions(draw: Any, leaves: list[sympy.Expr], depth: int = 2) -> sympy.Expr:
    """Draw a smooth, bounded expression without poles in some of the leaves."""
    if depth == 0 or draw(st.integers(0, 3)) == 0:
        return draw(st.sampled_from(leaves))
    one, two = (draw(expressions(leaves, depth - 1)) for _ in range(2))
    return draw(
        st.sampled_from(
            [
                one + two,
                one - two / 3,
                one * two,
                sympy.sin(one),
                sympy.cos(one),
                sympy.cos(one - two),
                one**2,
                sympy.sqrt(2 + one**2),
                1 / (2 + sympy.sin(one)),
                sympy.exp(-(one**2)) / 2,
                sympy.atan(one),
                sympy.Rational(2, 3) * one,
            ]
        )
    )


@st.composite
def systems(draw: Any) -> System:
    """Draw 1 to 3 coordinates, and K from squares and moving points with optional further terms."""
    q = [symbol(name) for name in NAMES[: draw(st.integers(1, 3))]]
    qd = [symbol(f"{name}_dot") for name in NAMES[: len(q)]]
    timed, linear, friction, inputs = (draw(st.booleans()) for _ in range(4))
    leaves_without_velocities = [*q, A, B] + [t] * timed
    over = expressions(leaves_without_velocities)

    # so that D > 0 whatever the other terms are
    kinetic = sum((A + k) * v**2 / 2 for k, v in enumerate(qd))
    for _ in range(draw(st.integers(0, 2))):
        combination = sum(draw(over) * v for v in draw(st.lists(st.sampled_from(qd), max_size=2)))
        kinetic += B * combination**2 / 2
    definitions: dict[sympy.Symbol, sympy.Expr] = {}
    points = [symbol(f"y{k}") for k in range(draw(st.integers(0, 2)))]
    for point in points:
        known = [*leaves_without_velocities, *definitions]
        definitions[point] = draw(expressions(known)) + draw(st.sampled_from(q))
        kinetic += A * dot(point) ** 2 / 2
    potential = draw(expressions([*leaves_without_velocities, *points]))
    if linear:
        kinetic += draw(over) * draw(st.sampled_from(qd)) + draw(over)
    dissipation = sympy.S.Zero
    if friction:
        dissipation = B * (draw(over) * draw(st.sampled_from(qd))) ** 2 / 2
        if points:
            dissipation += A * dot(points[0]) ** 2 / 4
    forces, signals = {}, {}
    if inputs:
        signals = {U: draw(expressions([*q, *qd, t]))}
        forces = {
            draw(st.sampled_from(q)): U * draw(over),
            draw(st.sampled_from(q)): draw(expressions([U, *q, *qd, t])),
        }
    start: Mapping[Any, float] = dict.fromkeys(q, 0.1)
    return System.make(
        "random_system", start, kinetic, potential, parameters={A: 1.5, B: 0.7},
        dissipation=dissipation, forces=forces, inputs=signals, definitions=definitions,
    )  # fmt: skip


def build_program(system: System) -> Program:
    return program.build(derive(system))


states = partial(point_masses.states, seed=5)


def reference_value(
    reference: SymbolicReference, name: str, state: Mapping[str, float]
) -> np.ndarray:
    """Return the reference's value of a field or of the acceleration."""
    system = reference.system
    q, qd, u = ([state[x.name] for x in xs] for xs in (system.q, system.qd, system.u))
    params = {p.name: state[p.name] for p in system.parameters}
    if name == "acceleration":
        return np.ravel(reference.acceleration(q, qd, state["t"], u, params))
    return np.ravel(reference.evaluate(name, q, qd, state["t"], u, params))


def assert_agree(system: System) -> None:
    """Assert that every value of the program equals the reference's, to rounding."""
    program_functions, reference = build_program(system), plainly(system)
    for state in states(system):
        size = 1 + max(
            np.max(np.abs(reference_value(reference, n, state))) for n in ("D", "bias", "tau")
        )
        for name, reference_name in [*VALUES.items(), ("acceleration", "acceleration")]:
            expected = reference_value(reference, reference_name, state)
            if name not in program_functions:  # trivial functions are omitted
                if name == "jacobi":
                    np.testing.assert_allclose(
                        expected,
                        reference_value(reference, "energy", state),
                        rtol=1e-11,
                        atol=1e-11 * size,
                    )
                else:
                    assert not np.any(expected), name
                continue
            result, regular = evaluate(program_functions[name], state)
            assert regular
            scale = size * (1 + np.max(np.abs(expected)))
            np.testing.assert_allclose(
                result, expected, rtol=1e-11, atol=1e-12 * scale, err_msg=name
            )


@pytest.mark.slow
@FEW
@given(systems())
def test_random_system_agrees_with_reference(system: System) -> None:
    assert_agree(system)


@pytest.mark.slow
@MANY
@given(systems())
def test_many_random_systems_agree_with_reference(system: System) -> None:
    assert_agree(system)


@pytest.mark.parametrize("route", ["lagrange", "expanded", "cancelled"])
@pytest.mark.parametrize(
    "name",
    tiers(
        ["cartpole", "double_pendulum", "foucault_pendulum", "heavy_top", "kapitza_pendulum"],
        "foucault_pendulum",
    ),
)
def test_every_route_gives_the_same_acceleration(
    name: str, route: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the cheapest route is used, so each one is tested by itself."""
    cheapest = program.cheapest

    def only_this_route(name: str, system: System, routes: Mapping[str, Any]) -> Any:
        return cheapest(name, system, {route: routes[route]} if route in routes else routes)

    monkeypatch.setattr(program, "cheapest", only_this_route)
    system = scene_system(name)
    assert build_program(system)["acceleration"].route == route
    assert_agree(system)


def test_comparison_detects_a_wrong_sign(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Program.__getitem__

    def with_negative_coriolis_matrix(self: Program, name: str) -> Any:
        function = original(self, name)
        if name != "C":
            return function
        from dataclasses import replace

        return replace(
            function,
            outputs=tuple(replace(o, coefficient=-o.coefficient) for o in function.outputs),
        )

    system = scene_system("cartpole")
    assert_agree(system)
    monkeypatch.setattr(Program, "__getitem__", with_negative_coriolis_matrix)
    with pytest.raises(AssertionError, match="C"):
        assert_agree(system)


# --- what it costs -------------------------------------------------------------------------------


def chain(links: int) -> str:
    """Write a planar chain in relative angles, with energies from the positions of the masses."""
    angles = [f"q{k}" for k in range(1, links + 1)]
    lines = ["eomc = 1", f'name = "chain_{links}"', "[coordinates]"]
    lines += [f'{q} = {{ unit = "rad", start = 0.1 }}' for q in angles]
    lines += ["[parameters]", "m = 1.0", "l = 0.5", "g = 9.81", "[definitions]"]
    for k in range(1, links + 1):
        before = f"x{k - 1} + ", f"y{k - 1} - ", f"a{k - 1} + "
        x, y, a = before if k > 1 else ("", "-", "")
        lines += [f'a{k} = "{a}q{k}"', f'x{k} = "{x}l*sin(a{k})"', f'y{k} = "{y}l*cos(a{k})"']
    squares = " + ".join(f"dot(x{k})**2 + dot(y{k})**2" for k in range(1, links + 1))
    heights = " + ".join(f"y{k}" for k in range(1, links + 1))
    lines += ["[energy]", f'kinetic = "m*({squares})/2"', f'potential = "m*g*({heights})"']
    return "\n".join(lines)


@pytest.mark.slow
def test_ten_links_are_derived_in_two_seconds_with_1800_flops() -> None:
    system = from_scene(parse(chain(10), "chain_10.toml"))

    def derivation() -> tuple[float, Program]:
        start = time.process_time()
        program_functions = build_program(system)
        return time.process_time() - start, program_functions

    spent, program_functions = derivation()
    if spent >= 2:  # perhaps the machine was busy
        spent, _ = derivation()
    assert program_functions["acceleration"].cost.flops <= 1800
    assert program_functions["bias"].cost.flops < program_functions["acceleration"].cost.flops
    assert spent < 2  # of CPU time; usual is 1.2


@pytest.mark.slow
def test_three_links_agree_with_reference() -> None:
    assert_agree(from_scene(parse(chain(3), "chain_3.toml")))


def test_constant_terms_cost_nothing_at_run_time() -> None:
    """D = m: its reciprocal is precomputed from parameters, and C is zero."""
    program_functions = build_program(scene_system("mass_spring"))
    assert program_functions["acceleration"].cost.divisions == 0
    assert [
        a.value.function
        for a in program_functions["acceleration"].early
        if isinstance(a.value, Call)
    ] == ["reciprocal"]
    assert program_functions["D"].cost.flops == 0
    assert [o.coefficient for o in program_functions["C"].outputs] == [0]
    assert "tau" not in program_functions
    assert "power" not in program_functions
    assert "jacobi" not in program_functions
    assert "signal" not in program_functions


def test_diagonal_mass_matrix_needs_no_elimination() -> None:
    """Three masses on springs need three divisions, all by parameters."""
    n = 3
    x, v = ([symbol(f"x{k}{end}") for k in range(n)] for end in ("", "_dot"))
    m = [symbol(f"m{k}") for k in range(n)]
    system = System.make(
        "masses", x, sum(m * v**2 for m, v in zip(m, v, strict=True)) / 2,
        sum((a - b) ** 2 for a, b in zip(x, [0, *x], strict=False)) / 2,
        parameters=dict.fromkeys(m, 1.0),
    )  # fmt: skip
    program_functions = build_program(system)
    assert program_functions["acceleration"].cost.divisions == 0
    assert program_functions["acceleration"].cost.flops <= 12
    assert_agree(system)


def arrow(n: int) -> System:
    """Return n bodies on a cart, each coupled with the cart only."""
    q = [symbol(f"q{k}") for k in range(n + 1)]
    (_, *angles), (cart, *rates) = q, [symbol(f"q{k}_dot") for k in range(n + 1)]
    pairs = zip(angles, rates, strict=True)
    kinetic = cart**2 + sum((cart * sympy.cos(a) + w) ** 2 + w**2 for a, w in pairs)
    return System.make("arrow", q, kinetic)


def test_elimination_skips_zeros_of_the_mass_matrix() -> None:
    """The arrow's D is eliminated from its tips without fill: each body adds a constant cost."""
    functions = (program.accelerations(RouteInputs(derive(arrow(n))))[0] for n in (3, 4, 5))
    flops = [acceleration.cost.flops for acceleration in functions]
    assert flops[2] - flops[1] == flops[1] - flops[0]
    ldl = derive(arrow(3)).ldl
    assert isinstance(ldl, Solution)
    assert 0 not in ldl.order[:2]
    assert_agree(arrow(3))


# --- what is refused -----------------------------------------------------------------------------

x, v, y, w = (symbol(name) for name in ("x", "x_dot", "y", "y_dot"))


@pytest.mark.parametrize(
    "kinetic", [v**4 + v**2, sympy.sqrt(1 + v**2), v**2 * sympy.tanh(v), sympy.exp(v) + v**2, v**3]
)
def test_kinetic_energy_not_quadratic_in_velocities_is_refused(kinetic: sympy.Expr) -> None:
    with pytest.raises(EomcError, match="not quadratic in the velocities") as error:
        build_program(System.make("odd", [x], kinetic))
    assert "x_dot" in str(error.value)


def test_kinetic_energy_that_simplifies_to_a_quadratic_is_accepted() -> None:
    """Terms that cancel are recognised: (v^2)^2/v^2, sin^2 + cos^2."""
    hidden = (1 + sympy.sin(x) ** 2 + sympy.cos(x) ** 2) * v**2 / 2 + (v + x) ** 2 - 2 * v * x
    assert_agree(System.make("hidden", [x], hidden))


@pytest.mark.parametrize(
    "kinetic",
    [sympy.S.Zero, v**2 / 2, v**2 / 2 + sympy.sin(x) * w, v**2 / 2 + y**2],
)
def test_coordinate_without_inertia_is_refused(kinetic: sympy.Expr) -> None:
    with pytest.raises(EomcError, match=r"has no inertia|nothing has inertia") as error:
        build_program(System.make("light", [x, y], kinetic, x**2 + y**2))
    assert "'y'" in str(error.value) or kinetic == 0
    assert ("write y_dot**2" in str(error.value)) == kinetic.has(w)


def test_derivative_of_a_discontinuity_is_refused() -> None:
    with pytest.raises((EomcError, SceneError), match="jumps"):
        build_program(System.make("jump", [x], v**2 / 2, sympy.sign(x) * x**2))


@pytest.mark.parametrize("mass", ["m/2 + 1/4", "m/2 + sqrt(2)", "m*sqrt(3) + sqrt(2) + 1/3"])
def test_irrational_constants_with_parameters_agree_with_reference(mass: str) -> None:
    system = from_scene(
        parse(
            f"""
            eomc = 1
            name = "irrational"
            [coordinates]
            x = {{}}
            [parameters]
            m = 1.0
            [definitions]
            u = "x*cos(0.3)"
            [energy]
            kinetic = "({mass})*dot(u)**2 + (m + 1/4)*(1 + x**2)*dot(u)**2"
            potential = "(m + sqrt(2))*sin(x) + sqrt(2)*sin(x)"
            """
        )
    )
    assert_agree(system)
