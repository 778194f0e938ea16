"""Trajectories of many instances: what `simulate_batch` returns, and their plots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, ByName
from .atomic_write import File
from .batch_work import BatchStepper, BatchSteps, Instances
from .columns import Columns
from .interfaces import CompiledBatchModel
from .package import own_model, reduced, require_eomc
from .status import STATUS, STATUS_MESSAGES
from .trajectory_data import parts, within

_ENDS = np.array(STATUS)
# keys of saved fields, in order
_FIELDS = "t0 q qd h steps codes every wanted params held method _u".split()
_SINGLE_RUN_ATTRIBUTES = {
    "balance": "balance()", "estimate": "estimate()", "error": "estimate()",
    "section": "section(...)",
}  # fmt: skip
_SINGLE_RUN_ARGUMENTS = {"phase", "section", "other", "labels"}
_ROWS_PER_CALL = 2**16  # rows of all instances in a call, which fit in the cache


@dataclass(eq=False, repr=False)
class BatchRun(Columns):
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
    model: CompiledBatchModel
    t0: float
    q: Array
    qd: Array
    h: float
    steps: Array
    status_codes: Array
    every: int
    _requested_steps: int
    parameter_values: Array  # (batch or 1, np)
    row_inputs: Array | None  # at the rows, (batch or 1, n or 1, nu)
    method: str
    input_source: Array | None = (
        None  # (batch or 1, steps or 1, nu), if _row_inputs has only a part of it
    )

    @cached_property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s, which are the same for all instances."""
        steps = np.minimum(np.arange(self.q.shape[1]) * self.every, self._requested_steps)
        return np.asarray(self.t0 + self.h * steps)

    @cached_property
    def status(self) -> Array:
        """Return the status of each instance as text, (batch,), such as "ok" or "singular"."""
        return np.asarray(_ENDS[self.status_codes])

    @property
    def u(self) -> Array:
        """Return the inputs applied at each row, (batch, n, nu), limited to their allowed ranges.

        At each row they are the values of the scene's signals, or the constant inputs of the step
        that begins there. The last row has the inputs of the last step.
        """
        return self._within(self.requested_inputs)

    @property
    def saturated(self) -> Array:
        """Return whether each input exceeds its limits at each row, as a bool array (batch, n, nu).

        The inputs are compared before they are limited. Values are False at rows that are nan.
        """
        inputs = self.requested_inputs
        return np.asarray(np.abs(inputs - self._within(inputs)) > 0)

    def _within(self, u: Array) -> Array:
        """Saturate inputs (batch, n, nu) at the limits of their instances."""
        return self.model.functions.saturate(u, self.parameter_values)

    @property
    def requested_inputs(self) -> Array:
        """Inputs at each row before saturation, (batch, n, nu)."""
        if self.row_inputs is None:
            return self.evaluate(self.model.functions.signal, (self.model.info.nu,))
        inputs = np.broadcast_to(self.row_inputs, (*self.q.shape[:2], self.model.info.nu)).copy()
        inputs[np.isnan(self.q[..., 0])] = np.nan
        return inputs

    @property
    def energy(self) -> Array:
        """Return the energy K + P (kinetic and potential) at each row, (batch, n), J.

        In a rotating frame, `jacobi` is conserved instead of the energy.
        """
        return self.evaluate(self.model.functions.energy, ())

    @property
    def jacobi(self) -> Array:
        """Return the Jacobi integral qd.dK/dqd - K + P at each row, (batch, n), J.

        It equals the energy if the kinetic energy K is purely quadratic in qd.
        """
        return self.evaluate(self.model.functions.jacobi, ())

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """Return the outputs of the scene as a dict from name to array (batch, n).

        Values are nan at rows that are nan. Outputs that depend on accelerations are also nan at
        states with a singular mass matrix D.
        """
        names = self.model.info.outputs
        if not names:
            return {}
        values = self._evaluate_with_inputs(self.model.functions.output, (len(names),))
        return dict(zip(names, np.ascontiguousarray(np.moveaxis(values, 2, 0)), strict=True))

    @property
    def constraints(self) -> Mapping[str, Array]:
        """Return the residual of each constraint equation as a dict from name to array (batch, n).

        A residual is 0 if the equation is satisfied; its unit is that of the equation. Raises
        KeyError for unknown names.
        """
        model, names = self.model, self.model.info.constraints.names
        return _by_name(
            "constraints", names,
            lambda: self.evaluate(model.constraints.constraints, (len(names),)),
        )  # fmt: skip

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """Return the Lagrange multiplier of each constraint as a dict from name to (batch, n).

        Raises KeyError for unknown names.
        """
        model, names = self.model, self.model.info.constraints.names
        return _by_name(
            "multipliers", names,
            lambda: self._evaluate_with_inputs(model.constraints.multipliers_or_nan, (len(names),)),
        )  # fmt: skip

    @property
    def reactions(self) -> Mapping[str, Array]:
        """Return the reaction of each loop's joint on its second body, by the loop's name.

        A loop is a [[loop]] of the scene: a joint that closes a kinematic chain. Its reaction is
        the force, N, and the moment about the joint's point, N m, along the axes of the world, as
        an array (batch, n, 6). In plane scenes the array is (batch, n, 3), with two components of
        the force and the moment.
        """
        model, loops = self.model, self.model.info.constraints.loops
        shape = (len(loops), 3 if model.info.plane else 6)
        return _by_name(
            "reactions",
            loops,
            lambda: self._evaluate_with_inputs(model.constraints.reactions_or_nan, shape),
        )

    def _evaluate_with_inputs(self, function: Callable[..., Any], shape: tuple[int, ...]) -> Array:
        """Evaluate a function of the state and the inputs at all rows."""
        return self.evaluate(
            function, shape, None if self.row_inputs is None else {"u": self.row_inputs}
        )

    def evaluate(
        self, function: Callable[..., Any], shape: tuple[int, ...],
        inputs: Mapping[str, Array] | None = None,
    ) -> Array:  # fmt: skip
        """Evaluate a function at all rows, (batch, n, ...), nan at rows that are nan."""
        count, n = self.q.shape[:2]
        results = np.full((count, n, *shape), np.nan, self.model.info.dtype)
        t, each = np.broadcast_to(self.t, (count, n)), {"params": self.parameter_values[:, None]}
        each |= inputs or {}
        alike = {name: x.size == x.shape[-1] for name, x in each.items()}
        for first in range(0, count, many := max(1, _ROWS_PER_CALL // max(n, 1))):
            at = slice(first, first + many)
            q, qd = self.q[at], self.qd[at]
            finite = np.isfinite(q).all(axis=-1) & np.isfinite(qd).all(axis=-1)
            here: Any = ... if finite.all() else finite
            arguments = {
                name: x[0, 0]
                if alike[name]
                else _rows(np.broadcast_to(x, (count, n, x.shape[-1]))[at][here])
                for name, x in each.items()
            }
            values = function(_rows(q[here]), _rows(qd[here]), t=t[at][here].ravel(), **arguments)
            results[at][here] = values.reshape(results[at][here].shape)
        return results

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
        unique_times, place = np.unique(times, return_inverse=True)
        q, qd = self._states(unique_times)[:, :, place.ravel()]
        shape = (len(self), *times.shape, self.model.info.nq)
        return q.reshape(shape), qd.reshape(shape)

    def _states(self, times: Array) -> Array:
        """Return states (2, batch, n, nq) at ascending times, from the row before each."""
        inputs, every = (
            self.row_inputs if self.input_source is None else self.input_source,
            self.every,
        )
        whole, rest = parts(times, self.t0, self.h, self._requested_steps)
        rows = np.empty((2, len(self), len(times), self.model.info.nq), self.model.info.dtype)
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
        if name in _SINGLE_RUN_ATTRIBUTES and name not in self._named():
            raise AttributeError(f"{name} {single_run_hint(self)}.{_SINGLE_RUN_ATTRIBUTES[name]}")
        return super().__getattr__(name)

    @property
    def events(self) -> Mapping[str, Any]:
        """Return the occurrences of each event as a dict by the event's name.

        The dict is empty for scenes without events.
        """
        return ByName("events", (), ())

    def plot(
        self, *names: str, quantiles: Sequence[float] = (0.05, 0.25, 0.5, 0.75, 0.95),
        lines: int | None = None, over: Any = None, wrap: bool | str | Sequence[str] = False,
        ax: Any = None, axes: Any = None, file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Plot the distribution of the instances over time, as bands between quantiles.

        Parameters
        ----------
        *names : str
            Columns to plot, each in its own panel; by default the coordinates.
        quantiles : sequence of float
            Limits of the bands, from 0 to 1, of the instances that reached each time. If their
            number is odd, the middle one is drawn as a line.
        lines : int, optional
            Draw this number of instances as lines instead of the bands.
        over : str or (batch,) array, optional
            Draw the final value of each instance instead, over "instance" (its index), a parameter
            or these numbers.
        wrap, ax, axes, file, **style
            As in `Run.plot`.

        Returns
        -------
        matplotlib Axes, or an array of Axes if there are several panels

        Raises
        ------
        TypeError
            For arguments that apply to single runs only, such as phase.
        KeyError
            For unknown names.
        ValueError
            If `over` is neither a known name nor has the shape (batch,).
        ModuleNotFoundError
            If matplotlib is not installed.
        """
        for name in _SINGLE_RUN_ARGUMENTS & style.keys():
            raise TypeError(f"plot: {name}= {single_run_hint(self)}.plot({name}=...)")
        from .plot import FanOptions, draw_fan

        options = FanOptions(quantiles, lines, over, wrap, ax, axes, file, style)
        return draw_fan(self, names, options)

    def animate(
        self, file: File | None = None, *, names: Sequence[str] = (),
        instances: int | Sequence[int] = 6, scene: Any = None, title: str | None = None,
    ) -> Any:  # fmt: skip
        """Animate several instances together in different colours.

        Instances that ended earlier keep their last position.

        Parameters
        ----------
        file : path, optional
            File to write: a page .html, or a film .gif or .mp4.
        names : sequence of str
            Columns to draw as curves; by default the coordinates and the energy.
        instances : int or sequence of int
            Number of instances, which are evenly spaced in the batch, or their indices; at most 24.
        scene : path, optional
            Scene file, if the module was not loaded by `eomc.load`.
        title : str, optional
            Title of the page.

        Returns
        -------
        Animation or None
            The page; None for a film.

        Raises
        ------
        KeyError
            For unknown names.
        EomcError
            For unknown instances, or if the animation cannot be drawn or written.
        ImportError
            If eomc is not installed.
        """
        page = require_eomc("report.animation")
        return page.instances(self, file, names=names, chosen=instances, scene=scene, title=title)

    def to_arrays(self) -> dict[str, Any]:
        """Return the data of a saved run by name; None: not saved."""
        return dict(zip(_FIELDS, self.field_values()[1:], strict=True))

    @classmethod
    def from_arrays(cls, model: CompiledBatchModel, arrays: Mapping[str, Any]) -> BatchRun:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        values: Any = map(arrays.get, _FIELDS)
        return cls(model, *values)

    @classmethod
    def _of_pickled(cls, arrays: Mapping[str, Any]) -> BatchRun:
        return cls.from_arrays(own_model(), arrays)

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
    def failure_summary(self) -> str:
        """Number of failed instances and the reason of the first failure; "" if none failed."""
        if not self.status_codes.any():
            return ""
        k = int(self.status_codes.nonzero()[0][0])
        first = f"the first that could not go on, instance {k}, stopped at t = {self._end(k):.9g}"
        return f"{self.message}; {first}: {self._why(k)}"

    def _end(self, k: int) -> float:
        """Return the time that instance k reached, s."""
        return float(self.t0 + self.h * self.steps[k])

    def _why(self, k: int) -> str:
        """Return the reason why instance k failed."""
        return STATUS_MESSAGES[str(_ENDS[self.status_codes[k]])]

    def __reduce__(self) -> tuple[Any, ...]:
        kind = type(self)
        path = f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}._of_pickled"
        return reduced(path, self.to_arrays())

    def field_values(self) -> tuple[Any, ...]:
        """Return the values of the fields that the base class `BatchRun` has, in order."""
        return tuple(getattr(self, each.name) for each in fields(self))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BatchRun):
            return NotImplemented
        alike = self.settings() == other.settings()
        both = zip(self.arrays(), other.arrays(), strict=True)
        return alike and all(np.array_equal(a, b, equal_nan=True) for a, b in both)

    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        model = self.model
        return (
            model.info.name,
            model.info.digest,
            self.t0,
            self.h,
            self.every,
            self._requested_steps,
            self.method,
        )

    def arrays(self) -> tuple[Array, ...]:
        """Return the arrays of the batch that have to agree for two batches to be equal."""
        inputs = np.empty(0) if self.row_inputs is None else self.row_inputs
        return self.q, self.qd, self.steps, self.status_codes, self.parameter_values, inputs

    def __len__(self) -> int:
        return len(self.status_codes)

    def __repr__(self) -> str:
        return f"<BatchRun of {self.model.info.name}: {self.message}>"


def initial_failures(run: BatchRun) -> Array:
    """Return the status number of each instance that failed at its initial state, (batch,).

    The number is 0 for all other instances.
    """
    return np.where(
        (run.steps == 0) & (run.status_codes < STATUS.index("interrupted")), run.status_codes, 0
    )


def stepper_for(run: BatchRun, both: Array, inputs: Array | None, first: int = 0) -> BatchStepper:
    """Return a stepper that continues a batch with fixed steps from given states.

    run: the batch. both: states [q, qd] of all instances after `first` steps, (2, batch, nq).
    inputs: inputs of the steps, (batch or 1, steps or 1, nu); None: the scene's signals. The
    stepper does not advance instances that failed at their initial state.
    """
    instances = Instances(None, run.parameter_values, inputs, initial_failures(run))
    plan = BatchSteps(run.method, run.h, run.t0, first)
    return BatchStepper(run.model, plan, both, instances)


def single_run_hint(runs: Any) -> str:
    """Return a hint for error messages: the call that repeats one instance as a single run.

    runs: the batch that contains the instance.
    """
    name = runs.model.info.name
    return f"is of one run: {name}.simulate(runs.q[k, 0], runs.qd[k, 0], params=...)"


def _rows(x: Array) -> Array:
    """Reshape (..., m) to rows (n, m)."""
    return x.reshape(-1, x.shape[-1]) if x.shape[-1] else x.reshape(int(np.prod(x.shape[:-1])), 0)


def _by_name(what: str, names: Sequence[str], rows: Callable[[], Array]) -> ByName:
    """Return the values of `rows`, (batch, n, names, ...), by name."""
    return ByName(what, names, np.ascontiguousarray(np.moveaxis(rows(), 2, 0)) if names else ())
