"""The Python interface of a compiled scene: arrays in, arrays out; the loops are in C.

The modules of this folder are copied into each built package, which therefore needs only NumPy and
cffi. Angles are in rad, all other quantities in SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from time import perf_counter
from typing import Any, Never, cast

import numpy as np
from numpy import empty
from numpy.typing import ArrayLike

from . import adaptive, fixed_step_events, output_times, saved
from .adaptive_arguments import as_progress, uses_adaptive_steps
from .arguments import (
    Array,
    Parameters,
    Start,
    as_count,
    as_flag,
    as_number,
    as_period,
    as_step_size,
    machine_memory,
)
from .atomic_write import File
from .discretize import discretize
from .laws import FeedbackLaw, SampledSignal, warn_called_each_step
from .metadata import CHUNK, SOME
from .package import option, warn
from .plugins import with_events
from .slices import next_chunk
from .stability import advice
from .starts import initial_state_for_parameters, is_by_name
from .status import STATUS, Interrupted
from .stepping import Stepping
from .trajectory import Run

Inputs = ArrayLike | Mapping[str, ArrayLike] | Callable[[float, Array, Array], ArrayLike] | None

LARGE = 2**24  # runs with more positions are checked against the memory
RARELY = 2**48  # steps from row to row, more than any run makes


class Model(Stepping):
    """A compiled scene: its functions, steps and runs.

    Each built package has one `Model` and exports its public methods as functions of the same
    names.
    """

    def load_run(self, file: File) -> Any:
        """Load a run, or a batch of runs, from an .npz file that `run.save` has written.

        Additional events of the run (its argument `events`) are compiled if needed. A warning is
        issued if the run is of another version of the scene.

        Parameters
        ----------
        file : str or path
            The .npz file.

        Returns
        -------
        Run or batch of runs
            Of the class that was saved.

        Raises
        ------
        ValueError
            If the file is not a run of this scene, or is a batch and the module has no batches.
        OSError
            If the file cannot be read.
        """
        model, kind, arrays = saved.read(self, file)
        if (run_class := model._kinds.get(kind)) is None:
            raise ValueError(
                f"{file}: is a run of many at once: build the module with {option('batch')}"
            )
        return run_class._from_arrays(model, arrays)

    @property
    def _kinds(self) -> dict[str, Any]:
        """The classes of runs by their names."""
        kinds = (Run, output_times.TimedRun, adaptive.AdaptiveRun, adaptive.SteppedRun)
        return {x.__name__: x for x in kinds}

    def discretize(
        self, q: ArrayLike, qd: ArrayLike, h: float | None = None, t: float = 0.0, u: Any = None,
        params: Any = None, method: str | None = None, *, control_period: float | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the derivatives Phi and Gamma of one step: dx' = Phi dx + Gamma du.

        x = [q; qd] is the state before the step, x' the state after it, and u are the inputs. The
        derivatives are those of the step itself, not of the exact motion, and are exact to
        rounding.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State before the step, or n states.
        h : float, optional
            Step size, s; by default that of the scene.
        t : float
            Time at the start of the step, s.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs, constant over the step. By default the step follows the scene's signals
            (formulas for the inputs), and Gamma belongs to constant inputs that are added to them.
        params : mapping or array_like, optional
            Parameters that differ from those of the scene; each value may be (n,).
        method : str, optional
            Name in `methods`; by default the first.
        control_period : float, optional
            Period, s, of several steps that are differentiated together. The inputs are constant
            over
            it: `u`, or the scene's signals at its start.

        Returns
        -------
        Phi : (2 nq, 2 nq) array
            dx'/dx. For n states both results have a leading axis n.
        Gamma : (2 nq, nu) array
            dx'/du.

        Raises
        ------
        MotionError
            If a step fails or a derivative is not finite.
        ValueError
            If the module was built without these derivatives.
        """
        at, moving = self._state(q, qd)
        h = self.h if h is None else as_step_size(h, self.dtype)
        hold = None if control_period is None else as_period(control_period, h)
        return discretize(self, self._method(method), at, moving, h, hold, t, u, params)

    def simulate(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        u: Inputs = None, params: Parameters = None, method: str | None = None, *, t0: float = 0.0,
        control_period: float | None = None, out: tuple[Array, Array] | None = None,
        progress: Callable[[int, int], None] | None = None, estimate: bool = False,
        tol: float | None = None, times: ArrayLike | None = None, h_most: float | None = None,
        stiff: bool = False, events: Mapping[str, Any] | None = None, **unknown: Never,
    ) -> Run:  # fmt: skip
        """Simulate the motion by fixed steps of size h or by adaptive steps, and return the run.

        Steps are adaptive if `tol`, `h_most`, `stiff` or method="auto" is given, or if the scene
        has a tolerance and none of `h`, `steps` and `method` is given. A run that cannot go on ends
        with its last valid state, and a warning is issued.

        Parameters
        ----------
        q0, qd0 : (nq,) array_like or mapping by coordinate, optional
            Initial positions and velocities; missing values are those of the scene.
        h : float, optional
            Size of fixed steps, s; by default that of the scene.
        duration : float, optional
            Simulated time, s; by default that of the scene.
        steps : int, optional
            Number of fixed steps, instead of `duration`.
        every : int
            Store a row after each `every` steps, besides the start and the end.
        u : optional
            Inputs: None for the scene's signals; (nu,) for constant ones; (steps, nu), a row for
            each step or control period; a mapping of all inputs by name to numbers or arrays
            (steps,); or a function u(t, q, qd) that returns them and is called before each step.
        params : mapping or (np,) array_like, optional
            Parameters that differ from those of the scene.
        method : str, optional
            Name in `methods` (by default the first), or "auto" for adaptive steps.
        t0 : float
            Initial time, s.
        control_period : float, optional
            Time, s, over which inputs are constant: the function is called, a row of `u` is taken,
            or the signals are read once in it. For fixed steps it is a whole number of steps.
        out : (q, qd), optional
            Arrays (rows, nq) for the rows of a run by fixed steps.
        progress : callable, optional
            Function that is called with (completed steps, all steps).
        estimate : bool
            Estimate the error, too, as `run.error`.
        tol : float, optional
            Tolerance of adaptive steps: error of a step relative to the distance that it moves.
        times : (n,) array_like, optional
            Ascending output times from t0 on, s, of the rows; within `duration` if that is given.
        h_most : float, optional
            Largest adaptive step, s.
        stiff : bool
            Begin adaptive steps with Newton's method, for stiff motion.
        events : mapping, optional
            Additional events by name, each a formula or a table such as [[event]] of a scene.

        Returns
        -------
        Run
            The trajectory; `run.status` is "ok" if it reached its end.

        Raises
        ------
        ValueError
            If an argument is invalid or two of them exclude each other.
        TypeError
            If an argument is unknown.
        MemoryError
            If the rows do not fit in memory.
        Interrupted
            On Ctrl-C; its attribute `run` is the run up to there.
        """
        if events is not None or unknown:
            other, arguments = with_events(self.simulate, dict(locals()))
            return cast(Run, other.simulate(**arguments))
        if (params is not None and self._follows) or is_by_name(q0, qd0):
            q0, qd0 = initial_state_for_parameters(self, q0, qd0, self._parameters(params))
        usual = (out is None and progress is None and control_period is None and not estimate
                 and times is None and type(t0) is float and isfinite(t0))  # fmt: skip
        if (
            usual and (room := self._room) and h is None and steps is None and method is None
            and h_most is None and every == 1 and stiff is False
            and (
                r := adaptive.simulate_short_run(self, q0, qd0, duration, u, params, t0, tol, room)
            ) is not None
        ):  # fmt: skip
            return r
        estimate, progress = as_flag(estimate, "estimate"), as_progress(progress)
        q0, qd0 = self._assembled(q0, qd0, t0, params)
        by_tol = uses_adaptive_steps(self, h, steps, method, tol, h_most, stiff)
        if by_tol or (self.events and not self._passes_over):
            common = q0, qd0, duration, u, params, t0, progress, times, control_period
            fixed = h, steps, method, every, out
            if not by_tol:
                return self._finished(
                    fixed_step_events.simulate(self, *common, fixed, self._look), estimate
                )
            run = adaptive.simulate(self, *common, tol, h_most, stiff, fixed)
            return self._finished(run, estimate)
        method = self.methods[0] if method is None else self._method(method)
        (q, qd), (from_q, from_qd, at_p), p = self._start, self._at, self._p0
        if q0 is not None:
            q, from_q = self._checked_half(q0, "q0")
        if qd0 is not None:
            qd, from_qd = self._checked_half(qd0, "qd0")
        h = self.h if h is None else as_step_size(h, self.dtype)
        if params is not None:
            p = self._parameters(params).copy()
            at_p = self._pointer(p)
        usual = usual and abs(t0) <= 1e6 * h  # other calls take the general path
        if usual and u is duration is None and type(steps) is type(every) is int and every > 0:
            _, run, short, stages, _, _ = self._loops[method]
            if 0 <= steps <= short >= every and (steps < SOME or (method, h) in self._warned):
                address, real, null = self._c
                rows = empty((2, 1 - -steps // every, self.nq), self.dtype)
                to, done = address(real, rows), stages * steps
                if 8 * steps == run(
                    to, null, from_q, from_qd, t0, h, steps, null, 0, every, at_p, null
                ):
                    return Run(self, t0, rows, h, steps, "ok", p, every, None, method, done)
        t0 = as_number(t0, "t0")
        at, steps = output_times.as_times_and_steps(self, times, t0, h, duration, steps, every, out)
        steps = self._steps(h, duration if at is None else None, steps)
        every = min(as_count(every, "every", 1), RARELY)
        u, hold = self._steps_and_table(t0, h, steps, u, control_period, duration, at)
        if u is None and control_period is not None and self.nu:
            u = SampledSignal(self, params)
        if steps >= SOME and (method, h) not in self._warned:
            self._look(q, qd, h, t0, self._first(u, steps, hold), p, method)
        result = self._trajectory(
            q, qd, from_q, from_qd, h, steps, every, u, p, at_p, method, t0, out, progress, hold, at
        )  # fmt: skip
        return self._finished(result, estimate)

    def _finished(self, run: Run, estimate: bool) -> Run:
        """Issue the warnings of a run and estimate its error on request; return the run."""
        if run.status == "interrupted":
            raise Interrupted(run)
        if words := run.message if run.status != "ok" else run._remark:
            warn(f"{self.name}: {words}")
        if estimate:
            try:
                run.estimate()
            except ValueError as fault:  # of what can't be done again; the run is there
                warn(f"{self.name}: {fault}")
        return run

    def _look(
        self, q: Array, qd: Array, h: float, t: float, u: Array | None, p: Array, method: str,
        whose: str = "",
    ) -> None:  # fmt: skip
        """Warn, once a method and step size, of h beyond the stability limit."""
        self._warned.add((method, h))
        if words := advice(self, q, qd, h, t, u, p, method):
            warn(f"{self.name}: {whose}{words}")

    def advice(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        u: ArrayLike | None = None, params: Parameters = None, method: str | None = None, *,
        t0: float = 0.0,
    ) -> str | None:  # fmt: skip
        """Return advice if the step size h is too large for a stable run from the initial state.

        The stability limit is that of the method for the motion linearised at the initial state.

        Parameters
        ----------
        q0, qd0 : (nq,) array_like or mapping by coordinate, optional
            Initial positions and velocities; missing values are those of the scene.
        h : float, optional
            Step size, s; by default that of the scene.
        u : (nu,) array_like, optional
            Inputs; by default the signals of the scene.
        params : mapping or (np,) array_like, optional
            Parameters that differ from those of the scene.
        method : str, optional
            Name in `methods`; by default the first.
        t0 : float
            Initial time, s.

        Returns
        -------
        str or None
            A message; None if h is within the limit, or if no limit can be computed.
        """
        p, method = self._parameters(params), self._method(method)
        q, qd = self._state(*initial_state_for_parameters(self, q0, qd0, p))
        h = self.h if h is None else as_step_size(h, self.dtype)
        return advice(self, q, qd, h, as_number(t0, "t0"), u, p, method)

    def _trajectory(
        self, q: Array, qd: Array, from_q: Any, from_qd: Any, h: float, steps: int, every: int,
        u: Any, p: Array, at_p: Any, method: str, t0: float, out: tuple[Array, Array] | None,
        progress: Callable[[int, int], None] | None, hold: int = 1, at: Array | None = None,
    ) -> Run:  # fmt: skip
        """Run from checked arguments and return the run, whatever its status.

        from_q, from_qd, at_p: addresses for C. at: output times, in place of `every`.
        """
        _, run, _, stages, work_type, counted = self._loops[method]
        nq, (address, real, null) = self.nq, self._c
        law, inputs, stride = (None, None, 0) if u is None else self._table(u, steps, every, hold)
        if at is not None:
            acts = law, inputs, stride, hold
            return output_times.run(self, q, qd, t0, h, steps, at, acts, p, method, progress)
        rows = 1 - -steps // every
        both: Any = out
        try:
            if out is not None:
                both = self._pair(out, (rows, nq))
            elif rows * nq > LARGE and self._bytes(rows) > machine_memory():
                raise MemoryError
            else:
                both = empty((2, rows, nq), self.dtype)
        except MemoryError:
            raise MemoryError(
                f"{rows} rows of {2 * nq} numbers don't fit in memory: keep fewer with every="
            ) from None
        q_rows, qd_rows = both[0], both[1]
        to_q, to_qd = address(real, q_rows), address(real, qd_rows)
        at_u = null if inputs is None else address(real, inputs)
        # a step of an implicit method may solve for all its stages
        done, chunk = 0, hold if law else CHUNK // (nq**3 if counted else nq) or 1
        # workspace from call to call, with counters; a single call may do without
        single = steps <= chunk and counted is None and not self._rows.names
        work = null if single else self._ffi.new(work_type)
        try:
            while True:
                if law and done < steps:
                    if done:  # else the start is not among the rows yet
                        row = -(-done // every)
                        q, qd = q_rows[row], qd_rows[row]
                    inputs = law(t0 + done * h, q, qd)
                    at_u = address(real, inputs)
                count = steps - done
                if count > chunk:
                    count, start_time = chunk, perf_counter()
                code = run(
                    to_q, to_qd, from_q, from_qd, t0, h, count, at_u, stride, every, at_p, work
                )
                done, status = code >> 3, STATUS[code & 7]
                if status != "ok":
                    break
                if progress is not None and done:
                    progress(done, steps)
                if done == steps:
                    break
                if not law:
                    chunk = next_chunk(count, perf_counter() - start_time)
        except KeyboardInterrupt:
            done, status = work.completed if work else done, "interrupted"
            if not done:
                q_rows[0], qd_rows[0] = q, qd
        if done < steps:
            count = 1 - -done // every
            both = q_rows[:count], qd_rows[:count]
        evaluations = counted(work) if counted else stages * done
        stored = law.law if law else None if inputs is None else inputs.copy()
        result = Run(self, t0, both, h, done, status, p, every, stored, method, evaluations)
        self._record_singular_steps(result, method, work)
        if law:
            result._hold = hold
            result._applied = law.rows(len(result), self.nu)
        return result

    def _first(self, u: Any, steps: int, hold: int) -> Array | None:
        """Return the inputs of the first step; None for a signal or a function."""
        inputs = self._table(u, steps, 1, hold)[1]
        return inputs[0] if inputs is not None and inputs.ndim == 2 else inputs

    def _table(
        self, u: Any, steps: int, every: int, hold: int
    ) -> tuple[FeedbackLaw | None, Array | None, int]:
        """Return (feedback law, constant inputs or rows, stride from step to step)."""
        if u is None:
            return None, None, 0
        if not self.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            if hold == 1:
                warn_called_each_step(self)
            return FeedbackLaw(u, self._inputs, every, hold), None, 0
        if isinstance(u, Mapping):
            u = self._by_name(u)
        array = self._numbers(u, "u")
        if self.nu == 1 and array.ndim < 2 and array.size:
            array = array.reshape((-1, 1) if array.size > 1 else 1)
        array = self._array(array, "u", self.nu)
        if array.ndim == 1:
            return None, array, 0
        if len(array) != -(-steps // hold):
            what = "step" if hold == 1 else f"control period of {hold} steps"
            raise ValueError(
                f"u: {len(array)} rows for {steps} steps: give one row a {what}, or the duration= "
                "or steps= that the rows cover"
            )
        return None, array if hold == 1 else np.repeat(array, hold, axis=0)[:steps], self.nu
