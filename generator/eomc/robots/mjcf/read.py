"""A robot from MuJoCo's MJCF: its joints, the tree of its bodies, actuators and key frames."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from eomc.base.errors import SceneError
from eomc.robots.mjcf import file as text
from eomc.robots.mjcf import masses as masses
from eomc.robots.mjcf.file import ACTUATORS, TRUTH, Attributes, Settings, Tag, Told
from eomc.robots.mjcf.masses import STILL, Mass, Placed, Pose, Reader
from eomc.robots.robot import (
    IDENTITY,
    ORIGIN,
    Drive,
    Motion,
    Robot,
    RobotBody,
    Vector,
    added,
    free_motions,
    from_axis_angle,
    from_quaternion,
    scaled,
    turned,
    unit,
    yaw_pitch_roll,
)
from eomc.scene.assembly import WORLD

# tags in a body that say nothing about its motion, and those that would
ORNAMENTS = {"camera", "light", "site"}
GENERATORS = {"replicate", "composite", "flexcomp", "attach", "plugin", "skin"}

# sections of the file, with the word under which their entries are listed
SECTIONS = {
    "asset": "assets",
    "tendon": "tendons",
    "equality": "equality constraints (loops, couplings)",
    "contact": "contact pairs and exclusions",
    "sensor": "sensors",
    "custom": "custom data",
    "extension": "extensions",
    "deformable": "deformables",
}
SETTINGS = {"visual", "statistic", "size"}  # of MuJoCo's viewer and memory; never of the motion
READ = {"compiler", "option", "default", "worldbody", "actuator", "keyframe"}


def read(path: str | Path, include: bool = False) -> Robot:
    """The robot in an MJCF file.

    Coordinates are MuJoCo's qpos: a hinge or slide has its `ref` in the pose in which the file
    is written. Free and ball joints have yaw, pitch and roll in place of the quaternion; those of
    a free joint begin at the body's own orientation, those of a ball joint at zero. The start is
    the key frame called "home", or else the pose in which the file is written.

    include: open the files that <include> names, if they lie in the folder of `path`.
    Raises SceneError with every fault found; EomcError where the file can't be read.
    """
    path = Path(path)
    told = Told()
    root = text.load(path, include, told)
    if root.kind != "mujoco":
        what = "URDF" if root.kind == "robot" else "not MJCF"
        told.fault(root, f"the file's element is <{root.kind}>, which is {what}; MJCF has <mujoco>")
        raise SceneError(told.faults)
    settings = text.settings_of(root, told)
    reader = Reader(settings, text.classes_of(root, told), told)
    bodies, joints = _bodies(root, reader)
    joints, drives = _actuators(root, joints, reader)
    joints = _started(root, joints, told)
    if settings.totalmass > 0:
        bodies = masses.scaled_to(bodies, settings.totalmass)
    _sections(root, told)
    if told.faults:
        raise SceneError(told.faults)
    name = root.attributes.get("model", "") or path.stem
    return Robot(
        name=name,
        title=f"{name}, from the MJCF file {path.name}",
        gravity=settings.gravity,
        bodies=_moving(bodies, joints),
        drives=drives,
        left_out=told.lines(),
    )


# ---- joints


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


def _joint(placed: Placed, name: str, pose: Pose, reader: Reader) -> Found | None:
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
    anchor = added(
        placed.pose.place,
        turned(placed.pose.turn, text.vector(a, "pos", tag, told) or ORIGIN),
    )
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
        motions = tuple(replace(m, note=_joined(m.note, note)) for m in free_motions()[3:])
        return _balled(Found(name, kind, "spherical", motions, (), anchor, STILL, 0.0), own, told)
    axis = masses.direction(
        text.numbers(a, "axis", tag, told, 3) or (0.0, 0.0, 1.0), "axis", tag, told
    )
    if axis is None:
        return None
    axis = unit(_cleaned(turned(placed.pose.turn, axis)))
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
    zero = Pose(scaled(-ref, axis) if ref else ORIGIN, IDENTITY)
    return Found(name, kind, "prismatic", (motion,), (axis,), ORIGIN, zero, 0.0)


def _cleaned(v: Vector) -> Vector:
    """A unit vector without what rounding left of zeros."""
    x, y, z = (masses.rounded(c, 1.0) for c in v)
    return x, y, z


def _joined(*notes: str) -> str:
    return "; ".join(note for note in notes if note)


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
    if limits and kind != "free" and _limited(a, "limited", settings):
        told.leave("limits of joints, kept as notes", name)
        low, high = (settings.angle(v) if kind != "slide" else v for v in limits)
        of = "rad" if kind != "slide" else "m"
        if kind == "ball":
            notes.append(f"turns by {high:.6g} rad at most")
        else:
            notes.append(f"from {low:.6g} to {high:.6g} {of}")
    force = text.numbers(a, "actuatorfrcrange", tag, told, 2)
    if force and kind in {"hinge", "slide"} and _limited(a, "actuatorfrclimited", settings):
        told.leave("limits of the actuators' force on joints, kept as notes", name)
        notes.append(
            f"driven with {force[0]:.6g} to {force[1]:.6g} {'N m' if kind == 'hinge' else 'N'}"
        )
    return _joined(*notes)


def _limited(a: Attributes, key: str, settings: Settings) -> bool:
    """Whether a range that is given holds."""
    word = a.get(key, "auto")
    return word == "true" or (word == "auto" and settings.autolimits)


def _geom_told(placed: Placed, reader: Reader) -> None:
    """Tell that a geom's shape and contacts are left out."""
    text.unknown(placed.tag, reader.told)
    a = masses.attributes_of(placed, "geom", reader)
    name = a.get("name", "")
    if a.get("contype", "1") != "0" or a.get("conaffinity", "1") != "0":
        reader.told.leave("contacts of geoms", name)
    else:
        reader.told.leave("shapes of geoms without contact", name)


