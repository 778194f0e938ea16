"""Constraint equations on a tape, and the accelerations and projections that satisfy them.

A holonomic constraint is phi(q, t) = 0, with time derivative A qd + phi_t. A nonholonomic
constraint is psi(q, qd, t) = 0, linear in qd, and A = d psi/d qd.

Accelerations follow from the KKT matrix by L diag(d) L^T, unrolled in a fixed order:

    D a - A^T lambda = b        [D  A^T] [   a   ]   [b]
    A a              = c        [A   0 ] [-lambda] = [c]

A constraint's pivot is eliminated only after all coordinates in its equation. It is then a pivot of
-A D^-1 A^T restricted to those coordinates, so the order is as stable as the Schur complement and
keeps the sparsity. The order is fixed at generation time. If a pivot falls below a fraction of its
initial value, the equation depends on others in this configuration: the pivot's inverse and the
multiplier are set to 0. The fraction is 1e-9 for the projection, where smaller pivots amplify
rounding errors into large corrections. It is 1e-12 for accelerations: in the system A02, larger
fractions drop an equation while the bars that it connects separate with g/16; the resulting error
of the velocity grows as 1/y^2 over the remaining stages, and one run of ten by dp8 failed.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S

from eomc.derive.energies import Energies
from eomc.derive.ldl import Pairs, Rows, Solution, Vector
from eomc.derive.outputs import differentiate
from eomc.derive.tape import Tape
from eomc.model.symbols import pivot_inverse
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


# --- the KKT matrix -------------------------------------------------------------------------------

Pattern = Mapping[int, set[int]]
DROPPED_PIVOT = sympy.Float("1e-9")  # replaces a dropped pivot, relative to its initial value


@dataclass(frozen=True)
class KktFactors:
    """Factors L diag(d) L^T of the KKT matrix [D A^T; A 0], as atoms of the attribute `tape`.

    D is the mass matrix and A the Jacobian of the constraint equations. Rows of the matrix with an
    index below `count` belong to coordinates, all others to constraint equations.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    steps
        For each elimination step, in order: the index of the row, the inverse of its pivot, and the
        column of L below the pivot.
    pivots
        For each coordinate: its pivot, which must be positive, and the diagonal entry of the matrix
        from which the elimination computes the pivot.
    inverses
        Inverse pivots of the constraint equations; 0 for an equation that is dropped because its
        pivot is too small.
    switched
        For each switched constraint (active in some contact or friction modes only), by index: its
        pivot, and the entries below the pivot before their division by it. The pivot of a dropped
        constraint is replaced by a small fraction of its initial value.
    slides
        For each coordinate that a switched constraint fixes, by index: 0 while that constraint is
        active, else 1.
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
        """Return the solution (a, lambda, residuals) of D a - A^T lambda = b, A a = c.

        A switched constraint is active in some contact or friction modes only. While it is active
        and fixes a coordinate, the acceleration of the coordinate is exactly 0, so that rounding
        errors do not move it.

        Parameters
        ----------
        b, c
            Right-hand sides, (nq,) and (m,).
        short
            Function that is applied to intermediate results. It may return a shorter expression
            with the same value.

        Returns
        -------
        a : (nq,)
            The accelerations.
        lambda : (m,)
            The multipliers; 0 for dropped equations.
        residuals
            For each switched constraint, the product of its lambda and its pivot. It is also
            computed for a constraint that is dropped.
        """
        tape, y = self.tape, [*b, *c]
        for k, _, factors in self.steps:
            for i, factor in factors.items():
                y[i] = short(tape.define(y[i] - factor * y[k]))
        x: dict[int, Expr] = {}
        for k, inverse, factors in reversed(self.steps):
            terms = [tape.define(-factor * x[i]) for i, factor in factors.items()]
            x[k] = tape.define(sympy.Add(tape.define(y[k] * inverse), *terms))
            if k in self.slides:
                x[k] = tape.times(self.slides[k], x[k])
        n, m = self.count, len(self.steps) - self.count
        residuals = (
            tape.total([y[n + r], *(tape.define(-a * x[i]) for i, a in below.items())])
            for r, (_, below) in self.switched.items()
        )
        multipliers = tuple(tape.define(-x[n + r]) for r in range(m))
        return tuple(x[i] for i in range(n)), multipliers, tuple(residuals)


@dataclass(frozen=True)
class PivotTolerance:
    """Bounds below which the pivot of a constraint equation counts as zero.

    An equation with a smaller pivot is dropped: it depends on the equations before it.

    Attributes
    ----------
    relative : Expr
        Fraction of the initial value of the pivot.
    absolute : sequence of Expr
        For each equation, the pivot below which its gradient counts as zero.
    """

    relative: Expr
    absolute: Sequence[Expr]


