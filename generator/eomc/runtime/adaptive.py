"""Runs by steps of a size that a tolerance asks for: what `[run] tolerance` adds in Python.

The method of Gauss and Legendre with eight stages; how its steps are chosen is said in the C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_end, as_limits, as_times, as_tolerance
from .adaptive_error import error_of
from .adaptive_memory import FULL, Kept, Rows
from .arguments import Array, as_number
from .begun import infinite_at_start
from .columns import ByName
from .dense import within
from .estimate import Estimate
from .happened import Found, Happened
from .periods import Acting, Periods, as_acting, held_at
from .section import crossings
from .slices import longer
from .trajectory import LEFT_OUT, SAID, STATUS, Run, state_text

if TYPE_CHECKING:
    from .model import Model

_ROOM = 48  # steps of the first call
_AT_ONCE = 2048  # steps times coordinates of it, at most
_MOST = 2**20  # of one call
_DRAWN = 1_000  # rows of a curve, at least
_EVEN = 8  # rows a step, as equally spaced ones need them
_NONE = (np.empty(0, np.intc), np.empty((0, 1)))  # events
STOPPED = (
    "no step is short enough to go on: forces grow without end there, as in a fall into a centre, "
    "or keep jumping: for friction by sign(x_dot) that sticks {}, or let events switch it; else a "
    "looser tolerance"
)
REMEDIES = (
    'take friction = "stick" in [run]',
    "give its coordinate friction = in place of the force",  # where the scene has that
)


@dataclass(eq=False, repr=False)
class AdaptiveRun(Run):
    """A run whose steps fit `tol`: rows after each step, or at the times that were asked for.

    h is the mean step, `rejected` how many steps were tried in vain, `stiff_steps` how many were
    found by Newton's method, since the motion is stiff there. events: by name where and when each
    happened, t, q, qd; stopped: the one that ended the run, or "". A run whose jumps follow one
    another ever sooner ends with the status "accumulated", and `limit`, the time that it can't
    pass, s. Everything else as in a Run.
    """

    tol: float = field(kw_only=True)
    rejected: int = field(kw_only=True)
    stiff_steps: int = field(kw_only=True)
    _times: Array = field(kw_only=True)
    _t_end: float = field(kw_only=True)
    # what few runs have is set behind: a run of few steps takes no longer than its making
    _h_most: float = field(default=0.0, init=False)
    _stiff: bool = field(default=False, init=False)
    _happened: tuple[Array, Array] = field(default=_NONE, init=False)  # which, rows of t, q, qd
    stopped: str = field(default="", init=False)
    limit: float = field(default=float("nan"), init=False)
    _period: float = field(default=0.0, init=False)  # over which inputs are held, if any are,
    _held: Array | None = field(default=None, init=False)  # and these, (n, nu)

    @property
    def t(self) -> Array:
        """The times of the rows, (n,), s."""
        return self._times

    @cached_property
    def _begin(self) -> Array:
        """q and qd at t0, (2, nq): its first row, where nobody said otherwise."""
        return np.array([self._rows[0][0], self._rows[1][0]])

    @property
    def message(self) -> str:
        """What happened, in a sentence."""
        done = f"{self.steps} steps, {self.told}"
        if self.status == "ok":
            return done
        if self.status == "not finite" and self.stopped:
            return f"event '{self.stopped}' jumps to no finite state at t = {self.t[-1]:.9g} s"
        if self.status == "accumulated":
            return (
                f"jumps follow one another ever sooner, up to t = {self.limit:.15g} s: there the "
                f"run ends, after {done}"
            )
        remedy = REMEDIES[bool(self._model._rows.modes)]
        said = STOPPED.format(remedy) if self.status == "no convergence" else SAID[self.status]
        said = infinite_at_start(self) or said
        where = state_text(self.q[-1], self.qd[-1]) if len(self) else ""
        end = self.t[-1] if len(self) else self.t0
        return f"stopped at t = {end:.9g} after {done}, {where}: {said}"

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """(q, qd) at any time within the run, t (...,): each (..., nq); at a jump before it.

        By the same steps once more, and shorter ones within them: as exact as these. Raises
        ValueError outside of the run.
        """
        times = within(self, t)
        asked, place = np.unique(times, return_inverse=True)
        q, qd = self._begin
        rows = np.empty((2, len(asked), len(q)), self._model.dtype)
        first = int(bool(len(asked)) and asked[0] <= self.t0)
        rows[:, :first] = [[q], [qd]]
        if len(asked) > first:
            rows[:, first:] = self._made(asked[first:], self._t_end)._rows
        both = rows[:, place.ravel()].reshape(2, *times.shape, len(q))
        return both[0], both[1]

    def _made(self, times: Array | None, end: float) -> AdaptiveRun:
        """The same run with rows at times, or after each step and on both sides of each jump."""
        q, qd = self._begin
        return run(
            self._model, q, qd, self.t0, end, self.tol, times,
            self._u if self._held is None else Periods(self._held, self._period),
            self._params, self._h_most, None, self._stiff,
        )  # fmt: skip

    @cached_property
    def events(self) -> dict[str, Happened]:
        """Where and when each of the scene's events happened."""
        which, rows = self._happened
        nq, names = self._model.nq, self._model.events
        each = (rows[which == k] for k in range(len(names)))
        found = (Happened(x[:, 0], x[:, 1 : 1 + nq], x[:, 1 + nq :]) for x in each)
        return ByName("events", names, found)

    @property
    def told(self) -> str:
        """How its steps were chosen, in words."""
        stiff = f", {self.stiff_steps} by Newton's method" if self.stiff_steps else ""
        return f"{self.rejected} rejected{stiff}, tolerance {self.tol:g}"

    @property
    def _remark(self) -> str:
        return self._singular

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps, tolerance {self.tol:g}>"

    @property
    def _drawn(self) -> Run:
        """Itself, with rows between where steps are too long for curves."""
        if len(self) < 2 or len(self) >= _DRAWN:
            return self
        return self._with(np.linspace(self.t[0], self.t[-1], _DRAWN + 1)[1:-1])

    def _with(self, times: Array) -> AdaptiveRun:
        """Itself, with rows at some times within among its own."""
        whole = np.concatenate([self.t, times])
        order = np.argsort(whole, kind="stable")
        both = zip((self.q, self.qd), self(times), strict=True)
        return self._at(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def _at(self, times: Array, rows: Array) -> AdaptiveRun:
        """Itself with other rows, (2, n, nq)."""
        made = copy(self)
        made._begin = self._begin
        for name in ("q", "qd", "outputs"):  # which are kept once they were made
            made.__dict__.pop(name, None)
        made._rows, made._times, made._energy = rows, times, None
        made._told_inputs()
        return made

    def _told_inputs(self) -> None:
        """Find which of the values that are held over periods acts at each row."""
        if self._held is not None:
            self._applied = held_at(self._times, self.t0, self._period, self._held)

    def section(
        self, name: str, value: float = 0.0, *, rising: bool | None = None,
        period: float | None = None,
    ) -> dict[str, Array]:  # fmt: skip
        """As of any run, with crossings placed by states within the steps: as exact as these.

        Raises ValueError where the state jumps: events find crossings there.
        """
        if (np.diff(self.t) == 0).any():
            raise ValueError("section: the state jumps; make an [[event]] of it, which is exact")
        parts, ends = np.arange(1, _EVEN) / _EVEN, self.t[[0, -1]]
        between = (self.t[:-1, None] + np.diff(self.t)[:, None] * parts).ravel()
        found = crossings(self._with(between).to_dict(), name, value, rising, period)
        times, by = found["t"], 1e-6 * float(np.max(np.diff(self.t), initial=0.0))
        turns = 0.0 if period is None else period * np.round((found[name] - value) / period)
        for _ in range(2):  # Newton's method
            places = times, np.clip(times - by, *ends), np.clip(times + by, *ends)
            here, one, other = (self._at(x, np.array(self(x)))[name] for x in places)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = (here - value - turns) / (other - one) * (places[2] - places[1])
            times = np.clip(np.where(np.isfinite(step), times - step, times), *ends)
        return self._at(times, np.array(self(times))).to_dict()

    def _even(self) -> Run:
        if (np.diff(self.t) == 0).any() or len(self) < 2:
            return self
        times = np.linspace(self.t[0], self.t[-1], _EVEN * (self.steps + 1))
        return self._at(times, np.array(self(times)))

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        return error_of(self, run, progress)

    def _again(self, parts: int, every: int, nudge: Array | None, progress: Any) -> Run:
        raise ValueError("an adaptive run has no steps of one size")

    def _kept(self) -> dict[str, Any]:
        own = {
            "tol": self.tol, "rejected": self.rejected, "stiff_steps": self.stiff_steps,
            "times": self.t, "h_most": self._h_most, "stiff": self._stiff, "begin": self._begin,
            "t_end": self._t_end, "which": self._happened[0],
            "event_rows": self._happened[1], "stopped": self.stopped, "limit": self.limit,
            "period": self._period, "values": self._held,
        }  # fmt: skip
        return super()._kept() | own

    @classmethod
    def _of_kept(cls, model: Model, kept: Mapping[str, Any], **own: Any) -> AdaptiveRun:
        held, values = kept.get("held"), kept.get("values")
        made = cls(
            model, kept["t0"], (kept["q"], kept["qd"]), kept["h"], kept["steps"], kept["status"],
            kept["params"], 1, held if values is None or held is not None else LEFT_OUT,
            kept["method"], kept["evaluations"],
            tol=kept["tol"], rejected=kept["rejected"], stiff_steps=kept.get("stiff_steps", 0),
            _times=kept["times"], _t_end=kept["t_end"],
        )  # fmt: skip
        made._h_most, made._stiff = kept["h_most"], bool(kept.get("stiff", False))
        made._begin, made._happened = kept["begin"], (kept["which"], kept["event_rows"])
        made.stopped, made.limit = kept["stopped"], kept["limit"]
        made._period, made._held = kept.get("period", 0.0), values
        made._told_inputs()
        return made

    def _state(self) -> dict[str, Any]:
        found = super()._state() | {"_times": self._times}
        found.pop("events", None)
        return found

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self.tol, self._times.tolist())


