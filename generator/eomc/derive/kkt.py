"""Accelerations under constraints: the KKT matrix by L diag(d) L^T, unrolled, in a safe order.

    D a - A^T lambda = b        [D  A^T] [   a   ]   [b]
    A a              = c        [A   0 ] [-lambda] = [c]

A row's pivot is taken once all coordinates that the row reads are gone, and never earlier: then it
is one of -A D^-1 A^T over those, which is as safe as the Schur complement, and sparse. The order is
fixed at generation. A row's pivot that is nearly nothing of what it was is dropped: 0 stands for
its inverse, its multiplier is 0. That is right where a row depends on others in some positions. In
corrections it is dropped below 1e-9, where rounding would lead far. Accelerations go on to 1e-12:
bars of A02 that a dropped row no longer holds together part at g/16, and what that makes of
velocities off the rows grows as 1/y^2 through the stages left, so that 1 run of 10 by dp8 was lost.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, S

from eomc.derive.constraints import Constraints, chosen, jacobian
from eomc.derive.ldl import Pairs, Rows, Solution, Vector
from eomc.derive.tape import Tape
from eomc.model.symbols import pivot_inverse

Pattern = Mapping[int, set[int]]
UNHELD = sympy.Float("1e-9")  # of a row's pivot: what counts as that where it is dropped


@dataclass(frozen=True)
class Factors:
    """L diag(d) L^T of a KKT matrix: coordinates first, then rows.

    steps: in their order what is eliminated, the inverse of its pivot, and L below it. pivots: of
    coordinates, all positive, paired with the entries they were. inverses: of the rows' pivots, 0
    where one is dropped. switched: of rows that modes switch the pivot, where it is dropped a part
    of what coordinates alone make of it, and the entries under it, before L. slides: of coordinates
    that such a row holds 0 where it does, 1 where it is none.
    """

    tape: Tape
    count: int
    steps: tuple[tuple[int, Expr, Mapping[int, Expr]], ...]
    pivots: Pairs
    inverses: Vector
    switched: Mapping[int, tuple[Expr, Mapping[int, Expr]]]
    slides: Mapping[int, Expr]

    def solve(
        self, b: Sequence[Expr], c: Sequence[Expr], short: Callable[[Expr], Expr]
    ) -> tuple[Vector, Vector, Vector]:
        """a and lambda, and of switched rows lambda times the pivot, dropped or not.

        What such a row holds has the acceleration 0 to the last bit: where nothing else moves,
        steps would follow rounding. short: rewrites what elimination makes.
        """
        tape, y = self.tape, [*b, *c]
        for k, _, factors in self.steps:
            for i, factor in factors.items():
                y[i] = short(tape.define(y[i] - factor * y[k]))
        x: dict[int, Expr] = {}
        for k, inverse, factors in reversed(self.steps):
            rest = [tape.define(-factor * x[i]) for i, factor in factors.items()]
            x[k] = tape.define(sympy.Add(tape.define(y[k] * inverse), *rest))
            if k in self.slides:
                x[k] = tape.times(self.slides[k], x[k])
        n, m = self.count, len(self.steps) - self.count
        lacks = (
            tape.total([y[n + r], *(tape.define(-a * x[i]) for i, a in below.items())])
            for r, (_, below) in self.switched.items()
        )
        multipliers = tuple(tape.define(-x[n + r]) for r in range(m))
        return tuple(x[i] for i in range(n)), multipliers, tuple(lacks)


def factors(
    tape: Tape,
    D: Rows,
    A: Rows,
    drop: Expr,
    faded: Sequence[Expr],
    short: Callable[[Expr], Expr] = lambda atom: atom,
    switched: Container[int] = (),
    late: Container[int] = (),
) -> Factors:
    """The KKT matrix of D and A, factored.

    drop, faded: the part of itself, and of each row the number, below which a pivot is none.
    switched: rows that modes switch, of which more is told. late: rows behind all others, which
    are dropped where the others leave them nothing to hold.
    """
    n = len(D)
    M = {(i, j): D[i][j] for i in range(n) for j in range(n) if D[i][j] != 0}
    for r, row in enumerate(A):
        for j, entry in enumerate(row):
            if entry != 0:
                M[n + r, j] = M[j, n + r] = entry
    order = _order(_pattern(M, n + len(A)), n, tape, M, [n + r for r in range(len(A)) if r in late])
    parts: dict[tuple[int, int], list[Expr]] = {}  # of what is left: what is yet to be added
    alone: dict[int, list[Expr]] = {}  # of rows: what coordinates alone make of the pivot
    left, steps, pivots = set(order), [], []
    inverses, told = dict[int, Expr](), dict[int, tuple[Expr, Mapping[int, Expr]]]()
    slides = dict[int, Expr]()

    def read(i: int, j: int) -> Expr:
        """An entry, i >= j, as one sum: what pivots of many coordinates have in common leads it."""
        if added := parts.pop((i, j), None):
            M[i, j] = M[j, i] = short(tape.total([M[i, j], *added]))
        return M[i, j]

    for k in order:
        left.remove(k)
        below = {i: read(max(i, k), min(i, k)) for i in sorted(left) if (i, k) in M}
        if k < n:
            pair = (read(k, k), tape.define(D[k][k]))
            if not all(x.is_Number for x in pair) or pair[0] <= 1e-12 * pair[1]:
                pivots.append(pair)
            inverse = tape.define(1 / M[k, k])
        else:
            whole = M[k, k] = short(tape.total(alone.get(k, [])))
            pivot = tape.define(-read(k, k))
            limit = tape.define(-drop * whole) if pivot != -whole else S.Zero
            limit = tape.total([limit, faded[k - n]])
            inverses[k] = tape.define(pivot_inverse(pivot, limit))
            inverse = tape.define(-inverses[k])
            if k - n in switched:
                kept = tape.define(pivot * inverses[k])  # 1, or 0
                spare = tape.times(tape.define(UNHELD * (kept - 1)), whole)
                told[k - n] = tape.total([pivot, spare]), below
                (of,) = (j for j, entry in enumerate(A[k - n]) if entry != 0)
                slides[of] = tape.define(1 - sympy.sign(inverses[k]))
        found = {i: tape.define(a * inverse) for i, a in below.items()}
        for i, factor in found.items():
            for j, a in below.items():
                if j <= i:
                    part = tape.define(-factor * a)
                    if i == j >= n and k < n:
                        alone.setdefault(i, []).append(part)
                    else:
                        M.setdefault((i, j), S.Zero)
                        M.setdefault((j, i), S.Zero)
                        parts.setdefault((i, j), []).append(part)
        steps.append((k, inverse, found))
    rows = tuple(inverses[n + r] for r in range(len(A)))
    return Factors(tape, n, tuple(steps), tuple(pivots), rows, told, slides)


def _pattern(M: Mapping[tuple[int, int], Expr], size: int) -> Pattern:
    return {i: {j for j in range(size) if j != i and (i, j) in M} for i in range(size)}


def _order(
    pattern: Pattern, n: int, tape: Tape, M: Mapping[tuple[int, int], Expr], late: list[int]
) -> list[int]:
    """The order with the fewest operations: rows as soon as they are ready, or at the end."""
    stage = [tape.stage_of(M[i, i]) if i < n and (i, i) in M else 0 for i in range(len(pattern))]
    found = []
    for early in (True, False):
        left = {i: set(to) for i, to in pattern.items()}
        order, work = list[int](), 0
        while left:
            ready = [i for i in left if i < n]
            if early or not ready:
                rows = [i for i in left if i >= n and i not in late] or late
                ready += [i for i in rows if i in left and not any(j in left for j in pattern[i])]
            k = min(ready, key=lambda i: (len(left[i]), stage[i], i))
            row = left.pop(k)
            work += len(row) * (len(row) + 6) + 2
            for i in row:
                left[i] = (left[i] | row) - {i, k}
            order.append(k)
        found.append((work, order))
    return min(found, key=lambda pair: pair[0])[1]


def accelerations(
    tape: Tape,
    D: Rows,
    b: Sequence[Expr],
    rows: Constraints,
    short: Callable[[Expr], Expr] = lambda atom: atom,
) -> Solution:
    """qdd and the multipliers of all rows, 0 of redundant ones."""
    A = jacobian(tape, rows)
    c = [tape.scaled(S.NegativeOne, x) for x in chosen(tape, rows.rest, rows)]
    D, b = with_mass(tape, D, b, A, c, rows.weights)
    switched = _switched(rows)
    made = factors(tape, D, A, rows.drop[0], rows.faded, short, switched, switched)
    a, some, lacks = made.solve(b, c, short)
    parts: dict[int, list[Expr]] = {}
    for row, x in zip(rows.solved, some, strict=True):
        for k, w in row:
            parts.setdefault(k, []).append(tape.scaled(w, x))
    multipliers = tuple(
        S.Zero if k not in parts else parts[k][0] if len(parts[k]) == 1 else tape.total(parts[k])
        for k in range(len(rows.values))
    )
    order = tuple(k for k, _, _ in made.steps if k < len(D))
    told = zip(made.switched.items(), lacks, strict=True)
    lack_of = {rows.solved[r][0][0]: (lack, pivot) for (r, (pivot, _)), lack in told}
    return Solution(tape, a, order, made.pivots, "D", multipliers, lack_of)


def _switched(rows: Constraints) -> list[int]:
    """Those of the rows solved for that modes switch."""
    return [r for r, row in enumerate(rows.solved) if row[0][0] in rows.switched]


def with_mass(
    tape: Tape, D: Rows, b: Sequence[Expr], A: Rows, c: Sequence[Expr], weights: Vector = ()
) -> tuple[Rows, Sequence[Expr]]:
    """D + A^T W A and b + A^T W c where D is singular by itself, as D and b elsewhere.

    The accelerations and multipliers are the same, exactly: A a = c. W: the weights of the rows, 1
    where none are given and a coordinate has no inertia at all.
    """
    n = range(len(D))
    if not weights and all(D[i][i] != 0 for i in n):
        return D, b
    weights = weights or (S.One,) * len(A)
    heavy = [[tape.scaled(w, x) for x in row] for w, row in zip(weights, A, strict=True)]

    def added(first: Expr, i: int, other: Sequence[Expr]) -> Expr:
        parts = [tape.times(row[i], x) for row, x in zip(heavy, other, strict=True)]
        return tape.total([first, *parts])

    more = tuple(tuple(added(D[i][j], i, [row[j] for row in A]) for j in n) for i in n)
    return more, [added(b[i], i, c) for i in n]


def projection(
    tape: Tape, D: Rows, rows: Constraints, q: Sequence[sympy.Symbol]
) -> tuple[Vector, Pairs]:
    """What is added to q and qd so that rows hold, and the inverses of the rows' pivots.

    Newton's step in the metric of D: the least change dq with A dq = -phi, then that of qd with
    rates that are taken at q + dq, to the first order. Of rows that modes switch there is no
    inverse: it may well be 0. Second: the pivots, as `Solution` has them.
    """
    n, A = len(D), jacobian(tape, rows)
    D, _ = with_mass(tape, D, [S.Zero] * n, A, [S.Zero] * len(A), rows.weights)
    made = factors(tape, D, A, rows.drop[1], rows.faded, late=_switched(rows))
    places = [row[0][0] for row in rows.solved]  # sums are of positions
    lacks = [tape.scaled(S.NegativeOne, x) for x in chosen(tape, rows.values, rows)]
    positions = [S.Zero if k >= rows.holonomic else x for k, x in zip(places, lacks, strict=True)]
    zero, same = [S.Zero] * n, lambda atom: atom
    dq, _, _ = made.solve(zero, positions, same)
    moved = tape.forward(rows.rates, dict(zip(q, dq, strict=True)))
    rates = [tape.total([x, y]) for x, y in zip(rows.rates, moved, strict=True)]
    off = [tape.scaled(S.NegativeOne, x) for x in chosen(tape, rates, rows)]
    dqd, _, _ = made.solve(zero, off, same)
    told = (x for k, x in zip(places, made.inverses, strict=True) if k not in rows.switched)
    return (*dq, *dqd, *told), made.pivots
