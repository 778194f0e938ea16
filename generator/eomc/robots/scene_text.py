"""The scene of a robot as readable TOML text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence

from eomc.base.texts import line, toml
from eomc.robots.limits import DAMPING, DEPTHS, Stop, joint_stops, stop_parameters
from eomc.robots.preparation import prepare_for_scene
from eomc.robots.robot import (
    UNLIMITED,
    Coupling,
    Drive,
    JointMotion,
    Law,
    Robot,
    RobotBody,
    RobotLoop,
    Tendon,
    join_notes,
)
from eomc.robots.rotations import SNAP, Vector, axis_rotations
from eomc.scene.assembly import WORLD
from eomc.scene.joints import JOINTS

_FORCES = {"rad": "N m", "m": "N"}  # by a coordinate's unit
_MAX_TERMS = 50  # of one sum: each term nests the formula deeper, and the limit on depth is 150


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
    about = {"eomc": "1", "name": toml(robot.name), "title": toml(robot.title),
             "gravity": vector(robot.gravity)}  # fmt: skip
    parts = [
        "\n".join(head),
        _table("", about),
        _table("[coordinates]", {m.name: _coordinate(m, robot) for m in robot.motions}),
    ]
    stops = joint_stops(robot) if robot.stopped else []
    numbers = parameters(robot) | gains(robot)
    for unit in (unit for unit in DEPTHS if any(s.unit == unit for s in stops)):
        deep, soft = stop_parameters(unit)
        numbers[deep] = _depth(unit)
        numbers[soft] = f'{{ value = {number(DAMPING[unit])}, unit = "s/{unit}" }}'
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


def _depth(unit: str) -> str:
    note = "how deep a joint's effort pushes it into its stop"
    return f"{{ value = {number(DEPTHS[unit])}, unit = {toml(unit)}, note = {toml(note)} }}"


def _stop(s: Stop) -> str:
    """Return the formula of a stop's force, described in `joint_stops`."""
    deep, soft = stop_parameters(s.unit)
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
    if turns := axis_rotations(loop.rotation):
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
    second = difference(linear_combination(c.second), c.at)
    second = second if second.isidentifier() else f"({second})"
    powers = [f"{number(a)}*{second}**{k}" for k, a in enumerate(c.polynomial) if a and k]
    terms = [number(c.polynomial[0])] * bool(c.polynomial[0]) + powers
    right = " + ".join(terms).replace("**1", "").replace("+ -", "- ")
    text = difference(linear_combination(c.first), c.zero) + (f" - ({right})" if right else "")
    unit = f", unit = {toml(c.unit)}" if c.unit else ""
    return f"{{ formula = {toml(text)}{unit} }}"


def _coordinate(m: JointMotion, robot: Robot) -> str:
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
    if turns := axis_rotations(body.rotation):
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
    forces = [force(m.name, robot) for m in body.motions]
    if any(force != "0" for force in forces):
        entry["actuator"] = _each([f if f == "0" else toml(f) for f in forces])
    if body.note:
        entry["note"] = toml(body.note)
    return entry


def _turns(turns: Sequence[tuple[str, float]]) -> str:
    shown = (f'["{axis}", {angle(by)}]' for axis, by in turns)
    return f"[{', '.join(shown)}]"


def _moved_by(m: JointMotion) -> str:
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


# --- inputs, control laws, tendons, and compensation of weights -----------------------------------


def inputs(robot: Robot) -> dict[str, str]:
    """Return the entries of the scene's table [inputs]: the TOML text of each input, by name.

    The scene has one input for each drive of the robot.
    """
    return {d.name: _input(d, robot) for d in robot.drives}


def gains(robot: Robot) -> dict[str, str]:
    """Return the entries of the scene's table [parameters] for the gains of servos.

    They map the name of each gain (kp or kv) to its TOML text.
    """
    units, entries = _units(robot), {}
    for d in robot.drives:
        if d.law:
            unit = units.get(d.coordinate, "") if d.gear == 1 else ""
            values = {"kp": d.law.kp, "kv": d.law.kv}
            for key, suffix in (("kp", f"/{unit}"), ("kv", f" s/{unit}")):
                shown = f", unit = {toml(_FORCES[unit] + suffix)}" if unit else ""
                if values[key]:
                    entries[f"{d.name}_{key}"] = f"{{ value = {number(values[key])}{shown} }}"
    return entries