def simulate(
    model: Model, q0: ArrayLike | None, qd0: ArrayLike | None, duration: float | None, u: Any,
    params: Any, t0: float, progress: Callable[[int, int], None] | None, tol: float | None,
    times: ArrayLike | None, h_most: float | None, stiff: bool, control_period: float | None,
    fixed: tuple[Any, ...],
) -> AdaptiveRun:  # fmt: skip
    """`Model.simulate` with a tolerance; fixed: the values of FIXED."""
    tol, most = as_limits(model, tol, h_most, stiff, fixed)
    q, qd = model._start
    if q0 is not None or qd0 is not None:
        q, qd = model._one(q if q0 is None else q0, qd if qd0 is None else qd0)
    t0 = as_number(t0, "t0")
    p = model._p0 if params is None else model._parameters(params).copy()
    rows, first = None, 0
    if times is None:
        end = as_end(model, t0, duration)
    else:
        rows = as_times(times, t0, model.dtype, duration)
        first, end = int(rows[0] == t0), float(rows[-1])
    held = as_acting(model, u, control_period, end - t0, params)
    asked = None if rows is None else rows[first:]
    found = run(model, q, qd, t0, end, tol, asked, held, p, most, progress, stiff)
    if first:
        both = np.concatenate([np.array([[q], [qd]]), found._rows], axis=1)
        return found._at(rows[: both.shape[1]], both)  # type: ignore[index]
    return found


