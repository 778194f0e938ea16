"""Constraints on a tape: what is zero, its Jacobian A, and what A qdd has to be.

A row is phi(q, t) = 0, of rate A qd + phi_t, or psi(q, qd, t) = 0, linear in qd, its own rate.
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

# parts of pivots: rows of accelerations, and of corrections, which lead far where pivots are small
DROPPED = {
    "double": (sympy.Float("1e-12"), sympy.Float("1e-9")),
    "float": (sympy.Float("1e-5"), sympy.Float("1e-5")),
}
Sum = tuple[tuple[int, Expr], ...]  # of rows: the place and weight of each
FADED = {"double": 1e-22, "float": 1e-12}  # of a row's usual pivot: it is rounding


@dataclass(frozen=True)
class Constraints:
    """Rows of a system, on the tape of its equations: m of them, holonomic ones first.

    values (m,); jacobian (m, nq); rates (m,): A qd + phi_t, and psi; rest (m,): what A qdd lacks to
    the rate of `rates`. moved (m,): what A qd is where `rates` are 0, by what time alone moves.
    holonomic: how many are; solved: what accelerations are solved for, sums of rows, (place,
    weight) of each: single ones mostly, which leaves redundant ones out. drop: a pivot that is this
    part of what it was, or less, tells a row that depends on others in this position: nothing is
    solved for it there; in accelerations, and in corrections. weights: where D alone is singular,
    of each row solved for, the part of A^T A that makes it regular; else none. faded: of each row
    solved for, the pivot that tells that it has no slope at all in this position, where it may have
    none. switched: rows that hold in some modes only.
    """

    values: Vector
    jacobian: Rows
    rates: Vector
    rest: Vector
    moved: Vector
    holonomic: int
    solved: tuple[Sum, ...]
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
    solved = tuple(
        tuple((k, S.One if w == 1 else sympy.Float(w)) for k, w in row) for row in system.solved
    )
    weights = system.closure.weights if system.closure else ()
    slopes = system.closure.slopes if system.closure else (0.0,) * len(system.constraints)
    made = Constraints(
        tuple(e.rows), tuple(map(tuple, by)), tuple(rates), tuple(tape.forward(rates, along)),
        tuple(tape.scaled(S.NegativeOne, x) for x in moved), count, solved,
        DROPPED[system.run.real],
        # the rows of sums have a slope of about 1
        tuple(sympy.Rational(_of(row, weights)) for row in solved if weights),
        switched=frozenset(k for k, c in enumerate(system.constraints) if c.switched),
    )  # fmt: skip
    least = FADED[system.run.real]
    A = jacobian(tape, made)
    faded = (_faded(a, _of(row, slopes) * least) for a, row in zip(A, solved, strict=True))
    return replace(made, faded=tuple(faded))


def _of(row: Sum, numbers: Sequence[float]) -> float:
    """That of a row that stands alone, 1 of a sum."""
    return numbers[row[0][0]] if len(row) == 1 else 1.0


def _faded(row: Sequence[Expr], limit: float) -> Expr:
    """The limit of a row's pivot; 0 where it is always one, an entry of the row being a number."""
    bounded = any(entry.is_Number and entry != 0 for entry in row)
    return S.Zero if bounded else sympy.Float(f"{limit:.0e}")


def rate_terms(tape: Tape, rows: Constraints, qd: Sequence[sympy.Symbol]) -> Vector:
    """Rates of the rows solved for that no mode switches, then the sums of their terms' sizes.

    Where a row depends on others its multiplier can't make it hold: what is left of its rate beside
    these tells a position that only others lead on from.
    """
    told = [k for k, row in enumerate(rows.solved) if row[0][0] not in rows.switched]
    A = jacobian(tape, rows)
    rates, moved = (chosen(tape, some, rows) for some in (rows.rates, rows.moved))
    sizes = []
    for k in told:
        terms = [tape.times(a, v) for a, v in zip(A[k], qd, strict=True)]
        sizes.append(tape.total([tape.define(sympy.Abs(x)) for x in (*terms, moved[k])]))
    return (*(rates[k] for k in told), *sizes)


def jacobian(tape: Tape, rows: Constraints) -> Rows:
    """That of what is solved for."""
    columns = [chosen(tape, column, rows) for column in zip(*rows.jacobian, strict=True)]
    return tuple(zip(*columns, strict=True))


def chosen(tape: Tape, some: Sequence[Expr], rows: Constraints) -> list[Expr]:
    """What is solved for, of numbers of all rows."""
    return [
        some[row[0][0]] if len(row) == 1
        else tape.total([tape.scaled(w, some[k]) for k, w in row])
        for row in rows.solved
    ]  # fmt: skip
