"""heyoka's adaptive Taylor integrator on a case of the library, for benchmarks/adaptive.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import heyoka
import numpy as np
import physics
import sympy

from eomc.model.system import System
from eomc.model.system import t as time
from eomc.verify import symbolic

Array = np.ndarray
SMALL = 4  # coordinates, up to which forms are searched without compact mode
SIMPLE = 400  # operations, up to which SymPy simplifies
FORMS = ("expanded", "simplified", "heyoka's own")


@dataclass(frozen=True)
class Options:
    """How an integrator is made. form: of the right-hand side."""

    form: str = "expanded"
    fast_math: bool = False
    compact_mode: bool = False

    def __str__(self) -> str:
        words = [self.form]
        words += ["fast_math"] if self.fast_math else []
        return ", ".join(words + (["compact_mode"] if self.compact_mode else []))


class Taylor:
    """The integrators of a system, by tolerance and options; parameters folded in as numbers."""

    def __init__(self, system: System, end: float) -> None:
        self.system, self.end, self.n = system, end, len(system.q)
        starts = [c.start for c in system.coordinates], [c.rate for c in system.coordinates]
        self.x0 = np.array([float(x) for half in starts for x in half])
        self.made = cache(self._made)

    @cached_property
    def forms(self) -> tuple[str, ...]:
        """Those of the right-hand side that differ."""
        kept = {str(self._right("expanded")): "expanded"}
        if all(sympy.count_ops(e) < SIMPLE for e in self._matrices):
            kept.setdefault(str(self._right("simplified")), "simplified")
        whole = not any(self.system.forces) and not self.system.kinetic.has(time)
        return (*kept.values(), *([FORMS[2]] if whole and self.n <= SMALL else []))

    def options(self) -> Iterator[Options]:
        """All that are worth a try."""
        for form in self.forms:
            for fast in (False, True):
                yield Options(form, fast)
                if self.n > SMALL:
                    yield Options(form, fast, True)

    @cached_property
    def _values(self) -> dict[Any, Any]:
        values = {p.symbol: sympy.Float(p.value) for p in self.system.parameters}
        return {k: sympy.Integer(int(x)) if x == int(x) else x for k, x in values.items()}

    @cached_property
    def _matrices(self) -> list[Any]:
        """The lower half of D, row by row, and tau - bias."""
        made, n = symbolic.derive(self.system), range(self.n)
        wanted = [made.D[i, j] for i in n for j in range(i + 1)]
        wanted += [made.tau[i] - made.bias[i] for i in n]
        return [sympy.expand(e.xreplace(self._values)) for e in wanted]

    def _right(self, form: str) -> list[Any]:
        if form == "simplified":
            return [sympy.simplify(e) for e in self._matrices]
        return self._matrices

    @cached_property
    def _names(self) -> dict[Any, Any]:
        known = [*self.system.q, *self.system.qd]
        x = heyoka.make_vars(*[f"x{i}" for i in range(2 * self.n)])
        return {**dict(zip(known, x, strict=True)), time: heyoka.time}

    def _told(self, e: Any) -> Any:
        if e == 0:
            return heyoka.expression(0.0)
        thirds = {x: sympy.Float(x) for x in e.atoms(sympy.Rational) if x.q & (x.q - 1)}
        return heyoka.from_sympy(e.xreplace(thirds), self._names)

    @cache  # noqa: B019  # few, and each as long as the benchmark
    def equations(self, form: str) -> list[tuple[Any, Any]]:
        """x' = f(x, t). One coordinate: divided; two: by Cramer's rule; more: by LDL^T."""
        n, x = self.n, list(self._names.values())[: 2 * self.n]
        if form == FORMS[2]:
            L = (self.system.kinetic - self.system.potential).xreplace(self._values)
            return list(heyoka.lagrangian(self._told(L), x[:n], x[n:]))
        wanted = self._right(form)
        D = iter(wanted[: -self.n])
        lower = [[next(D) for _ in range(i + 1)] for i in range(n)]
        tau = wanted[-n:]
        if all(lower[i][j] == 0 for i in range(n) for j in range(i)):
            rates = [self._told(sympy.expand(f / lower[i][i])) for i, f in enumerate(tau)]
        elif n == 2:
            (a,), (b, d) = ([self._told(e) for e in row] for row in lower)
            f, g = map(self._told, tau)
            over = 1.0 / (a * d - b * b)
            rates = [(d * f - b * g) * over, (a * g - b * f) * over]
        else:
            rates = physics.solve([[self._told(e) for e in row] for row in lower],
                                  [self._told(e) for e in tau])  # fmt: skip
        return list(zip(x, [*x[n:], *rates], strict=True))

    def _made(self, tol: float, options: Options) -> Any:
        return heyoka.taylor_adaptive(
            self.equations(options.form), self.x0, tol=tol, fast_math=options.fast_math,
            compact_mode=options.compact_mode,
        )  # fmt: skip

    def run(self, tol: float, options: Options) -> Callable[[], Array]:
        """A call that runs from the start to the end and returns q there, nan where it stops."""
        made = self.made(tol, options)

        def run() -> Array:
            made.time = 0.0
            made.state[:] = self.x0
            found = made.propagate_until(self.end)
            good = found[0] == heyoka.taylor_outcome.time_limit
            return made.state[: self.n] if good else np.full(self.n, math.nan)

        return run

    def steps(self, tol: float, options: Options) -> tuple[int, int]:
        """Its order and the steps of a run."""
        made = self.made(tol, options)
        made.time = 0.0
        made.state[:] = self.x0
        return made.order, made.propagate_until(self.end)[3]
