"""Consistent initial values of a system with constraints, and its independent constraints.

Initial values that a scene gives are fixed. The others change as little as possible from their
guesses, in the metric of D, until the constraints are satisfied. Newton's method takes small steps,
so that a loop closes on the branch of its guess where there is one. The result is refined to forty
digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eomc.base.errors import Problem, SceneError
from eomc.base.texts import listed
from eomc.mechanism.inconsistency import (
    constraints_without_gradient,
    gradient_problems,
    position_problems,
    scene_key,
    value_problems,
    velocity_problems,
)
from eomc.mechanism.manifold import (
    EXACT_ROUNDING,
    HALF_TURN_RESIDUAL,
    ROUNDING,
    ROUNDING_FACTOR,
    Configuration,
    Flags,
    Manifold,
    Vector,
)
from eomc.mechanism.ranks import Ranks, ranks
from eomc.model import hybrid
from eomc.model.constraints import find_wrong_rotations
from eomc.model.mechanics import ConstraintSummary, Move
from eomc.model.system import System

MIN_SOLVABLE_TIME = 1e-3  # of a run: constraints must be solvable at least so long
REPORTED_CHANGE = 1e-9  # relative to a value: larger changes are reported
RANDOM_STARTS = 16  # tried where the iteration from the guess does not converge
MIN_DISTANCE, MAX_DISTANCE = 0.1, 3.0  # of random starts, in the units of the coordinates
MAX_ROTATION_ERROR = 0.5  # rad: axis equations satisfied at more have a wrong rotation


@dataclass(frozen=True)
class ConsistentStart:
    """Consistent initial values of a system with constraints.

    Attributes
    ----------
    configuration : Configuration
        The constraint equations, their Jacobian and the mass matrix at the initial coordinates.
    q : (nq,)
        The initial coordinates, in forty digits.
    qd : (nq,)
        The initial velocities.
    may_have_changed_branch : bool
        Whether the iteration converged with long steps only. The loops may then be closed in
        another of their possible arrangements (branches) than near the given initial values.
    """

    configuration: Configuration
    q: Sequence[Any]
    qd: Vector
    may_have_changed_branch: bool  # small steps did not converge, longer ones did


def assembled(system: System) -> System:
    """Return a copy of the system whose initial values satisfy its constraints.

    In the copy, constraints that others imply are marked as redundant. Its attribute `closure`
    summarises the constraints and the changes of initial values. A system without constraints, or
    one that is assembled already, is returned unchanged.

    Raises
    ------
    SceneError
        If fixed values violate constraints, or constraints contradict one another.
    """
    if not system.constraints:
        return system
    if system.closure is not None and system.closure.computed_from == _dependencies(system):
        return system
    if system.modes or system.discrete:
        simpler = hybrid.without_modes if system.modes else hybrid.with_constant_parameters
        combined = hybrid.with_discrete_coordinates(system, assembled(simpler(system)))
        assert combined.closure is not None
        closure = replace(combined.closure, computed_from=_dependencies(combined))
        return replace(combined, closure=closure)
    manifold = Manifold(system)
    _refuse_idle(manifold)
    if flat := constraints_without_gradient(system):
        raise SceneError(list(gradient_problems(system, flat)))
    start = _start(manifold)
    constraint_ranks = ranks(manifold, start.configuration)
    constraints = tuple(
        replace(c, redundant=k in constraint_ranks.left_out)
        for k, c in enumerate(system.constraints)
    )
    coordinates = tuple(
        replace(c, start=q, rate=qd)
        for c, q, qd in zip(
            system.coordinates, start.configuration.q.tolist(), start.qd.tolist(), strict=True
        )
    )
    closure = _closure(manifold, start, constraint_ranks)
    changed = replace(system, coordinates=coordinates, constraints=constraints)
    _refuse_wrong_rotations(changed)
    return replace(
        changed,
        closure=replace(closure, computed_from=_dependencies(changed)),
        warnings=(
            *system.warnings,
            *_warnings(manifold, constraint_ranks, closure),
        ),
    )


def _dependencies(system: System) -> tuple[Any, ...]:
    """Return the data on which the assembled start and the ranks depend."""
    return (
        system.coordinates,
        system.constraints,
        system.parameters,
        system.definitions,
        system.kinetic,
        system.linear_potential,
        system.tree,
    )


def _refuse_idle(manifold: Manifold) -> None:
    """Raise SceneError for constraints that depend on no coordinate."""
    system = manifold.system
    idle = [
        system.problem(scene_key(c), "depends on no coordinate: it can hold nothing")
        for k, c in enumerate(system.constraints)
        if not np.any(manifold.reads[k])
    ]
    if idle:
        raise SceneError(idle)


def _start(manifold: Manifold) -> ConsistentStart:
    """Compute consistent initial values. Raises SceneError where there are none."""
    system = manifold.system
    free = np.array([not c.start_fixed for c in system.coordinates])
    guess, rates = np.array([(c.start, c.rate) for c in system.coordinates], float).T
    if not manifold.has_values(guess):
        raise SceneError(list(value_problems(manifold, guess)))
    configuration, strayed = manifold.configuration(guess), False
    q: Sequence[Any] = guess.tolist()
    if configuration is None or _violates_constraints(manifold, configuration, free):
        closest, converged, strayed = _search(manifold, guess, free)
        if closest is None:
            raise SceneError(list(value_problems(manifold, guess)))
        if not converged:
            if _half_turned(manifold, closest):
                _refuse_wrong_rotations(system)
            raise SceneError(list(position_problems(manifold, free, closest)))
        closest = manifold.closest_configuration(closest, guess, free)
        q, _ = manifold.refine(closest, free)
        rounded = np.where(free, _rounded(closest, q), guess)
        configuration = manifold.configuration(rounded) or closest
    return ConsistentStart(configuration, q, _rates(manifold, configuration, q, rates), strayed)


def _search(
    manifold: Manifold, guess: Vector, free: Flags
) -> tuple[Configuration | None, bool, bool]:
    """Return a configuration near a guess, whether it satisfies the constraints, and whether it may
    be on another branch.

    Tries small steps from the guess, then longer ones, then random starts at increasing distance:
    at the guess itself gradients may vanish, or a rotation error be half a turn.
    """
    first: Configuration | None = None
    for strict in (True, False):
        closest, converged = manifold.gauss_newton(guess, free, strict=strict)
        if converged:
            return closest, True, not strict
        first = closest or first
    random = np.random.default_rng(41)
    for reach in np.geomspace(MIN_DISTANCE, MAX_DISTANCE, RANDOM_STARTS):
        start = guess + np.where(free, reach * random.uniform(-1, 1, len(guess)), 0.0)
        closest, converged = manifold.gauss_newton(start, free, strict=False)
        if converged:
            return closest, True, True
        first = first or closest
    return first, False, True


def _half_turned(manifold: Manifold, configuration: Configuration) -> bool:
    """Whether some loop has a rotation error of half a turn at a configuration and near it."""
    axes = [k for rows in manifold.rotations for k in rows]
    random = np.random.default_rng(43)
    nearby = manifold.configuration(
        configuration.q + random.uniform(-1, 1, len(configuration.q)), configuration.t
    )
    both = [p.phi[axes] >= HALF_TURN_RESIDUAL for p in (configuration, nearby) if p is not None]
    return bool(np.any(np.all(both, axis=0)))


def _violates_constraints(manifold: Manifold, configuration: Configuration, free: Flags) -> bool:
    """Whether some residual exceeds its rounding error, or a wrong rotation satisfies it."""
    q, axes = configuration.q, [k for rows in manifold.rotations for k in rows]
    if np.any(np.abs(configuration.phi[axes]) > MAX_ROTATION_ERROR):
        return True
    exact = manifold.exact_value("constraints", q.tolist(), [0.0] * len(q), 0.0)
    off = np.abs([float(x) for x in exact])[manifold.holonomic]
    rounding = manifold.rounding(q, 0 * q, 0.0)[manifold.holonomic]
    moves = np.any(manifold.reads[:, free], axis=1)[manifold.holonomic]
    return bool(np.any(off > np.where(moves, 1, ROUNDING_FACTOR) * rounding))


def _rates(
    manifold: Manifold, configuration: Configuration, q: Sequence[Any], rates: Vector
) -> Vector:
    """Compute consistent velocities. Raises SceneError where fixed ones violate constraints."""
    free = np.array([not c.rate_fixed for c in manifold.system.coordinates])

    def satisfies_constraints(rates: Vector) -> bool:
        off = np.abs(manifold.value("constraint_rates", configuration.q, rates, 0.0))
        rounding = manifold.rounding(configuration.q, rates, 0.0, "constraint_rates")
        return bool(np.all(off <= ROUNDING_FACTOR * rounding))

    if satisfies_constraints(rates):
        return rates
    solution, converged = manifold.rates(configuration, list(q), rates, free)
    rounded = np.where(free, _rounded(configuration, solution), rates)
    if not (converged or satisfies_constraints(rounded)):
        problems = velocity_problems(manifold, free, configuration, list(q), rounded)
        raise SceneError(list(problems))
    return rounded


def _rounded(configuration: Configuration, exact: Sequence[Any]) -> Vector:
    """Convert numbers of forty digits to doubles; negligible ones become 0."""
    values = np.array([float(x) for x in exact])
    sizes = np.sqrt(np.diag(configuration.metric)) * np.abs(values)
    return np.where(sizes > EXACT_ROUNDING * np.linalg.norm(sizes), values, 0.0)


def _moves(
    names: Sequence[tuple[str, str]], before: Vector, after: Vector, configuration: Configuration
) -> Iterator[Move]:
    """Yield the changes of initial values that exceed rounding, in the metric of D."""
    sizes = np.sqrt(np.diag(configuration.metric))
    least = ROUNDING * np.linalg.norm(sizes * after) / sizes
    far = np.maximum(REPORTED_CHANGE * np.maximum(np.abs(before), np.abs(after)), least)
    changed = (np.abs(after - before) > far).tolist()
    for (name, unit), one, other, moved in zip(
        names, before.tolist(), after.tolist(), changed, strict=True
    ):
        if moved:
            yield Move(name, one, other, unit)


def _closure(
    manifold: Manifold, start: ConsistentStart, constraint_ranks: Ranks
) -> ConstraintSummary:
    system = manifold.system
    names = [c.name for c in system.constraints]
    guess, rates = np.array([(c.start, c.rate) for c in system.coordinates], float).T
    units = [(c.name, c.unit) for c in system.coordinates]
    speeds = [(f"{c.name}_dot", f"{c.unit}/s" if c.unit else "") for c in system.coordinates]
    return ConstraintSummary(
        rows=tuple(names),
        coordinates=len(system.q),
        rank=constraint_ranks.rank,
        redundant=tuple(names[k] for k in constraint_ranks.left_out),
        shared=tuple(names[k] for k in constraint_ranks.shared),
        start_sigma=constraint_ranks.sigma[0],
        least_sigma=constraint_ranks.sigma[1],
        positions=constraint_ranks.positions,
        weights=constraint_ranks.weights,
        slopes=constraint_ranks.slopes,
        sums=constraint_ranks.sums,
        moves=tuple(_moves(units, guess, start.configuration.q, start.configuration)),
        rate_moves=tuple(_moves(speeds, rates, start.qd, start.configuration)),
        remarks=tuple(_remarks(manifold, start, constraint_ranks)),
    )


def _remarks(manifold: Manifold, start: ConsistentStart, constraint_ranks: Ranks) -> Iterator[str]:
    """Yield messages on unusual properties of the constraints."""
    rows, rank = len(manifold.rows), constraint_ranks.rank
    if start.may_have_changed_branch:
        yield (
            "no position near the guess satisfies the constraints; this initial state is farther "
            "away and may be on another branch than intended: check it"
        )
    if constraint_ranks.rank == len(manifold.system.q):
        yield (
            "no degree of freedom remains: the constraints determine the motion in time"
            if manifold.timed
            else "no degree of freedom remains, and nothing moves: a structure"
        )
    if (
        manifold.timed
        and constraint_ranks.latest <= MIN_SOLVABLE_TIME * manifold.system.run.duration
    ):
        yield (
            "no position satisfies the constraints shortly after the start: they contradict each "
            "other as time increases, or the motion ends at the start"
        )
    elif not constraint_ranks.good:
        yield (
            f"rank {rank} of {rows}, but no {rank} equations are far from singular at every "
            "position: all are used, and an equation that depends on the others is left out there"
        )
    if constraint_ranks.sigma[0] == 0:
        yield (
            "the start is a singular position: equations depend on each other there, and the "
            "motion may have several continuations"
        )


def _refuse_wrong_rotations(system: System) -> None:
    """Raise SceneError for loops that close only with a wrong relative rotation."""
    start = [c.start for c in system.coordinates]
    problems = [
        system.problem(
            f"loop.{name}",
            "can't close as described: in every position the second frame has another orientation, "
            "for example rotated by half a turn. Reverse an axis, or correct rotation",
        )
        for name in find_wrong_rotations(system)(start, 0.0, {})
    ]
    if problems:
        raise SceneError(problems)


def _warnings(
    manifold: Manifold, constraint_ranks: Ranks, closure: ConstraintSummary
) -> Iterator[Problem]:
    """Yield the warnings and notes that a build issues on the constraints."""
    system = manifold.system
    if closure.redundant or closure.sums:
        yield system.problem("constraints", closure.ranks, severity="warning")
    for remark in closure.remarks:
        timely = manifold.timed and constraint_ranks.rank == len(system.q)
        severity = "note" if timely and remark.startswith("no degree of freedom") else "warning"
        yield system.problem("constraints", remark, severity=severity)
    moves = [*closure.moves, *closure.rate_moves]
    if moves:
        text = f"the start is assembled: {listed([str(m) for m in moves])}"
        yield system.problem("coordinates", text, severity="note")
