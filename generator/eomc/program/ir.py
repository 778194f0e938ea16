"""The small language that programs are written in.

A function is a list of sums, products and calls over names; what depends on parameters alone comes
first. Knows nothing of mechanics or C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from sympy import Expr, S

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
    """name = value, known from `stage` on; `named` where the name says what it is."""

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
        found = [f"{n} {what}{'s' if n > 1 and what != 'sincos' else ''}" for n, what in parts if n]
        return ", ".join(found) or "no arithmetic"


@dataclass(frozen=True)
class Function:
    """One function of the generated code.

    `early` depends on parameters alone, `body` on the rest; `outputs` are the results, row-major
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
