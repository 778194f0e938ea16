"""Joints of an MJCF file and the fixed tendons over them.

A joint has motions, axes, limits, and names of its coordinates. The length of a fixed tendon is a
linear combination of joint positions; springs, dampers and actuators act along it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from eomc.base.spatial import apply, plus, scaled
from eomc.robots.mjcf.file import (
    AttributeReader,
    ImportReport,
    Settings,
    missing_message,
    note_unread_attributes,
)
from eomc.robots.mjcf.masses import (
    IDENTITY_TRANSFORM,
    Placed,
    Reader,
    Transform,
    rounded,
    unit_vector,
)
from eomc.robots.robot import UNLIMITED, JointMotion, Range, Tendon, free_motions, join_notes
from eomc.robots.rotations import IDENTITY, ORIGIN, Vector, from_axis_angle, unit, yaw_pitch_roll
from eomc.robots.xml import Tag


@dataclass(frozen=True)
class MjcfJoint:
    """A joint of an MJCF file.

    Attributes
    ----------
    type, kind : str
        Type of the joint in MJCF, and as a key of joints.JOINTS.
    motions, axes : tuple
        Degrees of freedom, and their unit axes.
    anchor : Vector
        Its position in the body's frame (m).
    zero : Transform
        Pose of the frame in which the joint's coordinates are zero, relative to the body's frame
        moved to the anchor.
    armature : float
        Rotor inertia of the rotations of a free or ball joint (kg m^2).
    spring : (float, float)
        Time constant (s) and damping ratio of its springdamper; zeros if it has none.
    """

    name: str
    type: str
    kind: str
    motions: tuple[JointMotion, ...]
    axes: tuple[Vector, ...]
    anchor: Vector
    zero: Transform
    armature: float
    spring: tuple[float, float] = (0.0, 0.0)


# properties of a joint, and the flag of the file that disables each
DISABLES = {"stiffness": "spring", "damping": "damper", "friction": "frictionloss"}
LIMITS = "limits of joints, kept as notes"
TYPES = ("hinge", "slide", "ball", "free")


def read_joint(placed: Placed, name: str, pose: Transform, reader: Reader) -> MjcfJoint | None:
    """Return the joint that an element of the file describes, or None if the element has a fault.

    `pose` is the pose of the joint's body in the parent's frame. The motions of free and ball
    joints get their final names later, from `with_coordinate_names`.
    """
    report, settings, tag = reader.report, reader.settings, placed.tag
    free = tag.kind == "freejoint"
    a = reader.own_attributes(tag) if free else reader.attributes_with_defaults(placed, "joint")
    kind = "free" if free else a.choice("type", TYPES)
    turns = kind != "slide"

    def value(key: str) -> float:
        number = a.number(key)
        return settings.angle(number) if kind == "hinge" else number

    def first(key: str) -> float:
        """Return the linear coefficient; report quadratic and cubic ones."""
        numbers = a.numbers(key, 3, 1) or (0.0,)
        if any(numbers[1:]):
            report.leave_out(f"{key} in the square and cube of joints", name)
        return numbers[0]

    own = {
        "damping": first("damping"),
        "friction": a.number("frictionloss"),
        "armature": a.number("armature"),
        "stiffness": first("stiffness"),
    }
    for key, number in own.items():
        if number < 0:
            a.fault(f"{key} must not be negative")
    time, ratio = a.numbers("springdamper", 2) or (0.0, 0.0)
    if time or ratio:
        own |= {"stiffness": 0.0, "damping": 0.0}
        if time <= 0 or ratio <= 0:
            a.fault("springdamper is a time constant and a damping ratio, both positive")
    spring = time, ratio
    for key, effect in DISABLES.items():
        if effect in settings.disabled:
            own[key] = 0.0
    note_unread_attributes(a, "joint", name)
    note, ends, driven = _limits(a, kind, settings, name)
    anchor = plus(placed.pose.place, apply(placed.pose.turn, a.vector("pos") or ORIGIN))
    if kind == "free":
        align = a.get("align", "auto")
        if align == "true" or (align == "auto" and settings.alignfree):
            report.leave_out("alignment of free joints with the principal axes (alignfree)", name)
        start = (*pose.place, *yaw_pitch_roll(pose.turn))
        motions = tuple(
            replace(m, start=s, rest=s) for m, s in zip(free_motions(), start, strict=True)
        )
        mjcf_joint = MjcfJoint(
            name, kind, kind, motions, (), ORIGIN, IDENTITY_TRANSFORM, 0.0, spring
        )
        return _with_turn_forces(mjcf_joint, own, report)
    if kind == "ball":
        motions = tuple(replace(m, note=join_notes(m.note, note)) for m in free_motions()[3:])
        mjcf_joint = MjcfJoint(
            name, kind, "spherical", motions, (), anchor, IDENTITY_TRANSFORM, 0.0, spring
        )
        return _with_turn_forces(mjcf_joint, own, report)
    axis = unit_vector(a.numbers("axis", 3) or (0.0, 0.0, 1.0), "axis", a)
    if axis is None:
        return None
    x, y, z = (rounded(c, 1.0) for c in apply(placed.pose.turn, axis))
    axis = unit((x, y, z))
    ref = value("ref")
    motion = JointMotion(
        name,
        "rad" if turns else "m",
        start=ref,
        rest=value("springref"),
        note=note,
        mimics=None,
        limits=ends,
        driven=driven,
        **own,
    )
    if turns:
        zero = Transform(ORIGIN, from_axis_angle(axis, -ref) if ref else IDENTITY)
        return MjcfJoint(name, kind, "revolute", (motion,), (axis,), anchor, zero, 0.0, spring)
    # sliding does not depend on the place: at the body's origin the frames stay simple
    zero = Transform(scaled(axis, -ref) if ref else ORIGIN, IDENTITY)
    return MjcfJoint(name, kind, "prismatic", (motion,), (axis,), ORIGIN, zero, 0.0, spring)


def _with_turn_forces(joint: MjcfJoint, own: dict[str, float], report: ImportReport) -> MjcfJoint:
    """Return a free or ball joint with damping, friction and springs on each coordinate.

    In MuJoCo these act on the angular velocity and on the total angle of rotation. Applied to each
    of the three angles they are equivalent only near zero angles, which is reported.
    """
    springs = ("damping", "stiffness") if any(joint.spring) else ()
    keys = [key for key in ("damping", "friction", "stiffness") if own[key] or key in springs]
    if keys:
        report.leave_out(
            f"{' and '.join(keys)} of whole turns: here they act on each of the three angles, "
            "which is the same near zero angles only",
            joint.name,
        )
    motions = tuple(
        replace(
            m,
            damping=own["damping"],
            friction=own["friction"],
            stiffness=own["stiffness"],
            rest=m.rest if "stiffness" in keys else 0.0,
            armature=own["armature"] if m.unit == "m" else 0.0,
        )
        for m in joint.motions
    )
    return replace(joint, motions=motions, armature=own["armature"])


def _limits(
    a: AttributeReader, kind: str, settings: Settings, name: str
) -> tuple[str, tuple[float, float], tuple[float, float]]:
    """Return the limits of a joint as text for its note, and those of position and of force.

    All are reported as left out.
    """
    notes, ends, driven = [], JointMotion.limits, JointMotion.driven
    limits = a.numbers("range", 2)
    if limits and kind != "free" and is_limited(a, "limited", settings):
        off = "limit" in settings.disabled
        what = "joints whose limits the file disables (<flag>)" if off else LIMITS
        a.report.leave_out(what, name)
        low, high = (settings.angle(v) if kind != "slide" else v for v in limits)
        of = "rad" if kind != "slide" else "m"
        if off:
            ends = (low, high) if kind != "ball" else ends
        elif kind == "ball":
            notes.append(f"turns by {high:.6g} rad at most")
        else:
            notes.append(f"from {low:.6g} to {high:.6g} {of}")
            ends = (low, high)
    force = a.numbers("actuatorfrcrange", 2)
    if force and kind in {"hinge", "slide"} and is_limited(a, "actuatorfrclimited", settings):
        a.report.leave_out("limits of the actuators' force on joints, kept as notes", name)
        newton = "N m" if kind == "hinge" else "N"
        notes.append(f"driven with {force[0]:.6g} to {force[1]:.6g} {newton}")
        driven = (force[0], force[1])
    return join_notes(*notes), ends, driven


def without_limits(joint: MjcfJoint) -> MjcfJoint:
    """Return the joint without its position limits."""
    return replace(joint, motions=tuple(replace(m, limits=UNLIMITED) for m in joint.motions))


def is_limited(a: AttributeReader, key: str, settings: Settings) -> bool:
    """Return True if a range of an element is active.

    The attribute `key` (such as "limited") activates it by "true". With "auto", the default, it is
    active if the file's setting `autolimits` is true.
    """
    word = a.get(key, "auto")
    return word == "true" or (word == "auto" and settings.autolimits)


def unique_name(name: str, taken: Collection[str]) -> str:
    """Return `name`, with a number appended to it if it is already in `taken`."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


