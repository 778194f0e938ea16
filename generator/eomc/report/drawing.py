"""Drawings of a mechanism: moving points and the marks on them, without matplotlib.

Still figures, pages and films are all made from a `Drawing`. It contains what the scene declares:
bodies, joints, points, springs and the shapes of [picture]; without any of these, the paths of
points whose x and y the scene names. A scene that declares nothing of the kind has no drawing.

A `Timeline` has the drawing and the curves of a run, or of some instances of a batch, at its rows.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray

from eomc import pipeline
from eomc.base import spatial, texts
from eomc.base.errors import EomcError
from eomc.model.algebra import compile_function
from eomc.model.kinematics import ForwardKinematics, Pose, rotate
from eomc.model.system import System, dot
from eomc.model.system import t as time
from eomc.runtime.plot import Curve
from eomc.runtime.plot import Source as Quantities
from eomc.scene.formulas import Formula
from eomc.scene.scene import WORLD, Assembly, LoopJoint, RigidBody, Scene, Shape, SpringDamper

Array = NDArray[np.float64]
TRAVEL_LIMIT = 8.0  # times its own extent: how far a mechanism may move in one picture
PLANE_TOLERANCE = 1e-9  # relative to the size of the drawing
MAX_PATHS = 3


@dataclass(frozen=True)
class Mark:
    """One graphical symbol of a drawing, such as a line or a joint.

    points: indices, in `Drawing.points`, of the positions that define the symbol; their number
    depends on the kind. instance: index of the mechanism to which the mark belongs, if several
    instances are drawn over each other. kind: one of

    =========  ============================================================================
    line       of a [picture], through two points or more
    rod        between two points of one body
    arm        from a body's frame to its centre of mass
    rail       along the path of a sliding body
    spring     a coil between two points
    damper     a dashpot between two points
    box        a centre and the tips of its half axes: two in the plane, three in space
    inertia    a box with the mass and moments of inertia of a body
    circle     a centre and the tips of two radii
    joint      a revolute joint; spiral: one with a torsion spring
    slide      a body on a rail
    ground     a point fixed to the world
    mass       a centre of mass, and in the plane a second point that shows the rotation
    point      a [[point]]
    dot        a point of a [picture]
    =========  ============================================================================
    """

    kind: str
    points: tuple[int, ...]
    instance: int | None = None  # index, if several instances are drawn over each other


@dataclass(frozen=True)
class Path:
    """The path of a point during the motion, which is drawn as a curve.

    name: name of the point. point: its index in `Drawing.points`. instance: index of the mechanism
    to which the point belongs, if several instances are drawn over each other.
    """

    name: str
    point: int
    instance: int | None = None


@dataclass(frozen=True)
class Drawing:
    """A drawing of a mechanism at n instants.

    Attributes
    ----------
    points
        Positions (n, number of points, 2 or 3) in `unit`, to which marks and paths refer by index.
        They are not finite at instants at which a formula can't be evaluated.
    marks
        The graphical symbols, ordered from back to front in a plane drawing.
    paths
        Paths of points, drawn as curves.
    axes
        "xy", "xz" or "yz" for a drawing in the plane, "xyz" in space.
    unit
        Unit of the positions.
    names
        Names of the axes that the scene gives; empty if it gives none.
    up
        Index of the axis that points upwards, for a drawing in space.
    """

    points: Array
    marks: tuple[Mark, ...]
    paths: tuple[Path, ...]
    axes: str
    unit: str = "m"
    names: tuple[str, ...] = ()
    up: int = 2

    @property
    def is_planar(self) -> bool:
        """True if the drawing is in a plane, False if it is in space."""
        return len(self.axes) == 2

    @property
    def max_extent(self) -> float:
        """Largest extent of the mechanism along an axis at any one instant, in `unit`.

        It is 0 if the positions are finite at no instant.
        """
        with np.errstate(invalid="ignore"):
            sizes = np.ptp(self.points, axis=1).max(axis=1, initial=0.0)
        return float(sizes[np.isfinite(sizes)].max(initial=0.0))

    @property
    def travels(self) -> bool:
        """True if the mechanism moves too far for one picture of its whole motion.

        The limit is TRAVEL_LIMIT times its own largest extent.
        """
        finite = self.points[np.isfinite(self.points).all(axis=(1, 2))]
        range_ = float(np.ptp(finite, axis=(0, 1)).max(initial=0.0)) if len(finite) else 0.0
        return range_ > TRAVEL_LIMIT * self.max_extent > 0

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes: those of the scene, or letters of `axes` if it has none."""
        return self.names or tuple(self.axes)


