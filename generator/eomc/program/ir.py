"""Assignments: the small language that programs are written in, and its evaluation in Python.

A function is a list of sums, products and calls over names; what hangs on parameters alone comes
first. Knows nothing of mechanics or C.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import mpmath
from sympy import Expr, Rational, S

from eomc.derive.tape import Stage


@dataclass(frozen=True)
class Sum:
    """sum of coefficient times name, plus a constant."""

    terms: tuple[tuple[Expr, str], ...]
    constant: Expr = S.Zero

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names on this right-hand side, repeated as often as they stand there."""
        return tuple([n for _, n in self.terms])


@dataclass(frozen=True)
class Product:
    """coefficient times a product of names, repeated for whole powers."""

    coefficient: Expr
    factors: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """As of a sum."""
        return self.factors


@dataclass(frozen=True)
class Call:
    """A function of atoms: "reciprocal", "sqrt", "pow" or one of the scene's functions."""

    function: str
    args: tuple[Operand, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """As of a sum."""
        return tuple([a.name for a in self.args if a.name])


@dataclass(frozen=True)
class Operand:
    """A number times a name; the name is empty for a number alone."""

    coefficient: Expr
    name: str = ""


Value = Sum | Product | Call


@dataclass(frozen=True)
class Assignment:
    """name = value, known from `stage` on; `named` where the name tells what it is."""

    name: str
    value: Value
    stage: Stage
    named: bool = False


@dataclass(frozen=True)
class Cost:
    """Operations of one call, those that depend on parameters alone left out."""

    adds: int = 0
    multiplications: int = 0
    divisions: int = 0
    sincos: int = 0
    calls: int = 0  # square roots and other functions of the mathematics library

    @property
    def flops(self) -> int:
        """Additions, multiplications and divisions."""
        return self.adds + self.multiplications + self.divisions

    def __str__(self) -> str:
        parts = [
            (self.adds, "addition"),
            (self.multiplications, "multiplication"),
            (self.divisions, "division"),
            (self.sincos, "sincos"),
            (self.calls, "other call"),
        ]
        told = [f"{n} {what}{'s' if n > 1 and what != 'sincos' else ''}" for n, what in parts if n]
        return ", ".join(told) or "no arithmetic"


@dataclass(frozen=True)
class Function:
    """One function of the generated code.

    `early` hangs on parameters alone, `body` on the rest; `outputs` are the results, row-major
    where they are a matrix. `checks` are (pivot, diagonal) pairs that must be positive.
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
        """Every name that the function reads."""
        made = {a.name for a in (*self.early, *self.body)}
        read = {n for a in (*self.early, *self.body) for n in a.value.names}
        ends = [*self.outputs, *(o for pair in self.checks for o in pair)]
        return frozenset(read | {o.name for o in ends if o.name}) - made


def rename(function: Function, new: Mapping[str, str]) -> Function:
    """The function with other names for some of its values."""

    def real(name: str) -> str:
        return new.get(name, name)

    def operand(o: Operand) -> Operand:
        return replace(o, name=real(o.name)) if o.name else o

    def renamed(items: Iterable[Assignment]) -> tuple[Assignment, ...]:
        return tuple(
            Assignment(real(a.name), renamed_value(a.value, real), a.stage, a.named) for a in items
        )

    return replace(
        function,
        early=renamed(function.early),
        body=renamed(function.body),
        outputs=tuple(map(operand, function.outputs)),
        checks=tuple((operand(a), operand(b)) for a, b in function.checks),
    )


def renamed_value(value: Value, real: Callable[[str], str]) -> Value:
    """A right-hand side with other names."""
    if isinstance(value, Sum):
        return Sum(tuple((w, real(n)) for w, n in value.terms), value.constant)
    if isinstance(value, Product):
        return Product(value.coefficient, tuple(real(n) for n in value.factors))
    return Call(
        value.function, tuple(replace(a, name=real(a.name)) if a.name else a for a in value.args)
    )


# --- evaluation in Python -----------------------------------------------------------------------

_NAMES = "sin cos tan asin acos atan atan2 sinh cosh tanh exp log sqrt".split()

_DOUBLES: Mapping[str, Callable[..., Any]] = {
    **{name: getattr(math, name) for name in _NAMES},
    "number": float,
    "pow": math.pow,
    "abs": abs,
    "sign": lambda x: (x > 0) - (x < 0),
    "heaviside": lambda x: 0.5 + 0.5 * ((x > 0) - (x < 0)),
    "min": min,
    "max": max,
    "reciprocal": lambda x: 1 / x,
}


def _many_digits() -> Mapping[str, Callable[..., Any]]:
    """The same in 40 digits."""
    mp = mpmath.mp.clone()
    mp.dps = 40
    return {
        **_DOUBLES,
        **{name: getattr(mp, name) for name in _NAMES},
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
    of = _many_digits() if exact else _DOUBLES
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
    outputs = [atom(o) for o in function.outputs]
    checks = [(atom(pivot), atom(diagonal)) for pivot, diagonal in function.checks]
    tolerance = 8 * unit * max(1, len(checks))

    def evaluated(values: Mapping[str, float]) -> tuple[list[float], bool]:
        known: dict[str, Any] = {"": 1, **values}  # a number alone has no name
        for name, do, first, rest in steps:
            known[name] = do(known, first, rest)
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


def _added(known: Mapping[str, Any], constant: Any, terms: Sequence[tuple[Any, str]]) -> Any:
    return sum([w * known[n] for w, n in terms], constant)


def _multiplied(known: Mapping[str, Any], coefficient: Any, factors: Sequence[str]) -> Any:
    return math.prod([known[n] for n in factors], start=coefficient)


def _called(known: Mapping[str, Any], do: Callable[..., Any], args: Sequence[Any]) -> Any:
    return do(*[c * known[n] for c, n in args])
