"""Robots as robot files have them: bodies, joints and drives in plain numbers.

The readers (urdf.py, mjcf/) make a Robot with the names of the file, edit.py changes it as the user
asks, scene_text.py makes it fit for a scene and writes that.
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

BARE = "no <inertial>"  # the note of a link that has none, and no shape
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
        """Where the joint is while the coordinate has this value."""
        return self.gear * value + self.shift


@dataclass(frozen=True)
class Motion:
    """A coordinate of a joint, in `unit` "rad" or "m"; where it `mimics` another, it is none.

    damping: N m s/rad or N s/m; friction: N m or N; armature: kg m^2 or kg; stiffness (N m/rad or
    N/m) and rest: of the joint's own spring. friction_width: rad/s or m/s, 0 for the default.
    note: its limits, in words. limits: where it ends.
    driven: the least and largest force that drives it, N m or N, infinite where nobody says.
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
    """A body and the joint that holds it; `assembly.Body` in numbers.

    parent: a body above, or "world". joint: a key of joints.JOINTS, with a motion for each of
    its coordinates and its unit `axes` in the joint's frame. offset (m) and rotation: the joint's
    frame in the parent's, v_parent = offset + rotation v_joint. mass: kg. center: m, in the
    body's frame. inertia: kg m^2, of the centre of mass, along the body's axes. point: whether it
    only marks a place on its parent. lifted: the share of its weight that a force takes. rotor:
    what of the diagonal of the inertia is a joint's armature, kg m^2. parameter: what its mass is
    called in the scene, "" where that is a number.
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
    """A force that follows what it acts on: gain times an input, plus bias.

    gain, bias: each of 1, of the length and of the velocity. force: within which it stays.
    """

    gain: Vector
    bias: Vector
    force: Range = UNLIMITED

    @property
    def kp(self) -> float:
        """How stiff it is along the length."""
        return -self.bias[1]

    @property
    def kv(self) -> float:
        """How it damps the velocity."""
        return -self.bias[2]

    @property
    def set_point(self) -> str:
        """What pulls toward the input, "kp" or, where that is a velocity, "kv"; "" for none."""
        gain, *more = self.gain
        if not gain or any(more):
            return ""
        return "kp" if gain == self.kp else "kv" if gain == self.kv and not self.kp else ""

    @property
    def plain(self) -> bool:
        """Whether it is a number times the input."""
        return not any((*self.gain[1:], *self.bias))


@dataclass(frozen=True)
class Drive:
    """An input that acts along a coordinate, or a tendon, with the force gear times its value.

    law: of which that is the input; its length is gear times the coordinate, and gear times its
    force acts. limits: of the input, in its own unit, before the gear. start: the input at first.
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
        """Within which its force stays, before the gear."""
        return self.law.force if self.law else self.limits

    @property
    def max_force(self) -> float:
        """The largest force that acts, infinite where nobody says."""
        return abs(self.gear) * max(map(abs, self.ends)) if self.gear else 0.0


@dataclass(frozen=True)
class Tendon:
    """A sum of coordinates, each with its factor, that acts as its length does.

    stiffness, damping, armature: along it. rest: the length, or the ends of those, where the
    spring pulls nothing. offset: what locked joints add to the length.
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
        """Whether it has an effect of its own, and not by a drive alone."""
        return bool(self.stiffness or self.damping or self.armature)


@dataclass(frozen=True)
class RobotLoop:
    """A joint, "spherical" or "weld", that closes a loop between two bodies or with the world.

    points: where it is in the frame of each, m. rotation: of the second frame in the first.
    """

    name: str
    joint: str
    bodies: tuple[str, str]
    points: tuple[Vector, Vector]
    rotation: Matrix = IDENTITY


@dataclass(frozen=True)
class Coupling:
    """Sums of coordinates, each with its factor: first - zero = sum a_k (second - at)^k.

    polynomial: a_0 to a_4. unit: of the row.
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
        """The coordinates in it."""
        return {q for _, q in (*self.first, *self.second)}

    def excess(self, values: Mapping[str, float]) -> float:
        """Return the left side less the right side."""
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
    """A tree of bodies, parents first; gravity in m/s^2; what the file has besides, in words.

    stopped: whether limits of joints are stops. limited: whether those of drives act on inputs.
    method: of runs, "" for the default.
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
        """A coordinate or a tendon as a sum of coordinates."""
        return {t.name: t.terms for t in self.tendons}.get(name, ((1.0, name),))


def with_left_out_note(fault: EomcError, left_out: Sequence[str]) -> EomcError:
    """Return the fault with a note of what is not read of the file, which may be its cause."""
    if left_out:
        listed = "".join(f"\n  - {texts.line(words)}" for words in left_out)
        fault.add_note(f"not read of this file, which may be the cause:{listed}")
    return fault


def body_pose(body: RobotBody, values: Sequence[float]) -> tuple[Vector, Matrix]:
    """Where the body's frame stands in its parent's: offset (m) and rotation, at `values`."""
    offset, rotation = body.offset, body.rotation
    joint = JOINTS[body.joint]
    for kind, axis, value in zip(joint.motions, joint.motion_axes(body.axes), values, strict=True):
        if kind == "t":
            offset = plus(offset, apply(rotation, scaled(axis, value)))
        else:
            rotation = times(rotation, from_axis_angle(axis, value))
    return offset, rotation


def fix_body(body: RobotBody, offset: Vector, rotation: Matrix) -> RobotBody:
    """The body on a fixed joint there."""
    return replace(body, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation)


def with_joints_fixed(robot: Robot, frozen: Mapping[str, float] | None = None) -> Robot:
    """Return the robot with its joints fixed at coordinates that are frozen (rad or m).

    A joint that mimics a coordinate without motion is fixed too, and so is one whose coordinate is
    the only one that a coupling still has. In tendons and couplings frozen coordinates are
    constants. What needs a coordinate or a body that is neither there nor frozen is left out, and
    reported.
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
    """Return where a joint without motion stands; None for one that moves."""
    mimics = motion.mimics
    if not mimics:
        return values.get(motion.name)
    if mimics.coordinate in values:
        return mimics.joint_position(values[mimics.coordinate])
    return None if mimics.gear and mimics.coordinate in free else motion.start


def _propagate_couplings(
    robot: Robot, frozen: Mapping[str, float]
) -> tuple[dict[str, float], list[str]]:
    """Return the frozen coordinates, with those that couplings to them fix, and these in words."""
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
    """Return the terms of coordinates without a value, and the sum of the others."""
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
    """The six coordinates of a free body; `of` marks them where there are several such bodies."""
    end = f"_{of}" if of else ""
    slides = (Motion(f"{name}{end}", "m") for name in "xyz")
    turns = (
        Motion(f"yaw{end}", "rad", note="about z, first"),
        Motion(f"pitch{end}", "rad", note="about y then; singular at pi/2"),
        Motion(f"roll{end}", "rad", note="about x then"),
    )
    return (*slides, *turns)


def without_dust(body: RobotBody) -> Inertia:
    """Zeros for moments that are rounding: gyrations of 0.1 micrometres, as of 1e-20 kg m^2."""
    dust = max(map(abs, body.inertia)) <= 1e-14 * body.mass
    return NO_INERTIA if dust else body.inertia


def joined(*notes: str) -> str:
    """Notes in a line."""
    return "; ".join(note for note in notes if note)
