"""Reader of MuJoCo's MJCF: the tree of bodies, joints, actuators and key frames."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from eomc.base.errors import SceneError
from eomc.base.spatial import plus, scaled
from eomc.robots.geometry import IDENTITY, IDENTITY_TRANSFORM, ORIGIN, Transform, Vector
from eomc.robots.mjcf import masses
from eomc.robots.mjcf.actuators import read_actuators, with_key_frame_start
from eomc.robots.mjcf.file import (
    ONE_FILE,
    SCHEMA,
    load,
    read_default_classes,
    read_settings,
)
from eomc.robots.mjcf.joints import (
    MjcfJoint,
    Tendons,
    read_equalities,
    read_joint,
    unique_name,
    with_coordinate_names,
    with_motions,
    with_spring_dampers,
)
from eomc.robots.mjcf.masses import Mass, Placed, Reader
from eomc.robots.robot import UNLIMITED, Robot, RobotBody, with_left_out_note
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
