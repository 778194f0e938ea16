"""Functions evaluated in Python, in doubles or in forty digits, and states to evaluate them at."""

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

DIFFERENCE = 2.0**-20  # relative step of a difference: six digits are enough for an error bound

_DOUBLES: Mapping[str, Callable[..., Any]] = {
    **formulas.NUMERIC,
    "number": float,
    "pow": math.pow,
    "reciprocal": lambda x: 1 / x,
    "pivot_inverse": lambda pivot, limit: 1 / pivot if pivot > limit else 0,
}


@cache
def context() -> Any:
    """The numbers of 40 digits, mpmath's."""
    mp = mpmath.mp.clone()
    mp.dps = 40
    return mp


@cache
def _many_digits() -> Mapping[str, Callable[..., Any]]:
    """The same in 40 digits."""
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
    """The results of a function, and whether every pivot is positive, beyond rounding by `unit`.

    values: coordinates, velocities, parameters, inputs and t by name. In Python floats, or in 40
    digits and then rounded where `exact`. Raises ArithmeticError or ValueError where a result is
    not a finite, real number.
    """
    return evaluator(function, exact, unit)(values)


def evaluator(
    function: Function, exact: bool = False, unit: float = 2.0**-52
) -> Callable[[Mapping[str, float]], tuple[list[float], bool]]:
    """`evaluate` of one function for many states: its numbers are converted once."""
    run, atom = _steps(function, _many_digits() if exact else _DOUBLES)
    outputs = [atom(o) for o in function.outputs]
    checks = [(atom(pivot), atom(diagonal)) for pivot, diagonal in function.checks]
    tolerance = 8 * unit * max(1, len(checks))

    def evaluated(values: Mapping[str, float]) -> tuple[list[float], bool]:
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

    return evaluated


def exact_evaluator(function: Function) -> Callable[[Mapping[str, Any]], list[Any]]:
    """The results of a function in 40 digits, not rounded; values: floats or such numbers by name.

    Raises ArithmeticError or ValueError where a result is not a finite, real number.
    """
    mp = context()
    run, atom = _steps(function, _many_digits())
    outputs = [atom(o) for o in function.outputs]

    def evaluated(values: Mapping[str, Any]) -> list[Any]:
        known = run(values)
        results = [mp.mpmathify(c * known[n]) for c, n in outputs]
        if not all(isinstance(x, mp.mpf) and mp.isfinite(x) for x in results):
            raise ValueError(f"{function.name} is not finite and real")
        return results

    return evaluated


def _steps(
    function: Function, of: Mapping[str, Callable[..., Any]]
) -> tuple[Callable[[Mapping[str, Any]], dict[str, Any]], Callable[[Operand], tuple[Any, str]]]:
    """What carries the assignments out, in the algebra `of`, and what converts an operand."""
    number = lru_cache(maxsize=None)(of["number"])  # most are 1 and -1

    def atom(o: Operand) -> tuple[Any, str]:
        return number(o.coefficient), o.name

    steps: list[tuple[str, Callable[..., Any], Any, Sequence[Any]]] = []
    for a in (*function.early, *function.body):
        v = a.value
        if isinstance(v, Sum):
            terms = [(number(w), n) for w, n in v.terms]
            steps.append((a.name, _added, number(v.constant), terms))
        elif isinstance(v, Product):
            steps.append((a.name, _multiplied, number(v.coefficient), v.factors))
        else:
            steps.append((a.name, _called, of[v.function], [atom(o) for o in v.args]))

    def run(values: Mapping[str, Any]) -> dict[str, Any]:
        known: dict[str, Any] = {"": 1, **values}  # a number alone has no name
        for name, do, first, rest in steps:
            known[name] = do(known, first, rest)
        return known

    return run, atom


def _added(known: Mapping[str, Any], constant: Any, terms: Sequence[tuple[Any, str]]) -> Any:
    return sum([w * known[n] for w, n in terms], constant)


def _multiplied(known: Mapping[str, Any], coefficient: Any, factors: Sequence[str]) -> Any:
    return math.prod([known[n] for n in factors], start=coefficient)


def _called(known: Mapping[str, Any], do: Callable[..., Any], args: Sequence[Any]) -> Any:
    return do(*[c * known[n] for c, n in args])


def rounding_evaluator(function: Function) -> Callable[[Mapping[str, float]], list[float]]:
    """The first-order bound of the rounding error of each result, over the unit of rounding.

    sum over v of |d result/d v| |v|, where v are the inputs, the numbers, the terms of sums and all
    intermediate values (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1), by
    one backward sweep for each result. Raises as `evaluate`.
    """
    run, atom = _steps(function, _DOUBLES)
    outputs = [atom(o) for o in function.outputs]
    steps = [(a.name, *_linear(a.value)) for a in (*function.early, *function.body)]

    def bound(known: Mapping[str, float], coefficient: float, name: str) -> float:
        slopes, total = {name: coefficient}, 0.0
        for value, size, partials in reversed(steps):
            slope = slopes.pop(value, 0.0)
            if slope:
                total += abs(slope) * size(known)
                for argument, partial in partials(known):
                    slopes[argument] = slopes.get(argument, 0.0) + slope * partial
        return total + sum(abs(slope * known[n]) for n, slope in slopes.items())

    def evaluated(values: Mapping[str, float]) -> list[float]:
        known = run(values)
        found = [bound(known, c, n) for c, n in outputs]
        if not all(map(math.isfinite, found)):
            raise ValueError(f"{function.name} is not finite")
        return found

    return evaluated


def _linear(
    value: Value,
) -> tuple[
    Callable[[Mapping[str, float]], float],
    Callable[[Mapping[str, float]], list[tuple[str, float]]],
]:
    """The size of the terms of a right-hand side, and its partial derivatives by its names."""
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

        return lambda x: abs(_multiplied(x, coefficient, factors)), partials
    function = _DOUBLES[value.function]
    arguments = [(float(a.coefficient), a.name) for a in value.args]

    def called(x: Mapping[str, float]) -> float:
        return abs(float(_called(x, function, arguments)))

    def differences(x: Mapping[str, float]) -> list[tuple[str, float]]:
        points, found = [c * x[n] for c, n in arguments], list[tuple[str, float]]()
        middle = function(*points)
        for k, (c, n) in enumerate(arguments):
            step = DIFFERENCE * (abs(points[k]) or 1.0)
            for signed in (step, -step):  # one side may lie outside the domain
                moved = [y + signed * (i == k) for i, y in enumerate(points)]
                with suppress(ArithmeticError, ValueError):
                    found.append((n, c * (function(*moved) - middle) / signed))
                    break
        return found

    return called, differences


def nearby(system: System, k: int) -> dict[str, float]:
    """Values by name of the k-th of some states around the start (0: the start itself)."""
    out = {p.name: p.value for p in system.parameters} | {t.name: 0.0}
    for i, c in enumerate(system.coordinates):
        # steps in directions that have nothing to do with one another, short as they are printed
        out[c.name] = (
            float(f"{c.start + 0.37 * k * math.sin(1.0 + i + 2.3 * k):.6g}") if k else c.start
        )
        rate = c.rate + 0.53 * k * math.cos(0.7 + i + 1.9 * k)
        out[f"{c.name}_dot"] = float(f"{rate:.6g}") if k else c.rate
    return out
