"""Points that move, and marks on them: what every drawing is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
FAR = 8.0  # times its own extent


@dataclass(frozen=True)
class Mark:
    """One thing drawn on some of a drawing's points.

    kind: what it is, and how many points it has.

    =========  ============================================================================
    line       of a [picture], through two points or more
    rod        two points of one body
    arm        from a body's frame to its centre of mass
    rail       what a slide travels along
    spring     a coil between two points
    damper     a dashpot between two points
    box        a centre and the tips of its half axes: two in the plane, three in space
    inertia    a box of the same mass and moments of inertia as a body
    circle     a centre and the tips of two radii
    joint      where a body turns; spiral: with a spring that turns
    slide      a body on a rail
    ground     what is fixed to the world
    mass       a centre of mass, and in the plane another point to show how it is turned
    point      a [[point]]
    dot        a point of a [picture]
    =========  ============================================================================
    """

    kind: str
    points: tuple[int, ...]
    whose: int | None = None  # of which instance, where several are drawn over each other


@dataclass(frozen=True)
class Path:
    """The path of a point that has a name."""

    name: str
    point: int
    whose: int | None = None


@dataclass(frozen=True)
class Drawing:
    """What is drawn at n instants.

    points: (n, points, 2 or 3), in `unit`; not finite where a formula has no value. marks: from the
    back to the front in the plane. axes: "xy", "xz", "yz" in the plane, "xyz" in space, seen with
    axis `up` upwards. names: of the axes, where a scene has names for them.
    """

    points: Array
    marks: tuple[Mark, ...]
    paths: tuple[Path, ...]
    axes: str
    unit: str = "m"
    names: tuple[str, ...] = ()
    up: int = 2

    @property
    def plane(self) -> bool:
        """Whether it lies in a plane."""
        return len(self.axes) == 2

    @property
    def extent(self) -> float:
        """The largest extent that all its points have at an instant; 0 where none is known."""
        with np.errstate(invalid="ignore"):
            sizes = np.ptp(self.points, axis=1).max(axis=1, initial=0.0)
        return float(sizes[np.isfinite(sizes)].max(initial=0.0))

    @property
    def travels(self) -> bool:
        """Whether it goes so far that it would be a dot in a picture of all of it."""
        still = self.points[np.isfinite(self.points).all(axis=(1, 2))]
        whole = float(np.ptp(still, axis=(0, 1)).max(initial=0.0)) if len(still) else 0.0
        return whole > FAR * self.extent > 0

    @property
    def labels(self) -> tuple[str, ...]:
        """What the axes are called."""
        return self.names or tuple(self.axes)


_ORDER = ("rail", "inertia", "box", "circle", "arm", "line", "rod", "spring", "damper", "ground",
          "spiral", "joint", "slide", "point", "mass", "dot")  # fmt: skip


@dataclass
class Marks:
    """Collects points and marks of a drawing at `count` instants; equal points are one."""

    count: int
    points: list[Array] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    _index: dict[bytes, int] = field(default_factory=dict)

    def point(self, at: ArrayLike) -> int:
        """The index of a point that moves, (n, 3), or stands, (3,)."""
        path = np.ascontiguousarray(np.broadcast_to(np.asarray(at, dtype=float), (self.count, 3)))
        path = path + 0.0  # no zero has a sign
        key = blake2b(path.tobytes()).digest()
        if key not in self._index:
            self._index[key] = len(self.points)
            self.points.append(path)
        return self._index[key]

    def add(self, kind: str, *points: int) -> None:
        """A mark, unless it is there already or would have no length."""
        if len(points) > 1 and len(set(points)) == 1:
            return
        mark = Mark(kind, points)
        if mark not in self.marks:
            self.marks.append(mark)

    def path(self, name: str, point: int) -> None:
        """The path of a point, where it moves."""
        moves = np.ptp(self.points[point], axis=0).max(initial=0.0) > 0
        if moves and point not in [p.point for p in self.paths]:
            self.paths.append(Path(name, point))

    def drawing(
        self, axes: str, unit: str = "m", names: tuple[str, ...] = (), up: int = 2
    ) -> Drawing | None:
        """The whole; None where there is nothing in it."""
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


def together(drawings: Sequence[Drawing | None], names: Sequence[str]) -> Drawing | None:
    """Instances of one scene over each other, with a path of each under its name.

    None where nothing is drawn of any.
    """
    points, marks, paths = list[Array](), list[Mark](), list[Path]()
    made = [each for each in drawings if each]
    for whose, (each, name) in enumerate(zip(drawings, names, strict=True)):
        if each is None:
            continue
        at = sum(some.shape[1] for some in points)
        marks += [Mark(m.kind, tuple(at + k for k in m.points), whose) for m in each.marks]
        paths += [Path(name, at + p.point, whose) for p in each.paths[:1]]
        points.append(each.points)
    if not made:
        return None
    whole = np.concatenate(points, axis=1)
    return replace(made[0], points=whole, marks=tuple(marks), paths=tuple(paths))
