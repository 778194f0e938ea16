"""Separation of sines and cosines from a function, so that they can be computed at other times.

RK4 computes them at configurations that are known at the beginning of a step and rotates them by
the small remaining angle. This shortens the dependency chain that limits the speed of small scenes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from sympy import Expr, S

from eomc.program.ir import Assignment, Call, Function, Operand, Sum, Value


@dataclass(frozen=True)
class Angle:
    """An angle, offset + sum of coefficient times coordinate, and the names of its sine and cosine.

    `terms` contains the pairs (coefficient, coordinate).
    """

    terms: tuple[tuple[Expr, str], ...]
    offset: Expr
    sine: str
    cosine: str


def separate_angles(
    function: Function, coordinates: Collection[str]
) -> tuple[tuple[Angle, ...], Function]:
    """Turn the sines and cosines of angles of a function into values that it reads.

    The angles are those that are linear in the coordinates, whose names are `coordinates`. Returns
    the angles, and the function without the computation of their sines and cosines.
    """
    values = {a.name: a.value for a in function.body}
    by_argument: dict[tuple[Operand, ...], dict[str, str]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            if _terms(a.value.args[0], values, coordinates) is not None:
                by_argument.setdefault(a.value.args, {})[a.value.function] = a.name
    if not by_argument:
        return (), function
    angles = []
    for args, names in by_argument.items():
        terms, offset = _terms(args[0], values, coordinates) or ((), S.Zero)
        angles.append(Angle(terms, offset, *names_of_pair(names)))
    separated = {name for names in by_argument.values() for name in names.values()}
    return tuple(angles), _remove_values(function, separated)


def names_of_pair(names: Mapping[str, str]) -> tuple[str, str]:
    """Return the names of the sine and of the cosine of an angle.

    `names` maps "sin", "cos" or both to existing names. If one of the two is missing, its name is
    derived from the other one, as cos_theta_ from sin_theta.
    """
    sine = names.get("sin") or names["cos"].replace("cos", "sin") + "_"
    return sine, names.get("cos") or names["sin"].replace("sin", "cos") + "_"


def _terms(
    angle: Operand, values: Mapping[str, Value], coordinates: Collection[str]
) -> tuple[tuple[tuple[Expr, str], ...], Expr] | None:
    """Return an angle as (terms over coordinates, constant); None where it has another form."""
    if angle.name in coordinates:
        return ((angle.coefficient, angle.name),), S.Zero
    definition = values.get(angle.name)
    if not isinstance(definition, Sum) or not all(
        name in coordinates for _, name in definition.terms
    ):
        return None
    k = angle.coefficient
    return tuple((k * c, name) for c, name in definition.terms), k * definition.constant


def _remove_values(function: Function, separated: Collection[str]) -> Function:
    """Return the function without the given values, which become inputs, and values that only they
    need.
    """
    ends = [*function.outputs, *(o for pair in function.checks for o in pair)]
    needed = {o.name for o in ends}
    body: list[Assignment] = []
    for a in reversed(function.body):
        if a.name not in separated and a.name in needed:
            body.append(a)
            needed.update(a.value.names)
    return replace(function, body=tuple(reversed(body)))
