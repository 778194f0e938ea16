"""Where forces jump or bend."""

from __future__ import annotations

import sympy

from eomc.model.system import System

KINDS = (sympy.sign, sympy.Heaviside, sympy.Abs, sympy.Min, sympy.Max)


def corners(system: System) -> str:
    """The functions in the scene that jump or bend, by name; "" where all is smooth."""
    s = system
    exprs = (
        *(s.kinetic, s.potential, s.dissipation, *s.forces),
        *(e for x in s.applied for e in x),
        *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
        *(c.formula for c in s.constraints),
    )
    found = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*KINDS)}
    return ", ".join(sorted(found))
