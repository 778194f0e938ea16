"""Accelerations, steppers and batches for the templates.

A small acceleration is inlined into the steppers, its state in named scalars. A large one comes in
pieces that are called, its state in arrays, and in a batch each piece is a loop over a tile.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from math import isfinite, sqrt
from typing import Any

import numpy as np
from sympy import Expr, Rational, S

from eomc import ccode, side
from eomc.angles import Angle, apart
from eomc.assignments import Function, Operand, Sum
from eomc.ccode import DOUBLE, Body, Real, indent
from eomc.pieces import is_large, staged
from eomc.program import TIME
from eomc.steppers import METHODS, RK4, Method, Row
from eomc.system import System
from eomc.target import (
    TROUBLE,
    Access,
    Argument,
    Target,
    after,
    arguments,
    none_of,
    sentence,
)

NEAR = 32_768  # bytes that a tile of a small system may have: a first-level cache
MANY_ANGLES = 5  # of which sines are computed side by side in a step of one trajectory
WIDE = 131_072  # and of a large one: a part of a second-level cache


def dynamics(target: Target, slopes: Mapping[str, Any] | None) -> dict[str, Any]:
    """What belongs to accelerations and steppers; slopes: what evaluations.linearization gives."""
    s, function, real = target.system, target.program["acceleration"], target.real.name
    P, NQ = target.prefix, f"{target.PREFIX}_NQ"
    large = is_large(function)
    turned, rest = _apart(target, function)
    prepare = _prepare_large(target, function) if large else _prepare(target, rest, turned)
    kept = prepare["prepared_members"]
    takes_c, takes_p = bool(kept), target.needs_p and "signal" in target.program
    t, u = "t" if target.driven else "", "u" if s.inputs else ""
    c, p = "c" if takes_c else "", "p" if takes_p else ""
    scalar = _mode(target, rest, prepare, takes_c, takes_p, turned)
    t_arg, u_arg = f"{real} t" if t else "", f"const {real} *u" if u else ""
    outer = arguments(u_arg, target.p_arg)
    x = f"{real} q[{NQ}], {real} qd[{NQ}]"
    rows = f"long every, {real} *q_rows, {real} *qd_rows"
    t0_arg = f"{real} t0" if t else ""
    lane = _lane(target, function, prepare, scalar) if s.run.batch else None
    side_by_side = side.lane(target, function, kept) if _swept(s) and not large else None
    methods = [
        _method(target, METHODS[name], slopes, scalar, side_by_side, turned, lane)
        for name in s.run.methods
    ]
    return prepare | {
        "large": large,
        "prepare_arguments": arguments(f"{P}_prepared *c" if takes_c else "", target.p_arg),
        "prepare_call": arguments("&prepared" if takes_c else "", target.p_call),
        "prepare_unread": target.needs_p and not _reads_p(prepare),
        "p_unused": target.needs_p and not prepare["has_prepare"] and not takes_p,
        "takes_c": takes_c,
        "cost": sentence(function),
        "scalar": scalar,
        "lane": lane,
        "side_by_side": side_by_side,
        "lanes_turn": bool(lane and lane["angles"]),
        "rates_now": f"{P}_{scalar['rates']}(&a, &at, &moving{scalar['call']('t')})",
        "stepper_call": after(t, "h", u, c, p),
        "methods": methods,
        "tile_rates": any(m.get("by_rates") for m in methods),
        "implicit": any(METHODS[name].implicit for name in s.run.methods),
        "newton": any(METHODS[name].newton for name in s.run.methods),
        "angles": _angles(target, turned),
        "fabs": "fabs" + target.real.function_suffix,
        "fmax": "fmax" + target.real.function_suffix,
        "method_names": repr(s.run.methods),
        "t_call": after(t),
        "p_call": after(target.p_call),
        "acceleration_prototype": f"{P}_status {P}_acceleration("
        + arguments(
            f"{real} qdd[{NQ}]", f"const {real} q[{NQ}]", f"const {real} qd[{NQ}]", t_arg, outer
        ) + ")",
        "step_prototype": lambda name: f"{P}_status {P}_{name}_step("
        + arguments(x, t_arg, f"{real} h", outer) + ")",
        "run_prototype": lambda name: f"long {P}_{name}_run("
        + arguments(
            x, t0_arg, f"{real} h", "long first", "long steps",
            u_arg and f"{u_arg}, long u_stride", rows, target.p_arg,
            f"{P}_{name}_memory *memory", f"{P}_status *status",
        ) + ")",
        "batch_prototype": lambda name: f"void {P}_{name}_batch("
        + arguments(
            "long count", f"{real} *q", f"{real} *qd", t0_arg, f"{real} h", "long first",
            "long steps", u_arg and f"{u_arg}, long u_instance, long u_step",
            f"{rows}, long row_count", target.p_arg and f"{target.p_arg}, long p_instance",
            "long *done", "int *status",
        ) + ")",
        "tile": _tile(target, len(kept), lane) if lane else 0,
        "input_names": target.input_names,
        "sincos": f"{P}_sincos{target.real.function_suffix}" if target.sincos else "",
        "reach": target.literal(target.real.reach),
        "prepare_lane": arguments(
            "&prepared" if takes_c else "", "p + k*p_instance" if target.needs_p else ""
        ),
        "retry_call": after(
            t, "h", u and "u ? u + (base + i)*u_instance + n*u_step : 0",
            "&c" if takes_c else "", "p + (base + i)*p_instance" if takes_p else "",
        ),
        "tile_prototype": lambda name: f"int {P}_{name}_tile_step("
        + arguments(f"{P}_tile *s", t_arg, f"{real} h", u and "int held") + ")",
        "batch_binding": lambda name: f"{P}_{name}_batch("
        + arguments(
            "count", "q", "qd", t and "t0", "h", "first", "steps",
            u and "u, u_instance, u_step", "every", "q_rows", "qd_rows", "row_count",
            f"{target.p_cast}, p_instance" if target.needs_p else "", "done", "status",
        ) + ")",
        "vector_members": [f"{real} x[{NQ}];"] if large
        else [f"{real} {', '.join(target.names)};"],
        "vector_of": lambda name, element: _vector_of(target, large, name, element),
        "prepared_here": f"const {P}_prepared c = "
        + "{ " + ", ".join(f"s.c.{n}[i]" for n in kept) + " };",
    }  # fmt: skip


def _swept(system: System) -> bool:
    """Whether some method has its stages side by side."""
    return any(METHODS[name].sweeps for name in system.run.methods)


# --- sines and cosines apart ---------------------------------------------------------------------


def _apart(target: Target, function: Function) -> tuple[tuple[Angle, ...], Function]:
    """The angles that RK4 turns, and the acceleration that reads their sines and cosines."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods or is_large(function):
        return (), function
    return apart(function, target.names)


