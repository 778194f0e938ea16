"""Inputs of runs: constants, tables, signals, and functions of the time and the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from .arguments import Array, as_step_size, cut_table, machine_memory
from .interfaces import CompiledModel
from .package import warn
from .requests import SimulationArguments
from .status import PART

NO_PERIOD = (
    "u: a function is called once in each control period, and adaptive steps have no fixed "
    "length: give control_period=, in s"
)
_VALUE = 200  # bytes of the stored inputs of one period


def evaluate_law(
    law: Callable[..., Any], inputs: Callable[[Any], Any], t: float, q: Array, qd: Array
) -> Array:
    """Call a user's function law(t, q, qd) and return the inputs (nu,) that it computes.

    inputs: function that checks the returned value and converts it to an array. t: time, s. q, qd:
    state (nq,). An exception in the law gets a note with the time and the state. An invalid result
    raises ValueError or TypeError.
    """
    try:
        try:
            returned = law(t, q.copy(), qd.copy())
        except TypeError as fault:
            if fault.__traceback__ and fault.__traceback__.tb_next:  # raised inside the function
                raise
            raise TypeError(f"u: is called as u(t, q, qd), and {fault}") from None
        try:
            inputs_array = inputs(returned)
        except ValueError as fault:
            wrong = str(fault).removeprefix("u: ")
            raise ValueError(f"u: what the function returned: {wrong}") from None
    except Exception as fault:
        fault.add_note(f"u was called at t = {t:.9g} s, q = {q}, qd = {qd}")
        raise
    if inputs_array is None:
        raise ValueError("u: the function returned None, not the inputs")
    return np.array(inputs_array)


def warn_called_each_step(model: CompiledModel) -> None:
    """Issue a warning, once for each model, that calling a Python function in each step is slow."""
    if "u" not in model.integrator.warned:
        model.integrator.warned.add("u")
        warn(
            f"{model.info.name}: u is a Python function, called before each step: some hundred "
            "times "
            "slower than a table (steps, nu) or the scene's own signal"
        )


class FeedbackLaw:
    """A user's function u(t, q, qd) that a run by fixed steps calls once in each control period.

    The inputs that apply at each row of the run are stored. law: the function. inputs: function
    that converts and checks its result. every: number of steps between two rows. hold: number of
    steps of a control period.
    """

    def __init__(
        self, law: Callable[..., Any], inputs: Callable[[Any], Any], every: int, hold: int
    ) -> None:
        self.law, self.inputs, self.every, self.hold = law, inputs, every, hold
        self.calls, self.values = 0, list[Array]()
        self.last: Any = None

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Return, and store, the inputs (nu,) of the control period that begins at time t, s."""
        self.last = evaluate_law(self.law, self.inputs, t, q, qd)
        self.calls += 1
        rows = -(-self.calls * self.hold // self.every)  # of the run before the next call
        self.values += [self.last.copy()] * (rows - len(self.values))
        return self.last  # type: ignore[no-any-return]

    def rows(self, count: int, width: int) -> Array:
        """Return the stored inputs that apply from each row of the run on, (count, width).

        count: number of rows. width: number of inputs. Values are nan if the function has not been
        called.
        """
        last = np.full(width, np.nan) if self.last is None else self.last
        return np.array([*self.values, last][:count], last.dtype)


class SampledSignal:
    """The scene's input signals as a function u(t, q, qd).

    A run with a control period calls it once in each period and holds the result constant.
    """

    def __init__(self, model: CompiledModel, params: Any) -> None:
        self.model, self.params = model, params

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Return the scene's signals (nu,) at time t, s, and state q, qd."""
        values: Array = self.model.functions.signal(q, qd, t, self.params)
        return values


@dataclass(frozen=True)
class ZeroOrderHold:
    """Inputs that are constant over each control period.

    Attributes
    ----------
    source : callable or (n, nu) array
        Function u(t, q, qd) that is called at the start of each period, or an array with a row for
        each period.
    period : float
        Control period, s.
    count : int
        Number of periods of the run. The last period may be shorter.
    """

    source: Callable[..., Any] | Array  # rows: (n, nu)
    period: float  # s
    count: int  # of the run, the last of which may be shorter


def sample_zero_order_hold(times: Array, t0: float, period: float, values: Array) -> Array:
    """Return the values at times (m,) of inputs that are constant over periods, (..., m, nu).

    values: inputs (..., n, nu). Row k applies from the time t0 + k period until row k + 1 applies.
    times, t0, period: in s.
    """
    starts = np.asarray(t0 + period * np.arange(values.shape[-2]), times.dtype)
    index = np.searchsorted(starts, times, side="right") - 1
    return np.asarray(values[..., np.maximum(index, 0), :])


def input_schedule(
    model: CompiledModel, options: SimulationArguments, control_period: float | None, span: float
) -> Array | ZeroOrderHold | None:
    """Check the inputs of an adaptive run and convert them for `InputSchedule`.

    Parameters
    ----------
    options : SimulationArguments
        Arguments of the run. A table of inputs may cover the given duration instead of `span`, if
        the run ends earlier.
    control_period : float or None
        Control period, s.
    span : float
        Time from the start of the run to its end, s.

    Returns
    -------
    None, (nu,) array or ZeroOrderHold
        None for the scene's signals, an array for constant inputs, else a ZeroOrderHold.

    Raises
    ------
    ValueError
        If the inputs are invalid or do not fit the number of periods.
    MemoryError
        If the inputs of all periods do not fit in memory.
    """
    u, duration, period = options.u, options.duration, None
    if control_period is not None:
        period = as_step_size(control_period, model.info.dtype, "control_period")
    if u is None:
        if period is None or not model.info.nu:
            return None
        return _check_memory(
            model,
            ZeroOrderHold(
                SampledSignal(model, options.params), period, count_periods(span, period)
            ),
        )
    if not model.info.nu:
        raise ValueError("u: this scene has no inputs")
    if not callable(u):
        if period is not None and duration is not None:
            u = cut_table(
                u, model.info.nu, count_periods(duration, period), count_periods(span, period)
            )
        if isinstance(u, Mapping):
            u = model.arguments.inputs_by_name(u)
        rows = model.arguments.numbers(u, "u")
        if rows.ndim == 1 and model.info.nu == 1 < rows.size:
            rows = rows[:, None]
        if rows.ndim < 2:
            return model.arguments.array(rows.reshape(-1), "u", model.info.nu).copy()
        rows = model.arguments.array(rows, "u", model.info.nu)
        if period is None:
            raise ValueError(
                f"u: shape {np.shape(u)}, expected ({model.info.nu},): one value an input; "
                "rows, each "
                "constant over a control period, take control_period=, in s"
            )
        if len(rows) != (count := count_periods(span, period)):
            raise ValueError(
                f"u: {len(rows)} rows for {count} control periods of {period:g} s: give a row "
                f"each, or duration={len(rows) * period:g}"
            )
        u = rows.copy()
    if period is None:
        raise ValueError(NO_PERIOD)
    return _check_memory(model, ZeroOrderHold(u, period, count_periods(span, period)))


def _check_memory(model: CompiledModel, hold: ZeroOrderHold) -> ZeroOrderHold:
    """Return `hold`; raise MemoryError if the inputs of its periods do not fit in memory."""
    count = hold.count
    if count * (model.info.row_bytes(1) + _VALUE) > PART * machine_memory():
        raise MemoryError(
            f"control_period: the rows of {count:.3g} periods of {hold.period:g} s don't fit in "
            "memory: take a longer one, or a shorter duration"
        )
    return hold


def count_periods(span: float, period: float) -> int:
    """Return the number of control periods, at least 1, that begin within a time span.

    The last period may be shorter. span, period: in s.
    """
    return max(ceil(span / period * (1 - 1e-12)), 1)


def period_end(k: int, t0: float, period: float, dtype: np.dtype[Any]) -> float:
    """Return the end time of control period k, s, rounded to the module's number type `dtype`.

    t0: start of the run, s; the first period is k = 0.
    """
    return float(dtype.type(t0 + (k + 1) * period))


class InputSchedule:
    """Inputs of an adaptive run in progress.

    u: the inputs as `input_schedule` returns them. t0, t_end: start and end of the run, s. q, qd:
    initial state.

    Attributes
    ----------
    current : (nu,) array or None
        Present inputs; None for the scene's signals.
    stop : float
        Time until which `current` applies, s.
    values : list of (nu,) arrays
        Inputs of each control period so far.
    """

    def __init__(
        self,
        model: CompiledModel,
        u: Array | ZeroOrderHold | None,
        t0: float,
        t_end: float,
        q: Array,
        qd: Array,
    ) -> None:
        self.model, self.t0, self.t_end, self.stop = model, t0, t_end, t_end
        self.periods = u if isinstance(u, ZeroOrderHold) else None
        self.current: Any = None if self.periods else u
        self.values: list[Array] = []  # of each period
        if self.periods:
            self._next(t0, q, qd)

    @property
    def address(self) -> Any:
        """Pointer to the present inputs, for C; NULL if C evaluates the scene's signals."""
        return self.model.c.pointer(self.current)

    def advance(self, work: Any) -> bool:
        """Compute the inputs of the next control period if the present one has ended.

        Return False at the end of the run, else True. work: workspace of the C function, which
        contains the current time and state.
        """
        if work.t < self.stop:
            return True
        if self.stop >= self.t_end:
            return False
        x = np.frombuffer(self.model.c.ffi.buffer(work.x), self.model.info.dtype).copy()
        self._next(work.t, *x.reshape(2, -1))
        return True

    def _next(self, t: float, q: Array, qd: Array) -> None:
        """Set the inputs of the next period."""
        assert self.periods
        index, source, model = len(self.values), self.periods.source, self.model
        if callable(source):
            self.current = evaluate_law(source, model.arguments.inputs, t, q, qd)
        else:
            # a run that was interrupted has fewer rows than periods
            self.current = source[min(index, len(source) - 1)]
        self.values.append(self.current)
        self.stop = self.t_end
        if index + 1 < self.periods.count:
            self.stop = min(
                period_end(index, self.t0, self.periods.period, model.info.dtype), self.t_end
            )

    @property
    def u(self) -> Any:
        """The inputs in the form that a run stores: None, a function, or a copy of the values."""
        source = self.periods.source if self.periods else self.current
        return source if source is None or callable(source) else source.copy()
