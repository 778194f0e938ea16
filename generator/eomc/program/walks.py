"""Ways along the positions that rows leave, in steps so small that none leaves its branch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eomc.program.manifold import Flags, Frame, Manifold, Place, Vector

STEPS, HEADINGS = 6, 4  # from one position to the next; that are tried for each
FIRST, LONGEST = 0.1, 0.3  # of a step, in coordinates' own units
BENT = 0.1  # of a step: the correction back onto the rows, at most


def walk(manifold: Manifold, start: Place, positions: int) -> Iterator[Place]:
    """Places that hold the rows, reached from the start by small steps in random directions."""
    random = np.random.default_rng(17)
    free = np.ones(len(start.q), dtype=bool)
    span = manifold.system.run.duration if manifold.timed else 0.0
    place, step, found = start, FIRST, 0
    for _ in range(HEADINGS * positions):
        heading = random.normal(size=len(start.q))
        gone, steps = False, 0
        for _ in range(8 * STEPS):
            frame = Frame(place, free, manifold.holonomic)
            unit = np.sqrt(np.diag(place.metric))
            way = frame.along(heading / unit)
            size = float(np.max(np.abs(way), initial=0))
            drift = span / positions / STEPS * min(1.0, step / FIRST)
            if size <= 1e-12 * float(np.max(1 / unit)) and not drift:
                return  # no freedom
            way = way * (step / size) if size > 0 else way
            there = moved(manifold, place, way, drift, free)
            if there is None:
                step /= 2
                if step < 1e-9:
                    break
                continue
            place, gone, steps, step = there, True, steps + 1, min(LONGEST, 1.5 * step)
            if steps == STEPS:
                break
        if not gone:  # at a singular position few headings are of a motion
            step = FIRST
            continue
        q, held = manifold.polished(place, free)
        if held:
            place = manifold.place(np.array([float(x) for x in q]), place.t) or place
        yield place
        found += 1
        if found == positions:
            return


def along(
    manifold: Manifold, start: Place, longest: float = LONGEST, to: int = 1
) -> Iterator[Place]:
    """Places on one way along the rows, each a small step from the last: round a linkage.

    to: 1, or -1 for the other way.
    """
    free, place, step = np.ones(len(start.q), dtype=bool), start, FIRST
    way = np.random.default_rng(17).normal(size=len(start.q)) / np.sqrt(np.diag(start.metric))
    way = to * way
    while step > 1e-9:
        way = Frame(place, free, manifold.holonomic).along(way)
        size = float(np.max(np.abs(way), initial=0))
        if size == 0:
            return
        there = moved(manifold, place, way * (step / size), 0.0, free)
        if there is None:
            step /= 2
            continue
        place, step = there, min(longest, 1.5 * step)
        yield place


def moved(manifold: Manifold, place: Place, way: Vector, drift: float, free: Flags) -> Place | None:
    """The place a step on; None where it is too long to be sure of it."""
    aimed = manifold.place(place.q + way, place.t + drift)
    if aimed is None:
        return None
    frame = Frame(aimed, free, manifold.holonomic)
    length = frame.length(way) + 1e-9 * frame.length(np.ones(len(way)))
    if not drift and frame.length(frame.onto(aimed.phi)) > BENT * length:
        return None
    found, held = manifold.descend(aimed.q, free, aimed.t)
    if not held or found is None:
        return None
    return found if drift or frame.length(found.q - aimed.q) <= 2 * BENT * length else None
