"""Symmetric elimination on a tape: solve D x = b by L diag(d) L^T, unrolled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import sympy
from sympy import Expr, S

from eomc.derive.tape import Stage, Tape

Vector = tuple[Expr, ...]
Rows = tuple[Vector, ...]
Pairs = tuple[tuple[Expr, Expr], ...]

MAX_PIVOTS_PER_PRODUCT = 8  # products of 8 pivots from 1e-38 to 1e38 stay in a double's range


@dataclass(frozen=True)
class Solution:
    """The solution of D qdd = tau - bias by one method, as atoms of the attribute `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    acceleration : (nq,)
        qdd.
    order : tuple of int
        Indices of the coordinates in order of elimination.
    pivots : Pairs
        For each pivot of the factorization L diag(pivots) L^T: the pivot, and the magnitude of the
        terms that it was computed from. All pivots are positive if D is positive definite.
    matrix : str
        The matrix that is factored: "D" for the mass matrix, or "S" for the matrix of the equations
        for link multipliers (tensions of massless links).
    multipliers : Vector
        Lagrange multipliers of the constraints; empty without constraints.
    parts : mapping
        For each constraint that is active in some contact or friction modes only, by index: the
        numerator and the denominator of its multiplier, see `Constraint.parts`.
    """

    tape: Tape
    acceleration: Vector
    order: tuple[int, ...]
    pivots: Pairs
    matrix: str = "D"
    multipliers: Vector = ()
    parts: Mapping[int, Vector] = field(default_factory=dict)


# The accelerations by one method; the reason why it was not used; None where it does not apply.
SolveResult = Solution | str | None


@dataclass(frozen=True)
class Factors:
    """Factors L diag(d) L^T of a symmetric matrix, as atoms of the attribute `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    steps
        For each elimination step, in order: the index of the row, the inverse of its pivot, and the
        column of L below the pivot.
    pivots : Pairs
        For each step: the pivot, and the diagonal entry from which it is computed.
    """

    tape: Tape
    steps: tuple[tuple[int, Expr, Mapping[int, Expr]], ...]
    pivots: Pairs

    def solve(self, b: Sequence[Expr], short: Callable[[Expr], Expr] = lambda atom: atom) -> Vector:
        """Return the solution x of L diag(d) L^T x = b. `short` is the argument of `factorize`."""
        tape, y = self.tape, list(b)
        for k, _, factors in self.steps:
            for i, factor in factors.items():
                y[i] = short(tape.define(y[i] - factor * y[k]))
        x: dict[int, Expr] = {}
        for k, inverse, factors in reversed(self.steps):
            terms = [-factor * x[i] for i, factor in factors.items()]
            x[k] = tape.define(sympy.Add(tape.define(y[k] * inverse), *map(tape.define, terms)))
        return tuple(x[i] for i in range(len(y)))


def solve(
    tape: Tape,
    D: Rows,
    b: Sequence[Expr],
    short: Callable[[Expr], Expr] = lambda atom: atom,
    opaque: Callable[[Expr], Expr] = lambda atom: atom,
    short_chains: bool = False,
) -> Solution:
    """Return the solution x of D x = b by L diag(d) L^T factorization, as symbolic expressions.

    `b` is the right-hand side; the other arguments are those of `factorize`.
    """
    factors = factorize(tape, D, short, opaque, short_chains)
    order = tuple(k for k, _, _ in factors.steps)
    return Solution(tape, factors.solve(b, short), order, factors.pivots)


def factorize(
    tape: Tape,
    D: Rows,
    short: Callable[[Expr], Expr] = lambda atom: atom,
    opaque: Callable[[Expr], Expr] = lambda atom: atom,
    short_chains: bool = False,
) -> Factors:
    """Return the factors L diag(d) L^T of the symmetric matrix D, as symbolic expressions.

    Each operation is added to `tape`, a list of elementary operations with named results. Entries
    that are zero are neither stored nor computed with.

    The next pivot is the one with the fewest entries left in its row (minimum degree). Among
    several of these it is the one that can be computed earliest, then the one with the shortest
    chain of divisions before it. If D is the matrix of a chain of bodies, the chain is thus
    eliminated from both of its ends, which a processor computes in parallel.

    With `short_chains`, dependency chains are shorter at the price of more operations. A pivot that
    depends on parameters only is ranked as if its row had one entry less, so that every other pivot
    of a chain is eliminated first. Along the rest of the chain a pivot is p = N/M, where N and M
    are formed from earlier ones without division,

        p_i - a^2/p_k = (N_i N_k - a^2 M_i M_k)/(M_i N_k),

    and all divisions M/N can be done in parallel. Rounding errors are of the same size. For such a
    pivot, N is returned, with M times the entry that it started from.

    Parameters
    ----------
    tape : Tape
        Receives the operations of the factorization.
    D
        Symmetric matrix by rows.
    short
        Function that is applied to intermediate results. It may return a shorter expression with
        the same value, in which terms that cancel are removed.
    opaque
        Function that is applied to the entries of L. With `Tape.opaque`, later products do not
        expand them. Each x then depends on the one before through one operation, not two.
    short_chains
        Prefer short dependency chains to few operations.

    References
    ----------
    Golub & Van Loan, *Matrix Computations*, 4th ed., alg. 4.1.2.
    """
    n = len(D)
    A = {(i, j): D[i][j] for i in range(n) for j in range(n) if D[i][j] != 0}
    remaining, pivots, chain_length = list(range(n)), [], [0] * n
    denominators, length = (
        [S.One] * n,
        [1] * n,
    )  # M, and the number of pivots in N, which A's diagonal has
    steps: list[tuple[int, Expr, dict[int, Expr]]] = []
    while remaining:

        def rank(i: int) -> tuple[int, int, int, int]:
            stage, entries = tape.stage_of(A[i, i]), sum((i, j) in A for j in remaining)
            return entries - (short_chains and stage <= Stage.PARAMETER), stage, chain_length[i], i

        k = min(remaining, key=rank)
        remaining.remove(k)
        pivot = A[k, k]
        pivots.append((pivot, tape.define(denominators[k] * D[k][k])))
        inverse = tape.define(denominators[k] / pivot)
        row = {i: A[i, k] for i in remaining if (i, k) in A}
        for i in row:
            chain_length[i] = max(chain_length[i], chain_length[k] + 1)
        factors = {i: opaque(tape.define(a * inverse)) for i, a in row.items()}
        chained = short_chains and len(row) == 1 and tape.stage_of(pivot) > Stage.PARAMETER
        for i, factor in factors.items():
            for j, a in row.items():
                if j < i:
                    A[i, j] = A[j, i] = short(tape.define(A.get((i, j), S.Zero) - factor * a))
            a = row[i]
            if chained and length[i] + length[k] <= MAX_PIVOTS_PER_PRODUCT:
                N = A[i, i] * pivot - opaque(tape.define(a * a)) * denominators[i] * denominators[k]
                A[i, i], denominators[i] = (
                    opaque(tape.define(N)),
                    opaque(tape.define(denominators[i] * pivot)),
                )
                length[i] += length[k]
            else:
                A[i, i] = short(tape.define(A[i, i] - factor * a * denominators[i]))
        steps.append((k, inverse, factors))
    return Factors(tape, tuple(steps), tuple(pivots))


def count_operations(D: Rows) -> int:
    """Return the number of arithmetic operations with which `solve` factors D and solves D x = b.

    Entries that become nonzero during the elimination (fill-in) are included.
    """
    neighbours = {i: {j for j, x in enumerate(row) if x != 0 and j != i} for i, row in enumerate(D)}
    total = 0
    while neighbours:
        k = min(neighbours, key=lambda i: (len(neighbours[i]), i))
        row = neighbours.pop(k)
        total += len(row) * (len(row) + 6) + 2
        for i in row:
            neighbours[i] = (neighbours[i] | row) - {i, k}
    return total
