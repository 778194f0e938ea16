"""Robots as robot files have them: plain numbers; and a scene that a person can read and edit.

The readers (urdf.py, mjcf.py) make a Robot with the names of the file; `lock`, `cut` and `based`
change it as the user asks; `finished` makes it fit for a scene, `scene_text` writes that.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from eomc.base import names
from eomc.base.errors import EomcError
from eomc.base.texts import line, toml
from eomc.scene.assembly import WORLD
from eomc.scene.formulas import suggest
from eomc.scene.joints import JOINTS

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Inertia = tuple[float, float, float, float, float, float]

ORIGIN: Vector = (0.0, 0.0, 0.0)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

TRIANGLE = 1e-6  # relative excess of a principal moment over the other two that a scene may have

_INTO_MATRIX = ((0, 3, 4), (3, 1, 5), (4, 5, 2))  # the place in Ixx Iyy Izz Ixy Ixz Iyz
_SNAP = 1e-10  # rad: files write pi/2 with eleven digits and mean it
_NAME = 32  # characters of a name, so that what is made of it ("_torque", "_dot") fits too


@dataclass(frozen=True)
class Motion:
    """A coordinate of a joint, in `unit` "rad" or "m".

    damping: N m s/rad or N s/m; friction: N m or N; armature: kg m^2 or kg; stiffness (N m/rad or
    N/m) and rest: of the joint's own spring. note: its limits.
    """

    name: str
    unit: str
    start: float = 0.0
    note: str = ""
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0


@dataclass(frozen=True)
class RobotBody:
    """A body and the joint that holds it; `assembly.Body` in numbers.

    parent: a body above, or "world". joint: a key of joints.JOINTS, with a motion for each of
    its coordinates and its unit `axes` in the joint's frame. offset (m) and rotation: the joint's
    frame in the parent's, v_parent = offset + rotation v_joint. mass: kg. center: m, in the
    body's frame. inertia: kg m^2, of the centre of mass, along the body's axes.
    """

    name: str
    parent: str = WORLD
    joint: str = "fixed"
    motions: tuple[Motion, ...] = ()
    axes: tuple[Vector, ...] = ()
    offset: Vector = ORIGIN
    rotation: Matrix = IDENTITY
    mass: float = 0.0
    center: Vector = ORIGIN
    inertia: Inertia = NO_INERTIA
    note: str = ""


@dataclass(frozen=True)
class Drive:
    """An input that acts along a coordinate with the force gear times its value."""

    name: str
    coordinate: str
    gear: float = 1.0
    note: str = ""


@dataclass(frozen=True)
class Robot:
    """A tree of bodies, parents first; gravity in m/s^2; what the file has besides, in words."""

    name: str
    title: str
    gravity: Vector
    bodies: tuple[RobotBody, ...]
    drives: tuple[Drive, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The coordinates, in the order of the bodies."""
        return tuple(m for body in self.bodies for m in body.motions)


# --- rotations ------------------------------------------------------------------------------------


def cleaned(a: Matrix) -> Matrix:
    """A rotation with entries within 1e-12 of 0, 1 and -1 put there: cos(pi/2) is 6e-17."""

    def clean(x: float) -> float:
        near = float(round(x))
        return near + 0.0 if abs(x - near) < 1e-12 else x

    return _matrix([[clean(x) for x in row] for row in a])


def times(a: Matrix, b: Matrix) -> Matrix:
    """A B, of rotations; cleaned."""
    return cleaned(
        _matrix([[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)])
    )


def transposed(a: Matrix) -> Matrix:
    """A^T."""
    return _matrix([[a[j][i] for j in range(3)] for i in range(3)])


def turned(a: Matrix, v: Vector) -> Vector:
    """A v."""
    x, y, z = (sum(a[i][k] * v[k] for k in range(3)) for i in range(3))
    return x, y, z


