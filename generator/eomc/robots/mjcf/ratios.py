"""Damping and stiffness that MJCF gives as ratios and time constants, of what moves at the start.

The start is the pose in which the file is written, as in MuJoCo's compiler.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from eomc.base import spatial
from eomc.base.spatial import apply, cross, plus, scaled
from eomc.robots.mjcf.joints import MjcfJoint
from eomc.robots.mjcf.masses import IDENTITY_TRANSFORM, Transform
from eomc.robots.robot import Law, RobotBody, Tendon, body_pose
from eomc.robots.rotations import ORIGIN, Vector
from eomc.scene.assembly import WORLD
from eomc.scene.joints import X, Y, Z

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def has_ratio(law: Law | None) -> bool:
    """Return True if the control law of an actuator specifies its damping as a damping ratio.

    In MJCF this is a position servo with a positive velocity coefficient.
    """
    return bool(law and law.bias[2] > 0 and law.set_point == "kp" and law.kp > 0)


def servo_damping(
    law: Law, along: Iterable[tuple[float, str]], masses: NDArray[np.float64], rows: Sequence[str]
) -> float:
    """Return the damping kv of a servo from its damping ratio: ratio times 2 sqrt(kp m).

    m = 1/(J M^-1 J^T) is the mass that the servo moves, as in MuJoCo 4.

    Parameters
    ----------
    law : Law
        The servo, with the damping ratio as its velocity coefficient.
    along
        The gradient J of the servo's length (including its gear), as pairs (entry, coordinate).
    masses, rows
        The mass matrix M, and the coordinate of each of its rows.
    """
    import numpy as np

    J = np.zeros(len(rows))
    for by, q in along:
        J[rows.index(q)] += by
    if not np.isfinite(masses).all():  # masses that overflow
        return 0.0
    mobility = float(J @ np.linalg.lstsq(masses, J, rcond=None)[0])
    return 2 * law.bias[2] * math.sqrt(law.kp / mobility) if mobility > 0 else 0.0


def with_spring_dampers(
    joints: Sequence[MjcfJoint],
    bodies: Sequence[RobotBody],
    tendons: Iterable[Tendon],
    disabled: Collection[str],
) -> list[MjcfJoint]:
    """Return the joints with each `springdamper` replaced by a stiffness and a damping.

    MJCF specifies a springdamper by a time constant t and a damping ratio r. The stiffness is
    m/(t r)^2 and the damping 2 m/t, where 1/m is the mean of M^-1 along the joint's coordinates and
    M is the mass matrix. The damping of actuators is added. `disabled` contains the effects that
    flags of the file disable.
    """
    import numpy as np

    if not any(any(joint.spring) for joint in joints):
        return list(joints)
    masses, rows = mass_matrix_at_start(bodies, joints, tendons)
    if not np.isfinite(masses).all():  # masses that overflow
        return list(joints)
    mobilities = np.diag(np.linalg.lstsq(masses, np.eye(len(rows)), rcond=None)[0])
    out = []
    for joint in joints:
        time, ratio = joint.spring
        along = mobilities[[rows.index(m.name) for m in joint.motions]].mean()
        if time and along > 0:
            stiffness = 0.0 if "spring" in disabled else float(1 / (along * (time * ratio) ** 2))
            damping = 0.0 if "damper" in disabled else float(2 / (along * time))
            motions = (
                replace(m, stiffness=stiffness, damping=m.damping + damping) for m in joint.motions
            )
            joint = replace(joint, motions=tuple(motions))
        out.append(joint)
    return out


def mass_matrix_at_start(
    bodies: Sequence[RobotBody], joints: Sequence[MjcfJoint], tendons: Iterable[Tendon]
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the mass matrix in the pose of the file, and the names of the coordinates of its rows.

    Free and ball joints have rows for rotations about x, y and z; the names are those of the
    joint's angles.
    """
    import numpy as np

    rows = [m.name for joint in joints for m in joint.motions]
    M = np.diag([m.armature for joint in joints for m in joint.motions])
    poses: dict[str, Transform] = {WORLD: IDENTITY_TRANSFORM}
    columns: dict[str, list[tuple[int, Vector, Vector]]] = {WORLD: []}
    waiting, row = iter(joints), 0
    for body in bodies:
        around = poses[body.parent].compose(Transform(body.offset, body.rotation))
        stands = Transform(*body_pose(body, [m.start for m in body.motions]))
        pose = poses[body.name] = poses[body.parent].compose(stands)
        mine = []  # turns: the rate and a point of the axis; slides: no rate, the velocity
        if body.joint != "fixed":
            joint = next(waiting)
            kinds = {"prismatic": "t", "revolute": "r", "free": "tttrrr"}.get(body.joint, "rrr")
            axes = body.axes or (X, Y, Z, X, Y, Z)[-len(kinds) :]
            for kind, axis in zip(kinds, axes, strict=True):
                axis = apply(around.turn, axis)
                mine.append((row, axis, pose.place) if kind == "r" else (row, ORIGIN, axis))
                M[row, row] += joint.armature if kind == "r" else 0.0
                row += 1
        columns[body.name] = [*columns[body.parent], *mine]
        center = plus(pose.place, apply(pose.turn, body.center))
        tensor = spatial.tensor(spatial.rotated_inertia(pose.turn, body.inertia))
        at = [k for k, _, _ in columns[body.name]]
        turns = np.array([w for _, w, _ in columns[body.name]]).reshape(-1, 3)
        slides = np.array([_velocity(w, p, center) for _, w, p in columns[body.name]])
        slides = slides.reshape(-1, 3)
        M[np.ix_(at, at)] += body.mass * slides @ slides.T + turns @ np.array(tensor) @ turns.T
    for t in tendons:
        J = np.zeros(len(rows))
        for by, q in t.terms:
            J[rows.index(q)] += by
        M += t.armature * np.outer(J, J)
    return M, rows


def _velocity(turn: Vector, of: Vector, at: Vector) -> Vector:
    """Return the velocity of the point `at` for one joint motion.

    turn: its angular velocity about a line through `of`; zero for a slide, whose velocity is `of`.
    """
    return cross(turn, plus(at, scaled(of, -1.0))) if any(turn) else of
