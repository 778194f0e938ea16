"""Events in adaptive steps, in both forms of C: what crosses zero, where, and what it does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from math import cos, pi, prod
from typing import Any

from eomc.emit import c_function as c
from eomc.emit.adaptive import BUSY, LATELY, METHOD, Form, Stepping, busy, fixed, run, steps
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.coefficients import matrix, numbers
from eomc.emit.functions import Functions
from eomc.emit.plain.adaptive_views import Adaptive, AdaptiveRun, Begun, Events, FixedSteps
from eomc.integrators.tableaux import Row
from eomc.model.system import System
from eomc.scene.schema import ACTIONS

SAMPLES = 9  # values in a step
TOLD = 0.02  # of the largest value: what the last coefficients of an event in a step may be
HALVINGS = 10  # of steps in which they are more, beside one in LATELY
APART = 1e-6  # parts of a step between values that make a slope
DIRECTIONS = {"falling": -1, "both": 0, "rising": 1}


def nodes() -> Row:
    """Where the extrema of Chebyshev's polynomial are over a step, 0 and 1 among them."""
    last = SAMPLES - 1
    return tuple(Fraction((1 - cos(pi * j / last)) / 2).limit_denominator(10**12)
                 for j in range(SAMPLES))  # fmt: skip


def slopes(x: Row) -> Sequence[Row]:
    """From values at the nodes x to the slopes there of the polynomial through them."""
    weights = [1 / prod((a - b for b in x if b != a), start=Fraction(1)) for a in x]
    rows = [
        [w / v / (a - b) if a != b else Fraction(0) for b, w in zip(x, weights, strict=True)]
        for a, v in zip(x, weights, strict=True)
    ]
    for i, row in enumerate(rows):
        row[i] = -sum(row, Fraction(0))
    return tuple(map(tuple, rows))


def last(count: int) -> Sequence[Row]:
    """From values at the nodes to the last two coefficients by Chebyshev's polynomials."""
    top = count - 1
    ends = [Fraction(1, 2) if j in (0, top) else Fraction(1) for j in range(count)]
    return tuple(
        tuple(
            Fraction((-1) ** n * cos(pi * n * j / top)).limit_denominator(10**12)
            * end * Fraction(1 if n == top else 2, top)
            for j, end in enumerate(ends)
        )
        for n in (top - 1, top)
    )  # fmt: skip


def integrals(x: Row, count: int, times: int) -> Sequence[Row]:
    """Of (2 c - 1)^n, n below `count`, from 0 to each of x, once or twice."""
    signs = [Fraction((-1) ** n) for n in range(count + 3)]

    def once(n: int, at: Fraction) -> Fraction:
        power = Fraction(1)
        for _ in range(n + 1):
            power *= 2 * at - 1
        return (power - signs[n + 1]) / (2 * (n + 1))

    def twice(n: int, at: Fraction) -> Fraction:
        return (once(n + 1, at) - signs[n + 1] * at) / (2 * (n + 1))

    integral = (once, twice)[times - 1]
    return [tuple(integral(n, at) for n in range(count)) for at in x]


def views(
    functions: Functions, form: Form
) -> Iterator[Adaptive | FixedSteps | Events | Begun | AdaptiveRun]:
    """Adaptive steps, fixed ones and the events in them, and the loop over all."""
    made = Stepping(functions, form)
    yield steps(made)
    if not functions.target.system.events:
        yield run(made)
        return
    yield fixed(made)
    found = _events(made)
    yield found
    here = {"x": "&x", "reached": "&reached", "q_at": "q_at", "qd_at": "qd_at"}
    again = here | {"reached": "reached"}
    begun = _begun(made, found.restart) if "begins" in functions.target.program else None
    if begun:
        yield begun
    begins = begun.function.call(x="&x") if begun else ""
    ended = {"events": "x.seen", "t": "x.t", "q": "x.q", "qd": "x.qd"}
    values = functions.public.evaluation("events").call(**ended)
    changed = found.changed.call(x="&x")
    yield run(
        made, found.happened.call(**here), found.restart.call(**again), begins, changed, values
    )


def _begun(made: Stepping, restart: CFunction) -> Begun:
    functions, x = made.functions, made.state.name
    values, record = functions.public.evaluation("begins"), functions.public.adaptive_events
    taken = {a.name for f in (values, restart) for a in f.arguments}
    own = [a for a in functions.usual("u", "p") if a.name in taken]
    arguments = (made.state, *own, *record, made.held)
    state = {name: c.member(x, name) for name in ("t", "q", "qd")}
    return Begun(
        **functions.names,
        function=c.static(f"{made.method}_begun", functions.status, *arguments),
        values=values.call(begins="value", **state),
        method=made.method,
        restart=restart.call(reached=state["t"]),
    )  # fmt: skip


