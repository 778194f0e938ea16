"""What events watch has to cross zero: what jumps over it never does."""

from __future__ import annotations

import sympy
from sympy import Heaviside, sign

from eomc.base.errors import SceneError
from eomc.model.mechanics import Made
from eomc.model.symbols import resolved


def crossing(system: Made) -> Made:
    """The system. Raises SceneError where sign and heaviside alone change what an event watches."""
    known, fixed = resolved(system.definitions), {p.symbol for p in system.parameters}
    problems = []
    for k, event in enumerate(system.events, start=1):
        when = event.when.xreplace(known)
        jumps = sorted(when.atoms(Heaviside, sign), key=str)
        outside = when.xreplace(dict.fromkeys(jumps, sympy.S.One)).free_symbols
        if jumps and outside <= fixed:
            why = f'jumps over zero, which is no crossing: write when = "{jumps[0].args[0]}"'
            problems.append(system.problem(f"event.{k}.when", why))
    if problems:
        raise SceneError(problems)
    return system
