"""Detection of non-smooth functions, and of smooth ones that may be steep relative to a step."""

from __future__ import annotations

from typing import Any

import sympy

from eomc.model.symbols import dot
from eomc.model.system import System

KINDS = (sympy.sign, sympy.Heaviside, sympy.Abs, sympy.Min, sympy.Max)
STEEP = (*KINDS, sympy.tanh, sympy.atan)  # tanh and atan act as jumps if they are narrow


def nonsmooth_functions(system: System, kinds: tuple[Any, ...] = KINDS) -> str:
    """Return text that lists the non-smooth functions, such as abs, in a system's expressions.

    The names are separated by commas; the text is "" if there are none. kinds: SymPy classes of the
    functions to look for.
    """
    s = system
    exprs = (
        *(s.kinetic, s.potential, s.linear_potential, s.dissipation, *s.forces),
        *(e for x in s.applied for e in x),
        *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
        *(c.formula for c in s.constraints if not c.switched),
    )
    names = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*kinds)}
    return ", ".join(sorted(names))


def has_steep_terms(system: System) -> bool:
    """Return True if the expressions of a system are non-smooth or may vary fast within one step.

    Functions that may vary fast are tanh and atan of any argument, and functions of the velocities
    other than polynomials, sines and cosines, such as friction smoothed by v/sqrt(v**2 + w**2) or
    the Stribeck term exp(-v**2).
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
        (f.free_symbols & fast or f.has(dot)) and not _is_gentle(f)
        for e in exprs
        for f in e.atoms(sympy.Function, sympy.Pow)
    )


def _is_gentle(f: sympy.Expr) -> bool:
    natural_power = f.is_Pow and f.exp.is_Integer and f.exp > 0
    return bool(natural_power or isinstance(f, (dot, sympy.sin, sympy.cos)))
