"""Sines and cosines of a step that are turned from others, as the templates want them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sympy import Expr, S

from eomc import ccode
from eomc.angles import Angle, apart
from eomc.assignments import Function, Sum
from eomc.ccode import DOUBLE
from eomc.pieces import is_large
from eomc.target import Target

MANY_ANGLES = 5  # of which sines are computed side by side in a step of one trajectory


def turned_apart(target: Target, function: Function) -> tuple[tuple[Angle, ...], Function]:
    """The angles that RK4 turns, and the acceleration that reads their sines and cosines."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods or is_large(function):
        return (), function
    return apart(function, target.names)


def scalar(target: Target, turned: Sequence[Angle]) -> dict[str, Any] | None:
    """The struct of sines and cosines, and how they are had at a place, and near one."""
    if not turned:
        return None

    P, members, n = target.prefix, sines(turned), len(turned)
    ends = ("", "q"), ("N + ", "end")
    return {
        "members": members,
        "count": n,
        "many": n >= MANY_ANGLES,
        "gathered": [
            f"x[{at}{k}] = {along(target, a, of + '->', a.offset)};"
            for at, of in ends
            for k, a in enumerate(turned)
        ],
        "scattered": [
            f"{to}->{a.sine} = sines[{at}{k}], {to}->{a.cosine} = cosines[{at}{k}];"
            for (at, _), to in zip(ends, ("s", "s_end"), strict=True)
            for k, a in enumerate(turned)
        ],
        "at": [
            f"{P}_sincos({along(target, a, 'q->', a.offset)}, &s->{a.sine}, &s->{a.cosine});"
            for a in turned
        ],
        "near": [
            f"{P}_sincos_near({along(target, a, 'q->', a.offset)}, "
            f"{along(target, a, 'd->', S.Zero)}, from->{a.sine}, "
            f"from->{a.cosine}, &s->{a.sine}, &s->{a.cosine});"
            for a in turned
        ],
    }


def lane(target: Target, turned: Sequence[Angle]) -> dict[str, Any] | None:
    """The sines and cosines of an instance: at a place, on both sides of it, a little further."""
    if not turned:
        return None
    P, f = target.prefix, target.real.function_suffix

    def both(struct: str, angle: Angle) -> str:
        return f"&{struct}->{angle.sine}, &{struct}->{angle.cosine}"

    return {
        "members": sines(turned),
        "at": [
            f"{P}_sincos{f}_lane({along(target, a, 'q->', a.offset)}, {both('s', a)}, trouble);"
            for a in turned
        ],
        "around": [
            f"{P}_sincos_around{f}({along(target, a, 'q->', a.offset)}, "
            f"{along(target, a, 'd->', S.Zero)}, "
            f"{both('back', a)}, {both('s', a)}, {both('on', a)}, far);"
            for a in turned
        ],
        "turned": [
            f"{P}_turn{f}({along(target, a, 'd->', S.Zero)}, from->{a.sine}, from->{a.cosine}, "
            f"{both('s', a)});"
            for a in turned
        ],
        "far": [f"*far = {P}_far{f}({along(target, a, 'd->', S.Zero)}, *far);" for a in turned],
    }


def sines(turned: Sequence[Angle]) -> list[str]:
    """The names of all that is turned."""
    return [name for a in turned for name in (a.sine, a.cosine)]


def along(target: Target, angle: Angle, vector: str, offset: Expr) -> str:
    """An angle of a vector of coordinates."""
    where = {name: f"{vector}{name}" for _, name in angle.terms}
    printer = ccode.Printer(target.prefix, target.real, where)
    return printer.value(Sum(angle.terms, offset))[0]
