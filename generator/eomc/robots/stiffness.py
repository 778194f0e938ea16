"""Forces of a robot that are too stiff for a scene's default steps, and what the scene asks then.

At rest at the start, M q'' + B q' + K q = 0 to first order, with the slope of smoothed friction,
friction/width, in B. Its eigenvalues decide whether steps of fixed size are stable. The directions
in which loops and couplings do not let the robot move are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.spatial import apply, cross, plus, rotated_inertia, scaled, tensor
from eomc.integrators.tableaux import RK4
from eomc.robots.geometry import IDENTITY_TRANSFORM, Transform, Vector, from_axis_angle, times
from eomc.robots.robot import Coupling, JointMotion, Robot, RobotBody, RobotLoop
from eomc.runtime import rank
from eomc.scene import validate_tables
from eomc.scene.joints import JOINTS
from eomc.scene.scene import WORLD
from eomc.scene.schema import RunSettings

Array = NDArray[np.float64]

FRICTION_WIDTH = float(validate_tables.FRICTION_WIDTH.text)  # m/s or rad/s
OSCILLATION_LIMIT, DECAY_LIMIT = (x / RunSettings.h for x in RK4.limits)  # rad/s, 1/s, by default
# 1/s: friction whose velocities decay faster is smoothed over a wider range. Implicit steps to a
# tolerance of 1e-11, which estimates of errors take, resolve this decay in double precision
FRICTION_DECAY_LIMIT = 1e6


@dataclass(frozen=True)
class ForceElement:
    """A damper and a spring that act along the linear combination J q of the coordinates.

    Attributes
    ----------
    name : str
        Description of the damper or spring.
    J : (n,)
        The coefficients of the coordinates.
    damping : float
        N s/m or N m s/rad.
    stiffness : float
        N/m or N m/rad.
    """

    name: str
    J: Array
    damping: float
    stiffness: float = 0.0

    def is_stiff(self, inverse: Array) -> bool:
        """Return True if this damper and spring alone make a scene's default steps unstable.

        `inverse` is the inverse of the mass matrix.
        """
        mobility = float(self.J @ inverse @ self.J)
        oscillation = math.sqrt(self.stiffness * mobility)
        return self.damping * mobility > DECAY_LIMIT or oscillation > OSCILLATION_LIMIT


def with_stable_steps(robot: Robot) -> Robot:
    """Return the robot, with adaptive steps if a scene's default steps are unstable.

    Stability is determined at the initial state. Friction that is too stiff even for adaptive
    steps is smoothed over a wider range of velocities. Both changes are noted in `left_out`.
    """
    if robot.method or not robot.motions:
        return robot
    rows = [m.name for m in robot.motions]
    ways = allowed_velocities(robot, rows)
    elements = _elements(robot, rows)
    M = ways.T @ mass_matrix(robot, rows) @ ways
    if not _is_regular(M):  # a motion without inertia, which `eomc build` reports
        return robot
    inverse = ways @ np.linalg.inv(M) @ ways.T
    oscillation, decay = _fastest(inverse, elements)
    if not (oscillation > OSCILLATION_LIMIT or decay > DECAY_LIMIT):
        return robot
    stiff = [e.name for e in elements if e.is_stiff(inverse)] or ["all forces together"]
    rates = [f"velocities decay at up to {decay:.2g} 1/s"] * (decay > DECAY_LIMIT)
    rates += [f"motions oscillate at up to {oscillation:.2g} rad/s"] * (
        oscillation > OSCILLATION_LIMIT
    )
    words = (
        f"stiff: {texts.listed(stiff, 6)}: at the start {' and '.join(rates)}, too fast for steps "
        f"of rk4 of {RunSettings.h:g} s; therefore "
        '[run] has method = "auto", steps that fit a tolerance'
    )
    if any(name.startswith(FRICTION) for name in stiff):
        words += (
            f". Friction is smoothed within velocities of {FRICTION_WIDTH:g}: a larger "
            'friction_width makes it less stiff, friction = "stick" in [run] makes it exact'
        )
    robot = replace(robot, method="auto", left_out=(*robot.left_out, words))
    return _widened(robot, inverse, rows)


def _widened(robot: Robot, inverse: Array, rows: Sequence[str]) -> Robot:
    """Return the robot with a `friction_width` for each friction above FRICTION_DECAY_LIMIT."""
    bodies, wide = [], []
    for body in robot.bodies:
        motions = []
        for m in body.motions:
            J = _of_motion(m, rows)
            width = float(f"{m.friction * float(J @ inverse @ J) / FRICTION_DECAY_LIMIT:.2g}")
            if width > FRICTION_WIDTH:
                m = replace(m, friction_width=width)
                wide.append(f"{m.name} ({width:g} {m.unit}/s)")
            motions.append(m)
        bodies.append(replace(body, motions=tuple(motions)))
    if not wide:
        return robot
    words = (
        f"friction so large for what it moves that it is smoothed within a wider friction_width: "
        f'{texts.listed(wide, 6)}; check its value, or take friction = "stick" in [run]'
    )
    return replace(robot, bodies=tuple(bodies), left_out=(*robot.left_out, words))


def _is_regular(M: Array) -> bool:
    """Return whether M is finite and positive definite beyond rounding, whatever the units."""
    sizes = np.sqrt(np.abs(np.diag(M)))
    if not len(M) or not np.isfinite(M).all() or not sizes.all():
        return False
    return bool(np.linalg.eigvalsh(M / np.outer(sizes, sizes)).min() > 1e-12)


def _fastest(inverse: Array, elements: Sequence[ForceElement]) -> tuple[float, float]:
    """Return the largest |Im| and the fastest decay of the eigenvalues, rad/s and 1/s."""
    B, K = np.zeros((2, *inverse.shape))
    for e in elements:
        B += e.damping * np.outer(e.J, e.J)
        K += e.stiffness * np.outer(e.J, e.J)
    zero = np.zeros_like(inverse)
    rates = np.block([[zero, np.eye(len(zero))], [-inverse @ K, -inverse @ B]])
    if not np.isfinite(rates).all():
        return 0.0, 0.0
    values = np.linalg.eigvals(rates)
    return float(np.abs(values.imag).max()), float(-values.real.min())


FRICTION = "friction of "  # the beginning of such an element's name


def _elements(robot: Robot, rows: Sequence[str]) -> list[ForceElement]:
    """Return what damps and what pulls back."""
    elements = []
    for m in (m for body in robot.bodies for m in body.motions):
        J = _of_motion(m, rows)
        elements += [
            ForceElement(FRICTION + m.name, J, m.friction / FRICTION_WIDTH),
            ForceElement(f"damping of {m.name}", J, m.damping),
            ForceElement(f"the spring of {m.name}", J, 0.0, m.stiffness),
        ]
    for t in robot.tendons:
        elements.append(
            ForceElement(f"tendon {t.name}", gradient(t.terms, rows), t.damping, t.stiffness)
        )
    for d in robot.drives:
        if d.law:
            J = d.gear * gradient(robot.coordinate_terms(d.coordinate), rows)
            elements.append(
                ForceElement(f"servo {d.name}", J, max(d.law.kv, 0.0), max(d.law.kp, 0.0))
            )
    return [e for e in elements if e.damping or e.stiffness]


def _of_motion(motion: JointMotion, rows: Sequence[str]) -> Array:
    """Return the gradient of a joint's position over the coordinates."""
    of = motion.mimics
    return gradient([(of.gear, of.coordinate) if of else (1.0, motion.name)], rows)


