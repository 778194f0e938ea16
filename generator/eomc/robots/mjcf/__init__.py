"""Reader of MuJoCo's MJCF: the tree of bodies, joints, actuators and key frames."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from eomc.base.errors import SceneError
from eomc.base.spatial import plus, scaled
from eomc.robots.geometry import (
    IDENTITY,
    IDENTITY_TRANSFORM,
    ORIGIN,
    Transform,
    Vector,
    from_quaternion,
    yaw_pitch_roll,
)
from eomc.robots.mjcf import masses
from eomc.robots.mjcf.file import (
    ACTUATORS,
    MEASURES,
    ONE_FILE,
    SCHEMA,
    load,
    note_unread_attributes,
    read_default_classes,
    read_settings,
)
from eomc.robots.mjcf.joints import (
    MjcfJoint,
    Tendons,
    is_limited,
    mass_matrix_at_start,
    read_equalities,
    read_joint,
    unique_name,
    with_coordinate_names,
    with_motions,
    with_spring_dampers,
)
from eomc.robots.mjcf.masses import Mass, Placed, Reader
from eomc.robots.robot import (
    UNLIMITED,
    Drive,
    JointMotion,
    Law,
    Range,
    Robot,
    RobotBody,
    Tendon,
    input_range,
    intersection,
    join_notes,
    with_left_out_note,
)
from eomc.robots.stiffness import gradient
from eomc.robots.xml import AttributeReader, ImportReport, Tag, unknown_parts
from eomc.scene.scene import WORLD

# tags in a body that don't affect its motion, and unsupported ones that do
ORNAMENTS = {"camera", "light", "site"}
GENERATORS = {"replicate", "composite", "flexcomp", "attach", "plugin", "skin"}

# sections of the file, with the word under which their entries are listed
SECTIONS = {
    "asset": "assets",
    "contact": "contact pairs and exclusions",
    "sensor": "sensors",
    "custom": "custom data",
    "extension": "extensions",
    "deformable": "deformables",
}
SETTINGS = {"visual", "statistic", "size"}  # of MuJoCo's viewer and memory; never of the motion
# other files, by their element
KINDS = {
    "robot": "URDF",
    "mujocoinclude": "a part of a model: import the file that includes it, with --include",
}


def read(path: str | Path, include: bool = False) -> Robot:
    """Return the robot that an MJCF file describes.

    The coordinates are those of MuJoCo's qpos: in the pose in which the file is written, a hinge or
    slide has the value of its attribute `ref`. Free and ball joints have yaw, pitch and roll in
    place of MuJoCo's quaternion. In that pose, these angles are zero for a ball joint, and those of
    the body's orientation for a free joint. The initial state is the key frame called "home", or
    else the pose in which the file is written.

    With `include`, files that <include> names are opened if they lie in the folder of `path`.

    Raises
    ------
    SceneError
        With every fault found.
    EomcError
        If the file cannot be read.
    """
    path = Path(path)
    report = ImportReport()
    root = load(path, include, report)
    if root.kind != "mujoco":
        what = KINDS.get(root.kind, "not MJCF")
        AttributeReader({}, root, report).fault(
            f"the file's element is <{root.kind}>, which is {what}; MJCF has <mujoco>"
        )
        raise SceneError(report.faults)
    report.strangers = unknown_parts(root, SCHEMA, "MJCF")
    settings = read_settings(root, report)
    reader = Reader(settings, read_default_classes(root, report), report)
    bodies, joints, anchors = _bodies(root, reader)
    if settings.totalmass > 0:
        bodies = masses.scale_masses(bodies, settings.totalmass)
    tendons = Tendons(root, joints, reader)
    loops, couplings = read_equalities(
        root, with_motions(bodies, joints), joints, tendons, anchors, reader
    )
    joints, actuators = read_actuators(root, bodies, joints, tendons, reader)
    if not report.faults:
        joints = with_spring_dampers(joints, bodies, tendons.fixed.values(), settings.disabled)
    if "limit" in settings.disabled:  # after actuators, which may inherit them
        joints = [joint.with_motions(limits=UNLIMITED) for joint in joints]
    joints, drives = with_key_frame_start(root, joints, actuators, report)
    _sections(root, report)
    if report.faults:
        raise with_left_out_note(SceneError(report.faults), report.notes())
    name = root.get("model") or path.stem
    return Robot(
        name=name,
        title=f"{name}, from the MJCF file {path.name}",
        gravity=settings.gravity,
        bodies=with_motions(bodies, joints),
        drives=drives,
        tendons=tendons.acting,
        loops=loops,
        couplings=couplings,
        left_out=report.notes(),
    )


def _geom_left_out(placed: Placed, reader: Reader) -> None:
    """Report that a geom's shape and contacts are left out."""
    a = reader.attributes_with_defaults(placed, "geom")
    touches = a.get("contype", "1") != "0" or a.get("conaffinity", "1") != "0"
    what = "contacts of geoms" if touches else "shapes of geoms without contact"
    reader.report.leave_out(what, a.get("name"))


