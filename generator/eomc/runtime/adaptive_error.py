"""Error of adaptive runs and of runs with events.

The error is the difference from a run at a hundredth of the tolerance. A run from a perturbed start
shows how rounding errors grow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .arguments import Array
from .estimate import (
    SATURATED_DIFFERENCE,
    UNRESOLVED_ERROR,
    Estimate,
    growth_of,
    mean_mass_matrix,
    moving_mask,
    rounding_words,
    scales,
)
from .inputs import ZeroOrderHold
from .requests import MIN_TOLERANCE, AdaptiveRequest
from .status import FULL, REMEDY

GAUSS16_ORDER = 16
COMPLETE_STATUSES = ("ok", "accumulated")  # of runs that reached the end of their motion
_PERTURBATION_ROUNDINGS = 4.0  # perturbation of the start in roundings, if a larger one saturates
_TAIL_DIVISOR = 40  # the final error is the largest one in the last 1/40 of the rows
_TOLERANCE_RATIO = 100.0  # tolerance of the run over that of the reference run
_MIN_REFERENCE_STEPS = 512  # of the reference run
_MIN_CURVE_ROWS = 24  # at which differences between runs are computed
_MIN_EXTRA_STEPS = 10  # by which the reference run may exceed the event that ended the run
_EVENT_SHIFT_FACTOR = (
    4.0  # largest time shift of an event, relative to the shift that differing states imply
)
_END_TOLERANCE = 1e-9  # of a span: times so near an end are at it
_ZENO_FRACTION = (
    0.01  # of the time to an accumulation point: later jumps differ in number between runs
)
_MAX_STEP_RATIO = 100  # limit of the steps of a run from a perturbed start, relative to the run


def error_by_tighter_tolerance(
    own: Any, run: Callable[[Any, AdaptiveRequest], Any],
    progress: Callable[[int, int], None] | None,
) -> Estimate:  # fmt: skip
    """Estimate the error of an adaptive run, or of a run with fixed steps and events.

    The error is the difference from a reference run with a hundredth of the tolerance and shorter
    steps. A further run from a perturbed initial state shows how rounding errors grow. For runs
    with events, or with large errors, the estimate is at least the propagated rounding error.

    The perturbation may grow too large for a linear estimate. A run with the smallest tolerance,
    from a start that is perturbed by a few rounding units, then shows the growth.

    Parameters
    ----------
    own : Any
        The run whose error is estimated.
    run : callable
        The function `adaptive.run`, by which the run is repeated.
    progress : callable or None
        Called during each repetition with (simulated thousandths, 1000).

    Raises
    ------
    MemoryError
        If the run ended because its rows fill the memory.
    """
    if own.status == FULL:
        raise MemoryError(f"estimate: {REMEDY}")
    model, again = own.model, _Rerun(own, run, progress)
    x, begin = again.x, np.ravel(own.initial_state).astype(float)
    eps, least = float(np.finfo(model.info.dtype).eps) / 2, MIN_TOLERANCE[model.info.dtype.itemsize]
    scale = scales(x, float(np.ptp(own.t)), eps, len(model.info.discrete_coordinates))
    size = max(1e4 * eps, 100 * own.tol)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], x.shape[1])
    finer, other = again.finer(begin, least)
    modes, moves = np.array(model.info.constraints.modes, int).reshape(-1, 2), moving_mask(model)
    # nor are the velocities of sticking friction perturbed
    moves[model.info.nq + modes[:, 1]] = begin[modes[:, 0]] != 0
    x = x[again.beside]

    base = again.curve()

    def moved(nudge: Array, tol: float = own.tol, base: Array = base) -> Array:
        """Return the change of the states along the run that a perturbation of its start causes.

        nudge: perturbation of the initial state [q; qd]. tol: tolerance of the new run. base:
        states [q; qd], (m, 2 nq), that are subtracted from those of the new run.
        """
        # the perturbed motion may differ, so its steps are limited
        most = _MAX_STEP_RATIO * (own.steps + own.rejected) + _MAX_STEP_RATIO**2
        return again.states(tol, begin + nudge, own.max_step, most) - base

    differences = [moved(moves * size * scale * signs)]
    rows = _filled(np.abs(again.at_rows(differences[0]))) / size
    left, rounding = np.where(np.isfinite(finer), np.abs(x - finer), np.inf), eps * np.abs(x)
    events = _Events.compare(own, other, left, scale)
    if events.end is not None:
        left[-1] = np.abs(x[-1] - events.end)
    elif not events.stops:
        left[-1] = np.inf
    if len(own.event_data[0]) or (left > UNRESOLVED_ERROR * scale).any():
        # motion between jumps may be exact for any tolerance; then only rounding errors matter
        full = np.maximum.accumulate(np.max(rows / scale, axis=1) * size > SATURATED_DIFFERENCE)
        if full.any():  # the first perturbation is too large for a linear estimate
            little = moves * _PERTURBATION_ROUNDINGS * eps * scale * signs
            nearest = again.states(least, begin, own.max_step)
            differences.append(moved(little, least, nearest))
            near = _filled(np.abs(again.at_rows(differences[1]))) / (_PERTURBATION_ROUNDINGS * eps)
            rows = np.where(full[:, None], np.maximum(rows, near), rows)
        rounding = np.maximum(rounding, eps * rows)
    exact = [*modes[:, 0], *(model.info.nq + modes[:, 0])]
    for some in (left, rounding):
        some[:, exact] = some[own.t == own.t0] = 0.0
    error = np.maximum(left, rounding)
    amplification = growth_of(
        model, mean_mass_matrix(model, base[:, : model.info.nq], again.times, own.parameter_values),
        [_finite(x) for x in differences], float(np.ptp(own.t)), moves,
        (begin, own.t0, own.parameter_values), lambda nudge: _finite(moved(nudge)),
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -np.log10(eps)) + 0.0
    names = [*model.info.coordinates, *(f"{c}_dot" for c in model.info.coordinates)]
    end, right = (dict(zip(names, map(float, x), strict=True)) for x in (error[-1], digits))
    method = own.fixed_method
    order = model.info.method_table[method].order if method else GAUSS16_ORDER
    return Estimate(
        error[:, : model.info.nq], error[:, model.info.nq :], end, right,
        order, float("nan"),
        amplification, _verdict(own, left / scale, rounding / scale, amplification, events),
        events.errors, events.missed,
    )  # fmt: skip


class _Rerun:
    """Repeat the run `own` with another tolerance, other steps or another initial state."""

    def __init__(
        self,
        own: Any,
        run: Callable[[Any, AdaptiveRequest], Any],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.own, self.run, self.progress = own, run, progress
        self.u: Any = (
            ZeroOrderHold(own.input_source, own._period, own._periods)
            if own._period
            else own.input_source
        )
        self.x = own.x.astype(float)
        # a row at a jump may be on either side of the jump in another run
        jumps = np.isin(own.t, own.t[1:][np.diff(own.t) == 0])
        self.kept = np.flatnonzero(~jumps & (own.t > own.t0))
        self.beside = np.maximum.accumulate(np.where(jumps, 0, np.arange(len(self.x))))
        self.reached = float(own.events[own.stopped].t[-1] if own.stopped else own.t[-1])

    def __call__(
        self, tol: float, start: Array, max_step: float, steps: float = np.inf,
        end: float | None = None,
    ) -> tuple[Array, Any]:  # fmt: skip
        """Repeat the run; return the new states at the rows of the original run, and the new run.

        tol: tolerance. start: initial state [q; qd]. max_step: longest step, s, or size of fixed
        steps. steps: number of steps after which the run ends early. end: end time, s; None: that
        of the original run. The states have the shape (n, 2 nq) and are nan where the new run has
        no row. A row at a jump gets the state of the last row before that is not at a jump.
        """
        own = self.own
        out, start = np.full_like(self.x, np.nan), start.astype(own.model.info.dtype)
        out[own.t == own.t0] = start
        if not len(self.kept):
            return out[self.beside], None
        to = float(own.t[-1]) if end is None else end
        rerun = self.rerun(tol, start, max_step, steps, to, own.t[self.kept])
        out[self.kept[: len(rerun)]] = rerun.x
        self._end(out, rerun)
        return out[self.beside], rerun

    def rerun(
        self, tol: float, start: Array, max_step: float, steps: float, end: float, times: Array
    ) -> Any:
        own, nq = self.own, self.own.model.info.nq
        request = AdaptiveRequest(
            start[:nq], start[nq:], own.t0, end, tol, times.astype(own.model.info.dtype), self.u,
            own.parameter_values, max_step, own.stiff, own.fixed_method, steps, self.progress,
        )  # fmt: skip
        rerun = self.run(own.model, request)
        if rerun.status == "interrupted":
            raise KeyboardInterrupt
        return rerun

    def _end(self, rows: Array, rerun: Any) -> None:
        """Set the last row to the final state of the rerun if the same event ends both runs."""
        own = self.own
        if own.stopped and rerun.stopped == own.stopped and own.t[-1] == self.reached:
            event = rerun.events[own.stopped]
            rows[-1] = np.concatenate([event.q[-1], event.qd[-1]])

    @property
    def times(self) -> Array:
        """Return the times (m,), s, at which `curve` and `states` compute the states of a run.

        They are the times of the rows that are not next to a state jump. If these rows are few,
        equidistant times are added.
        """
        between = np.linspace(self.own.t0, self.own.t[-1], _MIN_CURVE_ROWS + 1)[1:-1]
        own = self.own.t[self.kept].astype(float)
        few = between if len(own) < _MIN_CURVE_ROWS else between[:0]
        return np.unique(np.concatenate([[self.own.t0], own, few]))

    def curve(self) -> Array:
        """Return the states [q; qd] of the original run at `times`, (m, 2 nq)."""
        if len(self.kept) < _MIN_CURVE_ROWS:
            return np.concatenate(self.own(self.times), axis=1).astype(float)
        return np.concatenate([np.ravel(self.own.initial_state)[None], self.x[self.kept]])

    def states(self, tol: float, start: Array, max_step: float, steps: float = np.inf) -> Array:
        """Repeat the run from another start and return its states [q; qd] at `times`, (m, 2 nq).

        tol: tolerance. start: initial state [q; qd]. max_step: longest step, s, or size of fixed
        steps.
        steps: number of steps after which the new run ends early. States after an early end are
        nan.
        """
        own, start, times = self.own, start.astype(self.own.model.info.dtype), self.times
        out = np.full((len(times), self.x.shape[1]), np.nan)
        out[0] = start
        if len(times) > 1:
            rerun = self.rerun(tol, start, max_step, steps, float(own.t[-1]), times[1:])
            out[1 : 1 + len(rerun)] = rerun.x
            self._end(out, rerun)
        return out

    def at_rows(self, states: Array) -> Array:
        """Select from the states at `times`, (m, 2 nq), those at the rows of the run, (n, 2 nq).

        At a row next to a state jump, the state at the last row before that is not next to a jump
        is taken.
        """
        out = np.full_like(self.x, np.nan)
        out[self.own.t == self.own.t0] = states[0]
        out[self.kept] = states[np.searchsorted(self.times, self.own.t[self.kept].astype(float))]
        return np.asarray(out[self.beside])

    def finer(self, begin: Array, least: float) -> tuple[Array, Any]:
        """Repeat the run with a tighter tolerance and shorter steps, as the reference run.

        Return the states of the new run at the rows of the original run, (n, 2 nq), and the new run
        itself. begin: initial state [q; qd]. least: smallest tolerance of the module.
        """
        own, end = self.own, None
        if own.stopped:  # shorter steps may detect that event later, or not at all
            end = min(
                own._t_end, self.reached + max(self.reached - own.t0, _MIN_EXTRA_STEPS * own.h)
            )
        tol, shorter = _finer(own, least)
        rows, rerun = self(tol, begin, shorter, end=end)
        if own.status == "ok" and rerun is not None and rerun.status not in COMPLETE_STATUSES:
            # this run had too short steps near singular positions
            rows, rerun = self(tol, begin, own.h / 2 if own.fixed_method else own.max_step, end=end)
        return rows, rerun


@dataclass(frozen=True)
class _Events:
    """Differences between the events of a run and those of a reference run with shorter steps.

    errors: by name, the absolute difference between the times of each event in both runs, s; inf
    for events that the reference run does not detect.
    missed: by name, the times, s, of events that only the reference run detects.
    false: by name, the times, s, of events that only the run detects.
    stops: whether both runs end in the same way.
    end: last state [q; qd] of the reference run if an event stops it at the end of the run, else
    None.
    """

    errors: dict[str, Array]
    missed: dict[str, Array]
    false: dict[str, Array]
    stops: bool
    end: Array | None

    @classmethod
    def compare(cls, own: Any, other: Any | None, left: Array, scale: Array) -> _Events:
        """Pair the events of a run with those of a reference run and return their differences.

        Events are compared up to the time at which the states of the two runs differ by a tenth of
        the motion. Two events count as the same event under two conditions. They are nearest to one
        another in time. Their distance in time is at most a step, or at most the time shift that
        the difference of the states implies.

        own: the run. other: the reference run, None if there is none. left: absolute difference of
        the states of both runs at the rows, (n, 2 nq). scale: magnitude of the motion in each
        state, (2 nq,).
        """
        names = own.model.info.events
        if other is None or not names:
            return cls({}, {}, {}, True, None)
        reached, other_end = (float(r.events[r.stopped].t[-1] if r.stopped else r.t[-1])
                         for r in (own, other))  # fmt: skip
        relative_difference = np.where(np.isfinite(left), left, 0.0) / scale
        wrong = np.flatnonzero((left > UNRESOLVED_ERROR * scale).any(axis=1))
        alike = slice(0, wrong[0] if len(wrong) else len(left))
        speed = np.max(np.abs(own.qd.astype(float)), axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            late = np.max(left[alike, : len(speed)], axis=0, initial=0.0) / speed
        shift = _EVENT_SHIFT_FACTOR * float(np.max(late[np.isfinite(late)], initial=0.0))
        gap = max(own.h, min(shift, UNRESOLVED_ERROR * abs(reached - own.t0)))
        # an event so near the end of one run may lie just after the end of the other
        edge = abs(reached - own.t0) * max(
            float(np.max(relative_difference[alike], initial=0.0)), _END_TOLERANCE
        )
        until = float(own.t[wrong[0]]) if len(wrong) else reached - edge
        whole = (
            r.limit - _ZENO_FRACTION * (r.limit - r.t0) for r in (own, other) if r.limit == r.limit
        )
        until = min(until, *whole, np.inf)
        # sticking of friction is a part of the state; its error is one of the state
        coordinates = (own.model.info.coordinates[k] for _, k in own.model.info.constraints.modes)
        stick = {f"{c}_{what}" for c in coordinates for what in ("stops", "slips")}
        errors, missed, false = {}, {}, {}
        for name in names:
            a, b = (r.events[name].t.astype(float) for r in (own, other))
            mine, others = _paired(a, b, gap)
            errors[name] = np.full(len(a), np.inf)
            errors[name][mine] = np.abs(a[mine] - b[others])
            if name not in stick:
                alone = np.delete(b, others), np.delete(a, mine)
                missed[name] = alone[0][alone[0] <= until]
                false[name] = alone[1][alone[1] <= min(until, other_end - edge)]
        at_end = bool(other.stopped) and not own.stopped and other_end >= reached - edge
        before_end = bool(own.stopped) and not other.stopped and other_end <= reached + edge
        same = own.stopped == other.stopped and (
            not own.stopped or bool(np.isfinite(errors[own.stopped][-1]))
        )
        event = other.events[other.stopped] if at_end else None
        return cls(
            errors,
            {name: t for name, t in missed.items() if len(t)},
            {name: t for name, t in false.items() if len(t)},
            same or at_end or before_end or other.status not in COMPLETE_STATUSES,
            None if event is None else np.concatenate([event.q[-1], event.qd[-1]]).astype(float),
        )

    def words(self, own: Any) -> list[str]:
        """Return phrases on events of the run `own` that were missed or falsely detected.

        The list is empty if the events of both runs agree.
        """
        finer, remedy = "shorter steps", "a smaller h"
        if not own.fixed_method:
            finer, remedy = "a tighter tolerance", "a tighter tolerance, or a shorter max_step"
        messages = []
        if self.missed:
            messages.append(
                f"{_listed(self.missed)}, detected by {finer}, was missed: take {remedy}"
            )
        if self.false:
            messages.append(f"{_listed(self.false)}, is not detected by {finer}: take {remedy}")
        if not (self.stops or messages):
            messages.append(f"{finer} end the run elsewhere: take {remedy}")
        return messages


def _listed(events: dict[str, Array]) -> str:
    """Describe the first of these events and the number of others."""
    name = min(events, key=lambda each: float(events[each][0]))
    more = sum(map(len, events.values())) - 1
    return f"event '{name}' at t = {events[name][0]:.9g} s{f' (and {more} more)' if more else ''}"


def _paired(a: Array, b: Array, gap: float) -> tuple[Array, Array]:
    """Return the indices of times of a and b that are mutually nearest and within `gap`."""
    if len(a) == len(b) and (np.abs(a - b) <= gap).all():
        return np.arange(len(a)), np.arange(len(b))
    if not (len(a) and len(b)):
        return np.empty(0, int), np.empty(0, int)

    def nearest(some: Array, to: Array) -> Array:
        k = np.clip(np.searchsorted(some, to), 1, max(len(some) - 1, 1))
        k = np.minimum(k, len(some) - 1)
        return np.asarray(np.where(np.abs(some[k - 1] - to) <= np.abs(some[k] - to), k - 1, k))

    at = nearest(b, a)
    mutual = (nearest(a, b)[at] == np.arange(len(a))) & (np.abs(a - b[at]) <= gap)
    return np.flatnonzero(mutual), at[mutual]


def _finer(own: Any, least: float) -> tuple[float, float]:
    """Return the tolerance and the longest step, s, of the reference run.

    For fixed steps, these are the tolerance of the run and h / 4. If the tolerance cannot be
    reduced, a larger one leads to other steps with other rounding errors. least: smallest
    tolerance of the module.
    """
    if own.fixed_method:
        return own.tol, own.h / 4
    tol = max(own.tol / _TOLERANCE_RATIO, least) if own.tol >= 2 * least else 4 * least
    longest = (own.h / 2, float(np.ptp(own.t)) / _MIN_REFERENCE_STEPS, own.max_step)
    return tol, min((h for h in longest if h > 0), default=0.0)


def _finite(rows: Array) -> Array:
    """Return the rows of a difference between two runs at which both runs have states."""
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _filled(rows: Array) -> Array:
    """Fill rows that are not finite with the last finite row."""
    is_finite = np.isfinite(rows).all(axis=1)
    filled: Array = np.nan_to_num(
        rows[np.maximum.accumulate(np.where(is_finite, np.arange(len(rows)), 0))]
    )
    # the difference may vanish for a moment
    filled[-1] = filled[-1 - len(rows) // _TAIL_DIVISOR :].max(axis=0)
    return filled


def _verdict(own: Any, left: Array, rounding: Array, amplification: float, events: _Events) -> str:
    """Return the reasons why the run is not resolved as text; "" if there is none.

    left, rounding: difference from the reference run and rounding error at the rows, (n, 2 nq),
    relative to the scale of each state.
    """
    words = []
    if own.status not in COMPLETE_STATUSES:
        words.append(f"the run stopped at t = {own.t[-1]:.6g} s")
    words += (event_messages := events.words(own))
    is_rounding, wrong = (np.asarray((x > UNRESOLVED_ERROR).any(axis=1)) for x in (rounding, left))
    if is_rounding[-1]:
        words.append(rounding_words(own.model, amplification, float(own.t[np.argmax(is_rounding)])))
    if wrong.any() and not (event_messages and np.isinf(left[wrong]).all()):
        row = int(np.argmax(wrong))
        words.append(
            f"the error exceeds a tenth of the motion from t = {own.t[row]:.4g} s on: take a "
            f"{'smaller h' if own.fixed_method else 'tighter tolerance'}, or a shorter duration"
        )
    return "; ".join(words)
