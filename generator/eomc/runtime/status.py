"""Statuses of runs and calls, their messages, and the exceptions that report them."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

from .arguments import Array
from .package import reduced

PART = 0.4  # fraction of the memory that a run may fill; its rows are copied once at the end
FULL = "out of memory"  # status of a run that ends because its rows fill the memory
REMEDY = (
    f"rows and events fill {100 * PART:.0f} % of this machine's memory: keep fewer rows with "
    "times=, or, where events never cease, end sooner with duration="
)
STATUS = (
    "ok", "singular", "not finite", "no convergence", "accumulated", "locked", "interrupted",
    "too long",
)  # fmt: skip
STATUS_MESSAGES = {
    "singular": "D is not positive definite there, so no acceleration exists",
    "not finite": "the state would no longer be finite: the step may be too long, "
    "or the motion runs into a singularity",
    "no convergence": "the iteration for the step does not converge: take a smaller h",
    "locked": "no state near obeys the constraints: they contradict one another there, the "
    "position is singular, as that of a stretched leg is (eomc dof tells; guess a bent one), or "
    "the step is far too long",
    "interrupted": "interrupted",
    "too long": "it took max_evaluations= evaluations of accelerations before its end: give more, "
    "a looser tolerance, or stiff=True where the motion is stiff",
    FULL: REMEDY,
}


class MotionError(ArithmeticError):
    """Error that is raised if the acceleration or the next step does not exist at a state.

    Attributes
    ----------
    status : str
        The reason, in the words of a run's status: "singular", "not finite", "no convergence",
        "locked" and others.
    """

    def __init__(self, message: str, status: str) -> None:
        super().__init__(message)
        self.status = status

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("status.MotionError", str(self), self.status)

    def _render_traceback_(self) -> list[str]:
        """Return the text that IPython prints: the message without the traceback."""
        return [f"{type(self).__name__}: {self}"]


class Interrupted(KeyboardInterrupt):
    """KeyboardInterrupt that is raised on Ctrl-C during a simulation.

    Attributes
    ----------
    run : Trajectory or BatchTrajectory
        The run up to the interruption.
    """

    def __init__(self, run: Any) -> None:
        super().__init__(run.message)
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("status.Interrupted", self.run)

    def _render_traceback_(self) -> list[str]:
        """Return the text that IPython prints: the message without the traceback."""
        return [f"{type(self).__name__}: {self}"]


def refuse(status: str, q: Any, qd: Any, k: Any = 0, what: str = "") -> NoReturn:
    """Raise MotionError for a state, or for state number k of many, (n, nq).

    what: the reason; by default that of the status.
    """
    where = state_text(*(np.atleast_2d(x)[k] for x in (q, qd)))
    raise MotionError(f"at {where}: {what or STATUS_MESSAGES[status]}", status)


def check_finite(values: Array, axes: int, q: Any, qd: Any, what: str) -> None:
    """Raise MotionError for the first state at which a value is not finite.

    values: (..., n) for the states q and qd, with `axes` axes for each. what: the reason.
    """
    is_finite = np.atleast_1d(np.isfinite(values).all(axis=tuple(range(-axes, 0))))
    if not is_finite.all():
        refuse("not finite", q, qd, int(np.argmin(is_finite)), f"{what} is not finite there")


def state_text(q: Array, qd: Array) -> str:
    """Return a state q, qd as text for a message, such as "q = [0.1 2.], qd = [0. 1.]"."""

    def text(x: Array) -> str:
        return np.array2string(x + 0.0, precision=6, threshold=12)  # no -0

    return f"q = {text(q)}, qd = {text(qd)}"