def with_coordinate_names(joints: Sequence[MjcfJoint]) -> list[MjcfJoint]:
    """Return the joints with unique names of their coordinates.

    The coordinate of a hinge or slide has the name of its joint. The coordinates of a free joint
    are x, y, z, yaw, pitch and roll, those of a ball joint yaw, pitch and roll. The joint's name is
    appended to them, except for a free joint that is the only one in the file.
    """
    taken = {joint.name for joint in joints if joint.type in {"hinge", "slide"}}
    several = sum(joint.type == "free" for joint in joints) > 1
    out = []
    for joint in joints:
        if joint.type in {"free", "ball"}:
            short = joint.type == "free" and not several
            motions = []
            for m in joint.motions:
                new = unique_name(m.name if short else f"{m.name}_{joint.name}", taken)
                taken.add(new)
                motions.append(replace(m, name=new))
            joint = replace(joint, motions=tuple(motions))
        out.append(joint)
    return out


# --- fixed tendons --------------------------------------------------------------------------------

LEFT = "tendons"  # kind in the report of tendons that have no effect


class Tendons:
    """The tendons of an MJCF file.

    `fixed` contains those that are linear combinations of joint positions, by name.
    """

    def __init__(self, root: Tag, joints: Sequence[MjcfJoint], reader: Reader) -> None:
        self.fixed: dict[str, Tendon] = {}
        self._reader = reader
        self._tags = [tag for section in root.each("tendon") for tag in section.children]
        self._joints = {joint.name: joint for joint in joints}
        self._driven: set[str] = set()
        used_names = {m.name for joint in joints for m in joint.motions}
        for tag in self._tags:
            name = tag.get("name")
            reader.report.leave_out(LEFT, f"{tag.kind} {name}".rstrip())
            terms = self._terms(tag) if tag.kind == "fixed" else None
            if not terms:
                continue
            tendon = self._read(Tendon(unique_name(name or "tendon", used_names), terms), tag)
            used_names.add(tendon.name)
            self.fixed[name or tendon.name] = tendon
            if tendon.has_forces:
                self.mark_modelled(name)

    @property
    def acting(self) -> tuple[Tendon, ...]:
        """The fixed tendons that have stiffness, damping, armature or an actuator."""
        return tuple(t for name, t in self.fixed.items() if t.has_forces or name in self._driven)

    def has_tendon(self, name: str, a: AttributeReader) -> bool:
        """Return True if the file has a tendon called `name`; otherwise report a fault."""
        names = {tag.get("name") for tag in self._tags}
        if name not in names:
            a.fault(missing_message("tendon", name, names))
        return name in names

    def mark_modelled(self, name: str) -> None:
        """Record that a fixed tendon is modelled, so that it is not listed as left out."""
        self._reader.report.mark_read(LEFT, f"fixed {name}".rstrip())

    def mark_driven(self, name: str) -> str:
        """Record that an actuator drives a tendon, and return the unique name of the tendon.

        `name` is the tendon's name in the file. It is a fixed tendon: a linear combination of joint
        positions.
        """
        self._driven.add(name)
        self.mark_modelled(name)
        return self.fixed[name].name

    def _terms(self, tag: Tag) -> tuple[tuple[float, str], ...]:
        """Return the terms of a fixed tendon; none if it refers to free, ball or unknown joints."""
        terms = []
        for each in tag.each("joint"):
            a = self._reader.own_attributes(each)
            joint = a.get("joint")
            if joint not in self._joints:
                a.fault(
                    missing_message("joint", joint, self._joints) if joint else "it needs a joint"
                )
                return ()
            if self._joints[joint].type in {"free", "ball"}:
                return ()
            terms.append((a.number("coef", 1.0), self._joints[joint].motions[0].name))
        return tuple(terms)

    def _read(self, tendon: Tendon, tag: Tag) -> Tendon:
        report, name = self._reader.report, tag.get("name")
        a = self._reader.attributes_with_defaults(Placed(tag, "", IDENTITY_TRANSFORM, ""), "tendon")
        own = {}
        for key in ("stiffness", "damping"):
            own[key], *more = a.numbers(key, 3, 1) or (0.0,)
            if any(more):
                report.leave_out(f"{key} in the square and cube of tendons", name)
        own["armature"] = a.number("armature")
        for key, value in own.items():
            if value < 0:
                a.fault(f"{key} must not be negative")
        for key, what in (("", "length"), ("actuatorfrc", "force")):
            if a.numbers(f"{key}range", 2) and is_limited(
                a, f"{key}limited", self._reader.settings
            ):
                report.leave_out(f"limits of {what} of tendons", name)
        note_unread_attributes(a, "tendon", name)
        disabled = self._reader.settings.disabled
        for key, effect in (("stiffness", "spring"), ("damping", "damper")):
            own[key] = 0.0 if effect in disabled else own[key]
        return replace(
            tendon,
            stiffness=own["stiffness"],
            damping=own["damping"],
            armature=own["armature"],
            rest=self._rest_range(tendon, a),
        )

    def _rest_range(self, tendon: Tendon, a: AttributeReader) -> Range:
        """Return the range in which its spring is slack: springlength, or the joints' springref."""
        slack = a.numbers("springlength", 2, 1) or (-1.0,)
        if {*slack} != {-1.0}:
            return slack[0], slack[-1]
        rests = {joint.motions[0].name: joint.motions[0].rest for joint in self._joints.values()}
        length = sum(by * rests[q] for by, q in tendon.terms)
        return length, length
