"""The evaluation functions for the templates: D, C, g, bias, tau, energies, signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from eomc.emit.c_names import Argument, Target, arguments, none_of, sentence
from eomc.program.ir import Function
from eomc.program.outline import is_large
from eomc.program.program import TIME


@dataclass(frozen=True)
class Kind:
    """What is known of a function before it is looked at: results, arguments, meaning."""

    out: str
    shape: str  # "", "n", "n*n", "n*p" or "m"
    qd: bool
    u: bool
    doc: str
    symmetric: bool = False


KINDS: Mapping[str, Kind] = {
    "D": Kind("D", "n*n", False, False, "D(q): mass matrix, nq x nq, symmetric.", True),
    "C": Kind("C", "n*n", True, False, "C(q, qd): Coriolis matrix, nq x nq, Christoffel form."),
    "g": Kind("g", "n", False, False, "g(q): dP/dq, the forces of the potential energy."),
    "bias": Kind("bias", "n", True, False, "bias = C(q, qd) qd + g(q), without forming C."),
    "tau": Kind("tau", "n", True, True, "tau = Q - dR/dqd: inputs, friction and other forces."),
    "kinetic_energy": Kind("", "", True, False, "K(q, qd), J."),
    "potential_energy": Kind("", "", False, False, "P(q), J."),
    "energy": Kind("", "", True, False, "K + P, J."),
    "jacobi": Kind(
        "", "", True, False, "qd.dK/dqd - K + P, J: what is conserved here in place of K + P."
    ),
    "power": Kind(
        "",
        "",
        True,
        True,
        "Power into the system, W: d(energy)/dt, or d(jacobi)/dt if there is one.",
    ),
    "sensitivity": Kind(
        "E",
        "n*p",
        True,
        True,
        "E = dqdd/dp at held inputs, nq rows, a column for each parameter in its order.",
    ),
    "signal": Kind("u", "m", True, False, "u: the scene's own signals for the inputs."),
}


def functions(target: Target) -> list[dict[str, Any]]:
    """The evaluation functions that the program has, in their order."""
    return [_function(target, name) for name in KINDS if source(target, name) is not None]


def source(target: Target, name: str) -> Function | None:
    """The function that `name` is computed by: its own, or one that gives a column at a time."""
    of = target.program.functions
    return of.get(name) or of.get(f"{name}_column")


def takes_t(target: Target, name: str) -> bool:
    """Whether a function's result depends on time, by itself or by the signals."""
    function = source(target, name)
    assert function is not None
    takes_u = KINDS[name].u and target.system.inputs
    return TIME in function.uses or bool(takes_u and target.signal_t)


def _function(target: Target, name: str) -> dict[str, Any]:
    """One evaluation function: prototype, documentation, body."""
    kind, s = KINDS[name], target.system
    function = source(target, name)
    assert function is not None
    by_columns = name not in target.program
    real, NQ, NU = target.real.name, f"{target.PREFIX}_NQ", f"{target.PREFIX}_NU"
    np = len(s.parameters)
    size = {"n*n": f"{NQ}*{NQ}", "n*p": f"{NQ}*{np}", "n": NQ, "m": NU}.get(kind.shape, "")
    takes_u = kind.u and bool(s.inputs)
    takes_q = name != "signal" or target.signal_state
    timed = takes_t(target, name)
    out = f"{real} {kind.out}[{size}]" if size else ""
    given = arguments(
        out,
        f"{real} t" if timed and name == "signal" else "",
        f"const {real} q[{NQ}]" if takes_q else "",
        f"const {real} qd[{NQ}]" if takes_q and kind.qd else "",
        f"{real} t" if timed and name != "signal" else "",
        f"const {real} *u" if takes_u else "",
        target.p_arg,
    )
    used, groups = function.uses, target.groups()
    reads_u = takes_u and bool(used & groups["u"])
    passes = reads_u and target.signal_state  # to the signals
    unused = []
    if takes_q and not used & groups["q"] and not passes:
        unused.append("q")
    if takes_q and kind.qd and not used & groups["qd"] and not passes:
        unused.append("qd")
    if target.needs_p and not used & groups["p"] and not reads_u:
        unused.append("p")
    if takes_u and not reads_u:
        unused.append("u")
    if timed and TIME not in used and not reads_u:
        unused.append("t")
    doc = [kind.doc]
    if takes_u:
        doc.append("u: the inputs; NULL for the scene's signals.")
    told = sentence(function)
    doc.append(f"By {len(s.q)} columns, each: {told[0].lower() + told[1:]}" if by_columns else told)
    made: dict[str, Any] = {
        "name": name,
        "doc": doc,
        "prototype": f"{'void' if size else real} {target.prefix}_{name}({given})",
        "takes_u": takes_u,
        "reads_u": reads_u,
        "size": size,
        "unused": unused,
        "signal_call": target.signal_call("now", "q", "qd"),
        "column": None,
        "outlined": None,
        "is_large": is_large(function),
    }
    if by_columns:
        return made | _by_columns(target, name, function)
    if is_large(function):
        return made | _outlined(target, name, function)
    return made | _straight(target, kind.out if size else "", function)