def plain(
    model: Model, q0: ArrayLike | None, qd0: ArrayLike | None, duration: float | None, u: Any,
    params: Any, t0: float, tol: float | None, count: int,
) -> AdaptiveRun | None:  # fmt: skip
    """A run with nothing unusual in one call, of count rows at most; None: it goes another way.

    Not for scenes with events or constraints.
    """
    (from_q, from_qd, at_p), p, (address, real, null) = model._at, model._p0, model._c
    held, at_u = None, null
    if u is not None:
        held = np.array([u], model.dtype) if type(u) is float else u
        if (at_u := model._listed(held, (model.nu or None,))) is None:
            return None
        held = held.copy()
    if q0 is not None:
        from_q = model._from(q0, "q0")[1]
    if qd0 is not None:
        from_qd = model._from(qd0, "qd0")[1]
    if params is not None:
        p = model._parameters(params).copy()
        at_p = model._pointer(p)
    tol = as_tolerance(model.tolerance if tol is None else tol, model.dtype)
    end = as_end(model, t0, duration)
    nq = model.nq
    work, whole = model._ffi.new("adaptive_work *"), np.empty(count * (1 + 2 * nq), model.dtype)
    to_t = address(real, whole)
    to_q = to_t + count
    found = model._lib.adaptive_begin(
        from_q, from_qd, t0, end, tol, 0.0, at_u, count - 1, null, 0,
        to_t, to_q, to_q + nq * count, at_p, work,
    )  # fmt: skip
    if found or work.t < end:
        model._room = 0
        return None
    steps, filled = work.steps, work.rows
    both = whole[count:].reshape(2, count, nq)[:, :filled]
    return AdaptiveRun(
        model, t0, both, (end - t0) / steps if steps else 0.0, steps, "ok", p, 1, held, "gauss16",
        work.evaluations, tol=tol, rejected=work.rejected, stiff_steps=work.stiff_steps,
        _times=whole[:filled], _t_end=end,
    )  # fmt: skip


