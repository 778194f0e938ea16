"""Symmetric elimination on a tape: x with D x = b by L diag(d) L^T, unrolled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import sympy
from sympy import Expr, S

from eomc.derive.tape import Stage, Tape

Vector = tuple[Expr, ...]
Rows = tuple[Vector, ...]
Pairs = tuple[tuple[Expr, Expr], ...]

LONGEST = 8  # pivots in one product, so that those of 1e-38 to 1e38 stay in the range of a double


@dataclass(frozen=True)
class Solution:
    """qdd by one way of solving D qdd = tau - bias, on the tape where it stands.

    order: the order in which coordinates are eliminated; pivots: those of L diag(pivots) L^T, all
    positive where D is positive definite, each paired with a value of the size of its origin.
    matrix: what is eliminated, D or, for the forces that hold links together, S. multipliers: of
    constraints, where there are; parts: of those that modes switch, by their places, what these are
    made of, as `Constraint.parts` says.
    """

    tape: Tape
    acceleration: Vector
    order: tuple[int, ...]
    pivots: Pairs
    matrix: str = "D"
    multipliers: Vector = ()
    parts: Mapping[int, Vector] = field(default_factory=dict)


# qdd by one way of solving; or why that was not tried; or None where there is nothing to try
Way = Solution | str | None


def solve(
    tape: Tape,
    D: Rows,
    b: Sequence[Expr],
    short: Callable[[Expr], Expr] = lambda atom: atom,
    kept: Callable[[Expr], Expr] = lambda atom: atom,
    prompt: bool = False,
) -> Solution:
    """x with D x = b by L diag(d) L^T x = b, unrolled; zeros are neither stored nor computed.

    Source: Golub & Van Loan, *Matrix Computations*, 4th ed., alg. 4.1.2. The next pivot is the
    one with the fewest entries left in its row (minimum degree), among equals the earliest known,
    and then the one with the fewest divisions in a row behind it: a chain is eliminated from both
    its ends, each at the other's side in a processor.
    short: rewrites what elimination makes, so that terms which cancel are gone. kept: what is done
    with the entries of L; where they are kept whole, each x waits for one operation on the one
    before, not for two.
    prompt: so that x waits for less, at the price of more operations. A pivot that parameters
    decide is taken as if it had an entry less in its row, so every other of a chain goes first.
    Along what is left a pivot is p = N/M, N and M made of those before without a division,

        p_i - a^2/p_k = (N_i N_k - a^2 M_i M_k)/(M_i N_k),

    and all divisions M/N are done side by side. It rounds as the other form does. Of such a pivot
    N is given, paired with M times the entry that it came from.
    """
    n = len(b)
    A = {(i, j): D[i][j] for i in range(n) for j in range(n) if D[i][j] != 0}
    y = list(b)
    left, order, pivots, behind = list(range(n)), [], [], [0] * n
    over, length = [S.One] * n, [1] * n  # M; A has N in its diagonal, a product of so many pivots
    steps: list[tuple[int, Expr, dict[int, Expr]]] = []
    while left:

        def rank(i: int) -> tuple[int, int, int, int]:
            stage, entries = tape.stage_of(A[i, i]), sum((i, j) in A for j in left)
            return entries - (prompt and stage <= Stage.PARAMETER), stage, behind[i], i

        k = min(left, key=rank)
        left.remove(k)
        order.append(k)
        pivot = A[k, k]
        pivots.append((pivot, tape.define(over[k] * D[k][k])))
        inverse = tape.define(over[k] / pivot)
        row = {i: A[i, k] for i in left if (i, k) in A}
        for i in row:
            behind[i] = max(behind[i], behind[k] + 1)
        factors = {i: kept(tape.define(a * inverse)) for i, a in row.items()}
        chained = prompt and len(row) == 1 and tape.stage_of(pivot) > Stage.PARAMETER
        for i, factor in factors.items():
            y[i] = short(tape.define(y[i] - factor * y[k]))
            for j, a in row.items():
                if j < i:
                    A[i, j] = A[j, i] = short(tape.define(A.get((i, j), S.Zero) - factor * a))
            a = row[i]
            if chained and length[i] + length[k] <= LONGEST:
                N = A[i, i] * pivot - kept(tape.define(a * a)) * over[i] * over[k]
                A[i, i], over[i] = kept(tape.define(N)), kept(tape.define(over[i] * pivot))
                length[i] += length[k]
            else:
                A[i, i] = short(tape.define(A[i, i] - factor * a * over[i]))
        steps.append((k, inverse, factors))
    x: dict[int, Expr] = {}
    for k, inverse, factors in reversed(steps):
        rest = [-factor * x[i] for i, factor in factors.items()]
        x[k] = tape.define(sympy.Add(tape.define(y[k] * inverse), *map(tape.define, rest)))
    return Solution(tape, tuple(x[i] for i in range(n)), tuple(order), tuple(pivots))


def work(D: Rows) -> int:
    """The operations of `solve`, all of its fill counted."""
    left = {i: {j for j, x in enumerate(row) if x != 0 and j != i} for i, row in enumerate(D)}
    total = 0
    while left:
        k = min(left, key=lambda i: (len(left[i]), i))
        row = left.pop(k)
        total += len(row) * (len(row) + 6) + 2
        for i in row:
            left[i] = (left[i] | row) - {i, k}
    return total
