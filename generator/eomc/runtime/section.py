"""Poincaré sections: the states of a run where one of its columns crosses a value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .arguments import Array, as_flag, as_number, not_one_of

_AT = 1e-9  # of what is between two rows: so near a jump is at it


def as_section(
    known: Iterable[str], name: str, value: Any, rising: Any, period: Any
) -> tuple[float, bool | None, float | None]:
    """value, rising and period as `crossings` takes them. Raises KeyError and ValueError."""
    if name not in known:
        raise KeyError(not_one_of("section", name, tuple(known)))
    value = as_number(value, "value")
    if rising is not None:
        rising = as_flag(rising, "rising")
    if period is not None and (period := as_number(period, "period")) <= 0:
        raise ValueError(f"period: {period:g} is not a period: give a number greater than 0")
    return value, rising, period


def crossings(
    columns: Mapping[str, Array], name: str, value: float, rising: bool | None, period: float | None
) -> dict[str, Array]:
    """See `Run.section`: all columns where one of them crosses a value, by cubics through rows.

    Two rows of the same time are those of a jump: cubics end there, and the jump crosses nothing.
    """
    t, f = columns["t"], np.asarray(columns[name], float) - value
    n = len(t)
    if n < 4:
        raise ValueError(f"section: {n} rows, where a cubic needs 4")
    moving = np.diff(t) > 0
    edges = np.diff(moving.astype(int), prepend=0, append=0)
    firsts, lasts = (np.flatnonzero(edges == side) for side in (1, -1))  # of pieces between jumps
    end, begin = lasts[:-1], firsts[1:]
    change = abs(f[end] - f[end - 1]) + abs(f[begin + 1] - f[begin])
    on = abs(f[begin] - f[end]) <= _AT * change
    f[begin[on]] = f[end[on]]  # where it goes on, it is crossed once, whatever rounding says
    low, high = np.minimum(f[:-1], f[1:]), np.maximum(f[:-1], f[1:])
    levels = np.zeros(n - 1) if period is None else np.ceil(low / period) * period
    inside = (low <= levels) & (levels < high) & moving
    up = f[1:] > f[:-1]
    if rising is not None:
        inside &= up == rising
    rows = np.flatnonzero(inside)
    piece = np.searchsorted(firsts, rows, "right") - 1
    long = (lasts - firsts)[piece] >= 3
    rows, piece = rows[long], piece[long]
    first = np.clip(rows - 1, firsts[piece], lasts[piece] - 3)[:, None] + np.arange(4)  # about each
    s = (t[first] - t[rows][:, None]) / (t[rows + 1] - t[rows])[:, None]
    target = levels[rows]
    a, b = np.zeros(len(rows)), np.ones(len(rows))
    for _ in range(60):  # bisection of the cubic, whose ends are the two rows
        middle = (a + b) / 2
        beyond = ((_weights(s, middle) * f[first]).sum(axis=1) > target) == up[rows]
        a, b = np.where(beyond, a, middle), np.where(beyond, middle, b)
    weights, kept = _weights(s, (a + b) / 2), np.full(len(rows), True)
    ending = (a > 1 - _AT) & (rows + 1 == lasts[piece]) & (piece < len(firsts) - 1)
    beginning = (b < _AT) & (rows == firsts[piece]) & (piece > 0)
    for at, last in (ending, piece[ending]), (beginning, piece[beginning] - 1):  # of two pieces
        before, behind = (f[row] < target[at] for row in (lasts[last] - 1, firsts[last + 1] + 1))
        kept[at] = before != behind  # what is touched at a jump is not crossed
    found = {key: (weights * np.asarray(x, float)[first]).sum(axis=1) for key, x in columns.items()}
    return {key: x[kept] for key, x in found.items()}


def _weights(nodes: Array, at: Array) -> Array:
    """Lagrange's of four nodes (n, 4) at n places."""
    made = np.ones_like(nodes)
    for i in range(4):
        for j in range(4):
            if i != j:
                made[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return made
