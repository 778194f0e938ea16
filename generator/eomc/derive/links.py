"""The frames of a tree's links on a tape: sines, arms, vectors from one frame to the next."""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Expr, S

from eomc.base.spatial import transposed
from eomc.derive.tape import Tape
from eomc.derive.vectors import AXES, ZERO, Vector, Vectors
from eomc.model.exact import Matrix
from eomc.model.multibody import Link


class Links(Vectors):
    """Links on a tape, parents first."""

    def __init__(self, tape: Tape, links: Sequence[Link]) -> None:
        super().__init__(tape)
        self.links = links
        self.n = len(links)
        self.cosine = [self.define(sympy.cos(x.q)) if x.turns else S.One for x in links]
        self.sine = [self.define(sympy.sin(x.q)) if x.turns else S.Zero for x in links]
        self.rotation: list[Matrix] = [
            tuple(self.vector(row) for row in x.rotation)  # type: ignore[misc]
            for x in links
        ]
        self.arm = [self._arm(k) for k in range(self.n)]

    def turn(self, k: int, v: Vector, back: bool = False) -> Vector:
        """A vector of link k's frame in the joint's frame; `back`: the other way."""
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
        """A vector of link k's frame in its parent's frame."""
        return self.apply(self.rotation[k], self.turn(k, v))

    def outwards(self, k: int, v: Vector) -> Vector:
        """A vector of the parent's frame in link k's frame."""
        return self.turn(k, self.apply(transposed(self.rotation[k]), v), back=True)

    def _arm(self, k: int) -> Vector:
        """From the parent's origin to link k's, in the parent's frame."""
        link = self.links[k]
        offset = self.vector(link.offset)
        if link.turns:
            return offset
        slide = tuple(self.times(row[link.axis], link.q) for row in self.rotation[k])
        return self.plus(offset, slide)

    def on_axis(self, k: int, x: Expr) -> Vector:
        """A vector along link k's axis."""
        v = list(ZERO)
        v[self.links[k].axis] = x
        return (v[0], v[1], v[2])

    def rates(self) -> list[Expr]:
        """The joints' rates, by link."""
        return [link.qd for link in self.links]

    def angular_velocities(self, rates: Sequence[Expr]) -> list[Vector]:
        """omega of each link in its frame."""
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            w = self.outwards(k, out[link.parent]) if link.parent >= 0 else ZERO
            out.append(self.plus(w, self.on_axis(k, rates[k])) if link.turns else w)
        return out

    def velocities(self, rates: Sequence[Expr], spin: Sequence[Vector]) -> list[Vector]:
        """Those of each link's origin, in its frame. spin: the angular ones."""
        out: list[Vector] = []
        for k, link in enumerate(self.links):
            v = ZERO
            if (p := link.parent) >= 0:
                v = self.plus(out[p], self.cross(spin[p], self.arm[k]))
            v = self.outwards(k, v)
            out.append(v if link.turns else self.plus(v, self.on_axis(k, rates[k])))
        return out
