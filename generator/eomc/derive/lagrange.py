"""Lagrange's equations on a tape: D, C, g, bias, generalized forces and accelerations.

With K, P and R as programs over named positions, the equations of motion

    D(q) qdd + bias(q, qd, t) = tau,    bias = C qd + g,    tau = Q - dR/dqd

follow by automatic differentiation (tape.py). What a scene writes as dot(y) is an independent
velocity w: since d(ydot)/dq = d/dt (dy/dq), Lagrange's operator has the same form in any
coordinates, so

    bias_i = d/dt(dF/dqd_i) - dF/dq_i + dP/dq_i + sum_k d/dt(dF/dw_k) dy_k/dq_i

with K = F(q, qd, w, t) and d/dt taken at qdd = 0. The last term is the inertial forces of the
points, projected by one reverse pass over their positions. This has the operation count of the
recursive Newton-Euler algorithm, and avoids terms that cancel when K is differentiated as a
function of q and qd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NoReturn

import sympy
from sympy import Expr, S, Symbol

from eomc.base.errors import Problem, SceneError
from eomc.derive import link_multipliers
from eomc.derive.articulated_body import MasslessError, accelerations
from eomc.derive.constraints import Constraints, constraints
from eomc.derive.energies import Energies, energies_on_tape, tangent_symbols
from eomc.derive.ldl import Rows, Solution, SolveResult, Vector, count_operations, solve
from eomc.derive.newton_euler import TreeDynamics
from eomc.derive.tape import NotDifferentiableError, Stage, Tape
from eomc.model.symbols import needed_definitions
from eomc.model.system import System, symbol, t
from eomc.model.tree import Tree

# Up to this many world coordinates of a tree, Lagrange's method may need fewer operations than the
# recursive algorithms, so both are derived.
MAX_LAGRANGE_DEFINITIONS = 12
# With more coordinates D is given as a product with a direction, unless elimination needs it whole.
MAX_UNROLLED_COORDINATES = 16
# Matrices with more names on the tape than this are not unrolled: they are given as the product
# with a symbolic direction, from which the C code computes one column per call.
UNROLLED_SIZE_LIMIT = 2500
# The reason why articulated bodies are not used.
MASSLESS = "a motion that nothing resists"


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
class EquationsOfMotion(MotionTerms):
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


@dataclass(frozen=True)
class Derivation:
    """The equations of motion of a system, derived by several methods.

    The compiler later selects the method whose code is fastest.

    Attributes
    ----------
    lagrange : EquationsOfMotion or None
        By differentiation of K and P; None where that method was not used.
    newton_euler : EquationsOfMotion or None
        By the recursive Newton-Euler algorithm; None for a system without bodies on joints.
    ldl : SolveResult
        Accelerations by L D L^T factorization of the mass matrix that Lagrange's method gives.
    composite : SolveResult
        Accelerations by L D L^T factorization of the mass matrix from composite bodies.
    articulated : SolveResult
        Accelerations by the articulated-body algorithm.
    multipliers : SolveResult
        Accelerations by link multipliers, the tensions of massless links between point masses.

    A SolveResult is a solution of D qdd = tau - bias, or a str with the reason why the method was
    not used. It is None if the method does not apply, as for a system with constraints.
    """

    system: System
    lagrange: EquationsOfMotion | None
    newton_euler: EquationsOfMotion | None
    ldl: SolveResult
    composite: SolveResult
    articulated: SolveResult
    multipliers: SolveResult


def derive(system: System) -> Derivation:
    """Return the equations of motion of `system`, derived by all methods that apply.

    Raises
    ------
    SceneError
        If K is not quadratic in the velocities, or a coordinate has no inertia.

    References
    ----------
    Greenwood, *Advanced Dynamics*, sec. 2.1 (Lagrange) and 2.3 (Jacobi's integral).
    Spong, Hutchinson & Vidyasagar, *Robot Modeling and Control*, sec. 6.3 (matrix C).
    """
    lagrange = newton_euler = articulated = composite = multipliers = None
    places = len(needed_definitions(system.definitions, (system.kinetic, system.potential)))
    ldl: SolveResult = f"{places} world coordinates to differentiate"
    try:
        if system.tree is None or places <= MAX_LAGRANGE_DEFINITIONS:
            lagrange, ldl, multipliers = _by_lagrange(system)
        if system.tree is not None:
            newton_euler, articulated, composite = _by_newton_euler(system, system.tree)
        if lagrange is None and not system.constraints:
            multipliers = _by_multipliers(system)
    except NotDifferentiableError:  # P and R are differentiated once, K and constraints twice
        if rough := _rough_rows(system):
            raise SceneError(rough) from None
        message = (
            "a second derivative of the kinetic energy jumps: it must be quadratic in the "
            "velocities and smooth; abs, sign, min, max and roots of velocities are not"
        )
        raise SceneError([system.problem("energy.kinetic", message)]) from None
    return Derivation(system, lagrange, newton_euler, ldl, composite, articulated, multipliers)


def _rough_rows(system: System) -> list[Problem]:
    """Return the problems of constraints that have no second derivative."""
    problems, without_energies = [], replace(system, kinetic=S.Zero, potential=S.Zero, tree=None)
    for row in system.constraints:
        alone = replace(without_energies, constraints=(row,))
        try:
            constraints(alone, energies_on_tape(alone, S.Zero, S.Zero))
        except NotDifferentiableError:
            key = f"loop.{row.loop}" if row.loop else f"constraints.{row.name}"
            message = (
                "abs, min and max have corners, and constraints are differentiated twice: write "
                "the side that is meant, such as x for abs(x)"
            )
            problems.append(system.problem(key, message))
    return problems


def _by_lagrange(system: System) -> tuple[EquationsOfMotion, SolveResult, SolveResult]:
    """Return the equations, and the accelerations by L D L^T and by link multipliers."""
    e = energies_on_tape(system, system.kinetic, system.potential)
    motion = derive_motion_terms(system, e)
    if system.constraints:
        result = equations(system, e, motion)
        _refuse_massless(system, motion.D, result.rows)
        return result, None, None
    _refuse_massless(system, motion.D)
    multipliers, operations = _by_multipliers(system), count_operations(motion.D)
    ldl: SolveResult = f"{operations} flops for elimination alone"
    if (
        not isinstance(multipliers, Solution)
        or len(system.q) <= MAX_UNROLLED_COORDINATES
        or operations <= _length(multipliers)
    ):
        ldl = solve(e.tape, motion.D, motion.balance)
    return equations(system, e, motion), ldl, multipliers


def _by_newton_euler(
    system: System, tree: Tree
) -> tuple[EquationsOfMotion, SolveResult, SolveResult]:
    """Return the equations, and the accelerations by articulated and by composite bodies.

    Bodies on joints by the recursive Newton-Euler algorithm, all other energies by Lagrange's
    method.
    """
    e = energies_on_tape(system, tree.other_kinetic, tree.other_potential)
    tape, q = e.tape, system.q
    rest = derive_motion_terms(system, e)
    dynamics = TreeDynamics(tape, tree)

    def by_coordinate(by_link: Sequence[Expr]) -> list[Expr]:
        projected = dynamics.tree.project_forces(by_link)
        return [projected.get(x, S.Zero) for x in q]

    bias = by_coordinate(dynamics.bias())
    motion = replace(
        rest,
        bias=_sums(tape, rest.bias, bias),
        g=_sums(tape, rest.g, by_coordinate(dynamics.gravity_forces())),
        balance=_sums(tape, rest.balance, [-x for x in bias]),
    )
    constrained = bool(system.constraints)
    articulated = None if constrained else _by_articulated_bodies(system, dynamics, rest)
    operations = dynamics.count_elimination_operations()
    use_articulated = isinstance(articulated, Solution) and operations > _length(articulated)
    if use_articulated and len(q) > MAX_UNROLLED_COORDINATES:
        direction = dynamics.tree.joint_rates(tangent_symbols(system))
        D: Rows = (tuple(by_coordinate(dynamics.mass_times(direction))),)
    else:
        columns = zip(*map(by_coordinate, dynamics.mass_matrix()), strict=True)
        matrix = [
            *map(by_coordinate, columns)
        ]  # by column; only one of two symmetric entries is used
        rows = [[matrix[min(i, j)][max(i, j)] for j in range(len(q))] for i in range(len(q))]
        D = tuple(_sums(tape, *pair) for pair in zip(rest.D, rows, strict=True))
        if not constrained:
            _refuse_massless(system, D)
    composite: SolveResult = None if constrained else f"{operations} flops for elimination alone"
    if not use_articulated and not constrained:
        composite = solve(tape, D, motion.balance)
    e.kinetic = tape.total([e.kinetic, dynamics.kinetic_energy()])
    e.potential = tape.total([e.potential, dynamics.potential_energy()])
    result = equations(system, e, replace(motion, D=D))
    if constrained:
        _refuse_massless(system, D, result.rows)
    return result, articulated, composite


def _by_articulated_bodies(
    system: System, dynamics: TreeDynamics, rest: MotionTerms
) -> SolveResult:
    """Return accelerations by articulated bodies if all inertia belongs to joints with one
    coordinate each.
    """
    q, links = system.q, dynamics.links
    if not dynamics.tree.has_own_coordinates:
        return "joints that move together"
    if len(links) < len(q) or any(x != 0 for column in rest.D for x in column):
        return None
    link_of = {link.q: k for k, link in enumerate(links)}
    try:
        qdd, pivots = accelerations(dynamics, [rest.balance[q.index(link.q)] for link in links])
    except MasslessError:  # D is singular; `program.inertia` reports the motion without inertia
        return MASSLESS
    order = tuple(q.index(link.q) for link in reversed(links))
    return Solution(dynamics.vectors.tape, tuple(qdd[link_of[x]] for x in q), order, pivots)


def _by_multipliers(system: System) -> SolveResult:
    """Return accelerations by link multipliers, or the reason why they do not apply."""
    try:
        return link_multipliers.solution(system)
    except link_multipliers.UnsuitedError as reason:
        return str(reason)


def _length(solution: Solution) -> int:
    """Return the number of definitions that the accelerations depend on, about their operation
    count.
    """
    return len(solution.tape.live(solution.acceleration))


def _refuse_massless(system: System, D: Rows, rows: Constraints | None = None) -> None:
    """Raise SceneError where a coordinate occurs neither in D nor in a constraint."""
    for k, (c, row) in enumerate(zip(system.coordinates, D, strict=True)):
        is_constrained = rows is not None and any(row[k] != 0 for row in rows.jacobian)
        if all(entry == 0 for entry in row) and not is_constrained:
            _raise_no_inertia(system, c.name)


def _raise_no_inertia(system: System, name: str) -> NoReturn:
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


def _sums(tape: Tape, first: Sequence[Expr], second: Sequence[Expr]) -> Vector:
    """Return the sums of corresponding entries."""
    return tuple(tape.total(pair) for pair in zip(first, second, strict=True))


# --- Lagrange's operator --------------------------------------------------------------------------


def derive_motion_terms(system: System, e: Energies) -> MotionTerms:
    """Derive D, bias, g, tau and b = tau - bias of the energies on a tape."""
    tape, q, qd = e.tape, system.q, system.qd
    w = list(e.points)
    stop = frozenset(w)

    momenta, momentum_rates = _momenta(system, e, {})
    p, p_w = momenta[: len(q)], momenta[len(q) :]
    p_dot, p_w_dot = momentum_rates[: len(q)], momentum_rates[len(q) :]
    dissipative = [(e.dissipation, S.One), *((v, -force) for v, force in e.applied)]
    friction = tape.gradient(dissipative, [*qd, *w], stop)
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
    depends_on_time = t in tape.leaves_of([e.kinetic, e.linear_potential])
    quadratic = (
        all(x == 0 for x in tape.substitute([e.kinetic, *p, *p_w], at_rest)) and not depends_on_time
    )
    g = tape.gradient([(e.potential, S.One)], q) if quadratic else tape.substitute(bias, at_rest)

    # b in D qdd = b, with all forces projected in one reverse pass
    if e.dissipation == 0 and not e.applied:
        b = [add(force, -c) for force, c in zip(e.forces, bias, strict=True)]
    else:
        seeds = [add(i, f) for i, f in zip(p_w_dot, r_w, strict=True)]
        forces = projected(seeds, *lagrangian)
        b = [
            add(force, -inertia, -drag, -inertia_and_potential)
            for force, inertia, drag, inertia_and_potential in zip(
                e.forces, p_dot, r, forces, strict=True
            )
        ]
    notes = _notes(tape, e, p, p_w, at_rest, D)
    return MotionTerms(D, tuple(bias), tuple(g), tuple(tau), tuple(b), quadratic, notes)


def _momenta(
    system: System, e: Energies, accelerations: Mapping[Symbol, Expr]
) -> tuple[list[Expr], list[Expr]]:
    """Return dL/dqd and dL/dw, and their time derivatives. The rate of a velocity not in
    `accelerations` is 0.
    """
    rates: dict[Symbol, Expr] = {**system.rates, t: S.One, **accelerations}
    velocities = [*system.qd, *e.points]
    lagrangian = [(e.kinetic, S.One), (e.linear_potential, S.NegativeOne)]
    momenta = e.tape.gradient(lagrangian, velocities, frozenset(e.points))
    return momenta, e.tape.forward(momenta, rates)


def _lagrangian(e: Energies) -> list[tuple[Expr, Expr]]:
    """Return -L = P - K as (output, seed) pairs of a gradient."""
    return [(e.kinetic, S.NegativeOne), (e.potential, S.One), (e.linear_potential, S.One)]


def _mass_matrix(
    system: System, e: Energies, momenta: list[Expr], projected: Callable[[list[Expr]], list[Expr]]
) -> Rows:
    """Return D_ij = d(dF/dqd_i)/dqd_j + sum_k d(dF/dw_k)/dqd_j dy_k/dq_i, one column per pass."""
    tape, n = e.tape, len(system.q)
    columns: list[list[Expr]] = []
    for velocity in system.qd:
        column = tape.forward(momenta, {velocity: S.One})
        at_points = projected(column[n:])
        columns.append([tape.define(a + b) for a, b in zip(column[:n], at_points, strict=True)])
    # D is symmetric, and its two triangles may differ in cost
    triangles = [
        [[columns[row_of(i, j)][column_of(i, j)] for j in range(n)] for i in range(n)]
        for row_of, column_of in ((min, max), (max, min))
    ]
    D = min(triangles, key=lambda half: len(tape.live(entry for row in half for entry in row)))
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
    """Return where terms of K that are not quadratic in the velocities appear in the equations."""
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


# --- the Coriolis matrix, the energy integral and its rate ----------------------------------------


def equations(system: System, e: Energies, motion: MotionTerms) -> EquationsOfMotion:
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
    return EquationsOfMotion(
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


# --- inverse dynamics -----------------------------------------------------------------------------


def inverse_dynamics(system: System) -> tuple[Tape, Sequence[Expr]]:
    """Return the pair (tape, tau) with the generalized forces tau = D qdd + C qd + g, shape (nq,).

    The tape is the list of elementary operations that compute tau from q, qd, qdd, t and the
    parameters. tau is derived without forming the matrix D: for trees of bodies by the recursive
    Newton-Euler algorithm (newton_euler.py), for energies that are written as K and P by Lagrange's
    operator.
    """
    tree = system.tree
    kinetic, potential = (
        (tree.other_kinetic, tree.other_potential) if tree else (system.kinetic, system.potential)
    )
    e = energies_on_tape(system, kinetic, potential, accelerations=True)
    accelerations = dict(zip(system.qd, system.qdd, strict=True))
    terms_of = [[x] for x in _inertial_forces(system, e, accelerations)]
    if tree:
        dynamics = TreeDynamics(e.tape, tree)
        joint_accelerations = dynamics.tree.joint_rates(
            dict(zip(system.q, system.qdd, strict=True))
        )
        tree_forces = dynamics.tree.project_forces(dynamics.inverse_dynamics(joint_accelerations))
        for terms, q in zip(terms_of, system.q, strict=True):
            terms.append(tree_forces.get(q, S.Zero))
    return e.tape, [e.tape.total(x for x in terms if x is not S.Zero) for terms in terms_of]


def _inertial_forces(
    system: System, e: Energies, accelerations: Mapping[Symbol, Expr]
) -> list[Expr]:
    """Return the generalized force D qdd + bias of each coordinate, derived from the energies `e`.

    It is computed by Lagrange's operator. `accelerations` maps each velocity symbol to the
    expression of its time derivative.
    """
    tape, q = e.tape, system.q
    momentum_rates = _momenta(system, e, accelerations)[1]
    seeds = [*_lagrangian(e), *zip(e.points.values(), momentum_rates[len(q) :], strict=True)]
    projected = tape.gradient(seeds, q, frozenset(e.points))
    return [tape.total(x) for x in zip(momentum_rates[: len(q)], projected, strict=True)]
