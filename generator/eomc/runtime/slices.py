"""Long work in C is done in slices, between which Ctrl-C is answered."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

_SECONDS = 0.05  # a slice, as its predecessor suggests
_FASTER = 16.0  # slices grow by this at most, since the first rows may be the cheap ones


def next_chunk(many: int, spent: float, seconds: float = _SECONDS) -> int:
    """How many to do at once after so many took so many seconds."""
    return int(many * min(_FASTER, max(1 / _FASTER, seconds / (spent + 1e-9)))) + 1


def slices(count: int, first: int) -> Iterator[tuple[int, int]]:
    """(at, many) that cover `count` rows: `first` of them, then as many as take some 50 ms."""
    at, many = 0, first
    while at < count:
        many = min(many, count - at)
        begun = perf_counter()
        yield at, many
        at, many = at + many, next_chunk(many, perf_counter() - begun)
