"""Robots as robot files have them: bodies, joints and drives in plain numbers.

The readers (urdf.py, mjcf/) make a Robot with the names of the file, edit.py changes it as the user
asks, scene_text.py makes it fit for a scene and writes that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from eomc.base.spatial import apply, plus, scaled
from eomc.robots.inertias import NO_INERTIA, Inertia
from eomc.robots.rotations import IDENTITY, ORIGIN, Matrix, Vector, from_axis_angle, times
from eomc.scene.assembly import WORLD
from eomc.scene.joints import JOINTS

BARE = "no <inertial>"  # the note of a link that has none, and no shape
UNLIMITED = (-math.inf, math.inf)


@dataclass(frozen=True)
class Mimic:
    """A joint moves by gear times a coordinate, plus shift (rad or m)."""

    coordinate: str
    gear: float = 1.0
    shift: float = 0.0

    def at(self, value: float) -> float:
        """Where the joint is while the coordinate has this value."""
        return self.gear * value + self.shift


@dataclass(frozen=True)
class Motion:
    """A coordinate of a joint, in `unit` "rad" or "m"; where it `mimics` another, it is none.

    damping: N m s/rad or N s/m; friction: N m or N; armature: kg m^2 or kg; stiffness (N m/rad or
    N/m) and rest: of the joint's own spring. note: its limits, in words. limits: where it ends.
    driven: the least and largest force that drives it, N m or N, infinite where nobody says.
    """

    name: str
    unit: str
    start: float = 0.0
    note: str = ""
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    mimics: Mimic | None = None
    limits: tuple[float, float] = UNLIMITED
    driven: tuple[float, float] = UNLIMITED


@dataclass(frozen=True)
class RobotBody:
    """A body and the joint that holds it; `assembly.Body` in numbers.

    parent: a body above, or "world". joint: a key of joints.JOINTS, with a motion for each of
    its coordinates and its unit `axes` in the joint's frame. offset (m) and rotation: the joint's
    frame in the parent's, v_parent = offset + rotation v_joint. mass: kg. center: m, in the
    body's frame. inertia: kg m^2, of the centre of mass, along the body's axes. point: whether it
    only marks a place on its parent.
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


@dataclass(frozen=True)
class Drive:
    """An input that acts along a coordinate with the force gear times its value.

    limits: of the input, in its own unit, before the gear.
    """

    name: str
    coordinate: str
    gear: float = 1.0
    note: str = ""
    limits: tuple[float, float] = UNLIMITED


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
    first: tuple[tuple[float, str], ...]
    second: tuple[tuple[float, str], ...]
    zero: float
    at: float
    polynomial: tuple[float, ...]
    unit: str = ""


@dataclass(frozen=True)
class Robot:
    """A tree of bodies, parents first; gravity in m/s^2; what the file has besides, in words.

    stopped: whether limits of joints are stops. limited: whether those of drives act on inputs.
    """

    name: str
    title: str
    gravity: Vector
    bodies: tuple[RobotBody, ...]
    drives: tuple[Drive, ...] = ()
    loops: tuple[RobotLoop, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    stopped: bool = False
    limited: bool = False
    left_out: tuple[str, ...] = ()

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The coordinates, in the order of the bodies."""
        return tuple(m for body in self.bodies for m in body.motions if not m.mimics)


def moved(body: RobotBody, values: Sequence[float]) -> tuple[Vector, Matrix]:
    """Where the body's frame stands in its parent's: offset (m) and rotation, at `values`."""
    offset, rotation = body.offset, body.rotation
    joint = JOINTS[body.joint]
    for kind, axis, value in zip(joint.motions, joint.along(body.axes), values, strict=True):
        if kind == "t":
            offset = plus(offset, apply(rotation, scaled(axis, value)))
        else:
            rotation = times(rotation, from_axis_angle(axis, value))
    return offset, rotation


def fixed(body: RobotBody, offset: Vector, rotation: Matrix) -> RobotBody:
    """The body on a fixed joint there."""
    return replace(body, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation)


def settled(robot: Robot) -> Robot:
    """The robot with joints fixed at their start that mimic what does not move.

    Drives of what is not there are left out, loops and couplings too, and these are told.
    """
    there = {m.name for m in robot.motions}
    bodies = []
    for body in robot.bodies:
        motion = body.motions[0] if body.motions else None
        mimics = motion.mimics if motion else None
        if motion and mimics and (not mimics.gear or mimics.coordinate not in there):
            note = f"joint {motion.name} stands at {motion.start:g} {motion.unit}"
            body = fixed(body, *moved(body, (motion.start,)))
            body = replace(body, note=joined(body.note, note))
        bodies.append(body)
    drives = tuple(d for d in robot.drives if d.coordinate in there)
    known = {WORLD, *(body.name for body in bodies)}
    loops = tuple(loop for loop in robot.loops if known.issuperset(loop.bodies))
    couplings = tuple(
        c for c in robot.couplings if there.issuperset(q for _, q in (*c.first, *c.second))
    )
    lost = {loop.name for loop in robot.loops} - {loop.name for loop in loops}
    lost |= {c.name for c in robot.couplings} - {c.name for c in couplings}
    told = ("constraints of what is cut off or locked: " + ", ".join(sorted(lost)),) if lost else ()
    return replace(
        robot,
        bodies=tuple(bodies),
        drives=drives,
        loops=loops,
        couplings=couplings,
        left_out=(*told, *robot.left_out),
    )


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