def _straight(target: Target, out: str, function: Function) -> dict[str, Any]:
    """Its statements, one after the other."""
    body = target.body(function)
    return {
        "loads": target.loads(function, target.element, target.element),
        "blocks": [*body.early, *body.blocks],
        "results": [f"{out}[{i}] = {r};" for i, r in enumerate(body.results)]
        if out
        else [f"return {body.results[0]};"],
    }


def _outlined(target: Target, name: str, function: Function) -> dict[str, Any]:
    """Its statements in functions of their own, called one after the other."""
    kind, real, uses = KINDS.get(name), target.real.name, function.uses
    array = kind.out if kind is not None else "column"
    scalar = array == ""
    given = [
        Argument(declared, key, target.groups()[key])
        for key, declared in (
            ("q", f"const {real} *q"),
            ("qd", f"const {real} *qd"),
            ("t", f"{real} t"),
            ("u", f"const {real} *u"),
            ("along", f"const {real} *along"),
            ("p", target.p_arg),
        )
        if uses & target.groups()[key]
    ]
    made = target.outlined(
        function,
        name,
        given,
        ["*result"] if scalar else [f"{array}[{i}]" for i in range(len(function.outputs))],
        Argument(f"{real} *{array or 'result'}", array or "&result", frozenset()),
        lambda f: target.loads(f, target.element, target.element),
    )
    return {
        "outlined": made,
        "loads": [*([f"{real} result;"] if scalar else []), *made["locals"]],
        "blocks": [],
        "results": [*made["calls"], *(["return result;"] if scalar else [])],
    }


def _by_columns(target: Target, name: str, function: Function) -> dict[str, Any]:
    """A matrix as a loop over its columns, the matrix times each unit vector."""
    real, kind, NQ = target.real.name, KINDS[name], f"{target.PREFIX}_NQ"
    groups = target.groups()
    read = [key for key in ("q", "qd", "t", "p") if function.uses & groups[key]]
    declared = {
        "q": f"const {real} *q", "qd": f"const {real} *qd", "t": f"{real} t", "p": target.p_arg,
    }  # fmt: skip
    given = arguments(
        f"{real} column[{NQ}]", f"const {real} along[{NQ}]", *(declared[key] for key in read)
    )
    if is_large(function):
        column = _outlined(target, f"{name}_column", function)
    else:
        column = {"outlined": None} | _straight(target, "column", function)
    one, zero = f"1.0{target.real.suffix}", target.zero
    cell = f"{kind.out}[{NQ}*i + j]"
    rows = (
        [
            f"for (i = j; i < {NQ}; i++) {{",
            f"    {cell} = column[i];",
            f"    {kind.out}[{NQ}*j + i] = column[i];",
            "}",
        ]
        if kind.symmetric
        else [f"for (i = 0; i < {NQ}; i++)", f"    {cell} = column[i];"]
    )
    call = arguments("column", "along", *read)
    return {
        "column": column
        | {
            "doc": f"{kind.out} times along. {sentence(function)}",
            "prototype": f"static void {target.prefix}_{name}_column({given})",
            "unused": [] if function.uses & groups["along"] else ["along"],
        },
        "loads": [f"{real} along[{NQ}] = {{ {zero} }}, column[{NQ}];", "int i, j;"],
        "blocks": [],
        "results": [
            f"for (j = 0; j < {NQ}; j++) {{",
            f"    along[j] = {one};",
            f"    {target.prefix}_{name}_column({call});",
            f"    along[j] = {zero};",
            *(f"    {line}" for line in rows),
            "}",
        ],
    }


