"""The scene of a robot as readable TOML text, with valid names, after checks of what can move."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eomc.base import names, texts
from eomc.base.errors import EomcError
from eomc.base.spatial import plus, scaled
from eomc.base.texts import line, toml
from eomc.robots.edit import DAMPING, DEPTHS, Stop, joint_stops, stop_parameters
from eomc.robots.geometry import (
    SNAP,
    Matrix,
    axis_rotations,
    has_nearest_valid,
    indefinite_message,
    triangle_message,
)
from eomc.robots.robot import (
    BARE,
    UNLIMITED,
    Coupling,
    Drive,
    JointMotion,
    Law,
    Mimic,
    Robot,
    RobotBody,
    RobotLoop,
    Tendon,
    join_notes,
    significant_inertia,
)
from eomc.robots.stiffness import coupling_gradient, loop_jacobian, rigid_bodies, with_stable_steps
from eomc.runtime import rank
from eomc.scene.formulas import MAX_DEPTH
from eomc.scene.joints import CLOSINGS, JOINTS
from eomc.scene.scene import WORLD

Entry = dict[str, Any]  # keys and values of a table
_FORCES = {"rad": "N m", "m": "N"}  # by a coordinate's unit
_MAX_TERMS = MAX_DEPTH // 3  # of one sum: each term nests the formula deeper


def scene_text(robot: Robot) -> str:
    """Return the scene of a robot as TOML text, without keys that have their default values.

    Numbers are written exactly, except angles within 1e-10 of a multiple of pi/12. These are
    written as multiples of pi, so that their sines are exact.
    """
    robot = prepare_for_scene(robot)
    head = [f"# {line(robot.title)}"]
    if robot.left_out:
        head += ["#", "# Not modelled, or to be looked at:"]
        head += [each for words in robot.left_out for each in _bullet(words)]
    about = {"eomc": 1, "name": robot.name, "title": robot.title, "gravity": robot.gravity}
    parts = [
        "\n".join(head),
        _table("", about),
        _table("[coordinates]", {m.name: _coordinate(m, robot) for m in robot.motions}),
    ]
    stops = joint_stops(robot) if robot.stopped else []
    numbers = parameters(robot) | gains(robot)
    for unit in (unit for unit in DEPTHS if any(s.unit == unit for s in stops)):
        deep, soft = stop_parameters(unit)
        note = "how deep a joint's effort pushes it into its stop"
        numbers[deep] = {"value": DEPTHS[unit], "unit": unit, "note": note}
        numbers[soft] = {"value": DAMPING[unit], "unit": f"s/{unit}"}
    tables = {
        "[inputs]": inputs(robot),
        "[parameters]": numbers,
        "[definitions]": definitions(robot),
        "[energy]": energies(robot),
        "[forces]": {s.coordinate: _stop(s) for s in stops},
    }
    parts += [_table(head, entries) for head, entries in tables.items() if entries]
    bodies = sorted(robot.bodies, key=lambda body: body.point)
    parts += [_table(f"[[{'point' if b.point else 'body'}]]", _entry(b, robot)) for b in bodies]
    for motion in robot.motions:
        if motion.stiffness:
            spring = {"coordinate": motion.name, "stiffness": motion.stiffness}
            rest = {"length": length(motion.rest, motion.unit)} if motion.rest else {}
            parts.append(_table("[[spring]]", spring | rest))
    parts += [_table("[[loop]]", _loop(loop)) for loop in robot.loops]
    parts += [_table("[[loop]]", _gear(c)) for c in robot.couplings if _is_gear(c)]
    if rows := {c.name: _row(c) for c in robot.couplings if not _is_gear(c)}:
        parts.append(_table("[constraints]", rows))
    if robot.method:
        parts.append(_table("[run]", {"method": robot.method}))
    return "\n\n".join(parts) + "\n"


def _stop(s: Stop) -> str:
    """Return the formula of a stop's force, described in `joint_stops`."""
    deep, soft = stop_parameters(s.unit)
    q, (low, high) = s.coordinate, (_formula(length(x, s.unit)) for x in s.limits)
    before = f"max(0, {low} - {q})*max(0, 1 - {soft}*{q}_dot)"
    beyond = f"max(0, {q} - {high})*max(0, 1 + {soft}*{q}_dot)".replace("- -", "+ ")
    return f"{number(s.effort)}/{deep}*({before} - {beyond})"


