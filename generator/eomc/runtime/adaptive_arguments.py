"""Checks of the arguments of adaptive steps. Invalid arguments raise ValueError."""

from __future__ import annotations

from math import isfinite
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, as_flag, as_number, as_step_size, check_time, without_mask
from .metadata import ModelInfo
from .package import option

MIN_TOLERANCE = {8: 1e-15, 4: 5e-7}  # by the size of a floating-point number in bytes
MAX_TOLERANCE = 1e-2
FIXED_STEP_DEFAULTS = {  # arguments of fixed steps and their default values
    "h": None, "steps": None, "method": None, "every": 1, "out": None,
}  # fmt: skip


def uses_adaptive_steps(
    model: ModelInfo, h: Any, steps: Any, method: Any, tol: Any, h_most: Any, stiff: Any
) -> bool:
    """Return True if a call of `simulate` with these arguments takes adaptive steps.

    Steps are adaptive if tol, h_most, stiff or method="auto" is given. They are also adaptive if
    the scene has a tolerance and none of h, steps and method is given.
    """
    if tol is None and h_most is None and stiff is False and method != "auto":
        return bool(model.tolerance) and h is None and steps is None and method is None
    return True


def as_limits(
    model: ModelInfo, tol: float | None, h_most: float | None, stiff: Any, fixed: tuple[Any, ...]
) -> tuple[float, float]:
    """Check the arguments of adaptive steps; return the tolerance and the longest step.

    Parameters
    ----------
    tol : float or None
        Tolerance; None: that of the scene.
    h_most : float or None
        Longest step, s; None: no limit.
    stiff : bool
        Whether to begin with Newton's method; the type is checked.
    fixed : tuple
        The values that the caller gave for the arguments in `FIXED_STEP_DEFAULTS`, which only fixed
        steps use. Each must have its default value.

    Returns
    -------
    tol : float
    h_most : float
        In s; 0 for no limit.

    Raises
    ------
    ValueError
        If an argument is invalid, or the module was built without adaptive steps.
    """
    as_flag(stiff, "stiff")
    if model.tolerance is None:
        raise ValueError(
            f"tol: {model.name} was built without adaptive steps, to which tol, h_most and stiff "
            f"belong: build it with {option('tolerance', '1e-9')}"
        )
    if not all(map(is_, fixed, FIXED_STEP_DEFAULTS.values())):
        for name, value in zip(FIXED_STEP_DEFAULTS, fixed, strict=True):
            if value is not None and (name, value) not in (("every", 1), ("method", "auto")):
                wants_adaptive = tol is not None or h_most is not None or stiff or "auto" in fixed
                raise ValueError(f"{name}: {_why_not(model, name, bool(wants_adaptive))}")
    most = 0.0 if h_most is None else as_step_size(h_most, model.dtype, "h_most")
    return as_tolerance(model.tolerance if tol is None else tol, model.dtype), most


def _why_not(model: ModelInfo, name: str, wants_adaptive: bool) -> str:
    """Explain why adaptive steps do not accept the argument `name`.

    wants_adaptive: whether the call has an argument of adaptive steps.
    """
    if wants_adaptive:
        return (
            "belongs to fixed steps; tol, h_most and stiff to adaptive ones: give one or the other"
        )
    return (
        f"belongs to fixed steps, and {model.name} goes by its tolerance, {model.tolerance:g}, "
        f"where nothing is said: give h too, such as h={model.h:g}"
    )


def as_progress(progress: Any) -> Any:
    """Return the progress callback unchanged; raise ValueError unless it is None or callable."""
    if progress is not None and not callable(progress):
        raise ValueError(f"progress: {progress!r} is not a function of steps done and in all")
    return progress


def as_end(model: ModelInfo, t0: float, duration: float | None) -> float:
    """Return the end time t0 + duration of a run, s, rounded to the module's number type.

    duration: in s; None: that of the scene. Raises ValueError if the duration is negative, or if
    the spacing of floating-point numbers near the end time is too large for the duration.
    """
    span = model.duration if duration is None else as_number(duration, "duration")
    if span < 0:
        raise ValueError(f"duration: {span:g} is not a time in s")
    check_time(model.dtype, t0, span)
    end = float(t0 + span)
    return end if model.dtype.itemsize == 8 else float(model.dtype.type(end))


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