def _angles(target: Target, turned: Sequence[Angle]) -> dict[str, Any] | None:
    """The struct of sines and cosines, and how they are had at a place, and near one."""
    if not turned:
        return None

    P, members, n = target.prefix, _sines(turned), len(turned)
    ends = ("", "q"), ("N + ", "end")
    return {
        "members": members,
        "count": n,
        "many": n >= MANY_ANGLES,
        "gathered": [
            f"x[{at}{k}] = {_along(target, a, of + '->', a.offset)};"
            for at, of in ends
            for k, a in enumerate(turned)
        ],
        "scattered": [
            f"{to}->{a.sine} = sines[{at}{k}], {to}->{a.cosine} = cosines[{at}{k}];"
            for (at, _), to in zip(ends, ("s", "s_end"), strict=True)
            for k, a in enumerate(turned)
        ],
        "at": [
            f"{P}_sincos({_along(target, a, 'q->', a.offset)}, &s->{a.sine}, &s->{a.cosine});"
            for a in turned
        ],
        "near": [
            f"{P}_sincos_near({_along(target, a, 'q->', a.offset)}, "
            f"{_along(target, a, 'd->', S.Zero)}, from->{a.sine}, "
            f"from->{a.cosine}, &s->{a.sine}, &s->{a.cosine});"
            for a in turned
        ],
    }


def _sines(turned: Sequence[Angle]) -> list[str]:
    return [name for a in turned for name in (a.sine, a.cosine)]


# --- what parameters alone decide -----------------------------------------------------------------


def _prepare(target: Target, function: Function, turned: Sequence[Angle]) -> dict[str, Any]:
    own = [p.name for p in target.system.parameters]
    where = {name: f"s->{name}" for name in _sines(turned)}
    body = target.body(function, where, keep=_in_prepared, parameters=own)
    kept = _with_signal(target, list(body.kept))
    return {
        "prepared_members": kept,
        "prepare_pieces": None,
        "prepare_early": [line for block in body.early for line in block.lines],
        "prepare_sets": [f"c->{n} = {'p->' if n in own else ''}{n};" for n in kept],
        "prepare_result": none_of(body.early_failures),
        "has_prepare": bool(kept or body.early_failures),
        "body": body,
    }


def _prepare_large(target: Target, function: Function) -> dict[str, Any]:
    """The same as a function of its own, itself in pieces where it is long."""
    own = [p.name for p in target.system.parameters]
    first, _ = staged(function, own)
    kept = _with_signal(target, [o.name for o in first.outputs])
    first = replace(first, outputs=tuple(Operand(S.One, n) for n in kept))
    places = [f"c->{n}" for n in kept]
    made = {"prepared_members": kept, "has_prepare": bool(kept or first.checks)}
    if not is_large(first):
        body = target.body(first)
        sets = [f"{to} = {text};" for to, text in zip(places, body.results, strict=True)]
        return made | {
            "prepare_pieces": None,
            "prepare_early": [line for block in body.early for line in block.lines],
            "prepare_sets": sets,
            "prepare_result": none_of(body.early_failures),
        }
    given = [Argument(target.p_arg, "p", frozenset(own))]
    out = Argument(f"{target.prefix}_prepared *c", "c", frozenset())
    cut = target.in_pieces(first, "prepare", given, places, out, lambda f: [])
    return made | {
        "prepare_pieces": cut,
        "prepare_early": cut["locals"],
        "prepare_sets": cut["calls"],
        "prepare_result": cut["outcome"],
    }


def _reads_p(prepare: Mapping[str, Any]) -> bool:
    lines = [*prepare["prepare_early"], *prepare["prepare_sets"], prepare["prepare_result"]]
    return any(re.search(r"\bp\b", line) for line in lines)


def _with_signal(target: Target, kept: list[str]) -> list[str]:
    """With the parameters that the signals read, since lanes have no others."""
    by_lanes = target.system.run.batch or _swept(target.system)
    if not (by_lanes and "signal" in target.program):
        return kept
    own = [p.name for p in target.system.parameters]
    uses = target.program["signal"].uses
    return [n for n in own if n in kept or n in uses] + [n for n in kept if n not in own]


