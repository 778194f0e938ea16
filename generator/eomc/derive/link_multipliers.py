"""Accelerations of point masses on links by link multipliers (tensions), without D.

Suppose K = sum m ydot^2/2, and the positions are sums y = A e + d(t) of increments e, each a
function of one angle: x2 = l1 sin a1 + l2 sin a2 has the increments sin a1 and sin a2. Then e = B
(y - d) with B sparse, and edd = u phidd + beta for a group of increments of one angle phi = sum c_i
q_i. The constraint forces within a group act along n, perpendicular to its u:

    M ydd = F + B^T (N^T lambda + U f),    N edd = N beta,    edd = B (ydd - ddd)
    S lambda = N (beta - B (M^-1 F - ddd) - T U f),    S = N T N^T,    T = B M^-1 B^T
    phidd = u . (edd - beta)/u.u

where F are the forces at the points and f = (generalized force on phi)/u.u. S has one entry per
pair of links that share a mass: it is tridiagonal for a chain, and as sparse for a tree. It remains
when the masses are eliminated from the equations with constraint forces as unknowns (Baraff,
"Linear-time dynamics using Lagrange multipliers", SIGGRAPH 1996).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from sympy import Expr, Mul, S, Symbol
from sympy.polys.domains import QQ
from sympy.polys.matrices import DomainMatrix
from sympy.polys.matrices.exceptions import DMNonInvertibleMatrixError

from eomc.derive.energies import Energies, energies_on_tape
from eomc.derive.ldl import Pairs, Solution, Vector, solve
from eomc.derive.newton_euler import Vectors
from eomc.derive.tape import Stage, is_negative, split
from eomc.model.system import System, dot, t

Row = dict[int, Expr]  # nonzero entries of a sparse row, by column


class UnsuitedError(Exception):
    """Raised if the method of link multipliers does not apply to a system.

    The text of the exception is the reason. The method computes the tensions of massless links
    between point masses.
    """


@dataclass(frozen=True)
class PointMass:
    """A point mass along one axis, with the kinetic energy mass speed^2/2.

    Attributes
    ----------
    place : Expr
        The position along the axis (m), or a coordinate. It is an atom of a tape: a number, a name
        on the tape, or a number times a name.
    speed : Symbol
        The time derivative of `place`.
    mass : Expr
        The mass.
    """

    place: Expr
    speed: Symbol
    mass: Expr


@dataclass(frozen=True)
class LinkGroup:
    """The increments e of positions that depend on the same angle phi = sum_i direction_i q_i.

    The position of each point mass is a sum of increments. An increment is a function of one angle,
    such as l sin(phi). Its second time derivative is slope phidd + beta.

    Attributes
    ----------
    direction : (nq,)
        Coefficients of the coordinates in the angle.
    members : tuple of int
        Indices of the increments.
    slopes : tuple of Expr
        For each increment, its derivative de/dphi.
    beta : tuple of Expr
        For each increment, its second time derivative at qdd = 0.
    perpendicular : tuple of rows
        A basis of the vectors n with n . slopes = 0.
    """

    direction: tuple[Expr, ...]
    members: tuple[int, ...]
    slopes: tuple[Expr, ...]
    beta: tuple[Expr, ...]
    perpendicular: tuple[tuple[Expr, ...], ...]


def prefer_short_chains(system: System) -> bool:
    """Return True if `ldl.solve` should prefer short dependency chains to few operations.

    The result is False for batches: several states are computed in parallel, so that the processor
    is busy even with long chains. It is also False in single precision, since products of pivots
    could exceed the range of a float.
    """
    return system.run.real == "double" and not system.run.batch


def solution(system: System) -> Solution:
    """Return the accelerations qdd of a system of point masses by link multipliers.

    Link multipliers are the tensions of massless links between the points.

    Raises
    ------
    UnsuitedError
        If the method does not apply to the system.
    """
    # With more velocities there would be more multipliers than coordinates.
    most = 2 * len(system.q)
    speeds = system.kinetic.atoms(dot) | (system.kinetic.free_symbols & {*system.qd})
    if len(speeds) > most:
        raise UnsuitedError(f"{len(speeds)} velocities in K, more than {most}")
    if system.applied:
        raise UnsuitedError("forces at points")
    if system.linear_potential != 0:
        raise UnsuitedError("a potential with velocities")
    if system.discrete:
        raise UnsuitedError("parameters that jumps set")
    energies = energies_on_tape(system, system.kinetic, system.potential)
    return _LinkEquations(system, energies).solution()


class _LinkEquations:
    """Points, increments and groups of a system, and the equations of its multipliers."""

    def __init__(self, system: System, e: Energies) -> None:
        self.tape, self.vectors = e.tape, Vectors(e.tape)
        self.system = system
        self.e = e
        self.sums: dict[Symbol, dict[Symbol, Expr]] = {}
        self.divisors: list[Expr] = []
        self.points = self._points()
        places = [self._sum_of(p.place) for p in self.points]
        # An increment takes the sign of its first occurrence, so that its neighbours have the same.
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

    def _points(self) -> list[PointMass]:
        """Return the point masses. Raises UnsuitedError where K is not sum m_k w_k^2/2."""
        e, q = self.e, self.system.q
        speeds, places = [*e.points, *self.system.qd], [*e.points.values(), *q]
        stop, kinetic = frozenset(e.points), [(e.kinetic, S.One)]
        if any(x != 0 for x in self.tape.gradient(kinetic, q, stop)):
            raise UnsuitedError("masses that depend on coordinates")
        momenta = self.tape.gradient(kinetic, speeds, stop)
        return [
            PointMass(place, speed, self._mass(momentum, speed))
            for place, speed, momentum in zip(places, speeds, momenta, strict=True)
            if momentum != 0
        ]

    def _mass(self, momentum: Expr, speed: Symbol) -> Expr:
        """Return m of momentum = m speed."""
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
        """Write the atom as a linear combination of names, with coefficients that depend on
        parameters only.

        Terms that depend on parameters only do not move and are left out.
        """
        for symbol in self.tape.live([atom]):  # in order, which avoids recursion
            if symbol not in self.sums:
                self.sums[symbol] = self._terms(symbol)
        return self._scaled_sum(atom)

    def _scaled_sum(self, atom: Expr) -> dict[Symbol, Expr]:
        """Return the linear combination of an atom whose name has been processed."""
        factor, symbol = split(atom)
        if symbol is None or self.tape.stage[symbol] <= Stage.PARAMETER:
            return {}
        known = self.sums.get(symbol, {symbol: S.One})
        return {b: self.tape.scaled(factor, c) for b, c in known.items()}

    def _terms(self, symbol: Symbol) -> dict[Symbol, Expr]:
        """Return the linear combination of a name, from those in its definition."""
        tape, rhs = self.tape, self.tape.rhs(symbol)
        if rhs.is_Add:
            parts: dict[Symbol, list[Expr]] = {}
            for term in rhs.args:
                for b, c in self._scaled_sum(term).items():
                    parts.setdefault(b, []).append(c)
            sums = {b: tape.total(cs) for b, cs in parts.items()}
            return {b: c for b, c in sums.items() if c != 0}
        if rhs.is_Mul and tape.stage[symbol] > Stage.PARAMETER:
            variable = [f for f in rhs.args if tape.stage_of(tape.define(f)) > Stage.PARAMETER]
            coefficient = tape.define(Mul(*(f for f in rhs.args if f not in variable)))
            combination = (
                self._scaled_sum(tape.define(Mul(*variable)))
                if len(variable) < len(rhs.args)
                else {}
            )
            return {b: tape.times(coefficient, c) for b, c in combination.items()} or {
                symbol: S.One
            }
        return {symbol: S.One}

    def _groups(self) -> list[LinkGroup]:
        """Group the increments by the angle that they depend on. There must be one angle per
        coordinate.
        """
        members: dict[tuple[Expr, ...], dict[int, Expr]] = {}
        for a, increment in enumerate(self.increments):
            slopes = [split(x) for x in self.tape.gradient([(increment, S.One)], self.system.q)]
            used = [k for k, (factor, _) in enumerate(slopes) if factor != 0]
            last, name = slopes[used[-1]]
            if any(slopes[k][1] != name for k in used):
                names = ", ".join(self.system.q[k].name for k in used)
                raise UnsuitedError(
                    f"a position depends on {names} otherwise than on a sum of them"
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
        return [self._group(direction, slopes_by) for direction, slopes_by in members.items()]

    def _group(
        self, direction: tuple[Expr, ...], slopes_by_member: Mapping[int, Expr]
    ) -> LinkGroup:
        """Return the group of increments with the angle sum direction_i q_i."""
        tape, system, slopes = self.tape, self.system, tuple(slopes_by_member.values())
        rates = {**system.rates, t: S.One}
        speeds = tape.forward([self.increments[a] for a in slopes_by_member], rates)
        beta = tuple(tape.forward(speeds, rates))
        return LinkGroup(
            direction, tuple(slopes_by_member), slopes, beta, self._perpendicular_rows(slopes)
        )

    def _perpendicular_rows(self, slopes: Sequence[Expr]) -> tuple[tuple[Expr, ...], ...]:
        """Return a basis of the rows perpendicular to the slopes."""
        if len(slopes) == 2:
            return ((self.vectors.minus(slopes[1]), slopes[0]),)
        constant = [k for k, x in enumerate(slopes) if self.tape.stage_of(x) <= Stage.PARAMETER]
        if not constant:
            if len(slopes) == 1:
                raise UnsuitedError("a position that depends on an angle along one direction only")
            raise UnsuitedError(f"{len(slopes)} increments on one angle, none of them steady")
        pivot = constant[0]
        self.divisors.append(slopes[pivot])
        return tuple(
            tuple(
                S.One if j == k else self.tape.define(-x / slopes[pivot]) if j == pivot else S.Zero
                for j in range(len(slopes))
            )
            for k, x in enumerate(slopes)
            if k != pivot
        )

    def _inverse(self, rows: Sequence[Row]) -> list[Row]:
        """Return B of e = B (y - d), by forward substitution in y = A e + d."""
        tape = self.tape
        if len(rows) != len(self.increments):
            raise UnsuitedError(f"{len(rows)} velocities in K, {len(self.increments)} increments")
        remaining, B = dict(enumerate(rows)), dict[int, Row]()
        while remaining:
            unknowns_of_rows = ((k, [a for a in row if a not in B]) for k, row in remaining.items())
            k, unknown = next(
                ((k, unknown) for k, unknown in unknowns_of_rows if len(unknown) == 1), (-1, [])
            )
            if not unknown:
                raise UnsuitedError("positions that do not follow one from another")
            row = remaining.pop(k)
            parts: dict[int, list[Expr]] = {k: [S.One]}
            for a, c in row.items():
                for j, b in B.get(a, {}).items():
                    parts.setdefault(j, []).append(self.vectors.minus(tape.times(c, b)))
            self.divisors.append(row[unknown[0]])
            inverse = tape.define(1 / row[unknown[0]])
            coefficients = {j: tape.times(inverse, tape.total(cs)) for j, cs in parts.items()}
            B[unknown[0]] = {j: c for j, c in coefficients.items() if c != 0}
        return [B[a] for a in range(len(rows))]

    # --- forces and masses -----------------------------------------------------------------------

    def _forces(self) -> tuple[list[Expr], list[Expr]]:
        """Return the forces at points, and the generalized forces on coordinates that are not
        points.
        """
        V = self.vectors
        e, tape, q, qd = self.e, self.tape, self.system.q, self.system.qd
        places, speeds = [split(p.place) for p in self.points], [p.speed for p in self.points]
        names = [name for _, name in places if name]
        gradient = tape.gradient([(e.potential, S.One)], [*names, *q], frozenset(names))
        drag = tape.gradient([(e.dissipation, S.One)], [*speeds, *qd], frozenset(speeds))
        loads = dict(zip(q, e.forces, strict=True))
        n = len(names)
        at_points = [
            tape.total([loads.get(name, S.Zero), V.minus(tape.define(p / factor)), V.minus(r)])
            for (factor, _), name, p, r in zip(places, names, gradient[:n], drag[:n], strict=True)
        ]
        on_coordinates = [
            S.Zero if x in names else tape.total([loads[x], V.minus(p), V.minus(r)])
            for x, p, r in zip(q, gradient[n:], drag[n:], strict=True)
        ]
        return at_points, on_coordinates

    def _accelerations_without_multipliers(self, forces: Sequence[Expr]) -> list[Expr]:
        """Return B (M^-1 F - ddd): the part of edd without multipliers and generalized forces."""
        tape, free = self.tape, []
        for point, force, terms in zip(self.points, forces, self.driven, strict=True):
            rates = tape.forward(tape.forward(list(terms), {t: S.One}), {t: S.One})
            drift = [
                self.vectors.minus(tape.times(c, r))
                for c, r in zip(terms.values(), rates, strict=True)
            ]
            free.append(tape.total([tape.define(force / point.mass), *drift]))
        return [tape.total([tape.times(b, free[k]) for k, b in row.items()]) for row in self.B]

    def _flexibility(self) -> tuple[dict[tuple[int, int], Expr], Expr]:
        """Return the nonzero entries of T/unit, T = B M^-1 B^T, and the common factor `unit`."""
        tape = self.tape
        inverse_masses = [tape.define(1 / p.mass) for p in self.points]
        increments_of: dict[int, list[int]] = {}  # increments by point
        for a, row in enumerate(self.B):
            for k in row:
                increments_of.setdefault(k, []).append(a)
        parts: dict[tuple[int, int], list[Expr]] = {}
        for k, increments in increments_of.items():
            for a, b in product(increments, repeat=2):
                product_ = tape.times(self.B[a][k], self.B[b][k])
                parts.setdefault((a, b), []).append(tape.times(product_, inverse_masses[k]))
        T = {place: x for place, xs in parts.items() if (x := tape.total(xs)) != 0}
        units = {split(x)[1] for x in T.values()}
        factor = units.pop() if len(units) == 1 else None
        if factor is None:
            return T, S.One
        return {place: split(x)[0] for place, x in T.items()}, factor

    def _product(self, g: int, x: Vector, h: int, y: Vector) -> Expr:
        """Return x . T y/unit for a row x of group g and a row y of group h."""
        V = self.vectors
        rows, columns = self.groups[g].members, self.groups[h].members
        T = [[self.T.get((a, b), S.Zero) for b in columns] for a in rows]
        if len(rows) == len(columns):  # most masses are the same in all directions
            first, size = T[0][0], range(len(rows))
            if all(T[i][j] == (first if i == j else 0) for i, j in product(size, size)):
                return self.tape.times(first, V.dot(x, y))
        return V.dot(x, [V.dot(row, y) for row in T])

    # --- the multipliers -------------------------------------------------------------------------

    def solution(self) -> Solution:
        """Return qdd. Its pivots are those of S and all quantities that were divided by."""
        V = self.vectors
        tape, groups, near = self.tape, self.groups, self.near
        forces, loads = self._forces()
        free = self._accelerations_without_multipliers(forces)
        coordinates_of = self._coordinates_of_angles()
        slopes = [g.slopes for g in groups]
        squares = [V.dot(u, u) for u in slopes]
        angle_forces = [
            tape.define(self.unit * load / square)
            for load, square in zip(self._on_angles(coordinates_of, loads), squares, strict=True)
        ]
        rows = [(g, n) for g, group in enumerate(groups) for n in group.perpendicular]

        def known_part(g: int, x: Vector) -> list[Expr]:
            """Return x . edd for a row x of group g, without the terms of the unknown multipliers.

            edd are the second time derivatives of the group's increments.
            """
            force_terms = [
                tape.times(self._product(g, x, h, slopes[h]), force)
                for h, force in enumerate(angle_forces)
                if force != 0 and (g, h) in near
            ]
            return [V.dot(x, [free[a] for a in groups[g].members]), *force_terms]

        matrix = tuple(
            tuple(self._product(g, x, h, y) if (g, h) in near else S.Zero for h, y in rows)
            for g, x in rows
        )
        rhs = [
            tape.total([V.dot(x, groups[g].beta), *map(V.minus, known_part(g, x))]) for g, x in rows
        ]
        solved = solve(
            tape, matrix, rhs, opaque=tape.opaque, short_chains=prefer_short_chains(self.system)
        )
        angle_accelerations = []
        for g, (u, square) in enumerate(zip(slopes, squares, strict=True)):
            multiplier_terms = [
                tape.times(self._product(g, u, h, y), multiplier)
                for (h, y), multiplier in zip(rows, solved.acceleration, strict=True)
                if (g, h) in near
            ]
            terms = [*multiplier_terms, *known_part(g, u), V.minus(V.dot(u, groups[g].beta))]
            angle_accelerations.append(tape.define(tape.total(terms) / square))
        acceleration = tuple(
            tape.total([tape.scaled(c, x) for c, x in zip(row, angle_accelerations, strict=True)])
            for row in coordinates_of
        )
        names = [max(k for k, c in enumerate(groups[g].direction) if c != 0) for g, _ in rows]
        by_row = tuple(names[k] for k in solved.order)
        return Solution(tape, acceleration, by_row, (*solved.pivots, *self._nonzero()), "S")

    def _on_angles(self, coordinates_of: Sequence[Vector], loads: Sequence[Expr]) -> list[Expr]:
        """Convert generalized forces on coordinates to forces on the angles."""
        return [
            self.tape.total([self.tape.scaled(c, x) for c, x in zip(column, loads, strict=True)])
            for column in zip(*coordinates_of, strict=True)
        ]

    def _coordinates_of_angles(self) -> list[Vector]:
        """Return the matrix that gives coordinates from angles: the inverse of the directions."""
        n = len(self.groups)
        rows = [[QQ(int(c.p), int(c.q)) for c in g.direction] for g in self.groups]
        try:
            inverse = DomainMatrix(rows, (n, n), QQ).inv()
        except DMNonInvertibleMatrixError:
            raise UnsuitedError("the angles do not determine the coordinates") from None
        return [tuple(inverse.to_Matrix().row(i)) for i in range(n)]

    def _nonzero(self) -> Pairs:
        """Return what must be positive: the masses, and squares of the parameters that are divided
        by.
        """
        tape = self.tape
        values = [p.mass for p in self.points] + [tape.times(x, x) for x in self.divisors]
        return tuple((x, x) for x in dict.fromkeys(values) if not x.is_number)
