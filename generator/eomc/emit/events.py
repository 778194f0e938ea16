"""Event detection in adaptive steps, in both forms of C: event functions, roots and state jumps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import cos, pi, prod
from typing import Any, ClassVar

from eomc.emit import c_function as c
from eomc.emit.adaptive import (
    EVENTS_PER_STEP,
    METHOD,
    RECENT_STEPS,
    AdaptiveFunctions,
    AdaptiveRunView,
    AdaptiveStepView,
    FixedStepsView,
    SweepInterface,
    fixed_steps_view,
    max_events_per_step,
    run_view,
    step_view,
)
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import Target
from eomc.emit.coefficients import literals, matrix_rows
from eomc.emit.functions import SceneFunctions
from eomc.emit.views import NameFields
from eomc.integrators.tableaux import Row
from eomc.scene.schema import ACTIONS

SAMPLES = 9  # values of an event function in a step
MAX_TAIL = 0.02  # last Chebyshev coefficients of a resolved event function, over its largest value
MAX_EVENT_HALVINGS = 10  # of steps with unresolved events, besides one in RECENT_STEPS
DIFFERENCE_STEP = 1e-6  # of finite differences, as a fraction of the step
DIRECTIONS = {"falling": -1, "both": 0, "rising": 1}


@dataclass(frozen=True)
class EventsView(NameFields):
    """Data for c/events.c: event detection in a step, and state jumps.

    An event triggers at a root of its event function, a function of time and state.

    Attributes
    ----------
    method, fabs, sqrt, eps, tiny, huge
        Prefix of C names, names of C functions, and constants.
    samples, nodes, slopes
        Number of evaluations of an event function in a step; their positions, as fractions of the
        step; and the matrix that multiplies the values there to obtain the derivatives there.
    stages, once, twice
        Number of stages; the first and the second integrals of the powers of time up to each node.
    directions, actions, above
        For each event: -1, 0 or 1 for falling, both or rising; 0, 1 or 2 for record, stop or jump;
        1 if its function cannot become negative immediately after it was zero.
    jumps
        Whether events make the state jump.
    max_events, together
        Largest number of events in one step, and of jumps at the same time.
    difference_step, near, close
        Tolerances as fractions of a step: for finite differences, for corrections of a root, and
        for an accurate root.
    chance
        Fraction of the time between jumps. If the next jump follows within it, the two jumps are
        taken as coincidental.
    halvings, recent_steps
        A step is halved at most `halvings` times to resolve event functions, not counting one
        halving in every `recent_steps` steps.
    max_tail, last
        Largest size of the last Chebyshev coefficients of a resolved event function, relative to
        its largest value, and the weights that compute these coefficients.
    rounding, rounded, values_near
        The function that estimates the rounding error of an event function, its C call, and the C
        call of the event functions in its body.
    evaluate_events, refine_root, find_root, event_step, changed, restart
        The functions: event functions within a step, root between two times, first root in a step,
        all events of a step, changes by new inputs, and the start after an event.
    values, values_there, values_end, values_now, values_before, values_after
        C calls of the event functions: in `evaluate_events`, at a state within the step, at its
        end, in `changed`, and before and after a jump.
    look_value, look_before, look_after, bracket, bracket_dip, cross, inside
        C calls of `evaluate_events` at a time and shortly before and after it, of `refine_root` up
        to a node and up to a minimum, of `find_root`, and of the state within a step.
    jump, project, project_all
        C calls of the jump map (the new state after an event), and of the projection onto the
        constraints with and without entries of the state that stay fixed; "" for none.
    set
        For each event of the scene, 1 for the entries of q and qd that its jump sets, else 0.
    modes
        Initialisers with the indices of each friction mode and of its coordinate.
    own
        Number of events that the scene itself defines; the others belong to friction.
    """

    TEMPLATE: ClassVar[str] = "c/events.c"
    method: str
    fabs: str
    sqrt: str
    eps: str
    tiny: str
    samples: int
    nodes: tuple[str, ...]
    slopes: tuple[str, ...]
    stages: int
    once: tuple[str, ...]
    twice: tuple[str, ...]
    directions: tuple[int, ...]
    actions: tuple[int, ...]
    above: tuple[int, ...]
    jumps: bool
    max_events: int
    together: int
    difference_step: str
    near: str
    close: str
    chance: str
    huge: str
    halvings: int
    recent_steps: int
    rounding: CFunction
    rounded: str
    values_near: str
    max_tail: str
    last: tuple[str, ...]
    evaluate_events: CFunction
    values: str
    refine_root: CFunction
    find_root: CFunction
    look_value: str
    bracket: str
    bracket_dip: str
    event_step: CFunction
    cross: str
    look_before: str
    look_after: str
    inside: str
    values_there: str
    values_end: str
    changed: CFunction
    values_now: str
    restart: CFunction
    values_before: str
    jump: str
    project: str
    project_all: str
    set: tuple[str, ...]
    modes: tuple[str, ...]
    own: int
    values_after: str


@dataclass(frozen=True)
class InitialEventsView(NameFields):
    """Data for c/initial_events.c: events that trigger at the start of a motion.

    Attributes
    ----------
    function
        Prototype of the static C function that makes the jumps of these events.
    values
        C call that computes one value for each event, which is positive if the event triggers.
    restart
        C call that makes the state jump.
    method
        Prefix of the C names of the integration method.
    """

    TEMPLATE: ClassVar[str] = "c/initial_events.c"
    function: CFunction
    values: str
    restart: str
    method: str


def adaptive_views(
    functions: SceneFunctions, form: SweepInterface
) -> Iterator[AdaptiveStepView | FixedStepsView | EventsView | InitialEventsView | AdaptiveRunView]:
    """Yield the data for the templates of adaptive steps, events and runs.

    They are in the order of the C file.

    form: what differs between portable and optimised C. Without events, there are only the
    templates of adaptive steps and runs.
    """
    stepping = AdaptiveFunctions(functions, form)
    yield step_view(stepping)
    if not functions.target.system.events:
        yield run_view(stepping)
        return
    yield fixed_steps_view(stepping)
    event_view = _event_view(stepping)
    yield event_view
    arguments = {"x": "&x", "reached": "&reached", "q_at": "q_at", "qd_at": "qd_at"}
    again = arguments | {"reached": "reached"}
    start_view = (
        _initial_event_view(stepping, event_view.restart)
        if "begins" in functions.target.program
        else None
    )
    if start_view:
        yield start_view
    start_call = start_view.function.call(x="&x") if start_view else ""
    end_state = {"events": "x.last_values", "t": "x.t", "q": "x.q", "qd": "x.qd"}
    values = functions.public.evaluation("events").call(**end_state)
    changed = event_view.changed.call(x="&x")
    yield run_view(
        stepping,
        event_view.event_step.call(**arguments),
        event_view.restart.call(**again),
        start_call,
        changed,
        values,
    )


def _initial_event_view(stepping: AdaptiveFunctions, restart: CFunction) -> InitialEventsView:
    """Return the data for the template of events that trigger at the start of a motion.

    restart: the C function that continues the run after an event.
    """
    functions, x = stepping.functions, stepping.state.name
    values, record = (
        functions.public.evaluation("begins"),
        functions.public.adaptive_events,
    )
    arguments_taken = {a.name for f in (values, restart) for a in f.arguments}
    extra = [a for a in functions.arguments("u", "p") if a.name in arguments_taken]
    arguments = (stepping.state, *extra, *record, stepping.workspace)
    state = {name: c.member(x, name) for name in ("t", "q", "qd")}
    return InitialEventsView(
        **functions.names,
        function=c.static_prototype(
            f"{stepping.method}_initial_events", functions.status, *arguments
        ),
        values=values.call(begins="value", **state),
        method=stepping.method,
        restart=restart.call(reached=state["t"]),
    )  # fmt: skip


def _event_view(stepping: AdaptiveFunctions) -> EventsView:
    """Return the data for the template of event detection."""
    functions, method = stepping.functions, stepping.method
    target, real, public = functions.target, functions.real, functions.public
    end, system = target.real.function_suffix, target.system
    jumps = "jumps" in target.program
    evaluated = [public.evaluation(n) for n in ("events", "begins", "jumps") if n in target.program]
    argument_names = {a.name for f in evaluated for a in f.arguments}
    values, number, k = evaluated[0], stepping.number, CArgument("int", "k")
    read = c.input_array(f"{method}_adaptive_state", "x")
    # arguments of the formulas besides the state
    extra = [a for a in functions.arguments("u", "p") if a.name in argument_names]

    values_at = (c.output_array(real, "g"), read, number("z"), *extra)
    evaluate_events = c.static_prototype(f"{method}_evaluate_events", "void", *values_at)
    ends = [number(name) for name in ("low", "high", "at_low", "at_high")]
    refine_root = c.static_prototype(f"{method}_refine_root", real, read, k, *ends, *extra)
    above = tuple(int(e.above) for e in system.events if "begins" in target.program)
    find_root = c.static_prototype(
        f"{method}_find_root", real, stepping.state, k, number("from"), c.input_array(real, "g"),
        *([number("noise")] if above else []), *extra,
    )  # fmt: skip
    outputs = [c.output_array(real, name) for name in ("reached", "q_at", "qd_at")]
    record = public.adaptive_events
    rest = (number("tol"), *stepping.step_arguments, *record, stepping.workspace)
    event_step = c.static_prototype(f"{method}_event_step", "int", stepping.state, *outputs, *rest)
    changed = c.static_prototype(f"{method}_events_changed", "int", stepping.state, *extra)
    calls = [*evaluated, *([public.project] if stepping.form.project else ())]
    taken_by_calls = {a.name for f in calls for a in f.arguments}
    after_event = [a for a in functions.arguments("u", "p") if a.name in taken_by_calls]
    restart = c.static_prototype(
        f"{method}_restart", functions.status, stepping.state, number("reached"), *outputs[1:],
        *(after_event if jumps else ()), *([stepping.workspace] if jumps else []),
    )  # fmt: skip
    at = {"q": "q_at", "qd": "qd_at"}
    within = {"t": f"{c.member('x', 'from')} + z*{c.member('x', 'size')}", **at}
    reached = {"t": "reached", **at}
    now = {name: c.member("x", name) for name in ("t", "q", "qd")}
    difference = DIFFERENCE_STEP if target.real.epsilon < 1e-10 else 1e-3
    return EventsView(
        method=method,
        fabs=f"fabs{end}",
        sqrt=f"sqrt{end}",
        **_tables(functions),
        directions=tuple(DIRECTIONS[e.direction] for e in system.events),
        actions=tuple(ACTIONS.index(e.action) for e in system.events),
        above=above,
        jumps=jumps,
        max_events=max_events_per_step(system),
        together=EVENTS_PER_STEP + 4 * (max_events_per_step(system) - EVENTS_PER_STEP),
        difference_step=target.literal(difference),
        near=target.literal(0.01),
        close=target.literal(1e-10 if target.real.epsilon < 1e-10 else 1e-5),
        chance=target.literal(1e-6),
        **_rounding(stepping, extra),
        evaluate_events=evaluate_events,
        values=values.call(events="g", **within),
        refine_root=refine_root,
        find_root=find_root,
        look_value=evaluate_events.call(g="value"),
        bracket=refine_root.call(high="node[j]", at_high="g[j]"),
        bracket_dip=refine_root.call(high="z", at_high="value[k]"),
        event_step=event_step,
        cross=find_root.call(**{"k": "i", "from": "from[i]", "g": "g[i]", "noise": "noise[i]"}),
        look_before=evaluate_events.call(g="value", z=f"z - {target.literal(difference / 2)}"),
        look_after=evaluate_events.call(g="value", z=f"z + {target.literal(difference / 2)}"),
        inside=stepping.state_within.call(),
        values_there=values.call(events="value", **within),
        values_end=values.call(events="value", t=now["t"]),
        changed=changed,
        values_now=values.call(events="value", **now),
        restart=restart,
        values_before=values.call(events="before", **reached),
        jump=evaluated[-1].call(**reached) if jumps else "",
        project=public.project.call(fixed="set[k]", **reached) if stepping.form.project else "",
        project_all=public.project.call(fixed="0", **reached) if stepping.form.project else "",
        set=_jump_flags(functions.target) if stepping.form.project and jumps else (),
        modes=c.initialiser_rows([str(m.at), str(m.of)] for m in system.modes),
        own=len(system.own_events),
        values_after=values.call(events="value", **reached),
    )


def _rounding(stepping: AdaptiveFunctions, extra: Sequence[CArgument]) -> dict[str, Any]:
    """Return the fields of `EventsView` for the rounding errors of event functions.

    They are its prototype, its call, and the call of the event functions in it. extra: its
    arguments besides the state.
    """
    read, k = c.input_array(f"{stepping.method}_adaptive_state", "x"), CArgument("int", "k")
    function = c.static_prototype(
        f"{stepping.method}_rounding", stepping.functions.real, read, k, *extra
    )
    state = {"t": c.member("x", "t"), "q": "q_at", "qd": "qd_at"}
    values = stepping.functions.public.evaluation("events").call(events="value", **state)
    return {"rounding": function, "rounded": function.call(), "values_near": values}


def _jump_flags(target: Target) -> tuple[str, ...]:
    """Return, for each event of the scene, flags in braces: the entries of [q, qd] that jump."""
    coordinates = [target.scene_name(c.name) for c in target.system.coordinates]
    states = [name + end for end in ("", "_dot") for name in coordinates]
    rows = ({name for name, _ in e.jump} for e in target.system.own_events)
    return c.initialiser_rows([str(int(name in names)) for name in states] for names in rows)


def _tables(functions: SceneFunctions) -> dict[str, Any]:
    """Return template variables: nodes for event functions, and weights for their values there."""
    target = functions.target
    x, real = chebyshev_nodes(), target.real
    return {
        **functions.names,
        "eps": target.literal(real.epsilon),
        "tiny": target.literal(1e-30),
        "samples": SAMPLES,
        "nodes": literals(x, real),
        "slopes": matrix_rows(differentiation_matrix(x), real),
        "huge": target.literal(1e30),
        "halvings": MAX_EVENT_HALVINGS,
        "recent_steps": RECENT_STEPS,
        "max_tail": target.literal(MAX_TAIL),
        "last": c.initialiser_rows(literals(row, real) for row in chebyshev_tail_weights(SAMPLES)),
        "stages": METHOD.stages,
        "once": c.initialiser_rows(
            literals(row, real) for row in power_integrals(x, METHOD.stages, 1)
        ),
        "twice": c.initialiser_rows(
            literals(row, real) for row in power_integrals(x, METHOD.stages, 2)
        ),
    }


def chebyshev_nodes() -> Row:
    """Return the fractions of a step, from 0 to 1, at which event functions are evaluated.

    They are the extrema of a Chebyshev polynomial and include both ends.
    """
    last = SAMPLES - 1
    return tuple(Fraction((1 - cos(pi * j / last)) / 2).limit_denominator(10**12)
                 for j in range(SAMPLES))  # fmt: skip


def differentiation_matrix(x: Row) -> Sequence[Row]:
    """Return the differentiation matrix of polynomial interpolation at the points x.

    The matrix maps a function's values at these points to the derivatives of the interpolating
    polynomial at the same points.
    """
    weights = [1 / prod((a - b for b in x if b != a), start=Fraction(1)) for a in x]
    rows = [
        [w / v / (a - b) if a != b else Fraction(0) for b, w in zip(x, weights, strict=True)]
        for a, v in zip(x, weights, strict=True)
    ]
    for i, row in enumerate(rows):
        row[i] = -sum(row, Fraction(0))
    return tuple(map(tuple, rows))


def chebyshev_tail_weights(count: int) -> Sequence[Row]:
    """Return two rows of weights that yield the last two Chebyshev coefficients of a function.

    Each coefficient is the weighted sum of the function's values at `count` points, the extrema of
    a Chebyshev polynomial.
    """
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


def power_integrals(x: Row, count: int, times: int) -> Sequence[Row]:
    """Return the integrals of the powers (2 c - 1)^n over c, from 0 to each x.

    The result has a row for each x and a column for each power n < `count`. With `times` = 2, it
    has the integrals of these integrals.
    """
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