def added(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scaled(a: float, v: Vector) -> Vector:
    """a v."""
    return a * v[0], a * v[1], a * v[2]


def unit(v: Vector) -> Vector:
    """v/|v|; ValueError where |v| is zero or not finite."""
    size = math.hypot(*v)
    if not size or not math.isfinite(size):
        raise ValueError("a vector of length zero" if not size else "a vector that is not finite")
    if abs(size - 1) < 1e-15:
        return v
    x, y, z = (c / size + 0.0 for c in v)
    return x, y, z


def from_axis_angle(axis: Vector, angle: float) -> Matrix:
    """The rotation by `angle` (rad) about `axis`, of any length but zero (Rodrigues)."""
    x, y, z = unit(axis)
    s, c = math.sin(angle), math.cos(angle)
    r = 1 - c
    return cleaned(
        (
            (c + x * x * r, x * y * r - z * s, x * z * r + y * s),
            (y * x * r + z * s, c + y * y * r, y * z * r - x * s),
            (z * x * r - y * s, z * y * r + x * s, c + z * z * r),
        )
    )


def from_turns(turns: Sequence[tuple[str, float]]) -> Matrix:
    """The rotation of turns (axis, rad), one after the other about the axes turned so far."""
    out = IDENTITY
    for axis, angle in turns:
        out = times(out, from_axis_angle(IDENTITY["xyz".index(axis)], angle))
    return out


def from_rpy(roll: float, pitch: float, yaw: float) -> Matrix:
    """Rz(yaw) Ry(pitch) Rx(roll), as URDF writes it."""
    return from_turns((("z", yaw), ("y", pitch), ("x", roll)))


def from_quaternion(w: float, x: float, y: float, z: float) -> Matrix:
    """The rotation of a quaternion, of any length but zero."""
    size = math.hypot(w, x, y, z)
    if not size or not math.isfinite(size):
        raise ValueError("a quaternion of length zero")
    w, x, y, z = w / size, x / size, y / size, z / size
    return cleaned(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def from_euler(sequence: str, angles: Sequence[float]) -> Matrix:
    """Turns about the axes of `sequence`: small letters turn with the frame, capitals do not."""
    out = IDENTITY
    for axis, angle in zip(sequence, angles, strict=True):
        turn = from_axis_angle(IDENTITY["xyz".index(axis.lower())], angle)
        out = times(out, turn) if axis.islower() else times(turn, out)
    return out


def turns_of(a: Matrix) -> tuple[tuple[str, float], ...]:
    """The turns about z, y and x that make the rotation `a`, those by zero left out.

    Near a pitch of pi/2 only the sum of the other two is well known: what rounding does to the
    first is undone by taking the last from what the first leaves.
    """
    yaw = math.atan2(a[1][0], a[0][0]) if math.hypot(a[0][0], a[1][0]) > 1e-12 else 0.0
    rest = times(transposed(from_axis_angle((0.0, 0.0, 1.0), yaw)), a)
    pitch = math.atan2(-rest[2][0], rest[0][0])
    roll = math.atan2(-rest[1][2], rest[1][1])
    # half turns about z and x are one about y the other way: the fewest turns are the clearest
    if abs(abs(yaw) - math.pi) < _SNAP and abs(abs(roll) - math.pi) < _SNAP:
        yaw, roll, pitch = 0.0, 0.0, math.pi - pitch if pitch >= 0 else -math.pi - pitch
    turns = (("z", yaw), ("y", pitch), ("x", roll))
    return tuple((axis, angle) for axis, angle in turns if abs(angle) >= _SNAP)


def yaw_pitch_roll(a: Matrix) -> Vector:
    """The angles (rad) with a = Rz(yaw) Ry(pitch) Rx(roll).

    Where they are singular, at a pitch of a quarter turn, the roll is 0.
    """
    cosine = math.hypot(a[0][0], a[1][0])
    pitch = math.atan2(-a[2][0], cosine)
    if cosine < 1e-9:
        return math.atan2(-a[0][1], a[1][1]) + 0.0, pitch + 0.0, 0.0
    yaw = math.atan2(a[1][0], a[0][0])
    return yaw + 0.0, pitch + 0.0, math.atan2(a[2][1], a[2][2]) + 0.0


def rotated_inertia(inertia: Inertia, a: Matrix) -> Inertia:
    """A I A^T: a tensor along axes that stand in the new ones as `a` says, along the new ones."""
    if a == IDENTITY:
        return inertia
    old = [[inertia[_INTO_MATRIX[i][j]] for j in range(3)] for i in range(3)]
    size = 1e-15 * max(map(abs, inertia))  # below it lies what rounding left of a zero

    def entry(i: int, j: int) -> float:
        value = sum(a[i][k] * old[k][m] * a[j][m] for k in range(3) for m in range(3))
        return value if abs(value) > size else 0.0

    return entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)


def _matrix(rows: Sequence[Sequence[float]]) -> Matrix:
    (a, b, c), (d, e, f), (g, h, i) = rows
    return (a, b, c), (d, e, f), (g, h, i)


# --- inertias -------------------------------------------------------------------------------------


def principal(inertia: Inertia) -> tuple[list[float], list[Vector]]:
    """The principal moments, the smallest first, and their axes."""
    import numpy as np

    tensor = np.array([[inertia[_INTO_MATRIX[i][j]] for j in range(3)] for i in range(3)])
    moments, axes = np.linalg.eigh(tensor)
    return moments.tolist(), [(x, y, z) for x, y, z in axes.T.tolist()]


def indefinite(inertia: Inertia) -> str:
    """In words, with one that would do, that a principal moment is negative, or ""."""
    moments, _ = principal(inertia)
    if moments[0] >= -TRIANGLE * max(map(abs, moments)):
        return ""
    return (
        f"its smallest principal moment of inertia is {moments[0]:.4g} kg m^2, and no body has "
        f"a negative one: correct it in the file, {_shown(nearest(inertia))} would do"
    )


def unbalanced(inertia: Inertia) -> str:
    """In words, with one that would do, that a moment exceeds the other two together, or ""."""
    (small, middle, large), _ = principal(inertia)
    if large <= (small + middle) * (1 + TRIANGLE):
        return ""
    return (
        f"its principal moments of inertia {small:.4g}, {middle:.4g}, {large:.4g} break the "
        f"triangle inequality, and no body has such: correct it, {_shown(nearest(inertia))} would "
        "do"
    )


def nearest(inertia: Inertia) -> Inertia:
    """The tensor that a body can have with the least sum of squares of what changes (Frobenius).

    It has the same axes. Its principal moments are I = (b + c, a + c, a + b) with the second
    moments a, b, c >= 0 of the mass along them: least squares, of which some are zero.
    """
    import numpy as np

    given, axes = principal(inertia)
    moments = np.array(given)
    sums = 1.0 - np.eye(3)
    best, least = np.zeros(3), float(moments @ moments)
    for kept in ((0, 1, 2), (0, 1), (0, 2), (1, 2), (0,), (1,), (2,)):
        second = np.linalg.lstsq(sums[:, kept], moments, rcond=None)[0]
        found = sums[:, kept] @ second
        off = float((found - moments) @ (found - moments))
        if min(second) >= 0 and off < least:
            best, least = found, off
    directions = np.array(axes)
    tensor = (directions.T * best) @ directions
    dust = 1e-12 * max(map(abs, inertia))
    a, b, c, d, e, f = (
        float(x) if abs(x := tensor[i, j]) > dust else 0.0
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    return a, b, c, d, e, f


def _shown(inertia: Inertia) -> str:
    return f"[{', '.join(f'{x:.8g}' for x in inertia)}]"


# --- what a user asks for -------------------------------------------------------------------------


def moved(body: RobotBody, values: Sequence[float]) -> tuple[Vector, Matrix]:
    """Where the body's frame stands in its parent's: offset (m) and rotation, at `values`."""
    offset, rotation = body.offset, body.rotation
    kinds = JOINTS[body.joint].motions
    for kind, axis, value in zip(kinds, motion_axes(body), values, strict=True):
        if kind == "t":
            offset = added(offset, turned(rotation, scaled(value, axis)))
        else:
            rotation = times(rotation, from_axis_angle(axis, value))
    return offset, rotation


def motion_axes(body: RobotBody) -> tuple[Vector, ...]:
    """The axis of each coordinate of the joint, in the frame that those before it have moved."""
    return JOINTS[body.joint].along(body.axes)


def free_motions(of: str = "") -> tuple[Motion, ...]:
    """The six coordinates of a free body; `of` marks them where there are several such bodies."""
    end = f"_{of}" if of else ""
    slides = (Motion(f"{name}{end}", "m") for name in "xyz")
    turns = (
        Motion(f"yaw{end}", "rad", note="about z, first"),
        Motion(f"pitch{end}", "rad", note="about y then; singular at pi/2"),
        Motion(f"roll{end}", "rad", note="about x then"),
    )
    return (*slides, *turns)


def lock(robot: Robot, values: Mapping[str, float]) -> Robot:
    """The robot with joints frozen: coordinate -> value (rad or m).

    Raises EomcError for what is not a coordinate, and for one of a joint that has several.
    """
    owners = {m.name: body for body in robot.bodies for m in body.motions}
    for name in values:
        if name not in owners:
            raise EomcError(
                f"--lock {name}: no joint that moves is called '{name}'"
                + (suggest(name, owners) or f"; there are {_listed(tuple(owners))}")
            )
        body = owners[name]
        if len(body.motions) > 1:
            those = ", ".join(m.name for m in body.motions)
            raise EomcError(
                f"--lock {name}: the {body.joint} joint of '{body.name}' moves by {those} "
                "together: only a joint with one coordinate can be frozen"
            )
    bodies = []
    for body in robot.bodies:
        if body.motions and body.motions[0].name in values:
            motion = body.motions[0]
            value = values[motion.name]
            offset, rotation = moved(body, (value,))
            body = replace(
                body, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation,
                note=_joined(body.note, f"joint {motion.name} locked at {value!r} {motion.unit}"),
            )  # fmt: skip
        bodies.append(body)
    return _without_loose_drives(replace(robot, bodies=tuple(bodies)))


def cut(robot: Robot, root: str = "", tip: str = "") -> Robot:
    """The bodies from `root` on, or those on the way from there to `tip`.

    The root is fixed to the world where it stands while all coordinates have their start values,
    so that gravity pulls as it did. What is fixed to a body on the way to the tip stays with it;
    what the tip carries does not. Raises EomcError for unknown bodies and a tip not behind the
    root.
    """
    by_name = {body.name: body for body in robot.bodies}
    for option, name in (("--root", root), ("--tip", tip)):
        if name and name not in by_name:
            raise EomcError(
                f"{option} {name}: no body is called '{name}'"
                + (suggest(name, by_name) or f"; there are {_listed(tuple(by_name))}")
            )
    kept = set(by_name)
    if root:
        kept = {root}
        for body in robot.bodies:
            if body.parent in kept:
                kept.add(body.name)
    if tip:
        if tip not in kept:
            raise EomcError(f"--tip {tip}: '{tip}' is not behind '{root}', which --root names")
        way = [tip]
        while (parent := by_name[way[-1]].parent) in kept:
            way.append(parent)
        kept = set(way)
        for body in robot.bodies:
            if body.joint == "fixed" and body.parent in kept and body.parent != tip:
                kept.add(body.name)
    bodies = []
    for body in robot.bodies:
        if body.name == root and body.parent != WORLD:
            offset, rotation = _stands(by_name, body)
            body = replace(
                body, parent=WORLD, joint="fixed", motions=(), axes=(),
                offset=offset, rotation=rotation,
            )  # fmt: skip
        if body.name in kept:
            bodies.append(body)
    gone = tuple(name for name in by_name if name not in kept)
    left_out = robot.left_out
    if gone:
        left_out = (f"cut off: {_listed(gone)}", *left_out)
    return _without_loose_drives(replace(robot, bodies=tuple(bodies), left_out=left_out))


def mended(robot: Robot) -> Robot:
    """The robot with the nearest tensor in place of each that no body can have; they are told."""
    bodies, told = [], []
    for body in robot.bodies:
        inertia = _without_dust(body)
        if indefinite(inertia) or unbalanced(inertia):
            (low, _, high), new = principal(inertia)[0], nearest(inertia)
            told.append(
                f"body {body.name}: its inertia {_shown(inertia)} is that of no body (principal "
                f"moments {low:.4g} to {high:.4g} kg m^2): {_shown(new)} is in its place"
            )
            body = replace(body, inertia=new)
        bodies.append(body)
    return replace(robot, bodies=tuple(bodies), left_out=(*robot.left_out, *told))


def based(robot: Robot, free: bool) -> Robot:
    """The robot with its first body free, or fixed to the world where it starts.

    A free one starts where it was fixed. Raises EomcError where several bodies stand on the world.
    """
    roots = [body for body in robot.bodies if body.parent == WORLD]
    if len(roots) != 1:
        those = _listed(tuple(body.name for body in roots))
        raise EomcError(f"--base: {len(roots)} bodies stand on the world ({those}), not one")
    root = roots[0]
    if free and root.joint == "fixed":
        taken = {m.name for m in robot.motions}
        motions = free_motions()
        if taken & {m.name for m in motions}:
            motions = free_motions("base")
        at = (*root.offset, *yaw_pitch_roll(root.rotation))
        motions = tuple(replace(m, start=s) for m, s in zip(motions, at, strict=True))
        new = replace(
            root, joint="free", motions=motions, axes=(), offset=ORIGIN, rotation=IDENTITY
        )  # fmt: skip
    elif not free and root.motions:
        offset, rotation = moved(root, [m.start for m in root.motions])
        new = replace(
            root, joint="fixed", motions=(), axes=(), offset=offset, rotation=rotation
        )  # fmt: skip
    else:
        new = root
    if free and new.joint != "free":
        raise EomcError(
            f"--base free: '{root.name}' stands on the world by a {root.joint} joint, "
            "which the file gives it: --base free is for a root without one"
        )
    bodies = tuple(new if body is root else body for body in robot.bodies)
    return _without_loose_drives(replace(robot, bodies=bodies))


def _stands(by_name: Mapping[str, RobotBody], body: RobotBody) -> tuple[Vector, Matrix]:
    """Where the body's frame stands in the world at the start."""
    offset, rotation = moved(body, [m.start for m in body.motions])
    while body.parent != WORLD:
        body = by_name[body.parent]
        o, r = moved(body, [m.start for m in body.motions])
        offset, rotation = added(o, turned(r, offset)), times(r, rotation)
    return offset, rotation


def _without_loose_drives(robot: Robot) -> Robot:
    there = {m.name for m in robot.motions}
    return replace(robot, drives=tuple(d for d in robot.drives if d.coordinate in there))


def _joined(*notes: str) -> str:
    return "; ".join(note for note in notes if note)


def _listed(those: Collection[str], most: int = 12) -> str:
    """Names in a line, the first of many."""
    shown = ", ".join(list(those)[:most]) or "none"
    return shown + (f" and {len(those) - most} more" if len(those) > most else "")


# --- fit for a scene ------------------------------------------------------------------------------


def finished(robot: Robot) -> Robot:
    """The robot fit for a scene: its names such as C can bear, bare frames left out and listed.

    Raises EomcError where nothing moves, where a joint moves nothing that has mass, and for a
    tensor that is not positive semi-definite. One that only breaks the triangle inequality is told.
    """
    bodies = tuple(replace(body, inertia=_without_dust(body)) for body in robot.bodies)
    robot = _without_frames(replace(robot, bodies=bodies))
    if not robot.motions:
        raise EomcError(
            f"{robot.name}: nothing moves in this robot, no joint has a coordinate; with "
            "--base free its root does"
        )
    faults = [
        f"body {b.name}: {why}, as --mend-inertias writes"
        for b in robot.bodies
        if (why := indefinite(b.inertia))
    ]
    if faults := [*faults, *_without_inertia(robot)]:
        raise EomcError("\n".join(faults))
    robot = _named(robot)  # after the faults, which have the names that --lock takes
    found = tuple(
        f"body {body.name}: {why}, as --mend-inertias writes; until then the scene is refused"
        for body in robot.bodies
        if (why := unbalanced(body.inertia))
    )
    rough = [b.name for b in robot.bodies if any(_rough(by) for _, by in turns_of(b.rotation))]
    if rough:
        found += (
            "quarter turns to five digits or so, as 1.5708, which are kept as they are ("
            f'{_listed(rough, 4)}): "pi/2" in their place makes less code',
        )
    new = tuple(words for words in found if words not in robot.left_out)
    return replace(robot, left_out=(*robot.left_out, *new))


def _rough(angle: float) -> bool:
    """Whether an angle is nearly, but not quite, a multiple of pi/2."""
    return _SNAP < abs(angle - round(angle * 2 / math.pi) * math.pi / 2) < 1e-4


def _without_dust(body: RobotBody) -> Inertia:
    """Zeros for moments that are rounding: gyrations of 0.1 micrometres, as of 1e-20 kg m^2."""
    dust = max(map(abs, body.inertia)) <= 1e-14 * body.mass
    return NO_INERTIA if dust else body.inertia


def _without_frames(robot: Robot) -> Robot:
    """Without fixed bodies that have no mass and carry nothing: they only mark places."""
    kept = list(robot.bodies)
    gone: list[str] = []
    carried: set[str] = set()
    for body in reversed(robot.bodies):  # children come before parents
        bare = not body.mass and not any(body.inertia)
        if body.joint == "fixed" and bare and body.name not in carried:
            kept.remove(body)
            gone.append(body.name)
        else:
            carried.add(body.parent)
    if not gone:
        return robot
    words = f"frames without mass that carry nothing: {_listed(gone[::-1], 1000)}"
    return replace(robot, bodies=tuple(kept), left_out=(*robot.left_out, words))


def _named(robot: Robot) -> Robot:
    """With the name of everything such as a scene can bear, and different from all others.

    A coordinate takes its velocity's name too, a body those of its centre of mass.
    """
    taken: set[str] = set()

    def fit(name: str, *ends: str) -> str:
        plain = names.plain(name)[:_NAME].rstrip("_")
        k = 1
        while True:
            new = plain if k == 1 else f"{plain}_{k}"
            mine = {new + end for end in ends}
            if not names.fault(new) and not mine & taken:
                taken.update(mine)
                return new
            k += 1

    coordinates = {m.name: fit(m.name, "", "_dot") for m in robot.motions}
    drives = tuple(
        replace(d, name=fit(d.name, ""), coordinate=coordinates[d.coordinate]) for d in robot.drives
    )
    bodies = {WORLD: WORLD}
    out = []
    for body in robot.bodies:
        name = fit(body.name, "", "_x", "_y", "_z")
        if name == WORLD:
            name = fit("world_body", "", "_x", "_y", "_z")
        bodies[body.name] = name
        motions = tuple(
            replace(m, name=new, note=_renamed(m.name, new, m.note))
            for m in body.motions
            if (new := coordinates[m.name])
        )
        note = _renamed(body.name, name, body.note)
        out.append(replace(body, name=name, parent=bodies[body.parent], motions=motions, note=note))
    name = names.plain(robot.name)[:_NAME].rstrip("_")
    if names.module_fault(name):
        name += "_robot"
    return replace(robot, name=name, bodies=tuple(out), drives=drives)


def _renamed(old: str, new: str, note: str) -> str:
    return note if old == new else _joined(f"'{old}' in the file", note)


def _without_inertia(robot: Robot) -> list[str]:
    """In words, each joint that moves nothing with mass or inertia."""
    faults: list[str] = []
    locks: list[str] = []
    carries: dict[str, list[RobotBody]] = {}
    for body in reversed(robot.bodies):  # children come before parents
        mine = [body, *carries.get(body.name, ())]
        carries[body.parent] = [*mine, *carries.get(body.parent, ())]
        kinds = JOINTS[body.joint].motions
        for kind, motion in zip(kinds, body.motions, strict=True):
            has = any(b.mass or (kind == "r" and any(b.inertia)) for b in mine)
            if has or motion.armature:
                continue
            those = _listed([b.name + (f" ({b.note})" if b.note else "") for b in mine], 4)
            lacks = "mass" if kind == "t" else "inertia"
            faults.append(f"joint {motion.name} moves nothing that has {lacks}, only {those}")
            if len(body.motions) == 1:
                locks.append(f"--lock {motion.name}=0")
    if not faults:
        return []
    freeze = f", or freeze what moves nothing: {' '.join(locks[::-1])}" if locks else ""
    return [*faults[::-1], f"add mass and inertia to the file{freeze}"]


# --- the scene's text -----------------------------------------------------------------------------


def scene_text(robot: Robot) -> str:
    """The scene of a robot as TOML, only what differs from the defaults written out.

    Numbers read back as they were, save angles within 1e-10 of a multiple of pi/12, which are
    written as such, so that their sines are exact.
    """
    robot = finished(robot)
    head = [f"# {line(robot.title)}"]
    if robot.left_out:
        head += ["#", "# Not modelled, or to be looked at:"]
        head += [each for words in robot.left_out for each in _bullet(words)]
    gravity = ", ".join(map(number, robot.gravity))
    parts = [
        "\n".join(head),
        "\n".join(
            _aligned(
                {"eomc": "1", "name": toml(robot.name), "title": toml(robot.title),
                 "gravity": f"[{gravity}]"}
            )
        ),
        "\n".join(["[coordinates]", *_aligned({m.name: _coordinate(m) for m in robot.motions})]),
    ]  # fmt: skip
    if robot.drives:
        units = {m.name: m.unit for m in robot.motions}
        parts.append(
            "\n".join(["[inputs]", *_aligned({d.name: _input(d, units) for d in robot.drives})])
        )
    parts += ["\n".join(["[[body]]", *_aligned(_entry(body, robot))]) for body in robot.bodies]
    for motion in robot.motions:
        if motion.stiffness:
            spring = {"coordinate": toml(motion.name), "stiffness": number(motion.stiffness)}
            if motion.rest:
                spring["length"] = _length(motion.rest, motion.unit)
            parts.append("\n".join(["[[spring]]", *_aligned(spring)]))
    return "\n\n".join(parts) + "\n"


def number(x: float) -> str:
    """The shortest text that reads back as x."""
    short = repr(float(x)).removesuffix(".0")
    return "0" if short == "-0" else short


def angle(x: float) -> str:
    """An angle as a scene has it: 0.3, or "pi/2" in quotes within 1e-10 of multiples of pi/12."""
    twelfths = round(x * 12 / math.pi)
    if abs(x - twelfths * math.pi / 12) > _SNAP or abs(twelfths) > 48:
        return _shortest(x)
    if not twelfths:
        return "0"
    common = math.gcd(twelfths, 12)
    above, below = abs(twelfths) // common, 12 // common
    words = ("-" if twelfths < 0 else "") + (f"{above}*pi" if above > 1 else "pi")
    return f'"{words}/{below}"' if below > 1 else f'"{words}"'


def _shortest(x: float) -> str:
    """An angle of a rotation, computed to about 4e-16: no more digits than that means."""
    for digits in range(1, 17):
        short = f"{x:.{digits}g}"
        if abs(float(short) - x) <= 4e-16:
            return number(float(short))
    return number(x)


def _length(x: float, of: str) -> str:
    return angle(x) if of == "rad" else number(x)


def _coordinate(m: Motion) -> str:
    start = f", start = {_length(m.start, m.unit)}" if m.start else ""
    note = f", note = {toml(m.note)}" if m.note else ""
    return f"{{ unit = {toml(m.unit)}{start}{note} }}"


def _input(drive: Drive, units: Mapping[str, str]) -> str:
    force = "N m" if units[drive.coordinate] == "rad" else "N"
    if drive.gear != 1:
        force = ""  # a signal, which the gear makes a force
    of = f"unit = {toml(force)}, " if force else ""
    return f"{{ {of}note = {toml(drive.note or 'along ' + drive.coordinate)} }}"


def _entry(body: RobotBody, robot: Robot) -> dict[str, str]:
    """The keys of a [[body]] that differ from their defaults."""
    entry = {"name": toml(body.name)}
    if body.parent != WORLD:
        entry["parent"] = toml(body.parent)
    entry["joint"] = toml(body.joint)
    if body.motions:
        entry["coordinates"] = _each([toml(m.name) for m in body.motions])
    if any(body.offset):
        entry["offset"] = vector(body.offset)
    if turns := turns_of(body.rotation):
        shown = (f'["{axis}", {angle(by)}]' for axis, by in turns)
        entry["rotation"] = f"[{', '.join(shown)}]"
    if body.axes and body.axes != JOINTS[body.joint].defaults:
        entry["axis"] = _each([vector(axis) for axis in body.axes])
    if body.mass:
        entry["mass"] = number(body.mass)
    if any(body.center):
        entry["center"] = vector(body.center)
    if any(body.inertia):
        kept = body.inertia if any(body.inertia[3:]) else body.inertia[:3]
        entry["inertia"] = f"[{', '.join(map(number, kept))}]"
    for key in ("armature", "damping", "friction"):
        values = [number(getattr(m, key)) for m in body.motions]
        if any(value != "0" for value in values):
            entry[key] = values[0] if len(set(values)) == 1 else _each(values)
    forces = [_force(m.name, robot.drives) for m in body.motions]
    if any(force != "0" for force in forces):
        entry["actuator"] = _each([f if f == "0" else toml(f) for f in forces])
    if body.note:
        entry["note"] = toml(body.note)
    return entry


def _force(coordinate: str, drives: Sequence[Drive]) -> str:
    mine = [d for d in drives if d.coordinate == coordinate]
    terms = [d.name if d.gear == 1 else f"{number(d.gear)}*{d.name}" for d in mine]
    return " + ".join(terms).replace("+ -", "- ") or "0"


def vector(v: Vector) -> str:
    """A vector as TOML has it."""
    return f"[{', '.join(map(number, v))}]"


def _each(those: Sequence[str]) -> str:
    return those[0] if len(those) == 1 else f"[{', '.join(those)}]"


def _aligned(entries: Mapping[str, str]) -> list[str]:
    wide = max(map(len, entries))
    return [f"{key:{wide}} = {value}" for key, value in entries.items()]


def _bullet(words: str) -> list[str]:
    return textwrap.wrap(
        line(words), 98, initial_indent="# - ", subsequent_indent="#   ",
        break_on_hyphens=False,
    )  # fmt: skip
