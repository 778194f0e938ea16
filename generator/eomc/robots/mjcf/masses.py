"""Poses and masses of an MJCF file: orientations, solids, <inertial>, and their sums in a body."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from eomc.base.spatial import apply, cross, dot, plus, point_inertia, six, transposed
from eomc.robots.inertias import (
    NO_INERTIA,
    Inertia,
    indefinite,
    principal,
    rotated_inertia,
    unbalanced,
)
from eomc.robots.mjcf import file as text
from eomc.robots.mjcf.file import ORIENTATION, TRUTH, Attributes, Classes, Settings, Tag, Told
from eomc.robots.robot import RobotBody
from eomc.robots.rotations import (
    IDENTITY,
    ORIGIN,
    Matrix,
    Vector,
    cleaned,
    from_axis_angle,
    from_euler,
    from_quaternion,
    times,
    unit,
)

ROUNDING = 1e-15  # what is smaller, relative to its neighbours, becomes zero


class Pose(NamedTuple):
    """A frame in another: its origin, m, and its axes, the columns of `turn`."""

    place: Vector
    turn: Matrix

    def of(self, other: Pose) -> Pose:
        """The frame `other`, given in this one, where this one is given."""
        return Pose(plus(self.place, apply(self.turn, other.place)), times(self.turn, other.turn))


STILL = Pose(ORIGIN, IDENTITY)


class Mass(NamedTuple):
    """A mass (kg), its centre, m, and its inertia about the centre, kg m^2."""

    mass: float = 0.0
    center: Vector = ORIGIN
    inertia: Inertia = NO_INERTIA

    def on(self, pose: Pose) -> Mass:
        """The same in the frame in which `pose` is given."""
        return Mass(
            self.mass,
            plus(pose.place, apply(pose.turn, self.center)),
            rotated_inertia(self.inertia, pose.turn),
        )


class Placed(NamedTuple):
    """A tag in a body, with the pose of the frames around it there, and its default class."""

    tag: Tag
    body: str
    pose: Pose
    childclass: str


@dataclass(frozen=True)
class Reader:
    """What every step of reading needs: the settings, the default classes, and who is told."""

    settings: Settings
    classes: Classes
    told: Told


def attributes_of(placed: Placed, kind: str, reader: Reader) -> Attributes:
    """The attributes of a tag with those of its class: its own, or the childclass around it."""
    tag = placed.tag
    name = tag.attributes.get("class", placed.childclass)
    return text.merged(class_of(name, tag, reader).get(kind, {}), tag)


def class_of(name: str, tag: Tag, reader: Reader) -> dict[str, Attributes]:
    """The default class that a tag names; the outermost one for "", or for a fault."""
    if name and name not in reader.classes:
        reader.told.fault(tag, f'there is no default class "{name}"')
        name = ""
    return reader.classes[name or "main"]


# ---- poses


def _toward(z: Vector) -> Matrix:
    """The smallest turn that takes the z axis into the unit vector `z`; a half turn is about x."""
    sine = math.hypot(z[0], z[1])
    axis = (-z[1], z[0], 0.0) if sine > 1e-10 else (1.0, 0.0, 0.0)
    return from_axis_angle(axis, math.atan2(sine, z[2]))


def direction(vector: Sequence[float], what: str, tag: Tag, told: Told) -> Vector | None:
    """`vector` of length one; None, and told, where it has none."""
    x, y, z = vector
    if math.hypot(x, y, z) < 1e-14:
        told.fault(tag, f"{what} has the length zero; give it a direction")
        return None
    return unit((x, y, z))


def _orientation(attributes: Attributes, tag: Tag, reader: Reader) -> Matrix:
    """The turn that one of quat, axisangle, euler, xyaxes, zaxis gives; none is no turn."""
    told, settings = reader.told, reader.settings
    given = [key for key in ORIENTATION if key in attributes]
    if not given:
        return IDENTITY
    if len(given) > 1:
        told.fault(tag, f"the orientation is given twice, by {' and '.join(given)}; leave one")
    key = given[0]
    v = text.numbers(attributes, key, tag, told, ORIENTATION[key])
    if v is None:
        return IDENTITY
    if key == "euler":
        return from_euler(settings.eulerseq, [settings.angle(value) for value in v])
    if key == "quat":
        if math.hypot(*v) < 1e-14:
            told.fault(tag, "quat has the length zero; no turn is 1 0 0 0")
            return IDENTITY
        return from_quaternion(v[0], v[1], v[2], v[3])
    first = direction(v[:3], key, tag, told)
    if first is None:
        return IDENTITY
    if key == "zaxis":
        return _toward(first)
    if key == "axisangle":
        return from_axis_angle(first, settings.angle(v[3]))
    along = dot(v[3:], first)
    across = [a - along * b for a, b in zip(v[3:], first, strict=True)]
    second = direction(across, "the y axis of xyaxes", tag, told)
    if second is None:
        return IDENTITY
    return cleaned(transposed((first, second, cross(first, second))))


def pose_of(attributes: Attributes, tag: Tag, reader: Reader) -> Pose:
    """Where an element's frame stands in the frame around it."""
    place = text.vector(attributes, "pos", tag, reader.told)
    return Pose(place or ORIGIN, _orientation(attributes, tag, reader))


