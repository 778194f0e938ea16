"""Reader of URDF files. Meshes and other files that a URDF refers to are not opened.

Source: the URDF specification of ROS (wiki.ros.org/urdf/XML). A link's frame coincides with its
joint's frame, in which axes are given; ixy, ixz and iyz are entries of the inertia tensor.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from eomc.base import texts
from eomc.base.errors import EomcError, Problem, SceneError
from eomc.base.spatial import as_inertia, transposed
from eomc.robots import xml
from eomc.robots.geometry import (
    NO_INERTIA,
    ORIGIN,
    Matrix,
    Vector,
    from_rpy,
    rotated_inertia,
    times,
    toward,
    unit,
)
from eomc.robots.robot import (
    BARE,
    UNLIMITED,
    Drive,
    JointMotion,
    Mimic,
    Robot,
    RobotBody,
    free_motions,
    join_notes,
    with_joints_fixed,
    with_left_out_note,
)
from eomc.robots.xml import AttributeReader, ImportReport, Tag
from eomc.scene.formulas import suggest
from eomc.scene.scene import WORLD
from eomc.scene.scope import cycle_text, find_cycles

GRAVITY: Vector = (0.0, 0.0, -9.81)  # URDF has none: z is up in ROS

_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
# elements and their attributes; those with * are not read, only counted
_SCHEMA = xml.parse_format(
    """
robot: name version
 link: name type
  inertial:
   origin: xyz rpy
   mass: value
   inertia: ixx iyy izz ixy ixz iyz
  visual: *
  collision: *
 joint: name type
  origin: xyz rpy
  parent: link
  child: link
  axis: xyz
  dynamics: damping friction
  limit: lower upper effort velocity
  mimic: joint multiplier offset
  safety_controller: *
  calibration: *
 material: *
 transmission: *
 gazebo: *
 sensor: *
