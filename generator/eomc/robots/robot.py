"""Data model of a robot file: bodies, joints and drives in plain numbers.

The readers (urdf.py, mjcf/) return a Robot with the names of the file, edit.py applies the user's
options, and scene_text.py converts it to a scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.base.spatial import apply, plus, scaled
from eomc.robots.geometry import (
    IDENTITY,
    IDENTITY_TRANSFORM,
    NO_INERTIA,
    ORIGIN,
    Inertia,
    Matrix,
    Transform,
    Vector,
    from_axis_angle,
    times,
)
from eomc.scene.joints import JOINTS
from eomc.scene.scene import WORLD

BARE = "no <inertial>"  # note of a link without inertia and shapes
Range = tuple[float, float]  # minimum and maximum
Terms = tuple[tuple[float, str], ...]  # a sum of coordinates, each with its factor
# rad or m: locked values may violate a coupling by this much: typed decimals are rounded
COUPLING_TOLERANCE = 1e-4
UNLIMITED: Range = (-math.inf, math.inf)


def input_range(force: Range, factor: float) -> Range:
    """Return the range of an input such that `factor` times the input is in the range `force`."""
    if not factor:
        return UNLIMITED
    low, high = sorted(f / factor for f in force)
    return low, high


def intersection(one: Range, other: Range) -> Range | None:
    """Return the range common to two ranges; None if it is empty or a single point."""
    low, high = max(one[0], other[0]), min(one[1], other[1])
    return (low, high) if low < high else None


@dataclass(frozen=True)
class Mimic:
    """The position of a joint that follows a coordinate: gear times it, plus shift (rad or m)."""

    coordinate: str
    gear: float = 1.0
    shift: float = 0.0

    def joint_position(self, value: float) -> float:
        """Return the position of the joint (rad or m) when the coordinate has the given value."""
        return self.gear * value + self.shift


@dataclass(frozen=True)
class JointMotion:
    """One degree of freedom of a joint.

    It is a coordinate of the scene (TOML file) unless it mimics another one.

    Attributes
    ----------
    name, unit : str
        Name of the coordinate, and its unit "rad" or "m".
    start : float
        Initial value.
    note : str
        Its limits, in words.
    damping : float
        N m s/rad or N s/m.
    friction, friction_width : float
        Dry friction (N m or N), and the velocity (rad/s or m/s) within which it is smoothed; 0 for
        the default.
    armature : float
        Inertia of the drive's rotor (kg m^2 or kg).
    stiffness, rest : float
        Of the joint's own spring: stiffness (N m/rad or N/m) and the position without force.
    mimics : Mimic or None
        The coordinate that it follows.
    limits, driven : (float, float)
        Range of positions, and range of driving forces (N m or N); infinite if not given.
    """

    name: str
    unit: str
    start: float = 0.0
    note: str = ""
    damping: float = 0.0
    friction: float = 0.0
    friction_width: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    mimics: Mimic | None = None
    limits: Range = UNLIMITED
    driven: Range = UNLIMITED


@dataclass(frozen=True)
class RobotBody:
    """A body, and the joint that connects it to its parent.

    Attributes
    ----------
    parent : str
        Name of an earlier body, or "world".
    joint : str
        Kind of the joint, a key of joints.JOINTS.
    motions, axes : tuple
        For each coordinate of the joint, its motion; the unit axes in the joint's frame.
    offset, rotation
        The joint's frame in the parent's frame: v_parent = offset + rotation v_joint, with the
        offset in m.
    mass, center, inertia
        Mass (kg), centre of mass in the body's frame (m), and inertia about the centre of mass,
        along the body's axes (kg m^2).
    point : bool
        Whether the body only marks a point of its parent.
    lifted : float
        The share of its weight that is compensated (gravcomp in MJCF).
    rotor : float
        The armature that is included in the diagonal of the inertia (kg m^2).
    parameter : str
        The name of its mass in the scene, or "" if the mass is a number.
    """

    name: str
    parent: str = WORLD
    joint: str = "fixed"
    motions: tuple[JointMotion, ...] = ()
    axes: tuple[Vector, ...] = ()
    offset: Vector = ORIGIN
    rotation: Matrix = IDENTITY
    mass: float = 0.0
    center: Vector = ORIGIN
    inertia: Inertia = NO_INERTIA
    note: str = ""
    point: bool = False
    lifted: float = 0.0
    rotor: float = 0.0
    parameter: str = ""


@dataclass(frozen=True)
class Law:
    """The affine control law of an actuator: force = gain(l, v) * input + bias(l, v).

    Attributes
    ----------
    gain, bias : Vector
        Coefficients of 1, of the length l and of the velocity v.
    force : (float, float)
        The range to which the force is clamped.
    """

    gain: Vector
    bias: Vector
    force: Range = UNLIMITED

    @property
    def kp(self) -> float:
        """Stiffness (position gain): minus the coefficient of the length in the bias."""
        return -self.bias[1]

    @property
    def kv(self) -> float:
        """Damping (velocity gain): minus the coefficient of the velocity in the bias."""
        return -self.bias[2]

    @property
    def set_point(self) -> str:
        """The gain of the quantity for which the input is a set point, or "".

        It is "kp" if the input is the set point of the position, "kv" if it is that of the
        velocity, and "" if the input is no set point.
        """
        gain, *more = self.gain
        if not gain or any(more):
            return ""
        return "kp" if gain == self.kp else "kv" if gain == self.kv and not self.kp else ""

    @property
    def has_constant_gain(self) -> bool:
        """Whether the force is a constant times the input."""
        return not any((*self.gain[1:], *self.bias))


@dataclass(frozen=True)
class Drive:
    """An input of the scene that exerts the force gear * input along a coordinate or a tendon.

    Attributes
    ----------
    coordinate : str
        Name of the coordinate or the tendon.
    gear : float
        Factor from the input to the force.
    limits : (float, float)
        Limits of the input in its own unit, before the gear.
    law : Law or None
        The actuator's control law. Its length is then gear times the coordinate, and the force
        along the coordinate is gear times that of the law.
    start : float
        Initial value of the input.
    """

    name: str
    coordinate: str
    gear: float = 1.0
    note: str = ""
    limits: Range = UNLIMITED
    law: Law | None = None
    start: float = 0.0

    @property
    def force_range(self) -> Range:
        """The range of the drive's force before it is multiplied by the gear factor."""
        return self.law.force if self.law else self.limits

    @property
    def max_force(self) -> float:
        """The largest magnitude of the force along the coordinate (N or N m); inf if unlimited."""
        return abs(self.gear) * max(map(abs, self.force_range)) if self.gear else 0.0


