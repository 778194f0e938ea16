"""Derivatives of accelerations and of steps with respect to q, q̇ and u, in both forms of C."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

from eomc.emit import c_function as c
from eomc.emit.c_function import CFunction, GeneratedFunction
from eomc.emit.c_names import cost_sentence
from eomc.emit.coefficients import TableauFields, tableau
from eomc.emit.functions import SceneFunctions
from eomc.emit.projection import ZERO_SQUARE, large_correction_limit
from eomc.emit.public import program_function
from eomc.emit.views import NameFields
from eomc.integrators.tableaux import METHODS

MAX_NEWTON_ITERATIONS = 50  # for the stages


@dataclass(frozen=True)
class LinearizationView(NameFields):
    """Data for c/linearization.c: derivatives of the accelerations by q, q̇ and u.

    Attributes
    ----------
    inputs
        Whether the scene has inputs u.
    width
        Length of one row [da/dq, da/dqd, da/du], as a C expression.
    slopes
        The static function that computes all rows.
    linearization
        Prototype of the public function, which splits the rows into A_q, A_qd and B.
    unread
        Names of arguments of the public function that its body does not use.
    signal_call, slopes_call
        C calls of the scene's signals for u ("" if they are not needed) and of `slopes`.
    """

    TEMPLATE: ClassVar[str] = "c/linearization.c"
    inputs: bool
    width: str
    slopes: GeneratedFunction
    linearization: CFunction
    unread: tuple[str, ...]
    signal_call: str
    slopes_call: str


@dataclass(frozen=True)
class DerivativeView(NameFields, TableauFields):
    """Data for c/derivative.c: a C function for the derivatives of one step.

    They are the derivatives of q and q̇ at the end of the step with respect to q, q̇ and u at its
    start.

    Attributes
    ----------
    inputs, width
        Whether there are inputs u, and the number of variables in q, q̇ and u, as a C expression.
    rates, eliminate, projection
        C functions that all methods share, so that only one method prints them: the derivatives of
        the accelerations (None for the other methods), Gaussian elimination (whether it is
        printed), and the correction onto the constraints with its directional derivative (or None).
    linearization, feedback
        C calls of the derivatives of the accelerations, and of the derivatives of the signals, the
        scene's formulas for inputs ("" if the signals do not depend on the state).
    moved, projection_call, move
        For scenes with constraints: the function that projects the end of a step and its
        derivatives onto the constraints, the call of `projection` in it, and the call of `moved`.
    near, scale_floor
        Tolerances of that correction, as in `ProjectionView`.
    function, implicit, stages
        Prototype of the function, whether the method is implicit, and its number of stages.
    step, start, stage, rates_call
        C calls of the step, of the accelerations at its start and at a stage, and of `rates`.
    converged, tolerance
        Largest relative correction of velocities with which the stages of an implicit method are
        accepted: in general, and when Newton's iteration does not reduce it further.
    other
        Largest relative difference between the end of the step itself and the end that follows from
        the stages computed here; if it is exceeded, the function fails.
    most
        Largest number of Newton iterations.
    """

    TEMPLATE: ClassVar[str] = "c/derivative.c"
    inputs: bool
    width: str
    rates: CFunction | None
    linearization: str
    feedback: str
    eliminate: bool
    projection: GeneratedFunction | None
    moved: CFunction | None
    projection_call: str
    move: str
    near: str
    scale_floor: str
    function: CFunction
    implicit: bool
    stages: int
    step: str
    start: str
    stage: str
    rates_call: str
    fabs: str
    fmax: str
    tiny: str
    converged: str
    tolerance: str
    other: str
    most: int


# --- the derivatives of the accelerations ---------------------------------------------------------


def linearization(functions: SceneFunctions) -> LinearizationView | None:
    """Return the template data for the derivatives of the accelerations q̈.

    The derivatives are A_q = ∂q̈/∂q, A_qd = ∂q̈/∂q̇ and B = ∂q̈/∂u. Return None if the program does
    not contain them. functions: the C functions of the scene.
    """
    target = functions.target
    function = program_function(target, "linearization")
    if function is None:
        return None
    NQ, inputs = functions.NQ, bool(target.system.inputs)
    width = f"2*{NQ} + {functions.NU}" if inputs else f"2*{NQ}"
    cost, doc = cost_sentence(function), "[da/dq, da/dqd, da/du] at constant inputs, by rows."
    if "linearization" in target.program:
        slopes = functions.static(function, "slopes", "slopes", doc, fails=True)
    else:
        column = "[da/dq, da/dqd, da/du] times along."
        one = functions.static(function, "slopes_column", "column", column, fails=True)
        along = ("column", "along")
        arguments_ = tuple(a for a in one.function.arguments if a.name not in along)
        loop_function = replace(
            one.function,
            name=f"{functions.prefix}_slopes",
            result=functions.status,
            body=(),
            doc=(doc,),
            arguments=(c.output_array(functions.real, "slopes"), *arguments_),
        )  # fmt: skip
        slopes = GeneratedFunction(
            loop_function, (*one.parts, one.function), one.values, one.function.call()
        )
        cost = f"By {width} columns, each: {cost[0].lower()}{cost[1:]}"
    arguments = functions.arguments(*functions.state, "u", "p")
    arguments_read = functions.arguments_read(function)
    reads_u = functions.reads_u(function) and functions.signal is not None
    return LinearizationView(
        **functions.names,
        inputs=inputs,
        width=width,
        slopes=slopes,
        linearization=replace(functions.public.linearization, doc=(cost,)),
        unread=tuple(a.name for a in arguments if a.name not in arguments_read),
        signal_call=functions.signal.call(u="now") if reads_u and functions.signal else "",
        slopes_call=slopes.function.call(),
    )


def step_derivatives(functions: SceneFunctions) -> Iterator[DerivativeView]:
    """Yield, for each integration method, the data for the template of the derivatives of a step.

    The derivatives are with respect to q, qd and u. Nothing is yielded if the scene does not
    request them. The first method's data include the C functions that all methods share.

    functions: the C functions of the scene.
    """
    target, real = functions.target, functions.target.real
    run = target.system.run
    if not run.discretize:
        return
    inputs, suffix = bool(target.system.inputs), real.function_suffix
    state = functions.arguments("q", "qd", *functions.state[2:], "u", "p")
    J = c.output_array(functions.real, "J")
    rates = c.static_prototype(f"{functions.prefix}_stage_slopes", functions.status, J, *state)
    feedback = ""
    if "signal_slopes" in target.program:
        feedback = functions.public.evaluation("signal_slopes").call(slopes="K")
    accelerate = functions.acceleration.function.call
    projection = functions.projection_along
    projected = _project_derivatives(functions) if projection else None
    methods = [METHODS[name] for name in run.methods]
    first_implicit = next((m for m in methods if m.implicit), None)
    for m in methods:
        yield DerivativeView(
            **functions.names,
            inputs=inputs,
            width=f"2*{functions.NQ} + {functions.NU}" if inputs else f"2*{functions.NQ}",
            rates=rates if m is methods[0] else None,
            linearization=functions.public.linearization.call(),
            feedback=feedback,
            eliminate=m is first_implicit,
            projection=projection if m is methods[0] else None,
            moved=projected,
            projection_call=projection.function.call(q="r", qd="v") if projection else "",
            move=projected.call(X="ends", t="t + h") if projected else "",
            near=target.literal(large_correction_limit(target)),
            scale_floor=target.literal(ZERO_SQUARE),
            function=functions.public.derivative(m.name),
            implicit=m.implicit,
            stages=m.stages,
            **tableau(m, real),
            step=functions.public.step(m.name).call(q="at", qd="moving"),
            start=accelerate(qdd="a"),
            stage=accelerate(qdd="f" if m.implicit else "a + NQ*i", q="r", qd="v", t="t + c[i]*h"),
            rates_call=rates.call(q="r", qd="v", t="t + c[i]*h"),
            fabs=f"fabs{suffix}",
            fmax=f"fmax{suffix}",
            tiny=target.literal(1e-30),
            converged=target.literal(16 * real.epsilon),
            tolerance=target.literal(real.epsilon**0.5),
            other=target.literal(real.epsilon**0.25),
            most=MAX_NEWTON_ITERATIONS,
        )


def _project_derivatives(functions: SceneFunctions) -> CFunction:
    """Return the static function that projects the end of a step, and its derivatives."""
    state = (
        c.output_array(functions.real, "X"),
        *(c.output_array(functions.real, n) for n in "rv"),
    )
    arguments_read = functions.arguments_read(functions.target.program["projection_along"])
    other_arguments = (
        functions.argument("q"),
        *functions.arguments(*(n for n in ("t", "p") if n in arguments_read)),
    )
    return c.static_prototype(
        f"{functions.prefix}_derivative_projected", functions.status, *state, *other_arguments
    )
