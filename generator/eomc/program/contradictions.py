"""Why a start can't be assembled: the rows and held values that contradict, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sympy import Add, Integer, sqf_part

from eomc.base.errors import Problem
from eomc.base.texts import listed
from eomc.model.symbols import Constraint
from eomc.model.system import System
from eomc.program.factors import powers_alone
from eomc.program.manifold import RANK_TOLERANCE, Flags, Frame, Manifold, Place, Vector

PART = 0.01  # of the row that is furthest from zero: a row contradicts
MOST = 12  # held values that are let go one by one
FAR = 3  # values that a message proposes
FEW, SMALL = 8, 24  # rows that are left out one by one, and coordinates of a system where they are
PLACES = 6  # beside one, at which rows are compared
ALONE = "None changes alone: leave one out, or correct a formula or a parameter"
BY_ITSELF = "each thing that is zero by itself, x and y for x**2 + y**2"
LONGEST = 60  # characters of a formula that a message writes out
NEAR = 0.1  # of the coordinates' size: how far beside


def key(row: Constraint) -> str:
    """Where a scene has the row."""
    return f"loop.{row.loop}" if row.loop else f"constraints.{row.name}"


def of_positions(manifold: Manifold, free: Flags, stuck: Place) -> Iterator[Problem]:
    """What is wrong with a start. stuck: where assembling it ended."""
    system = manifold.system
    step = Frame(stuck, free, manifold.holonomic).exactly_onto(stuck.phi)
    nearer = manifold.place(stuck.q + step, stuck.t)
    stuck = nearer if nearer is not None and nearer.off <= stuck.off else stuck
    off = np.abs(stuck.phi / stuck.sizes)
    rows = [k for k in manifold.holonomic if off[k] > PART * np.max(off)]
    involved = [k for k in np.flatnonzero(free == 0) if np.any(manifold.reads[rows, k])]
    ways: list[tuple[float, str]] = []
    for k in involved[:MOST]:
        found = _closed(manifold, free | (np.arange(len(free)) == k), stuck)
        if found is not None:
            c = system.coordinates[k]
            ways.append((abs(found.q[k] - c.start), f"{c.name} {_to(c.start, found.q[k])}"))
    row = system.constraints[rows[0]]
    held = listed([f"{system.coordinates[k].name} = {stuck.q[k]:.6g}" for k in involved])
    others = _beside(system.constraints, rows)
    if ways:
        told = ", or ".join(text for _, text in sorted(ways)[:FAR])
        message = (
            f"can't be zero{others} with {held} held: {told}. Correct a start, or let it move: "
            "guess = true"
        )
    else:
        whole = _closed(manifold, np.ones(len(free), dtype=bool), stuck) if involved else None
        if whole is not None:
            moved = [
                f"{system.coordinates[k].name} {_to(stuck.q[k], whole.q[k])}" for k in involved
            ]
            message = (
                f"can't be zero{others} with {held} held, nor with one of them let go: together "
                f"{', '.join(moved)}. Correct them, or let them move: guess = true"
            )
        else:
            yield _apart(manifold, rows, stuck)
            return
    yield system.problem(key(row), message)


def of_rates(
    manifold: Manifold, free: Flags, place: Place, q: Sequence[Any], rates: Vector
) -> Iterator[Problem]:
    """What is wrong with the rates of a start. rates: those that leave the rows least off."""
    system = manifold.system
    if clash := _clash(manifold, place):
        yield _apart_in_time(manifold, clash, place)
        return
    off = np.abs(manifold.value("constraint_rates", place.q, rates, 0.0) / place.sizes)
    rows = [k for k in manifold.rows if off[k] > PART * np.max(off)]
    involved = [k for k in np.flatnonzero(free == 0) if np.any(place.A[rows, k] != 0)]
    ways: list[tuple[float, str]] = []
    for k in involved[:MOST]:
        found, held = manifold.rates(place, list(q), rates, free | (np.arange(len(free)) == k))
        rate = system.coordinates[k].rate
        if held:
            name = f"{system.coordinates[k].name}_dot"
            ways.append((abs(float(found[k]) - rate), f"{name} {_to(rate, float(found[k]))}"))
    row, others = system.constraints[rows[0]], _beside(system.constraints, rows)
    given = listed([f"{system.coordinates[k].name}_dot = {rates[k]:.6g}" for k in involved])
    if ways:
        told = ", or ".join(text for _, text in sorted(ways)[:FAR])
        message = (
            f"changes at the start{others}, with {given} held: {told}. Correct a rate, or leave "
            "it out, and it follows"
        )
    else:
        message = (
            f"changes at the start{others}, with {given} held, nor does one of them alone mend it: "
            "leave them out, and they follow"
        )
    yield system.problem(key(row), message)


def _apart(manifold: Manifold, rows: Sequence[int], stuck: Place) -> Problem:
    """Rows that no positions near make zero together, whatever is held."""
    constraints = manifold.system.constraints
    rows = _needed(manifold, rows, stuck)
    left = ", ".join(f"{constraints[k].name} is {stuck.phi[k]:.2g}" for k in rows[:FAR])
    row, others = constraints[rows[0]], _beside(constraints, rows)
    if len(rows) > 1 and _alike(manifold, rows, stuck):
        why = f"contradicts {_names(constraints, rows[1:])}: where they are least, {left}. {ALONE}"
    else:
        leave = ", leave one out," if others else ""
        why = (
            f"can't be zero{others} near the start: the search for a position ends where {left}. "
            f"Correct a formula or a parameter{leave} or start closer to a position that closes"
        )
    return manifold.system.problem(key(row), why)


def _apart_in_time(manifold: Manifold, rows: Sequence[int], place: Place) -> Problem:
    """Rows that no rates keep at zero, whatever is held."""
    constraints = manifold.system.constraints
    row, others = constraints[rows[0]], _beside(constraints, rows)
    if len(rows) > 1 and _alike(manifold, rows, place):
        why = f"contradicts {_names(constraints, rows[1:])}: no rates keep them zero. {ALONE}"
    else:
        why = (
            f"changes at the start{others}, and no rates mend it: the start is a singular "
            "position. Start beside it, or correct a formula"
        )
    return manifold.system.problem(key(row), why)


def _needed(manifold: Manifold, rows: Sequence[int], stuck: Place) -> list[int]:
    """Rows that contradict, without those that nothing depends on."""
    system, free = manifold.system, np.ones(len(stuck.q), dtype=bool)
    if not 2 < len(rows) <= FEW or len(free) > SMALL:
        return list(rows)

    def closes(some: Sequence[int]) -> bool:
        alone = Manifold(replace(system, constraints=tuple(system.constraints[k] for k in some)))
        return _closed(alone, free, stuck) is not None

    return _fewest(rows, closes)


def _fewest(rows: Sequence[int], hold: Callable[[Sequence[int]], bool]) -> list[int]:
    """Rows without those that the others fail to hold without, the last of them first."""
    kept = list(rows)
    for k in reversed(rows):
        fewer = [i for i in kept if i != k]
        if fewer and not hold(fewer):
            kept = fewer
    return kept


def _clash(manifold: Manifold, place: Place) -> list[int]:
    """Rows that no rates keep at zero, none of them without need; none where some rates do."""
    A = Frame(place, np.ones(len(place.q), dtype=bool), manifold.rows).B
    aim = manifold.value("constraint_rates", place.q, 0 * place.q, place.t) / place.sizes

    def kept(rows: Sequence[int]) -> bool:
        U, s, _ = np.linalg.svd(A[rows], full_matrices=False)
        within = U[:, s > RANK_TOLERANCE]
        left = aim[rows] - within @ (within.T @ aim[rows])
        return bool(np.linalg.norm(left) <= RANK_TOLERANCE * np.linalg.norm(aim))

    return [] if kept(manifold.rows) else _fewest(manifold.rows, kept)


def _alike(manifold: Manifold, rows: Sequence[int], place: Place) -> bool:
    """Whether the rows depend on each other beside a place too."""
    free, random = np.ones(len(place.q), dtype=bool), np.random.default_rng(5)
    reach = NEAR * (float(np.max(np.abs(place.q))) or 1.0)
    for _ in range(PLACES):
        beside = manifold.place(place.q + reach * random.normal(size=len(free)), place.t)
        if beside is not None and len(rows) <= len(free):
            if Frame(beside, free, rows).parts[1][-1] > RANK_TOLERANCE:
                return False
    return True


def powers(system: System) -> list[int]:
    """Rows that their formulas alone show to have no slope where they hold.

    A power above 1, or a sum of even ones, with numbers before them; a power that is written out.
    """
    found, moving = [], {*system.q}
    for k, c in enumerate(system.constraints):
        terms = [term.as_coeff_Mul() for term in Add.make_args(c.formula)]
        exponents = [power.as_base_exp()[1] for _, power in terms]
        signs = {bool(factor > 0) for factor, _ in terms}
        alike = len(signs) == 1 and all(e.is_even and e > 0 for e in exponents)
        alone = len(terms) == 1 and exponents[0].is_number and exponents[0] > 1
        if c.holonomic and (alone or alike or (not c.loop and powers_alone(c.formula, moving))):
            found.append(k)
    return found


def of_slopes(system: System, flat: Sequence[int]) -> Iterator[Problem]:
    """What is wrong with rows that have no slope where they hold: with all, where none is told."""
    for row in [system.constraints[k] for k in flat]:
        base, power = row.formula.as_coeff_Mul()[1].as_base_exp()
        if power == 1 and powers_alone(row.formula, {*system.q}):  # of one that is written out
            base, power = sqf_part(row.formula), Integer(2)
        simple = power.is_number and power != 1 and not base.is_Number and len(str(base)) < LONGEST
        instead = f"{base} for {row.formula}" if simple else BY_ITSELF
        why = f"has no slope where it holds, and so no force: write {instead}"
        yield system.problem(key(row), why)
    if not flat:
        why = f"have no slope where they hold, and so no force: write {BY_ITSELF}"
        yield system.problem("constraints", why)


def of_inertia(system: System, loose: Sequence[int]) -> Problem:
    """What moves without inertia, and without a row that holds it."""
    names = [system.coordinates[k].name for k in loose]
    why = (
        f"{listed(names)} {'can move' if len(names) == 1 else 'can move together'} without moving "
        "anything that has mass or inertia, and no row holds "
        f"{'it' if len(names) == 1 else 'them'}: give what moves a mass, or add a row"
    )
    return system.problem(f"coordinates.{names[0]}", why)


def of_values(manifold: Manifold, q: Vector) -> Iterator[Problem]:
    """What has no value, or no slope, at a start."""
    system, n = manifold.system, 0
    for k, c in enumerate(system.constraints):
        alone = Manifold(replace(system, constraints=(c,)))
        what = ("constraints", "value"), ("constraint_jacobian", "slope")
        for name, called in what:
            if not np.all(np.isfinite(alone.value(name, q, 0 * q, 0.0))):
                at = _written(manifold, np.flatnonzero(manifold.reads[k]), q)
                why = f"has no {called} at {at}: start where it has one, or guess closer to it"
                yield system.problem(key(c), why)
                n += 1
                break
    if not n:
        at = _written(manifold, range(len(q)), q)
        yield system.problem("energy.kinetic", f"has no value at the start, {at}: start elsewhere")


def _written(manifold: Manifold, some: Iterable[int], q: Vector) -> str:
    names = [(manifold.system.coordinates[k].name, q[k]) for k in some]
    return listed([f"{name} = {value:.6g}" for name, value in names])


def _closed(manifold: Manifold, free: Flags, stuck: Place) -> Place | None:
    """Where the rows hold with those coordinates free, close to where they do not."""
    for strict in (True, False):
        found, held = manifold.descend(stuck.q, free, stuck.t, strict)
        if held and found is not None:
            return found
    return None


def _beside(constraints: Sequence[Constraint], rows: Sequence[int]) -> str:
    return f" together with {_names(constraints, rows[1:])}" if len(rows) > 1 else ""


def _names(constraints: Sequence[Constraint], rows: Sequence[int]) -> str:
    return listed([constraints[k].name for k in rows])


def _to(before: float, after: float) -> str:
    """The value it would need, with digits enough to show the difference."""
    for digits in range(4, 18):
        one, other = f"{before:.{digits}g}", f"{after:.{digits}g}"
        if one != other and abs(float(other) - after) < 0.05 * abs(after - before):
            break
    return f"would have to be {other} ({after - before:+.2g})"
