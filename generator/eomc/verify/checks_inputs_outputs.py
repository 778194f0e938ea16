"""Checks of outputs, of the closed loop with feedback signals, and of limits of inputs.

Values of outputs are evaluated with eighty digits, and nothing is differentiated as a formula:
along the motion q(s) = q + qd s + qdd s^2/2, formulas and definitions are evaluated as they are,
and dot(e) is (e(h) - e(-h))/2h. Accelerations and multipliers, which have checks of their own, are
the module's; derivatives of multipliers are differences of the reference's.

A of the closed loop must be A + B du/dx of the open one, with derivatives of the signals in eighty
digits. Inputs beyond their limits must act as the limits do, bit by bit.
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

from eomc.model.algebra import compile_function
from eomc.model.symbols import Output, resolve_definitions, symbol
from eomc.model.system import System, dot, t
from eomc.verify.checks_derivatives import differentiate
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import NUDGE, Expected, State, evaluate_module, perturb_each_input

DIGITS = 80  # about 30 of them remain correct after three nested differences
WIDTH = mpmath.mpf(10) ** -15  # step of differences
SLOPE_LIMIT = 1e-9  # error relative to the largest derivative of the same output
STATES = 4  # states at which values are compared
_NONE: Vector = np.zeros(0)

_NAMES = {"Min": min, "Max": max, "Heaviside": lambda x, middle=0.5: middle if x == 0 else +(x > 0)}


def report_outputs(check: Comparison) -> None:
    """Append checks of outputs and of their derivatives to the report of `eomc check`.

    Outputs are quantities that the scene defines by formulas.
    """
    formulas = Formulas(check.system)
    # derivatives of multipliers are differences of the reference's
    limit = max(1e-6 if formulas.multipliers else SLOPE_LIMIT, LIMIT * check.eps)
    for module, form in check.forms:
        check.add_check(
            f"{form}outputs", LIMIT, "units of rounding", partial(_values, check, module, formulas)
        )
        if check.system.run.needs_derivatives:
            unit, slopes = (
                "of the largest derivative",
                partial(_slope_error, check, module, formulas),
            )
            check.add_check(f"{form}outputs: C, D", limit, unit, slopes)
            if check.system.run.linearize == "parameters" and check.system.parameters:
                by_parameters = partial(_slope_error, check, module, formulas, by_parameters=True)
                check.add_check(f"{form}outputs: by parameters", limit, unit, by_parameters)


def _values(check: Comparison, module: Any, formulas: Formulas) -> float:
    """Return the largest error of the outputs at some states, in units of rounding."""

    def module_outputs(s: State) -> Vector:
        return np.asarray(module.output(s.q, s.qd, s.t, s.u, s.params), float)

    return compare_outputs(check, module, formulas, module_outputs)


def compare_outputs(
    check: Comparison, module: Any, formulas: Formulas, function: Callable[[State], Vector]
) -> float:
    """Return the largest error of a function of the module over some states, in units of rounding.

    function: returns the module's values, (ny,), at a state. formulas: evaluate the same values
    with many digits, from the module's own accelerations and multipliers.
    """

    def error(e: Expected) -> float:
        s = _with_fixed_inputs(check, module, e.state)
        value = function(s)
        near = [function(x) for x in perturb_each_input(s, check.sampler.defaults)]
        size = np.abs(value) + np.nansum([np.abs(x - value) / NUDGE for x in near], axis=0)
        qdd, forces = _solved(module, s)
        exact = formulas.evaluate(s, qdd, forces)
        # terms that cancel with an acceleration leave its rounding error
        for k in range(len(qdd)):
            moved = np.where(np.arange(len(qdd)) == k, 1 + NUDGE, 1.0) * qdd
            size += np.nan_to_num(np.abs(formulas.evaluate(s, moved, forces) - exact) / NUDGE)
        real = np.isfinite(value) | np.isfinite(exact)  # sqrt(x) for x < 0 is not finite in either
        return check.units(value[real], exact[real], size[real]) if np.any(real) else 0.0

    return check.largest(error, STATES)


def _slope_error(
    check: Comparison, module: Any, formulas: Formulas, by_parameters: bool = False
) -> float:
    """Compare C and D, or dy/dp, with differences of the outputs, through A, B or E."""

    def error(e: Expected) -> float:
        s = _with_fixed_inputs(check, module, e.state)
        n, arguments = len(s.q), {"u": s.u, "t": s.t, "params": s.params}
        if by_parameters:
            solved, module_slopes = (
                np.asarray(x, float)
                for x in module.sensitivity(s.q, s.qd, outputs=True, **arguments)
            )
        else:
            A, B, C, D = (
                np.asarray(x, float) for x in module.linearize(s.q, s.qd, outputs=True, **arguments)
            )
            solved, module_slopes = np.hstack([A[n:], B[n:]]), np.hstack([C, D])
        slopes, m = formulas.slopes(s, *_solved(module, s), by_parameters), module_slopes.shape[1]
        own, by_qdd, by_force = np.split(slopes, [m, m + n], axis=1)
        least: Vector = np.full((1, 1), np.inf)  # a wrong derivative is wrong at every width
        for forces in (
            _multiplier_slopes(check, s, by_parameters) if formulas.multipliers else [by_force[:0]]
        ):
            exact, sizes = own + by_qdd @ solved, abs(own) + abs(by_qdd) @ abs(solved)
            if formulas.multipliers:
                exact, sizes = exact + by_force @ forces, sizes + abs(by_force) @ abs(forces)
            off = np.abs(module_slopes - exact) / (np.max(sizes, axis=1, keepdims=True) + 1e-300)
            least = np.fmin(
                least, np.where(np.isfinite(module_slopes) | np.isfinite(exact), off, 0.0)
            )
        return float(np.max(least, initial=0))

    return check.largest(error, 2)


def _multiplier_slopes(check: Comparison, s: State, by_parameters: bool) -> Iterator[Vector]:
    """Yield derivatives of the multipliers, by differences of several widths.

    They are with respect to q, q̇ and u, (nc, 2 nq + nu), or to the parameters, (nc, np).
    """
    first = 2 * len(s.q) + len(check.system.inputs)
    arguments = (check.reference, s, check.sampler.scale, check.sampler.defaults, "multipliers")
    for slopes, _ in differentiate(*arguments):
        yield slopes[:, first:] if by_parameters else slopes[:, :first]


def _solved(module: Any, s: State) -> tuple[Vector, Vector]:
    """Return the module's accelerations and multipliers at a state."""
    rows = getattr(module, "constraint_names", ())
    return evaluate_module(module, "acceleration", s), evaluate_module(
        module, "multipliers", s
    ) if rows else np.zeros(0)


