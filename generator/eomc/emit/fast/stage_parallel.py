"""The acceleration of one stage without branches, for methods with their stages in parallel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from eomc.emit import vectors
from eomc.emit.c_expression import indent
from eomc.emit.c_names import Access, Target, after, arguments
from eomc.program.ir import Function
from eomc.program.program import TIME


def mode(
    target: Target,
    function: Function,
    kept: Sequence[str],
    arrays: bool,
    sines: Sequence[str] = (),
) -> dict[str, Any]:
    """What stage_parallel.c.jinja prints: solve, and where there are inputs rates and signals.

    Failures are noted in `failed`, so that a loop over stages has no branches. kept: what
    parameters alone decide. arrays: whether vectors are arrays. sines: sines and cosines that come
    from outside, in a struct s.
    """
    s, real, P = target.system, target.real.name, target.prefix
    timed, given = TIME in function.uses, bool(s.inputs)
    t_arg = f"{real} t" if target.driven else ""
    c_arg, c = (f"const {P}_constants *c", "c") if kept else ("", "")
    u_arg = f"const {P}_inputs *u" if given else ""
    state, failed = f"const {P}_vector *q, const {P}_vector *qd", f"{real} *failed"
    s_arg, s_call = (f"const {P}_angles *s", "s") if sines else ("", "")
    where = {name: f"s->{name}" for name in sines}
    own = [p.name for p in s.parameters]
    body = target.body(function, where, keep=lambda n: f"c->{n}", parameters=own, branchless=True)
    one = f"1.0{target.real.suffix}"
    quiet = [] if body.failures or body.sincos else ["failed"]
    return {
        "head": f"{target.PREFIX}_FORCE_INLINE void",
        "inputs": f"{P}_inputs",
        "solve": "solve_branchless",
        "signal": "signal_branchless",
        "rates": "rates_branchless" if given else "solve_branchless",
        "solve_arguments": arguments(
            f"{P}_vector *a", state, s_arg, f"{real} t" if timed else "", u_arg, c_arg, failed
        ),
        "solve_u": after(s_call, "t" if timed else "", "held ? u : &now", c, "failed"),
        "rates_arguments": arguments(
            f"{P}_vector *a", state, s_arg, t_arg, u_arg, "int held", c_arg, failed
        ),
        "own_signal": signal(target, state, c_arg, failed, arrays),
        "each": lambda lines, width=4: indent(vectors.one_by_one(target, arrays, lines), width),
        "unused": [*_unread(target, function, ("q", "qd", "u")), *quiet],
        "loads": target.loads(function, _members(target, arrays), _input),
        "blocks": body.blocks,
        "results": [
            f"a->{vectors.member(target, arrays, name)} = {r};"
            for name, r in zip(target.names, body.results, strict=True)
        ],
        "end": [f"*failed = {x} ? {one} : *failed;" for x in body.failures],
    }


def signal(
    target: Target, state: str, c_arg: str, failed: str, arrays: bool
) -> dict[str, Any] | None:
    """The scene's signals for one stage, or one of many."""
    if "signal" not in target.program:
        return None
    s, given = target.system, target.program["signal"]
    where = {p.name: f"c->{p.name}" for p in s.parameters}
    made = target.body(given, where=where, branchless=True)
    t, at = target.signal_t, target.signal_state
    return {
        "outlined": None,
        "arguments": arguments(
            f"{target.prefix}_inputs *u", f"{target.real.name} t" if t else "",
            state if at else "", c_arg, failed,
        ),
        "call": arguments(
            "&now", "t" if t else "", "q, qd" if at else "", "c" if c_arg else "", "failed"
        ),
        "unused": [
            *([] if not c_arg or given.uses & set(where) else ["c"]),
            *([] if made.sincos else ["failed"]),
            *(_unread(target, given, ("q", "qd")) if at else []),
        ],
        "loads": target.loads(given, _members(target, arrays), _input),
        "blocks": [*made.early, *made.blocks],
        "results": [f"u->{i.name} = {r};" for i, r in zip(s.inputs, made.results, strict=True)],
    }  # fmt: skip


def _members(target: Target, arrays: bool) -> Access:
    return lambda array, name: f"{array}->{vectors.member(target, arrays, name)}"


def _input(array: str, name: str) -> str:
    return f"{array}->{name}"


def _unread(target: Target, function: Function, which: Sequence[str]) -> list[str]:
    """Arguments that a body does not read."""
    groups = target.groups()
    return [k for k in which if groups[k] and not function.uses & groups[k]]
