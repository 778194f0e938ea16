"""Conversion of a robot to a scene: names and checks, and the scene as readable TOML text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace

from eomc.base import names, texts
from eomc.base.errors import EomcError
from eomc.base.texts import line, toml
from eomc.robots import actuation
from eomc.robots.formulas import angle, length, less, number, total, vector
from eomc.robots.ineffective_constraints import without_ineffective_constraints
from eomc.robots.inertias import has_nearest, indefinite, unbalanced
from eomc.robots.joint_stops import DAMPING, DEPTHS, Stop, joint_stops
from eomc.robots.masses import inertia_text, parameters
from eomc.robots.massless import light_root, without_inertia
from eomc.robots.robot import (
    BARE,
    Coupling,
    Mimic,
    Motion,
    Robot,
    RobotBody,
    RobotLoop,
    joined,
    without_dust,
)
from eomc.robots.rotations import SNAP, turns_of
from eomc.robots.stiffness import with_stable_steps
from eomc.scene.assembly import WORLD
from eomc.scene.joints import CLOSINGS, JOINTS

MENDED = ", as --mend-inertias writes"
_NAME = 32  # characters of a name, to leave room for suffixes such as "_torque" and "_dot"


def prepared_for_scene(robot: Robot) -> Robot:
    """Return the robot in the form in which it can be written as a scene (the TOML input).

    Its names are valid in a scene, massless frames become points, and constraints without effect
    are removed. Adaptive steps are selected if forces are stiff. Tensors that violate the triangle
    inequality are noted in `left_out`.

    Raises EomcError if no joint moves, if a joint moves no mass or inertia, or if an inertia tensor
    is not positive semi-definite.
    """
    robot = without_ineffective_constraints(robot)
    bodies = tuple(replace(body, inertia=without_dust(body)) for body in robot.bodies)
    robot = _with_points(replace(robot, bodies=bodies))
    if not robot.motions:
        raise EomcError(
            f"{robot.name}: nothing moves in this robot, no joint has a coordinate; with "
            "--base free its root does"
        )
    faults = [
        f"body {b.name}: {why}" + (MENDED if has_nearest(b.inertia) else "")
        for b in robot.bodies
        if (why := indefinite(b.inertia))
    ]
    if faults := [*faults, *without_inertia(robot)]:
        raise EomcError("\n".join(faults))
    robot = _with_scene_names(robot)  # after the errors, which use the names that --lock expects
    notes = tuple(
        f"body {body.name}: {why}{MENDED}; until then the scene is refused"
        for body in robot.bodies
        if (why := unbalanced(body.inertia))
    )
    if light := light_root(robot):
        notes += (
            f"body {light}: it is free and has neither mass nor inertia, so the joint that it "
            "carries moves nothing against it: give it both, or import with --base fixed; until "
            "then the scene is refused",
        )
    rough = [b.name for b in robot.bodies if any(_rough(by) for _, by in turns_of(b.rotation))]
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


def _with_scene_names(robot: Robot) -> Robot:
    """Return the robot with names that are valid in a scene and unique.

    A coordinate also reserves its velocity's name, and a body those of its centre of mass.
    """
    taken = {name for unit in DEPTHS for name in _stop_names(unit)} if robot.stopped else set()

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
        replace(d, name=fit(d.name, "", *actuation.law_names(d)), coordinate=along[d.coordinate])
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


def _mimic_in_scene(motion: Motion, coordinates: Mapping[str, str]) -> Mimic | None:
    """Return the mimic of a joint with the coordinate's name in the scene."""
    mimic = motion.mimics
    return mimic and replace(mimic, coordinate=coordinates[mimic.coordinate])


def _renamed(old: str, new: str, note: str) -> str:
    return note if old == new else joined(f"'{old}' in the file", note)


# --- the text -------------------------------------------------------------------------------------


