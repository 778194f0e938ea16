"""Portable C, strict C99 for any compiler: integration methods and files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, sqrt
from typing import ClassVar

from eomc.emit import adaptive, events, projection, sources
from eomc.emit import c_function as c
from eomc.emit.c_expression import Real
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.coefficients import TableauFields, tableau
from eomc.emit.derivatives import linearization, step_derivatives
from eomc.emit.functions import SceneFunctions, portable_functions
from eomc.emit.sources import SourceFields, method_title
from eomc.emit.views import NameFields, Show, View
from eomc.integrators.tableaux import METHODS, RK4, Method
from eomc.program.program import Program

MAX_ITERATIONS = {True: 50, False: 60}  # over the stages, with Newton's method and without


@dataclass(frozen=True)
class PortableSourceView(NameFields, SourceFields):
    """Data for c/portable/source.c: the source file of the portable C.

    adaptive: whether it contains adaptive steps.
    """

    TEMPLATE: ClassVar[str] = "c/portable/source.c"
    adaptive: bool


@dataclass(frozen=True)
class PortableRK4View(NameFields):
    """Data for c/portable/rk4.c: one step of the classical Runge-Kutta method.

    Attributes
    ----------
    about
        Lines of the comment above the function.
    step
        Prototype of the public function.
    advance, advance_call
        The function that makes the step, and its C call. Without constraints it is `step` itself.
        With constraints it is a static function, which also reports singular configurations: those
        in which a constraint equation has no multiplier.
    correct
        C call that projects the end of the step onto the constraints; "" without constraints.
    first, second, third, fourth
        C calls of the accelerations at the four stages.
    """

    TEMPLATE: ClassVar[str] = "c/portable/rk4.c"
    about: tuple[str, ...]
    step: CFunction
    advance: CFunction
    advance_call: str
    correct: str
    first: str
    second: str
    third: str
    fourth: str


@dataclass(frozen=True)
class PortableExplicitView(NameFields, TableauFields):
    """Data for c/portable/explicit.c: one step of an explicit Runge-Kutta method.

    about, step, advance, advance_call, correct: as in `PortableRK4View`. stages: the number of
    stages. stage: the C call of the accelerations at stage i.
    """

    TEMPLATE: ClassVar[str] = "c/portable/explicit.c"
    about: tuple[str, ...]
    step: CFunction
    advance: CFunction
    advance_call: str
    correct: str
    stages: int
    stage: str


@dataclass(frozen=True)
class PortableImplicitView(NameFields):
    """Data for c/portable/implicit.c: C functions that all implicit methods share.

    Attributes
    ----------
    fabs, fmax, tiny
        Names of the C functions for |x| and max(x, y), and a small positive number that avoids
        divisions by zero.
    nudge
        Relative step of finite differences.
    corrections, factors, newton
        Whether these functions are needed: for the size of corrections of the stages, for LU
        factorisation, and for derivatives of the accelerations by finite differences.
    slopes
        Prototype of the function for these derivatives.
    here, near
        C calls of the accelerations at the state and at a perturbed state.
    """

    TEMPLATE: ClassVar[str] = "c/portable/implicit.c"
    fabs: str
    fmax: str
    tiny: str
    nudge: str
    corrections: bool
    factors: bool
    newton: bool
    slopes: CFunction
    here: str
    near: str


@dataclass(frozen=True)
class PortableGaussView(NameFields, TableauFields):
    """Data for c/portable/gauss.c: one step of a Gauss method, solved by iteration.

    Attributes
    ----------
    method
        Prefix of the method's C names.
    newton
        Whether Newton's method is used where fixed-point iteration converges too slowly.
    sweeps
        Largest number of iterations.
    eps, tenth, half
        C literals: the rounding unit, 0.1 and 0.5.
    stages_function, matrix, solve, step
        Prototypes of the C functions: for the accelerations at all stages, for the LU factors of
        Newton's matrix, for the solution of a step by iteration, and the public one for a step.
    about
        Lines of the comment above the step.
    stage, slopes_call, start, sweep, matrix_start, matrix_mid, solve_call
        C calls: the accelerations at stage i, their derivatives, the accelerations at the start,
        `stages_function`, `matrix` at the start and at the middle of the step, and `solve`.
    onto, correct
        C calls that project a stage and the end of the step onto the constraints; "" for none. Only
        methods without Newton's method project stages.
    """

    TEMPLATE: ClassVar[str] = "c/portable/gauss.c"
    title: str
    method: str
    newton: bool
    sweeps: int
    stages: int
    eps: str
    tenth: str
    half: str
    stages_function: CFunction
    matrix: CFunction
    about: tuple[str, ...]
    solve: CFunction
    step: CFunction
    stage: str
    onto: str
    slopes_call: str
    start: str
    sweep: str
    matrix_start: str
    matrix_mid: str
    solve_call: str
    correct: str


@dataclass(frozen=True)
class PortableStagesView(NameFields):
    """Data for c/portable/stages.c: one fixed-point iteration over all stages of a step.

    Adaptive steps in portable C call the C function of this template.

    Attributes
    ----------
    title, name, stages
        The integration method: its title in comments, its name in C, and its number of stages.
    c, A, AA
        Nodes and coefficients of the method, as in `TableauFields`.
    sweep
        Prototype of the C function.
    stage
        C call of the accelerations at stage i.
    onto
        C call that projects stage i onto the constraints; "" without constraints.
    """

    TEMPLATE: ClassVar[str] = "c/portable/stages.c"
    title: str
    name: str
    stages: int
    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    sweep: CFunction
    stage: str
    onto: str


@dataclass(frozen=True)
class PortableRunsView(NameFields):
    """Data for c/portable/run.c: C functions for runs of one instance and of many.

    Attributes
    ----------
    implicit, constrained
        Whether the integration method is implicit, and whether the scene has constraints.
    run, batch
        Prototypes of the functions for one instance and for many; `batch` is None if the scene does
        not request it.
    one_step, run_one
        C call of one step in the body of `run`, and C call of `run` in the body of `batch`.
    """

    TEMPLATE: ClassVar[str] = "c/portable/run.c"
    implicit: bool
    constrained: bool
    run: CFunction
    batch: CFunction | None
    one_step: str
    run_one: str


def files(
    program: Program,
    show: Show,
    real: Real | None = None,
    written: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Return the header and the source of a program in portable C, as texts by file name.

    show: function that renders template data as text. real: the C type of numbers; by default that
    of the scene. written: names in the scene of names that differ in C.
    """
    functions = portable_functions(program, real, written)
    name = functions.prefix
    methods = [METHODS[m] for m in functions.target.system.run.methods]
    loops = [runs_view(functions, m) for m in methods]
    swept = functions.target.system.run.tolerance is not None or any(m.implicit for m in methods)
    views: list[View] = [implicit_view(functions, methods)] if swept else []
    views += [
        view
        for m, run in zip(methods, loops, strict=True)
        for view in (step_view(functions, m), run)
    ]
    views += [*step_derivatives(functions), *_adaptive(functions)]
    if onto := projection.portable_view(functions):
        views[:0] = [onto, projection.project_view(functions)]
    steppers = [show(view).rstrip("\n") for view in views]
    slopes = linearization(functions)
    texts = (
        show(sources.header_view(functions, slopes, handshake(functions))),
        show(
            PortableSourceView(
                **sources.source_fields(functions, handshake(functions), slopes, show),
                steppers=tuple(steppers),
                adaptive=functions.target.system.run.tolerance is not None,
            )
        ),
    )
    return {
        f"{name}.{end}": c.break_long_lines(text) for end, text in zip("hc", texts, strict=True)
    }


