"""Constraints: classification and checks of their formulas, and the equations of loop joints.

A constraint is holonomic, linear in the velocities, or invalid. The equations of joints that close
loops are as follows.

Let p be the vector from the first body's point to the second's, a and u axes of the first body and
b an axis of the second. A constraint equation is one of
  p.e = 0 for an axis e of the common ancestor, or of the world: the points coincide;
  p.u = 0 for an axis u across a joint axis: the second point stays on a line;
  a.b = 0: perpendicular axes. These equations are regular where the joint is closed. For a small
  rotation error d they equal the component of d along the axis after which they are named;
  (p.p - l^2)/2 = 0: the points keep the distance l.
If the second point moves by dp and its frame rotates by dr, these change by dp.e, dp.u,
dr.(b x a) and dp.p. The multiplier times the coefficient of dp is a force on the second body at its
point; times the coefficient of dr it is a moment. The opposite acts on the first body there.

Equations a.b = 0 have other solutions too, and gradients that vanish at a quarter turn. Each axis
equation therefore also has a component of 2 tan(a/2) n, for a rotation error a about n:
2 (R_zy - R_yz, ...)/(1 + tr R) for rotation matrices R. This has one zero, and a gradient
everywhere except at half a turn. The branches of a reaction are 1 where the joint is closed; at
other solutions one of them is 0 or -1.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import sympy
from sympy import Expr, S, Symbol

from eomc.base import spatial
from eomc.base.spatial import apply, cross, plus, product, scaled, transposed
from eomc.model.algebra import classes_of_shape, compile_function
from eomc.model.mechanics import Mechanics
from eomc.model.symbols import Constraint, Coordinate, Reaction, dot, needed_definitions, symbol, t
from eomc.model.tree import ONE, ZERO, Matrix, Vector, aligned_with, unit_vector
from eomc.scene.scene import LoopJoint

NONSMOOTH = classes_of_shape("corner", "jump")

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

        The left-hand side of such an equation does not depend on the coordinates. Its multiplier is
        zero in the reaction of the copy. If it is zero, a
        warning is reported. If it is not zero, so that the loop can't close, or if no equation is
        left, an error is reported.
        """
        fixed = [self._constant_value(row.formula) for row in closed.rows]
        if closed.points and None in fixed:
            hardly = self._nearly_constant_values(closed)
            fixed = [b if a is None else a for a, b in zip(fixed, hardly, strict=True)]
        pairs = [*zip(closed.rows, fixed, strict=True)]
        constant = [(row, value) for row, value in pairs if value is not None]
        zero = {row.multiplier: S.Zero for row, _ in constant}
        reduced = replace(
            closed,
            rows=[row for row, value in pairs if value is None],
            reactions=[
                replace(r, values=tuple(S(e).xreplace(zero) for e in r.values))
                for r in closed.reactions
            ],
        )
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


# --- joints that close loops ----------------------------------------------------------------------


@dataclass(frozen=True)
class End:
    """The end of a loop joint on one of its two bodies: the joint's point and the rotation.

    point: position in m of the point of the body at which the joint is attached. R: rotation matrix
    of the body's frame. Both are in the frame of the closest common ancestor of the two bodies,
    which may be the world.
    """

    point: Vector
    R: Matrix


@dataclass(frozen=True)
class _LoopEquation:
    """A constraint equation, and force and moment on the second body for a multiplier of one.

    rotation_error: see `Constraint`.
    """

    formula: Expr
    force: Vector = ZERO
    moment: Vector = ZERO
    rotation_error: tuple[Expr, Expr] | None = None


@dataclass
class LoopEquations:
    """The constraint equations, reaction and points of a joint that closes a loop.

    rows: the constraint equations. reactions: the force and moment on the second body, as a
    sequence of one Reaction; empty for a gear. points: position of the joint's point on each of the
    two bodies, in m; empty for a gear.
    """

    rows: list[Constraint]
    reactions: list[Reaction] = field(default_factory=list)
    points: tuple[Vector, ...] = ()


def derive_loop_equations(
    loop: LoopJoint,
    plane: bool,
    ends: tuple[End, End],
    turned: Matrix,
    length: Expr,
    to_world: Matrix,
) -> LoopEquations:
    """Return the constraint equations and the reaction of a joint that closes a loop.

    Parameters
    ----------
    loop
        The joint in the scene.
    plane
        Whether the scene is planar.
    ends
        Point and rotation of each of the two bodies.
    turned
        Rotation of the second body's frame relative to the first body's when the joint is closed.
    length
        Distance in m for a joint that keeps the distance of the two points; 0 for others.
    to_world
        Rotation from the frame of `ends` to the world; the reaction is in world axes.
    """
    first, second = ends
    R = (product(first.R, turned), second.R)
    p = plus(second.point, scaled(first.point, S.NegativeOne))
    kinds = loop.rows(plane)
    equations = {**_point_equations(p, length), **dict(_frame_equations(*R, plane=plane))}
    if loop.axes:
        equations |= _axis_equations(loop.axes, plane, (first.R, second.R), p)
    rows, force, moment = list[Constraint](), ZERO, ZERO
    for kind, name in kinds.items():
        equation = equations[kind]
        unit = {"length": "m^2"}.get(kind, "m" if kind in "xyzuv" else "")
        row = Constraint(name, equation.formula, True, unit, loop.note, loop.name)
        row = replace(row, rotation_error=equation.rotation_error)
        rows.append(row)
        force = plus(force, scaled(equation.force, row.multiplier))
        moment = plus(moment, scaled(equation.moment, row.multiplier))
    force, moment = apply(to_world, force), apply(to_world, moment)
    values = (*force[:2], moment[2]) if plane else (*force, *moment)
    branches = [*_branches(kinds, *R)]
    if "ru" in kinds:
        a, b = (apply(end.R, _unit(axis)) for end, axis in zip(ends, loop.axes, strict=True))
        branches.append(spatial.dot(a, b))
    reaction = Reaction(loop.name, values, loop.note, tuple(branches))
    return LoopEquations(rows, [reaction], (first.point, second.point))