def definitions(robot: Robot) -> dict[str, str]:
    """Return entries of the scene's table [definitions]: the TOML text of each formula, by name.

    The formulas are the lengths of tendons and the forces of servos.
    """
    driven = {d.coordinate for d in robot.drives}
    acting = [t for t in robot.tendons if t.has_forces or t.name in driven]
    entries = {t.name: toml(difference(linear_combination(t.terms), -t.offset)) for t in acting}
    for d in robot.drives:
        if d.law:
            entries[f"{d.name}_force"] = toml(_law(d, d.law, robot))
    return entries


def energies(robot: Robot) -> dict[str, str]:
    """Return entries of the scene's table [energy]: the TOML text of each formula, by its key.

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
    return {key: _long(linear_combination(terms)) for key, terms in sums.items() if terms}


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


def _input(drive: Drive, robot: Robot) -> str:
    unit = _units(robot).get(drive.coordinate, "") if drive.gear == 1 else ""
    note = drive.note or f"along {drive.coordinate}"
    if drive.law:
        at = drive.law.set_point
        unit = unit and {"kp": unit, "kv": f"{unit}/s"}.get(at, "")
        what = {"kp": "set point of", "kv": "set point of the rate of"}.get(at, "control along")
        note = join_notes(f"{what} {drive.coordinate}", drive.note)
    elif unit:
        unit = _FORCES[unit]
    of = f"unit = {toml(unit)}, " if unit else ""
    if drive.start:
        of += f"signal = {number(drive.start)}, "
    if robot.limited and drive.limits != UNLIMITED:
        of += f"limits = [{', '.join(map(number, drive.limits))}], "
    return f"{{ {of}note = {toml(note)} }}"


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


# --- numbers, angles and sums as formulas ---------------------------------------------------------


def number(x: float) -> str:
    """Return the shortest text that reads back as the number x."""
    short = repr(float(x)).removesuffix(".0")
    return "0" if short == "-0" else short


def angle(x: float) -> str:
    """Return the TOML text of an angle x (rad): a number such as 0.3, or a formula such as "pi/2".

    The formula, in quotes, is used for multiples of pi/12, to within 1e-10.
    """
    twelfths = round(x * 12 / math.pi)
    if abs(x - twelfths * math.pi / 12) > SNAP or abs(twelfths) > 48:
        return _shortest(x)
    if not twelfths:
        return "0"
    common = math.gcd(twelfths, 12)
    above, below = abs(twelfths) // common, 12 // common
    words = ("-" if twelfths < 0 else "") + (f"{above}*pi" if above > 1 else "pi")
    return f'"{words}/{below}"' if below > 1 else f'"{words}"'


def _shortest(x: float) -> str:
    """An angle of a rotation, computed to about 4e-16: no more digits than that means."""
    for digits in range(1, 17):
        short = f"{x:.{digits}g}"
        if abs(float(short) - x) <= 4e-16:
            return number(float(short))
    return number(x)


def length(x: float, of: str) -> str:
    """Return the TOML text of x, an angle if `of` is "rad", or a length if `of` is "m".

    An angle that is a multiple of pi/12 is written as a formula in quotes, such as "pi/2".
    """
    return angle(x) if of == "rad" else number(x)


def vector(v: Vector) -> str:
    """Return the TOML text of a vector, an array of numbers."""
    return f"[{', '.join(map(number, v))}]"


def linear_combination(terms: Sequence[tuple[float, str]]) -> str:
    """Return the formula of a linear combination as text, such as "2*q1 - q2".

    `terms` are pairs (factor, name of a coordinate).
    """
    shown = [{1.0: q, -1.0: f"-{q}"}.get(by, f"{number(by)}*{q}") for by, q in terms]
    return " + ".join(shown).replace("+ -", "- ") or "0"


def difference(text: str, x: float) -> str:
    """Return the text of the formula `text` minus the number x, such as "q1 - 0.5"."""
    return f"{text} - {number(x)}".replace("- -", "+ ") if x else text