def handshake(functions: SceneFunctions) -> str:
    """Return a hexadecimal C constant that must be the same in the C source and in its header.

    The C compiler reports a header of another scene or form. Optimised C has another constant than
    portable C, since its workspaces differ in size.
    """
    digest = hashlib.sha256(f"plain {functions.target.system.digest}".encode()).hexdigest()
    return f"0x{digest[:8]}u"


def _about(m: Method) -> tuple[str, ...]:
    """Return the lines of a comment on a method: title, reference and stability limits."""
    undamped, decay = m.limits
    stable = f"h omega <= {undamped:.3g} undamped" + (
        f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."
    )
    return (
        f"{method_title(m)[0].upper()}{method_title(m)[1:]}",
        f"({m.source}).",
        *(() if m.sweeps else m.notes),
        *((f"Stability limits: {stable}",) if isfinite(undamped) else ()),
    )


def step_view(
    functions: SceneFunctions, m: Method
) -> PortableRK4View | PortableExplicitView | PortableGaussView:
    """Return the template data for the C function that makes one step of the method `m`.

    functions: the C functions of the scene.
    """
    if m.implicit:
        return _gauss(functions, m)
    accelerate, step = functions.acceleration.function.call, functions.public.step(m.name)
    advance, correct = _advance(functions, m)
    inner = advance.call(singular="&singular")
    if m is RK4:
        return PortableRK4View(
            **functions.names,
            about=_about(m),
            step=step,
            advance=advance,
            advance_call=inner,
            correct=correct,
            first=accelerate(qdd="a1"),
            second=accelerate(qdd="a2", q="r", qd="v", t="t + h/2"),
            third=accelerate(qdd="a3", q="r", qd="v", t="t + h/2"),
            fourth=accelerate(qdd="a4", q="r", qd="v", t="t + h"),
        )
    return PortableExplicitView(
        **functions.names,
        about=_about(m),
        step=step,
        advance=advance,
        advance_call=inner,
        correct=correct,
        stages=m.stages,
        **tableau(m, functions.target.real),
        stage=accelerate(qdd="a[i]", q="r", qd="v", t="t + c[i]*h"),
    )


