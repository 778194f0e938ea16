"""Joints of a robot file that move no mass or inertia, so that D would be singular."""

from __future__ import annotations

from eomc.base import texts
from eomc.robots.robot import Robot, RobotBody
from eomc.scene.assembly import WORLD
from eomc.scene.joints import JOINTS


def without_inertia(robot: Robot) -> list[str]:
    """Return messages on the joints that move no mass or inertia.

    There is one message for each such joint; one last message proposes a remedy for all of them.
    The list is empty if there is no such joint.
    """
    faults: dict[str, str] = {}  # by coordinate
    locks: dict[str, str] = {}
    resisted: set[str] = set()
    carries: dict[str, list[RobotBody]] = {}
    for body in reversed(robot.bodies):  # children come before parents
        mine = [body, *carries.get(body.name, ())]
        carries[body.parent] = [*mine, *carries.get(body.parent, ())]
        kinds = JOINTS[body.joint].motions
        for kind, motion in zip(kinds, body.motions, strict=True):
            has = any(b.mass or (kind == "r" and any(b.inertia)) for b in mine)
            if has or motion.armature:
                resisted.add(motion.mimics.coordinate if motion.mimics else motion.name)
            if has or motion.armature or motion.mimics:
                continue
            those = texts.listed([b.name + (f" ({b.note})" if b.note else "") for b in mine], 4)
            lacks = "mass" if kind == "t" else "inertia"
            faults[motion.name] = (
                f"joint {motion.name}: it moves nothing that has {lacks}, only {those}"
            )
            if len(body.motions) == 1:
                locks[motion.name] = f"--lock {motion.name}=0"
    names = [name for name in reversed(faults) if name not in resisted]
    if not names:
        return []
    freeze = " ".join(locks[name] for name in names if name in locks)
    freeze = f", or freeze what moves nothing: {freeze}" if freeze else ""
    return [*(faults[name] for name in names), f"add mass and inertia to the file{freeze}"]


def light_root(robot: Robot) -> str:
    """Return the name of a free body without mass that carries exactly one joint.

    Returns "" if there is none. Bodies fixed to the free body count as part of it. Such a body
    cannot resist the motion of the joint that it carries.
    """
    for root in (b for b in robot.bodies if b.joint == "free" and b.parent == WORLD):
        mine, joints = {root.name}, list[RobotBody]()
        for body in robot.bodies:
            if body.parent in mine and body.motions:
                joints.append(body)
            elif body.parent in mine:
                mine.add(body.name)
        heavy = any(b.name in mine and (b.mass or any(b.inertia)) for b in robot.bodies)
        if not heavy and len(joints) == 1 and not any(m.armature for m in joints[0].motions):
            return root.name
    return ""
