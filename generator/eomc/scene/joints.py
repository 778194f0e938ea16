"""Tables of joints: the motions of each kind, and the constraints of each kind that closes a loop.

A joint is a sequence of elementary motions, each about and along an axis of the frame that the
previous ones have moved. A kind of joint made of these is one entry here. Each elementary motion is
given by its motion subspace S (Featherstone, *Rigid Body Dynamics Algorithms*, ch. 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

Axis = tuple[float, float, float]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


class MotionSubspace(NamedTuple):
    """The motion subspace S = (angular e, linear e) of an elementary motion along an axis e.

    A rate s of its coordinate turns the moving frame at the angular velocity `angular` e s, and
    moves its origin at the velocity `linear` e s.
    """

    axis: Axis
    angular: int
    linear: Any


# (angular, linear) of each elementary motion; None stands for the pitch of the joint
ELEMENTARY_MOTIONS: dict[str, tuple[int, int | None]] = {
    "r": (1, 0),  # rotation
    "t": (0, 1),  # translation
    "h": (1, None),  # screw (helical): rotation, and pitch times the angle along the axis
}


@dataclass(frozen=True)
class Joint:
    """A kind of joint, as a sequence of elementary motions with one coordinate each.

    Attributes
    ----------
    motions
        A letter for each motion, a key of ELEMENTARY_MOTIONS, in the order of the coordinates in
        the scene.
    axes
        The axis of each motion: a fixed vector, or an index (0 or 1) into the axes that the scene
        gives for the joint.
    defaults
        Axes for a scene that gives none; empty if the scene must give axes.
    plane
        True if the joint can be used in plane scenes.
    order
        Text that explains the order of the coordinates.
    aliases
        Names of the joint in other programs and textbooks.
    """

    motions: str
    axes: tuple[Axis | int, ...]
    defaults: tuple[Axis, ...] = ()
    plane: bool = False
    order: str = ""
    aliases: tuple[str, ...] = ()

    @property
    def axis_count(self) -> int:
        """Number of axes that a scene can give for the joint: 0, 1 or 2."""
        return max((axis + 1 for axis in self.axes if isinstance(axis, int)), default=0)

    @property
    def has_pitch(self) -> bool:
        """Whether a scene gives a pitch for the joint."""
        return any(ELEMENTARY_MOTIONS[motion][1] is None for motion in self.motions)

    def subspaces(self, scene_axes: Sequence[Axis], pitch: Any) -> tuple[MotionSubspace, ...]:
        """Return the motion subspace of each elementary motion of the joint.

        scene_axes: the axes that the scene gives for the joint; if empty, `defaults` is used.
        pitch: value or formula of the pitch in m/rad, for a joint that has one.
        """
        chosen = scene_axes or self.defaults
        pairs = zip(self.motions, self.axes, strict=True)
        motions = (
            (chosen[a] if isinstance(a, int) else a, *ELEMENTARY_MOTIONS[m]) for m, a in pairs
        )
        return tuple(MotionSubspace(e, w, pitch if v is None else v) for e, w, v in motions)


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
    "screw": Joint("h", (0,), (Z,), aliases=("helical", "leadscrew", "ballscrew")),
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
    """The constraint equations of a kind of joint that closes a loop between two bodies.

    plane, space: kinds of its constraint equations in plane scenes and in space; empty if the joint
    does not exist there. axes: number of axes in space; in the plane the joint has one if "u" is a
    constraint. defaults: axes for a scene that gives none. aliases: names of the joint in other
    programs and textbooks.

    Each kind of constraint equation keeps a quantity at zero or constant:

    - x, y, z: components of the vector from the first body's point to the second body's point,
      along the axes of the bodies' common ancestor.
    - u, v: components of the same vector along two directions perpendicular to the axis on the
      first body.
    - ru, rv: tilt of the axis on the second body from the axis on the first body, about u and v.
    - rx, ry, rz: rotation of the second body's frame relative to the first body's frame.
    - cross: cosine of the angle between two axes.
    - length, ratio: the only constraint equation of a distance or of a gear.
    """

    plane: tuple[str, ...] = ()
    space: tuple[str, ...] = ()
    axes: int = 0
    defaults: tuple[Axis, ...] = ()
    aliases: tuple[str, ...] = ()

    def rows(self, plane: bool) -> tuple[str, ...]:
        """Return the kinds of the joint's constraint equations, such as "x" or "ru".

        plane: True for plane scenes, False for scenes in space.
        """
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

# suffixes of a loop's reactions on its second body, in the plane (True) and in space
REACTIONS = {
    True: ("force_x", "force_y", "moment"),
    False: ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z"),
}
