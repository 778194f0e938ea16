"""The tree of bodies that joints connect: its elementary joints, frames on it, and relative poses.

`Tree` and `BodyFrame` are data for the recursive derivation of the equations. `Chains` gives the
pose of a body relative to a body from which both of two bodies descend, for joints that close
loops. Numbers in vectors, rotations and unit axes are fractions of fifty digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mpmath
import sympy
from sympy import Expr, Rational, S, Symbol

from eomc.base import spatial
from eomc.base.spatial import apply, cross, matrix, plus, product, scaled, transposed
from eomc.scene.joints import MotionSubspace
from eomc.scene.scene import WORLD

Vector = spatial.Vector[Expr]
Matrix = spatial.Matrix[Expr]

DIGITS = 50  # decimal digits to which numbers are rounded
INTEGER_TOLERANCE = 10**40  # numbers closer than 1e-40 to an integer are rounded to it

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
ONE: Matrix = ((S.One, S.Zero, S.Zero), (S.Zero, S.One, S.Zero), (S.Zero, S.Zero, S.One))


def rounded_number(e: Expr) -> Expr:
    """Return a number as a fraction that is rounded to 50 digits.

    A number within 1e-40 of an integer is rounded to that integer. An expression that is not a
    number is returned unchanged.
    """
    if not e.is_number:
        return e
    if not e.is_Rational:
        e = Rational(str(e.evalf(DIGITS + 5)))
    whole = (2 * e.p + e.q) // (2 * e.q)
    if abs(e.p - whole * e.q) * INTEGER_TOLERANCE < e.q:
        return S(whole)
    if e.q > 10**DIGITS:
        with mpmath.workdps(DIGITS):
            e = Rational(mpmath.nstr(mpmath.mpf(e.p) / e.q, DIGITS))
    return e


def rounded_vector(v: Vector) -> Vector:
    """Return a copy of a vector with its numbers rounded to fractions of 50 digits.

    Entries that are not numbers are unchanged.
    """
    x, y, z = map(rounded_number, v)
    return (x, y, z)


def rounded_matrix(matrix: Matrix) -> Matrix:
    """Return a copy of a matrix with its numbers rounded to fractions of 50 digits.

    Entries that are not numbers are unchanged.
    """
    one, two, three = map(rounded_vector, matrix)
    return (one, two, three)


def unit_vector(axis: Sequence[float]) -> list[Expr]:
    """Return the unit vector along `axis` as fractions, normalised to 50 digits."""
    entries = [Rational(str(x)) for x in axis]
    with mpmath.workdps(DIGITS + 5):
        long = [mpmath.mpf(x.p) / x.q for x in entries]
        size = mpmath.sqrt(sum(x * x for x in long))
        return [rounded_number(Rational(mpmath.nstr(x / size, DIGITS + 5))) for x in long]


def aligned_with(axis: Sequence[float]) -> tuple[int, Matrix]:
    """Return (k, R): a coordinate axis k (0, 1 or 2) and a rotation matrix R with R e_k = `axis`.

    e_k is the unit vector along the coordinate axis k, and `axis` is normalised. R is exact to 50
    digits. In the frame rotated by R, the direction `axis` is therefore the coordinate axis k.
    """
    along = unit_vector(axis)
    for k, x in enumerate(along):
        if abs(x) == 1:
            half_turn = spatial.elementary_rotation((k + 1) % 3, S.NegativeOne, S.Zero)
            return k, ONE if x == 1 else half_turn
    # Gram-Schmidt, from the coordinate axis that is farthest from the axis
    far = min(range(3), key=lambda i: (abs(along[i]), i))
    first = [-along[far] * x for x in along]
    first[far] += 1
    size = sympy.sqrt(sum(x * x for x in first))
    a = [rounded_number((x / size).evalf(DIGITS + 5)) if x != 0 else S.Zero for x in first]
    return 2, transposed(matrix((a, rounded_vector(cross(along, a)), along)))


def rotation_about(axis: int, angle: Expr) -> Matrix:
    """Return the matrix of a rotation by `angle` (rad) about the coordinate axis 0, 1 or 2.

    The matrix transforms the components of a vector from the rotated frame to the original one.
    """
    return spatial.elementary_rotation(axis, sympy.cos(angle), sympy.sin(angle))


def rotation_about_vector(axis: Sequence[float], angle: Expr) -> Matrix:
    """Return the matrix of a rotation by `angle` (rad) about any axis, as `rotation_about` does."""
    k, aligned = aligned_with(axis)
    return product(product(aligned, rotation_about(k, angle)), transposed(aligned))


@dataclass(frozen=True)
class Link:
    """An elementary joint with one coordinate, its frame and the mass fixed in the frame.

    Attributes
    ----------
    name
        Name of the body to which the joint belongs.
    parent
        Index of the parent link; -1 for the world.
    axis
        Coordinate axis (0, 1, 2) of the frame about which it turns or along which it slides.
    angular, linear
        Its motion subspace S = (angular e, linear e), with the unit vector e of the axis: (1, 0)
        for a rotation, (0, 1) for a translation, (1, pitch in m/rad) for a screw.
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
    axis: int
    angular: Expr
    linear: Expr
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
        Motions of the joint, as pairs of a motion subspace in the joint's frame and a displacement
        in m or rad.
    """

    parent: str
    offset: Vector
    rotation: Matrix
    angle: Expr
    motions: tuple[tuple[MotionSubspace, Expr], ...]


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
            for (axis, angular, linear), by in step.motions:
                x, y, z = map(S, unit_vector(axis))
                at = plus(at, scaled(apply(R, (x, y, z)), linear * by))
                if angular and self.plane:
                    angle = angle + by
                    R = rotation_about(2, angle)
                elif angular:
                    R = product(R, rotation_about_vector(axis, by))
            at, R = named(body, at, R)
        return at, R
