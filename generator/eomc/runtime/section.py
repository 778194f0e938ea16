"""Poincaré sections: the states of a run where one of its columns crosses a value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .arguments import Array, as_flag, as_number, not_one_of
from .columns import ROWS_PER_STEP


def section(run: Any, name: str, value: Any, rising: Any, period: Any) -> dict[str, Array]:
    """Return all columns of a run where the column `name` crosses a value.

    The arguments are those of `Trajectory.section`. Raises KeyError if `name` is no column of the
    run, ValueError for invalid values.
    """
    if name not in (columns := run.column_names):
        raise KeyError(not_one_of("section", name, columns))
    value = as_number(value, "value")
    if rising is not None:
        rising = as_flag(rising, "rising")
    if period is not None and (period := as_number(period, "period")) <= 0:
        raise ValueError(f"period: {period:g} is not a period: give a number greater than 0")
    if run.request.has_equal_steps:
        return crossings(run.to_dict(), name, value, rising, period)
    steps = run.with_jump_rows()
    t, parts = steps.t[:, None], np.arange(1, ROWS_PER_STEP) / ROWS_PER_STEP
    between = (t[:-1] + np.diff(t, axis=0) * parts).astype(t.dtype)
    is_inside = (t[:-1] < between) & (between < t[1:])
    rows = steps.insert_rows(between[is_inside]).to_dict()
    estimates = crossings(rows, name, value, rising, period)
    times = estimates["t"][estimates["t"] >= run.t[0]]
    level = np.full(len(times), value)
    if period is not None:
        level += period * np.round((estimates[name][estimates["t"] >= run.t[0]] - value) / period)
    refined: dict[str, Array] = run.rows_at(_refined(run, steps, name, times, level)).to_dict()
    return refined


def _refined(run: Any, steps: Any, name: str, times: Array, level: Array) -> Array:
    """Return the times at which a column is at a level, from estimates (m,), by Newton's method.

    steps: the run with both rows of each jump. A state at a jump is that before it.
    """
    by = 1e-6 * float(np.max(np.diff(steps.t)))
    jumps = np.unique(steps.t[1:][np.diff(steps.t) == 0])
    piece = np.searchsorted(jumps, times)
    ends = (
        np.array([steps.t[0], *np.nextafter(jumps, np.inf)])[piece],
        np.array([*jumps, steps.t[-1]])[piece],
    )
    for _ in range(2):
        places = times, np.clip(times - by, *ends), np.clip(times + by, *ends)
        here, one, other = (run.rows_at(x)[name] for x in places)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (here - level) / (other - one) * (places[2] - places[1])
        times = np.clip(np.where(np.isfinite(step), times - step, times), *ends)
    return times


def crossings(
    columns: Mapping[str, Array], name: str, value: float, rising: bool | None, period: float | None
) -> dict[str, Array]:
    """Return all columns of a run at the m times when the column `name` crosses `value`.

    The result is a dict of arrays (m,) by name. columns: arrays (n,) by name, including "t".
    rising, period: as in `Trajectory.section`. Columns are interpolated by cubics through four
    rows. Two rows of the same time are a state jump: no cubic spans it, and a jump is not a
    crossing. Raises ValueError for fewer than four rows.
    """
    t, column = columns["t"], columns[name]
    f, n = np.asarray(column, float) - value, len(t)
    if n < 4:
        raise ValueError(f"section: {n} rows, where a cubic needs 4")
    moving = np.diff(t) > 0
    # a row within so many ulp of the largest value lies on a level
    near = 0.0 if moving.all() else 16 * np.finfo(column.dtype).eps * np.max(abs(column))
    sides = _sides(f, near, period)
    up = sides[1:] > sides[:-1]
    inside = (sides[1:] != sides[:-1]) & moving & np.isfinite(np.diff(f))
    if rising is not None:
        inside &= up == rising
    edges = np.diff(moving.astype(int), prepend=0, append=0)
    firsts, lasts = (np.flatnonzero(edges == side) for side in (1, -1))  # of pieces between jumps
    rows = np.flatnonzero(inside)
    piece = np.searchsorted(firsts, rows, "right") - 1
    long = (lasts - firsts)[piece] >= 3
    rows, piece = rows[long], piece[long]
    first = np.clip(rows - 1, firsts[piece], lasts[piece] - 3)[:, None] + np.arange(4)  # about each
    s = (t[first] - t[rows][:, None]) / (t[rows + 1] - t[rows])[:, None]
    target = np.minimum(sides[rows], sides[rows + 1]) * (period or 0.0)
    a, b = np.zeros(len(rows)), np.ones(len(rows))
    for _ in range(60):  # bisection of the cubic, whose ends are the two rows
        middle = (a + b) / 2
        beyond = ((_weights(s, middle) * f[first]).sum(axis=1) > target) == up[rows]
        a, b = np.where(beyond, a, middle), np.where(beyond, middle, b)
    weights = _weights(s, (a + b) / 2)
    return {key: (weights * np.asarray(x, float)[first]).sum(axis=1) for key, x in columns.items()}


def _sides(f: Array, near: float, period: float | None) -> Array:
    """Return the number of levels below each of f (n,); levels are 0, or multiples of the period.

    A row within `near` of a level stays on the side of the row before.
    """
    turns = np.zeros(len(f)) if period is None else np.round(f / period)
    sides = (f > 0).astype(float) if period is None else np.ceil(f / period)
    for k in np.flatnonzero(abs(f - turns * (period or 0.0)) <= near):
        sides[k] = turns[k] + bool(k and sides[k - 1] > turns[k])
    return sides


def _weights(nodes: Array, at: Array) -> Array:
    """Return the Lagrange weights of four nodes (n, 4) at `at` (n,)."""
    weights = np.ones_like(nodes)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weights