def draw_mechanism(system: System, t: Array, q: Array) -> Drawing | None:
    """Return the drawing of a mechanism at times `t` (n,) in s and coordinates `q` (n, nq).

    Returns None if `t` is empty or if the scene of the system does not describe the shape of the
    mechanism.
    """
    result = _draw(system, t, q) if len(t) else None
    return _flatten(result) if result else None


def draw_instances(
    systems: Sequence[System], t: Array, q: Array, names: Sequence[str]
) -> Drawing | None:
    """Return one drawing of several instances of a mechanism, drawn over each other.

    systems: one system for each instance, with its parameter values. t: times (n,) in s, common to
    all. q: coordinates (batch, n, nq). names: the names of the instances. Returns None if `t` is
    empty or if the scene does not describe the shape of the mechanism.
    """
    if not len(t):
        return None
    each = [
        _draw(system, t, values_of_one) for system, values_of_one in zip(systems, q, strict=True)
    ]
    result = _superpose(each, names)
    return _flatten(result) if result else None


def _draw(system: System, t: Array, q: Array) -> Drawing | None:
    values: dict[str, Any] = {p.name: p.value for p in system.parameters}
    columns = zip(system.coordinates, q.T, strict=True)
    values |= {c.name: own for c, own in columns if c.name in system.discrete}
    declared = _draw_declared(system.scene, values, t, q) if system.scene else None
    return declared or _draw_named_points(system, t, q)


def _flatten(original: Drawing) -> Drawing:
    """Return a drawing that never leaves one of the planes x-z, y-z, x-y as a plane drawing."""
    if original.axes != "xyz":
        return original
    points = original.points[np.isfinite(original.points).all(axis=(1, 2))]
    if not len(points):
        return original
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    for normal in (1, 0, 2):  # seen from the front, from the side, from above
        if high[normal] - low[normal] <= PLANE_TOLERANCE * (high - low).max():
            in_plane = [k for k in range(3) if k != normal]
            in_plane.sort(key=lambda k: k == original.up)
            axes = "".join("xyz"[k] for k in in_plane)
            return Drawing(
                original.points[:, :, in_plane], original.marks, original.paths, axes, original.unit
            )
    return original


# --- collecting points and marks ------------------------------------------------------------------

_ORDER = ("rail", "inertia", "box", "circle", "arm", "line", "rod", "spring", "damper", "ground",
          "spiral", "joint", "slide", "point", "mass", "dot")  # fmt: skip


@dataclass
class Marks:
    """Collects the points, marks and paths of a drawing at `count` instants.

    Points with equal positions at all instants are merged.
    """

    count: int
    points: list[Array] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    _index: dict[bytes, int] = field(default_factory=dict)

    def add_point(self, at: ArrayLike) -> int:
        """Add a point and return its index.

        at: positions (count, 3) of a moving point at all instants, or (3,) of a fixed point.
        """
        path = np.ascontiguousarray(np.broadcast_to(np.asarray(at, dtype=float), (self.count, 3)))
        path = path + 0.0  # no zero has a sign
        key = blake2b(path.tobytes()).digest()
        if key not in self._index:
            self._index[key] = len(self.points)
            self.points.append(path)
        return self._index[key]

    def add_mark(self, kind: str, *points: int) -> None:
        """Add a mark (graphical symbol) that is defined by points.

        kind: kind of the mark, see `Mark`. points: indices of its points, as returned by
        `add_point`. Nothing is added if the mark exists already, or if all of its points are equal.
        """
        if len(points) > 1 and len(set(points)) == 1:
            return
        mark = Mark(kind, points)
        if mark not in self.marks:
            self.marks.append(mark)

    def add_path(self, name: str, point: int) -> None:
        """Add the path of a point, unless the point is fixed or has a path already.

        name: name of the path. point: index of the point, as returned by `add_point`.
        """
        moves = np.ptp(self.points[point], axis=0).max(initial=0.0) > 0
        if moves and point not in [p.point for p in self.paths]:
            self.paths.append(Path(name, point))

    def to_drawing(
        self, axes: str, unit: str = "m", names: tuple[str, ...] = (), up: int = 2
    ) -> Drawing | None:
        """Return the drawing of the collected points, or None if it has no marks and no paths.

        The arguments are the fields of `Drawing` with these names.
        """
        if not self.marks and not self.paths:
            return None
        ordered = sorted(self.marks, key=lambda mark: _ORDER.index(mark.kind))
        used = sorted({k for m in ordered for k in m.points} | {p.point for p in self.paths})
        place = {k: n for n, k in enumerate(used)}
        marks = tuple(Mark(m.kind, tuple(place[k] for k in m.points)) for m in ordered)
        paths = tuple(Path(p.name, place[p.point]) for p in self.paths)
        points = np.stack([self.points[k] for k in used], axis=1)
        if len(axes) == 2:
            points = points[:, :, :2]
        return Drawing(points, marks, paths, axes, unit, names, up)