def gradient(terms: Iterable[tuple[float, str]], rows: Sequence[str]) -> Array:
    """Return the gradient (n,) of a linear combination of the n coordinates.

    `terms` are pairs (factor, coordinate), and `rows` are the names of the coordinates, in order.
    """
    J = np.zeros(len(rows))
    for by, q in terms:
        J[rows.index(q)] += by
    return J


# --- masses and constraints -----------------------------------------------------------------------


@dataclass(frozen=True)
class Rigid:
    """A body's frame in the world at the start, and how the coordinates above it move it.

    Attributes
    ----------
    pose : Transform
        Pose of the frame in the world.
    columns : tuple
        For each joint motion on the path from the world to the body: the row of its coordinate, the
        angular velocity for a unit rate of the coordinate, and a function that returns the velocity
        of a point of the body at a given place in the world.
    """

    pose: Transform
    columns: tuple[tuple[int, Vector, Callable[[Vector], Vector]], ...] = ()

    def jacobians(self, at: Vector, n: int) -> tuple[Array, Array]:
        """Return the Jacobians (3, n) of a point's velocity and of the body's angular velocity.

        They are with respect to the n coordinate velocities. The point is fixed to the body and has
        the position `at` in the world (m).
        """
        moves, turns = np.zeros((2, 3, n))
        for row, turn, velocity in self.columns:
            moves[:, row] += velocity(at)
            turns[:, row] += turn
        return moves, turns


