"""Why a start can't be assembled: the rows and held values that contradict, and by how much."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from eomc.base.errors import Problem
from eomc.base.texts import listed
from eomc.model.symbols import Constraint
from eomc.program.manifold import Flags, Frame, Manifold, Place, Vector

PART = 0.01  # of the row that is furthest from zero: a row contradicts
MOST = 12  # held values that are let go one by one
FAR = 3  # values that a message proposes


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
            left = ", ".join(
                f"{system.constraints[k].name} is {stuck.phi[k]:.2g}" for k in rows[:FAR]
            )
            message = (
                f"can't be zero{others} near the start: where they are least, {left}. "
                "Correct a formula or a parameter"
                + (f", {held} that are held," if involved else "")
                + " or give a guess closer to a position that closes"
            )
    yield system.problem(key(row), message)


def of_rates(
    manifold: Manifold, free: Flags, place: Place, q: Sequence[Any], rates: Vector
) -> Iterator[Problem]:
    """What is wrong with the rates of a start. rates: those that leave the rows least off."""
    system = manifold.system
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
    frame = Frame(place, np.ones(len(free), dtype=bool), manifold.rows)
    if ways:
        told = ", or ".join(text for _, text in sorted(ways)[:FAR])
        message = (
            f"changes at the start{others}, with {given} held: {told}. Correct a rate, or leave "
            "it out, and it follows"
        )
    elif frame.parts[1][-1] < 1e-6:
        message = (
            f"changes at the start{others}, and no rates mend it: the start is a singular position"
        )
    else:
        message = (
            f"changes at the start{others}, with {given} held, nor does one of them alone mend it: "
            "leave them out, and they follow"
        )
    yield system.problem(key(row), message)


def _closed(manifold: Manifold, free: Flags, stuck: Place) -> Place | None:
    """Where the rows hold with those coordinates free, close to where they do not."""
    for strict in (True, False):
        found, held = manifold.descend(stuck.q, free, stuck.t, strict)
        if held and found is not None:
            return found
    return None


def _beside(constraints: Sequence[Constraint], rows: Sequence[int]) -> str:
    others = [constraints[k].name for k in rows[1:]]
    return f" together with {listed(others)}" if others else ""


def _to(before: float, after: float) -> str:
    """The value it would need, with digits enough to show the difference."""
    for digits in range(4, 18):
        one, other = f"{before:.{digits}g}", f"{after:.{digits}g}"
        if one != other and abs(float(other) - after) < 0.05 * abs(after - before):
            break
    return f"would have to be {other} ({after - before:+.2g})"
