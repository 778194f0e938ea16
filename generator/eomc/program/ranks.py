"""The rank of constraints on the positions that they leave, and the rows that are solved for.

A rank at the start says little: a flat or symmetric one looks redundant. Nor does one where rows do
not hold: there they are hardly ever redundant. So ranks are taken along a walk on the positions
that the rows leave, at places that hold them in forty digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice
from math import comb
from typing import Any

import numpy as np

from eomc.program.interpret import context
from eomc.program.manifold import NO_MASS, RANK_TOLERANCE, Frame, Manifold, Place, Vector
from eomc.program.walks import along, walk

POSITIONS = 12  # beside the start
MANY, FEWER = 24, 3  # rows of a large system; positions of one whose rank is full at the start
SAME = 1e-20  # of a row: it is a sum of others in forty digits
NEARLY = 1e-12  # the same of rows that hold in doubles alone
GOOD = 1e-2  # of the singular value of all rows: what that of the kept ones is at least
BETTER = 1.02  # times another set's: a set is better
BESIDE, REACH = 3, 0.1  # places beside the start, and how far, of the coordinates' size
KNOWN = 1e-7  # of the coordinates: how well a place that holds a square is known
FLAT = 1e-6  # of the slope beside: a row has none
MIXED = 12  # rows that sums are made of, at most
ALONG, TRIED, REFINED = 150, 1000, 20  # places along a motion; sums that are tried, how often
MIXED_WELL = 0.03  # of sums: their least singular value on the rows' own
MOST_SETS = 4000  # that are tried; beyond, rows are left out one by one


@dataclass(frozen=True)
class Ranks:
    """rank: of all rows, almost everywhere. left_out: rows that others imply. shared: rows without
    a force of their own. good: whether some set of rows will do everywhere that was looked at.
    sums: where none does, sums of `shared` that do, the weights of all rows in each.
    sigma: smallest over largest singular value that counts, at the start and at the worst place.
    weights: of the rows, that make D regular with them; none where it is so by itself. slopes: of
    each row the largest A D^-1 A^T. latest: the time of the last position, s.
    flat: rows without a slope wherever they hold. loose: coordinates that no inertia and no row
    holds.
    """

    rank: int
    left_out: tuple[int, ...]
    shared: tuple[int, ...]
    good: bool
    sigma: tuple[float, float]
    positions: int
    weights: tuple[float, ...] = ()
    slopes: tuple[float, ...] = ()
    latest: float = 0.0
    flat: tuple[int, ...] = ()
    loose: tuple[int, ...] = ()
    sums: tuple[tuple[float, ...], ...] = ()


def ranks(manifold: Manifold, start: Place) -> Ranks:
    """Of the rows around an assembled start."""
    found, places = _ranks(manifold, start)
    singular = any(place.singular for place in places)
    weights = tuple(start.weights.tolist()) if singular else ()
    slopes = np.max([place.slopes**2 for place in places], axis=0)
    scale = np.diag(start.metric) ** -0.5
    slopes = np.where(slopes > 0, slopes, (manifold.usual * np.max(scale)) ** 2)
    latest = max(place.t for place in places)
    return replace(
        found, weights=weights, slopes=tuple(slopes.tolist()), latest=latest, loose=_loose(places)
    )


def _loose(places: Sequence[Place]) -> tuple[int, ...]:
    """The coordinates along which, at every place, rows leave a way that moves no mass."""
    found: tuple[int, ...] = ()
    for place in places:
        diagonal = np.diag(place.D)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        A = place.A / place.sizes[:, None] * scale
        _, s, V = np.linalg.svd(A)
        ways = V[int(np.sum(s > RANK_TOLERANCE * np.max(s, initial=0))) :]
        if not len(ways):
            return ()
        values, vectors = np.linalg.eigh(ways @ (scale[:, None] * place.D * scale) @ ways.T)
        least = int(np.argmin(np.abs(values)))
        if abs(values[least]) > NO_MASS:
            return ()
        way = np.abs(vectors[:, least] @ ways)
        found = tuple(np.flatnonzero(way > 1e-6 * np.max(way)).tolist())
    return found


def _ranks(manifold: Manifold, start: Place) -> tuple[Ranks, list[Place]]:
    """Without weights and slopes, and the places that were looked at."""
    free = np.ones(len(start.q), dtype=bool)
    first = Frame(start, free, manifold.rows)
    sure = len(first.parts[1]) == len(manifold.rows) and first.parts[1][-1] > RANK_TOLERANCE
    positions = FEWER if sure and len(manifold.rows) > MANY else POSITIONS
    rest = [Frame(place, free, manifold.rows) for place in walk(manifold, start, positions)]
    frames, places = [first, *rest], [start, *(f.place for f in rest)]
    if flat := _flat(manifold, places):
        return Ranks(0, (), (), False, (0.0, 0.0), len(places), flat=flat), places
    counts = [int(np.sum(f.parts[1] > RANK_TOLERANCE)) for f in frames]
    rank, m = max(counts), len(manifold.rows)
    regular = [f for f, n in zip(frames, counts, strict=True) if n == rank]
    ends = [(float(f.parts[1][rank - 1]), float(f.parts[1][0])) if rank else (1, 1) for f in frames]
    ratios = [least / most if most else 0.0 for least, most in ends]
    ratios = [x if x > RANK_TOLERANCE else 0.0 for x in ratios]
    sigma = (ratios[0], min(ratios))
    if rank == m:
        return Ranks(rank, (), (), True, sigma, len(places)), places
    if rank == 0:
        return Ranks(0, (), tuple(range(m)), False, (0.0, 0.0), len(places)), places
    null = [np.linalg.svd(f.B)[0][:, rank:] for f in regular]
    shared = np.flatnonzero(np.max([np.linalg.norm(u, axis=1) for u in null], axis=0) > 1e-6)
    left_out, score = _chosen([f.B for f in regular], rank, shared.tolist())
    found = Ranks(rank, (), tuple(shared.tolist()), True, sigma, len(places))

    def good(nearly: bool) -> bool:
        some = [f.place for f in regular[:3]]
        return score >= GOOD and all(_implied(manifold, x, left_out, nearly) for x in some)

    if good(nearly=False):
        return replace(found, left_out=left_out), places
    if sums := _sums(manifold, start, rank, shared.tolist()):
        idle = tuple(k for k in shared.tolist() if not any(row[k] for row in sums))
        return replace(found, left_out=idle, sums=sums), places
    if good(nearly=True):
        return replace(found, left_out=left_out), places
    return replace(found, good=False), places


def _sums(
    manifold: Manifold, start: Place, rank: int, shared: list[int]
) -> tuple[tuple[float, ...], ...]:
    """Sums of the rows `shared`, as many as these are worth, that are solved for in their place.

    A set of rows is singular somewhere along most motions of linkages in space, since its
    determinant changes its sign; of some sums it does not. They are found by chance, and then made
    better, over places all along the motion. None where that leads to no good ones.
    """
    m, count = len(manifold.rows), len(shared) - (len(manifold.rows) - rank)
    if manifold.timed or not set(shared) <= set(manifold.holonomic) or len(shared) > MIXED:
        return ()
    places = [start, *islice(along(manifold, start), ALONG)]
    usual = np.max([place.slopes for place in places], axis=0)[shared]
    usual = np.where(usual > 0, usual, np.inf)
    free, spans = np.ones(len(start.q), dtype=bool), list[Vector]()
    for place in places:
        B = Frame(place, free, manifold.rows).B[shared] * (place.sizes[shared] / usual)[:, None]
        U, s, _ = np.linalg.svd(B)
        if s[count - 1] > RANK_TOLERANCE * s[0]:
            U = U[:, :count]
            if spans and np.linalg.det(spans[-1].T @ U) < 0:  # turned as the last one is
                U[:, 0] *= -1
            spans.append(U)
    score, found = _best(np.array(spans), np.random.default_rng(5))
    if score < MIXED_WELL:
        return ()
    sums = np.zeros((count, m))
    sums[:, shared] = [[float(f"{x:.3g}") for x in row] for row in found / usual]
    return tuple(map(tuple, sums.tolist()))


def _best(spans: Vector, random: np.random.Generator) -> tuple[float, Vector]:
    """Weights (count, n) of sums whose least singular value on all spans (k, n, count) is most.

    And that value; -1 where determinants on some have other signs than on others.
    """
    _, n, count = spans.shape

    def best(about: Vector, width: float, many: int) -> tuple[float, Vector]:
        near = about + width * random.normal(size=(many, count, n))
        tried = np.linalg.qr(near.transpose(0, 2, 1))[0].transpose(0, 2, 1)
        on = tried[:, None] @ spans
        least = np.linalg.svd(on, compute_uv=False)[..., -1].min(axis=1)
        signs = np.sign(np.linalg.det(on)).sum(axis=1)
        score = np.where(np.abs(signs) == len(spans), least, -1.0)
        return float(score.max()), tried[int(np.argmax(score))]

    score, found = best(np.zeros((count, n)), 1.0, TRIED)
    width = 0.3
    for _ in range(REFINED):
        more, better = best(found, width, TRIED // 10)
        if more > score:
            score, found = more, better
        else:
            width /= 2
    return score, found


def _flat(manifold: Manifold, places: Sequence[Place]) -> tuple[int, ...]:
    """Rows of positions whose slope is nothing where they hold, beside that next to it.

    They are squares, or other powers. Where one has no slope at the start alone, that is singular.
    """
    start, random = places[0], np.random.default_rng(29)
    sizes = [*start.q, *(c.start for c in manifold.system.coordinates)]
    flat = list(manifold.holonomic) if len(places) > 1 else []
    for place in places:
        if flat:
            # a walk from a singular position ends near it, where slopes grow with the way gone
            span = sizes if place is start else place.q - start.q
            reach = REACH * (float(np.max(np.abs(span))) or 1.0)
            # nearer, slopes beside are as small as what is left where a square counts as zero
            reach = max(reach, KNOWN * float(np.max(np.abs(place.q))))
            q = [place.q + reach * random.normal(size=len(place.q)) for _ in range(BESIDE)]
            found = [p for p in (manifold.place(x, place.t) for x in q) if p is not None]
            beside = np.max([p.slopes for p in found], axis=0, initial=0.0)
            flat = [k for k in flat if place.slopes[k] < FLAT * beside[k]]
    return tuple(k for k in flat if not _held_by_others(manifold, start, k, flat))


def _held_by_others(manifold: Manifold, start: Place, row: int, flat: Sequence[int]) -> bool:
    """Whether a row of a loop is zero wherever the rows are that are not flat.

    A row that a person wrote is reported all the same: it may be meant otherwise.
    """
    system = manifold.system
    if not system.constraints[row].loop:
        return False
    kept = tuple(c for k, c in enumerate(system.constraints) if k not in flat)
    if not kept:
        return False
    alone = Manifold(replace(system, constraints=kept))
    there = alone.place(start.q, start.t)
    if there is None:
        return False
    found = [manifold.place(x.q, x.t) for x in walk(alone, there, FEWER)]
    off = [abs(x.phi[row]) for x in found if x is not None]
    return bool(off) and max(off) <= KNOWN * float(manifold.usual[row])


def _chosen(
    matrices: Sequence[Vector], rank: int, some: Sequence[int]
) -> tuple[tuple[int, ...], float]:
    """The rows of `some` to leave out, and how well the rest does at the worst of the matrices.

    Each (m, nq), its rows of length 1. Well: their smallest singular value over that of all rows.
    Of sets that are as good, the one that leaves the last rows out.
    """
    m = len(matrices[0])
    every = range(m)
    whole = [float(np.linalg.svd(B, compute_uv=False)[rank - 1]) for B in matrices]

    def score(out: Sequence[int], relative: bool) -> float:
        kept = [k for k in every if k not in out]
        found = (float(np.linalg.svd(B[kept], compute_uv=False)[rank - 1]) for B in matrices)
        return min(s / w if relative else s for s, w in zip(found, whole, strict=True))

    def best(sets: Iterator[tuple[int, ...]]) -> tuple[int, ...]:
        chosen, most = tuple[int, ...](), 0.0
        for out in sets:
            found = score(out, False)
            if not chosen or found > BETTER * most:
                chosen, most = out, found
        return chosen

    spare, backwards = m - rank, sorted(some, reverse=True)
    if comb(len(backwards), spare) <= MOST_SETS:
        chosen = best(combinations(backwards, spare))
    else:
        chosen = ()
        for _ in range(spare):
            chosen = best((*chosen, k) for k in backwards if k not in chosen)
    return tuple(sorted(chosen)), score(chosen, True)


def _implied(manifold: Manifold, place: Place, out: Sequence[int], nearly: bool) -> bool:
    """Whether the gradients of rows `out` are sums of the others', in forty digits.

    nearly: or as doubles tell, where rows of numbers that are given in doubles agree no better.
    """
    mp, n = context(), len(place.q)
    free = np.ones(n, dtype=bool)
    q, held = manifold.polished(place, free)
    if not held and not (nearly and manifold.rounded(place)):
        return False
    same = SAME if held else NEARLY
    flat = manifold.exactly("constraint_jacobian", q, [0] * n, place.t)
    rows = [flat[k * n : (k + 1) * n] for k in manifold.rows]
    kept = [k for k in manifold.rows if k not in out]
    A = np.array([[float(x) for x in rows[k]] for k in kept])
    size = np.linalg.norm(A, axis=1)
    into = np.linalg.pinv((A / size[:, None]).T) / size[:, None]
    for k in (k for k in out if np.any(place.A[k])):
        left: list[Any] = [mp.mpf(x) for x in rows[k]]
        for _ in range(6):
            weights = (into @ np.array([float(x) for x in left])).tolist()
            for w, row in zip(weights, (rows[i] for i in kept), strict=True):
                if w:
                    left = [x - mp.mpf(w) * y for x, y in zip(left, row, strict=True)]
        whole = max(abs(x) for x in rows[k])
        if max(abs(x) for x in left) > same * whole:
            return False
    return True