# ---- masses


def _ball(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """Volume (area of a shell), and the mean squares of x, y and z over it. size: the radius."""
    r = size[0]
    if shell:
        return 4 * math.pi * r**2, (r * r / 3,) * 3
    return 4 / 3 * math.pi * r**3, (r * r / 5,) * 3


def _capsule(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _ball. size: radius, half the length of the cylinder between the two half balls."""
    r, h = size
    if shell:
        tube, caps = 4 * math.pi * r * h, 4 * math.pi * r**2
        across, cap_across = r * r / 2, r * r / 3
        beyond = r / 2  # how far beyond the cylinder a cap's centre of mass lies
    else:
        tube, caps = 2 * math.pi * r * r * h, 4 / 3 * math.pi * r**3
        across, cap_across = r * r / 4, r * r / 5
        beyond = 3 / 8 * r
    amount = tube + caps
    x = (tube * across + caps * cap_across) / amount
    return amount, (
        x,
        x,
        (tube * h * h / 3 + caps * (cap_across + 2 * h * beyond + h * h)) / amount,
    )


def _cylinder(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _ball. size: radius, half the length. A shell has its two discs."""
    r, h = size
    if not shell:
        return 2 * math.pi * r * r * h, (r * r / 4, r * r / 4, h * h / 3)
    tube, discs = 4 * math.pi * r * h, 2 * math.pi * r * r
    amount = tube + discs
    x = (tube * r * r / 2 + discs * r * r / 4) / amount
    return amount, (x, x, (tube * h * h / 3 + discs * h * h) / amount)


def _box(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _ball. size: half the edges."""
    a, b, c = size
    if not shell:
        return 8 * a * b * c, (a * a / 3, b * b / 3, c * c / 3)
    faces = (8 * b * c, 8 * a * c, 8 * a * b)  # each the two across one axis
    amount = sum(faces)
    # the two faces lie at the ends of that axis, the other four are spread along it
    x, y, z = (
        (f * s * s + (amount - f) * s * s / 3) / amount for f, s in zip(faces, size, strict=True)
    )
    return amount, (x, y, z)


def _ellipsoid(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _ball, and never a shell. size: the three radii."""
    a, b, c = size
    return 4 / 3 * math.pi * a * b * c, (a * a / 5, b * b / 5, c * c / 5)


SHAPES: dict[str, tuple[int, Callable[[Sequence[float], bool], tuple[float, Vector]]]] = {
    "sphere": (1, _ball),
    "capsule": (2, _capsule),
    "cylinder": (2, _cylinder),
    "box": (3, _box),
    "ellipsoid": (3, _ellipsoid),
}
MASSLESS = ("plane", "hfield")
FORMLESS = ("mesh", "sdf")  # their volume stands in a file of their own


def _geom_mass(placed: Placed, reader: Reader) -> Mass | None:
    """The mass of a geom in its body's frame; None where it has none, or a fault, which is told."""
    told, tag = reader.told, placed.tag
    a = attributes_of(placed, "geom", reader)
    kind = text.choice(a, "type", tag, told, (*SHAPES, *MASSLESS, *FORMLESS))
    mass = text.number(a, "mass", tag, told) if "mass" in a else None
    density = text.number(a, "density", tag, told, 1000.0)
    if density < 0 or (mass or 0) < 0:
        told.fault(tag, "mass and density must not be negative")
        return None
    low, high = reader.settings.groups
    if kind in MASSLESS or not low <= text.number(a, "group", tag, told) <= high:
        return None
    if mass == 0 or (mass is None and density == 0):
        return None
    shell = text.choice(a, "shellinertia", tag, told, TRUTH) == "true"
    if kind in FORMLESS or "mesh" in a:
        remedy = (
            'give the body an <inertial> (MuJoCo\'s compiler writes it with saveinertial="true")'
        )
        if reader.settings.inertia == "true":
            remedy += ', and <compiler> inertiafromgeom="auto", so that it counts'
        told.fault(
            tag,
            f"the mass of {placed.body} follows from a mesh, which is not opened: {remedy}, "
            'or the geom mass="0"',
        )
        return None
    if kind == "ellipsoid" and shell:
        told.fault(
            tag,
            f"the shell of an ellipsoid has no closed inertia; give {placed.body} an <inertial>",
        )
        return None
    found = _form(kind, a, tag, reader)
    if found is None:
        return None
    size, pose = found
    amount, (x, y, z) = SHAPES[kind][1](size, shell)
    m = density * amount if mass is None else mass
    inertia = (m * (y + z), m * (x + z), m * (x + y), 0.0, 0.0, 0.0)
    return Mass(m, ORIGIN, inertia).on(placed.pose.of(pose))


def _form(
    kind: str, a: Attributes, tag: Tag, reader: Reader
) -> tuple[Sequence[float], Pose] | None:
    """The sizes of a geom, m, and where it stands in the frame around it; None for a fault."""
    told = reader.told
    count = SHAPES[kind][0]
    size = text.numbers(a, "size", tag, told, 3, 1)
    ends = text.numbers(a, "fromto", tag, told, 6)
    if size is None:
        if "size" not in a:
            told.fault(tag, f"a {kind} needs a size: {count} positive numbers")
        return None
    if ends is None:
        pose = pose_of(a, tag, reader)
    elif kind == "sphere":
        told.fault(tag, "a sphere has no fromto; give it pos, or type a capsule")
        return None
    else:
        (ax, ay, az, bx, by, bz) = ends
        between = (bx - ax, by - ay, bz - az)
        along = direction(between, "fromto", tag, told)
        if along is None:
            return None
        half = math.hypot(*between) / 2
        size = (size[0], half) if count == 2 else (size[0], size[0], half)
        pose = Pose(((ax + bx) / 2, (ay + by) / 2, (az + bz) / 2), _toward(along))
    if len(size) < count or min(size[:count]) <= 0:
        told.fault(tag, f"the size of a {kind} is {count} positive numbers")
        return None
    return size[:count], pose


def _sum(masses: Sequence[Mass]) -> Mass:
    """Several masses as one: their centre, and Steiner's theorem about it."""
    total = sum(m.mass for m in masses)
    if len(masses) < 2 or not total:
        return masses[0] if masses else Mass()
    wide = max(abs(c) for m in masses for c in m.center)
    x, y, z = (rounded(sum(m.mass * m.center[k] for m in masses) / total, wide) for k in range(3))
    inertia = [0.0] * 6
    for m in masses:
        about = point_inertia(1.0, plus(m.center, (-x, -y, -z)))
        inertia = [
            i + own + m.mass * d for i, own, d in zip(inertia, m.inertia, about, strict=True)
        ]
    size = max(map(abs, inertia))
    return Mass(total, (x, y, z), six(rounded(i, size) for i in inertia))


def rounded(x: float, size: float) -> float:
    """`x`, or 0 where it is what rounding left of a zero among numbers of the size `size`."""
    return x if abs(x) > ROUNDING * size else 0.0


def _inertial(placed: Placed, reader: Reader) -> Mass | None:
    """The mass that <inertial> gives, in its body's frame; None for a fault."""
    told, tag = reader.told, placed.tag
    a = tag.attributes
    text.unknown(tag, told)
    if "mass" not in a or "pos" not in a:
        told.fault(tag, f"the <inertial> of {placed.body} needs pos and mass")
        return None
    pose = pose_of(a, tag, reader)
    mass = text.number(a, "mass", tag, told)
    if mass < 0:
        told.fault(tag, f"the mass of {placed.body}, {mass:g} kg, is negative")
        return None
    if "fullinertia" in a and a.keys() & {"diaginertia", *ORIENTATION}:
        told.fault(tag, "fullinertia goes with neither diaginertia nor an orientation; leave one")
        return None
    full = text.numbers(a, "fullinertia", tag, told, 6)
    along = text.vector(a, "diaginertia", tag, told) or ORIGIN
    inertia = six(full) if full else (*along, 0.0, 0.0, 0.0)
    return Mass(mass, ORIGIN, inertia).on(placed.pose.of(pose))


def body_mass(tag: Tag, inner: Sequence[Placed], reader: Reader) -> Mass:
    """The mass of a body, in its frame, from <inertial> or from its geoms."""
    told, how = reader.told, reader.settings.inertia
    inertials = [p for p in inner if p.tag.kind == "inertial"]
    geoms = [p for p in inner if p.tag.kind == "geom"]
    for placed in inertials[1:]:
        told.fault(placed.tag, f"{placed.body} has a second <inertial>; leave one")
    if inertials and (how != "true" or not geoms):
        mass, place = _inertial(inertials[0], reader) or Mass(), inertials[0].tag
    elif how == "false":
        mass, place = Mass(), tag
    else:
        masses = [m for placed in geoms if (m := _geom_mass(placed, reader)) is not None]
        mass, place = _sum(masses), tag
    return _bounded(mass, place, reader)


def _bounded(mass: Mass, tag: Tag, reader: Reader) -> Mass:
    """`mass` under boundmass, boundinertia and balanceinertia; its inertia checked."""
    s, told = reader.settings, reader.told
    inertia = mass.inertia
    if not all(math.isfinite(x) for x in (mass.mass, *mass.center, *inertia)):
        told.fault(tag, "its mass or inertia overflows: check sizes, densities and places")
        return Mass()
    if s.boundinertia > 0 or s.balance:
        moments, axes = principal(inertia)
        bounded = [max(m, s.boundinertia) for m in moments] if s.boundinertia > 0 else moments
        small, middle, large = bounded
        if s.balance and small + middle < large:
            bounded = [sum(bounded) / 3] * 3
        if bounded != moments:
            rows = tuple(zip(*axes, strict=True))
            inertia = rotated_inertia((*bounded, 0.0, 0.0, 0.0), rows)  # type: ignore[arg-type]
    if why := indefinite(inertia):
        told.fault(tag, f"{why}; mend it, or set boundinertia in <compiler>")
    elif why := unbalanced(inertia):
        told.fault(tag, f"{why}; so would balanceinertia in <compiler>")
    return Mass(max(mass.mass, s.boundmass), mass.center, inertia)


def scaled_to(bodies: Sequence[RobotBody], total: float) -> list[RobotBody]:
    """The bodies with masses and inertias scaled to settotalmass."""
    now = sum(body.mass for body in bodies)
    k = total / now if now else 1.0
    return [
        replace(body, mass=k * body.mass, inertia=six(k * v for v in body.inertia))
        for body in bodies
    ]