def _in_prepared(name: str) -> str:
    return f"c->{name}"


# --- one trajectory -------------------------------------------------------------------------------


def _mode(
    target: Target,
    function: Function,
    prepare: Mapping[str, Any],
    takes_c: bool,
    takes_p: bool,
    turned: Sequence[Angle],
) -> dict[str, Any]:
    """solve, rates and steppers for one trajectory: they return whether D was regular.

    turned: the angles whose sines and cosines are not computed in `function`.
    """
    s, real, P = target.system, target.real.name, target.prefix
    timed, u, large = TIME in function.uses, bool(s.inputs), "body" not in prepare
    t_arg = f"{real} t" if target.driven else ""
    u_arg = f"const {real} *u" if u else ""
    c_arg = f"const {P}_prepared *c" if takes_c else ""
    p_arg = target.p_arg if takes_p else ""
    c, p = "c" if takes_c else "", "p" if takes_p else ""
    state = f"const {P}_vector *q, const {P}_vector *qd"
    s_arg, s_call = (f"const {P}_angles *s", "s") if turned else ("", "")
    rates_rest = (t_arg, u_arg, c_arg, p_arg)

    def rates(time: str) -> str:
        if u:
            return after(time if target.driven else "", "u", c, p)
        return after(time if timed else "", c)

    def in_vector(array: str, name: str) -> str:
        return f"{array}->x[{target.enum[name]}]" if large else f"{array}->{name}"

    made: dict[str, Any] = {
        "head": "static int"
        if large
        else f"{target.PREFIX}_INLINE int"
        if turned
        else "static inline int",
        "vector": f"{P}_vector",
        "solve": "solve_at" if turned and not u else "solve",
        "rates": "rates" if u else "solve",
        "rates_at": ("rates" if u else "solve") + ("_at" if turned else ""),
        "suffix": "",
        "solve_arguments": arguments(
            f"{P}_vector *a", state, s_arg, f"{real} t" if timed else "", u_arg, c_arg
        ),
        "solve_u": after(s_call, "t" if timed else "", "u", c),
        "solve_now": after(s_call, "t" if timed else "", "now", c),
        "rates_arguments": arguments(f"{P}_vector *a", state, s_arg, *rates_rest),
        "own_rates_arguments": arguments(f"{P}_vector *a", state, *rates_rest)
        if u
        else arguments(f"{P}_vector *a", state, f"{real} t" if timed else "", c_arg),
        "rk4_arguments": arguments(
            f"{P}_vector *r, {P}_vector *v, {P}_angles *s, {state}",
            t_arg,
            f"{real} h",
            u_arg,
            c_arg,
            p_arg,
        ),
        "stepper_arguments": arguments(
            f"{P}_vector *r, {P}_vector *v, {state}", t_arg, f"{real} h", u_arg, c_arg, p_arg
        ),
        "unused": _unread(target, function),
        "pieces": None,
        "signal_at": [_gathered(target, large, "q", "at"), _gathered(target, large, "qd", "moving")]
        if target.signal_state
        else [],
        "signal_call": target.signal_call("now", "at", "moving"),
        "call": rates,
        "call_at": lambda angles, time: f", {angles}{rates(time)}",
        "compensated": True,
        "first": "int good = ",
        "and": "good &= ",
        "last": "return good;",
        "each": lambda lines, width=4, index="i": indent(_each(target, large, lines, index), width),
        "rows": indent(_rows(target, large), 12),
        "own_signal": None,
    }
    if not large:
        body: Body = prepare["body"]
        return made | {
            "loads": target.loads(function, in_vector, target.element),
            "blocks": body.blocks,
            "results": [
                f"a->{name} = {r};" for name, r in zip(target.names, body.results, strict=True)
            ],
            "end": [f"return {none_of(body.failures)};"],
        }
    _, rest = staged(function, [p.name for p in s.parameters])
    kept = prepare["prepared_members"]
    groups = target.groups()
    given = [
        Argument(f"const {P}_vector *q", "q", groups["q"]),
        Argument(f"const {P}_vector *qd", "qd", groups["qd"]),
        Argument(f"{real} t", "t", groups["t"]),
        Argument(u_arg, "u", groups["u"]),
        Argument(f"const {P}_prepared *c", "c", frozenset(kept)),
    ]
    cut = target.in_pieces(
        rest,
        "solve",
        given,
        [in_vector("a", name) for name in target.names],
        Argument(f"{P}_vector *a", "a", frozenset()),
        lambda f: target.loads(f, in_vector, target.element),
        {n: _in_prepared(n) for n in kept},
    )
    return made | {
        "pieces": cut,
        "unused": [*made["unused"], *(["c"] if takes_c and not rest.uses & set(kept) else [])],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "end": [f"return {cut['outcome']};"],
    }


def _each(target: Target, large: bool, lines: Sequence[str], index: str = "i") -> list[str]:
    """Statements for every coordinate: $ is its member of a vector, # its place in an array."""
    if large:
        inside = [line.replace("$", f"x[{index}]").replace("#", index) for line in lines]
        return _loop(index, f"{target.PREFIX}_NQ", inside)
    return [
        line.replace("$", name).replace("#", target.enum[name])
        for name in target.names
        for line in lines
    ]


