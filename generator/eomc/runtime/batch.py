"""Simulation of many instances of a scene, which `batch = true` adds to a module.

Instances run in the lanes of vector registers and in threads; no result depends on either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Never, cast

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, Start, as_count, as_number, as_step_size, row_times, without_mask
from .batch_integration import (
    MIN_STEPS_FOR_THREADS,
    BatchWork,
    batch_at_once,
    integrate_batch,
)
from .batch_trajectory import BatchTrajectory
from .integration import MIN_CHECKED_NUMBERS
from .model import Model
from .package import Component, warn, with_events
from .requests import (
    Progress,
    Request,
    SimulationArguments,
    StepChoice,
    as_progress,
    count_input_periods,
    cut_to_periods,
    named_initial_state,
)


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
        return super().trajectory_classes | {"BatchTrajectory": BatchTrajectory}


class Batch(Component):
    """Steps and simulations of many instances, which differ in states, parameters or inputs.

    Attributes
    ----------
    has_memory, has_own_parameters : bool
        Whether C keeps data of an instance between calls, and whether instances may differ in
        parameters.
    step_seconds : dict
        Measured seconds per step and instance, by function and log2 of the number of instances (few
        instances do not fill a register). They determine the size of chunks, no result.
    """

    path = "batch"

    def __init__(self, model: BatchModel) -> None:
        self.model, self.info, self.c, self.arguments = model, model.info, model.c, model.arguments
        self.has_memory = self.info.tolerance is not None or bool(self.info.events)
        names = dict(self.c.ffi.typeof("run_options").fields)
        self.has_own_parameters = "p_instance" in names
        self.count_type, self.status_type = map(self.c.ffi.typeof, ("long[]", "int[]"))
        self.outputs_type = self.c.ffi.typeof("run_output[]")
        self.step_seconds: dict[Any, float] = {}

    @cached_property
    def result_type(self) -> np.dtype[Any]:
        """The type of the results of an instance, numbers of the C struct `run_output`."""
        ffi, kinds = self.c.ffi, {"long": "l", "int": "i", "double": "d", "float": "f"}
        members = {
            name: kinds[field.type.cname]
            for name, field in ffi.typeof("run_output").fields
            if field.type.cname in kinds
        }
        layout = {
            "names": list(members), "formats": list(members.values()),
            "offsets": [ffi.offsetof("run_output", name) for name in members],
            "itemsize": ffi.sizeof("run_output"),
        }  # fmt: skip
        result_type: np.dtype[Any] = np.dtype(layout)  # type: ignore[call-overload]
        return result_type

    def simulate_batch(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        params: Any = None, u: ArrayLike | None = None, threads: int | None = None,
        method: str | None = None, *, t0: float = 0.0, control_period: float | None = None,
        progress: Callable[[int, int], None] | None = None, tol: float | None = None,
        times: ArrayLike | None = None, max_step: float | None = None, stiff: bool = False,
        max_evaluations: int | None = None, events: Mapping[str, Any] | None = None,
        **unknown: Never,
    ) -> BatchTrajectory:  # fmt: skip
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
        BatchTrajectory
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
            return cast(BatchTrajectory, other.batch.simulate_batch(**arguments))
        choice, integrator = None, self.model.integrator
        is_plain = max_step is control_period is None and max_evaluations is threads is None
        if is_plain and progress is None:
            key = h, duration, steps, every, method, tol, times is not None
            choice = integrator.plain_steps.find(key)
        is_short = integrator.has_plain_runs and times is None and stiff is False
        if choice is not None and is_short and type(t0) is float:
            run = batch_at_once(self.model, choice, (q0, qd0), t0, u, params)
            if run is not None:
                return run
        options = SimulationArguments(
            q0, qd0, h, duration, steps, every, u, params, method, t0, control_period, None,
            as_progress(progress), tol, times, max_step, stiff, threads, max_evaluations,
        )  # fmt: skip
        if threads is not None:
            as_count(threads, "threads", 1)
        request, codes = self._request(options, choice)
        run = self.integrate(request, codes, threads, options.progress)
        if np.count_nonzero(run.status_codes):
            warn(f"{self.info.name}: {run.failure_summary}")
        return run

    def integrate(
        self, request: Request, codes: Array | None = None, threads: int | None = None,
        progress: Progress = None,
    ) -> BatchTrajectory:  # fmt: skip
        """Make a batch from checked arguments and return it, as `integrate_batch`."""
        return integrate_batch(self.model, request, codes, threads, progress)

    def states_from(
        self, request: Request, state: Array, first: int, codes: Array, rows: Array
    ) -> None:
        """Compute states of a batch at the times of the request, from those after `first` steps.

        state: [q, qd] after these steps, (2, batch, nq), which is overwritten. codes: status number
        of each instance; others than 0 make no step. rows: the states, (2, batch, n, nq).
        """
        work = BatchWork(self.model, request, state, rows, request.times, codes, first=first)
        work.run(None, None)
        work.finish_rows()

    def _request(
        self, options: SimulationArguments, choice: StepChoice | None
    ) -> tuple[Request, Array | None]:
        """Check the arguments of `simulate_batch`; warn of a step size that is too large.

        choice: checked steps from t = 0, if known. Return the request, and the status numbers of
        instances that cannot start, or None. Raises ValueError if an argument is invalid.
        """
        info, integrator = self.info, self.model.integrator
        steps = integrator.checked_steps(options, choice)
        hold = count_input_periods(info, steps, options.control_period)
        if options.u is None and options.control_period is not None and info.nu:
            raise ValueError("control_period: a batch follows the signals: give u, a row a period")
        u = cut_to_periods(info, options, steps, hold, 1)
        q, qd, p, inputs, codes = self.instances(options, u, hold[1] or None, steps.t0)
        inputs = None if inputs is None else inputs.copy()
        request = steps.request(q, qd, (inputs, *hold), p.copy())
        integrator.check_step_size(request, "the first instance: ")
        return request, codes

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
        if method is not None:
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
            table, method = self.arguments.parameter_rows(params), method or self.info.methods[0]
            t0 = as_number(t, "t") if times is None else 0.0
            inputs_and_method = (inputs, 0.0, 0, table, method)
            request = Request(q, qd, t0, 0.0, h, steps, 1, None, *inputs_and_method)
            work = BatchWork(self.model, request, (q, qd), starts=times)
            if not work.run(threads, None):
                raise KeyboardInterrupt
            return np.array(work.results["status"])
        # too few steps for threads and for checks of Ctrl-C: call C directly
        address, real, null = self.c.tools
        status = np.empty(count, "i")
        self.c.lib.step_batch(
            0 if method is None else self.info.methods.index(method), count, address(real, q),
            address(real, qd), null if times is None else address(real, times),
            t if times is None else 0.0, h, steps, 1,
            null if inputs is None else address(real, inputs),
            self.info.nu if inputs is not None and len(inputs) > 1 else 0, 0,
            self.arguments.default_pointers[2] if table is None else address(real, table),
            1 if table is not None and len(table) > 1 else 0, null, 0, null,
            address(self.status_type, status),
        )  # fmt: skip
        return status

    def instances(
        self, options: SimulationArguments, u: Any, steps: int | None, t0: float
    ) -> tuple[Array, Array, Array, Array | None, Array | None]:
        """Check the initial states, parameters and inputs of a batch.

        Return positions and velocities, (batch, nq) each; parameters, (batch or 1, np); inputs,
        (batch or 1, steps or 1, nu), or None for the scene's signals; and status numbers, or None
        if all instances can start. Initial states may be the caller's arrays, and contain numbers
        that are not finite.

        u: inputs, cut to the steps of the run. steps: number of rows of a table of inputs. t0:
        time, s, at which the initial states are assembled on the constraints.
        """
        q0, qd0, params = options.q0, options.qd0, options.params
        start, table = self.info.initial_state, self.arguments.parameter_rows(params)
        q0, qd0 = named_initial_state(self.model, q0, qd0, params, many=True)
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
        return q, qd, table, inputs, codes

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