def _loop(loop: RobotLoop) -> Entry:
    """Return the keys of a [[loop]] between bodies."""
    entry: Entry = {
        "name": loop.name, "joint": loop.joint, "bodies": loop.bodies, "points": loop.points,
    }  # fmt: skip
    return entry | _rotation(loop.rotation)


def _is_gear(c: Coupling) -> bool:
    """Return whether one coordinate is a multiple of another plus a constant."""
    single = [by for by, _ in (*c.first, *c.second)] == [1.0, 1.0] and len(c.first) == 1
    return single and c.polynomial[1] != 0 and not any(c.polynomial[2:])


def _gear(c: Coupling) -> Entry:
    """Return the keys of a gear."""
    (_, driven), (_, driving) = c.first[0], c.second[0]
    ratio = c.polynomial[1]
    offset = c.zero + c.polynomial[0] - ratio * c.at
    entry = {"name": c.name, "joint": "gear", "coordinates": (driving, driven), "ratio": ratio}
    return {**entry, "offset": offset} if offset else entry


def _row(c: Coupling) -> Entry:
    """Return a coupling as an entry of [constraints]."""
    second = difference(linear_combination(c.second), c.at)
    second = second if second.isidentifier() else f"({second})"
    powers = [f"{number(a)}*{second}**{k}" for k, a in enumerate(c.polynomial) if a and k]
    terms = [number(c.polynomial[0])] * bool(c.polynomial[0]) + powers
    right = " + ".join(terms).replace("**1", "").replace("+ -", "- ")
    text = difference(linear_combination(c.first), c.zero) + (f" - ({right})" if right else "")
    return {"formula": text, **({"unit": c.unit} if c.unit else {})}


def _coordinate(m: JointMotion, robot: Robot) -> Entry:
    entry: Entry = {"unit": m.unit}
    if m.start:
        entry["start"] = length(m.start, m.unit)
    if robot.loops or robot.couplings:
        entry["guess"] = True
    return entry | ({"note": m.note} if m.note else {})


def _entry(body: RobotBody, robot: Robot) -> Entry:
    """Return the keys of a [[body]] or [[point]] that differ from their defaults."""
    entry: Entry = {"name": body.name}
    if body.point:
        entry["body"] = body.parent
    else:
        if body.parent != WORLD:
            entry["parent"] = body.parent
        entry["joint"] = body.joint
    if body.motions:
        entry["coordinates"] = _each([_moved_by(m) for m in body.motions])
    if any(body.offset):
        entry["place" if body.point else "offset"] = body.offset
    entry |= _rotation(body.rotation)
    if body.axes and body.axes != JOINTS[body.joint].defaults:
        entry["axis"] = _each(body.axes)
    if body.mass or body.parameter:
        entry["mass"] = body.parameter or body.mass
    if any(body.center):
        entry["center"] = body.center
    if any(body.inertia):
        entry["inertia"] = _inertia(body)
    for key in ("armature", "damping", "friction"):
        values = [getattr(m, key) for m in body.motions]
        if any(values):
            entry[key] = values[0] if len({*values}) == 1 else values
    if width := max((m.friction_width for m in body.motions), default=0.0):
        entry["friction_width"] = width
    forces = [force(m.name, robot) for m in body.motions]
    if any(force != "0" for force in forces):
        entry["actuator"] = _each([0 if f == "0" else f for f in forces])
    return entry | ({"note": body.note} if body.note else {})