def _superpose(drawings: Sequence[Drawing | None], names: Sequence[str]) -> Drawing | None:
    """Combine the drawings of several instances of a mechanism into one drawing.

    Of each drawing, only the first path is retained. names: names of the instances, which become
    the names of these paths. Returns None if all drawings are None.
    """
    points, marks, paths = list[Array](), list[Mark](), list[Path]()
    nonempty = [each for each in drawings if each]
    for instance, (each, name) in enumerate(zip(drawings, names, strict=True)):
        if each is None:
            continue
        offset = sum(some.shape[1] for some in points)
        marks += [Mark(m.kind, tuple(offset + k for k in m.points), instance) for m in each.marks]
        paths += [Path(name, offset + p.point, instance) for p in each.paths[:1]]
        points.append(each.points)
    if not nonempty:
        return None
    all_points = np.concatenate(points, axis=1)
    return replace(nonempty[0], points=all_points, marks=tuple(marks), paths=tuple(paths))


# --- what a scene declares of its shape -----------------------------------------------------------


def _draw_declared(scene: Scene, values: Mapping[str, Any], t: Array, q: Array) -> Drawing | None:
    """Draw the bodies, joints, springs and [picture] that a scene declares, at n instants.

    values: parameters by name, each a number or an array (n,). t: times (n,), s. q: coordinates
    (n, nq). Returns None if the scene declares nothing that can be drawn.
    """
    with np.errstate(all="ignore"):  # what has no value is not drawn
        return _Sketch(scene, values, t, q).drawing()


