"""Actuators and key frames of an MJCF file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from eomc.robots.geometry import IDENTITY_TRANSFORM, ORIGIN, from_quaternion, yaw_pitch_roll
from eomc.robots.mjcf.file import (
    ACTUATORS,
    MEASURES,
    note_unread_attributes,
)
from eomc.robots.mjcf.joints import (
    MjcfJoint,
    Tendons,
    is_limited,
    mass_matrix_at_start,
    unique_name,
)
from eomc.robots.mjcf.masses import Placed, Reader
from eomc.robots.robot import (
    UNLIMITED,
    Drive,
    JointMotion,
    Law,
    Range,
    RobotBody,
    Tendon,
    input_range,
    intersection,
    join_notes,
)
from eomc.robots.stiffness import gradient
from eomc.robots.xml import AttributeReader, ImportReport, Tag

# dyntype: dynamics from the control to the activation, which is the input here
DYNAMICS = {"none", "integrator", "filter", "filterexact"}
ACTIVATIONS = "activations of actuators, which are their inputs here, not what they follow"
BESIDES = "what the key frame home has besides positions and controls"
LAWLESS = "laws of actuators, whose input here is their force"

Loaded = TypeVar("Loaded", JointMotion, Tendon)


@dataclass(frozen=True)
class Actuator:
    """An actuator of an MJCF file.

    Attributes
    ----------
    drive : Drive or None
        The input of the scene; None if the actuator is left out.
    dynamics : str
        The dynamics between control and activation (dyntype in MJCF).
    lawful : bool
        Whether the input of the scene is the actuator's control or activation, and not its force.
    """

    drive: Drive | None
    dynamics: str
    lawful: bool


def read_actuators(
    root: Tag, bodies: Sequence[RobotBody], joints: Sequence[MjcfJoint], tendons: Tendons,
    reader: Reader,
) -> tuple[list[MjcfJoint], list[Actuator]]:  # fmt: skip
    """Return the joints and the actuators of a file.

    The armature and damping of actuators are added to the joints, and to `tendons` in place.
    `bodies` are in the pose of the file, and have masses.
    """
    by_name = {joint.name: joint for joint in joints}
    tags = [tag for section in root.each("actuator") for tag in section.children]
    names = {tag.attributes["name"] for tag in tags if "name" in tag.attributes}
    actuators: list[Actuator] = []
    for tag in tags:
        if tag.kind not in ACTUATORS:
            continue
        a = reader.attributes_with_defaults(Placed(tag, "", IDENTITY_TRANSFORM, ""), "actuator")
        on = a.get("joint", a.get("jointinparent", a.get("tendon")))
        name = a.get("name") or unique_name(f"{on or 'no'}_{tag.kind}", names)
        names.add(name)
        law, drive = _law(a), _drive(name, a, by_name, tendons, reader)
        if drive:
            ends = by_name[on].motions[0].limits if "tendon" not in a else UNLIMITED
            drive = _with_law(drive, law, a, ends, reader)
        actuators.append(Actuator(drive, a.get("dyntype", "none"), bool(drive and law)))
    joints = list(by_name.values())
    return joints, actuators if reader.report.faults else _with_damping_ratios(
        actuators, bodies, joints, tendons
    )


def _drive(
    name: str, a: AttributeReader, joints: dict[str, MjcfJoint], tendons: Tendons, reader: Reader
) -> Drive | None:
    """Return the drive of an actuator; add its armature and damping to its joint or tendon."""
    report = reader.report
    damps = a.linear_coefficient("damping", "actuators", name)
    gear = (a.numbers("gear", 6, 1) or (1.0,))[0]
    disabled = reader.settings.disabled
    load = gear**2 * a.number("armature"), 0.0 if "damper" in disabled else gear**2 * damps
    off = "actuation" in disabled or a.number("group") in reader.settings.off_groups
    key = next((key for key in ("joint", "jointinparent", "tendon") if a.get(key)), "")
    if key.startswith("joint"):
        on = a.reference(key, "joint", joints)
        if not on:
            return None
        joint = joints[on]
        if joint.type in {"free", "ball"}:
            report.leave_out("actuators on free and ball joints", name)
            return None
        (motion,) = joint.motions
        joints[on] = replace(joint, motions=(_with_load(motion, *load),))
    elif key == "tendon":
        on = a.reference(key, "tendon", tendons.names)
        if not on:
            return None
        if on not in tendons.fixed:
            report.leave_out("actuators on tendons through space", name)
            return None
        tendons.fixed[on] = _with_load(tendons.fixed[on], *load)
        if off and tendons.fixed[on].has_forces:
            tendons.mark_modelled(on)
        on = on if off else tendons.mark_driven(on)
    else:
        report.leave_out("actuators on sites, bodies and slider-cranks", name)
        return None
    if off:
        report.leave_out("actuators that the file disables (<flag>, actuatorgroupdisable)", name)
        return None
    note_unread_attributes(a, "actuator", name)
    return Drive(name, on, gear)


def _with_load(of: Loaded, armature: float, damping: float) -> Loaded:
    return replace(of, armature=of.armature + armature, damping=of.damping + damping)


def _with_law(
    drive: Drive, law: Law | None, a: AttributeReader, ends: Range, reader: Reader
) -> Drive:
    """Return the drive with the law of an actuator, its limits and its note.

    Without an affine law the input is the force, before the gear. With an activation the input is
    the activation. ends: limits of the joint.
    """
    name, report = drive.name, reader.report
    dynamics = a.get("dyntype", "none")
    control, active, force = (_range(a, key, reader) for key in ("ctrl", "act", "force"))
    inherits = a.number("inheritrange")
    if law and law.set_point == "kp" and inherits > 0:
        middle, half = sum(ends) / 2, (ends[1] - ends[0]) / 2
        if math.isfinite(half):
            mine = middle - inherits * half, middle + inherits * half
            control, active = (control, mine) if dynamics == "integrator" else (mine, active)
        else:
            report.leave_out("ranges of actuators that inherit those of what has none here", name)
    own, other = intersection(control, active) or control, UNLIMITED
    if not law:
        report.leave_out(LAWLESS, f"{name} ({a.get(' law', 'general')})")
        own, other = UNLIMITED, control
    elif dynamics == "integrator":
        own, other = active, control
    if "clampctrl" in reader.settings.disabled:
        own, other = (active if dynamics != "none" else UNLIMITED), UNLIMITED
    note = _range_note(a.report, name, own, other, force)
    if law and dynamics != "none":
        report.leave_out(ACTIVATIONS, f"{name} ({dynamics})")
        note = join_notes("its activation", note)
    if law and not law.has_constant_gain:
        gain, follows = 1.0, replace(law, force=intersection(force, UNLIMITED) or UNLIMITED)
        limits = intersection(own, UNLIMITED)
    else:
        gain, follows = law.gain[0] if law else 1.0, None
        limits = intersection(own, input_range(force, gain))
    if limits is None:
        report.leave_out("ranges of actuators that exclude each other", name)
    limits = limits or UNLIMITED
    return replace(drive, gear=drive.gear * gain, law=follows, limits=limits, note=note)


def _law(a: AttributeReader) -> Law | None:
    """Return the affine law of an actuator's force; None if it is not affine, or after a fault."""
    gain_type, bias_type = a.get("gaintype", "fixed"), a.get("biastype", "none")
    affine = gain_type in {"fixed", "affine"} and bias_type in {"none", "affine"}
    if not affine or a.get("dyntype", "none") not in DYNAMICS:
        return None
    faults = len(a.report.faults)
    for key in MEASURES if " law" in a else ():
        a.number(key)
    if len(a.report.faults) > faults:
        return None
    gain = (*(a.numbers("gainprm", 100, 1) or (1.0,)), 0.0, 0.0)
    bias = (*(a.numbers("biasprm", 100, 0) or ()), 0.0, 0.0, 0.0)
    return Law(
        (gain[0], gain[1], gain[2]) if gain_type == "affine" else (gain[0], 0.0, 0.0),
        (bias[0], bias[1], bias[2]) if bias_type == "affine" else ORIGIN,
    )