def _rotation(rotation: Matrix) -> Entry:
    """Return the key `rotation` of a table, unless nothing is rotated."""
    turns = [(axis, angle(by)) for axis, by in axis_rotations(rotation)]
    return {"rotation": turns} if turns else {}


def _moved_by(m: JointMotion) -> str:
    """Return the coordinate of a joint, or the formula of its position if it mimics another."""
    if not m.mimics:
        return m.name
    gear, shift = number(m.mimics.gear), _formula(length(m.mimics.shift, m.unit))
    factor = {"1": "", "-1": "-"}.get(gear, f"{gear}*")
    return f"{factor}{m.mimics.coordinate}" + (f" + {shift}" if shift != "0" else "").replace(
        "+ -", "- "
    )


def _each(those: Sequence[Any]) -> Any:
    return those[0] if len(those) == 1 else those


def _table(head: str, entries: Entry) -> str:
    wide = max(map(len, entries))
    write = _long if head == "[energy]" else toml
    lines = [f"{key:{wide}} = {write(value)}" for key, value in entries.items()]
    return "\n".join([head] * bool(head) + lines)


def _bullet(words: str) -> list[str]:
    return textwrap.wrap(
        line(words), 98, initial_indent="# - ", subsequent_indent="#   ",
        break_on_hyphens=False,
    )  # fmt: skip


# --- inputs, control laws, tendons, and compensation of weights -----------------------------------


def inputs(robot: Robot) -> Entry:
    """Return the scene's table [inputs], with one input for each drive of the robot."""
    return {d.name: _input(d, robot) for d in robot.drives}


def gains(robot: Robot) -> Entry:
    """Return the entries of the scene's table [parameters] for the gains kp and kv of servos."""
    units, entries = _units(robot), dict[str, Any]()
    for d in robot.drives:
        if d.law:
            unit = units.get(d.coordinate, "") if d.gear == 1 else ""
            values = {"kp": d.law.kp, "kv": d.law.kv}
            for key, suffix in (("kp", f"/{unit}"), ("kv", f" s/{unit}")):
                shown = {"unit": _FORCES[unit] + suffix} if unit else {}
                if values[key]:
                    entries[f"{d.name}_{key}"] = {"value": values[key]} | shown
    return entries


def definitions(robot: Robot) -> Entry:
    """Return entries of the scene's table [definitions].

    The formulas are the lengths of tendons and the forces of servos.
    """
    driven = {d.coordinate for d in robot.drives}
    acting = [t for t in robot.tendons if t.has_forces or t.name in driven]
    entries = {t.name: difference(linear_combination(t.terms), -t.offset) for t in acting}
    for d in robot.drives:
        if d.law:
            entries[f"{d.name}_force"] = _law(d, d.law, robot)
    return entries


def energies(robot: Robot) -> Entry:
    """Return entries of the scene's table [energy].

    The energies are those of tendons, and of the weight that is compensated (gravcomp in MJCF).
    """
    rates = [(t, f"dot({t.name})**2/2") for t in robot.tendons]
    lifted = [b for b in robot.bodies if b.lifted and b.mass]
    weights = [
        (g, _sum([_weight(b, axis) for b in lifted]))
        for g, axis in zip(robot.gravity, "xyz", strict=True)
        if g and lifted
    ]
    sums = {
        "kinetic": [(t.armature, rate) for t, rate in rates if t.armature],
        "potential": [*((t.stiffness, _spring(t)) for t in robot.tendons if t.stiffness), *weights],
        "dissipation": [(t.damping, rate) for t, rate in rates if t.damping],
    }
    return {key: linear_combination(terms) for key, terms in sums.items() if terms}


def _weight(body: RobotBody, axis: str) -> tuple[float, str]:
    """Return the compensated share of a body's mass, and its centre's coordinate on `axis`."""
    if body.parameter:
        return body.lifted, f"{body.parameter}*{body.name}_{axis}"
    return body.lifted * body.mass, f"{body.name}_{axis}"


