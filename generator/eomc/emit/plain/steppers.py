"""The plain form's linearization and methods of integration, and all of its files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from math import isfinite, sqrt

from eomc.base.texts import FreeText
from eomc.emit import c_function as c
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import sentence
from eomc.emit.evaluations import source
from eomc.emit.fast import context
from eomc.emit.fast.integrators import literal, rounded
from eomc.emit.plain.functions import Plain, handshake, indexed, of, parameters
from eomc.emit.plain.views import (
    Computed,
    Declared,
    Explicit,
    Gauss,
    Header,
    Implicit,
    Loop,
    RungeKutta4,
    Slopes,
    Source,
    View,
)
from eomc.integrators.tableaux import METHODS, RK4, Method, Row
from eomc.program.program import Program

Show = Callable[[View], str]  # a view by its template

SWEEPS = {True: 50, False: 60}  # at most, with Newton's method and without


def files(program: Program, show: Show) -> dict[str, str]:
    """Header and source of the plain form by file name."""
    plain = of(program)
    name = plain.prefix
    methods = [METHODS[m] for m in plain.target.system.run.methods]
    loops = [loop(plain, m) for m in methods]
    views: list[View] = [implicit(plain, methods)] if any(m.implicit for m in methods) else []
    views += [
        view for m, run in zip(methods, loops, strict=True) for view in (stepper(plain, m), run)
    ]
    steppers = [show(view).rstrip("\n") for view in views]
    slopes = linearization(plain)
    texts = (
        show(header(plain, slopes, loops)),
        show(source_view(plain, show(slopes).rstrip("\n") if slopes else "", steppers)),
    )
    return {f"{name}.{end}": c.laid_out(text) for end, text in zip("hc", texts, strict=True)}


def header(plain: Plain, slopes: Slopes | None, loops: Sequence[Loop]) -> Header:
    """The header's view."""
    target, s = plain.target, plain.target.system
    found = [*plain.evaluations, plain.acceleration]
    return Header(
        title=FreeText(s.title),
        stamp=tuple(context.stamp(target)),
        notes=tuple(context.notes(target)),
        description=tuple(context.description(target)),
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        handshake=handshake(plain),
        coordinates=indexed(plain),
        inputs=indexed(plain, inputs=True),
        parameters=parameters(plain),
        implicit=any(x.implicit for x in loops),
        timed=target.driven,
        functions=tuple(x.function for x in found),
        linearization=slopes.linearization if slopes else None,
        methods=tuple(
            Declared(m.name, _titled(m), m.implicit, step(plain, m), x.run, x.batch)
            for m, x in zip(map(METHODS.__getitem__, s.run.methods), loops, strict=True)
        ),
    )


def source_view(plain: Plain, slopes: str, steppers: Sequence[str]) -> Source:
    """The source's view."""
    target, s = plain.target, plain.target.system
    return Source(
        title=FreeText(s.title),
        stamp=tuple(context.stamp(target)),
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        handshake=handshake(plain),
        parameters=parameters(plain),
        q0=tuple(target.literal(x.start) for x in s.coordinates),
        qd0=tuple(target.literal(x.rate) for x in s.coordinates),
        evaluations=plain.evaluations,
        acceleration=plain.acceleration,
        solved=tuple(context.solved(target)),
        slopes=slopes,
        steppers=tuple(steppers),
    )


# --- the derivatives of the accelerations ---------------------------------------------------------


