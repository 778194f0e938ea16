"""Fixed steps with rows at given times: a row between two steps is a shorter one from the first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_times
from .arguments import Array
from .dense import parts, within
from .estimate import Estimate, estimate
from .laws import FeedbackLaw
from .slices import next_chunk
from .status import STATUS
from .stepping import Stepping
from .trajectory import Run

_ROWS = 4096  # of the run whose error is estimated, at least, where it has as many steps
_FIRST = 16_384  # steps times coordinates before the first look, some ms
_RARELY = 2**48  # steps from row to row: C keeps the last one alone


@dataclass(eq=False, repr=False)
class TimedRun(Run):
    """A run by fixed steps with rows at the times that were asked for.

    steps: those of size h. One that can't go on ends with its last good state. Everything else as
    in a Run.
    """

    _times: Array = field(kw_only=True)
    _begin: Array = field(kw_only=True)  # q and qd at t0, (2, nq)
    _gave: Array | None = field(default=None, init=False)  # of a function, a row for each call

    @property
    def t(self) -> Array:
        """The times of the rows, (n,), s."""
        return self._times

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """(q, qd) at any time within the run, t (...,): each (..., nq), by the same steps again.

        Raises ValueError outside of the run.
        """
        times = within(self, t)
        asked, place = np.unique(times, return_inverse=True)
        made = self._whole(1, asked)
        q, qd = (x[place.ravel()].reshape(*times.shape, -1) for x in (made.q, made.qd))
        return q, qd

    @property
    def _given(self) -> Array:
        if self._applied is None and self._u is not None and self._u.ndim == 2 and len(self._u):
            begun = parts(self._times, self.t0, self.h)[0]
            rows: Array = self._u[np.minimum(begun, len(self._u) - 1)]
            return rows
        return super()._given

    def _whole(self, every: int, at: Array | None = None) -> Run:
        """The run of all steps, the last one whole; at: of those that reach these times."""
        model, (q, qd), pointer = self._model, self._begin, self._model._pointer
        whole = self.status == "ok" or at is not None
        steps = _count(self._times if at is None else at, self.t0, self.h) if whole else self.steps
        u = self._u if at is None or self._gave is None else self._gave
        if isinstance(u, np.ndarray) and u.ndim == 2:
            u = u[: -(-steps // self._hold)]
        made: Run = model._trajectory(
            q, qd, pointer(q), pointer(qd), self.h, steps, every, u, self._params,
            pointer(self._params), self.method, self.t0, None, None, self._hold, at,
        )  # fmt: skip
        return made

    def _even(self) -> Run:
        return self._whole(1)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        """That of the steps, between these by lines."""
        count = _count(self._times, self.t0, self.h)
        whole = self._whole(max(1, count // _ROWS))
        found = estimate(whole, progress)

        def at_rows(error: Array) -> Array:
            return np.stack([np.interp(self.t, whole.t, column) for column in error.T], axis=1)

        return replace(found, q=at_rows(found.q), qd=at_rows(found.qd))

    def _kept(self) -> dict[str, Any]:
        own = {"times": self._times, "begin": self._begin, "values": self._gave}
        return super()._kept() | own

    @classmethod
    def _of_kept(cls, model: Stepping, kept: Mapping[str, Any], **own: Any) -> Self:
        made = super()._of_kept(model, kept, _times=kept["times"], _begin=kept["begin"])
        made._gave = kept.get("values")
        return made

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self._times.tolist())


def as_asked(
    model: Stepping, times: ArrayLike | None, t0: float, h: float, duration: float | None,
    steps: int | None, every: int, out: Any,
) -> tuple[Array | None, int | None]:  # fmt: skip
    """Times (n,), and the steps to the last of them or beyond; where there are none (None, steps).

    Raises ValueError beside what else says where rows are.
    """
    if times is None:
        return None, steps
    named = {"steps": steps is not None, "every": every != 1, "out": out is not None}
    for name, given in named.items():
        if given:
            raise ValueError(f"{name}: times say where rows are; give one or the other")
    found = as_times(times, t0, np.dtype(float), duration)
    return found, _count(found, t0, h)


def run(
    model: Stepping, q: Array, qd: Array, t0: float, h: float, steps: int, times: Array,
    acts: tuple[FeedbackLaw | None, Array | None, int, int], p: Array, method: str,
    progress: Callable[[int, int], None] | None,
) -> TimedRun:  # fmt: skip
    """A run from checked arguments, whatever its status; times (n,) from t0 on.

    acts: a law, held values, values from one step to the next, steps over which a law is held.
    """
    way = _Way(model, q, qd, t0, h, steps, acts, p, method)
    rows = np.empty((2, len(times) + 1, model.nq), model.dtype)
    applied = np.full((len(times) + 1, model.nu), np.nan, model.dtype)
    kept, said = 0, "ok"
    try:
        for n, rest in zip(*(x.tolist() for x in parts(times, t0, h)), strict=True):
            said = way.to(n, progress)
            if said == "ok":
                rows[:, kept], said = way.between(rest)
            if said != "ok":
                break
            if way.law and n < way.steps:  # else what was held over the last step
                way.inputs()
            applied[kept] = way.acts
            kept += 1
    except KeyboardInterrupt:
        said = "interrupted"
    stamps = times[:kept]
    at = t0 + way.done * h
    if said != "ok" and (not kept or stamps[-1] < at):  # the last good state
        rows[:, kept], stamps = way.state, np.append(stamps, at)
        applied[kept] = way.acts
    made = TimedRun(
        model, t0, rows[:, : len(stamps)], h, way.done, said, p, 1, way.given, method,
        way.evaluations, _times=stamps, _begin=np.array([q, qd]),
    )  # fmt: skip
    model._record_singular_steps(made, method, way.work)
    if way.law:
        made._hold, made._applied = way.hold, applied[: len(stamps)]
        made._gave = np.reshape(way.values, (-1, model.nu)).astype(model.dtype)
    return made


def _count(times: Array, t0: float, h: float) -> int:
    """Steps to the last of these times or beyond it."""
    return ceil((float(times[-1]) - t0) / h * (1 - 1e-12))


class _Way:
    """A run on its way: the state behind `done` steps, and what goes from call to call of C."""

    def __init__(
        self, model: Stepping, q: Array, qd: Array, t0: float, h: float, steps: int,
        acts: tuple[FeedbackLaw | None, Array | None, int, int], p: Array, method: str,
    ) -> None:  # fmt: skip
        self.model, self.t0, self.h, self.steps = model, t0, h, steps
        _, self.run, _, self.stages, self.work_type, self.counted = model._loops[method]
        self.law, self.held, self.stride, self.hold = acts
        copied = None if self.held is None or self.law else self.held.copy()
        self.given = self.law.law if self.law else copied
        self.p, self.work = p, model._ffi.new(self.work_type)
        self.pair = np.array([[q, q], [qd, qd]], model.dtype)  # of C: where it starts, where it is
        self.asked, self.between_them = -1, 0  # the step a law was called before; evaluations
        self.values: list[Array] = []  # what it gave
        self.chunk = max(1, _FIRST // (model.nq**3 if self.counted else model.nq))

    @property
    def state(self) -> Array:
        return self.pair[:, 1]

    @property
    def done(self) -> int:
        return int(self.work.done)

    @property
    def evaluations(self) -> int:
        own = self.counted(self.work) if self.counted else self.stages * self.done
        return int(own + self.between_them)

    def to(self, n: int, progress: Callable[[int, int], None] | None) -> str:
        """On to the state behind n steps; the status."""
        while self.done < n:
            count = min(n - self.done, self.chunk)
            if self.law:
                count = min(count, self.hold - self.done % self.hold)
            at_u, begun = self.inputs(), perf_counter()
            said = self._call(self.pair, self.t0, self.h, count, at_u, self.work)
            if said != "ok":
                return said
            if count == self.chunk:
                self.chunk = next_chunk(count, perf_counter() - begun)
            if progress is not None:
                progress(self.done, self.steps)
        return "ok"

    def between(self, rest: float) -> tuple[Array, str]:
        """The state so many seconds behind the last step, and the status."""
        if not rest:
            return self.state, "ok"
        work, pair = self.model._ffi.new(self.work_type), np.repeat(self.pair[:, 1:], 2, axis=1)
        t = self.t0 + self.done * self.h
        at_u = self.inputs()
        if self.held is not None and self.stride:
            at_u += self.stride * min(self.done, len(self.held) - 1)
        said = self._call(pair, t, rest, 1, at_u, work)
        self.between_them += self.counted(work) if self.counted else self.stages
        return pair[:, 1], said

    def _call(self, pair: Array, t: float, h: float, count: int, at_u: Any, work: Any) -> str:
        """So many steps on from a pair's first state, or from its last where steps were done."""
        pointer, stride = self.model._pointer, self.stride
        (q, qd), at_p = pair, pointer(self.p)
        found = self.run(
            pointer(q), pointer(qd), pointer(q[0]), pointer(qd[0]), t, h, count, at_u, stride,
            _RARELY, at_p, work,
        )  # fmt: skip
        return STATUS[found & 7]

    def inputs(self) -> Any:
        """The address of the inputs; those of a law over the next step."""
        period = self.done // self.hold
        if self.law and self.asked != period:
            self.held = self.law(self.t0 + self.done * self.h, *self.state)
            self.values.append(self.held)
            self.asked = period
        return self.model._pointer(self.held)

    @property
    def acts(self) -> Any:
        """What a law gave last."""
        return np.nan if not self.law or self.held is None else self.held
