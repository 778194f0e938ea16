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
from eomc.robots.inertias import NO_INERTIA, Inertia
from eomc.robots.rotations import IDENTITY, ORIGIN, Matrix, Vector, from_axis_angle, times
from eomc.scene.assembly import WORLD
from eomc.scene.joints import JOINTS

BARE = "no <inertial>"  # note of a link without inertia and shapes
Range = tuple[float, float]  # minimum and maximum
Terms = tuple[tuple[float, str], ...]  # a sum of coordinates, each with its factor
# rad or m: locked values may violate a coupling by this much: typed decimals are rounded
COUPLING_TOLERANCE = 1e-4
UNLIMITED: Range = (-math.inf, math.inf)


@dataclass(frozen=True)
class Mimic:
    """A joint moves by gear times a coordinate, plus shift (rad or m)."""

    coordinate: str
    gear: float = 1.0
    shift: float = 0.0

    def joint_position(self, value: float) -> float:
        """Return the position of the joint at this value of the coordinate."""
        return self.gear * value + self.shift


@dataclass(frozen=True)
class Motion:
    """One degree of freedom of a joint, in `unit` "rad" or "m".

    It is a coordinate of the scene unless it `mimics` another one. damping: N m s/rad or N s/m;
    friction: N m or N; armature: kg m^2 or kg; stiffness (N m/rad or N/m) and rest: of the joint's
    own spring. friction_width: rad/s or m/s, 0 for the default. note: its limits, in words.
    limits: range of positions. driven: range of driving forces, N m or N, infinite if not given.
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
    """A body and the joint that connects it to its parent; `assembly.Body` in numbers.

    parent: a body above, or "world". joint: a key of joints.JOINTS, with a motion for each of
    its coordinates and its unit `axes` in the joint's frame. offset (m) and rotation: the joint's
    frame in the parent's, v_parent = offset + rotation v_joint. mass: kg. center: m, in the
    body's frame. inertia: kg m^2, of the centre of mass, along the body's axes. point: whether it
    only marks a point of its parent. lifted: the share of its weight that is compensated
    (gravcomp). rotor: the armature that is included in the diagonal of the inertia, kg m^2.
    parameter: the name of its mass in the scene, or "" if that is a number.
    """

    name: str
    parent: str = WORLD
    joint: str = "fixed"
    motions: tuple[Motion, ...] = ()
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
    """The affine law of an actuator: force = gain(l, v) * input + bias(l, v).

    gain, bias: coefficients of 1, of the length l and of the velocity v. force: range to which the
    force is clamped.
    """

    gain: Vector
    bias: Vector
    force: Range = UNLIMITED

    @property
    def kp(self) -> float:
        """Stiffness: position gain."""
        return -self.bias[1]

    @property
    def kv(self) -> float:
        """Damping: velocity gain."""
        return -self.bias[2]

    @property
    def set_point(self) -> str:
        """Gain whose set point is the input: "kp" for a position, "kv" for a velocity, or ""."""
        gain, *more = self.gain
        if not gain or any(more):
            return ""
        return "kp" if gain == self.kp else "kv" if gain == self.kv and not self.kp else ""

    @property
    def plain(self) -> bool:
        """Whether the force is a constant times the input."""
        return not any((*self.gain[1:], *self.bias))


@dataclass(frozen=True)
class Drive:
    """An input that exerts the force gear * input along a coordinate or a tendon.

    law: the actuator's law, if it has one. Its length is then gear times the coordinate, and the
    force along the coordinate is gear times that of the law. limits: of the input, in its own
    unit, before the gear. start: initial value of the input.
    """

    name: str
    coordinate: str
    gear: float = 1.0
    note: str = ""
    limits: Range = UNLIMITED
    law: Law | None = None
    start: float = 0.0

    @property
    def ends(self) -> Range:
        """Range of its force, before the gear."""
        return self.law.force if self.law else self.limits

    @property
    def max_force(self) -> float:
        """Largest magnitude of the force along the coordinate, infinite if it is not limited."""
        return abs(self.gear) * max(map(abs, self.ends)) if self.gear else 0.0


@dataclass(frozen=True)
class Tendon:
    """A fixed tendon, whose length is a linear combination of coordinates plus `offset`.

    stiffness, damping, armature: along it. rest: the range of lengths in which its spring is slack.
    offset: contribution of locked joints to the length.
    """

    name: str
    terms: Terms
    offset: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    rest: Range = (0.0, 0.0)

    @property
    def acts(self) -> bool:
        """Whether it has stiffness, damping or armature, with or without a drive."""
        return bool(self.stiffness or self.damping or self.armature)


@dataclass(frozen=True)
class RobotLoop:
    """A joint, "spherical" or "weld", that closes a loop between two bodies or with the world.

    points: its position in each body's frame, m. rotation: of the second frame in the first.
    """

    name: str
    joint: str
    bodies: tuple[str, str]
    points: tuple[Vector, Vector]
    rotation: Matrix = IDENTITY


@dataclass(frozen=True)
class Coupling:
    """A holonomic constraint between coordinates: first - zero = sum a_k (second - at)^k.

    first, second: linear combinations of coordinates. polynomial: a_0 to a_4. unit: of both sides.
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
        """Names of the coordinates that occur in it."""
        return {q for _, q in (*self.first, *self.second)}

    def excess(self, values: Mapping[str, float]) -> float:
        """Return the residual: the left side less the right side."""
        first, second = (sum(by * values[q] for by, q in s) for s in (self.first, self.second))
        right = sum(a * (second - self.at) ** k for k, a in enumerate(self.polynomial))
        return first - self.zero - right

    def root(self, near: float) -> float | None:
        """Return the value of its only coordinate that is closest to `near`; None for none."""
        from numpy.polynomial import Polynomial

        one, other = (sum(by for by, _ in side) for side in (self.first, self.second))
        right = Polynomial(self.polynomial)(Polynomial([-self.at, other]))
        residual = (Polynomial([-self.zero, one]) - right).trim()
        real = [x.real for x in residual.roots() if abs(x.imag) <= 1e-6 * max(1.0, abs(x.real))]
        return min(map(float, real), key=lambda x: abs(x - near), default=None)


