"""Derivatives of a run with respect to its start, inputs and parameters.

Forward sensitivities of the rows are products of the derivatives of the steps (the variational
equations of the method). Gradients of functions of the rows use the discrete adjoint of the steps.

A step that ends at an event has the size for which the event function is zero there. The derivative
of its end is that at a constant size, plus the derivative with respect to the size times that of
the event time. A state jump multiplies derivatives by the Jacobian of the jump map; the step after
it starts at the event time. Together these are the saltation matrix of the steps themselves
(di Bernardo et al., Piecewise-smooth Dynamical Systems, Springer, 2008, sec. 2.5).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf, isqrt
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, as_flag, as_numbers, as_step_size, not_one_of
from .package import named_outputs, option
from .requests import Request, period_starts
from .status import STATUS, MotionError, refuse, state_text

if TYPE_CHECKING:
    from .interfaces import CompiledModel


class Sensitivity(NamedTuple):
    """Derivatives of n rows of a run, or of n occurrences of an event.

    k is 2 nq for states [q; qd], ny for outputs, and 1 + 2 nq for occurrences [t; q; qd].

    Attributes
    ----------
    start : (n, k, 2 nq) array
        Derivatives by the initial state.
    inputs : (n, k, nu) array
        Derivatives by a constant that is added to each input over the whole run.
    parameters : (n, k, np) array
        Derivatives by the parameters at a constant initial state. np is 0 if the module was built
        without derivatives by parameters.
    """

    start: Array
    inputs: Array
    parameters: Array


def sensitivity(run: Any, outputs: bool, h: float | None, method: str | None) -> Sensitivity:
    """Return the derivatives of the rows of a run; see `Trajectory.sensitivity`."""
    model, request, info = run.model, run.request, run.model.info
    if as_flag(outputs, "outputs") and not info.outputs:
        raise ValueError(f"sensitivity: {info.name} has no outputs: {named_outputs()}")
    if callable(request.u):
        raise ValueError(
            "sensitivity: u is a function, whose derivatives are unknown: give the table of its "
            "values, or let the scene's signals compute the inputs"
        )
    if isinstance(request.u, str):
        raise ValueError(f"sensitivity: {request.u}")
    if run.stopped or (np.diff(run.with_jump_rows().t) == 0).any():
        if h is not None or method is not None:
            raise ValueError(
                "sensitivity: h and method are those of the run where events change or end it: "
                "leave them out"
            )
        steps = _Steps(run, "sensitivity")
        states = steps.split(steps.derivatives()[: len(run), 1:])
        u = run.request.u if not run.request.period else run.u
        if not outputs:
            return states
        return output_sensitivity(model, states, (run.q, run.qd), run.t, u, request.p)
    method = info.method_name(method or (request.method if request.h else None))
    h = as_step_size(h, info.dtype) if h is not None else request.h or info.h
    t, q, qd, at = run.t, run.q, run.qd, np.arange(len(run))
    if request.period and len(run):  # inputs change at the starts of control periods
        starts = period_starts(request, len(request.u), np.dtype(float))
        starts = starts[~np.isclose(starts[:, None], t, rtol=0, atol=1e-9 * h).any(axis=1)]
        t = np.union1d(t, starts[starts < t[-1]])
        at = np.searchsorted(t, run.t)
        q, qd = run(t)
    u = request.u
    if u is not None and u.ndim == 2:
        u = u[np.clip(((t - request.t0) / request.period + 1e-9).astype(int), 0, len(u) - 1)]
    rows = np.ascontiguousarray(q), np.ascontiguousarray(qd)
    matrices = model.integrator.propagate(rows, t, u, request.p, h, method, has_rows=True)
    states = Sensitivity(*(x[at] for x in matrices))
    if not outputs:
        return states
    return output_sensitivity(
        model, states, (run.q, run.qd), run.t, u if u is None or u.ndim == 1 else u[at], request.p
    )


def event_sensitivity(run: Any) -> dict[str, Sensitivity]:
    """Return the derivatives of the occurrences of events; see `Trajectory.event_sensitivity`."""
    steps = _Steps(run, "event_sensitivity")
    derivatives, (which, _) = steps.derivatives()[len(run) :], _occurrences(run)
    names = enumerate(run.model.info.events)
    return {name: steps.split(derivatives[which == k]) for k, name in names}


def output_sensitivity(
    model: CompiledModel, states: Sensitivity, rows: tuple[Array, Array], t: Any,
    u: Array | None, p: Array,
) -> Sensitivity:  # fmt: skip
    """Return the derivatives of outputs at rows, from those of the states [q; qd] there.

    u: inputs, (nu,) or a row for each state; None: the scene's signals. p: parameters.
    """
    functions = model.functions
    _, _, C, D = functions.linearize(*rows, t, u, p, outputs=True)
    if not (has_parameters := states.parameters.shape[-1] > 0):
        by_p = np.zeros((*C.shape[:2], 0), C.dtype)
    else:
        _, by_p = functions.sensitivity(*rows, t, u, p, outputs=True)
    if u is None and hasattr(model.c.lib, "signal_slopes"):
        C = C + D @ functions.feedback(*rows, None, t, p)
    if u is None and has_parameters and hasattr(model.c.lib, "signal_sensitivity"):
        by_p = by_p + D @ functions.evaluate("signal_sensitivity", *rows, t, None, p)
    return Sensitivity(C @ states.start, C @ states.inputs + D, C @ states.parameters + by_p)


# Coordinates times steps up to which a run with few rows is repeated with a row after each step:
# the states take 64 MB in double precision. The rows of longer runs are the checkpoints.
MAX_REPEATED_NUMBERS = 2**22


class RunGradient(NamedTuple):
    """Derivatives of a scalar function of the rows of a run.

    Attributes
    ----------
    q, qd : (nq,) arrays
        With respect to the initial coordinates and velocities.
    u : array of the shape of the inputs
        With respect to the inputs: a row for each control period of a table, (nu,) for constant
        inputs. If the scene's signals are the inputs, a row for each step, with respect to what is
        added to the signals in that step.
    p : (np,) array
        With respect to the parameters, at a constant start.
    """

    q: Array
    qd: Array
    u: Array
    p: Array


def pull_back(
    run: Any, request: Request, q_bar: ArrayLike | None, qd_bar: ArrayLike | None,
    events: Mapping[str, Any] | None,
) -> RunGradient:  # fmt: skip
    """Return the gradient of a function with the derivatives q_bar, qd_bar at the rows of a run.

    See `Trajectory.vjp`. request: that of the run, without a function of inputs.
    """
    info, c, name = run.model.info, run.model.c, f"{request.method}_adjoint"
    if reason := _refusal(run, request):
        raise ValueError(f"vjp: {reason}")
    n, m, u = info.nq, info.nu, request.u
    bars = [_seeds(x, of, run.q) for x, of in ((q_bar, "q_bar"), (qd_bar, "qd_bar"))]
    event_bars = _event_seeds(run, events or {})
    if len(event_bars) or request.times is not None or not request.h:
        row_bars = np.hstack([np.zeros((len(run), 1)), *bars])
        return _Steps(run, "vjp").gradient(np.vstack([row_bars, event_bars]))
    if request.every > 1 and request.steps * n <= MAX_REPEATED_NUMBERS:
        steps = np.minimum(np.arange(len(run)) * request.every, request.steps)
        run = run.repeat(None)
        request = request.replace(every=1)
        bars = [_at_rows(x, steps, run.q) for x in bars]
    rows = [np.ascontiguousarray(x) for x in (run.q, run.qd)]
    hold, periods = 1, request.steps
    if u is not None:
        is_table = u.ndim == 2
        hold, periods = (request.hold, len(u)) if is_table else (max(1, request.steps), 1)
    sizes = n, n, (periods, m), len(info.parameters)
    q0_bar, qd0_bar, u_bar, p_bar = (np.zeros(size, info.dtype) for size in sizes)
    parts = isqrt(min(request.every, request.steps)) + 2
    work = np.empty(parts * (info.method_table[request.method].stages + 4) * n, info.dtype)
    p = np.ascontiguousarray(request.p)
    status = getattr(c.lib, name)(
        *map(c.pointer, (q0_bar, qd0_bar, u_bar, p_bar, None, *rows, *bars)), request.t0, request.h,
        request.steps, request.every, c.null, c.pointer(u), hold, c.pointer(p), c.pointer(work),
    )  # fmt: skip
    if status:
        _refuse(STATUS[status], run.q[0], run.qd[0])
    return RunGradient(q0_bar, qd0_bar, u_bar if u is None else u_bar.reshape(u.shape), p_bar)


def pull_back_batch(
    batch: Any, q_bar: ArrayLike | None, qd_bar: ArrayLike | None, events: Mapping[str, Any] | None
) -> RunGradient:
    """Return the gradients of functions of the rows of each instance; see `BatchTrajectory.vjp`."""
    bars = [_seeds(x, of, batch.q) for x, of in ((q_bar, "q_bar"), (qd_bar, "qd_bar"))]
    results = []
    for k in range(len(batch)):
        run, own = batch.simulate_instance(k), {}
        for name, parts in (events or {}).items():
            at = batch.events[name].instance == k
            own[name] = tuple(x if x is None else np.asarray(x)[at] for x in parts)
        results.append(run.vjp(*(x[k, : len(run)] for x in bars), events=own))
    return RunGradient(*(_stack(x, 0.0) for x in zip(*results, strict=True)))


def batch_sensitivity(batch: Any, **options: Any) -> Sensitivity:
    """Return the derivatives of the rows of each instance; see `BatchTrajectory.sensitivity`."""
    runs = map(batch.simulate_instance, range(len(batch)))
    results = [run.sensitivity(**options) for run in runs]
    return Sensitivity(*(_stack(x, np.nan) for x in zip(*results, strict=True)))


def _stack(arrays: Sequence[Array], value: float) -> Array:
    """Return arrays with different numbers of rows as one array, with a value in missing rows."""
    shape = len(arrays), max(len(x) for x in arrays), *arrays[0].shape[1:]
    result = np.full(shape, value, arrays[0].dtype)
    for row, x in zip(result, arrays, strict=True):
        row[: len(x)] = x
    return result


def _refuse(status: str, q: Array, qd: Array) -> NoReturn:
    """Raise MotionError: the derivatives of steps from a state on do not exist."""
    infinite = "a derivative along the run from there is not finite"
    refuse(status, q, qd, 0, infinite if status == "not finite" else "")


def _seeds(values: ArrayLike | None, name: str, rows: Array) -> Array:
    """Return the derivatives by the rows as an array of their shape; zeros for None."""
    if values is None:
        return np.zeros_like(rows)
    array = as_numbers(values, name, rows.dtype)
    if array.shape != rows.shape:
        raise ValueError(f"{name}: shape {array.shape}, expected {rows.shape}, that of the rows")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: not all numbers are finite")
    return array


def _occurrences(run: Any) -> tuple[Array, Array]:
    """Return the number of the event of each occurrence, (m,), and [t; q; qd], (m, 1 + 2 nq)."""
    which, rows = run.event_data or (np.zeros(0, int), np.zeros((0, 1 + 2 * run.model.info.nq)))
    return which, rows


def _event_seeds(run: Any, events: Mapping[str, Any]) -> Array:
    """Return the derivatives by all occurrences [t; q; qd] of events, (m, 1 + 2 nq).

    events: those by t, q and qd at the occurrences of an event, by its name; None: zeros.
    """
    which, rows = _occurrences(run)
    seeds = np.zeros_like(rows)
    for name, parts in events.items():
        if name not in run.events:
            raise KeyError(not_one_of("events", name, run.events))
        own, log = which == run.model.info.events.index(name), run.events[name]
        if not isinstance(parts, tuple) or len(parts) != 3:
            raise ValueError(f"events['{name}']: expected a tuple (t_bar, q_bar, qd_bar)")
        pairs = zip(parts, (log.t, log.q, log.qd), strict=True)
        label = f"events['{name}']"
        columns = [_seeds(x, f"{label}[{i}]", of) for i, (x, of) in enumerate(pairs)]
        seeds[own] = np.column_stack(columns)
    return seeds


def _at_rows(values: Array, indices: Array, rows: Array) -> Array:
    """Return an array of the shape of `rows` with the values at these rows, and zeros elsewhere."""
    full = np.zeros_like(rows)
    full[indices] = values
    return full


def _refusal(run: Any, request: Request) -> str:
    """Return why a run has no adjoint, or "" if it has one."""
    info, lib = run.model.info, run.model.c.lib
    if not hasattr(lib, "acceleration_vjp"):
        built = option("linearize", '"products"')
        return f"{info.name} was built without the products that it needs: build it with {built}"
    if info.constraints.names:
        return "runs with constraints have no adjoint"
    if not hasattr(lib, f"{request.method}_adjoint"):
        methods = ", ".join(f'"{name}"' for name in (*info.methods, request.method))
        built = option("method", f"[{methods}]")
        return f"adaptive steps are those of gauss16, which the module lacks: build it with {built}"
    if run.status != "ok":
        return f"the run did not reach its end: {run.message}"
    is_plain = request.h and request.times is None and not request.detects_events
    if is_plain and len(run) != 1 + -(-request.steps // request.every):
        return "the rows of the run are not those after its steps"
    if is_plain and np.ndim(request.u) == 2 and len(request.u) * request.hold < request.steps:
        return "the table of inputs is shorter than the run"
    if request.u is None and info.nu and not hasattr(lib, "signal_vjp"):
        return "a signal of the scene jumps (sign or heaviside): give u, or make it smooth"
    return ""


# --- steps of various sizes and events ------------------------------------------------------------


class _Bars(NamedTuple):
    """Derivatives of a function with respect to parts of a run.

    x (2 nq,): the state at the start; u (steps, nu): the inputs of each step; p (np,): the
    parameters; t (2,): the times of the first and of the last row, or (1,), that of an event.
    """

    x: Array
    u: Array
    p: Array
    t: Array


class _Point(NamedTuple):
    """The end of a step of the run, or of a shorter one, from a row.

    row: that from which the step starts. time, x: the time and the state (2 nq,). event: number of
    the event that occurs there; -1: none, the time is constant.
    """

    row: int
    time: float
    x: Array
    event: int


class _Steps:
    """The steps of a run, of any sizes and up to events, with their derivatives.

    There is a row after each step, and both rows of each state jump. The time of the rows at an
    event is the event time, which varies with the start, inputs and parameters. All other times are
    constant.

    Attributes
    ----------
    t, x : (n,) and (n, 2 nq) arrays
        Times and states [q; qd] at the rows.
    u : (n, nu) array or None
        Inputs in the step after each row; None: the scene's signals.
    period : (n,) array of int
        Index of the row of inputs that acts in the step after each row.
    ends : dict of _Point
        The events at which the state jumps or the run stops, by their rows.
    places : (m,) array of int
        Rows of the m results: the rows of the run, then the occurrences of events. -1 for a result
        between two rows.
    results : tuple of arrays
        The results: the rows, times, states and events of `_Point`.
    """

    def __init__(self, run: Any, name: str) -> None:
        request, info = run.replayed_request(), run.model.info
        if reason := _refusal(run, request):
            raise ValueError(f"{name}: {reason}")
        has_all_rows = request.every == 1 and request.times is None
        steps = run if has_all_rows else run.with_step_rows()
        self.request, self.info, self.model, self.h = request, info, run.model, run.h
        self.t, self.x, u = np.asarray(steps.t, float), steps.x, request.u
        self.period = np.cumsum(np.diff(self.t, prepend=self.t[0]) > 0)
        if u is not None:
            middle = (self.t + np.append(self.t[1:], self.t[-1])) / 2 - request.t0
            number = (middle / (request.period or np.inf)).astype(int)
            self.period = np.minimum(number, len(np.atleast_2d(u)) - 1)
        self.u = None if u is None else np.ascontiguousarray(np.atleast_2d(u)[self.period])
        which, occurrences = _occurrences(run)
        times, x = np.append(run.t, occurrences[:, 0]), np.vstack([run.x, occurrences[:, 1:]])
        events, places = np.append(np.full(len(run), -1), which), np.searchsorted(self.t, times)
        before = np.maximum(places - 1, 0)
        self.results = before, times, x, events
        places[self.t[np.minimum(places, len(self.t) - 1)] != times] = -1
        if has_all_rows:
            places[: len(run)] = np.arange(len(run))
        places[len(run) :] = [self._jump_row(x) for x in occurrences]
        if run.stopped:
            places[-1] = len(self.t) - 1
        self.places = places
        self.ends = {
            row: _Point(row - 1, *self.point(k)[1:])
            for k, row in enumerate(places.tolist())
            if row > 0 and k >= len(run)
        }

    def point(self, k: int) -> _Point:
        """Return the k-th result."""
        row, time, x, event = (values[k] for values in self.results)
        return _Point(int(row), float(time), x, int(event))

    def _jump_row(self, occurrence: Array) -> int:
        """Return the row before the state jump at an occurrence [t; q; qd]; -1: there is none."""
        first, end = (np.searchsorted(self.t, occurrence[0], x) for x in ("left", "right"))
        rows = range(int(first), int(end) - 1)
        return max((k for k in rows if np.array_equal(self.x[k], occurrence[1:])), default=-1)

    @property
    def pieces(self) -> list[tuple[int, int]]:
        """The first and the last row of each part of the run without state jumps."""
        last = len(self.t) - 1
        jumps = sorted(row for row in self.ends if row < last)
        return [*zip([0, *(row + 1 for row in jumps)], [*jumps, last], strict=True)]

    def event_slopes(self, at: _Point, rate: Callable[[Array], float]) -> _Bars:
        """Return the derivatives of an event time: by the end of the step to it, by u and by p.

        The first are those at a constant size of the step.

        rate: a function that returns the derivative of a function of the end of the step with
        respect to the size, from its derivatives with respect to the end.
        """
        # the event function crosses zero and returns within about this fraction of a step
        max_fraction = 1e-5
        evaluate, halves = self.model.functions.evaluate, np.split(at.x, 2)
        g = self._split(evaluate("event_slopes", *halves, *self._conditions(at))[at.event])
        start = _Point(at.row, self.t[at.row], self.x[at.row], at.event)
        before = np.split(start.x, 2)
        value = evaluate("events", *before, *self._conditions(start))[at.event]
        speed = rate(g.x) + g.t[0]
        if abs(speed) * self.h <= max_fraction * abs(value):
            raise MotionError(
                f"event '{self.info.events[at.event]}' grazes zero at t = {at.time:.9g} s, "
                f"{state_text(*halves)}: its function hardly crosses zero there, so its time has "
                "no derivative: change the start or the parameters",
                "not finite",
            )
        return _Bars(*(-part / speed for part in g))

    def jump_slopes(self, at: _Point, weights: Array) -> _Bars:
        """Return the derivatives of weights (k, 2 nq) times the state after a jump at an event."""
        info, count = self.info, len(self.info.events)
        zeros = np.zeros((len(weights), info.nu + len(info.parameters)))
        along = np.ascontiguousarray(np.hstack([weights, zeros]), info.dtype)
        q, qd = np.split(np.tile(at.x, (len(weights), 1)), 2, axis=1)
        width, here = along.shape[1] + 1, self._conditions(at)
        bars = self.model.functions.product("jump_vjp", q, qd, along, count * width, here)
        return self._split(bars.reshape(len(weights), count, width)[:, at.event])

    def _conditions(self, at: _Point) -> tuple[float, Array | None, Array]:
        """Return the time, the inputs and the parameters at the end of a step."""
        return float(at.time), None if self.u is None else self.u[at.row], self.request.p

    def _split(self, slopes: Array) -> _Bars:
        """Return derivatives by [q, qd, u, p, t] as parts."""
        n, m = 2 * self.info.nq, self.info.nu
        x, u, p, t = np.split(slopes, [n, n + m, slopes.shape[-1] - 1], axis=-1)
        if self.u is None and u.any():
            raise ValueError(
                "an event function or a state jump depends on an input that follows a signal of "
                "the scene, and derivatives through both are not available: give u=, or write the "
                "formula of the signal in place of the input"
            )
        return _Bars(x, u, p, t)

    # --- reverse mode

    def pull_back(self, first: int, t: Array, x: Array, bars: Array) -> _Bars:
        """Return the derivatives of a function of rows after the steps from row `first` on.

        t (n,), x (n, 2 nq): the rows. bars (n, 2 nq): the derivatives with respect to x.
        """
        info, c, request = self.info, self.model.c, self.request
        sizes = 2 * info.nq, (len(t) - 1, info.nu), len(info.parameters), 2
        result = _Bars(*(np.zeros(size, info.dtype) for size in sizes))
        halves = [half for a in (x, bars) for half in np.split(a, 2, axis=1)]
        u = None if self.u is None else self.u[first:]
        arrays = [np.ascontiguousarray(a, info.dtype) for a in (*halves, t, request.p)]
        *rows, times, p = map(c.pointer, arrays)
        stages = info.method_table[request.method].stages
        work = np.empty(3 * (stages + 4) * info.nq, info.dtype)
        status = getattr(c.lib, f"{request.method}_adjoint")(
            c.pointer(result.x), c.pointer(result.x[info.nq :]), *map(c.pointer, result[1:]),
            *rows, t[0], 0.0, len(t) - 1, 1, times, c.pointer(u), 1, p, c.pointer(work),
        )  # fmt: skip
        if status:
            _refuse(STATUS[status], *np.split(x[0], 2))
        return result

    def pull_back_step(self, at: _Point, bar: Array) -> _Bars:
        """Return the derivatives of a function of the end of a step."""
        rows = np.array([self.t[at.row], at.time]), self.x[[at.row, at.row]]
        return self.pull_back(at.row, *rows, np.stack([0 * bar, bar]))

    def gradient(self, seeds: Array) -> RunGradient:
        """Return the gradient of a function of the results.

        seeds: the derivatives with respect to the results [t; q; qd], (m, 1 + 2 nq).
        """
        n, info, u = len(self.t), self.info, self.request.u
        bars = np.zeros((n, seeds.shape[1]))
        u_bar = np.zeros((1 + self.period[-1] if u is None else len(np.atleast_2d(u)), info.nu))
        p_bar = np.zeros(len(info.parameters))

        def add(row: int, part: _Bars, factor: float = 1.0) -> None:
            of_u = np.atleast_2d(part.u)
            np.add.at(u_bar, self.period[row : row + len(of_u)], factor * of_u)
            p_bar[:] += factor * part.p

        def fix_size(at: _Point, bar: Array) -> Array:
            """Return the derivatives by the end of a step of constant size, from [t; q; qd]."""

            def rate(weights: Array) -> float:
                return float(self.pull_back_step(at, weights).t[1])

            if at.event < 0:
                return bar[1:]
            slopes, factor = self.event_slopes(at, rate), rate(bar[1:]) + bar[0]
            add(at.row, slopes, factor)
            return np.asarray(bar[1:] + factor * slopes.x)

        is_row = self.places >= 0
        np.add.at(bars, self.places[is_row], seeds[is_row])
        for k in np.flatnonzero(~is_row & seeds.any(axis=1)).tolist():
            at = self.point(k)
            part = self.pull_back_step(at, fix_size(at, seeds[k]))
            add(at.row, part)
            bars[at.row] += np.append(part.t[0], part.x)
        bar = np.zeros(seeds.shape[1])
        for first, last in reversed(self.pieces):
            if last < n - 1:
                part = _Bars(*(x[0] for x in self.jump_slopes(self.ends[last], bar[None, 1:])))
                add(last - 1, part)
                bar = np.append(bar[0] + part.t, part.x)
            bars[last] += bar
            if last in self.ends:
                bars[last, 1:] = fix_size(self.ends[last], bars[last])
            piece = slice(first, last + 1)
            part = self.pull_back(first, self.t[piece], self.x[piece], bars[piece, 1:])
            add(first, part)
            bar = np.append(part.t[0] + bars[first, 0], part.x)
        q, qd = np.split(bar[1:], 2)
        u_bar = u_bar[:-1] if u is None else u_bar.reshape(u.shape)
        return RunGradient(*(x.astype(info.dtype) for x in (q, qd, u_bar, p_bar)))

    # --- forward mode

    def rates(self, at: _Point) -> Array:
        """Return the derivatives (2, 2 nq) of the end of a step by its two times."""
        units = np.eye(2 * self.info.nq)
        return np.transpose([self.pull_back_step(at, unit).t for unit in units])

    def propagate(self, first: int, t: Array, x: Array, S: Array) -> Array:
        """Return the derivatives (n, 1 + 2 nq, k) of rows after the steps from row `first` on.

        t (n,), x (n, 2 nq): the rows, of which the later ones have constant times. S: the
        derivatives of [t; q; qd] at the first row (1 + 2 nq, k). The k columns belong to the
        start, the inputs and the parameters.
        """
        n, m, request = 2 * self.info.nq, self.info.nu, self.request
        count = 2 if S[0].any() else len(t)  # a step from a row whose time varies
        q, qd = (np.ascontiguousarray(half) for half in np.split(x[:count], 2, axis=1))
        u = None if self.u is None else self.u[first : first + count]
        Phi, Gamma, E = self.model.integrator.propagate(
            (q, qd), t[:count], u, request.p, inf, request.method, has_rows=True
        )
        result = np.zeros((len(t), *S.shape))
        result[:count, 1:] = Phi @ S[1:]
        result[:count, 1:, n : n + m] += Gamma
        result[:count, 1:, n + m :] += E
        if count == 2 <= len(t) and S[0].any():
            step = _Point(first, t[1], x[1], -1)
            result[1, 1:] += np.outer(self.rates(step)[0], S[0])
            result[1:] = self.propagate(first + 1, t[1:], x[1:], result[1])
        result[0] = S
        return result

    def vary_size(self, at: _Point, S: Array) -> Array:
        """Return the derivatives of [t; q; qd] at an event, from those at a constant step size."""
        by_size = self.rates(at)[1]
        slopes = self.event_slopes(at, lambda weights: float(weights @ by_size))
        T = slopes.x @ S[1:]
        T[len(by_size) :] += np.concatenate([slopes.u, slopes.p])
        return np.vstack([T, S[1:] + np.outer(by_size, T)])

    def derivatives(self) -> Array:
        """Return the derivatives of the results [t; q; qd], (m, 1 + 2 nq, k)."""
        n, size = len(self.t), 2 * self.info.nq
        S = np.zeros((n, 1 + size, size + self.info.nu + len(self.info.parameters)))
        S[0, 1:] = np.eye(*S.shape[1:])[:size]
        for first, last in self.pieces:
            piece = slice(first, last + 1)
            S[piece] = self.propagate(first, self.t[piece], self.x[piece], S[first])
            if last in self.ends:
                S[last] = self.vary_size(self.ends[last], S[last])
            if last < n - 1:
                jump = self.jump_slopes(self.ends[last], np.eye(size))
                S[last + 1] = S[last]
                S[last + 1, 1:] = jump.x @ S[last, 1:] + jump.t * S[last, 0]
                S[last + 1, 1:, size:] += np.concatenate([jump.u, jump.p], axis=1)
        results = S[self.places]
        for k in np.flatnonzero(self.places < 0).tolist():
            at = self.point(k)
            rows = np.array([self.t[at.row], at.time]), np.stack([self.x[at.row], at.x])
            results[k] = self.propagate(at.row, *rows, S[at.row])[1]
            if at.event >= 0:
                results[k] = self.vary_size(at, results[k])
        return results

    def split(self, derivatives: Array) -> Sensitivity:
        """Return derivatives with columns for start, inputs and parameters as parts."""
        n, m = 2 * self.info.nq, self.info.nu
        parts = np.split(derivatives.astype(self.info.dtype), [n, n + m], axis=-1)
        return Sensitivity(*parts)
