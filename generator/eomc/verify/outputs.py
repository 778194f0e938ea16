"""Checks of outputs, of the closed loop with feedback signals, and of limits of inputs.

Outputs are evaluated with dual numbers, along the definitions as they are: each dot(...) is a
tangent in time, of the motion q(s) = q + qd s + qdd s^2/2. Accelerations and multipliers, which
have checks of their own, are the module's; derivatives of multipliers are differences of the
reference's.

A of the closed loop must be A + B du/dx of the open one. Inputs beyond their limits must act as the
limits do, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import sympy
from sympy import Symbol

from eomc.model.symbols import Output, resolve_definitions, symbol
from eomc.model.system import System, t
from eomc.verify.comparison import LIMIT, Check, Comparison
from eomc.verify.equations import UNIT, differentiate
from eomc.verify.reference import Vector
from eomc.verify.sampling import NUDGE, Expected, State, evaluate_module, perturb_each_input
from eomc.verify.taylor import Dual, compile_formulas, nested_rates, part_of

SLOPE_LIMIT = 1e-9  # error relative to the largest derivative of the same output
_NONE: Vector = np.zeros(0)


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of outputs, of limits of inputs and of the closed loop."""
    if comparison.system.outputs and hasattr(comparison.module, "output"):
        yield from output_checks(comparison)
    if hasattr(comparison.module, "applied"):
        yield from limit_checks(comparison)
        yield from closed_loop_checks(comparison)


def output_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of outputs and of their derivatives.

    Outputs are quantities that the scene defines by formulas.
    """
    formulas, run = Formulas(comparison.system), comparison.system.run
    # derivatives of multipliers are differences of the reference's
    limit = max(1e-6 if formulas.multipliers else SLOPE_LIMIT, LIMIT * comparison.eps)
    error = partial(output_error, formulas, _outputs)
    yield Check("outputs", error, states=comparison.few(4), portable=True)
    derivatives = {"C, D": False} if run.needs_derivatives else {}
    if derivatives and run.by_parameters and comparison.system.parameters:
        derivatives["by parameters"] = True
    for name, by_parameters in derivatives.items():
        yield Check(
            f"outputs: {name}", partial(_slope_error, formulas, by_parameters), tolerance=limit,
            states=comparison.few(2), unit=UNIT, portable=True,
        )  # fmt: skip


def _outputs(of: Comparison, s: State) -> Vector:
    return np.asarray(of.module.output(s.q, s.qd, s.t, s.u, s.params), float)


def output_error(
    formulas: Formulas, function: Callable[[Comparison, State], Vector], of: Comparison, e: Expected
) -> float:
    """Return the largest error of a function of the module at a state, in units of rounding.

    function: returns the module's values, (ny,), at a state. formulas: evaluate the same values
    from the module's own accelerations and multipliers.
    """
    s = _with_fixed_inputs(of.module, e.state)
    value = function(of, s)
    near = [function(of, x) for x in perturb_each_input(s, of.sampler.defaults)]
    size = np.abs(value) + np.nansum([np.abs(x - value) / NUDGE for x in near], axis=0)
    qdd, forces = _solved(of.module, s)
    exact = formulas.evaluate(s, qdd, forces)
    # terms that cancel with an acceleration leave its rounding error
    for k in range(len(qdd)):
        moved = np.where(np.arange(len(qdd)) == k, 1 + NUDGE, 1.0) * qdd
        size += np.nan_to_num(np.abs(formulas.evaluate(s, moved, forces) - exact) / NUDGE)
    real = np.isfinite(value) | np.isfinite(exact)  # sqrt(x) for x < 0 is not finite in either
    return of.units(value[real], exact[real], size[real]) if np.any(real) else 0.0


def _slope_error(formulas: Formulas, by_parameters: bool, of: Comparison, e: Expected) -> float:
    """Compare C and D, or dy/dp, with differences of the outputs, through A, B or E."""
    module, s = of.module, _with_fixed_inputs(of.module, e.state)
    n, arguments = len(s.q), {"u": s.u, "t": s.t, "params": s.params, "outputs": True}
    derivatives = (module.sensitivity if by_parameters else module.linearize)(
        s.q, s.qd, **arguments
    )
    if by_parameters:
        solved, module_slopes = (np.asarray(x, float) for x in derivatives)
    else:
        A, B, C, D = (np.asarray(x, float) for x in derivatives)
        solved, module_slopes = np.hstack([A[n:], B[n:]]), np.hstack([C, D])
    slopes, m = formulas.slopes(s, *_solved(module, s), by_parameters), module_slopes.shape[1]
    own, by_qdd, by_force = np.split(slopes, [m, m + n], axis=1)
    least: Vector = np.full((1, 1), np.inf)  # a wrong derivative is wrong at every width
    for forces in (
        _multiplier_slopes(of, s, by_parameters) if formulas.multipliers else [by_force[:0]]
    ):
        exact, sizes = own + by_qdd @ solved, abs(own) + abs(by_qdd) @ abs(solved)
        if formulas.multipliers:
            exact, sizes = exact + by_force @ forces, sizes + abs(by_force) @ abs(forces)
        off = np.abs(module_slopes - exact) / (np.max(sizes, axis=1, keepdims=True) + 1e-300)
        least = np.fmin(least, np.where(np.isfinite(module_slopes) | np.isfinite(exact), off, 0.0))
    return float(np.max(least, initial=0))


def _multiplier_slopes(of: Comparison, s: State, by_parameters: bool) -> Iterator[Vector]:
    """Yield derivatives of the multipliers, by differences of several widths.

    They are with respect to q, q̇ and u, (nc, 2 nq + nu), or to the parameters, (nc, np).
    """
    first = 2 * len(s.q) + len(of.system.inputs)
    arguments = (of.reference, s, of.sampler.scale, of.sampler.defaults, "multipliers")
    for slopes, _ in differentiate(*arguments):
        yield slopes[:, first:] if by_parameters else slopes[:, :first]


def _solved(module: Any, s: State) -> tuple[Vector, Vector]:
    """Return the module's accelerations and multipliers at a state."""
    rows = getattr(module, "constraint_names", ())
    return evaluate_module(module, "acceleration", s), evaluate_module(
        module, "multipliers", s
    ) if rows else np.zeros(0)


