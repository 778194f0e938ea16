"""Joints of an MJCF file, the fixed tendons over them, and equality constraints.

A joint has motions, axes, limits, and names of its coordinates. The length of a fixed tendon is a
linear combination of joint positions; springs, dampers and actuators act along it. Equality
constraints connect or weld bodies, or couple joints or tendons. MuJoCo's are soft, with the
stiffness given by solref and solimp; here they are exact. The point on the second body follows from
the pose of the file, as in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base.spatial import apply, as_inertia, plus, scaled, transposed
from eomc.robots import geometry
from eomc.robots.geometry import (
    IDENTITY,
    IDENTITY_TRANSFORM,
    ORIGIN,
    Matrix,
    Transform,
    Vector,
    from_axis_angle,
    rounded,
    times,
    unit,
    yaw_pitch_roll,
)
from eomc.robots.mjcf.file import (
    Settings,
    note_unread_attributes,
)
from eomc.robots.mjcf.masses import Placed, Reader, read_pose, unit_vector
from eomc.robots.robot import (
    Coupling,
    JointMotion,
    Range,
    Robot,
    RobotBody,
    RobotLoop,
    Tendon,
    body_pose,
    free_motions,
    initial_poses,
    join_notes,
)
from eomc.robots.stiffness import mass_matrix
from eomc.robots.xml import AttributeReader, ImportReport, Tag
from eomc.scene.scene import WORLD


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

    def with_motions(self, **values: Any) -> MjcfJoint:
        """Return the joint with other values of attributes of all its motions."""
        return replace(self, motions=tuple(replace(m, **values) for m in self.motions))


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

    own = {
        "damping": a.linear_coefficient("damping", "joints", name),
        "friction": a.number("frictionloss"),
        "armature": a.number("armature"),
        "stiffness": a.linear_coefficient("stiffness", "joints", name),
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
    anchor = placed.pose.point(a.vector("pos") or ORIGIN)
    if kind in ("free", "ball"):
        motions = free_motions()
        if kind == "ball":
            motions = tuple(replace(m, note=join_notes(m.note, note)) for m in motions[3:])
        else:
            align = a.get("align", "auto")
            if align == "true" or (align == "auto" and settings.alignfree):
                what = "alignment of free joints with the principal axes (alignfree)"
                report.leave_out(what, name)
            start = (*pose.place, *yaw_pitch_roll(pose.turn))
            pairs = zip(motions, start, strict=True)
            motions = tuple(replace(m, start=s, rest=s) for m, s in pairs)
            anchor = ORIGIN
        scene_kind = "free" if kind == "free" else "spherical"
        return _with_turn_forces(
            MjcfJoint(name, kind, scene_kind, motions, (), anchor, IDENTITY_TRANSFORM, 0.0, spring),
            own,
            report,
        )
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


def with_motions(bodies: Sequence[RobotBody], joints: Sequence[MjcfJoint]) -> tuple[RobotBody, ...]:
    """Return the bodies with the motions of their joints and the armature of rotations."""
    waiting = iter(joints)
    out = []
    for body in bodies:
        if body.joint != "fixed":
            joint = next(waiting)
            xx, yy, zz, *rest = body.inertia
            a = joint.armature
            note = f"the inertia holds the joint's armature {a:g}" if a else ""
            body = replace(
                body,
                motions=joint.motions,
                inertia=as_inertia([xx + a, yy + a, zz + a, *rest]),
                rotor=a,
                note=join_notes(body.note, note),
            )
        out.append(body)
    return tuple(out)


# --- damping and stiffness from time constants and ratios -----------------------------------------


def mass_matrix_at_start(
    bodies: Sequence[RobotBody], joints: Sequence[MjcfJoint], tendons: Iterable[Tendon]
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the mass matrix in the pose of the file, and the names of the coordinates of its rows.

    Coordinates are measured from this pose: free and ball joints turn about z, y and x there.
    """
    placed = []
    for body in with_motions(bodies, joints):
        offset, rotation = body_pose(body)
        motions = tuple(replace(m, start=0.0) for m in body.motions)
        placed.append(replace(body, offset=offset, rotation=rotation, motions=motions))
    robot = Robot("", "", ORIGIN, tuple(placed), tendons=tuple(tendons))
    rows = [m.name for m in robot.motions]
    return mass_matrix(robot, rows), rows