def factorize(
    tape: Tape,
    D: Rows,
    A: Rows,
    tolerance: PivotTolerance,
    short: Callable[[Expr], Expr] = lambda atom: atom,
    switched: Container[int] = (),
    last: Container[int] = (),
) -> KktFactors:
    """Return the factors L diag(d) L^T of the KKT matrix [D A^T; A 0].

    Parameters
    ----------
    tape : Tape
        List of elementary operations, to which those of the factorization are added.
    D, A : Rows
        Mass matrix and Jacobian of the constraint equations.
    tolerance : PivotTolerance
        Bounds below which the pivot of a constraint equation counts as zero.
    short
        Function that is applied to intermediate results. It may return a shorter expression with
        the same value.
    switched
        Indices of constraint equations that are active in some contact or friction modes only.
    last
        Indices of constraint equations that are eliminated after all others. They are dropped if
        they depend on the others.
    """
    n = len(D)
    M = {(i, j): D[i][j] for i in range(n) for j in range(n) if D[i][j] != 0}
    for r, row in enumerate(A):
        for j, entry in enumerate(row):
            if entry != 0:
                M[n + r, j] = M[j, n + r] = entry
    order = _order(_pattern(M, n + len(A)), n, tape, M, [n + r for r in range(len(A)) if r in last])
    parts: dict[tuple[int, int], list[Expr]] = {}  # terms that remain to be added to an entry
    alone: dict[int, list[Expr]] = {}  # terms of a constraint's pivot that come from coordinates
    remaining, steps, pivots = set(order), [], []
    inverses, switched_pivots = dict[int, Expr](), dict[int, tuple[Expr, Mapping[int, Expr]]]()
    slides = dict[int, Expr]()

    def read(i: int, j: int) -> Expr:
        """Return the entry (i, j), i >= j, of the matrix during the elimination.

        Changes of the entry by earlier steps are added first, in a single sum.
        """
        if added := parts.pop((i, j), None):
            M[i, j] = M[j, i] = short(tape.total([M[i, j], *added]))
        return M[i, j]

    for k in order:
        remaining.remove(k)
        below = {i: read(max(i, k), min(i, k)) for i in sorted(remaining) if (i, k) in M}
        if k < n:
            pair = (read(k, k), tape.define(D[k][k]))
            if not all(x.is_Number for x in pair) or pair[0] <= 1e-12 * pair[1]:
                pivots.append(pair)
            inverse = tape.define(1 / M[k, k])
        else:
            initial = M[k, k] = short(tape.total(alone.get(k, [])))
            pivot = tape.define(-read(k, k))
            limit = tape.define(-tolerance.relative * initial) if pivot != -initial else S.Zero
            limit = tape.total([limit, tolerance.absolute[k - n]])
            inverses[k] = tape.define(pivot_inverse(pivot, limit))
            inverse = tape.define(-inverses[k])
            if k - n in switched:
                retained = tape.define(pivot * inverses[k])  # 1, or 0 where the pivot is dropped
                replacement = tape.times(tape.define(DROPPED_PIVOT * (retained - 1)), initial)
                switched_pivots[k - n] = tape.total([pivot, replacement]), below
                (coordinate,) = (j for j, entry in enumerate(A[k - n]) if entry != 0)
                slides[coordinate] = tape.define(1 - sympy.sign(inverses[k]))
        column = {i: tape.define(a * inverse) for i, a in below.items()}
        for i, factor in column.items():
            for j, a in below.items():
                if j <= i:
                    part = tape.define(-factor * a)
                    if i == j >= n and k < n:
                        alone.setdefault(i, []).append(part)
                    else:
                        M.setdefault((i, j), S.Zero)
                        M.setdefault((j, i), S.Zero)
                        parts.setdefault((i, j), []).append(part)
        steps.append((k, inverse, column))
    rows = tuple(inverses[n + r] for r in range(len(A)))
    return KktFactors(tape, n, tuple(steps), tuple(pivots), rows, switched_pivots, slides)


def _pattern(M: Mapping[tuple[int, int], Expr], size: int) -> Pattern:
    """Return the adjacency of the matrix's nonzero entries."""
    return {i: {j for j in range(size) if j != i and (i, j) in M} for i in range(size)}


