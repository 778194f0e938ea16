"""Bodies, springs and forces of scenes against mechanics written out anew.

test_newton_euler.py compares the routes with the energies that multibody.py writes. Here these, and
the forces, are compared with what shares nothing with the generator: a body is a handful of point
masses, its place a product of SciPy's rotations, its velocity a difference in time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import trees
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.scene.read import parse
from eomc.verify.taylor import TaylorReference

Array = NDArray[np.float64]
Pose = tuple[Array, Rotation]  # of a frame in the world: place and turn

# of the sizes added up: differences over STEP err by STEP^4 x'''''/30, some 1e-11 at these rates,
# and round by 1e-13; a wrong sign is off by 1
CLOSE = 1e-8
STEP = 1e-3  # s

X, Y, Z = np.eye(3)
GRAVITY = np.array([1.5, -2.0, -9.81])
OFFSET, TURNS = [0.3, -0.4, 0.2], [["y", 0.4], ["z", -0.7], ["x", 1.1]]

# four points each, without any symmetry: mass, x, y, z in the body's frame
POINTS = (
    np.array([[0.5, 0.3, 0.1, -0.2], [0.7, -0.1, 0.4, 0.2], [0.4, 0.2, -0.3, 0.5],
              [0.3, 0.5, 0.2, 0.3]]),
    np.array([[0.3, -0.2, 0.3, 0.1], [0.6, 0.4, 0.1, -0.3], [0.5, 0.1, 0.5, 0.4],
              [0.2, 0.3, -0.4, 0.2]]),
)  # fmt: skip


def given(points: Array, plane: bool) -> dict[str, Any]:
    """Mass, centre and inertia of points, as a [[body]] has them."""
    m, at = points[:, 0], points[:, 1:]
    center = m @ at / m.sum()
    x, y, z = (at - center).T
    tensor = [m @ (y * y + z * z), m @ (x * x + z * z), m @ (x * x + y * y),
              -m @ (x * y), -m @ (x * z), -m @ (y * z)]  # fmt: skip
    return {
        "mass": m.sum(),
        "center": center[: 2 if plane else 3].tolist(),
        "inertia": tensor[2] if plane else tensor,
    }


def about(axis: Any, angle: float) -> Rotation:
    return Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)


def along(axis: Any, way: float) -> Array:
    return np.array(axis) / np.linalg.norm(axis) * way


STILL = Rotation.identity()

# what docs/scenes.md says of each joint: where its coordinates take its frame
JOINTS: Mapping[str, tuple[int, Callable[[Array, Any], Pose]]] = {
    "fixed": (0, lambda q, a: (np.zeros(3), STILL)),
    "revolute": (1, lambda q, a: (np.zeros(3), about(a, q[0]))),
    "prismatic": (1, lambda q, a: (along(a, q[0]), STILL)),
    "planar": (3, lambda q, a: (q[0] * X + q[1] * Y, about(Z, q[2]))),
    "cylindrical": (2, lambda q, a: (along(a, q[0]), about(a, q[1]))),
    "universal": (2, lambda q, a: (np.zeros(3), about(a[0], q[0]) * about(a[1], q[1]))),
    "spherical": (3, lambda q, a: (np.zeros(3), Rotation.from_euler("ZYX", q))),
    "free": (6, lambda q, a: (q[:3], Rotation.from_euler("ZYX", q[3:]))),
}
SPACE = [
    ("fixed", None), ("revolute", None), ("revolute", [1, 2, -2]), ("revolute", [-1, 0, 0]),
    ("revolute", [0, 0, -2]), ("prismatic", [1, 2, -2]), ("prismatic", [0, -1, 0]),
    ("planar", None), ("cylindrical", None), ("cylindrical", [2, -1, 2]), ("universal", None),
    ("universal", [[0, 0, 1], [0.6, 0, 0.8]]), ("spherical", None), ("free", None),
]  # fmt: skip
PLANE = [("fixed", None), ("revolute", None), ("prismatic", [-0.6, 0.8]), ("planar", None)]
DEFAULT = {"universal": (X, Y)}  # of axes that are not written; else z


def then(one: Pose, other: Pose) -> Pose:
    """The frame `other`, given in `one`, where `one` is given."""
    return one[0] + one[1].apply(other[0]), one[1] * other[1]


class Arm:
    """Two bodies: one on the world by a turning joint, on it one by the joint in question."""

    def __init__(self, joint: str, axis: Any, plane: bool, **more: Any) -> None:
        self.joint, self.plane, self.wide = joint, plane, 2 if plane else 3
        self.number, self.moves = JOINTS[joint]
        self.points = [p * [1, 1, 1, 0] if plane else p for p in POINTS]
        self.axis = DEFAULT.get(joint, Z) if axis is None else axis
        if plane and axis is not None:
            self.axis = [*axis, 0]
        self.first = Z if plane else np.array([2, -1, 2])
        turn = 0.4 if plane else TURNS
        place = {"offset": OFFSET[: self.wide], "rotation": turn}
        base = {"name": "base", "joint": "revolute", "coordinates": "a", **place,
                **given(self.points[0], plane)}  # fmt: skip
        if not plane:
            base["axis"] = self.first.tolist()
        names = [f"q{k}" for k in range(self.number)]
        tool = {"name": "tool", "parent": "base", "joint": joint, "coordinates": names, **place,
                **given(self.points[1], plane), **more.pop("keys", {})}  # fmt: skip
        if axis is not None:
            tool["axis"] = axis
        gravity = GRAVITY[: self.wide].tolist()
        text = trees.text([base, tool], gravity, {"k": 30.0, "c": 0.7}, more.pop("tables", ()))
        self.made = from_scene(parse(text, "arm.toml"))

    def poses(self, q: Array) -> list[Pose]:
        """Of the frames of both bodies."""
        letters, angles = zip(*TURNS, strict=True)
        turn = (
            about(Z, 0.4) if self.plane else Rotation.from_euler("".join(letters).upper(), angles)
        )
        fixed = np.array([*OFFSET[: self.wide], 0][:3]), turn
        base = then(fixed, (np.zeros(3), about(self.first, q[0])))
        return [base, then(base, then(fixed, self.moves(q[1:], self.axis)))]

    def places(self, q: Array) -> Array:
        """Of all points in the world."""
        found = zip(self.poses(q), self.points, strict=True)
        return np.vstack([at + turn.apply(p[:, 1:]) for (at, turn), p in found])

    def energies(self, q: Array, qd: Array) -> tuple[float, float]:
        """K and P of the points."""
        masses = np.concatenate([p[:, 0] for p in self.points])
        gravity = GRAVITY * [1, 1, 0] if self.plane else GRAVITY
        velocity = rate(lambda s: self.places(q + s * qd))
        return masses @ (velocity**2).sum(axis=1) / 2, -masses @ self.places(q) @ gravity


def rate(of: Callable[[float], Any]) -> Any:
    """d/ds at s = 0, by central differences of order four."""
    h = STEP
    return (8 * (of(h) - of(-h)) - (of(2 * h) - of(-2 * h))) / (12 * h)


def gradient(of: Callable[[Array], float], q: Array) -> Array:
    return np.array([rate(lambda s, e=e: of(q + s * e)) for e in np.eye(len(q))])


def ask(made: System, name: str, q: Array, qd: Array, u: Any = ()) -> Array:
    params = {p.name: p.value for p in made.parameters}
    return np.asarray(
        TaylorReference(made).evaluate(name, q, qd, 0.0, np.array(u, dtype=float), params)
    )


def states(number: int, seed: int = 3) -> list[tuple[Array, Array]]:
    random = np.random.default_rng(seed)
    return [(random.uniform(-1, 1, number), random.uniform(-2, 2, number)) for _ in range(2)]


def near(found: Any, right: Any, size: float = 1.0) -> None:
    scale = size + np.max(np.abs(right), initial=0.0)
    np.testing.assert_allclose(found, right, rtol=0, atol=CLOSE * scale)


@pytest.mark.parametrize(
    ("joint", "axis", "plane"),
    [*((*joint, False) for joint in SPACE), *((*joint, True) for joint in PLANE)],
    ids=str,
)
def test_the_energies_of_a_joint_are_those_of_point_masses(
    joint: str, axis: Any, plane: bool
) -> None:
    arm = Arm(joint, axis, plane)
    for q, qd in states(1 + arm.number):
        kinetic, potential = arm.energies(q, qd)
        near(ask(arm.made, "kinetic", q, qd), kinetic)
        near(ask(arm.made, "potential", q, qd), potential)


@pytest.mark.parametrize(
    ("joint", "plane"),
    [("revolute", False), ("cylindrical", False), ("free", False), ("prismatic", True)],
)
def test_what_acts_along_a_joint_has_its_sign(joint: str, plane: bool) -> None:
    """Damping and friction against the rate, drives along the coordinate."""
    axis = [1, 0] if joint == "prismatic" else None
    n = JOINTS[joint][0]
    each = np.arange(1, n + 1) / 10
    drives = [f"{k + 2}*u" for k in range(n)]
    keys = {"damping": each.tolist(), "friction": (2 * each).tolist(), "friction_width": 0.5,
            "armature": (3 * each).tolist(), "actuator": drives}  # fmt: skip
    tables = [("[inputs]", {"u": {"signal": 0}})]
    arm = Arm(joint, axis, plane, keys=keys, tables=tables)
    for q, qd in states(1 + n):
        rates = qd[1:]
        force = -each * rates - 2 * each * np.tanh(rates / 0.5) + 0.7 * np.arange(2, n + 2)
        near(ask(arm.made, "tau", q, qd, [0.7]), [0, *force])
        kinetic = arm.energies(q, qd)[0] + 3 * each @ rates**2 / 2
        near(ask(arm.made, "kinetic", q, qd, [0.7]), kinetic)


@pytest.mark.parametrize("rest", [0.0, 0.6])
@pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
def test_springs_and_dampers_between_points(plane: bool, rest: float) -> None:
    """P = k (L - rest)^2/2; a damper pulls along the line by c dL/dt."""
    wide = 2 if plane else 3
    one, other = np.array([0.7, -0.3, 0.4]), np.array([-0.5, 0.9, -0.2])
    ends = {"bodies": ["world", "tool"], "points": [one[:wide].tolist(), other[:wide].tolist()]}
    tables = [("[[spring]]", {**ends, "stiffness": "k", "length": rest}),
              ("[[damper]]", {**ends, "damping": "c"})]  # fmt: skip
    arm = Arm("revolute", None, plane, tables=tables)
    if plane:
        one[2] = other[2] = 0

    def length(q: Array) -> float:
        at, turn = arm.poses(q)[1]
        return float(np.linalg.norm(at + turn.apply(other) - one))

    for q, qd in states(2):
        near(
            ask(arm.made, "potential", q, qd),
            arm.energies(q, qd)[1] + 30 * (length(q) - rest) ** 2 / 2,
        )
        faster = rate(lambda s, q=q, qd=qd: length(q + s * qd))
        near(ask(arm.made, "tau", q, qd), -0.7 * faster * gradient(length, q))


def test_springs_and_dampers_of_angles() -> None:
    """Along a coordinate, and between the angles of bodies; the length is the angle of rest."""
    pair = {"bodies": ["world", "tool"], "turning": True}
    tables = [("[[spring]]", {**pair, "stiffness": "k", "length": 0.3}),
              ("[[damper]]", {**pair, "damping": "c"}),
              ("[[spring]]", {"coordinate": "q0", "stiffness": 5, "length": -0.2}),
              ("[[damper]]", {"coordinate": "q0", "damping": 0.4})]  # fmt: skip
    arm = Arm("revolute", None, True, tables=tables)
    for q, qd in states(2):
        whole = q.sum() + 2 * 0.4  # both joints stand turned by 0.4
        springs = 30 * (whole - 0.3) ** 2 / 2 + 5 * (q[1] + 0.2) ** 2 / 2
        near(ask(arm.made, "potential", q, qd), arm.energies(q, qd)[1] + springs)
        both = -0.7 * qd.sum()
        near(ask(arm.made, "tau", q, qd), [both, both - 0.4 * qd[1]])


@pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
def test_a_body_placed_by_formulas_is_its_points(plane: bool) -> None:
    points = POINTS[0] * [1, 1, 1, 0] if plane else POINTS[0]
    keys = given(points, plane)
    center = np.array([*keys.pop("center"), 0][:3])
    position = ["x + l*cos(a)", "l*sin(a)", "x*sin(b)"]
    turns = "a - 2*b" if plane else [["x", "a"], ["z", "b"]]
    body = {"name": "bob", "position": position[: 2 if plane else 3], "rotation": turns, **keys}
    text = trees.text([body], GRAVITY[: 2 if plane else 3].tolist(), {"l": 0.8})
    text = text.replace("[coordinates]", "[coordinates]\nx = {}\na = {}\nb = {}")
    made = from_scene(parse(text, "bob.toml"))

    def places(q: Array) -> Array:
        x, a, b = q
        at = np.array([x + 0.8 * np.cos(a), 0.8 * np.sin(a), 0 if plane else x * np.sin(b)])
        turn = about(Z, a - 2 * b) if plane else about(X, a) * about(Z, b)
        return at + turn.apply(points[:, 1:] - center)

    for q, qd in states(3):
        velocity = rate(lambda s, q=q, qd=qd: places(q + s * qd))
        near(ask(made, "kinetic", q, qd), points[:, 0] @ (velocity**2).sum(axis=1) / 2)
        gravity = GRAVITY * [1, 1, 0] if plane else GRAVITY
        near(ask(made, "potential", q, qd), -points[:, 0] @ places(q) @ gravity)


def test_a_wrong_order_of_turns_would_be_seen() -> None:
    arm = Arm("spherical", None, False)
    arm.moves = lambda q, a: (np.zeros(3), Rotation.from_euler("XYZ", q))
    (q, qd), _ = states(4)
    with pytest.raises(AssertionError):
        near(ask(arm.made, "kinetic", q, qd), arm.energies(q, qd)[0])
