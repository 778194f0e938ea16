"""Access to the compiled functions of a scene, and long computations in slices."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SECONDS = 0.05  # target duration of a slice, from the time of the one before
_MAX_GROWTH = 16.0  # of a slice over the one before, since the first rows may be the cheap ones


class CLibrary:
    """The compiled functions of a scene, and what their calls need.

    Attributes
    ----------
    ffi, lib
        The interface of cffi, and the C functions as its attributes.
    null
        The null pointer.
    tools : tuple
        (address, real, null): address(real, array) is a pointer to the numbers of an array.
        Unpacking it once is faster than reading attributes.
    """

    def __init__(self, extension: Any, dtype: np.dtype[Any]) -> None:
        self.ffi, self.lib = extension.ffi, extension.lib
        real = self.ffi.typeof({"float64": "double[]", "float32": "float[]"}[dtype.name])
        self.null = self.ffi.NULL
        self.tools = (self.ffi.from_buffer, real, self.null)

    def pointer(self, array: NDArray[Any] | None) -> Any:
        """Return a pointer to the numbers of a C-contiguous array of the module's number type.

        Return the null pointer if `array` is None. The array has to exist as long as C uses it.
        """
        address, real, null = self.tools
        return null if array is None else address(real, array)


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
