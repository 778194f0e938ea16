"""Vectors in space and frames of the links of a tree, with atoms of a tape as entries.

The frames have joint rotations, offsets and transformations of vectors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import sympy
from sympy import Expr, S, Symbol

from eomc.base.spatial import transposed
from eomc.derive.tape import Tape
from eomc.model.rational import Matrix
from eomc.model.tree import Tree

Vector = tuple[Expr, Expr, Expr]

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
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


class LinkFrames:
    """Frames of the links of a kinematic tree, parents before children, as symbolic expressions.

    Expressions are defined on a tape, a list of elementary operations with named results. Link k
    moves relative to its parent by the displacement s_k(q) of its joint. This is an angle (rad)
    about the joint's axis if `links[k].turns`, else a length (m) along the axis.

    Attributes
    ----------
    vectors : Vectors
        Sums and products on the tape.
    displacement, speed, drift
        For each link, s_k, its time derivative, and its second time derivative at qdd = 0.
    slopes
        For each link, the derivatives ds_k/dq by coordinate.
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
        self.cosine = [V.define(sympy.cos(s)) if x.turns else S.One for x, s in pairs]
        self.sine = [V.define(sympy.sin(s)) if x.turns else S.Zero for x, s in pairs]
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

    def project_forces(self, by_link: Iterable[Expr]) -> dict[Symbol, Expr]:
        """Return the generalized force on each coordinate, from the force along each joint.

        `by_link` contains the force f_k (N) or moment (N m) along the joint of each link k. With
        the joint's displacement s_k, the generalized force on q is sum_k ds_k/dq f_k.
        """
        V = self.vectors
        terms: dict[Symbol, list[Expr]] = {}
        for slopes, force in zip(self.slopes, by_link, strict=True):
            for q, slope in slopes.items():
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
        if not self.links[k].turns:
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
        offset = V.vector(link.offset)
        if link.turns:
            return offset
        slide = tuple(V.times(row[link.axis], self.displacement[k]) for row in self.rotation[k])
        return V.plus(offset, slide)

    def on_axis(self, k: int, x: Expr) -> Vector:
        """Return the vector x e in link k's frame, where e is the unit vector of its joint axis."""
        v = list(ZERO)
        v[self.links[k].axis] = x
        return (v[0], v[1], v[2])

    def angular_velocities(self, rates: Sequence[Expr]) -> list[Vector]:
        """Return the angular velocity of each link, in its own frame (rad/s).

        `rates` are the rates of the joints' displacements.
        """
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            w = self.from_parent(k, out[link.parent]) if link.parent >= 0 else ZERO
            out.append(self.vectors.plus(w, self.on_axis(k, rates[k])) if link.turns else w)
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
            out.append(v if link.turns else V.plus(v, self.on_axis(k, rates[k])))
        return out
