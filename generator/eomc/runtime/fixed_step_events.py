"""Runs by fixed steps with event detection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import adaptive
from .adaptive import SteppedRun
from .adaptive_arguments import as_times
from .arguments import Array, as_count, as_number, as_period, as_step_size, check_time
from .input_schedule import input_schedule
from .laws import warn_called_each_step
from .metadata import SOME
from .stepping import Stepping


def simulate(
    model: Stepping, q0: Any, qd0: Any, duration: float | None, u: Any,
    params: Any, t0: float, progress: Callable[[int, int], None] | None, times: ArrayLike | None,
    control_period: float | None, fixed: tuple[Any, ...], check_stability: Callable[..., None],
) -> SteppedRun:  # fmt: skip
    """Simulate by fixed steps with event detection, and return the run.

    Parameters
    ----------
    fixed : tuple
        The arguments (h, steps, method, every, out) of `Model.simulate`.
    check_stability : callable
        Function that issues a warning if h is beyond the stability limit.

    The other arguments are those of `Model.simulate`.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    h, steps, method, every, out = fixed
    if out is not None:
        raise ValueError("out: events add rows, and no one knows how many: leave it out")
    q, qd = model._start
    if q0 is not None or qd0 is not None:
        q, qd = model._one(q if q0 is None else q0, qd if qd0 is None else qd0)
    method, t0 = model._method(method), as_number(t0, "t0")
    h = model.h if h is None else as_step_size(h, model.dtype)
    p = model._p0 if params is None else model._parameters(params).copy()
    rows, span = as_rows(model, times, t0, h, duration, steps, every)
    end = float(model.dtype.type(t0 + span))
    hold = as_hold(u, control_period, h)
    if callable(u) and hold == h:
        warn_called_each_step(model)
    schedule = input_schedule(model, u, hold, span, params, duration)
    if span >= SOME * h and (method, h) not in model._warned:
        check_stability(
            q, qd, h, t0, schedule if isinstance(schedule, np.ndarray) else None, p, method
        )
    first = 0 if rows is None else int(rows[0] == t0)
    output_times = None if rows is None else rows[first:]
    run = adaptive.run(
        model, q, qd, t0, end, 0.0, output_times, schedule, p, h, progress, method=method
    )
    assert isinstance(run, SteppedRun)
    if rows is None:
        return run
    both = np.concatenate([np.array([[q], [qd]])[:, :first], run._rows], axis=1)
    stamps, (t, x) = rows[: both.shape[1]], run._last
    if times is None and t > stamps[-1]:  # an event stopped the run between two rows
        both, stamps = np.append(both, x.reshape(2, 1, -1), axis=1), np.append(stamps, t)
    return run._with_rows(stamps, both)


def as_rows(
    model: Stepping, times: ArrayLike | None, t0: float, h: float, duration: float | None,
    steps: int | None, every: int, *, listed: bool = False,
) -> tuple[Array | None, float]:  # fmt: skip
    """Return the times (n,) of the rows of a run, s, and the time from its start to its end, s.

    If there is a row after each step, the times are None, unless `listed` is True.

    times: times of the rows that the user requests; None: a row after every `every` steps. The
    other arguments are those of `Model.simulate`. Raises ValueError if arguments exclude each
    other.
    """
    every = as_count(every, "every", 1)
    if times is not None:
        if steps is not None or every != 1:
            name = "every" if steps is None else "steps"
            raise ValueError(f"{name}: times say where rows are; give one or the other")
        rows = as_times(times, t0, model.dtype, duration)
        check_time(model.dtype, t0, float(rows[-1]) - t0, h)
        return rows, float(rows[-1]) - t0
    count = model._steps(h, duration, steps)
    span = count * h
    check_time(model.dtype, t0, span, h)
    if every == 1 and not listed:
        return None, span
    return (t0 + h * np.append(np.arange(0, count, every), count)).astype(model.dtype), span


def as_hold(u: Any, control_period: float | None, h: float) -> float | None:
    """Return the time over which the inputs of a run with fixed steps are constant, s.

    It is the control period, a whole number of steps, or one step if there is none. Return None if
    u and the control period are None: the inputs are then the scene's signals, which vary within
    steps. u: the inputs that the user gives. h: step size, s.
    """
    if u is None and control_period is None:
        return None
    return as_period(control_period, h) * h
