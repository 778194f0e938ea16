"""What events watch has to cross zero: what jumps over it never does."""

from __future__ import annotations

import sympy
from sympy import Expr, Heaviside, Symbol, sign

from eomc.base.errors import SceneError
from eomc.model.mechanics import Made


def check_event_functions(system: Made) -> Made:
    """The system. Raises SceneError where sign and heaviside alone change what an event watches."""
    if not system.events:
        return system
    smooth: dict[Symbol, frozenset[Symbol]] = {}  # of definitions: what changes them between jumps
    jumping: dict[Symbol, Expr] = {}  # and where they jump, if they do

    def of(e: Expr) -> tuple[frozenset[Symbol], Expr | None]:
        jumps = sorted(e.atoms(Heaviside, sign), key=str)
        names = e.xreplace(dict.fromkeys(jumps, sympy.S.One)).free_symbols
        inside = [j.args[0] for j in jumps] + [jumping[s] for s in names if s in jumping]
        left = frozenset[Symbol]().union(*(smooth.get(s, {s}) for s in names))
        return left, inside[0] if inside else None

    for name, e in system.definitions:
        smooth[name], where = of(e)
        if where is not None:
            jumping[name] = where
    fixed, problems = {p.symbol for p in system.parameters}, []
    for k, event in enumerate(system.events, start=1):
        left, where = of(event.when)
        if where is not None and left <= fixed:
            why = f'jumps over zero, which is no crossing: write when = "{where}"'
            problems.append(system.problem(f"event.{k}.when", why))
    if problems:
        raise SceneError(problems)
    return system
