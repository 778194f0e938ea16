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
    """A right-hand side: a constant plus a sum of products of a coefficient and a name.

    `terms` contains the pairs (coefficient, name).
    """

    terms: tuple[tuple[Expr, str], ...]
    constant: Expr = S.Zero

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names in the sum, repeated as often as they occur."""
        return tuple([n for _, n in self.terms])


@dataclass(frozen=True)
class Product:
    """A right-hand side: coefficient times a product of names.

    Integer powers are written as repeated names.
    """

    coefficient: Expr
    factors: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names in the product, repeated as often as they occur."""
        return self.factors


@dataclass(frozen=True)
class Call:
    """A right-hand side: a function of operands.

    `function` is "reciprocal", "sqrt", "pow", "pivot_inverse" or one of the functions of scenes.
    """

    function: str
    args: tuple[Operand, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names in the arguments, repeated as often as they occur."""
        return tuple([a.name for a in self.args if a.name])


@dataclass(frozen=True)
class Operand:
    """A coefficient times a name, as an argument or a result. A number alone has an empty name."""

    coefficient: Expr
    name: str = ""


Value = Sum | Product | Call


@dataclass(frozen=True)
class Assignment:
    """A statement "name = value" of a function.

    Attributes
    ----------
    stage
        The binding time: when the value can be computed, see `Stage`.
    named
        Whether the name is meaningful to a reader.
    """

    name: str
    value: Value
    stage: Stage
    named: bool = False


@dataclass(frozen=True)
class Cost:
    """Number of operations of one call of a function.

    Operations that depend on parameters only are not counted, since they are precomputed. `calls`
    counts square roots and other functions of the mathematics library.
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
        Pairs (pivot, diagonal entry); all pivots must be positive.
    cost
        Number of operations of one call.
    route, routes
        The method of derivation (route) that was selected, and the cost with each route.
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
    """Return the function with its values renamed: `new_names` maps old names to new ones."""

    def new_name(name: str) -> str:
        return new_names.get(name, name)

    def operand(o: Operand) -> Operand:
        return replace(o, name=new_name(o.name)) if o.name else o

    def renamed(items: Iterable[Assignment]) -> tuple[Assignment, ...]:
        return tuple(
            Assignment(new_name(a.name), renamed_value(a.value, new_name), a.stage, a.named)
            for a in items
        )

    return replace(
        function,
        early=renamed(function.early),
        body=renamed(function.body),
        outputs=tuple(map(operand, function.outputs)),
        checks=tuple((operand(a), operand(b)) for a, b in function.checks),
    )


def renamed_value(value: Value, real: Callable[[str], str]) -> Value:
    """Return a right-hand side with each of its names replaced by `real(name)`."""
    if isinstance(value, Sum):
        return Sum(tuple((w, real(n)) for w, n in value.terms), value.constant)
    if isinstance(value, Product):
        return Product(value.coefficient, tuple(real(n) for n in value.factors))
    return Call(
        value.function, tuple(replace(a, name=real(a.name)) if a.name else a for a in value.args)
    )