def _with_fixed_inputs(module: Any, s: State) -> State:
    """Return the state with the signals' values as inputs, which do not depend on it."""
    if s.u is not None or not module.inputs:
        return s
    return replace(s, u=np.asarray(module.signal(s.q, s.qd, s.t, s.params), float))


class Formulas:
    """The outputs of a system, evaluated and differentiated with dual numbers.

    Outputs are quantities that the scene defines by formulas.
    """

    def __init__(self, system: System) -> None:
        self.system, formulas = system, [o.formula for o in system.outputs]
        read = {x for e in formulas for x in e.free_symbols}
        multipliers = tuple(c.multiplier for c in system.constraints)
        # of all constraint equations; none if no output contains a multiplier
        self.multipliers: tuple[Symbol, ...] = multipliers if read & {*multipliers} else ()
        self.parameters = tuple(p.symbol for p in system.parameters)
        self.levels = nested_rates(formulas, system.definitions)
        symbols = (*system.q, *system.qd, *system.qdd, *system.u, *self.multipliers)
        self.symbols: tuple[Symbol, ...] = (*symbols, *self.parameters, t)
        self.function = compile_formulas(
            self.symbols, formulas, system.definitions, max(1, self.levels)
        )

    def evaluate(self, s: State, qdd: Vector, forces: Vector = _NONE) -> Vector:
        """Return the values of the outputs, (ny,), at a state.

        s: the state, with its inputs. qdd: the accelerations, (nq,). forces: the Lagrange
        multipliers, needed if `multipliers` is not empty.
        """
        values = self._values(self._variables(s, qdd, forces))
        return np.array([float(y) for y in values])

    def slopes(
        self, s: State, qdd: Vector, forces: Vector = _NONE, by_parameters: bool = False
    ) -> Vector:
        """Return the derivatives of the outputs, (ny, 3 nq + nu + nc).

        The columns are derivatives with respect to q, q̇, u, q̈ and the nc multipliers; nc is 0 if
        no output contains one. With `by_parameters`, the parameters replace q, q̇ and u. qdd,
        forces: as in `evaluate`.
        """
        system, variables = self.system, self._variables(s, qdd, forces)
        own = self.parameters if by_parameters else (*system.q, *system.qd, *system.u)
        by = (*own, *system.qdd, *self.multipliers)
        variables = {x: Dual(value) for x, value in variables.items()}
        variables |= {
            x: Dual(variables[x].value, e) for x, e in zip(by, np.eye(len(by)), strict=True)
        }
        values = (part_of(y, "tangent") for y in self._values(variables))
        return np.array([np.broadcast_to(y, len(by)) for y in values]).reshape(-1, len(by))

    def _variables(self, s: State, qdd: Vector, forces: Vector) -> dict[Symbol, Any]:
        u = () if s.u is None else s.u
        params = {p.name: p.value for p in self.system.parameters} | dict(s.params or {})
        values = (*s.q, *s.qd, *qdd, *u, *(forces if self.multipliers else ()), *params.values())
        return dict(zip(self.symbols, map(np.float64, (*values, s.t)), strict=True))

    def _values(self, variables: Mapping[Symbol, Any]) -> list[Any]:
        """Return the outputs, for accelerations that are constant in time."""
        system = self.system
        rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True))}
        for _ in range(self.levels):
            variables = {
                x: Dual(value, 1.0 if x == t else variables.get(rates.get(x)))
                for x, value in variables.items()
            }
        with np.errstate(all="ignore"):
            values = self.function(*variables.values())
        return [part_of(y, *["value"] * self.levels) for y in values]


