"""Bodies, joints, springs and dampers of a scene: checked data. No SymPy, no C.

Every vector has three entries and every inertia six; in a plane scene those out of the plane are
zero. Formulas depend on numbers, constants and parameters, save where it is said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

from eomc.scene.formulas import Formula
from eomc.scene.joints import CLOSINGS, REACTIONS

WORLD = "world"  # the frame that does not move, as a parent and at the ends of springs

Vector = tuple[Formula, Formula, Formula]


@dataclass(frozen=True)
class Turn:
    """A rotation by `angle` (rad) about an axis, "x", "y" or "z", of the frame rotated so far."""

    axis: str
    angle: Formula


@dataclass(frozen=True)
class Body:
    """A rigid body, held by a joint in a tree or placed by formulas.

    parent: a body's name or "world". joint: a key of joints.JOINTS, with `coordinates` in its
    order, each one of the scene or a formula of these, and unit `axes` in the joint's frame, which
    stands at `offset` (m) in the parent's frame, rotated by `rotation`. The body's frame is the
    joint's frame, moved by the coordinates. A body
    placed by formulas has joint "", no parent, the `position` (m) of its centre of mass in the
    world and the `rotation` of its frame there; these depend on coordinates, t and definitions too.

    mass: kg. center: the centre of mass in the body's frame, m; zero where placed by formulas.
    inertia: Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass along the body's axes, kg m^2;
    the off-diagonal entries are those of the tensor, -sum m x y.
    armature (kg or kg m^2), damping (N s/m or N m s/rad), friction (N or N m; Coulomb's, smoothed
    as friction*tanh(rate/friction_width)) and actuator (a force along the coordinate, of all
    names): empty, or one a coordinate. A `point` is a body without mass on a fixed joint.
    """

    name: str
    mass: Formula
    inertia: tuple[Formula, Formula, Formula, Formula, Formula, Formula]
    center: Vector
    rotation: tuple[Turn, ...]
    parent: str = WORLD
    joint: str = ""
    coordinates: tuple[Formula, ...] = ()
    axes: tuple[tuple[float, float, float], ...] = ()
    offset: Vector | None = None
    position: Vector | None = None
    armature: tuple[Formula, ...] = ()
    damping: tuple[Formula, ...] = ()
    friction: tuple[Formula, ...] = ()
    friction_width: Formula | None = None
    actuator: tuple[Formula, ...] = ()
    note: str = ""
    point: bool = False


@dataclass(frozen=True, kw_only=True)
class Between:
    """What a spring or damper acts on: a coordinate, or points of two bodies, or their angles.

    coordinate: the coordinate it acts on, "" where it is between `bodies`; then `points` (m) are
    its ends in their frames (the world's for "world"). turning: it acts on the difference of two
    bodies' angles in the plane, of the second over the first, and there are no points.
    """

    coordinate: str = ""
    bodies: tuple[str, str] | None = None
    points: tuple[Vector, Vector] | None = None
    turning: bool = False


@dataclass(frozen=True, kw_only=True)
class Spring(Between):
    """stiffness: N/m or N m/rad. length: the rest length, or the rest angle or position."""

    stiffness: Formula
    length: Formula


@dataclass(frozen=True, kw_only=True)
class Damper(Between):
    """As a spring, with the force -damping times the rate. damping: N s/m or N m s/rad."""

    damping: Formula


@dataclass(frozen=True)
class Force:
    """What acts on a body: a force (N) at a `point` (m, in the body's frame) and a torque (N m).

    Formulas of all names, along the world's axes, or where `in_body` the body's.
    """

    body: str
    point: Vector
    force: Vector
    torque: Vector
    in_body: bool = False


@dataclass(frozen=True)
class Loop:
    """A joint that closes a tree of bodies, or a gear between two coordinates.

    joint: a key of joints.CLOSINGS. points (m) and axes (unit vectors) are in the frames of the
    first and the second of the `bodies`, "world" among them. rotation: how the second body's frame
    stands in the first's. length: m, of a distance. A gear holds the second of its `coordinates` at
    ratio times the first plus offset.
    """

    name: str
    joint: str
    bodies: tuple[str, ...] = ()
    points: tuple[Vector, ...] = ()
    axes: tuple[tuple[float, float, float], ...] = ()
    rotation: tuple[Turn, ...] = ()
    length: Formula | None = None
    coordinates: tuple[str, ...] = ()
    ratio: Formula | None = None
    offset: Formula | None = None
    note: str = ""

    def rows(self, plane: bool) -> dict[str, str]:
        """What it keeps at zero, and the name of the row of each."""
        kinds = CLOSINGS[self.joint].rows(plane)
        if len(kinds) == 1:
            return {kinds[0]: self.name}
        return {kind: f"{self.name}_{kind}" for kind in kinds}

    def reactions(self, plane: bool) -> tuple[str, ...]:
        """What outputs call the entries of its reaction; a gear has none."""
        parts = () if self.joint == "gear" else REACTIONS[plane]
        return tuple(f"{self.name}_{part}" for part in parts)


@dataclass(frozen=True)
class Assembly:
    """The bodies, parents before children, and what acts between them; gravity in m/s^2."""

    plane: bool
    gravity: Vector
    bodies: tuple[Body, ...]
    springs: tuple[Spring, ...] = ()
    dampers: tuple[Damper, ...] = ()
    forces: tuple[Force, ...] = ()
    loops: tuple[Loop, ...] = ()
