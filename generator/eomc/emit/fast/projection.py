"""Steps of the fast form that end on the constraints, over a lane."""

from __future__ import annotations

from eomc.emit import c_function as c
from eomc.emit import projection
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import sentence
from eomc.emit.fast.lanes import NOINLINE, Lane
from eomc.emit.functions import RATE_TERMS, Functions
from eomc.emit.plain.constraint_views import Projection
from eomc.emit.plain.parts import Computed
from eomc.program.program import TIME


def view(functions: Functions, lane: Lane) -> Projection:
    """The view of a lane."""
    made, state = _correction(lane), {"q": "at", "qd": "moving"}
    call = made.function.call(**state)
    terms = None if lane.name else _rate_terms(lane)
    sines = lane.accelerations.correction[1]
    return projection.view(
        functions, made, projected(lane), call, terms, state, lane=lane.real.name, L=lane.end,
        mask=lane.mask, extent=lane.extent, increments=True,
        sines=f"{lane.prefix}_sines{lane.end}" if sines else "",
        sines_call=f"{lane.prefix}_sines_at{lane.end}(&own, at)" if sines and lane.alone else "",
        onto=onto(lane) if functions.swept and not lane.name else None,
    )  # fmt: skip


def projected(lane: Lane) -> CFunction:
    """What a step adds, so changed that it ends on the constraints."""
    out = tuple(c.filled(lane.real.name, n) for n in "rv")
    told = () if lane.name else (CArgument("int *", "singular"),)
    return CFunction(
        f"{lane.prefix}_projected{lane.end}",
        lane.mask if lane.name else f"{lane.prefix}_status",
        (*out, *map(lane.argument, _placed(lane)), *told),
        qualifier=lane.qualifiers[NOINLINE],
    )


def ending(functions: Functions, lane: Lane, **passed: str) -> str:
    """The call that ends a step on the constraints; "" where there are none."""
    return projected(lane).call(**passed) if functions.projection else ""


def onto(lane: Lane) -> CFunction:
    """A stage moved onto the constraints, to first order."""
    moved = tuple(c.filled(lane.real.name, n) for n in ("at", "moving"))
    more = (n for n in _placed(lane, sines=False) if n in "tc")
    return CFunction(
        f"{lane.prefix}_onto", "int", (*moved, *map(lane.argument, more)),
        qualifier=lane.qualifiers[NOINLINE],
    )  # fmt: skip


def _correction(lane: Lane) -> Computed:
    """What q and qd lack for the constraints to hold."""
    function = lane.accelerations.correction[0]
    places = [f"d[{k}]" for k in range(len(function.outputs))]
    return lane.computed(
        function, "projection", c.filled(lane.real.name, "d"), places, doc=sentence(function),
        takes=_placed(lane),
    )  # fmt: skip


def _rate_terms(lane: Lane) -> Computed | None:
    """Rates of rows that corrections may leave out, and sizes of their terms."""
    function = lane.target.program.functions.get("rate_terms")
    if function is None:
        return None
    own = {n: c.member("c", n) for n in lane.accelerations.own}
    places = [f"rates[{k}]" for k in range(len(function.outputs))]
    return lane.computed(
        function, "rate_terms", c.filled(lane.real.name, "rates"), places, doc=RATE_TERMS,
        takes=_placed(lane, sines=False), constants=own, inline=False,
    )  # fmt: skip


def _placed(lane: Lane, sines: bool = True) -> tuple[str, ...]:
    """What constraints are read from: q, qd, s, t, c, as far as they are."""
    timed = TIME in lane.target.program["projection"].uses
    known = sines and lane.accelerations.correction[1]
    names = ("q", "qd", *(["s"] if known else []), *(["t"] if timed else []), "c")
    return tuple(n for n in lane.there if n in names)
