"""Steps of a size that a tolerance asks for, in both forms of C: one text over a form's sweep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

from eomc.emit import c_function as c
from eomc.emit.c_expression import Real
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import Target
from eomc.emit.coefficients import matrix, numbers, rounded
from eomc.emit.functions import Functions
from eomc.emit.plain.adaptive_views import Adaptive, AdaptiveBatch, AdaptiveRun, FixedSteps
from eomc.integrators.tableaux import GAUSS16, Row
from eomc.model.corners import steep
from eomc.model.system import System
from eomc.program import outline
from eomc.scene.schema import LOOSEST

METHOD = GAUSS16
TITLE = f"the implicit method of Gauss and Legendre with {METHOD.stages} stages"
MOST = 14  # sweeps of a step
ROUGHEST = 2 * 0.8**-8  # of the root of tol/2: a step that is refused after two sweeps
LONGEST = 1e4  # times of the motion at the start: by no longer a time the least step is measured
OF_MOST = 1e-4  # of the largest coordinate and velocity, in the measures of all
OF_MOST_COARSE = 0.01  # where rounding counts, and in single precision, whose rounding is larger
SHARE = 0.1  # of the tolerance, for what a step with a corner errs by
ANEW = 32  # steps by Newton's method, before sweeps alone are tried again
SMALL = 300  # operations of accelerations, up to which many instances go side by side
LATELY = 4  # steps, in which one may be halved for its events without being counted
BUSY = 32  # events in one step, without those that happen at once


def memory(functions: Functions) -> str:
    """The type of what a run hands on from call to call."""
    return f"{functions.prefix}_{METHOD.name}_adaptive_memory"


def kept(system: System, width: int) -> int:
    """Numbers that it has room for; width: of a vector of coordinates."""
    vectors, few = (8, 26) if steep(system) else (6, 22)
    stages = METHOD.stages * len(system.coordinates)
    more = 11 * len(system.events) + 14 * bool(system.events) + bool(system.constraints)
    vectors += 2 * any(e.begins is not None for e in system.events)
    return vectors * width + stages + few + more


@dataclass(frozen=True)
class Form:
    """What a form of C brings: a sweep's arguments q, qd, t, h and so on, and calls.

    sweep: of a sweep from *a to b. start: of the accelerations f at q, qd. extent: of vectors of
    coordinates. constants: whether what parameters decide is a struct c; compute_constants: its
    call, which fails where there are none. lanes: a macro before loops over stages. project: the
    call that ends a step on constraints, if there are: of what it adds, or of its `whole` end.
    """

    around: tuple[CArgument, ...]
    sweep: str
    start: str
    extent: str
    constants: bool = False
    compute_constants: str = ""
    lanes: str = ""
    project: str = ""
    whole: bool = False


@dataclass(frozen=True)
class Stepping:
    """The functions of adaptive steps over the sweeps of a form."""

    functions: Functions
    form: Form

    @property
    def method(self) -> str:
        """What their C names begin with."""
        return f"{self.functions.prefix}_{METHOD.name}"

    @property
    def rest(self) -> Sequence[CArgument]:
        """The arguments that are the same all along a run."""
        return [a for a in self.form.around if a.name in "ucp"]

    @property
    def held(self) -> CArgument:
        """What a run hands on."""
        return c.filled(memory(self.functions), "memory")

    @property
    def state(self) -> CArgument:
        """The state of a run."""
        return c.filled(f"{self.method}_adaptive_state", "x")

    def number(self, name: str) -> CArgument:
        """An argument that is a number."""
        return CArgument(self.functions.real, name)

    @cached_property
    def settle(self) -> CFunction:
        """The accelerations over a step."""
        real = self.functions.real
        out = c.filled(f"{self.method}_stages", "a")
        measured = (c.filled(real, name) for name in ("scale", "coarse", "rough", "beyond"))
        by = c.given(f"{self.method}_newton", "m")
        limits = (self.number("tol"), self.number("most"))
        given = (*self.form.around, *self.functions.moves_stages, *limits, by)
        told = (*measured, c.filled("int", "sweeps"))
        cap = [c.given(real, "cap")] if self.held_at_rest else []
        return c.static(f"{self.method}_settled", "int", out, *given, *cap, *told)

    @property
    def held_at_rest(self) -> bool:
        """Whether forces that change in time may hold all at rest, so that rounding is left."""
        target = self.functions.target
        return bool(target.system.modes) and target.driven

    @cached_property
    def capped(self) -> CFunction:
        """What rounding makes of the accelerations over a step."""
        real = self.functions.real
        given = (c.given(f"{self.method}_stages", "a"), c.given(real, "scale"))
        around = (*self.form.around, *self.functions.moves_stages)
        arguments = (c.filled(real, "cap"), *given, *around, self.number("tol"))
        return c.static(f"{self.method}_capped", "int", *arguments)

    @cached_property
    def forces(self) -> CFunction:
        """The accelerations at a state."""
        out = c.filled(self.functions.real, "f")
        given = (a for a in self.form.around if a.name != "h")
        return c.static(f"{self.method}_forces", "int", out, *given)

    @cached_property
    def slopes(self) -> CFunction:
        """Their derivatives."""
        out = c.filled(f"{self.method}_newton", "m")
        return c.static(f"{self.method}_slopes", "int", out, *self.form.around)

    @cached_property
    def step(self) -> CFunction:
        """The next step."""
        given = (*map(self.number, ("t_end", "tol", "h_most")), *self.rest)
        status = self.functions.status
        return c.static(f"{self.method}_adapted", status, self.state, *given, self.held)

    @cached_property
    def within(self) -> CFunction:
        """The state within the last step."""
        out = tuple(c.filled(self.functions.real, name) for name in ("q_at", "qd_at"))
        state = c.given(f"{self.method}_adaptive_state", "x")
        given = (state, self.number("z"), self.number("tol"), *self.rest)
        return c.static(f"{self.method}_inside", "void", *out, *given, self.held)

    @property
    def taken(self) -> Sequence[CArgument]:
        """The rest, and what the public functions of steps take."""
        rest = self.rest
        there = {a.name for a in rest}
        return [*rest, *(a for a in self.functions.usual("u", "p") if a.name not in there)]

    @cached_property
    def fixed(self) -> CFunction:
        """The next step of fixed size."""
        limits, status = map(self.number, ("t_end", "h_most")), self.functions.status
        return c.static(f"{self.method}_fixed", status, self.state, *limits, *self.taken, self.held)

    @cached_property
    def at(self) -> CFunction:
        """The state within the last step, where that may be of fixed size."""
        if not self.functions.target.system.events:
            return self.within
        own = self.within.arguments[: -len(self.rest) - 1]
        return c.static(f"{self.method}_at", "void", *own, *self.taken, self.held)


def tableau(made: Stepping) -> dict[str, Any]:
    """The numbers that both texts of adaptive steps have, by the names of their views."""
    m, target = METHOD, made.functions.target
    real = target.real
    return {
        **made.functions.names,
        "method": made.method,
        "extent": made.form.extent,
        "stages": m.stages,
        "f": real.suffix,
        "sqrt": f"sqrt{real.function_suffix}",
        "eps": target.literal(real.epsilon),
        "tiny": target.literal(1e-30),
        "of_most": target.literal(OF_MOST if real.epsilon < 1e-10 else OF_MOST_COARSE),
        "of_most_coarse": target.literal(OF_MOST_COARSE),
        "most": MOST,
        "c": numbers(m.c, real),
        "powers": matrix(list(zip(*m.powers, strict=True)), real),
        "anew": ANEW,
        "still": len(target.system.modes) + len(target.system.discrete),
    }


def steps(made: Stepping) -> Adaptive:
    """A step, and the state within it."""
    functions, m, form = made.functions, METHOD, made.form
    target, real = functions.target, functions.target.real
    known = {name: f"&{name}" for name in ("a", "rough", "beyond", "sweeps")}
    known["m"] = "newton ? &m : 0"
    eigenvalues, to_parts, from_parts = m.eigen
    last, b = [m.legendre(n) for n in range(m.stages - 4, m.stages)], rounded(m.b, real)
    return Adaptive(
        **tableau(made),
        title=TITLE,
        fabs=f"fabs{real.function_suffix}",
        lanes=form.lanes and f"{form.lanes} ",
        total=_total([f"half[{i}]" for i in range(m.stages // 2)]),
        top=c.in_braces(numbers(row, real) for row in zip(*last, strict=True)),
        weights=c.in_braces(zip(numbers(m.b_a, real), numbers(b, real), strict=True)),
        timed=target.driven,
        held=made.held_at_rest,
        capped=made.capped,
        capped_now=made.capped.call(a="&a"),
        events=bool(target.system.events),
        begins="begins" in target.program,
        project=form.project,
        whole=form.whole,
        settle=made.settle,
        sweep=form.sweep,
        step=made.step,
        start=form.start,
        settled=made.settle.call(
            most=f"{target.literal(ROUGHEST)}*aim", cap="capped ? cap : 0", **known
        ),
        within=made.within,
        corners=steep(target.system),
        longest=target.literal(LONGEST),
        close=target.literal(float(f"{real.epsilon ** (-1 / 3):.0e}")),
        share=target.literal(SHARE),
        ends=c.in_braces(numbers(row, real) for row in _ends()),
        forces=made.forces,
        forces_here=made.forces.call(f="here", q="at_q", qd="at_qd"),
        forces_near=made.forces.call(f="near", q="at_q", qd="at_qd"),
        slopes=made.slopes,
        slopes_now=made.slopes.call(m="&m"),
        nudge=target.literal(math.sqrt(real.epsilon)),
        eigenvalues=c.in_braces(numbers(row, real) for row in eigenvalues),
        to_parts=c.in_braces(numbers(row, real) for row in to_parts),
        from_parts=c.in_braces(numbers(row, real) for row in from_parts),
        forces_there=made.forces.call(f="there", q="to_q", qd="to_qd", t="t + h"),
        settled_within=made.settle.call(most=target.literal(1e30), cap="0", **known),
    )


def fixed(made: Stepping) -> FixedSteps:
    """Steps of fixed size in which events are seen."""
    functions = made.functions
    target, real = functions.target, functions.target.real
    at = {"q": "q_at", "qd": "qd_at"}
    state = {name: c.member(made.state.name, name) for name in ("q", "qd")}
    return FixedSteps(
        **functions.names,
        method=made.method,
        extent=made.form.extent,
        stages=METHOD.stages,
        f=real.suffix,
        eps=target.literal(real.epsilon),
        fabs=f"fabs{real.function_suffix}",
        timed=target.driven,
        jumps="jumps" in target.program,
        above="begins" in target.program,
        fixed=made.fixed,
        at=made.at,
        inside=made.within.call(),
        step=functions.public.fixed_step.call(**at),
        forces_before=made.forces.call(f="before", **state),
        forces_halfway=made.forces.call(f="halfway", t="t + h/2", **at),
        forces_behind=made.forces.call(f="behind", t="t + h", **at),
    )


def busy(system: System) -> int:
    """Events in one step, from which on it ends there."""
    return BUSY + sum(e.begins is not None for e in system.events)


def keep(made: Stepping) -> CFunction:
    """A state into a row."""
    arguments = (c.filled(made.functions.real, n) for n in ("q_row", "qd_row", "q", "qd"))
    return CFunction(f"{made.method}_kept", "void", tuple(arguments))


def tightest(real: Real) -> float:
    """The least tolerance that numbers have digits for."""
    return 1e-15 if real.epsilon < 1e-10 else 5e-7


def run(
    made: Stepping, happen: str = "", restart: str = "", begun: str = "", changed: str = "",
    values: str = "",
) -> AdaptiveRun:  # fmt: skip
    """The loop. happen, restart, begun: the calls that find events, and go on behind them; changed,
    values: that which tells whether inputs have changed them, and their values."""
    functions, form = made.functions, made.form
    target = functions.target
    row = {name: f"{name} + {functions.NQ}*rows" for name in ("q_rows", "qd_rows")}
    kept = keep(made)
    to = {"q_row": row["q_rows"], "qd_row": row["qd_rows"]}
    takes_p = "p" in {a.name for a in made.rest} or bool(
        form.compute_constants or happen or form.project
    )

    def projected(**state: str) -> str:
        return functions.public.project.call(held="0", **state) if form.project else ""

    return AdaptiveRun(
        **functions.names,
        method=made.method,
        constants=form.constants,
        unread_p=target.needs_p and not takes_p,
        compute_constants=form.compute_constants,
        loosest=target.literal(LOOSEST),
        tightest=target.literal(tightest(target.real)),
        events=bool(happen),
        f=target.real.suffix,
        eps=target.literal(target.real.epsilon),
        fabs=f"fabs{target.real.function_suffix}",
        lately=LATELY,
        begun=begun,
        changed=changed,
        values=values,
        huge=target.literal(1e30),
        busy=busy(target.system),
        anew=ANEW,
        run=functions.public.adaptive(METHOD.name),
        advance=made.step.call(x="&x", **({"h_most": "longest"} if happen else {})),
        fixed=made.fixed.call(x="&x") if happen else "",
        happen=happen,
        restart=restart,
        row=kept.call(q="x.q", qd="x.qd", **to),
        row_before=kept.call(q="q_at", qd="qd_at", **to),
        look=made.at.call(q_at=row["q_rows"], qd_at=row["qd_rows"], x="&x"),
        project_row=projected(q=row["q_rows"], qd=row["qd_rows"], t="times[rows]"),
        project_restart=projected(q="x.q", qd="x.qd", t="x.t"),
    )


def together(target: Target) -> bool:
    """Whether the fast form has the steps of many side by side: of small systems without corners.

    Large ones have enough to do in one sweep.
    """
    s = target.system
    plain = not (s.events or s.constraints or steep(s))
    return plain and s.run.batch and outline.weight(target.program["acceleration"]) <= SMALL


def alone(functions: Functions) -> str:
    """The call for instance k of a batch."""
    NQ = functions.NQ
    rows = {f"{n}_rows": f"times ? {n}_rows + {NQ}*row : 0" for n in ("q", "qd")}
    return functions.public.adaptive(METHOD.name).call(
        q=f"q + {NQ}*k", qd=f"qd + {NQ}*k", t="t + k", u="u ? u + u_instance*k : 0",
        times="times ? times + kept[k] : 0", count="row_count - kept[k]", t_rows="0", **rows,
        events="events ? events + k : 0", which="which ? which + room*k : 0",
        event_rows=f"which ? event_rows + (1 + 2*{NQ})*room*k : 0", p="p + p_instance*k",
        memory="memory + k", status="&found",
    )  # fmt: skip


def batch(functions: Functions) -> AdaptiveBatch:
    """Many, one after the other."""
    return AdaptiveBatch(
        prefix=functions.prefix,
        batch=functions.public.adaptive_batch(METHOD.name),
        alone=alone(functions),
        events=bool(functions.target.system.events),
    )


def _ends() -> tuple[Row, Row]:
    """To the values at both ends of a step of the polynomial through those at its stages."""
    parts = [METHOD.legendre(n) for n in range(METHOD.stages)]
    columns = list(zip(*parts, strict=True))
    start = tuple(sum(column[::2], Fraction(0)) - sum(column[1::2]) for column in columns)
    return start, tuple(sum(column, Fraction(0)) for column in columns)


def _total(terms: list[str]) -> str:
    """Their sum by halves, which waits for three additions in place of seven, of eight."""
    half = len(terms) // 2
    if not half:
        return terms[0]
    parts = (_total(terms[:half]), _total(terms[half:]))
    return " + ".join(f"({part})" if " " in part else part for part in parts)
