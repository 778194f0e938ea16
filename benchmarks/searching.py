"""How long calls take, and the fewest steps that do, for several benchmarks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from eomc.runtime.package import model_of

Array = np.ndarray[Any, np.dtype[np.float64]]


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


def timed(ways: Sequence[Callable[[], object] | None], rounds: int) -> Array:
    """The least us of each, all in turns for some tenths of ms; what is slow in fewer rounds."""
    first = [math.nan if way is None else quick(way) for way in ways]
    counts = [1 if math.isnan(s) else max(1, round(4e-4 / s)) for s in first]
    rounds = max(3, min(rounds, round(20 / float(np.nansum(first)))))
    times = np.full((rounds, len(ways)), np.nan)
    for k in range(rounds):
        for i, way in enumerate(ways):
            if way is not None:
                begun = time.perf_counter()
                for _ in range(counts[i]):
                    way()
                times[k, i] = (time.perf_counter() - begun) / counts[i] * 1e6
    return np.array([np.min(column) for column in times.T])


def adaptive_in_c(
    module: ModuleType, end: float, tol: float, u: Array | None = None
) -> Callable[[], object]:
    """A run in steps that fit the tolerance: the loop in C, called with nothing around it."""
    model = model_of(module)
    ffi, pointer, null = model.c.ffi, model.c.pointer, model.c.null
    options = ffi.new("run_options *", {"tol": tol, "t_end": end, "steps": 2**40})
    output, nothing = ffi.new("run_output *"), bytes(ffi.sizeof("run_output"))
    (q, qd, p), no_events = model.arguments.default_pointers, model.integrator.no_events
    at_u, integrate = pointer(u), model.c.lib.integrate

    def run() -> None:
        ffi.memmove(output, nothing, len(nothing))
        integrate(
            options, output, null, q, qd, null, 0, at_u, 0, p, *no_events, null, null, null
        )  # fmt: skip

    return run


def fixed_in_c(module: ModuleType, method: str, h: float, steps: int) -> Callable[[], object]:
    """A run in fixed steps, likewise; it keeps the start and the end."""
    model = model_of(module)
    null, no_events = model.c.null, model.integrator.no_events
    options = model.c.ffi.new("run_options *", {"h": h, "steps": steps, "every": steps})
    if len(model.info.methods) > 1:
        options.method = model.info.methods.index(method)
    if model.info.events:
        options.ignores_events = True
    q0, qd0, p = model.arguments.default_pointers
    rows = np.empty((2, 2, model.info.nq))
    to, integrate = model.c.pointer(rows), model.c.lib.integrate

    def run() -> Array:
        integrate(options, null, null, q0, qd0, null, 2, null, 0, p, *no_events, null, to, null)
        return rows

    return run
