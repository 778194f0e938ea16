"""Rows of `check` about derivatives of accelerations: `linearize` and `sensitivity`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from eomc.verify.oracle import Vector

if TYPE_CHECKING:
    from eomc.verify.check import Comparison, State

LIMIT = 1e-6  # of what changes by all of the spread would make; differences are good to 1e-9
STENCIL = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
WIDTHS = (0.03, 0.003, 3e-4, 3e-5, 3e-6)  # of the differences, in parts of the spread


class Slopes:
    """The rows."""

    def __init__(self, check: Comparison) -> None:
        self.check, self.module, self.model = check, check.module, check.module._model

    def report(self) -> None:
        """Add them."""
        unit = "of differences of accelerations"
        self.check.row("linearize", LIMIT, unit, partial(self.largest, self.linear))
        if hasattr(self.model._lib, "sensitivity"):
            self.check.row("sensitivity", LIMIT, unit, partial(self.largest, self.sensitive))

    def largest(self, of: Callable[[State], float]) -> float:
        """The largest error over some states."""
        return float(np.max([of(e.state) for e in self.check.few(6)]))

    def held(self, s: State) -> State:
        """The state with its inputs held, as derivatives take them."""
        if not self.model.nu or s.u is not None:
            return s
        u = self.module.signal(s.q, s.qd, s.t, params=s.params)
        return replace(s, u=np.asarray(u, float))

    def linear(self, s: State) -> float:
        """A and B beside differences along each coordinate, velocity and input."""
        n, held = len(s.q), self.held(s)
        A, B = self.module.linearize(s.q, s.qd, u=s.u, t=s.t, params=s.params)
        upper = np.array_equal(A[:n], np.eye(n, 2 * n, n)) and not np.any(B[:n])
        spread = {"q": self.check.sampler.spread, "qd": self.check.sampler.speed}
        found = {"q": A[n:, :n], "qd": A[n:, n:]}
        if held.u is not None:
            found["u"], spread["u"] = B[n:], np.maximum(np.abs(held.u), 1.0)

        def moved(field: str, i: int, by: float) -> State:
            x = getattr(held, field).copy()
            x[i] += by
            return replace(held, **{field: x})

        errors = [
            self.column(
                matrix[:, i], float(spread[name][i]), partial(moved, name, i), found, spread
            )
            for name, matrix in found.items()
            for i in range(matrix.shape[1])
        ]
        return float(np.max(errors)) if upper else math.inf

    def sensitive(self, s: State) -> float:
        """The derivatives by each parameter beside differences."""
        held = self.held(s)
        E = self.module.sensitivity(s.q, s.qd, u=s.u, t=s.t, params=s.params)
        params = {**self.check.sampler.defaults, **(s.params or {})}
        spread = {"p": np.array([abs(x) or 1.0 for x in params.values()])}

        def moved(name: str, by: float) -> State:
            return replace(held, params={**params, name: params[name] + by})

        errors = [
            self.column(E[:, k], float(spread["p"][k]), partial(moved, name), {"p": E}, spread)
            for k, name in enumerate(params)
        ]
        return float(np.max(errors))

    def column(
        self, found: Vector, spread: float, moved: Callable[[float], State], matrices: Any,
        spreads: Any,
    ) -> float:  # fmt: skip
        """A column beside differences, by the best of some widths, in units of all changes."""
        size = sum(np.abs(m) @ spreads[name] for name, m in matrices.items())
        size = np.maximum(size, 1e-6 * np.max(size)) / spread
        errors = []
        for width in WIDTHS:
            h = width * spread
            slope = sum(
                weight * (self.at(moved(k * h)) - self.at(moved(-k * h))) for k, weight in STENCIL
            )
            off = np.abs(found - slope / h)
            with np.errstate(divide="ignore", invalid="ignore"):
                errors.append(float(np.max(np.where(off == 0, 0, off / size))))
        return min((x for x in errors if not math.isnan(x)), default=math.nan)

    def at(self, s: State) -> Vector:
        """The acceleration; nan where there is none."""
        try:
            return self.check.ask("acceleration", s)
        except ArithmeticError:
            return np.full(len(s.q), math.nan)
