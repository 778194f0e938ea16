"""Derivatives of steps with respect to q, q̇ and u, in both forms of C."""

from __future__ import annotations

from collections.abc import Iterator

from eomc.emit.common import c_function as c
from eomc.emit.common.amalgamate import amalgamate
from eomc.emit.common.c_expression import Block
from eomc.emit.common.solver import (
    SolverModel,
    define,
    library_names,
    method_kind,
    tableau_tables,
)
from eomc.integrators.tableaux import Method


def step_derivatives(model: SolverModel) -> Iterator[str]:
    """Yield C definitions of the derivatives of a step of each integration method.

    The derivatives are with respect to q, qd and u. Nothing is yielded if the scene does not
    request them. Methods share definitions.
    """
    functions, target = model.functions, model.functions.target
    if not target.system.run.discretize:
        return
    inputs = bool(target.system.inputs)
    features = {
        "INPUTS": inputs,
        "FEEDBACK": "signal_slopes" in target.program,
        "CONSTRAINTS": functions.projection_along is not None,
    }
    width = f"2*{functions.NQ}" + (f" + {functions.NU}" if inputs else "")
    exact = {"EOM_VARIABLES": width}
    if model.has_sweep:  # whose accelerations take precomputed constants
        exact["eom_accelerate"] = f"{functions.prefix}_evaluate_accelerations"
    for method in functions.methods:
        kind = "implicit" if method.implicit else "explicit"
        tables = (f"eom_{method_kind(method)}_{name}" for name in ("c", "A", "AA", "b", "bA"))
        yield from amalgamate(
            ("step_end.c", "step_derivative.c"),
            [f"eom_method_differentiate_{kind}_step", "eom_store_derivatives", *tables],
            library_names(model, method, **exact),
            features,
            tableau_tables(functions, method),
        )
        yield _derivative(model, method, width)


def _derivative(model: SolverModel, method: Method, width: str) -> str:
    """Return the definition of the public function for the derivatives of a step of a method.

    width: number of variables in q, qd and u, as a C expression.
    """
    functions, prefix = model.functions, f"{model.functions.prefix}_{method.name}"
    function = functions.public.derivative(method.name)
    NQ, real = functions.NQ, functions.real
    # the end of the step itself, with which stages that may have other solutions are compared
    compares = method.implicit or functions.projection_along is not None
    end, time = ("q1", "qd1") if compares else (), "t" if functions.target.driven else "0"
    step = f"{prefix}_make_step({', '.join([*end, time, 'h', *model.passed])})"
    make_step = (*c.copy_loop("q1", "q", 0, NQ), *c.copy_loop("qd1", "qd", 0, NQ),
                 c.assign("status", step), *c.return_if(["status"], "status"))  # fmt: skip
    call = model.call(
        f"{method.name}_differentiate_{'implicit' if method.implicit else 'explicit'}_step",
        "ends", *end, "q", "qd", time, "h",
    )  # fmt: skip
    out = [a.name for a in function.arguments if a.name in ("Phi", "Gamma")]
    store = f"{functions.prefix}_store_derivatives({', '.join([*out, 'ends'])})"
    unused = {a.name: "0" for a in model.members if a.name == "c"}
    variables = (
        *model.variable(**unused).lines,
        c.declare(functions.status, "status"),
        c.declare(real, f"ends[2*{NQ}*({width})]"),
        *(c.declare(real, f"{name}[{NQ}]") for name in end),
    )
    statements = (
        *(make_step if compares else ()), c.assign("status", call),
        c.return_statement(f"status ? status : {store}"),
    )  # fmt: skip
    return define(function, Block("", variables), Block("", statements))
