"""Euler and Lagrange over a tape: D, C, g, bias, generalized forces and accelerations.

With K, P and R as programs over named positions, the equations of motion

    D(q) qdd + bias(q, qd, t) = tau,    bias = C qd + g,    tau = Q - dR/dqd

follow by sweeps (tape.py). What a scene writes as dot(y) is treated as a velocity w of its own:
since d(ydot)/dq = d/dt (dy/dq), Lagrange's operator is the same in any coordinates, so

    bias_i = d/dt(dF/dqd_i) - dF/dq_i + dP/dq_i + sum_k d/dt(dF/dw_k) dy_k/dq_i

with K = F(q, qd, w, t) and d/dt taken at qdd = 0: the inertial forces of the points, projected
by one backward sweep over their positions. That is the operation count of recursive Newton and
Euler, without the terms that cancel when K is differentiated as a function of q and qd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import sympy
from sympy import Expr, S, Symbol

from eomc.base.errors import Problem, SceneError
from eomc.derive import link_multipliers
from eomc.derive.articulated_body import MasslessError, accelerations
from eomc.derive.constraints import Constraints, constraints
from eomc.derive.energies import Energies, directions, on_tape
from eomc.derive.equations import Equations, Motion, equations, no_inertia
from eomc.derive.ldl import Rows, Solution, Vector, Way, solve, work
from eomc.derive.newton_euler import Recursion
from eomc.derive.tape import RoughError, Stage, Tape
from eomc.model.symbols import needed
from eomc.model.system import System, t
from eomc.model.tree import Tree

LAGRANGE_DEFINITIONS = 12  # of a tree's world coordinates: beyond, recursion always needs less
MOST_ROWS = 16  # coordinates from which D is computed column by column, where nothing needs it


MASSLESS = "a motion that nothing resists"  # why there is no way by articulated bodies


@dataclass(frozen=True)
class Derivation:
    """The equations of motion by each way that may be worth its while.

    lagrange: over the program of K and P; newton_euler: recursively, where there are bodies on
    joints; None where that way was not gone. The rest are the accelerations, each by one way of
    solving D qdd = b: Lagrange's D by L D L^T, D of composite bodies by L D L^T, articulated
    bodies, link multipliers; or why it was not tried, or None where there is nothing to try, as
    where there are constraints (kkt.py).
    """

    system: System
    lagrange: Equations | None
    newton_euler: Equations | None
    ldl: Way
    composite: Way
    articulated: Way
    multipliers: Way


def derive(system: System) -> Derivation:
    """The equations of motion of `system`.

    Raises SceneError where K is not quadratic in the velocities or a coordinate has no inertia.
    Source: Greenwood, *Advanced Dynamics*, sec. 2.1 (Lagrange) and 2.3 (Jacobi's integral); C from
    Spong, Hutchinson & Vidyasagar, *Robot Modeling and Control*, sec. 6.3.
    """
    lagrange = newton_euler = articulated = composite = multipliers = None
    places = len(needed(system.definitions, (system.kinetic, system.potential)))
    ldl: Way = f"{places} world coordinates to differentiate"
    try:
        if system.tree is None or places <= LAGRANGE_DEFINITIONS:
            lagrange, ldl, multipliers = _by_lagrange(system)
        if system.tree is not None:
            newton_euler, articulated, composite = _by_newton_euler(system, system.tree)
        if lagrange is None and not system.constraints:
            multipliers = _by_multipliers(system)
    except RoughError:  # P and R are differentiated once, K and constraints twice
        if rough := _rough_rows(system):
            raise SceneError(rough) from None
        message = (
            "a second derivative of the kinetic energy jumps: it must be quadratic in the "
            "velocities and smooth; abs, sign, min, max and roots of velocities are not"
        )
        raise SceneError([system.problem("energy.kinetic", message)]) from None
    return Derivation(system, lagrange, newton_euler, ldl, composite, articulated, multipliers)


def _rough_rows(system: System) -> list[Problem]:
    """What is to be said of constraints with corners."""
    problems, still = [], replace(system, kinetic=S.Zero, potential=S.Zero, tree=None)
    for row in system.constraints:
        alone = replace(still, constraints=(row,))
        try:
            constraints(alone, on_tape(alone, S.Zero, S.Zero))
        except RoughError:
            key = f"loop.{row.loop}" if row.loop else f"constraints.{row.name}"
            message = (
                "abs, min and max have corners, and constraints are differentiated twice: write "
                "the side that is meant, such as x for abs(x)"
            )
            problems.append(system.problem(key, message))
    return problems


def _by_lagrange(system: System) -> tuple[Equations, Way, Way]:
    """The equations, and accelerations by L D L^T and by multipliers."""
    e = on_tape(system, system.kinetic, system.potential)
    motion = _lagrange(system, e)
    if system.constraints:
        made = equations(system, e, motion)
        _refuse_massless(system, motion.D, made.rows)
        return made, None, None
    _refuse_massless(system, motion.D)
    multipliers, operations = _by_multipliers(system), work(motion.D)
    ldl: Way = f"{operations} flops for elimination alone"
    if (
        not isinstance(multipliers, Solution)
        or len(system.q) <= MOST_ROWS
        or operations <= _length(multipliers)
    ):
        ldl = solve(e.tape, motion.D, motion.balance)
    return equations(system, e, motion), ldl, multipliers


def _by_newton_euler(system: System, tree: Tree) -> tuple[Equations, Way, Way]:
    """Newton and Euler for the tree, Lagrange for the rest; articulated and composite bodies."""
    e = on_tape(system, tree.beside_kinetic, tree.beside_potential)
    tape, q = e.tape, system.q
    rest = _lagrange(system, e)
    recursion = Recursion(tape, tree)

    def placed(by_link: Sequence[Expr]) -> list[Expr]:
        found = recursion.projected(by_link)
        return [found.get(x, S.Zero) for x in q]

    bias = placed(recursion.bias())
    motion = replace(
        rest,
        bias=_sums(tape, rest.bias, bias),
        g=_sums(tape, rest.g, placed(recursion.gravity_forces())),
        balance=_sums(tape, rest.balance, [-x for x in bias]),
    )
    constrained = bool(system.constraints)
    articulated = None if constrained else _by_articulated_bodies(system, recursion, rest)
    operations = recursion.elimination()
    long = isinstance(articulated, Solution) and operations > _length(articulated)
    if long and len(q) > MOST_ROWS:
        along = recursion.by_link(directions(system))
        D: Rows = (tuple(placed(recursion.mass_times(along))),)
    else:
        columns = zip(*map(placed, recursion.mass_matrix()), strict=True)
        whole = [*map(placed, columns)]  # by column; of symmetric entries one is kept
        rows = [[whole[min(i, j)][max(i, j)] for j in range(len(q))] for i in range(len(q))]
        D = tuple(_sums(tape, *pair) for pair in zip(rest.D, rows, strict=True))
        if not constrained:
            _refuse_massless(system, D)
    composite: Way = None if constrained else f"{operations} flops for elimination alone"
    if not long and not constrained:
        composite = solve(tape, D, motion.balance)
    e.kinetic = tape.total([e.kinetic, recursion.kinetic_energy()])
    e.potential = tape.total([e.potential, recursion.potential_energy()])
    made = equations(system, e, replace(motion, D=D))
    if constrained:
        _refuse_massless(system, D, made.rows)
    return made, articulated, composite


def _by_articulated_bodies(system: System, recursion: Recursion, rest: Motion) -> Way:
    """The accelerations where all inertia is the tree's, and joints have their own coordinates."""
    q, links = system.q, recursion.links
    if not recursion.plain:
        return "joints that move together"
    if len(links) < len(q) or any(x != 0 for column in rest.D for x in column):
        return None
    at = {link.q: k for k, link in enumerate(links)}
    try:
        found, pivots = accelerations(recursion, [rest.balance[q.index(link.q)] for link in links])
    except MasslessError:  # D is singular, from which `program.inertia` finds the motion
        return MASSLESS
    order = tuple(q.index(link.q) for link in reversed(links))
    return Solution(recursion.tape, tuple(found[at[x]] for x in q), order, pivots)


def _by_multipliers(system: System) -> Way:
    try:
        return link_multipliers.solution(system)
    except link_multipliers.UnsuitedError as why:
        return str(why)


def _length(solution: Solution) -> int:
    """The names that a solution depends on, about its operations."""
    return len(solution.tape.live(solution.acceleration))


def _refuse_massless(system: System, D: Rows, rows: Constraints | None = None) -> None:
    """Raise SceneError where a coordinate is neither in D nor in a row."""
    for k, (c, row) in enumerate(zip(system.coordinates, D, strict=True)):
        held = rows is not None and any(row[k] != 0 for row in rows.jacobian)
        if all(entry == 0 for entry in row) and not held:
            no_inertia(system, c.name)


def _sums(tape: Tape, one: Sequence[Expr], other: Sequence[Expr]) -> Vector:
    return tuple(tape.total(pair) for pair in zip(one, other, strict=True))


def inertial_forces(
    system: System, e: Energies, accelerations: Mapping[Symbol, Expr]
) -> list[Expr]:
    """D qdd + bias of K and P on a tape, by Lagrange's operator. accelerations: by velocity."""
    tape, q = e.tape, system.q
    moving = _momenta(system, e, accelerations)[1]
    seeds = [*_lagrangian(e), *zip(e.points.values(), moving[len(q) :], strict=True)]
    back = tape.gradient(seeds, q, frozenset(e.points))
    return [tape.total(x) for x in zip(moving[: len(q)], back, strict=True)]


def _momenta(
    system: System, e: Energies, accelerations: Mapping[Symbol, Expr]
) -> tuple[list[Expr], list[Expr]]:
    """dL/dqd and dL/dw, and their rates; velocities without an acceleration are steady."""
    rates: dict[Symbol, Expr] = {**system.rates, t: S.One, **accelerations}
    wanted = [*system.qd, *e.points]
    lagrangian = [(e.kinetic, S.One), (e.linear_potential, S.NegativeOne)]
    momenta = e.tape.gradient(lagrangian, wanted, frozenset(e.points))
    return momenta, e.tape.forward(momenta, rates)


def _lagrangian(e: Energies) -> list[tuple[Expr, Expr]]:
    """Seeds of the gradient of -L."""
    return [(e.kinetic, S.NegativeOne), (e.potential, S.One), (e.linear_potential, S.One)]


def _lagrange(system: System, e: Energies) -> Motion:
    tape, q, qd = e.tape, system.q, system.qd
    w = list(e.points)
    stop = frozenset(w)

    momenta, moving = _momenta(system, e, {})
    p, p_w = momenta[: len(q)], momenta[len(q) :]
    p_dot, p_w_dot = moving[: len(q)], moving[len(q) :]
    against = [(e.dissipation, S.One), *((v, -force) for v, force in e.applied)]
    friction = tape.gradient(against, [*qd, *w], stop)
    r, r_w = friction[: len(q)], friction[len(q) :]

    def projected(at_points: list[Expr], *energies: tuple[Expr, Expr]) -> list[Expr]:
        seeds = [*energies, *zip(e.points.values(), at_points, strict=True)]
        return tape.gradient(seeds, q, stop)

    def add(*terms: Expr) -> Expr:
        return tape.define(sympy.Add(*terms))

    lagrangian = _lagrangian(e)
    bias = [add(a, b) for a, b in zip(p_dot, projected(p_w_dot, *lagrangian), strict=True)]
    damping = [add(a, b) for a, b in zip(r, projected(r_w), strict=True)]
    tau = [add(force, -drag) for force, drag in zip(e.forces, damping, strict=True)]

    D = _mass_matrix(system, e, [*p, *p_w], projected)

    at_rest = dict.fromkeys(qd, S.Zero)
    driven = t in tape.leaves_of([e.kinetic, e.linear_potential])
    quadratic = all(x == 0 for x in tape.substitute([e.kinetic, *p, *p_w], at_rest)) and not driven
    g = tape.gradient([(e.potential, S.One)], q) if quadratic else tape.substitute(bias, at_rest)

    # D qdd = b, the forces projected in one sweep
    if e.dissipation == 0 and not e.applied:
        b = [add(force, -c) for force, c in zip(e.forces, bias, strict=True)]
    else:
        seeds = [add(i, f) for i, f in zip(p_w_dot, r_w, strict=True)]
        whole = projected(seeds, *lagrangian)
        b = [
            add(force, -inertia, -drag, -rest)
            for force, inertia, drag, rest in zip(e.forces, p_dot, r, whole, strict=True)
        ]
    notes = _notes(tape, e, p, p_w, at_rest, D)
    return Motion(D, tuple(bias), tuple(g), tuple(tau), tuple(b), quadratic, notes)


def _mass_matrix(
    system: System, e: Energies, momenta: list[Expr], projected: Callable[[list[Expr]], list[Expr]]
) -> Rows:
    """D_ij = d(dF/dqd_i)/dqd_j + sum_k d(dF/dw_k)/dqd_j dy_k/dq_i, a column a sweep."""
    tape, n = e.tape, len(system.q)
    whole: list[list[Expr]] = []
    for velocity in system.qd:
        column = tape.forward(momenta, {velocity: S.One})
        at_points = projected(column[n:])
        whole.append([tape.define(a + b) for a, b in zip(column[:n], at_points, strict=True)])
    # D is symmetric, and one half of it may cost less than the other
    halves = [
        [[whole[side(i, j)][other(i, j)] for j in range(n)] for i in range(n)]
        for side, other in ((min, max), (max, min))
    ]
    D = min(halves, key=lambda half: len(tape.live(entry for row in half for entry in row)))
    for i, j in product(range(n), repeat=2):
        if tape.stage_of(D[i][j]) >= Stage.VELOCITY:
            message = (
                "the kinetic energy is not quadratic in the velocities "
                f"(d2K/d{system.qd[i]}d{system.qd[j]} still depends on a velocity): "
                "D qdd + C qd + g = tau needs K = qd.D(q).qd/2 + a(q).qd + b(q)"
            )
            raise SceneError([system.problem("energy.kinetic", message)])
    return tuple(map(tuple, D))


def _notes(
    tape: Tape, e: Energies, p: list[Expr], p_w: list[Expr], at_rest: dict[Symbol, Expr], D: Rows
) -> tuple[str, ...]:
    """Where terms of K went that are not quadratic in the velocities."""
    notes = []
    if any(x != 0 for x in tape.substitute([*p, *p_w], at_rest)):
        notes.append(
            "The part of L that is linear in the velocities, a(q, t).qd, gives gyroscopic forces: "
            "its skew matrix is in C, da/dt in g."
        )
    if tape.substitute([e.kinetic], at_rest) != [S.Zero]:
        notes.append(
            "The part K0 of K that is free of velocities acts as -K0 in P: -dK0/dq is in g."
        )
    if t in tape.leaves_of([entry for row in D for entry in row]):
        notes.append(
            "D depends on time: C includes dD/dt, and Ddot - 2 C + dD/dt is skew-symmetric."
        )
    return tuple(notes)
