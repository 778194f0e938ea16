"""Joints of an MJCF file: their motions, axes, limits, and the names of coordinates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from eomc.base.spatial import apply, plus, scaled
from eomc.robots.mjcf import file as text
from eomc.robots.mjcf import masses
from eomc.robots.mjcf.file import Attributes, Settings, Tag, Told
from eomc.robots.mjcf.masses import STILL, Placed, Pose, Reader
from eomc.robots.robot import Motion, free_motions, joined
from eomc.robots.rotations import (
    IDENTITY,
    ORIGIN,
    Vector,
    from_axis_angle,
    unit,
    yaw_pitch_roll,
)


class Found(NamedTuple):
    """A joint as it is read. kind: as in joints.JOINTS. type: as in MJCF.

    anchor: where it stands in the body's frame. zero: from the body's frame there to the frame in
    which the joint's coordinates are zero. armature: of all turns of a free or ball joint.
    """

    name: str
    type: str
    kind: str
    motions: tuple[Motion, ...]
    axes: tuple[Vector, ...]
    anchor: Vector
    zero: Pose
    armature: float


TYPES = ("hinge", "slide", "ball", "free")


def joint_of(placed: Placed, name: str, pose: Pose, reader: Reader) -> Found | None:
    """A joint; `pose` is where its body stands in the parent. None for a fault.

    The motions of free and ball joints get their names in _named.
    """
    told, settings, tag = reader.told, reader.settings, placed.tag
    text.unknown(tag, told)
    free = tag.kind == "freejoint"
    a = tag.attributes if free else masses.attributes_of(placed, "joint", reader)
    kind = "free" if free else text.choice(a, "type", tag, told, TYPES)
    turns = kind != "slide"

    def value(key: str) -> float:
        number = text.number(a, key, tag, told)
        return settings.angle(number) if kind == "hinge" else number

    def first(key: str) -> float:
        """The linear coefficient; those of the square and the cube are told."""
        numbers = text.numbers(a, key, tag, told, 3, 1) or (0.0,)
        if any(numbers[1:]):
            told.leave(f"{key} in the square and cube of joints", name)
        return numbers[0]

    own = {
        "damping": first("damping"),
        "friction": text.number(a, "frictionloss", tag, told),
        "armature": text.number(a, "armature", tag, told),
        "stiffness": first("stiffness"),
    }
    for key, number in own.items():
        if number < 0:
            told.fault(tag, f"{key} must not be negative")
    spring = text.numbers(a, "springdamper", tag, told, 2)
    if spring and min(spring) > 0:
        told.leave("stiffness and damping given by springdamper", name)
        own |= {"stiffness": 0.0, "damping": 0.0}
    if text.number(a, "springyield", tag, told):
        told.leave("yield of the springs of joints", name)
    note = _limits(a, kind, tag, reader, name)
    at = text.vector(a, "pos", tag, told) or ORIGIN
    anchor = plus(placed.pose.place, apply(placed.pose.turn, at))
    if kind == "free":
        align = a.get("align", "auto")
        if align == "true" or (align == "auto" and settings.alignfree):
            told.leave("alignment of free joints with the principal axes (alignfree)", name)
        start = (*pose.place, *yaw_pitch_roll(pose.turn))
        motions = tuple(
            replace(m, start=s, rest=s) for m, s in zip(free_motions(), start, strict=True)
        )
        return _balled(Found(name, kind, kind, motions, (), ORIGIN, STILL, 0.0), own, told)
    if kind == "ball":
        motions = tuple(replace(m, note=joined(m.note, note)) for m in free_motions()[3:])
        return _balled(Found(name, kind, "spherical", motions, (), anchor, STILL, 0.0), own, told)
    axis = masses.direction(
        text.numbers(a, "axis", tag, told, 3) or (0.0, 0.0, 1.0), "axis", tag, told
    )
    if axis is None:
        return None
    axis = unit(_cleaned(apply(placed.pose.turn, axis)))
    ref = value("ref")
    motion = Motion(
        name,
        "rad" if turns else "m",
        start=ref,
        rest=value("springref") if own["stiffness"] else 0.0,
        note=note,
        **own,
    )
    if turns:
        zero = Pose(ORIGIN, from_axis_angle(axis, -ref) if ref else IDENTITY)
        return Found(name, kind, "revolute", (motion,), (axis,), anchor, zero, 0.0)
    # sliding does not depend on the place: at the body's origin the frames stay simple
    zero = Pose(scaled(axis, -ref) if ref else ORIGIN, IDENTITY)
    return Found(name, kind, "prismatic", (motion,), (axis,), ORIGIN, zero, 0.0)


def _cleaned(v: Vector) -> Vector:
    """A unit vector without what rounding left of zeros."""
    x, y, z = (masses.rounded(c, 1.0) for c in v)
    return x, y, z


def _balled(joint: Found, own: dict[str, float], told: Told) -> Found:
    """A free or ball joint with what acts along its coordinates.

    MuJoCo lets damping, friction and springs of turns act on the angular velocity and on the
    angle of the whole turn; per angle they are the same only near zero angles, which is told.
    """
    given = [key for key in ("damping", "friction", "stiffness") if own[key]]
    if given:
        told.leave(
            f"{' and '.join(given)} of whole turns: here they act on each of the three angles, "
            "which is the same near zero angles only",
            joint.name,
        )
    motions = tuple(
        replace(
            m,
            damping=own["damping"],
            friction=own["friction"],
            stiffness=own["stiffness"],
            rest=m.rest if own["stiffness"] else 0.0,
            armature=own["armature"] if m.unit == "m" else 0.0,
        )
        for m in joint.motions
    )
    return joint._replace(motions=motions, armature=own["armature"])


def _limits(a: Attributes, kind: str, tag: Tag, reader: Reader, name: str) -> str:
    """The limits of a joint in words, for its note; told as left out."""
    told, settings = reader.told, reader.settings
    notes = []
    limits = text.numbers(a, "range", tag, told, 2)
    if limits and kind != "free" and limited(a, "limited", settings):
        told.leave("limits of joints, kept as notes", name)
        low, high = (settings.angle(v) if kind != "slide" else v for v in limits)
        of = "rad" if kind != "slide" else "m"
        if kind == "ball":
            notes.append(f"turns by {high:.6g} rad at most")
        else:
            notes.append(f"from {low:.6g} to {high:.6g} {of}")
    force = text.numbers(a, "actuatorfrcrange", tag, told, 2)
    if force and kind in {"hinge", "slide"} and limited(a, "actuatorfrclimited", settings):
        told.leave("limits of the actuators' force on joints, kept as notes", name)
        notes.append(
            f"driven with {force[0]:.6g} to {force[1]:.6g} {'N m' if kind == 'hinge' else 'N'}"
        )
    return joined(*notes)


def limited(a: Attributes, key: str, settings: Settings) -> bool:
    """Whether a range that is given holds."""
    word = a.get(key, "auto")
    return word == "true" or (word == "auto" and settings.autolimits)


def fresh(name: str, taken: Collection[str]) -> str:
    """`name`, with a number behind it where another has it."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


def named(joints: Sequence[Found]) -> list[Found]:
    """With a name of its own for each coordinate: its joint's, or x to roll of a lone free one."""
    taken = {joint.name for joint in joints if joint.type in {"hinge", "slide"}}
    several = sum(joint.type == "free" for joint in joints) > 1
    out = []
    for joint in joints:
        if joint.type in {"free", "ball"}:
            short = joint.type == "free" and not several
            motions = []
            for m in joint.motions:
                new = fresh(m.name if short else f"{m.name}_{joint.name}", taken)
                taken.add(new)
                motions.append(replace(m, name=new))
            joint = joint._replace(motions=tuple(motions))
        out.append(joint)
    return out