# --- the derivatives of the accelerations ---------------------------------------------------------


def linearization(target: Target) -> dict[str, Any] | None:
    """NAME_slopes, [da/dq, da/dqd, da/du] as rows, and what NAME_linearization hands on of it."""
    function = source(target, "linearization")
    if function is None:
        return None
    s, real, groups = target.system, target.real.name, target.groups()
    NQ, NU, P = f"{target.PREFIX}_NQ", f"{target.PREFIX}_NU", target.prefix
    width = f"2*{NQ} + {NU}" if s.inputs else f"2*{NQ}"
    declared = {
        "q": f"const {real} *q", "qd": f"const {real} *qd", "t": f"{real} t",
        "u": f"const {real} *u", "along": f"const {real} *along", "p": target.p_arg,
    }  # fmt: skip
    read = [key for key in ("q", "qd", "t", "u", "p") if function.uses & groups[key]]
    used = set(read)
    if "u" in read:  # by the signals
        state = {"q", "qd"} if target.signal_state else set()
        used |= state | ({"t"} if target.signal_t else set()) | ({"p"} if target.needs_p else set())
    there = ["q", "qd", *(["t"] if target.driven else []), *(["u"] if s.inputs else [])]
    there += ["p"] if target.needs_p else []
    whole = "linearization" in target.program
    told = sentence(function)
    parts = [("A_q", NQ, "0"), ("A_qd", NQ, NQ), *([("B", NU, f"2*{NQ}")] if s.inputs else [])]
    out = "slopes" if whole else "column"
    keys = read if whole else ["along", *read]
    made = _slopes(target, function, out, [Argument(declared[k], k, groups[k]) for k in keys])
    cost = told if whole else f"By {width} columns, each: {told[0].lower() + told[1:]}"
    return {
        "cost": cost,
        "width": width,
        "read": read,
        "by_columns": not whole,
        "inner": made
        | {"prototype": f"static int {P}_{'slopes' if whole else 'slopes_column'}("
           + arguments(f"{real} *{out}", *(declared[k] for k in keys)) + ")",
           "unused": [] if whole or function.uses & groups["along"] else ["along"]},
        "outer": f"static int {P}_slopes("
        + arguments(f"{real} *slopes", *(declared[key] for key in read)) + ")",
        "column_call": arguments("column", *keys),
        "call": arguments("slopes", *read),
        "parts": [{"name": n, "width": w, "at": at} for n, w, at in parts],
        "prototype": f"{P}_status {P}_linearization("
        + arguments(
            *(f"{real} {n}[{NQ}*{w}]" for n, w, _ in parts), f"const {real} q[{NQ}]",
            f"const {real} qd[{NQ}]", f"{real} t" if target.driven else "",
            declared["u"] if s.inputs else "", target.p_arg,
        ) + ")",
        "reads_u": "u" in read,
        "unread": [name for name in there if name not in used],
        "takes_p": "p" in used,
        "signal_call": target.signal_call("now", "q", "qd"),
        "signal_near": target.signal_call("near_u", "near_q", "near_qd")
        if target.signal_state
        else "",
    }  # fmt: skip


def _slopes(target: Target, function: Function, out: str, given: list[Argument]) -> dict[str, Any]:
    """The body that fills `out` and returns whether D was regular."""
    results = [f"{out}[{k}]" for k in range(len(function.outputs))]
    if is_large(function):
        filled = Argument(f"{target.real.name} *{out}", out, frozenset())
        cut = target.outlined(
            function, "slopes", given, results, filled,
            lambda f: target.loads(f, target.element, target.element),
        )  # fmt: skip
        return {
            "outlined": cut, "loads": cut["locals"], "blocks": [], "results": cut["calls"],
            "end": cut["outcome"],
        }  # fmt: skip
    body = target.body(function)
    return {
        "outlined": None,
        "loads": target.loads(function, target.element, target.element),
        "blocks": [*body.early, *body.blocks],
        "results": [f"{to} = {x};" for to, x in zip(results, body.results, strict=True)],
        "end": none_of([*body.early_failures, *body.failures]),
    }
