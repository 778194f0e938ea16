"""Views of the files besides both forms of C: example, binding and Python package."""

from __future__ import annotations

import math
import textwrap

from eomc.base.texts import FreeText
from eomc.emit import adaptive
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_function import cast, member
from eomc.emit.c_names import Target
from eomc.emit.evaluations import KINDS, refuses, takes_qdd
from eomc.emit.heading import stamp, words
from eomc.emit.public import Public
from eomc.emit.views import (
    Binding,
    Bound,
    BoundAdaptive,
    BoundMethod,
    Declarations,
    Face,
    Main,
    Named,
    Stub,
)
from eomc.integrators.tableaux import METHODS
from eomc.runtime.package import CONSTRAINED
from eomc.scene.formulas import fold_values, parse

_OF_STEPS = ("Phi", "Gamma")
ROWS = 200  # approximate number of rows that main.c prints
LINE = 88  # width of the column names there
FUNCTIONS = (
    "C D acceleration advice applied bias discretize energy equilibrium g jacobi kinetic_energy "
    "limits linearize load_run output potential_energy power rhs sensitivity signal simulate "
    "simulate_batch step step_batch tau"
).split()
OPTIONAL = {  # functions by the option that brings them
    "frames": ("pose", "frame_velocity", "frame_acceleration", "jacobian", "frame_forces"),
    "inverse_dynamics": ("inverse_dynamics", "drive_forces"),
    "momentum": ("momentum",),
}


