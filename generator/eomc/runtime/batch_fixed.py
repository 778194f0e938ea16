"""Simulation of many instances with fixed steps: rows after every few steps or at any times.

A state between two steps is computed by a shorter step from the first of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, machine_memory
from .batch_trajectory import BatchRun, stepper_for
from .batch_work import BatchStepper, BatchSteps, Instances, Work
from .integrator import MIN_CHECKED_NUMBERS
from .interfaces import CompiledBatchModel
from .requests import Progress
from .status import STATUS
from .trajectory_data import parts

_SAVED_FIELDS = {"_times": "_times", "_begin": "initial_state"}  # by names in files
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
    initial_state: Array = field(kw_only=True)  # q and qd at t0, (2, batch, nq)

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        return self._times

    def _states(self, times: Array) -> Array:
        rows = np.empty((2, len(self), len(times), self.model.info.nq), self.model.info.dtype)
        stepper = stepper_for(self, self.initial_state.copy(), self.input_source)
        stepper.rows(parts(times, self.t0, self.h), rows)
        return rows

    def field_values(self) -> tuple[Any, ...]:
        """Return the values of the fields that the base class `BatchRun` has, in order."""
        return tuple(getattr(self, each.name) for each in fields(BatchRun))

    def to_arrays(self) -> dict[str, Any]:
        """Return the arrays and numbers that a file of the run contains, by name."""
        return super().to_arrays() | {
            key: getattr(self, name) for key, name in _SAVED_FIELDS.items()
        }

    @classmethod
    def from_arrays(cls, model: Any, arrays: Mapping[str, Any]) -> TimedBatchRun:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        fields_of_batch = BatchRun.from_arrays(model, arrays).field_values()
        own: Any = {name: arrays.get(key) for key, name in _SAVED_FIELDS.items()}
        return cls(*fields_of_batch, **own)

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        return (*super().settings(), self._times.tolist())


class BatchRequest(NamedTuple):
    """Checked arguments of a batch with fixed steps that are the same for all instances.

    Attributes
    ----------
    plan : BatchSteps
        Method, step size, start time, numbers of steps.
    times : (n,) array or None
        Requested times of the rows, s. None: a row after each `every` steps.
    threads : int or None
        Number of threads; None: one for each processor.
    progress : callable or None
        Called with the numbers of completed and of all steps, summed over all instances.
    """

    plan: BatchSteps
    times: Array | None
    threads: int | None
    progress: Progress


def simulate(
    model: CompiledBatchModel, instances: Instances, request: BatchRequest
) -> tuple[BatchRun, bool]:
    """Simulate many instances with fixed steps, from checked arguments.

    Return the batch, and False if Ctrl-C interrupted it, else True.
    """
    run = _by_steps if request.times is None else _at_times
    return run(model, instances, request)


def _by_steps(
    model: CompiledBatchModel, instances: Instances, request: BatchRequest
) -> tuple[BatchRun, bool]:
    """Simulate with rows after every `every` steps and at the end."""
    method, h, t0, steps, every = request.plan
    starts, table, inputs, _ = instances
    assert starts is not None
    rows = 1 + steps // every + (steps % every > 0)
    (q, qd), (q_rows, qd_rows) = _ends_and_rows(model, len(starts[0]), rows)
    work = Work(model, request.plan, (q, qd), instances, (q_rows, qd_rows))
    whole = work.run(request.threads, request.progress)
    if steps % every:
        q_rows[:, -1], qd_rows[:, -1] = q, qd
    if not whole or work.failed:
        short = work.completed < steps
        for k in short.nonzero()[0]:  # a row exists where its own step was completed
            completed = 1 + work.completed[k] // every
            q_rows[k, completed:] = qd_rows[k, completed:] = np.nan
        if not whole:
            work.status[(work.status == 0) & short] = _INTERRUPTED
    row_inputs = None if inputs is None else _at_rows(inputs, np.arange(rows) * every, steps)
    step_inputs = inputs if inputs is not None and inputs.shape[1] > 1 and every > 1 else None
    run = BatchRun(
        model, t0, q_rows, qd_rows, h, work.completed, work.status, every, steps, table.copy(),
        row_inputs, model.info.method_name(method),
        None if step_inputs is None else step_inputs.copy(),
    )  # fmt: skip
    return run, whole


def _at_times(
    model: CompiledBatchModel, instances: Instances, request: BatchRequest
) -> tuple[BatchRun, bool]:
    """Simulate with rows at the requested times."""
    (method, h, t0, steps, _), times = request.plan, request.times
    starts, table, inputs, _ = instances
    assert starts is not None and times is not None
    places = parts(times, t0, h, steps)
    both, (q_rows, qd_rows) = _ends_and_rows(model, len(starts[0]), len(times))
    stepper = BatchStepper(model, request.plan._replace(steps=0), both, instances)
    whole = stepper.rows(places, (q_rows, qd_rows), request.threads, request.progress)
    work, last = stepper.work, int(places[0][-1])
    if not whole:
        work.status[(work.status == 0) & (work.completed < last)] = _INTERRUPTED
    row_inputs = None if inputs is None else _at_rows(inputs, places[0], steps)
    run = TimedBatchRun(
        model, t0, q_rows, qd_rows, h, work.completed, work.status, 1, last, table.copy(),
        row_inputs, model.info.method_name(method), None if inputs is None else inputs.copy(),
        _times=times, initial_state=np.array(starts, model.info.dtype),
    )  # fmt: skip
    return run, whole


def _at_rows(inputs: Array, step_indices: Array, steps: int) -> Array:
    """Return a copy of the inputs that apply from each of these steps on."""
    if inputs.shape[1] == 1:
        return inputs.copy()
    return np.ascontiguousarray(inputs[:, np.minimum(step_indices, steps - 1)])


def _ends_and_rows(
    model: CompiledBatchModel, count: int, rows: int
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Allocate q and qd at the ends, (batch, nq), and of the rows, (batch, rows, nq)."""
    nq, dtype = model.info.nq, model.info.dtype
    try:
        if (
            count * rows * nq > MIN_CHECKED_NUMBERS
            and model.info.row_bytes(count * rows) > machine_memory()
        ):
            raise MemoryError
        end, whole = (count, nq), (count, rows, nq)
        ends = np.empty(end, dtype), np.empty(end, dtype)
        return ends, (np.empty(whole, dtype), np.empty(whole, dtype))
    except MemoryError:
        raise MemoryError(
            f"{count} times {rows} rows of {2 * nq} numbers don't fit in memory: "
            "keep fewer with every="
        ) from None
