"""A checked scene as data, with the place of each entry in its file. Independent of SymPy and C.

Every vector of a body has three components and every inertia six; in a plane scene, the components
out of the plane are zero. Formulas of bodies depend on numbers, constants and parameters unless
stated otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from eomc.base.errors import EomcError, Problem
from eomc.scene.formulas import Formula
from eomc.scene.joints import CLOSINGS, REACTIONS
from eomc.scene.schema import RunSettings
from eomc.scene.scope import Path, value_of
from eomc.scene.toml_text import SourceMap

# --- bodies ---------------------------------------------------------------------------------------

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
    pitch : Formula or None
        Displacement along the axis of a screw joint for each radian, in m/rad.
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
    pitch: Formula | None = None
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


# --- tables ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneCoordinate:
    """A generalized coordinate of a scene.

    start: initial value in `unit`. rate: initial velocity in unit/s. The velocity has the name
    `<name>_dot` in formulas. start_fixed, rate_fixed: True if the initial value or velocity must
    not be changed to satisfy the constraints. friction: Coulomb friction in N or N m.
    friction_width: width w of the smoothed friction, friction*tanh(velocity/w).
    """

    name: str
    unit: str
    start: Formula
    rate: Formula
    note: str
    start_fixed: bool = True
    rate_fixed: bool = True
    friction: Formula | None = None
    friction_width: Formula | None = None


@dataclass(frozen=True)
class Quantity:
    """A parameter, which can be changed at run time, or a constant, which is fixed in the code.

    value: its value in `unit`. formula: the formula in the scene that gives this value.
    """

    name: str
    unit: str
    value: float
    note: str
    formula: Formula


@dataclass(frozen=True)
class SceneInput:
    """An input, whose value can be given at every step.

    signal: formula that determines the input if no value is given. limits: formulas of the smallest
    and the largest value of the input, beyond which it is clipped; None if unbounded.
    """

    name: str
    unit: str
    signal: Formula
    note: str
    limits: tuple[Formula | None, ...] = (None, None)


@dataclass(frozen=True)
class NamedFormula:
    """An output or a constraint equation.

    The formula of an output may use all quantities of the scene, accelerations and constraint
    forces too. That of a constraint equation is zero along every motion; it depends on coordinates
    and t (holonomic), or is linear in the velocities.
    """

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class SceneEvent:
    """An event, which is triggered when a formula crosses zero.

    when: the formula. direction: "rising", "falling" or "both". action: "record", "stop" or "jump".
    jump: pairs (name, formula) of the coordinates, velocities and parameters that a jump sets.
    """

    name: str
    when: Formula
    direction: str
    action: str
    jump: tuple[tuple[str, Formula], ...]
    note: str


@dataclass(frozen=True)
class PicturePlace:
    """A position in a picture.

    at: three formulas in m; if None, the position and the axes are those of the body or [[point]]
    `name`.
    """

    name: str
    at: Vector | None


@dataclass(frozen=True)
class Shape:
    """One shape of a picture.

    kind: "dot" or "path" (one place), "line" (two places or more), "spring" (two places), "box" or
    "circle" (one place, their centre). size: edges of a box or radius of a circle, m. rotation: of
    a box or circle, relative to the axes of the body at its place, or else to the world's axes.
    """

    kind: str
    places: tuple[PicturePlace, ...]
    size: tuple[Formula, ...] = ()
    rotation: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Picture:
    """The shapes that a scene draws in its table [picture].

    axes: letters of the axes, such as "xz" in the plane, and "xyz" in space.
    """

    shapes: tuple[Shape, ...]
    axes: str


@dataclass(frozen=True)
class Scene:
    """A checked scene: the mechanical system and the settings that a TOML file describes.

    All names in the formulas are declared, and no definition is circular.

    Attributes
    ----------
    file, digest
        Name of the file, and SHA-256 digest of its text.
    kinetic, potential, dissipation
        Formulas of the energies in J and of Rayleigh's dissipation function.
    forces
        Formulas of generalized forces, by coordinate.
    assembly
        Bodies, joints, springs, dampers, forces and loops; None if there are none.
    places
        Lines of all keys in the file.
    warnings
        Problems that are not errors.
    used
        For each name, the keys of the formulas that use it.
    """

    name: str
    title: str
    note: str
    file: str
    digest: str
    coordinates: tuple[SceneCoordinate, ...]
    parameters: tuple[Quantity, ...]
    constants: tuple[Quantity, ...]
    inputs: tuple[SceneInput, ...]
    definitions: tuple[tuple[str, Formula], ...]
    kinetic: Formula
    potential: Formula
    dissipation: Formula
    forces: Mapping[str, Formula]
    outputs: tuple[NamedFormula, ...]
    events: tuple[SceneEvent, ...]
    constraints: tuple[NamedFormula, ...]
    run: RunSettings
    assembly: Assembly | None
    picture: Picture | None
    places: SourceMap = field(repr=False, compare=False)
    warnings: tuple[Problem, ...] = ()
    used: Mapping[str, Sequence[Path]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def constrained(self) -> bool:
        """True if the scene has constraint equations, from [constraints] or from loops."""
        return bool(self.constraints or (self.assembly and self.assembly.loops))

    def start(
        self, parameters: Mapping[str, float] | None = None
    ) -> tuple[list[float], list[float]]:
        """Return the initial coordinates q and velocities q̇, each a list in the scene's order.

        parameters: values that replace those of the scene's parameters. Raises EomcError if an
        initial value can't be computed, such as 1/l with l = 0.
        """
        values = {p.name: p.value for p in (*self.parameters, *self.constants)}
        values.update(parameters or {})

        def number(formula: Formula, key: str) -> float:
            value, fault = value_of(formula, values)
            if fault:
                raise EomcError(str(self.problem(key, fault, formula)))
            return value

        return (
            [number(c.start, f"coordinates.{c.name}.start") for c in self.coordinates],
            [number(c.rate, f"coordinates.{c.name}.rate") for c in self.coordinates],
        )

    def problem(
        self,
        key: str,
        message: str,
        formula: Formula | None = None,
        severity: str = "error",
    ) -> Problem:
        """Return a problem (error or warning) at a key of the scene such as "energy.kinetic".

        It contains the line of the key in the file. formula: the formula to mark in that line.
        severity: "error" or "warning".
        """
        text = formula.text if formula else None
        return self.places.problem(tuple(key.split(".")), message, text=text, severity=severity)
