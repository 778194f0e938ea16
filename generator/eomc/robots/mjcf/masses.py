"""Poses and masses of an MJCF file: orientations, geoms, <inertial>, and the mass of a body."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from eomc.base.spatial import as_inertia, cross, dot, plus, point_inertia, transposed
from eomc.robots import geometry
from eomc.robots.geometry import (
    IDENTITY,
    IDENTITY_TRANSFORM,
    NO_INERTIA,
    ORIGIN,
    Inertia,
    Matrix,
    Transform,
    Vector,
    indefinite_message,
    principal_moments,
    rotated_inertia,
    rounded,
    toward,
    triangle_message,
    unit,
)
from eomc.robots.mjcf.file import (
    ORIENTATION,
    Classes,
    Settings,
    with_defaults,
)
from eomc.robots.robot import RobotBody
from eomc.robots.xml import AttributeReader, ImportReport, Tag
from eomc.scene.formulas import suggest

LEAST_MASS = 1e-15  # kg, mjMINVAL of MuJoCo's compiler


@dataclass(frozen=True)
class Mass:
    """A mass (kg), its centre of mass (m), and its inertia tensor about the centre (kg m^2)."""

    mass: float = 0.0
    center: Vector = ORIGIN
    inertia: Inertia = NO_INERTIA

    def in_frame(self, pose: Transform) -> Mass:
        """Return the mass with its centre and inertia tensor transformed to another frame.

        `pose` is the pose of the present frame in that other frame.
        """
        return Mass(
            self.mass,
            pose.point(self.center),
            rotated_inertia(self.inertia, pose.turn),
        )


@dataclass(frozen=True)
class Placed:
    """An element of a body, with its place in the tree.

    Attributes
    ----------
    tag, body
        The element, and the name of the body.
    pose : Transform
        Pose of the enclosing frames in the body's frame.
    childclass : str
        Default class that applies to the element.
    """

    tag: Tag
    body: str = ""
    pose: Transform = IDENTITY_TRANSFORM
    childclass: str = ""


@dataclass(frozen=True)
class Reader:
    """The context in which elements are read.

    Attributes
    ----------
    settings, classes
        Settings of the file, and default classes of attributes.
    report : ImportReport
        Receives faults and notes on parts that are left out.
    sites : dict
        Named sites read so far.
    """

    settings: Settings
    classes: Classes
    report: ImportReport
    sites: dict[str, Placed] = field(default_factory=dict)

    def attributes_with_defaults(self, placed: Placed, kind: str) -> AttributeReader:
        """Return the attributes of an element, completed by those of its default class.

        The default class is the one that the element names, or else the `childclass` of the
        enclosing bodies. `kind` is the kind of element, such as "joint", to which entries of the
        class apply.
        """
        tag = placed.tag
        default = self.class_of(tag.get("class", placed.childclass), tag)
        return AttributeReader(with_defaults(default.get(kind, {}), tag), tag, self.report)

    def class_of(self, name: str, tag: Tag) -> dict[str, dict[str, str]]:
        """Return the default class `name`, which maps each kind of element to its attributes.

        If the name is "", this is the outermost class. If there is no such class, a fault is
        reported for the element `tag`, and the outermost class is returned.
        """
        if name and name not in self.classes:
            self.own_attributes(tag).fault(
                f'there is no default class "{name}"{suggest(name, self.classes)}'
            )
            name = ""
        return self.classes[name or "main"]

    def own_attributes(self, tag: Tag) -> AttributeReader:
        """Return the attributes of an element without those of its default class."""
        return AttributeReader(tag.attributes, tag, self.report)


# --- poses ----------------------------------------------------------------------------------------


def unit_vector(vector: Sequence[float], what: str, a: AttributeReader) -> Vector | None:
    """Return the unit vector along `vector`, or None if its length is zero.

    A length of zero is reported as a fault; `what` describes the vector in the message.
    """
    x, y, z = vector
    if math.hypot(x, y, z) < 1e-14:
        a.fault(f"{what} has the length zero; give it a direction")
        return None
    return unit((x, y, z))


def _orientation(a: AttributeReader, settings: Settings) -> Matrix:
    """Return the rotation given by one of quat, axisangle, euler, xyaxes, zaxis."""
    keys = [key for key in ORIENTATION if key in a]
    if len(keys) > 1:
        a.fault(f"the orientation is given twice, by {' and '.join(keys)}; leave one")
    key = keys[0] if keys else ""
    v = a.numbers(key, ORIENTATION.get(key, 0))
    if v is None:
        return IDENTITY
    if key == "euler":
        return geometry.from_euler(settings.eulerseq, [settings.angle(value) for value in v])
    if key == "quat":
        if math.hypot(*v) < 1e-14:
            a.fault("quat has the length zero; no turn is 1 0 0 0")
            return IDENTITY
        return geometry.from_quaternion(*v)
    first = unit_vector(v[:3], key, a)
    if first is None:
        return IDENTITY
    if key == "zaxis":
        return toward(first)
    if key == "axisangle":
        return geometry.from_axis_angle(first, settings.angle(v[3]))
    along = dot(v[3:], first)
    across = [x - along * y for x, y in zip(v[3:], first, strict=True)]
    second = unit_vector(across, "the y axis of xyaxes", a)
    if second is None:
        return IDENTITY
    return geometry.cleaned(transposed((first, second, cross(first, second))))


def read_pose(a: AttributeReader, settings: Settings) -> Transform:
    """Return the pose of an element's frame in the enclosing frame, from its attributes."""
    return Transform(a.vector("pos") or ORIGIN, _orientation(a, settings))