@dataclass(frozen=True)
class Robot:
    """A tree of bodies, parents first, with drives, tendons and constraints; gravity in m/s^2.

    stopped: whether joint limits become stops. limited: whether limits of drives become limits of
    inputs. method: of integration, "" for the default. left_out: notes on parts of the file that
    are not modelled.
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
    def motions(self) -> tuple[Motion, ...]:
        """The coordinates, in the order of the bodies."""
        return tuple(m for body in self.bodies for m in body.motions if not m.mimics)

    def coordinate_terms(self, name: str) -> Terms:
        """Return a coordinate or a tendon as a linear combination of coordinates."""
        return {t.name: t.terms for t in self.tendons}.get(name, ((1.0, name),))


def with_left_out_note(fault: EomcError, left_out: Sequence[str]) -> EomcError:
    """Return the error with a note on parts of the file that are not read and may be its cause."""
    if left_out:
        listed = "".join(f"\n  - {texts.line(words)}" for words in left_out)
        fault.add_note(f"not read of this file, which may be the cause:{listed}")
    return fault


def body_pose(body: RobotBody, values: Sequence[float]) -> tuple[Vector, Matrix]:
    """Return the pose of a body in its parent, offset (m) and rotation, at joint `values`."""
    offset, rotation = body.offset, body.rotation
    joint = JOINTS[body.joint]
    for kind, axis, value in zip(joint.motions, joint.motion_axes(body.axes), values, strict=True):
        if kind == "t":
            offset = plus(offset, apply(rotation, scaled(axis, value)))
        else:
            rotation = times(rotation, from_axis_angle(axis, value))
    return offset, rotation


def fix_body(body: RobotBody, offset: Vector, rotation: Matrix) -> RobotBody:
    """Return the body with a fixed joint in this pose."""
    return replace(body, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation)


def with_joints_fixed(robot: Robot, frozen: Mapping[str, float] | None = None) -> Robot:
    """Return the robot with joints fixed at the values of the `frozen` coordinates (rad or m).

    Joints that mimic a fixed coordinate are fixed as well, and so is a coordinate that a coupling
    determines from fixed ones. In tendons and couplings fixed coordinates become constants. Drives,
    tendons and constraints that refer to a removed coordinate or body are left out and reported.
    """
    values, coupled = _propagate_couplings(robot, frozen or {})
    free = {m.name for m in robot.motions} - values.keys()
    bodies = []
    for body in robot.bodies:
        motion = body.motions[0] if body.motions else None
        position = _fixed_position(motion, values, free) if motion else None
        if motion and position is not None:
            note = f"joint {motion.name} stands at {position:g} {motion.unit}"
            body = replace(
                fix_body(body, *body_pose(body, (position,))), note=joined(body.note, note)
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
    violated = [c.name for c in fully_locked if abs(c.excess(values)) > COUPLING_TOLERANCE]
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


def _fixed_position(motion: Motion, values: Mapping[str, float], free: Set[str]) -> float | None:
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


def free_motions(of: str = "") -> tuple[Motion, ...]:
    """Return the six coordinates of a free body; a non-empty `of` is appended to their names."""
    end = f"_{of}" if of else ""
    slides = (Motion(f"{name}{end}", "m") for name in "xyz")
    turns = (
        Motion(f"yaw{end}", "rad", note="about z, first"),
        Motion(f"pitch{end}", "rad", note="about y then; singular at pi/2"),
        Motion(f"roll{end}", "rad", note="about x then"),
    )
    return (*slides, *turns)


def without_dust(body: RobotBody) -> Inertia:
    """Return the inertia, or zero if it is rounding error: radii of gyration below 0.1 um."""
    dust = max(map(abs, body.inertia)) <= 1e-14 * body.mass
    return NO_INERTIA if dust else body.inertia


def joined(*notes: str) -> str:
    """Join non-empty notes by semicolons."""
    return "; ".join(note for note in notes if note)
