"""A tree of elementary joints, and the frames on it: what the recursions run along."""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, S, Symbol

from eomc.model.rational import ZERO, Matrix, Vector


@dataclass(frozen=True)
class Link:
    """An elementary joint and the mass that moves with it, in the frame that the joint moves.

    The frame stands at `offset` in the parent's frame, rotated by `rotation` (it takes vectors of
    the joint's frame to the parent's), and then turns about (`turns`) or slides along its own
    `axis` (0, 1, 2) by `q`, a coordinate or an expression in coordinates. mass, moment (mass times
    centre of mass) and inertia (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) are about the frame's origin.
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
    """Links, parents first, and the energies of all other parts of the system (other_*).

    fixed_moment: first moment of mass that is fixed in the world, for its potential energy. rates:
    coordinates of joints and their velocities.
    """

    links: tuple[Link, ...]
    rates: tuple[tuple[Symbol, Symbol], ...]
    gravity: Vector
    fixed_moment: Vector
    other_kinetic: Expr = S.Zero
    other_potential: Expr = S.Zero


@dataclass(frozen=True)
class Frame:
    """The frame of a body or a point: at `offset`, rotated by `rotation`, in that of its link.

    link -1: in the world, where a body placed by formulas has them in the coordinates, and its
    mass and inertia (as those of a link) about its centre, where its frame is. angle: in the plane,
    over definitions.
    """

    name: str
    link: int
    offset: Vector
    rotation: Matrix
    angle: Expr
    mass: Expr = S.Zero
    inertia: tuple[Expr, ...] = (S.Zero,) * 6
