"""The reference for systems with parameters that jumps set: that of the system without them.

Discrete variables s have D = 1 and nothing else in their rows, and K contains s_dot**2/2 of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eomc.model.system import System
from eomc.verify.reference import Reference, Values, Vector

ROWS = ("g", "bias", "tau", "friction")
KINETIC = ("kinetic", "energy", "jacobi")


class DiscreteReference(Reference):
    """Reference of a system with discrete variables: parameters that jumps at events set.

    A reference is the independent evaluation of the equations in Python. system: the system, with
    the discrete variables as additional coordinates. core: the reference of the same system with
    the discrete variables as parameters.
    """

    def __init__(self, system: System, core: Reference) -> None:
        self.system, self.core = system, core
        names = [c.name for c in system.coordinates]
        self.continuous_indices = [k for k, name in enumerate(names) if name not in system.discrete]
        self.discrete_indices = [k for k, name in enumerate(names) if name in system.discrete]

    def terms(self, name: str, s: Mapping[str, Any]) -> float:
        """Return the sum of the absolute values of all terms of "energy" or "power" at a state.

        s: the arguments of `evaluate` by name. See `Reference.terms`.
        """
        q, qd = np.asarray(s["q"]), np.asarray(s["qd"])
        values = {self.system.coordinates[k].name: float(q[k]) for k in self.discrete_indices}
        params = {**(s.get("params") or {}), **values}
        own = {
            **s,
            "q": q[self.continuous_indices],
            "qd": qd[self.continuous_indices],
            "params": params,
        }
        added = float(np.sum(qd[self.discrete_indices] ** 2)) / 2 if name == "energy" else 0.0
        return self.core.terms(name, own) + added

    def _value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        value = np.asarray(self.core._value(name, *self._core_arguments(q, qd, t, u, values)))
        if name in KINETIC:
            value = value + np.sum(qd[..., self.discrete_indices] ** 2, axis=-1) / 2
        elif name in ROWS or name == "constraint_jacobian":
            value = self._with_discrete_columns(value)
        elif name in ("D", "C"):
            value = self._with_discrete_block(value, float(name == "D"))
        return value[()]

    def _motion(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        D, force = self.core._motion(*self._core_arguments(q, qd, t, u, values))
        return self._with_discrete_block(D, 1.0), self._with_discrete_columns(force)

    def _core_arguments(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector, Any, ArrayLike | None, Values]:
        """Return the arguments of the core reference, discrete variables among the parameters."""
        discrete = (q[..., k] for k in self.discrete_indices)
        return (
            q[..., self.continuous_indices],
            qd[..., self.continuous_indices],
            t,
            u,
            (*values, *discrete),
        )

    def _with_discrete_columns(self, columns: Vector) -> Vector:
        """Return the values with zeros for the discrete variables, (..., nq)."""
        result = np.zeros(
            (*columns.shape[:-1], len(self.continuous_indices) + len(self.discrete_indices))
        )
        result[..., self.continuous_indices] = columns
        return result

    def _with_discrete_block(self, matrix: Vector, diagonal: float) -> Vector:
        """Return the matrix (..., nq, nq) with `diagonal` on the discrete variables' diagonal."""
        result = np.swapaxes(
            self._with_discrete_columns(np.swapaxes(self._with_discrete_columns(matrix), -1, -2)),
            -1,
            -2,
        )
        result[..., self.discrete_indices, self.discrete_indices] = diagonal
        return result
