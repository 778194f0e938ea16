"""The kinds of joints: the tables of what moves each, and of what closes each in a loop.

A joint is a row of elementary motions, turns and slides, each along or about an axis of the frame
that those before it have moved. A new kind made of these is one more entry here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Axis = tuple[float, float, float]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Joint:
    """A kind of joint.

    motions: one "r" (turns) or "t" (slides) for each coordinate, in the scene's order.
    axes: of each motion its axis, or which of the axes that the scene gives it takes (0, 1).
    defaults: the axes of a scene that gives none; empty where it has to give them, or has none.
    plane: whether a plane scene may have it. order: what its coordinates are, where that is not
    plain. aliases: what other tools and textbooks call it.
    """

    motions: str
    axes: tuple[Axis | int, ...]
    defaults: tuple[Axis, ...] = ()
    plane: bool = False
    order: str = ""
    aliases: tuple[str, ...] = ()

    @property
    def axis_count(self) -> int:
        """How many axes the scene chooses: 0, 1 or 2."""
        return max((axis + 1 for axis in self.axes if isinstance(axis, int)), default=0)

    def motion_axes(self, scene_axes: Sequence[Axis]) -> tuple[Axis, ...]:
        """The axis of each motion, `scene_axes` being those of the scene."""
        chosen = scene_axes or self.defaults
        return tuple(chosen[a] if isinstance(a, int) else a for a in self.axes)


JOINTS = {
    "fixed": Joint("", (), plane=True, aliases=("weld", "rigid")),
    "revolute": Joint(
        "r", (0,), (Z,), plane=True, aliases=("hinge", "pin", "rotational", "continuous")
    ),
    "prismatic": Joint(
        "t", (0,), plane=True, aliases=("slider", "slide", "translational", "linear")
    ),
    "planar": Joint(
        "ttr", (X, Y, Z), plane=True, order="along x, along y and about z", aliases=("plane",)
    ),
    "cylindrical": Joint("tr", (0, 0), (Z,), order="along the axis and about it"),
    "universal": Joint("rr", (0, 1), (X, Y), order="about each axis", aliases=("cardan", "hooke")),
    # yaw, pitch, roll: singular at a pitch of pi/2
    "spherical": Joint("rrr", (Z, Y, X), order="about z, then y, then x", aliases=("ball",)),
    "free": Joint(
        "tttrrr",
        (X, Y, Z, Z, Y, X),
        order="along x, y and z, then about z, y and x",
        aliases=("floating",),
    ),
}


@dataclass(frozen=True)
class Closing:
    """What a joint between two bodies of a tree, which closes a loop, keeps at zero.

    plane, space: its rows, empty where there is no such joint. x, y, z: from the first body's point
    to the second's, along the axes of what both hang from; u, v: along two directions across the
    first axis; ru, rv: the second axis out of the first, about u and v; rx, ry, rz: the second
    frame out of the first; cross: the cosine between two axes; all others are the whole of it.
    axes: how many it has in space; in the plane one, where u is a row. defaults: those of a scene
    that gives none.
    """

    plane: tuple[str, ...] = ()
    space: tuple[str, ...] = ()
    axes: int = 0
    defaults: tuple[Axis, ...] = ()
    aliases: tuple[str, ...] = ()

    def rows(self, plane: bool) -> tuple[str, ...]:
        """Those in the plane or in space."""
        return self.plane if plane else self.space


CLOSINGS = {
    "revolute": Closing(
        ("x", "y"), ("x", "y", "z", "ru", "rv"), 1, (Z, Z), ("hinge", "pin", "rotational")
    ),
    "spherical": Closing((), ("x", "y", "z"), aliases=("ball", "connect", "point", "coincident")),
    "weld": Closing(
        ("x", "y", "rz"), ("x", "y", "z", "rx", "ry", "rz"), aliases=("fixed", "rigid")
    ),
    "prismatic": Closing(
        ("u", "rz"), ("u", "v", "rx", "ry", "rz"), 1, (), ("slider", "slide", "translational")
    ),
    "cylindrical": Closing((), ("u", "v", "ru", "rv"), 1, (Z, Z)),
    "universal": Closing((), ("x", "y", "z", "cross"), 2, (X, Y), ("cardan", "hooke")),
    "point-on-line": Closing(
        ("u",), ("u", "v"), 1, (), ("point_on_line", "line", "slot", "pin-in-slot")
    ),
    "distance": Closing(("length",), ("length",), aliases=("rod", "rope", "link")),
    "gear": Closing(("ratio",), ("ratio",), aliases=("gears", "belt", "mimic", "coupling")),
}

# what a loop between bodies does to the second: names behind its own, in the plane and in space
REACTIONS = {
    True: ("force_x", "force_y", "moment"),
    False: ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z"),
}

CLOSING_ALIASES = {other: kind for kind, joint in CLOSINGS.items() for other in joint.aliases}

JOINT_ALIASES = {other: kind for kind, joint in JOINTS.items() for other in joint.aliases}