def linearization(plain: Plain) -> Slopes | None:
    """A_q, A_qd and B, where the program has them."""
    target = plain.target
    function = source(target, "linearization")
    if function is None:
        return None
    NQ, inputs = plain.NQ, bool(target.system.inputs)
    width = f"2*{NQ} + {plain.NU}" if inputs else f"2*{NQ}"
    told, doc = sentence(function), "[da/dq, da/dqd, da/du] at held inputs, by rows."
    if "linearization" in target.program:
        slopes = plain.static(function, "slopes", "slopes", doc, fails=True)
    else:
        column = "[da/dq, da/dqd, da/du] times along."
        one = plain.static(function, "slopes_column", "column", column, fails=True)
        along = ("column", "along")
        rest = tuple(a for a in one.function.arguments if a.name not in along)
        made = replace(
            one.function, name=f"{plain.prefix}_slopes", result=plain.status, body=(), doc=(doc,),
            arguments=(c.filled(plain.real, "slopes"), *rest),
        )  # fmt: skip
        slopes = Computed(made, (*one.parts, one.function), one.values, one.function.call())
        told = f"By {width} columns, each: {told[0].lower()}{told[1:]}"
    out = (("A_q", NQ), ("A_qd", NQ), *([("B", plain.NU)] if inputs else []))
    arguments = plain.usual(*plain.state, "u", "p")
    read = plain.read(function)
    reads_u = plain.reads_u(function) and plain.signal is not None
    return Slopes(
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        inputs=inputs,
        width=width,
        slopes=slopes,
        linearization=CFunction(
            f"{plain.prefix}_linearization",
            plain.status,
            (*(c.filled(plain.real, n, f"{NQ}*{w}") for n, w in out), *arguments),
            doc=(told,),
        ),
        unread=tuple(a.name for a in arguments if a.name not in read),
        signal_call=plain.signal.call(u="now") if reads_u and plain.signal else "",
        slopes_call=slopes.function.call(),
    )


# --- methods of integration -----------------------------------------------------------------------


def _titled(m: Method) -> str:
    """What a method is called, with its order."""
    return m.title if "order" in m.title else f"{m.title}, order {m.order}"


def _about(m: Method) -> tuple[str, ...]:
    """What a method is, where from, and up to which step: lines of a comment."""
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


def step(plain: Plain, m: Method) -> CFunction:
    """The prototype of one step."""
    return CFunction(
        f"{plain.prefix}_{m.name}_step",
        plain.status,
        (
            c.filled(plain.real, "q", plain.NQ),
            c.filled(plain.real, "qd", plain.NQ),
            *plain.usual(*plain.state[2:], "h", "u", "p"),
        ),
    )


def stepper(plain: Plain, m: Method) -> RungeKutta4 | Explicit | Gauss:
    """The view of the function that computes one step."""
    if m.implicit:
        return _gauss(plain, m)
    accelerate = plain.acceleration.function.call
    if m is RK4:
        return RungeKutta4(
            prefix=plain.prefix,
            PREFIX=plain.PREFIX,
            real=plain.real,
            about=_about(m),
            step=step(plain, m),
            first=accelerate(qdd="a1"),
            second=accelerate(qdd="a2", q="r", qd="v", t="t + h/2"),
            third=accelerate(qdd="a3", q="r", qd="v", t="t + h/2"),
            fourth=accelerate(qdd="a4", q="r", qd="v", t="t + h"),
        )
    return Explicit(
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        about=_about(m),
        step=step(plain, m),
        stages=m.stages,
        c=_numbers(plain, m.c),
        A=_matrix(plain, m.a),
        AA=_matrix(plain, m.a_squared),
        b=_numbers(plain, rounded(m.b, plain.target.real)),
        bA=_numbers(plain, m.b_a),
        stage=accelerate(qdd="a[i]", q="r", qd="v", t="t + c[i]*h"),
    )


def _numbers(plain: Plain, row: Row) -> tuple[str, ...]:
    return tuple(literal(x, plain.target.real) for x in row)


def _matrix(plain: Plain, rows: Sequence[Row]) -> tuple[str, ...]:
    """The rows of a square matrix, zeros where a triangle ends."""
    whole = [(*row, *[Fraction(0)] * (len(rows) - len(row))) for row in rows]
    return c.in_braces(_numbers(plain, row) for row in whole)


def implicit(plain: Plain, methods: Sequence[Method]) -> Implicit:
    """What the implicit methods share."""
    real, accelerate = plain.target.real, plain.acceleration.function.call
    return Implicit(
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        fabs=f"fabs{real.function_suffix}",
        fmax=f"fmax{real.function_suffix}",
        tiny=plain.target.literal(1e-30),
        nudge=plain.target.literal(sqrt(real.epsilon)),
        newton=any(m.newton for m in methods),
        slopes=CFunction(
            f"{plain.prefix}_differences",
            plain.status,
            (c.filled(plain.real, "slopes"), *plain.usual(*plain.state, "u", "p")),
            qualifier="static",
        ),
        here=accelerate(qdd="here"),
        near=accelerate(qdd="near", q="x", qd="x + NQ"),
    )


