"""Projection onto the constraints: the library's part of the C source, and what it calls."""

from __future__ import annotations

from itertools import accumulate

from eomc.emit.common import c_function as c
from eomc.emit.common.amalgamate import amalgamate
from eomc.emit.common.c_expression import Block
from eomc.emit.common.c_function import define_int_table, define_table, initialiser_rows
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.solver import SolverModel, define, library_names


def correction_size(target: Target) -> int:
    """Return the number of results of the C function that computes corrections for constraints.

    The results are the corrections that move q and qd onto the constraints, and one inverse pivot
    for each constraint equation.
    """
    return len(target.program["projection"].outputs)


def step_features(functions: SceneFunctions, increments: bool, sines: bool) -> dict[str, bool]:
    """Return which features of csrc/solver/step_projection.c a model has.

    increments: whether the end of a step is given by the increments of q and q̇. sines: whether the
    correction takes sines and cosines.
    """
    return {
        "INCREMENTS": increments,
        "SINES": sines,
        "RATE_TERMS": "rate_terms" in functions.target.program,
        "SINGLE": functions.target.system.run.real == "float",
    }


def step_source(model: SolverModel) -> tuple[str, ...]:
    """Return the projection of steps and of their stages onto the constraints, in portable C."""
    functions = model.functions
    if functions.projection is None:
        return ()
    size = str(correction_size(functions.target))
    return amalgamate(
        ("step_projection.c",),
        ["eom_project_end", *(["eom_project_stage"] if functions.iterates_stages else [])],
        library_names(model, EOM_CORRECTION_SIZE=size),
        step_features(functions, increments=False, sines=False),
    )


def project_end(model: SolverModel, r: str, v: str, q: str, t: str) -> str:
    """Return the C call that projects the end r, v of a step from q, in portable C.

    t: C expression of the time at the end, for a motion that depends on time.
    """
    time = t if model.functions.target.driven else "0"
    return model.call("project_end", r, v, q, time, last=["singular"])


def state_source(model: SolverModel) -> tuple[str, ...]:
    """Return the public function `project` and its part of the library, as C definitions.

    The function projects a state (q, qd) onto the constraints.
    """
    functions = model.functions
    rows, closure = functions.target.system.constraints, functions.target.system.closure
    if not rows:
        return ()
    rotations = functions.target.system.rotations if functions.rotation_errors else ()
    holonomic = sum(row.holonomic for row in rows)
    sizes = {
        "EOM_HOLONOMIC_ROWS": holonomic,
        "EOM_SUMS": len(closure.sums) if closure else 0,
        "EOM_ROTATIONS": len(rotations),
        "EOM_ROTATION_ROWS": sum(map(len, rotations)),
    }
    weighted = bool(closure and closure.weights)
    features = {
        "HOLONOMIC": bool(holonomic),
        "MULTIPLE": len(rows) > 1,
        "SEARCH": any(row.holonomic and row.loop for row in rows),
        "ROTATIONS": bool(rotations),
        "WEIGHTS": weighted,
        "SUMS": bool(closure and closure.sums),
        "REDUNDANT": any(redundant_rows(functions.target)),
        "PINNED": weighted and holonomic < len(rows),
    }
    public = functions.public.project
    time = "t" if any(a.name == "t" for a in public.arguments) else "0"
    call = model.call("project_state", "q", "qd", time, "fixed")
    unused = {a.name: "0" for a in model.members if a.name != "p"}
    return (
        *amalgamate(
            ("projection.c",),
            ["eom_project_state"],
            library_names(model, None, **{name: str(size) for name, size in sizes.items()}),
            features,
            _tables(functions),
        ),
        define(public, model.variable(**unused), Block("", (c.return_statement(call),))),
    )


def redundant_rows(target: Target) -> list[bool]:
    """Return whether each constraint equation is redundant, since others or their sums imply it."""
    rows, closure = target.system.constraints, target.system.closure
    summed = summed_rows(target)[len(closure.sums) if closure else 0 :]
    return [row.redundant or k in summed for k, row in enumerate(rows)]


def summed_rows(target: Target) -> list[int]:
    """Return the indices of the constraint equations in sums that replace some of them."""
    closure = target.system.closure
    return sorted({k for row in (closure.sums if closure else ()) for k, x in enumerate(row) if x})


def _tables(functions: SceneFunctions) -> list[str]:
    """Return tables of the constraint equations: weights, sums, redundant ones, and rotations."""
    target = functions.target
    closure, count = target.system.closure, len(target.system.constraints)
    weights, sums = (closure.weights, closure.sums) if closure else ((), ())
    rotations = target.system.rotations if functions.rotation_errors else ()
    integers = {
        "sum_rows": summed_rows(target)[: len(sums)],
        "redundant_rows": [*map(int, redundant_rows(target))],
        "rotation_rows": [k for rows in rotations for k in rows],
        "rotation_ends": [*accumulate(map(len, rotations))],
    }
    sum_lines = initialiser_rows([*map(target.literal, row)] for row in sums)
    return [
        define_table("eom_row_weights", [count], [", ".join(map(target.literal, weights))]),
        define_table("eom_row_sums", [len(sums), count], sum_lines),
        *(define_int_table(f"eom_{name}", values) for name, values in integers.items() if values),
    ]