def _with_fixed_inputs(check: Comparison, module: Any, s: State) -> State:
    """Return the state with the signals' values as inputs, which do not depend on it."""
    if s.u is not None or not check.system.inputs:
        return s
    return replace(s, u=np.asarray(module.signal(s.q, s.qd, s.t, s.params), float))


@dataclass
class Formulas:
    """The outputs of a system, evaluated from their formulas with many digits.

    Outputs are quantities that the scene defines by formulas. A rate dot(...) in a formula is
    computed as a difference quotient along the motion.
    """

    system: System
    _compiled: dict[Expr, tuple[Callable[..., Any], Sequence[Symbol], Sequence[Expr]]] = field(
        default_factory=dict
    )

    @cached_property
    def multipliers(self) -> tuple[Symbol, ...]:
        """Symbols of the multipliers of all constraint equations.

        The tuple is empty if no output contains a multiplier.
        """
        read = {x for o in self.system.outputs for x in o.formula.free_symbols}
        multipliers = tuple(c.multiplier for c in self.system.constraints)
        return multipliers if read & {*multipliers} else ()

    def evaluate(self, s: State, qdd: Vector, forces: Vector = _NONE) -> Vector:
        """Return the values of the outputs, (ny,), at a state.

        s: the state, with its inputs. qdd: the accelerations, (nq,). forces: the Lagrange
        multipliers, needed if `multipliers` is not empty.
        """
        with mpmath.workdps(DIGITS):
            return np.array([float(y) for y in self._values(self._symbol_values(s, qdd, forces))])

    def slopes(
        self, s: State, qdd: Vector, forces: Vector = _NONE, by_parameters: bool = False
    ) -> Vector:
        """Return difference quotients of the outputs, (ny, 3 nq + nu + nc).

        The columns are derivatives with respect to q, q̇, u, q̈ and the nc multipliers; nc is 0 if
        no output contains one. With `by_parameters`, the parameters replace q, q̇ and u. qdd,
        forces: as in `evaluate`.
        """
        system = self.system
        own = (*system.q, *system.qd, *system.u)
        if by_parameters:
            own = tuple(p.symbol for p in system.parameters)
        with mpmath.workdps(DIGITS):
            symbol_values, columns = self._symbol_values(s, qdd, forces), []
            for x in (*own, *system.qdd, *self.multipliers):
                ends = [
                    self._values({**symbol_values, x: symbol_values[x] + h})
                    for h in (WIDTH, -WIDTH)
                ]
                columns.append([float((a - b) / (2 * WIDTH)) for a, b in zip(*ends, strict=True)])
        return np.array(columns).T

    def _symbol_values(self, s: State, qdd: Vector, forces: Vector) -> dict[Symbol, Any]:
        system = self.system
        symbol_values = dict(
            zip((*system.q, *system.qd, *system.qdd), (*s.q, *s.qd, *qdd), strict=True)
        )
        symbol_values |= dict(zip(system.u, () if s.u is None else s.u, strict=True))
        symbol_values |= dict(zip(self.multipliers, forces, strict=bool(self.multipliers)))
        symbol_values |= {symbol(n): v for n, v in (s.params or self._defaults).items()} | {t: s.t}
        return {name: mpmath.mpf(float(value)) for name, value in symbol_values.items()}

    @property
    def _defaults(self) -> dict[str, float]:
        return {p.name: p.value for p in self.system.parameters}

    def _values(self, symbol_values: Mapping[Symbol, Any]) -> list[Any]:
        motion = _Motion(self, symbol_values)
        return [_real(motion, o.formula) for o in self.system.outputs]

    def compiled(self, e: Expr) -> tuple[Callable[..., Any], Sequence[Symbol], Sequence[Expr]]:
        """Return a formula as a Python function, with a description of its arguments.

        The result is (function, symbols, expressions). The arguments of the function are the values
        of `symbols`, followed by the time derivatives of `expressions`: these are the y of all
        dot(y) in the formula.
        """
        if e not in self._compiled:
            rates = [d for d in e.atoms(dot) if not any(d != o and o.has(d) for o in e.atoms(dot))]
            stand_ins = [sympy.Dummy() for _ in rates]
            bare = e.xreplace(dict(zip(rates, stand_ins, strict=True)))
            symbols = sorted(bare.free_symbols - set(stand_ins), key=str)
            f = compile_function([*symbols, *stand_ins], bare, [_NAMES, "mpmath"])
            self._compiled[e] = f, symbols, [d.args[0] for d in rates]
        return self._compiled[e]


