"""Compare bodies, springs and forces of scenes with independent mechanics.

test_newton_euler.py compares the routes with the energies that multibody.py writes. Here the
energies and forces are compared with code that shares nothing with the generator: a body is a set
of point masses, its pose a product of SciPy's rotations, its velocity a difference in time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support import trees

from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify.taylor import TaylorReference

Array = NDArray[np.float64]
Pose = tuple[Array, Rotation]  # of a frame in the world: position and rotation

# relative to the summed sizes: differences over STEP err by STEP^4 x'''''/30, some 1e-11 at these
# velocities, and round by 1e-13; a wrong sign gives an error of 1
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


def inertia_keys(points: Array, plane: bool) -> dict[str, Any]:
    """Return mass, centre and inertia of points as the keys of a [[body]]."""
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


def rotation_about(axis: Any, angle: float) -> Rotation:
    return Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)


def translation_along(axis: Any, distance: float) -> Array:
    return np.array(axis) / np.linalg.norm(axis) * distance


IDENTITY = Rotation.identity()
PITCH = -0.3  # m/rad

# the displacement of the frame by the coordinates of each joint, from docs/scenes.md
JOINTS: Mapping[str, tuple[int, Callable[[Array, Any], Pose]]] = {
    "fixed": (0, lambda q, a: (np.zeros(3), IDENTITY)),
    "revolute": (1, lambda q, a: (np.zeros(3), rotation_about(a, q[0]))),
    "prismatic": (1, lambda q, a: (translation_along(a, q[0]), IDENTITY)),
    "planar": (3, lambda q, a: (q[0] * X + q[1] * Y, rotation_about(Z, q[2]))),
    "cylindrical": (2, lambda q, a: (translation_along(a, q[0]), rotation_about(a, q[1]))),
    "screw": (1, lambda q, a: (translation_along(a, PITCH * q[0]), rotation_about(a, q[0]))),
    "universal": (
        2,
        lambda q, a: (np.zeros(3), rotation_about(a[0], q[0]) * rotation_about(a[1], q[1])),
    ),
    "spherical": (3, lambda q, a: (np.zeros(3), Rotation.from_euler("ZYX", q))),
    "free": (6, lambda q, a: (q[:3], Rotation.from_euler("ZYX", q[3:]))),
}
SPACE = [
    ("fixed", None), ("revolute", None), ("revolute", [1, 2, -2]), ("revolute", [-1, 0, 0]),
    ("revolute", [0, 0, -2]), ("prismatic", [1, 2, -2]), ("prismatic", [0, -1, 0]),
    ("planar", None), ("cylindrical", None), ("cylindrical", [2, -1, 2]), ("screw", None),
    ("screw", [2, -1, 2]), ("universal", None),
    ("universal", [[0, 0, 1], [0.6, 0, 0.8]]), ("spherical", None), ("free", None),
]  # fmt: skip
PLANE = [("fixed", None), ("revolute", None), ("prismatic", [-0.6, 0.8]), ("planar", None)]
DEFAULT = {"universal": (X, Y)}  # default axes; z for the other joints


def compose(one: Pose, other: Pose) -> Pose:
    """Compose two poses: the frame `other`, expressed in `one`, in the frame of `one`."""
    return one[0] + one[1].apply(other[0]), one[1] * other[1]


class Arm:
    """Two bodies: one on a revolute joint to the world, and one on it by the joint under test."""

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
                **inertia_keys(self.points[0], plane)}  # fmt: skip
        if not plane:
            base["axis"] = self.first.tolist()
        names = [f"q{k}" for k in range(self.number)]
        tool = {"name": "tool", "parent": "base", "joint": joint, "coordinates": names, **place,
                **inertia_keys(self.points[1], plane), **more.pop("keys", {})}  # fmt: skip
        if axis is not None:
            tool["axis"] = axis
        if joint == "screw":
            tool["pitch"] = PITCH
        gravity = GRAVITY[: self.wide].tolist()
        text = trees.text([base, tool], gravity, {"k": 30.0, "c": 0.7}, more.pop("tables", ()))
        self.system = from_scene(parse(text, "arm.toml"))

    def poses(self, q: Array) -> list[Pose]:
        """Return the frames of both bodies."""
        letters, angles = zip(*TURNS, strict=True)
        turn = (
            rotation_about(Z, 0.4)
            if self.plane
            else Rotation.from_euler("".join(letters).upper(), angles)
        )
        fixed = np.array([*OFFSET[: self.wide], 0][:3]), turn
        base = compose(fixed, (np.zeros(3), rotation_about(self.first, q[0])))
        return [base, compose(base, compose(fixed, self.moves(q[1:], self.axis)))]

    def positions(self, q: Array) -> Array:
        """Return all points in the world."""
        poses_and_points = zip(self.poses(q), self.points, strict=True)
        return np.vstack([at + turn.apply(p[:, 1:]) for (at, turn), p in poses_and_points])

    def energies(self, q: Array, qd: Array) -> tuple[float, float]:
        """Return K and P of the points."""
        masses = np.concatenate([p[:, 0] for p in self.points])
        gravity = GRAVITY * [1, 1, 0] if self.plane else GRAVITY
        velocity = derivative(lambda s: self.positions(q + s * qd))
        return masses @ (velocity**2).sum(axis=1) / 2, -masses @ self.positions(q) @ gravity


def derivative(function: Callable[[float], Any]) -> Any:
    """Return d/ds at s = 0 by central differences of order four."""
    h = STEP
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


def gradient(function: Callable[[Array], float], q: Array) -> Array:
    return np.array([derivative(lambda s, e=e: function(q + s * e)) for e in np.eye(len(q))])


def evaluate_reference(system: System, name: str, q: Array, qd: Array, u: Any = ()) -> Array:
    params = {p.name: p.value for p in system.parameters}
    reference = _reference(system)
    return np.asarray(reference.evaluate(name, q, qd, 0.0, np.array(u, dtype=float), params))


_reference = lru_cache(maxsize=1)(TaylorReference)  # its functions are compiled once


def states(number: int, seed: int = 3) -> list[tuple[Array, Array]]:
    random = np.random.default_rng(seed)
    return [(random.uniform(-1, 1, number), random.uniform(-2, 2, number)) for _ in range(2)]


def assert_close(result: Any, expected: Any, size: float = 1.0) -> None:
    scale = size + np.max(np.abs(expected), initial=0.0)
    np.testing.assert_allclose(result, expected, rtol=0, atol=CLOSE * scale)


@pytest.mark.parametrize(
    ("joint", "axis", "plane"),
    [
        pytest.param(*joint, plane, id=f"{joint}-{plane}", marks=pytest.mark.slow if k % 3 else ())
        for plane, joints in ((False, SPACE), (True, PLANE))
        for k, joint in enumerate(joints)
    ],
)
def test_energies_of_a_joint_agree_with_point_masses(joint: str, axis: Any, plane: bool) -> None:
    arm = Arm(joint, axis, plane)
    for q, qd in states(1 + arm.number):
        kinetic, potential = arm.energies(q, qd)
        assert_close(evaluate_reference(arm.system, "kinetic", q, qd), kinetic)
        assert_close(evaluate_reference(arm.system, "potential", q, qd), potential)


@pytest.mark.parametrize(
    ("joint", "plane"),
    [
        ("revolute", False),
        ("cylindrical", False),
        ("screw", False),
        ("free", False),
        ("prismatic", True),
    ],
)
def test_forces_along_a_joint_have_the_right_sign(joint: str, plane: bool) -> None:
    """Damping and friction oppose the velocity; drives act along the coordinate."""
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
        assert_close(evaluate_reference(arm.system, "tau", q, qd, [0.7]), [0, *force])
        kinetic = arm.energies(q, qd)[0] + 3 * each @ rates**2 / 2
        assert_close(evaluate_reference(arm.system, "kinetic", q, qd, [0.7]), kinetic)


@pytest.mark.parametrize("rest", [0.0, 0.6])
@pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
def test_springs_and_dampers_between_points_agree_with_differences(
    plane: bool, rest: float
) -> None:
    """P = k (L - rest)^2/2; a damper acts along the line with c dL/dt."""
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
        assert_close(
            evaluate_reference(arm.system, "potential", q, qd),
            arm.energies(q, qd)[1] + 30 * (length(q) - rest) ** 2 / 2,
        )
        faster = derivative(lambda s, q=q, qd=qd: length(q + s * qd))
        assert_close(
            evaluate_reference(arm.system, "tau", q, qd), -0.7 * faster * gradient(length, q)
        )


def test_springs_and_dampers_of_angles_agree_with_formulas() -> None:
    """Along a coordinate and between the angles of bodies; the length is the rest angle."""
    pair = {"bodies": ["world", "tool"], "turning": True}
    tables = [("[[spring]]", {**pair, "stiffness": "k", "length": 0.3}),
              ("[[damper]]", {**pair, "damping": "c"}),
              ("[[spring]]", {"coordinate": "q0", "stiffness": 5, "length": -0.2}),
              ("[[damper]]", {"coordinate": "q0", "damping": 0.4})]  # fmt: skip
    arm = Arm("revolute", None, True, tables=tables)
    for q, qd in states(2):
        whole = q.sum() + 2 * 0.4  # both joints are rotated by 0.4
        springs = 30 * (whole - 0.3) ** 2 / 2 + 5 * (q[1] + 0.2) ** 2 / 2
        assert_close(
            evaluate_reference(arm.system, "potential", q, qd), arm.energies(q, qd)[1] + springs
        )
        both = -0.7 * qd.sum()
        assert_close(evaluate_reference(arm.system, "tau", q, qd), [both, both - 0.4 * qd[1]])


@pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
def test_body_placed_by_formulas_agrees_with_point_masses(plane: bool) -> None:
    points = POINTS[0] * [1, 1, 1, 0] if plane else POINTS[0]
    keys = inertia_keys(points, plane)
    center = np.array([*keys.pop("center"), 0][:3])
    position = ["x + l*cos(a)", "l*sin(a)", "x*sin(b)"]
    turns = "a - 2*b" if plane else [["x", "a"], ["z", "b"]]
    body = {"name": "bob", "position": position[: 2 if plane else 3], "rotation": turns, **keys}
    text = trees.text([body], GRAVITY[: 2 if plane else 3].tolist(), {"l": 0.8})
    text = text.replace("[coordinates]", "[coordinates]\nx = {}\na = {}\nb = {}")
    system = from_scene(parse(text, "bob.toml"))

    def positions(q: Array) -> Array:
        x, a, b = q
        at = np.array([x + 0.8 * np.cos(a), 0.8 * np.sin(a), 0 if plane else x * np.sin(b)])
        turn = (
            rotation_about(Z, a - 2 * b) if plane else rotation_about(X, a) * rotation_about(Z, b)
        )
        return at + turn.apply(points[:, 1:] - center)

    for q, qd in states(3):
        velocity = derivative(lambda s, q=q, qd=qd: positions(q + s * qd))
        assert_close(
            evaluate_reference(system, "kinetic", q, qd),
            points[:, 0] @ (velocity**2).sum(axis=1) / 2,
        )
        gravity = GRAVITY * [1, 1, 0] if plane else GRAVITY
        assert_close(
            evaluate_reference(system, "potential", q, qd), -points[:, 0] @ positions(q) @ gravity
        )


def test_comparison_detects_a_wrong_order_of_rotations() -> None:
    arm = Arm("spherical", None, False)
    arm.moves = lambda q, a: (np.zeros(3), Rotation.from_euler("XYZ", q))
    (q, qd), _ = states(4)
    with pytest.raises(AssertionError):
        assert_close(evaluate_reference(arm.system, "kinetic", q, qd), arm.energies(q, qd)[0])
