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
from typing import NoReturn

import sympy
from sympy import Expr, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive import link_tensions
from eomc.derive.articulated_body import MasslessError, accelerations
from eomc.derive.energies import Energies, directions, on_tape
from eomc.derive.ldl import Rows, Solution, Vector, solve, work
from eomc.derive.newton_euler import Recursion
from eomc.derive.tape import RoughError, Stage, Tape
from eomc.model.multibody import Tree
from eomc.model.symbols import ALONG
from eomc.model.system import System, symbol, t

LAGRANGE_DEFINITIONS = 12  # of a tree's world coordinates: beyond, recursion always needs less
MOST_ROWS = 16  # coordinates from which D is computed column by column, where nothing needs it
WRITTEN_OUT = 2500  # names on the tape, about, from which C is computed column by column


@dataclass(frozen=True)
class Equations:
    """The equations of motion as atoms of a tape; shapes as in the field: D, C (nq, nq).

    D, C: by rows, or where that would be long a single column, D e and C e, for a direction e
    whose entries are the leaves `along` (then `is_column`). kinetic, potential: K and P.
    jacobi: p.qd - K + P, what is conserved without forces and explicit time; None where it is
    K + P. power: d(jacobi)/dt; 0 for a conservative system. balance: b in D qdd = b.
    solutions: the accelerations, by route; passed_over: routes that were not tried, and why.
    notes: where unusual terms of K went.
    """

    system: System
    tape: Tape
    D: Rows
    C: Rows
    g: Vector
    bias: Vector
    tau: Vector
    signals: Vector
    kinetic: Expr
    potential: Expr
    jacobi: Expr | None
    power: Expr
    balance: Vector
    solutions: Mapping[str, Solution]
    passed_over: Mapping[str, str]
    notes: tuple[str, ...]


def derive(system: System) -> dict[str, Equations]:
    """The equations of motion of `system` by each way that may be worth its while.

    "program" is Lagrange's way over the program of K and P; "tree" the recursive one, where bodies
    hang on joints. The first that there is has the tensions among its solutions, where they apply.
    Raises SceneError where K is not quadratic in the velocities or a coordinate has no inertia.
    Source: Greenwood, *Advanced Dynamics*, sec. 2.1 (Lagrange) and 2.3 (Jacobi's integral); C from
    Spong, Hutchinson & Vidyasagar, *Robot Modeling and Control*, sec. 6.3.
    """
    out: dict[str, Equations] = {}
    try:
        if system.tree is None or len(system.definitions) <= LAGRANGE_DEFINITIONS:
            out["program"] = _by_lagrange(system)
        if system.tree is not None:
            out["tree"] = _by_recursion(system, system.tree)
    except RoughError:  # P and R are differentiated once, K twice
        message = (
            "a second derivative of the kinetic energy jumps: it must be quadratic in the "
            "velocities and smooth; abs, sign, min, max and roots of velocities are not"
        )
        raise SceneError([system.problem("energy.kinetic", message)]) from None
    return out


def _by_lagrange(system: System) -> Equations:
    e = on_tape(system, system.kinetic, system.potential)
    motion = _lagrange(system, e)
    _has_inertia(system, motion.D)
    solutions, passed_over = _by_tensions(system)
    elimination = work(motion.D)
    if solutions and len(system.q) > MOST_ROWS and elimination > _length(solutions["tensions"]):
        passed_over["program"] = f"{elimination} flops for elimination alone"
    else:
        order, acceleration, pivots = solve(e.tape, motion.D, motion.balance)
        solutions = {"program": Solution(e.tape, acceleration, order, pivots), **solutions}
    return _equations(system, e, motion, solutions, passed_over)


