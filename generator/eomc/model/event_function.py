"""Check that event functions cross zero continuously."""

from __future__ import annotations

import sympy
from sympy import Expr, Heaviside, Symbol, sign

from eomc.base.errors import SceneError
from eomc.model.mechanics import AnySystem


def check_event_functions(system: AnySystem) -> AnySystem:
    """Check that the event functions of a system can cross zero continuously; return the system.

    The system is returned unchanged. Raises SceneError if an event function is piecewise constant,
    such as sign(x): it jumps over zero and has no root there.
    """
    if not system.events:
        return system
    smooth: dict[
        Symbol, frozenset[Symbol]
    ] = {}  # symbols on which each definition depends continuously
    jumping: dict[Symbol, Expr] = {}  # argument of a discontinuity of each definition that has one

    def dependencies(e: Expr) -> tuple[frozenset[Symbol], Expr | None]:
        jumps = sorted(e.atoms(Heaviside, sign), key=str)
        names = e.xreplace(dict.fromkeys(jumps, sympy.S.One)).free_symbols
        inside = [j.args[0] for j in jumps] + [jumping[s] for s in names if s in jumping]
        continuous = frozenset[Symbol]().union(*(smooth.get(s, {s}) for s in names))
        return continuous, inside[0] if inside else None

    for name, e in system.definitions:
        smooth[name], where = dependencies(e)
        if where is not None:
            jumping[name] = where
    fixed, problems = {p.symbol for p in system.parameters}, []
    for k, event in enumerate(system.events, start=1):
        continuous, where = dependencies(event.when)
        if where is not None and continuous <= fixed:
            why = f'jumps over zero, which is no crossing: write when = "{where}"'
            problems.append(system.problem(f"event.{k}.when", why))
    if problems:
        raise SceneError(problems)
    return system
