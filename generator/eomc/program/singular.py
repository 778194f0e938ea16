"""Search for the configuration closest to a singularity, for mechanisms with one degree of
freedom.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from eomc.model import hybrid
from eomc.model.system import System
from eomc.program.manifold import Configuration, Flags, Manifold, TangentSpace, Vector
from eomc.program.manifold_sampling import step_on_manifold, trace_branch

MAX_CONFIGURATIONS = 120  # in each direction from the start
MAX_STEP = 0.1  # between configurations, in the units of the coordinates
GOLDEN_SECTION_STEPS = 40
ZERO_TOLERANCE = 1e-6  # singular values below this fraction of the largest one count as 0
TIE_RATIO = 1.0001  # configurations within this ratio of the least value are equally close
FLAT_RATIO = 0.999  # a minimum must be below this ratio of its larger neighbour
ZERO_COORDINATE_TOLERANCE = 1e-7  # relative to the largest coordinate
GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class ClosestSingularity:
    """The configuration closest to a singularity, for a mechanism with one degree of freedom.

    Constraint equations are scaled by their largest inverse inertia along the motion, and
    coordinates by the metric of D, so that a constraint whose gradient vanishes is detected.

    Attributes
    ----------
    sigma : float
        Smallest over largest nonzero singular value of the scaled constraint Jacobian; 0 at a
        singular configuration.
    q : dict
        The coordinates by name.
    """

    sigma: float
    q: dict[str, float]

    def __str__(self) -> str:
        where = ", ".join(f"{name} = {x:.6g}" for name, x in self.q.items())
        return f"  sigma_min/sigma_max {self.sigma:.3g} at the worst on its way: {where}"


def closest_singularity(system: System) -> ClosestSingularity | None:
    """Return the configuration closest to a singularity along the motion of an assembled system.

    None for more than one degree of freedom, and for constraints that depend on velocities or time.
    Among equally close configurations, the one that is reached first is returned.
    """
    system = hybrid.with_constant_parameters(
        hybrid.without_modes(system) if system.modes else system
    )
    manifold, rows = Manifold(system), system.constraints
    rank = system.closure.rank if system.closure else 0
    if manifold.timed or not all(c.holonomic for c in rows) or len(system.q) - rank != 1:
        return None
    start = manifold.configuration(np.array([c.start for c in system.coordinates], float))
    if start is None:
        return None
    branches = [
        [start, *islice(trace_branch(manifold, start, MAX_STEP, to), MAX_CONFIGURATIONS)]
        for to in (1, -1)
    ]
    scales = np.max([place.slopes for way in branches for place in way], axis=0)
    scales = np.where(scales > 0, scales, 1.0)
    free = np.ones(len(start.q), dtype=bool)

    def sigma(place: Configuration | None) -> float:
        """Return the ratio of the smallest nonzero to the largest singular value of the Jacobian.

        It is infinite without a configuration.
        """
        if place is None:
            return np.inf
        frame = TangentSpace(place, free, manifold.rows)
        s = np.linalg.svd(frame.B * (place.sizes / scales)[:, None], compute_uv=False)
        return float(s[rank - 1] / s[0])

    candidates = [(0, sigma(start), start)]
    for way in branches:
        values = [sigma(place) for place in way]
        candidates += [(k, *pair) for k, pair in enumerate(zip(values, way, strict=True))]
        for k in range(1, len(way) - 1):
            neighbours = values[k - 1], values[k + 1]
            if values[k] <= min(neighbours) and values[k] < FLAT_RATIO * max(neighbours):
                ends = (way[k - 1].q - way[k].q, way[k + 1].q - way[k].q)
                candidates.append((k, *_minimise(manifold, sigma, way[k], ends, free)))
    least = max(min(value for _, value, _ in candidates), ZERO_TOLERANCE)
    _, least_sigma, closest = min(
        (x for x in candidates if x[1] <= TIE_RATIO * least), key=lambda x: x[0]
    )
    size = max(np.max(np.abs(place.q)) for _, _, place in candidates)
    q = np.where(np.abs(closest.q) > ZERO_COORDINATE_TOLERANCE * size, closest.q, 0.0)
    coordinates = dict(zip((c.name for c in system.coordinates), q.tolist(), strict=True))
    return ClosestSingularity(least_sigma if least_sigma > ZERO_TOLERANCE else 0.0, coordinates)


def _minimise(
    manifold: Manifold, sigma: Callable[[Configuration | None], float], middle: Configuration,
    ends: tuple[Vector, Vector], free: Flags,
) -> tuple[float, Configuration]:  # fmt: skip
    """Minimise sigma between a configuration's neighbours by golden-section search."""

    def configuration(s: float) -> Configuration | None:
        """Return the configuration at s, from one neighbour (-1) over the middle (0) to the other
        (1).
        """
        return (
            step_on_manifold(manifold, middle, abs(s) * ends[int(s > 0)], 0.0, free)
            if s
            else middle
        )

    low, high = -1.0, 1.0
    values = {s: sigma(configuration(s)) for s in (-(GOLDEN**3), GOLDEN**3)}
    for _ in range(GOLDEN_SECTION_STEPS):
        first, second = sorted(s for s in values if low < s < high)
        if values[first] < values[second]:
            high, new_point = second, second - GOLDEN * (second - low)
        else:
            low, new_point = first, first + GOLDEN * (high - first)
        values[new_point] = sigma(configuration(new_point))
    s = min(values, key=lambda s: values[s])
    return values[s], configuration(s) or middle