def force(coordinate: str, robot: Robot) -> str:
    """Return the formula of the force (N or N m) that drives exert along a coordinate.

    It is the value of the key `actuator` in a scene, and "0" if no drive acts on the coordinate.
    """
    terms = [
        (by * d.gear, f"{d.name}_force" if d.law else d.name)
        for d in robot.drives
        for by, q in robot.coordinate_terms(d.coordinate)
        if q == coordinate
    ]
    return linear_combination(terms)


def _units(robot: Robot) -> Mapping[str, str]:
    return {m.name: m.unit for m in robot.motions}


def _input(drive: Drive, robot: Robot) -> Entry:
    unit = _units(robot).get(drive.coordinate, "") if drive.gear == 1 else ""
    note = drive.note or f"along {drive.coordinate}"
    if drive.law:
        at = drive.law.set_point
        unit = unit and {"kp": unit, "kv": f"{unit}/s"}.get(at, "")
        what = {"kp": "set point of", "kv": "set point of the rate of"}.get(at, "control along")
        note = join_notes(f"{what} {drive.coordinate}", drive.note)
    elif unit:
        unit = _FORCES[unit]
    entry: Entry = {"unit": unit} if unit else {}
    if drive.start:
        entry["signal"] = drive.start
    if robot.limited and drive.limits != UNLIMITED:
        entry["limits"] = drive.limits
    return entry | {"note": note}


def _law(d: Drive, law: Law, robot: Robot) -> str:
    """Return the formula of a servo's force, before the gear."""
    coordinate = d.coordinate in _units(robot)
    q, rate = d.coordinate, f"{d.coordinate}_dot" if coordinate else f"dot({d.coordinate})"
    gain, by_length, by_rate = law.gain
    pulls = {"kp": (law.kp, q), "kv": (law.kv, rate)}
    words = []
    if at := law.set_point:
        words.append(
            f"{d.name}_{at}*({linear_combination([(1.0, d.name), (-d.gear, pulls.pop(at)[1])])})"
        )
        gain = 0.0
    terms = [
        (gain, d.name),
        (by_length * d.gear, f"{q}*{d.name}"),
        (by_rate * d.gear, f"{rate}*{d.name}"),
        *((-d.gear * bool(k), f"{d.name}_{key}*{of}") for key, (k, of) in pulls.items()),
    ]
    words += [linear_combination([(by, of)]) for by, of in terms if by]
    words += [number(law.bias[0])] if law.bias[0] else []
    text = " + ".join(words).replace("+ -", "- ") or "0"
    if robot.limited and law.force != UNLIMITED:
        low, high = map(number, law.force)
        text = f"min(max({text}, {low}), {high})"
    return text


def _spring(t: Tendon) -> str:
    """Return the energy of a spring of stiffness 1, which is zero within its range of rest."""
    low, high = t.rest
    if low == high:
        return f"({difference(t.name, low)})**2/2"
    beyond = f"max(0, {difference(t.name, high)})", f"max(0, {difference(f'-{t.name}', -low)})"
    return f"({beyond[0]}**2 + {beyond[1]}**2)/2"


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """Return a sum in parentheses; a long one is split into partial sums."""
    if len(terms) <= _MAX_TERMS:
        return f"({linear_combination(terms)})"
    return (
        "("
        + " + ".join(_sum(terms[k : k + _MAX_TERMS]) for k in range(0, len(terms), _MAX_TERMS))
        + ")"
    )


def _long(formula: str) -> str:
    """Return a formula of plain names and numbers as TOML, wrapped if it is long."""
    lines = textwrap.wrap(formula, 98, break_long_words=False, break_on_hyphens=False)
    return toml(formula) if len(lines) < 2 else '"""\n' + "\n".join(lines) + '"""'


# --- masses as parameters -------------------------------------------------------------------------


