"""Evaluation of functions in Python, in doubles or 40 digits, and states to evaluate them at."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any

import mpmath
from sympy import Rational

from eomc.model.system import System, t
from eomc.program.ir import Function, Operand, Product, Sum, Value
from eomc.scene import formulas

DIFFERENCE = 2.0**-20  # relative step of finite differences; six digits suffice for error bounds

_DOUBLES: Mapping[str, Callable[..., Any]] = {
    **formulas.NUMERIC,
    "number": float,
    "pow": math.pow,
    "reciprocal": lambda x: 1 / x,
    "pivot_inverse": lambda pivot, limit: 1 / pivot if pivot > limit else 0,
}


@cache
def context() -> Any:
    """Return the mpmath context with 40 digits, in which exact values are computed."""
    mp = mpmath.mp.clone()
    mp.dps = 40
    return mp


@cache
def _many_digits() -> Mapping[str, Callable[..., Any]]:
    """Return the functions of `_DOUBLES` for 40 digits."""
    mp = context()
    return {
        **_DOUBLES,
        **{name: getattr(mp, name) for name in formulas.ELEMENTARY},
        "number": lambda x: mp.mpf(x.p) / x.q if isinstance(x, Rational) else mp.mpf(x.evalf(40)),
        "pow": mp.power,
    }


def evaluate(
    function: Function, values: Mapping[str, float], exact: bool = False, unit: float = 2.0**-52
) -> tuple[list[float], bool]:
    """Return the results of a function of the generated code at one state, computed in Python.

    Parameters
    ----------
    function
        The function, as a list of assignments.
    values
        Coordinates, velocities, parameters, inputs and t by name.
    exact
        If True, compute in 40 digits and round the results to doubles; else compute in doubles.
    unit
        Unit of rounding, such as 2^-52 for doubles. The tolerance of the pivots is a multiple of
        it.

    Returns
    -------
    results : list of float
        The outputs.
    regular : bool
        Whether all pivots of the matrix that the function factors exceed their rounding errors.

    Raises
    ------
    ArithmeticError, ValueError
        If a result is not a finite real number.
    """
    return evaluator(function, exact, unit)(values)


def evaluator(
    function: Function, exact: bool = False, unit: float = 2.0**-52
) -> Callable[[Mapping[str, float]], tuple[list[float], bool]]:
    """Return a Python function that maps `values` to the results of `evaluate(function, values)`.

    For many states this is faster than `evaluate`, since the numbers in `function` are converted
    only once. The arguments are those of `evaluate`.
    """
    run, atom = _steps(function, _many_digits() if exact else _DOUBLES)
    outputs = [atom(o) for o in function.outputs]
    checks = [(atom(pivot), atom(diagonal)) for pivot, diagonal in function.checks]
    tolerance = 8 * unit * max(1, len(checks))

    def evaluate_at(values: Mapping[str, float]) -> tuple[list[float], bool]:
        """Return the results of `function` at one state, and whether all its pivots are positive.

        A pivot of the matrix that `function` factors must exceed its rounding error.
        """
        known = run(values)
        try:
            results = [float(c * known[n]) for c, n in outputs]
        except TypeError:  # a complex number
            raise ValueError(f"{function.name} is not real") from None
        if not all(map(math.isfinite, results)):
            raise ValueError(f"{function.name} is not finite")
        return results, all(
            c * known[n] > (0 if (c, n) == (e, m) else tolerance * (e * known[m]))
            for (c, n), (e, m) in checks
        )

    return evaluate_at


def exact_evaluator(function: Function) -> Callable[[Mapping[str, Any]], list[Any]]:
    """Return a Python function that computes the results of `function` in 40 digits, not rounded.

    The argument of the returned function maps names to values, floats or mpmath numbers. It raises
    ArithmeticError or ValueError if a result is not a finite real number.
    """
    mp = context()
    run, atom = _steps(function, _many_digits())
    outputs = [atom(o) for o in function.outputs]

    def evaluate_at(values: Mapping[str, Any]) -> list[Any]:
        """Return the results of `function` at the state `values`, as numbers of 40 digits."""
        known = run(values)
        results = [mp.mpmathify(c * known[n]) for c, n in outputs]
        if not all(isinstance(x, mp.mpf) and mp.isfinite(x) for x in results):
            raise ValueError(f"{function.name} is not finite and real")
        return results

    return evaluate_at


def _steps(
    function: Function, arithmetic: Mapping[str, Callable[..., Any]]
) -> tuple[Callable[[Mapping[str, Any]], dict[str, Any]], Callable[[Operand], tuple[Any, str]]]:
    """Return a function that runs the assignments in the arithmetic `of`, and one that converts
    operands.
    """
    number = lru_cache(maxsize=None)(arithmetic["number"])  # most numbers are 1 or -1

    def atom(o: Operand) -> tuple[Any, str]:
        return number(o.coefficient), o.name

    steps: list[tuple[str, Callable[..., Any], Any, Sequence[Any]]] = []
    for a in (*function.early, *function.body):
        v = a.value
        if isinstance(v, Sum):
            terms = [(number(w), n) for w, n in v.terms]
            steps.append((a.name, _add, number(v.constant), terms))
        elif isinstance(v, Product):
            steps.append((a.name, _multiply, number(v.coefficient), v.factors))
        else:
            steps.append((a.name, _call, arithmetic[v.function], [atom(o) for o in v.args]))

    def run(values: Mapping[str, Any]) -> dict[str, Any]:
        known: dict[str, Any] = {"": 1, **values}  # a number alone has no name
        for name, operation, first, arguments in steps:
            known[name] = operation(known, first, arguments)
        return known

    return run, atom


def _add(known: Mapping[str, Any], constant: Any, terms: Sequence[tuple[Any, str]]) -> Any:
    """Return constant + sum(weight * value)."""
    return sum([w * known[n] for w, n in terms], constant)


def _multiply(known: Mapping[str, Any], coefficient: Any, factors: Sequence[str]) -> Any:
    """Return coefficient * product(values)."""
    return math.prod([known[n] for n in factors], start=coefficient)


def _call(known: Mapping[str, Any], operation: Callable[..., Any], args: Sequence[Any]) -> Any:
    """Return a function of operands."""
    return operation(*[c * known[n] for c, n in args])


def rounding_evaluator(function: Function) -> Callable[[Mapping[str, float]], list[float]]:
    """Return a Python function that bounds the rounding errors of the results of `function`.

    The argument of the returned function maps names to values. It returns one bound for each
    result, in units of rounding. To first order, the bound is the sum of |d result/d v| |v| over
    all inputs, numbers, terms of sums and intermediate values v (Higham, *Accuracy and Stability of
    Numerical Algorithms*, sec. 3.1). The function raises ArithmeticError or ValueError if a result
    is not a finite real number.
    """
    run, atom = _steps(function, _DOUBLES)
    outputs = [atom(o) for o in function.outputs]
    steps = [(a.name, *_linearize(a.value)) for a in (*function.early, *function.body)]

    def bound(known: Mapping[str, float], coefficient: float, name: str) -> float:
        """Return a bound of the rounding error of a result, in units of rounding.

        The result is `coefficient` times the value `name`; `known` contains all values by name.
        """
        slopes, total = {name: coefficient}, 0.0
        for value, size, partials in reversed(steps):
            slope = slopes.pop(value, 0.0)
            if slope:
                total += abs(slope) * size(known)
                for argument, partial in partials(known):
                    slopes[argument] = slopes.get(argument, 0.0) + slope * partial
        return total + sum(abs(slope * known[n]) for n, slope in slopes.items())

    def evaluate_at(values: Mapping[str, float]) -> list[float]:
        """Return a bound of the rounding error of each result of `function` at the state `values`.

        The bounds are in units of rounding.
        """
        known = run(values)
        bounds = [bound(known, c, n) for c, n in outputs]
        if not all(map(math.isfinite, bounds)):
            raise ValueError(f"{function.name} is not finite")
        return bounds

    return evaluate_at


def _linearize(
    value: Value,
) -> tuple[
    Callable[[Mapping[str, float]], float],
    Callable[[Mapping[str, float]], list[tuple[str, float]]],
]:
    """Return functions for the scale of a right-hand side (sum of |terms|) and its partial
    derivatives.
    """
    if isinstance(value, Sum):
        constant = abs(float(value.constant))
        terms = [(name, float(w)) for w, name in value.terms]
        return lambda x: constant + sum(abs(w * x[n]) for n, w in terms), lambda x: terms
    if isinstance(value, Product):
        coefficient, factors = float(value.coefficient), value.factors

        def partials(x: Mapping[str, float]) -> list[tuple[str, float]]:
            values = [x[n] for n in factors]
            return [
                (n, math.prod(values[:k] + values[k + 1 :], start=coefficient))
                for k, n in enumerate(factors)
            ]

        return lambda x: abs(_multiply(x, coefficient, factors)), partials
    function = _DOUBLES[value.function]
    arguments = [(float(a.coefficient), a.name) for a in value.args]

    def magnitude(x: Mapping[str, float]) -> float:
        return abs(float(_call(x, function, arguments)))

    def differences(x: Mapping[str, float]) -> list[tuple[str, float]]:
        points, partials_ = [c * x[n] for c, n in arguments], list[tuple[str, float]]()
        value_ = function(*points)
        for k, (c, n) in enumerate(arguments):
            step = DIFFERENCE * (abs(points[k]) or 1.0)
            for signed in (step, -step):  # one side may lie outside the domain
                shifted = [y + signed * (i == k) for i, y in enumerate(points)]
                with suppress(ArithmeticError, ValueError):
                    partials_.append((n, c * (function(*shifted) - value_) / signed))
                    break
        return partials_

    return magnitude, differences


def nearby(system: System, k: int) -> dict[str, float]:
    """Return the values of parameters, coordinates, velocities and t at the k-th test state.

    The keys are the names of these quantities. State 0 is the initial state. The other states lie
    around it, farther away for larger k; parameters and t are the same in all of them.
    """
    out = {p.name: p.value for p in system.parameters} | {t.name: 0.0}
    for i, c in enumerate(system.coordinates):
        # Steps in unrelated directions, rounded to few digits because they are printed.
        out[c.name] = (
            float(f"{c.start + 0.37 * k * math.sin(1.0 + i + 2.3 * k):.6g}") if k else c.start
        )
        rate = c.rate + 0.53 * k * math.cos(0.7 + i + 1.9 * k)
        out[c.qd.name] = float(f"{rate:.6g}") if k else c.rate
    return out