class _Sketch(ForwardKinematics):
    """The drawing of a scene at n instants, while marks are added to it."""

    def __init__(self, scene: Scene, values: Mapping[str, Any], t: Array, q: Array) -> None:
        super().__init__(scene, t, q, values)
        self.marks = Marks(self.n)

    def drawing(self) -> Drawing | None:
        """Return the drawing, or None if the scene declares nothing that can be drawn."""
        assembly, picture = self.scene.assembly, self.scene.picture
        if assembly:
            self._draw_skeleton(assembly)
        if picture:
            for shape in picture.shapes:
                self._draw_shape(shape)
        if assembly and not self.marks.paths:
            self._add_paths(assembly)
        plane = assembly.plane if assembly else bool(picture and picture.axes != "xyz")
        axes = picture.axes if picture else "xy" if plane else "xyz"
        units = {c.unit for c in self.scene.coordinates} | {p.unit for p in self.scene.parameters}
        unit = "m" if assembly or "m" in units else ""
        return self.marks.to_drawing(axes, unit, up=self._upward_axis(assembly))

    def _upward_axis(self, assembly: Assembly | None) -> int:
        """Return the index of the upward axis, opposite to gravity."""
        if assembly is None:
            return 2
        pull = np.abs([float(self.number(g)) for g in assembly.gravity])
        return int(pull.argmax()) if pull.any() else 2

    def _draw_skeleton(self, assembly: Assembly) -> None:
        for body in assembly.bodies:
            if body.joint:
                self._draw_joint(body)
        for body in assembly.bodies:
            self._draw_center_of_mass(body, assembly.plane)
        if not assembly.plane:
            self._draw_boxes(assembly)
        for loop in assembly.loops:
            if loop.bodies:
                self._draw_loop(loop)
        for kind, some in (("spring", assembly.springs), ("damper", assembly.dampers)):
            for end in some:
                self._draw_spring_or_damper(kind, end, assembly)

    def _draw_joint(self, body: RigidBody) -> None:
        """Draw the joint of a body, and a rod from the parent's frame to it."""
        marks, (seat, R) = self.marks, self.joint_frames[body.name]
        at = marks.add_point(seat)
        if body.parent != WORLD:
            marks.add_mark("rod", marks.add_point(self.poses[body.parent][0]), at)
        if body.joint in ("free", "planar"):
            return
        motions = self.joint_motions(body)
        slides = [(axis, linear * moved) for (axis, _, linear), moved in motions if linear]
        if body.parent == WORLD and not body.point and not slides:
            marks.add_mark("ground", at)
        if slides:
            axis, distance = slides[0]
            direction = np.broadcast_to(distance, self.n)
            unit = rotate(R, np.broadcast_to(np.array(axis) / np.linalg.norm(axis), (self.n, 3)))
            ends = (marks.add_point(seat + x * unit) for x in (direction.min(), direction.max()))
            marks.add_mark("rail", *ends)
            marks.add_mark("slide", marks.add_point(self.poses[body.name][0]))
        elif motions:
            marks.add_mark("joint", at)
        if body.point:
            marks.add_mark("point", marks.add_point(self.poses[body.name][0]))

    def _draw_loop(self, loop: LoopJoint) -> None:
        """Draw the joint that closes a loop, and rods from the frames of its bodies to it."""
        marks, ends = self.marks, list[Array]()
        for k, name in enumerate(loop.bodies):
            at, R = self.poses[name]
            ends.append(at + rotate(R, self.vector(loop.points[k])) if loop.points else at)
            marks.add_mark(
                "ground" if name == WORLD else "rod",
                *self._support_points(name, marks.add_point(ends[k])),
            )
        first, second = map(marks.add_point, ends)
        if loop.joint == "distance":
            marks.add_mark("rod", first, second)
        if loop.joint in ("prismatic", "cylindrical", "point-on-line"):
            unit = rotate(self.poses[loop.bodies[0]][1], np.tile(loop.axes[0], (self.n, 1)))
            direction = np.sum((ends[1] - ends[0]) * unit, axis=1)
            marks.add_mark(
                "rail",
                *(marks.add_point(ends[0] + x * unit) for x in (direction.min(), direction.max())),
            )
            marks.add_mark("slide", second)
        elif loop.joint != "weld":
            for end in (first, second) if loop.joint == "distance" else (first,):
                marks.add_mark("joint", end)

    def _draw_center_of_mass(self, body: RigidBody, plane: bool) -> None:
        """Draw the centre of mass; in the plane also the orientation of the body."""
        mass = float(self.number(body.mass))
        if mass <= 0:
            return
        marks, center, (origin, R) = self.marks, self.centers[body.name], self.poses[body.name]
        at = marks.add_point(center)
        if body.joint:
            marks.add_mark("arm", marks.add_point(origin), at)
        if plane:
            radius = np.sqrt(max(float(self.number(body.inertia[2])), 0) / mass)  # of gyration
            marks.add_mark(
                "mass", at, *([marks.add_point(center + radius * R[:, :, 0])] if radius else [])
            )
            return
        marks.add_mark("mass", at)

    def _draw_boxes(self, assembly: Assembly) -> None:
        """Draw inertia boxes of bodies in space whose rotation no line shows.

        Bodies that are fixed to one another share one box.
        """
        roots: dict[str, str] = {}
        for body in assembly.bodies:
            together = body.joint == "fixed" and body.parent != WORLD
            roots[body.name] = roots[body.parent] if together else body.name
        marks = self.marks
        lines = {m.points[0] for m in marks.marks if m.kind in ("rod", "arm")}
        for root in assembly.bodies:
            group = [b for b in assembly.bodies if roots[b.name] == root.name]
            shows_rotation = any(marks.add_point(self.poses[b.name][0]) in lines for b in group)
            if group and (root.joint in ("", "free") or not shows_rotation):
                self._draw_inertia(group, self.poses[root.name][1])

    def _draw_inertia(self, group: Sequence[RigidBody], R: Array) -> None:
        """Draw the box with the mass and inertia of bodies fixed to one another.

        `R` is the rotation of the box. With edges 2a, 2b, 2c, Ixx = m (b² + c²)/3.
        """
        masses = np.array([float(self.number(body.mass)) for body in group])
        if not masses.sum() > 0:
            return
        centers = np.stack([self.centers[body.name] for body in group])  # (bodies, n, 3)
        center = centers[0]  # exactly, where it is alone
        if len(group) > 1:
            center = np.tensordot(masses, centers, 1) / masses.sum()
        inertia_sum = np.zeros((3, 3))
        for body, m, own in zip(group, masses, centers, strict=True):
            d, turned = R[0].T @ (own[0] - center[0]), np.eye(3)
            if body is not group[0]:
                turned = R[0].T @ self.poses[body.name][1][0]
            inertia = [float(self.number(entry)) for entry in body.inertia]
            inertia_sum += turned @ spatial.tensor(inertia) @ turned.T
            inertia_sum += m * (d @ d * np.eye(3) - np.outer(d, d))
        if not np.isfinite(inertia_sum).all():
            return
        moments, axes = np.linalg.eigh(inertia_sum)
        halves = np.sqrt(np.maximum(3 * (moments.sum() / 2 - moments) / masses.sum(), 0))
        halves[halves < 1e-6 * halves.max(initial=0.0)] = 0
        if halves.any():
            tips = (R @ axes * halves).transpose(2, 0, 1)
            points = (self.marks.add_point(center + tip) for tip in tips)
            self.marks.add_mark("inertia", self.marks.add_point(center), *points)

    def _draw_spring_or_damper(self, kind: str, end: SpringDamper, assembly: Assembly) -> None:
        """Draw a spring or damper if its end points are known."""
        marks = self.marks
        if end.points and end.bodies:
            points = []
            for name, place in zip(end.bodies, end.points, strict=True):
                at, R = self.poses[name]
                points.append(marks.add_point(at + rotate(R, self.vector(place))))
                marks.add_mark(
                    "ground" if name == WORLD else "rod", *self._support_points(name, points[-1])
                )
            marks.add_mark(kind, *points)
            return
        for body in assembly.bodies:
            motions = self.joint_motions(body) if body.joint else []
            if len(motions) != 1:
                continue
            angular = motions[0][0].angular
            by = [formula.text for formula in body.coordinates]
            turns = end.turning and end.bodies and {body.name, body.parent} == {*end.bodies}
            if angular and (turns or by == [end.coordinate]) and kind == "spring":
                marks.add_mark("spiral", marks.add_point(self.joint_frames[body.name][0]))
            elif not angular and by == [end.coordinate]:
                ends = (self.joint_frames[body.name][0], self.poses[body.name][0])
                marks.add_mark(kind, *map(marks.add_point, ends))

    def _support_points(self, name: str, point: int) -> tuple[int, ...]:
        """Return the points of the mark that supports a spring's end: ground or rod."""
        return (point,) if name == WORLD else (self.marks.add_point(self.poses[name][0]), point)

    def _add_paths(self, assembly: Assembly) -> None:
        """Add the paths of the scene's [[point]]s, or of the only body without children."""
        marks = self.marks
        tips = [b.name for b in assembly.bodies if b.point]
        if tips:
            for name in tips[:MAX_PATHS]:
                marks.add_path(name, marks.add_point(self.poses[name][0]))
            return
        parents = {b.parent for b in assembly.bodies if b.joint}
        leaves = [b.name for b in assembly.bodies if b.name not in parents]
        if len(leaves) == 1:
            marks.add_path(leaves[0], marks.add_point(self.centers[leaves[0]]))

    # --- the picture of a scene ------------------------------------------------------------------

    def _draw_shape(self, shape: Shape) -> None:
        marks = self.marks
        at = [self._pose_of_place(place.name, place.at) for place in shape.places]
        points = [marks.add_point(x) for x, _ in at]
        if shape.kind == "path":
            name = shape.places[0].name
            marks.add_path(name or f"point {len(marks.paths) + 1}", points[0])
        elif shape.kind in ("dot", "line", "spring"):
            marks.add_mark(shape.kind, *points)
        else:
            center, R = at[0]
            R = R @ self.rotation(shape.rotation)
            sizes = [float(self.number(size)) for size in shape.size]
            halves = sizes * 2 if shape.kind == "circle" else [size / 2 for size in sizes]
            tips = (marks.add_point(center + h * R[:, :, k]) for k, h in enumerate(halves))
            marks.add_mark(shape.kind, points[0], *tips)

    def _pose_of_place(self, name: str, at: Sequence[Formula] | None) -> Pose:
        """Return the position of a place and the axes there."""
        return self.poses[name] if at is None else (self.vector(at), self.poses[WORLD][1])


