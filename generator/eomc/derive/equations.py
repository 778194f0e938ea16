"""The equations of motion as values on a tape, and what follows from D, bias, K and P."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import sympy
from sympy import Expr, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive.constraints import Constraints, constraints
from eomc.derive.energies import Energies, directions
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import Tape
from eomc.model.system import System, symbol, t

WRITTEN_OUT = 2500  # names on the tape, about, from which C is computed column by column


@dataclass(frozen=True)
class Motion:
    """What Lagrange's equations give, as atoms of a tape; shapes as in the field: D, C (nq, nq).

    D: by rows, or where that would be long a single column, D e, for a direction e whose entries
    are `directions`. g: the part of bias at rest. balance: b in D qdd = b. notes: where unusual
    terms of K went.
    """

    D: Rows
    bias: Vector
    g: Vector
    tau: Vector
    balance: Vector
    quadratic: bool  # K is so in the velocities, with nothing else and without explicit time
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Equations(Motion):
    """The equations of motion. C: as D; kinetic, potential: K and P.

    jacobi: p.qd - K + P, what is conserved without forces and explicit time; None where it is
    K + P. power: d(jacobi)/dt without what constraints do; 0 for a conservative system.
    """

    tape: Tape
    C: Rows
    signals: Vector
    kinetic: Expr
    potential: Expr
    jacobi: Expr | None
    power: Expr
    rows: Constraints | None


def equations(system: System, e: Energies, motion: Motion) -> Equations:
    """The equations with what follows from D, bias, K and P: C, p.qd - K + P and its rate."""
    tape, qd = e.tape, system.qd

    def add(*terms: Expr) -> Expr:
        return tape.define(sympy.Add(*terms))

    euler = dict(zip(qd, qd, strict=True))
    jacobi = None
    if not motion.quadratic:
        twice, once = tape.forward([e.kinetic, e.linear_potential], euler)
        jacobi = add(twice, -once, -e.kinetic, e.potential, e.linear_potential)
        if e.linear_potential != 0 and jacobi == add(e.kinetic, e.potential):
            jacobi = None
    explicit = tape.forward([e.kinetic, e.potential, e.linear_potential], {t: S.One})
    (lost,) = tape.forward([e.dissipation], euler)
    works = [tape.define(force * v) for force, v in zip(e.forces, qd, strict=True)]
    moved = tape.forward([v for v, _ in e.applied], euler)
    works += [tape.define(f * v) for v, (_, f) in zip(moved, e.applied, strict=True)]
    power = add(*works, -lost, explicit[1], explicit[2], -explicit[0])
    return Equations(
        **vars(motion),
        tape=tape,
        C=_coriolis(system, tape, motion.bias, motion.quadratic),
        signals=tuple(e.signals),
        kinetic=e.kinetic,
        potential=e.potential,
        jacobi=jacobi,
        power=power,
        rows=constraints(system, e),
    )


def _coriolis(system: System, tape: Tape, bias: Sequence[Expr], quadratic: bool) -> Rows:
    """C = (J(qd) + J(0))/2 with J = d(bias)/dqd, or C e where that would be long.

    The part of bias that is quadratic in qd is sum_jk c_ijk qd_j qd_k with Christoffel's symbols
    of the first kind, symmetric in j and k, so half its Jacobian is the Christoffel form of C.
    The linear part (gyroscopic terms, explicit time in D) is J(0) qd and goes in whole.
    """
    at_rest = dict.fromkeys(system.qd, S.Zero)

    def column(seeds: Mapping[Symbol, Expr]) -> list[Expr]:
        slope = tape.forward(bias, seeds)
        still = [S.Zero] * len(slope) if quadratic else tape.substitute(slope, at_rest)
        return [tape.define((a + b) / 2) for a, b in zip(slope, still, strict=True)]

    if len(bias) * len(tape.live(bias)) > WRITTEN_OUT:
        entries = directions(system)
        return (tuple(column({qd: entries[q] for q, qd in zip(system.q, system.qd, strict=True)})),)
    columns = [column({velocity: S.One}) for velocity in system.qd]
    return tuple(tuple(column[i] for column in columns) for i in range(len(columns)))


def no_inertia(system: System, name: str) -> NoReturn:
    """Raise SceneError for a coordinate that nothing resists."""
    links = system.tree.links if system.tree else ()
    body = next((link.name for link in links if symbol(name) in link.q.free_symbols), "")
    if body:
        key = f"body.{body}"
        message = (
            f"coordinate '{name}' has no inertia: nothing that the joint moves resists it, such as "
            "a point mass on its axis; give the body inertia about it, or fix the joint"
        )
    elif links:
        key = f"coordinates.{name}"
        message = (
            f"coordinate '{name}' has no inertia: neither a joint nor the kinetic energy has it; "
            "name it in a body's joint, or take it out"
        )
    else:
        key = "energy.kinetic"
        message = (
            f"coordinate '{name}' has no inertia: the kinetic energy does not depend on "
            f"{name}_dot, so nothing can be solved for its acceleration; "
            "give it a mass, or make it an input"
        )
        if symbol(f"{name}_dot") in system.kinetic.free_symbols:
            message = (
                f"coordinate '{name}' has no inertia: the kinetic energy has {name}_dot, but not "
                f"its square, so nothing can be solved for its acceleration; write {name}_dot**2"
            )
    raise SceneError([system.problem(key, message)])
