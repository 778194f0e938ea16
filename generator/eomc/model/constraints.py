"""Classification and checks of constraints: holonomic, linear in the velocities, or invalid."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from eomc.model import loops
from eomc.model.algebra import compile_function
from eomc.model.loops import LoopEquations
from eomc.model.symbols import Constraint, Coordinate, dot, needed_definitions, t

NONSMOOTH = (sympy.Abs, sympy.Max, sympy.Min, sympy.sign, sympy.Heaviside)

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
    """How an expression depends on velocities, coordinates and time.

    Attributes
    ----------
    degree
        Degree in the velocities: 0, 1, or 2 for any nonlinear expression.
    moves
        Other dependence: 0 if constant, 1 if on time alone, 2 if on coordinates or velocities.
    exact
        Whether the expression is recognised as the time derivative of a position: a sum of
        velocities and dot(...) with constant factors, and functions of time.
    """

    degree: int = 0
    moves: int = 0
    exact: bool = False


_FIXED, _TIME, _POSITION, _RATE = Degree(), Degree(0, 1), Degree(0, 2), Degree(1, 2, True)
_NONLINEAR = Degree(2, 2)


class VelocityDegree:
    """Classifier of expressions by their dependence on the velocities (see `Degree`).

    definitions: pairs (symbol, expression), each over the symbols before it. Where such a symbol
    occurs in an expression, its definition is classified in its place.
    """

    def __init__(
        self, coordinates: Iterable[Coordinate], definitions: Iterable[tuple[Symbol, Expr]]
    ) -> None:
        self.known: dict[Expr, Degree] = {t: _TIME}
        for c in coordinates:
            self.known |= {c.q: _POSITION, c.qd: _RATE}
        for name, e in definitions:
            self.known[name] = self.degree(e)

    def degree(self, e: Expr) -> Degree:
        """Return how the expression `e` depends on velocities, coordinates and time."""
        degree = self.known.get(e)
        if degree is None:
            degree = self._combine(e, [self.degree(part) for part in e.args])
            self.known[e] = degree
        return degree

    def _combine(self, e: Expr, parts: Sequence[Degree]) -> Degree:
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
            constant = all(p.moves == 0 for p in factors)
            return Degree(min(degree, 2), moves, degree == 1 and constant and self._exact(parts))
        return _NONLINEAR

    @staticmethod
    def _exact(parts: Iterable[Degree]) -> bool:
        return all(p.exact for p in parts if p.degree)


class ConstraintChecker:
    """Checker and classifier of the constraint equations of a system.

    Parameters
    ----------
    coordinates
        Coordinates of the system.
    definitions
        Definitions of the system: pairs (symbol, expression), each over the symbols before it.
    values
        Values of the parameters.
    fault
        Function that reports an error; it is called with the constraint and a message.
    doubt
        Function that reports a warning; it is called with the constraint and a message.
    """

    ZERO_RESIDUAL = 1e-9  # m or rad; smaller residuals count as zero
    SAMPLES = 4  # random configurations at which loop equations are evaluated
    # changes relative to the loop's length (1 for axis equations) that count as zero
    ROUNDING_TOLERANCE = 1e-13

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
        self.velocity_degree = VelocityDegree(coordinates, definitions)

    def classify(self, rows: Iterable[Constraint]) -> tuple[Constraint, ...]:
        """Return the valid constraints, holonomic ones first, with the attribute `holonomic` set.

        rows: the constraint equations to check. An invalid constraint is left out and reported as
        an error. A constraint that could be written for positions instead of velocities is returned
        and reported as a warning.
        """
        holonomic, others = [], []
        for row in rows:
            degree = self.velocity_degree.degree(row.formula)
            if degree.moves < 2:
                self.fault(row, NOTHING_MOVES)
            elif degree.degree > 1:
                self.fault(row, NOT_LINEAR)
            elif degree.degree == 0:
                holonomic.append(row)
            else:
                if degree.exact:
                    self.doubt(row, _DRIFTS + _position_advice(row.formula, self.coordinates))
                others.append(replace(row, holonomic=False))
        return (*holonomic, *others)

    def without_constant_rows(self, closed: LoopEquations) -> LoopEquations:
        """Return a copy of a loop from which constant constraint equations are removed.

        The left-hand side of such an equation does not depend on the coordinates. If it is zero, a
        warning is reported. If it is not zero, so that the loop can't close, or if no equation is
        left, an error is reported.
        """
        fixed = [self._constant_value(row.formula) for row in closed.rows]
        if closed.points and None in fixed:
            hardly = self._nearly_constant_values(closed)
            fixed = [b if a is None else a for a, b in zip(fixed, hardly, strict=True)]
        reduced, constant = loops.without_constant_rows(closed, fixed)
        far = [(row, value) for row, value in constant if not abs(value) <= self.ZERO_RESIDUAL]
        for row, value in far:
            why = f"can't close: its row {row.name} is {value:.6g} wherever its bodies move"
            self.fault(row, f"{why}: check its points and axes")
        if not reduced.rows and not far:
            self.fault(constant[0][0], "its bodies do not move against each other: leave it out")
        elif constant and not far:
            row, names = constant[0][0], ", ".join(row.name for row, _ in constant)
            what = "a row that is" if len(constant) == 1 else "rows that are"
            why = f"has {what} zero wherever its bodies move, left out: {names}"
            self.doubt(row, f"{why}; what they would carry is not determined, and counts as zero")
        return reduced

    def _constant_value(self, e: Expr) -> float | None:
        """Return the value of an expression that depends on no coordinate; None otherwise."""
        if self.velocity_degree.degree(e).moves == 2:
            return None
        known: dict[Expr, Expr] = {name: sympy.Float(v) for name, v in self.values.items()}
        for name, formula in needed_definitions(self.definitions, [e]):
            known[name] = formula.xreplace(known)
        value = e.xreplace(known).evalf()
        return (
            float(value) if value.is_number else math.inf
        )  # a function of t: the loop does not stay closed

    def _nearly_constant_values(self, closed: LoopEquations) -> list[float | None]:
        """Return the values of a loop's equations that change by rounding only, None for others.

        Axes of a planar mechanism that is tilted in space are parallel to sixteen digits only, if
        they are given in doubles. The equations across the plane then change by rounding, also at
        other parameters.
        """
        expressions = [
            *(x for point in closed.points for x in point),
            *(r.formula for r in closed.rows),
        ]
        known = needed_definitions(self.definitions, expressions)
        if any(e.has(*NONSMOOTH) for e in (*expressions, *(formula for _, formula in known))):
            return [None] * len(closed.rows)  # such an equation may be constant locally
        names = [*self.values, t, *(c.q for c in self.coordinates)]
        of = compile_function(names, expressions, "math", known)
        draw, samples = random.Random(1), list[list[float]]()
        for _ in range(self.SAMPLES):
            p = [x + 0.1 * draw.uniform(-1, 1) * (abs(x) or 1.0) for x in self.values.values()]
            q = [c.start + draw.uniform(-1, 1) for c in self.coordinates]
            with suppress(ArithmeticError, ValueError, TypeError):  # no real value
                samples.append([float(x) for x in of(*p, draw.random(), *q)])
        if len(samples) < 2:
            return [None] * len(closed.rows)
        size = max(math.hypot(*place[k : k + 3]) for place in samples for k in (0, 3))
        sizes = {"m": size, "m^2": size**2}
        columns = list(zip(*samples, strict=True))[6:]
        return [
            column[0]
            if max(column) - min(column) <= self.ROUNDING_TOLERANCE * sizes.get(row.unit, 1)
            else None
            for row, column in zip(closed.rows, columns, strict=True)
        ]


def _position_advice(rate: Expr, coordinates: Iterable[Coordinate]) -> str:
    """Return the advice to write the position in place of its time derivative."""
    positions: Mapping[Expr, Expr] = {c.qd: c.q for c in coordinates}
    terms = sympy.Add.make_args(rate)
    plain = all(term.has(dot) or term.free_symbols & positions.keys() for term in terms)
    position = rate.replace(dot, lambda e: e).xreplace(positions)
    shown = str(position)
    if not plain or len(shown) > 80:
        return "write the position itself, less its value at the start"
    return f"write the position itself, {shown}, less its value at the start"
