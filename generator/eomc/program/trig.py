"""Sines and cosines apart from the rest of a function, so that they can be had at other times.

RK4 computes them at places that are known when a step begins, and turns them from there by the
little that is missing: that shortens the chain of operations which a small scene waits for.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from sympy import Expr, S

from eomc.program.ir import Assignment, Call, Function, Operand, Sum, Value


@dataclass(frozen=True)
class Angle:
    """An angle, offset + sum of coefficient times coordinate; the names of its sine and cosine."""

    terms: tuple[tuple[Expr, str], ...]
    offset: Expr
    sine: str
    cosine: str


def apart(function: Function, coordinates: Collection[str]) -> tuple[tuple[Angle, ...], Function]:
    """The angles that depend on coordinates alone, and the function that reads their sines."""
    values = {a.name: a.value for a in function.body}
    found: dict[tuple[Operand, ...], dict[str, str]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            if _terms(a.value.args[0], values, coordinates) is not None:
                found.setdefault(a.value.args, {})[a.value.function] = a.name
    if not found:
        return (), function
    angles = []
    for args, names in found.items():
        terms, offset = _terms(args[0], values, coordinates) or ((), S.Zero)
        angles.append(Angle(terms, offset, *pair_of(names)))
    gone = {name for names in found.values() for name in names.values()}
    return tuple(angles), _without(function, gone)


def pair_of(names: Mapping[str, str]) -> tuple[str, str]:
    """Names for the sine and the cosine of an angle, of which one may be needed only."""
    sine = names.get("sin") or names["cos"].replace("cos", "sin") + "_"
    return sine, names.get("cos") or names["sin"].replace("sin", "cos") + "_"


def _terms(
    angle: Operand, values: Mapping[str, Value], coordinates: Collection[str]
) -> tuple[tuple[tuple[Expr, str], ...], Expr] | None:
    """An angle as a sum over coordinates and a number; None where it is something else."""
    if angle.name in coordinates:
        return ((angle.coefficient, angle.name),), S.Zero
    made = values.get(angle.name)
    if not isinstance(made, Sum) or not all(name in coordinates for _, name in made.terms):
        return None
    k = angle.coefficient
    return tuple((k * c, name) for c, name in made.terms), k * made.constant


def _without(function: Function, gone: Collection[str]) -> Function:
    """The function without those values, which come from outside then, and what they alone need."""
    ends = [*function.outputs, *(o for pair in function.checks for o in pair)]
    needed = {o.name for o in ends}
    body: list[Assignment] = []
    for a in reversed(function.body):
        if a.name not in gone and a.name in needed:
            body.append(a)
            needed.update(a.value.names)
    return replace(function, body=tuple(reversed(body)))