# ---- the tree


def _bodies(root: Tag, reader: Reader) -> tuple[list[RobotBody], list[Found]]:
    """The bodies, parents first and in the file's order, and the joints in the order of qpos.

    Each joint is that of one body, in the order of the bodies that move.
    """
    told = reader.told
    worlds = list(root.each("worldbody"))
    below = [tag for world in worlds for tag in _below(world)]
    names = {
        kind: {t.attributes["name"] for t in below if t.kind in of and "name" in t.attributes}
        for kind, of in (("body", {"body"}), ("joint", {"joint", "freejoint"}))
    }
    inner = [placed for world in worlds for placed in _contents(world, WORLD, "", reader)]
    for placed in inner:
        if placed.tag.kind == "geom":
            _geom_told(placed, reader)
        elif placed.tag.kind != "body":
            told.fault(placed.tag, "the world can't have this; put it into a <body>")
    # a body, and whether its parent stands still
    waiting = [(placed, True) for placed in reversed(inner) if placed.tag.kind == "body"]
    if not waiting:
        told.fault(worlds[0] if worlds else root, "there is no <body> in <worldbody>")
    bodies: list[RobotBody] = []
    joints: list[Found] = []
    seen: dict[str, set[str]] = {"body": {WORLD}, "joint": set()}

    def called(tag: Tag, kind: str, otherwise: str) -> str:
        name = tag.attributes.get("name", "")
        if name and name in seen[kind]:
            told.fault(tag, f'there are two called "{name}"; rename one')
        name = name or _fresh(otherwise, names[kind] | seen[kind])
        seen[kind].add(name)
        return name

    count = 0
    while waiting:
        placed, still = waiting.pop()
        tag, parent = placed.tag, placed.body
        count += 1
        name = called(tag, "body", f"body{count}")
        pose = placed.pose.of(masses.pose_of(tag.attributes, tag, reader))
        childclass = tag.attributes.get("childclass", placed.childclass)
        inner = _contents(tag, name, childclass, reader)
        found = [
            _joint(p, called(p.tag, "joint", f"{name}_joint"), pose, reader)
            for p in inner
            if p.tag.kind in {"joint", "freejoint"}
        ]
        own = [joint for joint in found if joint is not None]
        if any(joint.type == "free" for joint in own):
            if parent != WORLD:
                told.fault(tag, "only a body in <worldbody> can have a free joint")
            if len(own) > 1:
                told.fault(tag, "a body with a free joint has no other joints; leave one")
        if text.choice(tag.attributes, "mocap", tag, told, TRUTH) == "true":
            told.leave("motions of mocap bodies, which stand still here", name)
        if text.number(tag.attributes, "gravcomp", tag, told):
            told.leave("compensation of gravity (gravcomp) of bodies", name)
        for p in inner:
            if p.tag.kind == "geom":
                _geom_told(p, reader)
        mass = masses.body_mass(tag, inner, reader)
        chain, own, anchor = _chain(name, parent, still, pose, own, mass, names["body"], told)
        seen["body"].update(body.name for body in chain)
        bodies += chain
        joints += own
        back = Pose(scaled(-1.0, anchor), IDENTITY)
        waiting += [
            (p._replace(pose=back.of(p.pose)), still and not own)
            for p in reversed(inner)
            if p.tag.kind == "body"
        ]
    return bodies, _named(joints)


