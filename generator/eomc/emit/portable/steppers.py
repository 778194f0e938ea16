"""Portable C: linearization, integration methods and files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite, sqrt
from typing import Any

from eomc.base.texts import FreeText
from eomc.emit import adaptive, evaluations, events, heading, projection
from eomc.emit import c_function as c
from eomc.emit.c_expression import Real
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import sentence
from eomc.emit.coefficients import tableau
from eomc.emit.derivatives import derivatives
from eomc.emit.functions import Functions, handshake, indexed, parameters, portable_functions
from eomc.emit.portable.parts import Computed
from eomc.emit.portable.views import (
    AdaptiveDeclared,
    Declared,
    Explicit,
    Gauss,
    Header,
    Implicit,
    Loop,
    Nodes,
    RungeKutta4,
    Slopes,
    Source,
    View,
)
from eomc.integrators.tableaux import METHODS, RK4, Method
from eomc.program.program import Program

Show = Callable[[View], str]  # renders template data as text

MAX_ITERATIONS = {True: 50, False: 60}  # over the stages, with Newton's method and without


def files(program: Program, show: Show, real: Real | None = None) -> dict[str, str]:
    """Return the header and the source of a program in portable C, as texts by file name.

    show: function that renders template data as text. real: the C type of numbers; by default that
    of the scene.
    """
    plain = portable_functions(program, real)
    name = plain.prefix
    methods = [METHODS[m] for m in plain.target.system.run.methods]
    loops = [loop(plain, m) for m in methods]
    swept = plain.target.system.run.tolerance is not None or any(m.implicit for m in methods)
    views: list[View] = [implicit(plain, methods)] if swept else []
    views += [
        view for m, run in zip(methods, loops, strict=True) for view in (stepper(plain, m), run)
    ]
    views += [*derivatives(plain), *_adaptive(plain)]
    if onto := projection.plain(plain):
        views[:0] = [onto, projection.project(plain)]
    steppers = [show(view).rstrip("\n") for view in views]
    slopes = linearization(plain)
    texts = (
        show(header(plain, slopes, handshake(plain))),
        show(
            Source(
                **source(plain, handshake(plain), slopes, show),
                steppers=tuple(steppers),
                adaptive=plain.target.system.run.tolerance is not None,
            )
        ),
    )
    return {f"{name}.{end}": c.laid_out(text) for end, text in zip("hc", texts, strict=True)}


def header(
    plain: Functions,
    slopes: Slopes | None,
    stamp: str,
    rooms: Sequence[int] = (),
    fast: bool = False,
) -> Header:
    """Return the data for the template of the C header, of portable or of optimised C.

    Parameters
    ----------
    plain
        The C functions of the scene.
    slopes
        Template data of the derivatives of the accelerations; None if the scene does not need them.
    stamp
        Number that the source compares with its own, to detect a header of another build.
    rooms
        Length of the workspace, as a count of numbers, for each integration method in optimised C,
        and then for adaptive steps. Empty for portable C, whose runs with fixed steps need none.
    fast
        Whether the header belongs to the optimised C.
    """
    target, s = plain.target, plain.target.system
    methods = [METHODS[name] for name in s.run.methods]
    *fixed_rooms, adaptive_room = rooms or [
        *(0 for _ in methods),
        adaptive.workspace_size(s, len(s.coordinates)),
    ]
    functions = [*plain.evaluations, plain.acceleration]
    return Header(
        title=FreeText(s.title),
        stamp=tuple(heading.stamp(target)),
        notes=tuple(heading.notes(target)),
        description=tuple(heading.description(target)),
        **plain.names,
        handshake=stamp,
        fast=fast,
        coordinates=indexed(plain, s.coordinates),
        inputs=indexed(plain, s.inputs),
        outputs=indexed(plain, s.outputs, "OUT_"),
        constraints=indexed(plain, s.constraints, "CONSTRAINT_"),
        events=indexed(plain, s.events, "EVENT_"),
        frames=tuple(target.enum[f"FRAME_{f.name}"] for f in s.output_frames),
        parameters=parameters(plain),
        implicit=any(m.implicit for m in methods) or s.run.tolerance is not None,
        timed=target.driven,
        functions=tuple(x.function for x in functions),
        linearization=slopes.linearization if slopes else None,
        project=plain.public.project if s.constraints else None,
        methods=tuple(
            Declared(
                m.name, _titled(m), m.implicit, room, plain.public.step(m.name),
                plain.public.run(m.name), plain.public.batch(m.name) if s.run.batch else None,
                plain.public.derivative(m.name) if s.run.discretize else None,
            )
            for m, room in zip(methods, fixed_rooms, strict=True)
        ),
        adaptive=AdaptiveDeclared(
            adaptive.TITLE, adaptive.memory(plain), adaptive_room,
            plain.public.adaptive(adaptive.METHOD.name),
            plain.public.adaptive_batch(adaptive.METHOD.name) if s.run.batch else None,
            adaptive.steps_in_parallel(target),
            plain.public.fixed_type if s.events else None,
        ) if s.run.tolerance else None,
        max_events=adaptive.max_events_per_step(s),
    )  # fmt: skip


def source(functions: Functions, stamp: str, slopes: Slopes | None, show: Show) -> dict[str, Any]:
    """Return the template fields that the sources of portable and optimised C share, by name.

    These are all fields of `AnySource` except `steppers`. functions: the C functions of the scene.
    stamp, slopes: as in `header`. show: function that renders template data as text.
    """
    target, s = functions.target, functions.target.system
    return {
        "title": FreeText(s.title),
        "stamp": tuple(heading.stamp(target)),
        **functions.names,
        "handshake": stamp,
        "parameters": parameters(functions),
        "q0": tuple(target.literal(x.start) for x in s.coordinates),
        "qd0": tuple(target.literal(x.rate) for x in s.coordinates),
        "evaluations": functions.evaluations,
        "acceleration": functions.acceleration,
        "solved": tuple(heading.solved(target)),
        "constrained": bool(s.constraints),
        "slopes": show(slopes).rstrip("\n") if slopes else "",
    }


# --- the derivatives of the accelerations ---------------------------------------------------------


def linearization(plain: Functions) -> Slopes | None:
    """Return the template data for the derivatives of the accelerations q̈.

    The derivatives are A_q = ∂q̈/∂q, A_qd = ∂q̈/∂q̇ and B = ∂q̈/∂u. Return None if the program does
    not contain them. plain: the C functions of the scene.
    """
    target = plain.target
    function = evaluations.source(target, "linearization")
    if function is None:
        return None
    NQ, inputs = plain.NQ, bool(target.system.inputs)
    width = f"2*{NQ} + {plain.NU}" if inputs else f"2*{NQ}"
    cost, doc = sentence(function), "[da/dq, da/dqd, da/du] at held inputs, by rows."
    if "linearization" in target.program:
        slopes = plain.static(function, "slopes", "slopes", doc, fails=True)
    else:
        column = "[da/dq, da/dqd, da/du] times along."
        one = plain.static(function, "slopes_column", "column", column, fails=True)
        along = ("column", "along")
        arguments_ = tuple(a for a in one.function.arguments if a.name not in along)
        loop_function = replace(
            one.function, name=f"{plain.prefix}_slopes", result=plain.status, body=(), doc=(doc,),
            arguments=(c.output_array(plain.real, "slopes"), *arguments_),
        )  # fmt: skip
        slopes = Computed(
            loop_function, (*one.parts, one.function), one.values, one.function.call()
        )
        cost = f"By {width} columns, each: {cost[0].lower()}{cost[1:]}"
    arguments = plain.arguments(*plain.state, "u", "p")
    arguments_read = plain.read(function)
    reads_u = plain.reads_u(function) and plain.signal is not None
    return Slopes(
        **plain.names,
        inputs=inputs,
        width=width,
        slopes=slopes,
        linearization=replace(plain.public.linearization, doc=(cost,)),
        unread=tuple(a.name for a in arguments if a.name not in arguments_read),
        signal_call=plain.signal.call(u="now") if reads_u and plain.signal else "",
        slopes_call=slopes.function.call(),
    )


# --- methods of integration -----------------------------------------------------------------------


def _titled(m: Method) -> str:
    """Return the title of a method with its order."""
    return m.title if "order" in m.title else f"{m.title}, order {m.order}"


def _about(m: Method) -> tuple[str, ...]:
    """Return the description of a method, its reference and stability limits, as lines of a
    comment.
    """
    undamped, decay = m.limits
    stable = f"h omega <= {undamped:.3g} undamped" + (
        f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."
    )
    return (
        f"{_titled(m)[0].upper()}{_titled(m)[1:]}",
        f"({m.source}).",
        *(() if m.sweeps else m.notes),
        *((f"Stability limits: {stable}",) if isfinite(undamped) else ()),
    )


def stepper(plain: Functions, m: Method) -> RungeKutta4 | Explicit | Gauss:
    """Return the template data for the C function that makes one step of the method `m`.

    plain: the C functions of the scene.
    """
    if m.implicit:
        return _gauss(plain, m)
    accelerate, step = plain.acceleration.function.call, plain.public.step(m.name)
    advance, correct = _advance(plain, m)
    inner = advance.call(singular="&singular")
    if m is RK4:
        return RungeKutta4(
            **plain.names,
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
    return Explicit(
        **plain.names,
        about=_about(m),
        step=step,
        advance=advance,
        advance_call=inner,
        correct=correct,
        stages=m.stages,
        **tableau(m, plain.target.real),
        stage=accelerate(qdd="a[i]", q="r", qd="v", t="t + c[i]*h"),
    )


def _advance(plain: Functions, m: Method) -> tuple[CFunction, str]:
    """Return the function for a step of an explicit method, and the call that projects its end.

    With constraints, it is a static function that the public function calls.
    """
    step = plain.public.step(m.name)
    if not plain.projection:
        return step, ""
    singular_flag = plain.projected.arguments[-1]
    inner = c.static(f"{plain.prefix}_{m.name}", plain.status, *step.arguments, singular_flag)
    return inner, plain.projected.call(t="t + h")


def implicit(plain: Functions, methods: Sequence[Method]) -> Implicit:
    """Return the template data for the C functions that implicit methods share.

    methods: the integration methods of the scene, of which some may be implicit. plain: the C
    functions of the scene.
    """
    real, accelerate = plain.target.real, plain.acceleration.function.call
    newton = any(m.newton for m in methods)
    return Implicit(
        **plain.names,
        fabs=f"fabs{real.function_suffix}",
        fmax=f"fmax{real.function_suffix}",
        tiny=plain.target.literal(1e-30),
        nudge=plain.target.literal(sqrt(real.epsilon)),
        corrections=any(m.implicit for m in methods),
        factors=newton or plain.target.system.run.tolerance is not None,
        newton=newton,
        slopes=c.static(
            f"{plain.prefix}_differences",
            plain.status,
            c.output_array(plain.real, "slopes"),
            *plain.arguments(*plain.state, "u", "p"),
        ),
        here=accelerate(qdd="here"),
        near=accelerate(qdd="near", q="x", qd="x + NQ"),
    )


def _gauss(plain: Functions, m: Method) -> Gauss:
    """Return the view of a Gauss method."""
    accelerate = plain.acceleration.function.call
    method = f"{plain.prefix}_{m.name}"
    state_arguments = plain.arguments(*plain.state, "h", "u", "p")
    shared = implicit(plain, [m])
    onto = plain.moves_stages if m.sweeps else ()
    out = (c.output_array(plain.real, name) for name in ("f", "q_mid", "qd_mid"))
    a = c.input_array(plain.real, "a")
    stages = c.static(f"{method}_evaluated", plain.status, *out, a, *state_arguments, *onto)
    matrix_out = (c.output_array(plain.real, "M"), c.output_array("int", "row"))
    matrix_function = c.static(f"{method}_matrix", plain.status, *matrix_out, *state_arguments)
    one = plain.public.step(m.name)
    count = CArgument("long *", "evaluations")
    singular_flag = plain.projected.arguments[-1:] if plain.projection else ()
    solve = c.static(method, plain.status, *one.arguments, count, *singular_flag)
    return Gauss(
        **plain.names,
        title=m.title,
        method=method,
        newton=m.newton,
        sweeps=MAX_ITERATIONS[m.newton],
        stages=m.stages,
        **tableau(m, plain.target.real),
        eps=plain.target.literal(plain.target.real.epsilon),
        tenth=plain.target.literal(0.1),
        half=plain.target.literal(0.5),
        stages_function=stages,
        matrix=matrix_function,
        about=_about(m),
        solve=solve,
        step=one,
        stage=accelerate(qdd="f + NQ*i", q="r", qd="v", t=f"t + {method}_c[i]*h"),
        onto=plain.onto.call(t=f"t + {method}_c[i]*h") if onto else "",
        slopes_call=shared.slopes.call(),
        start=accelerate(qdd="a"),
        sweep=stages.call(),
        matrix_start=matrix_function.call(),
        matrix_mid=matrix_function.call(q="q_mid", qd="qd_mid", t="t + h/2"),
        solve_call=solve.call(evaluations="&evaluations", singular="&singular"),
        correct=plain.projected.call(t="t + h") if plain.projection else "",
    )


def _adaptive(plain: Functions) -> list[View]:
    """Return the views of adaptive steps, where the scene requests them."""
    if plain.target.system.run.tolerance is None:
        return []
    m, method = adaptive.METHOD, f"{plain.prefix}_{adaptive.METHOD.name}"
    state_arguments = plain.arguments(*plain.state, "h", "u", "p")
    values = (c.output_array(f"{method}_stages", "b"), c.input_array(f"{method}_stages", "a"))
    sweep = c.static(f"{method}_sweep", "int", *values, *state_arguments, *plain.moves_stages)
    accelerate, coefficients = plain.acceleration.function.call, tableau(m, plain.target.real)
    nodes = Nodes(
        **plain.names,
        title=adaptive.TITLE,
        name=m.name,
        stages=m.stages,
        c=coefficients["c"],
        A=coefficients["A"],
        AA=coefficients["AA"],
        sweep=sweep,
        stage=accelerate(qdd="f", q="r", qd="v", t="t + c[i]*h"),
        onto=plain.onto.call(t="t + c[i]*h") if plain.projection else "",
    )
    end = f"{c.member('x', 't')} + h"
    projection_call = plain.projected.call(r="at", v="moving", t=end, singular="&singular")
    form = adaptive.SweepInterface(
        state_arguments, sweep.call(b="to", a="from"), accelerate(qdd="f"), plain.NQ,
        project=projection_call if plain.projection else "", whole=True,
    )  # fmt: skip
    batch_views = [adaptive.batch(plain)] if plain.target.system.run.batch else []
    return [nodes, *events.views(plain, form), *batch_views]


def loop(plain: Functions, m: Method) -> Loop:
    """Return the template data for the C functions that make many steps by the method `m`.

    One function is for a run of one instance, the other for a batch of many instances. plain: the C
    functions of the scene.
    """
    NQ, real = plain.NQ, plain.real
    run = plain.public.run(m.name)
    one = stepper(plain, m)
    advance = one.solve if isinstance(one, Gauss) else one.advance
    return Loop(
        **plain.names,
        implicit=m.implicit,
        constrained=bool(plain.projection),
        run=run,
        batch=plain.public.batch(m.name) if plain.target.system.run.batch else None,
        one_step=advance.call(
            t=f"t0 + ({real})(first + n)*h", u="u ? u + u_stride*n : 0", singular="&singular"
        ),
        run_one=run.call(
            q=f"q + {NQ}*k", qd=f"qd + {NQ}*k", u="u ? u + u_instance*k : 0", u_stride="u_step",
            q_rows="to_q", qd_rows="to_qd", p="p + p_instance*k", memory="0", status="&result",
        ),
    )  # fmt: skip
