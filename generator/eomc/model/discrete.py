"""Discrete variables: parameters that state jumps set, constant between events.

Each becomes a coordinate, so that runs, batches and C have its value at any time. It is no
generalized coordinate: no derivative with respect to it is taken and its velocity is 0. The term
x_dot**2/2 in K, which is decoupled from all others, keeps D regular and the variable at rest.
"""

from __future__ import annotations

from dataclasses import replace

from eomc.base.errors import Problem, SceneError
from eomc.model.mechanics import AnySystem, Mechanics
from eomc.model.symbols import Coordinate, Parameter


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
    if (
        problems := _taken(system, jumped_parameters)
        + _limiting(system, jumped_parameters)
        + _idle(system, jumped_parameters)
    ):
        raise SceneError(problems)
    variables = tuple(Coordinate(p.name, p.unit, p.value, note=p.note) for p in jumped_parameters)
    energy = sum(c.qd**2 for c in variables) / 2
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic + energy)
    return replace(
        system,
        coordinates=(*system.coordinates, *variables),
        kinetic=system.kinetic + energy,
        forces=system.forces and (*system.forces, *[0 * energy] * len(variables)),
        parameters=tuple(p for p in system.parameters if p not in jumped_parameters),
        discrete=tuple(p.name for p in jumped_parameters),
        tree=tree,
    )


def _taken(system: Mechanics, jumped_parameters: list[Parameter]) -> list[Problem]:
    """Report names of the scene that coincide with velocities of discrete variables."""
    known = {*system.names, *(s.name for s, _ in system.definitions)}
    known |= {o.name for o in system.outputs}
    return [
        system.problem(
            f"parameters.{p.name}", f"a jump sets it, which needs the name '{name}': rename yours"
        )
        for p in jumped_parameters
        for name in (f"{p.name}_dot", f"{p.name}_ddot")
        if name in known
    ]


def _limiting(system: Mechanics, jumped_parameters: list[Parameter]) -> list[Problem]:
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


def _idle(system: Mechanics, jumped_parameters: list[Parameter]) -> list[Problem]:
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
    own = [c for c in system.coordinates if c.name not in system.discrete]
    variables = [c for c in system.coordinates if c.name in system.discrete]
    energy = sum(c.qd**2 for c in variables) / 2
    tree = system.tree and replace(system.tree, other_kinetic=system.tree.other_kinetic - energy)
    forces = zip(system.coordinates, system.forces or (), strict=False)
    return replace(
        system,
        coordinates=tuple(own),
        kinetic=system.kinetic - energy,
        forces=tuple(force for c, force in forces if c.name not in system.discrete),
        parameters=(
            *system.parameters,
            *(Parameter(c.name, c.start, c.unit, c.note) for c in variables),
        ),
        discrete=(),
        events=(),
        tree=tree,
    )


def with_parameters_as_states(system: AnySystem, core: AnySystem) -> AnySystem:
    """Return a copy of a system with discrete coordinates that has the initial values of `core`.

    core: the result of `with_constant_parameters` for the system, after its initial values were
    adjusted to its constraints. The copy also has the constraints of `core` and their summary.
    """
    variables = [c for c in system.coordinates if c.name in system.discrete]
    return replace(
        system,
        coordinates=(*core.coordinates, *variables),
        constraints=core.constraints,
        closure=core.closure,
        warnings=core.warnings,
    )
