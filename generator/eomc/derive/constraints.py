"""Constraint equations on a tape: values, Jacobian A and the right-hand side of A qdd = c.

A holonomic constraint is phi(q, t) = 0, with time derivative A qd + phi_t. A nonholonomic
constraint is psi(q, qd, t) = 0, linear in qd, and A = d psi/d qd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S

from eomc.derive.energies import Energies
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import Tape
from eomc.model.system import System, t

# A constraint is redundant if its pivot falls below this fraction of the pivot's initial value: for
# accelerations, and for the projection, whose corrections would be too large at small pivots.
PIVOT_TOLERANCES = {
    "double": (sympy.Float("1e-12"), sympy.Float("1e-9")),
    "float": (sympy.Float("1e-5"), sympy.Float("1e-5")),
}
Sum = tuple[tuple[int, Expr], ...]  # a weighted sum of constraints: index and weight of each
# A gradient whose pivot is below this fraction of its usual value consists of rounding errors.
ZERO_GRADIENT_TOLERANCE = {"double": 1e-22, "float": 1e-12}


@dataclass(frozen=True)
class Constraints:
    """The m constraint equations of a system, holonomic equations first, as symbolic expressions.

    Expressions are atoms of the tape of the equations of motion. A tape is a list of elementary
    operations, each with a named result. An atom is a number, a name on the tape, or a number times
    a name.

    Attributes
    ----------
    values : (m,)
        Residuals: phi(q, t) of holonomic and psi(q, qd, t) of nonholonomic constraints.
    jacobian : (m, nq)
        A: d phi/d q of holonomic and d psi/d qd of nonholonomic constraints.
    rates : (m,)
        Rate of each constraint: d(phi)/dt = A qd + phi_t for holonomic constraints, psi for
        nonholonomic ones.
    rest : (m,)
        The part of d(rates)/dt that does not depend on qdd: d(rates)/dt - A qdd.
    drift : (m,)
        The value that A qd has where the constraints hold: rates = A qd - drift.
    holonomic : int
        The number of holonomic constraints.
    solved : tuple of Sum
        The independent equations from which accelerations are computed, each a weighted sum of
        constraint equations. Most consist of a single one; redundant ones are left out.
    drop : (Expr, Expr)
        Relative pivot tolerances: the first for accelerations, the second for the projection of q
        and qd onto the constraints. An equation whose pivot is below the tolerance depends on
        others in this configuration; it is dropped, and its multiplier is set to 0.
    weights : tuple of Expr
        If D alone is singular: the weight of each equation in `solved`. With the diagonal matrix W
        of the weights, D + A^T W A is regular. Empty if D is regular.
    pivot_limits : tuple of Expr
        For each equation in `solved`, the pivot below which its gradient counts as zero.
    switched : frozenset of int
        Indices of the constraints that are active in some modes only.
    rotation_errors : tuple of (Expr, Expr)
        For each axis equation of a loop whose rotation error is an angle a about n: the component
        of 2 tan(a/2) n along the axis, and cos(a/2)^2.
    """

    values: Vector
    jacobian: Rows
    rates: Vector
    rest: Vector
    drift: Vector
    holonomic: int
    solved: tuple[Sum, ...]
    drop: tuple[Expr, Expr]
    weights: Vector = ()
    pivot_limits: Vector = ()
    switched: frozenset[int] = frozenset()
    rotation_errors: tuple[tuple[Expr, Expr], ...] = ()


def constraints(system: System, e: Energies) -> Constraints | None:
    """Return the constraint equations of a system with their derivatives, or None without any.

    `e` contains the residuals of the constraints, defined on a tape (list of elementary
    operations). The derivatives are added to the same tape.
    """
    if not system.constraints:
        return None
    tape, q, qd = e.tape, system.q, system.qd
    time_derivatives = {**system.rates, t: S.One}
    count = sum(c.holonomic for c in system.constraints)
    phi, psi = e.rows[:count], e.rows[count:]
    rates = [*tape.forward(phi, time_derivatives), *psi]
    gradients = [tape.gradient([(row, S.One)], q) for row in phi]
    gradients += [tape.gradient([(row, S.One)], qd) for row in psi]
    zero_velocities = dict.fromkeys(qd, S.Zero)
    drift = [*tape.forward(phi, {t: S.One}), *tape.substitute(psi, zero_velocities)]
    solved = tuple(
        tuple((k, S.One if w == 1 else sympy.Float(w)) for k, w in row) for row in system.solved
    )
    weights = system.closure.weights if system.closure else ()
    gradient_norms = system.closure.slopes if system.closure else (0.0,) * len(system.constraints)
    rows = Constraints(
        tuple(e.rows), tuple(map(tuple, gradients)), tuple(rates),
        tuple(tape.forward(rates, time_derivatives)),
        tuple(tape.scaled(S.NegativeOne, x) for x in drift), count, solved,
        PIVOT_TOLERANCES[system.run.real],
        # the gradient of a sum of constraints is of order 1
        tuple(sympy.Rational(_number_of(row, weights)) for row in solved if weights),
        switched=frozenset(k for k, c in enumerate(system.constraints) if c.switched),
        rotation_errors=tuple(e.rotation_errors),
    )  # fmt: skip
    tolerance = ZERO_GRADIENT_TOLERANCE[system.run.real]
    A = jacobian(tape, rows)
    pivot_limits = (
        _pivot_limit(a, _number_of(row, gradient_norms) * tolerance)
        for a, row in zip(A, solved, strict=True)
    )
    return replace(rows, pivot_limits=tuple(pivot_limits))


def _number_of(equation: Sum, numbers: Sequence[float]) -> float:
    """Return the number that belongs to an equation of a single constraint; 1 for a sum."""
    return numbers[equation[0][0]] if len(equation) == 1 else 1.0


def _pivot_limit(gradient: Sequence[Expr], limit: float) -> Expr:
    """Return the smallest nonzero pivot of an equation; 0 where a constant entry bounds it from
    below.
    """
    bounded = any(entry.is_Number and entry != 0 for entry in gradient)
    return S.Zero if bounded else sympy.Float(f"{limit:.0e}")


def rate_terms(tape: Tape, rows: Constraints, qd: Sequence[sympy.Symbol]) -> Vector:
    """Return the rates of independent constraint equations, followed by the scales of the rates.

    The rate of an equation is A qd + phi_t; its scale is the sum of the absolute values of the
    terms. A rate that is large relative to its scale shows that the motion violates the equation,
    as where the equation depends on others and its multiplier was set to 0. Equations that are
    active in some contact or friction modes only are left out.
    """
    indices = [k for k, row in enumerate(rows.solved) if row[0][0] not in rows.switched]
    A = jacobian(tape, rows)
    rates, drifts = (select_rows(tape, numbers, rows) for numbers in (rows.rates, rows.drift))
    sizes = []
    for k in indices:
        terms = [tape.times(a, v) for a, v in zip(A[k], qd, strict=True)]
        sizes.append(tape.total([tape.define(sympy.Abs(x)) for x in (*terms, drifts[k])]))
    return (*(rates[k] for k in indices), *sizes)


def jacobian(tape: Tape, rows: Constraints) -> Rows:
    """Return the Jacobian A of the independent constraint equations, by rows.

    `rows` contains all constraint equations. Those in `rows.solved` are independent.
    """
    columns = [select_rows(tape, column, rows) for column in zip(*rows.jacobian, strict=True)]
    return tuple(zip(*columns, strict=True))


def select_rows(tape: Tape, numbers: Sequence[Expr], rows: Constraints) -> list[Expr]:
    """Return the values of the independent equations, from `numbers` for all constraint equations.

    `numbers` contains one quantity for each constraint equation, such as its rate. An independent
    equation, listed in `rows.solved`, is a weighted sum of constraint equations. Its value is the
    sum of their numbers with the same weights.
    """
    return [
        numbers[row[0][0]] if len(row) == 1
        else tape.total([tape.scaled(w, numbers[k]) for k, w in row])
        for row in rows.solved
    ]  # fmt: skip
