"""What a scene's [picture] draws: checked data. No SymPy, no C."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.scene.assembly import Turn, Vector
from eomc.scene.formulas import Formula


@dataclass(frozen=True)
class Place:
    """A point: three formulas in m, or where `at` is None the frame of the body or point `name`."""

    name: str
    at: Vector | None


@dataclass(frozen=True)
class Shape:
    """One thing that is drawn.

    kind: "dot", "path" (of one place), "line" (through places), "spring" (between two), "box",
    "circle" (about one). size: edges of a box, the radius of a circle, m. rotation: of a box or
    circle, from the axes of the world, or of the body that it is about.
    """

    kind: str
    places: tuple[Place, ...]
    size: tuple[Formula, ...] = ()
    rotation: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Picture:
    """What is drawn. axes: what the scene calls the axes, two in the plane and three in space."""

    shapes: tuple[Shape, ...]
    axes: str