""",
    {},
)
_SKIPPED = {kind for kind, part in _SCHEMA.children.items() if part.skipped}
_JOINT_SKIPPED = {"safety_controller", "calibration"}
_JOINT_PARTS = ("origin", "parent", "child", "axis", "dynamics", "limit", "mimic")
_SHAPES = ("mesh", "box", "cylinder", "sphere", "capsule")


def read(file: str | os.PathLike[str]) -> Robot:
    """Return the robot described by a URDF file, with its root link fixed to the world.

    Raises SceneError with all faults of the robot, EomcError if the file is not a URDF.
    """
    root, shown = xml.root(file), texts.line(str(file))
    if any(tag.kind.startswith("xacro:") for tag in root.all()):
        raise EomcError(f"{shown}: {xml.RUN_XACRO}")
    if root.kind != "robot":
        raise EomcError(f"{shown}: not a URDF: its root element is <{root.kind}>, not <robot>")
    return _UrdfReader(root, Path(file), shown).robot()


@dataclass(frozen=True)
class _Joint:
    """A joint between two links, with its motions and drive."""

    name: str
    kind: str
    parent: str
    child: str
    offset: Vector
    rotation: Matrix
    axis: Vector
    motions: tuple[JointMotion, ...]
    drive: Drive | None


class _UrdfReader:
    """Reader of one file, which collects faults."""

    def __init__(self, root: Tag, path: Path, shown: str) -> None:
        self.root = root
        self.path = path
        self.shown = shown
        self.report = ImportReport()
        self.lines: dict[str, int] = {}  # of links and joints, by key

    def robot(self) -> Robot:
        """Return the robot that the file describes. Raises SceneError with all of its faults."""
        links = self._named("link")
        if not links and not self.report.faults:
            self.add_fault("", "the robot has no <link>: a URDF has one for each body")
        bodies = {name: self._link(name, element) for name, element in links.items()}
        elements = self._named("joint")
        read = [self._joint(name, e, bodies) for name, e in elements.items()]
        joints = self._with_mimics([j for j in read if j], elements)
        tree = self._tree(bodies, joints)
        if self.report.faults:
            raise with_left_out_note(SceneError(self.report.faults), self._unread_parts())
        name = self.root.get("name") or self.path.stem
        robot = Robot(
            name=name,
            title=f"{name}, from {self.path.name}",
            gravity=GRAVITY,
            bodies=tuple(tree),
            drives=tuple(j.drive for j in joints if j.drive),
            left_out=tuple(self._unread_parts()),
        )
        return with_joints_fixed(robot)

    def add_fault(self, key: str, message: str) -> None:
        """Add an error message on the link or joint `key`, with its line in the file."""
        self.report.faults.append(Problem(message, key, self.shown, self.lines.get(key, 0)))

    def _parts(self, element: Tag, tags: Sequence[str], key: str) -> None:
        """Report child elements that occur more than once."""
        for tag in tags:
            parts = [*element.each(tag)]
            if len(parts) > 1:
                self.add_fault(key, f"it has {len(parts)} <{tag}>: leave the one that is meant")

    # --- links

    def _named(self, tag: str) -> dict[str, Tag]:
        """Return the elements of the robot with this tag, by name."""
        out: dict[str, Tag] = {}
        for k, element in enumerate(self.root.each(tag)):
            name = element.get("name").strip()
            self.lines.setdefault(f"{tag} {name or k + 1}", element.line)
            if not name:
                self.add_fault(f"{tag} {k + 1}", f'it has no name: write <{tag} name="...">')
            elif name in out:
                self.add_fault(
                    f"{tag} {name}", f"a second {tag} has this name: rename one of the two"
                )
            else:
                out[name] = element
        return out

    def _link(self, name: str, link: Tag) -> RobotBody:
        key = f"link {name}"
        self._parts(link, ("inertial",), key)
        inertial = link.first("inertial")
        if inertial is None:
            shapes = _shapes(link)
            note = f"a {shapes[0]} only, {BARE}" if shapes else BARE
            return RobotBody(name, note=note)
        self._parts(inertial, ("origin", "mass", "inertia"), key)
        for part, example in (("mass", 'value="..."'), ("inertia", 'ixx="..." ...')):
            if inertial.first(part) is None:
                fault = f"its <inertial> has no mass or no inertia: add <{part} {example}/>"
                self.add_fault(key, fault)
                return RobotBody(name)
        mass, tensor = (self._part(inertial, part, key) for part in ("mass", "inertia"))
        for a, required in ((mass, ("value",)), (tensor, ("ixx", "iyy", "izz"))):
            for attribute in required:
                if attribute not in a:
                    a.fault(f'<{a.tag.kind}> has no {attribute}: add {attribute}="..."')
        kilograms = mass.number("value")
        if kilograms < 0:
            self.add_fault(key, f"its mass is negative ({kilograms:g} kg): masses are zero or more")
        center, turn = self._origin(inertial, key)
        entries = map(tensor.number, ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
        inertia = rotated_inertia(as_inertia(entries), turn)
        return RobotBody(name, mass=kilograms, center=center, inertia=inertia)

    # --- joints

    def _joint(self, name: str, joint: Tag, bodies: dict[str, RobotBody]) -> _Joint | None:
        key = f"joint {name}"
        kind = joint.get("type")
        if kind not in _TYPES:
            known = f"known are {', '.join(_TYPES)}"
            message = f"unknown type '{kind}'" if kind else "it has no type"
            self.add_fault(key, message + (suggest(kind, _TYPES) or f": {known}"))
        self._parts(joint, _JOINT_PARTS, key)
        ends = [self._end(joint, end, key, bodies) for end in ("parent", "child")]
        offset, rotation = self._origin(joint, key)
        axis: Vector = (1.0, 0.0, 0.0)
        if kind not in ("fixed", "floating"):
            axis = self._part(joint, "axis", key).vector("xyz") or axis
            try:
                axis = unit(axis)
            except ValueError:
                self.add_fault(
                    key, 'its axis has length zero: give it a direction, <axis xyz="0 0 1"/>'
                )
        motions = self._motions(name, kind, joint, key)
        if kind not in _TYPES or not all(ends):
            return None
        drive = None
        if len(motions) == 1:
            word, newton = ("torque", "N m") if motions[0].unit == "rad" else ("force", "N")
            effort = motions[0].driven[1]
            note = f"along {name}" + (f", at most {effort:g} {newton}" if effort < math.inf else "")
            drive = Drive(f"{name}_{word}", name, note=note)
        return _Joint(name, kind, ends[0], ends[1], offset, rotation, axis, motions, drive)

    def _end(self, joint: Tag, end: str, key: str, bodies: dict[str, RobotBody]) -> str:
        """Return the link at one end of a joint, or "" after a fault."""
        tag = joint.first(end)
        link = "" if tag is None else tag.get("link").strip()
        if not link:
            self.add_fault(key, f'it has no {end} link: add <{end} link="..."/>')
        elif link not in bodies:
            near = suggest(link, bodies) or f': add <link name="{link}">'
            self.add_fault(key, f"its {end} link '{link}' is not in the file{near}")
            return ""
        return link

    def _motions(self, name: str, kind: str, joint: Tag, key: str) -> tuple[JointMotion, ...]:
        if kind == "floating":
            return free_motions(name)
        if kind not in ("revolute", "continuous", "prismatic", "planar"):
            return ()
        dynamics, limit = self._part(joint, "dynamics", key), self._part(joint, "limit", key)
        damping, friction = dynamics.number("damping"), dynamics.number("friction")
        for what, value in (("damping", damping), ("friction", friction)):
            if value < 0:
                self.add_fault(key, f"its {what} is negative ({value:g}): it would drive the joint")
        of = "m" if kind == "prismatic" else "rad"
        if kind == "planar":
            slide = JointMotion(f"x_{name}", "m", damping=damping, friction=friction)
            return slide, replace(slide, name=f"y_{name}"), JointMotion(f"turn_{name}", "rad")
        start, note = 0.0, "turns without end" if kind == "continuous" else ""
        ends, effort, speed = UNLIMITED, limit.number("effort"), limit.number("velocity")
        lower, upper = limit.number("lower"), limit.number("upper")
        if kind != "continuous" and (lower or upper):
            note, ends = f"{lower:g} to {upper:g}", (lower, upper)
            start = min(max(0.0, lower), upper) if lower <= upper else 0.0
        note = join_notes(note, f"at most {speed:g} {of}/s" if speed > 0 else "")
        driven = (-effort, effort) if effort > 0 else UNLIMITED
        return (JointMotion(name, of, start, note, damping, friction, limits=ends, driven=driven),)

    def _with_mimics(self, joints: list[_Joint], elements: Mapping[str, Tag]) -> list[_Joint]:
        """Return the joints, with each <mimic> resolved to a coordinate of the scene."""
        mimics: dict[str, Mimic] = {}
        for joint in joints:
            mimic_tag = elements[joint.name].first("mimic")
            if mimic_tag is not None and joint.kind != "fixed":
                mimics[joint.name] = self._mimic(joint, mimic_tag, elements)
        for ring in find_cycles({name: [mimic.coordinate] for name, mimic in mimics.items()}):
            self.add_fault(
                f"joint {ring[0]}", f"joints mimic one another in a ring: {cycle_text(ring)}"
            )
            for name in ring:
                mimics.pop(name, None)
        by_name = {joint.name: joint for joint in joints}
        out = []
        for joint in joints:
            if joint.name in mimics:
                mimic = mimics[joint.name]
                while further := mimics.get(mimic.coordinate):
                    gear, shift = mimic.gear * further.gear, mimic.joint_position(further.shift)
                    mimic = Mimic(further.coordinate, gear, shift)
                joint = self._as_mimic(joint, mimic, by_name.get(mimic.coordinate))
            out.append(joint)
        return out

    def _mimic(self, joint: _Joint, mimic_tag: Tag, elements: Mapping[str, Tag]) -> Mimic:
        key, leader = f"joint {joint.name}", mimic_tag.get("joint").strip()
        if not leader:
            self.add_fault(key, 'its <mimic> names no joint: add joint="..."')
        elif leader not in elements:
            near = suggest(leader, elements) or ": remove the <mimic>, or add that joint"
            self.add_fault(key, f"it mimics joint '{leader}', which is not in the file{near}")
        a = AttributeReader(mimic_tag.attributes, mimic_tag, self.report, key)
        return Mimic(leader, a.number("multiplier", 1.0), a.number("offset"))

    def _as_mimic(self, joint: _Joint, mimic: Mimic, leader: _Joint | None) -> _Joint:
        """Return the joint with its motion as a mimic of the leader's, and without a drive."""
        for each in (joint, leader):
            if each and len(each.motions) > 1:
                count = f"a {each.kind} joint, which has {len(each.motions)} coordinates"
                why = f"it mimics '{mimic.coordinate}'; '{each.name}' is {count}: only joints "
                self.add_fault(
                    f"joint {joint.name}", why + "with one can mimic: remove the <mimic>"
                )
                return joint
        leader_start = leader.motions[0].start if leader and leader.motions else 0.0
        (motion,) = joint.motions
        motion = replace(motion, start=mimic.joint_position(leader_start), mimics=mimic)
        return replace(joint, motions=(motion,), drive=None)

    # --- the tree

    def _tree(self, bodies: dict[str, RobotBody], joints: list[_Joint]) -> list[RobotBody]:
        """Return the bodies in depth-first order, parents first."""
        parent_joints: dict[str, _Joint] = {}
        child_joints: dict[str, list[_Joint]] = {name: [] for name in bodies}
        for joint in joints:
            if other := parent_joints.get(joint.child):
                self.add_fault(
                    f"joint {joint.name}",
                    f"its child link '{joint.child}' is held by joint '{other.name}' already: "
                    "bodies of a URDF hang in a tree, remove one of the two joints and close the "
                    "loop by a [[loop]] in the scene",
                )
            else:
                parent_joints[joint.child] = joint
                child_joints[joint.parent].append(joint)
        roots = [name for name in bodies if name not in parent_joints]
        if self.report.faults:
            return []  # a joint at fault leaves its links alone, and they would seem roots
        if len(roots) > 1:
            ends = {e.kind for e in self.root.children if e.kind.lower().endswith("joint")}
            strange = ", ".join(f"<{kind}>" for kind in sorted(ends - {"joint"}))
            why = f"; {strange} is not read, only <joint> is" if strange else ""
            self.add_fault(
                f"link {roots[1]}",
                f"{len(roots)} links have no parent ({', '.join(roots[:8])}): a robot has one "
                f"root, connect the others to it by fixed joints{why}",
            )
        out: list[RobotBody] = []
        waiting = roots[:1]
        while waiting:
            name = waiting.pop()
            out += self._on_joint(bodies[name], parent_joints.get(name))
            waiting += [joint.child for joint in reversed(child_joints[name])]
        loop = next(
            find_cycles({name: [joint.parent] for name, joint in parent_joints.items()}), []
        )
        if loop and not self.report.faults:
            self.add_fault(
                f"joint {parent_joints[loop[0]].name}",
                f"the links hold one another in a loop ({' on '.join(loop)}): "
                "one of them belongs to the root",
            )
        return out[1:] if out and out[0].name == WORLD else out  # many files call the ground so

    def _on_joint(self, body: RobotBody, joint: _Joint | None) -> list[RobotBody]:
        """Return the link with its joint.

        A planar joint may need a frame in between, whose z axis is the plane's normal.
        """
        if joint is None:
            return [body]
        kinds = {"continuous": "revolute", "floating": "free"}
        child = replace(
            body,
            parent=joint.parent,
            joint=kinds.get(joint.kind, joint.kind),
            motions=joint.motions,
            axes=(joint.axis,) if len(joint.motions) == 1 else (),
            offset=joint.offset,
            rotation=joint.rotation,
            note=join_notes(
                body.note, *(f"joint {_mimic_description(m)}" for m in joint.motions if m.mimics)
            ),
        )
        if joint.kind != "planar" or joint.axis == (0.0, 0.0, 1.0):
            return [child]
        turn = toward(joint.axis)
        frame = f"{joint.name}_frame"
        rotation = times(joint.rotation, turn)
        note = "the joint's plane is its x and y"
        between = replace(child, name=frame, mass=0.0, inertia=NO_INERTIA,
                          center=ORIGIN, rotation=rotation, note=note)  # fmt: skip
        return [between, replace(body, parent=frame, rotation=transposed(turn))]

    # --- what is not modelled

    def _unread_parts(self) -> list[str]:
        """Return notes on the parts of the file that are not modelled."""
        out = [*xml.unknown_parts(self.root, _SCHEMA, "URDF")]
        links, joints = [*self.root.each("link")], [*self.root.each("joint")]
        for use, what in (("visual", "shapes to be seen"), ("collision", "contact between shapes")):
            parts = [shape for link in links for part in link.each(use) for shape in part.all()]
            counts = Counter(shape.kind for shape in parts if shape.kind in _SHAPES)
            if counts:
                shown = ", ".join(f"{n} {texts.plural(shape, n)}" for shape, n in counts.items())
                out.append(f"{what}: {shown}" + (" (not opened)" if "mesh" in counts else ""))
        bare = [x.get("name") for x in links if x.first("inertial") is None and _shapes(x)]
        if bare:
            out.append(
                "links with a shape but without <inertial>, taken as massless: " + ", ".join(bare)
            )
        ends = [j for j in joints if j.first("limit") is not None and j.get("type") != "fixed"]
        limited = [j for j in ends if j.get("type") not in ("planar", "floating")]
        if several := [j.get("name") for j in ends if j not in limited]:
            out.append(f"limits of planar and floating joints: {texts.listed(several)}")
        if limited:
            many = f"{len(limited)} {texts.plural('joint', len(limited))}"
            out.append(f"limits of {many}: their values are in the notes")
        rest = Counter(e.kind for e in self.root.children if e.kind in _SKIPPED)
        rest.update(e.kind for j in joints for e in j.children if e.kind in _JOINT_SKIPPED)
        out += [f"<{tag}>, {n} {texts.plural('element', n)}" for tag, n in sorted(rest.items())]
        floating = [j.get("name") for j in joints if j.get("type") == "floating"
                    and j.first("dynamics") is not None]  # fmt: skip
        if floating:
            out.append(f"<dynamics> of floating joints: {', '.join(floating)}")
        return out

    # --- numbers

    def _part(self, element: Tag, kind: str, key: str) -> AttributeReader:
        """Return the attributes of a child of the element; none if there is no such child.

        `key` names the link or joint in messages.
        """
        tag = element.first(kind)
        return AttributeReader(tag.attributes if tag else {}, tag or element, self.report, key)

    def _origin(self, element: Tag, key: str) -> tuple[Vector, Matrix]:
        origin = self._part(element, "origin", key)
        return origin.vector("xyz") or ORIGIN, from_rpy(*(origin.vector("rpy") or ORIGIN))


def _mimic_description(motion: JointMotion) -> str:
    """Return a description of a joint that mimics another, with its limits."""
    assert motion.mimics
    return join_notes(f"{motion.name} mimics {motion.mimics.coordinate}", motion.note)


def _shapes(link: Tag) -> list[str]:
    return [shape.kind for shape in link.all() if shape.kind in _SHAPES]
