"""Hybrid dynamics: what acts at events, or switches between them.

Event functions are checked, and inputs are saturated at their limits.

Parameters that state jumps set become discrete coordinates, so that runs, batches and C have their
values at any time. A discrete coordinate is no generalized coordinate: no derivative with respect
to it is taken, and its velocity is 0. The term x_dot**2/2 in K, which is decoupled from all others,
keeps D regular and the variable at rest.

Coulomb friction with stick-slip transitions switches modes at events. Each coordinate q with
friction F gets a discrete coordinate s: 1 if q slides forwards, -1 if backwards, 0 if it sticks.
While q slides the friction force is -F s. While q sticks a constraint keeps its velocity at zero,
and the multiplier is the friction force. Sliding ends where the velocity crosses zero; sticking
ends where the multiplier crosses F. The multiplier is taken times the pivot of its constraint,
which vanishes at dead points, where friction cannot prevent slip. Forces are smooth between events.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Heaviside, S, Symbol, sign

from eomc.base.errors import Problem, SceneError
from eomc.model.mechanics import AnySystem, ConstraintSummary, Mechanics
from eomc.model.symbols import Constraint, Coordinate, Event, FrictionMode, Parameter, symbol


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


def add_hybrid_dynamics(system: AnySystem, frictions: Sequence[Friction]) -> AnySystem:
    """Return a copy of a system with saturated inputs, discrete coordinates and friction modes.

    The event functions of the system are checked first. frictions: Coulomb friction that switches
    between sticking and sliding. Raises SceneError as the four functions that are called here do.
    """
    system = saturate_inputs(check_event_functions(system))
    return add_stick_slip(add_discrete_coordinates(system), frictions)


# --- events and inputs ----------------------------------------------------------------------------


def check_event_functions(system: AnySystem) -> AnySystem:
    """Check that the event functions of a system can cross zero continuously; return the system.

    The system is returned unchanged. Raises SceneError if an event function is piecewise constant,
    such as sign(x): it jumps over zero and has no root there.
    """
    if not system.events:
        return system
    # of each definition: the symbols on which it depends continuously, and, if it is discontinuous,
    # the argument of a discontinuity
    smooth: dict[Symbol, frozenset[Symbol]] = {}
    jumping: dict[Symbol, Expr] = {}

    def dependencies(e: Expr) -> tuple[frozenset[Symbol], Expr | None]:
        jumps = sorted(e.atoms(Heaviside, sign), key=str)
        names = e.xreplace(dict.fromkeys(jumps, sympy.S.One)).free_symbols
        inside = [j.args[0] for j in jumps] + [jumping[s] for s in names if s in jumping]
        continuous = frozenset[Symbol]().union(*(smooth.get(s, {s}) for s in names))
        return continuous, inside[0] if inside else None

    for name, e in system.definitions:
        smooth[name], where = dependencies(e)
        if where is not None:
            jumping[name] = where
    fixed, problems = {p.symbol for p in system.parameters}, []
    for k, event in enumerate(system.events, start=1):
        continuous, where = dependencies(event.when)
        if where is not None and continuous <= fixed:
            why = f'jumps over zero, which is no crossing: write when = "{where}"'
            problems.append(system.problem(f"event.{k}.when", why))
    if problems:
        raise SceneError(problems)
    return system


def saturate_inputs(system: AnySystem) -> AnySystem:
    """Return a copy of a system in which inputs with limits are saturated at their limits.

    For an input such as `force`, the copy has a new definition `force_limited`, the saturated
    value. It replaces the input in all definitions, forces, events and outputs.
    """
    names = {s.name for s, _ in system.definitions} | system.names | {system.name}
    limited_symbols: dict[Symbol, Symbol] = {}
    for i in system.inputs:
        if any(x is not None for x in i.limits):
            name = f"{i.name}_limited"
            while name in names:
                name += "_too"
            names.add(name)
            limited_symbols[i.symbol] = symbol(name)
    if not limited_symbols:
        return system
    limited = [
        (limited_symbols[i.symbol], i.limited) for i in system.inputs if i.symbol in limited_symbols
    ]
    return replace(
        system,
        definitions=(*limited, *((s, e.xreplace(limited_symbols)) for s, e in system.definitions)),
        forces=tuple(e.xreplace(limited_symbols) for e in system.forces),
        applied=tuple((y, force.xreplace(limited_symbols)) for y, force in system.applied),
        events=tuple(
            replace(
                e,
                when=e.when.xreplace(limited_symbols),
                jump=tuple((name, to.xreplace(limited_symbols)) for name, to in e.jump),
            )
            for e in system.events
        ),
        outputs=tuple(
            replace(o, formula=o.formula.xreplace(limited_symbols)) for o in system.outputs
        ),
    )


# --- parameters that events change ----------------------------------------------------------------


def add_discrete_coordinates(system: AnySystem) -> AnySystem:
    """Return a copy of a system in which parameters that events change are discrete coordinates.

    A discrete coordinate is a coordinate that is constant between events. Raises SceneError in
    three cases: the name of its velocity or acceleration is already in use; the limit of an input
    depends on such a parameter; an event function depends on nothing but parameters.
    """
    jumped = {name for event in system.events for name, _ in event.jump}
    jumped_parameters = [p for p in system.parameters if p.name in jumped]
    if not jumped_parameters:
        return system
    velocities = (
        (f"parameters.{p.name}", f"{p.name}{end}", "a jump sets it, which")
        for p in jumped_parameters
        for end in ("_dot", "_ddot")
    )
    if (
        problems := _report_taken_names(system, velocities)
        + _inputs_with_jumped_limits(system, jumped_parameters)
        + _events_without_motion(system, jumped_parameters)
    ):
        raise SceneError(problems)
    variables = tuple(Coordinate(p.name, p.unit, p.value, note=p.note) for p in jumped_parameters)
    return replace(
        _with_coordinates(system, variables),
        parameters=tuple(p for p in system.parameters if p not in jumped_parameters),
        discrete=tuple(p.name for p in jumped_parameters),
    )


def _with_coordinates(system: AnySystem, variables: Sequence[Coordinate]) -> AnySystem:
    """Return a copy of a system with further, discrete coordinates, on which no force acts."""
    energy = sympy.Add(*(c.qd**2 / 2 for c in variables))
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic + energy)
    forces = system.forces or [S.Zero] * len(system.coordinates)
    return replace(
        system,
        coordinates=(*system.coordinates, *variables),
        kinetic=system.kinetic + energy,
        forces=(*forces, *[S.Zero] * len(variables)),
        tree=tree,
    )


def _without_coordinates(system: AnySystem, names: Collection[str]) -> AnySystem:
    """Return a copy of a system without some discrete coordinates and without any events."""
    energy = sympy.Add(*(c.qd**2 / 2 for c in system.coordinates if c.name in names))
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic - energy)
    pairs = zip(system.coordinates, system.forces or (), strict=False)
    return replace(
        system,
        coordinates=tuple(c for c in system.coordinates if c.name not in names),
        kinetic=system.kinetic - energy,
        forces=tuple(force for c, force in pairs if c.name not in names),
        events=(),
        tree=tree,
    )


def _report_taken_names(
    system: Mechanics, requests: Iterable[tuple[str, str, str]]
) -> list[Problem]:
    """Report names that are needed, but that the scene has already.

    requests: tuples (key in the scene, name, what needs the name).
    """
    taken = {
        *system.names, *(s.name for s, _ in system.definitions), *(o.name for o in system.outputs),
        *(r.name for r in system.constraints), *(e.name for e in system.events),
    }  # fmt: skip
    return [
        system.problem(key, f"{what} needs the name '{name}': rename yours")
        for key, name, what in requests
        if name in taken
    ]


def _inputs_with_jumped_limits(
    system: Mechanics, jumped_parameters: list[Parameter]
) -> list[Problem]:
    """Report inputs whose limits depend on discrete variables."""
    names = {p.name for p in jumped_parameters}
    return [
        system.problem(
            f"inputs.{u.name}.limits",
            f"a jump sets '{min(jumped)}', and limits stay the same throughout a run: leave out"
            f" these limits, and write min and max around '{u.name}' where it acts",
        )
        for u in system.inputs
        if (jumped := names & {str(s) for end in u.limits if end for s in end.free_symbols})
    ]


def _events_without_motion(system: Mechanics, jumped_parameters: list[Parameter]) -> list[Problem]:
    """Report event functions of discrete variables alone, which are constant between jumps."""
    jumped, constant = {p.name for p in jumped_parameters}, {p.name for p in system.parameters}
    problems = []
    for k, event in enumerate(system.events, start=1):
        names = {str(s) for s in event.when.free_symbols}
        if names & jumped and names <= constant:
            problems.append(
                system.problem(
                    f"event.{k}.when",
                    f"only jumps change '{min(names & jumped)}', and a jump over zero is no "
                    'crossing: let the jump set a time, until = "t + 1e-6" with a parameter '
                    'until = 1e9, and write when = "t - until"',
                )
            )
    return problems


def with_constant_parameters(system: AnySystem) -> AnySystem:
    """Return a copy of a system in which discrete coordinates are parameters again.

    A discrete coordinate stands for a parameter that events change. The copy has no events, and the
    value of each such parameter is the initial value of the discrete coordinate. A system without
    discrete coordinates is returned unchanged, with its events.
    """
    if not system.discrete:
        return system
    variables = (c for c in system.coordinates if c.name in system.discrete)
    parameters = (Parameter(c.name, c.start, c.unit, c.note) for c in variables)
    return replace(
        _without_coordinates(system, system.discrete),
        parameters=(*system.parameters, *parameters),
        discrete=(),
    )


# --- friction -------------------------------------------------------------------------------------

NOTE = "1 where {name} slides forwards, -1 backwards, 0 where it sticks"


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
    for f in frictions:
        forces_by_name[f.coordinate] = forces_by_name.get(f.coordinate, S.Zero) + f.force
    names = (
        ("run.friction", f"{name}_{word}", '"stick"')
        for name in forces_by_name
        for word in ("slides", "slides_dot", "sticks", "stops", "slips")
    )
    if taken := _report_taken_names(system, names):
        raise SceneError(taken)
    index = {c.name: k for k, c in enumerate(system.coordinates)}
    modes = tuple(
        FrictionMode(len(index) + n, index[name]) for n, name in enumerate(forces_by_name)
    )
    sliding_forces: dict[int, Expr] = {}
    states, rows, events = [], [], []
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
        sliding_forces[mode.of] = -force * s.q
        states.append(s)
        rows.append(row)
        events += _transitions(c, s, force, row)
        sliding[c.qd.name] = s.name
    whole = _with_coordinates(system, states)
    return replace(
        whole,
        forces=tuple(f + sliding_forces.get(k, S.Zero) for k, f in enumerate(whole.forces)),
        constraints=(*system.constraints, *rows),
        events=(*(_set_modes(e, sliding) for e in system.events), *events),
        modes=modes,
    )


def _side(rate: float) -> float:
    return float((rate > 0) - (rate < 0))


def _transitions(c: Coordinate, s: Coordinate, force: Expr, row: Constraint) -> list[Event]:
    """Return the two transitions: to sticking where the velocity vanishes, to slip where friction
    cannot prevent it.

    If several joints start to slip at one time, each is treated separately. A joint that another
    one drives back sticks again as soon as it moves.
    """
    residual, pivot = row.parts
    sticks = ((c.qd.name, S.Zero), (s.name, S.Zero))
    slips = sympy.Abs(residual) - force * pivot - s.q**2
    goes = ((c.qd.name, S.Zero), (s.name, -sympy.sign(residual)))
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
    initial values are computed that satisfy all other constraints; `with_discrete_coordinates` then
    transfers them to the original system.
    """
    modes = [system.coordinates[mode.at] for mode in system.modes]
    sticking = {c.q: S.Zero for c in modes}
    core = _without_coordinates(system, [c.name for c in modes])
    return replace(
        core,
        forces=tuple(force.xreplace(sticking) for force in core.forces),
        constraints=system.constraints[: len(system.constraints) - len(modes)],
        modes=(),
        closure=None,
    )


def with_discrete_coordinates(system: AnySystem, core: AnySystem) -> AnySystem:
    """Return a copy of a system with discrete coordinates that has the initial values of `core`.

    core: the result of `without_modes` or `with_constant_parameters` for the system, after its
    initial values were adjusted to its constraints. The copy also has the constraints of `core` and
    their summary. The initial friction modes are computed from the initial velocities.
    """
    coordinates = [*core.coordinates, *system.coordinates[len(core.coordinates) :]]
    for m in system.modes:
        coordinates[m.at] = replace(coordinates[m.at], start=_side(coordinates[m.of].rate))
    own, count = system.constraints[len(core.constraints) :], len(system.modes)
    summary = core.closure or ConstraintSummary((), len(core.rates), 0)
    closure = replace(
        summary,
        rows=(*summary.rows, *(row.name for row in own)),
        coordinates=summary.coordinates + count,
        rank=summary.rank + len(own),
        weights=(*summary.weights, *[0.0] * len(own)) if summary.weights else (),
        slopes=(*summary.slopes, *[0.0] * len(own)),
    )
    return replace(
        system,
        coordinates=tuple(coordinates),
        constraints=(*core.constraints, *own),
        closure=closure,
        warnings=core.warnings,
    )