def _rows(target: Target, large: bool) -> list[str]:
    """The state into the present rows."""
    both = ("q_rows", "at"), ("qd_rows", "moving")
    if large:
        return _each(target, True, [f"{row}[#] = {x}.$;" for row, x in both])
    return [f"{row}[{k}] = {x}.{name};" for k, name in enumerate(target.names) for row, x in both]


def _loop(index: str, end: str, inside: Sequence[str]) -> list[str]:
    brace = len(inside) > 1
    head = f"for (int {index} = 0; {index} < {end}; {index}++)" + " {" * brace
    return [head, *(f"    {line}" for line in inside), *(["}"] if brace else [])]


def _gathered(target: Target, large: bool, of: str, name: str) -> str:
    """The numbers of a vector as an array."""
    inside = ", ".join(
        f"{of}->x[{target.enum[n]}]" if large else f"{of}->{n}" for n in target.names
    )
    return f"const {target.real.name} {name}[{target.PREFIX}_NQ] = {{ {inside} }};"


def _vector_of(target: Target, large: bool, name: str, element: str) -> str:
    """A vector whose numbers are `element` with # for each place."""
    inside = ", ".join(element.replace("#", target.enum[n]) for n in target.names)
    inside = f"{{ {{ {inside} }} }}" if large else f"{{ {inside} }}"
    return f"{target.prefix}_vector {name} = {inside};"


def _unread(target: Target, function: Function) -> list[str]:
    """Arguments that the body of a function does not read."""
    groups, uses = target.groups(), function.uses
    return [k for k in ("q", "qd", "u") if groups[k] and not uses & groups[k]]


# --- many at once ---------------------------------------------------------------------------------


def _lane(
    target: Target, function: Function, prepare: Mapping[str, Any], mode: Mapping[str, Any]
) -> dict[str, Any]:
    """The same for a batch: no branches; what goes wrong is noted in trouble.

    Accelerations and steppers of a whole tile. Large: each piece is a loop over it. Small: what one
    instance needs is inlined into such loops, one for every stage of a step.
    """
    s, real, P = target.system, target.real.name, target.prefix
    large, held = "body" not in prepare, bool(s.inputs)
    timed = TIME in function.uses
    kept = prepare["prepared_members"]
    alone = f"{target.PREFIX}_ALONE "
    troubles = f"{real} *{alone}troubles"
    u_arg = f"const {P}_inputs_lanes *u" if held else ""
    c_arg = f"const {P}_prepared_lanes *c" if kept else ""
    t_arg = f"{real} t" if target.driven else ""
    state = f"const {P}_lanes *q, const {P}_lanes *qd"
    c = "c" if kept else ""

    def rates(time: str) -> str:
        if held:
            return after(time if target.driven else "", "u", "held", c, "troubles")
        return after(time if timed else "", c, "troubles")

    made = dict(mode) | {
        "head": "static void" if large else f"{target.PREFIX}_PIECE void",
        "inline": f"{target.PREFIX}_{'INLINE' if large else 'LANE'}",
        "vector": f"{P}_lanes",
        "solve": "solve_lane",
        "rates": ("rates_lane" if held else "solve_lane") if large else "rates_tile",
        "suffix": "_lane",
        "solve_arguments": arguments(
            f"{P}_lanes *a", state, f"{real} t" if timed else "", u_arg, c_arg, troubles
        ),
        "solve_u": after("t" if timed else "", "held ? u : &now", c, "troubles"),
        "rates_arguments": arguments(
            f"{P}_lanes *{'' if large else alone}a", state, t_arg, u_arg,
            "int held" if held else "", c_arg, troubles,
        ),
        "inputs": f"{P}_inputs_lanes",
        "stepper_arguments": arguments(
            f"{P}_lanes *r, {P}_lanes *v" if large else f"{P}_lanes *{alone}r, {P}_lanes *{alone}v",
            state, t_arg, f"{real} h", u_arg and f"{u_arg}, int held", c_arg, troubles,
        ),
        "stepper_call": lambda troubles: after(
            "t" if target.driven else "", "h", "&s->u, held" if held else "",
            "&s->c" if kept else "", troubles,
        ),
        "call": rates,
        "compensated": False,
        "first": "",
        "and": "",
        "last": "",
        "each": lambda lines, width=4: indent(_each_of_tile(target, lines), width),
        "flag": "long long" if real == "double" else "int",  # as wide as a real
        "angles": None,
        "one": None,
        "pieces": None,
        "own_signal": _signal_lanes(target, kept, c_arg, troubles) if large else None,
    }  # fmt: skip
    if not large:
        return made | _lane_small(target, function, kept)
    return made | _lane_large(target, function, kept, made)


def _each_of_tile(target: Target, lines: Sequence[str]) -> list[str]:
    """Statements for every coordinate of every instance."""
    inside = [line.replace("$", "x[j][i]") for line in lines]
    return _loop("j", f"{target.PREFIX}_NQ", _loop("i", f"{target.PREFIX}_TILE", inside))


