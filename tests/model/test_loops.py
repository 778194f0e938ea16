"""Compare rows of loops, and reactions by virtual work, with differences of the rows."""

from functools import cache

import numpy as np
import pytest
import sympy

from eomc.model.constraints import perpendicular_axes
from eomc.model.kinematics import ForwardKinematics
from eomc.model.symbols import needed_definitions
from eomc.model.system import from_scene
from eomc.scene.joints import CLOSINGS
from eomc.scene.read import parse

STEP = 1e-5
HEAD = 'eomc = 1\nname = "two"\ngravity = {gravity}\n\n[coordinates]\n'
BODY = """
[[body]]
name        = "{name}"
joint       = "{joint}"
coordinates = {coordinates}
mass        = 1.0
inertia     = {inertia}
offset      = {offset}
"""
LOOP = """
[[loop]]
name   = "pin"
bodies = {bodies}
joint  = "{joint}"
"""
AXES = {
    "revolute": "[[0.3, -1, 0.4], [1, 2, -0.5]]",
    "prismatic": "[0.3, -1, 0.4]",
    "cylindrical": "[[0, 0, -1], [0.1, 2, -0.5]]",
    "universal": "[[0.3, -1, 0.4], [1, 2, -0.5]]",
    "point-on-line": "[1, 0, 0.4]",
}
SLOW = pytest.mark.slow
CASES = [
    (kind, plane, world)
    for kind, closing in CLOSINGS.items()
    for plane in (True, False)
    for world in ("", "first", "second")
    if closing.rows(plane) and kind != "gear"
]
# all kinds in space, between two bodies
QUICK = [pytest.param(*case, marks=() if case[1:] == (False, "") else SLOW) for case in CASES]


def text(kind, plane, world):
    """Write two free bodies, or one and the world, and a loop between them."""
    names = ["one", "other"]
    letters = ("x", "y", "a") if plane else ("x", "y", "z", "a", "b", "c")
    known = [f"{name}_q{letter}" for name in names for letter in letters]
    out = HEAD.format(gravity=[0, 0] if plane else [0, 0, 0])
    out += "".join(f'{name} = {{ unit = "rad" }}\n' for name in known)
    for k, name in enumerate(names):
        out += BODY.format(
            name=name, joint="planar" if plane else "free",
            coordinates=known[: len(letters)] if not k else known[len(letters) :],
            inertia=0.5 if plane else [0.5, 0.6, 0.7],
            offset=[0.1, 0.2] if plane else [0.1, 0.2, 0.3],
        )  # fmt: skip
    bodies = {"": names, "first": ["world", "other"], "second": ["one", "world"]}[world]
    out += LOOP.format(bodies=bodies, joint=kind)
    points = [[0.3, -0.2, 0.5], [-0.1, 0.4, 0.2]]
    out += f"points = {[p[:2] for p in points] if plane else points}\n"
    if kind in AXES and not plane:
        out += f"axis = {AXES[kind]}\n"
    elif kind in ("prismatic", "point-on-line"):
        out += "axis = [0.6, -0.8]\n"
    if kind in ("weld", "prismatic"):
        out += f"rotation = {0.7 if plane else [['z', 0.4], ['x', -0.3]]}\n"
    if kind == "distance":
        out += "length = 0.8\n"
    return out, bodies, points


