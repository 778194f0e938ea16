"""What acts in the scene of a robot: inputs, laws of drives, tendons, weights that are borne."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from eomc.base.texts import toml
from eomc.robots.formulas import less, number, total
from eomc.robots.robot import UNLIMITED, Drive, Law, Robot, RobotBody, Tendon, joined

_FORCES = {"rad": "N m", "m": "N"}  # by a coordinate's unit
_MAX_TERMS = 50  # terms of a sum at most: each nests the formula deeper, which bears 150


def law_names(drive: Drive) -> tuple[str, ...]:
    """What a drive's names end in, besides the empty end of its own."""
    return ("_force", "_kp", "_kv") if drive.law else ()


def inputs(robot: Robot) -> dict[str, str]:
    """The entries of [inputs]."""
    return {d.name: _input(d, robot) for d in robot.drives}


def gains(robot: Robot) -> dict[str, str]:
    """The gains of servos, entries of [parameters]."""
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
    """The lengths of tendons and the forces of servos, entries of [definitions]."""
    driven = {d.coordinate for d in robot.drives}
    acting = [t for t in robot.tendons if t.acts or t.name in driven]
    entries = {t.name: toml(less(total(t.terms), -t.offset)) for t in acting}
    for d in robot.drives:
        if d.law:
            entries[f"{d.name}_force"] = toml(_law(d, d.law, robot))
    return entries


def energies(robot: Robot) -> dict[str, str]:
    """The entries of [energy]."""
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
    """The part of a body's mass that is borne, as a factor, times a place."""
    if body.parameter:
        return body.lifted, f"{body.parameter}*{body.name}_{axis}"
    return body.lifted * body.mass, f"{body.name}_{axis}"


def force(coordinate: str, robot: Robot) -> str:
    """What drives a coordinate, its `actuator`."""
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
    """The force of a servo, before the gear."""
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
    """The energy of a spring of stiffness 1, which has none between the ends of its rest."""
    low, high = t.rest
    if low == high:
        return f"({less(t.name, low)})**2/2"
    beyond = f"max(0, {less(t.name, high)})", f"max(0, {less(f'-{t.name}', -low)})"
    return f"({beyond[0]}**2 + {beyond[1]}**2)/2"


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """A sum in parentheses, of sums where it is long."""
    if len(terms) <= _MAX_TERMS:
        return f"({total(terms)})"
    return (
        "("
        + " + ".join(_sum(terms[k : k + _MAX_TERMS]) for k in range(0, len(terms), _MAX_TERMS))
        + ")"
    )


def _long(formula: str) -> str:
    """A formula of names and numbers alone as TOML has it, over lines where it is long."""
    lines = textwrap.wrap(formula, 98, break_long_words=False, break_on_hyphens=False)
    return toml(formula) if len(lines) < 2 else '"""\n' + "\n".join(lines) + '"""'