def _lane_small(target: Target, function: Function, kept: Sequence[str]) -> dict[str, Any]:
    """Accelerations of one instance, and how loops over a tile call them."""
    s, real = target.system, target.real
    held, timed = bool(s.inputs), TIME in function.uses
    reach = real.reach and "rk4" in s.run.methods
    turned, rest = apart(function, target.names) if reach else ((), function)
    at = [target.enum[n] for n in target.names]

    def call(angles: str, time: str, hold: str, troubles: str) -> str:
        now = time if (target.driven if held else timed) else ""
        return after(
            angles if turned else "", now, f"&given, {hold}" if held else "",
            "&here" if kept else "", f"&{troubles}[i]",
        )  # fmt: skip

    one = side.lane(target, rest, kept, _sines(turned)) | {
        "each": lambda lines, width=4: indent(_each(target, False, lines), width)
    }
    return {
        "one": one,
        "angles": _angles_lane(target, turned),
        "odd": [
            f"const {real.name} sum = "
            + " + ".join(f"{x}.{n}" for n in target.names for x in ("q", "qd"))
            + ";",
            f"odd |= !((sum - sum) + s->trouble[i] + {'far' if turned else 's->idle'}[i] < 1);",
        ],
        "sum": " + ".join(f"{x}.x[{k}][i]" for k in at for x in "rv"),
        "rates_given": [
            *_of_instance(target, "at", "vector", "q->x[#][i]", target.names),
            *_of_instance(target, "moving", "vector", "qd->x[#][i]", target.names),
            *_given(target, kept, "u->", "c->"),
        ],
        "rates_call": call("&s", "t", "held", "troubles"),
        "rates_held": lambda hold: arguments(
            "a, q, qd", "t" if target.driven else "", "u", hold, "c" if kept else "", "troubles"
        ),
        "stages": _stages(target, turned, _given(target, kept, "s->u.", "s->c."), call),
    }


def _of_instance(
    target: Target, name: str, struct: str, element: str, members: Sequence[str]
) -> list[str]:
    """A struct of one instance's numbers; # in `element` is the place of each."""
    inside = ", ".join(element.replace("#", target.enum[n]) for n in members)
    return [f"const {target.prefix}_{struct} {name} = {{ {inside} }};"]


def _given(target: Target, kept: Sequence[str], u: str, c: str) -> list[str]:
    """The inputs and the prepared values of one instance."""
    lines = []
    if target.system.inputs:
        lines += _of_instance(target, "given", "inputs", f"{u}x[#][i]", target.input_names)
    if kept:
        inside = ", ".join(f"{c}{n}[i]" for n in kept)
        lines.append(f"const {target.prefix}_prepared here = {{ {inside} }};")
    return lines


def _angles_lane(target: Target, turned: Sequence[Angle]) -> dict[str, Any] | None:
    """The sines and cosines of an instance: at a place, on both sides of it, a little further."""
    if not turned:
        return None
    P, f = target.prefix, target.real.function_suffix

    def both(struct: str, angle: Angle) -> str:
        return f"&{struct}->{angle.sine}, &{struct}->{angle.cosine}"

    return {
        "members": _sines(turned),
        "at": [
            f"{P}_sincos{f}_lane({_along(target, a, 'q->', a.offset)}, {both('s', a)}, trouble);"
            for a in turned
        ],
        "around": [
            f"{P}_sincos_around{f}({_along(target, a, 'q->', a.offset)}, "
            f"{_along(target, a, 'd->', S.Zero)}, "
            f"{both('back', a)}, {both('s', a)}, {both('on', a)}, far);"
            for a in turned
        ],
        "turned": [
            f"{P}_turn{f}({_along(target, a, 'd->', S.Zero)}, from->{a.sine}, from->{a.cosine}, "
            f"{both('s', a)});"
            for a in turned
        ],
        "far": [f"*far = {P}_far{f}({_along(target, a, 'd->', S.Zero)}, *far);" for a in turned],
    }


def _along(target: Target, angle: Angle, vector: str, offset: Expr) -> str:
    """An angle of a vector of coordinates."""
    where = {name: f"{vector}{name}" for _, name in angle.terms}
    printer = ccode.Printer(target.prefix, target.real, where)
    return printer.value(Sum(angle.terms, offset))[0]


