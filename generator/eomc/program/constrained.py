"""Functions that systems with constraints have in addition: constraints, multipliers, reactions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from sympy import S

from eomc.derive import kkt, outputs
from eomc.derive.constraints import rate_terms
from eomc.derive.lagrange import Derivation, EquationsOfMotion
from eomc.derive.ldl import Pairs, Vector
from eomc.derive.linearize import directional_derivatives
from eomc.model.symbols import Output
from eomc.model.system import System
from eomc.program.interpret import evaluator
from eomc.program.ir import Function
from eomc.program.lower import lower
from eomc.program.routes import Candidate, weight


def functions(derived: Derivation, taken: Candidate) -> Iterator[Function]:
    """Yield the additional functions of a system with constraints; none without constraints.

    `derived` contains the equations of motion. `taken` is the selected computation of the
    accelerations, which also gives the Lagrange multipliers.
    """
    system = derived.system
    if not system.constraints:
        return
    yield from constraint_functions(derived)
    names = [f"lambda_{c.name}" for c in system.constraints]
    yield lower(
        "multipliers", taken.tape, taken.multipliers, system.names, checks=taken.checks,
        labels=names,
    )  # fmt: skip
    e, values, pivots, correction = min(
        (_correction(system, e) for e in _all_equations(derived)),
        key=lambda candidate: weight(candidate[-1].cost),
    )
    assert e.rows is not None
    yield correction
    if terms := rate_terms(e.tape, e.rows, system.qd):
        yield lower("rate_terms", e.tape, terms, system.names)
    if system.run.discretize:
        corrections = values[: 2 * len(system.q)]
        values_and_derivatives = [
            *corrections,
            *directional_derivatives(system, e.tape, corrections),
        ]
        yield lower("projection_along", e.tape, values_and_derivatives, system.names, checks=pivots)
    if system.reactions:
        yield _reactions(system)
    if system.run.needs_derivatives:
        gradients = [x for r in e.rows.rates for x in e.tape.gradient([(r, S.One)], system.q)]
        yield lower("constraint_slopes", e.tape, gradients, system.names)


def constraint_functions(derived: Derivation) -> Iterator[Function]:
    """Yield the functions for residuals, Jacobian and rates of the constraint equations.

    They are used to find initial values that satisfy the constraints. `derived` contains the
    equations of motion.
    """
    system, e = derived.system, _equations(derived)
    assert e.rows is not None
    names = [c.name for c in system.constraints]
    yield lower("constraints", e.tape, e.rows.values, system.names, labels=names)
    jacobian = [x for row in e.rows.jacobian for x in row]
    yield lower("constraint_jacobian", e.tape, jacobian, system.names)
    labels = [f"{name}_rate" for name in names]
    yield lower("constraint_rates", e.tape, e.rows.rates, system.names, labels=labels)
    if errors := e.rows.rotation_errors:
        slopes = [x for error, _ in errors for x in e.tape.gradient([(error, S.One)], system.q)]
        values = [*(error for error, _ in errors), *(half for _, half in errors)]
        yield lower("rotation_errors", e.tape, [*values, *slopes], system.names)


def _equations(derived: Derivation) -> EquationsOfMotion:
    """Return the equations with the constraints: the shorter ones if there are two."""
    return min(
        _all_equations(derived), key=lambda e: len(e.tape.live([x for row in e.D for x in row]))
    )


def _all_equations(derived: Derivation) -> list[EquationsOfMotion]:
    """Return the equations of motion by Lagrange and by Newton-Euler, where they exist."""
    return [e for e in (derived.lagrange, derived.newton_euler) if e is not None]


def _correction(
    system: System, e: EquationsOfMotion
) -> tuple[EquationsOfMotion, Vector, Pairs, Function]:
    """Derive the projection onto the constraints: the equations, corrections, pivots and the
    function.
    """
    assert e.rows is not None
    values, pivots = kkt.projection(e.tape, e.D, e.rows, system.q)
    return e, values, pivots, lower("projection", e.tape, values, system.names, checks=pivots)


def _reactions(system: System) -> Function:
    """Return the function of forces and moments in the loops, which depend on the multipliers."""
    values = [x for r in system.reactions for x in r.values]
    formulas = tuple(Output(f"reaction_{k}", x) for k, x in enumerate(values))
    multipliers = [c.multiplier for c in system.constraints]
    derived = outputs.outputs(
        replace(system, outputs=formulas), with_derivatives=False, extra_symbols=multipliers
    )
    return lower("reactions", derived.tape, derived.values, system.names)


def weighted_gradients(
    functions: Mapping[str, Function], system: System, values: Mapping[str, float]
) -> list[tuple[float, list[float]]]:
    """Return the pairs (weight w_k, gradient a_k) with which D + sum_k w_k a_k a_k^T is regular.

    There is one pair for each constraint equation that is not redundant. The list is empty if the
    mass matrix D is regular by itself.

    Parameters
    ----------
    functions
        Functions of the generated code by name, among them "constraint_jacobian".
    values
        Coordinates and parameters by name.

    Raises
    ------
    ArithmeticError, ValueError
        If an entry of the Jacobian is not a finite real number.
    """
    closure = system.closure
    if closure is None or not closure.weights:
        return []
    flat, _ = evaluator(functions["constraint_jacobian"])(values)
    n = len(system.q)
    return [
        (w, list(flat[n * k : n * k + n]))
        for k, (w, row) in enumerate(zip(closure.weights, system.constraints, strict=True))
        if not row.redundant
    ]
