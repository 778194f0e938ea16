"""Rows of `check` about outputs: in eighty digits, their rates by differences along the motion.

Nothing is differentiated as a formula: q(s) = q + qd s + qdd s^2/2, formulas and definitions are
evaluated as they stand, and dot(e) is (e(h) - e(-h))/2h. Accelerations and multipliers, which other
rows look at, are the module's own; slopes of multipliers are differences of the reference's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from eomc.model.numeric import compiled
from eomc.model.system import System, dot, symbol, t
from eomc.verify import derivatives
from eomc.verify.comparison import Comparison
from eomc.verify.oracle import Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import NUDGE, Expected, State, ask, nudged

DIGITS = 80  # three differences leave some thirty
WIDTH = mpmath.mpf(10) ** -15  # of differences
SLOPE_LIMIT = 1e-9  # of a row's largest derivative
OF_MULTIPLIERS = 1e-6  # likewise, where an output reads multipliers
STATES = 4
_NONE: Vector = np.zeros(0)

_NAMES = {"Min": min, "Max": max, "Heaviside": lambda x, middle=0.5: middle if x == 0 else +(x > 0)}


def report(of: Comparison) -> None:
    """Add the rows of a scene that has outputs."""
    formulas = Formulas(of.system)
    limit = max(OF_MULTIPLIERS if formulas.multipliers else SLOPE_LIMIT, LIMIT * of.eps)
    for module, form in of.forms:
        of.row(f"{form}outputs", LIMIT, "units of rounding", partial(_values, of, module, formulas))
        if of.system.run.needs_derivatives:
            unit, slopes = "of the largest derivative", partial(_slopes, of, module, formulas)
            of.row(f"{form}outputs: C, D", limit, unit, slopes)
            if of.system.run.linearize == "parameters" and of.system.parameters:
                by_parameters = partial(_slopes, of, module, formulas, by_parameters=True)
                of.row(f"{form}outputs: by parameters", limit, unit, by_parameters)


def _values(of: Comparison, module: Any, formulas: Formulas) -> float:
    """The outputs at some states, with the module's own accelerations and multipliers."""

    def found(s: State) -> Vector:
        return np.asarray(module.output(s.q, s.qd, s.t, s.u, s.params), float)

    return apart(of, module, formulas, found)


def apart(
    of: Comparison, module: Any, formulas: Formulas, found: Callable[[State], Vector]
) -> float:
    """What a function of the module's finds at some states beside formulas, in units."""

    def error(e: Expected) -> float:
        s = _held(of, module, e.state)
        value = found(s)
        near = [found(x) for x in nudged(s, of.sampler.defaults)]
        size = np.abs(value) + np.nansum([np.abs(x - value) / NUDGE for x in near], axis=0)
        qdd, forces = _solved(module, s)
        exact = formulas.at(s, qdd, forces)
        # terms that cancel against an acceleration leave its rounding error
        for k in range(len(qdd)):
            moved = np.where(np.arange(len(qdd)) == k, 1 + NUDGE, 1.0) * qdd
            size += np.nan_to_num(np.abs(formulas.at(s, moved, forces) - exact) / NUDGE)
        real = np.isfinite(value) | np.isfinite(exact)  # sqrt(x) of x < 0 is neither
        return of.units(value[real], exact[real], size[real]) if np.any(real) else 0.0

    return of.largest(error, STATES)


def _slopes(of: Comparison, module: Any, formulas: Formulas, by_parameters: bool = False) -> float:
    """Compare C and D, or dy/dp, with differences of the outputs, through A, B or E."""

    def error(e: Expected) -> float:
        s = _held(of, module, e.state)
        n, held = len(s.q), {"u": s.u, "t": s.t, "params": s.params}
        if by_parameters:
            solved, found = (
                np.asarray(x, float) for x in module.sensitivity(s.q, s.qd, outputs=True, **held)
            )
        else:
            A, B, C, D = (
                np.asarray(x, float) for x in module.linearize(s.q, s.qd, outputs=True, **held)
            )
            solved, found = np.hstack([A[n:], B[n:]]), np.hstack([C, D])
        slopes, m = formulas.slopes(s, *_solved(module, s), by_parameters), found.shape[1]
        own, by_qdd, by_force = np.split(slopes, [m, m + n], axis=1)
        least: Vector = np.full(
            (1, 1), np.inf
        )  # of all widths of differences: what is wrong is so at each
        for forces in (
            _of_multipliers(of, s, by_parameters) if formulas.multipliers else [by_force[:0]]
        ):
            exact, sizes = own + by_qdd @ solved, abs(own) + abs(by_qdd) @ abs(solved)
            if formulas.multipliers:
                exact, sizes = exact + by_force @ forces, sizes + abs(by_force) @ abs(forces)
            off = np.abs(found - exact) / (np.max(sizes, axis=1, keepdims=True) + 1e-300)
            least = np.fmin(least, np.where(np.isfinite(found) | np.isfinite(exact), off, 0.0))
        return float(np.max(least, initial=0))

    return of.largest(error, 2)


def _of_multipliers(of: Comparison, s: State, by_parameters: bool) -> Iterator[Vector]:
    """Derivatives of the multipliers, by differences of several widths.

    With respect to q, qd and u, (nc, 2 nq + nu), or to the parameters, (nc, np).
    """
    first = 2 * len(s.q) + len(of.system.inputs)
    given = (of.reference, s, of.sampler.scale, of.sampler.defaults, "multipliers")
    for slopes, _ in derivatives.by_differences(*given):
        yield slopes[:, first:] if by_parameters else slopes[:, :first]


