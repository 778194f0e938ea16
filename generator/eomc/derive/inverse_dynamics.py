"""Inverse dynamics on a tape: the generalized forces of a motion, D qdd + bias, without D.

Along a tree by Newton and Euler (newton_euler.py), of what is written as K and P by Lagrange's
operator at the given accelerations.
"""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Expr, S

from eomc.derive.energies import on_tape
from eomc.derive.lagrange import inertial_forces
from eomc.derive.newton_euler import Recursion
from eomc.derive.tape import Tape
from eomc.model.system import System


def inverse_dynamics(system: System) -> tuple[Tape, Sequence[Expr]]:
    """tau = D qdd + C qd + g, (nq,), over q, qd, qdd and t."""
    tree = system.tree
    energies = (tree.beside_kinetic, tree.beside_potential) if tree else None
    e = on_tape(system, *(energies or (system.kinetic, system.potential)), accelerations=True)
    accelerations = dict(zip(system.qd, system.qdd, strict=True))
    found = [[x] for x in inertial_forces(system, e, accelerations)]
    if tree:
        r = Recursion(e.tape, tree)
        along = r.by_link(dict(zip(system.q, system.qdd, strict=True)))
        whole = r.projected(r.inverse_dynamics(along))
        for terms, q in zip(found, system.q, strict=True):
            terms.append(whole.get(q, S.Zero))
    return e.tape, [e.tape.total(x for x in terms if x is not S.Zero) for terms in found]