def _stages(
    target: Target,
    turned: Sequence[Angle],
    given: Sequence[str],
    call: Callable[[str, str, str, str], str],
) -> dict[str, Any]:
    """The stages of RK4 as loops over a tile: how each has its place, and what it leaves."""
    P, real, members = target.prefix, target.real.name, _sines(turned)
    t_arg, t = (f"{real} t", "t") if target.driven else ("", "")
    u_arg = "int held" if target.system.inputs else ""
    q, qd, two = "s->q.x[#][i]", "s->qd.x[#][i]", target.literal(2.0)
    a1, a2, a3, a4 = (f"a{k}.x[#][i]" for k in (1, 2, 3, 4))
    plans = [
        ("back", "t", [f"at.$ = {q};", f"moving.$ = {qd};"], ""),
        ("mid", "t + h_2", [f"at.$ = {q} + h_2*{qd};", f"moving.$ = {qd} + h_2*{a1};"], ""),
        (
            "mid", "t + h_2",
            [f"at.$ = ({q} + h_2*{qd}) + hh_4*{a1};", f"moving.$ = {qd} + h_2*{a2};"],
            f"d.$ = hh_4*{a1};",
        ),
        (
            "on", "t + h",
            [f"at.$ = ({q} + h*{qd}) + hh_2*{a2};", f"moving.$ = {qd} + h*{a3};"],
            f"d.$ = hh_2*{a2};",
        ),
    ]  # fmt: skip
    loops = []
    for k, (near, time, lines, d) in enumerate(plans, 1):
        from_near = ", ".join(f"{near}.{n}[i]" for n in members)
        loops.append(
            {
                "given": given,
                "angles": [
                    f"const {P}_angles s_near = {{ {from_near} }};",
                    *([f"{P}_angles s_at;", f"{P}_vector d;"] if d else []),
                ],
                "lines": lines + ([d] if d and turned else []),
                "turned": [f"{P}_angles_turned(&s_at, &d, &s_near);"] if d else [],
                "call": call("&s_at" if d else "&s_near", time, "held", "s->trouble"),
                "ends": [f"a{k}.x[#][i] = a.$;"],
                "looks_ahead": turned and k == 2,
            }
        )
    far_arg, far = (f"{real} *far", "far") if turned else ("", "")
    return {
        "prototype": f"{target.PREFIX}_LANE int {P}_rk4_stages("
        + arguments(
            f"{P}_lanes *r, {P}_lanes *v", far_arg, f"{P}_tile *s", t_arg, f"{real} h", u_arg
        ) + ")",
        "around": [f"{x}.{n}[i] = s_{x}.{n};" for x in ("back", "mid", "on") for n in members],
        "loops": loops,
        "ahead": [[plans[2][3]], [plans[3][3]]],
        "ends": [
            f"q.$ = {q} + (h*{qd} + hh_6*({a1} + ({a2} + {a3})));",
            f"qd.$ = {qd} + h_6*(({a1} + {a4}) + {two}*({a2} + {a3}));",
            "r->x[#][i] = q.$;",
            "v->x[#][i] = qd.$;",
        ],
        "call": lambda hold: f"{P}_rk4_stages("
        + arguments("&r, &v", far, "s", t, "h", hold) + ")",
    }  # fmt: skip


def _lane_large(
    target: Target, function: Function, kept: Sequence[str], made: Mapping[str, Any]
) -> dict[str, Any]:
    s, P = target.system, target.prefix
    _, rest = staged(function, [p.name for p in s.parameters])
    cut = target.in_pieces(
        rest,
        "solve_lane",
        _lane_arguments(target, kept),
        [_in_lanes(target)("a", name) for name in target.names],
        Argument(f"{P}_lanes *{target.PREFIX}_ALONE a", "a", frozenset()),
        lambda f: target.loads(f, _in_lanes(target), _in_lanes(target)),
        {n: f"c->{n}[i]" for n in kept},
        lane=True,
    )
    return {
        "pieces": cut,
        "unused": [*made["unused"], *(["troubles"] if not cut["troubled"] else [])],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "end": [],
    }


def _in_lanes(target: Target) -> Access:
    return lambda array, name: f"{array}->x[{target.enum[name]}][i]"


def _lane_arguments(target: Target, kept: Sequence[str]) -> list[Argument]:
    """What a piece over a tile may read."""
    P, groups, real = target.prefix, target.groups(), target.real.name
    return [
        Argument(f"const {P}_lanes *q", "q", groups["q"]),
        Argument(f"const {P}_lanes *qd", "qd", groups["qd"]),
        Argument(f"{real} t", "t", groups["t"]),
        Argument(f"const {P}_inputs_lanes *u", "u", groups["u"]),
        Argument(f"const {P}_prepared_lanes *c", "c", frozenset(kept)),
        Argument(f"{real} *{target.PREFIX}_ALONE troubles", "troubles", frozenset({TROUBLE})),
    ]


def _signal_lanes(
    target: Target, kept: Sequence[str], c_arg: str, trouble: str
) -> dict[str, Any] | None:
    """The scene's signals for a whole tile."""
    if "signal" not in target.program:
        return None
    P, given = target.prefix, target.program["signal"]
    own = {p.name for p in target.system.parameters}
    cut = target.in_pieces(
        given,
        "signal_lane",
        _lane_arguments(target, [n for n in kept if n in own]),
        [f"u->x[{target.enum[name]}][i]" for name in target.input_names],
        Argument(f"{P}_inputs_lanes *{target.PREFIX}_ALONE u", "u", frozenset()),
        lambda f: target.loads(f, _in_lanes(target), _in_lanes(target)),
        {n: f"c->{n}[i]" for n in own},
        lane=True,
    )
    state = f"const {P}_lanes *q, const {P}_lanes *qd"
    return {
        "pieces": cut,
        "arguments": arguments(
            f"{P}_inputs_lanes *u", f"{target.real.name} t" if target.signal_t else "",
            state if target.signal_state else "", c_arg, trouble,
        ),
        "unused": [
            *([] if not c_arg or given.uses & own else ["c"]),
            *([] if cut["troubled"] else ["troubles"]),
            *_unread_state(target, given),
        ],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "call": _signal_lane_call(target, c_arg, "troubles"),
    }  # fmt: skip


def _unread_state(target: Target, given: Function) -> list[str]:
    if not target.signal_state:
        return []
    return [name for name in ("q", "qd") if not given.uses & target.groups()[name]]


def _signal_lane_call(target: Target, c_arg: str, trouble: str) -> str:
    return arguments(
        "&now", "t" if target.signal_t else "", "q, qd" if target.signal_state else "",
        "c" if c_arg else "", trouble,
    )  # fmt: skip


