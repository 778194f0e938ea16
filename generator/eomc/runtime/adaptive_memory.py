"""How many rows and events a run by adaptive steps keeps: what the machine has memory for."""

from __future__ import annotations

from typing import Any

import numpy as np

from .arguments import Array, machine_memory
from .metadata import ModelInfo
from .status import PART


class StepCounters:
    """How many rows and events a run keeps, and how many more there is room for."""

    def __init__(self, model: ModelInfo) -> None:
        self.rows, self.most = 0, room_for(model)

    def add(self, work: Any, events: bool) -> None:
        """Those of the last call of C."""
        self.rows += work.rows + (work.events if events else 0)

    def limit_steps(self, steps: int, each: int) -> int:
        """So many steps of `each` rows, or as many as there is room for; 0: none."""
        return int(min(steps, max(0.0, self.most - self.rows) // each))


class RowBuffer:
    """Times and rows as C fills them, in pieces: one after each step, or at `times` (n,)."""

    def __init__(self, model: ModelInfo, times: Array | None, count: int) -> None:
        self.model, self.own = model, times is None
        self.times = None if times is None else np.ascontiguousarray(times, model.dtype)
        self.pieces: list[tuple[Array, Array]] = []
        self._piece(count if times is None else len(times))

    def _piece(self, count: int) -> None:
        address, real, _ = self.model._c
        self.whole, self.count, self.filled = rows_for(self.model, count), count, 0
        self.to = address(real, self.whole)
        self.to_t = self.to if self.times is None else address(real, self.times)

    def reserve(self, steps: int, each: int) -> None:
        """Have room for a step of `each` rows at least: where there is none, for so many steps."""
        if self.own and self.count - self.filled < each:
            self.pieces.append(self._filled())
            self._piece(1 + each * steps)

    def c_arguments(self, steps: int, each: int) -> tuple[Any, ...]:
        """What C takes: steps at most, times and how many, room for times, for q and for qd."""
        null, nq, left = self.model._c[2], self.model.nq, self.count - self.filled
        to_q = self.to + (self.count + nq * self.filled)
        at = to_q, to_q + nq * self.count
        if self.own:
            return (left - (not self.filled)) // each, null, 0, self.to_t + self.filled, *at
        return steps, self.to_t + self.filled, left, null, *at

    def concatenate(self) -> tuple[Array, Array]:
        """The times (n,) and rows (2, n, nq)."""
        times, rows = self._filled()
        if self.pieces:
            times = np.concatenate([*(t for t, _ in self.pieces), times])
            rows = np.concatenate([*(rows for _, rows in self.pieces), rows], axis=1)
        return times, rows

    def _filled(self) -> tuple[Array, Array]:
        """Those of the last piece."""
        times = self.whole if self.times is None else self.times
        rows = self.whole[self.count :].reshape(2, self.count, self.model.nq)
        return times[: self.filled], rows[:, : self.filled]


def room_for(model: ModelInfo) -> float:
    """How many rows and events a run may keep."""
    return PART * machine_memory() / _row(model)


def rows_for(model: ModelInfo, count: int) -> Array:
    """Room for so many times, q and qd. Raises MemoryError where there is none."""
    try:
        if count * _row(model) > machine_memory():
            raise MemoryError
        return np.empty(count * (1 + 2 * model.nq), model.dtype)
    except MemoryError:
        raise MemoryError(
            f"{count} rows of {1 + 2 * model.nq} numbers don't fit in memory: give fewer times="
        ) from None


def _row(model: ModelInfo) -> int:
    """The bytes of a time, q and qd."""
    return (1 + 2 * model.nq) * model.dtype.itemsize
