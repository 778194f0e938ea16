"""Ineffective constraints of a robot: loops and couplings whose Jacobian is identically zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eomc.base.spatial import plus, scaled
from eomc.robots.robot import Robot, RobotLoop
from eomc.robots.stiffness import coupling_gradient, loop_jacobian, rigid_bodies

STATE_COUNT = 3  # random states at which the Jacobian is evaluated
ZERO_TOLERANCE = 1e-10  # of an entry of the Jacobian, relative to the bodies' distances
GAP_TOLERANCE = 1e-6  # m: a larger gap is reported


def without_ineffective_constraints(robot: Robot) -> Robot:
    """Return the robot without those loops and couplings that have no effect on the motion.

    Their Jacobian is zero in all positions. They are noted in `Robot.left_out`. MuJoCo, too, gives
    such a constraint no equations.
    """
    if not robot.loops and not robot.couplings:
        return robot
    rows = [m.name for m in robot.motions]
    effective: set[str] = set()
    random = np.random.default_rng(0)
    for _ in range(STATE_COUNT):
        starts = dict(zip(rows, random.uniform(-1, 1, len(rows)).tolist(), strict=True))
        bodies = tuple(
            replace(b, motions=tuple(
                replace(m, start=m.mimics.joint_position(starts[m.mimics.coordinate]) if m.mimics
                        else starts[m.name])
                for m in b.motions
            ))
            for b in robot.bodies
        )  # fmt: skip
        rigid = rigid_bodies(bodies, rows)
        size = max(1.0, *(float(np.abs(body.place).max()) for body in rigid.values()))
        slopes = {loop.name: loop_jacobian(loop, rigid, rows) for loop in robot.loops}
        slopes |= {c.name: coupling_gradient(c, starts, rows) for c in robot.couplings}
        effective |= {
            name for name, J in slopes.items() if np.abs(J).max(initial=0.0) > ZERO_TOLERANCE * size
        }
    ineffective = [
        _described(loop, robot, rows) for loop in robot.loops if loop.name not in effective
    ]
    ineffective += [c.name for c in robot.couplings if c.name not in effective]
    if not ineffective:
        return robot
    words = f"constraints that no motion changes, which hold nothing: {', '.join(ineffective)}"
    return replace(
        robot,
        loops=tuple(loop for loop in robot.loops if loop.name in effective),
        couplings=tuple(c for c in robot.couplings if c.name in effective),
        left_out=(*robot.left_out, words),
    )


def _described(loop: RobotLoop, robot: Robot, rows: list[str]) -> str:
    """Return a loop's name, with the distance between its points if it is open."""
    rigid = rigid_bodies(robot.bodies, rows)
    one, other = (rigid[b].point(p) for b, p in zip(loop.bodies, loop.points, strict=True))
    gap = float(np.linalg.norm(plus(one, scaled(other, -1.0))))
    return loop.name + (f" (open by {gap:.3g} m)" if gap > GAP_TOLERANCE else "")