def _advance(functions: SceneFunctions, m: Method) -> tuple[CFunction, str]:
    """Return the function for a step of an explicit method, and the call that projects its end.

    With constraints, it is a static function that the public function calls.
    """
    step = functions.public.step(m.name)
    if not functions.projection:
        return step, ""
    singular_flag = functions.project_end.arguments[-1]
    inner = c.static_prototype(
        f"{functions.prefix}_{m.name}", functions.status, *step.arguments, singular_flag
    )
    return inner, functions.project_end.call(t="t + h")


def implicit_view(functions: SceneFunctions, methods: Sequence[Method]) -> PortableImplicitView:
    """Return the template data for the C functions that implicit methods share.

    methods: the integration methods of the scene, of which some may be implicit. functions: the C
    functions of the scene.
    """
    real, accelerate = functions.target.real, functions.acceleration.function.call
    newton = any(m.newton for m in methods)
    return PortableImplicitView(
        **functions.names,
        fabs=f"fabs{real.function_suffix}",
        fmax=f"fmax{real.function_suffix}",
        tiny=functions.target.literal(1e-30),
        nudge=functions.target.literal(sqrt(real.epsilon)),
        corrections=any(m.implicit for m in methods),
        factors=newton or functions.target.system.run.tolerance is not None,
        newton=newton,
        slopes=c.static_prototype(
            f"{functions.prefix}_differences",
            functions.status,
            c.output_array(functions.real, "slopes"),
            *functions.arguments(*functions.state, "u", "p"),
        ),
        here=accelerate(qdd="here"),
        near=accelerate(qdd="near", q="x", qd="x + NQ"),
    )