@dataclass(frozen=True)
class Tendon:
    """A fixed tendon, whose length is a linear combination of coordinates plus an offset.

    Attributes
    ----------
    terms : tuple of (float, str)
        The factor of each coordinate.
    offset : float
        The contribution of locked joints to the length (m).
    stiffness, damping, armature : float
        Along the tendon.
    rest : (float, float)
        The range of lengths in which its spring is slack.
    """

    name: str
    terms: Terms
    offset: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    rest: Range = (0.0, 0.0)

    @property
    def has_forces(self) -> bool:
        """Whether the tendon itself has stiffness, damping or armature.

        A drive that acts on the tendon does not count.
        """
        return bool(self.stiffness or self.damping or self.armature)


@dataclass(frozen=True)
class RobotLoop:
    """A joint that closes a kinematic loop between two bodies, or between a body and the world.

    Attributes
    ----------
    joint : str
        "spherical" or "weld".
    bodies : (str, str)
        The two bodies, or "world".
    points : (Vector, Vector)
        The joint's position in each body's frame (m).
    rotation : Matrix
        Of the second frame in the first one when the loop is closed.
    """

    name: str
    joint: str
    bodies: tuple[str, str]
    points: tuple[Vector, Vector]
    rotation: Matrix = IDENTITY


@dataclass(frozen=True)
class Coupling:
    """A holonomic constraint between coordinates: first - zero = sum a_k (second - at)^k.

    Attributes
    ----------
    first, second : tuple of (float, str)
        Linear combinations of coordinates, as the factor of each.
    zero, at : float
        Offsets of the two.
    polynomial : (float, ...)
        Coefficients a_0 to a_4.
    unit : str
        Unit of both sides.
    """

    name: str
    first: Terms
    second: Terms
    zero: float
    at: float
    polynomial: tuple[float, ...]
    unit: str = ""

    @property
    def coordinates(self) -> set[str]:
        """The names of the coordinates that occur in the constraint."""
        return {q for _, q in (*self.first, *self.second)}

    def residual(self, values: Mapping[str, float]) -> float:
        """Return the residual of the constraint: its left side minus its right side.

        `values` are the coordinates by name.
        """
        first, second = (sum(by * values[q] for by, q in s) for s in (self.first, self.second))
        right = sum(a * (second - self.at) ** k for k, a in enumerate(self.polynomial))
        return first - self.zero - right

    def root(self, near: float) -> float | None:
        """Return the value of a coordinate that satisfies a constraint on this coordinate alone.

        Among several solutions it is the one closest to `near`. None if there is no solution.
        """
        from numpy.polynomial import Polynomial

        one, other = (sum(by for by, _ in side) for side in (self.first, self.second))
        right = Polynomial(self.polynomial)(Polynomial([-self.at, other]))
        residual = (Polynomial([-self.zero, one]) - right).trim()
        real = [x.real for x in residual.roots() if abs(x.imag) <= 1e-6 * max(1.0, abs(x.real))]
        return min(map(float, real), key=lambda x: abs(x - near), default=None)


