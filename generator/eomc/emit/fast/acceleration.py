"""Accelerations of one trajectory for the templates, and what surrounds them.

A small acceleration is inlined into the steppers, its state in named scalars. A large one calls
outlined functions, its state in arrays, and in a batch each of them is a loop over a tile.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sympy import S

from eomc.emit import vectors
from eomc.emit.c_expression import Body, indent
from eomc.emit.c_names import (
    Argument,
    Target,
    after,
    arguments,
    none_of,
    sentence,
)
from eomc.emit.fast import (
    batch,
    integrators,
    predicted_angles,
    rotations,
    stage_parallel,
    two_point,
)
from eomc.emit.fast.two_point import Parts
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System
from eomc.program.ir import Function, Operand
from eomc.program.outline import is_large, staged, with_names
from eomc.program.program import TIME
from eomc.program.trig import Angle


def dynamics(target: Target, slopes: Mapping[str, Any] | None) -> dict[str, Any]:
    """What belongs to accelerations and steppers; slopes: what evaluations.linearization gives."""
    s, function, real = target.system, target.program["acceleration"], target.real.name
    P, NQ = target.prefix, f"{target.PREFIX}_NQ"
    parts = two_point.apart(target, function)
    large, arrays = is_large(function), is_large(function) or parts is not None
    extent = str(two_point.width(target, parts)) if parts else NQ
    rotated, rest = ((), function) if parts else rotations.rotated_apart(target, function)
    constants = _constants_apart(target, function) if arrays else _constants(target, rest, rotated)
    kept = constants["constants_members"]
    if parts:  # in loops over many it is printed anew
        function = with_names(function, frozenset(kept))
    takes_c, takes_p = bool(kept), target.needs_p and "signal" in target.program
    t, u = "t" if target.driven else "", "u" if s.inputs else ""
    c, p = "c" if takes_c else "", "p" if takes_p else ""
    scalar = _mode(target, rest, constants, takes_c, takes_p, rotated, parts)
    faster = "two_point" if parts else "angles" if rotated else ""

    t_arg, u_arg = f"{real} t" if t else "", f"const {real} *u" if u else ""
    outer = arguments(u_arg, target.p_arg)
    x = f"{real} q[{NQ}], {real} qd[{NQ}]"
    rows = f"long every, {real} *q_rows, {real} *qd_rows"
    t0_arg = f"{real} t0" if t else ""
    tile = batch.mode(target, function, constants, scalar) if s.run.batch else None
    stages = (
        stage_parallel.mode(target, function, kept, arrays) if _swept(s) and not large else None
    )
    chosen = [
        integrators.method(target, METHODS[name], slopes, scalar, stages, faster, tile)
        for name in s.run.methods
    ]
    return constants | {
        "large": large,
        "constants_arguments": arguments(f"{P}_constants *c" if takes_c else "", target.p_arg),
        "constants_call": arguments("&constants" if takes_c else "", target.p_call),
        "constants_unread": target.needs_p and not _reads_p(constants),
        "p_unused": target.needs_p and not constants["has_constants"] and not takes_p,
        "takes_c": takes_c,
        "cost": sentence(function),
        "scalar": scalar,
        "tile": tile,
        "stage_parallel": stages,
        "batch_rotates": bool(tile and tile["angles"]),
        "rates_now": f"{P}_{scalar['rates']}(&a, &at, &moving{scalar['call']('t')})",
        "stepper_call": after(t, "h", u, c, p),
        "methods": chosen,
        "tile_rates": any(m.get("by_rates") for m in chosen),
        "implicit": any(METHODS[name].implicit for name in s.run.methods),
        "newton": any(METHODS[name].newton for name in s.run.methods),
        "angles": rotations.scalar(target, rotated),
        "predicted": predicted_angles.steps(target, rotated, rest.uses, scalar, c, p),
        "rotated": len(rotated),
        "two_point": scalar["two_point"],
        "fabs": "fabs" + target.real.function_suffix,
        "fmax": "fmax" + target.real.function_suffix,
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
        **(batch.sizes(target, len(kept), tile) if tile else {}),
        "input_names": target.input_names,
        "sincos": f"{P}_sincos{target.real.function_suffix}" if target.sincos else "",
        "reach": target.literal(target.real.reach),
        "constants_tile": arguments(
            "&constants" if takes_c else "", "p + k*p_instance" if target.needs_p else ""
        ),
        "retry_call": after(
            t, "h", u and "u ? u + (base + i)*u_instance + n*u_step : 0",
            "&c" if takes_c else "", "p + (base + i)*p_instance" if takes_p else "",
        ),
        "vector_members": [f"{real} x[{extent}];"] if arrays
        else [f"{real} {', '.join(target.names)};"],
        "vector_of": lambda name, element: vectors.vector_of(target, arrays, name, element),
        "constants_here": f"const {P}_constants c = "
        + "{ " + ", ".join(f"s.c.{n}[i]" for n in kept) + " };",
    }  # fmt: skip


def _swept(system: System) -> bool:
    """Whether some method has its stages in parallel."""
    return any(METHODS[name].sweeps for name in system.run.methods)


def _constants(target: Target, function: Function, rotated: Sequence[Angle]) -> dict[str, Any]:
    own = [p.name for p in target.system.parameters]
    where = {name: f"s->{name}" for name in rotations.sines(rotated)}
    body = target.body(function, where, keep=_in_constants, parameters=own)
    kept = _with_signal(target, list(body.kept))
    return {
        "constants_members": kept,
        "constants_outlined": None,
        "constants_early": [line for block in body.early for line in block.lines],
        "constants_sets": [f"c->{n} = {'p->' if n in own else ''}{n};" for n in kept],
        "constants_result": none_of(body.early_failures),
        "has_constants": bool(kept or body.early_failures),
        "body": body,
    }


def _constants_apart(target: Target, function: Function) -> dict[str, Any]:
    """The same as a function of its own, itself outlined where it is long."""
    own = [p.name for p in target.system.parameters]
    first, _ = staged(function, own)
    kept = _with_signal(target, [o.name for o in first.outputs])
    first = replace(first, outputs=tuple(Operand(S.One, n) for n in kept))
    places = [f"c->{n}" for n in kept]
    made = {"constants_members": kept, "has_constants": bool(kept or first.checks)}
    if not is_large(first):
        body = target.body(first, parameters=own)
        sets = [f"{to} = {text};" for to, text in zip(places, body.results, strict=True)]
        return made | {
            "constants_outlined": None,
            "constants_early": [line for block in body.early for line in block.lines],
            "constants_sets": sets,
            "constants_result": none_of(body.early_failures),
        }
    given = [Argument(target.p_arg, "p", frozenset(own))]
    out = Argument(f"{target.prefix}_constants *c", "c", frozenset())
    cut = target.outlined(first, "compute_constants", given, places, out, lambda f: [])
    return made | {
        "constants_outlined": cut,
        "constants_early": cut["locals"],
        "constants_sets": cut["calls"],
        "constants_result": cut["outcome"],
    }


def _reads_p(constants: Mapping[str, Any]) -> bool:
    lines = [
        *constants["constants_early"],
        *constants["constants_sets"],
        constants["constants_result"],
    ]
    return any(re.search(r"\bp\b", line) for line in lines)


def _with_signal(target: Target, kept: list[str]) -> list[str]:
    """With the parameters that the signals read, since tiles have no others."""
    in_loops = target.system.run.batch or _swept(target.system)
    if not (in_loops and "signal" in target.program):
        return kept
    own = [p.name for p in target.system.parameters]
    uses = target.program["signal"].uses
    return [n for n in own if n in kept or n in uses] + [n for n in kept if n not in own]


def _in_constants(name: str) -> str:
    return f"c->{name}"


def _mode(
    target: Target,
    function: Function,
    constants: Mapping[str, Any],
    takes_c: bool,
    takes_p: bool,
    rotated: Sequence[Angle],
    parts: Parts | None,
) -> dict[str, Any]:
    """solve, rates and steppers for one trajectory: they return whether D was regular.

    rotated: the angles whose sines and cosines come from outside. parts: of the two-point form.
    """
    s, real, P = target.system, target.real.name, target.prefix
    timed, u, arrays = TIME in function.uses, bool(s.inputs), "body" not in constants
    t_arg = f"{real} t" if target.driven else ""
    u_arg = f"const {real} *u" if u else ""
    c_arg = f"const {P}_constants *c" if takes_c else ""
    p_arg = target.p_arg if takes_p else ""
    c, p = "c" if takes_c else "", "p" if takes_p else ""
    state = f"const {P}_vector *q, const {P}_vector *qd"
    s_arg, s_call = (f"const {P}_angles *s", "s") if rotated else ("", "")
    rates_rest = (t_arg, u_arg, c_arg, p_arg)
    alone = f"{target.PREFIX}_ALONE " if parts else ""

    def rates(time: str) -> str:
        if u:
            return after(time if target.driven else "", "u", c, p)
        return after(time if timed else "", c)

    def in_vector(array: str, name: str) -> str:
        return f"{array}->{vectors.member(target, arrays, name)}"

    made: dict[str, Any] = {
        "head": "static int"
        if arrays
        else f"{target.PREFIX}_INLINE int"
        if rotated
        else "static inline int",
        "vector": f"{P}_vector",
        "solve": "solve_at" if rotated and not u else "solve",
        "rates": "rates" if u else "solve",
        "rates_at": ("rates" if u else "solve") + ("_at" if rotated else ""),
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
            f"{P}_vector *{alone}r, {P}_vector *{alone}v, {state}",
            t_arg,
            f"{real} h",
            u_arg,
            c_arg,
            p_arg,
        ),
        "unused": _unread(target, function),
        "outlined": None,
        "signal_at": [
            vectors.gathered(target, arrays, "q", "at"),
            vectors.gathered(target, arrays, "qd", "moving"),
        ]
        if target.signal_state
        else [],
        "signal_call": target.signal_call("now", "at", "moving"),
        "call": rates,
        "call_at": lambda angles, time: f", {angles}{rates(time)}",
        "compensated": True,
        "first": "int good = ",
        "and": "good &= ",
        "last": "return good;",
        "each": lambda lines, width=4, index="i": indent(
            vectors.each(target, arrays, lines, index), width
        ),
        "whole": lambda lines, width=4: indent(
            vectors.each(
                target, arrays, lines, width=two_point.width(target, parts) if parts else 0
            ),
            width,
        ),
        "rows": indent(vectors.rows(target, arrays), 12),
        "arrays": arrays,
        "flag": "int" if real == "float" else "long long",  # as wide as a real
        "two_point": None,
        "own_signal": None,
    }
    if not arrays:
        body: Body = constants["body"]
        return made | {
            "loads": target.loads(function, in_vector, target.element),
            "blocks": body.blocks,
            "results": [
                f"a->{name} = {r};" for name, r in zip(target.names, body.results, strict=True)
            ],
            "end": [f"return {none_of(body.failures)};"],
        }
    kept = constants["constants_members"]
    if parts:
        made["two_point"] = two = two_point.context(target, parts, kept, timed, takes_p)
        return made | {
            "unused": [],
            "loads": two["solve_locals"],
            "blocks": [],
            "results": two["solve_lines"],
            "end": two["solve_end"],
        }
    _, rest = staged(function, [p.name for p in s.parameters])
    groups = target.groups()
    given = [
        Argument(f"const {P}_vector *q", "q", groups["q"]),
        Argument(f"const {P}_vector *qd", "qd", groups["qd"]),
        Argument(f"{real} t", "t", groups["t"]),
        Argument(u_arg, "u", groups["u"]),
        Argument(f"const {P}_constants *c", "c", frozenset(kept)),
    ]
    cut = target.outlined(
        rest,
        "solve",
        given,
        [in_vector("a", name) for name in target.names],
        Argument(f"{P}_vector *a", "a", frozenset()),
        lambda f: target.loads(f, in_vector, target.element),
        {n: _in_constants(n) for n in kept},
    )
    return made | {
        "outlined": cut,
        "unused": [*made["unused"], *(["c"] if takes_c and not rest.uses & set(kept) else [])],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "end": [f"return {cut['outcome']};"],
    }


def _unread(target: Target, function: Function) -> list[str]:
    """Arguments that the body of a function does not read."""
    groups, uses = target.groups(), function.uses
    return [k for k in ("q", "qd", "u") if groups[k] and not uses & groups[k]]
