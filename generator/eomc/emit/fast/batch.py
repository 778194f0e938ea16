"""Accelerations and steps of many instances at once, for the templates.

Large: each outlined function is a loop over a tile. Small: what one instance needs is inlined into
such loops, one for every stage of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

from eomc.emit import vectors
from eomc.emit.c_expression import DOUBLE, indent
from eomc.emit.c_names import COUNT, FAILED, Access, Argument, Target, after, arguments
from eomc.emit.fast import rotations, stage_parallel
from eomc.integrators.tableaux import METHODS
from eomc.program.ir import Function
from eomc.program.outline import is_large, staged
from eomc.program.program import TIME
from eomc.program.trig import Angle, apart

KEPT = {"a1": "first", "a2": "second", "a3": "third", "a4": "fourth"}  # by the stages of RK4
CACHE = 32_768  # bytes that a tile may have: a first-level cache


def mode(
    target: Target, function: Function, constants: Mapping[str, Any], mode: Mapping[str, Any]
) -> dict[str, Any]:
    """The same for a batch: no branches; failures are noted in `failed`.

    Accelerations and steppers of a whole tile.
    """
    s, real, P = target.system, target.real.name, target.prefix
    large, held = is_large(function), bool(s.inputs)
    timed = TIME in function.uses
    kept = constants["constants_members"]
    alone = f"{target.PREFIX}_ALONE "
    rest = f"int count, {real} *{alone}failures"  # how many to take, and which failed
    u_arg = f"const {P}_inputs_tile *u" if held else ""
    c_arg = f"const {P}_constants_tile *c" if kept else ""
    t_arg = f"{real} t" if target.driven else ""
    state = f"const {P}_vector_tile *q, const {P}_vector_tile *qd"
    c = "c" if kept else ""
    own = bool(kept) and target.needs_p and not large

    def rates(time: str) -> str:
        if held:
            return after(time if target.driven else "", "u", "held", c, "count, failures")
        return after(time if timed else "", c, "count, failures")

    made = dict(mode) | {
        "head": "static void" if large else f"{target.PREFIX}_NOINLINE void",
        "inline": f"{target.PREFIX}_{'INLINE' if large else 'FORCE_INLINE'}",
        "vector": f"{P}_vector_tile",
        "solve": "solve_tile",
        "signal": "signal_tile",
        "rates": "rates_tile" if held or not large else "solve_tile",
        "suffix": "_tile",
        "solve_arguments": arguments(
            f"{P}_vector_tile *a", state, f"{real} t" if timed else "", u_arg, c_arg, rest
        ),
        "solve_u": after("t" if timed else "", "held ? u : &now", c, "count, failures"),
        "rates_arguments": arguments(
            f"{P}_vector_tile *{'' if large else alone}a", state, t_arg, u_arg,
            "int held" if held else "", c_arg, rest,
        ),
        "inputs": f"{P}_inputs_tile",
        "stepper_arguments": arguments(
            *(f"{P}_vector_tile *{'' if large else alone}{name}" for name in "rv"),
            state, t_arg, f"{real} h", u_arg and f"{u_arg}, int held", c_arg, rest,
        ),
        "tile_prototype": lambda name: f"int {P}_{name}_tile_step("
        + arguments(
            f"{P}_states *{alone}to", f"const {P}_states *{alone}from", f"{P}_tile *{alone}s",
            t_arg, f"{real} h", "int held" if held else "", "int own" if own else "",
            "int count",
        ) + ")",
        "own": own,
        "stepper_call": lambda failures: after(
            "t" if target.driven else "", "h", "&s->u, held" if held else "",
            "&s->c" if kept else "", "count", failures,
        ),
        "call": rates,
        "compensated": False,
        "first": "",
        "and": "",
        "last": "",
        "each": lambda lines, width=4: indent(_each_of_tile(target, lines), width),
        "angles": None,
        "one": None,
        "outlined": None,
        "own_signal": _signal_of_tile(target, kept, c_arg, rest) if large else None,
    }  # fmt: skip
    if not large:
        return made | _small(target, function, kept, mode["arrays"])
    return made | _large(target, function, kept, made)


def _each_of_tile(target: Target, lines: Sequence[str]) -> list[str]:
    """Statements for every coordinate of every instance."""
    inside = [line.replace("$", "x[j][i]") for line in lines]
    return vectors.loop("j", f"{target.PREFIX}_NQ", vectors.loop("i", "count", inside))


def _small(target: Target, function: Function, kept: Sequence[str], arrays: bool) -> dict[str, Any]:
    """Accelerations of one instance, and how loops over a tile call them."""
    s, real = target.system, target.real
    held, timed = bool(s.inputs), TIME in function.uses
    reach = real.reach and "rk4" in s.run.methods
    rotated, rest = apart(function, target.names) if reach else ((), function)

    def call(angles: str, time: str, hold: str, failed: str = "&failed") -> str:
        now = time if (target.driven if held else timed) else ""
        return after(
            angles if rotated else "", now, f"&given, {hold}" if held else "",
            "&here" if kept else "", failed,
        )  # fmt: skip

    one = stage_parallel.mode(target, rest, kept, arrays, rotations.sines(rotated))
    angles = rotations.of_tile(target, rotated, arrays)
    own = bool(kept) and target.needs_p
    k = "own ? i : 0" if own else "0"
    return {
        "one": one,
        "angles": angles,
        "rates_given": [
            "const " + vectors.vector_of(target, arrays, "at", "q->x[#][i]"),
            "const " + vectors.vector_of(target, arrays, "moving", "qd->x[#][i]"),
            *_given(target, kept, "u->", "c->"),
        ],
        "rates_call": call("&s", "t", "held", "&failures[i]"),
        "rates_held": lambda hold: arguments(
            "a, q, qd", "t" if target.driven else "", "u", hold, "c" if kept else "",
            "count, failures",
        ),
        "stages": _stages(
            target, arrays, rotated, angles, own, _given(target, kept, "s->u.", "s->c.", k), call
        ),
    }  # fmt: skip


def _given(target: Target, kept: Sequence[str], u: str, c: str, k: str = "i") -> list[str]:
    """The inputs and the constants values of one instance."""
    lines = []
    if target.system.inputs:
        inside = ", ".join(f"{u}x[{target.enum[n]}][i]" for n in target.input_names)
        lines.append(f"const {target.prefix}_inputs given = {{ {inside} }};")
    if kept:
        inside = ", ".join(f"{c}{n}[{k}]" for n in kept)
        lines.append(f"const {target.prefix}_constants here = {{ {inside} }};")
    return lines


def _each_known(names: Sequence[str], call: Callable[[list[str]], str]) -> list[str]:
    """A call by what is zero and what is not, so that each can be compiled for its case."""
    if not names:
        return [call([])]
    lines: list[str] = []
    for case in product((1, 0), repeat=len(names)):
        asked = " && ".join(n for n, one in zip(names, case, strict=True) if one)
        lines += [f"{'else ' if lines else ''}{f'if ({asked})' if asked else ''}".rstrip()]
        lines += ["    " + call([str(x) for x in case])]
    return lines


def _stages(
    target: Target,
    arrays: bool,
    rotated: Sequence[Angle],
    angles: Mapping[str, Any] | None,
    own: bool,
    given: Sequence[str],
    call: Callable[[str, str, str], str],
) -> dict[str, Any]:
    """The stages of RK4 as loops over a tile: what each reads, and what it leaves."""
    P, real, members = target.prefix, target.real.name, rotations.sines(rotated)
    alone = f"{target.PREFIX}_ALONE "
    t_arg, t = (f"{real} t", "t") if target.driven else ("", "")
    plans = [
        ("back", "t", []),
        ("mid", "t + h_2", ["at.$ = q.$ + h_2*qd.$;", "moving.$ = qd.$ + h_2*a1.$;"]),
        ("mid", "t + h_2", ["at.$ = (q.$ + h_2*qd.$) + hh_4*a1.$;", "moving.$ = qd.$ + h_2*a2.$;"]),
        ("on", "t + h", ["at.$ = (q.$ + h*qd.$) + hh_2*a2.$;", "moving.$ = qd.$ + h*a3.$;"]),
    ]
    read: tuple[list[str], ...] = [], ["a1"], ["a1", "a2"], ["a2", "a3"]

    def earlier(names: Sequence[str]) -> list[str]:
        """The state, and accelerations of earlier stages."""
        places = {"q": "from->q", "qd": "from->qd"} | {name: KEPT[name] for name in names}
        return [
            "const " + vectors.vector_of(target, arrays, name, of + ".x[#][i]")
            for name, of in places.items()
        ]

    good = [*(angles["slowly"] + angles["narrow"] if angles else []), "sum - sum == 0"]
    loops = []
    for k, (near, time, lines) in enumerate(plans, 1):
        sines = ", ".join(f"{near}.{n}[i]" for n in members)
        first = vectors.member(target, arrays, target.names[0])
        loops.append(
            {
                "given": [
                    *earlier(read[k - 1]),
                    *given,
                    *([f"const {P}_angles s_at = {{ {sines} }};"] if rotated else []),
                ],
                "vectors": ["at", "moving", f"a{k}"] if lines else ["a1"],
                "lines": lines,
                "call": f"(&a{k}, {'&at, &moving' if lines else '&q, &qd'}"
                + call("&s_at", time, "held") + ");",
                "spoilt": f"a{k}.{first} += failed < 1 ? 0 : ({real})NAN;",
                "kept": [f"{KEPT[f'a{k}']}.x[#][i] = a{k}.$;"],
            }
        )  # fmt: skip
    ended = [
        "const " + vectors.vector_of(target, arrays, name, f"to->{of}.x[#][i]")
        for name, of in (("at", "q"), ("moving", "qd"))
    ]
    return {
        "prototype": f"{target.PREFIX}_FORCE_INLINE int {P}_rk4_stages("
        + arguments(
            f"{P}_states *{alone}to", f"const {P}_states *{alone}from", f"{P}_tile *{alone}s",
            t_arg, f"{real} h", "int held" if target.system.inputs else "",
            "int own" if own else "", "int count",
        ) + ")",
        "calls": _each_known(
            ["held"] * bool(target.system.inputs) + ["own"] * own,
            lambda known: (
                f"odd = {P}_rk4_stages({arguments('to, from, s', t, 'h', *known, 'count')});"
            ),
        ),
        "before": loops[:2],
        "after": loops[2:],
        "all": earlier(list(KEPT)),
        "ends": [
            "at.$ = q.$ + (h*qd.$ + hh_6*(a1.$ + (a2.$ + a3.$)));",
            "moving.$ = qd.$ + h_6*(((a1.$ + (a2.$ + a3.$)) + (a2.$ + a3.$)) + a4.$);",
            "to->q.x[#][i] = at.$;",
            "to->qd.x[#][i] = moving.$;",
        ],
        "sum": " + ".join(
            f"{x}.{vectors.member(target, arrays, n)}"
            for n in target.names
            for x in ("at", "moving")
        ),
        "looked": [*(earlier(["a1", "a2"]) if angles else []), *ended],
        "good": ["int good = 1;", *(f"good &= {x};" for x in good)],
    }  # fmt: skip


def _large(
    target: Target, function: Function, kept: Sequence[str], made: Mapping[str, Any]
) -> dict[str, Any]:
    s, P = target.system, target.prefix
    _, rest = staged(function, [p.name for p in s.parameters])
    cut = target.outlined(
        rest,
        "solve_tile",
        _tile_arguments(target, kept),
        [_in_tile(target)("a", name) for name in target.names],
        Argument(f"{P}_vector_tile *{target.PREFIX}_ALONE a", "a", frozenset()),
        lambda f: target.loads(f, _in_tile(target), _in_tile(target)),
        {n: f"c->{n}[i]" for n in kept},
        tile=True,
    )
    return {
        "outlined": cut,
        "unused": [*made["unused"], *(["failures"] if not cut["fails"] else [])],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "end": [],
    }


def _in_tile(target: Target) -> Access:
    return lambda array, name: f"{array}->x[{target.enum[name]}][i]"


def _tile_arguments(target: Target, kept: Sequence[str]) -> list[Argument]:
    """What an outlined function over a tile may read."""
    P, groups, real = target.prefix, target.groups(), target.real.name
    return [
        Argument(f"const {P}_vector_tile *q", "q", groups["q"]),
        Argument(f"const {P}_vector_tile *qd", "qd", groups["qd"]),
        Argument(f"{real} t", "t", groups["t"]),
        Argument(f"const {P}_inputs_tile *u", "u", groups["u"]),
        Argument(f"const {P}_constants_tile *c", "c", frozenset(kept)),
        Argument("int count", "count", frozenset({COUNT})),
        Argument(f"{real} *{target.PREFIX}_ALONE failures", "failures", frozenset({FAILED})),
    ]


def _signal_of_tile(
    target: Target, kept: Sequence[str], c_arg: str, failed: str
) -> dict[str, Any] | None:
    """The scene's signals for a whole tile."""
    if "signal" not in target.program:
        return None
    P, given = target.prefix, target.program["signal"]
    own = {p.name for p in target.system.parameters}
    cut = target.outlined(
        given,
        "signal_tile",
        _tile_arguments(target, [n for n in kept if n in own]),
        [f"u->x[{target.enum[name]}][i]" for name in target.input_names],
        Argument(f"{P}_inputs_tile *{target.PREFIX}_ALONE u", "u", frozenset()),
        lambda f: target.loads(f, _in_tile(target), _in_tile(target)),
        {n: f"c->{n}[i]" for n in own},
        tile=True,
    )
    state = f"const {P}_vector_tile *q, const {P}_vector_tile *qd"
    return {
        "outlined": cut,
        "arguments": arguments(
            f"{P}_inputs_tile *u", f"{target.real.name} t" if target.signal_t else "",
            state if target.signal_state else "", c_arg, failed,
        ),
        "unused": [
            *([] if not c_arg or given.uses & own else ["c"]),
            *([] if cut["fails"] else ["failures"]),
            *_unread_state(target, given),
        ],
        "loads": cut["locals"],
        "blocks": [],
        "results": cut["calls"],
        "call": _signal_call(target, c_arg, "failures"),
    }  # fmt: skip


