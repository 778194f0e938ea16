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
from .adaptive_arguments import as_progress, uses_adaptive_steps
from .arguments import (
    Array,
    Start,
    as_count,
    as_number,
    as_step_size,
    row_times,
    without_mask,
)
from .batch_instances import Instances
from .batch_run import BatchRun
from .batch_work import MIN_STEPS_FOR_THREADS, Work
from .metadata import SOME
from .model import RARELY
from .output_times import as_times_and_steps
from .package import warn
from .plugins import with_events
from .status import Interrupted


class BatchModel(Instances):
    """Compiled scene that simulates many instances (independent copies) at once.

    The instances differ in their initial states, parameters or inputs.
    """

    @property
    def _kinds(self) -> dict[str, Any]:
        own = (BatchRun, batch_fixed.TimedBatchRun, batch_adaptive.AdaptiveBatchRun)
        return super()._kinds | {x.__name__: x for x in own}

    def simulate_batch(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        params: Any = None, u: ArrayLike | None = None, threads: int | None = None,
        method: str | None = None, *, t0: float = 0.0, control_period: float | None = None,
        progress: Callable[[int, int], None] | None = None, tol: float | None = None,
        times: ArrayLike | None = None, h_most: float | None = None, stiff: bool = False,
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
        h_most : float, optional
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
            other, given = with_events(self.simulate_batch, dict(locals()))
            return cast(BatchRun, other.simulate_batch(**given))
        progress = as_progress(progress)
        if uses_adaptive_steps(self, h, steps, method, tol, h_most, stiff):
            fitted, whole = batch_adaptive.simulate(
                self, q0, qd0, duration, params, u, threads, t0, progress, tol, times, h_most,
                stiff, control_period, (h, steps, method, every, None), max_evaluations,
            )  # fmt: skip
            return self._finish(fitted, whole)
        if max_evaluations is not None:
            raise ValueError("max_evaluations: belongs to adaptive steps: give tol=, and no h=")
        if self.events and not self._passes_over:
            seen, whole = batch_adaptive.stepped(
                self, q0, qd0, h, duration, steps, every, params, u, threads, method, t0, progress,
                times, control_period,
            )  # fmt: skip
            return self._finish(seen, whole)
        step = self._stepper(method, "batch")
        h, t0 = self.h if h is None else as_step_size(h, self.dtype), as_number(t0, "t0")
        at = None
        if times is not None:
            at, steps = as_times_and_steps(self, times, t0, h, duration, steps, every, None)
        steps = self._steps(h, duration if at is None else None, steps)
        every = min(as_count(every, "every", 1), RARELY)
        u, hold = self._steps_and_table(t0, h, steps, u, control_period, duration, at, 1)
        batch_adaptive.no_signals(self, u, control_period)
        starts, table, inputs, codes = self._instances(q0, qd0, params, u, -(-steps // hold), t0)
        if inputs is not None and hold > 1 and inputs.shape[1] > 1:
            inputs = np.ascontiguousarray(np.repeat(inputs, hold, axis=1)[:, :steps])
        method = self._method(method)
        if steps >= SOME and (method, h) not in self._warned:
            first, u0 = (starts[0][0], starts[1][0]), None if inputs is None else inputs[0, 0]
            self._look(*first, h, t0, u0, table[0], method, "the first instance: ")
        request = batch_fixed.FixedStepRequest(
            step, h, t0, steps, every, at, method, threads, progress, codes
        )
        run, whole = batch_fixed.simulate(self, starts, inputs, table, request)
        return self._finish(run, whole)

    def _finish(self, run: BatchRun, whole: bool) -> BatchRun:
        """Return the run, with a warning if instances failed. Raises Interrupted unless `whole`."""
        if not whole:
            raise Interrupted(run)
        if words := run._no_convergence_message:
            warn(f"{self.name}: {words}")
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
        if not isinstance(method, (str, NoneType)) or method not in self._batch_steps:
            self._method(method)  # raises, with those there are
        if out is not None:
            into = self._pair(out, np.shape(q))
            into[0][...], into[1][...] = without_mask(q, "q"), without_mask(qd, "qd")
            q, qd = into
        self._movable(q, "q")
        self._movable(qd, "qd")
        count = len(q)
        if count != len(qd):
            raise ValueError(f"qd: {len(qd)} instances where q has {count}")
        views = q.base is not None or qd.base is not None
        if count and (q is qd or (views and np.may_share_memory(q, qd))):
            raise ValueError("qd: lies in the memory of q, where q is to be written")
        h, steps = self.h if h is None else as_step_size(h, self.dtype), as_count(steps, "steps", 0)
        times = row_times(self, t, (count,))
        if times is None:
            t = as_number(t, "t")
        inputs = None if u is None else self._input_rows(u, 1)
        table = None if params is None else self._parameter_rows(params)
        for name, rows in (("params", table), ("u", inputs)):
            if rows is not None and len(rows) not in (1, count):
                raise ValueError(f"{name}: {len(rows)} instances where q has {count}")
        if threads is not None:
            as_count(threads, "threads", 1)
        if (
            count * steps >= MIN_STEPS_FOR_THREADS
            or count * steps * self.nq > 8 * MIN_STEPS_FOR_THREADS
        ):
            table, step = self._parameter_rows(params), self._stepper(method, "batch")
            begin = t if times is None else times
            work = Work(self, step, q, qd, h, begin, steps, 0, inputs, table, None, None)
            if not work.run(threads, None):
                raise KeyboardInterrupt
            return work.status
        # too few steps for threads and for checks of Ctrl-C: call C directly
        address, real, null = self._c
        status = np.empty(count, "i")
        self._batch_steps[method](
            count, address(real, q), address(real, qd),
            [t] if times is None else address(real, times), int(times is not None), h, steps,
            null if inputs is None else address(real, inputs),
            self.nu if inputs is not None and len(inputs) > 1 else 0,
            self._at[2] if table is None else address(real, table),
            1 if table is not None and len(table) > 1 else 0, address(self._whole[1], status),
        )  # fmt: skip
        return status
