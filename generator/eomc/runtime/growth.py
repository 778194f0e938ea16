"""The factor by which a motion multiplies a small difference of its start.

The size of a difference d = [dq; dqd] is |d|^2 = dqd' D dqd + (dq/T)' D (dq/T), where D is the mean
mass matrix along the motion, and T_i is the time in which a difference of q_i changes: the median
of |dq_i|/|dqd_i| along the motion, at most its duration. So it depends neither on the origin of a
coordinate, nor on units, nor on how far anything moves; of a harmonic oscillator, for which
T = 1/omega, it is constant along the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .arguments import Array

_STATES = 16  # number of rows of which D is the mean
_DEFINITE = 1e-12  # smallest eigenvalue of D, relative to the largest
_MIN_DISTANCE = 1e-6  # relative tolerance of the rank of the initial differences
_DIRECTIONS = 4  # initial differences, each of which costs a run


def mean_mass_matrix(model: Any, q: Array, t: Array, params: Any = None) -> Array:
    """Return the mean (n, n) of the mass matrices D at some of the states q (rows, n).

    t: their times (rows,), s. params: parameters of the model; None: those of the scene.
    """
    rows = np.unique(np.linspace(0, len(q) - 1, _STATES).astype(int))
    return np.asarray(
        np.mean([model.D(q[k], t=float(t[k]), params=params) for k in rows], axis=0), float
    )


def norm_root(D: Array, differences: Sequence[Array], duration: float) -> Array:
    """Return the matrix W (2n, 2n) that defines the norm |W d| of a difference d = [dq; dqd].

    |W d|^2 = dqd' D dqd + (dq/T)' D (dq/T). D: mean mass matrix (n, n). differences: arrays
    (rows, 2n) of differences along the motion. The time T of each coordinate is the median of
    |dq|/|dqd| in these, at most `duration`, s.
    """
    values, vectors = np.linalg.eigh((D + D.T) / 2)
    values = np.maximum(values, _DEFINITE * max(float(values[-1]), np.finfo(float).tiny))
    root = np.sqrt(values)[:, None] * vectors.T
    n, rows = len(D), np.concatenate([*differences])
    times = np.full(n, duration or 1.0)
    for k in range(n):
        dq, dqd = np.abs(rows[:, k]), np.abs(rows[:, n + k])
        good = (dq > 0) & (dqd > 0) & (dq < np.inf) & (dqd < np.inf)
        if good.any():
            times[k] = min(times[k], float(np.exp(np.median(np.log(dq[good]) - np.log(dqd[good])))))
    whole = np.zeros((2 * n, 2 * n))
    whole[:n, :n], whole[n:, n:] = root / times, root
    return whole


def growth(root: Array, first: Array, last: Array) -> float:
    """Return the largest factor by which differences of states grow between two times.

    first, last: k differences at the first and at the last time, (2n, k), a column for each. The
    maximum is over all linear combinations of the columns; inf if a value is not finite. root:
    matrix W (2n, 2n) of `norm_root`, which defines the norm.
    """
    if not (np.isfinite(first).all() and np.isfinite(last).all()):
        return float("inf")
    most = float(np.max(np.abs(last), initial=0.0)) or 1.0  # its square may overflow
    inverse = np.linalg.pinv(root @ first, rcond=_MIN_DISTANCE)
    return most * float(np.linalg.norm(root @ (last / most) @ inverse, 2))


def other_directions(root: Array, first: Array, moves: Array, rank: int) -> list[Array]:
    """Return further initial differences, (2n,) each, that are orthogonal to `first` (2n,).

    They are also orthogonal to each other, and as large as `first`, in the norm of `root`, the
    matrix W (2n, 2n) of `norm_root`. moves (2n,): 1 for states that may differ, else 0. rank:
    dimension of the space of differences; there are fewer than `rank` results.
    """
    random, directions = np.random.default_rng(2), [first]
    size = float(np.linalg.norm(root @ first))
    widths = np.linalg.norm(root, axis=0)
    for _ in range(min(rank, _DIRECTIONS) - 1):
        d = moves * random.standard_normal(len(first)) / widths
        for other in directions:
            w = root @ other
            d = d - other * float(w @ (root @ d)) / max(float(w @ w), np.finfo(float).tiny)
        length = float(np.linalg.norm(root @ d))
        if not 0 < length < np.inf:
            break
        directions.append(moves * d * (size / length))
    return directions[1:]
