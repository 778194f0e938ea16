"""Limits in robot files: of drives as limits of the scene's inputs, and of joints as stops.

Joint stops are position limits as stiff, dissipative springs. The contact force beyond a limit is
that of Hunt and Crossley (1975), k x (1 + d v), cut off at zero so that it never pulls; x is the
penetration and v = dx/dt. k = effort/depth, so that the full effort of the joint penetrates by
`depth`. The effort is the smaller of the joint's own limit and the largest total force of its
drives. If the file gives neither, it is the force that holds all bodies carried by the joint,
stretched out, against gravity.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.robots.robot import UNLIMITED, JointMotion, Range, Robot

# notes of the readers: on limits that take effect here, and on those of position and speed
_ACTING = re.compile(r"limits of (actuators|the actuators' force on joints), kept as notes")
_JOINTS = re.compile(r"^(limits of \d+ joints?)(?=: )")
_STOPS = "those of speed and effort are notes"  # a note of edit.with_joint_stops


def input_range(force: Range, factor: float) -> Range:
    """Return the range of an input such that `factor` times the input is in the range `force`."""
    if not factor:
        return UNLIMITED
    low, high = sorted(f / factor for f in force)
    return low, high


def intersection(one: Range, other: Range) -> Range | None:
    """Return the range common to two ranges; None if it is empty or a single point."""
    low, high = max(one[0], other[0]), min(one[1], other[1])
    return (low, high) if low < high else None


def with_input_limits(robot: Robot) -> Robot:
    """Return the robot with each input limited to the range of its drive and of its joint's force.

    Servos limit their force instead of their input. The force limits of a joint that several
    drives or tendons act on apply to the sum of their forces; they are left out and noted in
    `left_out`. Raises EomcError if no input has limits.
    """
    on = [q for d in robot.drives for _, q in robot.coordinate_terms(d.coordinate)]
    driven = {m.name: m.driven for m in robot.motions if m.driven != UNLIMITED}
    alone = {d.coordinate for d in robot.drives if on.count(d.coordinate) == 1}
    drives, excluded = [], []
    for d in robot.drives:
        force_range: Range | None = d.force_range
        if d.coordinate in driven and d.coordinate in alone:
            force_range = intersection(d.force_range, input_range(driven[d.coordinate], d.gear))
        if force_range is None:
            excluded.append(d.name)
        elif d.law:
            d = replace(d, law=replace(d.law, force=force_range))
        else:
            d = replace(d, limits=force_range)
        drives.append(d)
    free = [d.name for d in drives if d.limits == d.force_range == UNLIMITED]
    if len(free) == len(drives):
        raise EomcError("--limits: no input of this robot has limits")
    many = len(drives) - len(free)
    notes = [f"limits of drives: {many} of {len(drives)} inputs have them, and act within"]
    notes[0] += f"; without are {texts.listed(free, 4)}" if free else ""
    if shared := sorted(q for q in driven if q in on and q not in alone):
        words = "limits of force on joints that several inputs, or tendons, drive"
        notes.append(f"{words}: {texts.listed(shared)}")
    if excluded:
        notes.append(f"limits of force that exclude those of the input: {texts.listed(excluded)}")
    others = (
        _JOINTS.sub(r"\1, of position and speed", words).replace(_STOPS, "those of speed are notes")
        for words in robot.left_out
        if not _ACTING.match(words)
    )
    return replace(robot, drives=tuple(drives), limited=True, left_out=(*notes, *others))


# --- stops at the limits of joints ----------------------------------------------------------------

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

    def stop(m: JointMotion) -> Stop:
        effort = min(max(map(abs, m.driven)), drive_force.get(m.name, math.inf))
        known = 0 < effort < math.inf
        effort = effort if known else float(f"{holding_effort[m.name]:.3g}") or 1.0
        return Stop(m.name, m.unit, m.limits, effort, known)

    return [
        stop(m)
        for m in robot.motions
        if m.limits[0] < m.limits[1] and all(map(math.isfinite, m.limits))
    ]


def stop_parameters(unit: str) -> tuple[str, str]:
    """Return the names of the scene's parameters for stops: those of their depth and damping.

    `unit` is the unit of the coordinates of these stops, "rad" or "m".
    """
    kind = "slide" if unit == "m" else "turn"
    return f"stop_depth_{kind}", f"stop_damping_{kind}"
