"""The independent answer where jumps set parameters: that of the system in which they are constant.

Discrete variables s have D = 1 and nothing else in their rows, and K has s_dot**2/2 of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eomc.model.system import System
from eomc.verify.oracle import Answer, Values, Vector

ROWS = ("g", "bias", "tau", "friction")
KINETIC = ("kinetic", "energy", "jacobi")


class Discrete(Answer):
    """The equations of `system`, from an answer for `discrete.constant` of it."""

    def __init__(self, system: System, core: Answer) -> None:
        self.system, self.core = system, core
        names = [c.name for c in system.coordinates]
        self.own = [k for k, name in enumerate(names) if name not in system.discrete]
        self.more = [k for k, name in enumerate(names) if name in system.discrete]

    def terms(self, name: str, s: Mapping[str, Any]) -> float:
        """As `Answer.terms`."""
        q, qd = np.asarray(s["q"]), np.asarray(s["qd"])
        values = {self.system.coordinates[k].name: float(q[k]) for k in self.more}
        params = {**(s.get("params") or {}), **values}
        own = {**s, "q": q[self.own], "qd": qd[self.own], "params": params}
        more = float(np.sum(qd[self.more] ** 2)) / 2 if name == "energy" else 0.0
        return self.core.terms(name, own) + more

    def _value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        found = np.asarray(self.core._value(name, *self._of_core(q, qd, t, u, values)))
        if name in KINETIC:
            found = found + np.sum(qd[..., self.more] ** 2, axis=-1) / 2
        elif name in ROWS or name == "constraint_jacobian":
            found = self._columns(found)
        elif name in ("D", "C"):
            found = self._square(found, float(name == "D"))
        return found[()]

    def _motion(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        D, force = self.core._motion(*self._of_core(q, qd, t, u, values))
        return self._square(D, 1.0), self._columns(force)

    def _of_core(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector, Any, ArrayLike | None, Values]:
        """The same arguments, discrete variables among the parameters."""
        more = (q[..., k] for k in self.more)
        return q[..., self.own], qd[..., self.own], t, u, (*values, *more)

    def _columns(self, found: Vector) -> Vector:
        """(..., nq) with zeros for the discrete variables."""
        whole = np.zeros((*found.shape[:-1], len(self.own) + len(self.more)))
        whole[..., self.own] = found
        return whole

    def _square(self, found: Vector, diagonal: float) -> Vector:
        """(..., nq, nq), likewise, with these numbers on their diagonal."""
        whole = np.swapaxes(self._columns(np.swapaxes(self._columns(found), -1, -2)), -1, -2)
        whole[..., self.more, self.more] = diagonal
        return whole
