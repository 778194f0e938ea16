"""Where forces jump or bend, or may do so to steps that are longer than it takes."""

from __future__ import annotations

from typing import Any

import sympy

from eomc.model.symbols import dot
from eomc.model.system import System

KINDS = (sympy.sign, sympy.Heaviside, sympy.Abs, sympy.Min, sympy.Max)
STEEP = (*KINDS, sympy.tanh, sympy.atan)  # corners to steps longer than they are wide


def nonsmooth_functions(system: System, kinds: tuple[Any, ...] = KINDS) -> str:
    """The functions in the scene that jump or bend, by name; "" where all is smooth."""
    s = system
    exprs = (
        *(s.kinetic, s.potential, s.linear_potential, s.dissipation, *s.forces),
        *(e for x in s.applied for e in x),
        *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
        *(c.formula for c in s.constraints if not c.switched),
    )
    found = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*kinds)}
    return ", ".join(sorted(found))


def has_steep_terms(system: System) -> bool:
    """Whether there are corners, or what may be one to a long step.

    That is tanh or atan of anything, and whatever is not a polynomial, sine or cosine in the
    velocities, such as friction that is smoothed by v/sqrt(v**2 + w**2) or Stribeck's exp(-v**2).
    """
    if nonsmooth_functions(system, STEEP):
        return True
    s, fast = system, set(system.qd)
    for name, e in s.definitions:
        if e.free_symbols & fast or e.has(dot):
            fast.add(name)
    exprs = (
        s.dissipation, *s.forces, *(f for _, f in s.applied), *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
    )  # fmt: skip
    return any(
        (f.free_symbols & fast or f.has(dot)) and not _gentle(f)
        for e in exprs
        for f in e.atoms(sympy.Function, sympy.Pow)
    )


def _gentle(f: sympy.Expr) -> bool:
    whole = f.is_Pow and f.exp.is_Integer and f.exp > 0
    return bool(whole or isinstance(f, (dot, sympy.sin, sympy.cos)))
