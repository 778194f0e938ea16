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
from eomc.derive.links import AXES, ZERO, LinkFrames, Vector
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


class TreeDynamics:
    """Dynamics of a kinematic tree of links, as symbolic expressions.

    Expressions are defined on a tape, a list of elementary operations with named results. The
    recursive Newton-Euler algorithm gives bias, gravity forces and inverse dynamics. The
    composite-body algorithm gives the mass matrix. A force along a joint is in N, or in N m for a
    revolute joint.

    Attributes
    ----------
    tree : LinkFrames
        The frames of the links.
    vectors : Vectors
        Sums and products on the tape.
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
        self.tree = LinkFrames(tape, tree)
        self.vectors, self.links, self.n = self.tree.vectors, self.tree.links, self.tree.n
        V = self.vectors
        self.gravity = V.vector(tree.gravity)
        self.fixed_moment = V.vector(tree.fixed_moment)  # first moment of mass fixed in the world
        self.armature = [V.define(x.armature) for x in self.links]
        self.inertia = self._grouped()

    # --- inertial parameters ---------------------------------------------------------------------

    def _link_inertia(self, link: Link) -> Inertia:
        """Return a link's inertia as given in the scene."""
        V = self.vectors
        inertia = dict(zip(ENTRIES, map(V.define, link.inertia), strict=True))
        return Inertia(V.define(link.mass), V.vector(link.moment), inertia)

    def _sum(self, a: Inertia, b: Inertia) -> Inertia:
        """Return the sum of two inertias about the same origin in the same frame."""
        V = self.vectors
        if a.is_zero() or b.is_zero():
            return a if b.is_zero() else b
        keys = sorted({*a.inertia, *b.inertia})
        return Inertia(
            V.add(a.mass, b.mass),
            V.plus(a.moment, b.moment),
            {k: V.add(a.inertia.get(k, S.Zero), b.inertia.get(k, S.Zero)) for k in keys},
        )

    def _grouped(self) -> list[Inertia]:
        """Group each link's inertial parameters: move those without a separate effect to the
        parent.

        Mass on the axis of a revolute joint, with equal moments of inertia across the axis and none
        about it, acts as if it belonged to the parent; so does the whole inertia tensor of a
        prismatic link. Gautier & Khalil, IEEE Trans. Robotics and Automation 6(3), 1990.
        """
        V, tree = self.vectors, self.tree
        inertias = [self._link_inertia(link) for link in self.links]
        for k in reversed(range(self.n)):
            link, own = self.links[k], inertias[k]
            i, j = AXES[link.axis]
            a = link.axis
            if link.turns:
                across = own.entry(j, j)
                moved = Inertia(
                    own.mass, tree.on_axis(k, own.moment[a]), {(i, i): across, (j, j): across}
                )
                moment = list(own.moment)
                moment[a] = S.Zero
                remaining = dict(own.inertia)
                remaining[i, i] = V.add(own.entry(i, i), V.minus(across))
                remaining[j, j] = S.Zero
                inertias[k] = Inertia(S.Zero, (moment[0], moment[1], moment[2]), remaining)
                at_parent = self._to_parent_frame(k, moved, rotated=False)
            else:
                inertias[k] = Inertia(own.mass, own.moment, {})
                moved = Inertia(S.Zero, ZERO, own.inertia)
                at_parent = self._rotate(tree.rotation[k], moved)
            if link.parent >= 0:
                inertias[link.parent] = self._sum(inertias[link.parent], at_parent)
            else:
                self.fixed_moment = V.plus(self.fixed_moment, at_parent.moment)
        return inertias

    def _rotate(self, R: Matrix, x: Inertia) -> Inertia:
        """Return the inertia in a frame rotated by R: R I R^T and R h."""
        V = self.vectors
        if all(R[i][j] == (i == j) for i in range(3) for j in range(3)):
            return x
        half = [V.apply(R, row) for row in x.tensor]  # (R I)^T, I symmetric
        columns = list(zip(*half, strict=True))
        pairs = combinations_with_replacement(range(3), 2)
        inertia = {(i, j): V.dot(R[j], columns[i]) for i, j in pairs}
        return Inertia(x.mass, V.apply(R, x.moment), inertia)

    def _to_parent_frame(self, k: int, x: Inertia, rotated: bool = True) -> Inertia:
        """Transform an inertia from link k's frame to its parent's frame and origin."""
        V, tree = self.vectors, self.tree
        if rotated and self.links[k].turns:
            x = self._rotate_by_joint(k, x)
        x = self._rotate(tree.rotation[k], x)
        r = tree.arm[k]
        if r == ZERO:
            return x
        shift = V.scaled(r, x.mass)
        g = V.plus(x.moment, V.scaled(shift, S.Half))
        twice = self._double(V.dot(g, r))
        inertia = {}
        for i, j in combinations_with_replacement(range(3), 2):
            change = V.minus(V.add(V.times(g[i], r[j]), V.times(r[i], g[j])))
            inertia[i, j] = V.add(x.entry(i, j), change, twice if i == j else S.Zero)
        return Inertia(x.mass, V.plus(x.moment, shift), inertia)

    def _rotate_by_joint(self, k: int, x: Inertia) -> Inertia:
        """Rotate an inertia by joint k's angle."""
        V, tree = self.vectors, self.tree
        i, j = AXES[self.links[k].axis]
        a = self.links[k].axis
        inertia = dict(x.inertia)

        def put(p: int, q: int, e: Expr) -> None:
            inertia[min(p, q), max(p, q)] = e

        t, off = self.half_turn(k, x.entry(i, i), x.entry(j, j), self._double(x.entry(i, j)))
        put(i, i, V.add(x.entry(i, i), V.minus(t)))
        put(j, j, V.add(x.entry(j, j), t))
        put(i, j, V.add(off, V.minus(x.entry(i, j))))
        mixed = [S.Zero] * 3
        mixed[i], mixed[j] = x.entry(i, a), x.entry(j, a)
        mixed = list(tree.rotate(k, (mixed[0], mixed[1], mixed[2])))
        put(i, a, mixed[i])
        put(j, a, mixed[j])
        return Inertia(x.mass, tree.rotate(k, x.moment), inertia)

    def _double(self, x: Expr) -> Expr:
        """Return 2 x."""
        return self.vectors.tape.scaled(S(2), x)

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
        V, tree = self.vectors, self.tree
        c, s = tree.cosine[k], tree.sine[k]
        e = V.add(V.times(s, V.add(first, V.minus(second))), V.times(c, across))
        return V.times(s, e), V.times(c, e)

    # --- outwards: velocities, accelerations, forces ---------------------------------------------

    def forces(
        self, rates: Sequence[Expr], joint_accelerations: Sequence[Expr], gravity: bool = True
    ) -> _Forces:
        """Return the force (N) and moment (N m) on each link that cause the given joint motions.

        Their components are in the link's own frame; the moment is about the origin of the frame.
        `rates` and `joint_accelerations` are the first and second time derivatives of the joint
        displacements. With `gravity`, the forces also support the weight of the links.
        """
        V, tree = self.vectors, self.tree
        out = _Forces([], [])
        spin = tree.angular_velocities(rates)
        alphas: list[Vector] = []
        origins: list[Vector] = []
        matrices: list[list[list[Expr]]] = []
        fall: Vector = V.scaled(self.gravity, S.NegativeOne) if gravity else ZERO
        for k, link in enumerate(self.links):
            p, r = link.parent, tree.arm[k]
            alpha, acceleration = (alphas[p], origins[p]) if p >= 0 else (ZERO, fall)
            if p >= 0 and r != ZERO:
                acceleration = V.plus(acceleration, V.apply(matrices[p], r))
            alpha, acceleration = tree.from_parent(k, alpha), tree.from_parent(k, acceleration)
            parent_spin = tree.from_parent(k, spin[p]) if p >= 0 else ZERO
            relative = tree.on_axis(k, rates[k])
            if link.turns:
                alpha = V.plus(
                    alpha,
                    V.cross(parent_spin, relative),
                    tree.on_axis(k, joint_accelerations[k]),
                )
            else:
                coriolis = V.cross(parent_spin, relative)
                acceleration = V.plus(
                    acceleration,
                    V.scaled(coriolis, S(2)),
                    tree.on_axis(k, joint_accelerations[k]),
                )
            alphas.append(alpha)
            origins.append(acceleration)
            squares = self._squares(spin[k])
            U = self._acceleration_matrix(alpha, squares)
            matrices.append(U)
            x = self.inertia[k]
            out.force.append(V.plus(V.scaled(acceleration, x.mass), V.apply(U, x.moment)))
            out.moment.append(self._moment(x, spin[k], alpha, acceleration, U))
        return out

    def _squares(self, w: Vector) -> dict[tuple[int, int], Expr]:
        """Return the products w_i w_j, i <= j."""
        pairs = combinations_with_replacement(range(3), 2)
        return {(i, j): self.vectors.times(w[i], w[j]) for i, j in pairs}

    def _acceleration_matrix(
        self, alpha: Vector, ww: Mapping[tuple[int, int], Expr]
    ) -> list[list[Expr]]:
        """Return U = [alpha] + [omega][omega]: a point at r has the acceleration a + U r."""
        V = self.vectors
        U = [[S.Zero] * 3 for _ in range(3)]
        for a, (i, j) in enumerate(AXES):
            U[a][a] = V.minus(V.add(ww[i, i], ww[j, j]))
            product = ww[min(i, j), max(i, j)]
            U[i][j] = V.add(product, V.minus(alpha[a]))
            U[j][i] = V.add(product, alpha[a])
        return U

    def _moment(
        self, x: Inertia, w: Vector, alpha: Vector, acceleration: Vector, U: list[list[Expr]]
    ) -> Vector:
        """Return h x a + I alpha + omega x I omega, expressed by the entries of U."""
        V = self.vectors
        moment_of_force = V.cross(x.moment, acceleration)
        out = []
        for a, (i, j) in enumerate(AXES):
            ww = V.times(w[i], w[j])
            out.append(
                V.add(
                    moment_of_force[a],
                    V.times(x.entry(a, a), alpha[a]),
                    V.times(V.add(x.entry(j, j), V.minus(x.entry(i, i))), ww),
                    V.minus(V.times(x.entry(a, i), U[j][a])),
                    V.times(x.entry(a, j), U[i][a]),
                    V.times(x.entry(i, j), V.add(U[i][i], V.minus(U[j][j]))),
                )
            )
        return (out[0], out[1], out[2])

    # --- inwards: joint forces -------------------------------------------------------------------

    def joint_forces(self, forces: _Forces) -> list[Expr]:
        """Return the force along each joint that is equivalent to the forces on the links.

        It is the sum of the `forces` on all links beyond the joint, projected onto the joint's
        axis.
        """
        V, tree = self.vectors, self.tree
        f, n = list(forces.force), list(forces.moment)
        out: list[Expr] = [S.Zero] * self.n
        for k in reversed(range(self.n)):
            link = self.links[k]
            out[k] = (n if link.turns else f)[k][link.axis]
            if link.parent >= 0:
                force, moment = tree.to_parent(k, f[k]), tree.to_parent(k, n[k])
                f[link.parent] = V.plus(f[link.parent], force)
                n[link.parent] = V.plus(n[link.parent], moment, V.cross(tree.arm[k], force))
        return out

    def bias(self) -> list[Expr]:
        """Return the bias C qd + g (Coriolis, centrifugal and gravity forces) along each joint."""
        return self._forces_for(self.tree.drift)

    def inverse_dynamics(self, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return D qdd + C qd + g as the force along each joint.

        `joint_accelerations` is the second time derivative of each joint's displacement, without
        the part that depends on velocities alone; `LinkFrames.joint_rates` computes it from qdd.
        """
        pairs = zip(joint_accelerations, self.tree.drift, strict=True)
        return self._forces_for([self.vectors.add(*pair) for pair in pairs])

    def gravity_forces(self) -> list[Expr]:
        """Return g, the forces along the joints that hold the tree at rest against gravity."""
        rest = [S.Zero] * self.n
        return self.joint_forces(self.forces(rest, rest))

    def mass_times(self, direction: Sequence[Expr]) -> list[Expr]:
        """Return the product D v as the force along each joint, without forming the mass matrix D.

        `direction` contains v by joint; `LinkFrames.joint_rates` computes it from one entry for
        each coordinate.
        """
        forces = self.forces([S.Zero] * self.n, direction, gravity=False)
        return self._with_rotors(forces, direction)

    def _forces_for(self, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return the joint forces at the current rates for given total joint accelerations."""
        forces = self.forces(self.tree.speed, joint_accelerations)
        return self._with_rotors(forces, joint_accelerations)

    def _with_rotors(self, forces: _Forces, joint_accelerations: Sequence[Expr]) -> list[Expr]:
        """Return the joint forces, including those that the armatures need."""
        V = self.vectors
        terms = zip(self.joint_forces(forces), self.armature, joint_accelerations, strict=True)
        return [V.add(x, V.times(a, v)) for x, a, v in terms]

    # --- D by composite bodies -------------------------------------------------------------------

    def mass_matrix(self) -> list[list[Expr]]:
        """Return the mass matrix by the composite-body algorithm, with one row and column per link.

        Its coordinates are the displacements of the joints. An entry of two links on different
        branches of the tree is 0.
        """
        V, tree = self.vectors, self.tree
        beyond = list(self.inertia)
        for k in reversed(range(self.n)):
            if (p := self.links[k].parent) >= 0:
                beyond[p] = self._sum(beyond[p], self._to_parent_frame(k, beyond[k]))
        D: list[list[Expr]] = [[S.Zero] * self.n for _ in range(self.n)]
        for k, link in enumerate(self.links):
            x, a = beyond[k], link.axis
            if link.turns:
                moment = (x.entry(0, a), x.entry(1, a), x.entry(2, a))
                force = V.cross(tree.on_axis(k, S.One), x.moment)
            else:
                force = tree.on_axis(k, x.mass)
                moment = V.cross(x.moment, tree.on_axis(k, S.One))
            D[k][k] = V.add((moment if link.turns else force)[a], self.armature[k])
            i = k
            while (p := self.links[i].parent) >= 0:
                force, moment = tree.to_parent(i, force), tree.to_parent(i, moment)
                moment = V.plus(moment, V.cross(tree.arm[i], force))
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
        V, tree = self.vectors, self.tree
        rates = tree.speed
        spin = tree.angular_velocities(rates)
        terms: list[Expr] = []
        for k, v in enumerate(tree.velocities(rates, spin)):
            x, w = self.inertia[k], spin[k]
            momentum = V.apply(x.tensor, w)
            terms += [
                V.times(V.define(x.mass / 2), V.dot(v, v)),
                V.dot(v, V.cross(w, x.moment)),
                V.define(V.dot(w, momentum) / 2),
                V.define(self.armature[k] * rates[k] ** 2 / 2),
            ]
        return V.add(*terms)

    def potential_energy(self) -> Expr:
        """Return the potential energy of the tree in gravity (J): -g . sum(mass times position)."""
        V, tree = self.vectors, self.tree
        mass = [x.mass for x in self.inertia]
        moment = [x.moment for x in self.inertia]
        total = self.fixed_moment
        for k in reversed(range(self.n)):
            moment_at_parent = V.plus(tree.to_parent(k, moment[k]), V.scaled(tree.arm[k], mass[k]))
            if (p := self.links[k].parent) >= 0:
                mass[p] = V.add(mass[p], mass[k])
                moment[p] = V.plus(moment[p], moment_at_parent)
            else:
                total = V.plus(total, moment_at_parent)
        return V.minus(V.dot(self.gravity, total))
