"""Events of a run: their times and states, and the buffers into which C writes them."""

from __future__ import annotations

from dataclasses import dataclass
from operator import index
from typing import Any

import numpy as np

from .arguments import Array
from .interfaces import CompiledModel
from .package import reduced

# capacity of the buffers, in addition to one event of each kind: of a run, of each of a batch
_EVENTS, EVENTS_EACH = 1024, 64


@dataclass(frozen=True, repr=False)
class EventLog:
    """Occurrences of one event in a run.

    Attributes
    ----------
    t : (n,) array
        Times, s.
    q, qd : (n, nq) arrays
        States at these times, before a state jump.
    """

    t: Array
    q: Array
    qd: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(f"events.{type(self).__name__}", *self.__dict__.values())

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"<{self._times}>"

    @property
    def _times(self) -> str:
        """Number of occurrences and their time span as text."""
        if len(self) < 2:
            return f"once, at {self.t[0]:.6g} s" if len(self) else "never"
        return f"{len(self)} times, {self.t.min():.6g} s to {self.t.max():.6g} s"


@dataclass(frozen=True, repr=False)
class BatchEventLog(EventLog):
    """Occurrences of one event in all instances of a batch, sorted by instance, then by time.

    Attributes
    ----------
    t : (n,) array
        Times, s.
    q, qd : (n, nq) arrays
        States at these times, before a state jump.
    instance : (n,) array
        Index of the instance of each occurrence.
    """

    instance: Array
    _batch: int

    def for_instance(self, k: int) -> EventLog:
        """Return the occurrences in instance k as an EventLog; a negative k counts from the end.

        Raises IndexError if there is no instance k, TypeError if k is not an integer.
        """
        try:
            at = index(k)
        except TypeError:
            raise TypeError(f"for_instance: {k!r} is not the index of an instance") from None
        if not -self._batch <= at < self._batch:
            last = self._batch - 1
            raise IndexError(f"for_instance: there is no instance {at}: they are 0 to {last}")
        own = self.instance == at % self._batch
        return EventLog(self.t[own], self.q[own], self.qd[own])

    def __repr__(self) -> str:
        many = f", in {len(np.unique(self.instance))} of {self._batch} instances"
        return f"<{self._times}{many if len(self) else ''}>"


class BatchEventBuffer:
    """Collect the events of all instances of a batch.

    Several threads call C functions, each of which writes events into a buffer of its own; `keep`
    copies them. most: largest number of events that fit in memory.
    """

    def __init__(self, model: CompiledModel, most: float) -> None:
        self.model, self.most, self.count = model, most, 0
        self.pieces: list[tuple[Array, Array, Array]] = []

    def room(self, count: int) -> GroupEventBuffer:
        """Return a new, empty buffer for one call of C, which simulates `count` instances."""
        return GroupEventBuffer(self.model, count)

    def keep(self, room: GroupEventBuffer, counts: Array, first: int) -> None:
        """Copy the events that a call of C wrote into its buffer.

        room: the buffer. counts: number of events of each instance. first: index in the batch of
        the first instance of that call.
        """
        some = np.arange(room.which.shape[1]) < counts[:, None]
        if some.any():
            self.pieces.append((some.nonzero()[0] + first, room.which[some], room.rows[some]))
            self.count += int(some.sum())

    @property
    def full(self) -> bool:
        """True if the collected events exceed the number that fits in memory."""
        return self.count > self.most

    def all(self) -> tuple[Array, Array, Array]:
        """Return the instances (n,), event indices (n,) and rows (n, 1 + 2 nq) of all occurrences.

        A row is [t, q, qd]. The occurrences are sorted by instance. An event index is the position
        of the event's name in `events` of the model.
        """
        none = np.empty(0, int), np.empty(0, np.intc), np.empty((0, 1 + 2 * self.model.info.nq))
        parts = zip(*self.pieces, strict=True) if self.pieces else [[x] for x in none]
        instances, which, rows = (np.concatenate(list(x)) for x in parts)
        order = np.argsort(instances, kind="stable")
        return instances[order], which[order], rows[order]


class GroupEventBuffer:
    """Buffer into which one call of a C function writes the events of `count` instances.

    Attributes
    ----------
    which : (count, capacity) array
        Index of each event in `events` of the model.
    rows : (count, capacity, 1 + 2 nq) array
        Time and state [t, q, qd] of each event.
    c_arguments : tuple
        The arguments of the C function: the capacity, and pointers to these two arrays.
    """

    def __init__(self, model: CompiledModel, count: int) -> None:
        each = EVENTS_EACH + len(model.info.events)
        self.which = np.empty((count, each), np.intc)
        self.rows = np.empty((count, each, 1 + 2 * model.info.nq), model.info.dtype)
        which = model.c.ffi.from_buffer("int[]", self.which)
        self.c_arguments = each, which, model.c.pointer(self.rows)


class EventBuffer:
    """Collect the events of a single run.

    One call of C writes into a buffer, from which `keep` copies the events.
    """

    def __init__(self, model: CompiledModel) -> None:
        self.model = model
        self.pieces: list[tuple[Array, Array]] = []
        self.which = np.empty(_EVENTS + len(model.info.events), np.intc)
        self.rows = np.empty((len(self.which), 1 + 2 * model.info.nq), model.info.dtype)

    def room(self) -> tuple[Any, ...]:
        """Return the arguments with which a C function writes events into the buffer.

        They are the capacity, a pointer to the event indices and a pointer to the rows [t, q, qd].
        """
        address, real, _ = self.model.c.tools
        which = self.model.c.ffi.from_buffer("int[]", self.which)
        return len(self.which), which, address(real, self.rows)

    def keep(self, work: Any) -> None:
        """Copy the events that the last call of C wrote into the buffer.

        work: workspace of the C function; its number of events is reset to 0.
        """
        if work.events:
            n, work.events = work.events, 0
            self.pieces.append((self.which[:n].copy(), self.rows[:n].copy()))

    def all(self) -> tuple[Array, Array]:
        """Return the event indices (n,) and rows (n, 1 + 2 nq) of all n events copied so far.

        A row is [t, q, qd].
        """
        if not self.pieces:
            return self.which[:0], self.rows[:0]
        which, rows = zip(*self.pieces, strict=True)
        return np.concatenate(which), np.concatenate(rows)
