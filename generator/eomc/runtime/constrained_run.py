"""What a run under constraints has besides: what rows lack, multipliers, reactions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .arguments import Array
from .columns import ByName


class ConstrainedRun:
    """A part of `trajectory.Run`. singular_steps: behind so many a constraint depends on others.

    Its multiplier is 0 there, and the forces in the joints are not unique; the motion is right.
    first_singular: when the first of them ended, s; nan where there is none.
    """

    _model: Any
    _values: Callable[..., Array]
    _driven: Callable[..., Array]
    singular_steps: int = 0
    first_singular: float = float("nan")

    @property
    def constraints(self) -> Mapping[str, Array]:
        """What each constraint lacks along the run, (n,), by name: rounding."""
        names = self._model.constraint_names
        return ByName("constraints", names, self._values("constraints").T if names else ())

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """The multiplier of each constraint along the run, (n,), by name."""
        names = self._model.constraint_names
        found = self._driven("multipliers", self._model.multipliers).T if names else ()
        return ByName("multipliers", names, np.ascontiguousarray(found))

    @property
    def reactions(self) -> Mapping[str, Array]:
        """What each [[loop]] does to its second body along the run, by name, in the world's axes.

        Force and moment about the joint's point, (n, 6); in the plane (n, 3), force (2) and moment.
        """
        loops = self._model.loops
        if not loops:
            return ByName("reactions", (), ())
        # their multipliers may depend on the time, by signals or rows, where they do not themselves
        timed = self._model._timed & {"multipliers", "reactions"}
        found = self._driven(min(timed, default="reactions"), self._model._reactions)
        return ByName("reactions", loops, np.moveaxis(found, -2, 0))

    @property
    def _singular(self) -> str:
        """What is to be said of steps behind which a constraint depends on others, or ""."""
        if not self.singular_steps:
            return ""
        many = "a step ends" if self.singular_steps == 1 else f"{self.singular_steps} steps end"
        return (
            f"{many} where a constraint depends on others, first at t = {self.first_singular:.9g}: "
            "multipliers and reactions are not unique there"
        )
