"""Limits of inputs: formulas see what acts, min(max(u, least), most), in place of the input."""

from __future__ import annotations

from dataclasses import replace

from sympy import Symbol

from eomc.model.mechanics import Made
from eomc.model.symbols import symbol


def saturate_inputs(system: Made) -> Made:
    """The system with a definition for each limited input, `force_limited`, used in its place."""
    names = {s.name for s, _ in system.definitions} | system.names | {system.name}
    made: dict[Symbol, Symbol] = {}
    for i in system.inputs:
        if any(x is not None for x in i.limits):
            name = f"{i.name}_limited"
            while name in names:
                name += "_too"
            names.add(name)
            made[i.symbol] = symbol(name)
    if not made:
        return system
    limited = [(made[i.symbol], i.limited) for i in system.inputs if i.symbol in made]
    return replace(
        system,
        definitions=(*limited, *((s, e.xreplace(made)) for s, e in system.definitions)),
        forces=tuple(e.xreplace(made) for e in system.forces),
        applied=tuple((y, force.xreplace(made)) for y, force in system.applied),
        events=tuple(
            replace(
                e,
                when=e.when.xreplace(made),
                jump=tuple((name, to.xreplace(made)) for name, to in e.jump),
            )
            for e in system.events
        ),
        outputs=tuple(replace(o, formula=o.formula.xreplace(made)) for o in system.outputs),
    )
