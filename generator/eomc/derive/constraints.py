"""Constraints on a tape: what is zero, its Jacobian A, and what A qdd has to be.

A row is phi(q, t) = 0, of rate A qd + phi_t, or psi(q, qd, t) = 0, linear in qd, its own rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, S

from eomc.derive.energies import Energies
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import Tape
from eomc.model.system import System, t

# parts of pivots: rows of accelerations, and of corrections, which lead far where pivots are small
DROPPED = {
    "double": (sympy.Float("1e-12"), sympy.Float("1e-9")),
    "float": (sympy.Float("1e-5"), sympy.Float("1e-5")),
}
FADED = {"double": 1e-22, "float": 1e-12}  # of a row's usual pivot: it is rounding


@dataclass(frozen=True)
class Constraints:
    """Rows of a system, on the tape of its equations: m of them, holonomic ones first.

    values (m,); jacobian (m, nq); rates (m,): A qd + phi_t, and psi; rest (m,): what A qdd lacks to
    the rate of `rates`. moved (m,): what A qd is where `rates` are 0, by what time alone moves.
    holonomic: how many are; solved: those that accelerations are solved for,
    which leaves redundant ones out. drop: a pivot that is this part of what it was, or less, tells
    a row that depends on others in this position: nothing is solved for it there; in accelerations,
    and in corrections. weights: where D alone is singular, of each row solved for, the part of
    A^T A that makes it regular; else none. faded: of each row solved for, the pivot that tells that
    it has no slope at all in this position, where it may have none. switched: rows that hold in
    some modes only.
    """

    values: Vector
    jacobian: Rows
    rates: Vector
    rest: Vector
    moved: Vector
    holonomic: int
    solved: tuple[int, ...]
    drop: tuple[Expr, Expr]
    weights: Vector = ()
    faded: Vector = ()
    switched: frozenset[int] = frozenset()


def constraints(system: System, e: Energies) -> Constraints | None:
    """The rows of a system whose energies are on the tape of e; None where it has none."""
    if not system.constraints:
        return None
    tape, q, qd = e.tape, system.q, system.qd
    along = {**system.rates, t: S.One}
    count = sum(c.holonomic for c in system.constraints)
    phi, psi = e.rows[:count], e.rows[count:]
    rates = [*tape.forward(phi, along), *psi]
    by = [tape.gradient([(row, S.One)], q) for row in phi]
    by += [tape.gradient([(row, S.One)], qd) for row in psi]
    still = dict.fromkeys(qd, S.Zero)
    moved = [*tape.forward(phi, {t: S.One}), *tape.substitute(psi, still)]
    solved = tuple(k for k, c in enumerate(system.constraints) if not c.redundant)
    weights = system.closure.weights if system.closure else ()
    slopes = system.closure.slopes if system.closure else (0.0,) * len(system.constraints)
    return Constraints(
        tuple(e.rows), tuple(map(tuple, by)), tuple(rates), tuple(tape.forward(rates, along)),
        tuple(tape.scaled(S.NegativeOne, x) for x in moved), count, solved,
        DROPPED[system.run.real], tuple(sympy.Rational(weights[k]) for k in solved if weights),
        tuple(_faded(by[k], slopes[k] * FADED[system.run.real]) for k in solved),
        frozenset(k for k, c in enumerate(system.constraints) if c.switched),
    )  # fmt: skip


def _faded(row: Sequence[Expr], limit: float) -> Expr:
    """The limit of a row's pivot; 0 where it is always one, an entry of the row being a number."""
    bounded = any(entry.is_Number and entry != 0 for entry in row)
    return S.Zero if bounded else sympy.Float(f"{limit:.0e}")


def rate_terms(tape: Tape, rows: Constraints, qd: Sequence[sympy.Symbol]) -> Vector:
    """Rates of the rows solved for that no mode switches, then the sums of their terms' sizes.

    Where a row depends on others its multiplier can't make it hold: what is left of its rate beside
    these tells a position that only others lead on from.
    """
    told = [k for k in rows.solved if k not in rows.switched]
    sizes = []
    for k in told:
        terms = [tape.times(a, v) for a, v in zip(rows.jacobian[k], qd, strict=True)]
        sizes.append(tape.total([tape.define(sympy.Abs(x)) for x in (*terms, rows.moved[k])]))
    return (*(rows.rates[k] for k in told), *sizes)


def chosen(some: Sequence[Expr], rows: Constraints) -> list[Expr]:
    """Those of the rows that are solved for."""
    return [some[k] for k in rows.solved]
