"""Arguments of simulations: as the user gives them, their checks, and the checked values.

Invalid arguments raise ValueError.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import ceil, inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import (
    Array,
    as_count,
    as_flag,
    as_number,
    as_period,
    as_step_size,
    check_time,
    cut_table,
    without_mask,
)
from .info import SceneInfo
from .package import option, warn

Progress = Callable[[int, int], None] | None
Inputs = ArrayLike | Mapping[str, ArrayLike] | Callable[[float, Array, Array], ArrayLike] | None

MIN_TOLERANCE = {8: 1e-15, 4: 5e-7}  # by the size of a floating-point number in bytes
MAX_TOLERANCE = 1e-2
FIRST_CALL_NUMBERS = 16_384  # steps times coordinates of the first call of C, some ms
MAX_EVERY = 2**48  # steps from row to row, more than any run makes
_MAX_STEPS = 2**60  # so that C can return four times as many


class SimulationArguments(NamedTuple):
    """Arguments of `simulate` and `simulate_batch` as the user gives them; None if not given.

    Their meaning is described there. `threads` and `max_evaluations` belong to batches, `out` and
    a function `u` to single runs.
    """

    q0: Any = None
    qd0: Any = None
    h: float | None = None
    duration: float | None = None
    steps: int | None = None
    every: int = 1
    u: Any = None
    params: Any = None
    method: str | None = None
    t0: float = 0.0
    control_period: float | None = None
    out: Any = None
    progress: Progress = None
    tol: float | None = None
    times: ArrayLike | None = None
    max_step: float | None = None
    stiff: bool = False
    threads: int | None = None
    max_evaluations: int | None = None

    def uses_adaptive_steps(self, info: SceneInfo) -> bool:
        """Return True if these arguments ask for adaptive steps.

        Steps are adaptive if tol, max_step, stiff or method="auto" is given. They are also adaptive
        if the scene has a tolerance and none of h, steps and method is given.
        """
        if self.tol is None and self.max_step is None and self.stiff is False:
            if self.method is None:
                return bool(info.tolerance) and self.h is None and self.steps is None
            return self.method == "auto"
        return True

    def adaptive_limits(self, info: SceneInfo) -> tuple[float, float]:
        """Return the tolerance and the longest adaptive step, s (0: no limit).

        Raises ValueError if the module was built without adaptive steps, or if an argument of fixed
        steps is given.
        """
        as_flag(self.stiff, "stiff")
        if info.tolerance is None:
            raise ValueError(
                f"tol: {info.name} was built without adaptive steps, to which tol, max_step and "
                f"stiff belong: build it with {option('tolerance', '1e-9')}"
            )
        fixed = (
            ("h", self.h is not None), ("steps", self.steps is not None),
            ("method", self.method is not None and self.method != "auto"),
            ("every", self.every is not None and self.every != 1), ("out", self.out is not None),
        )  # fmt: skip
        for name, is_present in fixed:
            if is_present:
                raise ValueError(f"{name}: {self._why_not_adaptive(info)}")
        most = 0.0 if self.max_step is None else as_step_size(self.max_step, info.dtype, "max_step")
        return as_tolerance(info.tolerance if self.tol is None else self.tol, info.dtype), most

    def _why_not_adaptive(self, info: SceneInfo) -> str:
        """Return the reason why adaptive steps do not accept an argument of fixed steps."""
        if self.tol is not None or self.max_step is not None or self.stiff or self.method == "auto":
            return (
                "belongs to fixed steps; tol, max_step and stiff to adaptive ones: give one or the "
                "other"
            )
        return (
            f"belongs to fixed steps, and {info.name} goes by its tolerance, {info.tolerance:g}, "
            f"where nothing is said: give h too, such as h={info.h:g}"
        )

    def output_times(self, t0: float, h: float) -> tuple[Array | None, int | None]:
        """Return the requested times (n,), s, and the number of steps of size h up to the last.

        If no times are requested, return (None, steps). Raises ValueError if `times` is invalid, or
        is combined with `steps`, `every` or `out`, which determine the rows as well.
        """
        if self.times is None:
            return None, self.steps
        excluded = {
            "steps": self.steps is not None, "every": self.every != 1, "out": self.out is not None,
        }  # fmt: skip
        for name, is_present in excluded.items():
            if is_present:
                raise ValueError(f"{name}: times say where rows are; give one or the other")
        rows = as_times(self.times, t0, np.dtype(float), self.duration)
        return rows, count_steps(rows, t0, h)

    def event_rows(
        self, info: SceneInfo, t0: float, h: float, *, listed: bool = False
    ) -> tuple[Array | None, float]:
        """Return the times (n,) of the rows, s, and the duration, s, of fixed steps with events.

        If there is a row after each step, the times are None, unless `listed` is True. Raises
        ValueError if arguments exclude each other.
        """
        every = as_count(self.every, "every", 1)
        if self.times is not None:
            if self.steps is not None or every != 1:
                name = "every" if self.steps is None else "steps"
                raise ValueError(f"{name}: times say where rows are; give one or the other")
            rows = as_times(self.times, t0, info.dtype, self.duration)
            check_time(info.dtype, t0, float(rows[-1]) - t0, h)
            return rows, float(rows[-1]) - t0
        count = step_count(info, h, self.duration, self.steps)
        span = count * h
        check_time(info.dtype, t0, span, h)
        if every == 1 and not listed:
            return None, span
        return (t0 + h * np.append(np.arange(0, count, every), count)).astype(info.dtype), span

    def input_period(self, h: float) -> float | None:
        """Return the time over which the inputs are constant, s, in fixed steps with events.

        It is the control period, a whole number of steps, or one step of size h if there is none.
        None: the inputs are the scene's signals, which vary within steps.
        """
        if self.u is None and self.control_period is None:
            return None
        return as_period(self.control_period, h) * h

    def inputs_and_hold(
        self, info: SceneInfo, t0: float, h: float, steps: int, axis: int = 0
    ) -> tuple[Any, int]:
        """Return the inputs, and the number of steps for which a row of them is constant.

        A table for the duration is cut if the last output time is earlier. axis: axis of its rows,
        1 for a batch. Raises ValueError if times t0 + k h are not distinct: in single precision at
        the start only, as the times of rows are in double precision.
        """
        if steps:
            check_time(info.dtype, t0, h, h)
            check_time(np.dtype(float), t0, steps * h, h)
        # a period may be longer than the run
        hold = min(as_period(self.control_period, h), max(steps, 2))
        if self.times is not None and self.duration is not None:
            count = -(-step_count(info, h, self.duration, None) // hold)
            return cut_table(self.u, info.nu, count, -(-steps // hold), axis), hold
        return self.u, hold


class FixedStepRequest(NamedTuple):
    """Checked arguments of a run by fixed steps.

    Attributes
    ----------
    q, qd : (nq,) arrays
        Initial state.
    t0, h : float
        Initial time and step size, s.
    steps, every : int
        Number of steps, and of steps from one row to the next.
    u : callable, array, mapping or None
        Inputs as in `Integrator.simulate`; None: the scene's signals.
    p : (np,) array
        Parameters.
    method : str
        Name of the method.
    hold : int
        Number of steps of a control period.
    times : (n,) array or None
        Requested times of the rows, s, in place of `every`.
    out : pair of (rows, nq) arrays or None
        Arrays for the rows.
    progress : callable or None
        Function that is called with (completed steps, all steps).
    c_arguments : tuple or None
        q, qd and p in the form that C reads, if the caller has it.
    """

    q: Array
    qd: Array
    t0: float
    h: float
    steps: int
    every: int
    u: Any
    p: Array
    method: str
    hold: int = 1
    times: Array | None = None
    out: tuple[Array, Array] | None = None
    progress: Progress = None
    c_arguments: tuple[Any, Any, Any] | None = None


class AdaptiveRequest(NamedTuple):
    """Checked arguments of a run with adaptive steps, or with fixed steps and events.

    Attributes
    ----------
    q, qd : (nq,) arrays
        Initial state.
    t0, t_end : float
        Start and end time, s.
    tol : float
        Tolerance of adaptive steps.
    times : (n,) array or None
        Times of the rows, s, later than t0. None: a row at t0 and after each step.
    u : (nu,) array, ZeroOrderHold or None
        Constant inputs, inputs that are held over control periods, or the scene's signals (None).
    p : (np,) array
        Parameters.
    max_step : float
        Longest adaptive step, s (0: no limit), or the size of fixed steps.
    stiff : bool
        Whether the run begins with Newton's method.
    method : str
        Name of the method of fixed steps of size max_step; "": adaptive steps.
    max_steps : float
        Number of steps after which the run ends early. It is checked between calls of C, so the
        run may have more steps.
    progress : callable or None
        Called with (simulated thousandths of the run, 1000).
    """

    q: Array
    qd: Array
    t0: float
    t_end: float
    tol: float
    times: Array | None
    u: Any
    p: Array
    max_step: float
    stiff: bool = False
    method: str = ""
    max_steps: float = inf
    progress: Progress = None


def step_count(info: SceneInfo, h: float, duration: float | None, steps: int | None) -> int:
    """Return the number of fixed steps of size h, s, from `steps` or `duration`, s.

    If neither is given, the duration is that of the scene. Raises ValueError if both are given or
    the number is too large.
    """
    if steps is not None:
        steps = as_count(steps, "steps", 0)
        if duration is not None:
            raise ValueError("steps: give steps or duration, not both")
        if steps > _MAX_STEPS:
            shown = f"{steps:.3g}" if steps < 10**300 else "so many"
            raise ValueError(f"steps: {shown} are more than a run can count, {_MAX_STEPS:.3g}")
        return steps
    time = info.duration if duration is None else as_number(duration, "duration")
    if words := beyond_end(h, time):
        warn(f"{info.name}: {words}")
    if time < 0:
        raise ValueError(f"duration: {duration} is not a time in s")
    if time / h > _MAX_STEPS:
        raise ValueError(
            f"duration: {time:g} s are more steps of h = {h:g} s than a run can count, "
            f"{_MAX_STEPS:.3g}: take a larger h, or a shorter duration"
        )
    # the first multiple of h that is not before the duration, rounding aside
    return ceil(time / h * (1 - 1e-12))


def beyond_end(h: float, duration: float) -> str | None:
    """Return a message if the step size h, s, is larger than the duration, s, else None."""
    if not 0 < duration < h * (1 - 1e-12):
        return None
    return (
        f"h = {h:g} s is longer than the duration, {duration:g} s: the run is one step of {h:g} s"
    )


def count_steps(times: Array, t0: float, h: float) -> int:
    """Return the number of steps of size h, s, from t0 up to or beyond the last of these times."""
    return ceil((float(times[-1]) - t0) / h * (1 - 1e-12))


def as_progress(progress: Any) -> Any:
    """Return the progress callback unchanged; raise ValueError unless it is None or callable."""
    if progress is not None and not callable(progress):
        raise ValueError(f"progress: {progress!r} is not a function of steps done and in all")
    return progress


def as_end(info: SceneInfo, t0: float, duration: float | None) -> float:
    """Return the end time t0 + duration of a run, s, rounded to the module's number type.

    duration: in s; None: that of the scene. Raises ValueError if the duration is negative, or if
    the spacing of floating-point numbers near the end time is too large for the duration.
    """
    span = info.duration if duration is None else as_number(duration, "duration")
    if span < 0:
        raise ValueError(f"duration: {span:g} is not a time in s")
    check_time(info.dtype, t0, span)
    end = float(t0 + span)
    return end if info.dtype.itemsize == 8 else float(info.dtype.type(end))


def as_tolerance(tol: Any, dtype: np.dtype[Any]) -> float:
    """Return the tolerance as a float; raise ValueError if it is outside of the allowed range.

    The range is from MIN_TOLERANCE, which depends on the module's number type `dtype`, to
    MAX_TOLERANCE.
    """
    least = MIN_TOLERANCE[dtype.itemsize]
    number = as_number(tol, "tol")
    if not least <= number <= MAX_TOLERANCE:
        raise ValueError(f"tol: {number:g}: give one between {least:.1g} and {MAX_TOLERANCE:g}")
    return number


def as_numbers(value: ArrayLike, name: str, dtype: np.dtype[Any]) -> Array:
    """Convert a value of any shape to a C-contiguous array of type `dtype`.

    Raises ValueError, which begins with the argument's `name`, if the value is not numeric.
    """
    without_mask(value, name)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cUSmM":  # text that looks like a number is none
            raise TypeError
        return np.asarray(array, dtype, order="C")
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: {value!r} is not an array of numbers") from None


def as_times(
    times: ArrayLike, t0: float, dtype: np.dtype[Any], duration: float | None = None
) -> Array:
    """Check the requested times of rows and return them as an array (n,), s.

    Raises ValueError unless the times are finite, ascending and not before t0, nor after
    t0 + duration if a duration in s is given.
    """
    array = np.atleast_1d(as_numbers(times, "times", dtype))
    if array.ndim != 1 or not len(array) or not (isfinite(array[0]) and isfinite(array[-1])):
        raise ValueError("times: expected a row of finite numbers, in s")
    if array[0] < t0 or not (array[1:] > array[:-1]).all():
        raise ValueError(f"times: expected ascending times from t0 = {t0:g} s on")
    if duration is not None:
        end = t0 + as_number(duration, "duration")
        if array[-1] > end + 4 * np.finfo(dtype).eps * abs(end):  # sums of steps are rounded
            raise ValueError(
                f"times: {array[-1]:g} s is behind the end of the duration, {end:g} s: leave out "
                "such times, or duration, as a run ends with the last of its times"
            )
    return array
