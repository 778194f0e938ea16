"""Steppers as their templates want them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import isfinite, sqrt
from typing import Any

from sympy import Rational

from eomc.emit import c_expression, vectors
from eomc.emit.c_expression import Real
from eomc.emit.c_names import Target, after, arguments
from eomc.integrators.tableaux import RK4, Method, Row
from eomc.program.program import TIME

RK4_BY = {
    "angles": "c/fast/rk4_angles.c.jinja",
    "two_point": "c/fast/rk4_two_point.c.jinja",
}  # what makes it faster


def literal(x: Fraction, real: Real) -> str:
    """A coefficient as it is written in C."""
    return c_expression.number(Rational(x.numerator, x.denominator), real)


def _nearest(x: Fraction, real: Real) -> Fraction:
    """The double nearest to x, or the float nearest to that."""
    form = {"float64": "d", "float32": "f"}[real.dtype]
    return Fraction(*struct.unpack(form, struct.pack(form, float(x))))


def rounded(weights: Row, real: Real) -> Row:
    """The weights as they are in C, with their sum as it is: what it lacks would add up over steps.

    The smallest one takes what rounding left of the sum; of a symmetric method both of a pair.
    """
    if not real.dtype:  # 113 bits, for references
        return weights
    rounded = [_nearest(x, real) for x in weights]
    lack = Fraction(round(sum(weights, Fraction(0)))) - sum(rounded, Fraction(0))
    symmetric = weights == weights[::-1] and len(weights) > 1
    for k in sorted(range(len(rounded)), key=lambda k: abs(rounded[k])):
        places = {k, len(rounded) - 1 - k} if symmetric else {k}
        wished = rounded[k] + lack / len(places)
        if rounded[k] and _nearest(wished, real) == wished:
            return tuple(wished if n in places else x for n, x in enumerate(rounded))
    return tuple(rounded)


def _about(m: Method) -> dict[str, Any]:
    """What a method's template says of it."""
    undamped, decay = m.limits
    return {
        "name": m.name,
        "title": m.title,
        "order": m.order,
        "source": m.source,
        "stages": m.stages,
        "two_point": False,
        "limits": m.limits,
        "notes": m.notes,
        "implicit": m.implicit,
        "newton": m.newton,
        "sweeps": m.sweeps,
        "stability": f"h omega <= {undamped:.3g} undamped"
        + (f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."),
    }


def method(
    target: Target, m: Method, slopes: Mapping[str, Any] | None, scalar: Mapping[str, Any],
    stage_parallel: Mapping[str, Any] | None, faster: str,
    tile: Mapping[str, Any] | None,
) -> dict[str, Any]:  # fmt: skip
    """A method as its template wants it. faster: what RK4 makes use of, if anything."""
    arrays = scalar["arrays"]
    if m.sweeps:
        return _stage_parallel(target, m, scalar, stage_parallel)
    if slopes is not None and m.newton:
        return _implicit(target, m, slopes, scalar, arrays)
    return _explicit(m, target.real, faster, tile)


def _explicit(m: Method, real: Real, faster: str, tile: Mapping[str, Any] | None) -> dict[str, Any]:
    """An explicit method as its template wants it; RK4 has one of its own, written out by hand."""

    def total(row: Row) -> str:
        terms = [(x, k + 1) for k, x in enumerate(row) if x]
        text = " + ".join(f"{literal(x, real)}*a{k}.$" for x, k in terms).replace("+ -", "- ")
        return text or literal(Fraction(0), real)

    def lines(c: Fraction, positions: Row, velocities: Row) -> list[str]:
        step = "h" if c == 1 else f"{literal(c, real)}*h"
        return [
            f"r->$ = q->$ + ({step}*qd->$ + hh*({total(positions)}));",
            f"v->$ = qd->$ + h*({total(velocities)});",
        ]

    def time(c: Fraction) -> str:
        return "t + h" if c == 1 else f"t + {literal(c, real)}*h"

    stages = [] if m is RK4 else list(zip(m.c, m.a_squared, m.a, strict=True))[1:]
    first, half = m.c[0], literal(m.c[0], real)
    faster = faster if m is RK4 else ""
    tile_template = "c/fast/rk4.c.jinja" if m is RK4 else "c/fast/explicit.c.jinja"
    by_stages = m is RK4 and bool(tile and tile["one"])
    return _about(m) | {
        "by_stages": by_stages,
        "by_rates": not by_stages or bool(tile and tile["angles"]),
        "angles": faster == "angles",
        "two_point": faster == "two_point",
        "template": RK4_BY.get(faster, tile_template),
        "tile_template": tile_template,
        "begin": [f"r->$ = q->$ + {half}*h*qd->$;"] if first else [],
        "begin_at": "r, qd" if first else "q, qd",
        "begin_time": time(first) if first else "t",
        "body": [{"lines": lines(c, *rows), "time": time(c)} for c, *rows in stages],
        "end": [
            f"r->$ = h*qd->$ + hh*({total(m.b_a)});",
            f"v->$ = h*({total(rounded(m.b, real))});",
        ],
    }


def _start(target: Target, arrays: bool) -> list[str]:
    """The state that a step begins from, as arrays."""
    both = ("q", "at_now"), ("qd", "moving_now")
    return [vectors.gathered(target, arrays, of, name) for of, name in both]


def _implicit(
    target: Target, m: Method, slopes: Mapping[str, Any], scalar: Mapping[str, Any], arrays: bool
) -> dict[str, Any]:
    """An implicit method as its template wants it, for one trajectory."""
    real, P, s = target.real, target.prefix, m.stages
    t, u = ("t" if target.driven else ""), ("u" if target.system.inputs else "")
    p = "p" if slopes["takes_p"] or (slopes["signal_near"] and target.needs_p) else ""
    memory = f"{P}_{m.name}_memory *m"
    own_p = p if "_params *p" not in scalar["stepper_arguments"] else ""
    given = arguments(
        memory, f"{real.name} h", f"const {real.name} *q", f"const {real.name} *qd",
        t and f"{real.name} t", u and f"const {real.name} *u", p and target.p_arg,
    )  # fmt: skip

    def matrix(rows: Sequence[Row]) -> list[str]:
        return ["{ " + ", ".join(literal(x, real) for x in row) + " }," for row in rows]

    def total(matrix: str, of: str = "#") -> str:
        return " + ".join(f"{matrix}[{j}]*a[{j}][{of}]" for j in range(s))

    def now(at: str, moving: str, time: str) -> str:
        return arguments("m", "h", at, moving, t and time, u, p)

    last = [" + ".join(f"{literal(x, real)}*a[{j}][#]" for j, x in enumerate(row))
            for row in (m.b_a, rounded(m.b, real))]  # fmt: skip
    return _about(m) | {
        "template": "c/fast/gauss.c.jinja",
        "arguments": arguments(scalar["stepper_arguments"], own_p and target.p_arg, memory),
        "call_more": after(own_p, "m"),
        "angles": False,
        "factor_arguments": given,
        "factor_unread": [name for name in slopes["unread"] if name != "p" or p],
        "factor_now": now("at_now", "moving_now", "t"),
        "factor_mid": now("mid_q", "mid_qd", f"t + {literal(Fraction(1, 2), real)}*h"),
        "eps": repr(real.epsilon) + real.suffix,
        "nudge": repr(sqrt(real.epsilon)) + real.suffix,
        "c": [literal(x, real) for x in m.c],
        "A": matrix(m.a),
        "AA": matrix(m.a_squared),
        "extrapolation": matrix(m.ahead),
        "guess": " + ".join(f"extrapolation[i][{j}]*m->a[{j}][k]" for j in range(s)),
        "gathered": _start(target, arrays),
        "stage": [
            f"at.$ = q->$ + (c_[i]*h*qd->$ + hh*({total('AA[i]')}));",
            f"moving.$ = qd->$ + h*({total('A[i]')});",
        ],
        "end": [f"r->$ = h*qd->$ + hh*({last[0]});", f"v->$ = h*({last[1]});"],
    }  # fmt: skip


def _stage_parallel(
    target: Target, m: Method, scalar: Mapping[str, Any], stages: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A method of few sweeps as its template wants it, for one trajectory.

    stages: what a loop over them calls; None where accelerations are long, and stages take turns.
    """
    real, P, s = target.real, target.prefix, m.stages
    timed = TIME in target.program["acceleration"].uses
    t, u = ("t" if target.driven else ""), ("u" if target.system.inputs else "")
    rest = scalar["stepper_arguments"].split(", ", 2)[2]
    c, p = ("c" if "_constants *c" in rest else ""), ("p" if "_params *p" in rest else "")
    values, memory = f"{P}_{m.name}_stages", f"{P}_{m.name}_memory *m"
    arrays, alone = scalar["arrays"], f"{target.PREFIX}_ALONE"

    def by_stage(rows: Sequence[Row]) -> list[str]:
        columns = zip(*rows, strict=True)
        return ["{ " + ", ".join(literal(x, real) for x in column) + " }," for column in columns]

    def total(terms: Sequence[str]) -> str:
        """In pairs, since a sum in a row would wait for each of its terms."""
        while len(terms) > 1:
            pairs = [" + ".join(terms[k : k + 2]) for k in range(0, len(terms), 2)]
            terms = [f"({pair})" for pair in pairs] if len(pairs) > 1 else pairs
        return terms[0]

    def held(given: str) -> str:
        return after(t and "t + c_[i]*h", "&given", given, c, "&bad")

    last = [total([f"{literal(x, real)}*a.x[#][{k}]" for k, x in enumerate(row)])
            for row in (m.b_a, rounded(m.b, real))]  # fmt: skip
    inputs = ", ".join(f"u ? u[{target.enum[n]}] : {target.zero}" for n in target.input_names)
    return _about(m) | {
        "template": "c/fast/picard.c.jinja",
        "angles": False,
        "arguments": arguments(scalar["stepper_arguments"], memory),
        "call_more": after("m"),
        "inline": f"{target.PREFIX}_FORCE_INLINE" if stages else "static inline",
        "stage_parallel": stages is not None,
        "sum": total([f"w[{k}][i]*a[{k}]" for k in range(s)]),
        "c": [literal(x, real) for x in m.c],
        "A": by_stage(m.a),
        "AA": by_stage(m.a_squared),
        "A_extrapolated": by_stage(m.a_ahead),
        "AA_extrapolated": by_stage(m.a_squared_ahead),
        "sweep_arguments": arguments(
            f"{values} *{alone} b", f"const {values} *{alone} a",
            f"const {P}_{m.name}_sums *w", rest,
        ),
        "sweep": lambda of, sums: f"{P}_{m.name}_sweep("
        + arguments(of, f"&{P}_{m.name}_{sums}", "q", "qd", t, "h", u, c, p) + ");",
        "settle_arguments": arguments(f"{values} *a", "int fresh", rest, memory),
        "settle_call": arguments("&a", "!smooth", "q", "qd", t, "h", u, c, p, "m"),
        "given": f"const {P}_inputs given = {{ {inputs} }};",
        "loops": [
            {"only": "if (u)", "call": held("1")}, {"only": "else", "call": held("0")},
        ] if u else [{"only": "", "call": after("t + c_[i]*h" if timed else "", c, "&bad")}],
        "eps": repr(real.epsilon) + real.suffix,
        # steps that five sweeps do not do are long, and err by more than this
        "enough": repr(max(1e-8, real.epsilon)) + real.suffix,
        "loose": f"{max(1e-6, 512 * real.epsilon):.0e}" + real.suffix,
        "gathered": _start(target, arrays),
        "stage": [
            f"at.$ = q->$ + (c_[i]*h*qd->$ + hh*{P}_{m.name}_sum(w->AA, a->x[#], i));",
            f"moving.$ = qd->$ + h*{P}_{m.name}_sum(w->A, a->x[#], i);",
        ],
        "end": [f"r->$ = h*qd->$ + hh*({last[0]});", f"v->$ = h*({last[1]});"],
    }  # fmt: skip