def _has_ratio(law: Law | None) -> bool:
    """Return True if the control law of an actuator specifies its damping as a damping ratio.

    In MJCF this is a position servo with a positive velocity coefficient.
    """
    return bool(law and law.bias[2] > 0 and law.set_point == "kp" and law.kp > 0)


def _servo_damping(
    law: Law, along: Iterable[tuple[float, str]], masses: NDArray[np.float64], rows: Sequence[str]
) -> float:
    """Return the damping kv of a servo from its damping ratio: ratio times 2 sqrt(kp m).

    m = 1/(J M^-1 J^T) is the mass that the servo moves, as in MuJoCo 4.

    Parameters
    ----------
    law : Law
        The servo, with the damping ratio as its velocity coefficient.
    along
        The gradient J of the servo's length (including its gear), as pairs (entry, coordinate).
    masses, rows
        The mass matrix M, and the coordinate of each of its rows.
    """
    J = gradient(along, rows)
    if not np.isfinite(masses).all():  # masses that overflow
        return 0.0
    mobility = float(J @ np.linalg.lstsq(masses, J, rcond=None)[0])
    return 2 * law.bias[2] * math.sqrt(law.kp / mobility) if mobility > 0 else 0.0


def _with_damping_ratios(
    actuators: Sequence[Actuator], bodies: Sequence[RobotBody], joints: Sequence[MjcfJoint],
    tendons: Tendons,
) -> list[Actuator]:  # fmt: skip
    """Return the actuators with damping ratios converted to damping."""
    if not any(each.drive and _has_ratio(each.drive.law) for each in actuators):
        return list(actuators)
    masses, rows = mass_matrix_at_start(bodies, joints, tendons.fixed.values())
    terms = {t.name: t.terms for t in tendons.fixed.values()}
    out = []
    for each in actuators:
        d = each.drive
        if d and d.law and _has_ratio(d.law):
            along = [(d.gear * by, q) for by, q in terms.get(d.coordinate, ((1.0, d.coordinate),))]
            kv = _servo_damping(d.law, along, masses, rows)
            law = replace(d.law, bias=(*d.law.bias[:2], -kv))
            note = join_notes(f"a damping ratio of {d.law.bias[2]:g}", d.note)
            each = replace(each, drive=replace(d, law=law, note=note))
        out.append(each)
    return out


