"""Recursive Newton-Euler and composite-body algorithms on a tape, in the frames of the links.

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

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import sympy
from sympy import Expr, S, Symbol

from eomc.base.spatial import ENTRIES, transposed
from eomc.derive.tape import Tape
from eomc.model.tree import Link, Matrix, Tree

Vector = tuple[Expr, Expr, Expr]

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
Rows = list[list[Expr]]

AXES = ((1, 2), (2, 0), (0, 1))  # for each axis, the other two in cyclic order


class Vectors:
    """Sums and products of numbers and vectors on a tape; terms that are zero are left out.

    A tape is a list of elementary operations, each with a named result. The arguments and results
    of the methods are atoms of the tape: numbers, names, or numbers times a name.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape

    def define(self, e: Expr) -> Expr:
        """Add an expression to the tape and return it as a number, a name, or a number times it."""
        return self.tape.define(e)

    def add(self, *terms: Expr) -> Expr:
        """Return the sum of the terms, 0 without terms."""
        return self.tape.total([x for x in terms if x is not S.Zero])

    def times(self, a: Expr, b: Expr) -> Expr:
        """Return the product a b of two atoms."""
        return S.Zero if a is S.Zero or b is S.Zero else self.tape.times(a, b)

    def minus(self, a: Expr) -> Expr:
        """Return -a, the negative of an atom."""
        return self.tape.scaled(S.NegativeOne, a)

    def vector(self, v: Sequence[Expr]) -> Vector:
        """Return the vector whose entries are the atoms of the three expressions v."""
        x, y, z = map(self.define, v)
        return (x, y, z)

    def plus(self, *vectors: Sequence[Expr]) -> Vector:
        """Return the sum of vectors, entry by entry."""
        x, y, z = (self.add(*parts) for parts in zip(*vectors, strict=True))
        return (x, y, z)

    def dot(self, a: Sequence[Expr], b: Sequence[Expr]) -> Expr:
        """Return the scalar product a . b."""
        return self.add(*(self.times(x, y) for x, y in zip(a, b, strict=True)))

    def cross(self, a: Sequence[Expr], b: Sequence[Expr]) -> Vector:
        """Return the vector product a x b."""
        x, y, z = (
            self.add(self.times(a[i], b[j]), self.minus(self.times(a[j], b[i]))) for i, j in AXES
        )
        return (x, y, z)

    def apply(self, R: Sequence[Sequence[Expr]], v: Sequence[Expr]) -> Vector:
        """Return the product R v of a 3 x 3 matrix, given by rows, and a vector."""
        x, y, z = (self.dot(row, v) for row in R)
        return (x, y, z)

    def scaled(self, v: Sequence[Expr], x: Expr) -> Vector:
        """Return the product x v of a vector and an atom."""
        a, b, c = (self.times(e, x) for e in v)
        return (a, b, c)


def symmetric_matrix(entry: Callable[[int, int], Expr]) -> Rows:
    """Return the symmetric 3 x 3 matrix with the given upper triangle."""
    rows = [[S.Zero] * 3 for _ in range(3)]
    for i, j in combinations_with_replacement(range(3), 2):
        rows[i][j] = rows[j][i] = entry(i, j)
    return rows


