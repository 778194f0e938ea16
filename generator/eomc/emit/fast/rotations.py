"""Incremental sines and cosines: those of a stage rotated from others, for the templates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sympy import Expr, S

from eomc.emit import c_expression, vectors
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.program.ir import Function, Sum
from eomc.program.outline import is_large
from eomc.program.trig import Angle, apart


def rotated_apart(target: Target, function: Function) -> tuple[tuple[Angle, ...], Function]:
    """The angles that RK4 rotates, and the acceleration that reads their sines and cosines."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods or is_large(function):
        return (), function
    return apart(function, target.names)


def scalar(target: Target, rotated: Sequence[Angle]) -> dict[str, Any] | None:
    """The struct of sines and cosines, how they are computed, and how they are rotated."""
    if not rotated:
        return None
    P = target.prefix
    return {
        "members": sines(rotated),
        "count": len(rotated),
        "at": [
            f"{P}_sincos({along(target, a, 'q->', a.offset)}, &s->{a.sine}, &s->{a.cosine});"
            for a in rotated
        ],
        "rotated": [
            f"{P}_sincos_with_fallback({along(target, a, 'q->', a.offset)}, "
            f"{along(target, a, 'd->', S.Zero)}, from->{a.sine}, "
            f"from->{a.cosine}, &s->{a.sine}, &s->{a.cosine});"
            for a in rotated
        ],
    }


def of_tile(target: Target, rotated: Sequence[Angle], arrays: bool) -> dict[str, Any] | None:
    """The sines and cosines of an instance, computed or, in loops over a tile, rotated from others.

    triple: statements for three loops of every angle: reduced at q + h/2 qd, their sine and cosine,
    and rotated to q and q + h qd. further: rotated from the middle by h^2/4 a1 and from the end by
    h^2/2 a2, in place. within: that all angles are within what rotations are good for.
    """
    if not rotated:
        return None
    P, f = target.prefix, target.real.function_suffix
    # the bounds of sincos_rotate_both and sincos_rotate in csrc/sincos/incremental.h
    both_by, by = (0.125, 0.015625) if target.real is DOUBLE else (0.25, 0.0625)
    vector = f"{P}_vector"

    def both(struct: str, angle: Angle, at: str = "") -> str:
        return f"&{struct}{angle.sine}{at}, &{struct}{angle.cosine}{at}"

    def coordinates(angle: Angle, line: str) -> list[str]:
        return [
            line.replace("$", vectors.member(target, arrays, n)).replace("#", target.enum[n])
            for _, n in angle.terms
        ]

    def sum_of(angle: Angle, vector: str, offset: Expr = S.Zero) -> str:
        return along(target, angle, vector, offset, arrays)

    def rotate(angle: Angle, of: str) -> str:
        d = sum_of(angle, "d.")
        place = f"{of}.{angle.sine}[i], {of}.{angle.cosine}[i], {both(of + '.', angle, '[i]')}"
        return f"{P}_sincos{f}_rotate({d}, {place});"

    def within(angle: Angle, v: str, most: str) -> str:
        return f"fabs{f}({sum_of(angle, v)}) <= {most}"

    def slowly(angle: Angle, q: str, qd: str) -> list[str]:
        reach = target.literal(target.real.reach - both_by)
        return [f"fabs{f}({sum_of(angle, q, angle.offset)}) <= {reach}", within(angle, qd, "slow")]

    def odd(conditions: Sequence[str]) -> str:
        return "odd |= !(" + " & ".join(f"({x})" for x in conditions) + ");"

    def reduced(angle: Angle) -> list[str]:
        x = sum_of(angle, "at.", angle.offset)
        return [
            f"{vector} at, moving;",
            "",
            *coordinates(angle, "at.$ = from->q.x[#][i];"),
            *coordinates(angle, "moving.$ = from->qd.x[#][i];"),
            odd(slowly(angle, "at.", "moving.")),
            *coordinates(angle, "at.$ += h_2*moving.$;"),
            f"mid.{angle.sine}[i] = {P}_sincos{f}_reduce({x}, &mid.{angle.cosine}[i]);",
        ]

    def computed(angle: Angle) -> list[str]:
        r = f"mid.{angle.sine}[i], mid.{angle.cosine}[i]"
        return [f"{P}_sincos{f}_of_reduced({r}, {both('mid.', angle, '[i]')});"]

    def triple(angle: Angle) -> list[str]:
        d = sum_of(angle, "d.")
        middle = f"mid.{angle.sine}[i], mid.{angle.cosine}[i]"
        sides = f"{both('back.', angle, '[i]')}, {both('on.', angle, '[i]')}"
        return [
            f"{vector} d;",
            "",
            *coordinates(angle, "d.$ = h_2*from->qd.x[#][i];"),
            f"{P}_sincos{f}_rotate_both({d}, {middle}, {sides});",
        ]

    def further(angle: Angle) -> list[str]:
        return [
            f"{vector} a1, a2, d;",
            "",
            *coordinates(angle, "a1.$ = first.x[#][i];"),
            *coordinates(angle, "a2.$ = second.x[#][i];"),
            odd([within(angle, v, "small") for v in ("a1.", "a2.")]),
            *coordinates(angle, "d.$ = hh_4*a1.$;"),
            rotate(angle, "mid"),
            *coordinates(angle, "d.$ = hh_2*a2.$;"),
            rotate(angle, "on"),
        ]

    return {
        "members": sines(rotated),
        "at": [
            f"{P}_sincos{f}_branchless({sum_of(a, 'q->', a.offset)}, {both('s->', a)}, failed);"
            for a in rotated
        ],
        "triple": [x for a in rotated for x in (reduced(a), computed(a), triple(a))],
        "further": [further(a) for a in rotated],
        "slow": f"{target.literal(both_by)}/fabs{f}(h_2)",
        "small": f"{target.literal(by)}/hh_2",
        "slowly": [x for a in rotated for x in slowly(a, "q.", "qd.")],
        "narrow": [within(a, v, "small") for v in ("a1.", "a2.") for a in rotated],
        "within": " && ".join(within(a, "d.", "most") for a in rotated),
        "changes": "const " + vectors.vector_of(target, arrays, "d", "v->x[#][i]"),
    }


def sines(rotated: Sequence[Angle]) -> list[str]:
    """The names of all that is rotated."""
    return [name for a in rotated for name in (a.sine, a.cosine)]


def along(target: Target, angle: Angle, vector: str, offset: Expr, arrays: bool = False) -> str:
    """An angle of a vector of coordinates."""
    where = {n: vector + vectors.member(target, arrays, n) for _, n in angle.terms}
    printer = c_expression.Printer(target.prefix, target.real, where)
    return printer.value(Sum(angle.terms, offset))[0]