def _order(
    pattern: Pattern, n: int, tape: Tape, M: Mapping[tuple[int, int], Expr], last: list[int]
) -> list[int]:
    """Return the elimination order with the fewest operations: constraints first, or last."""
    stage = [tape.stage_of(M[i, i]) if i < n and (i, i) in M else 0 for i in range(len(pattern))]
    candidates = []
    for immediately in (True, False):
        neighbours = {i: set(to) for i, to in pattern.items()}
        order, work = list[int](), 0
        while neighbours:
            ready = [i for i in neighbours if i < n]
            if immediately or not ready:
                rows = [i for i in neighbours if i >= n and i not in last] or last
                ready += [
                    i
                    for i in rows
                    if i in neighbours and not any(j in neighbours for j in pattern[i])
                ]
            k = min(ready, key=lambda i: (len(neighbours[i]), stage[i], i))
            row = neighbours.pop(k)
            work += len(row) * (len(row) + 6) + 2
            for i in row:
                neighbours[i] = (neighbours[i] | row) - {i, k}
            order.append(k)
        candidates.append((work, order))
    return min(candidates, key=lambda pair: pair[0])[1]


def constrained_accelerations(
    tape: Tape,
    D: Rows,
    b: Sequence[Expr],
    rows: Constraints,
    short: Callable[[Expr], Expr] = lambda atom: atom,
) -> Solution:
    """Return the accelerations qdd and Lagrange multipliers of a system with constraints.

    The result has one multiplier for each constraint; those of redundant constraints are 0.

    Parameters
    ----------
    tape : Tape
        List of elementary operations, to which those of the solution are added.
    D, b
        Mass matrix by rows, and tau - bias.
    rows : Constraints
        The constraint equations.
    short
        Function that is applied to intermediate results. It may return a shorter expression with
        the same value.
    """
    equations = _factored_equations(tape, D, b, rows, short)
    factored, c = equations.factors, equations.c
    a, solved_multipliers, residuals = factored.solve(equations.b, c, short)
    parts: dict[int, list[Expr]] = {}
    for row, x in zip(rows.solved, solved_multipliers, strict=True):
        for k, w in row:
            parts.setdefault(k, []).append(tape.scaled(w, x))
    multipliers = tuple(
        S.Zero if k not in parts else parts[k][0] if len(parts[k]) == 1 else tape.total(parts[k])
        for k in range(len(rows.values))
    )
    order = tuple(k for k, _, _ in factored.steps if k < len(D))
    switched_rows = zip(factored.switched.items(), residuals, strict=True)
    parts_of_switched = {
        rows.solved[r][0][0]: (residual, pivot) for (r, (pivot, _)), residual in switched_rows
    }
    return Solution(tape, a, order, factored.pivots, "D", multipliers, parts_of_switched)


@dataclass(frozen=True)
class _FactoredEquations:
    """The equations D a - A^T lambda = b, A a = c with a regular D, and the factors of K."""

    D: Rows
    A: Rows
    b: Sequence[Expr]
    c: Sequence[Expr]
    factors: KktFactors


def _factored_equations(
    tape: Tape,
    D: Rows,
    b: Sequence[Expr],
    rows: Constraints,
    short: Callable[[Expr], Expr] = lambda atom: atom,
) -> _FactoredEquations:
    """Return the equations of the accelerations and multipliers, factored."""
    A = jacobian(tape, rows)
    c = [tape.scaled(S.NegativeOne, x) for x in select_rows(tape, rows.rest, rows)]
    D, b = regularize_mass(tape, D, b, A, c, rows.weights)
    switched = _switched(rows)
    tolerance = PivotTolerance(rows.drop[0], rows.pivot_limits)
    factors = factorize(tape, D, A, tolerance, short, switched, switched)
    return _FactoredEquations(D, A, b, c, factors)


def linearize_constrained(
    system: System, tape: Tape, D: Rows, b: Sequence[Expr], rows: Constraints
) -> tuple[Rows, Pairs]:
    """Return the derivatives [da/dq, da/dqd, da/du] of constrained accelerations a, and the pivots.

    They follow from the residuals of the equations at constant a and lambda,

        [D  A^T] [   da   ]   [db - dD a + dA^T lambda]
        [A   0 ] [-dlambda] = [dc - dA a              ],

    with the factors that gave a. The arguments are those of `constrained_accelerations`; no
    constraint is switched by modes. Raises SceneError if the equations contain a discontinuous
    function.
    """
    equations = _factored_equations(tape, D, b, rows)
    D, A, factors = equations.D, equations.A, equations.factors
    a, multipliers, _ = factors.solve(equations.b, equations.c, lambda atom: atom)
    a, multipliers = (tuple(map(tape.opaque, x)) for x in (a, multipliers))
    n, m = range(len(D)), range(len(A))
    values = [*equations.b, *equations.c, *(x for row in (*D, *A) for x in row)]

    def column(x: sympy.Symbol) -> Vector:
        """Return da/dx."""
        (changes,) = differentiate(system, tape, values, [{x: S.One}])
        db, dc = changes[: len(n)], changes[len(n) : len(n) + len(m)]
        entries = iter(changes[len(n) + len(m) :])
        dD, dA = ([[next(entries) for _ in n] for _ in count] for count in (n, m))

        def minus_product(first: Expr, row: Sequence[Expr]) -> list[Expr]:
            products = (tape.times(y, z) for y, z in zip(row, a, strict=True))
            return [first, *(tape.scaled(S.NegativeOne, y) for y in products)]

        forces = [
            tape.total(
                [*minus_product(db[i], dD[i]), *(tape.times(dA[r][i], multipliers[r]) for r in m)]
            )
            for i in n
        ]
        rates = [tape.total(minus_product(dc[r], dA[r])) for r in m]
        return factors.solve(forces, rates, lambda atom: atom)[0]

    columns = [column(x) for x in (*system.q, *system.qd, *system.u)]
    return tuple(zip(*columns, strict=True)), factors.pivots


