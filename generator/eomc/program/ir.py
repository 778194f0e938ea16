"""Intermediate representation: functions as lists of sums, products and calls over names.

Assignments that depend on parameters only come first. Independent of mechanics and of C. Functions
are evaluated in Python, in doubles or forty digits, at a system's states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any

import mpmath
from sympy import Expr, Rational, S

from eomc.derive.tape import Stage
from eomc.model import algebra
from eomc.model.system import System, t
from eomc.scene import formulas


@dataclass(frozen=True)
class Sum:
    """The right-hand side of an assignment: constant + sum of coefficient * value.

    `terms` contains a pair (coefficient, name of the value) for each term.
    """

    terms: tuple[tuple[Expr, str], ...]
    constant: Expr = S.Zero

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the values in the sum, repeated as often as they occur."""
        return tuple([n for _, n in self.terms])


@dataclass(frozen=True)
class Product:
    """The right-hand side of an assignment: coefficient * product of values.

    `factors` contains the names of the values. For an integer power, the name is repeated.
    """

    coefficient: Expr
    factors: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the values in the product, repeated as often as they occur."""
        return self.factors


@dataclass(frozen=True)
class Call:
    """The right-hand side of an assignment: a function of operands.

    `function` is "reciprocal", "sqrt", "pow", "pivot_inverse" (1/pivot, or 0 for a pivot that is
    too small), or a function that formulas of scenes may contain, such as "sin". `args` contains
    the operands.
    """

    function: str
    args: tuple[Operand, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names in the arguments, repeated as often as they occur."""
        return tuple([a.name for a in self.args if a.name])


@dataclass(frozen=True)
class Operand:
    """A coefficient times a value, as an argument or a result of a function.

    `name` is the name of the value. If the operand is a number, `name` is empty and the coefficient
    is the number.
    """

    coefficient: Expr
    name: str = ""


Value = Sum | Product | Call


@dataclass(frozen=True)
class Assignment:
    """A statement "name = value" of a generated function.

    Attributes
    ----------
    value
        The right-hand side.
    stage
        The binding time: when the value can be computed, for example once for each set of
        parameters, or from q.
    named
        Whether the name is meaningful to a reader, unlike w1, w2, ...
    """

    name: str
    value: Value
    stage: Stage
    named: bool = False


@dataclass(frozen=True)
class Cost:
    """Number of operations of one call of a function.

    Operations that depend on parameters only are precomputed and not counted. `sincos` counts
    pairs of sine and cosine of the same angle, `calls` counts square roots and other functions of
    the mathematics library.
    """

    adds: int = 0
    multiplications: int = 0
    divisions: int = 0
    sincos: int = 0
    calls: int = 0  # square roots and other functions of the mathematics library

    @property
    def flops(self) -> int:
        """The number of additions, multiplications and divisions."""
        return self.adds + self.multiplications + self.divisions

    def __str__(self) -> str:
        parts = [
            (self.adds, "addition"),
            (self.multiplications, "multiplication"),
            (self.divisions, "division"),
            (self.sincos, "sincos"),
            (self.calls, "other call"),
        ]
        shown = [f"{n} {kind}{'s' if n > 1 and kind != 'sincos' else ''}" for n, kind in parts if n]
        return ", ".join(shown) or "no arithmetic"


@dataclass(frozen=True)
class Function:
    """One function of the generated code, as a list of assignments.

    Attributes
    ----------
    early
        Assignments that depend on parameters only.
    body
        All other assignments.
    outputs
        The results; matrices by rows.
    checks
        Pairs (pivot, diagonal entry) of a matrix factorization; the function fails unless all
        pivots are positive.
    cost
        Number of operations of one call.
    route
        The method of derivation (route) that was selected.
    routes
        The name of each possible route, with the cost of the function that it gives.
    """

    name: str
    early: tuple[Assignment, ...]
    body: tuple[Assignment, ...]
    outputs: tuple[Operand, ...]
    checks: tuple[tuple[Operand, Operand], ...]
    cost: Cost
    route: str
    routes: tuple[tuple[str, Cost], ...]

    @cached_property
    def uses(self) -> frozenset[str]:
        """The names of all values that the function reads and does not compute."""
        computed = {a.name for a in (*self.early, *self.body)}
        names = {n for a in (*self.early, *self.body) for n in a.value.names}
        results = [*self.outputs, *(o for pair in self.checks for o in pair)]
        return frozenset(names | {o.name for o in results if o.name}) - computed


def rename(function: Function, new_names: Mapping[str, str]) -> Function:
    """Return a copy of the function in which values have other names.

    `new_names` maps old names to new ones. Names that are absent from it are unchanged.
    """

    def new_name(name: str) -> str:
        return new_names.get(name, name)

    def operand(o: Operand) -> Operand:
        return replace(o, name=new_name(o.name)) if o.name else o

    def renamed(items: Iterable[Assignment]) -> tuple[Assignment, ...]:
        return tuple(
            Assignment(new_name(a.name), rename_value(a.value, new_name), a.stage, a.named)
            for a in items
        )

    return replace(
        function,
        early=renamed(function.early),
        body=renamed(function.body),
        outputs=tuple(map(operand, function.outputs)),
        checks=tuple((operand(a), operand(b)) for a, b in function.checks),
    )


def rename_value(value: Value, real: Callable[[str], str]) -> Value:
    """Return a copy of a right-hand side, in which each name n is replaced by `real(n)`."""
    if isinstance(value, Sum):
        return Sum(tuple((w, real(n)) for w, n in value.terms), value.constant)
    if isinstance(value, Product):
        return Product(value.coefficient, tuple(real(n) for n in value.factors))
    return Call(
        value.function, tuple(replace(a, name=real(a.name)) if a.name else a for a in value.args)
    )


def names_of_pair(names: Mapping[str, str]) -> tuple[str, str]:
    """Return the names of the sine and of the cosine of an angle.

    `names` maps "sin", "cos" or both to existing names. If one of the two is missing, its name is
    derived from the other one, as cos_theta_ from sin_theta.
    """
    sine = names.get("sin") or names["cos"].replace("cos", "sin") + "_"
    return sine, names.get("cos") or names["sin"].replace("sin", "cos") + "_"


# --- evaluation in Python -------------------------------------------------------------------------

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
        **algebra.mpmath_functions(mp),
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
