"""Functions for the derivatives of a step with respect to q, qd and u, in both forms of C."""

from __future__ import annotations

from collections.abc import Iterator

from eomc.emit import c_function as c
from eomc.emit.c_function import CFunction
from eomc.emit.coefficients import tableau
from eomc.emit.functions import Functions
from eomc.emit.portable.views import Derivative
from eomc.emit.projection import ZERO_SQUARE, near
from eomc.integrators.tableaux import METHODS

MAX_NEWTON_ITERATIONS = 50  # for the stages


def derivatives(plain: Functions) -> Iterator[Derivative]:
    """Yield, for each integration method, the data for the template of the derivatives of a step.

    The derivatives are with respect to q, qd and u. Nothing is yielded if the scene does not
    request them. The first method's data include the C functions that all methods share. `plain`
    has the C functions in portable form.
    """
    target, real = plain.target, plain.target.real
    run = target.system.run
    if not run.discretize:
        return
    inputs, suffix = bool(target.system.inputs), real.function_suffix
    state = plain.arguments("q", "qd", *plain.state[2:], "u", "p")
    J = c.output_array(plain.real, "J")
    rates = c.static(f"{plain.prefix}_stage_slopes", plain.status, J, *state)
    feedback = ""
    if "signal_slopes" in target.program:
        feedback = plain.public.evaluation("signal_slopes").call(slopes="K")
    accelerate = plain.acceleration.function.call
    projection = plain.projection_along
    projected = _moved(plain) if projection else None
    methods = [METHODS[name] for name in run.methods]
    first_implicit = next((m for m in methods if m.implicit), None)
    for m in methods:
        yield Derivative(
            **plain.names,
            inputs=inputs,
            width=f"2*{plain.NQ} + {plain.NU}" if inputs else f"2*{plain.NQ}",
            rates=rates if m is methods[0] else None,
            linearization=plain.public.linearization.call(),
            feedback=feedback,
            eliminate=m is first_implicit,
            projection=projection if m is methods[0] else None,
            moved=projected,
            projection_call=projection.function.call(q="r", qd="v") if projection else "",
            move=projected.call(X="ends", t="t + h") if projected else "",
            near=target.literal(near(target)),
            scale_floor=target.literal(ZERO_SQUARE),
            function=plain.public.derivative(m.name),
            implicit=m.implicit,
            stages=m.stages,
            **tableau(m, real),
            step=plain.public.step(m.name).call(q="at", qd="moving"),
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


def _moved(plain: Functions) -> CFunction:
    """Return the static function that projects a step's end and its derivatives onto the
    constraints.
    """
    state = (c.output_array(plain.real, "X"), *(c.output_array(plain.real, n) for n in "rv"))
    arguments_read = plain.read(plain.target.program["projection_along"])
    other_arguments = (
        plain.argument("q"),
        *plain.arguments(*(n for n in ("t", "p") if n in arguments_read)),
    )
    return c.static(f"{plain.prefix}_derivative_projected", plain.status, *state, *other_arguments)