# --- points that a scene only names ---------------------------------------------------------------


def _draw_named_points(system: System, times: Array, q: Array) -> Drawing | None:
    """Draw the paths of points whose x and y are named, such as x_p and y_p, or x1 and y1."""
    known = [c.name for c in system.coordinates] + [s.name for s, _ in system.definitions]
    paths = _positions(system, times, q, _pairs(known))
    if not paths:
        return None
    marks = Marks(len(times))
    for pair, path in paths.items():
        index = marks.add_point(np.column_stack([path, np.zeros(len(times))]))
        marks.add_mark("dot", index)
        marks.add_path("(" + ", ".join(pair) + ")", index)
    x, y = next(iter(paths))
    units = {c.unit for c in system.coordinates} | {p.unit for p in system.parameters}
    names = (x, y) if len(paths) == 1 else ("x", "y")
    return marks.to_drawing("xy", "m" if "m" in units else "", names)


def _pairs(known: Sequence[str]) -> list[tuple[str, str]]:
    """Return pairs of names such as (x_p, y_p), (x1, y1), (tip_x, tip_y) without a matching z."""
    pairs = []
    for name in known:
        if match := re.fullmatch(r"(|.*_)x(|_.*|\d+)", name):
            before, after = match.groups()
            if f"{before}y{after}" in known and f"{before}z{after}" not in known:
                pairs.append((name, f"{before}y{after}"))
    return pairs


