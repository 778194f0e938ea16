"""Inputs of adaptive steps: followed or held throughout, or set anew at each control period."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from .arguments import Array, as_step_size, cut_table, machine_memory
from .laws import SampledSignal, asked
from .metadata import ModelInfo
from .status import PART

NO_PERIOD = (
    "u: a function is asked once a control period, and steps that fit a tolerance don't tell how "
    "long that is: give control_period=, in s"
)
_VALUE = 200  # bytes of what is held over a period, as it is kept


@dataclass(frozen=True)
class ZeroOrderHold:
    """What is held over one period after another: by a function u(t, q, qd), or by rows (n, nu)."""

    of: Callable[..., Any] | Array
    period: float  # s
    count: int  # of the run, the last of which may be shorter


def sample_zero_order_hold(times: Array, t0: float, period: float, values: Array) -> Array:
    """Which of values (..., n, nu) are held at times (m,), (..., m, nu): at a start its own."""
    starts = np.asarray(t0 + period * np.arange(values.shape[-2]), times.dtype)
    begun = np.searchsorted(starts, times, side="right") - 1
    return np.asarray(values[..., np.maximum(begun, 0), :])


def input_schedule(
    model: ModelInfo, u: Any, control_period: float | None, span: float, params: Any,
    duration: float | None = None,
) -> Array | ZeroOrderHold | None:  # fmt: skip
    """The inputs of a run by a tolerance as `InputSchedule` takes them, or a ValueError.

    duration: which a table may cover instead of the span, s.
    """
    period = None
    if control_period is not None:
        period = as_step_size(control_period, model.dtype, "control_period")
    if u is None:
        if period is None or not model.nu:
            return None
        return _few(
            model, ZeroOrderHold(SampledSignal(model, params), period, count_periods(span, period))
        )
    if not model.nu:
        raise ValueError("u: this scene has no inputs")
    if not callable(u):
        if period is not None and duration is not None:
            u = cut_table(u, model.nu, count_periods(duration, period), count_periods(span, period))
        if isinstance(u, Mapping):
            u = model._by_name(u)
        rows = model._numbers(u, "u")
        if rows.ndim == 1 and model.nu == 1 < rows.size:
            rows = rows[:, None]
        if rows.ndim < 2:
            return model._array(rows.reshape(-1), "u", model.nu).copy()
        rows = model._array(rows, "u", model.nu)
        if period is None:
            raise ValueError(
                f"u: shape {np.shape(u)}, expected ({model.nu},): one value an input; rows, each "
                "held over a control period, take control_period=, in s"
            )
        if len(rows) != (count := count_periods(span, period)):
            raise ValueError(
                f"u: {len(rows)} rows for {count} control periods of {period:g} s: give a row "
                f"each, or duration={len(rows) * period:g}"
            )
        u = rows.copy()
    if period is None:
        raise ValueError(NO_PERIOD)
    return _few(model, ZeroOrderHold(u, period, count_periods(span, period)))


def _few(model: ModelInfo, made: ZeroOrderHold) -> ZeroOrderHold:
    """The same, or a MemoryError where a run can't keep its rows."""
    count = made.count
    if count * (model._bytes(1) + _VALUE) > PART * machine_memory():
        raise MemoryError(
            f"control_period: the rows of {count:.3g} periods of {made.period:g} s don't fit in "
            "memory: take a longer one, or a shorter duration"
        )
    return made


def count_periods(span: float, period: float) -> int:
    """Periods in a span, the last of which may be shorter."""
    return max(ceil(span / period * (1 - 1e-12)), 1)


def period_end(k: int, t0: float, period: float, dtype: np.dtype[Any]) -> float:
    """Where the k-th period of a run ends, as the module's numbers hold it."""
    return float(dtype.type(t0 + (k + 1) * period))


class InputSchedule:
    """The inputs of a run on its way: what C takes now, and the time until which that holds."""

    def __init__(
        self,
        model: ModelInfo,
        u: Array | ZeroOrderHold | None,
        t0: float,
        t_end: float,
        q: Array,
        qd: Array,
    ) -> None:
        self.model, self.t0, self.t_end, self.stop = model, t0, t_end, t_end
        self.periods = u if isinstance(u, ZeroOrderHold) else None
        self.held: Any = None if self.periods else u
        self.values: list[Array] = []  # of each period
        if self.periods:
            self._next(t0, q, qd)

    @property
    def at(self) -> Any:
        """The address of what is held."""
        return self.model._pointer(self.held)

    def on(self, work: Any) -> bool:
        """Whether the run goes on at the state that it has reached, by the next inputs."""
        if work.t < self.stop:
            return True
        if self.stop >= self.t_end:
            return False
        x = np.frombuffer(self.model._ffi.buffer(work.x), self.model.dtype).copy()
        self._next(work.t, *x.reshape(2, -1))
        return True

    def _next(self, t: float, q: Array, qd: Array) -> None:
        """The inputs of the next period."""
        assert self.periods
        done, of, model = len(self.values), self.periods.of, self.model
        if callable(of):
            self.held = asked(of, model._inputs, t, q, qd)
        else:
            self.held = of[min(done, len(of) - 1)]  # of a run that was interrupted
        self.values.append(self.held)
        self.stop = self.t_end
        if done + 1 < self.periods.count:
            self.stop = min(period_end(done, self.t0, self.periods.period, model.dtype), self.t_end)

    @property
    def u(self) -> Any:
        """The inputs as a run keeps them: a function, or a copy of what was held."""
        of = self.periods.of if self.periods else self.held
        return of if of is None or callable(of) else of.copy()
