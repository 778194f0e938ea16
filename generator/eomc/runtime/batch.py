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
    """A model whose extension steps many instances at once."""

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
        """Simulate many instances; for other arguments see `simulate`.

        q0, qd0: (batch, nq), or (nq,) for all instances. params: a dict of numbers or (batch,)
        arrays, Params, or an array (batch, np). u: None, the scene's signals; (nu,) or
        (batch, nu), constant; (batch, steps, nu) or (1, steps, nu), a row held over each step, or
        over each control_period; a dict of all inputs by name, numbers, (batch,), (batch, steps)
        or (1, steps).
        threads: number of threads; by default one for each processor. An instance that cannot
        continue, or whose start cannot be assembled, has its own status and does not affect the
        others. Ctrl-C raises Interrupted with the run so far. tol: tolerance of adaptive steps,
        which differ between instances. times: (n,), times of the rows, within duration; by default
        adaptive steps have rows at the start and the end. max_evaluations: the number of
        evaluations of accelerations after which an instance with adaptive steps begins no further
        step; its status is then "too long". events: as in `simulate`.
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
        """Make steps of many instances, in place.

        Parameters
        ----------
        q, qd : (batch, nq) arrays
            The states, which are overwritten unless `out` is given.
        h : float, optional
            The step size, s; by default that of the scene.
        t : float or (batch,) array
            The time at the start, s, of all instances or of each.
        u : (nu,) or (batch, nu) array, or dict, optional
            Inputs, held over all steps; by default the scene's signals.
        params : optional
            As in `simulate_batch`.
        out : pair of (batch, nq) arrays, optional
            Where the new states are written.
        threads : int, optional
            The number of threads; by default one for each processor.
        method : str, optional
            The method; by default the first of the scene.
        steps : int
            The number of steps of size h.

        Returns
        -------
        (batch,) array of integers
            The status of each instance: 0 if all steps were made, else `STATUS[number]` says why
            one could not be made; the state is then that before this step.
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