def _below(tag: Tag) -> Iterator[Tag]:
    """Every tag in `tag`."""
    waiting = [tag]
    while waiting:
        inner = waiting.pop().children
        yield from inner
        waiting += inner


def _fresh(name: str, taken: Collection[str]) -> str:
    """`name`, with a number behind it where another has it."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


def _contents(tag: Tag, body: str, childclass: str, reader: Reader) -> list[Placed]:
    """What a body holds, frames resolved, in the file's order; what is not read is told."""
    told = reader.told
    if tag.kind == "body":
        text.unknown(tag, told)
    found: list[Placed] = []
    masses.class_of(childclass, tag, reader)
    waiting = [Placed(child, body, STILL, childclass) for child in reversed(tag.children)]
    while waiting:
        placed = waiting.pop()
        inner = placed.tag
        name = inner.attributes.get("name", inner.attributes.get("prefix", ""))
        if inner.kind == "frame":
            text.unknown(inner, told)
            around = placed.pose.of(masses.pose_of(inner.attributes, inner, reader))
            default = inner.attributes.get("childclass", placed.childclass)
            waiting += [Placed(child, body, around, default) for child in reversed(inner.children)]
        elif inner.kind in {"body", "joint", "freejoint", "geom", "inertial"}:
            found.append(placed)
        elif inner.kind in ORNAMENTS:
            told.leave(f"{inner.kind}s", name)
        elif inner.kind in GENERATORS:
            told.leave(f"<{inner.kind}> and all that it adds, masses too", name or f"in {body}")
        else:
            told.leave("elements that MJCF does not have", f"{inner.kind} in {body}")
    return found