def rigid_bodies(bodies: Sequence[RobotBody], rows: Sequence[str]) -> dict[str, Rigid]:
    """Return the frame and the motions of each body at the initial state, by name.

    The world is included as a body. `rows` are the names of the coordinates, in the order of the
    columns of Jacobians.
    """
    rigid = {WORLD: Rigid(IDENTITY_TRANSFORM)}
    for body in bodies:
        parent = rigid[body.parent]
        place, turn = parent.pose.compose(Transform(body.offset, body.rotation))
        columns, joint = [*parent.columns], JOINTS[body.joint]
        subspaces = joint.subspaces(body.axes, pitch=0.0)
        for (axis, angular, linear), m in zip(subspaces, body.motions, strict=True):
            gear = m.mimics.gear if m.mimics else 1.0
            row = rows.index(m.mimics.coordinate if m.mimics else m.name)
            rate = scaled(apply(turn, axis), gear)
            spin, slide = scaled(rate, angular), scaled(rate, linear)
            columns.append((row, spin, partial(_velocity, spin, slide, place)))
            place = plus(place, apply(turn, scaled(axis, linear * m.start)))
            turn = times(turn, from_axis_angle(axis, angular * m.start))
        rigid[body.name] = Rigid(Transform(place, turn), tuple(columns))
    return rigid


def _velocity(spin: Vector, slide: Vector, place: Vector, at: Vector) -> Vector:
    """Return the velocity at a point `at` of a body that moves so at the point `place`."""
    return plus(slide, cross(spin, plus(at, scaled(place, -1.0))))


def mass_matrix(robot: Robot, rows: Sequence[str]) -> Array:
    """Return the mass matrix (n, n) at the initial state, including armatures of joints.

    `rows` are the names of the n coordinates, in the order of the matrix.
    """
    M = np.zeros((len(rows), len(rows)))
    rigid = rigid_bodies(robot.bodies, rows)
    for body in robot.bodies:
        its = rigid[body.name]
        moves, turns = its.jacobians(its.pose.point(body.center), len(rows))
        inertia = np.array(tensor(rotated_inertia(its.pose.turn, body.inertia)))
        M += body.mass * moves.T @ moves + turns.T @ inertia @ turns
        for m in body.motions:
            J = _of_motion(m, rows)
            M += m.armature * np.outer(J, J)
    for tendon in robot.tendons:
        J = gradient(tendon.terms, rows)
        M += tendon.armature * np.outer(J, J)
    return M


def allowed_velocities(robot: Robot, rows: Sequence[str]) -> Array:
    """Return an orthonormal basis (n, k) of the velocities that loops and couplings allow.

    It applies at the initial state. `rows` are the names of the n coordinates, in order.
    """
    starts = {m.name: m.start for m in robot.motions}
    if not robot.loops and not robot.couplings:
        return np.eye(len(rows))
    rigid = rigid_bodies(robot.bodies, rows)
    A = [coupling_gradient(c, starts, rows)[None] for c in robot.couplings]
    A += [loop_jacobian(loop, rigid, rows) for loop in robot.loops]
    return rank.null_space(np.vstack(A))


def coupling_gradient(c: Coupling, starts: dict[str, float], rows: Sequence[str]) -> Array:
    """Return the gradient (n,) of a coupling's residual with respect to the coordinates.

    `starts` are the positions of the coordinates by name, at which the gradient is evaluated;
    `rows` are the names of the n coordinates, in order.
    """
    x = sum(by * starts[q] for by, q in c.second) - c.at
    slope = sum(k * a * x ** (k - 1) for k, a in enumerate(c.polynomial) if k)
    return gradient(c.first, rows) - slope * gradient(c.second, rows)


def loop_jacobian(loop: RobotLoop, rigid: dict[str, Rigid], rows: Sequence[str]) -> Array:
    """Return the Jacobian (3, n) of a loop's constraint equations, or (6, n) for a weld.

    The first three rows are for the relative velocity of the loop's two points, the others for the
    relative angular velocity of its bodies. `rigid` has the frame of each body at the initial
    state, by name. `rows` are the names of the n coordinates, in order.
    """
    ends = zip((rigid[name] for name in loop.bodies), loop.points, strict=True)
    pairs = [body.jacobians(body.pose.point(at), len(rows)) for body, at in ends]
    moves, turns = (one - other for one, other in zip(*pairs, strict=True))
    return np.vstack([moves, turns]) if loop.joint == "weld" else moves