def scene_text(robot: Robot) -> str:
    """Return the scene of a robot as TOML text, without keys that have their default values.

    Numbers are written exactly, except angles within 1e-10 of a multiple of pi/12. These are
    written as multiples of pi, so that their sines are exact.
    """
    robot = prepared_for_scene(robot)
    head = [f"# {line(robot.title)}"]
    if robot.left_out:
        head += ["#", "# Not modelled, or to be looked at:"]
        head += [each for words in robot.left_out for each in _bullet(words)]
    about = {"eomc": "1", "name": toml(robot.name), "title": toml(robot.title),
             "gravity": vector(robot.gravity)}  # fmt: skip
    parts = [
        "\n".join(head),
        _table("", about),
        _table("[coordinates]", {m.name: _coordinate(m, robot) for m in robot.motions}),
    ]
    stops = joint_stops(robot) if robot.stopped else []
    numbers = parameters(robot) | actuation.gains(robot)
    for unit in (unit for unit in DEPTHS if any(s.unit == unit for s in stops)):
        deep, soft = _stop_names(unit)
        numbers[deep] = _depth(unit)
        numbers[soft] = f'{{ value = {number(DAMPING[unit])}, unit = "s/{unit}" }}'
    tables = {
        "[inputs]": actuation.inputs(robot),
        "[parameters]": numbers,
        "[definitions]": actuation.definitions(robot),
        "[energy]": actuation.energies(robot),
        "[forces]": {s.coordinate: _stop(s) for s in stops},
    }
    parts += [_table(head, entries) for head, entries in tables.items() if entries]
    bodies = sorted(robot.bodies, key=lambda body: body.point)
    parts += [_table(f"[[{'point' if b.point else 'body'}]]", _entry(b, robot)) for b in bodies]
    for motion in robot.motions:
        if motion.stiffness:
            spring = {"coordinate": toml(motion.name), "stiffness": number(motion.stiffness)}
            if motion.rest:
                spring["length"] = length(motion.rest, motion.unit)
            parts.append(_table("[[spring]]", spring))
    parts += [_table("[[loop]]", _loop(loop)) for loop in robot.loops]
    parts += [_table("[[loop]]", _gear(c)) for c in robot.couplings if _is_gear(c)]
    if rows := {c.name: _row(c) for c in robot.couplings if not _is_gear(c)}:
        parts.append(_table("[constraints]", rows))
    if robot.method:
        parts.append(_table("[run]", {"method": toml(robot.method)}))
    return "\n\n".join(parts) + "\n"


def _stop_names(unit: str) -> tuple[str, str]:
    """Return the names of the parameters of stops of this unit: depth and damping."""
    kind = "slide" if unit == "m" else "turn"
    return f"stop_depth_{kind}", f"stop_damping_{kind}"


def _depth(unit: str) -> str:
    note = "how deep a joint's effort pushes it into its stop"
    return f"{{ value = {number(DEPTHS[unit])}, unit = {toml(unit)}, note = {toml(note)} }}"


def _stop(s: Stop) -> str:
    """Return the formula of a stop's force, described in `joint_stops`."""
    deep, soft = _stop_names(s.unit)
    q, (low, high) = s.coordinate, (length(x, s.unit).strip('"') for x in s.limits)
    before = f"max(0, {low} - {q})*max(0, 1 - {soft}*{q}_dot)"
    beyond = f"max(0, {q} - {high})*max(0, 1 + {soft}*{q}_dot)".replace("- -", "+ ")
    return toml(f"{number(s.effort)}/{deep}*({before} - {beyond})")


def _loop(loop: RobotLoop) -> dict[str, str]:
    """Return the keys of a [[loop]] between bodies."""
    entry = {
        "name": toml(loop.name),
        "joint": toml(loop.joint),
        "bodies": _each([toml(body) for body in loop.bodies]),
        "points": _each([vector(point) for point in loop.points]),
    }
    if turns := turns_of(loop.rotation):
        entry["rotation"] = _turns(turns)
    return entry


def _is_gear(c: Coupling) -> bool:
    """Return whether one coordinate is a multiple of another plus a constant."""
    single = [by for by, _ in (*c.first, *c.second)] == [1.0, 1.0] and len(c.first) == 1
    return single and c.polynomial[1] != 0 and not any(c.polynomial[2:])


def _gear(c: Coupling) -> dict[str, str]:
    """Return the keys of a gear."""
    (_, driven), (_, driving) = c.first[0], c.second[0]
    ratio = c.polynomial[1]
    offset = c.zero + c.polynomial[0] - ratio * c.at
    entry = {
        "name": toml(c.name),
        "joint": toml("gear"),
        "coordinates": _each([toml(driving), toml(driven)]),
        "ratio": number(ratio),
    }
    return {**entry, "offset": number(offset)} if offset else entry


