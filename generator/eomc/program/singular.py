"""How near a linkage with one freedom comes to a singular position, all along its way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from eomc.model import discrete, sticking
from eomc.model.system import System
from eomc.program.manifold import Flags, Frame, Manifold, Place, Vector
from eomc.program.walks import along, moved

PLACES = 120  # each way from the start
STEP = 0.1  # from one to the next, at most, in coordinates' own units
REFINED = 40  # steps of the golden section
NOUGHT = 1e-6  # of the largest singular value: the least one is none
AS_NEAR = 1.0001  # times the least: a place is as near
EVEN = 0.999  # times that beside: as good as no change
ROUND = 1e-7  # of the largest coordinate: as good as 0
GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Nearest:
    """sigma: smallest over largest singular value that counts, 0 at a singular position; q there.

    Rows in units of the largest inverse inertia that they have on the way, coordinates in the
    metric of D, so that a row without a slope counts too.
    """

    sigma: float
    q: dict[str, float]

    def __str__(self) -> str:
        where = ", ".join(f"{name} = {x:.6g}" for name, x in self.q.items())
        return f"  sigma_min/sigma_max {self.sigma:.3g} at the worst on its way: {where}"


def nearest(system: System) -> Nearest | None:
    """The place along the motion of an assembled system; None of one with more freedoms than one.

    None too where rows are of rates or depend on the time: positions are then no one way. Of places
    that are as near the one that is reached first.
    """
    system = discrete.constant(sticking.without(system) if system.modes else system)
    manifold, rows = Manifold(system), system.constraints
    rank = system.closure.rank if system.closure else 0
    if manifold.timed or not all(c.holonomic for c in rows) or len(system.q) - rank != 1:
        return None
    start = manifold.place(np.array([c.start for c in system.coordinates], float))
    if start is None:
        return None
    ways = [[start, *islice(along(manifold, start, STEP, to), PLACES)] for to in (1, -1)]
    usual = np.max([place.slopes for way in ways for place in way], axis=0)
    usual = np.where(usual > 0, usual, 1.0)
    free = np.ones(len(start.q), dtype=bool)

    def sigma(place: Place | None) -> float:
        if place is None:
            return np.inf
        frame = Frame(place, free, manifold.rows)
        s = np.linalg.svd(frame.B * (place.sizes / usual)[:, None], compute_uv=False)
        return float(s[rank - 1] / s[0])

    found = [(0, sigma(start), start)]
    for way in ways:
        values = [sigma(place) for place in way]
        found += [(k, *pair) for k, pair in enumerate(zip(values, way, strict=True))]
        for k in range(1, len(way) - 1):
            beside = values[k - 1], values[k + 1]
            if values[k] <= min(beside) and values[k] < EVEN * max(beside):
                ends = (way[k - 1].q - way[k].q, way[k + 1].q - way[k].q)
                found.append((k, *_least(manifold, sigma, way[k], ends, free)))
    least = max(min(value for _, value, _ in found), NOUGHT)
    _, best, at = min((x for x in found if x[1] <= AS_NEAR * least), key=lambda x: x[0])
    size = max(np.max(np.abs(place.q)) for _, _, place in found)
    q = np.where(np.abs(at.q) > ROUND * size, at.q, 0.0)
    named = dict(zip((c.name for c in system.coordinates), q.tolist(), strict=True))
    return Nearest(best if best > NOUGHT else 0.0, named)


def _least(
    manifold: Manifold, sigma: Callable[[Place | None], float], middle: Place,
    ends: tuple[Vector, Vector], free: Flags,
) -> tuple[float, Place]:  # fmt: skip
    """The least sigma between a place's neighbours, by golden section, and its place."""

    def there(s: float) -> Place | None:
        """From one neighbour, -1, over the middle, 0, to the other, 1."""
        return moved(manifold, middle, abs(s) * ends[int(s > 0)], 0.0, free) if s else middle

    low, high = -1.0, 1.0
    tried = {s: sigma(there(s)) for s in (-(GOLDEN**3), GOLDEN**3)}
    for _ in range(REFINED):
        one, other = sorted(s for s in tried if low < s < high)
        if tried[one] < tried[other]:
            high, more = other, other - GOLDEN * (other - low)
        else:
            low, more = one, one + GOLDEN * (high - one)
        tried[more] = sigma(there(more))
    s = min(tried, key=lambda s: tried[s])
    return tried[s], there(s) or middle