def _unread_state(target: Target, given: Function) -> list[str]:
    if not target.signal_state:
        return []
    return [name for name in ("q", "qd") if not given.uses & target.groups()[name]]


def _signal_call(target: Target, c_arg: str, failed: str) -> str:
    return arguments(
        "&now", "t" if target.signal_t else "", "q, qd" if target.signal_state else "",
        "c" if c_arg else "", "count", failed,
    )  # fmt: skip


def sizes(target: Target, kept: int, tile: Mapping[str, Any]) -> dict[str, int]:
    """Instances of a tile: as many as fit a first-level cache with their data, and no row of their
    numbers above 512 bytes. A tile that is not full is taken by blocks: rows of 64 bytes."""
    s, n, size = target.system, len(target.system.q), 8 if target.real is DOUBLE else 4
    numbers = 4 * n + len(s.u) + kept + 1  # two states, and whether it failed
    if tile["outlined"]:
        numbers += len(tile["outlined"]["members"]) // 2 + 4 * n  # of those, not all live at once
    else:
        numbers += max(METHODS[name].stages for name in s.run.methods) * n
        numbers += 3 * len(tile["angles"]["members"]) if tile["angles"] else 0
    block, fitting = 64 // size, CACHE // (size * numbers)
    return {"tile_size": max(block, min(512 // size, fitting // block * block)), "block": block}
