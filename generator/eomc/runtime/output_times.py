"""Runs by fixed steps with rows at given output times.

A row between two steps is reached by a shorter step from the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_arguments import as_times
from .arguments import Array
from .dense import parts, within
from .estimate import Estimate, estimate
from .laws import FeedbackLaw
from .slices import next_chunk
from .status import STATUS
from .stepping import Stepping
from .trajectory import Run

_ROWS = 4096  # minimum number of rows in the error estimate, if the run has as many steps
_FIRST = 16_384  # steps times coordinates of the first call of C, some ms
_RARELY = 2**48  # steps from row to row: C stores the last state only


@dataclass(eq=False, repr=False)
class TimedRun(Run):
    """A run by fixed steps whose rows are at requested times.

    The attributes are those of a `Run`, except that `steps` is the number of steps of size h, not
    of rows. The last row of a run that stops early is its last valid state.
    """

    _times: Array = field(kw_only=True)
    _begin: Array = field(kw_only=True)  # q and qd at t0, (2, nq)
    # the values of a function u(t, q, qd), a row for each call
    _law_values: Array | None = field(default=None, init=False)

    @property
    def t(self) -> Array:
        """Times of the rows, (n,), s."""
        return self._times

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the state at times t within the run, by repeating the steps of the run.

        Parameters
        ----------
        t : array_like, any shape
            Times, s.

        Returns
        -------
        q, qd : arrays of shape t.shape + (nq,)

        Raises
        ------
        ValueError
            If a time is outside of the run.
        """
        times = within(self, t)
        unique_times, place = np.unique(times, return_inverse=True)
        result = self._repeat_all(1, unique_times)
        q, qd = (x[place.ravel()].reshape(*times.shape, -1) for x in (result.q, result.qd))
        return q, qd

    @property
    def _requested_inputs(self) -> Array:
        if self._applied is None and self._u is not None and self._u.ndim == 2 and len(self._u):
            index = parts(self._times, self.t0, self.h)[0]
            rows: Array = self._u[np.minimum(index, len(self._u) - 1)]
            return rows
        return super()._requested_inputs

    def _repeat_all(self, every: int, at: Array | None = None) -> Run:
        """Repeat the run with rows after `every` steps, or at the times `at`."""
        model, (q, qd), pointer = self._model, self._begin, self._model._pointer
        whole = self.status == "ok" or at is not None
        steps = _count(self._times if at is None else at, self.t0, self.h) if whole else self.steps
        u = self._u if at is None or self._law_values is None else self._law_values
        if isinstance(u, np.ndarray) and u.ndim == 2:
            u = u[: -(-steps // self._hold)]
        result: Run = model._trajectory(
            q, qd, pointer(q), pointer(qd), self.h, steps, every, u, self._params,
            pointer(self._params), self.method, self.t0, None, None, self._hold, at,
        )  # fmt: skip
        return result

    def _equidistant(self) -> Run:
        return self._repeat_all(1)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        """Estimate the error after each step, and interpolate it linearly to the rows."""
        count = _count(self._times, self.t0, self.h)
        whole = self._repeat_all(max(1, count // _ROWS))
        error = estimate(whole, progress)

        def at_rows(values: Array) -> Array:
            """Interpolate errors after each step linearly to the rows of this run."""
            return np.stack([np.interp(self.t, whole.t, column) for column in values.T], axis=1)

        return replace(error, q=at_rows(error.q), qd=at_rows(error.qd))

    def _to_arrays(self) -> dict[str, Any]:
        own = {"times": self._times, "begin": self._begin, "values": self._law_values}
        return super()._to_arrays() | own

    @classmethod
    def _from_arrays(cls, model: Stepping, arrays: Mapping[str, Any], **own: Any) -> Self:
        times, begin = arrays["times"], arrays["begin"]
        result = super()._from_arrays(model, arrays, _times=times, _begin=begin)
        result._law_values = arrays.get("values")
        return result

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self._times.tolist())


def as_times_and_steps(
    model: Stepping, times: ArrayLike | None, t0: float, h: float, duration: float | None,
    steps: int | None, every: int, out: Any,
) -> tuple[Array | None, int | None]:  # fmt: skip
    """Return the requested times (n,), s, and the number of steps of size h up to the last of them.

    If `times` is None, return (None, steps). The arguments are those of `Model.simulate`. Raises
    ValueError if `times` is invalid, or is combined with `steps`, `every` or `out`, which determine
    the rows as well.
    """
    if times is None:
        return None, steps
    excluded = {"steps": steps is not None, "every": every != 1, "out": out is not None}
    for name, is_given in excluded.items():
        if is_given:
            raise ValueError(f"{name}: times say where rows are; give one or the other")
    rows = as_times(times, t0, np.dtype(float), duration)
    return rows, _count(rows, t0, h)


def run(
    model: Stepping, q: Array, qd: Array, t0: float, h: float, steps: int, times: Array,
    acts: tuple[FeedbackLaw | None, Array | None, int, int], p: Array, method: str,
    progress: Callable[[int, int], None] | None,
) -> TimedRun:  # fmt: skip
    """Simulate by fixed steps with rows at requested times, from checked arguments.

    Parameters
    ----------
    q, qd : (nq,) arrays
        Initial state.
    t0, h : float
        Initial time and step size, s.
    steps : int
        Number of steps up to the last requested time.
    times : (n,) array
        Requested times from t0 on, s.
    acts : tuple
        The inputs, as four values: the feedback law u(t, q, qd), or None; the inputs as an array,
        or None; the distance in that array between the inputs of two steps (0 if they are
        constant); the number of steps of a control period.
    p : (np,) array
        Parameters.
    method : str
        Name of the method.
    progress : callable or None
        Function that is called with (completed steps, all steps).

    Returns
    -------
    TimedRun
        The run, even if it failed; `status` is then the reason.
    """
    stepper = _IntervalStepper(model, q, qd, t0, h, steps, acts, p, method)
    rows = np.empty((2, len(times) + 1, model.nq), model.dtype)
    applied = np.full((len(times) + 1, model.nu), np.nan, model.dtype)
    count, status = 0, "ok"
    try:
        for n, rest in zip(*(x.tolist() for x in parts(times, t0, h)), strict=True):
            status = stepper.step_to(n, progress)
            if status == "ok":
                rows[:, count], status = stepper.interpolate(rest)
            if status != "ok":
                break
            if stepper.law and n < stepper.steps:  # else the inputs of the last step stay
                stepper.inputs()
            applied[count] = stepper.applied
            count += 1
    except KeyboardInterrupt:
        status = "interrupted"
    stamps = times[:count]
    at = t0 + stepper.completed * h
    if status != "ok" and (not count or stamps[-1] < at):  # the last valid state
        rows[:, count], stamps = stepper.state, np.append(stamps, at)
        applied[count] = stepper.applied
    result = TimedRun(
        model, t0, rows[:, : len(stamps)], h, stepper.completed, status, p, 1, stepper.u, method,
        stepper.evaluations, _times=stamps, _begin=np.array([q, qd]),
    )  # fmt: skip
    model._record_singular_steps(result, method, stepper.work)
    if stepper.law:
        result._hold, result._applied = stepper.hold, applied[: len(stamps)]
        result._law_values = np.reshape(stepper.values, (-1, model.nu)).astype(model.dtype)
    return result


def _count(times: Array, t0: float, h: float) -> int:
    """Return the number of steps up to or beyond the last of these times."""
    return ceil((float(times[-1]) - t0) / h * (1 - 1e-12))


class _IntervalStepper:
    """A run in progress: the state after `completed` steps, and the workspace of the C function.

    The arguments are those of the function `run`.
    """

    def __init__(
        self, model: Stepping, q: Array, qd: Array, t0: float, h: float, steps: int,
        acts: tuple[FeedbackLaw | None, Array | None, int, int], p: Array, method: str,
    ) -> None:  # fmt: skip
        self.model, self.t0, self.h, self.steps = model, t0, h, steps
        _, self.run, _, self.stages, self.work_type, self.counted = model._loops[method]
        self.law, self.current, self.stride, self.hold = acts
        copied = None if self.current is None or self.law else self.current.copy()
        self.u = self.law.law if self.law else copied
        self.p, self.work = p, model._ffi.new(self.work_type)
        self.pair = np.array([[q, q], [qd, qd]], model.dtype)  # start and current state
        self.period = -1  # of the last call of the law
        self.extra_evaluations = 0  # of accelerations, in steps to rows between two steps
        self.values: list[Array] = []  # of the law
        self.chunk = max(1, _FIRST // (model.nq**3 if self.counted else model.nq))

    @property
    def state(self) -> Array:
        """Positions and velocities after the last completed step, (2, nq)."""
        return self.pair[:, 1]

    @property
    def completed(self) -> int:
        """Number of completed steps."""
        return int(self.work.completed)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of accelerations so far."""
        own = self.counted(self.work) if self.counted else self.stages * self.completed
        return int(own + self.extra_evaluations)

    def step_to(self, n: int, progress: Callable[[int, int], None] | None) -> str:
        """Step until n steps are completed; return "ok", or the reason if the run stops before."""
        while self.completed < n:
            count = min(n - self.completed, self.chunk)
            if self.law:
                count = min(count, self.hold - self.completed % self.hold)
            at_u, start = self.inputs(), perf_counter()
            status = self._call(self.pair, self.t0, self.h, count, at_u, self.work)
            if status != "ok":
                return status
            if count == self.chunk:
                self.chunk = next_chunk(count, perf_counter() - start)
            if progress is not None:
                progress(self.completed, self.steps)
        return "ok"

    def interpolate(self, rest: float) -> tuple[Array, str]:
        """Compute the state `rest` seconds after the last completed step, by a shorter step.

        Return (state, status): the state [q, qd], (2, nq), and "ok" or the reason of a failure.
        """
        if not rest:
            return self.state, "ok"
        work, pair = self.model._ffi.new(self.work_type), np.repeat(self.pair[:, 1:], 2, axis=1)
        t = self.t0 + self.completed * self.h
        at_u = self.inputs()
        if self.current is not None and self.stride:
            at_u += self.stride * min(self.completed, len(self.current) - 1)
        status = self._call(pair, t, rest, 1, at_u, work)
        self.extra_evaluations += self.counted(work) if self.counted else self.stages
        return pair[:, 1], status

    def _call(self, pair: Array, t: float, h: float, count: int, at_u: Any, work: Any) -> str:
        """Make `count` steps in C, from the last state of `pair`, or its first at the start."""
        pointer, stride = self.model._pointer, self.stride
        (q, qd), at_p = pair, pointer(self.p)
        code = self.run(
            pointer(q), pointer(qd), pointer(q[0]), pointer(qd[0]), t, h, count, at_u, stride,
            _RARELY, at_p, work,
        )  # fmt: skip
        return STATUS[code & 7]

    def inputs(self) -> Any:
        """Return a pointer to the inputs of the next step, for C.

        If a control period begins, the feedback law is called first.
        """
        period = self.completed // self.hold
        if self.law and self.period != period:
            self.current = self.law(self.t0 + self.completed * self.h, *self.state)
            self.values.append(self.current)
            self.period = period
        return self.model._pointer(self.current)

    @property
    def applied(self) -> Any:
        """The inputs (nu,) that the feedback law returned at its last call; nan without a law."""
        return np.nan if not self.law or self.current is None else self.current
