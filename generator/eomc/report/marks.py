"""Moving points and the marks on them, from which drawings are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
TRAVEL_LIMIT = 8.0  # times its own extent: how far a mechanism may move in one picture


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

    def point(self, at: ArrayLike) -> int:
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

    def add(self, kind: str, *points: int) -> None:
        """Add a mark (graphical symbol) that is defined by points.

        kind: kind of the mark, see `Mark`. points: indices of its points, as `point` returns them.
        Nothing is added if the mark exists already, or if it has several points that are all equal.
        """
        if len(points) > 1 and len(set(points)) == 1:
            return
        mark = Mark(kind, points)
        if mark not in self.marks:
            self.marks.append(mark)

    def path(self, name: str, point: int) -> None:
        """Add the path of a point, unless the point is fixed or has a path already.

        name: name of the path. point: index of the point, as the method `point` returns it.
        """
        moves = np.ptp(self.points[point], axis=0).max(initial=0.0) > 0
        if moves and point not in [p.point for p in self.paths]:
            self.paths.append(Path(name, point))

    def drawing(
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


def superpose(drawings: Sequence[Drawing | None], names: Sequence[str]) -> Drawing | None:
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