def _real(motion: _Motion, formula: Expr) -> Any:
    """Return the value of a formula; nan if it is not real or has a pole."""
    try:
        value = mpmath.mpmathify(motion.value(formula, mpmath.mpf(0)))
    except (ZeroDivisionError, ValueError):
        return mpmath.mpf("nan")
    return value.real if value.imag == 0 else mpmath.mpf("nan")


class _Motion:
    """Values of formulas in many digits, as functions of time near one state."""

    def __init__(self, formulas: Formulas, symbol_values: Mapping[Symbol, Any]) -> None:
        self.formulas, self.symbol_values, system = formulas, symbol_values, formulas.system
        self.definitions = dict(system.definitions)
        self.rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True))}
        self.known: dict[tuple[Symbol, Any], Any] = {}

    def value(self, e: Expr, time: Any) -> Any:
        """Return the value of the formula `e` at `time`, in s after the time of the state."""
        f, symbols, rates = self.formulas.compiled(e)
        ends = [[self.value(x, time + h) for h in (WIDTH, -WIDTH)] for x in rates]
        slopes = ((a - b) / (2 * WIDTH) for a, b in ends)
        return f(*(self.symbol(x, time) for x in symbols), *slopes)

    def symbol(self, x: Symbol, time: Any) -> Any:
        """Return the value of the symbol `x` at `time`, in s after the time of the state.

        Accelerations are taken as constant.
        """
        if (x, time) not in self.known:
            if x in self.definitions:
                value = self.value(self.definitions[x], time)
            elif x in self.rates:  # accelerations are constant
                rate = self.rates[x]
                half = self.symbol_values[self.rates[rate]] * time / 2 if rate in self.rates else 0
                value = self.symbol_values[x] + (self.symbol_values[rate] + half) * time
            else:
                value = self.symbol_values[x] + (time if x == t else 0)
            self.known[x, time] = value
        return self.known[x, time]


