"""How many rows and events a run by adaptive steps keeps: what the machine has memory for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import Array, machine_memory

if TYPE_CHECKING:
    from .model import Model

PART = 0.4  # of the machine's memory: where a run ends, what was kept is copied once
FULL = "out of memory"  # the status of a run that ends since no more can be kept
REMEDY = (
    f"rows and events fill {100 * PART:.0f} % of this machine's memory: keep fewer rows with "
    "times=, or, where events never cease, end sooner with duration="
)


class Kept:
    """How many rows and events a run keeps, and how many more there is room for."""

    def __init__(self, model: Model) -> None:
        self.rows, self.most = 0, room_for(model)

    def count(self, work: Any, events: bool) -> None:
        """Those of the last call of C."""
        self.rows += work.rows + (work.events if events else 0)

    def at_most(self, steps: int, each: int) -> int:
        """So many steps of `each` rows, or as many as there is room for; 0: none."""
        return int(min(steps, max(0.0, self.most - self.rows) // each))


def room_for(model: Model) -> float:
    """How many rows and events a run may keep."""
    return PART * machine_memory() / _row(model)


def rows_for(model: Model, count: int) -> Array:
    """Room for so many times, q and qd. Raises MemoryError where there is none."""
    try:
        if count * _row(model) > machine_memory():
            raise MemoryError
        return np.empty(count * (1 + 2 * model.nq), model.dtype)
    except MemoryError:
        raise MemoryError(
            f"{count} rows of {1 + 2 * model.nq} numbers don't fit in memory: give fewer times="
        ) from None


def _row(model: Model) -> int:
    """The bytes of a time, q and qd."""
    return (1 + 2 * model.nq) * model.dtype.itemsize
