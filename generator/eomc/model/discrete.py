"""Parameters that jumps set: discrete variables, constant between events.

Each becomes a coordinate, so that runs, batches and C have its value at any time. It is no
coordinate of Lagrange's: nothing is differentiated along it, its rate counts as 0, and
x_dot**2/2 in K, which stands beside all else, leaves it at rest.
"""

from __future__ import annotations

from dataclasses import replace

from eomc.base.errors import Problem, SceneError
from eomc.model.mechanics import Made, Mechanics
from eomc.model.symbols import Coordinate, Parameter


def add_discrete_coordinates(system: Made) -> Made:
    """The system whose parameters that jumps set are discrete variables, behind its coordinates.

    Raises SceneError where a name that one needs is taken, one is a limit of an input, or an
    event watches nothing else.
    """
    jumped = {name for event in system.events for name, _ in event.jump}
    found = [p for p in system.parameters if p.name in jumped]
    if not found:
        return system
    if problems := _taken(system, found) + _limiting(system, found) + _idle(system, found):
        raise SceneError(problems)
    more = tuple(Coordinate(p.name, p.unit, p.value, note=p.note) for p in found)
    energy = sum(c.qd**2 for c in more) / 2
    tree = system.tree and replace(system.tree, beside_kinetic=system.tree.beside_kinetic + energy)
    return replace(
        system,
        coordinates=(*system.coordinates, *more),
        kinetic=system.kinetic + energy,
        forces=system.forces and (*system.forces, *[0 * energy] * len(more)),
        parameters=tuple(p for p in system.parameters if p not in found),
        discrete=tuple(p.name for p in found),
        tree=tree,
    )


def _taken(system: Mechanics, found: list[Parameter]) -> list[Problem]:
    """Names of the scene's that the rates of discrete variables need."""
    known = {*system.names, *(s.name for s, _ in system.definitions)}
    known |= {o.name for o in system.outputs}
    return [
        system.problem(
            f"parameters.{p.name}", f"a jump sets it, which needs the name '{name}': rename yours"
        )
        for p in found
        for name in (f"{p.name}_dot", f"{p.name}_ddot")
        if name in known
    ]


def _limiting(system: Mechanics, found: list[Parameter]) -> list[Problem]:
    """Inputs whose limits depend on discrete variables."""
    names = {p.name for p in found}
    return [
        system.problem(
            f"inputs.{u.name}.limits",
            f"a jump sets '{min(jumped)}', and limits stay the same throughout a run: leave out"
            f" these limits, and write min and max around '{u.name}' where it acts",
        )
        for u in system.inputs
        if (jumped := names & {str(s) for end in u.limits if end for s in end.free_symbols})
    ]


def _idle(system: Mechanics, found: list[Parameter]) -> list[Problem]:
    """Events of discrete variables alone, which nothing carries through zero between jumps."""
    jumped, still = {p.name for p in found}, {p.name for p in system.parameters}
    problems = []
    for k, event in enumerate(system.events, start=1):
        names = {str(s) for s in event.when.free_symbols}
        if names & jumped and names <= still:
            problems.append(
                system.problem(
                    f"event.{k}.when",
                    f"only jumps change '{min(names & jumped)}', and a jump over zero is no "
                    'crossing: let the jump set a time, until = "t + 1e-6" with a parameter '
                    'until = 1e9, and write when = "t - until"',
                )
            )
    return problems


def with_constant_parameters(system: Made) -> Made:
    """The system with parameters in place of its discrete variables, which nothing sets."""
    if not system.discrete:
        return system
    own = [c for c in system.coordinates if c.name not in system.discrete]
    more = [c for c in system.coordinates if c.name in system.discrete]
    energy = sum(c.qd**2 for c in more) / 2
    tree = system.tree and replace(system.tree, beside_kinetic=system.tree.beside_kinetic - energy)
    forces = zip(system.coordinates, system.forces or (), strict=False)
    return replace(
        system,
        coordinates=tuple(own),
        kinetic=system.kinetic - energy,
        forces=tuple(force for c, force in forces if c.name not in system.discrete),
        parameters=(
            *system.parameters,
            *(Parameter(c.name, c.start, c.unit, c.note) for c in more),
        ),
        discrete=(),
        events=(),
        tree=tree,
    )


def with_parameters_as_states(system: Made, core: Made) -> Made:
    """The system with start and rows of its `core`, which has parameters and is assembled."""
    more = [c for c in system.coordinates if c.name in system.discrete]
    return replace(
        system,
        coordinates=(*core.coordinates, *more),
        constraints=core.constraints,
        closure=core.closure,
        warnings=core.warnings,
    )