def report_closed_loop(check: Comparison) -> None:
    """Append checks of the linearised closed loop to the report of `eomc check`.

    The loop is closed by the signals, the scene's formulas for inputs. There are no checks if no
    signal depends on the state or if a signal has discontinuities.
    """
    if not check.system.run.needs_derivatives or not _is_feedback(check.system):
        return
    signals = tuple(Output(i.name, i.signal) for i in check.system.inputs)
    formulas = Formulas(replace(check.system, outputs=signals, inputs=()))
    limit, unit = max(SLOPE_LIMIT, LIMIT * check.eps), "of the largest derivative"
    for module, form in check.forms:
        check.add_check(
            f"{form}closed loop", limit, unit, partial(_closed_loop_error, check, module, formulas)
        )


def _is_feedback(system: System) -> bool:
    """Return whether a signal depends on the state, and none has discontinuities."""
    known = resolve_definitions(system.definitions)
    signals = sympy.Tuple(*(i.signal.xreplace(known) for i in system.inputs))
    moves = signals.free_symbols & {*system.q, *system.qd}
    return bool(moves) and not signals.has(sympy.sign, sympy.Heaviside)


def _closed_loop_error(check: Comparison, module: Any, formulas: Formulas) -> float:
    """Compare A of the closed loop with A + B du/dx, from the module's own A and B."""

    def error(e: Expected) -> float:
        s = replace(e.state, u=None)
        arguments = {"t": s.t, "params": s.params}
        n = 2 * len(s.q)
        A, B, closed = (
            np.asarray(x, float)
            for x in (
                *module.linearize(s.q, s.qd, **arguments),
                module.linearize(s.q, s.qd, closed=True, **arguments)[0],
            )
        )
        K = formulas.slopes(s, np.zeros(len(s.q)))[:, :n]
        size = np.max(abs(A) + abs(B) @ abs(K), axis=1, keepdims=True)
        return float(np.max(abs(closed - A - B @ K) / (size + 1e-300)))

    return check.largest(error, 2)


def report_limits(check: Comparison) -> None:
    """Append checks of limits of inputs to the report of `eomc check`, if the scene has limits."""
    if all(x is None for i in check.system.inputs for x in i.limits):
        return
    for module, form in check.forms:
        check.add_check(
            f"{form}limits of inputs", 0, "that differ", partial(_differing_results, check, module)
        )


def _differing_results(check: Comparison, module: Any) -> float:
    """Return how many inputs, accelerations and steps differ from those at the limits."""
    differing = 0
    for e in check.few(STATES):
        s = e.state
        least, most = limits(check.system, s.params or check.sampler.defaults)
        for beyond in _beyond(least, most):
            both = [
                list(_results_with_inputs(module, s, u))
                for u in (beyond, np.clip(beyond, least, most))
            ]
            differing += sum(not np.array_equal(a, b) for a, b in zip(*both, strict=True))
    return float(differing)


def limits(system: System, params: Mapping[str, float]) -> tuple[Vector, Vector]:
    """Return the smallest and the largest permitted values of the inputs, both (nu,).

    An input without a limit has the value -inf or inf there. params: values of the parameters,
    which the formulas of the limits may contain.
    """
    values = {symbol(name): value for name, value in params.items()}
    ends = [
        [
            far if x is None else float(x.xreplace(values))
            for x, far in zip(i.limits, (-np.inf, np.inf), strict=True)
        ]
        for i in system.inputs
    ]
    least, most = np.array(ends).T
    return least, most


def _beyond(least: Vector, most: Vector) -> Iterator[Vector]:
    """Yield inputs of which some are below, some above and some between their limits."""
    width = np.where(np.isfinite(most - least), most - least, 1.0)
    low = np.where(np.isfinite(least), least, np.where(np.isfinite(most), most, 0) - 2 * width)
    high = np.where(np.isfinite(most), most, low + 2 * width)
    for turn in range(3):
        where = (np.arange(len(low)) + turn) % 3
        yield np.choose(where, [low - 3 * width, high + 3 * width, (low + high) / 2])


def _results_with_inputs(module: Any, s: State, u: Vector) -> Iterator[Vector]:
    arguments = {"t": s.t, "u": u, "params": s.params}
    yield module.applied(s.q, s.qd, **arguments)
    yield module.acceleration(s.q, s.qd, **arguments)
    for method in module.methods:
        yield np.array(module.step(s.q, s.qd, method=method, **arguments))
    if hasattr(module, "step_batch"):
        q, qd = np.array([s.q], module.dtype), np.array([s.qd], module.dtype)
        yield module.step_batch(q, qd, **arguments)
        yield np.array([q, qd])
