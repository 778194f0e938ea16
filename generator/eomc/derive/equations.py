"""The equations of motion as expressions on a tape: C, the energy integral and its rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import sympy
from sympy import Expr, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive.constraints import Constraints, constraints
from eomc.derive.energies import Energies, tangent_symbols
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import Tape
from eomc.model.system import System, symbol, t

# Matrices with more names on the tape than this are not unrolled: they are given as the product
# with a symbolic direction, from which the C code computes one column per call.
UNROLLED_SIZE_LIMIT = 2500


@dataclass(frozen=True)
class MotionTerms:
    """Terms of the equations of motion D qdd + bias = tau, as atoms of a tape.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    D : (nq, nq) or (1, nq)
        Mass matrix by rows. If its expressions would be too long: the single row D v, where the
        entries of the vector v are symbols, see `tangent_symbols`.
    bias : (nq,)
        C qd + g.
    g : (nq,)
        The bias at qd = 0.
    tau : (nq,)
        Generalized forces.
    balance : (nq,)
        tau - bias, the right-hand side of D qdd = tau - bias.
    quadratic : bool
        Whether the kinetic energy K is a quadratic form of qd and does not depend on t explicitly.
    notes : tuple of str
        Sentences that say where the parts of K that are not quadratic appear in the equations.
    """

    D: Rows
    bias: Vector
    g: Vector
    tau: Vector
    balance: Vector
    quadratic: bool  # K = qd . D(q) . qd/2, without lower terms and explicit time
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Equations(MotionTerms):
    """The equations of motion of a system, as atoms of the attribute `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    tape : Tape
        The definitions of all names that the attributes contain.
    C : (nq, nq) or (1, nq)
        Coriolis matrix by rows, or the single row C v if D is given as D v.
    signals : (nu,)
        Values of the inputs, by their formulas in the scene.
    kinetic, potential : Expr
        Energies K and P (J).
    jacobi : Expr or None
        Jacobi's integral p . qd - K + P, with p = dK/dqd. It is conserved without forces and
        explicit time. None where it equals K + P.
    power : Expr
        Time derivative of Jacobi's integral (of K + P if `jacobi` is None), without the power of
        constraint forces (W). It is 0 for a conservative system.
    rows : Constraints or None
        The constraint equations; None without constraints.
    """

    tape: Tape
    C: Rows
    signals: Vector
    kinetic: Expr
    potential: Expr
    jacobi: Expr | None
    power: Expr
    rows: Constraints | None


def equations(system: System, e: Energies, motion: MotionTerms) -> Equations:
    """Return the equations of motion of a system, completed from `motion` (D, bias and tau).

    The Coriolis matrix, Jacobi's integral with its time derivative, and the constraint equations
    are derived and added. `e` contains the energies and the residuals of the constraints.
    """
    tape, qd = e.tape, system.qd

    def add(*terms: Expr) -> Expr:
        return tape.define(sympy.Add(*terms))

    velocities = dict(zip(qd, qd, strict=True))
    jacobi = None
    if not motion.quadratic:
        twice, once = tape.forward([e.kinetic, e.linear_potential], velocities)
        jacobi = add(twice, -once, -e.kinetic, e.potential, e.linear_potential)
        if e.linear_potential != 0 and jacobi == add(e.kinetic, e.potential):
            jacobi = None
    explicit = tape.forward([e.kinetic, e.potential, e.linear_potential], {t: S.One})
    (dissipated,) = tape.forward([e.dissipation], velocities)
    powers = [tape.define(force * v) for force, v in zip(e.forces, qd, strict=True)]
    velocities_of_points = tape.forward([v for v, _ in e.applied], velocities)
    powers += [
        tape.define(f * v) for v, (_, f) in zip(velocities_of_points, e.applied, strict=True)
    ]
    power = add(*powers, -dissipated, explicit[1], explicit[2], -explicit[0])
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
    """Return C = (J(qd) + J(0))/2 with J = d(bias)/dqd, or C v for a direction v where C would be
    long.

    The part of bias that is quadratic in qd is sum_jk c_ijk qd_j qd_k with Christoffel's symbols of
    the first kind, symmetric in j and k, so half its Jacobian is the Christoffel form of C. The
    linear part (gyroscopic terms, explicit time in D) is J(0) qd and enters with the factor 1.
    """
    at_rest = dict.fromkeys(system.qd, S.Zero)

    def column(seeds: Mapping[Symbol, Expr]) -> list[Expr]:
        derivative = tape.forward(bias, seeds)
        at_zero = [S.Zero] * len(derivative) if quadratic else tape.substitute(derivative, at_rest)
        return [tape.define((a + b) / 2) for a, b in zip(derivative, at_zero, strict=True)]

    if len(bias) * len(tape.live(bias)) > UNROLLED_SIZE_LIMIT:
        entries = tangent_symbols(system)
        return (tuple(column({qd: entries[q] for q, qd in zip(system.q, system.qd, strict=True)})),)
    columns = [column({velocity: S.One}) for velocity in system.qd]
    return tuple(tuple(column[i] for column in columns) for i in range(len(columns)))


def raise_no_inertia(system: System, name: str) -> NoReturn:
    """Raise a SceneError which says that the coordinate `name` has no inertia.

    The message suggests a remedy. It depends on whether the inertia of the coordinate should come
    from bodies on joints or from a formula of the kinetic energy.
    """
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
