"""State of a run at any time within it, by a shorter step from the last row before."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_numbers
from .arguments import Array
from .trajectory_data import Trajectory

_STEP_TOLERANCE = 1e-12  # times closer to a step than this fraction of h coincide with it


def within(run: Any, t: ArrayLike) -> Array:
    """Check that times lie within a run; return them, s, as an array of the same shape.

    A time that is outside of the run by no more than rounding is set to the start or end of the
    run. Raises ValueError if a time is further outside.
    """
    times = as_numbers(t, "t", np.dtype(float))
    begin, end = run.t0, float(run.t[-1])
    slack = 1e-12 * max(abs(begin), abs(end), end - begin)
    if times.size and not (times.min() >= begin - slack and times.max() <= end + slack):
        raise ValueError(f"t: the run goes from {begin:g} s to {end:.9g} s")
    return np.asarray(np.clip(times, begin, end))


def states(run: Trajectory, t: ArrayLike) -> tuple[Array, Array]:
    """Return the positions and velocities of a run with fixed steps at any times within the run.

    The state at a time is computed by a shorter step of the same method from the last step before
    that time. Its error has the order of the method if the forces are smooth. Inputs are constant
    over the same steps as in the run.

    Parameters
    ----------
    t : array_like, (...)
        Times, s.

    Returns
    -------
    q, qd : (..., nq) arrays

    Raises
    ------
    ValueError
        If a time is outside of the run, or if u was a function whose values are not stored at each
        step.
    """
    times = within(run, t)
    nq, (whole, rest) = run._model.nq, parts(times.ravel(), run.t0, run.h, run.steps)
    out = np.empty((2, times.size, nq), run._model.dtype)
    for k, (n, left) in enumerate(zip(whole.tolist(), rest.tolist(), strict=True)):
        out[:, k] = _state(run, n, left)
    q, qd = out.reshape(2, *times.shape, nq)
    return q, qd


def parts(times: Array, t0: float, h: float, most: int = 2**60) -> tuple[Array, Array]:
    """Split times into a number of whole steps from t0 and a remaining time, both (n,).

    times: (n,), s. t0: start of the run, s. h: step size, s. most: largest number of steps, such as
    the number of steps of the run. The remaining time is in s.
    """
    steps = (times - t0) / h
    near = _STEP_TOLERANCE + 4 * np.finfo(float).eps * steps  # times are rounded
    whole = np.minimum((steps + near).astype(int), most)
    return whole, np.where(steps - whole < near, 0.0, times - (t0 + whole * h))


def _state(run: Trajectory, n: int, rest: float) -> Any:
    """Return the state `rest` seconds after step n."""
    model, row = run._model, min(n // run.every, len(run) - 1)
    q, qd, first = run.q[row], run.qd[row], row * run.every
    for k in range(first, n):
        q, qd = model.step(q, qd, run.h, *_time_and_inputs(run, k), run._params, run.method)
    if rest > 0:
        q, qd = model.step(q, qd, rest, *_time_and_inputs(run, n), run._params, run.method)
    return q, qd


def _time_and_inputs(run: Trajectory, n: int) -> tuple[float, Any]:
    """Return the time of step n and its inputs."""
    t, u = run.t0 + n * run.h, run._u
    if u is None or (not callable(u) and not isinstance(u, str) and u.ndim == 1):
        return t, u
    if not callable(u) and not isinstance(u, str):
        return t, u[min(n, len(u) - 1)]
    if run._applied is None or run.every > 1:
        raise ValueError("u was a function, which rows don't tell: take every=1")
    return t, run._applied[n]
