"""The tree of bodies that joints connect: its elementary joints, frames on it, and relative poses.

`Tree` and `BodyFrame` are data for the recursive derivation of the equations. `Chains` gives the
pose of a body relative to a body from which both of two bodies descend, for joints that close
loops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import sympy
from sympy import Expr, S, Symbol

from eomc.base import spatial
from eomc.base.spatial import apply, plus, product, scaled, transposed
from eomc.model import rational
from eomc.model.rational import ONE, ZERO, Matrix, Vector
from eomc.scene.assembly import WORLD


@dataclass(frozen=True)
class Link:
    """An elementary joint (one rotation or translation), its frame and the mass fixed in the frame.

    Attributes
    ----------
    name
        Name of the body to which the joint belongs.
    parent
        Index of the parent link; -1 for the world.
    turns
        True for a rotation, False for a translation.
    axis
        Coordinate axis (0, 1, 2) of the frame about which it turns or along which it slides.
    q
        Angle (rad) or displacement (m): a coordinate or an expression in coordinates.
    offset, rotation
        Position (m) and rotation matrix of the frame in the parent's frame for q = 0. The matrix
        transforms components of vectors from the frame to the parent's frame.
    mass, moment, inertia
        Mass, mass times centre of mass, and inertia (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the
        frame's origin, in the axes of the frame.
    armature
        Inertia of the joint's rotor: kg m^2, or kg for a translation.
    """

    name: str
    parent: int  # -1: the world
    turns: bool
    axis: int
    q: Expr
    offset: Vector
    rotation: Matrix
    mass: Expr = S.Zero
    moment: Vector = ZERO
    inertia: tuple[Expr, ...] = (S.Zero,) * 6
    armature: Expr = S.Zero


@dataclass(frozen=True)
class Tree:
    """A tree of elementary joints and the energies of all other parts of the system.

    Attributes
    ----------
    links
        Elementary joints; each parent comes before its children.
    rates
        Pairs (coordinate, velocity) of the coordinates that move the joints.
    gravity
        Acceleration of gravity in the world, in m/s^2.
    fixed_moment
        First moment (mass times centre of mass, kg m) of the bodies that are fixed in the world,
        for their potential energy.
    other_kinetic, other_potential
        Energies of the parts of the system that do not belong to the tree.
    """

    links: tuple[Link, ...]
    rates: tuple[tuple[Symbol, Symbol], ...]
    gravity: Vector
    fixed_moment: Vector
    other_kinetic: Expr = S.Zero
    other_potential: Expr = S.Zero


@dataclass(frozen=True)
class BodyFrame:
    """The frame of a body or of a point on a body.

    Attributes
    ----------
    name
        Name of the body or point.
    link
        Index of the link in whose frame it is fixed; -1 for the world.
    offset, rotation
        Position and rotation matrix in the frame of the link. For a body placed by formulas they
        are expressions in the coordinates, in the world.
    angle
        Rotation angle in rad in a planar scene, an expression that may use definitions.
    mass, inertia
        Mass, and inertia (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass, of a body placed
        by formulas; its frame is at its centre of mass. Zero for other bodies.
    """

    name: str
    link: int
    offset: Vector
    rotation: Matrix
    angle: Expr
    mass: Expr = S.Zero
    inertia: tuple[Expr, ...] = (S.Zero,) * 6


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
                    x, y, z = map(S, rational.unit_vector(axis))
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
    return spatial.elementary_rotation(axis, sympy.cos(angle), sympy.sin(angle))
