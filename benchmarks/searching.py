"""How long calls take, and the fewest steps that do: for digits.py and adaptive.py."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


def quick(run: Callable[[], object]) -> float:
    """Seconds, the least of some; of what is slow, of one."""
    times: list[float] = []
    while not times or (len(times) < 15 and sum(times) < 0.02):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return min(times)


def fewest(
    error: Callable[[int], float], wanted: float, worth: Callable[[int], bool], within: int = 50
) -> int:
    """The least number of steps that reaches the error, to a part; 0 where it is not worth it."""
    low, high = 0, 16
    while not error(high) <= wanted:
        low, high = high, math.ceil(high * 1.25)
        if not worth(high):
            return 0
    while high - low > max(1, high // within):
        middle = (low + high) // 2
        low, high = (low, middle) if error(middle) <= wanted else (middle, high)
    return high