def with_spring_dampers(
    joints: Sequence[MjcfJoint],
    bodies: Sequence[RobotBody],
    tendons: Iterable[Tendon],
    disabled: Collection[str],
) -> list[MjcfJoint]:
    """Return the joints with each `springdamper` replaced by a stiffness and a damping.

    MJCF specifies a springdamper by a time constant t and a damping ratio r. The stiffness is
    m/(t r)^2 and the damping 2 m/t, where 1/m is the mean of M^-1 along the joint's coordinates and
    M is the mass matrix. The damping of actuators is added. `disabled` contains the effects that
    flags of the file disable.
    """
    if not any(any(joint.spring) for joint in joints):
        return list(joints)
    masses, rows = mass_matrix_at_start(bodies, joints, tendons)
    if not np.isfinite(masses).all():  # masses that overflow
        return list(joints)
    mobilities = np.diag(np.linalg.lstsq(masses, np.eye(len(rows)), rcond=None)[0])
    out = []
    for joint in joints:
        time, ratio = joint.spring
        along = mobilities[[rows.index(m.name) for m in joint.motions]].mean()
        if time and along > 0:
            stiffness = 0.0 if "spring" in disabled else float(1 / (along * (time * ratio) ** 2))
            damping = 0.0 if "damper" in disabled else float(2 / (along * time))
            motions = (
                replace(m, stiffness=stiffness, damping=m.damping + damping) for m in joint.motions
            )
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

    @property
    def names(self) -> set[str]:
        """The names of all tendons, also of those through space."""
        return {name for tag in self._tags if (name := tag.get("name"))}

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
            joint = a.reference("joint", "joint", self._joints)
            if not joint:
                return ()
            if self._joints[joint].type in {"free", "ball"}:
                return ()
            terms.append((a.number("coef", 1.0), self._joints[joint].motions[0].name))
        return tuple(terms)

    def _read(self, tendon: Tendon, tag: Tag) -> Tendon:
        report, name = self._reader.report, tag.get("name")
        a = self._reader.attributes_with_defaults(Placed(tag), "tendon")
        own = {key: a.linear_coefficient(key, "tendons", name) for key in ("stiffness", "damping")}
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


# --- equality constraints -------------------------------------------------------------------------

POLYNOMIAL = 5  # coefficients of a coupling
KINDS = ("connect", "weld", "joint", "tendon")
SOFT = "the softness of equality constraints (solref, solimp), which hold exactly here"


Sides = tuple[tuple[float, JointMotion], ...]  # a sum of coordinates, each with its factor


@dataclass(frozen=True)
class _Ends:
    """Frames of the bodies in the pose of the file, in the scene's and in the file's convention.

    poses: of the scene's frames in the world. anchors: origins of the scene's frames in the file's.
    """

    poses: Mapping[str, Transform]
    anchors: Mapping[str, Vector]

    def file_pose(self, body: str) -> Transform:
        """Return the pose in the world of the frame that the file defines for a body.

        `body` is the body's name. The frames of the file and of the scene differ by an offset.
        """
        back = Transform(scaled(self.anchors.get(body, ORIGIN), -1.0), IDENTITY)
        return self.poses[body].compose(back)

    def point(self, body: str, place: Vector) -> Vector:
        """Return the position of a point in the body's frame of the scene (m).

        `body` is the body's name, and `place` the position of the point in the world (m).
        """
        pose = self.poses[body]
        x, y, z = apply(transposed(pose.turn), plus(place, scaled(pose.place, -1.0)))
        return _rounded_length(x), _rounded_length(y), _rounded_length(z)

    def shifted(self, body: str, point: Vector) -> Vector:
        """Return the position of a point in the body's frame of the scene (m).

        `body` is the body's name, and `point` the position of the point in the body's frame of the
        file (m).
        """
        return plus(point, scaled(self.anchors.get(body, ORIGIN), -1.0))


