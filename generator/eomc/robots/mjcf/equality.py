"""Equality constraints of an MJCF file: connected or welded bodies, coupled joints and tendons.

MuJoCo's constraints are soft, with the stiffness given by solref and solimp; here they are exact.
The point on the second body follows from the pose of the file, as in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eomc.base.spatial import apply, plus, scaled, transposed
from eomc.robots import rotations
from eomc.robots.mjcf.file import AttributeReader, missing_message
from eomc.robots.mjcf.joints import MjcfJoint, Tendons, unique_name
from eomc.robots.mjcf.masses import (
    IDENTITY_TRANSFORM,
    Placed,
    Reader,
    Transform,
    read_pose,
    rounded,
)
from eomc.robots.robot import Coupling, JointMotion, RobotBody, RobotLoop, body_pose
from eomc.robots.rotations import IDENTITY, ORIGIN, Matrix, Vector, times
from eomc.robots.xml import Tag
from eomc.scene.assembly import WORLD

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
    poses = {WORLD: IDENTITY_TRANSFORM}
    for body in bodies:
        offset, turn = body_pose(body, [m.start for m in body.motions])
        poses[body.name] = poses[body.parent].compose(Transform(offset, turn))
    reading = _Reading(tendons, _Ends(poses, anchors), joints, reader)
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
        a = self.reader.attributes_with_defaults(
            Placed(tag, "", IDENTITY_TRANSFORM, ""), "equality"
        )
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
        sites = [a.get("site1"), a.get("site2")]
        attachments = [self._site(s, a) for s in sites] if any(sites) else self._anchored(kind, a)
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

    def _site(self, name: str, a: AttributeReader) -> tuple[str, Vector, Matrix] | None:
        """Return a site's body, its position there, and the body's axes in the site's frame."""
        placed = self.reader.sites.get(name)
        if placed is None:
            what = missing_message("site", name, self.reader.sites)
            a.fault(what if name else "it needs both site1 and site2")
            return None
        self.reader.report.mark_read("sites", name)
        site = placed.pose.compose(
            read_pose(self.reader.attributes_with_defaults(placed, "site"), self.reader.settings)
        )
        world = self.ends.file_pose(placed.body).compose(site)
        return placed.body, self.ends.point(placed.body, world.place), transposed(site.turn)

    def _anchored(self, kind: str, a: AttributeReader) -> list[tuple[str, Vector, Matrix] | None]:
        """Return both bodies, each with the common point and its rotation in a common frame."""
        names = [a.get("body1"), a.get("body2", WORLD)]
        for name in names:
            if name not in self.ends.poses:
                a.fault(
                    missing_message("body", name, self.ends.poses) if name else "it needs body1"
                )
                return [None, None]
        one, other = names
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
            turn = rotations.from_quaternion(*quaternion)
        return [(one, on_first, IDENTITY), (other, self.ends.shifted(other, point), turn)]

    # --- joints

    def _coupling(self, name: str, kind: str, a: AttributeReader) -> None:
        read = self._joint if kind == "joint" else self._tendon
        first = read(a.get(f"{kind}1"), name, a)
        second = read(a.get(f"{kind}2"), name, a) if a.get(f"{kind}2") else ()
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

    def _joint(self, joint: str, name: str, a: AttributeReader) -> Sides | None:
        """Return the coordinate of a joint, as a sum with one term; None if it has none."""
        if joint not in self.joints:
            a.fault(missing_message("joint", joint, self.joints) if joint else "it needs joint1")
            return None
        mjcf_joint = self.joints[joint]
        if len(mjcf_joint.motions) > 1:
            self.reader.report.leave_out("couplings of free and ball joints", name)
            return None
        return ((1.0, mjcf_joint.motions[0]),)

    def _tendon(self, tendon: str, name: str, a: AttributeReader) -> Sides | None:
        """Return a tendon's length as a sum of coordinates; None if it is not fixed."""
        if not tendon:
            a.fault("it needs tendon1")
            return None
        if not self.tendons.has_tendon(tendon, a):
            return None
        if tendon not in self.tendons.fixed:
            self.reader.report.leave_out("couplings of tendons through space", name)
            return None
        self.tendons.mark_modelled(tendon)
        motions = {m.name: m for joint in self.joints.values() for m in joint.motions}
        return tuple((by, motions[q]) for by, q in self.tendons.fixed[tendon].terms)
