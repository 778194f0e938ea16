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
    """One rotation in a sequence: by `angle` (rad) about an axis "x", "y" or "z".

    The axis is that of the frame as rotated by the preceding rotations.
    """

    axis: str
    angle: Formula


@dataclass(frozen=True)
class RigidBody:
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
        Position and rotation of the joint's frame in the parent's frame. The body's frame is the
        joint's frame, moved by the coordinates. For a body placed by formulas, `rotation` is the
        rotation of the body's frame in the world.
    position : vector or None
        Position of the centre of mass in the world in m, for a body placed by formulas. `position`
        and `rotation` of such a body may depend on coordinates, t and definitions.
    mass : Formula
        Mass in kg.
    center : vector
        Centre of mass in the body's frame in m.
    inertia : six Formulas
        Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass along the body's axes, in kg m^2.
        Off-diagonal elements are those of the tensor, such as Ixy = -sum m x y.
    armature : tuple of Formula
        Rotor inertia of the joint, in kg or kg m^2. This tuple and those below are empty or have
        one formula for each coordinate.
    damping : tuple of Formula
        Damping constant in N s/m or N m s/rad.
    friction : tuple of Formula
        Coulomb friction in N or N m, smoothed as friction*tanh(rate/friction_width).
    actuator : tuple of Formula
        Force or moment along the coordinate, as a formula that may use all names of the scene.
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
class SpringDamper:
    """A spring or damper: the place where it acts, a coordinate, two points or two angles.

    coordinate: name of the coordinate along which the element acts, "" if it acts between two
    bodies. bodies: names of the two bodies. points: position in m of each end of the element, in
    the frame of its body. turning: True, in the plane only, if the element acts on the angle of the
    second body minus the angle of the first; `points` is then empty.
    """

    coordinate: str = ""
    bodies: tuple[str, str] | None = None
    points: tuple[Vector, Vector] | None = None
    turning: bool = False


@dataclass(frozen=True, kw_only=True)
class Spring(SpringDamper):
    """A linear spring, whose force is -stiffness times its extension.

    stiffness: in N/m, or N m/rad for a spring on an angle. length: the rest length or rest position
    in m, or the rest angle in rad.
    """

    stiffness: Formula
    length: Formula


@dataclass(frozen=True, kw_only=True)
class Damper(SpringDamper):
    """A linear damper, whose force is -damping times the rate of change of its length or angle.

    damping: damping constant in N s/m, or N m s/rad for a damper on an angle.
    """

    damping: Formula


@dataclass(frozen=True)
class Force:
    """A force and a torque that act on a body.

    point: position in m, in the body's frame, of the point at which the force acts. force, torque:
    components in N and N m, as formulas that may use all names of the scene. in_body: True if the
    components are along the body's axes, False if they are along the world's axes.
    """

    body: str
    point: Vector
    force: Vector
    torque: Vector
    in_body: bool = False


@dataclass(frozen=True)
class LoopJoint:
    """A joint that closes a loop in a tree of bodies, or a gear between two coordinates.

    Attributes
    ----------
    joint
        Kind of the joint, a key of joints.CLOSINGS.
    bodies
        Names of the two bodies, one of which may be "world".
    points
        Position of the joint in the frame of each body, in m.
    axes
        Unit vector of the joint's axis in the frame of each body.
    rotation
        Rotation of the second body's frame relative to the first body's frame.
    length
        Distance in m that a joint of the kind "distance" keeps constant.
    coordinates, ratio, offset
        Data of a gear: second coordinate = ratio * first coordinate + offset.
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
        """Return a dict from the kind of each constraint equation of the joint to its name.

        The kinds, such as "x" or "rz", are explained in `joints.Closing`. If the joint has one
        equation, its name is that of the loop; several equations have names such as "<loop>_x".
        plane: True for a plane scene, False for a scene in space.
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
    bodies: tuple[RigidBody, ...]
    springs: tuple[Spring, ...] = ()
    dampers: tuple[Damper, ...] = ()
    forces: tuple[Force, ...] = ()
    loops: tuple[LoopJoint, ...] = ()
