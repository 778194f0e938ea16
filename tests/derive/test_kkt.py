"""Compare accelerations and multipliers under constraints with a dense solve of the KKT system."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy

from eomc.derive.constraints import _pivot_limit
from eomc.derive.lagrange import derive
from eomc.model.symbols import symbol
from eomc.model.system import Constraint, System
from eomc.program.ir import evaluator
from eomc.program.program import Program, build, matrix


def with_constraints(system: System, **rows: str) -> System:
    """Return the system with holonomic constraints in its own coordinates."""
    result = System.make(
        system.name, [c.name for c in system.coordinates], system.kinetic, outputs=rows,
        parameters={p.name: p.value for p in system.parameters},
    )  # fmt: skip
    return replace(system, constraints=tuple(Constraint(o.name, o.formula) for o in result.outputs))


DOUBLE = System.make(
    "two_links",
    {"x1": 0.6, "y1": -0.8, "x2": 0.96, "y2": -1.28},
    "m1*(x1_dot**2 + y1_dot**2)/2 + m2*(x2_dot**2 + y2_dot**2)/2 + x1_dot*x2_dot/9",
    "9.81*(m1*y1 + m2*y2) + x1*x2",
    parameters={"m1": 1.0, "m2": 0.7, "l": 1.0},
)
LINKS = {"first": "x1**2 + y1**2 - l**2", "second": "(x2 - x1)**2 + (y2 - y1)**2 - 0.36"}
STATE = {
    "x1": 0.6, "y1": -0.8, "x2": 0.96, "y2": -1.28, "x1_dot": 0.3, "y1_dot": 0.2, "x2_dot": -0.4,
    "y2_dot": 0.7, "m1": 1.1, "m2": 0.7, "l": 1.0, "t": 0.0,
}  # fmt: skip


def values(program: Program, name: str) -> np.ndarray:
    """Return the results of a function at the state."""
    return np.array(evaluator(program[name], exact=True)(STATE)[0])


@pytest.mark.parametrize("massless", [False, True])
def test_accelerations_and_multipliers_solve_the_dense_kkt_system(massless: bool) -> None:
    system = with_constraints(DOUBLE, **LINKS)
    if massless:  # only the constraint moves x2
        kinetic = system.kinetic.subs(symbol("x2_dot"), 0)
        system = replace(system, kinetic=kinetic)
    program = build(derive(system))
    a, multipliers = values(program, "acceleration"), values(program, "multipliers")
    A = values(program, "constraint_jacobian").reshape(2, 4)
    D = np.array(matrix(program, "D", STATE))
    bias = values(program, "bias")
    np.testing.assert_allclose(D @ a + bias, A.T @ multipliers, atol=1e-13)
    qd = np.array([STATE[f"{c.name}_dot"] for c in system.coordinates])
    # d(A qd)/dt by differences of the constraint velocities along qd
    rates = evaluator(program["constraint_rates"], exact=True)
    step = 1e-6
    shifted = [
        np.array(rates(STATE | {c.name: STATE[c.name] + s * step * v for c, v in
                                zip(system.coordinates, qd, strict=True)})[0])
        for s in (-1, 1)
    ]  # fmt: skip
    np.testing.assert_allclose(A @ a, -(shifted[1] - shifted[0]) / (2 * step), rtol=1e-9)


def test_locally_redundant_constraint_is_dropped_and_reported() -> None:
    twice = with_constraints(DOUBLE, **LINKS, again="2*x1**2 + 2*y1**2 - 2*l**2")
    program = build(derive(twice))
    *_, inverses = np.split(values(program, "projection"), [8])
    assert sum(inverses == 0) == 1
    alone = values(build(derive(with_constraints(DOUBLE, **LINKS))), "acceleration")
    np.testing.assert_allclose(values(program, "acceleration"), alone, rtol=1e-13)
    first, _, again = values(program, "multipliers")
    assert 0 in (first, again)


def test_projection_is_minimal_in_the_metric_of_the_mass_matrix() -> None:
    program = build(derive(with_constraints(DOUBLE, **LINKS)))
    inconsistent = STATE | {"x1": 0.6003, "y2": -1.2797}
    names = [c.name for c in DOUBLE.coordinates]
    d = np.array(evaluator(program["projection"], exact=True)(inconsistent)[0])
    A = np.array(evaluator(program["constraint_jacobian"], exact=True)(inconsistent)[0]).reshape(
        2, 4
    )
    phi = np.array(evaluator(program["constraints"], exact=True)(inconsistent)[0])
    D = np.array(matrix(program, "D", inconsistent))
    np.testing.assert_allclose(A @ d[:4], -phi, atol=1e-15)
    null = np.linalg.svd(A)[2][2:]  # D dq lies in the row space of A
    np.testing.assert_allclose(null @ D @ d[:4], 0, atol=1e-16)
    after = {n: inconsistent[n] + x for n, x in zip(names, d[:4], strict=True)}
    after |= {f"{n}_dot": inconsistent[f"{n}_dot"] + x for n, x in zip(names, d[4:8], strict=True)}
    left = np.array(evaluator(program["constraint_rates"], exact=True)(inconsistent | after)[0])
    before = np.array(evaluator(program["constraint_rates"], exact=True)(inconsistent)[0])
    assert np.abs(left).max() < 1e-3 * np.abs(before).max()


def test_pivot_limit_of_a_row_with_a_nonzero_constant_is_zero() -> None:
    x, zero, one = symbol("x1"), sympy.S.Zero, sympy.S.One
    assert _pivot_limit([x, zero], 1e-5) == sympy.Float("1e-05")
    assert _pivot_limit([zero, zero], 1e-5) == sympy.Float("1e-05")
    assert _pivot_limit([x, -one], 1e-5) == _pivot_limit([zero, one], 1e-5) == 0


def test_variable_pivot_is_checked_where_its_entry_of_D_is_constant() -> None:
    kinetic = "(x_dot**2 + y_dot**2 + z_dot**2)/2 + (x_dot*y_dot + y_dot*z_dot)*cos(x)/2"
    system = System.make("mixed", ["x", "y", "z"], kinetic, constraints={"row": "x + y*z"})
    program = build(derive(system))
    state = {"x": 0.3, "y": -0.3, "z": 1.0, "x_dot": 0.2, "y_dot": -0.1, "z_dot": 0.4, "t": 0.0}
    a = np.array(evaluator(program["acceleration"], exact=True)(state)[0])
    D = np.array(matrix(program, "D", state))
    A, bias, multipliers = (
        np.array(evaluator(program[name], exact=True)(state)[0])
        for name in ("constraint_jacobian", "bias", "multipliers")
    )
    np.testing.assert_allclose(D @ a + bias, A * multipliers, atol=1e-13)
    assert program["acceleration"].checks