def _row(c: Coupling) -> str:
    """Return a coupling as an entry of [constraints]."""
    second = less(total(c.second), c.at)
    second = second if second.isidentifier() else f"({second})"
    powers = [f"{number(a)}*{second}**{k}" for k, a in enumerate(c.polynomial) if a and k]
    terms = [number(c.polynomial[0])] * bool(c.polynomial[0]) + powers
    right = " + ".join(terms).replace("**1", "").replace("+ -", "- ")
    text = less(total(c.first), c.zero) + (f" - ({right})" if right else "")
    unit = f", unit = {toml(c.unit)}" if c.unit else ""
    return f"{{ formula = {toml(text)}{unit} }}"


def _coordinate(m: Motion, robot: Robot) -> str:
    start = f", start = {length(m.start, m.unit)}" if m.start else ""
    note = f", note = {toml(m.note)}" if m.note else ""
    guess = ", guess = true" if robot.loops or robot.couplings else ""
    return f"{{ unit = {toml(m.unit)}{start}{guess}{note} }}"


def _entry(body: RobotBody, robot: Robot) -> dict[str, str]:
    """Return the keys of a [[body]] or [[point]] that differ from their defaults."""
    entry = {"name": toml(body.name)}
    if body.point:
        entry["body"] = toml(body.parent)
    else:
        if body.parent != WORLD:
            entry["parent"] = toml(body.parent)
        entry["joint"] = toml(body.joint)
    if body.motions:
        entry["coordinates"] = _each([toml(_moved_by(m)) for m in body.motions])
    if any(body.offset):
        entry["place" if body.point else "offset"] = vector(body.offset)
    if turns := turns_of(body.rotation):
        entry["rotation"] = _turns(turns)
    if body.axes and body.axes != JOINTS[body.joint].defaults:
        entry["axis"] = _each([vector(axis) for axis in body.axes])
    if body.mass or body.parameter:
        entry["mass"] = toml(body.parameter) if body.parameter else number(body.mass)
    if any(body.center):
        entry["center"] = vector(body.center)
    if any(body.inertia):
        entry["inertia"] = inertia_text(body)
    for key in ("armature", "damping", "friction"):
        values = [number(getattr(m, key)) for m in body.motions]
        if any(value != "0" for value in values):
            entry[key] = values[0] if len(set(values)) == 1 else _each(values)
    if width := max((m.friction_width for m in body.motions), default=0.0):
        entry["friction_width"] = number(width)
    forces = [actuation.force(m.name, robot) for m in body.motions]
    if any(force != "0" for force in forces):
        entry["actuator"] = _each([f if f == "0" else toml(f) for f in forces])
    if body.note:
        entry["note"] = toml(body.note)
    return entry


def _turns(turns: Sequence[tuple[str, float]]) -> str:
    shown = (f'["{axis}", {angle(by)}]' for axis, by in turns)
    return f"[{', '.join(shown)}]"


def _moved_by(m: Motion) -> str:
    """Return the coordinate of a joint, or the formula of its position if it mimics another."""
    if not m.mimics:
        return m.name
    gear, shift = number(m.mimics.gear), length(m.mimics.shift, m.unit).strip('"')
    factor = {"1": "", "-1": "-"}.get(gear, f"{gear}*")
    return f"{factor}{m.mimics.coordinate}" + (f" + {shift}" if shift != "0" else "").replace(
        "+ -", "- "
    )


def _each(those: Sequence[str]) -> str:
    return those[0] if len(those) == 1 else f"[{', '.join(those)}]"


def _table(head: str, entries: Mapping[str, str]) -> str:
    wide = max(map(len, entries))
    return "\n".join([head] * bool(head) + [f"{k:{wide}} = {v}" for k, v in entries.items()])


def _bullet(words: str) -> list[str]:
    return textwrap.wrap(
        line(words), 98, initial_indent="# - ", subsequent_indent="#   ",
        break_on_hyphens=False,
    )  # fmt: skip
