"""Many trajectories by steps that fit a tolerance, each its own: `[run] tolerance` with `batch`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import BOTH, as_end, as_limits, as_times
from .arguments import Array, as_number
from .batch import BatchRun
from .batch_work import all_of, as_threads
from .package import reduced
from .slices import longer
from .trajectory import STATUS

if TYPE_CHECKING:
    from .batch import BatchModel

_GROUP, _FEWEST = 128, 16  # instances that a thread takes at once, of many and of few
_COUNTED = ("steps", "evaluations", "rejected", "stiff_steps")
_FEW = 64  # steps of an instance before the first look at Ctrl-C
_NAMES = ("tol", "evaluations", "rejected", "stiff_steps", "reached", "_times")


@dataclass(eq=False, repr=False)
class AdaptiveBatchRun(BatchRun):
    """Trajectories by steps that fit `tol`, rows at the same times for all.

    evaluations, rejected, stiff_steps: of each instance, (batch,). reached: the time to which each
    has come, (batch,), s; rows behind it are nan, as where an event stops an instance. Everything
    else as in a BatchRun.
    """

    tol: float = field(kw_only=True)
    evaluations: Array = field(kw_only=True)
    rejected: Array = field(kw_only=True)
    stiff_steps: Array = field(kw_only=True)
    reached: Array = field(kw_only=True)
    _times: Array = field(kw_only=True)

    @property
    def t(self) -> Array:
        """The time of each row, (n,), s."""
        return self._times

    @cached_property
    def status(self) -> Array:
        """How each ended."""
        return np.asarray(np.array([*STATUS, "interrupted"])[self._codes])

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
    h_most: float | None, stiff: bool, fixed: tuple[Any, ...],
) -> tuple[AdaptiveBatchRun, bool]:  # fmt: skip
    """`simulate_batch` by a tolerance, and whether it is whole, not cut off by Ctrl-C."""
    tol, most = as_limits(model, tol, h_most, stiff, fixed)
    t0 = as_number(t0, "t0")
    if times is None:
        end = as_end(model, t0, duration)
        times = [t0, end] if end > t0 else [t0]
    elif duration is not None:
        raise ValueError(BOTH)
    rows = as_times(times, t0, model.dtype)
    starts, table, held, _ = model._instances(q0, qd0, params, u, 1, t0)
    q, qd = (model._array(x, name, model.nq) for x, name in zip(starts, ("q0", "qd0"), strict=True))
    work = _Work(model, q.copy(), qd.copy(), t0, rows, tol, most, held, table)
    for memory in work.memory if stiff else ():
        memory.stiff = 1
    whole = work.run(threads, progress)
    kept = np.arange(len(rows)) < work.kept[:, None]
    for values in work.rows:
        values[~kept] = np.nan
    counts = work.counts
    codes = np.where((work.status == 0) & work.open, len(STATUS), work.status).astype("i")
    span = float(rows[-1]) - t0
    made = AdaptiveBatchRun(
        model, t0, work.rows[0], work.rows[1], span / max(1.0, float(counts["steps"].mean())),
        counts["steps"], codes, 1, 0, table.copy(), held, "gauss16", tol=tol,
        evaluations=counts["evaluations"], rejected=counts["rejected"],
        stiff_steps=counts["stiff_steps"],
        reached=work.t, _times=rows,
    )  # fmt: skip
    return made, whole


class _Work:
    """Instances on their way: where each is, its memory, and the rows of all."""

    def __init__(
        self, model: BatchModel, q: Array, qd: Array, t0: float, times: Array, tol: float,
        most: float, held: Array | None, table: Array,
    ) -> None:  # fmt: skip
        self.model, self.q, self.qd, self.times = model, q, qd, times
        self.held, self.table, self.limits = held, table, (float(times[-1]), tol, most)
        count, n = len(q), len(times)
        self.t = np.full(count, t0, model.dtype)
        self.rows = np.empty((2, count, n, model.nq), model.dtype)
        self.kept, self.status = np.zeros(count, "l"), np.zeros(count, "i")
        self.memory = model._ffi.new("adaptive_memory[]", count)
        self.open, self.stop, self.ended = np.ones(count, bool), False, 0
        if times[0] == t0:
            self.kept[:] = 1
            self.rows[0, :, 0], self.rows[1, :, 0] = q, qd

    @property
    def counts(self) -> dict[str, Array]:
        """Steps and so on of each instance, (batch,), by their names in C."""
        ffi, memory = self.model._ffi, "adaptive_memory"
        layout: Any = {
            "names": _COUNTED, "formats": ["l"] * len(_COUNTED), "itemsize": ffi.sizeof(memory),
            "offsets": [ffi.offsetof(memory, name) for name in _COUNTED],
        }  # fmt: skip
        found: Any = np.frombuffer(ffi.buffer(self.memory), np.dtype(layout))
        return {name: found[name].copy() for name in _COUNTED}

    def run(self, threads: int | None, progress: Callable[[int, int], None] | None) -> bool:
        """All of it; False where Ctrl-C came in between."""
        count = len(self.q)
        group = _GROUP if count > 8 * _GROUP else _FEWEST
        groups = [(at, min(group, count - at)) for at in range(0, count, group)]
        return all_of(
            self, groups, as_threads(threads), lambda: progress and progress(self.ended, count)
        )

    def _group(self, at: int, count: int, look: Callable[[], object] = lambda: None) -> None:
        """Instances at, ..., at + count - 1 to the end, some steps of each at once."""
        end = at + count
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
                count, pointer(self.q[at:end]), pointer(self.qd[at:end]), pointer(self.t[at:end]),
                *self.limits, u,
                model.nu if u_each else 0, many, pointer(self.times), n,
                pointer(self.rows[0, at:end]), pointer(self.rows[1, at:end]),
                pointer(self.table[at:end] if p_each else self.table), int(p_each),
                self.memory + at, address(long, self.kept[at:end]),
                address(integer, self.status[at:end]),
            )  # fmt: skip
            many = min(longer(many, perf_counter() - begun), 2**40)
            look()
        if not more:
            self.open[at:end] = False
            self.ended += count  # a figure for the bar; threads may lose one another's
            look()
