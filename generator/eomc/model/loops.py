"""Loop joints: constraint equations over the bodies' frames, and reactions.

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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import sympy
from sympy import Expr, S

from eomc.base.spatial import apply, cross, dot, plus, product, scaled, transposed
from eomc.model import rational
from eomc.model.mechanics import Mechanics
from eomc.model.rational import ZERO, Matrix, Vector
from eomc.model.symbols import Constraint, Reaction, needed_definitions, symbol, t
from eomc.scene.assembly import LoopJoint


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
        branches.append(dot(a, b))
    reaction = Reaction(loop.name, values, loop.note, tuple(branches))
    return LoopEquations(rows, [reaction], (first.point, second.point))


def _point_equations(p: Vector, length: Expr) -> dict[str, _LoopEquation]:
    """Return the equations of the vector between two points."""
    along = {kind: _LoopEquation(p[k], force=rational.ONE[k]) for k, kind in enumerate("xyz")}
    return {**along, "length": _LoopEquation((dot(p, p) - length**2) / 2, force=p)}


def _axis_equations(
    axes: Sequence[Sequence[float]], plane: bool, R: tuple[Matrix, Matrix], p: Vector
) -> dict[str, _LoopEquation]:
    """Return the equations of an axis of each body."""
    u, v, a = (apply(R[0], axis) for axis in perpendicular_axes(axes[0], plane))
    b = apply(R[1], _unit(axes[1]))
    half = (1 + dot(a, b)) / 2
    return {
        "u": _LoopEquation(dot(p, u), force=u),
        "v": _LoopEquation(dot(p, v), force=v),
        "ru": _perpendicularity(scaled(v, S.NegativeOne), b, (-dot(v, b) / half, half)),
        "rv": _perpendicularity(u, b, (dot(u, b) / half, half)),
        "cross": _perpendicularity(a, b),
    }


def _frame_equations(
    first: Matrix, second: Matrix, plane: bool
) -> Iterator[tuple[str, _LoopEquation]]:
    """Yield the equations of equal orientation of two frames."""
    mine, other = transposed(first), transposed(second)
    if plane:
        half = (1 + dot(mine[0], other[0])) / 2
        yield "rz", _perpendicularity(mine[1], other[0], (dot(mine[1], other[0]) / half, half))
        return
    R = [[dot(a, b) for b in other] for a in mine]
    half = (1 + R[0][0] + R[1][1] + R[2][2]) / 4
    for kind, i, k in (("rx", 2, 1), ("ry", 0, 2), ("rz", 1, 0)):
        yield kind, _perpendicularity(mine[i], other[k], ((R[i][k] - R[k][i]) / (2 * half), half))


def _perpendicularity(
    a: Vector, b: Vector, rotation_error: tuple[Expr, Expr] | None = None
) -> _LoopEquation:
    """Return the equation a.b = 0 of an axis of the first body and one of the second."""
    return _LoopEquation(dot(a, b), moment=cross(b, a), rotation_error=rotation_error)


def _branches(kinds: Mapping[str, str], first: Matrix, second: Matrix) -> Iterator[Expr]:
    """Yield cosines that are 1 if frames are aligned, -1 or 0 at other solutions."""
    cosines = [dot(a, b) for a, b in zip(transposed(first), transposed(second), strict=True)]
    if "rx" in kinds:
        yield from cosines
    elif "rz" in kinds:
        yield cosines[0]


def _unit(axis: Sequence[float]) -> Vector:
    x, y, z = rational.unit_vector(axis)
    return x, y, z


def perpendicular_axes(axis: Sequence[float], plane: bool) -> tuple[Vector, Vector, Vector]:
    """Return a right-handed triad of unit vectors (u, v, axis) for a given axis.

    plane: whether the scene is planar; if so, `axis` and u lie in the plane and v is normal to it.
    """
    along = _unit(axis)
    if plane:
        return (-along[1], along[0], S.Zero), (S.Zero, S.Zero, S.One), along
    k, aligned = rational.aligned_with(axis)
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
    of = sympy.lambdify(names, branches, "math", cse=lambda e: (known, e))

    def wrong(q: Sequence[float], time: float, parameters: Mapping[str, float]) -> list[str]:
        values = of(*q, time, *(defaults | dict(parameters)).values())
        each = zip(cosines, values, strict=True)
        return list(dict.fromkeys(name for (name, _), x in each if x < 0.5))

    return wrong


def without_constant_rows(
    closed: LoopEquations, values: Sequence[float | None]
) -> tuple[LoopEquations, list[tuple[Constraint, float]]]:
    """Return a copy of a loop without its constant constraint equations, and these equations.

    values: for each equation of the loop, the value of its left-hand side if that is constant, else
    None. The removed equations are returned as pairs (constraint, value). The Lagrange multipliers
    of the removed equations are zero in the reaction of the copy.
    """
    rows, constant = [], []
    for row, fixed in zip(closed.rows, values, strict=True):
        if fixed is None:
            rows.append(row)
        else:
            constant.append((row, fixed))
    zero = {row.multiplier: S.Zero for row, _ in constant}
    reactions = [
        replace(r, values=tuple(S(e).xreplace(zero) for e in r.values)) for r in closed.reactions
    ]
    return replace(closed, rows=rows, reactions=reactions), constant