class TwoBodies:
    """Evaluate the scene's rows, reaction and branches numerically."""

    def __init__(self, kind, plane, world):
        written, self.bodies, self.points = text(kind, plane, world)
        self.scene = parse(written)
        self.system = system = from_scene(self.scene)
        self.plane = plane
        (self.reaction,) = system.reactions
        self.multipliers = [row.multiplier for row in system.constraints]
        self.rows = self.numeric([row.formula for row in system.constraints])
        self.branches = self.numeric(self.reaction.branches)
        self.values = self.numeric(self.reaction.values, self.multipliers)
        if plane:
            self.points = [[x, y, 0.0] for x, y, _ in self.points]

    def numeric(self, expressions, more=()):
        """Compile expressions into a function of the coordinates."""
        expressions = list(expressions)
        for name, e in reversed(needed_definitions(self.system.definitions, expressions)):
            expressions = [sympy.sympify(x).xreplace({name: e}) for x in expressions]
        return sympy.lambdify([*self.system.q, *more], expressions)

    def frame_of(self, end, q):
        """Return the joint's point on a body and the body's rotation."""
        at, R = (np.zeros(3), np.eye(3))
        if self.bodies[end] != "world":
            poses = ForwardKinematics(self.scene, np.zeros(1), np.array(q, float)[None]).poses
            at, R = (x[0] for x in poses[self.bodies[end]])
        return at + R @ self.points[end], R

    def jacobian(self, q):
        """Return the Jacobian of the rows by central differences."""
        columns = []
        for k in range(len(q)):
            step = STEP * np.eye(len(q))[k]
            columns.append((np.array(self.rows(*(q + step))) - self.rows(*(q - step))) / 2 / STEP)
        return np.array(columns).T

    def twist(self, end, at, q):
        """Return the velocity Jacobian and the angular one of the point `at` on a body."""
        point, R = self.frame_of(end, q)
        inside = R.T @ (at - point)
        v, omega = np.zeros((2, 3, len(q)))
        for k in range(len(q)):
            step = STEP * np.eye(len(q))[k]
            (p1, R1), (p0, R0) = self.frame_of(end, q + step), self.frame_of(end, q - step)
            v[:, k] = (p1 + R1 @ inside - p0 - R0 @ inside) / 2 / STEP
            skew = (R1 @ R0.T - R0 @ R1.T) / 4 / STEP
            omega[:, k] = skew[2, 1], skew[0, 2], skew[1, 0]
        return v, omega

    def loads(self, q, multipliers):
        """Return the reaction: a force and a moment, three entries each."""
        values = np.array(self.values(*q, *multipliers), float)
        if self.plane:
            return np.array([values[0], values[1], 0]), np.array([0, 0, values[2]])
        return values[:3], values[3:]

    def close_loop(self, seed):
        """Return a position where the loop is closed on its branch, by the Gauss-Newton method."""
        for start in np.random.default_rng(seed).uniform(-1.5, 1.5, (50, len(self.system.q))):
            q = start
            for _ in range(30):
                q = q - np.linalg.lstsq(self.jacobian(q), np.array(self.rows(*q)), rcond=None)[0]
            if np.abs(self.rows(*q)).max() < 1e-13 and min(self.branches(*q), default=1) > 0.5:
                return q
        raise AssertionError("not closed")


@cache
def two_bodies(kind, plane, world):
    return TwoBodies(kind, plane, world)


@pytest.mark.parametrize(("kind", "plane", "world"), QUICK)
def test_reactions_do_the_virtual_work_of_the_rows(kind, plane, world):
    bodies = two_bodies(kind, plane, world)
    random = np.random.default_rng(1)
    multipliers = random.normal(size=len(bodies.multipliers))
    for q, ends in (
        (random.uniform(-1, 1, len(bodies.system.q)), (1,)),
        (bodies.close_loop(2), (0, 1)),
    ):
        force, moment = bodies.loads(q, multipliers)
        work = multipliers @ bodies.jacobian(q)
        at = bodies.frame_of(1, q)[0]
        for end in ends:
            v, omega = bodies.twist(end, at, q)
            is_moving = np.abs(v).max(axis=0) + np.abs(omega).max(axis=0) > 1e-6
            sign = 1 if end else -1
            np.testing.assert_allclose(
                sign * (force @ v + moment @ omega)[is_moving], work[is_moving], atol=1e-8
            )
            assert is_moving.any() == (bodies.bodies[end] != "world")


@pytest.mark.parametrize(("kind", "plane", "world"), QUICK)
def test_rows_are_regular_at_a_closed_position(kind, plane, world):
    bodies = two_bodies(kind, plane, world)
    q = bodies.close_loop(3)
    values = np.linalg.svd(bodies.jacobian(q), compute_uv=False)
    assert len(values) == len(CLOSINGS[kind].rows(plane))
    assert values[-1] > 1e-4 * values[0]  # a prismatic joint may be far from its points
    assert [b for b in bodies.branches(*q) if abs(b - 1) > 1e-12] == []


