"""What a system is written in: coordinates, parameters, inputs, the time, rates as they stand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy
from sympy import Expr, Symbol

t = Symbol("t", real=True)

# behind a name: a direction's entry along it; no name of a user's ends so
ALONG = "_along_"
MULTIPLIER = "_lambda_"  # likewise behind a constraint's name, its Lagrange multiplier
PARTS = ("_lack_", "_pivot_")  # and what that is made of


class dot(sympy.Function):  # type: ignore[misc]  # noqa: N801 - it prints as the scene writes it
    """The total time derivative of its argument, kept as it stands until it is asked for."""

    nargs = 1
    is_real = True

    @classmethod
    def eval(cls, inner: Any) -> Any:
        """Zero of a number, which does not change."""
        return sympy.S.Zero if inner.is_number else None

    def _latex(self, printer: Any, exp: str = "") -> str:
        rate = rf"\frac{{d}}{{dt}} \left({printer._print(self.args[0])}\right)"
        return rf"\left({rate}\right)^{{{exp}}}" if exp else rate


class pivot_inverse(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as the tape has it
    """1/pivot where the pivot is more than a limit, else 0: (pivot, limit)."""

    nargs = 2
    is_real = True

    @classmethod
    def eval(cls, pivot: Expr, limit: Expr) -> Expr | None:
        """Of numbers a number."""
        if not (pivot.is_number and limit.is_number):
            return None
        return 1 / pivot if pivot > limit else sympy.S.Zero

    def fdiff(self, argindex: int = 1) -> Expr:
        """That of 1/pivot; the limit does not count."""
        return -(self**2) if argindex == 1 else sympy.S.Zero


@lru_cache(maxsize=10_000)  # SymPy takes ten times as long to find one that it has
def symbol(name: str) -> Symbol:
    """The symbol of a name; all of a system's symbols are real."""
    return Symbol(name, real=True)


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate `q` and its velocity `qd`; `start` in `unit`, `rate` in unit/s.

    start_fixed, rate_fixed: whether the assembly of consistent initial values keeps them as given.
    follows, rate_follows: the formulas of start and rate where these are of parameters, else "".
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
        """The acceleration's symbol, `<name>_ddot`, which outputs alone have."""
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
    """A quantity that is asked for; its formula is over everything, accelerations too."""

    formula: Expr
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Input(_Named):
    """A quantity given from outside at every step; `signal` is its value by default.

    limits: the least and largest value that acts, None where there is none.
    """

    unit: str = ""
    signal: Expr = sympy.S.Zero
    note: str = ""
    limits: tuple[Expr | None, ...] = (None, None)

    @property
    def limited(self) -> Expr:
        """What acts: the input within its limits."""
        least, most = self.limits
        within = self.symbol if least is None else sympy.Max(self.symbol, least)
        return within if most is None else sympy.Min(within, most)


@dataclass(frozen=True)
class Event(_Named):
    """Where `when` crosses zero, "rising", "falling" or "both"; action: "record", "stop", "jump".

    jump: what coordinates and velocities are then, by their names. begins: what is above zero where
    it happens, wherever `when` is, as a run or the motion behind a jump begins. above: whether
    `when` can't leave zero downwards: where it seems to, that comes behind a short way upwards.
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
    """What is zero along every motion: a formula over t, coordinates, parameters and definitions.

    holonomic: of positions and t alone; else it is linear in the rates. loop: the [[loop]] that the
    row is of. redundant: whether the other rows say the same, so that none is solved for it.
    switched: whether it holds in some modes only, and is zero by itself in the others.
    rotation_error: of a loop's row of axes, the component of 2 tan(a/2) n along the axis that the
    row is named after, where the second frame is out by an angle a about n, and cos(a/2)^2: zero
    only where the joint is closed as is meant; a start is assembled with it.
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
        """The row's Lagrange multiplier, in reactions."""
        return multiplier_of(self.name)

    @property
    def parts(self) -> tuple[Symbol, ...]:
        """Of one that is switched, in events: its multiplier times its pivot, and this, >= 0."""
        return tuple(symbol(f"{self.name}{part}") for part in PARTS)


@dataclass(frozen=True)
class FrictionMode:
    """A coordinate that is 1, -1 or 0, as another slides forwards, backwards or sticks.

    at, of: the places of both among the coordinates.
    """

    at: int
    of: int


@dataclass(frozen=True)
class Reaction(_Named):
    """What a [[loop]] does to the second of its bodies, over definitions and multipliers.

    values: the force (2) and the moment about the joint's point in the plane; force (3) and moment
    (3) in space, along the world's axes. branches: 1 where the joint is closed as it is meant;
    rows of its axes hold after some other turns too, where one of these is 0 or -1.
    """

    values: tuple[Expr, ...]
    note: str = ""
    branches: tuple[Expr, ...] = ()


def multiplier_of(row: str) -> Symbol:
    """The Lagrange multiplier of a constraint of that name."""
    return symbol(f"{row}{MULTIPLIER}")


def resolved(definitions: Sequence[tuple[Symbol, Expr]]) -> dict[Expr, Expr]:
    """Each definition over no other, by its symbol."""
    known: dict[Expr, Expr] = {}
    for name, e in definitions:
        known[name] = e.xreplace(known)
    return known


def needed(
    definitions: Sequence[tuple[Symbol, Expr]], ends: Sequence[Expr]
) -> list[tuple[Symbol, Expr]]:
    """The definitions that `ends` depend on, in their order."""
    known: Mapping[Symbol, Expr] = dict(definitions)
    found: set[Symbol] = set()
    queue = [s for end in ends for s in end.free_symbols]
    while queue:
        name = queue.pop()
        if name in known and name not in found:
            found.add(name)
            queue.extend(known[name].free_symbols)
    return [(name, e) for name, e in definitions if name in found]