def parameters(robot: Robot) -> Entry:
    """Return the entries of the scene's table [parameters] for masses and payloads."""
    entries = dict[str, Any]()
    for b in robot.bodies:
        if b.parameter:
            note = {} if b.mass else {"note": f"payload at {b.parent}"}
            entries[b.parameter] = {"value": b.mass, "unit": "kg"} | note
    return entries


def _inertia(body: RobotBody) -> Sequence[float | str]:
    """Return a body's inertia tensor about its centre of mass.

    If the mass is a parameter of the scene, the entries are formulas proportional to it.
    """
    tensor_entries = body.inertia if any(body.inertia[3:]) else body.inertia[:3]
    if not body.parameter:
        return tensor_entries
    entries = list[float | str]()
    for k, entry in enumerate(tensor_entries):
        rotor = body.rotor if k < 3 else 0.0
        own = entry - rotor
        text = f"{number(own)}*{body.parameter}/{number(body.mass)}" if own else ""
        text = f"{number(rotor)} + {text}" if text and rotor else text or number(rotor)
        entries.append(text if own else rotor)
    return entries


# --- numbers, angles and sums as formulas ---------------------------------------------------------


def number(x: float) -> str:
    """Return the shortest text that reads back as the number x."""
    return toml(float(x))


def _formula(value: float | str) -> str:
    """Return a number or a formula as text in a formula."""
    return value if isinstance(value, str) else number(value)


def angle(x: float) -> float | str:
    """Return an angle x (rad), as a formula such as "pi/2" for multiples of pi/12 within 1e-10."""
    twelfths = round(x * 12 / math.pi)
    if abs(x - twelfths * math.pi / 12) > SNAP or abs(twelfths) > 48:
        return _shortest(x)
    if not twelfths:
        return 0.0
    common = math.gcd(twelfths, 12)
    above, below = abs(twelfths) // common, 12 // common
    words = ("-" if twelfths < 0 else "") + (f"{above}*pi" if above > 1 else "pi")
    return f"{words}/{below}" if below > 1 else words


def _shortest(x: float) -> float:
    """An angle of a rotation, computed to about 4e-16: no more digits than that means."""
    for digits in range(1, 17):
        short = f"{x:.{digits}g}"
        if abs(float(short) - x) <= 4e-16:
            return float(short)
    return x


def length(x: float, of: str) -> float | str:
    """Return x, as `angle` does if `of` is "rad"."""
    return angle(x) if of == "rad" else x


def linear_combination(terms: Sequence[tuple[float, str]]) -> str:
    """Return the formula of a linear combination as text, such as "2*q1 - q2".

    `terms` are pairs (factor, name of a coordinate).
    """
    shown = [{1.0: q, -1.0: f"-{q}"}.get(by, f"{number(by)}*{q}") for by, q in terms]
    return " + ".join(shown).replace("+ -", "- ") or "0"


def difference(text: str, x: float) -> str:
    """Return the text of the formula `text` minus the number x, such as "q1 - 0.5"."""
    return f"{text} - {number(x)}".replace("- -", "+ ") if x else text


# --- preparation: names, points, checks -----------------------------------------------------------

MENDED = ", as --mend-inertias writes"
_NAME = names.MAX_LENGTH - 8  # room for suffixes such as "_torque" and "_dot"
LAW_SUFFIXES = "_force", "_kp", "_kv"  # of a drive's name: the force and gains of its control law
STATE_COUNT = 3  # random states at which the Jacobian is evaluated
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
        size = max(1.0, *(float(np.abs(body.pose.place).max()) for body in rigid.values()))
        least = rank.tolerance() * size
        slopes = {loop.name: loop_jacobian(loop, rigid, rows) for loop in robot.loops}
        slopes |= {c.name: coupling_gradient(c, starts, rows) for c in robot.couplings}
        effective |= {name for name, J in slopes.items() if np.abs(J).max(initial=0.0) > least}
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
    one, other = (rigid[b].pose.point(p) for b, p in zip(loop.bodies, loop.points, strict=True))
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
