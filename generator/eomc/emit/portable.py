"""Portable C, strict C99 for any compiler: integration methods and files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from eomc.emit.common import adaptive, solver
from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import Real
from eomc.emit.common.c_function import CArgument, CFunction
from eomc.emit.common.functions import SceneFunctions, portable_functions
from eomc.emit.common.solver import SolverModel, step_derivatives
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import RK4, Method
from eomc.program.program import Program


def files(
    program: Program, real: Real | None = None, written: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the header and the source of a program in portable C, as texts by file name.

    real: the C type of numbers; by default that of the scene. written: names in the scene of names
    that differ in C.
    """
    functions = portable_functions(program, real, written)
    name = functions.prefix
    model = solver.portable_model(functions)
    texts = [*solver.projected_step_source(model), *solver.state_source(model)]
    for m in functions.methods:
        texts += [*(solver.step_source(model, m) if m is not RK4 else ()), step(model, m)]
    texts += [*step_derivatives(model), *solver.run_adjoints(model), *_runs(model)]
    corrections = [f.text for f in (functions.projection, functions.rate_terms) if f]
    texts[:0] = [*corrections, *functions.constraint_texts, *model.source(texts)]
    steps = list(dict.fromkeys(text.rstrip("\n") for text in texts))  # methods share definitions
    source = show("c/portable/source.c", functions, steps=steps)
    contents = {f"{name}.h": adaptive.header(functions), f"{name}.c": source}
    return {file: c.break_long_lines(text) for file, text in contents.items()}


def step(model: SolverModel, m: Method) -> str:
    """Return the C function for one step by an integration method."""
    advance = step_advance(model, m)
    shared = {"model": model, "method": m, "advance": advance}
    if m is not RK4:
        return show("c/portable/step.c", model.functions, **shared)
    correct = solver.project_end(model, "r", "v", "q", "t + h") if advance.qualifier else ""
    return show("c/portable/rk4.c", model.functions, **shared, correct=correct)


def step_advance(model: SolverModel, m: Method) -> CFunction:
    """Return the C function for a step that reports singular configurations of constraints."""
    functions = model.functions
    if m is not RK4:
        return solver.step_advance(model, m)
    step = functions.public.step(m.name)
    if not functions.projection:
        return step
    arguments = (*step.arguments, CArgument("int *", "singular"))
    return c.static_prototype(f"{functions.prefix}_{m.name}", functions.status, *arguments)


def _make_step(functions: SceneFunctions, advances: Mapping[str, CFunction]) -> CFunction:
    """Return the prototype of the C function that makes a step by a method, or the only method's.

    advances: the functions that make a step, by the name of the method.
    """
    if len(advances) == 1:
        return next(iter(advances.values()))
    public = functions.public
    return c.static_prototype(
        f"{functions.prefix}_make_step", functions.status, *public.step("make").arguments,
        CArgument(public.method_type, "method"), c.output_array("long", "evaluations"),
        *((CArgument("int *", "singular"),) if functions.projection else ()),
    )  # fmt: skip


def _runs(model: SolverModel) -> Iterator[str]:
    """Yield the library's part of adaptive steps and events, then the functions for runs."""
    functions = model.functions
    advances = {m.name: step_advance(model, m) for m in functions.methods}
    if functions.target.integrates:
        yield from adaptive.library_texts(model)
    make = _make_step(functions, advances)
    yield show("c/portable/run.c", functions, model=model, advances=advances, make=make)
    if functions.target.integrates:
        yield adaptive.integrate(model)
    if functions.target.system.run.batch:
        yield show("c/integrate_batch.c", functions, in_parallel=False)