def _solved(module: Any, s: State) -> tuple[Vector, Vector]:
    """The module's accelerations and multipliers."""
    rows = getattr(module, "constraint_names", ())
    return ask(module, "acceleration", s), ask(module, "multipliers", s) if rows else np.zeros(0)


def _held(of: Comparison, module: Any, s: State) -> State:
    """The state with inputs that don't follow it."""
    if s.u is not None or not of.system.inputs:
        return s
    return replace(s, u=np.asarray(module.signal(s.q, s.qd, s.t, s.params), float))


@dataclass
class Formulas:
    """The outputs of a system, evaluated as they stand."""

    system: System
    _compiled: dict[Expr, tuple[Callable[..., Any], Sequence[Symbol], Sequence[Expr]]] = field(
        default_factory=dict
    )

    @cached_property
    def multipliers(self) -> tuple[Symbol, ...]:
        """Those of all constraints, where an output reads one."""
        read = {x for o in self.system.outputs for x in o.formula.free_symbols}
        found = tuple(c.multiplier for c in self.system.constraints)
        return found if read & {*found} else ()

    def at(self, s: State, qdd: Vector, forces: Vector = _NONE) -> Vector:
        """(ny,): at a state with inputs, accelerations and multipliers."""
        with mpmath.workdps(DIGITS):
            return np.array([float(y) for y in self._values(self._given(s, qdd, forces))])

    def slopes(
        self, s: State, qdd: Vector, forces: Vector = _NONE, by_parameters: bool = False
    ) -> Vector:
        """Derivatives of the outputs by differences, (ny, 3 nq + nu + nc).

        With respect to q, qd, u, q̈ and the multipliers that are read; to parameters in place of q,
        qd, u where `by_parameters`.
        """
        system = self.system
        own = (*system.q, *system.qd, *system.u)
        if by_parameters:
            own = tuple(p.symbol for p in system.parameters)
        with mpmath.workdps(DIGITS):
            given, columns = self._given(s, qdd, forces), []
            for x in (*own, *system.qdd, *self.multipliers):
                ends = [self._values({**given, x: given[x] + h}) for h in (WIDTH, -WIDTH)]
                columns.append([float((a - b) / (2 * WIDTH)) for a, b in zip(*ends, strict=True)])
        return np.array(columns).T

    def _given(self, s: State, qdd: Vector, forces: Vector) -> dict[Symbol, Any]:
        system = self.system
        given = dict(zip((*system.q, *system.qd, *system.qdd), (*s.q, *s.qd, *qdd), strict=True))
        given |= dict(zip(system.u, () if s.u is None else s.u, strict=True))
        given |= dict(zip(self.multipliers, forces, strict=bool(self.multipliers)))
        given |= {symbol(n): v for n, v in (s.params or self._defaults).items()} | {t: s.t}
        return {name: mpmath.mpf(float(value)) for name, value in given.items()}

    @property
    def _defaults(self) -> dict[str, float]:
        return {p.name: p.value for p in self.system.parameters}

    def _values(self, given: Mapping[Symbol, Any]) -> list[Any]:
        motion = _Motion(self, given)
        return [_real(motion, o.formula) for o in self.system.outputs]

    def compiled(self, e: Expr) -> tuple[Callable[..., Any], Sequence[Symbol], Sequence[Expr]]:
        """A formula as a function of its symbols and of the rates in it."""
        if e not in self._compiled:
            rates = [d for d in e.atoms(dot) if not any(d != o and o.has(d) for o in e.atoms(dot))]
            stand_ins = [sympy.Dummy() for _ in rates]
            bare = e.xreplace(dict(zip(rates, stand_ins, strict=True)))
            symbols = sorted(bare.free_symbols - set(stand_ins), key=str)
            f = compiled([*symbols, *stand_ins], bare, [_NAMES, "mpmath"])
            self._compiled[e] = f, symbols, [d.args[0] for d in rates]
        return self._compiled[e]


def _real(motion: _Motion, formula: Expr) -> Any:
    """The value of a formula; nan where that is not real, or a pole."""
    try:
        value = mpmath.mpmathify(motion.value(formula, mpmath.mpf(0)))
    except (ZeroDivisionError, ValueError):
        return mpmath.mpf("nan")
    return value.real if value.imag == 0 else mpmath.mpf("nan")


class _Motion:
    """What formulas are near one state, as functions of the time since then."""

    def __init__(self, formulas: Formulas, given: Mapping[Symbol, Any]) -> None:
        self.formulas, self.given, system = formulas, given, formulas.system
        self.definitions = dict(system.definitions)
        self.rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True))}
        self.known: dict[tuple[Symbol, Any], Any] = {}

    def value(self, e: Expr, time: Any) -> Any:
        """Of a formula."""
        f, symbols, rates = self.formulas.compiled(e)
        ends = [[self.value(x, time + h) for h in (WIDTH, -WIDTH)] for x in rates]
        slopes = ((a - b) / (2 * WIDTH) for a, b in ends)
        return f(*(self.symbol(x, time) for x in symbols), *slopes)

    def symbol(self, x: Symbol, time: Any) -> Any:
        """Of a name."""
        if (x, time) not in self.known:
            if x in self.definitions:
                found = self.value(self.definitions[x], time)
            elif x in self.rates:  # at constant accelerations
                rate = self.rates[x]
                half = self.given[self.rates[rate]] * time / 2 if rate in self.rates else 0
                found = self.given[x] + (self.given[rate] + half) * time
            else:
                found = self.given[x] + (time if x == t else 0)
            self.known[x, time] = found
        return self.known[x, time]
