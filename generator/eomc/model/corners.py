"""Where forces jump or bend."""

from __future__ import annotations

from typing import Any

import sympy

from eomc.model.system import System

KINDS = (sympy.sign, sympy.Heaviside, sympy.Abs, sympy.Min, sympy.Max)
STEEP = (*KINDS, sympy.tanh)  # which is a corner to steps that are longer than it is wide


def corners(system: System, kinds: tuple[Any, ...] = KINDS) -> str:
    """The functions in the scene that jump or bend, by name; "" where all is smooth."""
    s = system
    exprs = (
        *(s.kinetic, s.potential, s.dissipation, *s.forces),
        *(e for x in s.applied for e in x),
        *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
        *(c.formula for c in s.constraints),
    )
    found = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*kinds)}
    return ", ".join(sorted(found))