# --- masses ---------------------------------------------------------------------------------------


def _ball(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _capsule. size: the radius."""
    return _capsule((*size, 0.0), shell)


def _capsule(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """Return the volume (area of a shell), and the mean squares of x, y and z over it.

    size: radius, half the length of the cylinder between the two half balls.
    """
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
    z = (tube * h * h / 3 + caps * (cap_across + 2 * h * beyond + h * h)) / amount
    return amount, (x, x, z)


def _cylinder(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _capsule. size: radius, half the length. A shell has its two discs."""
    r, h = size
    if not shell:
        return 2 * math.pi * r * r * h, (r * r / 4, r * r / 4, h * h / 3)
    tube, discs = 4 * math.pi * r * h, 2 * math.pi * r * r
    amount = tube + discs
    x = (tube * r * r / 2 + discs * r * r / 4) / amount
    return amount, (x, x, (tube * h * h / 3 + discs * h * h) / amount)


def _box(size: Sequence[float], shell: bool) -> tuple[float, Vector]:
    """As _capsule. size: half the edges."""
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
    """As _capsule, and never a shell. size: the three radii."""
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
FORMLESS = ("mesh", "sdf")  # their shape is in a separate file


def _geom_mass(placed: Placed, reader: Reader, is_static: bool) -> Mass | None:
    """Return the mass of a geom in its body's frame; None if it has none, or after a fault.

    is_static: the body doesn't move, so that its mass has no effect.
    """
    a = reader.attributes_with_defaults(placed, "geom")
    kind = a.choice("type", (*SHAPES, *MASSLESS, *FORMLESS))
    mass = a.number("mass") if "mass" in a else None
    density = a.number("density", 1000.0)
    if density < 0 or (mass or 0) < 0:
        a.fault("mass and density must not be negative")
        return None
    low, high = reader.settings.groups
    if kind in MASSLESS or not low <= a.number("group") <= high:
        return None
    if mass == 0 or (mass is None and density == 0):
        return None
    shell = a.is_true("shellinertia")
    if kind in FORMLESS or "mesh" in a:
        if is_static and reader.settings.totalmass <= 0:
            reader.report.leave_out(
                "masses of meshes (not opened) on bodies that stand still, taken as zero",
                placed.body,
            )
            return None
        remedy = (
            'give the body an <inertial> (MuJoCo\'s compiler writes it with saveinertial="true")'
        )
        if reader.settings.inertia == "true":
            remedy += ', and <compiler> inertiafromgeom="auto", so that it counts'
        a.fault(
            f"the mass of {placed.body} follows from a mesh, which is not opened: {remedy}, "
            'or the geom mass="0"'
        )
        return None
    if kind == "ellipsoid" and shell:
        a.fault(
            f"the shell of an ellipsoid has no closed inertia; give {placed.body} an <inertial>"
        )
        return None
    geometry = _form(kind, a, reader.settings)
    if geometry is None:
        return None
    size, pose = geometry
    amount, (x, y, z) = SHAPES[kind][1](size, shell)
    m = density * amount if mass is None else mass
    inertia = (m * (y + z), m * (x + z), m * (x + y), 0.0, 0.0, 0.0)
    return Mass(m, ORIGIN, inertia).in_frame(placed.pose.compose(pose))


def _form(
    kind: str, a: AttributeReader, settings: Settings
) -> tuple[Sequence[float], Transform] | None:
    """Return the sizes of a geom, m, and its pose in the enclosing frame; None after a fault."""
    count = SHAPES[kind][0]
    size, ends = a.numbers("size", 3, 1), a.numbers("fromto", 6)
    if size is None:
        if "size" not in a:
            a.fault(f"a {kind} needs a size: {count} positive numbers")
        return None
    if ends is None:
        pose = read_pose(a, settings)
    elif kind == "sphere":
        a.fault("a sphere has no fromto; give it pos, or type a capsule")
        return None
    else:
        (ax, ay, az, bx, by, bz) = ends
        between = (bx - ax, by - ay, bz - az)
        along = unit_vector(between, "fromto", a)
        if along is None:
            return None
        half = math.hypot(*between) / 2
        size = (size[0], half) if count == 2 else (size[0], size[0], half)
        pose = Transform(((ax + bx) / 2, (ay + by) / 2, (az + bz) / 2), toward(along))
    if len(size) < count or min(size[:count]) <= 0:
        a.fault(f"the size of a {kind} is {count} positive numbers")
        return None
    return size[:count], pose


def _sum(masses: Sequence[Mass]) -> Mass:
    """Combine masses into one, by Steiner's theorem about the common centre of mass."""
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
    return Mass(total, (x, y, z), as_inertia(rounded(i, size) for i in inertia))


def _inertial(placed: Placed, reader: Reader) -> Mass | None:
    """Return the mass given by <inertial>, in its body's frame; None after a fault."""
    a = reader.own_attributes(placed.tag)
    if "mass" not in a or "pos" not in a:
        a.fault(f"the <inertial> of {placed.body} needs pos and mass")
        return None
    pose = read_pose(a, reader.settings)
    mass = a.number("mass")
    if mass < 0:
        a.fault(f"the mass of {placed.body}, {mass:g} kg, is negative")
        return None
    if "fullinertia" in a and a.attributes.keys() & {"diaginertia", *ORIENTATION}:
        a.fault("fullinertia goes with neither diaginertia nor an orientation; leave one")
        return None
    full, along = a.numbers("fullinertia", 6), a.vector("diaginertia") or ORIGIN
    inertia = as_inertia(full) if full else (*along, 0.0, 0.0, 0.0)
    return Mass(mass, ORIGIN, inertia).in_frame(placed.pose.compose(pose))


def body_mass(tag: Tag, inner: Sequence[Placed], reader: Reader, is_static: bool) -> Mass:
    """Return the mass of a body in the body's frame, from its <inertial> or its <geom> elements.

    `tag` is the body's element, and `inner` are the elements in it. `is_static` says that the body
    does not move.
    """
    how = reader.settings.inertia
    inertials = [p for p in inner if p.tag.kind == "inertial"]
    geoms = [p for p in inner if p.tag.kind == "geom"]
    for placed in inertials[1:]:
        reader.own_attributes(placed.tag).fault(f"{placed.body} has a second <inertial>; leave one")
    mass = Mass()
    if how == "true" or (how == "auto" and not inertials):
        mass = _sum([m for p in geoms if (m := _geom_mass(p, reader, is_static)) is not None])
    if inertials and mass.mass < LEAST_MASS:  # of geoms, which then leave <inertial> as it is
        mass, tag = _inertial(inertials[0], reader) or Mass(), inertials[0].tag
    return _with_bounds(mass, reader.own_attributes(tag), reader.settings)


def _with_bounds(mass: Mass, a: AttributeReader, s: Settings) -> Mass:
    """Apply boundmass, boundinertia and balanceinertia to a mass, and check its inertia."""
    inertia = mass.inertia
    if not all(math.isfinite(x) for x in (mass.mass, *mass.center, *inertia)):
        a.fault("its mass or inertia overflows: check sizes, densities and places")
        return Mass()
    if s.boundinertia > 0 or s.balance:
        moments, axes = principal_moments(inertia)
        bounded = [max(m, s.boundinertia) for m in moments] if s.boundinertia > 0 else moments
        small, middle, large = bounded
        if s.balance and small + middle < large:
            bounded = [sum(bounded) / 3] * 3
        if bounded != moments:
            rows = tuple(zip(*axes, strict=True))
            inertia = rotated_inertia((*bounded, 0.0, 0.0, 0.0), rows)  # type: ignore[arg-type]
    if why := indefinite_message(inertia):
        a.fault(f"{why}; mend it, or set boundinertia in <compiler>")
    elif why := triangle_message(inertia):
        a.fault(f"{why}; so would balanceinertia in <compiler>")
    return Mass(max(mass.mass, s.boundmass), mass.center, inertia)


def scale_masses(bodies: Sequence[RobotBody], total: float) -> list[RobotBody]:
    """Return the bodies with masses and inertias scaled so that the total mass is `total` (kg)."""
    now = sum(body.mass for body in bodies)
    k = total / now if now else 1.0
    return [
        replace(body, mass=k * body.mass, inertia=as_inertia(k * v for v in body.inertia))
        for body in bodies
    ]