@pytest.mark.parametrize("kind", ["weld", "prismatic", "revolute", "cylindrical"])
def test_axis_rows_are_small_rotations_about_the_axes(kind):
    bodies = TwoBodies(kind, False, "first")
    q = bodies.close_loop(4)
    _, omega = bodies.twist(1, bodies.frame_of(1, q)[0], q)
    names = [row.name.removeprefix("pin_") for row in bodies.system.constraints]
    slopes = dict(zip(names, bodies.jacobian(q), strict=True))
    if kind in ("weld", "prismatic"):
        R = bodies.frame_of(1, q)[1]  # rotates the first frame into the second
        axes = {f"r{letter}": R[:, k] for k, letter in enumerate("xyz")}
    else:
        loop = bodies.scene.assembly.loops[0]
        u, v, _ = (np.array(e, float) for e in perpendicular_axes(loop.axes[0], False))
        axes = {"ru": u, "rv": v}
    for name, axis in axes.items():
        np.testing.assert_allclose(slopes[name], axis @ omega, atol=1e-8)


def test_comparison_detects_a_wrong_sign():
    """A reaction with its moment reversed must fail the comparison of work."""
    bodies = TwoBodies("weld", True, "")
    q = bodies.close_loop(5)
    force, moment = bodies.loads(q, [0.3, 0.4, 0.5])
    v, omega = bodies.twist(1, bodies.frame_of(1, q)[0], q)
    work = np.array([0.3, 0.4, 0.5]) @ bodies.jacobian(q)
    is_moving = np.abs(omega).max(axis=0) > 1e-6
    assert np.abs((force @ v - moment @ omega - work)[is_moving]).max() > 0.1


def test_gear_couples_two_angles():
    scene = parse(
        """
eomc = 1
name = "gears"

[coordinates]
phi = { unit = "rad", start = 0.5 }
psi = { unit = "rad" }

[parameters]
n = -3.0
c = 0.2

[energy]
kinetic = "phi_dot**2 + psi_dot**2"

[[loop]]
name = "mesh"
joint = "gear"
coordinates = ["phi", "psi"]
ratio = "n"
offset = "c"
"""
    )
    system = from_scene(scene)
    (row,) = system.constraints
    assert str(row.formula) == "-c - n*phi + psi"
    assert (row.name, row.loop, row.holonomic) == ("mesh", "mesh", True)
    assert [c.start_fixed for c in system.coordinates] == [True, False]
    assert not system.reactions


SLIDER = """
eomc = 1
name = "slider"
gravity = {gravity}

[coordinates]
a = {{ unit = "rad", start = 0.5 }}
b = {{ unit = "rad" }}

[parameters]
l = 1.0
h = 0.0

[[body]]
name = "crank"
joint = "revolute"
coordinates = "a"
mass = 1.0
inertia = {inertia}

[[body]]
name = "rod"
parent = "crank"
joint = "revolute"
coordinates = "b"
offset = ["l"{zeros}]
mass = 1.0
inertia = {inertia}

[[point]]
name = "end"
body = "rod"
place = [2.0{zeros}]

[[point]]
name = "rail"
body = "world"
place = [0.0, "h"{zero}]

[[loop]]
name = "pin"
bodies = ["rail", "end"]
{joint}
"""


def slider(joint, space):
    return SLIDER.format(
        gravity=[0, 0, -9.81] if space else [0, -9.81],
        inertia=[0.1, 0.1, 0.1] if space else 0.1,
        zeros=", 0, 0" if space else ", 0",
        zero=", 0" if space else "",
        joint=joint,
    )


def test_loop_without_points_uses_those_of_the_bodies():
    system = from_scene(parse(slider('joint = "point-on-line"\naxis = [1, 0]', False)))
    (row,) = system.constraints
    assert row.name == "pin"
    assert str(row.formula) == "end_joint_y - h"


def test_constant_row_is_dropped_with_a_warning():
    system = from_scene(parse(slider('joint = "spherical"', True)))
    assert [row.name for row in system.constraints] == ["pin_x", "pin_y"]
    (warning,) = system.warnings
    assert "has a row that is zero wherever its bodies move, left out: pin_z" in warning.message
    (reaction,) = system.reactions
    assert str(reaction.values) == "(pin_x_lambda_, pin_y_lambda_, 0, 0, 0, 0)"


def test_hinges_of_a_planar_mechanism_in_space_have_two_rows():
    system = from_scene(parse(slider('joint = "revolute"', True)))
    assert [row.name for row in system.constraints] == ["pin_x", "pin_y"]
    assert "left out: pin_z, pin_ru, pin_rv; what they would carry" in system.warnings[0].message
