"""Fixed tendons of an MJCF file: sums of joints, with springs, dampers and actuators along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from eomc.robots.mjcf.file import AttributeReader, leave_unread, missing
from eomc.robots.mjcf.joints import MjcfJoint, is_limited, unique_name
from eomc.robots.mjcf.masses import IDENTITY_POSE, Placed, Reader
from eomc.robots.robot import Range, Tendon
from eomc.robots.xml import Tag

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
            reader.report.leave(LEFT, f"{tag.kind} {name}".rstrip())
            terms = self._terms(tag) if tag.kind == "fixed" else None
            if not terms:
                continue
            tendon = self._read(Tendon(unique_name(name or "tendon", used_names), terms), tag)
            used_names.add(tendon.name)
            self.fixed[name or tendon.name] = tendon
            if tendon.acts:
                self.reads(name)

    @property
    def acting(self) -> tuple[Tendon, ...]:
        """The fixed tendons that have stiffness, damping, armature or an actuator."""
        return tuple(t for name, t in self.fixed.items() if t.acts or name in self._driven)

    def known(self, name: str, a: AttributeReader) -> bool:
        """Return True if the file has a tendon called `name`; otherwise report a fault."""
        names = {tag.get("name") for tag in self._tags}
        if name not in names:
            a.fault(missing("tendon", name, names))
        return name in names

    def reads(self, name: str) -> None:
        """Record that a fixed tendon is modelled, so that it is not listed as left out."""
        self._reader.report.read(LEFT, f"fixed {name}".rstrip())

    def driven(self, name: str) -> str:
        """Record that an actuator drives a tendon, and return the unique name of the tendon.

        `name` is the tendon's name in the file. It is a fixed tendon: a linear combination of joint
        positions.
        """
        self._driven.add(name)
        self.reads(name)
        return self.fixed[name].name

    def _terms(self, tag: Tag) -> tuple[tuple[float, str], ...]:
        """Return the terms of a fixed tendon; none if it refers to free, ball or unknown joints."""
        terms = []
        for each in tag.each("joint"):
            a = self._reader.own_attributes(each)
            joint = a.get("joint")
            if joint not in self._joints:
                a.fault(missing("joint", joint, self._joints) if joint else "it needs a joint")
                return ()
            if self._joints[joint].type in {"free", "ball"}:
                return ()
            terms.append((a.number("coef", 1.0), self._joints[joint].motions[0].name))
        return tuple(terms)

    def _read(self, tendon: Tendon, tag: Tag) -> Tendon:
        report, name = self._reader.report, tag.get("name")
        a = self._reader.attributes_with_defaults(Placed(tag, "", IDENTITY_POSE, ""), "tendon")
        own = {}
        for key in ("stiffness", "damping"):
            own[key], *more = a.numbers(key, 3, 1) or (0.0,)
            if any(more):
                report.leave(f"{key} in the square and cube of tendons", name)
        own["armature"] = a.number("armature")
        for key, value in own.items():
            if value < 0:
                a.fault(f"{key} must not be negative")
        for key, what in (("", "length"), ("actuatorfrc", "force")):
            if a.numbers(f"{key}range", 2) and is_limited(
                a, f"{key}limited", self._reader.settings
            ):
                report.leave(f"limits of {what} of tendons", name)
        leave_unread(a, "tendon", name)
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