def _point_equations(p: Vector, length: Expr) -> dict[str, _LoopEquation]:
    """Return the equations of the vector between two points."""
    along = {kind: _LoopEquation(p[k], force=ONE[k]) for k, kind in enumerate("xyz")}
    return {**along, "length": _LoopEquation((spatial.dot(p, p) - length**2) / 2, force=p)}


def _axis_equations(
    axes: Sequence[Sequence[float]], plane: bool, R: tuple[Matrix, Matrix], p: Vector
) -> dict[str, _LoopEquation]:
    """Return the equations of an axis of each body."""
    u, v, a = (apply(R[0], axis) for axis in perpendicular_axes(axes[0], plane))
    b = apply(R[1], _unit(axes[1]))
    half = (1 + spatial.dot(a, b)) / 2
    return {
        "u": _LoopEquation(spatial.dot(p, u), force=u),
        "v": _LoopEquation(spatial.dot(p, v), force=v),
        "ru": _perpendicularity(scaled(v, S.NegativeOne), b, (-spatial.dot(v, b) / half, half)),
        "rv": _perpendicularity(u, b, (spatial.dot(u, b) / half, half)),
        "cross": _perpendicularity(a, b),
    }


def _frame_equations(
    first: Matrix, second: Matrix, plane: bool
) -> Iterator[tuple[str, _LoopEquation]]:
    """Yield the equations of equal orientation of two frames."""
    mine, other = transposed(first), transposed(second)
    if plane:
        half = (1 + spatial.dot(mine[0], other[0])) / 2
        yield (
            "rz",
            _perpendicularity(mine[1], other[0], (spatial.dot(mine[1], other[0]) / half, half)),
        )
        return
    R = [[spatial.dot(a, b) for b in other] for a in mine]
    half = (1 + R[0][0] + R[1][1] + R[2][2]) / 4
    for kind, i, k in (("rx", 2, 1), ("ry", 0, 2), ("rz", 1, 0)):
        yield kind, _perpendicularity(mine[i], other[k], ((R[i][k] - R[k][i]) / (2 * half), half))


def _perpendicularity(
    a: Vector, b: Vector, rotation_error: tuple[Expr, Expr] | None = None
) -> _LoopEquation:
    """Return the equation a.b = 0 of an axis of the first body and one of the second."""
    return _LoopEquation(spatial.dot(a, b), moment=cross(b, a), rotation_error=rotation_error)


def _branches(kinds: Mapping[str, str], first: Matrix, second: Matrix) -> Iterator[Expr]:
    """Yield cosines that are 1 if frames are aligned, -1 or 0 at other solutions."""
    cosines = [
        spatial.dot(a, b) for a, b in zip(transposed(first), transposed(second), strict=True)
    ]
    if "rx" in kinds:
        yield from cosines
    elif "rz" in kinds:
        yield cosines[0]


def _unit(axis: Sequence[float]) -> Vector:
    x, y, z = unit_vector(axis)
    return x, y, z


def perpendicular_axes(axis: Sequence[float], plane: bool) -> tuple[Vector, Vector, Vector]:
    """Return a right-handed triad of unit vectors (u, v, axis) for a given axis.

    plane: whether the scene is planar; if so, `axis` and u lie in the plane and v is normal to it.
    """
    along = _unit(axis)
    if plane:
        return (-along[1], along[0], S.Zero), (S.Zero, S.Zero, S.One), along
    k, aligned = aligned_with(axis)
    columns = transposed(aligned)
    return columns[(k + 1) % 3], columns[(k + 2) % 3], along


def derive_gear_equation(loop: LoopJoint, ratio: Expr, offset: Expr) -> LoopEquations:
    """Return the constraint equation of a gear between two coordinates.

    The equation is second coordinate - ratio * first coordinate - offset = 0. loop: the gear in the
    scene, which names the coordinates. The result has no reaction and no points.
    """
    first, second = (symbol(name) for name in loop.coordinates)
    row = second - ratio * first - offset
    return LoopEquations([Constraint(loop.name, row, True, "", loop.note, loop.name)])


def find_wrong_rotations(
    system: Mechanics,
) -> Callable[[Sequence[float], float, Mapping[str, float]], list[str]]:
    """Return a function that finds the loops whose bodies have a wrong relative rotation.

    The constraint equations that align axes have several solutions, of which one closes the joint.
    The returned function tells them apart. Its arguments are the coordinates q, the time t in s and
    a dict of parameter values by name; parameters that are not in the dict have their defaults. It
    returns the names of the loops that are in a wrong solution.
    """
    cosines = [(r.name, branch) for r in system.reactions for branch in r.branches]
    if not cosines:
        return lambda q, t, parameters: []
    branches = [branch for _, branch in cosines]
    known = needed_definitions(system.definitions, branches)
    names = [*(c.q for c in system.coordinates), t, *(p.symbol for p in system.parameters)]
    defaults = {p.name: p.value for p in system.parameters}
    of = compile_function(names, branches, "math", known)

    def wrong(q: Sequence[float], time: float, parameters: Mapping[str, float]) -> list[str]:
        values = of(*q, time, *(defaults | dict(parameters)).values())
        each = zip(cosines, values, strict=True)
        return list(dict.fromkeys(name for (name, _), x in each if x < 0.5))

    return wrong
