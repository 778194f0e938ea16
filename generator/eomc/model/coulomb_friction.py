"""Coulomb friction that sticks and slides, exactly: modes that events switch.

Each coordinate q that friction F holds gets another, s: 1 where q slides forwards, -1 backwards, 0
where it sticks. While it slides the force is -F s; while it sticks a row of constraints holds its
velocity at zero, and the row's multiplier is the force that does. It stops sliding where its
velocity crosses zero, and slips where the multiplier crosses F: taken times the row's pivot, which
vanishes at dead points, where nothing can hold it. Forces are smooth between events.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S

from eomc.base.errors import Problem, SceneError
from eomc.model.constraint_report import ConstraintSummary
from eomc.model.mechanics import Made, Mechanics
from eomc.model.symbols import Constraint, Coordinate, Event, FrictionMode

NOTE = "1 where {name} slides forwards, -1 backwards, 0 where it sticks"


@dataclass(frozen=True)
class Friction:
    """Coulomb's, of the size `force` (N or N m, >= 0), along a coordinate; key: where it stands."""

    coordinate: str
    force: Expr
    key: str


def add_stick_slip(system: Made, frictions: Sequence[Friction]) -> Made:
    """The system with friction that sticks, along coordinates; of one coordinate they add up.

    Raises SceneError where a name that it needs is taken.
    """
    if not frictions:
        return system
    whole: dict[str, Expr] = {}
    for friction in frictions:
        whole[friction.coordinate] = whole.get(friction.coordinate, S.Zero) + friction.force
    if taken := _taken(system, whole):
        raise SceneError(taken)
    at = {c.name: k for k, c in enumerate(system.coordinates)}
    modes = tuple(FrictionMode(len(at) + n, at[name]) for n, name in enumerate(whole))
    forces = [*(system.forces or [S.Zero] * len(at)), *[S.Zero] * len(modes)]
    made, rows, events, energy = [], [], [], S.Zero
    sliding: dict[str, str] = {}  # the mode of each velocity
    for (name, force), mode in zip(whole.items(), modes, strict=True):
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
        made.append(s)
        rows.append(row)
        events += _events(c, s, force, row)
        sliding[c.qd.name] = s.name
    tree = system.tree and replace(system.tree, beside_kinetic=system.tree.beside_kinetic + energy)
    return replace(
        system,
        coordinates=(*system.coordinates, *made),
        kinetic=system.kinetic + energy,
        forces=tuple(forces),
        constraints=(*system.constraints, *rows),
        events=(*(_jumping(e, sliding) for e in system.events), *events),
        tree=tree,
        modes=modes,
    )


def _side(rate: float) -> float:
    return float((rate > 0) - (rate < 0))


def _taken(system: Mechanics, whole: Iterable[str]) -> list[Problem]:
    """Names of the scene's that modes need."""
    known = {
        *system.names, *(s.name for s, _ in system.definitions), *(o.name for o in system.outputs),
        *(r.name for r in system.constraints), *(e.name for e in system.events),
    }  # fmt: skip
    words = ("slides", "slides_dot", "sticks", "stops", "slips")
    return [
        system.problem("run.friction", f"\"stick\" needs the name '{name}_{word}': rename yours")
        for name in whole
        for word in words
        if f"{name}_{word}" in known
    ]


def _events(c: Coordinate, s: Coordinate, force: Expr, row: Constraint) -> list[Event]:
    """It stops, and sticks if what holds it can; else it slips at once.

    Where several slip at one time each is taken for itself. What begins to slip and is driven back
    by another that slips behind it stops again as soon as it moves.
    """
    lack, pivot = row.parts
    still = ((c.qd.name, S.Zero), (s.name, S.Zero))
    slips = sympy.Abs(lack) - force * pivot - s.q**2
    goes = ((c.qd.name, S.Zero), (s.name, -sympy.sign(lack)))
    return [
        Event(f"{c.name}_stops", s.q * c.qd, "falling", "jump", still, above=True),
        Event(f"{c.name}_slips", slips, "rising", "jump", goes, begins=slips),
    ]


def _jumping(event: Event, sliding: Mapping[str, str]) -> Event:
    """The event, whose jump sets the modes of the velocities that it sets."""
    modes = [(sliding[n], sympy.sign(to)) for n, to in event.jump if n in sliding]
    return replace(event, jump=(*event.jump, *modes))


def without_modes(system: Made) -> Made:
    """The system without its modes, for what rows of constraints leave where all slides."""
    n, m = len(system.coordinates) - len(system.modes), len(system.constraints) - len(system.modes)
    energy = sympy.Add(*(c.qd**2 / 2 for c in system.coordinates[n:]))
    still = dict.fromkeys((c.q for c in system.coordinates[n:]), S.Zero)
    tree = system.tree and replace(system.tree, beside_kinetic=system.tree.beside_kinetic - energy)
    return replace(
        system,
        coordinates=system.coordinates[:n],
        kinetic=system.kinetic - energy,
        forces=tuple(force.xreplace(still) for force in system.forces[:n]),
        events=(),
        constraints=system.constraints[:m],
        tree=tree,
        modes=(),
        closure=None,
    )


def with_modes(system: Made, core: Made) -> Made:
    """The system with start and rows of its `core`, which has no modes and is assembled."""
    modes = [
        replace(system.coordinates[m.at], start=_side(core.coordinates[m.of].rate))
        for m in system.modes
    ]
    own = system.constraints[len(core.constraints) :]
    found = core.closure or ConstraintSummary((), len(core.rates), 0)
    closure = replace(
        found,
        rows=(*found.rows, *(row.name for row in own)),
        coordinates=found.coordinates + len(modes),
        rank=found.rank + len(own),
        weights=(*found.weights, *[0.0] * len(own)) if found.weights else (),
        slopes=(*found.slopes, *[0.0] * len(own)),
    )
    return replace(
        system,
        coordinates=(*core.coordinates, *modes),
        constraints=(*core.constraints, *own),
        closure=closure,
        warnings=core.warnings,
    )
