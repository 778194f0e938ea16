"""Bodies, joints, springs and dampers of a scene as checked data. Independent of SymPy and C.

Every vector has three components and every inertia six; in a plane scene, the components out of the
plane are zero. Formulas depend on numbers, constants and parameters unless stated otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

from eomc.scene.formulas import Formula
from eomc.scene.joints import CLOSINGS, REACTIONS

WORLD = "world"  # the inertial frame, as a parent or at the end of a spring

Vector = tuple[Formula, Formula, Formula]


@dataclass(frozen=True)
class Turn:
    """A rotation by `angle` (rad) about an axis, "x", "y" or "z", of the frame rotated so far."""

    axis: str
    angle: Formula


@dataclass(frozen=True)
class Body:
    """A rigid body, attached by a joint in a tree or placed by formulas.

    Attributes
    ----------
    parent : str
        Name of a body, or "world".
    joint : str
        Key of joints.JOINTS; "" if the body is placed by formulas.
    coordinates : tuple of Formula
        Displacement of each elementary motion of the joint (see joints.Joint): a coordinate of the
        scene, or a formula of coordinates. In rad or m.
    axes : tuple of vectors
        Unit vectors in the joint's frame.
    offset, rotation : vector in m, and tuple of Turn
        Pose of the joint's frame in the parent's frame. The body's frame is the joint's frame,
        moved by the coordinates. For a body placed by formulas, the rotation of its frame in the
        world.
    position : vector or None
        Centre of mass in the world, m, of a body placed by formulas. It and the rotation may then
        depend on coordinates, t and definitions.
    mass, center, inertia : Formula, vector and six Formulas
        kg; centre of mass in the body's frame, m; Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of
        mass along the body's axes, kg m^2. Off-diagonal elements are those of the tensor, -sum m x
        y.
    armature, damping, friction, actuator : tuple of Formula
        Empty, or one for each coordinate: kg or kg m^2; N s/m or N m s/rad; N or N m (Coulomb
        friction, smoothed as friction*tanh(rate/friction_width)); a force along the coordinate,
        which may use all names.
    point : bool
        True for a [[point]], a massless body on a fixed joint.
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
    """Where a spring or damper acts: along a coordinate, between two points, or between two angles.

    coordinate: name of the coordinate, "" if the element acts between two bodies. bodies: names of
    the two bodies. points: end of the element in the frame of each body, m. turning: True if the
    element acts on the angle of the second body minus that of the first, in the plane; then there
    are no points.
    """

    coordinate: str = ""
    bodies: tuple[str, str] | None = None
    points: tuple[Vector, Vector] | None = None
    turning: bool = False


@dataclass(frozen=True, kw_only=True)
class Spring(Between):
    """A linear spring.

    stiffness: N/m or N m/rad. length: rest length or rest position (m), or rest angle (rad).
    """

    stiffness: Formula
    length: Formula


@dataclass(frozen=True, kw_only=True)
class Damper(Between):
    """A linear damper, whose force is -damping times the rate. damping: N s/m or N m s/rad."""

    damping: Formula


@dataclass(frozen=True)
class Force:
    """A force (N) at a `point` (m, in the body's frame) and a torque (N m) on a body.

    Their components are formulas of all names, along the world's axes or, if `in_body`, the body's.
    """

    body: str
    point: Vector
    force: Vector
    torque: Vector
    in_body: bool = False


@dataclass(frozen=True)
class Loop:
    """A joint that closes a loop in a tree of bodies, or a gear between two coordinates.

    joint: key of joints.CLOSINGS. bodies: names of the two bodies, one of which may be "world".
    points: position of the joint in the frame of each body, m. axes: unit vector of its axis in the
    frame of each body. rotation: rotation of the second body's frame relative to the first one's.
    length: distance in m that a joint of kind "distance" keeps. coordinates, ratio, offset: a gear
    keeps the second coordinate at ratio times the first plus offset.
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
        """Return the names of the constraint equations of the joint, by kind of equation.

        The kinds, such as "x" or "rz", are those of `joints.Closing`. plane: True for a plane
        scene, False for a scene in space. A single equation has the name of the loop, several have
        names such as "<loop>_x".
        """
        kinds = CLOSINGS[self.joint].rows(plane)
        if len(kinds) == 1:
            return {kinds[0]: self.name}
        return {kind: f"{self.name}_{kind}" for kind in kinds}

    def reactions(self, plane: bool) -> tuple[str, ...]:
        """Return the names of the components of the joint's reaction force and moment in outputs.

        An example is "<loop>_force_x". plane: True for a plane scene. A gear has no reactions.
        """
        parts = () if self.joint == "gear" else REACTIONS[plane]
        return tuple(f"{self.name}_{part}" for part in parts)


@dataclass(frozen=True)
class Assembly:
    """The bodies of a scene and the springs, dampers, forces and loops between them.

    plane: True if the scene is plane. gravity: acceleration of gravity, m/s^2. bodies: ordered so
    that each parent precedes its children.
    """

    plane: bool
    gravity: Vector
    bodies: tuple[Body, ...]
    springs: tuple[Spring, ...] = ()
    dampers: tuple[Damper, ...] = ()
    forces: tuple[Force, ...] = ()
    loops: tuple[Loop, ...] = ()