class LinkFrames:
    """Frames of the links of a kinematic tree, parents before children, as symbolic expressions.

    Expressions are defined on a tape, a list of elementary operations with named results. Link k
    moves relative to its parent by the displacement s_k(q) of its joint: it turns about the joint's
    axis by `links[k].angular` s_k (rad), and slides along it by `links[k].linear` s_k (m).

    Attributes
    ----------
    vectors : Vectors
        Sums and products on the tape.
    displacement, speed, drift
        For each link, s_k, its time derivative, and its second time derivative at qdd = 0.
    slopes
        For each link, the derivatives ds_k/dq by coordinate.
    angular, linear
        For each link, the motion subspace (angular e, linear e) with the unit vector e of the axis.
    cosine, sine
        For each link, the cosine and sine of the joint's angle; 1 and 0 for a prismatic joint.
    rotation
        For each link, the rotation matrix from its frame at s_k = 0 to its parent's frame.
    arm
        For each link, the vector from the parent's origin to its own, in the parent's frame.
    """

    def __init__(self, tape: Tape, tree: Tree) -> None:
        V = self.vectors = Vectors(tape)
        self.links = tree.links
        self.n = len(tree.links)
        # joint displacement s_k(q), its rate, its second derivative at qdd = 0, and ds_k/dq
        rates = dict(tree.rates)
        self.displacement = [V.define(x.q) for x in self.links]
        self.speed = tape.forward(self.displacement, rates)
        self.drift = tape.forward(self.speed, rates)
        self.slopes = [
            {q: tape.forward([moved], {q: S.One})[0] for q in rates if q in x.q.free_symbols}
            for x, moved in zip(self.links, self.displacement, strict=True)
        ]
        pairs = [*zip(self.links, self.displacement, strict=True)]
        self.angular = [x.angular for x in self.links]
        self.linear = [V.define(x.linear) for x in self.links]
        self.cosine = [V.define(sympy.cos(x.angular * s)) for x, s in pairs]
        self.sine = [V.define(sympy.sin(x.angular * s)) for x, s in pairs]
        self.rotation: list[Matrix] = [
            tuple(V.vector(row) for row in x.rotation)  # type: ignore[misc]
            for x in self.links
        ]
        self.arm = [self._arm(k) for k in range(self.n)]

    # --- joints and coordinates ------------------------------------------------------------------

    @property
    def has_own_coordinates(self) -> bool:
        """Whether each joint has a coordinate of its own: s_k = q_k."""
        coordinates = {link.q for link in self.links if link.q.is_Symbol}
        return len(coordinates) == self.n

    def project_forces(
        self, by_link: Iterable[Expr], slopes: Sequence[Mapping[Symbol, Expr]] | None = None
    ) -> dict[Symbol, Expr]:
        """Return the generalized force on each coordinate, from the force along each joint.

        `by_link` contains the force f_k (N) or moment (N m) along the joint of each link k. With
        the joint's displacement s_k, the generalized force on q is sum_k ds_k/dq f_k. `slopes` is
        used in place of ds_k/dq if it is given.
        """
        V = self.vectors
        terms: dict[Symbol, list[Expr]] = {}
        for slopes_of_link, force in zip(slopes or self.slopes, by_link, strict=True):
            for q, slope in slopes_of_link.items():
                terms.setdefault(q, []).append(V.times(slope, force))
        return {q: V.add(*forces) for q, forces in terms.items()}

    def joint_rates(self, direction: Mapping[Symbol, Expr]) -> list[Expr]:
        """Return the rate of each joint's displacement, from the rate of each coordinate.

        `direction` maps each coordinate q to its rate v_q. With the displacement s_k of the joint
        of link k, the result for link k is sum_q ds_k/dq v_q.
        """
        V = self.vectors
        return [
            V.add(*(V.times(slope, direction[q]) for q, slope in slopes.items()))
            for slopes in self.slopes
        ]

    # --- frames ----------------------------------------------------------------------------------

    def rotate(self, k: int, v: Vector, back: bool = False) -> Vector:
        """Return the vector `v`, given in link k's frame, rotated by the angle of the link's joint.

        With `back`, the vector is rotated by the negative angle. If the joint is prismatic, the
        vector is returned unchanged.
        """
        V = self.vectors
        if self.angular[k] == 0:
            return v
        c, s = self.cosine[k], self.sine[k]
        i, j = AXES[self.links[k].axis]
        out = list(v)
        up, down = V.times(s, v[i]), V.times(s, v[j])
        out[i] = V.add(V.times(c, v[i]), down if back else V.minus(down))
        out[j] = V.add(V.minus(up) if back else up, V.times(c, v[j]))
        return (out[0], out[1], out[2])

    def to_parent(self, k: int, v: Vector) -> Vector:
        """Return the components in the parent's frame of a vector given in link k's frame."""
        return self.vectors.apply(self.rotation[k], self.rotate(k, v))

    def from_parent(self, k: int, v: Vector) -> Vector:
        """Return the components in link k's frame of a vector given in its parent's frame."""
        return self.rotate(k, self.vectors.apply(transposed(self.rotation[k]), v), back=True)

    def _arm(self, k: int) -> Vector:
        """Return the vector from the parent's origin to link k's, in the parent's frame."""
        V = self.vectors
        link = self.links[k]
        distance = V.times(self.linear[k], self.displacement[k])
        slide = tuple(V.times(row[link.axis], distance) for row in self.rotation[k])
        return V.plus(V.vector(link.offset), slide)

    def on_axis(self, k: int, x: Expr) -> Vector:
        """Return the vector x e in link k's frame, where e is the unit vector of its joint axis."""
        v = list(ZERO)
        v[self.links[k].axis] = x
        return (v[0], v[1], v[2])

    def turn(self, k: int, rate: Expr) -> Vector:
        """Return the angular velocity S s of joint k in link k's frame, for its rate s."""
        return self.on_axis(k, self.vectors.times(self.angular[k], rate))

    def slide(self, k: int, rate: Expr) -> Vector:
        """Return the velocity S s of joint k in link k's frame, for its rate s."""
        return self.on_axis(k, self.vectors.times(self.linear[k], rate))

    def along_joint(self, k: int, force: Vector, moment: Vector) -> Expr:
        """Return the force S . f along joint k of a force and a moment in link k's frame."""
        V, axis = self.vectors, self.links[k].axis
        terms = ((self.angular[k], moment), (self.linear[k], force))
        return V.add(*(V.times(x, v[axis]) for x, v in terms))

    def angular_velocities(self, rates: Sequence[Expr]) -> list[Vector]:
        """Return the angular velocity of each link, in its own frame (rad/s).

        `rates` are the rates of the joints' displacements.
        """
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            w = self.from_parent(k, out[link.parent]) if link.parent >= 0 else ZERO
            out.append(self.vectors.plus(w, self.turn(k, rates[k])))
        return out

    def velocities(self, rates: Sequence[Expr], spin: Sequence[Vector]) -> list[Vector]:
        """Return the velocity of each link's origin, in the link's own frame (m/s).

        `rates` are the rates of the joints' displacements; `spin` are the angular velocities of the
        links, as `angular_velocities` returns them.
        """
        V = self.vectors
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            v = ZERO
            if (p := link.parent) >= 0:
                v = V.plus(out[p], V.cross(spin[p], self.arm[k]))
            v = self.from_parent(k, v)
            out.append(V.plus(v, self.slide(k, rates[k])))
        return out


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
    """Force on each link and moment about its origin, in its own frame.

    parent_motion: for each link, angular velocity and acceleration of its parent, and acceleration
    of the parent's point at the link's origin less that of gravity, in the link's frame.
    """

    force: list[Vector]
    moment: list[Vector]
    parent_motion: list[tuple[Vector, Vector, Vector]]


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
        self.inertia = self.group_inertias()

    # --- inertial parameters ---------------------------------------------------------------------

    def link_inertia(self, link: Link) -> Inertia:
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

    def group_inertias(self) -> list[Inertia]:
        """Group each link's inertial parameters: move those without a separate effect to the
        parent.

        Mass on the axis of a revolute joint, with equal moments of inertia across the axis and none
        about it, acts as if it belonged to the parent; so does the whole inertia tensor of a
        prismatic link. A link on a screw joint keeps its parameters. Gautier & Khalil, IEEE Trans.
        Robotics and Automation 6(3), 1990.
        """
        V, tree = self.vectors, self.tree
        inertias = [self.link_inertia(link) for link in self.links]
        for k in reversed(range(self.n)):
            link, own = self.links[k], inertias[k]
            i, j = AXES[link.axis]
            a = link.axis
            if link.angular != 0 and link.linear != 0:
                continue
            if link.angular != 0:
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
        if rotated and tree.angular[k] != 0:
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

    def matrix_to_parent(self, k: int, m: Rows, symmetric: bool = False) -> Rows:
        """Return R m R^T, where R is the rotation from link k's frame to its parent's."""
        V, tree = self.vectors, self.tree
        if tree.angular[k] != 0:
            m = self._rotate_matrix(k, m)
        R = tree.rotation[k]
        if all(R[i][j] == (i == j) for i in range(3) for j in range(3)):
            return m
        columns = list(zip(*(V.apply(R, row) for row in m), strict=True))  # columns of m R^T
        if symmetric:
            return symmetric_matrix(lambda i, j: V.dot(R[i], columns[j]))
        return [[V.dot(row, column) for column in columns] for row in R]

    def _rotate_matrix(self, k: int, m: Rows) -> Rows:
        """Return R m R^T, where R is the rotation by joint k's angle."""
        V = self.vectors
        i, j = AXES[self.links[k].axis]
        a = self.links[k].axis
        out = [list(row) for row in m]
        across = V.add(m[i][j], m[j][i])
        t, off = self.half_turn(k, m[i][i], m[j][j], across)
        change = V.add(off, V.minus(across))
        out[i][i], out[j][j] = V.add(m[i][i], V.minus(t)), V.add(m[j][j], t)
        out[i][j], out[j][i] = V.add(m[i][j], change), V.add(m[j][i], change)

        def rotated(x: Expr, y: Expr) -> tuple[Expr, Expr]:
            v = list(ZERO)
            v[i], v[j] = x, y
            v = list(self.tree.rotate(k, (v[0], v[1], v[2])))
            return v[i], v[j]

        out[a][i], out[a][j] = rotated(m[a][i], m[a][j])
        out[i][a], out[j][a] = rotated(m[i][a], m[j][a])
        return out

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
        out = _Forces([], [], [])
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
            out.parent_motion.append((parent_spin, alpha, acceleration))
            alpha = V.plus(
                alpha,
                V.cross(parent_spin, tree.turn(k, rates[k])),
                tree.turn(k, joint_accelerations[k]),
            )
            acceleration = V.plus(
                acceleration,
                V.scaled(V.cross(parent_spin, tree.slide(k, rates[k])), S(2)),
                tree.slide(k, joint_accelerations[k]),
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
            out[k] = tree.along_joint(k, f[k], n[k])
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
            turn, slide = tree.turn(k, S.One), tree.slide(k, S.One)
            inertia = (x.entry(0, a), x.entry(1, a), x.entry(2, a))
            moment = V.plus(V.scaled(inertia, tree.angular[k]), V.cross(x.moment, slide))
            force = V.plus(V.cross(turn, x.moment), V.scaled(slide, x.mass))
            D[k][k] = V.add(tree.along_joint(k, force, moment), self.armature[k])
            i = k
            while (p := self.links[i].parent) >= 0:
                force, moment = tree.to_parent(i, force), tree.to_parent(i, moment)
                moment = V.plus(moment, V.cross(tree.arm[i], force))
                i = p
                D[k][i] = D[i][k] = tree.along_joint(i, force, moment)
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
