"""Preparation of a robot for its scene: valid names, points, and checks of what can move."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from eomc.base import names, texts
from eomc.base.errors import EomcError
from eomc.base.spatial import plus, scaled
from eomc.robots.inertias import has_nearest_valid, indefinite_message, triangle_message
from eomc.robots.limits import DEPTHS, stop_parameters
from eomc.robots.robot import (
    BARE,
    JointMotion,
    Mimic,
    Robot,
    RobotBody,
    RobotLoop,
    join_notes,
    significant_inertia,
)
from eomc.robots.rotations import SNAP, axis_rotations
from eomc.robots.stiffness import coupling_gradient, loop_jacobian, rigid_bodies, with_stable_steps
from eomc.scene.assembly import WORLD
from eomc.scene.joints import CLOSINGS, JOINTS

MENDED = ", as --mend-inertias writes"
_NAME = 32  # characters of a name, to leave room for suffixes such as "_torque" and "_dot"
LAW_SUFFIXES = "_force", "_kp", "_kv"  # of a drive's name: the force and gains of its control law
STATE_COUNT = 3  # random states at which the Jacobian is evaluated
ZERO_TOLERANCE = 1e-10  # of an entry of the Jacobian, relative to the bodies' distances
GAP_TOLERANCE = 1e-6  # m: a larger gap is reported


def prepare_for_scene(robot: Robot) -> Robot:
    """Return the robot in the form in which it can be written as a scene (the TOML input).

    Its names are valid in a scene, massless frames become points, and constraints without effect
    are removed. Adaptive steps are selected if forces are stiff. Tensors that violate the triangle
    inequality are noted in `left_out`.

    Raises EomcError if no joint moves, if a joint moves no mass or inertia, or if an inertia tensor
    is not positive semi-definite.
    """
    robot = without_ineffective_constraints(robot)
    bodies = tuple(replace(body, inertia=significant_inertia(body)) for body in robot.bodies)
    robot = _with_points(replace(robot, bodies=bodies))
    if not robot.motions:
        raise EomcError(
            f"{robot.name}: nothing moves in this robot, no joint has a coordinate; with "
            "--base free its root does"
        )
    faults = [
        f"body {b.name}: {why}" + (MENDED if has_nearest_valid(b.inertia) else "")
        for b in robot.bodies
        if (why := indefinite_message(b.inertia))
    ]
    if faults := [*faults, *massless_joint_messages(robot)]:
        raise EomcError("\n".join(faults))
    robot = _with_scene_names(robot)  # after the errors, which use the names that --lock expects
    notes = tuple(
        f"body {body.name}: {why}{MENDED}; until then the scene is refused"
        for body in robot.bodies
        if (why := triangle_message(body.inertia))
    )
    if light := massless_free_root(robot):
        notes += (
            f"body {light}: it is free and has neither mass nor inertia, so the joint that it "
            "carries moves nothing against it: give it both, or import with --base fixed; until "
            "then the scene is refused",
        )
    rough = [
        b.name for b in robot.bodies if any(_rough(by) for _, by in axis_rotations(b.rotation))
    ]
    if rough:
        notes += (
            "quarter turns to five digits or so, as 1.5708, which are kept as they are ("
            f'{texts.listed(rough, 4)}): "pi/2" in their place makes less code',
        )
    new = tuple(words for words in notes if words not in robot.left_out)
    return with_stable_steps(replace(robot, left_out=(*robot.left_out, *new)))


def _rough(angle: float) -> bool:
    """Return whether an angle is close, but not equal, to a multiple of pi/2."""
    return SNAP < abs(angle - round(angle * 2 / math.pi) * math.pi / 2) < 1e-4


def _with_points(robot: Robot) -> Robot:
    """Return the robot with fixed, massless bodies that carry no other body as points."""
    bodies: list[RobotBody] = []
    parents: set[str] = set()
    for body in reversed(robot.bodies):  # children come before parents
        bare = not body.mass and not any(body.inertia) and not body.parameter
        point = body.joint == "fixed" and bare and body.name not in parents
        note = "" if point and body.note == BARE else body.note
        bodies.append(replace(body, point=point, note=note))
        if not point:
            parents.add(body.parent)
    return replace(robot, bodies=tuple(bodies[::-1]))


# --- names ----------------------------------------------------------------------------------------


def _with_scene_names(robot: Robot) -> Robot:
    """Return the robot with names that are valid in a scene and unique.

    A coordinate also reserves its velocity's name, and a body those of its centre of mass.
    """
    taken = {name for unit in DEPTHS for name in stop_parameters(unit)} if robot.stopped else set()

    def fit(name: str, *ends: str) -> str:
        plain = names.plain(name)[:_NAME].rstrip("_")
        k = 1
        while True:
            new = plain if k == 1 else f"{plain}_{k}"
            mine = {new + end for end in ends}
            if not names.fault(new) and not mine & taken:
                taken.update(mine)
                return new
            k += 1

    coordinates = {m.name: fit(m.name, "", "_dot") for m in robot.motions}
    lengths = {t.name: fit(t.name, "") for t in robot.tendons}
    tendons = tuple(
        replace(t, name=lengths[t.name], terms=tuple((by, coordinates[q]) for by, q in t.terms))
        for t in robot.tendons
    )
    along = coordinates | lengths
    drives = tuple(
        replace(
            d, name=fit(d.name, "", *LAW_SUFFIXES * bool(d.law)), coordinate=along[d.coordinate]
        )
        for d in robot.drives
    )
    bodies = {WORLD: WORLD}
    out = []
    for body in robot.bodies:
        name = fit(body.name, "", "_x", "_y", "_z")
        if name == WORLD:
            name = fit("world_body", "", "_x", "_y", "_z")
        bodies[body.name] = name
        motions = tuple(
            replace(m, name=new, note=_renamed(m.name, new, m.note))
            if (new := coordinates.get(m.name, ""))
            else replace(m, mimics=_mimic_in_scene(m, coordinates))
            for m in body.motions
        )
        note = _renamed(body.name, name, body.note)
        parameter = fit(body.parameter, "") if body.parameter else ""
        out.append(
            replace(
                body, name=name, parent=bodies[body.parent], motions=motions, note=note,
                parameter=parameter,
            )
        )  # fmt: skip
    rows = [f"_{kind}" for joint in CLOSINGS.values() for kind in joint.space]
    loops = tuple(
        replace(loop, name=fit(loop.name, "", *rows), bodies=(bodies[one], bodies[other]))
        for loop in robot.loops
        for one, other in [loop.bodies]
    )
    couplings = tuple(
        replace(
            c,
            name=fit(c.name, ""),
            first=tuple((by, coordinates[q]) for by, q in c.first),
            second=tuple((by, coordinates[q]) for by, q in c.second),
        )
        for c in robot.couplings
    )
    name = names.plain(robot.name)[:_NAME].rstrip("_")
    if names.module_fault(name):
        name += "_robot"
    return replace(
        robot, name=name, bodies=tuple(out), drives=drives, tendons=tendons, loops=loops,
        couplings=couplings,
    )  # fmt: skip


def _mimic_in_scene(motion: JointMotion, coordinates: Mapping[str, str]) -> Mimic | None:
    """Return the mimic of a joint with the coordinate's name in the scene."""
    mimic = motion.mimics
    return mimic and replace(mimic, coordinate=coordinates[mimic.coordinate])


def _renamed(old: str, new: str, note: str) -> str:
    return note if old == new else join_notes(f"'{old}' in the file", note)


# --- constraints without effect -------------------------------------------------------------------


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


# --- motions without inertia ----------------------------------------------------------------------


def massless_joint_messages(robot: Robot) -> list[str]:
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


def massless_free_root(robot: Robot) -> str:
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
