"""Symbols of a system: coordinates, parameters, inputs, outputs, events, constraints, time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy
from sympy import Expr, Symbol

t = Symbol("t", real=True)

# suffix of the component of a direction along a variable; users' names do not end in it
ALONG = "_along_"
MULTIPLIER = "_lambda_"  # suffix of a constraint's Lagrange multiplier
PARTS = ("_lack_", "_pivot_")  # suffixes of the numerator and denominator of a multiplier


class dot(sympy.Function):  # type: ignore[misc]  # noqa: N801 - it prints as the scene writes it
    """The total time derivative of its argument, not evaluated."""

    nargs = 1
    is_real = True

    @classmethod
    def eval(cls, inner: Any) -> Any:
        """Return zero for a number."""
        return sympy.S.Zero if inner.is_number else None

    def _latex(self, printer: Any, exp: str = "") -> str:
        rate = rf"\frac{{d}}{{dt}} \left({printer._print(self.args[0])}\right)"
        return rf"\left({rate}\right)^{{{exp}}}" if exp else rate


class pivot_inverse(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as the tape has it
    """The function (pivot, limit): 1/pivot if the pivot exceeds the limit, else 0."""

    nargs = 2
    is_real = True

    @classmethod
    def eval(cls, pivot: Expr, limit: Expr) -> Expr | None:
        """Evaluate for numbers."""
        if not (pivot.is_number and limit.is_number):
            return None
        return 1 / pivot if pivot > limit else sympy.S.Zero

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return the derivative of 1/pivot; the limit is constant."""
        return -(self**2) if argindex == 1 else sympy.S.Zero


@lru_cache(maxsize=10_000)  # SymPy takes ten times as long for a symbol that exists
def symbol(name: str) -> Symbol:
    """Return the symbol of a name; all symbols of a system are real."""
    return Symbol(name, real=True)


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate `q` and its velocity `qd`; `start` in `unit`, `rate` in unit/s.

    start_fixed, rate_fixed: whether the assembly of consistent initial values keeps them as given.
    follows, rate_follows: formulas of start and rate if these depend on parameters, else "".
    """

    name: str
    unit: str = ""
    start: float = 0.0
    rate: float = 0.0
    note: str = ""
    start_fixed: bool = True
    rate_fixed: bool = True
    follows: str = ""
    rate_follows: str = ""

    @property
    def q(self) -> Symbol:
        """The coordinate's symbol."""
        return symbol(self.name)

    @property
    def qd(self) -> Symbol:
        """The velocity's symbol, `<name>_dot`."""
        return symbol(f"{self.name}_dot")

    @property
    def qdd(self) -> Symbol:
        """The acceleration's symbol, `<name>_ddot`, which occurs in outputs only."""
        return symbol(f"{self.name}_ddot")


@dataclass(frozen=True)
class _Named:
    name: str

    @property
    def symbol(self) -> Symbol:
        """The symbol of its name."""
        return symbol(self.name)


@dataclass(frozen=True)
class Parameter(_Named):
    """A number that may change at run time."""

    value: float
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Output(_Named):
    """An output of the model; its formula may use all variables, accelerations too."""

    formula: Expr
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Input(_Named):
    """An external input, given at each step; `signal` is its default value.

    limits: saturation limits (lower, upper), None where there is none.
    """

    unit: str = ""
    signal: Expr = sympy.S.Zero
    note: str = ""
    limits: tuple[Expr | None, ...] = (None, None)

    @property
    def limited(self) -> Expr:
        """The input saturated at its limits."""
        lower, upper = self.limits
        value = self.symbol if lower is None else sympy.Max(self.symbol, lower)
        return value if upper is None else sympy.Min(value, upper)


@dataclass(frozen=True)
class Event(_Named):
    """An event with the event function `when`; direction: "rising", "falling" or "both".

    action: "record", "stop" or "jump". jump: new values of coordinates, velocities and parameters,
    by name. begins: an expression that triggers the event if it is positive at the start of a run
    or after a jump. above: whether `when` cannot become negative immediately after it was zero; a
    sign change there means that it was positive for a short time.
    """

    when: Expr
    direction: str = "both"
    action: str = "record"
    jump: tuple[tuple[str, Expr], ...] = ()
    unit: str = ""
    note: str = ""
    begins: Expr | None = None
    above: bool = False


@dataclass(frozen=True)
class Constraint(_Named):
    """A constraint equation formula = 0 over t, coordinates, parameters and definitions.

    holonomic: whether it depends on positions and t only; else it is linear in the velocities.
    loop: name of the [[loop]] to which it belongs. redundant: whether other constraints imply it,
    so that it has no multiplier. switched: whether it is active in some friction modes only and
    identically zero in the others. rotation_error: for an axis equation of a loop, the component of
    2 tan(a/2) n along the axis after which it is named, where the rotation error is an angle a
    about n, and cos(a/2)^2. It is zero only if the joint is closed; initial values are assembled
    with it.
    """

    formula: Expr
    holonomic: bool = True
    unit: str = ""
    note: str = ""
    loop: str = ""
    redundant: bool = False
    switched: bool = False
    rotation_error: tuple[Expr, Expr] | None = None

    @property
    def multiplier(self) -> Symbol:
        """The constraint's Lagrange multiplier, in reactions."""
        return multiplier_of(self.name)

    @property
    def parts(self) -> tuple[Symbol, ...]:
        """For a switched constraint, in events: multiplier times pivot, and the pivot (>= 0)."""
        return tuple(symbol(f"{self.name}{part}") for part in PARTS)


@dataclass(frozen=True)
class FrictionMode:
    """A discrete coordinate: 1, -1 or 0 as another one slides forwards, backwards or sticks.

    at: index of the discrete coordinate. of: index of the other one.
    """

    at: int
    of: int


@dataclass(frozen=True)
class Reaction(_Named):
    """The reaction of a [[loop]] on its second body, over definitions and multipliers.

    values: force (2) and moment about the joint's point in the plane; force (3) and moment (3) in
    space, in world axes. branches: expressions that are 1 if the joint is closed. At other
    rotations that satisfy the axis equations, one of them is 0 or -1.
    """

    values: tuple[Expr, ...]
    note: str = ""
    branches: tuple[Expr, ...] = ()


def multiplier_of(row: str) -> Symbol:
    """Return the Lagrange multiplier of the constraint with a name."""
    return symbol(f"{row}{MULTIPLIER}")


def resolved(definitions: Sequence[tuple[Symbol, Expr]]) -> dict[Expr, Expr]:
    """Return each definition with the others substituted, by its symbol."""
    known: dict[Expr, Expr] = {}
    for name, e in definitions:
        known[name] = e.xreplace(known)
    return known


def needed(
    definitions: Sequence[tuple[Symbol, Expr]], ends: Sequence[Expr]
) -> list[tuple[Symbol, Expr]]:
    """Return the definitions on which `ends` depend, in their order."""
    known: Mapping[Symbol, Expr] = dict(definitions)
    required: set[Symbol] = set()
    queue = [s for end in ends for s in end.free_symbols]
    while queue:
        name = queue.pop()
        if name in known and name not in required:
            required.add(name)
            queue.extend(known[name].free_symbols)
    return [(name, e) for name, e in definitions if name in required]
