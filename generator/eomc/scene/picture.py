"""A scene's [picture] as checked data. Independent of SymPy and C."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.scene.assembly import Turn, Vector
from eomc.scene.formulas import Formula


@dataclass(frozen=True)
class PicturePlace:
    """A point: three formulas in m, or, if `at` is None, the frame of the body or point `name`."""

    name: str
    at: Vector | None


@dataclass(frozen=True)
class Shape:
    """One shape of a picture.

    kind: "dot" or "path" (of one place), "line" (through places), "spring" (between two), "box" or
    "circle" (about one). size: edges of a box or radius of a circle, m. rotation: of a box or
    circle, from the world's axes or those of its body.
    """

    kind: str
    places: tuple[PicturePlace, ...]
    size: tuple[Formula, ...] = ()
    rotation: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Picture:
    """The shapes of a picture, and the names of its axes: two in the plane, three in space."""

    shapes: tuple[Shape, ...]
    axes: str
