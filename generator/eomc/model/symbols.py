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


def add_suffix(name: str, suffix: str) -> str:
    """Return `name` with a suffix such as "_dot", without two underscores in a row.

    Names in C may end in an underscore: the velocity of `I_` is `I_dot`.
    """
    return name.rstrip("_") + suffix


class dot(sympy.Function):  # type: ignore[misc]  # noqa: N801 - it prints as the scene writes it
    """SymPy function dot(e) for the total time derivative of e, which is not evaluated."""

    nargs = 1
    is_real = True

    @classmethod
    def eval(cls, inner: Any) -> Any:
        """Return 0 if `inner` is a number, else None, so that SymPy keeps dot(inner) as it is."""
        return sympy.S.Zero if inner.is_number else None

    def _latex(self, printer: Any, exp: str = "") -> str:
        rate = rf"\frac{{d}}{{dt}} \left({printer.parenthesize(self.args[0], 0)}\right)"
        return rf"\left({rate}\right)^{{{exp}}}" if exp else rate


class pivot_inverse(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as the tape has it
    """SymPy function pivot_inverse(pivot, limit): 1/pivot if pivot > limit, else 0."""

    nargs = 2
    is_real = True

    @classmethod
    def eval(cls, pivot: Expr, limit: Expr) -> Expr | None:
        """Return the value if both arguments are numbers, else None (SymPy keeps the call)."""
        if not (pivot.is_number and limit.is_number):
            return None
        return 1 / pivot if pivot > limit else sympy.S.Zero

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return the derivative with respect to the pivot (argument 1) or the limit (argument 2).

        argindex: 1 for the derivative with respect to the pivot, -1/pivot^2 or 0 if pivot <= limit;
        2 for the derivative with respect to the limit, which is 0.
        """
        return -(self**2) if argindex == 1 else sympy.S.Zero


@lru_cache(maxsize=10_000)  # SymPy takes ten times as long for a symbol that exists
def symbol(name: str) -> Symbol:
    """Return the SymPy symbol `name` with the assumption real, as all symbols of a system have."""
    return Symbol(name, real=True)


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate with its initial values.

    Attributes
    ----------
    name, unit, note
        Name, unit and description.
    start, rate
        Initial value in `unit` and initial velocity in `unit`/s.
    start_fixed, rate_fixed
        Whether start and rate are kept when initial values are adjusted to the constraints.
    follows, rate_follows
        Formulas of start and rate if these depend on parameters, else "".
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
        """The symbol of the coordinate."""
        return symbol(self.name)

    @property
    def qd(self) -> Symbol:
        """The symbol of the velocity, `<name>_dot`."""
        return symbol(add_suffix(self.name, "_dot"))

    @property
    def qdd(self) -> Symbol:
        """The symbol of the acceleration, `<name>_ddot`, which occurs in outputs only."""
        return symbol(add_suffix(self.name, "_ddot"))


@dataclass(frozen=True)
class _Named:
    name: str

    @property
    def symbol(self) -> Symbol:
        """The symbol with the name of the quantity."""
        return symbol(self.name)


@dataclass(frozen=True)
class Parameter(_Named):
    """A parameter of a system: a number that can be set at run time.

    value: its default, in `unit`.
    """

    value: float
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Output(_Named):
    """An output of a system, a quantity computed from the state.

    formula: its value in `unit`, over all variables of the system and the accelerations.
    """

    formula: Expr
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Input(_Named):
    """An external input of a system, such as the force of an actuator.

    signal: its default value, an expression. limits: lower and upper limit at which the input is
    saturated; None for no limit.
    """

    unit: str = ""
    signal: Expr = sympy.S.Zero
    note: str = ""
    limits: tuple[Expr | None, ...] = (None, None)

    @property
    def limited(self) -> Expr:
        """The expression of the input saturated at its limits, min(max(u, lower), upper)."""
        lower, upper = self.limits
        value = self.symbol if lower is None else sympy.Max(self.symbol, lower)
        return value if upper is None else sympy.Min(value, upper)


@dataclass(frozen=True)
class Event(_Named):
    """An event, which is triggered when its event function crosses zero.

    Attributes
    ----------
    when
        The event function.
    direction
        Crossings that trigger the event: "rising", "falling" or "both".
    action
        "record" the event, "stop" the run, or let the state "jump".
    jump
        Pairs (name, new value) of coordinates, velocities and parameters that a jump sets.
    begins
        Expression that triggers the event if it is positive at the start of a run or after a jump;
        None for none.
    above
        True if `when` cannot become negative immediately after it was zero. If it is negative
        later, it was positive for a short time in between.
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
    """A constraint equation, formula = 0.

    Attributes
    ----------
    formula
        Expression over t, coordinates, velocities, parameters and definitions.
    holonomic
        True if the formula depends on coordinates and t only, False if it is linear in velocities.
    loop
        Name of the [[loop]] to which it belongs, or "".
    redundant
        Whether other constraints imply it, so that it has no multiplier.
    switched
        Whether it is active in some friction modes only and identically zero in the others.
    rotation_error
        For an equation that aligns axes of a loop joint, the pair (component of 2 tan(a/2) n along
        the axis after which the equation is named, cos(a/2)^2), where the rotation error of the
        joint is an angle a about the unit vector n. The component is zero only if the joint is
        closed; initial values that satisfy the constraints are computed with it.
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
        """The symbol of the Lagrange multiplier, which occurs in reactions and outputs."""
        return multiplier_of(self.name)

    @property
    def parts(self) -> tuple[Symbol, ...]:
        """Two symbols (multiplier times pivot, pivot) for events of a switched constraint.

        The pivot is that of the constraint equation in the elimination for the multipliers, >= 0.
        The Lagrange multiplier of the constraint is the quotient of the two.
        """
        return tuple(symbol(f"{self.name}{part}") for part in PARTS)


@dataclass(frozen=True)
class FrictionMode:
    """The friction mode of a coordinate with stick-slip friction, which is a discrete coordinate.

    Its value is 1 if the coordinate slides forwards, -1 if it slides backwards, and 0 if it sticks.
    at: index of the discrete coordinate. of: index of the coordinate with friction.
    """

    at: int
    of: int


@dataclass(frozen=True)
class Reaction(_Named):
    """The force and moment that the joint of a [[loop]] exerts on its second body.

    Attributes
    ----------
    values
        Expressions over definitions and multipliers, in world axes. In the plane: two components
        of the force (N) and the moment about the joint's point (N m); in space: three of each.
    branches
        Expressions that are 1 if the joint is closed. They detect a wrong solution of the equations
        that align axes: one of them is then 0 or -1.
    """

    values: tuple[Expr, ...]
    note: str = ""
    branches: tuple[Expr, ...] = ()


def multiplier_of(row: str) -> Symbol:
    """Return the symbol of the Lagrange multiplier of a constraint. row: name of the constraint."""
    return symbol(f"{row}{MULTIPLIER}")


def resolve_definitions(definitions: Sequence[tuple[Symbol, Expr]]) -> dict[Expr, Expr]:
    """Return a dict from the symbol of each definition to its fully substituted expression.

    definitions: pairs (symbol, expression), each over the symbols before it. In the result, these
    symbols are replaced by their expressions.
    """
    known: dict[Expr, Expr] = {}
    for name, e in definitions:
        known[name] = e.xreplace(known)
    return known


def needed_definitions(
    definitions: Sequence[tuple[Symbol, Expr]], ends: Sequence[Expr]
) -> list[tuple[Symbol, Expr]]:
    """Return the definitions on which expressions depend, in the order of `definitions`.

    definitions: pairs (symbol, expression), each over the symbols before it. ends: the expressions.
    """
    known: Mapping[Symbol, Expr] = dict(definitions)
    required: set[Symbol] = set()
    queue = [s for end in ends for s in end.free_symbols]
    while queue:
        name = queue.pop()
        if name in known and name not in required:
            required.add(name)
            queue.extend(known[name].free_symbols)
    return [(name, e) for name, e in definitions if name in required]
