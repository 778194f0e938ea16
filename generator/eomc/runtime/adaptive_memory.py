"""Memory of the rows and events of adaptive runs, limited by the memory of the machine."""

from __future__ import annotations

from typing import Any

import numpy as np

from .arguments import Array, machine_memory
from .metadata import ModelInfo
from .status import PART


class StepCounters:
    """Count the stored rows and events of a run to keep the run within the machine's memory."""

    def __init__(self, model: ModelInfo) -> None:
        self.rows, self.most = 0, room_for(model)

    def add(self, work: Any, events: bool) -> None:
        """Add the number of rows, and if `events` is True the number of events, of the last C call.

        work: the C struct of the run, of type adaptive_work.
        """
        self.rows += work.rows + (work.events if events else 0)

    def limit_steps(self, steps: int, each: int) -> int:
        """Return how many steps the next call of C may make so that its rows fit in memory.

        steps: upper limit of the result. each: maximum number of rows that a step stores.
        """
        return int(min(steps, max(0.0, self.most - self.rows) // each))


class RowBuffer:
    """Memory that C fills with the rows (t, q, qd) of a run.

    times: requested times of the rows (n,), s; None: a row after each step. Without requested times
    the number of rows is not known in advance. Several arrays ("pieces") are then allocated one
    after the other, and `count` is the number of rows of the first piece.
    """

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
        """Allocate a new piece (array) for `steps` steps if the current one is full.

        A piece is full if it cannot store the rows of another step. each: maximum number of rows
        that a step stores. With requested times there is only one piece.
        """
        if self.own and self.count - self.filled < each:
            self.pieces.append(self._filled())
            self._piece(1 + each * steps)

    def c_arguments(self, steps: int, each: int) -> tuple[Any, ...]:
        """Return the arguments about rows that the next call of the C function receives.

        steps: maximum number of steps of the call. each: maximum number of rows that a step stores.
        The result is (maximum number of steps, pointer to the requested times, number of these
        times, pointers to the buffers for t, q and qd).
        """
        null, nq, left = self.model._c[2], self.model.nq, self.count - self.filled
        to_q = self.to + (self.count + nq * self.filled)
        at = to_q, to_q + nq * self.count
        if self.own:
            return (left - (not self.filled)) // each, null, 0, self.to_t + self.filled, *at
        return steps, self.to_t + self.filled, left, null, *at

    def concatenate(self) -> tuple[Array, Array]:
        """Return the times (n,), s, and the states [q, qd], (2, n, nq), of all stored rows."""
        times, rows = self._filled()
        if self.pieces:
            times = np.concatenate([*(t for t, _ in self.pieces), times])
            rows = np.concatenate([*(rows for _, rows in self.pieces), rows], axis=1)
        return times, rows

    def _filled(self) -> tuple[Array, Array]:
        """Return the times and rows of the last piece."""
        times = self.whole if self.times is None else self.times
        rows = self.whole[self.count :].reshape(2, self.count, self.model.nq)
        return times[: self.filled], rows[:, : self.filled]


def room_for(model: ModelInfo) -> float:
    """Return the largest number of rows and events, counted together, that a run may store.

    The number follows from the memory of the machine.
    """
    return PART * machine_memory() / _row(model)


def rows_for(model: ModelInfo, count: int) -> Array:
    """Allocate a flat array for `count` rows (t, q, qd), which has count * (1 + 2 nq) numbers.

    Raises MemoryError if the array does not fit in the machine's memory.
    """
    try:
        if count * _row(model) > machine_memory():
            raise MemoryError
        return np.empty(count * (1 + 2 * model.nq), model.dtype)
    except MemoryError:
        raise MemoryError(
            f"{count} rows of {1 + 2 * model.nq} numbers don't fit in memory: give fewer times="
        ) from None


def _row(model: ModelInfo) -> int:
    """Size of a row (t, q, qd) in bytes."""
    return (1 + 2 * model.nq) * model.dtype.itemsize
