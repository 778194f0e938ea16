"""Saturation of inputs: formulas use min(max(u, least), most) in place of the input u."""

from __future__ import annotations

from dataclasses import replace

from sympy import Symbol

from eomc.model.mechanics import AnySystem
from eomc.model.symbols import symbol


def saturate_inputs(system: AnySystem) -> AnySystem:
    """Return a copy of a system in which inputs with limits are saturated at their limits.

    For an input such as `force`, the copy has a new definition `force_limited`, the saturated
    value. It replaces the input in all definitions, forces, events and outputs.
    """
    names = {s.name for s, _ in system.definitions} | system.names | {system.name}
    limited_symbols: dict[Symbol, Symbol] = {}
    for i in system.inputs:
        if any(x is not None for x in i.limits):
            name = f"{i.name}_limited"
            while name in names:
                name += "_too"
            names.add(name)
            limited_symbols[i.symbol] = symbol(name)
    if not limited_symbols:
        return system
    limited = [
        (limited_symbols[i.symbol], i.limited) for i in system.inputs if i.symbol in limited_symbols
    ]
    return replace(
        system,
        definitions=(*limited, *((s, e.xreplace(limited_symbols)) for s, e in system.definitions)),
        forces=tuple(e.xreplace(limited_symbols) for e in system.forces),
        applied=tuple((y, force.xreplace(limited_symbols)) for y, force in system.applied),
        events=tuple(
            replace(
                e,
                when=e.when.xreplace(limited_symbols),
                jump=tuple((name, to.xreplace(limited_symbols)) for name, to in e.jump),
            )
            for e in system.events
        ),
        outputs=tuple(
            replace(o, formula=o.formula.xreplace(limited_symbols)) for o in system.outputs
        ),
    )