def closed_loop_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the check of the linearised closed loop.

    The loop is closed by the signals, the scene's formulas for inputs. There is no check if no
    signal depends on the state or if a signal has discontinuities.
    """
    system = comparison.system
    if system.run.needs_derivatives and _is_feedback(system):
        signals = tuple(Output(i.name, i.signal) for i in system.inputs)
        formulas = Formulas(replace(system, outputs=signals, inputs=()))
        yield Check(
            "closed loop", partial(_closed_loop_error, formulas), states=comparison.few(2),
            tolerance=max(SLOPE_LIMIT, LIMIT * comparison.eps), unit=UNIT, portable=True,
        )  # fmt: skip


def _is_feedback(system: System) -> bool:
    """Return whether a signal depends on the state, and none has discontinuities."""
    known = resolve_definitions(system.definitions)
    signals = sympy.Tuple(*(i.signal.xreplace(known) for i in system.inputs))
    moves = signals.free_symbols & {*system.q, *system.qd}
    return bool(moves) and not signals.has(sympy.sign, sympy.Heaviside)


def _closed_loop_error(formulas: Formulas, of: Comparison, e: Expected) -> float:
    """Compare A of the closed loop with A + B du/dx, from the module's own A and B."""
    s, n = replace(e.state, u=None), 2 * len(e.state.q)
    matrices = [
        x
        for closed in (False, True)
        for x in of.module.linearize(s.q, s.qd, t=s.t, params=s.params, closed=closed)
    ]
    A, B, closed_loop = (np.asarray(x, float) for x in matrices[:3])
    K = formulas.slopes(s, np.zeros(len(s.q)))[:, :n]
    size = np.max(abs(A) + abs(B) @ abs(K), axis=1, keepdims=True)
    return float(np.max(abs(closed_loop - A - B @ K) / (size + 1e-300)))


def limit_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the check of limits of inputs, if the scene has limits."""
    if any(x is not None for i in comparison.system.inputs for x in i.limits):
        yield Check(
            "limits of inputs", _differing_results, tolerance=0, states=comparison.few(4),
            unit="that differ", portable=True,
        )  # fmt: skip


def _differing_results(of: Comparison, e: Expected) -> float:
    """Return how many inputs, accelerations and steps differ from those at the limits."""
    differing, s = 0, e.state
    least, most = limits(of.system, s.params or of.sampler.defaults)
    for beyond in _beyond(least, most):
        both = [
            list(_results_with_inputs(of.module, s, u))
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
