"""Simulation of many instances with fixed steps: rows after every few steps or at any times.

A state between two steps is computed by a shorter step from the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, machine_memory
from .batch_instances import Instances
from .batch_run import BatchRun, stepper_for
from .batch_work import BatchStepper, Work
from .dense import parts
from .model import LARGE
from .status import STATUS

_NAMES = ("_times", "_begin")
_INTERRUPTED = STATUS.index("interrupted")


@dataclass(eq=False, repr=False)
class TimedBatchRun(BatchRun):
    """Trajectories of many instances with fixed steps and rows at requested times.

    A requested time may lie between two steps. The state there is computed by a shorter step that
    begins at the earlier of the two. Rows after the last successful step of an instance are nan.
    The attribute `steps` (batch,) is the number of steps of size h that each instance completed.
    The other attributes are those of `BatchRun`.
    """

    _times: Array = field(kw_only=True)
    _begin: Array = field(kw_only=True)  # q and qd at t0, (2, batch, nq)

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        return self._times

    def _states(self, times: Array) -> Array:
        rows = np.empty((2, len(self), len(times), self._model.nq), self._model.dtype)
        stepper = stepper_for(self, self._begin.copy(), self._u)
        stepper.rows(parts(times, self.t0, self.h), rows)
        return rows

    def _all(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(BatchRun))

    def _to_arrays(self) -> dict[str, Any]:
        return super()._to_arrays() | {name: getattr(self, name) for name in _NAMES}

    @classmethod
    def _from_arrays(cls, model: Any, arrays: Mapping[str, Any]) -> TimedBatchRun:
        fields_of_batch = BatchRun._from_arrays(model, arrays)._all()
        own: Any = {name: arrays.get(name) for name in _NAMES}
        return cls(*fields_of_batch, **own)

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self._times.tolist())


class FixedStepRequest(NamedTuple):
    """Checked arguments of a batch with fixed steps.

    Attributes
    ----------
    step : C function
        Function that advances a group of instances by steps.
    h, t0 : float
        Step size and start time, s.
    steps : int
        Number of steps.
    every : int
        Number of steps between two rows.
    times : (n,) array or None
        Requested times of the rows, s. None: a row after each `every` steps.
    method : str
        Name of the method.
    threads : int or None
        Number of threads; None: one for each processor.
    progress : callable or None
        Called with the numbers of completed and of all steps, summed over all instances.
    codes : (batch,) array or None
        Status number of each instance before the first step: 0, or the number of the failure if its
        initial state cannot be moved onto the constraints. None if all are 0.
    """

    step: Any  # C function
    h: float
    t0: float
    steps: int
    every: int
    times: Array | None
    method: str
    threads: int | None
    progress: Callable[[int, int], None] | None
    codes: Array | None


def simulate(
    model: Instances,
    starts: tuple[Array, Array],
    inputs: Array | None,
    table: Array,
    request: FixedStepRequest,
) -> tuple[BatchRun, bool]:
    """Simulate many instances with fixed steps, from checked arguments.

    Parameters
    ----------
    starts : pair of (batch, nq) arrays
        Initial positions and velocities.
    inputs : (batch or 1, steps or 1, nu) array or None
        Inputs of each step; None: the scene's signals.
    table : (batch or 1, np) array
        Parameters.
    request : FixedStepRequest
        All other arguments.

    Returns
    -------
    run : BatchRun
    completed : bool
        False if Ctrl-C interrupted the run.
    """
    run = _by_steps if request.times is None else _at_times
    return run(model, starts, inputs, table, request)


def _by_steps(
    model: Instances,
    starts: tuple[Array, Array],
    inputs: Array | None,
    table: Array,
    request: FixedStepRequest,
) -> tuple[BatchRun, bool]:
    """Simulate with rows after every `every` steps and at the end."""
    step, h, t0, steps, every, _, method, threads, progress, codes = request
    rows = 1 + steps // every + (steps % every > 0)
    (q, qd), (q_rows, qd_rows) = _ends_and_rows(model, len(starts[0]), rows)
    work = Work(model, step, q, qd, h, t0, steps, every, inputs, table, q_rows, qd_rows, starts)
    work.leave(codes)
    whole = work.run(threads, progress)
    if steps % every:
        q_rows[:, -1], qd_rows[:, -1] = q, qd
    if not whole or work.failed:
        short = work.done < steps
        for k in short.nonzero()[0]:  # a row exists where its own step was completed
            completed = 1 + work.done[k] // every
            q_rows[k, completed:] = qd_rows[k, completed:] = np.nan
        if not whole:
            work.status[(work.status == 0) & short] = _INTERRUPTED
    row_inputs = None if inputs is None else _at_rows(inputs, np.arange(rows) * every, steps)
    step_inputs = inputs if inputs is not None and inputs.shape[1] > 1 and every > 1 else None
    run = BatchRun(
        model, t0, q_rows, qd_rows, h, work.done, work.status, every, steps, table.copy(),
        row_inputs, method, None if step_inputs is None else step_inputs.copy(),
    )  # fmt: skip
    return run, whole


def _at_times(
    model: Instances,
    starts: tuple[Array, Array],
    inputs: Array | None,
    table: Array,
    request: FixedStepRequest,
) -> tuple[BatchRun, bool]:
    """Simulate with rows at the requested times."""
    h, t0, method, times = request.h, request.t0, request.method, request.times
    assert times is not None
    places = parts(times, t0, h, request.steps)
    both, (q_rows, qd_rows) = _ends_and_rows(model, len(starts[0]), len(times))
    stepper = BatchStepper(model, method, both, t0, h, inputs, table, starts)
    stepper.work.leave(request.codes)
    whole = stepper.rows(places, (q_rows, qd_rows), request.threads, request.progress)
    work, last = stepper.work, int(places[0][-1])
    if not whole:
        work.status[(work.status == 0) & (work.done < last)] = _INTERRUPTED
    row_inputs = None if inputs is None else _at_rows(inputs, places[0], request.steps)
    run = TimedBatchRun(
        model, t0, q_rows, qd_rows, h, work.done, work.status, 1, last, table.copy(),
        row_inputs, method, None if inputs is None else inputs.copy(), _times=times,
        _begin=np.array(starts, model.dtype),
    )  # fmt: skip
    return run, whole


def _at_rows(inputs: Array, step_indices: Array, steps: int) -> Array:
    """Return a copy of the inputs that apply from each of these steps on."""
    if inputs.shape[1] == 1:
        return inputs.copy()
    return np.ascontiguousarray(inputs[:, np.minimum(step_indices, steps - 1)])


def _ends_and_rows(
    model: Instances, count: int, rows: int
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Allocate q and qd at the ends, (batch, nq), and of the rows, (batch, rows, nq)."""
    nq, dtype = model.nq, model.dtype
    try:
        if count * rows * nq > LARGE and model._bytes(count * rows) > machine_memory():
            raise MemoryError
        end, whole = (count, nq), (count, rows, nq)
        ends = np.empty(end, dtype), np.empty(end, dtype)
        return ends, (np.empty(whole, dtype), np.empty(whole, dtype))
    except MemoryError:
        raise MemoryError(
            f"{count} times {rows} rows of {2 * nq} numbers don't fit in memory: "
            "keep fewer with every="
        ) from None
