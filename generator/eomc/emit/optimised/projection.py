"""Projection onto the constraints in optimised C, over a lane."""

from __future__ import annotations

from eomc.emit import c_function as c
from eomc.emit import projection
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import sentence
from eomc.emit.functions import RATE_TERMS, Functions
from eomc.emit.optimised.lanes import NOINLINE, Lane
from eomc.emit.portable.constraint_views import Projection
from eomc.emit.portable.parts import Computed
from eomc.program.program import TIME


def view(functions: Functions, lane: Lane) -> Projection:
    """Return the template data of the projection of a step's end onto the constraints.

    lane: the C type that the function computes with, plain numbers or a vector register with one
    value of each of several instances.
    """
    correction, state = _correction(lane), {"q": "at", "qd": "moving"}
    call = correction.function.call(**state)
    terms = None if lane.name else _rate_terms(lane)
    sines = lane.accelerations.correction[1]
    return projection.view(
        functions, correction, projected(lane), call, terms, state, lane=lane.real.name, L=lane.end,
        mask=lane.mask, extent=lane.extent, increments=True,
        sines=f"{lane.prefix}_sines{lane.end}" if sines else "",
        sines_call=f"{lane.prefix}_sines_at{lane.end}(&own, at)"
        if sines and lane.computes_own_sines else "",
        onto=onto(lane) if functions.swept and not lane.name else None,
    )  # fmt: skip


def projected(lane: Lane) -> CFunction:
    """Return the prototype of the C function that makes the end of a step satisfy the constraints.

    The C function changes r and v, the increments of q and q̇ in the step, in place. lane: the C
    type that it computes with, plain numbers or a vector register.
    """
    out = tuple(c.output_array(lane.real.name, n) for n in "rv")
    singular_flag = () if lane.name else (CArgument("int *", "singular"),)
    return CFunction(
        f"{lane.prefix}_projected{lane.end}",
        lane.mask if lane.name else f"{lane.prefix}_status",
        (*out, *map(lane.argument, _arguments(lane)), *singular_flag),
        qualifier=lane.qualifiers[NOINLINE],
    )


def ending(functions: Functions, lane: Lane, **passed: str) -> str:
    """Return the C call of `projected`, or "" if the scene has no constraints.

    lane: the C type that the function computes with, plain numbers or a vector register. passed: C
    expressions for some arguments of the call, by name; the others are passed under their names.
    """
    return projected(lane).call(**passed) if functions.projection else ""


def onto(lane: Lane) -> CFunction:
    """Return the prototype of the C function that projects one stage onto the constraints.

    A stage is an intermediate state (q, q̇) within a step. The function corrects the state once, so
    that the constraint residuals vanish to first order. lane: the C type that it computes with.
    """
    state = tuple(c.output_array(lane.real.name, n) for n in ("at", "moving"))
    others = (n for n in _arguments(lane, sines=False) if n in "tc")
    return CFunction(
        f"{lane.prefix}_onto", "int", (*state, *map(lane.argument, others)),
        qualifier=lane.qualifiers[NOINLINE],
    )  # fmt: skip


def _correction(lane: Lane) -> Computed:
    """Return the function for the corrections of q and qd."""
    function = lane.accelerations.correction[0]
    places = [f"d[{k}]" for k in range(len(function.outputs))]
    return lane.computed(
        function, "projection", c.output_array(lane.real.name, "d"), places, doc=sentence(function),
        takes=_arguments(lane),
    )  # fmt: skip


def _rate_terms(lane: Lane) -> Computed | None:
    """Return the function for rates of constraints that corrections may drop, and sums of
    |terms|.
    """
    function = lane.target.program.functions.get("rate_terms")
    if function is None:
        return None
    parameters = {n: c.member("c", n) for n in lane.accelerations.parameter_names}
    places = [f"rates[{k}]" for k in range(len(function.outputs))]
    return lane.computed(
        function, "rate_terms", c.output_array(lane.real.name, "rates"), places, doc=RATE_TERMS,
        takes=_arguments(lane, sines=False), constants=parameters, inline=False,
    )  # fmt: skip


def _arguments(lane: Lane, sines: bool = True) -> tuple[str, ...]:
    """Return the arguments that the constraints depend on, among q, qd, s, t, c."""
    timed = TIME in lane.target.program["projection"].uses
    known = sines and lane.accelerations.correction[1]
    names = ("q", "qd", *(["s"] if known else []), *(["t"] if timed else []), "c")
    return tuple(n for n in lane.argument_names if n in names)
