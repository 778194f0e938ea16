"""Steps and runs of a compiled scene, and the stability limit of steps; the loops are in C."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf, sqrt
from typing import Any, Never, cast

import numpy as np
from numpy import empty
from numpy.typing import ArrayLike

from . import rank
from .arguments import (
    Array,
    Parameters,
    Start,
    StateArguments,
    as_flag,
    as_number,
    as_period,
    as_step_size,
)
from .info import slices
from .integration import integrate, run_at_once
from .interfaces import CompiledModel
from .package import Component, option, warn, with_events
from .requests import (
    ADAPTIVE_METHOD,
    FIRST_CALL_NUMBERS,
    MAX_SHORT_STEPS,
    MIN_CHECKED_STEPS,
    Inputs,
    PlainSteps,
    Progress,
    Request,
    SimulationArguments,
    StepChoice,
    as_progress,
    checked_inputs,
    initial_state_for_parameters,
    named_initial_state,
)
from .status import STATUS, STATUS_MESSAGES, Interrupted, MotionError, state_text
from .trajectory import Trajectory

_State = tuple[Array, Array, float, Any, Any]  # q, qd, t, u, params
_STEPS = 20_000  # steps times coordinates cubed in one call of C, some ms at most


class Integrator(Component):
    """Steps and simulations of a compiled scene.

    Attributes
    ----------
    step_functions : dict
        C functions that make a step of a method, by its name.
    short_methods : dict
        For each method the largest number of fixed steps of a run that needs no workspace and no
        check of Ctrl-C, the number of the method in C, and the number of evaluations in a step (0:
        not constant).
    plain_steps : PlainSteps
        Checked steps by the arguments of calls.
    spare_counts : list
        Memory for the counts of a short run, for which no run has use.
    start_bytes : bytes
        Numbers of the scene's initial state, q and then qd.
    input_shape : tuple
        Shape of constant inputs.
    no_events : tuple
        Arguments of C in place of a buffer for events; () for a scene without events.
    warned : set
        Warnings that have been issued: pairs (method, step size) beyond the stability limit, and
        "u" for a Python function as input.
    room : int
        Number of rows that suffices for a short adaptive run; 0 if the last run was long.
    has_plain_runs : bool
        Whether the scene has neither constraints nor discrete coordinates.
    has_short_runs : bool
        Whether the scene has no events either, as runs by a single call of C require.
    ignores_events : bool
        True to simulate with fixed steps as if the scene had no events, as checks need.
    """

    path = "integrator"

    def __init__(self, model: CompiledModel) -> None:
        self.model, self.info, self.c, self.arguments = model, model.info, model.c, model.arguments
        info, null = self.info, self.c.null
        self.step_functions = {x: getattr(self.c.lib, f"{x}_step") for x in info.methods}
        self.short_methods = {ADAPTIVE_METHOD: (0, 0, 0)}
        for number, name in enumerate(info.methods):
            method = info.method_table[name]
            most = FIRST_CALL_NUMBERS // info.nq ** (3 if method.is_implicit else 1)
            stages = 0 if method.is_implicit else method.stages
            self.short_methods[name] = min(MAX_SHORT_STEPS, most), number, stages
        self.spare_counts: list[Any] = []
        self.start_bytes = b"".join(x.tobytes() for x in info.initial_state)
        self.input_shape = (info.nu,)
        self.no_events: tuple[Any, ...] = (0, null, null) if info.events else ()
        self.has_plain_runs = not (self.info.constraints.names or self.info.discrete_count)
        self.has_short_runs = self.has_plain_runs and not info.events
        self.warned: set[Any] = set()
        self.plain_steps = PlainSteps(info, self.warned)
        self.room = 0
        self.ignores_events = False

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
        step = self.step_functions[self.info.method_name(method)]
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
        parameters: bool = False, out: tuple[Array, Array] | None = None,
    ) -> tuple[Array, ...]:  # fmt: skip
        """Return the derivatives Phi, Gamma and E of one step: dx' = Phi dx + Gamma du + E dp.

        x = [q; qd] is the state before the step, x' the state after it, u are the inputs, and p
        the parameters. The derivatives are those of the step itself, not of the exact motion, and
        are exact to rounding.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State before the step, or n states.
        h : float, optional
            Step size, s; by default that of the scene.
        t : float or (n,) array_like
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
            over it: `u`, or the scene's signals at its start.
        parameters : bool
            Return E, too. The initial state x is constant, even if the scene's initial values are
            formulas of parameters.
        out : (Phi, Gamma), optional
            Arrays that receive Phi and Gamma. Their contents are undefined after an error.

        Returns
        -------
        Phi : (2 nq, 2 nq) array
            dx'/dx. For n states all results have a leading axis n.
        Gamma : (2 nq, nu) array
            dx'/du.
        E : (2 nq, np) array, if `parameters`
            dx'/dp, a column for each parameter, at constant inputs `u`; if the step follows the
            scene's signals, through these too.

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
        self._require_derivatives("discretize")
        functions = self.model.functions
        count = len(self.info.parameters) if hasattr(lib, "sensitivity") else 0
        if as_flag(parameters, "parameters") and not count:
            functions.refuse_sensitivity("discretize")
        rows, n, nu = q.shape[:-1], self.info.nq, self.info.nu
        Phi, Gamma = self.arguments.output_matrices(out, "(Phi, Gamma)", q, qd)
        E = empty((*rows, 2 * n, count), self.info.dtype)
        K = u_p = None
        if hold is not None and u is None and self.info.nu:
            u = functions.signal(q, qd, t, params)
            if hasattr(lib, "signal_slopes"):
                K = functions.feedback(q, qd, None, t, params)
            if hasattr(lib, "signal_sensitivity"):
                u_p = functions.evaluate("signal_sensitivity", q, qd, t, None, params)
        steps, acts = hold or 1, StateArguments(self.arguments, rows, t, u, params)
        derivative, null = getattr(lib, f"{method}_derivative"), self.c.null
        to_Phi, to_Gamma, to_E, from_q, from_qd = (
            self.c.pointer(x) if x.size else null for x in (Phi, Gamma, E, q, qd)
        )
        for k, many in slices(q.size // n, _STEPS // (steps * n**3) + 1):
            now, inputs, p, own = acts.pointers(k)
            code = derivative(
                many, to_Phi + 4 * n**2 * k, to_Gamma + 2 * n * nu * k if nu else null,
                to_E + 2 * n * count * k if count else null, from_q + n * k, from_qd + n * k, now,
                h, steps, inputs, p, own,
            )  # fmt: skip
            if code & 7:
                completed, step = divmod(code >> 3, steps)
                _refuse(q.reshape(-1, n)[k + completed], qd.reshape(-1, n)[k + completed],
                        acts.time(k + completed), step, STATUS[code & 7])  # fmt: skip
        if K is not None:
            Phi += Gamma @ K
        if u_p is not None:
            E += Gamma @ u_p
        return (Phi, Gamma, E) if parameters else (Phi, Gamma)

    def _require_derivatives(self, name: str) -> None:
        """Raise ValueError if the module has no derivatives of steps; name: the caller."""
        if not hasattr(self.c.lib, f"{self.info.methods[0]}_derivative"):
            raise ValueError(
                f"{name}: {self.info.name} was built without it: build it with "
                f"{option('discretize')}"
            )

    def propagate(
        self, rows: tuple[Array, Array], times: Array, u: Array | None, p: Array, h: float,
        method: str, *, has_rows: bool,
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Return the derivatives of the states at given times by the first state, u and p.

        They are the products of the derivatives of the steps.

        Parameters
        ----------
        rows : tuple of two (n, nq) arrays
            q and qd. Those after the first row are computed, unless `has_rows`.
        times : (n,) array
            Ascending times of the rows, s. Between two of them there are steps of equal size.
        u : (nu,) or (n, nu) array, or None
            Inputs, constant or from each row to the next; None: the scene's signals.
        p : (np,) array
            Parameters.
        h : float
            Largest step size, s.
        method : str
            Name of the method.
        has_rows : bool
            Whether the steps after each row start from its given state.

        Returns
        -------
        Phi, Gamma, E : (n, 2 nq, 2 nq), (n, 2 nq, nu) and (n, 2 nq, np) arrays
            Derivatives by the first state, by a constant that is added to the inputs, and by the
            parameters; np is 0 if the module has no derivatives by them.

        Raises
        ------
        MotionError
            If a step fails or a derivative is not finite.
        ValueError
            If the module was built without derivatives of steps.
        """
        self._require_derivatives("sensitivity")
        info, pointer, count, size = self.info, self.c.pointer, len(times), 2 * self.info.nq
        widths = size, info.nu, len(info.parameters) if hasattr(self.c.lib, "sensitivity") else 0
        matrices = [np.zeros((count, size, width), info.dtype) for width in widths]
        matrices[0][:1] = np.eye(size)
        u_step = u.shape[-1] if u is not None and u.ndim == 2 else 0
        clock, function = np.ascontiguousarray(times, float), f"{method}_sensitivity"
        steps = 1 + (clock[-1] - clock[0]) / h / count
        for k, many in slices(count - 1, int(_STEPS // (steps * info.nq**3)) + 1):
            code = getattr(self.c.lib, function)(
                many + 1, *(pointer(x[k:]) if x.size else self.c.null for x in matrices),
                *(pointer(x[k:]) for x in rows), has_rows,
                self.c.ffi.from_buffer("double *", clock[k:]), h,
                self.c.null if u is None else pointer(u[k:] if u_step else u), u_step, pointer(p),
            )  # fmt: skip
            if code & 7:
                at = k + (code >> 3)
                _refuse(rows[0][at], rows[1][at], clock[at], 0, STATUS[code & 7])
        return matrices[0], matrices[1], matrices[2]

    def simulate(
        self, q0: Start = None, qd0: Start = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        u: Inputs = None, params: Parameters = None, method: str | None = None, *, t0: float = 0.0,
        control_period: float | None = None, out: tuple[Array, Array] | None = None,
        progress: Callable[[int, int], None] | None = None, estimate: bool = False,
        tol: float | None = None, times: ArrayLike | None = None, max_step: float | None = None,
        stiff: bool = False, events: Mapping[str, Any] | None = None, **unknown: Never,
    ) -> Trajectory:  # fmt: skip
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
        Trajectory
            The run; `run.status` is "ok" if it reached its end.

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
            return cast(Trajectory, other.integrator.simulate(**arguments))
        choice = None
        if max_step is control_period is None and out is None and progress is None:
            key = h, duration, steps, every, method, tol, times is not None
            choice = self.plain_steps.find(key)
        is_short = self.has_short_runs and stiff is False and estimate is False
        if choice is not None and is_short and type(t0) is float:
            run = run_at_once(self.model, choice, t0, times, (q0, qd0, u, params))
            if run is not None:
                return run
        estimate, progress = as_flag(estimate, "estimate"), as_progress(progress)
        q0, qd0 = named_initial_state(self.model, q0, qd0, params)
        start = self.model.constraints.assemble(q0, qd0, t0, params)
        options = SimulationArguments(
            *start, h, duration, steps, every, u, params, method, t0, control_period, out,
            progress, tol, times, max_step, stiff,
        )  # fmt: skip
        request = self._request(options, choice)
        return self._finish(integrate(self.model, request, progress, out), estimate)

    def integrate(
        self, request: Request, progress: Progress = None, out: tuple[Array, Array] | None = None
    ) -> Trajectory:
        """Make a run from checked arguments and return it, whatever its status."""
        return integrate(self.model, request, progress, out)

    def _request(self, options: SimulationArguments, choice: StepChoice | None) -> Request:
        """Check the arguments of `simulate` and return them; warn of a step size that is too large.

        choice: checked steps from t = 0, if known. Raises ValueError if an argument is invalid.
        """
        steps = self.checked_steps(options, choice)
        q, qd, p = self._initial(options)
        request = steps.request(q, qd, checked_inputs(self.model, options, steps, p), p)
        self.check_step_size(request)
        return request

    def checked_steps(self, options: SimulationArguments, choice: StepChoice | None) -> StepChoice:
        """Return the checked steps: `choice`, from t = 0, if these arguments permit it."""
        is_other = self.ignores_events or options.times is not None or options.stiff is not False
        if choice is None or is_other or type(options.t0) is not float or options.t0:
            return StepChoice.from_arguments(self.info, options, self.ignores_events)
        return choice

    def _initial(self, options: SimulationArguments) -> tuple[Array, Array, Array]:
        """Return copies of q, qd and the parameters at the start of a run."""
        (q, qd), p = self.info.initial_state, self.info.p0
        if options.q0 is not None:
            q = self.arguments.initial_half(options.q0, "q0").copy()
        if options.qd0 is not None:
            qd = self.arguments.initial_half(options.qd0, "qd0").copy()
        if options.params is not None:
            p = self.arguments.parameters(options.params).copy()
        return q, qd, p

    def _finish(self, run: Trajectory, estimate: bool) -> Trajectory:
        """Issue the warnings of a run and estimate its error on request; return the run."""
        if run.status == "interrupted":
            raise Interrupted(run)
        if run.status == "ok" and not estimate and self.has_plain_runs:
            return run
        if words := run.message if run.status != "ok" else run.remark:
            warn(f"{self.info.name}: {words}")
        if estimate:
            try:
                run.estimate()
            except ValueError as fault:  # of what can't be done again; the run is there
                warn(f"{self.info.name}: {fault}")
        return run

    def check_step_size(self, request: Request, whose: str = "") -> None:
        """Warn, once a method and step size, if h is beyond the stability limit at the start.

        The first instance of a batch is checked. whose: beginning of the message.
        """
        method, h = request.method, request.h
        if request.steps < MIN_CHECKED_STEPS or (method, h) in self.warned:
            return
        self.warned.add((method, h))
        arrays = request.q, request.qd, request.u, request.p
        first: list[Any] = [
            None if x is None or callable(x) else x[(0,) * (x.ndim - 1)] for x in arrays
        ]
        state = first[0], first[1], request.t0, first[2], first[3]
        if words := _step_size_advice(self.model, state, h, method):
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
        return _step_size_advice(self.model, (q, qd, as_number(t0, "t0"), u, p), h, method)


def _refuse(q: Array, qd: Array, t: float, step: int, status: str) -> None:
    """Raise MotionError for a state without a derivative; step: number of steps before it."""
    what = "a derivative is not finite there" if status == "not finite" else STATUS_MESSAGES[status]
    later = f" {step} steps later" if step else ""
    raise MotionError(
        f"no derivative of a step{later} from t = {t:.9g}, {state_text(q, qd)}: {what}", status
    )


def _step_size_advice(model: CompiledModel, state: _State, h: float, method: str) -> str | None:
    """Return a message if the step size h is too large for a stable run from a state, else None.

    state: q, qd, time, inputs (None: the scene's signals) and parameters. h: step size, s. method:
    name of the method.

    The motion is linearised at the state. The largest |imaginary part| and the fastest decay of its
    eigenvalues are compared with the two stability limits of the method. A mode whose speed depends
    on the width of the finite differences comes from a discontinuity of the forces and is ignored.
    """
    limits = model.info.method_table[method]
    undamped, decaying = limits.oscillation_limit, limits.decay_limit
    turning, decay = _fastest_modes(model, state, 1.0)
    modes = ((undamped, turning), (decaying, decay))
    longest = min((limit / rate for limit, rate in modes if rate), default=inf)
    if not 0 < longest < abs(h):
        return None
    if max(_fastest_modes(model, state, 100.0)) < max(turning, decay) / 2:
        return None
    if undamped * decay > decaying * turning:
        mode = f"fastest decay {decay:.3g} 1/s"
    else:
        mode = f"fastest mode {turning:.3g} rad/s"
    return (
        f"h = {abs(h):g} s is beyond {method}'s stability limit of about {longest:.2g} s here "
        f"({mode} at the start)"
    )


def _fastest_modes(model: CompiledModel, state: _State, wide: float) -> tuple[float, float]:
    """Return (largest |Im|, fastest decay) of the eigenvalues at a state, 1/s; 0 if unknown.

    The linearisation is the module's own where available, else a finite difference of the
    acceleration, whose width is `wide` times the usual one. With constraints there are two
    spectra, of all perturbations and of those tangent to the constraints; the slower one counts.
    """
    q, qd, t, u, params = state
    n, x = model.info.nq, np.concatenate([q, qd]).astype(float)
    near = wide * sqrt(float(np.finfo(model.info.dtype).eps)) * np.maximum(1.0, np.abs(x))

    def spectrum(ways: Array) -> tuple[float, float]:
        """Return (largest |Im|, fastest decay) of the linearised motion's eigenvalues, 1/s.

        ways: (2 nq, k), orthonormal columns; the motion is linearised in these directions only.
        """
        moved = near[:, None] * ways
        # signals may depend on the state
        if model.functions.has_slopes and (u is not None or not model.info.nu):
            A = model.functions.linearize(q, qd, t=t, u=u, params=params)[0]
            rates = A.astype(float) @ moved
        else:
            states = np.vstack([x, x + moved.T]).astype(model.info.dtype)
            a = model.functions.acceleration(states[:, :n], states[:, n:], t, u, params)
            a = a.astype(float)
            rates = np.vstack([moved[n:], (a[1:] - a[0]).T])
        values = np.linalg.eigvals(ways.T @ (rates / near[:, None]))
        turning, decay = np.max(np.abs(values.imag), initial=0), np.max(-values.real, initial=0)
        return float(turning), float(decay)

    modes: list[tuple[float, float]] = []  # if empty, the run itself reports the error
    with suppress(ArithmeticError, np.linalg.LinAlgError):
        modes.append(spectrum(np.eye(2 * n)))
    if model.info.constraints.names:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            modes.append(spectrum(_tangent_basis(model, x, t, params, near)))
    return min(modes, key=max, default=(0.0, 0.0))


def _tangent_basis(model: CompiledModel, x: Array, t: float, params: Any, near: Array) -> Array:
    """Return an orthonormal basis (2 nq, k) of the tangent space of the constraints.

    Perturbations of x = [q; qd] are in units of `near`.
    """
    n, holonomic = model.info.nq, model.info.constraints.holonomic
    q, qd = (half.astype(model.info.dtype) for half in (x[:n], x[n:]))
    A = model.constraints.constraint_jacobian(q, t=t, params=params).astype(float)
    sizes = np.maximum(np.linalg.norm(A * near[n:], axis=1), 1e-300)  # rows have units of their own
    back = A * near[n:] / sizes[:, None]
    of_q = rank.null_space((A * near[:n])[:holonomic], model.info.dtype)
    places = np.vstack([q, x[:n] + (near[:n, None] * of_q).T]).astype(model.info.dtype)
    rates = model.constraints.constraint_rates(
        places, np.tile(qd, (len(places), 1)), t, params
    ).astype(float)
    follow = (
        -np.linalg.pinv(back, rcond=rank.tolerance(model.info.dtype))
        @ ((rates[1:] - rates[0]) / sizes).T
    )
    of_qd = rank.null_space(back, model.info.dtype)
    whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
    return np.asarray(np.linalg.qr(whole)[0])
