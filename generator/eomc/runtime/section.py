"""Poincaré sections: the states of a run where one of its columns crosses a value."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .arguments import Array, not_one_of


def crossings(
    columns: Mapping[str, Array], name: str, value: float, rising: bool | None, period: float | None
) -> dict[str, Array]:
    """See `Run.section`: all columns where one of them crosses a value, by cubics through rows."""
    if name not in columns:
        raise KeyError(not_one_of("section", name, tuple(columns)))
    t, f = columns["t"], np.asarray(columns[name], float) - value
    n = len(t)
    if n < 4:
        raise ValueError(f"section: {n} rows, where a cubic needs 4")
    low, high = np.minimum(f[:-1], f[1:]), np.maximum(f[:-1], f[1:])
    levels = np.zeros(n - 1) if period is None else np.ceil(low / period) * period
    inside = (low <= levels) & (levels < high)
    up = f[1:] > f[:-1]
    if rising is not None:
        inside &= up == rising
    rows = np.flatnonzero(inside)
    first = np.clip(rows - 1, 0, n - 4)[:, None] + np.arange(4)  # four rows about each
    s = (t[first] - t[rows][:, None]) / (t[rows + 1] - t[rows])[:, None]
    target = levels[rows]
    a, b = np.zeros(len(rows)), np.ones(len(rows))
    for _ in range(60):  # bisection of the cubic, whose ends are the two rows
        middle = (a + b) / 2
        beyond = ((_weights(s, middle) * f[first]).sum(axis=1) > target) == up[rows]
        a, b = np.where(beyond, a, middle), np.where(beyond, middle, b)
    weights = _weights(s, (a + b) / 2)
    return {key: (weights * np.asarray(x, float)[first]).sum(axis=1) for key, x in columns.items()}


def _weights(nodes: Array, at: Array) -> Array:
    """Lagrange's of four nodes (n, 4) at n places."""
    made = np.ones_like(nodes)
    for i in range(4):
        for j in range(4):
            if i != j:
                made[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return made