def main(target: Target) -> Main:
    """Return the data for main.c, an example program that simulates the scene.

    The program prints about 200 lines.
    """
    s, public = target.system, Public(target)
    steps = max(1, math.ceil(s.run.duration / s.run.h * (1 - 1e-12)))
    names = [target.as_written(c.name) for c in s.coordinates]
    method, output_names = s.run.methods[0], [o.name for o in s.outputs]
    columns = ", ".join(("t", *names, *(f"{n}_dot" for n in names), *output_names, "energy"))
    outputs = public.evaluation("outputs").call(u="NULL") if output_names else ""
    solved = output_names and takes_qdd(target, "outputs")
    rows = {"q_rows": "NULL", "qd_rows": "NULL", "memory": "&memory", "status": "&status"}
    if s.run.tolerance is None:
        run = public.run(method).call(
            t0="0", first="n", steps="next", u="NULL", u_stride="0", every="0", **rows
        )
    else:
        method, limits = f"{adaptive.METHOD.name}_adaptive", {"t_end": "next", "h_most": "0"}
        run = public.adaptive(adaptive.METHOD.name).call(
            t="&t", **limits, u="NULL", steps="1000000", times="NULL", count="0", t_rows="NULL",
            room="0", events="NULL", which="NULL", event_rows="NULL", **rows,
        )  # fmt: skip
    return Main(
        title=FreeText(s.title),
        stamp=tuple(stamp(target)),
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        has_p=target.needs_p,
        method=method,
        adaptive=s.run.tolerance is not None,
        rows=ROWS,
        t_end=target.literal(s.run.duration),
        tolerance=target.literal(s.run.tolerance or 0.0),
        events=bool(s.events),
        h=target.literal(s.run.h),
        steps=steps,
        every=max(1, steps // ROWS),
        columns=tuple(line.replace(" ", "") for line in textwrap.wrap(columns, LINE)),
        run=run,
        energy=public.evaluation("energy").call(),
        outputs=outputs,
        accelerations=public.acceleration.call(u="NULL") if solved else "",
        refuses=bool(output_names and refuses(target, "outputs")),
    )  # fmt: skip


def _bound(target: Target) -> tuple[Bound, ...]:
    """Return the evaluation functions for the Python binding, with their C calls for state k."""
    state_arguments, bindings = _rows(target), []
    for function in Public(target).evaluations():
        name = function.name.removeprefix(f"{target.prefix}_")
        kind = KINDS[name]
        extents = {a.name: a.extent for a in function.arguments}
        rows = {kind.out: f"out + {extents[kind.out]}*k"} if kind.out else {}
        if kind.extra_argument:  # passed in place of the inputs
            rows[kind.extra_argument] = f"u + {member('own', 'u')}*k"
        call = function.call(**(state_arguments | rows))
        solve = (
            Public(target).acceleration.call(**state_arguments) if takes_qdd(target, name) else ""
        )
        # functions for SciPy's LowLevelCallable take doubles only
        state_only = not kind.out and target.real is DOUBLE and not {"t", "u", "qdd"} & set(extents)
        at_x = function.call(q="x", qd=f"x + {target.PREFIX}_NQ", p=_parameters(target))
        text = call if kind.out else f"out[k] = {call}"
        size = extents[kind.out] if refuses(target, name) else ""
        bindings.append(Bound(name, text, solve, at_x if state_only else "", size))
    return tuple(bindings)


def _parameters(target: Target, place: str = "p") -> str:
    """Return the C expression `place`, an array of numbers, cast to the struct of parameters.

    Returns "" if the scene has no parameters.
    """
    return cast(f"{target.prefix}_params", place) if target.needs_p else ""


def _rows(target: Target) -> dict[str, str]:
    """Return the C arguments q, qd, t, u and p for the state with index k, by name.

    The binding's arrays have one row for each state; t, u and p may be the same for all.
    """
    NQ = f"{target.PREFIX}_NQ"
    return {
        "q": f"q + {NQ}*k",
        "qd": f"qd + {NQ}*k",
        "t": f"{member('own', 't')} ? {member('own', 't')}[k] : t",
        "u": f"u ? u + {member('own', 'u')}*k : u",
        "p": _parameters(target, f"(p + {member('own', 'p')}*k)"),
    }


def _methods(target: Target) -> tuple[BoundMethod, ...]:
    """Return the C calls for step, run, batch and derivative of each integration method in the
    binding.
    """
    public, p, NQ = Public(target), _parameters(target), f"{target.PREFIX}_NQ"
    memory = f"work ? &{member('work', 'memory')} : NULL"
    return tuple(
        BoundMethod(
            name,
            METHODS[name].implicit,
            public.step(name).call(q="at", qd="moving", p=p),
            public.run(name).call(
                u="u ? u + first*u_stride : u", q_rows=f"q_rows + {NQ}*(row + 1)",
                qd_rows=f"qd_rows + {NQ}*(row + 1)", p=p, memory=memory,
                status="&result",
            ),
            public.batch(name).call(
                count="many", q=f"q + {NQ}*base", qd=f"qd + {NQ}*base", t0="t[t_instance*base]",
                u="u ? u + u_instance*base : u",
                q_rows=f"q_rows ? q_rows + {NQ}*row_count*base : q_rows",
                qd_rows=f"qd_rows ? qd_rows + {NQ}*row_count*base : qd_rows",
                p=f"{p} + p_instance*base", completed="completed + base", status="status + base",
            ),
            *(_derivative(target, name) if target.system.run.discretize else ("", "", "")),
        )
        for name in target.system.run.methods
    )  # fmt: skip


def _adaptive(target: Target) -> BoundAdaptive | None:
    """Return the data for adaptive steps in the binding; None if the scene has no tolerance."""
    if target.system.run.tolerance is None:
        return None
    run = Public(target).adaptive(adaptive.METHOD.name)
    call = run.call(
        q="x", qd=f"x + {target.PREFIX}_NQ", p=_parameters(target), status="&result",
        memory=f"&{member('work', 'memory')}", events=f"&{member('work', 'events')}",
    )  # fmt: skip
    many = Public(target).adaptive_batch(adaptive.METHOD.name).call(p=_parameters(target))
    return BoundAdaptive(f"{run.name}_memory", call, bool(target.system.events), many)


def _derivative(target: Target, method: str) -> tuple[str, str, str]:
    """Return three C calls for the derivatives of several steps from the state with index k.

    They compute the derivatives of the first step, make the next step, and compute its derivatives.
    """
    function, rows = Public(target).derivative(method), _rows(target)
    out = {a.name: f"{a.name} + {a.extent}*k" for a in function.arguments if a.name in _OF_STEPS}
    later = rows | {"q": "at", "qd": "moving"}
    before, now = later, later
    if target.driven:
        before = later | {"t": f"({rows['t']}) + (step - 1)*h"}
        now = later | {"t": f"({rows['t']}) + step*h"}
    return (
        function.call(**rows, **out),
        Public(target).step(method).call(**before),
        function.call(**now, Phi="A", Gamma="B"),
    )


def binding(target: Target) -> Binding:
    """Return the data for the Python binding, C functions that Python calls.

    All functions have the same signature, and each evaluates many states in one call.
    """
    public, at, NQ = Public(target), _rows(target), f"{target.PREFIX}_NQ"
    linear = public.linearization
    matrices = {a.name: f"{a.name} + {a.extent}*k" for a in linear.arguments if a.name[0] in "AB"}
    return Binding(
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        evaluations=_bound(target),
        acceleration=public.acceleration.call(qdd=f"out + {NQ}*k", **at),
        project=public.project.call(**at) if target.system.constraints else "",
        linearization=linear.call(**at, **matrices) if _linearized(target) else "",
        batch=target.system.run.batch,
        methods=_methods(target),
        adaptive=_adaptive(target),
        parameter_count=len(target.system.parameters),
        input_count=len(target.system.inputs),
        timed=any(a.name == "t0" for a in public.batch(target.system.run.methods[0]).arguments),
    )


def _linearized(target: Target) -> bool:
    """Return True if the program has a linearization."""
    return bool({"linearization", "linearization_column"} & set(target.program.functions))


def declarations(bound: Binding) -> Declarations:
    """Return the data for the C declarations from which cffi makes the Python binding."""
    return Declarations(
        bound.real, bound.evaluations, bound.project, bound.linearization, bound.batch,
        bound.methods, bound.adaptive,
    )  # fmt: skip


def _functions(target: Target) -> tuple[str, ...]:
    """Return the sorted names of the model's public functions in the Python package."""
    s, run = target.system, target.system.run
    functions = [n for n in FUNCTIONS if run.batch or not n.endswith("_batch")]
    functions += CONSTRAINED if s.constraints else ()
    functions += ["reactions"] if s.reactions else ()
    functions += [n for key, names in OPTIONAL.items() if getattr(run, key) for n in names]
    return tuple(sorted(functions))


def stub(target: Target) -> Stub:
    """Return the data for the type stubs of the Python package."""
    return Stub(tuple(stamp(target)), target.system.run.batch, _functions(target))


def start_formulas(target: Target) -> dict[str, str]:
    """Return the formulas of those initial values that depend on parameters.

    They are given by the name of a coordinate (`theta`) or velocity (`theta_dot`) in the scene.
    Parameters that state jumps change are replaced by their values.
    """
    s, written = target.system, target.as_written
    set_by_jumps = {written(c.name): c.start for c in s.coordinates if c.name in s.discrete}
    return {
        f"{written(c.name)}{end}": fold_values(parse(text), set_by_jumps)
        for c in s.coordinates
        for end, text in (("", c.follows), ("_dot", c.rate_follows))
        if text
    }


def face(target: Target, extension: str) -> Face:
    """Return the data for the __init__.py of the Python package.

    extension: name of the compiled extension module, which it imports.
    """
    s, written = target.system, target.as_written
    units = {c.name: c.unit for c in s.coordinates} | {p.name: p.unit for p in s.parameters}
    units |= {i.name: i.unit for i in s.inputs} | {o.name: o.unit for o in s.outputs}
    return Face(
        title=FreeText(s.title),
        stamp=tuple(stamp(target)),
        prefix=target.prefix,
        extension=extension,
        digest=s.digest,
        dtype=target.real.dtype,
        coordinates=tuple(Named(written(c.name), words(c.unit, c.note)) for c in s.coordinates),
        parameters=tuple(
            Named(written(p.name), words(p.unit, p.note), repr(p.value)) for p in s.parameters
        ),
        inputs=tuple(Named(written(i.name), words(i.unit, i.note)) for i in s.inputs),
        outputs=tuple(Named(o.name, words(o.unit, o.note)) for o in s.outputs),
        coordinate_units=FreeText({written(c.name): c.unit for c in s.coordinates}),
        parameter_values={written(p.name): p.value for p in s.parameters},
        input_units=FreeText({written(i.name): i.unit for i in s.inputs}),
        output_units=FreeText({o.name: o.unit for o in s.outputs}),
        frames=tuple(f.name for f in s.output_frames),
        plane=bool(s.plane and (s.output_frames or s.run.momentum or s.reactions)),
        units=FreeText({written(name): unit for name, unit in units.items() if unit}),
        start=([c.start for c in s.coordinates], [c.rate for c in s.coordinates]),
        follows=FreeText(start_formulas(target)),
        h=s.run.h,
        duration=s.run.duration,
        tolerance=s.run.tolerance,
        events=tuple(e.name for e in s.events),
        constraints=tuple(c.name for c in s.constraints),
        fixed=(*(c.start_fixed for c in s.coordinates), *(c.rate_fixed for c in s.coordinates)),
        holonomic=sum(c.holonomic for c in s.constraints),
        redundant=tuple(k for k, c in enumerate(s.constraints) if c.redundant),
        modes=tuple((m.at, m.of) for m in s.modes),
        discrete=len(s.discrete),
        reactions=tuple(r.name for r in s.reactions),
        batch=s.run.batch,
        methods=tuple(METHODS[name] for name in s.run.methods),
        functions=_functions(target),
        optional=tuple(x for x in OPTIONAL.items() if not getattr(s.run, x[0])),
        from_python=s.scene is None,
    )
