"""Options of `eomc import`: lock joints, cut out a part, change the base, correct inertias."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.base.spatial import apply, plus
from eomc.robots.inertias import (
    entries_text,
    has_nearest_valid,
    indefinite_message,
    nearest_valid,
    principal_moments,
    triangle_message,
)
from eomc.robots.limits import joint_stops
from eomc.robots.robot import (
    COUPLING_TOLERANCE,
    Robot,
    RobotBody,
    body_pose,
    fix_body,
    free_motions,
    join_notes,
    significant_inertia,
    with_joints_fixed,
)
from eomc.robots.rotations import IDENTITY, ORIGIN, Matrix, Vector, times, yaw_pitch_roll
from eomc.scene.assembly import WORLD
from eomc.scene.formulas import suggest

_LIMITS = re.compile(r"limits of (\d+ )?joints?\b")  # in what readers leave out


def lock(robot: Robot, values: Mapping[str, float]) -> Robot:
    """Return the robot with joints fixed at given positions.

    `values` maps the name of a coordinate to its value (rad or m). Raises EomcError for unknown
    coordinates, and for those of a joint that has several.
    """
    owners = {m.name: body for body in robot.bodies for m in body.motions}
    for name in values:
        if name not in owners:
            raise EomcError(
                f"--lock {name}: no joint that moves is called '{name}'"
                + (suggest(name, owners) or f"; there are {texts.listed(tuple(owners))}")
            )
        body = owners[name]
        if len(body.motions) > 1:
            those = ", ".join(m.name for m in body.motions)
            raise EomcError(
                f"--lock {name}: the {body.joint} joint of '{body.name}' moves by {those} "
                "together: only a joint with one coordinate can be frozen"
            )
        mimics = body.motions[0].mimics
        if mimics and mimics.coordinate not in values:
            raise EomcError(
                f"--lock {name}: it moves as '{mimics.coordinate}' does: lock that, and both are "
                "frozen"
            )
        if (
            mimics
            and abs(mimics.joint_position(values[mimics.coordinate]) - values[name])
            > COUPLING_TOLERANCE
        ):
            raise EomcError(
                f"--lock {name}: it moves as '{mimics.coordinate}' does, which puts it at "
                f"{mimics.joint_position(values[mimics.coordinate]):g} "
                f"{body.motions[0].unit}: lock it there"
            )
    bodies = []
    for body in robot.bodies:
        motion = body.motions[0] if body.motions else None
        if motion and motion.name in values:
            value = values[motion.name]
            note = join_notes(body.note, f"joint {motion.name} locked at {value!r} {motion.unit}")
            body = replace(fix_body(body, *body_pose(body, (value,))), note=note)
        bodies.append(body)
    for c in robot.couplings:
        if (
            c.coordinates <= values.keys()
            and abs(violation := c.residual(values)) > COUPLING_TOLERANCE
        ):
            those = " ".join(f"--lock {q}={values[q]:g}" for q in sorted(c.coordinates))
            raise EomcError(
                f"{those}: these values break the coupling {c.name} by {violation:g}: lock one "
                "of the joints only, and the coupling fixes the other, or give values that agree"
            )
    return with_joints_fixed(replace(robot, bodies=tuple(bodies)), values)


def with_joint_stops(robot: Robot) -> Robot:
    """Return the robot with stops (stiff springs) at its joint limits.

    Raises EomcError if no joint has limits.
    """
    stops = joint_stops(robot)
    if not stops:
        raise EomcError("--stops: no joint of this robot has limits")
    notes = [
        "stops: at limits of positions [forces] pushes back; those of speed and effort are notes"
    ]
    estimated = [s for s in stops if not s.known]
    if estimated:
        newton = {"rad": "N m", "m": "N"}
        those = texts.listed([f"{s.coordinate} ({s.effort:g} {newton[s.unit]})" for s in estimated])
        notes.append(f"stops whose effort is not known, and is taken from weights: {those}")
    other_notes = (words for words in robot.left_out if not _LIMITS.match(words))
    return replace(robot, stopped=True, left_out=(*notes, *other_notes))


def cut(robot: Robot, root: str = "", tip: str = "") -> Robot:
    """Return a part of the robot: the bodies carried by `root`, or the chain from `root` to `tip`.

    Without `root`, the chain begins at the world. The root is fixed to the world in its pose at the
    start, so that the direction of gravity relative to it is unchanged. Bodies fixed to a body of
    the chain are retained, except those carried by the tip.

    Raises EomcError for unknown bodies, and if `tip` is not carried by `root`.
    """
    by_name = {body.name: body for body in robot.bodies}
    for option, name in (("--root", root), ("--tip", tip)):
        if name and name not in by_name:
            raise EomcError(
                f"{option} {name}: no body is called '{name}'"
                + (suggest(name, by_name) or f"; there are {texts.listed(tuple(by_name))}")
            )
    selected = set(by_name)
    if root:
        selected = {root}
        for body in robot.bodies:
            if body.parent in selected:
                selected.add(body.name)
    if tip:
        if tip not in selected:
            raise EomcError(f"--tip {tip}: '{tip}' is not behind '{root}', which --root names")
        way = [tip]
        while (parent := by_name[way[-1]].parent) in selected:
            way.append(parent)
        selected = set(way)
        for body in robot.bodies:
            if body.joint == "fixed" and body.parent in selected and body.parent != tip:
                selected.add(body.name)
    bodies = [body for body in robot.bodies if body.name in selected]
    for k, body in enumerate(bodies):
        if body.name == root and body.parent != WORLD:
            bodies[k] = replace(fix_body(body, *_pose_in_world(by_name, body)), parent=WORLD)
    removed = tuple(name for name in by_name if name not in selected)
    left_out = ((f"cut off: {texts.listed(removed)}",) if removed else ()) + robot.left_out
    frozen: dict[str, float] = {}  # the joints between the world and the root, at their start
    above = by_name[root] if root and by_name[root].parent != WORLD else None
    while above:
        frozen |= {m.name: m.start for m in above.motions if not m.mimics}
        above = by_name.get(above.parent)
    return with_joints_fixed(replace(robot, bodies=tuple(bodies), left_out=left_out), frozen)


def with_nearest_inertias(robot: Robot) -> Robot:
    """Return the robot with each invalid inertia tensor replaced by the nearest valid one.

    A tensor is invalid if no body can have it. The replacements are noted in `left_out`.
    """
    bodies, words = [], []
    for body in robot.bodies:
        inertia = significant_inertia(body)
        if (indefinite_message(inertia) or triangle_message(inertia)) and has_nearest_valid(
            inertia
        ):
            (low, _, high), new = principal_moments(inertia)[0], nearest_valid(inertia)
            words.append(
                f"body {body.name}: its inertia {entries_text(inertia)} is that of no body "
                f"(principal moments {low:.4g} to {high:.4g} kg m^2): "
                f"{entries_text(new)} is in its place"
            )
            body = replace(body, inertia=new)
        bodies.append(body)
    return replace(robot, bodies=tuple(bodies), left_out=(*robot.left_out, *words))


def with_base(robot: Robot, free: bool) -> Robot:
    """Return the robot with its root body either free to move or fixed to the world.

    `free` selects which. A root body that becomes fixed keeps its pose at the start. One that
    becomes free starts in the pose in which it was fixed. Raises EomcError if several bodies are
    attached to the world.
    """
    roots = [body for body in robot.bodies if body.parent == WORLD]
    if len(roots) != 1:
        those = texts.listed(tuple(body.name for body in roots))
        raise EomcError(f"--base: {len(roots)} bodies stand on the world ({those}), not one")
    root = roots[0]
    root_body = root
    if free and root.joint == "fixed":
        names = {m.name for m in robot.motions}
        motions = free_motions()
        if names & {m.name for m in motions}:
            motions = free_motions("base")
        at = (*root.offset, *yaw_pitch_roll(root.rotation))
        motions = tuple(replace(m, start=s) for m, s in zip(motions, at, strict=True))
        root_body = replace(fix_body(root, ORIGIN, IDENTITY), joint="free", motions=motions)
    elif not free and root.motions:
        root_body = fix_body(root, *_at_start(root))
    if free and root_body.joint != "free":
        raise EomcError(
            f"--base free: '{root.name}' stands on the world by a {root.joint} joint, "
            "which the file gives it: --base free is for a root without one"
        )
    bodies = tuple(root_body if body is root else body for body in robot.bodies)
    frozen = {} if free else {m.name: m.start for m in root.motions}
    return with_joints_fixed(replace(robot, bodies=bodies), frozen)


def _at_start(body: RobotBody) -> tuple[Vector, Matrix]:
    return body_pose(body, [m.start for m in body.motions])


def _pose_in_world(by_name: Mapping[str, RobotBody], body: RobotBody) -> tuple[Vector, Matrix]:
    """Return the pose of the body's frame in the world at the start."""
    offset, rotation = _at_start(body)
    while body.parent != WORLD:
        body = by_name[body.parent]
        o, r = _at_start(body)
        offset, rotation = plus(o, apply(r, offset)), times(r, rotation)
    return offset, rotation


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