def _positions(
    system: System, times: Array, q: Array, pairs: Sequence[tuple[str, str]]
) -> dict[tuple[str, str], Array]:
    """Return the paths (n, 2) of those pairs that are functions of q and t only and depend on q."""
    if not pairs:
        return {}
    body = _bodies(system)
    expression = {s.name: body[s] for s in (*system.q, *(s for s, _ in system.definitions))}
    coordinates = set(system.q)
    chosen = []
    for pair in pairs:
        used = expression[pair[0]].free_symbols | expression[pair[1]].free_symbols
        rates = expression[pair[0]].has(dot) or expression[pair[1]].has(dot)
        if not rates and used & coordinates and used <= coordinates | {time}:
            chosen.append(pair)
    flat = [expression[name] for pair in chosen for name in pair]
    values = compile_function((time, *system.q), flat, "numpy")(times, *q.T)
    columns = [np.broadcast_to(v, times.shape).astype(float) for v in values]
    return {pair: np.column_stack(columns[2 * k : 2 * k + 2]) for k, pair in enumerate(chosen)}


def _bodies(system: System) -> dict[sympy.Symbol, sympy.Expr]:
    """Return each name's expression in t, q and q̇, at the values of the parameters."""
    body: dict[sympy.Symbol, sympy.Expr] = {s: s for s in system.q}
    body |= {p.symbol: sympy.Float(p.value) for p in system.parameters}
    for s, expr in system.definitions:
        body[s] = expr.xreplace(body)
    return body


Rows = NDArray[np.int64]
Source = str | os.PathLike[str] | System  # a scene file or a system

MAX_CURVES_PER_PANEL = 4  # at most, where each curve has its own panel
MAX_PANELS = 6
MAX_INSTANCES = 24  # that can be told apart in one drawing
MAX_KEY_PARAMETERS = 2  # that differ between the instances, in the key


class Panel(NamedTuple):
    """A panel of an animation: curves with the same unit that share one pair of axes.

    The values of the curves belong to the stored times that the animation shows. name: name of the
    quantity, if all curves show one quantity for different instances (runs of a batch); else "".
    """

    curves: tuple[Curve, ...]
    name: str = ""


