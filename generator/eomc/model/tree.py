"""A tree of elementary joints, and frames on it, for the recursive derivation of the equations."""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, S, Symbol

from eomc.model.rational import ZERO, Matrix, Vector


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