def _gauss(plain: Plain, m: Method) -> Gauss:
    """A method of Gauss and Legendre."""
    accelerate = plain.acceleration.function.call
    method = f"{plain.prefix}_{m.name}"
    around = plain.usual(*plain.state, "h", "u", "p")
    shared = implicit(plain, [m])
    stages = CFunction(
        f"{method}_stages",
        plain.status,
        (
            *(c.filled(plain.real, name) for name in ("f", "q_mid", "qd_mid")),
            c.given(plain.real, "a"), *around,
        ),
        qualifier="static",
    )  # fmt: skip
    matrix = CFunction(
        f"{method}_matrix",
        plain.status,
        (c.filled(plain.real, "M"), c.filled("int", "row"), *around),
        qualifier="static",
    )
    one = step(plain, m)
    count = CArgument("long *", "evaluations")
    solve = CFunction(method, plain.status, (*one.arguments, count), qualifier="static")
    return Gauss(
        prefix=plain.prefix,
        PREFIX=plain.PREFIX,
        real=plain.real,
        title=m.title,
        method=method,
        newton=m.newton,
        sweeps=SWEEPS[m.newton],
        stages=m.stages,
        c=_numbers(plain, m.c),
        A=_matrix(plain, m.a),
        AA=_matrix(plain, m.a_squared),
        b=_numbers(plain, rounded(m.b, plain.target.real)),
        bA=_numbers(plain, m.b_a),
        eps=plain.target.literal(plain.target.real.epsilon),
        tenth=plain.target.literal(0.1),
        half=plain.target.literal(0.5),
        stages_function=stages,
        matrix=matrix,
        about=_about(m),
        solve=solve,
        step=one,
        stage=accelerate(qdd="f + NQ*i", q="r", qd="v", t=f"t + {method}_c[i]*h"),
        slopes_call=shared.slopes.call(),
        start=accelerate(qdd="a"),
        sweep=stages.call(),
        matrix_start=matrix.call(),
        matrix_mid=matrix.call(q="q_mid", qd="qd_mid", t="t + h/2"),
        solve_call=solve.call(evaluations="&evaluations"),
    )


def loop(plain: Plain, m: Method) -> Loop:
    """The view of a method's step, run and batch."""
    target, real = plain.target, plain.real
    has_u, P, NQ = bool(target.system.inputs), plain.prefix, plain.NQ
    state = (c.filled(real, "q", NQ), c.filled(real, "qd", NQ))
    t0 = (CArgument(real, "t0"),) if target.driven else ()
    h, first, steps = CArgument(real, "h"), CArgument("long", "first"), CArgument("long", "steps")
    rows = (CArgument("long", "every"), c.filled(real, "q_rows"), c.filled(real, "qd_rows"))
    u, p = plain.usual("u"), plain.usual("p")
    strides = [CArgument("long", n) for n in ("u_stride", "u_instance", "u_step", "p_instance")]
    count, row_count = CArgument("long", "count"), CArgument("long", "row_count")
    memory = CArgument(f"{P}_{m.name}_memory *", "memory")
    status = CArgument(f"{plain.status} *", "status")
    held = strides[:1] if has_u else []
    run = CFunction(
        f"{P}_{m.name}_run", "long",
        (*state, *t0, h, first, steps, *u, *held, *rows, *p, memory, status),
    )  # fmt: skip
    batch = CFunction(
        f"{P}_{m.name}_batch",
        "void",
        (
            count, c.filled(real, "q"), c.filled(real, "qd"), *t0, h, first, steps, *u,
            *(strides[1:3] if has_u else []), *rows, row_count, *p,
            *(strides[3:] if target.needs_p else []),
            CArgument("long *", "done"), CArgument("int *", "status"),
        ),
    )  # fmt: skip
    one = stepper(plain, m)
    advance = one.solve if isinstance(one, Gauss) else one.step
    return Loop(
        prefix=P,
        PREFIX=plain.PREFIX,
        real=real,
        implicit=m.implicit,
        run=run,
        batch=batch if target.system.run.batch else None,
        one_step=advance.call(t=f"t0 + ({real})(first + n)*h", u="u ? u + u_stride*n : 0"),
        run_one=run.call(
            q=f"q + {NQ}*k", qd=f"qd + {NQ}*k", u="u ? u + u_instance*k : 0", u_stride="u_step",
            q_rows="to_q", qd_rows="to_qd", p="p + p_instance*k", memory="0", status="&found",
        ),
    )  # fmt: skip
