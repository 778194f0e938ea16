"""Single steps of a compiled scene, and the number of fixed steps of a run."""

from __future__ import annotations

from math import ceil
from typing import Any

from numpy import dtype, empty
from numpy.typing import ArrayLike

from .arguments import (
    Array,
    Parameters,
    as_count,
    as_number,
    as_period,
    as_step_size,
    check_time,
    cut_table,
)
from .metadata import ModelInfo
from .package import warn
from .stability import beyond_end
from .status import STATUS, STATUS_MESSAGES, MotionError, state_text

_MOST = 2**60  # steps, so that C can return four times as many


class Stepping(ModelInfo):
    """A compiled scene with methods that compute single steps."""

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
        from_q, from_qd, at, moving = self._read(q, qd, many=False)
        h = self.h if h is None else as_step_size(h, self.dtype)
        inputs, p = self._input_pointers(u, params)
        address, real, null = self._c
        if out is None:
            both = empty((2, self.nq), self.dtype)
            ends, to_q, to_qd = (both[0], both[1]), address(real, both), null
        else:
            ends = self._pair(out, at.shape)
            to_q, to_qd = address(real, ends[0]), address(real, ends[1])
        step = self._loops[self._method(method)][0]
        code = step(to_q, to_qd, from_q, from_qd, as_number(t, "t"), h, inputs, p)
        if code:
            status = STATUS[code]
            raise MotionError(
                f"no step from t = {t:.9g}, {state_text(at, moving)}: {STATUS_MESSAGES[status]}",
                status,
            )
        return ends

    def _steps(self, h: float, duration: float | None, steps: int | None) -> int:
        """Return the number of fixed steps from `steps` or `duration`."""
        steps = None if steps is None else as_count(steps, "steps", 0)
        if steps is not None:
            if duration is not None:
                raise ValueError("steps: give steps or duration, not both")
            if steps > _MOST:
                shown = f"{steps:.3g}" if steps < 10**300 else "so many"
                raise ValueError(f"steps: {shown} are more than a run can count, {_MOST:.3g}")
            return steps
        time = self.duration if duration is None else as_number(duration, "duration")
        if words := beyond_end(h, time):
            warn(f"{self.name}: {words}")
        if time < 0:
            raise ValueError(f"duration: {duration} is not a time in s")
        if time / h > _MOST:
            raise ValueError(
                f"duration: {time:g} s are more steps of h = {h:g} s than a run can count, "
                f"{_MOST:.3g}: take a larger h, or a shorter duration"
            )
        # the first multiple of h that is not before the duration, rounding aside
        return ceil(time / h * (1 - 1e-12))

    def _steps_and_table(
        self, t0: float, h: float, steps: int, u: Any, control_period: float | None,
        duration: float | None, times: Array | None, axis: int = 0,
    ) -> tuple[Any, int]:  # fmt: skip
        """Return the inputs, and the number of steps for which a row of them is constant.

        A table for the duration is cut if the last output time is earlier. Raises ValueError if
        times t0 + k h are not distinct: in single precision at the start only, as the times of
        rows are in double precision.
        """
        if steps:
            check_time(self.dtype, t0, h, h)
            check_time(dtype(float), t0, steps * h, h)
        hold = min(as_period(control_period, h), max(steps, 2))  # a period may be beyond the run
        if times is not None and duration is not None:
            count = -(-self._steps(h, duration, None) // hold)
            u = cut_table(u, self.nu, count, -(-steps // hold), axis)
        return u, hold

    def _trajectory(self, *_: Any) -> Any:
        """Run by fixed steps from checked arguments; `Model` implements it."""
        raise NotImplementedError