def _tile(target: Target, kept: int, lane: Mapping[str, Any]) -> int:
    """Instances side by side: as many as stay near with what belongs to them.

    Small: eight vectors of 32 bytes at most, since more brought nothing.
    """
    s, n, size = target.system, len(target.system.q), 8 if target.real is DOUBLE else 4
    numbers = 2 * n + len(s.u) + kept + 2
    if lane["pieces"]:
        most, near, size = 64, WIDE, 8
        numbers += len(lane["pieces"]["members"]) + 6 * n
    else:
        most, near = 256 // size, NEAR
        numbers += (2 + max(METHODS[name].stages for name in s.run.methods)) * n
        numbers += 1 + 3 * len(lane["angles"]["members"]) if lane["angles"] else 1
    return max(8, min(most, 1 << (near // (size * numbers)).bit_length() - 1))


# --- steppers -------------------------------------------------------------------------------------


def _number(x: Fraction, real: Real) -> str:
    return ccode.number(Rational(x.numerator, x.denominator), real)


def _rounded(weights: Row, real: Real) -> Row:
    """The weights as they are in C, with their sum as it is: what it lacks would add up over steps.

    The smallest one takes what rounding left of the sum; of a symmetric method both of a pair.
    """
    if not real.dtype:  # 113 bits, for references
        return weights
    rounded = [Fraction(float(x)) for x in np.array([float(x) for x in weights], real.dtype)]
    lack = Fraction(round(sum(weights, Fraction(0)))) - sum(rounded, Fraction(0))
    symmetric = weights == weights[::-1] and len(weights) > 1
    for k in sorted(range(len(rounded)), key=lambda k: abs(rounded[k])):
        places = {k, len(rounded) - 1 - k} if symmetric else {k}
        wished = rounded[k] + lack / len(places)
        if rounded[k] and Fraction(float(np.array(float(wished), real.dtype))) == wished:
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
        "limits": m.limits,
        "notes": m.notes,
        "implicit": m.implicit,
        "newton": m.newton,
        "sweeps": m.sweeps,
        "stability": f"h omega <= {undamped:.3g} undamped"
        + (f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."),
    }


def _method(
    target: Target, m: Method, slopes: Mapping[str, Any] | None, scalar: Mapping[str, Any],
    side_by_side: Mapping[str, Any] | None, turned: Sequence[Angle],
    lane: Mapping[str, Any] | None,
) -> dict[str, Any]:  # fmt: skip
    """A method as its template wants it."""
    large = scalar["pieces"] is not None
    if m.sweeps:
        return _side_by_side(target, m, scalar, side_by_side)
    if slopes is not None and m.newton:
        return _implicit(target, m, slopes, scalar, large)
    return _explicit(m, target.real, turned, lane)


def _explicit(
    m: Method, real: Real, turned: Sequence[Angle], lane: Mapping[str, Any] | None
) -> dict[str, Any]:
    """An explicit method as its template wants it; RK4 has one of its own, written out by hand."""

    def total(row: Row) -> str:
        terms = [(x, k + 1) for k, x in enumerate(row) if x]
        text = " + ".join(f"{_number(x, real)}*a{k}.$" for x, k in terms).replace("+ -", "- ")
        return text or _number(Fraction(0), real)

    def lines(c: Fraction, positions: Row, velocities: Row) -> list[str]:
        step = "h" if c == 1 else f"{_number(c, real)}*h"
        return [
            f"r->$ = q->$ + ({step}*qd->$ + hh*({total(positions)}));",
            f"v->$ = qd->$ + h*({total(velocities)});",
        ]

    def time(c: Fraction) -> str:
        return "t + h" if c == 1 else f"t + {_number(c, real)}*h"

    stages = [] if m is RK4 else list(zip(m.c, m.a_squared, m.a, strict=True))[1:]
    first, half = m.c[0], _number(m.c[0], real)
    angles = m is RK4 and bool(turned)
    lane_template = "rk4.c.jinja" if m is RK4 else "explicit.c.jinja"
    by_stages = m is RK4 and bool(lane and lane["one"])
    return _about(m) | {
        "by_stages": by_stages,
        "by_rates": not by_stages or bool(lane and lane["angles"]),
        "angles": angles,
        "template": "rk4_angles.c.jinja" if angles else lane_template,
        "lane_template": lane_template,
        "begin": [f"r->$ = q->$ + {half}*h*qd->$;"] if first else [],
        "begin_at": "r, qd" if first else "q, qd",
        "begin_time": time(first) if first else "t",
        "body": [{"lines": lines(c, *rows), "time": time(c)} for c, *rows in stages],
        "end": [
            f"r->$ = h*qd->$ + hh*({total(m.b_a)});",
            f"v->$ = h*({total(_rounded(m.b, real))});",
        ],
    }


def _implicit(
    target: Target, m: Method, slopes: Mapping[str, Any], scalar: Mapping[str, Any], large: bool
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
        return ["{ " + ", ".join(_number(x, real) for x in row) + " }," for row in rows]

    def total(matrix: str, of: str = "#") -> str:
        return " + ".join(f"{matrix}[{j}]*a[{j}][{of}]" for j in range(s))

    def now(at: str, moving: str, time: str) -> str:
        return arguments("m", "h", at, moving, t and time, u, p)

    last = [" + ".join(f"{_number(x, real)}*a[{j}][#]" for j, x in enumerate(row))
            for row in (m.b_a, _rounded(m.b, real))]  # fmt: skip
    return _about(m) | {
        "template": "gauss.c.jinja",
        "arguments": arguments(scalar["stepper_arguments"], own_p and target.p_arg, memory),
        "call_more": after(own_p, "m"),
        "angles": False,
        "factor_arguments": given,
        "factor_now": now("at_now", "moving_now", "t"),
        "factor_mid": now("mid_q", "mid_qd", f"t + {_number(Fraction(1, 2), real)}*h"),
        "eps": repr(real.epsilon) + real.suffix,
        "nudge": repr(sqrt(real.epsilon)) + real.suffix,
        "c": [_number(x, real) for x in m.c],
        "A": matrix(m.a),
        "AA": matrix(m.a_squared),
        "ahead": matrix(m.ahead),
        "guess": " + ".join(f"ahead[i][{j}]*m->a[{j}][k]" for j in range(s)),
        "gathered": [
            _gathered(target, large, "q", "at_now"), _gathered(target, large, "qd", "moving_now"),
        ],
        "stage": [
            f"at.$ = q->$ + (c_[i]*h*qd->$ + hh*({total('AA[i]')}));",
            f"moving.$ = qd->$ + h*({total('A[i]')});",
        ],
        "end": [f"r->$ = h*qd->$ + hh*({last[0]});", f"v->$ = h*({last[1]});"],
    }  # fmt: skip


def _side_by_side(
    target: Target, m: Method, scalar: Mapping[str, Any], lane: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A method of few sweeps as its template wants it, for one trajectory.

    lane: what a loop over the stages calls; None where accelerations are long, and stages take
    turns.
    """
    real, P, s = target.real, target.prefix, m.stages
    timed = TIME in target.program["acceleration"].uses
    t, u = ("t" if target.driven else ""), ("u" if target.system.inputs else "")
    rest = scalar["stepper_arguments"].split(", ", 2)[2]
    c, p = ("c" if "_prepared *c" in rest else ""), ("p" if "_params *p" in rest else "")
    stages, memory = f"{P}_{m.name}_stages", f"{P}_{m.name}_memory *m"
    large, alone = scalar["pieces"] is not None, f"{target.PREFIX}_ALONE"

    def by_stage(rows: Sequence[Row]) -> list[str]:
        columns = zip(*rows, strict=True)
        return ["{ " + ", ".join(_number(x, real) for x in column) + " }," for column in columns]

    def total(terms: Sequence[str]) -> str:
        """In pairs, since a sum in a row would wait for each of its terms."""
        while len(terms) > 1:
            pairs = [" + ".join(terms[k : k + 2]) for k in range(0, len(terms), 2)]
            terms = [f"({pair})" for pair in pairs] if len(pairs) > 1 else pairs
        return terms[0]

    def held(given: str) -> str:
        return after(t and "t + c_[i]*h", "&given", given, c, "&bad")

    last = [total([f"{_number(x, real)}*a.x[#][{k}]" for k, x in enumerate(row)])
            for row in (m.b_a, _rounded(m.b, real))]  # fmt: skip
    inputs = ", ".join(f"u ? u[{target.enum[n]}] : {target.zero}" for n in target.input_names)
    return _about(m) | {
        "template": "picard.c.jinja",
        "angles": False,
        "arguments": arguments(scalar["stepper_arguments"], memory),
        "call_more": after("m"),
        "inline": f"{target.PREFIX}_LANE" if lane else "static inline",
        "side_by_side": lane is not None,
        "sum": total([f"w[{k}][i]*a[{k}]" for k in range(s)]),
        "c": [_number(x, real) for x in m.c],
        "A": by_stage(m.a),
        "AA": by_stage(m.a_squared),
        "A_ahead": by_stage(m.a_ahead),
        "AA_ahead": by_stage(m.a_squared_ahead),
        "sweep_arguments": arguments(
            f"{stages} *{alone} b", f"const {stages} *{alone} a",
            f"const {P}_{m.name}_sums *w", rest,
        ),
        "sweep": lambda of, sums: f"{P}_{m.name}_sweep("
        + arguments(of, f"&{P}_{m.name}_{sums}", "q", "qd", t, "h", u, c, p) + ");",
        "settle_arguments": arguments(f"{stages} *a", "int fresh", rest, memory),
        "settle_call": arguments("&a", "!smooth", "q", "qd", t, "h", u, c, p, "m"),
        "given": f"const {P}_inputs given = {{ {inputs} }};",
        "lanes": [
            {"only": "if (u)", "call": held("1")}, {"only": "else", "call": held("0")},
        ] if u else [{"only": "", "call": after("t + c_[i]*h" if timed else "", c, "&bad")}],
        "eps": repr(real.epsilon) + real.suffix,
        # steps that five sweeps do not do are long, and err by more than this
        "enough": repr(max(1e-8, real.epsilon)) + real.suffix,
        "loose": f"{max(1e-6, 512 * real.epsilon):.0e}" + real.suffix,
        "gathered": [
            _gathered(target, large, "q", "at_now"), _gathered(target, large, "qd", "moving_now"),
        ],
        "stage": [
            f"at.$ = q->$ + (c_[i]*h*qd->$ + hh*{P}_{m.name}_sum(w->AA, a->x[#], i));",
            f"moving.$ = qd->$ + h*{P}_{m.name}_sum(w->A, a->x[#], i);",
        ],
        "end": [f"r->$ = h*qd->$ + hh*({last[0]});", f"v->$ = h*({last[1]});"],
    }  # fmt: skip
