"""Events of a run: where and when each happened, and the room in which C tells of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import Array

if TYPE_CHECKING:
    from .model import Model

_EVENTS = 1024  # of one call


@dataclass(frozen=True)
class Happened:
    """Where an event happened: t (n,), s; q and qd (n, nq), before a jump."""

    t: Array
    q: Array
    qd: Array

    def __len__(self) -> int:
        return len(self.t)


class Found:
    """Room for the events of a call, and all that were found."""

    def __init__(self, model: Model) -> None:
        self.model, self.pieces = model, list[tuple[Array, Array]]()
        self.which = np.empty(_EVENTS, np.intc)
        self.rows = np.empty((len(self.which), 1 + 2 * model.nq), model.dtype)

    def room(self) -> tuple[Any, ...]:
        """What C is told of it."""
        address, real, _ = self.model._c
        which = self.model._ffi.from_buffer("int[]", self.which)
        return len(self.which), which, address(real, self.rows)

    def keep(self, work: Any) -> None:
        """Copy what the last call has found."""
        if work.events:
            n, work.events = work.events, 0
            self.pieces.append((self.which[:n].copy(), self.rows[:n].copy()))

    def all(self) -> tuple[Array, Array]:
        """Of each event which it is, and its row."""
        if not self.pieces:
            return self.which[:0], self.rows[:0]
        which, rows = zip(*self.pieces, strict=True)
        return np.concatenate(which), np.concatenate(rows)