def _range(a: AttributeReader, key: str, reader: Reader) -> Range:
    """Return an active range of an actuator, or an unlimited one."""
    values = a.numbers(f"{key}range", 2)
    if not values or not is_limited(a, f"{key}limited", reader.settings):
        return UNLIMITED
    return values[0], values[1]


def _range_note(report: ImportReport, name: str, own: Range, control: Range, force: Range) -> str:
    """Return the ranges of input, control and force as text; report them as left out."""
    words = []
    for what, ends in (("input", own), ("control", control), ("force", force)):
        if ends != UNLIMITED:
            kind = "actuators" if what != "control" else "controls that are no inputs here"
            report.leave_out(f"limits of {kind}, kept as notes", name)
            words.append(f"{what} from {ends[0]:.6g} to {ends[1]:.6g}")
    return join_notes(*words)


def with_key_frame_start(
    root: Tag, joints: Sequence[MjcfJoint], actuators: Sequence[Actuator], report: ImportReport
) -> tuple[list[MjcfJoint], tuple[Drive, ...]]:
    """Return the joints and drives with the initial values from the file's key frame "home".

    A joint whose yaw, pitch and roll are singular at the start (pitch of a quarter turn) is noted
    in the report.
    """
    out, drives = list(joints), [each.drive for each in actuators]
    for tag in (tag for section in root.each("keyframe") for tag in section.each("key")):
        a = AttributeReader(tag.attributes, tag, report)
        if a.get("name") != "home" or not {"qpos", "ctrl", "act"} & a.attributes.keys():
            report.leave_out("key frames", a.get("name"))
            continue
        for key in ("qvel", "mpos", "mquat", "plastic"):
            if any(a.numbers(key, 1_000_000, 0) or ()):
                report.leave_out(BESIDES, key)
        out = _with_positions(a, joints)
        drives = _with_controls(a, actuators)
    for joint in out:
        if joint.type in {"ball", "free"} and abs(math.cos(joint.motions[-2].start)) < 1e-6:
            report.leave_out(
                "to be looked at: yaw, pitch and roll are singular at the start, "
                "with a pitch of a quarter turn",
                joint.name,
            )
    return out, tuple(drive for drive in drives if drive)


def _with_positions(a: AttributeReader, joints: Sequence[MjcfJoint]) -> list[MjcfJoint]:
    """Return the joints with the positions of a key frame."""
    sizes = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
    size = sum(sizes[joint.type] for joint in joints)
    values = a.numbers("qpos", 1_000_000, 0)
    if values is None:
        return list(joints)
    if len(values) != size:
        a.report.leave_out(
            f"the start of the key frame home: it has not the {size} numbers of qpos"
        )
        return list(joints)
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
        out.append(replace(joint, motions=tuple(motions)))
    return out


def _with_controls(a: AttributeReader, actuators: Sequence[Actuator]) -> list[Drive | None]:
    """Return the drives with the controls of a key frame, or the activations of integrators."""
    drives = [each.drive for each in actuators]
    active = [k for k, each in enumerate(actuators) if each.dynamics != "none"]
    for key, those in (("ctrl", range(len(drives))), ("act", active)):
        values = a.numbers(key, 1_000_000, 0) or ()
        if len(values) != len(those) and any(values):
            a.report.leave_out(f"the {key} of the key frame home: it has not {len(those)} numbers")
            continue
        for k, value in zip(those, values, strict=False):
            each, drive = actuators[k], drives[k]
            if drive and each.lawful and (each.dynamics == "integrator") == (key == "act"):
                drives[k] = replace(drive, start=value)
            elif value:
                a.report.leave_out(BESIDES, key)
    return drives