# --- the tree -------------------------------------------------------------------------------------


def _bodies(
    root: Tag, reader: Reader
) -> tuple[list[RobotBody], list[MjcfJoint], dict[str, Vector]]:
    """Return the bodies (parents first, in the file's order), the joints, and the anchors.

    Joints are in the order of qpos, one for each body that moves. Anchors are the origins of the
    bodies' frames in the frames of the file.
    """
    report, settings = reader.report, reader.settings
    worlds = list(root.each("worldbody"))
    below = [tag for world in worlds for tag in world.all()]
    names = {
        kind: {t.get("name") for t in below if t.kind in of}
        for kind, of in (("body", {"body"}), ("joint", {"joint", "freejoint"}))
    }
    inner = [placed for world in worlds for placed in _contents(world, WORLD, "", reader)]
    for placed in inner:
        if placed.tag.kind == "geom":
            _geom_left_out(placed, reader)
        elif placed.tag.kind != "body":
            reader.own_attributes(placed.tag).fault(
                "the world can't have this; put it into a <body>"
            )
    # a body, and whether its parent stands still
    waiting = [(placed, True) for placed in reversed(inner) if placed.tag.kind == "body"]
    if not waiting:
        generator = next((t.kind for t in below if t.kind in GENERATORS), "")
        more = f"; what <{generator}> adds is not read: {ONE_FILE}" if generator else ""
        reader.own_attributes([*worlds, root][0]).fault(f"there is no <body> in <worldbody>{more}")
    bodies: list[RobotBody] = []
    joints: list[MjcfJoint] = []
    anchors: dict[str, Vector] = {}
    used_names: dict[str, set[str]] = {"body": {WORLD}, "joint": set()}

    def called(tag: Tag, kind: str, otherwise: str) -> str:
        name = tag.get("name")
        if name and name in used_names[kind]:
            reader.own_attributes(tag).fault(f'there are two called "{name}"; rename one')
        name = name or unique_name(otherwise, names[kind] | used_names[kind])
        used_names[kind].add(name)
        return name

    count = 0
    while waiting:
        placed, is_static = waiting.pop()
        tag, parent, a = placed.tag, placed.body, reader.own_attributes(placed.tag)
        count += 1
        name = called(tag, "body", f"body{count}")
        pose = placed.pose.compose(masses.read_pose(a, settings))
        inner = _contents(tag, name, a.get("childclass", placed.childclass), reader)
        body_joints = [
            read_joint(p, called(p.tag, "joint", f"{name}_joint"), pose, reader)
            for p in inner
            if p.tag.kind in {"joint", "freejoint"}
        ]
        own = [joint for joint in body_joints if joint is not None]
        if any(joint.type == "free" for joint in own):
            if parent != WORLD:
                a.fault("only a body in <worldbody> can have a free joint")
            if len(own) > 1:
                a.fault("a body with a free joint has no other joints; leave one")
        if a.is_true("mocap"):
            report.leave_out("motions of mocap bodies, which stand still here", name)
        for p in inner:
            if p.tag.kind == "geom":
                _geom_left_out(p, reader)
        mass = masses.body_mass(tag, inner, reader, is_static and not own)
        fixed = RobotBody(name, parent, offset=pose.place, rotation=pose.turn)
        chain, own, anchor = _chain(fixed, mass, own, is_static, names["body"], report)
        if own or not is_static:
            passive = not {"spring", "damper"} <= settings.disabled  # as MuJoCo has it
            lifted = a.number("gravcomp")
            chain[-1] = replace(chain[-1], lifted=lifted if passive else 0.0)
        used_names["body"].update(body.name for body in chain)
        bodies += chain
        anchors[name] = anchor
        joints += own
        back = Transform(scaled(anchor, -1.0), IDENTITY)
        waiting += [
            (replace(p, pose=back.compose(p.pose)), is_static and not own)
            for p in reversed(inner)
            if p.tag.kind == "body"
        ]
    return bodies, with_coordinate_names(joints), anchors


