"""Sines and cosines of a step that are turned from others, as the templates want them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sympy import Expr, S

from eomc import ccode, vectors
from eomc.angles import Angle, apart
from eomc.assignments import Function, Sum
from eomc.ccode import DOUBLE
from eomc.pieces import is_large
from eomc.target import Target


def turned_apart(target: Target, function: Function) -> tuple[tuple[Angle, ...], Function]:
    """The angles that RK4 turns, and the acceleration that reads their sines and cosines."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods or is_large(function):
        return (), function
    return apart(function, target.names)


def scalar(target: Target, turned: Sequence[Angle]) -> dict[str, Any] | None:
    """The struct of sines and cosines, and how they are had at a place, and near one."""
    if not turned:
        return None
    P = target.prefix
    return {
        "members": sines(turned),
        "count": len(turned),
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


def lane(target: Target, turned: Sequence[Angle], arrays: bool) -> dict[str, Any] | None:
    """The sines and cosines of an instance: at a place; in loops over a tile, turned from others.

    around: a vector and statements with it, for two loops of every angle: computed at q + h/2 qd,
    turned to q and q + h qd. further: turned from the middle by h^2/4 a1 and from the end by
    h^2/2 a2, in place.
    """
    if not turned:
        return None
    P, f = target.prefix, target.real.function_suffix

    r = target.literal(64.0 if target.real is DOUBLE else 16.0)  # over 1 is what turns are good for

    def both(struct: str, angle: Angle, at: str = "") -> str:
        return f"&{struct}{angle.sine}{at}, &{struct}{angle.cosine}{at}"

    def coordinates(angle: Angle, line: str) -> list[str]:
        return [
            line.replace("$", vectors.member(target, arrays, n)).replace("#", target.enum[n])
            for _, n in angle.terms
        ]

    def sum_of(angle: Angle, vector: str, offset: Expr = S.Zero) -> str:
        return along(target, angle, vector, offset, arrays)

    def far(angle: Angle) -> str:
        return target.zero if angle is turned[0] else "s->trouble[i]"

    def turn(angle: Angle, of: str) -> str:
        d = sum_of(angle, "d.")
        place = f"{of}.{angle.sine}[i], {of}.{angle.cosine}[i], {both(of + '.', angle, '[i]')}"
        return f"{P}_turn{f}({d}, {place});"

    def at(angle: Angle) -> list[str]:
        x = sum_of(angle, "at.", angle.offset)
        return [
            *coordinates(angle, "at.$ = from->q.x[#][i] + h_2*from->qd.x[#][i];"),
            f"{P}_sincos{f}_side_by_side({x}, {both('mid.', angle, '[i]')});",
            f"s->trouble[i] = {P}_far_at{f}({x}, {far(angle)});",
        ]

    def around(angle: Angle) -> list[str]:
        d = sum_of(angle, "d.")
        middle = f"mid.{angle.sine}[i], mid.{angle.cosine}[i]"
        sides = f"{both('back.', angle, '[i]')}, {both('on.', angle, '[i]')}"
        return [
            *coordinates(angle, "d.$ = h_2*from->qd.x[#][i];"),
            f"{P}_turn_both{f}({d}, {middle}, {sides}, &s->trouble[i]);",
        ]

    def further(angle: Angle) -> list[str]:
        return [
            *coordinates(angle, "d.$ = hh_4*first.x[#][i];"),
            turn(angle, "mid"),
            *coordinates(angle, "d.$ = hh_2*second.x[#][i];"),
            turn(angle, "on"),
        ]

    return {
        "members": sines(turned),
        "at": [
            f"{P}_sincos{f}_lane({sum_of(a, 'q->', a.offset)}, {both('s->', a)}, trouble);"
            for a in turned
        ],
        "around": [x for a in turned for x in (("at", at(a)), ("d", around(a)))],
        "further": [("d", further(a)) for a in turned],
        "far_2": f"({r}*hh_2)*({r}*hh_2)",
        "squares": {
            "given": f"const {target.real.name} "
            + ", ".join(f"d{k} = {sum_of(a, 'd->')}" for k, a in enumerate(turned, 1))
            + ";",
            "sum": " + ".join(f"d{k}*d{k}" for k in range(1, len(turned) + 1)),
        },
    }


def sines(turned: Sequence[Angle]) -> list[str]:
    """The names of all that is turned."""
    return [name for a in turned for name in (a.sine, a.cosine)]


def along(target: Target, angle: Angle, vector: str, offset: Expr, arrays: bool = False) -> str:
    """An angle of a vector of coordinates."""
    where = {n: vector + vectors.member(target, arrays, n) for _, n in angle.terms}
    printer = ccode.Printer(target.prefix, target.real, where)
    return printer.value(Sum(angle.terms, offset))[0]
