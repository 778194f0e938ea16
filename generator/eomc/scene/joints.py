"""The kinds of joints: the one table of what each is.

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
    plain. others: what other tools and textbooks call it.
    """

    motions: str
    axes: tuple[Axis | int, ...]
    defaults: tuple[Axis, ...] = ()
    plane: bool = False
    order: str = ""
    others: tuple[str, ...] = ()

    @property
    def given(self) -> int:
        """How many axes the scene chooses: 0, 1 or 2."""
        return max((axis + 1 for axis in self.axes if isinstance(axis, int)), default=0)

    def along(self, given: Sequence[Axis]) -> tuple[Axis, ...]:
        """The axis of each motion, `given` being those of the scene."""
        chosen = given or self.defaults
        return tuple(chosen[a] if isinstance(a, int) else a for a in self.axes)


JOINTS = {
    "fixed": Joint("", (), plane=True, others=("weld", "rigid")),
    "revolute": Joint(
        "r", (0,), (Z,), plane=True, others=("hinge", "pin", "rotational", "continuous")
    ),
    "prismatic": Joint(
        "t", (0,), plane=True, others=("slider", "slide", "translational", "linear")
    ),
    "planar": Joint(
        "ttr", (X, Y, Z), plane=True, order="along x, along y and about z", others=("plane",)
    ),
    "cylindrical": Joint("tr", (0, 0), (Z,), order="along the axis and about it"),
    "universal": Joint("rr", (0, 1), (X, Y), order="about each axis", others=("cardan", "hooke")),
    # yaw, pitch, roll: singular at a pitch of pi/2
    "spherical": Joint("rrr", (Z, Y, X), order="about z, then y, then x", others=("ball",)),
    "free": Joint(
        "tttrrr",
        (X, Y, Z, Z, Y, X),
        order="along x, y and z, then about z, y and x",
        others=("floating",),
    ),
}

MEANT = {other: kind for kind, joint in JOINTS.items() for other in joint.others}