def _events(made: Stepping) -> Events:
    functions, method = made.functions, made.method
    target, real, public = functions.target, functions.real, functions.public
    end, system = target.real.function_suffix, target.system
    jumps = "jumps" in target.program
    asked = [public.evaluation(n) for n in ("events", "begins", "jumps") if n in target.program]
    needed = {a.name for f in asked for a in f.arguments}
    values, number, k = asked[0], made.number, CArgument("int", "k")
    read = c.given(f"{method}_adaptive_state", "x")
    # what the formulas take besides the state
    own = [a for a in functions.usual("u", "p") if a.name in needed]

    looked = c.static(f"{method}_looked", "void", c.filled(real, "g"), read, number("z"), *own)
    ends = [number(name) for name in ("low", "high", "at_low", "at_high")]
    bracketed = c.static(f"{method}_bracketed", real, read, k, *ends, *own)
    above = tuple(int(e.above) for e in system.events if "begins" in target.program)
    crossing = c.static(
        f"{method}_crossing", real, made.state, k, number("from"), c.given(real, "g"),
        *([number("noise")] if above else []), *own,
    )  # fmt: skip
    there = [c.filled(real, name) for name in ("reached", "q_at", "qd_at")]
    record = public.adaptive_events
    arguments = (made.state, *there, number("tol"), *made.taken, *record, made.held)
    happened = c.static(f"{method}_happened", "int", *arguments)
    changed = c.static(f"{method}_changed", "int", made.state, *own)
    calls = [*asked, *([public.project] if made.form.project else ())]
    taken = {a.name for f in calls for a in f.arguments}
    behind = [a for a in functions.usual("u", "p") if a.name in taken]
    restart = c.static(
        f"{method}_restarted", functions.status, made.state, number("reached"), *there[1:],
        *(behind if jumps else ()), *([made.held] if jumps else []),
    )  # fmt: skip
    at = {"q": "q_at", "qd": "qd_at"}
    within = {"t": f"{c.member('x', 'from')} + z*{c.member('x', 'size')}", **at}
    reached = {"t": "reached", **at}
    now = {name: c.member("x", name) for name in ("t", "q", "qd")}
    apart = APART if target.real.epsilon < 1e-10 else 1e-3
    return Events(
        method=method,
        fabs=f"fabs{end}",
        sqrt=f"sqrt{end}",
        **_tables(functions),
        directions=tuple(DIRECTIONS[e.direction] for e in system.events),
        actions=tuple(ACTIONS.index(e.action) for e in system.events),
        above=above,
        jumps=jumps,
        busy=busy(system),
        together=BUSY + 4 * (busy(system) - BUSY),
        apart=target.literal(apart),
        near=target.literal(0.01),
        close=target.literal(1e-10 if target.real.epsilon < 1e-10 else 1e-5),
        chance=target.literal(1e-6),
        **_rounding(made, own),
        looked=looked,
        values=values.call(events="g", **within),
        bracketed=bracketed,
        crossing=crossing,
        look_value=looked.call(g="value"),
        bracket=bracketed.call(high="node[j]", at_high="g[j]"),
        bracket_dip=bracketed.call(high="z", at_high="value[k]"),
        happened=happened,
        cross=crossing.call(**{"k": "i", "from": "from[i]", "g": "g[i]", "noise": "noise[i]"}),
        look_before=looked.call(g="value", z=f"z - {target.literal(apart / 2)}"),
        look_behind=looked.call(g="value", z=f"z + {target.literal(apart / 2)}"),
        inside=made.at.call(),
        values_there=values.call(events="value", **within),
        values_end=values.call(events="value", t=now["t"]),
        changed=changed,
        values_now=values.call(events="value", **now),
        restart=restart,
        values_before=values.call(events="before", **reached),
        jump=asked[-1].call(**reached) if jumps else "",
        project=public.project.call(held="set[k]", **reached) if made.form.project else "",
        project_all=public.project.call(held="0", **reached) if made.form.project else "",
        set=_set(system) if made.form.project and jumps else (),
        modes=c.in_braces([str(m.at), str(m.of)] for m in system.modes),
        own=len(system.own_events),
        values_after=values.call(events="value", **reached),
    )


def _rounding(made: Stepping, own: Sequence[CArgument]) -> dict[str, Any]:
    """What rounding makes of an event: its function, its call and the call in it."""
    read, k = c.given(f"{made.method}_adaptive_state", "x"), CArgument("int", "k")
    function = c.static(f"{made.method}_rounding", made.functions.real, read, k, *own)
    state = {"t": c.member("x", "t"), "q": "q_at", "qd": "qd_at"}
    values = made.functions.public.evaluation("events").call(events="value", **state)
    return {"rounding": function, "rounded": function.call(), "values_near": values}


def _set(system: System) -> tuple[str, ...]:
    """Of each event of the scene which of q and qd its jump sets."""
    states = [name for end in ("", "_dot") for name in (c.name + end for c in system.coordinates)]
    rows = ({name for name, _ in e.jump} for e in system.own_events)
    return c.in_braces([str(int(name in names)) for name in states] for names in rows)


def _tables(functions: Functions) -> dict[str, Any]:
    """The numbers of the nodes at which events are looked at, by the names of their view."""
    target = functions.target
    x, real = nodes(), target.real
    return {
        **functions.names,
        "eps": target.literal(real.epsilon),
        "tiny": target.literal(1e-30),
        "samples": SAMPLES,
        "nodes": numbers(x, real),
        "slopes": matrix(slopes(x), real),
        "huge": target.literal(1e30),
        "halvings": HALVINGS,
        "lately": LATELY,
        "told": target.literal(TOLD),
        "last": c.in_braces(numbers(row, real) for row in last(SAMPLES)),
        "stages": METHOD.stages,
        "once": c.in_braces(numbers(row, real) for row in integrals(x, METHOD.stages, 1)),
        "twice": c.in_braces(numbers(row, real) for row in integrals(x, METHOD.stages, 2)),
    }
