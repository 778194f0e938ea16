"""Generalized potentials: forces of magnetic fields, with energies that do not contain them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from support.session import Modules

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.derive import lagrange
from eomc.model.mechanics import NotLinearError, split_potential
from eomc.model.system import System, dot, from_scene, symbol
from eomc.program import program
from eomc.scene.read import parse
from eomc.verify import symbolic, taylor

x, y, x_dot, y_dot = map(symbol, ("x", "y", "x_dot", "y_dot"))
VELOCITIES = (x_dot, y_dot)

CHARGE = """
eomc = 1
name = "charge"
[coordinates]
x = { start = 0.0, rate = 1.0 }
y = { start = 0.0, rate = 0.5 }
[parameters]
m = 1.0
e = 2.0
B = 3.0
k = 0.5
[definitions]
A_x = "-B*y/2"
A_y = "B*x/2"
place = "x"
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "k*x**2/2 - e*(A_x*dot(place) + A_y*y_dot)"
[run]
linearize = true
inverse_dynamics = true
"""


def charge(potential: str) -> System:
    """Return a charge with m = 1, e = 2, B = 3."""
    return System.make(
        "made_charge", {"x": (0, 1), "y": (0, 0.5)}, "m*(x_dot**2 + y_dot**2)/2", potential,
        parameters={"m": 1, "e": 2, "B": 3},
    )  # fmt: skip


def test_charge_moves_on_the_circle_of_the_lorentz_force(modules: Modules) -> None:
    module = modules.unoptimised(charge("e*B*(y*x_dot - x*y_dot)/2"))
    assert module.acceleration([0.3, 0.2], [1.0, 0.5]) == pytest.approx([3.0, -6.0])
    run = module.simulate(h=0.001, duration=1.0)
    speed, angle = np.hypot(1.0, 0.5), np.arctan2(0.5, 1.0) - 6.0 * run.t
    assert run.qd == pytest.approx(
        speed * np.column_stack([np.cos(angle), np.sin(angle)]), abs=1e-8
    )


def test_linear_part_of_the_potential_has_no_energy(modules: Modules) -> None:
    module = modules.unoptimised(from_scene(parse(CHARGE)))
    q, qd = [0.3, 0.2], [1.0, 0.5]
    assert module.acceleration(q, qd) == pytest.approx([3.0 - 0.15, -6.0])
    assert module.potential_energy(q) == pytest.approx(0.5 * 0.3**2 / 2)
    assert module.energy(q, qd) == pytest.approx(0.625 + 0.5 * 0.3**2 / 2)
    assert module.jacobi(q, qd) == module.energy(q, qd)
    A, _ = module.linearize(q, qd)
    assert A[2:] == pytest.approx(np.array([[-0.5, 0, 0, 6], [0, 0, -6, 0]]))
    forces = module.inverse_dynamics(q, qd, [0.0, 0.0])
    assert forces == pytest.approx([-3.0 + 0.15, 6.0])


def test_equations_contain_the_full_lorentz_force() -> None:
    result = eomc.equations(charge("e*B*(y*x_dot - x*y_dot)/2"))
    names = ("m", "e", "B", "x", "y", "x_dot", "y_dot", "x_ddot", "y_ddot")
    m, e, B, x, y, x_dot, y_dot, x_ddot, y_ddot = (result.symbols[name] for name in names)
    rows = [sympy.expand(row.lhs - row.rhs) for row in result.scalar]
    assert rows == [m * x_ddot - e * B * y_dot, m * y_ddot + e * B * x_dot]
    assert sympy.expand(result.kinetic - result.L - e * B * (y * x_dot - x * y_dot) / 2) == 0
    assert result.potential == 0
    assert "Lagrangian K - P - U:" in str(result)


@pytest.mark.parametrize("path", ["-e*B*x*y_dot", "e*B*y*x_dot + x*y_dot + y*x_dot"])
def test_gauge_transformation_preserves_the_motion(path: str) -> None:
    def acceleration_of(potential: str) -> sympy.Matrix:
        result = symbolic.derive(charge(potential))
        return sympy.expand(sympy.Matrix(result.bias))

    assert acceleration_of(path) == acceleration_of("e*B*(y*x_dot - x*y_dot)/2")


def test_references_and_derivation_agree_for_a_varying_field() -> None:
    """With explicit time, dot(...) of a moving point, and a term that is linear in K as well."""
    text = CHARGE.replace("B*y/2", "B*y/2*(1 + sin(t))").replace('place = "x"', 'place = "x*t"')
    text = text.replace('_dot**2)/2"', '_dot**2)/2 + k*x_dot"')
    system = from_scene(parse(text))
    plain, jets = symbolic.derive(system), taylor.TaylorReference(system)
    state = {"q": [0.3, 0.4], "qd": [0.7, -0.2], "t": 0.3}
    for name in ("D", "C", "g", "bias", "kinetic", "potential", "energy", "jacobi", "power"):
        assert plain.evaluate(name, **state) == pytest.approx(jets.evaluate(name, **state)), name
    program_functions = program.build(lagrange.derive(system))
    assert "jacobi" in program_functions.functions  # the potential depends on time


def test_method_for_position_dependent_forces_is_refused() -> None:
    with pytest.raises(SceneError, match="verlet"):
        eomc.sources(from_scene(parse(CHARGE.replace("[run]", '[run]\nmethod = "verlet"'))))


@pytest.mark.parametrize(
    "definition", ["x*y_dot", "x_dot**2 - x_dot**2 + 3*y_dot", "sin(y)*dot(c) + 1"]
)
def test_potential_is_split_through_its_definitions(definition: str) -> None:
    known = {"x": x, "y": y, "x_dot": x_dot, "y_dot": y_dot, "c": symbol("c"), "dot": dot}
    body = sympy.sympify(definition, known)
    d, c = symbol("d"), symbol("c")
    potential, linear = split_potential(x**2 + y * d, [(c, x * y), (d, body)], VELOCITIES)
    whole = (x**2 + y * body).xreplace({dot(c): x_dot * y + x * y_dot})
    linear = linear.xreplace({dot(c): x_dot * y + x * y_dot})
    assert potential.free_symbols <= {x, y}
    assert sympy.expand(potential + linear - whole) == 0
    assert linear.xreplace({x_dot: 0, y_dot: 0}) == 0


@pytest.mark.parametrize(
    "text", ["x_dot**2", "x_dot*y_dot", "Abs(x_dot)", "sin(x_dot*y)", "dot(c)**2"]
)
def test_potential_not_linear_in_velocities_is_refused(text: str) -> None:
    c = symbol("c")
    names = {"x": x, "y": y, "x_dot": x_dot, "y_dot": y_dot, "c": c, "dot": dot}
    with pytest.raises(NotLinearError, match="linear terms only"):
        split_potential(sympy.sympify(text, names), [(c, x * y)], VELOCITIES)


def test_systems_and_scenes_refuse_with_the_same_message() -> None:
    with pytest.raises(EomcError, match=r"potential: .* linear terms only") as error:
        charge("x_dot**2")
    with pytest.raises(SceneError) as read:
        from_scene(parse(CHARGE.replace("k*x**2/2", "k*x_dot**2/2")))
    (problem,) = read.value.problems
    assert problem.key == "energy.potential"
    assert problem.message in str(error.value)


def test_lagrangian_is_passed_as_two_energies() -> None:
    with pytest.raises(EomcError, match="kinetic = K and potential = P"):
        System.make("a", ["x"])
    text = 'eomc = 1\nname = "a"\n[coordinates]\nx = {}\n[energy]\nlagrangian = "x_dot**2"\n'
    with pytest.raises(SceneError, match="kinetic = K and potential = P"):
        parse(text)
