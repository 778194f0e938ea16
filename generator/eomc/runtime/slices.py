"""Split long work in C into slices, so that Ctrl-C is handled between them."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

_SECONDS = 0.05  # target duration of a slice, from the time of the one before
_MAX_GROWTH = 16.0  # of a slice over the one before, since the first rows may be the cheap ones


def next_chunk(count: int, elapsed: float, seconds: float = _SECONDS) -> int:
    """Return the size of the next chunk after `count` items took `elapsed` seconds."""
    return int(count * min(_MAX_GROWTH, max(1 / _MAX_GROWTH, seconds / (elapsed + 1e-9)))) + 1


def slices(count: int, first: int) -> Iterator[tuple[int, int]]:
    """Yield (start, size) of slices that cover `count` rows: `first` rows, then some 50 ms each."""
    start, size = 0, first
    while start < count:
        size = min(size, count - start)
        start_time = perf_counter()
        yield start, size
        start, size = start + size, next_chunk(size, perf_counter() - start_time)