class Timeline:
    """The data of one run for an animation: the drawing of the mechanism and curves against time.

    t: times (n,) in s of the stored states of the run.
    """

    key: tuple[str, ...] = ()  # a label for each instance of a batch

    def __init__(self, system: Any, run: Any) -> None:
        self.system, self.run = system, run
        self.t = np.asarray(run.t, dtype=float)
        self.title: str = system.title or system.name

    @property
    def has_stairs(self) -> bool:
        """True if the inputs are held constant from one row to the next (zero-order hold)."""
        return getattr(getattr(self.run, "request", None), "u", None) is not None

    @property
    def curves(self) -> int:
        """Approximate number of curves in all panels."""
        return 2 * len(self.system.q) + 1

    def resample(self, count: int) -> bool:
        """Replace the stored states of an adaptive run by `count` interpolated ones.

        The new states are equidistant in time. Returns True if they were replaced; returns False
        and changes nothing if the run has fixed steps or no duration, or is a batch.
        """
        run = self.run
        request = getattr(run, "request", None)
        if (
            request is None
            or request.has_equal_steps
            or np.ndim(run.q) > 2
            or not (len(run) > 1 and run.t[-1] > run.t[0])
        ):
            return False
        self.run = run.resample(count)
        self.t = np.asarray(self.run.t, dtype=float)
        return True

    def drawing(self, rows: Rows) -> Drawing | None:
        """Return the drawing at the stored times with the indices `rows`.

        Returns None if the scene does not describe the shape of the mechanism.
        """
        return draw_mechanism(self.system, self.t[rows], np.asarray(self.run.q, dtype=float)[rows])

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """Yield the panels with curves of coordinates, outputs and inputs, and one of the energy.

        rows: indices of the stored times that the curves show. If there are few curves, each has a
        panel of its own; otherwise all curves with the same unit share a panel. The panel of the
        energy is the last one.
        """
        system, run = self.system, self.run

        def curves(kind: str, quantities: Sequence[Any], columns: Any) -> list[Curve]:
            pairs = zip(quantities, columns, strict=True)
            return [Curve(x.name, np.asarray(v, float)[rows], x.unit, kind) for x, v in pairs]

        lines = curves("coordinates", system.coordinates, np.transpose(run.q))
        lines += curves("outputs", system.outputs, [run.outputs[o.name] for o in system.outputs])
        lines += curves("inputs", system.inputs, np.transpose(run.u) if system.inputs else ())
        separate = len(lines) <= MAX_PANELS - 1 and len(lines) <= MAX_CURVES_PER_PANEL
        for unit in dict.fromkeys(line.unit for line in lines):
            group = tuple(line for line in lines if line.unit == unit)
            yield from ([Panel((line,)) for line in group] if separate else [Panel(group)])
        known = "J" if any(c.unit for c in system.coordinates) else ""
        yield Panel((Curve("energy", np.asarray(run.energy, dtype=float)[rows], known, "energy"),))


class BatchTimeline(Timeline):
    """The data of several instances of a batch for an animation that shows them superimposed.

    An instance is one run of the batch. names: quantities to plot, by default coordinates and the
    energy. chosen: number of instances to show, or the list of their indices.
    """

    def __init__(self, system: System, batch: Any, names: Sequence[str], chosen: Any) -> None:
        numbers = choose_instances(len(batch), chosen)
        super().__init__(system, batch.select(numbers))
        self.names = tuple(names) or self._default()
        table = np.broadcast_to(self.run.request.p, (len(numbers), len(system.parameters)))
        self.systems = [
            system.with_parameters(
                dict(zip(batch.model.info.parameters, map(float, row), strict=True))
            )
            for row in table
        ]
        self.key = tuple(
            _instance_label(k, table, n, self.run, system) for n, k in enumerate(numbers)
        )
        self.numbers = [str(k) for k in numbers]
        self.q = _hold_last_finite(np.asarray(self.run.q, dtype=float))

    def _default(self) -> tuple[str, ...]:
        coordinates: tuple[str, ...] = self.run.model.info.coordinates
        return (
            (*coordinates, "energy") if len(coordinates) < MAX_PANELS else coordinates[:MAX_PANELS]
        )

    @property
    def curves(self) -> int:
        """Number of curves in all panels: one for each quantity and instance."""
        return len(self.names) * len(self.numbers)

    def drawing(self, rows: Rows) -> Drawing | None:
        """Return the drawing of all chosen instances at the stored times with the indices `rows`.

        An instance whose run has ended keeps its last position.
        """
        return draw_instances(self.systems, self.t[rows], self.q[:, rows], self.numbers)

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """Yield one panel for each quantity in `names`, with a curve for each instance.

        rows: indices of the stored times that the curves show.
        """
        source = Quantities(self.run)
        for curve in map(source.curve, self.names):
            pairs = zip(self.numbers, curve.values, strict=True)
            lines = tuple(replace(curve, name=n, values=x[rows]) for n, x in pairs)
            yield Panel(lines, curve.name)


