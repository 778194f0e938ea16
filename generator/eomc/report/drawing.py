"""Drawings of a mechanism: moving points and the marks on them, without matplotlib.

Still figures, pages and films are all made from a `Drawing`. It contains what the scene declares:
bodies, joints, points, springs and the shapes of [picture]; without any of these, the paths of
points whose x and y the scene names. A scene that declares nothing of the kind has no drawing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray

from eomc.base import spatial
from eomc.model.algebra import compile_function
from eomc.model.kinematics import ForwardKinematics, Pose, rotate
from eomc.model.system import System, dot
from eomc.model.system import t as time
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
