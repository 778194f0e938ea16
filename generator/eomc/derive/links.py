"""Frames of a tree's links on a tape: joint rotations, offsets and transformations of vectors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import sympy
from sympy import Expr, S, Symbol

from eomc.base.spatial import transposed
from eomc.derive.tape import Tape
from eomc.derive.vectors import AXES, ZERO, Vector, Vectors
from eomc.model.rational import Matrix
from eomc.model.tree import Tree


class Links(Vectors):
    """The links of a tree on a tape, parents before children."""

    def __init__(self, tape: Tape, tree: Tree) -> None:
        super().__init__(tape)
        self.links = tree.links
        self.n = len(tree.links)
        # joint displacement s_k(q), its rate, its second derivative at qdd = 0, and ds_k/dq
        rates = dict(tree.rates)
        self.moved = [self.define(x.q) for x in self.links]
        self.speed = tape.forward(self.moved, rates)
        self.drift = tape.forward(self.speed, rates)
        self.slopes = [
            {q: tape.forward([moved], {q: S.One})[0] for q in rates if q in x.q.free_symbols}
            for x, moved in zip(self.links, self.moved, strict=True)
        ]
        pairs = [*zip(self.links, self.moved, strict=True)]
        self.cosine = [self.define(sympy.cos(s)) if x.turns else S.One for x, s in pairs]
        self.sine = [self.define(sympy.sin(s)) if x.turns else S.Zero for x, s in pairs]
        self.rotation: list[Matrix] = [
            tuple(self.vector(row) for row in x.rotation)  # type: ignore[misc]
            for x in self.links
        ]
        self.arm = [self._arm(k) for k in range(self.n)]

    # --- joints and coordinates ------------------------------------------------------------------

    @property
    def plain(self) -> bool:
        """Whether each joint has a coordinate of its own."""
        coordinates = {link.q for link in self.links if link.q.is_Symbol}
        return len(coordinates) == self.n

    def projected(self, by_link: Iterable[Expr]) -> dict[Symbol, Expr]:
        """Convert forces along joints to generalized forces: sum_k ds_k/dq f_k."""
        terms: dict[Symbol, list[Expr]] = {}
        for slopes, force in zip(self.slopes, by_link, strict=True):
            for q, slope in slopes.items():
                terms.setdefault(q, []).append(self.times(slope, force))
        return {q: self.add(*forces) for q, forces in terms.items()}

    def by_link(self, direction: Mapping[Symbol, Expr]) -> list[Expr]:
        """Convert a direction of the coordinates to one of the joints: sum_q ds_k/dq v_q."""
        return [
            self.add(*(self.times(slope, direction[q]) for q, slope in slopes.items()))
            for slopes in self.slopes
        ]

    # --- frames ----------------------------------------------------------------------------------

    def turn(self, k: int, v: Vector, back: bool = False) -> Vector:
        """Rotate a vector of link k's frame by the joint's angle; by the negative angle with
        `back`.
        """
        if not self.links[k].turns:
            return v
        c, s = self.cosine[k], self.sine[k]
        i, j = AXES[self.links[k].axis]
        out = list(v)
        up, down = self.times(s, v[i]), self.times(s, v[j])
        out[i] = self.add(self.times(c, v[i]), down if back else self.minus(down))
        out[j] = self.add(self.minus(up) if back else up, self.times(c, v[j]))
        return (out[0], out[1], out[2])

    def inwards(self, k: int, v: Vector) -> Vector:
        """Transform a vector from link k's frame to its parent's frame."""
        return self.apply(self.rotation[k], self.turn(k, v))

    def outwards(self, k: int, v: Vector) -> Vector:
        """Transform a vector from the parent's frame to link k's frame."""
        return self.turn(k, self.apply(transposed(self.rotation[k]), v), back=True)

    def _arm(self, k: int) -> Vector:
        """Return the vector from the parent's origin to link k's, in the parent's frame."""
        link = self.links[k]
        offset = self.vector(link.offset)
        if link.turns:
            return offset
        slide = tuple(self.times(row[link.axis], self.moved[k]) for row in self.rotation[k])
        return self.plus(offset, slide)

    def on_axis(self, k: int, x: Expr) -> Vector:
        """Return the vector of length x along link k's joint axis."""
        v = list(ZERO)
        v[self.links[k].axis] = x
        return (v[0], v[1], v[2])

    def angular_velocities(self, rates: Sequence[Expr]) -> list[Vector]:
        """Return the angular velocity of each link in its own frame."""
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            w = self.outwards(k, out[link.parent]) if link.parent >= 0 else ZERO
            out.append(self.plus(w, self.on_axis(k, rates[k])) if link.turns else w)
        return out

    def velocities(self, rates: Sequence[Expr], spin: Sequence[Vector]) -> list[Vector]:
        """Return the velocity of each link's origin in its own frame. spin: the angular
        velocities.
        """
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            v = ZERO
            if (p := link.parent) >= 0:
                v = self.plus(out[p], self.cross(spin[p], self.arm[k]))
            v = self.outwards(k, v)
            out.append(v if link.turns else self.plus(v, self.on_axis(k, rates[k])))
        return out