def _contents(tag: Tag, body: str, childclass: str, reader: Reader) -> list[Placed]:
    """Return the elements of a body in the file's order, with <frame> resolved; report others."""
    report = reader.report
    contents: list[Placed] = []
    reader.class_of(childclass, tag)
    waiting = [
        Placed(child, body, IDENTITY_TRANSFORM, childclass) for child in reversed(tag.children)
    ]
    while waiting:
        placed = waiting.pop()
        inner = placed.tag
        name = inner.get("name", inner.get("prefix"))
        if inner.kind == "frame":
            around = placed.pose.compose(
                masses.read_pose(reader.own_attributes(inner), reader.settings)
            )
            default = inner.get("childclass", placed.childclass)
            waiting += [Placed(child, body, around, default) for child in reversed(inner.children)]
        elif inner.kind in {"body", "joint", "freejoint", "geom", "inertial"}:
            contents.append(placed)
        elif inner.kind in ORNAMENTS:
            if inner.kind == "site" and name:
                reader.sites[name] = placed
            report.leave_out(f"{inner.kind}s", name)
        elif inner.kind in GENERATORS:
            what = f"<{inner.kind}> and all that it adds, joints and masses too; {ONE_FILE}"
            report.leave_out(what, name or f"in {body}")
    return contents


def _chain(
    body: RobotBody,
    mass: Mass,
    joints: Sequence[MjcfJoint],
    is_static: bool,
    taken: Collection[str],
    report: ImportReport,
) -> tuple[list[RobotBody], list[MjcfJoint], Vector]:
    """Return the chain of bodies for one <body>, one for each joint; the last has the mass.

    `body` is the body without mass, fixed to its parent in the pose of the file; `is_static` says
    that the parent does not move. `taken` are the names of bodies in the file. The second value
    are the joints of the chain. The third is the origin of the last body's frame, the anchor of
    the last joint, in the frame of <body>.
    """
    if not joints:
        return [_with_mass(body, mass, ORIGIN)], [], ORIGIN
    name, pose = body.name, Transform(body.offset, body.rotation)
    bodies: list[RobotBody] = []
    own: list[MjcfJoint] = []
    anchor = ORIGIN
    for i, joint in enumerate(joints):
        step = Transform(plus(joint.anchor, scaled(anchor, -1.0)), IDENTITY)
        frame = (step if bodies else pose.compose(step)).compose(joint.zero)
        if joint.type == "free":
            frame = IDENTITY_TRANSFORM
        last = i == len(joints) - 1
        bodies.append(
            RobotBody(
                name if last else unique_name(f"{name}_{joint.name}", taken),
                bodies[-1].name if bodies else body.parent,
                joint.kind,
                joint.motions,
                joint.axes,
                frame.place,
                frame.turn,
                note="" if last else f"between the joints of {name}",
            )
        )
        anchor = joint.anchor
        # as an inertia of the body it is exact where what carries the joint does not turn
        if joint.armature and not (is_static and all(j.type == "slide" for j in joints[:i])):
            report.leave_out(
                "exact armature of ball joints: here it acts on each of the three angles, "
                "which is the same near zero angles only",
                joint.name,
            )
            joint = replace(joint.with_motions(armature=joint.armature), armature=0.0)
        own.append(joint)
    bodies[-1] = _with_mass(bodies[-1], mass, anchor)
    return bodies, own, anchor


def _with_mass(body: RobotBody, mass: Mass, anchor: Vector) -> RobotBody:
    """Return the body with a mass; `anchor` is its frame's origin in the frame of the mass."""
    note = ""
    if anchor != ORIGIN:
        x, y, z = anchor
        note = f"its frame stands in its joint, in the file's frame at ({x:g}, {y:g}, {z:g})"
    center = plus(mass.center, scaled(anchor, -1.0)) if mass.mass else ORIGIN
    return replace(body, mass=mass.mass, center=center, inertia=mass.inertia, note=note)


# --- sections besides the tree --------------------------------------------------------------------


def _sections(root: Tag, report: ImportReport) -> None:
    """Report the sections of the file that are not read."""
    for section in root.children:
        if section.kind in SECTIONS:
            for tag in section.children:
                report.leave_out(SECTIONS[section.kind], _label(tag))
        elif section.kind in SETTINGS:
            report.leave_out("settings of MuJoCo's viewer and memory", section.kind)


def _label(tag: Tag) -> str:
    """Return the label of an entry of a section: its kind, and its name or those it refers to."""
    a = tag.attributes
    ends = [
        a[k] for k in a if k.rstrip("12") in {"body", "joint", "site", "geom", "tendon", "file"}
    ]
    return f"{tag.kind} {a.get('name') or ' and '.join(ends)}".rstrip()


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
        a = reader.attributes_with_defaults(Placed(tag), "actuator")
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
