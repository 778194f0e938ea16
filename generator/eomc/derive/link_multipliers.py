"""Accelerations of point masses on links by link multipliers (tensions), without D.

Where K = sum m ydot^2/2, positions are sums y = A e + d(t) of increments, and each increment is a
function of one angle: x2 = l1 sin a1 + l2 sin a2 has sin a1 and sin a2. So e = B (y - d) with B
sparse, and edd = u phidd + beta for a group of increments of one angle phi = sum c_i q_i.
What holds a group together is a force along n, perpendicular to its u:

    M ydd = F + B^T (N^T lambda + U f),    N edd = N beta,    edd = B (ydd - ddd)
    S lambda = N (beta - B (M^-1 F - ddd) - T U f),    S = N T N^T,    T = B M^-1 B^T
    phidd = u . (edd - beta)/u.u

with F at the points and f = (generalized force on phi)/u.u. S has an entry for each two links that
meet in a mass: it is tridiagonal for a chain, and for a tree as sparse. It is what is left of the
equations with constraint forces as unknowns once the masses are eliminated (Baraff, "Linear-time
dynamics using Lagrange multipliers", SIGGRAPH 1996).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from sympy import Expr, Mul, S, Symbol
from sympy.polys.domains import QQ
from sympy.polys.matrices import DomainMatrix
from sympy.polys.matrices.exceptions import DMNonInvertibleMatrixError

from eomc.derive.atoms import is_negative, split
from eomc.derive.energies import Energies, on_tape
from eomc.derive.ldl import Pairs, Solution, Vector, solve
from eomc.derive.tape import Stage
from eomc.derive.vectors import Vectors
from eomc.model.system import System, dot, t

Row = dict[int, Expr]  # the entries of a sparse row that are not zero, by column


class UnsuitedError(Exception):
    """Why the system is none of point masses on links."""


@dataclass(frozen=True)
class Point:
    """A position with the kinetic energy mass*speed^2/2."""

    place: Expr
    speed: Symbol
    mass: Expr


@dataclass(frozen=True)
class Group:
    """Increments of one angle, sum direction_i q_i: their slopes along it and beta.

    across: the rows n with n . slopes = 0.
    """

    direction: tuple[Expr, ...]
    members: tuple[int, ...]
    slopes: tuple[Expr, ...]
    beta: tuple[Expr, ...]
    across: tuple[tuple[Expr, ...], ...]


def is_prompt(system: System) -> bool:
    """Whether multipliers are eliminated so that little is waited for, see ldl.solve.

    Many computed at once don't wait, and products of pivots would leave the range of a float.
    """
    return system.run.real == "double" and not system.run.batch


def solution(system: System) -> Solution:
    """qdd by the multipliers. Raises UnsuitedError where the system is not of this kind."""
    most = 2 * len(system.q)  # velocities; with more there are more multipliers than coordinates
    speeds = system.kinetic.atoms(dot) | (system.kinetic.free_symbols & {*system.qd})
    if len(speeds) > most:
        raise UnsuitedError(f"{len(speeds)} velocities in K, more than {most}")
    if system.applied:
        raise UnsuitedError("forces at points")
    if system.linear_potential != 0:
        raise UnsuitedError("a potential with velocities")
    if system.discrete:
        raise UnsuitedError("parameters that jumps set")
    return _Links(system, on_tape(system, system.kinetic, system.potential)).solution()


class _Links(Vectors):
    """The points, increments and groups of a system, and the equations of its multipliers."""

    def __init__(self, system: System, e: Energies) -> None:
        super().__init__(e.tape)
        self.system = system
        self.e = e
        self.sums: dict[Symbol, dict[Symbol, Expr]] = {}
        self.divisors: list[Expr] = []
        self.points = self._points()
        places = [self._sum_of(p.place) for p in self.points]
        # an increment has the sign with which it first stands, so that neighbours are alike
        signs: dict[Symbol, Expr] = {}
        for b, c in (pair for place in places for pair in place.items()):
            if self.tape.stage[b] > Stage.TIME:
                signs.setdefault(b, S.NegativeOne if is_negative(split(c)[0]) else S.One)
        self.increments = [self.tape.scaled(sign, b) for b, sign in signs.items()]
        self.groups = self._groups()
        self.group_of = {a: k for k, g in enumerate(self.groups) for a in g.members}
        at = {b: a for a, b in enumerate(signs)}
        rows = [
            {at[b]: self.tape.scaled(signs[b], c) for b, c in place.items() if b in at}
            for place in places
        ]
        self.driven = [{b: c for b, c in place.items() if b not in at} for place in places]
        self.B = self._inverse(rows)
        self.T, self.unit = self._flexibility()
        self.near = {(self.group_of[a], self.group_of[b]) for a, b in self.T}

    # --- points ----------------------------------------------------------------------------------

    def _points(self) -> list[Point]:
        """What has kinetic energy, which must be a sum of masses times squares of velocities."""
        e, q = self.e, self.system.q
        speeds, places = [*e.points, *self.system.qd], [*e.points.values(), *q]
        stop, kinetic = frozenset(e.points), [(e.kinetic, S.One)]
        if any(x != 0 for x in self.tape.gradient(kinetic, q, stop)):
            raise UnsuitedError("masses that depend on coordinates")
        momenta = self.tape.gradient(kinetic, speeds, stop)
        return [
            Point(place, speed, self._mass(momentum, speed))
            for place, speed, momentum in zip(places, speeds, momenta, strict=True)
            if momentum != 0
        ]

    def _mass(self, momentum: Expr, speed: Symbol) -> Expr:
        factor, symbol = split(momentum)
        rhs = self.tape.rhs(symbol) if symbol in self.tape.parts else S.One
        if symbol == speed:
            mass = factor
        else:
            mass = self.tape.define(factor * rhs / speed) if rhs.is_Mul else S.Zero
        if self.tape.stage_of(mass) > Stage.PARAMETER or (mass.is_number and not mass > 0):
            raise UnsuitedError("K is no sum of masses times squares of velocities")
        return mass

    # --- increments ------------------------------------------------------------------------------

    def _sum_of(self, atom: Expr) -> dict[Symbol, Expr]:
        """The atom as a sum of names known after the parameters, each times what these decide.

        What depends on parameters alone does not move, and is left out.
        """
        for symbol in self.tape.live([atom]):  # in order, so that nothing recurses
            if symbol not in self.sums:
                self.sums[symbol] = self._terms(symbol)
        return self._scaled_sum(atom)

    def _scaled_sum(self, atom: Expr) -> dict[Symbol, Expr]:
        factor, symbol = split(atom)
        if symbol is None or self.tape.stage[symbol] <= Stage.PARAMETER:
            return {}
        known = self.sums.get(symbol, {symbol: S.One})
        return {b: self.tape.scaled(factor, c) for b, c in known.items()}

    def _terms(self, symbol: Symbol) -> dict[Symbol, Expr]:
        tape, rhs = self.tape, self.tape.rhs(symbol)
        if rhs.is_Add:
            parts: dict[Symbol, list[Expr]] = {}
            for term in rhs.args:
                for b, c in self._scaled_sum(term).items():
                    parts.setdefault(b, []).append(c)
            sums = {b: tape.total(cs) for b, cs in parts.items()}
            return {b: c for b, c in sums.items() if c != 0}
        if rhs.is_Mul and tape.stage[symbol] > Stage.PARAMETER:
            late = [f for f in rhs.args if tape.stage_of(tape.define(f)) > Stage.PARAMETER]
            early = tape.define(Mul(*(f for f in rhs.args if f not in late)))
            inner = self._scaled_sum(tape.define(Mul(*late))) if len(late) < len(rhs.args) else {}
            return {b: tape.times(early, c) for b, c in inner.items()} or {symbol: S.One}
        return {symbol: S.One}

    def _groups(self) -> list[Group]:
        """The increments by the angle that they depend on; as many angles as coordinates."""
        members: dict[tuple[Expr, ...], dict[int, Expr]] = {}
        for a, increment in enumerate(self.increments):
            slopes = [split(x) for x in self.tape.gradient([(increment, S.One)], self.system.q)]
            on = [k for k, (factor, _) in enumerate(slopes) if factor != 0]
            last, name = slopes[on[-1]]
            if any(slopes[k][1] != name for k in on):
                found = ", ".join(self.system.q[k].name for k in on)
                raise UnsuitedError(
                    f"a position depends on {found} otherwise than on a sum of them"
                )
            direction = tuple(factor / last for factor, _ in slopes)
            if not all(c.is_Rational for c in direction):
                raise UnsuitedError("a position depends on a sum with irrational weights")
            slope = last if name is None else self.tape.scaled(last, name)
            members.setdefault(direction, {})[a] = slope
        n = len(self.system.q)
        if len(self.increments) == len(members):
            raise UnsuitedError("no links")
        if len(members) != n:
            raise UnsuitedError(f"positions depend on {len(members)} angles, of {n} coordinates")
        return [self._group(direction, found) for direction, found in members.items()]

    def _group(self, direction: tuple[Expr, ...], found: Mapping[int, Expr]) -> Group:
        tape, system, slopes = self.tape, self.system, tuple(found.values())
        rates = {**system.rates, t: S.One}
        speeds = tape.forward([self.increments[a] for a in found], rates)
        beta = tuple(tape.forward(speeds, rates))
        return Group(direction, tuple(found), slopes, beta, self._across(slopes))

    def _across(self, slopes: Sequence[Expr]) -> tuple[tuple[Expr, ...], ...]:
        """A basis of what is perpendicular to the slopes."""
        if len(slopes) == 2:
            return ((self.minus(slopes[1]), slopes[0]),)
        constant = [k for k, x in enumerate(slopes) if self.tape.stage_of(x) <= Stage.PARAMETER]
        if not constant:
            if len(slopes) == 1:
                raise UnsuitedError("a position that depends on an angle along one direction only")
            raise UnsuitedError(f"{len(slopes)} increments on one angle, none of them steady")
        one = constant[0]
        self.divisors.append(slopes[one])
        return tuple(
            tuple(
                S.One if j == k else self.tape.define(-x / slopes[one]) if j == one else S.Zero
                for j in range(len(slopes))
            )
            for k, x in enumerate(slopes)
            if k != one
        )

    def _inverse(self, rows: Sequence[Row]) -> list[Row]:
        """B with e = B (y - d), the increments found one after another from y = A e + d."""
        tape = self.tape
        if len(rows) != len(self.increments):
            raise UnsuitedError(f"{len(rows)} velocities in K, {len(self.increments)} increments")
        left, B = dict(enumerate(rows)), dict[int, Row]()
        while left:
            news = ((k, [a for a in row if a not in B]) for k, row in left.items())
            k, new = next(((k, new) for k, new in news if len(new) == 1), (-1, []))
            if not new:
                raise UnsuitedError("positions that do not follow one from another")
            row = left.pop(k)
            parts: dict[int, list[Expr]] = {k: [S.One]}
            for a, c in row.items():
                for j, b in B.get(a, {}).items():
                    parts.setdefault(j, []).append(self.minus(tape.times(c, b)))
            self.divisors.append(row[new[0]])
            inverse = tape.define(1 / row[new[0]])
            made = {j: tape.times(inverse, tape.total(cs)) for j, cs in parts.items()}
            B[new[0]] = {j: c for j, c in made.items() if c != 0}
        return [B[a] for a in range(len(rows))]

    # --- forces and masses -----------------------------------------------------------------------

    def _forces(self) -> tuple[list[Expr], list[Expr]]:
        """Forces at the points, and on the coordinates that are none."""
        e, tape, q, qd = self.e, self.tape, self.system.q, self.system.qd
        places, speeds = [split(p.place) for p in self.points], [p.speed for p in self.points]
        names = [name for _, name in places if name]
        pull = tape.gradient([(e.potential, S.One)], [*names, *q], frozenset(names))
        drag = tape.gradient([(e.dissipation, S.One)], [*speeds, *qd], frozenset(speeds))
        loads = dict(zip(q, e.forces, strict=True))
        n = len(names)
        at = [
            tape.total(
                [loads.get(name, S.Zero), self.minus(tape.define(p / factor)), self.minus(r)]
            )
            for (factor, _), name, p, r in zip(places, names, pull[:n], drag[:n], strict=True)
        ]
        on = [
            S.Zero if x in names else tape.total([loads[x], self.minus(p), self.minus(r)])
            for x, p, r in zip(q, pull[n:], drag[n:], strict=True)
        ]
        return at, on

    def _free(self, forces: Sequence[Expr]) -> list[Expr]:
        """B (M^-1 F - ddd): edd without multipliers and forces on angles."""
        tape, free = self.tape, []
        for point, force, terms in zip(self.points, forces, self.driven, strict=True):
            rates = tape.forward(tape.forward(list(terms), {t: S.One}), {t: S.One})
            lost = [
                self.minus(tape.times(c, r)) for c, r in zip(terms.values(), rates, strict=True)
            ]
            free.append(tape.total([tape.define(force / point.mass), *lost]))
        return [tape.total([tape.times(b, free[k]) for k, b in row.items()]) for row in self.B]

    def _flexibility(self) -> tuple[dict[tuple[int, int], Expr], Expr]:
        """T/unit where it is not zero, T = B M^-1 B^T, and the unit, which all entries share."""
        tape = self.tape
        ease = [tape.define(1 / p.mass) for p in self.points]
        on: dict[int, list[int]] = {}  # the increments that a point is in
        for a, row in enumerate(self.B):
            for k in row:
                on.setdefault(k, []).append(a)
        parts: dict[tuple[int, int], list[Expr]] = {}
        for k, found in on.items():
            for a, b in product(found, repeat=2):
                both = tape.times(self.B[a][k], self.B[b][k])
                parts.setdefault((a, b), []).append(tape.times(both, ease[k]))
        T = {place: x for place, xs in parts.items() if (x := tape.total(xs)) != 0}
        units = {split(x)[1] for x in T.values()}
        unit = units.pop() if len(units) == 1 else None
        if unit is None:
            return T, S.One
        return {place: split(x)[0] for place, x in T.items()}, unit

    def _through(self, g: int, x: Vector, h: int, y: Vector) -> Expr:
        """x . T y/unit of a row x on group g and a row y on group h."""
        one, other = self.groups[g].members, self.groups[h].members
        T = [[self.T.get((a, b), S.Zero) for b in other] for a in one]
        if len(one) == len(other):  # most masses resist alike in all directions
            first, size = T[0][0], range(len(one))
            if all(T[i][j] == (first if i == j else 0) for i, j in product(size, size)):
                return self.tape.times(first, self.dot(x, y))
        return self.dot(x, [self.dot(row, y) for row in T])

    # --- the multipliers -------------------------------------------------------------------------

    def solution(self) -> Solution:
        """qdd; each of its pivots belongs to a multiplier, or is what something was divided by."""
        tape, groups, near = self.tape, self.groups, self.near
        forces, loads = self._forces()
        free = self._free(forces)
        back = self._back()
        slopes = [g.slopes for g in groups]
        squares = [self.dot(u, u) for u in slopes]
        pushes = [
            tape.define(self.unit * load / square)
            for load, square in zip(self._through_rows(back, loads), squares, strict=True)
        ]
        rows = [(g, n) for g, group in enumerate(groups) for n in group.across]

        def given(g: int, x: Vector) -> list[Expr]:
            """x . edd for a row x on group g, without the multipliers' part."""
            pushed = [
                tape.times(self._through(g, x, h, slopes[h]), push)
                for h, push in enumerate(pushes)
                if push != 0 and (g, h) in near
            ]
            return [self.dot(x, [free[a] for a in groups[g].members]), *pushed]

        matrix = tuple(
            tuple(self._through(g, x, h, y) if (g, h) in near else S.Zero for h, y in rows)
            for g, x in rows
        )
        right = [
            tape.total([self.dot(x, groups[g].beta), *map(self.minus, given(g, x))])
            for g, x in rows
        ]
        solved = solve(tape, matrix, right, kept=tape.whole, prompt=is_prompt(self.system))
        turning = []
        for g, (u, square) in enumerate(zip(slopes, squares, strict=True)):
            drawn = [
                tape.times(self._through(g, u, h, y), multiplier)
                for (h, y), multiplier in zip(rows, solved.acceleration, strict=True)
                if (g, h) in near
            ]
            whole = [*drawn, *given(g, u), self.minus(self.dot(u, groups[g].beta))]
            turning.append(tape.define(tape.total(whole) / square))
        acceleration = tuple(
            tape.total([tape.scaled(c, x) for c, x in zip(row, turning, strict=True)])
            for row in back
        )
        names = [max(k for k, c in enumerate(groups[g].direction) if c != 0) for g, _ in rows]
        by_row = tuple(names[k] for k in solved.order)
        return Solution(tape, acceleration, by_row, (*solved.pivots, *self._nonzero()), "S")

    def _through_rows(self, back: Sequence[Vector], loads: Sequence[Expr]) -> list[Expr]:
        """Forces on the angles from those on the coordinates."""
        return [
            self.tape.total([self.tape.scaled(c, x) for c, x in zip(column, loads, strict=True)])
            for column in zip(*back, strict=True)
        ]

    def _back(self) -> list[Vector]:
        """The coordinates by the angles: the inverse of the directions."""
        n = len(self.groups)
        rows = [[QQ(int(c.p), int(c.q)) for c in g.direction] for g in self.groups]
        try:
            inverse = DomainMatrix(rows, (n, n), QQ).inv()
        except DMNonInvertibleMatrixError:
            raise UnsuitedError("the angles do not determine the coordinates") from None
        return [tuple(inverse.to_Matrix().row(i)) for i in range(n)]

    def _nonzero(self) -> Pairs:
        """Masses, which must be positive, and squares of what parameters divide by."""
        tape = self.tape
        found = [p.mass for p in self.points] + [tape.times(x, x) for x in self.divisors]
        return tuple((x, x) for x in dict.fromkeys(found) if not x.is_number)