def _by_recursion(system: System, tree: Tree) -> Equations:
    """Newton and Euler for the tree, Lagrange for what is beside it."""
    e = on_tape(system, tree.beside_kinetic, tree.beside_potential)
    tape, q = e.tape, system.q
    beside = _lagrange(system, e)
    recursion = Recursion(tape, tree)
    at = {link.q: k for k, link in enumerate(tree.links)}

    def placed(by_link: Sequence[Expr]) -> list[Expr]:
        return [by_link[at[x]] if x in at else S.Zero for x in q]

    bias = placed(recursion.bias())
    motion = replace(
        beside,
        bias=_sums(tape, beside.bias, bias),
        g=_sums(tape, beside.g, placed(recursion.gravity_forces())),
        balance=_sums(tape, beside.balance, [-x for x in bias]),
    )
    solutions: dict[str, Solution] = {}
    alone = all(x == 0 for column in beside.D for x in column) and len(at) == len(q)
    if alone:
        drive = [beside.balance[q.index(link.q)] for link in tree.links]
        try:
            found, pivots = accelerations(recursion, drive)
        except MasslessError as fault:
            _no_inertia(system, tree.links[fault.link].q.name)
        order = tuple(q.index(link.q) for link in reversed(tree.links))
        solutions["articulated"] = Solution(tape, tuple(found[at[x]] for x in q), order, pivots)
    passed_over: dict[str, str] = {}
    more: dict[str, Solution] = {}
    if len(system.definitions) > LAGRANGE_DEFINITIONS:  # else Lagrange's way has the tensions
        more, passed_over = _by_tensions(system)
        passed_over["program"] = f"{len(system.definitions)} world coordinates to differentiate"
    elimination = recursion.elimination()
    long = solutions and elimination > len(tape.live(solutions["articulated"].acceleration))
    if long and len(q) > MOST_ROWS:
        D = _column(system, tape, recursion, at)
    else:
        rows = recursion.mass_matrix()
        D = tuple(
            tuple(
                tape.total([beside.D[i][j], rows[at[x]][at[y]] if {x, y} <= at.keys() else S.Zero])
                for j, y in enumerate(q)
            )
            for i, x in enumerate(q)
        )
        _has_inertia(system, D)
    if long:
        passed_over["composite"] = f"{elimination} flops for elimination alone"
    else:
        order, acceleration, pivots = solve(tape, D, motion.balance)
        solutions["composite"] = Solution(tape, acceleration, order, pivots)
    solutions |= more
    e.kinetic = tape.total([e.kinetic, recursion.kinetic_energy()])
    e.potential = tape.total([e.potential, recursion.potential_energy()])
    return _equations(system, e, replace(motion, D=D), solutions, passed_over)


def _by_tensions(system: System) -> tuple[dict[str, Solution], dict[str, str]]:
    """One more way to the accelerations, or why there is none."""
    try:
        return {"tensions": link_tensions.solution(system)}, {}
    except link_tensions.UnsuitedError as why:
        return {}, {"tensions": str(why)}


def _length(solution: Solution) -> int:
    """The names that a solution hangs on, about its operations."""
    return len(solution.tape.live(solution.acceleration))


def along(system: System) -> list[Symbol]:
    """The entries of a direction e, for D e and C e."""
    return [symbol(f"{c.name}{ALONG}") for c in system.coordinates]


