"""Intermediate representation: functions as lists of sums, products and calls over names.

Assignments that depend on parameters only come first. Independent of mechanics and of C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from sympy import Expr, S

from eomc.derive.tape import Stage


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
