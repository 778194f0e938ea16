"""Coulomb friction with stick-slip transitions: modes that events switch.

Each coordinate q with friction F gets a discrete coordinate s: 1 if q slides forwards, -1 if
backwards, 0 if it sticks. While q slides the friction force is -F s. While q sticks a constraint
keeps its velocity at zero, and the multiplier is the friction force. Sliding ends where the
velocity crosses zero; sticking ends where the multiplier crosses F. The multiplier is taken times
the pivot of its constraint, which vanishes at dead points, where friction cannot prevent slip.
Forces are smooth between events.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S

from eomc.base.errors import Problem, SceneError
from eomc.model.constraint_report import ConstraintSummary
from eomc.model.mechanics import AnySystem, Mechanics
from eomc.model.symbols import Constraint, Coordinate, Event, FrictionMode

NOTE = "1 where {name} slides forwards, -1 backwards, 0 where it sticks"


@dataclass(frozen=True)
class Friction:
    """Coulomb friction that opposes the motion of a coordinate.

    coordinate: name of the coordinate. force: magnitude of the friction while it slides, an
    expression >= 0 in N or N m. key: key of the friction in the scene, such as
    "coordinates.x.friction", for messages.
    """

    coordinate: str
    force: Expr
    key: str


def add_stick_slip(system: AnySystem, frictions: Sequence[Friction]) -> AnySystem:
    """Return a copy of a system with added friction that switches between sticking and sliding.

    frictions: the friction to add; frictions along the same coordinate are summed. For each
    coordinate with friction, the copy has a further discrete coordinate (the friction mode: stick
    or slide), a constraint (the coordinate is at rest while it sticks) and two events (start and
    end of sticking). Raises SceneError if the name of an added quantity is already in use.
    """
    if not frictions:
        return system
    forces_by_name: dict[str, Expr] = {}
    for friction in frictions:
        forces_by_name[friction.coordinate] = (
            forces_by_name.get(friction.coordinate, S.Zero) + friction.force
        )
    if taken := _taken(system, forces_by_name):
        raise SceneError(taken)
    index = {c.name: k for k, c in enumerate(system.coordinates)}
    modes = tuple(
        FrictionMode(len(index) + n, index[name]) for n, name in enumerate(forces_by_name)
    )
    forces = [*(system.forces or [S.Zero] * len(index)), *[S.Zero] * len(modes)]
    states, rows, events, energy = [], [], [], S.Zero
    sliding: dict[str, str] = {}  # friction mode of each velocity
    for (name, force), mode in zip(forces_by_name.items(), modes, strict=True):
        c = system.coordinates[mode.of]
        s = Coordinate(f"{name}_slides", start=_side(c.rate), note=NOTE.format(name=name))
        row = Constraint(
            f"{name}_sticks",
            sympy.Max(0, sympy.Min(1, 3 - 4 * s.q**2)) * c.qd,
            holonomic=False,
            note=f"what holds {name} where it sticks",
            switched=True,
        )
        forces[mode.of] -= force * s.q
        energy += s.qd**2 / 2
        states.append(s)
        rows.append(row)
        events += _events(c, s, force, row)
        sliding[c.qd.name] = s.name
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic + energy)
    return replace(
        system,
        coordinates=(*system.coordinates, *states),
        kinetic=system.kinetic + energy,
        forces=tuple(forces),
        constraints=(*system.constraints, *rows),
        events=(*(_set_modes(e, sliding) for e in system.events), *events),
        tree=tree,
        modes=modes,
    )


def _side(rate: float) -> float:
    return float((rate > 0) - (rate < 0))


def _taken(system: Mechanics, forces_by_name: Iterable[str]) -> list[Problem]:
    """Report names of the scene that coincide with names of modes."""
    known = {
        *system.names, *(s.name for s, _ in system.definitions), *(o.name for o in system.outputs),
        *(r.name for r in system.constraints), *(e.name for e in system.events),
    }  # fmt: skip
    words = ("slides", "slides_dot", "sticks", "stops", "slips")
    return [
        system.problem("run.friction", f"\"stick\" needs the name '{name}_{word}': rename yours")
        for name in forces_by_name
        for word in words
        if f"{name}_{word}" in known
    ]


def _events(c: Coordinate, s: Coordinate, force: Expr, row: Constraint) -> list[Event]:
    """Return the two transitions: to sticking where the velocity vanishes, to slip where friction
    cannot prevent it.

    If several joints start to slip at one time, each is treated separately. A joint that another
    one drives back sticks again as soon as it moves.
    """
    lack, pivot = row.parts
    sticks = ((c.qd.name, S.Zero), (s.name, S.Zero))
    slips = sympy.Abs(lack) - force * pivot - s.q**2
    goes = ((c.qd.name, S.Zero), (s.name, -sympy.sign(lack)))
    return [
        Event(f"{c.name}_stops", s.q * c.qd, "falling", "jump", sticks, above=True),
        Event(f"{c.name}_slips", slips, "rising", "jump", goes, begins=slips),
    ]


def _set_modes(event: Event, sliding: Mapping[str, str]) -> Event:
    """Return the event with a jump that also sets the modes of the velocities it sets."""
    modes = [(sliding[n], sympy.sign(to)) for n, to in event.jump if n in sliding]
    return replace(event, jump=(*event.jump, *modes))


def without_modes(system: AnySystem) -> AnySystem:
    """Return a copy of a system without stick-slip friction and without any events.

    The coordinates and constraints that `add_stick_slip` added are removed. With this copy,
    initial values are computed that satisfy all other constraints; `with_modes` then transfers
    them to the original system.
    """
    n, m = len(system.coordinates) - len(system.modes), len(system.constraints) - len(system.modes)
    energy = sympy.Add(*(c.qd**2 / 2 for c in system.coordinates[n:]))
    sticking = dict.fromkeys((c.q for c in system.coordinates[n:]), S.Zero)
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic - energy)
    return replace(
        system,
        coordinates=system.coordinates[:n],
        kinetic=system.kinetic - energy,
        forces=tuple(force.xreplace(sticking) for force in system.forces[:n]),
        events=(),
        constraints=system.constraints[:m],
        tree=tree,
        modes=(),
        closure=None,
    )


def with_modes(system: AnySystem, core: AnySystem) -> AnySystem:
    """Return a copy of a system with stick-slip friction that has the initial values of `core`.

    core: the result of `without_modes` for the system, after its initial values were adjusted to
    its constraints. The copy also has the constraints of `core` and their summary. The initial
    friction modes are computed from the initial velocities.
    """
    modes = [
        replace(system.coordinates[m.at], start=_side(core.coordinates[m.of].rate))
        for m in system.modes
    ]
    own = system.constraints[len(core.constraints) :]
    summary = core.closure or ConstraintSummary((), len(core.rates), 0)
    closure = replace(
        summary,
        rows=(*summary.rows, *(row.name for row in own)),
        coordinates=summary.coordinates + len(modes),
        rank=summary.rank + len(own),
        weights=(*summary.weights, *[0.0] * len(own)) if summary.weights else (),
        slopes=(*summary.slopes, *[0.0] * len(own)),
    )
    return replace(
        system,
        coordinates=(*core.coordinates, *modes),
        constraints=(*core.constraints, *own),
        closure=closure,
        warnings=core.warnings,
    )
