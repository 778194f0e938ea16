"""What an independent answer can be asked, and RK4 in plain Python on top of it.

`reference.Reference` answers from expressions written out, `jets.Jets` by Taylor arithmetic along
the definitions. Both take many states at once, as leading rows of their arguments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eomc.base.errors import EomcError
from eomc.model.system import System
from eomc.scene.formulas import suggest

Vector = NDArray[np.float64]
Values = tuple[Any, ...]  # of the parameters, in the system's order: floats, or one a row

MATRICES = ("D", "C")
SCALARS = ("kinetic", "potential", "energy", "jacobi", "power", "magnitude")


class Answer(ABC):
    """D qdd + bias = tau of a system, and what belongs to it, at given states.

    Where q is (b, nq), there are b states: qd is (b, nq) and u (b, nu) too, t and every value in
    params one number or (b,), and each answer has one row more in front.
    """

    system: System

    def terms(self, s: Mapping[str, Any]) -> float:
        """The sizes of the terms of K and P multiplied out, added up, at the arguments `s`.

        0 where they are not written out.
        """
        return 0.0

    @abstractmethod
    def _value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """What `evaluate` returns, of arguments that are complete."""

    def evaluate(
        self,
        name: str,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> Any:
        """The value of `name`: a float, an (nq,) or (nu,) vector or an (nq, nq) matrix.

        name: D, C, g, bias, tau, kinetic, potential, energy, jacobi, power or signals, as in
        `reference.derive`. q, qd: (nq,), m or rad per coordinate and their rates, qd None at
        rest; u: (nu,), None for the scene's signals; params: values in place of defaults. nan
        where a formula has no real value. Raises EomcError where params names no parameter.
        """
        q = np.asarray(q, float)
        qd = np.zeros_like(q) if qd is None else np.asarray(qd, float)
        return self._value(name, q, qd, t, u, self._values(params))

    def acceleration(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> Vector:
        """Solve D qdd = tau - bias: (nq,). nan where D is singular."""
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        return self._acceleration(q, qd, t, u, self._values(params))

    def step(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        h: float,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> tuple[Vector, Vector]:
        """One step of the classical Runge-Kutta method of order 4: q and qd at t + h.

        u None: the scene's signals at every stage; u given: held over the step.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        return self._step(q, qd, h, np.asarray(t, float), u, self._values(params))

    def simulate(
        self,
        q0: ArrayLike | None = None,
        qd0: ArrayLike | None = None,
        h: float | None = None,
        steps: int | None = None,
        every: int = 1,
        u: ArrayLike | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> tuple[Vector, Vector, Vector]:
        """Run from the start: t (n,) and q, qd (n, nq), rows every `every` steps and the last.

        With b states q and qd are (n, b, nq).
        """
        start = self.system.coordinates
        q = np.array([c.start for c in start] if q0 is None else q0, float)
        qd = np.array([c.rate for c in start] if qd0 is None else qd0, float)
        h = self.system.run.h if h is None else h
        steps = round(self.system.run.duration / h) if steps is None else steps
        values = self._values(params)
        rows = [(0.0, q, qd)]
        for n in range(steps):
            q, qd = self._step(q, qd, h, n * h, u, values)
            if (n + 1) % every == 0 or n + 1 == steps:
                rows.append(((n + 1) * h, q, qd))
        times, qs, qds = zip(*rows, strict=True)
        return np.array(times), np.array(qs), np.array(qds)

    @cached_property
    def _defaults(self) -> Values:
        return tuple(p.value for p in self.system.parameters)

    def _values(self, params: Mapping[str, Any] | None) -> Values:
        """Parameters in the system's order."""
        if not params:
            return self._defaults
        values = {p.name: p.value for p in self.system.parameters}
        for name in params:
            if name not in values:
                raise EomcError(f"'{name}' is not a parameter{suggest(name, values)}")
        return tuple((values | dict(params)).values())

    def _acceleration(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Vector:
        D, force = self._motion(q, qd, t, u, values)
        try:
            return np.asarray(np.linalg.solve(D, force[..., None])[..., 0])
        except np.linalg.LinAlgError:  # of one of the states at least
            found = np.full(force.shape, np.nan)
            for k in np.ndindex(force.shape[:-1]):
                with suppress(np.linalg.LinAlgError):
                    found[k] = np.linalg.solve(D[k], force[k])
            return found

    def _motion(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        """D and tau - bias."""
        D, bias, tau = (self._value(name, q, qd, t, u, values) for name in ("D", "bias", "tau"))
        return D, tau - bias

    def _step(
        self, q: Vector, qd: Vector, h: float, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        v1, a1 = qd, self._acceleration(q, qd, t, u, values)
        v2 = qd + h / 2 * a1
        a2 = self._acceleration(q + h / 2 * v1, v2, t + h / 2, u, values)
        v3 = qd + h / 2 * a2
        a3 = self._acceleration(q + h / 2 * v2, v3, t + h / 2, u, values)
        v4 = qd + h * a3
        a4 = self._acceleration(q + h * v3, v4, t + h, u, values)
        return (
            q + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4),
            qd + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4),
        )
