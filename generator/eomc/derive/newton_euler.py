"""The recursive algorithms over a tape: a tree of bodies, joint by joint, in the links' own frames.

What is zero or a number at generation time folds away on the tape, so the plane, parallel axes
and links without mass need no code of their own. With all qdd = 0, one sweep outwards gives the
velocities, the accelerations and the forces that each link needs (Newton and Euler); then

- bias: those forces, summed inwards and projected on the joints;
- composite bodies: D from the inertia of everything beyond a joint.

articulated_body.py solves for the accelerations without D. Sources: Featherstone, *Rigid Body
Dynamics Algorithms*, ch. 5 and 6; Khalil & Dombre, *Modeling, Identification and Control of
Robots*, ch. 9 (the matrix U, the grouping of inertial parameters).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

from sympy import Expr, S

from eomc.base.spatial import ENTRIES
from eomc.derive.links import Links
from eomc.derive.tape import Tape
from eomc.derive.vectors import AXES, ZERO, Vector
from eomc.model.exact import Matrix
from eomc.model.tree import Link, Tree


@dataclass(frozen=True)
class Inertia:
    """Mass, its moment and its inertia (symmetric, by (i, j) with i <= j) about a frame's origin.

    As Gautier and Khalil group it: what a joint can't tell from its parent's is there.
    """

    mass: Expr
    moment: Vector
    inertia: Mapping[tuple[int, int], Expr]

    def entry(self, i: int, j: int) -> Expr:
        """I_ij"""
        return self.inertia.get((min(i, j), max(i, j)), S.Zero)

    @property
    def tensor(self) -> list[list[Expr]]:
        """I by rows."""
        return [[self.entry(i, j) for j in range(3)] for i in range(3)]

    def is_zero(self) -> bool:
        """Whether there is none at all."""
        return self.mass == 0 and self.moment == ZERO and not any(self.inertia.values())


@dataclass
class _Forces:
    """Force and moment about the origin that each link needs, in its frame."""

    force: list[Vector]
    moment: list[Vector]


class Recursion(Links):
    """A tree on a tape: grouped inertias and the sweeps."""

    def __init__(self, tape: Tape, tree: Tree) -> None:
        super().__init__(tape, tree)
        self.gravity = self.vector(tree.gravity)
        self.still = self.vector(tree.still)
        self.armature = [self.define(x.armature) for x in self.links]
        self.inertia = self._grouped()

    # --- inertial parameters ---------------------------------------------------------------------

    def _own(self, link: Link) -> Inertia:
        """What moves with a link, as it is."""
        inertia = dict(zip(ENTRIES, map(self.define, link.inertia), strict=True))
        return Inertia(self.define(link.mass), self.vector(link.moment), inertia)

    def _sum(self, one: Inertia, other: Inertia) -> Inertia:
        if one.is_zero() or other.is_zero():
            return one if other.is_zero() else other
        keys = sorted({*one.inertia, *other.inertia})
        return Inertia(
            self.add(one.mass, other.mass),
            self.plus(one.moment, other.moment),
            {k: self.add(one.inertia.get(k, S.Zero), other.inertia.get(k, S.Zero)) for k in keys},
        )

    def _grouped(self) -> list[Inertia]:
        """Each link's inertia without what makes no difference on it, which its parent gets.

        Mass on the axis of a turning link, with equal moments across it and none about it, moves
        as if it were the parent's; so does all inertia of a sliding link. Gautier & Khalil, IEEE
        Trans. Robotics and Automation 6(3), 1990.
        """
        own = [self._own(link) for link in self.links]
        for k in reversed(range(self.n)):
            link, mine = self.links[k], own[k]
            i, j = AXES[link.axis]
            a = link.axis
            if link.turns:
                across = mine.entry(j, j)
                given = Inertia(
                    mine.mass, self.on_axis(k, mine.moment[a]), {(i, i): across, (j, j): across}
                )
                moment = list(mine.moment)
                moment[a] = S.Zero
                kept = dict(mine.inertia)
                kept[i, i] = self.add(mine.entry(i, i), self.minus(across))
                kept[j, j] = S.Zero
                own[k] = Inertia(S.Zero, (moment[0], moment[1], moment[2]), kept)
                there = self._carried(k, given, rotated=False)
            else:
                own[k] = Inertia(mine.mass, mine.moment, {})
                given = Inertia(S.Zero, ZERO, mine.inertia)
                there = self._rotated(self.rotation[k], given)
            if link.parent >= 0:
                own[link.parent] = self._sum(own[link.parent], there)
            else:
                self.still = self.plus(self.still, there.moment)
        return own

    def _rotated(self, R: Matrix, x: Inertia) -> Inertia:
        """The same in a frame that R takes vectors to."""
        if all(R[i][j] == (i == j) for i in range(3) for j in range(3)):
            return x
        half = [self.apply(R, row) for row in x.tensor]  # (R I)^T, I symmetric
        columns = list(zip(*half, strict=True))
        pairs = combinations_with_replacement(range(3), 2)
        inertia = {(i, j): self.dot(R[j], columns[i]) for i, j in pairs}
        return Inertia(x.mass, self.apply(R, x.moment), inertia)

    def _carried(self, k: int, x: Inertia, rotated: bool = True) -> Inertia:
        """An inertia of link k, about its origin, in the parent's frame and about its origin."""
        if rotated and self.links[k].turns:
            x = self._by_angle(k, x)
        x = self._rotated(self.rotation[k], x)
        r = self.arm[k]
        if r == ZERO:
            return x
        shift = self.scaled(r, x.mass)
        g = self.plus(x.moment, self.scaled(shift, S.Half))
        twice = self._double(self.dot(g, r))
        inertia = {}
        for i, j in combinations_with_replacement(range(3), 2):
            more = self.minus(self.add(self.times(g[i], r[j]), self.times(r[i], g[j])))
            inertia[i, j] = self.add(x.entry(i, j), more, twice if i == j else S.Zero)
        return Inertia(x.mass, self.plus(x.moment, shift), inertia)

    def _by_angle(self, k: int, x: Inertia) -> Inertia:
        """Rotated by the joint's angle."""
        i, j = AXES[self.links[k].axis]
        a = self.links[k].axis
        inertia = dict(x.inertia)

        def put(p: int, q: int, e: Expr) -> None:
            inertia[min(p, q), max(p, q)] = e

        t, off = self.half_turn(k, x.entry(i, i), x.entry(j, j), self._double(x.entry(i, j)))
        put(i, i, self.add(x.entry(i, i), self.minus(t)))
        put(j, j, self.add(x.entry(j, j), t))
        put(i, j, self.add(off, self.minus(x.entry(i, j))))
        mixed = [S.Zero] * 3
        mixed[i], mixed[j] = x.entry(i, a), x.entry(j, a)
        mixed = list(self.turn(k, (mixed[0], mixed[1], mixed[2])))
        put(i, a, mixed[i])
        put(j, a, mixed[j])
        return Inertia(x.mass, self.turn(k, x.moment), inertia)

    def _double(self, x: Expr) -> Expr:
        return self.tape.scaled(S(2), x)

    def half_turn(self, k: int, first: Expr, second: Expr, across: Expr) -> tuple[Expr, Expr]:
        """(t, c e) of a rotated 2 x 2 matrix [[first, b], [b', second]], across = b + b'.

        With e = s (first - second) + c across, t = s e: first - t, second + t, and the entries off
        the diagonal change by c e - across.
        """
        c, s = self.cosine[k], self.sine[k]
        e = self.add(self.times(s, self.add(first, self.minus(second))), self.times(c, across))
        return self.times(s, e), self.times(c, e)

    # --- outwards: velocities, accelerations, forces ---------------------------------------------

    def forces(
        self, rates: Sequence[Expr], wishes: Sequence[Expr], gravity: bool = True
    ) -> _Forces:
        """What moves the links with the given rates and joint accelerations (`wishes`)."""
        out = _Forces([], [])
        spin = self.angular_velocities(rates)
        alphas: list[Vector] = []
        origins: list[Vector] = []
        matrices: list[list[list[Expr]]] = []
        fall: Vector = self.scaled(self.gravity, S.NegativeOne) if gravity else ZERO
        for k, link in enumerate(self.links):
            p, r = link.parent, self.arm[k]
            alpha, at = (alphas[p], origins[p]) if p >= 0 else (ZERO, fall)
            if p >= 0 and r != ZERO:
                at = self.plus(at, self.apply(matrices[p], r))
            alpha, at = self.outwards(k, alpha), self.outwards(k, at)
            turning = self.outwards(k, spin[p]) if p >= 0 else ZERO
            own = self.on_axis(k, rates[k])
            if link.turns:
                alpha = self.plus(alpha, self.cross(turning, own), self.on_axis(k, wishes[k]))
            else:
                twice = self.cross(turning, own)
                at = self.plus(at, self.scaled(twice, S(2)), self.on_axis(k, wishes[k]))
            alphas.append(alpha)
            origins.append(at)
            squares = self._squares(spin[k])
            U = self._acceleration_matrix(alpha, squares)
            matrices.append(U)
            x = self.inertia[k]
            out.force.append(self.plus(self.scaled(at, x.mass), self.apply(U, x.moment)))
            out.moment.append(self._moment(x, spin[k], alpha, at, U))
        return out

    def _squares(self, w: Vector) -> dict[tuple[int, int], Expr]:
        pairs = combinations_with_replacement(range(3), 2)
        return {(i, j): self.times(w[i], w[j]) for i, j in pairs}

    def _acceleration_matrix(
        self, alpha: Vector, ww: Mapping[tuple[int, int], Expr]
    ) -> list[list[Expr]]:
        """U = [alpha] + [omega][omega]: a point at r has the acceleration a + U r."""
        U = [[S.Zero] * 3 for _ in range(3)]
        for a, (i, j) in enumerate(AXES):
            U[a][a] = self.minus(self.add(ww[i, i], ww[j, j]))
            both = ww[min(i, j), max(i, j)]
            U[i][j] = self.add(both, self.minus(alpha[a]))
            U[j][i] = self.add(both, alpha[a])
        return U

    def _moment(
        self, x: Inertia, w: Vector, alpha: Vector, at: Vector, U: list[list[Expr]]
    ) -> Vector:
        """h x a + I alpha + omega x I omega, with the entries of U in it."""
        arm = self.cross(x.moment, at)
        out = []
        for a, (i, j) in enumerate(AXES):
            ww = self.times(w[i], w[j])
            out.append(
                self.add(
                    arm[a],
                    self.times(x.entry(a, a), alpha[a]),
                    self.times(self.add(x.entry(j, j), self.minus(x.entry(i, i))), ww),
                    self.minus(self.times(x.entry(a, i), U[j][a])),
                    self.times(x.entry(a, j), U[i][a]),
                    self.times(x.entry(i, j), self.add(U[i][i], self.minus(U[j][j]))),
                )
            )
        return (out[0], out[1], out[2])

    # --- inwards: joint forces -------------------------------------------------------------------

    def joint_forces(self, forces: _Forces) -> list[Expr]:
        """The forces along the joints, by link: the moments' and forces' own components."""
        f, n = list(forces.force), list(forces.moment)
        out: list[Expr] = [S.Zero] * self.n
        for k in reversed(range(self.n)):
            link = self.links[k]
            out[k] = (n if link.turns else f)[k][link.axis]
            if link.parent >= 0:
                force, moment = self.inwards(k, f[k]), self.inwards(k, n[k])
                f[link.parent] = self.plus(f[link.parent], force)
                n[link.parent] = self.plus(n[link.parent], moment, self.cross(self.arm[k], force))
        return out

    def bias(self) -> list[Expr]:
        """C qd + g, by link."""
        return self._moving(self.drift)

    def inverse_dynamics(self, wishes: Sequence[Expr]) -> list[Expr]:
        """D qdd + C qd + g, by link. wishes: the accelerations along the joints, qdd, by link."""
        return self._moving([self.add(*pair) for pair in zip(wishes, self.drift, strict=True)])

    def gravity_forces(self) -> list[Expr]:
        """g, by link."""
        rest = [S.Zero] * self.n
        return self.joint_forces(self.forces(rest, rest))

    def mass_times(self, direction: Sequence[Expr]) -> list[Expr]:
        """D v for a direction v, by link, without D."""
        forces = self.forces([S.Zero] * self.n, direction, gravity=False)
        return self._with_rotors(forces, direction)

    def _moving(self, faster: Sequence[Expr]) -> list[Expr]:
        return self._with_rotors(self.forces(self.speed, faster), faster)

    def _with_rotors(self, forces: _Forces, wishes: Sequence[Expr]) -> list[Expr]:
        """The forces along the joints, with those that armatures need."""
        found = zip(self.joint_forces(forces), self.armature, wishes, strict=True)
        return [self.add(x, self.times(a, v)) for x, a, v in found]

    # --- D by composite bodies -------------------------------------------------------------------

    def mass_matrix(self) -> list[list[Expr]]:
        """D, by links; zero between branches."""
        beyond = list(self.inertia)
        for k in reversed(range(self.n)):
            if (p := self.links[k].parent) >= 0:
                beyond[p] = self._sum(beyond[p], self._carried(k, beyond[k]))
        D: list[list[Expr]] = [[S.Zero] * self.n for _ in range(self.n)]
        for k, link in enumerate(self.links):
            x, a = beyond[k], link.axis
            if link.turns:
                moment = (x.entry(0, a), x.entry(1, a), x.entry(2, a))
                force = self.cross(self.on_axis(k, S.One), x.moment)
            else:
                force = self.on_axis(k, x.mass)
                moment = self.cross(x.moment, self.on_axis(k, S.One))
            D[k][k] = self.add((moment if link.turns else force)[a], self.armature[k])
            i = k
            while (p := self.links[i].parent) >= 0:
                force, moment = self.inwards(i, force), self.inwards(i, moment)
                moment = self.plus(moment, self.cross(self.arm[i], force))
                i = p
                along = (moment if self.links[i].turns else force)[self.links[i].axis]
                D[k][i] = D[i][k] = along
        return D

    def elimination(self) -> int:
        """Operations to factor D, which is zero between branches, and to solve with it."""
        depth = [0] * self.n
        for k, link in enumerate(self.links):
            depth[k] = depth[link.parent] + 1 if link.parent >= 0 else 0
        return sum(a * a + 6 * a + 1 for a in depth)

    # --- energies --------------------------------------------------------------------------------

    def kinetic_energy(self) -> Expr:
        """K of the tree."""
        rates = self.speed
        spin = self.angular_velocities(rates)
        terms: list[Expr] = []
        for k, v in enumerate(self.velocities(rates, spin)):
            x, w = self.inertia[k], spin[k]
            momentum = self.apply(x.tensor, w)
            terms += [
                self.times(self.define(x.mass / 2), self.dot(v, v)),
                self.dot(v, self.cross(w, x.moment)),
                self.define(self.dot(w, momentum) / 2),
                self.define(self.armature[k] * rates[k] ** 2 / 2),
            ]
        return self.add(*terms)

    def potential_energy(self) -> Expr:
        """P of the tree in gravity: -g . (sum of mass times position)."""
        mass = [x.mass for x in self.inertia]
        moment = [x.moment for x in self.inertia]
        total = self.still
        for k in reversed(range(self.n)):
            at = self.plus(self.inwards(k, moment[k]), self.scaled(self.arm[k], mass[k]))
            if (p := self.links[k].parent) >= 0:
                mass[p] = self.add(mass[p], mass[k])
                moment[p] = self.plus(moment[p], at)
            else:
                total = self.plus(total, at)
        return self.minus(self.dot(self.gravity, total))