@dataclass(frozen=True)
class Robot:
    """A robot as its file describes it, before it becomes a scene: a tree of bodies.

    Attributes
    ----------
    bodies : tuple of RobotBody
        Parents before children.
    gravity : Vector
        m/s^2.
    stopped, limited : bool
        Whether joint limits become stops, and limits of drives become limits of inputs.
    method : str
        Method of integration; "" for the default.
    left_out : tuple of str
        Notes on parts of the file that are not modelled.
    """

    name: str
    title: str
    gravity: Vector
    bodies: tuple[RobotBody, ...]
    drives: tuple[Drive, ...] = ()
    tendons: tuple[Tendon, ...] = ()
    loops: tuple[RobotLoop, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    stopped: bool = False
    limited: bool = False
    method: str = ""
    left_out: tuple[str, ...] = ()

    @property
    def motions(self) -> tuple[JointMotion, ...]:
        """The coordinates of the robot, in the order of the bodies."""
        return tuple(m for body in self.bodies for m in body.motions if not m.mimics)

    def coordinate_terms(self, name: str) -> Terms:
        """Return a coordinate or the length of a tendon as a linear combination of coordinates.

        `name` is that of the coordinate or tendon. The result has a pair (factor, coordinate) for
        each term.
        """
        return {t.name: t.terms for t in self.tendons}.get(name, ((1.0, name),))


def with_left_out_note(fault: EomcError, left_out: Sequence[str]) -> EomcError:
    """Return the error with an additional note on parts of the robot file that are left out.

    Such parts (`left_out`) may be the cause of the error.
    """
    if left_out:
        listed = "".join(f"\n  - {texts.line(words)}" for words in left_out)
        fault.add_note(f"not read of this file, which may be the cause:{listed}")
    return fault


def body_pose(body: RobotBody, values: Sequence[float] | None = None) -> Transform:
    """Return the pose of a body in its parent's frame for given positions of its joint.

    `values` contains the position of each coordinate of the joint (rad or m), by default its
    initial value.
    """
    values = [m.start for m in body.motions] if values is None else values
    offset, rotation = body.offset, body.rotation
    subspaces = JOINTS[body.joint].subspaces(body.axes, pitch=0.0)
    for (axis, angular, linear), value in zip(subspaces, values, strict=True):
        offset = plus(offset, apply(rotation, scaled(axis, linear * value)))
        rotation = times(rotation, from_axis_angle(axis, angular * value))
    return Transform(offset, rotation)


def initial_poses(bodies: Sequence[RobotBody]) -> dict[str, Transform]:
    """Return the poses in the world of the bodies, and of the world, at the initial state."""
    poses = {WORLD: IDENTITY_TRANSFORM}
    for body in bodies:
        poses[body.name] = poses[body.parent].compose(body_pose(body))
    return poses


def fix_body(body: RobotBody, offset: Vector, rotation: Matrix) -> RobotBody:
    """Return the body, fixed to its parent in the given pose.

    The pose is the offset (m) and the rotation matrix of the body's frame in the parent's frame.
    """
    return replace(body, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation)


def with_joints_fixed(robot: Robot, frozen: Mapping[str, float] | None = None) -> Robot:
    """Return the robot with joints fixed at the values of the `frozen` coordinates (rad or m).

    Joints that mimic a fixed coordinate are fixed as well, and so is a coordinate that a coupling
    determines from fixed ones. In tendons and couplings fixed coordinates become constants. Drives,
    tendons and constraints that refer to a removed coordinate or body are left out and noted in
    `left_out`.
    """
    values, coupled = _propagate_couplings(robot, frozen or {})
    free = {m.name for m in robot.motions} - values.keys()
    bodies = []
    for body in robot.bodies:
        motion = body.motions[0] if body.motions else None
        position = _fixed_position(motion, values, free) if motion else None
        if motion and position is not None:
            note = f"joint {motion.name} stands at {position:.12g} {motion.unit}"
            body = replace(
                fix_body(body, *body_pose(body, (position,))), note=join_notes(body.note, note)
            )
        bodies.append(body)
    tendons = tuple(t for each in robot.tendons if (t := _shortened(each, values)).terms)
    tendons = tuple(t for t in tendons if free.issuperset(q for _, q in t.terms))
    acting = free | {t.name for t in tendons}
    drives = tuple(d for d in robot.drives if d.coordinate in acting)
    known = {WORLD, *(body.name for body in bodies)}
    loops = tuple(loop for loop in robot.loops if known.issuperset(loop.bodies))
    couplings = tuple(_reduced(c, values) for c in robot.couplings)
    orphaned = {loop.name for loop in robot.loops} - {loop.name for loop in loops}
    orphaned |= {c.name for c in couplings if not free.issuperset(c.coordinates)}
    fully_locked = [c for c in robot.couplings if c.coordinates <= values.keys()]
    violated = [c.name for c in fully_locked if abs(c.residual(values)) > COUPLING_TOLERANCE]
    notes = [
        ("constraints that the values of locked joints break", violated),
        ("constraints of what is cut off or locked", sorted(orphaned)),
        ("tendons of what is cut off or locked", sorted({t.name for t in robot.tendons} - acting)),
        ("fixed by couplings to what is locked", coupled),
    ]
    return replace(
        robot,
        bodies=tuple(bodies),
        drives=drives,
        tendons=tendons,
        loops=loops,
        couplings=tuple(c for c in couplings if c.coordinates and c.name not in orphaned),
        left_out=(*(f"{what}: {', '.join(n)}" for what, n in notes if n), *robot.left_out),
    )


def _fixed_position(
    motion: JointMotion, values: Mapping[str, float], free: Set[str]
) -> float | None:
    """Return the position of a joint that is fixed; None if it moves."""
    mimics = motion.mimics
    if not mimics:
        return values.get(motion.name)
    if mimics.coordinate in values:
        return mimics.joint_position(values[mimics.coordinate])
    return None if mimics.gear and mimics.coordinate in free else motion.start


def _propagate_couplings(
    robot: Robot, frozen: Mapping[str, float]
) -> tuple[dict[str, float], list[str]]:
    """Return the values of all coordinates that are frozen, directly or by couplings.

    The second value describes those that couplings fix, one text each.
    """
    values, words = dict(frozen), []
    motions = {m.name: m for m in robot.motions}
    waiting = [c for c in robot.couplings if c.coordinates & values.keys()]
    while waiting:
        c = waiting.pop()
        free = c.coordinates - values.keys()
        if len(free) != 1 or not free <= motions.keys():
            continue
        (name,) = free
        value = _reduced(c, values).root(motions[name].start)
        if value is None:
            raise EomcError(
                f"coupling {c.name}: no value of '{name}' fulfils it while "
                + ", ".join(f"{q} = {values[q]:g}" for q in sorted(c.coordinates - free))
            )
        values[name] = value
        words.append(f"{name} at {value:g} {motions[name].unit}")
        waiting += [other for other in robot.couplings if name in other.coordinates]
    return values, words


def _split(terms: Terms, values: Mapping[str, float]) -> tuple[Terms, float]:
    """Return the terms of free coordinates, and the constant sum of the others."""
    remaining = tuple((by, q) for by, q in terms if q not in values)
    return remaining, sum((by * values[q] for by, q in terms if q in values), 0.0)


def _shortened(tendon: Tendon, values: Mapping[str, float]) -> Tendon:
    """Return the tendon with its locked coordinates as constants."""
    terms, constant = _split(tendon.terms, values)
    return replace(tendon, terms=terms, offset=tendon.offset + constant)


def _reduced(c: Coupling, values: Mapping[str, float]) -> Coupling:
    """Return the coupling with its locked coordinates as constants."""
    (first, one), (second, other) = _split(c.first, values), _split(c.second, values)
    return replace(c, first=first, zero=c.zero - one, second=second, at=c.at - other)


def free_motions(of: str = "") -> tuple[JointMotion, ...]:
    """Return the six coordinates of a free body: x, y, z (m), yaw, pitch, roll (rad).

    `of` is the name of the body or joint; if it is not empty, it is appended to the names of the
    coordinates.
    """
    end = f"_{of}" if of else ""
    slides = (JointMotion(f"{name}{end}", "m") for name in "xyz")
    turns = (
        JointMotion(f"yaw{end}", "rad", note="about z, first"),
        JointMotion(f"pitch{end}", "rad", note="about y then; singular at pi/2"),
        JointMotion(f"roll{end}", "rad", note="about x then"),
    )
    return (*slides, *turns)


def significant_inertia(body: RobotBody) -> Inertia:
    """Return a body's inertia tensor, or zero if the tensor is a rounding error.

    It is a rounding error if the radii of gyration are below 0.1 um.
    """
    dust = max(map(abs, body.inertia)) <= 1e-14 * body.mass
    return NO_INERTIA if dust else body.inertia


def join_notes(*notes: str) -> str:
    """Return one text with all notes that are not empty, separated by semicolons."""
    return "; ".join(note for note in notes if note)