def linearization(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """[da/dq, da/dqd, da/du] at held inputs, (nq, 2 nq + nu), of accelerations a on the tape.

    By rows, or where that would be long a single column, the derivative along a direction whose
    entries are `directions`. Raises SceneError where the accelerations jump.
    """
    entries = directions(system)
    if len(entries) * len(tape.live(accelerations)) > WRITTEN_OUT:
        return (_slopes(system, tape, accelerations, [entries])[0],)
    columns = _slopes(system, tape, accelerations, [{x: S.One} for x in entries])
    return tuple(zip(*columns, strict=True))


def sensitivity(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """da/dp at held inputs, (nq, np), of accelerations a on the tape. Raises as linearization."""
    entries = [{p.symbol: S.One} for p in system.parameters]
    return tuple(zip(*_slopes(system, tape, accelerations, entries), strict=True))


def _slopes(
    system: System,
    tape: Tape,
    accelerations: Sequence[Expr],
    along: Sequence[Mapping[Symbol, Expr]],
) -> list[Vector]:
    """The derivatives of accelerations along each of some directions."""
    try:
        return [tuple(tape.forward(accelerations, entries)) for entries in along]
    except RoughError:
        message = (
            "the accelerations jump (sign or heaviside of a coordinate or velocity), so they have "
            "no derivatives: make them smooth, say tanh(x/width), or do without linearize and the "
            "implicit methods"
        )
        raise SceneError([system.problem("run", message)]) from None


def _column(system: System, tape: Tape, recursion: Recursion, at: Mapping[Symbol, int]) -> Rows:
    """D e for a direction e."""
    direction = dict(zip(system.q, along(system), strict=True))
    found = recursion.mass_times([direction[link.q] for link in recursion.links])
    return (tuple(found[at[x]] for x in system.q),)


def _sums(tape: Tape, one: Sequence[Expr], other: Sequence[Expr]) -> Vector:
    return tuple(tape.total(pair) for pair in zip(one, other, strict=True))


@dataclass(frozen=True)
class _Motion:
    """What Lagrange's equations give: D, bias, its part g at rest, tau and D qdd = balance."""

    D: Rows
    bias: Vector
    g: Vector
    tau: Vector
    balance: Vector
    quadratic: bool  # K is so in the velocities, with nothing else and without explicit time
    notes: tuple[str, ...]


def _lagrange(system: System, e: Energies) -> _Motion:
    tape, q, qd = e.tape, system.q, system.qd
    w = list(e.points)
    stop = frozenset(w)
    rates: dict[Symbol, Expr] = {**dict(zip(q, qd, strict=True)), t: S.One}

    # momenta dF/dqd and dF/dw, and their rates at qdd = 0
    momenta = tape.gradient([(e.kinetic, S.One)], [*qd, *w], stop)
    p, p_w = momenta[: len(q)], momenta[len(q) :]
    moving = tape.forward(momenta, rates)
    p_dot, p_w_dot = moving[: len(q)], moving[len(q) :]
    friction = tape.gradient([(e.dissipation, S.One)], [*qd, *w], stop)
    r, r_w = friction[: len(q)], friction[len(q) :]

    def projected(at_points: list[Expr], *energies: tuple[Expr, Expr]) -> list[Expr]:
        seeds = [*energies, *zip(e.points.values(), at_points, strict=True)]
        return tape.gradient(seeds, q, stop)

    def add(*terms: Expr) -> Expr:
        return tape.define(sympy.Add(*terms))

    lagrangian = ((e.kinetic, S.NegativeOne), (e.potential, S.One))
    bias = [add(a, b) for a, b in zip(p_dot, projected(p_w_dot, *lagrangian), strict=True)]
    damping = [add(a, b) for a, b in zip(r, projected(r_w), strict=True)]
    tau = [add(force, -drag) for force, drag in zip(e.forces, damping, strict=True)]

    D = _mass_matrix(system, e, [*p, *p_w], projected)

    at_rest = dict.fromkeys(qd, S.Zero)
    driven = t in tape.leaves_of([e.kinetic])
    quadratic = all(x == 0 for x in tape.substitute([e.kinetic, *p, *p_w], at_rest)) and not driven
    g = tape.gradient([(e.potential, S.One)], q) if quadratic else tape.substitute(bias, at_rest)

    # D qdd = b, the forces projected in one sweep
    if e.dissipation == 0:
        b = [add(force, -c) for force, c in zip(e.forces, bias, strict=True)]
    else:
        seeds = [add(i, f) for i, f in zip(p_w_dot, r_w, strict=True)]
        whole = projected(seeds, *lagrangian)
        b = [
            add(force, -inertia, -drag, -rest)
            for force, inertia, drag, rest in zip(e.forces, p_dot, r, whole, strict=True)
        ]
    notes = _notes(tape, e, p, p_w, at_rest, D)
    return _Motion(D, tuple(bias), tuple(g), tuple(tau), tuple(b), quadratic, notes)


def _equations(
    system: System, e: Energies, motion: _Motion, solutions: Mapping[str, Solution],
    passed_over: Mapping[str, str],
) -> Equations:  # fmt: skip
    tape, qd = e.tape, system.qd

    def add(*terms: Expr) -> Expr:
        return tape.define(sympy.Add(*terms))

    euler = dict(zip(qd, qd, strict=True))
    jacobi = None
    if not motion.quadratic:
        (twice,) = tape.forward([e.kinetic], euler)
        jacobi = add(twice, -e.kinetic, e.potential)
    explicit = tape.forward([e.kinetic, e.potential], {t: S.One})
    (lost,) = tape.forward([e.dissipation], euler)
    works = [tape.define(force * v) for force, v in zip(e.forces, qd, strict=True)]
    power = add(*works, -lost, explicit[1], -explicit[0])
    return Equations(
        system=system,
        tape=tape,
        D=motion.D,
        C=_coriolis(system, tape, motion.bias, motion.quadratic),
        g=motion.g,
        bias=motion.bias,
        tau=motion.tau,
        signals=tuple(e.signals),
        kinetic=e.kinetic,
        potential=e.potential,
        jacobi=jacobi,
        power=power,
        balance=motion.balance,
        solutions=solutions,
        passed_over=passed_over,
        notes=motion.notes,
    )


def _mass_matrix(
    system: System,
    e: Energies,
    momenta: list[Expr],
    projected: Callable[[list[Expr]], list[Expr]],
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


def _has_inertia(system: System, D: Sequence[Sequence[Expr]]) -> None:
    for c, row in zip(system.coordinates, D, strict=True):
        if all(entry == 0 for entry in row):
            _no_inertia(system, c.name)


def _no_inertia(system: System, name: str) -> NoReturn:
    links = system.tree.links if system.tree else ()
    body = next((link.name for link in links if link.q.name == name), "")
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
    raise SceneError([system.problem(key, message)])


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
        return (tuple(column(dict(zip(system.qd, along(system), strict=True)))),)
    columns = [column({velocity: S.One}) for velocity in system.qd]
    return tuple(tuple(column[i] for column in columns) for i in range(len(columns)))


def _notes(
    tape: Tape, e: Energies, p: list[Expr], p_w: list[Expr], at_rest: dict[Symbol, Expr], D: Rows
) -> tuple[str, ...]:
    """Where terms of K went that are not quadratic in the velocities."""
    notes = []
    if any(x != 0 for x in tape.substitute([*p, *p_w], at_rest)):
        notes.append(
            "The part of K that is linear in the velocities, a(q, t).qd, gives gyroscopic forces: "
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
