"""Split long work in C into slices, so that Ctrl-C is handled between them."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

_SECONDS = 0.05  # target duration of a slice, from the time of the one before
_MAX_GROWTH = 16.0  # of a slice over the one before, since the first rows may be the cheap ones


def next_chunk(count: int, elapsed: float, seconds: float = _SECONDS) -> int:
    """Return the number of items that are expected to take `seconds` to process.

    The estimate uses the time per item of the last chunk: `count` items in `elapsed` seconds. The
    result differs from `count` by at most a factor of 16.
    """
    return int(count * min(_MAX_GROWTH, max(1 / _MAX_GROWTH, seconds / (elapsed + 1e-9)))) + 1


def slices(count: int, first: int) -> Iterator[tuple[int, int]]:
    """Yield consecutive slices (start, size) of `count` rows, each of which takes some 50 ms.

    The first slice has `first` rows. The size of each further slice follows from the time that the
    caller spent on the previous one.
    """
    start, size = 0, first
    while start < count:
        size = min(size, count - start)
        start_time = perf_counter()
        yield start, size
        start, size = start + size, next_chunk(size, perf_counter() - start_time)
