"""Limits of drives in robot files as limits of the scene's inputs, each in its input's unit."""

from __future__ import annotations

import re
from dataclasses import replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.robots.robot import UNLIMITED, Range, Robot

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
        force_range: Range | None = d.ends
        if d.coordinate in driven and d.coordinate in alone:
            force_range = intersection(d.ends, input_range(driven[d.coordinate], d.gear))
        if force_range is None:
            excluded.append(d.name)
        elif d.law:
            d = replace(d, law=replace(d.law, force=force_range))
        else:
            d = replace(d, limits=force_range)
        drives.append(d)
    free = [d.name for d in drives if d.limits == d.ends == UNLIMITED]
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
