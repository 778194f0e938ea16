"""Data of adaptive runs beyond the rows: step counts, events and the settings of the run."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from .arguments import Array
from .by_name import ByName
from .events import EventLog
from .initial_checks import infinite_at_start
from .input_schedule import sample_zero_order_hold
from .package import is_built_from_system, option
from .status import STATUS_MESSAGES, state_text
from .stepping import Stepping
from .trajectory import Run
from .trajectory_data import LEFT_OUT

_NONE = (np.empty(0, np.intc), np.empty((0, 1)))  # events
STEP_TOO_SHORT = (
    "no step is short enough to go on: forces grow without end there, as in a fall into a centre, "
    "or keep jumping: for friction by sign(x_dot) that sticks {}, or let events switch it; else a "
    "looser tolerance"
)
FRICTION_REMEDIES = (
    "take {}",
    "give its coordinate friction = in place of the force",  # where the scene has that
)


def _friction() -> str:
    """The option of a scene that adds Coulomb friction with sticking."""
    return (
        "System.make(..., friction={...})"
        if is_built_from_system()
        else option("friction", '"stick"')
    )


def failure_message(model: Stepping, status: str, fixed: str) -> str:
    """Return a sentence with the reason why a run ended with this status, and with a remedy.

    status: such as "singular". fixed: name of the method of fixed steps; "": adaptive steps.
    """
    if status == "no convergence" and not fixed:
        return STEP_TOO_SHORT.format(FRICTION_REMEDIES[bool(model._rows.modes)].format(_friction()))
    return STATUS_MESSAGES[status]


@dataclass(eq=False, repr=False)
class AdaptiveTrajectory(Run):
    """Data of an adaptive run and quantities that follow from them without another simulation.

    The attributes are described in the subclass `adaptive.AdaptiveRun`.
    """

    tol: float = field(kw_only=True)
    rejected: int = field(kw_only=True)
    stiff_steps: int = field(kw_only=True)
    _times: Array = field(kw_only=True)
    _t_end: float = field(kw_only=True)
    # rarely used fields are set after construction, whose time dominates that of short runs
    _h_most: float = field(default=0.0, init=False)
    _by: str = field(default="", init=False)  # the method of fixed steps
    _last: tuple[float, Array] = field(default=(0.0, _NONE[1]), init=False)  # t, [q; qd] reached
    _stiff: bool = field(default=False, init=False)
    # event indices (n,), rows of t, q, qd
    _event_data: tuple[Array, Array] = field(default=_NONE, init=False)
    stopped: str = field(default="", init=False)
    limit: float = field(default=float("nan"), init=False)
    _period: float = field(default=0.0, init=False)  # control period, s; 0 without one
    _period_inputs: Array | None = field(default=None, init=False)  # inputs of the periods, (n, nu)
    _periods: int = field(default=0, init=False)  # number of control periods in the run

    @property
    def t(self) -> Array:
        """Return the times of the rows, (n,), s."""
        return self._times

    @cached_property
    def _begin(self) -> Array:
        """q and qd at t0, (2, nq); by default the first row."""
        return np.array([self._rows[0][0], self._rows[1][0]])

    @property
    def message(self) -> str:
        """Return a sentence on the result of the run; for a failed run it states the reason."""
        progress = f"{self.steps} steps, {self.description}"
        if self.status == "ok":
            return progress
        if self.status == "not finite" and self.stopped:
            return f"event '{self.stopped}' jumps to no finite state at t = {self.t[-1]:.9g} s"
        if self.status == "accumulated":
            return (
                f"jumps follow one another ever sooner, up to t = {self.limit:.15g} s: there the "
                f"run ends, after {progress}"
            )
        why = infinite_at_start(self) or failure_message(self._model, self.status, self._by)
        where = state_text(self.q[-1], self.qd[-1]) if len(self) else ""
        end = self.t[-1] if len(self) else self.t0
        return f"stopped at t = {end:.9g} after {progress}, {where}: {why}"

    @cached_property
    def events(self) -> dict[str, EventLog]:
        """Return the occurrences of each event of the scene as a dict from name to `EventLog`.

        An `EventLog` has the times t (n,), s, and the states q, qd (n, nq) at the occurrences. At a
        state jump, the state is that before the jump.
        """
        which, rows = self._event_data
        nq, names = self._model.nq, self._model.events
        each = (rows[which == k] for k in range(len(names)))
        logs = (EventLog(x[:, 0], x[:, 1 : 1 + nq], x[:, 1 + nq :]) for x in each)
        return ByName("events", names, logs)

    @property
    def description(self) -> str:
        """Return the numbers of rejected steps and of Newton steps, and the tolerance, as text."""
        stiff = f", {self.stiff_steps} by Newton's method" if self.stiff_steps else ""
        return f"{self.rejected} rejected{stiff}, tolerance {self.tol:g}"

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps, tolerance {self.tol:g}>"

    def _with_rows(self, times: Array, rows: Array) -> Self:
        """Return a copy of the run with other times (n,) and rows (2, n, nq)."""
        run = copy(self)
        run._begin = self._begin
        for name in ("q", "qd", "outputs"):  # cached properties
            run.__dict__.pop(name, None)
        run._rows, run._times, run._energy = rows, times, None
        run._update_applied_inputs()
        return run

    def _update_applied_inputs(self) -> None:
        """Set the inputs that are applied at each row (zero-order hold)."""
        if self._period_inputs is not None:
            self._applied = sample_zero_order_hold(
                self._times, self.t0, self._period, self._period_inputs
            )

    def _repeat(self, parts: int, every: int, nudge: Array | None, progress: Any) -> Run:
        raise ValueError("an adaptive run has no steps of one size")

    def _to_arrays(self) -> dict[str, Any]:
        own = {
            "tol": self.tol, "rejected": self.rejected, "stiff_steps": self.stiff_steps,
            "times": self.t, "h_most": self._h_most, "stiff": self._stiff, "begin": self._begin,
            "t_end": self._t_end, "which": self._event_data[0],
            "event_rows": self._event_data[1], "stopped": self.stopped, "limit": self.limit,
            "period": self._period, "values": self._period_inputs, "by": self._by,
            "periods": self._periods,
        }  # fmt: skip
        return super()._to_arrays() | own

    @classmethod
    def _from_arrays(cls, model: Stepping, arrays: Mapping[str, Any], **own: Any) -> Self:
        held, values = arrays.get("held"), arrays.get("values")
        u = held if values is None or held is not None else LEFT_OUT
        run = cls(
            model, arrays["t0"], (arrays["q"], arrays["qd"]), arrays["h"], arrays["steps"],
            arrays["status"], arrays["params"], 1, u, arrays["method"], arrays["evaluations"],
            tol=arrays["tol"], rejected=arrays["rejected"],
            stiff_steps=arrays.get("stiff_steps", 0), _times=arrays["times"],
            _t_end=arrays["t_end"],
        )  # fmt: skip
        run._h_most, run._stiff = arrays["h_most"], bool(arrays.get("stiff", False))
        run._by = arrays.get("by", "")
        run._begin, run._event_data = arrays["begin"], (arrays["which"], arrays["event_rows"])
        run.stopped, run.limit = arrays["stopped"], arrays["limit"]
        run._period, run._period_inputs = arrays.get("period", 0.0), values
        run._periods = arrays.get("periods", 0 if values is None else len(values))
        run._update_applied_inputs()
        return run

    def _state(self) -> dict[str, Any]:
        state = super()._state() | {"_times": self._times}
        state.pop("events", None)
        return state

    def _settings(self) -> tuple[Any, ...]:
        return (*super()._settings(), self.tol, self._times.tolist())
