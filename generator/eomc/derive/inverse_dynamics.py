"""Inverse dynamics on a tape: D qdd + bias for given accelerations, without forming D.

Trees of bodies by the recursive Newton-Euler algorithm (newton_euler.py); energies that are written
as K and P by Lagrange's operator.
"""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Expr, S

from eomc.derive.energies import energies_on_tape
from eomc.derive.lagrange import inertial_forces
from eomc.derive.newton_euler import Recursion
from eomc.derive.tape import Tape
from eomc.model.system import System


def inverse_dynamics(system: System) -> tuple[Tape, Sequence[Expr]]:
    """Return the pair (tape, tau) with the generalized forces tau = D qdd + C qd + g, shape (nq,).

    The tape is the list of elementary operations that compute tau from q, qd, qdd, t and the
    parameters. tau is derived without forming the matrix D.
    """
    tree = system.tree
    energies = (tree.other_kinetic, tree.other_potential) if tree else None
    energies_ = energies_on_tape(
        system, *(energies or (system.kinetic, system.potential)), accelerations=True
    )
    accelerations = dict(zip(system.qd, system.qdd, strict=True))
    terms_of = [[x] for x in inertial_forces(system, energies_, accelerations)]
    if tree:
        r = Recursion(energies_.tape, tree)
        joint_accelerations = r.by_link(dict(zip(system.q, system.qdd, strict=True)))
        tree_forces = r.projected(r.inverse_dynamics(joint_accelerations))
        for terms, q in zip(terms_of, system.q, strict=True):
            terms.append(tree_forces.get(q, S.Zero))
    return energies_.tape, [
        energies_.tape.total(x for x in terms if x is not S.Zero) for terms in terms_of
    ]
