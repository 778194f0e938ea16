"""Actuation in the scene of a robot: inputs, drive laws, tendons, and gravity compensation."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from eomc.base.texts import toml
from eomc.robots.formulas import less, number, total
from eomc.robots.robot import UNLIMITED, Drive, Law, Robot, RobotBody, Tendon, joined

_FORCES = {"rad": "N m", "m": "N"}  # by a coordinate's unit
_MAX_TERMS = 50  # of one sum: each term nests the formula deeper, and the limit on depth is 150


def law_names(drive: Drive) -> tuple[str, ...]:
    """Return the suffixes with which a drive's control law extends the drive's name.

    The extended names are those of its force and of its gains kp and kv in the scene. Returns ()
    if the drive has no control law.
    """
    return ("_force", "_kp", "_kv") if drive.law else ()


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
    acting = [t for t in robot.tendons if t.acts or t.name in driven]
    entries = {t.name: toml(less(total(t.terms), -t.offset)) for t in acting}
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
    return {key: _long(total(terms)) for key, terms in sums.items() if terms}


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
    return total(terms)


def _units(robot: Robot) -> Mapping[str, str]:
    return {m.name: m.unit for m in robot.motions}


def _input(drive: Drive, robot: Robot) -> str:
    unit = _units(robot).get(drive.coordinate, "") if drive.gear == 1 else ""
    note = drive.note or f"along {drive.coordinate}"
    if drive.law:
        at = drive.law.set_point
        unit = unit and {"kp": unit, "kv": f"{unit}/s"}.get(at, "")
        what = {"kp": "set point of", "kv": "set point of the rate of"}.get(at, "control along")
        note = joined(f"{what} {drive.coordinate}", drive.note)
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
        words.append(f"{d.name}_{at}*({total([(1.0, d.name), (-d.gear, pulls.pop(at)[1])])})")
        gain = 0.0
    terms = [
        (gain, d.name),
        (by_length * d.gear, f"{q}*{d.name}"),
        (by_rate * d.gear, f"{rate}*{d.name}"),
        *((-d.gear * bool(k), f"{d.name}_{key}*{of}") for key, (k, of) in pulls.items()),
    ]
    words += [total([(by, of)]) for by, of in terms if by]
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
        return f"({less(t.name, low)})**2/2"
    beyond = f"max(0, {less(t.name, high)})", f"max(0, {less(f'-{t.name}', -low)})"
    return f"({beyond[0]}**2 + {beyond[1]}**2)/2"


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """Return a sum in parentheses; a long one is split into partial sums."""
    if len(terms) <= _MAX_TERMS:
        return f"({total(terms)})"
    return (
        "("
        + " + ".join(_sum(terms[k : k + _MAX_TERMS]) for k in range(0, len(terms), _MAX_TERMS))
        + ")"
    )


def _long(formula: str) -> str:
    """Return a formula of plain names and numbers as TOML, wrapped if it is long."""
    lines = textwrap.wrap(formula, 98, break_long_words=False, break_on_hyphens=False)
    return toml(formula) if len(lines) < 2 else '"""\n' + "\n".join(lines) + '"""'
