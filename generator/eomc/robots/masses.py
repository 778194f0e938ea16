"""Masses of a robot as parameters of its scene, and payloads at its tips."""

from __future__ import annotations

from dataclasses import replace

from eomc.base.texts import toml
from eomc.robots.formulas import number
from eomc.robots.robot import Robot, RobotBody
from eomc.scene.assembly import WORLD


def with_masses(robot: Robot, tip: str = "") -> Robot:
    """Return the robot with its moving masses as parameters, and a payload of 0 kg at its tips.

    With the name of a body as `tip`, only that body gets a payload. Otherwise each moving group of
    rigidly connected bodies that carries no further joint gets one, on its outermost body.
    """
    group, _ = _groups(robot)
    bodies = [
        replace(b, parameter=f"mass_{b.name}") if b.mass and group[b.name] != WORLD else b
        for b in robot.bodies
    ]
    taken = {b.name for b in bodies}
    tips = [tip] if tip else _tips(robot)
    for name in tips:
        end = f"_{name}" if len(tips) > 1 else ""
        load = f"load{end}"
        while load in taken:
            load += "_"
        note = f"a point mass in the origin of the frame of {name}"
        body = RobotBody(load, name, note=note, parameter=f"payload{end}")
        at = 1 + next(k for k, b in enumerate(bodies) if b.name == name)
        bodies.insert(at, body)
    return replace(robot, bodies=tuple(bodies))


def _groups(robot: Robot) -> tuple[dict[str, str], dict[str, int]]:
    """Return, for each body, the one whose joint moves it, and the fixed joints in between."""
    group, depth = {WORLD: WORLD}, {WORLD: 0}
    for b in robot.bodies:
        moves = b.joint != "fixed"
        group[b.name] = b.name if moves else group[b.parent]
        depth[b.name] = 0 if moves else depth[b.parent] + 1
    return group, depth


def _tips(robot: Robot) -> list[str]:
    """Return the deepest body, the last of several, of each rigid group at an end of the tree."""
    group, depth = _groups(robot)
    carries = {WORLD, *(group[b.parent] for b in robot.bodies if b.joint != "fixed")}
    tips: dict[str, str] = {}
    for b in robot.bodies:
        of = group[b.name]
        if of not in carries and depth[b.name] >= depth[tips.get(of, of)]:
            tips[of] = b.name
    return [*tips.values()]


def parameters(robot: Robot) -> dict[str, str]:
    """Return the entries of the scene's table [parameters] for masses and payloads.

    They map the name of each mass parameter to its TOML text.
    """
    entries = {}
    for b in robot.bodies:
        if b.parameter:
            note = "" if b.mass else f", note = {toml(f'payload at {b.parent}')}"
            entries[b.parameter] = f'{{ value = {number(b.mass)}, unit = "kg"{note} }}'
    return entries


def inertia_text(body: RobotBody) -> str:
    """Return the TOML text of a body's inertia tensor about its centre of mass.

    If the mass is a parameter of the scene, the entries are formulas proportional to it.
    """
    tensor_entries = body.inertia if any(body.inertia[3:]) else body.inertia[:3]
    if not body.parameter:
        return f"[{', '.join(map(number, tensor_entries))}]"
    entries = []
    for k, entry in enumerate(tensor_entries):
        rotor = body.rotor if k < 3 else 0.0
        own = entry - rotor
        text = f"{number(own)}*{body.parameter}/{number(body.mass)}" if own else ""
        text = f"{number(rotor)} + {text}" if text and rotor else text or number(rotor)
        entries.append(toml(text) if own else text)
    return f"[{', '.join(entries)}]"