def _rounded_length(x: float) -> float:
    """Return a computed length, m, rounded to 15 digits."""
    return rounded(float(f"{x:.15g}"), 1.0)


def read_equalities(
    root: Tag,
    bodies: Sequence[RobotBody],
    joints: Sequence[MjcfJoint],
    tendons: Tendons,
    anchors: Mapping[str, Vector],
    reader: Reader,
) -> tuple[tuple[RobotLoop, ...], tuple[Coupling, ...]]:
    """Return the loops and couplings that the equality constraints of a file define.

    Bodies and joints are in the pose of the file. `anchors` maps each body to the origin of its
    frame in the scene, in the body's frame in the file (m).
    """
    reading = _Reading(tendons, _Ends(initial_poses(bodies), anchors), joints, reader)
    for section in root.each("equality"):
        for tag in section.children:
            reading.read(tag)
    return tuple(reading.loops), tuple(reading.couplings)


class _Reading:
    """Reader of equality constraints, with those read so far."""

    def __init__(
        self, tendons: Tendons, ends: _Ends, joints: Sequence[MjcfJoint], reader: Reader
    ) -> None:
        self.ends = ends
        self.reader = reader
        self.joints = {joint.name: joint for joint in joints}
        self.tendons = tendons
        self.taken: set[str] = set()
        self.loops: list[RobotLoop] = []
        self.couplings: list[Coupling] = []

    def read(self, tag: Tag) -> None:
        """Convert one equality constraint, or note in the report that it is left out.

        `tag` is the element of the constraint in the file.
        """
        report = self.reader.report
        a = self.reader.attributes_with_defaults(Placed(tag), "equality")
        ends = [a.get(f"{what}{k}") for k in "12" for what in ("body", "joint", "tendon", "site")]
        name = a.get("name") or "_".join([tag.kind, *filter(None, ends)])
        name = unique_name(name, self.taken)
        if tag.kind not in KINDS:
            report.leave_out("equality constraints of other kinds", f"{tag.kind} {name}")
        elif not a.is_true("active", True):
            report.leave_out("equality constraints that are not active", name)
        elif "equality" in self.reader.settings.disabled:
            report.leave_out("equality constraints that the file disables (<flag>)", name)
        else:
            self.taken.add(name)
            if tag.kind in ("connect", "weld"):
                self._loop(name, tag.kind, a)
            else:
                self._coupling(name, tag.kind, a)

    # --- bodies

    def _loop(self, name: str, kind: str, a: AttributeReader) -> None:
        sites = ["site1", "site2"]
        by_sites = any(a.get(key) for key in sites)
        attachments = [self._site(s, a) for s in sites] if by_sites else self._anchored(kind, a)
        places = [place for place in attachments if place]
        if len(places) < 2:
            return
        one, other = places
        if one[0] == other[0]:
            a.fault(f'it holds body "{one[0]}" to itself; name two bodies')
            return
        turn = times(transposed(one[2]), other[2]) if kind == "weld" else IDENTITY
        joint = "weld" if kind == "weld" else "spherical"
        loop = RobotLoop(name, joint, (one[0], other[0]), (one[1], other[1]), turn)
        self.loops.append(loop)
        self.reader.report.leave_out(SOFT, name)

    def _site(self, key: str, a: AttributeReader) -> tuple[str, Vector, Matrix] | None:
        """Return a site's body, its position there, and the body's axes in the site's frame."""
        name = a.reference(key, "site", self.reader.sites)
        if not name:
            return None
        placed = self.reader.sites[name]
        self.reader.report.mark_read("sites", name)
        site = placed.pose.compose(
            read_pose(self.reader.attributes_with_defaults(placed, "site"), self.reader.settings)
        )
        world = self.ends.file_pose(placed.body).compose(site)
        return placed.body, self.ends.point(placed.body, world.place), transposed(site.turn)

    def _anchored(self, kind: str, a: AttributeReader) -> list[tuple[str, Vector, Matrix] | None]:
        """Return both bodies, each with the common point and its rotation in a common frame."""
        keys = ["body1", *["body2"] * ("body2" in a)]
        names = [a.reference(key, "body", self.ends.poses) for key in keys]
        if not all(names):
            return [None, None]
        one, other = names = [*names, WORLD][:2]
        first, second = self.ends.file_pose(one), self.ends.file_pose(other)
        anchor = a.vector("anchor")
        if kind == "connect":
            if anchor is None:
                if "anchor" not in a:
                    a.fault('it needs an anchor="x y z", where the bodies meet, in that of body1')
                return [None, None]
            place = first.compose(Transform(anchor, IDENTITY)).place
            return [(name, self.ends.point(name, place), IDENTITY) for name in names]
        point = anchor or ORIGIN  # in the frame of the second body
        place, turn = (
            second.compose(Transform(point, IDENTITY)).place,
            times(transposed(first.turn), second.turn),
        )
        on_first = self.ends.point(one, place)
        relative = a.numbers("relpose", 7)
        if relative and any(relative[3:]):  # a zero quaternion means the pose of the file
            x, y, z, *quaternion = relative
            on_first = self.ends.shifted(one, (x, y, z))
            turn = geometry.from_quaternion(*quaternion)
        return [(one, on_first, IDENTITY), (other, self.ends.shifted(other, point), turn)]

    # --- joints

    def _coupling(self, name: str, kind: str, a: AttributeReader) -> None:
        read = self._joint if kind == "joint" else self._tendon
        first = read(f"{kind}1", name, a)
        second = read(f"{kind}2", name, a) if a.get(f"{kind}2") else ()
        if first is None or second is None:
            return
        coefficients = a.numbers("polycoef", POLYNOMIAL, 1) or (0.0, 1.0)
        polynomial = (*coefficients, *(0.0,) * POLYNOMIAL)[:POLYNOMIAL]
        if len(coefficients) == 1:
            polynomial = (coefficients[0], 1.0, 0.0, 0.0, 0.0)
        if not second:
            polynomial = (polynomial[0], 0.0, 0.0, 0.0, 0.0)
        elif not any(polynomial[1:]):
            second = ()
        unit = {m.unit for _, m in first}.pop() if first else ""
        zeros = [sum((by * m.start for by, m in side), 0.0) for side in (first, second)]
        sides = [tuple((by, m.name) for by, m in side if by) for side in (first, second)]
        self.couplings.append(
            Coupling(name, sides[0], sides[1], zeros[0], zeros[1], polynomial, unit)
        )
        self.reader.report.leave_out(SOFT, name)

    def _joint(self, key: str, name: str, a: AttributeReader) -> Sides | None:
        """Return the coordinate of a joint, as a sum with one term; None if it has none."""
        joint = a.reference(key, "joint", self.joints)
        if not joint:
            return None
        mjcf_joint = self.joints[joint]
        if len(mjcf_joint.motions) > 1:
            self.reader.report.leave_out("couplings of free and ball joints", name)
            return None
        return ((1.0, mjcf_joint.motions[0]),)

    def _tendon(self, key: str, name: str, a: AttributeReader) -> Sides | None:
        """Return a tendon's length as a sum of coordinates; None if it is not fixed."""
        tendon = a.reference(key, "tendon", self.tendons.names)
        if not tendon:
            return None
        if tendon not in self.tendons.fixed:
            self.reader.report.leave_out("couplings of tendons through space", name)
            return None
        self.tendons.mark_modelled(tendon)
        motions = {m.name: m for joint in self.joints.values() for m in joint.motions}
        return tuple((by, motions[q]) for by, q in self.tendons.fixed[tendon].terms)
