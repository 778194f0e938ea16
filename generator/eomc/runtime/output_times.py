"""Runs by fixed steps with rows at given output times.

A row between two steps is reached by a shorter step from the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array
from .c_library import next_chunk
from .estimate import Estimate, estimate
from .inputs import FeedbackLaw
from .interfaces import CompiledModel
from .requests import FIRST_CALL_NUMBERS, MAX_EVERY, FixedStepRequest, count_steps
from .status import STATUS
from .trajectory import Run
from .trajectory_data import parts, within

_ROWS = 4096  # minimum number of rows in the error estimate, if the run has as many steps
InputTable = tuple[FeedbackLaw | None, Array | None, int]  # of `Integrator.input_table`


@dataclass(eq=False, repr=False)
class TimedRun(Run):
    """A run by fixed steps whose rows are at requested times.

    The attributes are those of a `Run`, except that `steps` is the number of steps of size h, not
    of rows. The last row of a run that stops early is its last valid state.
    """

    _times: Array = field(kw_only=True)
    initial_state: Array = field(kw_only=True)  # q and qd at t0, (2, nq)
    # the values of a function u(t, q, qd), a row for each call
    law_values: Array | None = field(default=None, init=False)

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
    def requested_inputs(self) -> Array:
        """The inputs at each row before saturation, (n, nu)."""
        if (
            self.applied_inputs is None
            and self.input_source is not None
            and self.input_source.ndim == 2
            and len(self.input_source)
        ):
            index = parts(self._times, self.t0, self.h)[0]
            rows: Array = self.input_source[np.minimum(index, len(self.input_source) - 1)]
            return rows
        return super().requested_inputs

    def _repeat_all(self, every: int, at: Array | None = None) -> Run:
        """Repeat the run with rows after `every` steps, or at the times `at`."""
        q, qd = self.initial_state
        whole = self.status == "ok" or at is not None
        times = self._times if at is None else at
        steps = count_steps(times, self.t0, self.h) if whole else self.steps
        u = self.input_source if at is None or self.law_values is None else self.law_values
        if isinstance(u, np.ndarray) and u.ndim == 2:
            u = u[: -(-steps // self.hold)]
        request = FixedStepRequest(
            q, qd, self.t0, self.h, steps, every, u, self.parameter_values, self.method, self.hold,
            at,
        )  # fmt: skip
        result: Run = self.model.integrator.run(request)
        return result

    def equidistant(self) -> Run:
        """Return a run with equidistant rows, one for each step, or enough for a picture."""
        return self._repeat_all(1)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        """Estimate the error after each step, and interpolate it linearly to the rows."""
        count = count_steps(self._times, self.t0, self.h)
        whole = self._repeat_all(max(1, count // _ROWS))
        error = estimate(whole, progress)

        def at_rows(values: Array) -> Array:
            """Interpolate errors after each step linearly to the rows of this run."""
            return np.stack([np.interp(self.t, whole.t, column) for column in values.T], axis=1)

        return replace(error, q=at_rows(error.q), qd=at_rows(error.qd))

    def to_arrays(self) -> dict[str, Any]:
        """Return the arrays and numbers that a file of the run contains, by name."""
        own = {"times": self._times, "begin": self.initial_state, "values": self.law_values}
        return super().to_arrays() | own

    @classmethod
    def from_arrays(cls, model: CompiledModel, arrays: Mapping[str, Any], **own: Any) -> Self:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        times, begin = arrays["times"], arrays["begin"]
        result = super().from_arrays(model, arrays, _times=times, initial_state=begin)
        result.law_values = arrays.get("values")
        return result

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        return (*super().settings(), self._times.tolist())


def run(model: CompiledModel, request: FixedStepRequest, table: InputTable) -> TimedRun:
    """Simulate by fixed steps with rows at requested times, from checked arguments.

    table: inputs as `Integrator.input_table` returns them. The run is returned even if it failed;
    its attribute `status` is then the reason.
    """
    stepper = _IntervalStepper(model, request, table)
    t0, h, times = request.t0, request.h, request.times
    assert times is not None
    rows = np.empty((2, len(times) + 1, model.info.nq), model.info.dtype)
    applied = np.full((len(times) + 1, model.info.nu), np.nan, model.info.dtype)
    count, status = 0, "ok"
    try:
        for n, rest in zip(*(x.tolist() for x in parts(times, t0, h)), strict=True):
            status = stepper.step_to(n, request.progress)
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
        model, t0, rows[:, : len(stamps)], h, stepper.completed, status, request.p, 1, stepper.u,
        request.method,
        stepper.evaluations, _times=stamps, initial_state=np.array([request.q, request.qd]),
    )  # fmt: skip
    model.integrator.record_singular_steps(result, request.method, stepper.work)
    if stepper.law:
        result.hold, result.applied_inputs = request.hold, applied[: len(stamps)]
        result.law_values = np.reshape(stepper.values, (-1, model.info.nu)).astype(model.info.dtype)
    return result


class _IntervalStepper:
    """A run in progress: the state after `completed` steps, and the workspace of the C function.

    The arguments are those of the function `run`.
    """

    def __init__(self, model: CompiledModel, request: FixedStepRequest, table: InputTable) -> None:
        self.model, self.request = model, request
        self.t0, self.h, self.steps, self.hold = request.t0, request.h, request.steps, request.hold
        self.loop = model.integrator.loops[request.method]
        self.law, self.current, self.stride = table
        copied = None if self.current is None or self.law else self.current.copy()
        self.u = self.law.law if self.law else copied
        self.work = model.c.ffi.new(self.loop.work_type)
        start = [[request.q, request.q], [request.qd, request.qd]]
        self.pair = np.array(start, model.info.dtype)  # start and current state
        self.period = -1  # of the last call of the law
        self.extra_evaluations = 0  # of accelerations, in steps to rows between two steps
        self.values: list[Array] = []  # of the law
        numbers = model.info.nq**3 if self.loop.evaluations else model.info.nq
        self.chunk = max(1, FIRST_CALL_NUMBERS // numbers)

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
        own = (
            self.loop.evaluations(self.work)
            if self.loop.evaluations
            else self.loop.stages * self.completed
        )
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
        work, pair = (
            self.model.c.ffi.new(self.loop.work_type),
            np.repeat(self.pair[:, 1:], 2, axis=1),
        )
        t = self.t0 + self.completed * self.h
        at_u = self.inputs()
        if self.current is not None and self.stride:
            at_u += self.stride * min(self.completed, len(self.current) - 1)
        status = self._call(pair, t, rest, 1, at_u, work)
        self.extra_evaluations += (
            self.loop.evaluations(work) if self.loop.evaluations else self.loop.stages
        )
        return pair[:, 1], status

    def _call(self, pair: Array, t: float, h: float, count: int, at_u: Any, work: Any) -> str:
        """Make `count` steps in C, from the last state of `pair`, or its first at the start."""
        pointer, stride = self.model.c.pointer, self.stride
        (q, qd), at_p = pair, pointer(self.request.p)
        code = self.loop.run(
            pointer(q), pointer(qd), pointer(q[0]), pointer(qd[0]), t, h, count, at_u, stride,
            MAX_EVERY, at_p, work,  # C stores the last state only
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
        return self.model.c.pointer(self.current)

    @property
    def applied(self) -> Any:
        """The inputs (nu,) that the feedback law returned at its last call; nan without a law."""
        return np.nan if not self.law or self.current is None else self.current
