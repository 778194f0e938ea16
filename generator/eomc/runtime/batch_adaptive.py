"""Many trajectories by steps that fit a tolerance, each its own: `[run] tolerance` with `batch`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from dataclasses import dataclass, field, fields
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive import as_times, as_tolerance
from .arguments import Array, as_count, as_number, as_step_size
from .batch import BatchRun
from .batch_work import _pool
from .package import reduced
from .slices import longer
from .trajectory import STATUS

if TYPE_CHECKING:
    from .batch import BatchModel

_GROUP = 16  # instances that a thread takes at once
_FEW = 64  # steps of an instance before the first look at Ctrl-C
_NAMES = ("tol", "evaluations", "rejected", "reached", "_times")


@dataclass(eq=False, repr=False)
class AdaptiveBatchRun(BatchRun):
    """Trajectories by steps that fit `tol`, rows at the same times for all.

    evaluations, rejected: of each instance, (batch,). reached: the time to which each has come,
    (batch,), s; rows behind it are nan, as where an event stops an instance. Everything else as
    in a BatchRun.
    """

    tol: float = field(kw_only=True)
    evaluations: Array = field(kw_only=True)
    rejected: Array = field(kw_only=True)
    reached: Array = field(kw_only=True)
    _times: Array = field(kw_only=True)

    @property
    def t(self) -> Array:
        """The time of each row, (n,), s."""
        return self._times

    @cached_property
    def status(self) -> Array:
        """How each ended."""
        return np.asarray(np.array([*STATUS, "accumulated", "interrupted"])[self._codes])

    @property
    def message(self) -> str:
        """What happened, in a sentence."""
        names, counts = np.unique(self.status, return_counts=True)
        found = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        done = int(self.steps.sum())
        return f"{len(self)} instances, {done} steps, tolerance {self.tol:g}: {found}"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("batch_adaptive.AdaptiveBatchRun._of_kept", self._model, self._kept())

    def _all(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(BatchRun))

    def _kept(self) -> dict[str, Any]:
        return super()._kept() | {name: getattr(self, name) for name in _NAMES}

    @classmethod
    def _of_kept(cls, model: Any, kept: Mapping[str, Any]) -> AdaptiveBatchRun:
        made = BatchRun._of_kept(model, kept)._all()
        return cls(*made, **{name: kept[name] for name in _NAMES})

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self.tol, self._times.tolist())


def simulate(
    model: BatchModel, q0: ArrayLike | None, qd0: ArrayLike | None, duration: float | None,
    params: Any, u: ArrayLike | None, threads: int | None, t0: float,
    progress: Callable[[int, int], None] | None, tol: float | None, times: ArrayLike | None,
    h_most: float | None, **fixed: Any,
) -> tuple[AdaptiveBatchRun, bool]:  # fmt: skip
    """`simulate_batch` by a tolerance, and whether it is whole, not cut off by Ctrl-C."""
    if model.tolerance is None:
        raise ValueError("tol, times: not built; a scene asks for them with [run] tolerance = 1e-9")
    for name, value in fixed.items():
        if value is not None and (name, value) != ("every", 1):
            raise ValueError(f"{name}: belongs to fixed steps, tol to adaptive ones: give one")
    tol = as_tolerance(model.tolerance if tol is None else tol, model.dtype)
    most = 0.0 if h_most is None else as_step_size(h_most, model.dtype, "h_most")
    t0 = as_number(t0, "t0")
    if times is not None and duration is not None:
        raise ValueError("times: say where the run ends; give times or duration, not both")
    if times is None:
        span = model.duration if duration is None else as_number(duration, "duration")
        if span < 0:
            raise ValueError(f"duration: {span:g} is not a time in s")
        times = [t0, t0 + span] if span else [t0]
    rows = as_times(times, t0, model.dtype)
    starts, table, held, _ = model._instances(q0, qd0, params, u, 1)
    q, qd = (model._array(x, name, model.nq) for x, name in zip(starts, ("q0", "qd0"), strict=True))
    work = _Work(model, np.ascontiguousarray(np.hstack([q, qd])), t0, rows, tol, most, held, table)
    whole = work.run(threads, progress)
    kept = np.arange(len(rows)) < work.kept[:, None]
    for values in work.rows:
        values[~kept] = np.nan
    counts = np.array([[w.steps, w.evaluations, w.rejected] for w in work.works])
    codes = np.where((work.status == 0) & work.open, len(STATUS) + 1, work.status).astype("i")
    span = float(rows[-1]) - t0
    made = AdaptiveBatchRun(
        model, t0, work.rows[0], work.rows[1], span / max(1.0, float(counts[:, 0].mean())),
        counts[:, 0], codes, 1, 0, table.copy(), held, "gauss16", tol=tol,
        evaluations=counts[:, 1], rejected=counts[:, 2], reached=work.t, _times=rows,
    )  # fmt: skip
    return made, whole


class _Work:
    """Instances on their way: where each is, its memory, and the rows of all."""

    def __init__(
        self, model: BatchModel, x: Array, t0: float, times: Array, tol: float, most: float,
        held: Array | None, table: Array,
    ) -> None:  # fmt: skip
        self.model, self.x, self.times, self.held, self.table = model, x, times, held, table
        self.limits = float(times[-1]), tol, most
        count, n = len(x), len(times)
        self.t = np.full(count, t0, model.dtype)
        self.rows = np.empty((2, count, n, model.nq), model.dtype)
        self.kept, self.status = np.zeros(count, "l"), np.zeros(count, "i")
        self.works = model._ffi.new("adaptive_work[]", count)
        self.open, self.stop = np.ones(count, bool), False
        if times[0] == t0:
            self.kept[:] = 1
            self.rows[0, :, 0], self.rows[1, :, 0] = x[:, : model.nq], x[:, model.nq :]

    def run(self, threads: int | None, progress: Callable[[int, int], None] | None) -> bool:
        """All of it; False where Ctrl-C came in between."""
        count = len(self.x)
        if threads is None:
            threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        threads = as_count(threads, "threads", 1)
        groups = [(at, min(at + _GROUP, count)) for at in range(0, count, _GROUP)]
        try:
            if threads == 1 or len(groups) == 1:
                for k, group in enumerate(groups):
                    self._group(*group)
                    if progress is not None:
                        progress(k + 1, len(groups))
                return True
            waiting = {_pool(threads).submit(self._group, *group) for group in groups}
            while waiting:
                ended, waiting = wait(waiting, timeout=0.05)
                for future in ended:
                    future.result()
                if progress is not None:
                    progress(len(groups) - len(waiting), len(groups))
        except KeyboardInterrupt:
            self.stop = True
            for future in () if threads == 1 or len(groups) == 1 else waiting:
                future.cancel()
            return False
        return True

    def _group(self, at: int, end: int) -> None:
        """Instances at, ..., end - 1 to the end, some steps of each at once."""
        model, pointer = self.model, self.model._pointer
        null, n, many = model._c[2], len(self.times), _FEW
        u_each = self.held is not None and len(self.held) > 1
        p_each = len(self.table) > 1
        u = null if self.held is None else pointer(self.held[at:end] if u_each else self.held)
        address, (long, integer) = model._c[0], model._whole
        more = True
        while more and not self.stop:
            begun = perf_counter()
            more = model._lib.adaptive_batch(
                end - at, pointer(self.x[at:end]), pointer(self.t[at:end]), *self.limits, u,
                model.nu if u_each else 0, many, pointer(self.times), n,
                pointer(self.rows[0, at:end]), pointer(self.rows[1, at:end]),
                pointer(self.table[at:end] if p_each else self.table), int(p_each),
                self.works + at, address(long, self.kept[at:end]),
                address(integer, self.status[at:end]),
            )  # fmt: skip
            many = min(longer(many, perf_counter() - begun), 2**40)
        if not more:
            self.open[at:end] = False
