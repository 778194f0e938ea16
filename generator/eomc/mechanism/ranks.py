"""Rank of the constraints, and the selection of independent equations.

The rank at the start is not reliable: constraints may look redundant at a flat or symmetric
configuration, and hardly ever look redundant where they do not hold. So ranks are computed along a
random walk on the constraint manifold, at configurations that satisfy the constraints to 40 digits.

For mechanisms with one degree of freedom, the configuration closest to a singularity is searched
for along the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice
from math import comb
from typing import Any

import numpy as np

from eomc.base.errors import SceneError
from eomc.mechanism.inconsistency import gradient_problems, massless_problem
from eomc.mechanism.manifold import (
    EXACT_ROUNDING,
    INITIAL_PATH_STEP,
    NEARBY_DISTANCE,
    SINGULAR_MASS_TOLERANCE,
    Configuration,
    Flags,
    Manifold,
    TangentSpace,
    Vector,
    random_walk,
    step_on_manifold,
    trace_branch,
)
from eomc.model import hybrid
from eomc.model.system import System
from eomc.program.ir import context
from eomc.runtime import rank as matrix_rank

SAMPLE_COUNT = 12  # configurations besides the start
# Fewer samples suffice for many constraints whose rank is full at the start.
MANY_CONSTRAINTS, FEW_SAMPLES = 24, 3
DOUBLE_TOLERANCE = 1e-12  # residual of a linear combination of rows that hold in doubles only
MIN_SINGULAR_RATIO = 1e-2  # least singular value of the selected equations over that of all
IMPROVEMENT = 1.02  # a set is preferred if its least singular value is larger by this factor
# relative accuracy of a configuration that satisfies a squared constraint
POSITION_TOLERANCE = matrix_rank.tolerance()
MAX_SUMMED_CONSTRAINTS = 12  # constraints that sums are formed of
# Search for sums: configurations along the motion, random candidates, refinements.
MAX_CONFIGURATIONS, CANDIDATES, REFINEMENTS = 150, 1000, 20
MIN_SUM_SINGULAR_VALUE = 0.03  # on the span of the constraints, for sums to be accepted
MAX_SETS = 4000  # sets that are compared; with more, constraints are dropped one by one


@dataclass(frozen=True)
class Ranks:
    """The rank of a system's constraint equations, and which of them are independent.

    Attributes
    ----------
    rank : int
        Rank of all constraint equations almost everywhere.
    left_out : tuple of int
        Constraints that others imply, by index.
    shared : tuple of int
        Constraints whose multipliers are not unique.
    good : bool
        Whether some set of equations is independent at all sampled configurations.
    sigma : (float, float)
        Smallest over largest nonzero singular value of the scaled Jacobian, at the start and at the
        worst configuration.
    positions : int
        Number of sampled configurations.
    weights : tuple of float
        Weight of each constraint that makes D regular; empty where D is regular by itself.
    slopes : tuple of float
        Largest A D^-1 A^T of each constraint equation.
    latest : float
        Time of the last configuration (s).
    sums : tuple of tuple of float
        If no set of single constraints is `good`: weighted sums of `shared` that are independent,
        as the weight of each constraint.
    """

    rank: int
    left_out: tuple[int, ...] = ()
    shared: tuple[int, ...] = ()
    good: bool = True
    sigma: tuple[float, float] = (1.0, 1.0)
    positions: int = 1
    weights: tuple[float, ...] = ()
    slopes: tuple[float, ...] = ()
    latest: float = 0.0
    sums: tuple[tuple[float, ...], ...] = ()


def ranks(manifold: Manifold, start: Configuration) -> Ranks:
    """Return the rank of the constraint equations, and which of them are independent.

    The equations are evaluated at configurations on a random walk from `start`, which satisfies the
    constraints.

    Raises
    ------
    SceneError
        If the gradient of a constraint vanishes wherever the constraint is satisfied, or neither
        inertia nor a constraint determines a coordinate.
    """
    system, m = manifold.system, len(manifold.rows)
    frames = _sampled_frames(manifold, start)
    places = [f.configuration for f in frames]
    flat = _flat(manifold, places)
    counts = [f.rank for f in frames]
    rank = max(counts)
    if flat or rank == 0:
        raise SceneError(list(gradient_problems(system, flat)))
    if massless := _unresisted(places):
        raise SceneError([massless_problem(manifold, massless, start)])
    ratios = [
        float(f.parts[1][rank - 1] / f.parts[1][0]) if n == rank else 0.0
        for f, n in zip(frames, counts, strict=True)
    ]
    singular = any(place.singular for place in places)
    slopes = np.max([place.slopes**2 for place in places], axis=0)
    scale = np.diag(start.metric) ** -0.5
    slopes = np.where(slopes > 0, slopes, (manifold.typical_gradients * np.max(scale)) ** 2)
    result = Ranks(
        rank,
        sigma=(ratios[0], min(ratios)),
        positions=len(places),
        weights=tuple(start.weights.tolist()) if singular else (),
        slopes=tuple(slopes.tolist()),
        latest=max(place.t for place in places),
    )
    if rank == m:
        return result
    regular = [f for f, n in zip(frames, counts, strict=True) if n == rank]
    return _with_selection(result, manifold, start, regular)


def _sampled_frames(manifold: Manifold, start: Configuration) -> list[TangentSpace]:
    """Return the tangent spaces at the start and at configurations on a random walk from it."""
    free = np.ones(len(start.q), dtype=bool)
    first = TangentSpace(start, free, manifold.rows)
    full_rank = first.rank == len(manifold.rows)
    positions = FEW_SAMPLES if full_rank and len(manifold.rows) > MANY_CONSTRAINTS else SAMPLE_COUNT
    walk = random_walk(manifold, start, positions)
    return [first, *(TangentSpace(place, free, manifold.rows) for place in walk)]


def _unresisted(places: Sequence[Configuration]) -> tuple[int, ...]:
    """Return coordinates that can move without inertia and without violating constraints,
    everywhere.
    """
    indices: tuple[int, ...] = ()
    for place in places:
        diagonal = np.diag(place.D)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        A = place.A / place.sizes[:, None] * scale
        null_space = matrix_rank.null_space(A).T
        if not len(null_space):
            return ()
        values, vectors = np.linalg.eigh(
            null_space @ (scale[:, None] * place.D * scale) @ null_space.T
        )
        smallest = int(np.argmin(np.abs(values)))
        if abs(values[smallest]) > SINGULAR_MASS_TOLERANCE:
            return ()
        direction = np.abs(vectors[:, smallest] @ null_space)
        indices = tuple(np.flatnonzero(direction > 1e-6 * np.max(direction)).tolist())
    return indices


def _with_selection(
    result: Ranks, manifold: Manifold, start: Configuration, regular: Sequence[TangentSpace]
) -> Ranks:
    """Return the ranks with the independent equations, or sums of equations, that are solved for.

    `regular` are the tangent spaces at the configurations where the rank is that of `result`.
    """
    rank = result.rank
    null = [np.linalg.svd(f.B)[0][:, rank:] for f in regular]
    dependent = np.max([np.linalg.norm(u, axis=1) for u in null], axis=0) > 1e-6
    shared: list[int] = np.flatnonzero(dependent).tolist()
    left_out, score = _select_dropped([f.B for f in regular], rank, shared)
    result = replace(result, shared=tuple(shared))

    def is_good(allow_double: bool) -> bool:
        """Return True if the selected equations are independent and imply the others.

        With `allow_double`, constraints may be satisfied in double precision only.
        """
        samples = [f.configuration for f in regular[:3]]
        return score >= MIN_SINGULAR_RATIO and all(
            _implied(manifold, x, left_out, allow_double) for x in samples
        )

    if is_good(allow_double=False):
        return replace(result, left_out=left_out)
    if sums := _sums(manifold, start, rank, shared):
        idle = tuple(k for k in shared if not any(row[k] for row in sums))
        return replace(result, left_out=idle, sums=sums)
    if is_good(allow_double=True):
        return replace(result, left_out=left_out)
    return replace(result, good=False)


def _sums(
    manifold: Manifold, start: Configuration, rank: int, shared: list[int]
) -> tuple[tuple[float, ...], ...]:
    """Find weighted sums of the constraints `shared` that are independent along the motion.

    For most spatial linkages every set of single constraints becomes singular somewhere, since its
    determinant changes sign; for some sums it does not. Candidates are drawn at random and then
    refined, over configurations all along the motion. Empty where the search fails.
    """
    m, count = len(manifold.rows), len(shared) - (len(manifold.rows) - rank)
    if (
        manifold.timed
        or not set(shared) <= set(manifold.holonomic)
        or len(shared) > MAX_SUMMED_CONSTRAINTS
    ):
        return ()
    places = [start, *islice(trace_branch(manifold, start), MAX_CONFIGURATIONS)]
    scales = np.max([place.slopes for place in places], axis=0)[shared]
    scales = np.where(scales > 0, scales, np.inf)
    free, spans = np.ones(len(start.q), dtype=bool), list[Vector]()
    for place in places:
        B = (
            TangentSpace(place, free, manifold.rows).B[shared]
            * (place.sizes[shared] / scales)[:, None]
        )
        U, s, _ = np.linalg.svd(B)
        if matrix_rank.count(s) >= count:
            U = U[:, :count]
            if spans and np.linalg.det(spans[-1].T @ U) < 0:  # same orientation as the last one
                U[:, 0] *= -1
            spans.append(U)
    score, weights = _best(np.array(spans), np.random.default_rng(5))
    if score < MIN_SUM_SINGULAR_VALUE:
        return ()
    sums = np.zeros((count, m))
    sums[:, shared] = [[float(f"{x:.3g}") for x in row] for row in weights / scales]
    return tuple(map(tuple, sums.tolist()))


def _best(spans: Vector, random: np.random.Generator) -> tuple[float, Vector]:
    """Find weights (count, n) of sums that maximise the least singular value on all spans (k, n,
    count).

    Returns that value and the weights; -1 where the determinant changes sign.
    """
    _, n, count = spans.shape

    def best(about: Vector, width: float, many: int) -> tuple[float, Vector]:
        """Return the best score of `many` random candidates around `about`, and that candidate.

        Candidates are weights of sums; the score is the least singular value on all spans.
        """
        candidates_ = about + width * random.normal(size=(many, count, n))
        candidates = np.linalg.qr(candidates_.transpose(0, 2, 1))[0].transpose(0, 2, 1)
        projected = candidates[:, None] @ spans
        least = np.linalg.svd(projected, compute_uv=False)[..., -1].min(axis=1)
        signs = np.sign(np.linalg.det(projected)).sum(axis=1)
        score = np.where(np.abs(signs) == len(spans), least, -1.0)
        return float(score.max()), candidates[int(np.argmax(score))]

    score, weights = best(np.zeros((count, n)), 1.0, CANDIDATES)
    width = 0.3
    for _ in range(REFINEMENTS):
        new_score, new_weights = best(weights, width, CANDIDATES // 10)
        if new_score > score:
            score, weights = new_score, new_weights
        else:
            width /= 2
    return score, weights


def _flat(manifold: Manifold, places: Sequence[Configuration]) -> tuple[int, ...]:
    """Return holonomic constraints whose gradient vanishes where they hold, compared with nearby
    gradients.

    Such constraints are squares or other powers. A gradient that vanishes at the start only is a
    singular configuration.
    """
    start = places[0]
    sizes = [*start.q, *(c.start for c in manifold.system.coordinates)]
    flat = list(manifold.holonomic) if len(places) > 1 else []
    for place in places:
        if flat:
            # Near a singular configuration, gradients grow with the distance from it.
            extent = sizes if place is start else place.q - start.q
            # Closer, nearby gradients would be as small as the remaining residual of a square.
            least = POSITION_TOLERANCE / NEARBY_DISTANCE
            size = max(float(np.max(np.abs(extent))), least * float(np.max(np.abs(place.q))))
            nearby = manifold.nearby(place.q, place.t, size)
            gradients = np.max([p.slopes for p in nearby], axis=0, initial=0.0)
            flat = [k for k in flat if place.slopes[k] < least * gradients[k]]
    return tuple(k for k in flat if not _is_implied_in_loop(manifold, start, k, flat))


def _is_implied_in_loop(
    manifold: Manifold, start: Configuration, row: int, flat: Sequence[int]
) -> bool:
    """Return True if a constraint of a loop holds wherever the other constraints hold.

    A constraint written by the user is reported in any case, since it may be a mistake.
    """
    system = manifold.system
    if not system.constraints[row].loop:
        return False
    others = tuple(c for k, c in enumerate(system.constraints) if k not in flat)
    if not others:
        return False
    reduced = Manifold(replace(system, constraints=others))
    start_on_reduced = reduced.configuration(start.q, start.t)
    if start_on_reduced is None:
        return False
    configurations = [
        manifold.configuration(x.q, x.t)
        for x in random_walk(reduced, start_on_reduced, FEW_SAMPLES)
    ]
    residuals = [abs(x.phi[row]) for x in configurations if x is not None]
    return bool(residuals) and max(residuals) <= POSITION_TOLERANCE * float(
        manifold.typical_gradients[row]
    )


def _select_dropped(
    matrices: Sequence[Vector], rank: int, removable: Sequence[int]
) -> tuple[tuple[int, ...], float]:
    """Select the constraints of `removable` to drop, and return them with the quality of the rest.

    matrices: Jacobians (m, nq) with rows of length 1. The quality is the smallest singular value of
    the remaining rows over that of all rows, at the worst matrix. Among equally good sets, the last
    constraints are dropped.
    """
    m = len(matrices[0])
    every = range(m)
    full_values = [float(np.linalg.svd(B, compute_uv=False)[rank - 1]) for B in matrices]

    def score(removed: Sequence[int], relative: bool) -> float:
        remaining = [k for k in every if k not in removed]
        score_of_set = (
            float(np.linalg.svd(B[remaining], compute_uv=False)[rank - 1]) for B in matrices
        )
        return min(s / w if relative else s for s, w in zip(score_of_set, full_values, strict=True))

    def best(sets: Iterator[tuple[int, ...]]) -> tuple[int, ...]:
        dropped, best_score = tuple[int, ...](), 0.0
        for removed in sets:
            score_of_set = score(removed, False)
            if not dropped or score_of_set > IMPROVEMENT * best_score:
                dropped, best_score = removed, score_of_set
        return dropped

    surplus, last_first = m - rank, sorted(removable, reverse=True)
    if comb(len(last_first), surplus) <= MAX_SETS:
        dropped = best(combinations(last_first, surplus))
    else:
        dropped = ()
        for _ in range(surplus):
            dropped = best((*dropped, k) for k in last_first if k not in dropped)
    return tuple(sorted(dropped)), score(dropped, True)


def _implied(
    manifold: Manifold, place: Configuration, removed: Sequence[int], allow_double: bool
) -> bool:
    """Return True if the gradients of the constraints `removed` are linear combinations of the
    others, to 40 digits.

    allow_double: accept double precision where the constraints hold in double precision only.
    """
    mp, n = context(), len(place.q)
    free = np.ones(n, dtype=bool)
    q, exact = manifold.refine(place, free)
    if not exact and not (allow_double and manifold.rounded(place)):
        return False
    tolerance = EXACT_ROUNDING if exact else DOUBLE_TOLERANCE
    flat = manifold.exact_value("constraint_jacobian", q, [0] * n, place.t)
    rows = [flat[k * n : (k + 1) * n] for k in manifold.rows]
    remaining = [k for k in manifold.rows if k not in removed]
    A = np.array([[float(x) for x in rows[k]] for k in remaining])
    size = np.linalg.norm(A, axis=1)
    inverse = np.linalg.pinv((A / size[:, None]).T) / size[:, None]
    for k in (k for k in removed if np.any(place.A[k])):
        residual: list[Any] = [mp.mpf(x) for x in rows[k]]
        for _ in range(6):
            weights = (inverse @ np.array([float(x) for x in residual])).tolist()
            for w, row in zip(weights, (rows[i] for i in remaining), strict=True):
                if w:
                    residual = [x - mp.mpf(w) * y for x, y in zip(residual, row, strict=True)]
        size_of_row = max(abs(x) for x in rows[k])
        if max(abs(x) for x in residual) > tolerance * size_of_row:
            return False
    return True


# --- the configuration closest to a singularity ---------------------------------------------------

TIE_RATIO = 1.0001  # configurations within this ratio of the least value are equally close
FLAT_RATIO = 0.999  # a minimum must be below this ratio of its larger neighbour
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
        return f"  smallest sigma_min/sigma_max along the motion {self.sigma:.3g}: {where}"


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
        [start, *islice(trace_branch(manifold, start, INITIAL_PATH_STEP, to), MAX_CONFIGURATIONS)]
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
    zero = matrix_rank.tolerance()
    least = max(min(value for _, value, _ in candidates), zero)
    _, least_sigma, closest = min(
        (x for x in candidates if x[1] <= TIE_RATIO * least), key=lambda x: x[0]
    )
    size = max(np.max(np.abs(place.q)) for _, _, place in candidates)
    q = np.where(np.abs(closest.q) > POSITION_TOLERANCE * size, closest.q, 0.0)
    coordinates = dict(zip((c.name for c in system.coordinates), q.tolist(), strict=True))
    return ClosestSingularity(least_sigma if least_sigma > zero else 0.0, coordinates)


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
    while high - low > matrix_rank.tolerance():
        first, second = sorted(s for s in values if low < s < high)
        if values[first] < values[second]:
            high, new_point = second, second - GOLDEN * (second - low)
        else:
            low, new_point = first, first + GOLDEN * (high - first)
        values[new_point] = sigma(configuration(new_point))
    s = min(values, key=lambda s: values[s])
    return values[s], configuration(s) or middle
