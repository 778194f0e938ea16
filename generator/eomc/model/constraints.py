"""Rows of constraints: those of positions, those linear in the rates, and what no row can be."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from eomc.model import loops
from eomc.model.loops import Closed
from eomc.model.numeric import compiled
from eomc.model.symbols import Constraint, Coordinate, dot, needed, t

NEAR = 1e-9  # m, or rad: a row that is off by less is zero
ROUNDING = 1e-13  # of a loop's size, or of 1 where its row is of axes: it has not moved
BENDING = (sympy.Abs, sympy.Max, sympy.Min, sympy.sign, sympy.Heaviside)
PLACES = 4  # at which rows of loops are compared
LONGEST = 80  # characters of a position that a message writes out

NOTHING_MOVES = (
    "has no coordinates or rates, so that no motion can make it zero: write what is to be zero, "
    "such as x**2 + y**2 - l**2"
)
NOT_LINEAR = (
    "is not linear in the rates: a row of rates is a sum of rates, each times a factor of "
    "coordinates, t and parameters, as in x_dot*sin(psi) - y_dot*cos(psi); what is no such sum "
    "is a force or a control law, in [forces]"
)
_DRIFTS = "is the rate of a position, and where rates alone are held, the position drifts: "


@dataclass(frozen=True)
class Degree:
    """How an expression depends on rates.

    degree: 0, 1, or 2 for all that is not linear. moves: what else it varies with: 0 nothing, 1 the
    time, 2 coordinates. exact: of degree 1, sums of rates and dot(...) with constant factors, and
    functions of time: the rate of a position.
    """

    degree: int = 0
    moves: int = 0
    exact: bool = False


_FIXED, _TIME, _POSITION, _RATE = Degree(), Degree(0, 1), Degree(0, 2), Degree(1, 2, True)
_NONLINEAR = Degree(2, 2)


class VelocityDegree:
    """How expressions depend on rates, definitions followed."""

    def __init__(
        self, coordinates: Iterable[Coordinate], definitions: Iterable[tuple[Symbol, Expr]]
    ) -> None:
        self.known: dict[Expr, Degree] = {t: _TIME}
        for c in coordinates:
            self.known |= {c.q: _POSITION, c.qd: _RATE}
        for name, e in definitions:
            self.known[name] = self.of(e)

    def of(self, e: Expr) -> Degree:
        """That of an expression over coordinates, rates, t, parameters and the definitions."""
        found = self.known.get(e)
        if found is None:
            found = self._made(e, [self.of(part) for part in e.args])
            self.known[e] = found
        return found

    def _made(self, e: Expr, parts: Sequence[Degree]) -> Degree:
        degree = max((p.degree for p in parts), default=0)
        moves = max((p.moves for p in parts), default=0)
        if isinstance(e, dot):
            (inside,) = parts
            return (_FIXED, _TIME, _RATE)[inside.moves] if not inside.degree else _NONLINEAR
        if degree == 0:
            return Degree(0, moves)
        if isinstance(e, sympy.Add):
            exact = all(p.exact or (p.degree == 0 and p.moves < 2) for p in parts)
            return Degree(degree, moves, exact and degree == 1)
        if isinstance(e, sympy.Mul):
            degree = sum(p.degree for p in parts)
            factors = [p for p in parts if p.degree == 0]
            still = all(p.moves == 0 for p in factors)
            return Degree(min(degree, 2), moves, degree == 1 and still and self._exact(parts))
        return _NONLINEAR

    @staticmethod
    def _exact(parts: Iterable[Degree]) -> bool:
        return all(p.exact for p in parts if p.degree)


class Rows:
    """What rows are, and what is wrong with them, over a system's coordinates and definitions.

    values: of the parameters. fault, doubt: called with a row and what is wrong with it.
    """

    def __init__(
        self,
        coordinates: Sequence[Coordinate],
        definitions: Sequence[tuple[Symbol, Expr]],
        values: Mapping[Symbol, float],
        fault: Callable[[Constraint, str], None],
        doubt: Callable[[Constraint, str], None],
    ) -> None:
        self.coordinates = coordinates
        self.definitions = definitions
        self.values = values
        self.fault = fault
        self.doubt = doubt
        self.depends = VelocityDegree(coordinates, definitions)

    def sorted(self, rows: Iterable[Constraint]) -> tuple[Constraint, ...]:
        """The rows, holonomic ones first, each told what it is."""
        holonomic, others = [], []
        for row in rows:
            found = self.depends.of(row.formula)
            if found.moves < 2:
                self.fault(row, NOTHING_MOVES)
            elif found.degree > 1:
                self.fault(row, NOT_LINEAR)
            elif found.degree == 0:
                holonomic.append(row)
            else:
                if found.exact:
                    self.doubt(row, _DRIFTS + _instead(row.formula, self.coordinates))
                others.append(replace(row, holonomic=False))
        return (*holonomic, *others)

    def settled(self, closed: Closed) -> Closed:
        """A loop without the rows that no coordinate changes; each is reported."""
        fixed = [self._fixed(row.formula) for row in closed.rows]
        if closed.points and None in fixed:
            hardly = self._hardly_moved(closed)
            fixed = [b if a is None else a for a, b in zip(fixed, hardly, strict=True)]
        kept, still = loops.settled(closed, fixed)
        far = [(row, value) for row, value in still if not abs(value) <= NEAR]
        for row, value in far:
            why = f"can't close: its row {row.name} is {value:.6g} wherever its bodies move"
            self.fault(row, f"{why}: check its points and axes")
        if not kept.rows and not far:
            self.fault(still[0][0], "its bodies do not move against each other: leave it out")
        elif still and not far:
            row, names = still[0][0], ", ".join(row.name for row, _ in still)
            what = "a row that is" if len(still) == 1 else "rows that are"
            why = f"has {what} zero wherever its bodies move, left out: {names}"
            self.doubt(row, f"{why}; what they would carry is not determined, and counts as zero")
        return kept

    def _fixed(self, e: Expr) -> float | None:
        """The value of what no coordinate changes; None of anything else."""
        if self.depends.of(e).moves == 2:
            return None
        known: dict[Expr, Expr] = {name: sympy.Float(v) for name, v in self.values.items()}
        for name, formula in needed(self.definitions, [e]):
            known[name] = formula.xreplace(known)
        value = e.xreplace(known).evalf()
        return float(value) if value.is_number else math.inf  # of t: no such loop stays closed

    def _hardly_moved(self, closed: Closed) -> list[float | None]:
        """The values of a loop's rows that change by rounding alone, None of others.

        Where axes and points are given in doubles, those of a plane mechanism that is tilted in
        space are parallel to sixteen digits, and rows across the plane change by what is left, at
        other parameters too.
        """
        wanted = [*(x for point in closed.points for x in point), *(r.formula for r in closed.rows)]
        known = needed(self.definitions, wanted)
        if any(e.has(*BENDING) for e in (*wanted, *(formula for _, formula in known))):
            return [None] * len(closed.rows)  # such a row may be level for a while
        names = [*self.values, t, *(c.q for c in self.coordinates)]
        of = compiled(names, wanted, "math", known)
        draw, found = random.Random(1), list[list[float]]()
        for _ in range(PLACES):
            p = [x + 0.1 * draw.uniform(-1, 1) * (abs(x) or 1.0) for x in self.values.values()]
            q = [c.start + draw.uniform(-1, 1) for c in self.coordinates]
            with suppress(ArithmeticError, ValueError, TypeError):  # no value, or none that is real
                found.append([float(x) for x in of(*p, draw.random(), *q)])
        if len(found) < 2:
            return [None] * len(closed.rows)
        size = max(math.hypot(*place[k : k + 3]) for place in found for k in (0, 3))
        sizes = {"m": size, "m^2": size**2}
        columns = list(zip(*found, strict=True))[6:]
        return [
            column[0] if max(column) - min(column) <= ROUNDING * sizes.get(row.unit, 1) else None
            for row, column in zip(closed.rows, columns, strict=True)
        ]


def _instead(rate: Expr, coordinates: Iterable[Coordinate]) -> str:
    """What to write in place of the rate of a position."""
    positions: Mapping[Expr, Expr] = {c.qd: c.q for c in coordinates}
    terms = sympy.Add.make_args(rate)
    plain = all(term.has(dot) or term.free_symbols & positions.keys() for term in terms)
    position = rate.replace(dot, lambda e: e).xreplace(positions)
    shown = str(position)
    if not plain or len(shown) > LONGEST:
        return "write the position itself, less its value at the start"
    return f"write the position itself, {shown}, less its value at the start"