def find_system(run: Any, scene: Source | None = None) -> System:
    """Return the system that a run simulated, with the parameter values of the run.

    Parameters
    ----------
    run : Run or batch of runs
        For a batch, the parameter values are those of the first instance.
    scene : path or System, optional
        The scene or system that the module was built from. Needed only if the module was not
        loaded with `eomc.load`.

    Returns
    -------
    System

    Raises
    ------
    EomcError
        If the scene is unknown, or is not the one that the module was built from.
    """
    model = run.model
    source = model.source if scene is None else scene
    if source is None:
        raise EomcError(
            f"{model.info.name}: was imported without its scene, which says what is drawn: load it "
            "with eomc.load, or give scene=PATH"
        )
    system = source if isinstance(source, System) else pipeline.read(source)
    if system.digest != model.info.digest:
        where = texts.line(system.file) or system.name
        raise EomcError(
            f"{where}: is not the scene that {model.info.name} was built from, or has changed "
            "since: load it again with eomc.load"
        )
    values = np.atleast_2d(run.request.p)[0]
    return system.with_parameters(dict(zip(model.info.parameters, map(float, values), strict=True)))


def choose_instances(count: int, chosen: int | Sequence[int]) -> list[int]:
    """Return the indices of the instances to show, for a batch of `count` instances.

    chosen: how many to show, spread evenly over the batch, or the list of their indices. Raises
    EomcError if an index does not exist or if there are more than MAX_INSTANCES.
    """
    requested: Any = chosen
    if isinstance(chosen, (int, np.integer)) and not isinstance(chosen, bool) and chosen > 0:
        requested = np.linspace(0, count - 1, min(chosen, count)).astype(int)
    try:
        array = np.asarray(requested)
        numbers = [*dict.fromkeys(array.tolist())]
        valid = array.ndim == 1 and array.dtype.kind in "iu" and 0 <= array.min() <= array.max()
    except (TypeError, ValueError):
        valid, numbers = False, []
    if not valid or max(numbers) >= count:
        raise EomcError(
            f"instances: give how many, or a list of some from 0 to {count - 1}, here {chosen!r}"
        )
    if len(numbers) > MAX_INSTANCES:
        raise EomcError(
            f"instances: at most {MAX_INSTANCES} can be told apart, here {len(numbers)}"
        )
    return numbers


def _hold_last_finite(q: Array) -> Array:
    """Return q (batch, n, nq) with rows that are not finite replaced by the last finite row."""
    good = np.isfinite(q).all(axis=2)
    last = np.maximum.accumulate(np.where(good, np.arange(q.shape[1]), 0), axis=1)
    return np.take_along_axis(q, last[:, :, None], axis=1)


def _instance_label(k: int, table: Array, row: int, run: Any, system: System) -> str:
    """Return the number of an instance, the parameters that differ, and its status if not "ok"."""
    varying = np.flatnonzero(np.ptp(table, axis=0) > 0)
    units: Mapping[str, str] = run.model.info.units
    names = [p.name for p in system.parameters]
    labels = [
        f"{names[j]} = {table[row, j]:.4g} {units.get(names[j], '')}".rstrip()
        for j in varying[:MAX_KEY_PARAMETERS]
        if len(varying) <= MAX_KEY_PARAMETERS
    ]
    ended = str(run.status[row])
    words = ", ".join([*labels, *([] if ended == "ok" else [ended])])
    return f"{k}: {words}" if words else str(k)
