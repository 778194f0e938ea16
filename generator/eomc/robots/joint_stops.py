"""Joint stops: position limits as stiff, dissipative springs.

The contact force beyond a limit is that of Hunt and Crossley (1975), k x (1 + d v), cut off at zero
so that it never pulls; x is the penetration and v = dx/dt. k = effort/depth, so that the full
effort of the joint penetrates by `depth`. The effort is the smaller of the joint's own limit and
the largest total force of its drives. If the file gives neither, it is the force that holds all
bodies carried by the joint, stretched out, against gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eomc.robots.robot import Motion, Robot

DEPTHS = {"rad": 0.01, "m": 0.001}  # by a coordinate's unit
DAMPING = {"rad": 1.0, "m": 10.0}  # s/rad, s/m


@dataclass(frozen=True)
class Stop:
    """The stop of a coordinate at its limits: a spring that acts beyond them, see the module.

    Attributes
    ----------
    coordinate, unit : str
        Name of the coordinate, and its unit "rad" or "m".
    limits : (float, float)
        Lowest and highest position.
    effort : float
        The force (N or N m) at which the penetration of the limit is the depth in `DEPTHS`.
    known : bool
        Whether the file gives the effort. Otherwise it is estimated from the weight that the joint
        carries.
    """

    coordinate: str
    unit: str
    limits: tuple[float, float]
    effort: float
    known: bool


def joint_stops(robot: Robot) -> list[Stop]:
    """Return a stop for each coordinate that has finite limits."""
    loads: dict[str, tuple[float, float]] = {}  # by body: mass, and largest mass times distance
    holding_effort: dict[str, float] = {}  # by coordinate: against gravity, N or N m
    g = math.hypot(*robot.gravity)
    for body in reversed(robot.bodies):  # children come before parents
        mass, moment = loads.get(body.name, (0.0, 0.0))
        mass, moment = mass + body.mass, moment + body.mass * math.hypot(*body.center)
        holding_effort |= {m.name: g * (moment if m.unit == "rad" else mass) for m in body.motions}
        more = mass, moment + mass * math.hypot(*body.offset)
        one, other = loads.get(body.parent, (0.0, 0.0)), more
        loads[body.parent] = one[0] + other[0], one[1] + other[1]
    drive_force: dict[str, float] = {}  # by coordinate: the sum over its drives
    for d in robot.drives:
        for factor, q in robot.coordinate_terms(d.coordinate):
            drive_force[q] = drive_force.get(q, 0.0) + (
                abs(factor) * d.max_force if factor else 0.0
            )

    def stop(m: Motion) -> Stop:
        effort = min(max(map(abs, m.driven)), drive_force.get(m.name, math.inf))
        known = 0 < effort < math.inf
        effort = effort if known else float(f"{holding_effort[m.name]:.3g}") or 1.0
        return Stop(m.name, m.unit, m.limits, effort, known)

    return [
        stop(m)
        for m in robot.motions
        if m.limits[0] < m.limits[1] and all(map(math.isfinite, m.limits))
    ]
