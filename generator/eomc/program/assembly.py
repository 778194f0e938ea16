"""The assembled start of a system with constraints, and the rows that are solved for.

What a scene gives is held; the rest moves least from its guess, in the metric of D, until the rows
are zero. Newton's method goes there by small ways, so that a guess is closed on its own branch
where it has one, and ends in forty digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eomc.base.errors import Problem, SceneError
from eomc.base.texts import listed
from eomc.model import coulomb_friction, discrete, loops
from eomc.model.constraint_report import ConstraintSummary, Move
from eomc.model.system import System
from eomc.program import contradictions
from eomc.program.manifold import AWAY, ROUNDED, Flags, Manifold, Place, Vector
from eomc.program.ranks import Ranks, ranks

NOTHING = 1e-25  # of all values together, as lengths: what forty digits leave of a zero
BEGUN = 1e-3  # of a run: rows that hold no longer do not hold
SHOWN = 1e-9  # of a value: a coordinate has moved
ROUNDING = 1e-13  # of all values together: what a coordinate that is 0 may move by
STARTS = 16  # random starts that are tried where the search from the guess ends nowhere
NEAREST, FARTHEST = 0.1, 3.0  # how far they lie from the guess, in coordinates' own units or rad
ROTATED = 0.5  # rad: rows of axes that hold all the same hold after some other rotation


@dataclass(frozen=True)
class Start:
    """An assembled start: where it is, in doubles and forty digits, and its rates."""

    place: Place
    q: Sequence[Any]
    qd: Vector
    strayed: bool  # small ways led to no position, and longer ones were taken


def assembled(system: System) -> System:
    """The system with its start assembled, rows that others imply marked, and its `closure`.

    A system without constraints, or that has been assembled, is returned as it is. Raises
    SceneError where held values contradict rows, or rows each other.
    """
    if not system.constraints:
        return system
    if system.closure is not None and system.closure.made_for == _made_for(system):
        return system
    if system.modes or system.discrete:
        if system.modes:
            made = coulomb_friction.with_modes(
                system, assembled(coulomb_friction.without_modes(system))
            )
        else:
            made = discrete.with_parameters_as_states(
                system, assembled(discrete.with_constant_parameters(system))
            )
        assert made.closure is not None
        return replace(made, closure=replace(made.closure, made_for=_made_for(made)))
    manifold = Manifold(system)
    _refuse_idle(manifold)
    if flat := contradictions.powers(system):
        raise SceneError(list(contradictions.of_slopes(system, flat)))
    start = _start(manifold)
    found = ranks(manifold, start.place)
    if found.rank == 0:
        raise SceneError(list(contradictions.of_slopes(system, found.flat)))
    if found.loose:
        raise SceneError([contradictions.of_inertia(manifold, found.loose, start.place)])
    constraints = tuple(
        replace(c, redundant=k in found.left_out) for k, c in enumerate(system.constraints)
    )
    coordinates = tuple(
        replace(c, start=q, rate=qd)
        for c, q, qd in zip(
            system.coordinates, start.place.q.tolist(), start.qd.tolist(), strict=True
        )
    )
    closure = _closure(manifold, start, found)
    made = replace(system, coordinates=coordinates, constraints=constraints)
    _refuse_wrong_rotations(made)
    return replace(
        made,
        closure=replace(closure, made_for=_made_for(made)),
        warnings=(
            *system.warnings,
            *_warnings(manifold, found, closure),
        ),
    )


def _made_for(system: System) -> tuple[Any, ...]:
    """What the assembled start and the ranks depend on."""
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
    """Raise SceneError for rows that no coordinate moves."""
    system = manifold.system
    idle = [
        system.problem(contradictions.key(c), "depends on no coordinate: it can hold nothing")
        for k, c in enumerate(system.constraints)
        if not np.any(manifold.reads[k])
    ]
    if idle:
        raise SceneError(idle)


def _start(manifold: Manifold) -> Start:
    """The assembled start. Raises SceneError where there is none."""
    system = manifold.system
    free = np.array([not c.held for c in system.coordinates])
    guess, rates = np.array([(c.start, c.rate) for c in system.coordinates], float).T
    if not manifold.has_values(guess):
        raise SceneError(list(contradictions.of_values(manifold, guess)))
    place, strayed = manifold.place(guess), False
    q: Sequence[Any] = guess.tolist()
    if place is None or _off(manifold, place, free):
        found, held, strayed = _search(manifold, guess, free)
        if found is None:
            raise SceneError(list(contradictions.of_values(manifold, guess)))
        if not held:
            if _half_turned(manifold, found):
                _refuse_wrong_rotations(system)
            raise SceneError(list(contradictions.of_positions(manifold, free, found)))
        found = manifold.nearest(found, guess, free)
        q, _ = manifold.polished(found, free)
        rounded = np.where(free, _rounded(found, q), guess)
        place = manifold.place(rounded) or found
    return Start(place, q, _rates(manifold, place, q, rates), strayed)


def _search(manifold: Manifold, guess: Vector, free: Flags) -> tuple[Place | None, bool, bool]:
    """A place near a guess, whether the rows hold there, and whether it may be on another branch.

    By small ways from the guess, by longer ones, and then from random starts around it, ever
    further away: at the guess itself rows may have no slope, or rotations be half a turn off.
    """
    first: Place | None = None
    for strict in (True, False):
        found, held = manifold.descend(guess, free, strict=strict)
        if held:
            return found, True, not strict
        first = found or first
    random = np.random.default_rng(41)
    for reach in np.geomspace(NEAREST, FARTHEST, STARTS):
        start = guess + np.where(free, reach * random.uniform(-1, 1, len(guess)), 0.0)
        found, held = manifold.descend(start, free, strict=False)
        if held:
            return found, True, True
        first = first or found
    return first, False, True


def _half_turned(manifold: Manifold, place: Place) -> bool:
    """Whether some loop stands half a turn off at a place, and elsewhere too."""
    axes = [k for rows in manifold.rotations for k in rows]
    random = np.random.default_rng(43)
    beside = manifold.place(place.q + random.uniform(-1, 1, len(place.q)), place.t)
    both = [p.phi[axes] >= AWAY for p in (place, beside) if p is not None]
    return bool(np.any(np.all(both, axis=0)))


def _off(manifold: Manifold, place: Place, free: Flags) -> bool:
    """Whether some row is further from zero than doubles can tell: a rounding where it can move."""
    q, axes = place.q, [k for rows in manifold.rotations for k in rows]
    if np.any(np.abs(place.phi[axes]) > ROTATED):
        return True
    exact = manifold.exactly("constraints", q.tolist(), [0.0] * len(q), 0.0)
    off = np.abs([float(x) for x in exact])[manifold.holonomic]
    rounding = manifold.rounding(q, 0 * q, 0.0)[manifold.holonomic]
    moves = np.any(manifold.reads[:, free], axis=1)[manifold.holonomic]
    return bool(np.any(off > np.where(moves, 1, ROUNDED) * rounding))


def _rates(manifold: Manifold, place: Place, q: Sequence[Any], rates: Vector) -> Vector:
    """The assembled rates. Raises SceneError where held ones contradict rows."""
    free = np.array([not c.held_rate for c in manifold.system.coordinates])
    off = manifold.value("constraint_rates", place.q, rates, 0.0)
    limit = ROUNDED * manifold.rounding(place.q, rates, 0.0, "constraint_rates")
    if np.all(np.abs(off) <= limit):
        return rates
    found, held = manifold.rates(place, list(q), rates, free)
    rounded = np.where(free, _rounded(place, found), rates)
    if not held:
        off = np.abs(manifold.value("constraint_rates", place.q, rounded, 0.0))
        limit = ROUNDED * manifold.rounding(place.q, rounded, 0.0, "constraint_rates")
        if np.any(off > limit):
            problems = contradictions.of_rates(manifold, free, place, list(q), rounded)
            raise SceneError(list(problems))
    return rounded


def _rounded(place: Place, exact: Sequence[Any]) -> Vector:
    """Numbers of forty digits as doubles; 0 of what is nothing beside the others."""
    found = np.array([float(x) for x in exact])
    sizes = np.sqrt(np.diag(place.metric)) * np.abs(found)
    return np.where(sizes > NOTHING * np.linalg.norm(sizes), found, 0.0)


def _moves(
    names: Sequence[tuple[str, str]], before: Vector, after: Vector, place: Place
) -> Iterator[Move]:
    """What has moved, as far as that is something beside all values together, as lengths."""
    sizes = np.sqrt(np.diag(place.metric))
    least = ROUNDING * np.linalg.norm(sizes * after) / sizes
    far = np.maximum(SHOWN * np.maximum(np.abs(before), np.abs(after)), least)
    told = (np.abs(after - before) > far).tolist()
    for (name, unit), one, other, moved in zip(
        names, before.tolist(), after.tolist(), told, strict=True
    ):
        if moved:
            yield Move(name, one, other, unit)


def _closure(manifold: Manifold, start: Start, found: Ranks) -> ConstraintSummary:
    system = manifold.system
    names = [c.name for c in system.constraints]
    guess, rates = np.array([(c.start, c.rate) for c in system.coordinates], float).T
    units = [(c.name, c.unit) for c in system.coordinates]
    speeds = [(f"{c.name}_dot", f"{c.unit}/s" if c.unit else "") for c in system.coordinates]
    return ConstraintSummary(
        rows=tuple(names),
        coordinates=len(system.q),
        rank=found.rank,
        redundant=tuple(names[k] for k in found.left_out),
        shared=tuple(names[k] for k in found.shared),
        start_sigma=found.sigma[0],
        least_sigma=found.sigma[1],
        positions=found.positions,
        weights=found.weights,
        slopes=found.slopes,
        sums=found.sums,
        moves=tuple(_moves(units, guess, start.place.q, start.place)),
        rate_moves=tuple(_moves(speeds, rates, start.qd, start.place)),
        remarks=tuple(_remarks(manifold, start, found)),
    )


def _remarks(manifold: Manifold, start: Start, found: Ranks) -> Iterator[str]:
    """What is unusual, in words."""
    rows = len(manifold.rows)
    if start.strayed:
        yield (
            "small ways from the guess lead to no position that the rows leave; longer ones led to "
            "this start, which may lie on another branch than was meant: look at it"
        )
    if found.rank == len(manifold.system.q):
        yield (
            "no freedom is left: the rows alone decide the motion in time"
            if manifold.timed
            else "no freedom is left, and nothing moves: a structure under its load"
        )
    if manifold.timed and found.latest <= BEGUN * manifold.system.run.duration:
        yield (
            "no position obeys the rows a little later: they contradict one another as time goes "
            "on, or the start is where the motion ends"
        )
    elif not found.good:
        yield (
            f"rank {found.rank} of {rows}, but no {found.rank} rows are far from singular at every "
            "position: all are kept, and where a row depends on the others it is dropped"
        )
    if found.sigma[0] == 0:
        yield (
            "the start is a singular position: rows depend on each other there, and the motion may "
            "go on in more ways than one"
        )


def _refuse_wrong_rotations(system: System) -> None:
    """Raise SceneError for loops whose frames stand in a wrong rotation wherever they move."""
    start = [c.start for c in system.coordinates]
    found = [
        system.problem(
            f"loop.{name}",
            "can't close as is meant: wherever its bodies move, the second frame stands in another "
            "rotation, such as half a turn off. Reverse an axis, or correct rotation",
        )
        for name in loops.find_wrong_rotations(system)(start, 0.0, {})
    ]
    if found:
        raise SceneError(found)


def _warnings(manifold: Manifold, found: Ranks, closure: ConstraintSummary) -> Iterator[Problem]:
    """What a build says of it."""
    system = manifold.system
    if closure.redundant or closure.sums:
        yield system.problem("constraints", closure.ranks, severity="warning")
    for remark in closure.remarks:
        timely = manifold.timed and found.rank == len(system.q)
        severity = "note" if timely and remark.startswith("no freedom") else "warning"
        yield system.problem("constraints", remark, severity=severity)
    moves = [*closure.moves, *closure.rate_moves]
    if moves:
        text = f"the start is assembled: {listed([str(m) for m in moves])}"
        yield system.problem("coordinates", text, severity="note")
