"""What a user asks for of a robot: joints locked, parts cut, another base, inertias mended."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.base.spatial import apply, plus
from eomc.robots.inertias import has_nearest, indefinite, nearest, principal, shown, unbalanced
from eomc.robots.joint_stops import joint_stops
from eomc.robots.robot import (
    LACK,
    Robot,
    RobotBody,
    fixed,
    free_motions,
    joined,
    moved,
    settled,
    without_dust,
)
from eomc.robots.rotations import IDENTITY, ORIGIN, Matrix, Vector, times, yaw_pitch_roll
from eomc.scene.assembly import WORLD
from eomc.scene.formulas import suggest

_LIMITS = re.compile(r"limits of (\d+ )?joints?\b")  # in what readers leave out


def lock(robot: Robot, values: Mapping[str, float]) -> Robot:
    """The robot with joints frozen: coordinate -> value (rad or m).

    Raises EomcError for what is not a coordinate, and for one of a joint that has several.
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
        if mimics and abs(mimics.at(values[mimics.coordinate]) - values[name]) > LACK:
            raise EomcError(
                f"--lock {name}: it moves as '{mimics.coordinate}' does, which puts it at "
                f"{mimics.at(values[mimics.coordinate]):g} {body.motions[0].unit}: lock it there"
            )
    bodies = []
    for body in robot.bodies:
        motion = body.motions[0] if body.motions else None
        if motion and motion.name in values:
            value = values[motion.name]
            note = joined(body.note, f"joint {motion.name} locked at {value!r} {motion.unit}")
            body = replace(fixed(body, *moved(body, (value,))), note=note)
        bodies.append(body)
    for c in robot.couplings:
        if c.coordinates <= values.keys() and abs(lack := c.excess(values)) > LACK:
            those = " ".join(f"--lock {q}={values[q]:g}" for q in sorted(c.coordinates))
            raise EomcError(
                f"{those}: these values break the coupling {c.name} by {lack:g}: lock one of the "
                "joints only, and the coupling fixes the other, or give values that agree"
            )
    return settled(replace(robot, bodies=tuple(bodies)), values)


def stopped(robot: Robot) -> Robot:
    """The robot with stops where its joints have limits. Raises EomcError where none has."""
    found = joint_stops(robot)
    if not found:
        raise EomcError("--stops: no joint of this robot has limits")
    told = [
        "stops: at limits of positions [forces] pushes back; those of speed and effort are notes"
    ]
    weighed = [s for s in found if not s.known]
    if weighed:
        newton = {"rad": "N m", "m": "N"}
        those = texts.listed([f"{s.coordinate} ({s.effort:g} {newton[s.unit]})" for s in weighed])
        told.append(f"stops whose effort is not known, and is taken from weights: {those}")
    others = (words for words in robot.left_out if not _LIMITS.match(words))
    return replace(robot, stopped=True, left_out=(*told, *others))


def cut(robot: Robot, root: str = "", tip: str = "") -> Robot:
    """The bodies from `root` on, or those on the way from there to `tip`.

    The root is fixed to the world where it stands while all coordinates have their start values,
    so that gravity pulls as it did. What is fixed to a body on the way to the tip stays with it;
    what the tip carries does not. Raises EomcError for unknown bodies and a tip not behind the
    root.
    """
    by_name = {body.name: body for body in robot.bodies}
    for option, name in (("--root", root), ("--tip", tip)):
        if name and name not in by_name:
            raise EomcError(
                f"{option} {name}: no body is called '{name}'"
                + (suggest(name, by_name) or f"; there are {texts.listed(tuple(by_name))}")
            )
    kept = set(by_name)
    if root:
        kept = {root}
        for body in robot.bodies:
            if body.parent in kept:
                kept.add(body.name)
    if tip:
        if tip not in kept:
            raise EomcError(f"--tip {tip}: '{tip}' is not behind '{root}', which --root names")
        way = [tip]
        while (parent := by_name[way[-1]].parent) in kept:
            way.append(parent)
        kept = set(way)
        for body in robot.bodies:
            if body.joint == "fixed" and body.parent in kept and body.parent != tip:
                kept.add(body.name)
    bodies = [body for body in robot.bodies if body.name in kept]
    for k, body in enumerate(bodies):
        if body.name == root and body.parent != WORLD:
            bodies[k] = replace(fixed(body, *_stands(by_name, body)), parent=WORLD)
    gone = tuple(name for name in by_name if name not in kept)
    left_out = ((f"cut off: {texts.listed(gone)}",) if gone else ()) + robot.left_out
    frozen: dict[str, float] = {}  # the joints that hold the root, at their start
    above = by_name[root] if root and by_name[root].parent != WORLD else None
    while above:
        frozen |= {m.name: m.start for m in above.motions if not m.mimics}
        above = by_name.get(above.parent)
    return settled(replace(robot, bodies=tuple(bodies), left_out=left_out), frozen)


def mended(robot: Robot) -> Robot:
    """The robot with the nearest tensor in place of each that no body can have, noted."""
    bodies, words = [], []
    for body in robot.bodies:
        inertia = without_dust(body)
        if (indefinite(inertia) or unbalanced(inertia)) and has_nearest(inertia):
            (low, _, high), new = principal(inertia)[0], nearest(inertia)
            words.append(
                f"body {body.name}: its inertia {shown(inertia)} is that of no body (principal "
                f"moments {low:.4g} to {high:.4g} kg m^2): {shown(new)} is in its place"
            )
            body = replace(body, inertia=new)
        bodies.append(body)
    return replace(robot, bodies=tuple(bodies), left_out=(*robot.left_out, *words))


def based(robot: Robot, free: bool) -> Robot:
    """The robot with its first body free, or fixed to the world where it starts.

    A free one starts where it was fixed. Raises EomcError where several bodies stand on the world.
    """
    roots = [body for body in robot.bodies if body.parent == WORLD]
    if len(roots) != 1:
        those = texts.listed(tuple(body.name for body in roots))
        raise EomcError(f"--base: {len(roots)} bodies stand on the world ({those}), not one")
    root = roots[0]
    new = root
    if free and root.joint == "fixed":
        taken = {m.name for m in robot.motions}
        motions = free_motions()
        if taken & {m.name for m in motions}:
            motions = free_motions("base")
        at = (*root.offset, *yaw_pitch_roll(root.rotation))
        motions = tuple(replace(m, start=s) for m, s in zip(motions, at, strict=True))
        new = replace(fixed(root, ORIGIN, IDENTITY), joint="free", motions=motions)
    elif not free and root.motions:
        new = fixed(root, *_at_start(root))
    if free and new.joint != "free":
        raise EomcError(
            f"--base free: '{root.name}' stands on the world by a {root.joint} joint, "
            "which the file gives it: --base free is for a root without one"
        )
    bodies = tuple(new if body is root else body for body in robot.bodies)
    frozen = {} if free else {m.name: m.start for m in root.motions}
    return settled(replace(robot, bodies=bodies), frozen)


def _at_start(body: RobotBody) -> tuple[Vector, Matrix]:
    return moved(body, [m.start for m in body.motions])


def _stands(by_name: Mapping[str, RobotBody], body: RobotBody) -> tuple[Vector, Matrix]:
    """Where the body's frame stands in the world at the start."""
    offset, rotation = _at_start(body)
    while body.parent != WORLD:
        body = by_name[body.parent]
        o, r = _at_start(body)
        offset, rotation = plus(o, apply(r, offset)), times(r, rotation)
    return offset, rotation