def _chain(
    name: str,
    parent: str,
    still: bool,
    pose: Pose,
    joints: Sequence[Found],
    mass: Mass,
    taken: Collection[str],
    told: Told,
) -> tuple[list[RobotBody], list[Found], Vector]:
    """The bodies for one <body>: one a joint, in their order, the mass in the last.

    still: the parent stands still. pose: of the body in the parent. The third is the place of the
    last body's frame in that of <body>: it stands in the last joint's anchor.
    """
    if not joints:
        only = RobotBody(name, parent, offset=pose.place, rotation=pose.turn)
        return [_heavy(only, mass, ORIGIN)], [], ORIGIN
    bodies: list[RobotBody] = []
    own: list[Found] = []
    anchor = ORIGIN
    for i, joint in enumerate(joints):
        step = Pose(added(joint.anchor, scaled(-1.0, anchor)), IDENTITY)
        frame = (step if bodies else pose.of(step)).of(joint.zero)
        if joint.type == "free":
            frame = STILL
        last = i == len(joints) - 1
        bodies.append(
            RobotBody(
                name if last else _fresh(f"{name}_{joint.name}", taken),
                bodies[-1].name if bodies else parent,
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
        if joint.armature and not (still and all(j.type == "slide" for j in joints[:i])):
            told.leave(
                "exact armature of ball joints: here it acts on each of the three angles, "
                "which is the same near zero angles only",
                joint.name,
            )
            motions = tuple(replace(m, armature=joint.armature) for m in joint.motions)
            joint = joint._replace(motions=motions, armature=0.0)
        own.append(joint)
    bodies[-1] = _heavy(bodies[-1], mass, anchor)
    return bodies, own, anchor


def _heavy(body: RobotBody, mass: Mass, anchor: Vector) -> RobotBody:
    """The body with a mass, which is given where the body's frame stands at `anchor`."""
    note = ""
    if anchor != ORIGIN:
        x, y, z = anchor
        note = f"its frame stands in its joint, in the file's frame at ({x:g}, {y:g}, {z:g})"
    center = added(mass.center, scaled(-1.0, anchor)) if mass.mass else ORIGIN
    return replace(body, mass=mass.mass, center=center, inertia=mass.inertia, note=note)


def _named(joints: Sequence[Found]) -> list[Found]:
    """With a name of its own for each coordinate: its joint's, or x to roll of a lone free one."""
    taken = {joint.name for joint in joints if joint.type in {"hinge", "slide"}}
    several = sum(joint.type == "free" for joint in joints) > 1
    named = []
    for joint in joints:
        if joint.type in {"free", "ball"}:
            short = joint.type == "free" and not several
            motions = []
            for m in joint.motions:
                new = _fresh(m.name if short else f"{m.name}_{joint.name}", taken)
                taken.add(new)
                motions.append(replace(m, name=new))
            joint = joint._replace(motions=tuple(motions))
        named.append(joint)
    return named


def _moving(bodies: Sequence[RobotBody], joints: Sequence[Found]) -> tuple[RobotBody, ...]:
    """The bodies, those that move with the motions of their joints and the armature of turns."""
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
                inertia=masses.six([xx + a, yy + a, zz + a, *rest]),
                note=_joined(body.note, note),
            )
        out.append(body)
    return tuple(out)


# ---- what is beside the tree


def _actuators(
    root: Tag, joints: Sequence[Found], reader: Reader
) -> tuple[list[Found], tuple[Drive, ...]]:
    """The joints with their actuators' armature and damping, and the drives of hinges and slides.

    Of an actuator whose force is gain times its control the input is the control; of any other
    (servos, muscles, ...) it is the force, before the gear, which is told.
    """
    told = reader.told
    found = {joint.name: joint for joint in joints}
    drives: list[Drive] = []
    tags = [tag for section in root.each("actuator") for tag in section.children]
    named = {tag.attributes["name"] for tag in tags if "name" in tag.attributes}
    for tag in tags:
        if tag.kind not in ACTUATORS:
            told.leave("elements that MJCF does not have", f"{tag.kind} in actuator")
            continue
        a = masses.attributes_of(Placed(tag, "", STILL, ""), "actuator", reader)
        on = a.get("joint", a.get("jointinparent", ""))
        name = a.get("name") or _fresh(f"{on or 'no'}_{tag.kind}", named)
        named.add(name)
        if not on:
            told.leave("actuators on tendons, sites, bodies and slider-cranks", name)
            continue
        if on not in found:
            told.fault(tag, f'there is no joint "{on}"')
            continue
        joint = found[on]
        if joint.type in {"free", "ball"}:
            told.leave("actuators on free and ball joints", name)
            continue
        gear = (text.numbers(a, "gear", tag, told, 6, 1) or (1.0,))[0]
        damping = text.numbers(a, "damping", tag, told, 3, 1) or (0.0,)
        if any(damping[1:]):
            told.leave("damping in the square and cube of actuators", name)
        (motion,) = joint.motions
        motion = replace(
            motion,
            armature=motion.armature + gear**2 * text.number(a, "armature", tag, told),
            damping=motion.damping + gear**2 * damping[0],
        )
        found[on] = joint._replace(motions=(motion,))
        law = a.get(" law", "general")
        laws = [a.get(key, "none") for key in ("dyntype", "biastype")]
        if law in {"motor", "general"} and {*laws, a.get("gaintype", "fixed")} == {"none", "fixed"}:
            gear *= (text.numbers(a, "gainprm", tag, told, 100, 1) or (1.0,))[0]
        else:
            told.leave("laws of actuators, whose input here is their force", f"{name} ({law})")
        if text.number(a, "delay", tag, told):
            told.leave("delays of actuators", name)
        note = _joined(*(_within(a, key, name, tag, reader) for key in ("ctrl", "force")))
        drives.append(Drive(name, on, gear, note))
    return list(found.values()), tuple(drives)


def _within(a: Attributes, key: str, name: str, tag: Tag, reader: Reader) -> str:
    """A range of an actuator in words, for its note; told as left out."""
    values = text.numbers(a, f"{key}range", tag, reader.told, 2)
    if not values or not _limited(a, f"{key}limited", reader.settings):
        return ""
    reader.told.leave("limits of actuators, kept as notes", name)
    what = {"ctrl": "input", "force": "force"}[key]
    return f"{what} from {values[0]:.6g} to {values[1]:.6g}"


def _started(root: Tag, joints: Sequence[Found], told: Told) -> list[Found]:
    """The joints with the start of the key frame "home", where there is one; singular ones told."""
    sizes = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
    size = sum(sizes[joint.type] for joint in joints)
    out = list(joints)
    for tag in (tag for section in root.each("keyframe") for tag in section.each("key")):
        name = tag.attributes.get("name", "")
        if name != "home" or "qpos" not in tag.attributes:
            told.leave("key frames", name)
            continue
        values = text.numbers(tag.attributes, "qpos", tag, told, 1_000_000, 0) or ()
        if len(values) != size:
            told.leave(f"the start of the key frame home: it has not the {size} numbers of qpos")
            continue
        out, at = [], 0
        for joint in joints:
            mine = values[at : at + sizes[joint.type]]
            at += len(mine)
            if joint.type in {"ball", "free"}:
                if not any(mine[-4:]):
                    told.fault(tag, f"the quaternion of joint {joint.name} has the length zero")
                    continue
                w, x, y, z = mine[-4:]
                mine = (*mine[:-4], *yaw_pitch_roll(from_quaternion(w, x, y, z)))
            motions = (replace(m, start=v) for m, v in zip(joint.motions, mine, strict=True))
            out.append(joint._replace(motions=tuple(motions)))
    for joint in out:
        if joint.type in {"ball", "free"} and abs(math.cos(joint.motions[-2].start)) < 1e-6:
            told.leave(
                "to be looked at: yaw, pitch and roll are singular at the start, "
                "with a pitch of a quarter turn",
                joint.name,
            )
    return out


def _sections(root: Tag, told: Told) -> None:
    """Tell the sections of the file that are not read."""
    for section in root.children:
        if section.kind in SECTIONS:
            for tag in section.children:
                told.leave(SECTIONS[section.kind], _label(tag))
        elif section.kind in SETTINGS:
            told.leave("settings of MuJoCo's viewer and memory", section.kind)
        elif section.kind not in READ:
            told.leave("elements that MJCF does not have", section.kind)


def _label(tag: Tag) -> str:
    """An entry of a section: its name, or what it is and on which things it acts."""
    a = tag.attributes
    ends = [
        a[k] for k in a if k.rstrip("12") in {"body", "joint", "site", "geom", "tendon", "file"}
    ]
    return f"{tag.kind} {a.get('name') or ' and '.join(ends)}".rstrip()
