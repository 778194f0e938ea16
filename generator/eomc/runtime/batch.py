"""Simulation of many instances of a scene, which `batch = true` adds to a module.

Instances run in the lanes of vector registers and in threads; no result depends on either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import NoneType
from typing import Any, Never, cast

import numpy as np
from numpy.typing import ArrayLike

from . import batch_adaptive, batch_fixed
from .arguments import Array, Start, as_count, as_number, as_step_size, row_times, without_mask
from .batch_trajectory import BatchRun
from .batch_work import MIN_STEPS_FOR_THREADS, BatchSteps, Instances, Work
from .integrator import MIN_CHECKED_NUMBERS
from .model import Model
from .package import Component, warn, with_events
from .requests import MAX_EVERY, SimulationArguments, as_progress, step_count
from .stability import MIN_STEPS
from .starts import initial_state_for_parameters, is_by_name
from .status import Interrupted


class BatchModel(Model):
    """Compiled scene that simulates many instances (independent copies) at once.

    Attributes
    ----------
    batch : Batch
        Steps and runs of many instances. The other attributes are those of `Model`.
    """

    def __init__(self, extension: Any, **scene: Any) -> None:
        super().__init__(extension, **scene)
        self.batch = Batch(self)

    @property
    def trajectory_classes(self) -> dict[str, Any]:
        """The classes of runs and batches by their names."""
        own = (BatchRun, batch_fixed.TimedBatchRun, batch_adaptive.AdaptiveBatchRun)
        return super().trajectory_classes | {x.__name__: x for x in own}


class Batch(Component):
    """Steps and simulations of many instances, which differ in states, parameters or inputs.

    Attributes
    ----------
    count_types : tuple
        C types of arrays of numbers of steps and of status numbers.
    step_functions : dict
        C functions that step many instances, by method; None: the first.
    step_seconds : dict
        Measured seconds per step and instance, by function and log2 of the number of instances (few
        instances do not fill a register). They determine the size of chunks, no result.
    """

    path = "batch"

    def __init__(self, model: BatchModel) -> None:
        self.model, self.info, self.c, self.arguments = model, model.info, model.c, model.arguments
        self.count_types = (self.c.ffi.typeof("long[]"), self.c.ffi.typeof("int[]"))
        function = model.integrator.c_function
        self.step_functions = {x: function(x, "batch_step") for x in (None, *self.info.methods)}
        self.step_seconds: dict[Any, float] = {}

    def simulate_batch(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        params: Any = None, u: ArrayLike | None = None, threads: int | None = None,
        method: str | None = None, *, t0: float = 0.0, control_period: float | None = None,
        progress: Callable[[int, int], None] | None = None, tol: float | None = None,
        times: ArrayLike | None = None, max_step: float | None = None, stiff: bool = False,
        max_evaluations: int | None = None, events: Mapping[str, Any] | None = None,
        **unknown: Never,
    ) -> BatchRun:  # fmt: skip
        """Simulate many instances of the scene and return their trajectories.

        An instance that cannot continue, or whose initial state cannot be moved onto the
        constraints, gets its own status and does not affect the others.

        Parameters
        ----------
        q0, qd0 : (batch, nq) or (nq,) array, or dict by name, optional
            Initial positions and velocities of each instance, or the same of all; by default those
            of the scene.
        h : float, optional
            Size of fixed steps, s; by default that of the scene.
        duration : float, optional
            Simulated time, s; by default that of the scene.
        steps : int, optional
            Number of fixed steps, instead of `duration`.
        every : int
            Number of fixed steps between two rows. The first and the last state also have a row.
        params : dict, Params or (batch, np) array, optional
            Parameters. The values of a dict are numbers, or arrays (batch,).
        u : array or dict, optional
            Inputs: (nu,) or (batch, nu), constant during the run; (batch, steps, nu) or
            (1, steps, nu), one row for each step or for each `control_period`, constant over it; or
            a dict of all inputs by name, whose values are numbers or have the shape (batch,),
            (batch, steps) or (1, steps). By default the scene's signals.
        threads : int, optional
            Number of threads; by default one for each processor.
        method : str, optional
            Name of the method of fixed steps, one of `methods`; "auto": adaptive steps.
        t0 : float
            Time of the initial states, s.
        control_period : float, optional
            Time over which each row of `u` is constant, s.
        progress : callable, optional
            Called repeatedly with (done, total): the steps of all instances, or with adaptive
            steps and with events the numbers of instances.
        tol : float, optional
            Tolerance of adaptive steps, whose sizes differ between instances. By default that of
            the scene, if none of h, steps and method is given.
        times : (n,) array, optional
            Ascending times of the rows, s, within the duration. By default adaptive steps have rows
            at the start and at the end only.
        max_step : float, optional
            Longest adaptive step, s.
        stiff : bool
            Begin adaptive steps with Newton's method.
        max_evaluations : int, optional
            Number of evaluations of the accelerations after which an instance with adaptive steps
            begins no further step. Its status is then "too long".
        events : dict, optional
            Additional events by name, as in `simulate`.

        Returns
        -------
        BatchRun
            Trajectories with q and qd (batch, n, nq), and the status of each instance.

        Raises
        ------
        ValueError
            If an argument is invalid.
        Interrupted
            At Ctrl-C; its attribute `run` is the run up to that moment.
        """
        if events is not None or unknown:
            other, arguments = with_events(self.simulate_batch, dict(locals()))
            return cast(BatchRun, other.batch.simulate_batch(**arguments))
        options = SimulationArguments(
            q0, qd0, h, duration, steps, every, u, params, method, t0, control_period, None,
            as_progress(progress), tol, times, max_step, stiff, threads, max_evaluations,
        )  # fmt: skip
        if options.uses_adaptive_steps(self.info):
            return self._finish(*batch_adaptive.simulate(self.model, options))
        if max_evaluations is not None:
            raise ValueError("max_evaluations: belongs to adaptive steps: give tol=, and no h=")
        if self.info.events and not self.model.integrator.ignores_events:
            return self._finish(*batch_adaptive.simulate_fixed_steps(self.model, options))
        return self._finish(*self._fixed_steps(options))

    def _fixed_steps(self, options: SimulationArguments) -> tuple[BatchRun, bool]:
        """Check the arguments of a batch with fixed steps and simulate.

        Return the batch, and False if Ctrl-C interrupted it.
        """
        method = self.info.method_name(options.method)
        h = self.info.h if options.h is None else as_step_size(options.h, self.info.dtype)
        t0 = as_number(options.t0, "t0")
        times, steps = options.output_times(t0, h)
        steps = step_count(self.info, h, options.duration if times is None else None, steps)
        every = min(as_count(options.every, "every", 1), MAX_EVERY)
        u, hold = options.inputs_and_hold(self.info, t0, h, steps, 1)
        batch_adaptive.no_signals(self.model, u, options.control_period)
        instances = self.instances(options, u, -(-steps // hold), t0)
        inputs = instances.inputs
        if inputs is not None and hold > 1 and inputs.shape[1] > 1:
            inputs = np.ascontiguousarray(np.repeat(inputs, hold, axis=1)[:, :steps])
            instances = instances._replace(inputs=inputs)
        if steps >= MIN_STEPS and (method, h) not in self.model.integrator.warned:
            state = instances.first_state(t0)
            self.model.integrator.check_step_size(state, h, method, "the first instance: ")
        plan = BatchSteps(method, h, t0, steps, every)
        request = batch_fixed.BatchRequest(plan, times, options.threads, options.progress)
        return batch_fixed.simulate(self.model, instances, request)

    def _finish(self, run: BatchRun, whole: bool) -> BatchRun:
        """Return the run, with a warning if instances failed. Raises Interrupted unless `whole`."""
        if not whole:
            raise Interrupted(run)
        if words := run.failure_summary:
            warn(f"{self.info.name}: {words}")
        return run

    def step_batch(
        self, q: Array, qd: Array, h: float | None = None, t: ArrayLike = 0.0,
        u: ArrayLike | None = None, params: Any = None,
        out: tuple[Array, Array] | None = None, threads: int | None = None,
        method: str | None = None, *, steps: int = 1,
    ) -> Array:  # fmt: skip
        """Advance many instances by one or more steps of size h, in place.

        Parameters
        ----------
        q, qd : (batch, nq) arrays
            States of the instances, which are overwritten unless `out` is given.
        h : float, optional
            Step size, s; by default that of the scene.
        t : float or (batch,) array
            Time before the first step, s, of all instances or of each.
        u : (nu,) or (batch, nu) array, or dict, optional
            Inputs, constant over all steps; by default the scene's signals.
        params : optional
            As in `simulate_batch`.
        out : pair of (batch, nq) arrays, optional
            Arrays into which the new states are written instead.
        threads : int, optional
            Number of threads; by default one for each processor.
        method : str, optional
            Name of the method, one of `methods`; by default the first of the scene.
        steps : int
            Number of steps.

        Returns
        -------
        (batch,) array of integers
            Status of each instance: 0 if all steps succeeded, else an index into the module's tuple
            `STATUS`, whose text is the reason of the failure; the state is then that before the
            failed step.

        Raises
        ------
        ValueError
            If an argument is invalid, or q and qd are not writeable, C-contiguous arrays of the
            module's number type.
        KeyboardInterrupt
            At Ctrl-C.
        """
        if not isinstance(method, (str, NoneType)) or method not in self.step_functions:
            self.info.method_name(method)  # raises, with those there are
        if out is not None:
            into = self.arguments.output_pair(out, np.shape(q))
            into[0][...], into[1][...] = without_mask(q, "q"), without_mask(qd, "qd")
            q, qd = into
        self.arguments.check_writable(q, "q")
        self.arguments.check_writable(qd, "qd")
        count = len(q)
        if count != len(qd):
            raise ValueError(f"qd: {len(qd)} instances where q has {count}")
        views = q.base is not None or qd.base is not None
        if count and (q is qd or (views and np.may_share_memory(q, qd))):
            raise ValueError("qd: lies in the memory of q, where q is to be written")
        h, steps = (
            self.info.h if h is None else as_step_size(h, self.info.dtype),
            as_count(steps, "steps", 0),
        )
        times = row_times(self.arguments, t, (count,))
        if times is None:
            t = as_number(t, "t")
        inputs = None if u is None else self.input_rows(u, 1)
        table = None if params is None else self.arguments.parameter_rows(params)
        for name, rows in (("params", table), ("u", inputs)):
            if rows is not None and len(rows) not in (1, count):
                raise ValueError(f"{name}: {len(rows)} instances where q has {count}")
        if threads is not None:
            as_count(threads, "threads", 1)
        if (
            count * steps >= MIN_STEPS_FOR_THREADS
            or count * steps * self.info.nq > 8 * MIN_STEPS_FOR_THREADS
        ):
            table = self.arguments.parameter_rows(params)
            plan = BatchSteps(method, h, t if times is None else times, steps)
            work = Work(self.model, plan, (q, qd), Instances(None, table, inputs))
            if not work.run(threads, None):
                raise KeyboardInterrupt
            return work.status
        # too few steps for threads and for checks of Ctrl-C: call C directly
        address, real, null = self.c.tools
        status = np.empty(count, "i")
        self.step_functions[method](
            count, address(real, q), address(real, qd),
            [t] if times is None else address(real, times), int(times is not None), h, steps,
            null if inputs is None else address(real, inputs),
            self.info.nu if inputs is not None and len(inputs) > 1 else 0,
            self.arguments.default_pointers[2] if table is None else address(real, table),
            1 if table is not None and len(table) > 1 else 0, address(self.count_types[1], status),
        )  # fmt: skip
        return status

    def instances(
        self, options: SimulationArguments, u: Any, steps: int | None, t0: float
    ) -> Instances:
        """Check the initial states, parameters and inputs of a batch.

        u: inputs, cut to the steps of the run. steps: number of rows of a table of inputs. t0:
        time, s, at which the initial states are assembled on the constraints.
        """
        q0, qd0, params = options.q0, options.qd0, options.params
        start, table = self.info.initial_state, self.arguments.parameter_rows(params)
        if (params is not None and self.info.start_formulas) or is_by_name(q0, qd0):
            q0, qd0 = initial_state_for_parameters(self.model, q0, qd0, table, many_values=True)
        q = self._state_rows(start[0] if q0 is None else self.info.with_discrete(q0, 0), "q0")
        qd = self._state_rows(start[1] if qd0 is None else self.info.with_discrete(qd0, 1), "qd0")
        inputs = self.input_rows(u, steps)
        sizes = {
            "q0": 1 if q.ndim == 1 else len(q),
            "qd0": 1 if qd.ndim == 1 else len(qd),
            "params": len(table),
            "u": 1 if inputs is None else len(inputs),
        }
        if empty := [name for name, size in sizes.items() if not size]:
            raise ValueError(f"{empty[0]}: no instances")
        whose, count = next((x for x in sizes.items() if x[1] > 1), ("q0", 1))
        for name, size in sizes.items():
            if size not in (1, count):
                hint = ": a table over time for all is (1, steps, nu)" if name == "u" else ""
                raise ValueError(f"{name}: {size} instances where {whose} has {count}{hint}")

        if whose == "u" and inputs is not None and np.ndim(u) == 2 and len(inputs) == steps:
            one, each = f"(1, {steps}, {self.info.nu})", f"({steps}, 1, {self.info.nu})"
            raise ValueError(
                f"u: shape {np.shape(u)} may be a table over time or one row an instance: give "
                f"{one} for a table, {each} for as many instances"
            )

        whole = (count, self.info.nq)  # broadcast_to is slow even without effect
        q, qd = (x if x.shape == whole else np.broadcast_to(x, whole) for x in (q, qd))
        q, qd, codes = self.model.constraints.assemble_rows(q, qd, table, t0)
        return Instances((q, qd), table, inputs, codes)

    def _state_rows(self, values: ArrayLike, name: str) -> Array:
        """Return states (nq,) or (n, nq); an array (n, nq) is returned without further checks."""
        if isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == self.info.nq:
            without_mask(values, name)
            if values.dtype in (self.info.dtype, np.float64) and values.flags.aligned:
                return values
        return self.arguments.array(values, name, self.info.nq)

    def input_rows(self, u: Any, steps: int | None) -> Array | None:
        """Return inputs (batch or 1, steps or 1, nu); steps None: constant during the run."""
        if u is None:
            return None
        if not self.info.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            raise ValueError(
                "u: a Python function can't be called for many at once: give a table, or step all "
                "instances by step_batch in a loop that computes u from their states"
            )
        if type(u) is not np.ndarray and isinstance(u, Mapping):
            u = self.arguments.inputs_by_name(u)
        if type(u) is np.ndarray and u.dtype is self.info.dtype and u.flags.carray:
            array = u
        else:
            array = self.arguments.numbers(u, "u")
        if array.ndim < 3:
            array = array[:, None] if array.ndim == 2 else array.reshape(1, 1, -1)
        if array.ndim != 3 or array.shape[2] != self.info.nu or array.shape[1] not in (1, steps):
            shapes, wide = (
                f"({self.info.nu},), (batch, {self.info.nu})",
                f"(batch, {steps}, {self.info.nu})",
            )
            table = ": rows, each constant over a control period, take control_period=, in s"
            rows = ", a row for each step or control period of duration="
            over = f" or {wide}{rows}" if steps else table
            raise ValueError(f"u: shape {np.shape(u)}, expected {shapes}{over}")
        at = self.c.pointer(array)
        for k in range(0, array.size, MIN_CHECKED_NUMBERS):
            if not self.c.lib.all_finite(min(MIN_CHECKED_NUMBERS, array.size - k), at + k):
                raise ValueError("u: not all numbers are finite")
        return array
