"""Actuators and key frames of an MJCF file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from eomc.robots.limits import both, through
from eomc.robots.mjcf.file import ACTUATORS, Given, Report, missing
from eomc.robots.mjcf.joints import Found, fresh, limited
from eomc.robots.mjcf.masses import STILL, Placed, Reader
from eomc.robots.robot import UNLIMITED, Drive, joined
from eomc.robots.rotations import from_quaternion, yaw_pitch_roll
from eomc.robots.xml import Tag


def actuated(
    root: Tag, joints: Sequence[Found], reader: Reader
) -> tuple[list[Found], tuple[Drive, ...]]:
    """The joints with their actuators' armature and damping, and the drives of hinges and slides.

    Of an actuator whose force is gain times its control the input is the control; of any other
    (servos, muscles, ...) it is the force, before the gear, which is reported.
    """
    report = reader.report
    found = {joint.name: joint for joint in joints}
    drives: list[Drive] = []
    tags = [tag for section in root.each("actuator") for tag in section.children]
    named = {tag.attributes["name"] for tag in tags if "name" in tag.attributes}
    for tag in tags:
        if tag.kind not in ACTUATORS:
            report.leave("elements that MJCF does not have", f"{tag.kind} in actuator")
            continue
        a = reader.given(Placed(tag, "", STILL, ""), "actuator")
        on = a.get("joint", a.get("jointinparent", ""))
        name = a.get("name") or fresh(f"{on or 'no'}_{tag.kind}", named)
        named.add(name)
        if not on:
            report.leave("actuators on tendons, sites, bodies and slider-cranks", name)
            continue
        if on not in found:
            a.fault(missing("joint", on, found))
            continue
        joint = found[on]
        if joint.type in {"free", "ball"}:
            report.leave("actuators on free and ball joints", name)
            continue
        gear = (a.numbers("gear", 6, 1) or (1.0,))[0]
        damping = a.numbers("damping", 3, 1) or (0.0,)
        if any(damping[1:]):
            report.leave("damping in the square and cube of actuators", name)
        (motion,) = joint.motions
        motion = replace(
            motion,
            armature=motion.armature + gear**2 * a.number("armature"),
            damping=motion.damping + gear**2 * damping[0],
        )
        found[on] = joint._replace(motions=(motion,))
        law = a.get(" law", "general")
        laws = [a.get(key, "none") for key in ("dyntype", "biastype")]
        plain = law in {"motor", "general"}
        plain = plain and {*laws, a.get("gaintype", "fixed")} == {"none", "fixed"}
        gain = (a.numbers("gainprm", 100, 1) or (1.0,))[0] if plain else 1.0
        if not plain:
            report.leave("laws of actuators, whose input here is their force", f"{name} ({law})")
        if a.number("delay"):
            report.leave("delays of actuators", name)
        control, force = (_range(a, key, reader) for key in ("ctrl", "force"))
        limits = both(control if plain else UNLIMITED, through(force, gain))
        if limits is None:
            report.leave("ranges of actuators that exclude each other", name)
        note = _noted(a, name, control, force, plain)
        drives.append(Drive(name, on, gear * gain, note, limits or UNLIMITED))
    return list(found.values()), tuple(drives)


def _range(a: Given, key: str, reader: Reader) -> tuple[float, float]:
    """A range of an actuator that holds, or an unlimited one."""
    values = a.numbers(f"{key}range", 2)
    if not values or not limited(a, f"{key}limited", reader.settings):
        return UNLIMITED
    return values[0], values[1]


def _noted(
    a: Given, name: str, control: tuple[float, float], force: tuple[float, float], plain: bool
) -> str:
    """Ranges of an actuator in words, for its note; reported as left out."""
    words = []
    for what, ends in (("input" if plain else "control", control), ("force", force)):
        if ends != UNLIMITED:
            kind = "actuators" if what != "control" else "controls whose law is left out"
            a.report.leave(f"limits of {kind}, kept as notes", name)
            words.append(f"{what} from {ends[0]:.6g} to {ends[1]:.6g}")
    return joined(*words)


def started(root: Tag, joints: Sequence[Found], report: Report) -> list[Found]:
    """The joints with the start of the key frame "home"; singular starts are reported."""
    sizes = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
    size = sum(sizes[joint.type] for joint in joints)
    out = list(joints)
    for tag in (tag for section in root.each("keyframe") for tag in section.each("key")):
        a = Given(tag.attributes, tag, report)
        if a.get("name") != "home" or "qpos" not in a:
            report.leave("key frames", a.get("name"))
            continue
        others = ("qvel", "act", "ctrl", "mpos", "mquat")
        for key in others:
            if any(a.numbers(key, 1_000_000, 0) or ()):
                report.leave("what the key frame home has besides positions", key)
        values = a.numbers("qpos", 1_000_000, 0) or ()
        if len(values) != size:
            report.leave(f"the start of the key frame home: it has not the {size} numbers of qpos")
            continue
        out, at = [], 0
        for joint in joints:
            mine = values[at : at + sizes[joint.type]]
            at += len(mine)
            if joint.type in {"ball", "free"}:
                if not any(mine[-4:]):
                    a.fault(f"the quaternion of joint {joint.name} has the length zero")
                    continue
                w, x, y, z = mine[-4:]
                mine = (*mine[:-4], *yaw_pitch_roll(from_quaternion(w, x, y, z)))
            motions = (replace(m, start=v) for m, v in zip(joint.motions, mine, strict=True))
            out.append(joint._replace(motions=tuple(motions)))
    for joint in out:
        if joint.type in {"ball", "free"} and abs(math.cos(joint.motions[-2].start)) < 1e-6:
            report.leave(
                "to be looked at: yaw, pitch and roll are singular at the start, "
                "with a pitch of a quarter turn",
                joint.name,
            )
    return out
