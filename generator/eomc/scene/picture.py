"""A scene's [picture] as checked data. Independent of SymPy and C."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.scene.assembly import Turn, Vector
from eomc.scene.formulas import Formula


@dataclass(frozen=True)
class PicturePlace:
    """A position in a picture.

    at: three formulas in m; if None, the position and the axes are those of the body or [[point]]
    `name`.
    """

    name: str
    at: Vector | None


@dataclass(frozen=True)
class Shape:
    """One shape of a picture.

    kind: "dot" or "path" (one place), "line" (two places or more), "spring" (two places), "box" or
    "circle" (one place, their centre). size: edges of a box or radius of a circle, m. rotation: of
    a box or circle, relative to the axes of the body at its place, or else to the world's axes.
    """

    kind: str
    places: tuple[PicturePlace, ...]
    size: tuple[Formula, ...] = ()
    rotation: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Picture:
    """The shapes that a scene draws in its table [picture].

    axes: letters of the axes, such as "xz" in the plane, and "xyz" in space.
    """

    shapes: tuple[Shape, ...]
    axes: str
