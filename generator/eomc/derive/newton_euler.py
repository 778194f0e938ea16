"""Recursive Newton-Euler and composite-body algorithms on a tape, in the links' own frames.

Zeros and numbers that are known at generation time vanish on the tape, so the plane, parallel axes
and massless links need no code of their own. With all qdd = 0, one outward pass computes the
velocities, accelerations and forces of each link (Newton and Euler). Then

- bias: these forces are summed inwards and projected onto the joints;
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
from eomc.derive.links import AXES, ZERO, Links, Vector
from eomc.derive.tape import Tape
from eomc.model.rational import Matrix
from eomc.model.tree import Link, Tree


@dataclass(frozen=True)
class Inertia:
    """Mass, first moment and inertia tensor of a link about the origin of a frame.

    A parameter of a link that has the same effect on the motion as a parameter of the parent link
    is added to the parent (grouping by Gautier and Khalil).

    Attributes
    ----------
    mass : Expr
        Mass (kg).
    moment : Vector
        Mass times the position of the centre of mass (kg m).
    inertia : mapping
        Entries (i, j), i <= j, of the symmetric inertia tensor (kg m^2); absent entries are 0.
    """

    mass: Expr
    moment: Vector
    inertia: Mapping[tuple[int, int], Expr]

    def entry(self, i: int, j: int) -> Expr:
        """Return the entry (i, j) of the inertia tensor."""
        return self.inertia.get((min(i, j), max(i, j)), S.Zero)

    @property
    def tensor(self) -> list[list[Expr]]:
        """The 3 x 3 inertia tensor by rows."""
        return [[self.entry(i, j) for j in range(3)] for i in range(3)]

    def is_zero(self) -> bool:
        """Return True if mass, first moment and inertia tensor are zero."""
        return self.mass == 0 and self.moment == ZERO and not any(self.inertia.values())


@dataclass
class _Forces:
    """Force on each link and moment about its origin, in its own frame."""

    force: list[Vector]
    moment: list[Vector]


class Recursion(Links):
    """A kinematic tree of links, with methods that return its dynamics as symbolic expressions.

    Expressions are defined on a tape, a list of elementary operations with named results. The
    recursive Newton-Euler algorithm gives bias, gravity forces and inverse dynamics. The
    composite-body algorithm gives the mass matrix. A force along a joint is in N, or in N m for a
    revolute joint.

    Attributes
    ----------
    gravity : Vector
        Acceleration of gravity in the world's axes (m/s^2).
    armature
        For each link, the inertia of its drive's rotor along the joint (kg m^2 or kg).
    inertia : list of Inertia
        For each link, its inertial parameters after grouping, see `Inertia`.
    fixed_moment : Vector
        First moment (kg m) of mass that is fixed in the world.
    """

    def __init__(self, tape: Tape, tree: Tree) -> None:
        super().__init__(tape, tree)
        self.gravity = self.vector(tree.gravity)
        self.fixed_moment = self.vector(
            tree.fixed_moment
        )  # first moment of mass fixed in the world
        self.armature = [self.define(x.armature) for x in self.links]
        self.inertia = self._grouped()

    # --- inertial parameters ---------------------------------------------------------------------

    def _link_inertia(self, link: Link) -> Inertia:
        """Return a link's inertia as given in the scene."""
        inertia = dict(zip(ENTRIES, map(self.define, link.inertia), strict=True))
        return Inertia(self.define(link.mass), self.vector(link.moment), inertia)

    def _sum(self, a: Inertia, b: Inertia) -> Inertia:
        """Return the sum of two inertias about the same origin in the same frame."""
        if a.is_zero() or b.is_zero():
            return a if b.is_zero() else b
        keys = sorted({*a.inertia, *b.inertia})
        return Inertia(
            self.add(a.mass, b.mass),
            self.plus(a.moment, b.moment),
            {k: self.add(a.inertia.get(k, S.Zero), b.inertia.get(k, S.Zero)) for k in keys},
        )

    def _grouped(self) -> list[Inertia]:
        """Group each link's inertial parameters: move those without a separate effect to the
        parent.

        Mass on the axis of a revolute joint, with equal moments of inertia across the axis and none
        about it, acts as if it belonged to the parent; so does the whole inertia tensor of a
        prismatic link. Gautier & Khalil, IEEE Trans. Robotics and Automation 6(3), 1990.
        """
        inertias = [self._link_inertia(link) for link in self.links]
        for k in reversed(range(self.n)):
            link, own = self.links[k], inertias[k]
            i, j = AXES[link.axis]
            a = link.axis
            if link.turns:
                across = own.entry(j, j)
                moved = Inertia(
                    own.mass, self.on_axis(k, own.moment[a]), {(i, i): across, (j, j): across}
                )
                moment = list(own.moment)
                moment[a] = S.Zero
                remaining = dict(own.inertia)
                remaining[i, i] = self.add(own.entry(i, i), self.minus(across))
                remaining[j, j] = S.Zero
                inertias[k] = Inertia(S.Zero, (moment[0], moment[1], moment[2]), remaining)
                at_parent = self._to_parent_frame(k, moved, rotated=False)
            else:
                inertias[k] = Inertia(own.mass, own.moment, {})
                moved = Inertia(S.Zero, ZERO, own.inertia)
                at_parent = self._rotate(self.rotation[k], moved)
            if link.parent >= 0:
                inertias[link.parent] = self._sum(inertias[link.parent], at_parent)
            else:
                self.fixed_moment = self.plus(self.fixed_moment, at_parent.moment)
        return inertias

    def _rotate(self, R: Matrix, x: Inertia) -> Inertia:
        """Return the inertia in a frame rotated by R: R I R^T and R h."""
        if all(R[i][j] == (i == j) for i in range(3) for j in range(3)):
            return x
        half = [self.apply(R, row) for row in x.tensor]  # (R I)^T, I symmetric
        columns = list(zip(*half, strict=True))
        pairs = combinations_with_replacement(range(3), 2)
        inertia = {(i, j): self.dot(R[j], columns[i]) for i, j in pairs}
        return Inertia(x.mass, self.apply(R, x.moment), inertia)

    def _to_parent_frame(self, k: int, x: Inertia, rotated: bool = True) -> Inertia:
        """Transform an inertia from link k's frame to its parent's frame and origin."""
        if rotated and self.links[k].turns:
            x = self._rotate_by_joint(k, x)
        x = self._rotate(self.rotation[k], x)
        r = self.arm[k]
        if r == ZERO:
            return x
        shift = self.scaled(r, x.mass)
        g = self.plus(x.moment, self.scaled(shift, S.Half))
        twice = self._double(self.dot(g, r))
        inertia = {}
        for i, j in combinations_with_replacement(range(3), 2):
            change = self.minus(self.add(self.times(g[i], r[j]), self.times(r[i], g[j])))
            inertia[i, j] = self.add(x.entry(i, j), change, twice if i == j else S.Zero)
        return Inertia(x.mass, self.plus(x.moment, shift), inertia)

    def _rotate_by_joint(self, k: int, x: Inertia) -> Inertia:
        """Rotate an inertia by joint k's angle."""
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
        """Return 2 x."""
        return self.tape.scaled(S(2), x)

    def half_turn(self, k: int, first: Expr, second: Expr, across: Expr) -> tuple[Expr, Expr]:
        """Return the two terms by which a rotation about joint k's axis changes a 2 x 2 matrix.

        The matrix is [[first, b], [b', second]], and across = b + b'. Let c and s be the cosine and
        sine of the joint's angle, e = s (first - second) + c across, and t = s e. The rotated
        matrix has the diagonal entries first - t and second + t. Its off-diagonal entries are those
        of the matrix plus c e - across.

        Returns
        -------
        t, c e : Expr
            The two terms, as atoms of the tape.
        """
        c, s = self.cosine[k], self.sine[k]
        e = self.add(self.times(s, self.add(first, self.minus(second))), self.times(c, across))
        return self.times(s, e), self.times(c, e)

    # --- outwards: velocities, accelerations, forces ---------------------------------------------

    def forces(
        self, rates: Sequence[Expr], joint_accelerations: Sequence[Expr], gravity: bool = True
    ) -> _Forces:
        """Return the force (N) and moment (N m) on each link that cause the given joint motions.

        Their components are in the link's own frame; the moment is about the origin of the frame.
        `rates` and `joint_accelerations` are the first and second time derivatives of the joint
        displacements. With `gravity`, the forces also support the weight of the links.
        """
        out = _Forces([], [])
        spin = self.angular_velocities(rates)
        alphas: list[Vector] = []
        origins: list[Vector] = []
        matrices: list[list[list[Expr]]] = []
        fall: Vector = self.scaled(self.gravity, S.NegativeOne) if gravity else ZERO
        for k, link in enumerate(self.links):
            p, r = link.parent, self.arm[k]
            alpha, acceleration = (alphas[p], origins[p]) if p >= 0 else (ZERO, fall)
            if p >= 0 and r != ZERO:
                acceleration = self.plus(acceleration, self.apply(matrices[p], r))
            alpha, acceleration = self.outwards(k, alpha), self.outwards(k, acceleration)
            parent_spin = self.outwards(k, spin[p]) if p >= 0 else ZERO
            relative = self.on_axis(k, rates[k])
            if link.turns:
                alpha = self.plus(
                    alpha,
                    self.cross(parent_spin, relative),
                    self.on_axis(k, joint_accelerations[k]),
                )
            else:
                coriolis = self.cross(parent_spin, relative)
                acceleration = self.plus(
                    acceleration,
                    self.scaled(coriolis, S(2)),
                    self.on_axis(k, joint_accelerations[k]),
                )
            alphas.append(alpha)
            origins.append(acceleration)
            squares = self._squares(spin[k])
            U = self._acceleration_matrix(alpha, squares)
            matrices.append(U)
            x = self.inertia[k]
            out.force.append(self.plus(self.scaled(acceleration, x.mass), self.apply(U, x.moment)))
            out.moment.append(self._moment(x, spin[k], alpha, acceleration, U))
        return out

    def _squares(self, w: Vector) -> dict[tuple[int, int], Expr]:
        """Return the products w_i w_j, i <= j."""
        pairs = combinations_with_replacement(range(3), 2)
        return {(i, j): self.times(w[i], w[j]) for i, j in pairs}

    def _acceleration_matrix(
        self, alpha: Vector, ww: Mapping[tuple[int, int], Expr]
    ) -> list[list[Expr]]:
        """Return U = [alpha] + [omega][omega]: a point at r has the acceleration a + U r."""
        U = [[S.Zero] * 3 for _ in range(3)]
        for a, (i, j) in enumerate(AXES):
            U[a][a] = self.minus(self.add(ww[i, i], ww[j, j]))
            product = ww[min(i, j), max(i, j)]
            U[i][j] = self.add(product, self.minus(alpha[a]))
            U[j][i] = self.add(product, alpha[a])
        return U

    def _moment(
        self, x: Inertia, w: Vector, alpha: Vector, acceleration: Vector, U: list[list[Expr]]
    ) -> Vector:
        """Return h x a + I alpha + omega x I omega, expressed by the entries of U."""
        moment_of_force = self.cross(x.moment, acceleration)
        out = []
        for a, (i, j) in enumerate(AXES):
            ww = self.times(w[i], w[j])
            out.append(
                self.add(
                    moment_of_force[a],
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
        """Return the force along each joint that is equivalent to the forces on the links.

        It is the sum of the `forces` on all links beyond the joint, projected onto the joint's
        axis.
        """
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
        """Return the bias C qd + g (Coriolis, centrifugal and gravity forces) along each joint."""
        return self._forces_for(self.drift)

    def inverse_dynamics(self, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return D qdd + C qd + g as the force along each joint.

        `joint_accelerations` is the second time derivative of each joint's displacement, without
        the part that depends on velocities alone; `by_link` computes it from qdd.
        """
        return self._forces_for(
            [self.add(*pair) for pair in zip(joint_accelerations, self.drift, strict=True)]
        )

    def gravity_forces(self) -> list[Expr]:
        """Return g, the forces along the joints that hold the tree at rest against gravity."""
        rest = [S.Zero] * self.n
        return self.joint_forces(self.forces(rest, rest))

    def mass_times(self, direction: Sequence[Expr]) -> list[Expr]:
        """Return the product D v as the force along each joint, without forming the mass matrix D.

        `direction` contains v by joint; `by_link` computes it from one entry for each coordinate.
        """
        forces = self.forces([S.Zero] * self.n, direction, gravity=False)
        return self._with_rotors(forces, direction)

    def _forces_for(self, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return the joint forces at the current rates for given total joint accelerations."""
        return self._with_rotors(self.forces(self.speed, joint_accelerations), joint_accelerations)

    def _with_rotors(self, forces: _Forces, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return the joint forces, including those that the armatures need."""
        terms = zip(self.joint_forces(forces), self.armature, joint_accelerations, strict=True)
        return [self.add(x, self.times(a, v)) for x, a, v in terms]

    # --- D by composite bodies -------------------------------------------------------------------

    def mass_matrix(self) -> list[list[Expr]]:
        """Return the mass matrix by the composite-body algorithm, with one row and column per link.

        Its coordinates are the displacements of the joints. An entry of two links on different
        branches of the tree is 0.
        """
        beyond = list(self.inertia)
        for k in reversed(range(self.n)):
            if (p := self.links[k].parent) >= 0:
                beyond[p] = self._sum(beyond[p], self._to_parent_frame(k, beyond[k]))
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
                projected = (moment if self.links[i].turns else force)[self.links[i].axis]
                D[k][i] = D[i][k] = projected
        return D

    def count_elimination_operations(self) -> int:
        """Return the number of operations to factor the mass matrix D and solve D x = b.

        Operations on entries that are zero, those of two links on different branches, do not count.
        """
        depth = [0] * self.n
        for k, link in enumerate(self.links):
            depth[k] = depth[link.parent] + 1 if link.parent >= 0 else 0
        return sum(a * a + 6 * a + 1 for a in depth)

    # --- energies --------------------------------------------------------------------------------

    def kinetic_energy(self) -> Expr:
        """Return the kinetic energy of the tree, including that of its armatures (J)."""
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
        """Return the potential energy of the tree in gravity (J): -g . sum(mass times position)."""
        mass = [x.mass for x in self.inertia]
        moment = [x.moment for x in self.inertia]
        total = self.fixed_moment
        for k in reversed(range(self.n)):
            moment_at_parent = self.plus(
                self.inwards(k, moment[k]), self.scaled(self.arm[k], mass[k])
            )
            if (p := self.links[k].parent) >= 0:
                mass[p] = self.add(mass[p], mass[k])
                moment[p] = self.plus(moment[p], moment_at_parent)
            else:
                total = self.plus(total, moment_at_parent)
        return self.minus(self.dot(self.gravity, total))