def run(
    model: Model, q: Array, qd: Array, t0: float, t_end: float, tol: float, times: Array | None,
    u: Array | Periods | None, p: Array, h_most: float,
    progress: Callable[[int, int], None] | None, stiff: bool = False, enough: float = inf,
) -> AdaptiveRun:  # fmt: skip
    """A run from checked arguments, whatever its status, not far beyond `enough` steps; times (n,)
    later than t0."""
    (address, real, _), nq = model._c, model.nq
    work = model._ffi.new("adaptive_work *")
    if stiff:
        work.stiff = 1
    acting = Acting(model, u, t0, t_end, q, qd)
    at_p = model._at[2] if p is model._p0 else address(real, p)
    events = Found(model) if model.events else None
    each = 2 if events else 1  # rows of a step, beside a jump
    room = max(_ROOM, min(model._room, _AT_ONCE // nq))
    rows = Rows(model, times, 1 + each * room)
    call = model._lib.adaptive_begin
    place: tuple[Any, ...] = address(real, q), address(real, qd), t0
    said, kept = "ok", Kept(model)
    try:
        while True:
            begun = perf_counter()
            most, *to = rows.taken(room, each)
            found = call(
                *place, acting.stop, tol, h_most, acting.at, most, *to,
                *(events.room() if events else ()), at_p, work,
            )  # fmt: skip
            kept.count(work, bool(events))
            rows.filled += _kept(work, events)
            said = STATUS[found]
            ended, cut = found or (events and work.stopped), work.t < acting.stop
            if ended or work.steps >= enough or not acting.on(work):
                break
            if progress is not None:
                progress(round(1000 * (work.t - t0) / (t_end - t0)), 1000)
            room = min(longer(room, perf_counter() - begun), _MOST) if cut else room
            call, place = model._lib.adaptive, (work.x, model._ffi.addressof(work, "t"))
            if not (room := kept.at_most(room, each)):
                said = FULL
                break
            rows.more(room, each)
        if progress is not None and said == "ok":
            progress(1000, 1000)
    except KeyboardInterrupt:
        rows.filled += _kept(work, events)
        said = "interrupted"
    stamps, both = rows.all()
    steps = work.steps
    odd = events or model.constraint_names or nq * steps > _AT_ONCE
    model._room = 0 if odd else steps + _ROOM
    made = AdaptiveRun(
        model, t0, both, (work.t - t0) / steps if steps else t_end - t0, steps, said, p, 1,
        acting.u, "gauss16", work.evaluations, tol=tol,
        rejected=work.rejected, stiff_steps=work.stiff_steps, _times=stamps, _t_end=t_end,
    )  # fmt: skip
    made._h_most, made._stiff = h_most, bool(stiff)
    if times is not None:
        made._begin = np.array([q, qd])
    if acting.periods:
        made._period, made._held = acting.periods.period, np.array(acting.values)
        made._told_inputs()
    if events:
        made._happened = events.all()
        made.stopped = model.events[work.stopped - 1] if work.stopped else ""
        made.limit = work.limit if said == "accumulated" else made.limit
    if model.constraint_names:
        made.singular_steps = work.singular
        made.first_singular = work.first if work.singular else made.first_singular
    return made


def _kept(work: Any, events: Found | None) -> int:
    """The rows of the last call, whose events are kept."""
    rows, work.rows = work.rows, 0
    if events:
        events.keep(work)
    return int(rows)