def _switched(rows: Constraints) -> list[int]:
    """Return the indices in `rows.solved` of constraints that modes switch."""
    return [r for r, row in enumerate(rows.solved) if row[0][0] in rows.switched]


def regularize_mass(
    tape: Tape, D: Rows, b: Sequence[Expr], A: Rows, c: Sequence[Expr], weights: Vector = ()
) -> tuple[Rows, Sequence[Expr]]:
    """Return a regular mass matrix and its right-hand side for constrained equations of motion.

    They are (D + A^T W A, b + A^T W c) if D is singular, else (D, b). The accelerations a, with
    D a - A^T lambda = b and A a = c, and the multipliers lambda are the same in both cases. W is
    the diagonal matrix of `weights`, which are given only if D is singular. Without them, D counts
    as singular if a diagonal entry is 0, and W is then the identity.
    """
    n = range(len(D))
    if not weights and all(D[i][i] != 0 for i in n):
        return D, b
    weights = weights or (S.One,) * len(A)
    weighted = [[tape.scaled(w, x) for x in row] for w, row in zip(weights, A, strict=True)]

    def add_products(first: Expr, i: int, other: Sequence[Expr]) -> Expr:
        parts = [tape.times(row[i], x) for row, x in zip(weighted, other, strict=True)]
        return tape.total([first, *parts])

    augmented = tuple(tuple(add_products(D[i][j], i, [row[j] for row in A]) for j in n) for i in n)
    return augmented, [add_products(b[i], i, c) for i in n]


def projection(
    tape: Tape, D: Rows, rows: Constraints, q: Sequence[sympy.Symbol]
) -> tuple[Vector, Pairs]:
    """Return the corrections of q and qd that project them onto the constraints.

    They are one Newton step. The correction dq of q is the smallest in the norm of D that satisfies
    A dq = -phi. The correction dqd of qd is the smallest with which the velocity constraints hold
    at q + dq, to first order in dq.

    Returns
    -------
    values : tuple of Expr
        dq (nq), dqd (nq), and the inverse pivot of each constraint equation that is active in all
        contact and friction modes.
    pivots : Pairs
        For each coordinate: its pivot in the factorization, and the diagonal entry of the matrix
        from which the pivot is computed.
    """
    n, A = len(D), jacobian(tape, rows)
    D, _ = regularize_mass(tape, D, [S.Zero] * n, A, [S.Zero] * len(A), rows.weights)
    tolerance = PivotTolerance(rows.drop[1], rows.pivot_limits)
    factored = factorize(tape, D, A, tolerance, last=_switched(rows))
    indices = [row[0][0] for row in rows.solved]  # sums of constraints are all holonomic
    position_residuals = [
        tape.scaled(S.NegativeOne, x) for x in select_rows(tape, rows.values, rows)
    ]
    positions = [
        S.Zero if k >= rows.holonomic else x
        for k, x in zip(indices, position_residuals, strict=True)
    ]
    zeros, identity = [S.Zero] * n, lambda atom: atom
    dq, _, _ = factored.solve(zeros, positions, identity)
    rate_changes = tape.forward(rows.rates, dict(zip(q, dq, strict=True)))
    rates = [tape.total([x, y]) for x, y in zip(rows.rates, rate_changes, strict=True)]
    velocity_residuals = [tape.scaled(S.NegativeOne, x) for x in select_rows(tape, rates, rows)]
    dqd, _, _ = factored.solve(zeros, velocity_residuals, identity)
    inverse_pivots = (
        x for k, x in zip(indices, factored.inverses, strict=True) if k not in rows.switched
    )
    return (*dq, *dqd, *inverse_pivots), factored.pivots
