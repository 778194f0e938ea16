"""Residuals, multipliers and reactions of runs with constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .arguments import Array
from .by_name import ByName

_MAX_ROUNDINGS = (
    2.0**26
)  # residuals above this number of roundings of their terms violate a constraint
_MIN_SCALE = 1e-9  # smallest scale of the terms


class ConstrainedRun:
    """Mixin of `trajectory.Run` with residuals, multipliers and reactions of constraints.

    Attributes
    ----------
    singular_steps : int
        Number of steps that end at a singular position, where a constraint equation depends on the
        others. Its multiplier is large or 0 there, and joint forces are not unique. The motion is
        correct nevertheless.
    first_singular : float
        End time of the first of these steps, s; nan if there is none.
    """

    _model: Any
    _evaluate: Callable[..., Array]
    _evaluate_with_inputs: Callable[..., Array]
    _params: Array
    q: Any
    qd: Any
    t: Any
    status: str
    singular_steps: int = 0
    first_singular: float = float("nan")

    @property
    def constraints(self) -> Mapping[str, Array]:
        """Return the residual of each constraint equation as a dict from name to array (n,).

        The array has a value for each row. A residual is 0 if the equation is satisfied; its unit
        is that of the equation. Raises KeyError for unknown names.
        """
        names = self._model.constraint_names
        return ByName(
            "constraints", names, self._evaluate(self._model.constraints).T if names else ()
        )

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """Return the Lagrange multiplier of each constraint as a dict from name to array (n,).

        The array has a value for each row; nan where the multiplier does not exist. Raises KeyError
        for unknown names.
        """
        names = self._model.constraint_names
        values = self._evaluate_with_inputs(self._model._multipliers).T if names else ()
        return ByName("multipliers", names, np.ascontiguousarray(values))

    @property
    def reactions(self) -> Mapping[str, Array]:
        """Return the reaction of each loop's joint on its second body, by the loop's name.

        A loop is a [[loop]] of the scene: a joint that closes a kinematic chain. Its reaction is
        the force, N, and the moment about the joint's point, N m, along the axes of the world, at
        all rows: an array (n, 6). In plane scenes the array is (n, 3), with two components of the
        force and the moment.
        """
        loops = self._model.loops
        if not loops:
            return ByName("reactions", (), ())
        values = self._evaluate_with_inputs(self._model._reactions)
        return ByName("reactions", loops, np.moveaxis(values, -2, 0))

    @property
    def _broken(self) -> str:
        """Return a message on a constraint that is violated at the end of the run, or ""."""
        model, names = self._model, self._model.constraint_names
        left_out = (
            self.singular_steps or model._rows.redundant
        )  # steps satisfy all other constraints
        if not left_out or not len(self.q) or self.status != "ok":
            return ""
        q, qd, t, p = self.q[-1], self.qd[-1], float(self.t[-1]), self._params
        sizes = np.abs(model.constraint_jacobian(q, t=t, params=p)).astype(float)
        for what, x in (("constraints", q), ("constraint_rates", qd)):
            off = np.abs(getattr(model, what)(q, qd, t, p)).astype(float)
            share = off / np.maximum(sizes @ (np.abs(x) + np.max(np.abs(x))), _MIN_SCALE)
            worst = int(np.argmax(share))
            if share[worst] > _MAX_ROUNDINGS * float(np.finfo(model.dtype).eps):
                rate = "the rate of " if what != "constraints" else ""
                return (
                    f"{rate}{names[worst]} is {off[worst]:.3g} at the end, not 0: constraints "
                    "contradict one another, and this motion does not obey them all"
                )
        return ""

    @property
    def _singular(self) -> str:
        """Return a message on violated or dependent constraint equations; "" if there are none."""
        if broken := self._broken:
            return broken
        if not self.singular_steps:
            return ""
        many = "a step ends" if self.singular_steps == 1 else f"{self.singular_steps} steps end"
        return (
            f"{many} where a constraint depends on others, first at t = {self.first_singular:.9g}: "
            "multipliers and reactions are not unique there"
        )
