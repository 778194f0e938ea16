"""Bodies that hang from one another by joints, seen from a body that they all hang from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import sympy
from sympy import Expr, S

from eomc.base import spatial
from eomc.base.spatial import apply, plus, product, scaled, transposed
from eomc.model import rational
from eomc.model.rational import ONE, ZERO, Matrix, Vector
from eomc.scene.assembly import WORLD

Named = Callable[[str, Vector, Matrix], tuple[Vector, Matrix]]  # a body's place, by names


@dataclass(frozen=True)
class Step:
    """From a parent's frame to a body's: where the joint is, and what it moves by.

    angle: of the rotation, in the plane. motions: of each what it is, its axis, by how much.
    """

    parent: str
    offset: Vector
    rotation: Matrix
    angle: Expr
    motions: tuple[tuple[str, Sequence[float], Expr], ...]


@dataclass
class Chains:
    """The steps to all bodies that are held by joints."""

    plane: bool
    steps: dict[str, Step] = field(default_factory=dict)

    def path(self, name: str) -> list[str]:
        """Return the body and its ancestors connected by joints, then the world."""
        path = [name]
        while path[-1] in self.steps:
            path.append(self.steps[path[-1]].parent)
        return path if path[-1] == WORLD else [*path, WORLD]

    def common(self, one: str, other: str) -> str:
        """Return the closest common ancestor of two bodies, or the world if that does not move.

        The relative pose of the two bodies does not depend on the motion of the ancestor.
        """
        others = self.path(other)
        ancestor = next(name for name in self.path(one) if name in others)
        moves = any(self.steps[name].motions for name in self.path(ancestor) if name in self.steps)
        return ancestor if moves else WORLD

    def relative_pose(self, name: str, base: str, named: Named) -> tuple[Vector, Matrix]:
        """Return the position and rotation of a body in the frame of one of its ancestors."""
        at, R, angle, path = ZERO, ONE, S.Zero, self.path(name)
        for body in reversed(path[: path.index(base)]):
            step = self.steps[body]
            at = plus(at, apply(R, step.offset))
            R, angle = product(R, step.rotation), angle + step.angle
            for motion, axis, by in step.motions:
                k, aligned = rational.aligned_with(axis)
                if motion == "t":
                    x, y, z = map(S, rational.unit(axis))
                    at = plus(at, scaled(apply(R, (x, y, z)), by))
                elif self.plane:
                    angle = angle + by
                    R = rotation_about(2, angle)
                else:
                    turn = product(product(aligned, rotation_about(k, by)), transposed(aligned))
                    R = product(R, turn)
            at, R = named(body, at, R)
        return at, R


def rotation_about(axis: int, angle: Expr) -> Matrix:
    """Return the rotation about a coordinate axis, from the rotated frame to the original one."""
    return spatial.about_axis(axis, sympy.cos(angle), sympy.sin(angle))
