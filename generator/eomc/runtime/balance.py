"""Energy balance of a run: work of inputs and forces along its rows, and the numerical error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np

from .arguments import Array
from .columns import ROWS_PER_STEP
from .interfaces import CompiledModel
from .package import reduced
from .saved import NOT_STORED

_MAX_ORDER = 8  # of the interpolating polynomials, and so of the quadrature
_MIN_ROWS = 2 * _MAX_ORDER + 1  # fewer rows give no error estimate
_MIN_PIECE_ROWS = 4 * _MAX_ORDER + 1  # rows of a piece between jumps
_MAX_ROWS = 400_000  # rows of all pieces


@dataclass(frozen=True)
class Balance:
    """Energy balance of a run: E(end) - E(start) = inputs + forces - dissipated + jumps.

    E is the energy, or the Jacobi integral if it differs from the energy. The work is integrated
    numerically along the rows of the run.

    Attributes
    ----------
    inputs : float
        Work of the inputs, including the scene's signals, J.
    forces : float
        Work of all other forces that are not dissipative, and of prescribed motion, J.
    dissipated : float
        Energy dissipated by forces that are odd in the velocities, such as friction, J.
    error : float
        Largest difference between the two sides of the balance along the run, J. It is the
        error of the integration method.
    uncertainty : float
        Error bound of the numerical integration of the work, J. Values of `error` below it are not
        significant.
    is_resolved : bool
        Whether `uncertainty` is small compared with the work.
    jumps : float
        Energy added by state jumps, J; negative for impacts.
    """

    inputs: float
    forces: float
    dissipated: float
    error: float
    uncertainty: float
    is_resolved: bool
    jumps: float = 0.0

    @property
    def words(self) -> str:
        """Return the supplied and dissipated energy and the numerical error as a sentence, in J."""
        if not self.is_resolved:
            return "the steps are too long to determine the energy balance"
        parts = (
            ("work of inputs", self.inputs),
            ("work of forces", self.forces),
            ("dissipated", self.dissipated),
            ("added by jumps", self.jumps),
        )
        messages = [f"{name} {x:.3g} J" for name, x in parts if abs(x) > self.uncertainty]
        error = f"{self.error:.2g}" if self.error > 3 * self.uncertainty else ""
        error = error or f"at most {self.error + self.uncertainty:.1g}"
        return f"{', '.join(messages) or 'no work or dissipation'}; numerical error {error} J"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("balance.Balance", *self.__dict__.values())


@dataclass(frozen=True)
class _PowerSamples:
    """States of a run at which the power of its forces is evaluated.

    t : (n,) times, s. q, qd : (n, nq) states. u : (nu,) or (n, nu) inputs; None: the signals.
    """

    model: CompiledModel
    params: Array
    t: Array
    q: Array
    qd: Array
    u: Array | None

    def values(self, function: Callable[..., Any], **inputs: Any) -> Array:
        """Evaluate a function of the model, such as `functions.power`, at all samples: (n, ...).

        inputs: further arguments of the function, such as u.
        """
        values = function(self.q, self.qd, t=self.t, params=self.params, **inputs)
        return np.asarray(values, float)


def balance(run: Any) -> Balance | None:
    """Return the energy balance of a run, or None if it cannot be computed.

    The balance cannot be computed if an energy or a force is not finite at a row, or if the inputs
    at the rows are unknown. They are unknown for inputs u(t, q, qd) that are not stored at each
    step.
    """
    if not np.isfinite(run.jacobi).all():
        return None
    rows = _rows(run)
    if rows is None:
        return None
    model, energy = run.model, rows.values(run.model.functions.jacobi)
    none = np.zeros(model.info.nu) if model.info.nu else None
    power, rest = (rows.values(model.functions.power, u=u) for u in (rows.u, none))
    # the modes of Coulomb friction are signs of velocities and change their sign as well
    signs = np.ones(model.info.nq, model.info.dtype)
    signs[[at for at, _ in model.info.constraints.modes]] = -1
    reversed_rows = replace(rows, q=signs * rows.q, qd=-rows.qd)
    forward, backward = (x.values(model.functions.tau, u=none) for x in (rows, reversed_rows))
    if not all(np.isfinite(x).all() for x in (power, rest, forward, backward)):
        return None
    braking = np.sum((backward - forward) / 2 * rows.qd, axis=1).astype(float)
    jumps = 1 + np.flatnonzero(np.diff(rows.t) == 0)  # the rows after jumps
    (work, off), (other, _), (dissipated_work, blur) = (
        _in_pieces(rows.t, y, jumps) for y in (power, rest, braking)
    )
    jump_energy = np.zeros(len(energy))
    jump_energy[jumps] = energy[jumps] - energy[jumps - 1]
    inputs, forces = float(work[-1] - other[-1]), float(other[-1] + dissipated_work[-1])
    parts, jump_work = (inputs, forces, float(dissipated_work[-1])), np.cumsum(jump_energy)
    off, rounding = max(off, blur), float(np.finfo(model.info.dtype).eps * np.max(np.abs(energy)))
    left = float(np.max(np.abs(energy - energy[0] - work - jump_work)))
    jumped = float(jump_work[-1])
    max_relative_error = 0.005  # of the quadrature, for a balance that is reported
    is_resolved = off <= max(max_relative_error * max(map(abs, (*parts, jumped))), 10 * rounding)
    return Balance(*parts, left, off + rounding, is_resolved=is_resolved, jumps=jumped)


def _rows(run: Any) -> _PowerSamples | None:
    """Return samples whose power is smooth between jumps of the state or the inputs."""
    model, u = run.model, run.request.u
    if u is None or np.ndim(u) == 1:
        # all rows: a few of them may look smooth although the power is not
        states = _in_steps(run) or _between_jumps(run)
        return _PowerSamples(model, run.request.p, *states, u)
    run = run.with_jump_rows()
    ends, values = _piecewise_inputs(run)
    if not len(values):
        return None
    after_jumps = 1 + np.flatnonzero(np.diff(run.t) == 0)  # rows after jumps
    periods, (ends, values) = ends, _cut(ends, values, run.t[after_jumps])
    per_step = 1 if run.request.has_equal_steps else ROWS_PER_STEP
    each = per_step * ceil(run.steps / (len(periods) - 1)) + 1
    count = min(max(each, _MIN_ROWS), max(_MAX_ROWS // len(values), 2))
    t = np.concatenate([np.linspace(a, b, count) for a, b in pairwise(ends.tolist())])
    q, qd = run(t)
    for row in after_jumps.tolist():
        first = count * int(np.searchsorted(ends, run.t[row]))
        if first == len(t):  # it jumps at its end
            t, q, qd = np.append(t, t[-1:]), np.append(q, q[-1:], 0), np.append(qd, qd[-1:], 0)
        q[first], qd[first] = run.q[row], run.qd[row]
    piece = np.minimum(np.arange(len(t)) // count, len(values) - 1)
    return _PowerSamples(model, run.request.p, t, q, qd, values[piece])


def _cut(ends: Array, values: Array, at: Array) -> tuple[Array, Array]:
    """Split the intervals between the times `ends` (n + 1,) at the times `at` as well.

    values: value in each interval, (n, nu). Return the new times and values.
    """
    both = np.unique([*ends, *at])
    return both, values[np.searchsorted(ends, both[:-1], side="right") - 1]


def _piecewise_inputs(run: Any) -> tuple[Array, Array]:
    """Return times (n + 1,) and the constant inputs between them, (n, nu).

    n = 0 if the inputs are unknown.
    """
    request, last = run.request, float(run.t[-1])
    values = request.u if run.period_inputs is None else run.period_inputs
    if np.ndim(values) != 2 or (isinstance(request.u, str) and request.u == NOT_STORED):
        return np.zeros(1), np.zeros((0, run.model.info.nu))
    starts = request.t0 + (request.period or request.h) * np.arange(len(values))
    started = starts < last
    return np.append(starts[started], last), values[started]


def _in_steps(run: Any) -> tuple[Array, Array, Array] | None:
    """Return equidistant t, q and qd within each adaptive step; its ends are on two rows.

    Such steps are short where power is not smooth, as in a joint stop. Steps of a few roundings of
    the time have no inner rows. None for fixed steps, or if there are too many steps.
    """
    if (
        run.request.has_equal_steps
        or run.steps * _MIN_ROWS > _MAX_ROWS
        or not run.model.functions.has_power
    ):
        return None
    run = run.with_jump_rows()
    if np.sum(np.diff(run.t) > 0) != run.steps:  # its rows are at requested times
        run = run.with_step_rows()
    t, both, grain = run.t, np.array([run.q, run.qd]), 16 * np.finfo(run.model.info.dtype).eps
    intervals = np.diff(t)
    long = np.flatnonzero(intervals > _MIN_ROWS * grain * np.maximum(np.abs(t[:-1]), np.abs(t[1:])))
    inner = np.arange(1, _MIN_ROWS - 1) / (_MIN_ROWS - 1)
    at = (t[long, None] + intervals[long, None] * inner).ravel()
    # the end of a step and the beginning of another
    between = 1 + np.flatnonzero(intervals[:-1] * intervals[1:])
    rows = np.sort([*range(len(t)), *between])
    places = np.repeat(np.searchsorted(rows, long, side="right"), len(inner))
    q, qd = np.insert(both[:, rows], places, np.array(run(at)), axis=1)
    return np.insert(t[rows], places, at), q, qd


def _between_jumps(run: Any) -> tuple[Array, Array, Array]:
    """Return equidistant t, q, qd in each piece between jumps; each jump has two rows."""
    run = run.with_jump_rows()
    n, jumps = len(run.t), 1 + np.flatnonzero(np.diff(run.t) == 0)
    if not len(jumps) or not run.model.functions.has_power:
        even = run if len(jumps) else run.equidistant()
        return even.t, even.q, even.qd
    firsts, lasts = np.array([0, *jumps]), np.array([*(jumps - 1), n - 1])
    times, grain = [], 16 * np.finfo(run.model.info.dtype).eps
    for a, b in zip(firsts.tolist(), lasts.tolist(), strict=True):
        rows = min(
            max(ROWS_PER_STEP * (b - a + 1), _MIN_PIECE_ROWS), max(_MAX_ROWS // len(firsts), 2)
        )
        begin, end = float(run.t[a]), float(run.t[b])
        if end - begin > rows * grain * max(abs(begin), abs(end)):
            times.append(np.linspace(begin, end, rows)[1:-1])
    ends = np.unique([*firsts, *lasts])
    bare = run.with_rows(run.t[ends], np.array([run.q[ends], run.qd[ends]]))
    dense = bare.insert_rows(np.concatenate(times)) if times else bare
    return dense.t, dense.q, dense.qd


def _in_pieces(t: Array, power: Array, jumps: Array) -> tuple[Array, float]:
    """Integrate a power that is smooth between jumps, as `_work`. jumps: the rows after them.

    Pieces with the same number of equidistant rows are integrated together.
    """
    if not len(jumps):
        sums, off = _work(t, power)
        return sums, float(off)
    firsts, ends = np.array([0, *jumps]), np.array([*jumps, len(t)])
    counts, sums, unsure = ends - firsts, np.zeros(len(t)), 0.0
    for n in np.unique(counts).tolist():
        rows = firsts[counts == n][:, None] + np.arange(n)
        spacing = (t[rows[:, -1]] - t[rows[:, 0]]) / max(n - 1, 1)
        work, off = _work(np.arange(n), power[rows])
        sums[rows] = work * spacing[:, None]
        unsure += float(np.sum(off * spacing))
    before = np.concatenate([[0.0], np.cumsum(sums[ends - 1])])[:-1]
    return sums + np.repeat(before, counts), unsure


def _work(t: Array, power: Array) -> tuple[Array, Array]:
    """Integrate a power (..., n) up to each row, (..., n), with an error bound, (...).

    The bound is three times the Richardson estimate from every second and every fourth row.
    """
    n = len(t)

    def sums(rows: Array) -> Array:
        parts = np.cumsum(_intervals(t[rows], power[..., rows]), axis=-1)
        return np.concatenate([np.zeros((*power.shape[:-1], 1)), parts], axis=-1)

    if n < _MIN_ROWS:
        return sums(np.arange(n)), np.max(np.abs(power), axis=-1) * (t[-1] - t[0])
    strides = [np.unique([*range(0, n, stride), n - 1]) for stride in (1, 2, 4)]
    integrals = [sums(rows) for rows in strides]
    whole, half, quarter = (
        some[..., np.searchsorted(k, strides[-1])]
        for some, k in zip(integrals, strides, strict=True)
    )
    near, far = (np.max(np.abs(x), axis=-1) for x in (whole - half, half - quarter))
    min_order = 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        order = np.where((near > 0) & (far > 0), np.log2(far / near), min_order)
    order = np.clip(order, min_order, _MAX_ORDER)
    return integrals[0], 3 * near / (2.0**order - 1)


def _intervals(t: Array, y: Array) -> Array:
    """Integrate y (..., n) from each row to the next, (..., n - 1), by polynomial interpolation.

    The rows are equidistant, except perhaps the last.
    """
    n, rows = len(t), min(_MAX_ORDER, len(t))
    k = np.arange(n - 1)
    first = np.clip(k - (rows // 2 - 1), 0, n - rows)
    usual = _weights(np.arange(rows)) * (t[1] - t[0] if n > 1 else 0.0)
    weights = usual[k - first]
    last = first == n - rows
    weights[last] = _weights(t[n - rows :])[k[last] - (n - rows)]
    windows = np.lib.stride_tricks.sliding_window_view(y, rows, axis=-1)[..., first, :]
    return np.asarray(np.sum(weights * windows, axis=-1))


def _weights(nodes: Array) -> Array:
    """Return the quadrature weights of each interval between nodes, (n - 1, n)."""
    n, middle, half = len(nodes), (nodes[0] + nodes[-1]) / 2, (nodes[-1] - nodes[0]) / 2 or 1.0
    x = (nodes - middle) / half
    powers = np.arange(1, n + 1)
    moments = np.diff(x[:, None] ** powers / powers, axis=0)
    return np.asarray(half * np.linalg.solve(np.vander(x, increasing=True).T, moments.T).T)