def _gauss(functions: SceneFunctions, m: Method) -> PortableGaussView:
    """Return the view of a Gauss method."""
    accelerate = functions.acceleration.function.call
    method = f"{functions.prefix}_{m.name}"
    state_arguments = functions.arguments(*functions.state, "h", "u", "p")
    shared = implicit_view(functions, [m])
    onto = functions.onto_argument if m.sweeps else ()
    out = (c.output_array(functions.real, name) for name in ("f", "q_mid", "qd_mid"))
    a = c.input_array(functions.real, "a")
    stages = c.static_prototype(
        f"{method}_evaluated", functions.status, *out, a, *state_arguments, *onto
    )
    matrix_out = (c.output_array(functions.real, "M"), c.output_array("int", "row"))
    matrix_function = c.static_prototype(
        f"{method}_matrix", functions.status, *matrix_out, *state_arguments
    )
    one = functions.public.step(m.name)
    count = CArgument("long *", "evaluations")
    singular_flag = functions.project_end.arguments[-1:] if functions.projection else ()
    solve = c.static_prototype(method, functions.status, *one.arguments, count, *singular_flag)
    return PortableGaussView(
        **functions.names,
        title=m.title,
        method=method,
        newton=m.newton,
        sweeps=MAX_ITERATIONS[m.newton],
        stages=m.stages,
        **tableau(m, functions.target.real),
        eps=functions.target.literal(functions.target.real.epsilon),
        tenth=functions.target.literal(0.1),
        half=functions.target.literal(0.5),
        stages_function=stages,
        matrix=matrix_function,
        about=_about(m),
        solve=solve,
        step=one,
        stage=accelerate(qdd="f + NQ*i", q="r", qd="v", t=f"t + {method}_c[i]*h"),
        onto=functions.project_stage.call(t=f"t + {method}_c[i]*h") if onto else "",
        slopes_call=shared.slopes.call(),
        start=accelerate(qdd="a"),
        sweep=stages.call(),
        matrix_start=matrix_function.call(),
        matrix_mid=matrix_function.call(q="q_mid", qd="qd_mid", t="t + h/2"),
        solve_call=solve.call(evaluations="&evaluations", singular="&singular"),
        correct=functions.project_end.call(t="t + h") if functions.projection else "",
    )


def _adaptive(functions: SceneFunctions) -> list[View]:
    """Return the views of adaptive steps, where the scene requests them."""
    if functions.target.system.run.tolerance is None:
        return []
    m, method = adaptive.METHOD, f"{functions.prefix}_{adaptive.METHOD.name}"
    state_arguments = functions.arguments(*functions.state, "h", "u", "p")
    values = (c.output_array(f"{method}_stages", "b"), c.input_array(f"{method}_stages", "a"))
    sweep = c.static_prototype(
        f"{method}_sweep", "int", *values, *state_arguments, *functions.onto_argument
    )
    accelerate, coefficients = (
        functions.acceleration.function.call,
        tableau(m, functions.target.real),
    )
    nodes = PortableStagesView(
        **functions.names,
        title=adaptive.TITLE,
        name=m.name,
        stages=m.stages,
        c=coefficients["c"],
        A=coefficients["A"],
        AA=coefficients["AA"],
        sweep=sweep,
        stage=accelerate(qdd="f", q="r", qd="v", t="t + c[i]*h"),
        onto=functions.project_stage.call(t="t + c[i]*h") if functions.projection else "",
    )
    end = f"{c.member('x', 't')} + h"
    projection_call = functions.project_end.call(r="at", v="moving", t=end, singular="&singular")
    form = adaptive.SweepInterface(
        state_arguments, sweep.call(b="to", a="from"), accelerate(qdd="f"), functions.NQ,
        project=projection_call if functions.projection else "", whole=True,
    )  # fmt: skip
    batch_views = [adaptive.batch_view(functions)] if functions.target.system.run.batch else []
    return [nodes, *events.adaptive_views(functions, form), *batch_views]


def runs_view(functions: SceneFunctions, m: Method) -> PortableRunsView:
    """Return the template data for the C functions that make many steps by the method `m`.

    One function is for a run of one instance, the other for a batch of many instances.

    functions: the C functions of the scene.
    """
    NQ, real = functions.NQ, functions.real
    run = functions.public.run(m.name)
    one = step_view(functions, m)
    advance = one.solve if isinstance(one, PortableGaussView) else one.advance
    return PortableRunsView(
        **functions.names,
        implicit=m.implicit,
        constrained=bool(functions.projection),
        run=run,
        batch=functions.public.batch(m.name) if functions.target.system.run.batch else None,
        one_step=advance.call(
            t=f"t0 + ({real})(first + n)*h", u="u ? u + u_stride*n : 0", singular="&singular"
        ),
        run_one=run.call(
            q=f"q + {NQ}*k", qd=f"qd + {NQ}*k", u="u ? u + u_instance*k : 0", u_stride="u_step",
            q_rows="to_q", qd_rows="to_qd", p="p + p_instance*k", memory="0", status="&result",
        ),
    )  # fmt: skip
