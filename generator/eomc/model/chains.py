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

# (name of a body, its position and rotation) -> the same pose in symbols defined for it
Named = Callable[[str, Vector, Matrix], tuple[Vector, Matrix]]


@dataclass(frozen=True)
class Step:
    """The transformation from the frame of a parent body to the frame of a body.

    Attributes
    ----------
    parent
        Name of the parent body.
    offset, rotation
        Position (m) and rotation matrix of the joint's frame in the parent's frame.
    angle
        Angle of `rotation` in rad, for a planar scene.
    motions
        Motions of the joint, as tuples (kind, axis, amount). kind: "t" for a translation, "r" for
        a rotation. axis: in the joint's frame. amount: in m or rad.
    """

    parent: str
    offset: Vector
    rotation: Matrix
    angle: Expr
    motions: tuple[tuple[str, Sequence[float], Expr], ...]


@dataclass
class Chains:
    """Kinematic chains of the bodies with joints.

    plane: whether the scene is planar. steps: transformation from the parent's frame to the
    body's frame, by the name of the body.
    """

    plane: bool
    steps: dict[str, Step] = field(default_factory=dict)

    def path(self, name: str) -> list[str]:
        """Return the names of a body and its ancestors, from the body to "world"."""
        path = [name]
        while path[-1] in self.steps:
            path.append(self.steps[path[-1]].parent)
        return path if path[-1] == WORLD else [*path, WORLD]

    def common(self, one: str, other: str) -> str:
        """Return the name of the closest common ancestor of two bodies.

        The result is "world" if this ancestor does not move. The relative pose of the two bodies
        does not depend on the motion of the ancestor.
        """
        others = self.path(other)
        ancestor = next(name for name in self.path(one) if name in others)
        moves = any(self.steps[name].motions for name in self.path(ancestor) if name in self.steps)
        return ancestor if moves else WORLD

    def relative_pose(self, name: str, base: str, named: Named) -> tuple[Vector, Matrix]:
        """Return the position (m) and rotation matrix of a body in the frame of an ancestor.

        name, base: names of the body and the ancestor. named: function that is called for each body
        on the path with the name, position and rotation of the body. It returns the position and
        rotation from which the next body's are computed. It may replace long expressions by symbols
        that it defines.
        """
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
    """Return the matrix of a rotation by `angle` (rad) about the coordinate axis 0, 1 or 2.

    The matrix transforms the components of a vector from the rotated frame to the original one.
    """
    return spatial.about_axis(axis, sympy.cos(angle), sympy.sin(angle))
