"""The angles in a system's formulas: the arguments of its sines, cosines and tangents."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sympy

from eomc.model.algebra import compiled
from eomc.model.symbols import needed
from eomc.model.system import System, dot, t
from eomc.verify.sampling import State

PERIODIC = (sympy.sin, sympy.cos, sympy.tan)


def largest_angle(system: System) -> Callable[[State], float]:
    """Return a function that computes the largest angle in the system's formulas at a state, rad.

    An angle is an argument of a sine, cosine or tangent. Its rounding error, relative to its size,
    limits the precision of all results. The function ignores angles that contain a rate dot(...),
    and returns 0 if there are no angles.
    """
    formulas = [
        system.kinetic, system.potential, system.linear_potential, system.dissipation,
        *system.forces, *(e for pair in system.applied for e in pair),
        *(i.signal for i in system.inputs), *(c.formula for c in system.constraints),
    ]  # fmt: skip
    known, free = [], set[sympy.Symbol]()  # definitions without rates
    for name, e in needed(system.definitions, formulas):
        if not e.has(dot) and not e.free_symbols & free:
            known.append((name, e))
        else:
            free.add(name)
        formulas.append(e)
    angles = {f.args[0] for e in formulas for f in e.atoms(*PERIODIC)}
    angles = {e for e in angles if not e.has(dot) and not e.free_symbols & free}
    if not angles:
        return lambda s: 0.0
    parameters = [p.symbol for p in system.parameters]
    names = [*system.q, *system.qd, t, *system.u, *parameters]
    evaluate = compiled(names, sorted(angles, key=str), "numpy", needed(known, [*angles]))
    defaults = {p.name: p.value for p in system.parameters}

    def largest(s: State) -> float:
        values = s.params or defaults
        u = np.zeros(len(system.u)) if s.u is None else s.u
        with np.errstate(all="ignore"):
            arguments = evaluate(
                *s.q, *s.qd, s.t, *u, *(np.float64(values[p.name]) for p in parameters)
            )
        return float(np.nanmax(np.abs(np.array(arguments, float)), initial=0.0))

    return largest
