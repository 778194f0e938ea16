"""Trajectories of many instances: what `simulate_batch` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array
from .batch_plot import Fans, single_run_hint
from .batch_values import Values
from .batch_work import BatchStepper
from .by_name import ByName
from .columns import Columns
from .dense import parts, within
from .model import Model
from .package import own_model, reduced
from .status import STATUS, STATUS_MESSAGES

_ENDS = np.array(STATUS)
# keys of saved fields, in order
_FIELDS = "t0 q qd h steps codes every wanted params held method _u".split()
_OF_ONE = {
    "balance": "balance()", "estimate": "estimate()", "error": "estimate()",
    "section": "section(...)",
}  # fmt: skip


@dataclass(eq=False, repr=False)
class BatchRun(Values, Fans, Columns):
    """Trajectories of many instances of a scene, returned by `simulate_batch`.

    All instances have rows at the same n times. A row is stored if the instance completed the steps
    to its time; the rows of an instance after its failure are nan. Columns are available by name:
    run["theta_dot"] has the shape (batch, n). Two runs are equal if scene, settings and rows are
    equal bit by bit.

    Attributes
    ----------
    t : (n,) array
        Times of the rows, s.
    q, qd : (batch, n, nq) arrays
        Positions and velocities.
    u : (batch, n, nu) array
        Applied inputs.
    status : (batch,) array of str
        "ok", "singular", "not finite", "no convergence", "locked" or "interrupted". For an initial
        state that cannot be moved onto the constraints ("locked"), the first row is the initial
        state of the caller.
    steps : (batch,) array of int
        Number of steps that each instance completed.
    t0, h : float
        Start time and step size, s.
    every : int
        Number of steps between two rows.
    method : str
        Name of the integration method.
    """

    _axes = ("instance", "t")
    _model: Model
    t0: float
    q: Array
    qd: Array
    h: float
    steps: Array
    _codes: Array
    every: int
    _requested_steps: int
    _params: Array  # (batch or 1, np)
    _row_inputs: Array | None  # at the rows, (batch or 1, n or 1, nu)
    method: str
    _u: Array | None = None  # (batch or 1, steps or 1, nu), if _row_inputs has only a part of it

    @cached_property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        steps = np.minimum(np.arange(self.q.shape[1]) * self.every, self._requested_steps)
        return np.asarray(self.t0 + self.h * steps)

    @cached_property
    def status(self) -> Array:
        """Return the status of each instance as text, (batch,), such as "ok" or "singular"."""
        return np.asarray(_ENDS[self._codes])

    @property
    def u(self) -> Array:
        """Return the inputs applied at each row, (batch, n, nu), limited to their allowed ranges.

        At each row they are the values of the scene's signals, or the constant inputs of the step
        that begins there. The last row has the inputs of the last step.
        """
        return self._within(self._requested_inputs)

    @property
    def saturated(self) -> Array:
        """Return whether each input exceeds its limits at each row, as a bool array (batch, n, nu).

        The inputs are compared before they are limited. Values are False at rows that are nan.
        """
        inputs = self._requested_inputs
        return np.asarray(np.abs(inputs - self._within(inputs)) > 0)

    def _within(self, u: Array) -> Array:
        """Saturate inputs (batch, n, nu) at the limits of their instances."""
        return self._model._within(u, self._params)

    @property
    def _requested_inputs(self) -> Array:
        """Inputs at each row before saturation, (batch, n, nu)."""
        if self._row_inputs is None:
            return self._evaluate(self._model.signal, (self._model.nu,))
        inputs = np.broadcast_to(self._row_inputs, (*self.q.shape[:2], self._model.nu)).copy()
        inputs[np.isnan(self.q[..., 0])] = np.nan
        return inputs

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the positions and velocities of all instances at any times within the run.

        The steps from the preceding row, or all steps, are repeated, so the states are as accurate
        as the run.

        Parameters
        ----------
        t : array_like, (...)
            Times, s.

        Returns
        -------
        q, qd : (batch, ..., nq) arrays
            nan at times after the end of an instance.

        Raises
        ------
        ValueError
            If a time is outside of the run.
        """
        times = within(self, t)
        asked, place = np.unique(times, return_inverse=True)
        q, qd = self._states(asked)[:, :, place.ravel()]
        shape = (len(self), *times.shape, self._model.nq)
        return q.reshape(shape), qd.reshape(shape)

    def _states(self, times: Array) -> Array:
        """Return states (2, batch, n, nq) at ascending times, from the row before each."""
        inputs, every = self._row_inputs if self._u is None else self._u, self.every
        whole, rest = parts(times, self.t0, self.h, self._requested_steps)
        rows = np.empty((2, len(self), len(times), self._model.nq), self._model.dtype)
        for row in np.unique(whole // every):
            own, first = (whole // every == row).nonzero()[0], int(row) * every
            stepper = stepper_for(self, np.array([self.q[:, row], self.qd[:, row]]), inputs, first)
            stepper.work.status[self.steps < first] = STATUS.index(
                "not finite"
            )  # instances that did not reach this row
            here = slice(own[0], own[-1] + 1)
            stepper.rows((whole[own], rest[own]), rows[:, :, here])
        return rows

    def __getattr__(self, name: str) -> Any:
        """Return a column of the scene; the error for attributes of single runs has a hint."""
        if name in _OF_ONE and name not in self._named():
            raise AttributeError(f"{name} {single_run_hint(self)}.{_OF_ONE[name]}")
        return super().__getattr__(name)

    @property
    def events(self) -> Mapping[str, Any]:
        """Return the occurrences of each event as a dict by the event's name.

        The dict is empty for scenes without events.
        """
        return ByName("events", (), ())

    def _to_arrays(self) -> dict[str, Any]:
        """Return the data of a saved run by name; None: not saved."""
        return dict(zip(_FIELDS, self._all()[1:], strict=True))

    @classmethod
    def _from_arrays(cls, model: Model, arrays: Mapping[str, Any]) -> BatchRun:
        values: Any = map(arrays.get, _FIELDS)
        return cls(model, *values)

    @classmethod
    def _of_pickled(cls, arrays: Mapping[str, Any]) -> BatchRun:
        return cls._from_arrays(own_model(), arrays)

    @property
    def message(self) -> str:
        """Return a sentence with the numbers of instances, of steps and of instances by status."""
        names, counts = np.unique(self.status, return_counts=True)
        statuses = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        step_count = int(self.steps.sum())
        total_steps = len(self) * self._requested_steps
        steps = f"{step_count} of {total_steps} steps of {self.h:g} s"
        return f"{len(self)} instances, {steps}: {statuses}"

    @property
    def _no_convergence_message(self) -> str:
        """Number of failed instances and the reason of the first failure; "" if none failed."""
        if not self._codes.any():
            return ""
        k = int(self._codes.nonzero()[0][0])
        first = f"the first that could not go on, instance {k}, stopped at t = {self._end(k):.9g}"
        return f"{self.message}; {first}: {self._why(k)}"

    def _end(self, k: int) -> float:
        """Return the time that instance k reached, s."""
        return float(self.t0 + self.h * self.steps[k])

    def _why(self, k: int) -> str:
        """Return the reason why instance k failed."""
        return STATUS_MESSAGES[str(_ENDS[self._codes[k]])]

    def __reduce__(self) -> tuple[Any, ...]:
        kind = type(self)
        path = f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}._of_pickled"
        return reduced(path, self._to_arrays())

    def _all(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(self))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BatchRun):
            return NotImplemented
        alike = self._settings() == other._settings()
        both = zip(self._arrays(), other._arrays(), strict=True)
        return alike and all(np.array_equal(a, b, equal_nan=True) for a, b in both)

    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    def _settings(self) -> tuple[Any, ...]:
        model = self._model
        return (
            model.name,
            model.digest,
            self.t0,
            self.h,
            self.every,
            self._requested_steps,
            self.method,
        )

    def _arrays(self) -> tuple[Array, ...]:
        inputs = np.empty(0) if self._row_inputs is None else self._row_inputs
        return self.q, self.qd, self.steps, self._codes, self._params, inputs

    def __len__(self) -> int:
        return len(self._codes)

    def __repr__(self) -> str:
        return f"<BatchRun of {self._model.name}: {self.message}>"


def initial_failures(run: BatchRun) -> Array:
    """Return the status number of each instance that failed at its initial state, (batch,).

    The number is 0 for all other instances.
    """
    return np.where((run.steps == 0) & (run._codes < STATUS.index("interrupted")), run._codes, 0)


def stepper_for(run: BatchRun, both: Array, inputs: Array | None, first: int = 0) -> BatchStepper:
    """Return a stepper that continues a batch with fixed steps from given states.

    run: the batch. both: states [q, qd] of all instances after `first` steps, (2, batch, nq).
    inputs: inputs of the steps, (batch or 1, steps or 1, nu); None: the scene's signals. The
    stepper does not advance instances that failed at their initial state.
    """
    model: Any = run._model
    stepper = BatchStepper(model, run.method, both, run.t0, run.h, inputs, run._params, None, first)
    stepper.work.leave(initial_failures(run))
    return stepper
