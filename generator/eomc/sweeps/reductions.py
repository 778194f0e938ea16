"""Reductions over draws, whose parts of blocks merge to the same bits in any order.

Moments are merged as a binary tree over leaves of LEAF trajectories, so a block of LEAF times a
power of two is a subtree. Histograms and the counts for quantiles are integers.

References
----------
Chan, Golub, LeVeque: Updating formulae and a pairwise algorithm for computing sample variances
(1979), for the merging of moments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eomc.sweeps.axes import Array

LEAF = 256  # trajectories
# Quantiles count values by sign, exponent and seven bits of the fraction: 0.4 % wide bins from
# 2**-64 to 2**64. Smaller values count as 0, larger ones as the largest bin.
FRACTION_SHIFT = 45
LOWEST_KEY = (1023 - 64) << 7
HALF_BINS = 128 << 7


def part_width(kind: str, numbers: Sequence[float]) -> int:
    """Return the number of values that a block stores of a reduction."""
    return {"mean": 3, "histogram": len(numbers) - 1, "quantile": 2 * HALF_BINS}[kind]


def part_of_block(kind: str, numbers: Sequence[float], x: Array) -> Array:
    """Return the part (..., width) of a reduction, for values (..., n) of a block's draws.

    Values that are not finite are left out.
    """
    if kind == "mean":
        return _moments(x)
    rows = np.ascontiguousarray(x, float).reshape(-1, x.shape[-1])
    if kind == "histogram":
        parts = [np.histogram(row[np.isfinite(row)], numbers)[0] for row in rows]
    else:
        parts = [np.bincount(_bins(row[np.isfinite(row)]), minlength=2 * HALF_BINS) for row in rows]
    return np.stack(parts).reshape(*x.shape[:-1], -1)


def merge(kind: str, numbers: Sequence[float], parts: Any) -> dict[str, Array]:
    """Merge the parts (..., blocks, width) of all blocks; return the results by their endings."""
    if kind == "mean":
        count, mean, squares = np.moveaxis(_merge_tree(np.moveaxis(parts[...], -2, 0)), -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            deviation = np.sqrt(squares / (count - 1))
        mean = np.where(count > 0, mean, np.nan)
        return {
            "count": count.astype(int),
            "mean": mean,
            "std": np.where(count > 1, deviation, np.nan),
        }
    total = sum(parts[..., k, :] for k in range(parts.shape[-2]))
    return {kind: total if kind == "histogram" else _quantiles(total, numbers)}


# --- moments --------------------------------------------------------------------------------------


def _moments(x: Array) -> Array:
    """Return number, mean and sum of squared deviations (..., 3) of the finite values (..., n)."""
    missing = -x.shape[-1] % LEAF
    x = np.concatenate([x, np.full((*x.shape[:-1], missing), np.nan)], -1)
    # NumPy adds in another order along axes that are not contiguous
    x = np.ascontiguousarray(x, float).reshape(*x.shape[:-1], -1, LEAF)
    finite = np.isfinite(x)
    count = finite.sum(-1).astype(float)
    mean = np.where(finite, x, 0.0).sum(-1) / np.maximum(count, 1)
    deviations = np.where(finite, x - mean[..., None], 0.0)
    leaves = np.stack([count, mean, (deviations * deviations).sum(-1)], -1)
    return _merge_tree(np.moveaxis(leaves, -2, 0))


def _merge_tree(parts: Array) -> Array:
    """Merge neighbours (m, ..., 3) until one is left, (..., 3)."""
    while len(parts) > 1:
        if len(parts) % 2:
            parts = np.concatenate([parts, np.zeros((1, *parts.shape[1:]))])
        parts = _merge_pair(parts[0::2], parts[1::2])
    return np.asarray(parts[0])


def _merge_pair(a: Array, b: Array) -> Array:
    """Merge moments (..., 3) of two disjoint sets; an empty set changes no bit of the other."""
    (n, mean, squares), (m, other_mean, other_squares) = (
        np.moveaxis(a, -1, 0),
        np.moveaxis(b, -1, 0),
    )
    total = n + m
    weight = m / np.maximum(total, 1)
    step = other_mean - mean
    merged = [total, mean + step * weight, squares + other_squares + step * step * n * weight]
    return np.stack(merged, -1)


# --- quantiles ------------------------------------------------------------------------------------


def _bins(x: Array) -> Array:
    """Return the index of the bin of each value; indices ascend with the values."""
    keys = (np.abs(x).view(np.int64) >> FRACTION_SHIFT) - LOWEST_KEY
    keys = np.clip(keys, 0, HALF_BINS - 1)
    return np.asarray(np.where(x < 0, HALF_BINS - 1 - keys, HALF_BINS + keys))


def _quantiles(counts: Array, probabilities: Sequence[float]) -> Array:
    """Return quantiles (..., probabilities) from counts (..., bins): the middle of the bin."""
    totals = np.cumsum(counts, -1)
    ranks = np.asarray(probabilities) * (totals[..., -1:] - 1)
    rows = zip(
        totals.reshape(-1, totals.shape[-1]), ranks.reshape(-1, ranks.shape[-1]), strict=True
    )
    bins = np.array([np.searchsorted(row, rank, side="right") for row, rank in rows])
    keys = np.where(bins < HALF_BINS, HALF_BINS - 1 - bins, bins - HALF_BINS)
    lower = ((keys + LOWEST_KEY) << FRACTION_SHIFT).view(float)
    upper = ((keys + LOWEST_KEY + 1) << FRACTION_SHIFT).view(float)
    values = np.where(keys == 0, 0.0, (lower + upper) / 2) * np.where(bins < HALF_BINS, -1, 1)
    return np.where(totals[..., -1:] > 0, values.reshape(ranks.shape), np.nan)
