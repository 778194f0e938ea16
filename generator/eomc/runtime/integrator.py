"""Steps and runs of a compiled scene by fixed or adaptive steps; the loops are in C."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from time import perf_counter
from typing import Any, NamedTuple, Never, cast

import numpy as np
from numpy import empty
from numpy.typing import ArrayLike

from . import adaptive, output_times
from .arguments import (
    Array,
    Parameters,
    Start,
    StateArguments,
    as_count,
    as_flag,
    as_number,
    as_period,
    as_step_size,
    machine_memory,
)
from .c_library import next_chunk, slices
from .inputs import FeedbackLaw, SampledSignal, warn_called_each_step
from .interfaces import CompiledModel
from .package import Component, option, warn, with_events
from .requests import (
    FIRST_CALL_NUMBERS,
    MAX_EVERY,
    FixedStepRequest,
    Inputs,
    SimulationArguments,
    as_progress,
    step_count,
)
from .stability import MIN_STEPS, LinearizationState, advice
from .starts import initial_state_for_parameters, is_by_name
from .status import STATUS, STATUS_MESSAGES, Interrupted, MotionError, state_text
from .trajectory import Run

_STEPS = 20_000  # steps times coordinates cubed in one call of C, some ms at most
_MAX_SHORT_STEPS = 999  # of a run in a single call of C
MIN_CHECKED_NUMBERS = 2**24  # positions; larger runs are checked against the memory


class Loop(NamedTuple):
    """C functions of an integration method.

    Attributes
    ----------
    step, run : C functions
        A step, and a run of steps.
    short : int
        Largest number of steps of a run that needs no workspace and no check of Ctrl-C; -1: none.
    stages : int
        Number of evaluations of the accelerations in a step of an explicit method.
    work_type : C type
        Type of a pointer to the workspace of a run.
    evaluations : C function or None
        Returns the number of evaluations in a run; None if it is stages times steps.
    """

    step: Any
    run: Any
    short: int
    stages: int
    work_type: Any
    evaluations: Any


class Integrator(Component):
    """Steps and simulations of a compiled scene.

    Attributes
    ----------
    loops : dict of Loop
        C functions of each method, by name.
    warned : set
        Warnings that have been issued: pairs (method, step size) beyond the stability limit, and
        "u" for a Python function as input.
    room : int
        Number of rows that suffices for a short adaptive run; 0 if the last run was long.
    ignores_events : bool
        True to simulate with fixed steps as if the scene had no events, as checks need.
    """

    path = "integrator"

    def __init__(self, model: CompiledModel) -> None:
        self.model, self.info, self.c, self.arguments = model, model.info, model.c, model.arguments
        self.loops = {name: self._loop(name) for name in self.info.methods}
        self.warned: set[Any] = set()
        self.room = 0
        self.ignores_events = False

    def _loop(self, name: str) -> Loop:
        lib, info = self.c.lib, self.info
        evaluations = getattr(lib, f"{name}_evaluations", None)
        needs_work = evaluations or info.constraints.names or info.events
        short = -1 if needs_work else min(_MAX_SHORT_STEPS, FIRST_CALL_NUMBERS // info.nq)
        step, run = (getattr(lib, f"{name}_{what}") for what in ("step", "run"))
        stages = info.method_table[name].stages
        return Loop(step, run, short, stages, self.c.ffi.typeof(f"{name}_work *"), evaluations)

    def c_function(self, method: str | None, what: str) -> Any:
        """Return the C function of a method (None: the first): its step, run or batch."""
        return getattr(self.c.lib, f"{self.info.method_name(method)}_{what}")

    def step(
        self, q: ArrayLike, qd: ArrayLike, h: float | None = None, t: float = 0.0, u: Any = None,
        params: Parameters = None, method: str | None = None,
        out: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the state (q, qd) after one step of size h. Events are not detected.

        Parameters
        ----------
        q, qd : (nq,) array_like
            State before the step.
        h : float, optional
            Step size, s; by default that of the scene.
        t : float
            Time at the start of the step, s.
        u : (nu,) array_like or mapping by name, optional
            Inputs, constant over the step. By default the scene's signals, which are evaluated as
            functions of time and state within the step.
        params : mapping or (np,) array_like, optional
            Parameters that differ from those of the scene.
        method : str, optional
            Name in `methods`; by default the first.
        out : (q, qd), optional
            Arrays (nq,) that receive the result.

        Returns
        -------
        q, qd : (nq,) arrays
            State after the step, at t + h.

        Raises
        ------
        MotionError
            If the step fails; `out` is unchanged then.
        """
        from_q, from_qd, at, moving = self.arguments.read_state(q, qd, many=False)
        h = self.info.h if h is None else as_step_size(h, self.info.dtype)
        inputs, p = self.arguments.input_pointers(u, params)
        address, real, null = self.c.tools
        if out is None:
            both = empty((2, self.info.nq), self.info.dtype)
            ends, to_q, to_qd = (both[0], both[1]), address(real, both), null
        else:
            ends = self.arguments.output_pair(out, at.shape)
            to_q, to_qd = address(real, ends[0]), address(real, ends[1])
        step = self.loops[self.info.method_name(method)].step
        code = step(to_q, to_qd, from_q, from_qd, as_number(t, "t"), h, inputs, p)
        if code:
            status = STATUS[code]
            raise MotionError(
                f"no step from t = {t:.9g}, {state_text(at, moving)}: {STATUS_MESSAGES[status]}",
                status,
            )
        return ends

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
        q, qd = self.arguments.state(q, qd)
        h = self.info.h if h is None else as_step_size(h, self.info.dtype)
        hold = None if control_period is None else as_period(control_period, h)
        method = self.info.method_name(method)
        lib = self.c.lib
        if not hasattr(lib, f"{method}_derivative"):
            raise ValueError(
                f"discretize: {self.info.name} was built without it: build it with "
                f"{option('discretize')}"
            )
        rows, n, nu = q.shape[:-1], self.info.nq, self.info.nu
        Phi = empty((*rows, 2 * n, 2 * n), self.info.dtype)
        Gamma = empty((*rows, 2 * n, nu), self.info.dtype)
        K = None
        if hold is not None and u is None and self.info.nu:
            u = self.model.functions.signal(q, qd, t, params)
            if hasattr(lib, "signal_slopes"):
                K = self.model.functions.feedback(q, qd, None, t, params)
        steps, acts = hold or 1, StateArguments(self.arguments, rows, t, u, params)
        derivative, null = getattr(lib, f"{method}_derivative"), self.c.null
        to_Phi, to_Gamma, from_q, from_qd = (
            self.c.pointer(x) if x.size else null for x in (Phi, Gamma, q, qd)
        )
        for k, many in slices(q.size // n, _STEPS // (steps * n**3) + 1):
            now, inputs, p, own = acts.pointers(k)
            code = derivative(
                many, to_Phi + 4 * n**2 * k, to_Gamma + 2 * n * nu * k if nu else null,
                from_q + n * k, from_qd + n * k, now, h, steps, inputs, p, own,
            )  # fmt: skip
            if code & 7:
                completed, step = divmod(code >> 3, steps)
                _refuse(q.reshape(-1, n)[k + completed], qd.reshape(-1, n)[k + completed],
                        acts.time(k + completed), step, STATUS[code & 7])  # fmt: skip
        return (Phi if K is None else Phi + Gamma @ K), Gamma

    def simulate(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        u: Inputs = None, params: Parameters = None, method: str | None = None, *, t0: float = 0.0,
        control_period: float | None = None, out: tuple[Array, Array] | None = None,
        progress: Callable[[int, int], None] | None = None, estimate: bool = False,
        tol: float | None = None, times: ArrayLike | None = None, max_step: float | None = None,
        stiff: bool = False, events: Mapping[str, Any] | None = None, **unknown: Never,
    ) -> Run:  # fmt: skip
        """Simulate the motion by fixed steps of size h or by adaptive steps, and return the run.

        Steps are adaptive if `tol`, `max_step`, `stiff` or method="auto" is given, or if the scene
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
        max_step : float, optional
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
            return cast(Run, other.integrator.simulate(**arguments))
        if (params is not None and self.info.start_formulas) or is_by_name(q0, qd0):
            p = self.arguments.parameters(params)
            q0, qd0 = initial_state_for_parameters(self.model, q0, qd0, p)
        # calls with few arguments take a short path, since a short run takes a few microseconds
        is_simple = (out is None and progress is None and control_period is None and not estimate
                     and times is None and type(t0) is float and isfinite(t0))  # fmt: skip
        if (
            is_simple and (room := self.room) and h is None and steps is None and method is None
            and max_step is None and every == 1 and stiff is False
            and (
                short := adaptive.simulate_short_run(
                    self.model, (q0, qd0), duration, u, params, t0, tol, room
                )
            ) is not None
        ):  # fmt: skip
            return short
        estimate, progress = as_flag(estimate, "estimate"), as_progress(progress)
        q0, qd0 = self.model.constraints.assemble(q0, qd0, t0, params)
        if is_simple and u is duration is tol is max_step is None and stiff is False:
            run = self._short_run((q0, qd0), h, steps, every, params, method, t0)
            if run is not None:
                return run
        options = SimulationArguments(
            q0, qd0, h, duration, steps, every, u, params, method, t0, control_period, out,
            progress, tol, times, max_step, stiff,
        )  # fmt: skip
        if options.uses_adaptive_steps(self.info):
            return self._finish(adaptive.simulate(self.model, options), estimate)
        if self.info.events and not self.ignores_events:
            return self._finish(adaptive.simulate_fixed_steps(self.model, options), estimate)
        return self._finish(self._fixed_steps(options), estimate)

    def _short_run(
        self, start: tuple[Any, Any], h: float | None, steps: Any, every: Any, params: Any,
        method: str | None, t0: float,
    ) -> Run | None:  # fmt: skip
        """Simulate a short run by fixed steps in a single call of C.

        Return None, and let the caller take the general path, if the run has many steps, does not
        reach its end, or begins so late that its times need a check. start: q0 and qd0. The
        arguments are those of `simulate`, of which only the initial state is checked already.
        """
        if not (type(steps) is type(every) is int and (method is None or type(method) is str)):
            return None
        info, (q0, qd0) = self.info, start
        method = method or info.methods[0]
        if (loop := self.loops.get(method)) is None or not 0 < every <= loop.short >= steps >= 0:
            return None
        h = info.h if h is None else as_step_size(h, info.dtype)
        if abs(t0) > 1e6 * h or (steps >= MIN_STEPS and (method, h) not in self.warned):
            return None
        (from_q, from_qd, at_p), p = self.arguments.default_pointers, info.p0
        if q0 is not None:
            from_q = self.arguments.initial_half(q0, "q0")[1]
        if qd0 is not None:
            from_qd = self.arguments.initial_half(qd0, "qd0")[1]
        if params is not None:
            p = self.arguments.parameters(params).copy()
            at_p = self.c.pointer(p)
        address, real, null = self.c.tools
        rows = empty((2, 1 - -steps // every, info.nq), info.dtype)
        code = loop.run(
            address(real, rows), null, from_q, from_qd, t0, h, steps, null, 0, every, at_p, null
        )
        if code != 8 * steps:
            return None
        evaluations = loop.stages * steps
        return Run(self.model, t0, rows, h, steps, "ok", p, every, None, method, evaluations)

    def _initial(
        self, options: SimulationArguments
    ) -> tuple[Array, Array, Array, tuple[Any, Any, Any]]:
        """Return q, qd and p at the start of a run, and all three in the form that C reads."""
        (q, qd), p = self.info.initial_state, self.info.p0
        from_q, from_qd, at_p = self.arguments.default_pointers
        if options.q0 is not None:
            q, from_q = self.arguments.initial_half(options.q0, "q0")
        if options.qd0 is not None:
            qd, from_qd = self.arguments.initial_half(options.qd0, "qd0")
        if options.params is not None:
            p = self.arguments.parameters(options.params).copy()
            at_p = self.c.pointer(p)
        return q, qd, p, (from_q, from_qd, at_p)

    def _fixed_steps(self, options: SimulationArguments) -> Run:
        """Check the arguments of a run by fixed steps and simulate."""
        method = self.info.method_name(options.method)
        q, qd, p, c_arguments = self._initial(options)
        h = self.info.h if options.h is None else as_step_size(options.h, self.info.dtype)
        t0 = as_number(options.t0, "t0")
        times, steps = options.output_times(t0, h)
        steps = step_count(self.info, h, options.duration if times is None else None, steps)
        every = min(as_count(options.every, "every", 1), MAX_EVERY)
        u, hold = options.inputs_and_hold(self.info, t0, h, steps)
        if u is None and options.control_period is not None and self.info.nu:
            u = SampledSignal(self.model, options.params)
        if steps >= MIN_STEPS and (method, h) not in self.warned:
            self.check_step_size(
                LinearizationState(q, qd, t0, self._first(u, steps, hold), p), h, method
            )
        return self.run(
            FixedStepRequest(
                q, qd, t0, h, steps, every, u, p, method, hold, times, options.out,
                options.progress, c_arguments,
            )
        )  # fmt: skip

    def _finish(self, run: Run, estimate: bool) -> Run:
        """Issue the warnings of a run and estimate its error on request; return the run."""
        if run.status == "interrupted":
            raise Interrupted(run)
        if words := run.message if run.status != "ok" else run.remark:
            warn(f"{self.info.name}: {words}")
        if estimate:
            try:
                run.estimate()
            except ValueError as fault:  # of what can't be done again; the run is there
                warn(f"{self.info.name}: {fault}")
        return run

    def check_step_size(
        self, state: LinearizationState, h: float, method: str, whose: str = ""
    ) -> None:
        """Warn, once a method and step size, if h, s, is beyond the stability limit.

        state: initial state. whose: beginning of the message.
        """
        self.warned.add((method, h))
        if words := advice(self.model, state, h, method):
            warn(f"{self.info.name}: {whose}{words}")

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
        p, method = self.arguments.parameters(params), self.info.method_name(method)
        q, qd = self.arguments.state(*initial_state_for_parameters(self.model, q0, qd0, p))
        h = self.info.h if h is None else as_step_size(h, self.info.dtype)
        return advice(self.model, LinearizationState(q, qd, as_number(t0, "t0"), u, p), h, method)

    def run(self, request: FixedStepRequest) -> Run:
        """Simulate by fixed steps from checked arguments; return the run, whatever its status."""
        if request.times is not None:
            return output_times.run(self.model, request, self.input_table(request))
        steps, every, h, t0 = request.steps, request.every, request.h, request.t0
        loop, nq, (address, real, null) = self.loops[request.method], self.info.nq, self.c.tools
        law, inputs, stride = self.input_table(request)
        q_rows, qd_rows = self._memory(request)
        to_q, to_qd = address(real, q_rows), address(real, qd_rows)
        at_u = null if inputs is None else address(real, inputs)
        from_q, from_qd, at_p = request.c_arguments or (
            self.c.pointer(x) for x in (request.q, request.qd, request.p)
        )
        # a step of an implicit method may solve for all its stages
        numbers = nq**3 if loop.evaluations else nq
        completed, chunk = 0, request.hold if law else FIRST_CALL_NUMBERS // numbers or 1
        # workspace from call to call, with counters; a single call may do without
        is_single = steps <= chunk and loop.evaluations is None and not self.info.constraints.names
        work = null if is_single else self.c.ffi.new(loop.work_type)
        try:
            while True:
                if law and completed < steps:
                    row = -(-completed // every)
                    # at the start the rows are still empty
                    state = (q_rows[row], qd_rows[row]) if completed else (request.q, request.qd)
                    inputs = law(t0 + completed * h, *state)
                    at_u = address(real, inputs)
                count = steps - completed
                if count > chunk:
                    count, start_time = chunk, perf_counter()
                code = loop.run(
                    to_q, to_qd, from_q, from_qd, t0, h, count, at_u, stride, every, at_p, work
                )
                completed, status = code >> 3, STATUS[code & 7]
                if status != "ok":
                    break
                if request.progress is not None and completed:
                    request.progress(completed, steps)
                if completed == steps:
                    break
                if not law:
                    chunk = next_chunk(count, perf_counter() - start_time)
        except KeyboardInterrupt:
            completed, status = work.completed if work else completed, "interrupted"
            if not completed:
                q_rows[0], qd_rows[0] = request.q, request.qd
        if completed < steps:
            count = 1 - -completed // every
            q_rows, qd_rows = q_rows[:count], qd_rows[:count]
        evaluations = loop.evaluations(work) if loop.evaluations else loop.stages * completed
        stored = law.law if law else None if inputs is None else inputs.copy()
        result = Run(
            self.model, t0, (q_rows, qd_rows), h, completed, status, request.p, every, stored,
            request.method, evaluations,
        )  # fmt: skip
        self.record_singular_steps(result, request.method, work)
        if law:
            result.hold = request.hold
            result.applied_inputs = law.rows(len(result), self.info.nu)
        return result

    def _memory(self, request: FixedStepRequest) -> Any:
        """Return q and qd of all rows, (rows, nq) each: those of the caller, or new ones."""
        rows, nq = 1 - -request.steps // request.every, self.info.nq
        try:
            if request.out is not None:
                return self.arguments.output_pair(request.out, (rows, nq))
            if rows * nq > MIN_CHECKED_NUMBERS and self.info.row_bytes(rows) > machine_memory():
                raise MemoryError
            return empty((2, rows, nq), self.info.dtype)
        except MemoryError:
            raise MemoryError(
                f"{rows} rows of {2 * nq} numbers don't fit in memory: keep fewer with every="
            ) from None

    def _first(self, u: Any, steps: int, hold: int) -> Array | None:
        """Return the inputs of the first step; None for a signal or a function."""
        inputs = self._table(u, steps, 1, hold)[1]
        return inputs[0] if inputs is not None and inputs.ndim == 2 else inputs

    def input_table(
        self, request: FixedStepRequest
    ) -> tuple[FeedbackLaw | None, Array | None, int]:
        """Return the inputs of a run by fixed steps in the form that C takes.

        The result is (law, inputs, stride): the feedback law u(t, q, qd), or None; the inputs as an
        array, or None; the distance in that array between the inputs of two steps, 0 if they are
        constant.
        """
        return self._table(request.u, request.steps, request.every, request.hold)

    def _table(
        self, u: Any, steps: int, every: int, hold: int
    ) -> tuple[FeedbackLaw | None, Array | None, int]:
        """Return (feedback law, constant inputs or rows, stride from step to step)."""
        if u is None:
            return None, None, 0
        if not self.info.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            if hold == 1:
                warn_called_each_step(self.model)
            return FeedbackLaw(u, self.arguments.inputs, every, hold), None, 0
        if isinstance(u, Mapping):
            u = self.arguments.inputs_by_name(u)
        array = self.arguments.numbers(u, "u")
        if self.info.nu == 1 and array.ndim < 2 and array.size:
            array = array.reshape((-1, 1) if array.size > 1 else 1)
        array = self.arguments.array(array, "u", self.info.nu)
        if array.ndim == 1:
            return None, array, 0
        if len(array) != -(-steps // hold):
            what = "step" if hold == 1 else f"control period of {hold} steps"
            raise ValueError(
                f"u: {len(array)} rows for {steps} steps: give one row a {what}, or the duration= "
                "or steps= that the rows cover"
            )
        return None, array if hold == 1 else np.repeat(array, hold, axis=0)[:steps], self.info.nu

    def record_singular_steps(self, run: Any, method: str, work: Any) -> None:
        """Store the singular steps of a run, which C counted."""
        if not self.info.constraints.names:
            return
        run.singular_steps = getattr(self.c.lib, f"{method}_singular")(work)
        if run.singular_steps:
            run.first_singular = run.t0 + getattr(self.c.lib, f"{method}_first")(work)


def _refuse(q: Array, qd: Array, t: float, step: int, status: str) -> None:
    """Raise MotionError for a state without a derivative; step: number of steps before it."""
    what = "a derivative is not finite there" if status == "not finite" else STATUS_MESSAGES[status]
    later = f" {step} steps later" if step else ""
    raise MotionError(
        f"no derivative of a step{later} from t = {t:.9g}, {state_text(q, qd)}: {what}", status
    )
