"""Derivatives of the accelerations of bodies on joints, from those of inverse dynamics.

With the accelerations qdd that solve ID(q, qd, qdd) = tau,

    dqdd/dx = -D^-1 d(ID - tau)/dx    for x = q, qd and u, at constant qdd,

and one factorization D = L diag(d) L^T serves qdd and all columns. By link, with spatial vectors
(moment or angular part first) in the link's frame and the motion subspace S_i of joint i:

    d tau_i/dq_j  = r1_i . Psid_j + r2_i . Psidd_j      j an ancestor of i, or i
    d tau_j/dq_i  = F1_i . S_j                          j a proper ancestor of i
    d tau_i/dqd_j = r1_i . S_j + 2 r2_i . Psid_j
    d tau_j/dqd_i = F2_i . S_j
    D_ij          = r2_i . S_j

    Psid = V x S,    Psidd = A x S + V x Psid,          V, A: motion of the parent
    r1 = (2 B)^T S,  r2 = I S
    F1 = 2 B Psid + I Psidd + S x* f,   F2 = 2 B S + 2 I Psid

I, B and f are the inertia, Coriolis matrix and force of everything beyond the joint. About any
point, the Coriolis matrix of a rigid body is determined by twelve numbers,

    2 B = -2 [[G, 0], [[p]x, 0]],   G = [w]x E + [h]x [v]x,   p = m v + w x h,

where w and v are its angular velocity and the velocity of the point, m, h and J its mass, first
moment and inertia tensor, and E = tr(J)/2 - J. Where a is the acceleration of the point (not the
spatial one) and e the axis, Psid = (w x e; v x e) and Psidd = (alpha x e + w x (w x e);
a x e + 2 v x (w x e)) for a revolute joint. For a prismatic joint, their linear parts are the
angular parts of a revolute one, and their angular parts are 0.

Source: Singh, Russell & Wensing, IEEE Robotics and Automation Letters 7(2), 2022.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sympy import Expr, S, Symbol

from eomc.derive.energies import energies_on_tape
from eomc.derive.lagrange import derive_motion_terms
from eomc.derive.ldl import Pairs, Rows, factorize
from eomc.derive.newton_euler import AXES, ZERO, Inertia, TreeDynamics, Vector, Vectors
from eomc.derive.outputs import MAX_LINEARIZATION_SIZE, differentiate
from eomc.derive.tape import Tape
from eomc.model.system import System
from eomc.model.tree import Tree

Matrix = list[list[Expr]]
Spatial = tuple[Vector, Vector]  # angular and linear part of a motion, or moment and force
Coriolis = tuple[Matrix, Vector]  # G and p of 2 B
Slopes = Sequence[Mapping[Symbol, Expr]]  # ds_k/dq of each link, by coordinate


@dataclass(frozen=True)
class AccelerationDerivatives:
    """The derivatives [dqdd/dq, dqdd/dqd, dqdd/du] by rows, as atoms of the attribute `tape`.

    accelerations: qdd itself. pivots: those of the factorization of D, each with the diagonal entry
    that it is computed from. order: indices of the coordinates in order of elimination.
    """

    tape: Tape
    rows: Rows
    accelerations: Sequence[Expr]
    pivots: Pairs
    order: tuple[int, ...]


def applies(system: System, tree: Tree) -> bool:
    """Return True if joints move all coordinates, and the expressions are not too long."""
    pairs, depths = 0, dict[int, int]()
    for k, link in enumerate(tree.links):
        depths[k] = depths.get(link.parent, 0) + 1
        pairs += depths[k]
    width = 2 * len(system.q) + len(system.u)
    return len(tree.rates) == len(system.q) and width * pairs <= MAX_LINEARIZATION_SIZE


def linearize(system: System, tree: Tree) -> AccelerationDerivatives:
    """Return the derivatives of the accelerations of a system of bodies on joints.

    The system has no constraints. Everything that is not part of the tree, such as springs and
    other energies, is differentiated as a residual at constant accelerations.

    Raises
    ------
    SceneError
        If the accelerations contain a discontinuous function.
    """
    e = energies_on_tape(system, tree.other_kinetic, tree.other_potential, accelerations=True)
    tape, q, n = e.tape, system.q, range(len(system.q))
    rest = derive_motion_terms(system, e)
    dynamics = TreeDerivatives(tape, tree)
    V, frames = dynamics.vectors, dynamics.tree

    def by_coordinate(by_link: Iterable[Expr], slopes: Slopes | None = None) -> list[Expr]:
        projected = frames.project_forces(by_link, slopes)
        return [projected.get(x, S.Zero) for x in q]

    columns = zip(*map(by_coordinate, dynamics.mass_matrix()), strict=True)
    M = [*map(by_coordinate, columns)]
    D = tuple(tuple(V.add(rest.D[i][j], M[min(i, j)][max(i, j)]) for j in n) for i in n)
    factors = factorize(tape, D, opaque=tape.opaque)
    bias = map(V.minus, by_coordinate(dynamics.bias()))
    qdd = factors.solve([V.add(*pair) for pair in zip(rest.balance, bias, strict=True)])

    constant = dict(zip(system.qdd, qdd, strict=True))
    rates = frames.joint_rates(dict(zip(q, system.qdd, strict=True)))
    accelerations = [V.add(*pair) for pair in zip(rates, frames.drift, strict=True)]
    residuals = [
        V.add(V.dot(row, system.qdd), V.minus(b))
        for row, b in zip(rest.D, rest.balance, strict=True)
    ]
    values = [*frames.displacement, *frames.speed, *accelerations, *residuals]
    J = dynamics.derivatives(tape.substitute(accelerations, constant))

    def column(x: Symbol) -> Sequence[Expr]:
        """Return dqdd/dx."""
        (tangents,) = differentiate(system, tape, values, [{x: S.One}])
        changes = iter(tape.substitute(tangents, constant))
        joints = [[next(changes) for _ in frames.links] for _ in range(3)]
        matrices = zip(J.displacement, J.speed, J.acceleration, strict=True)
        forces = [V.add(*map(V.dot, rows, joints)) for rows in matrices]
        slopes = [
            {y: tape.forward([slope], {x: S.One})[0] for y, slope in slopes.items()}
            for slopes in frames.slopes
        ]
        parts = (by_coordinate(forces), by_coordinate(J.forces, slopes), changes)
        return factors.solve([V.minus(V.add(*terms)) for terms in zip(*parts, strict=True)])

    rows = tuple(zip(*map(column, (*q, *system.qd, *system.u)), strict=True))
    return AccelerationDerivatives(
        tape, rows, qdd, factors.pivots, tuple(k for k, _, _ in factors.steps)
    )


@dataclass(frozen=True)
class ForceDerivatives:
    """The forces along the joints of a tree, and their derivatives at one state.

    displacement, speed, acceleration: their derivatives by the displacements of the joints, the
    speeds and the accelerations, (links, links); the last is the mass matrix.
    """

    forces: list[Expr]
    displacement: Matrix
    speed: Matrix
    acceleration: Matrix


class TreeDerivatives(TreeDynamics):
    """Derivatives of the inverse dynamics of a tree of links, as symbolic expressions."""

    def derivatives(self, joint_accelerations: Sequence[Expr]) -> ForceDerivatives:
        """Return the forces along the joints, and their derivatives, at given accelerations."""
        V, tree, n = self.vectors, self.tree, self.n
        forces = self.forces(tree.speed, joint_accelerations)
        spin = tree.angular_velocities(tree.speed)
        velocity = tree.velocities(tree.speed, spin)
        psi = [
            self._psi(k, self._parent_velocity(k, spin, velocity), motion)
            for k, motion in enumerate(forces.parent_motion)
        ]
        inertia = list(self.inertia)
        coriolis = [self._coriolis(*x) for x in zip(inertia, spin, velocity, strict=True)]
        wrench = list(zip(forces.moment, forces.force, strict=True))
        Jq, Jv, D = ([[S.Zero] * n for _ in range(n)] for _ in range(3))
        tau = [S.Zero] * n
        for k in reversed(range(n)):
            tau[k] = V.add(
                self._project(k, wrench[k]), V.times(self.armature[k], joint_accelerations[k])
            )
            r1, *wrenches = self._wrenches(k, inertia[k], coriolis[k], wrench[k], psi[k])
            j = k
            while True:
                r2, F1, F2 = wrenches
                psid, psidd = psi[j]
                Jq[k][j] = V.add(V.dot(r1, psid[0]), self._power(r2, psidd))
                Jv[k][j] = V.add(self._project(j, (r1, ZERO)), self._double(self._power(r2, psid)))
                D[k][j] = D[j][k] = self._project(j, r2)
                if j != k:
                    Jq[j][k], Jv[j][k] = self._project(j, F1), self._project(j, F2)
                if (p := self.links[j].parent) < 0:
                    break
                r1 = tree.to_parent(j, r1)
                wrenches = [self._wrench_to_parent(j, x) for x in wrenches]
                j = p
            D[k][k] = V.add(D[k][k], self.armature[k])
            if (p := self.links[k].parent) >= 0:
                inertia[p] = self._sum(inertia[p], self._to_parent_frame(k, inertia[k]))
                coriolis[p] = self._coriolis_with(coriolis[p], k, coriolis[k])
                wrench[p] = self._add(wrench[p], self._wrench_to_parent(k, wrench[k]))
        return ForceDerivatives(tau, Jq, Jv, D)

    # --- motion of the links ---------------------------------------------------------------------

    def _psi(
        self, k: int, v: Vector, motion: tuple[Vector, Vector, Vector]
    ) -> tuple[Spatial, Spatial]:
        """Return Psid and Psidd of joint k, from the motion of the parent's point at its origin.

        v: the velocity of the point. motion: the parent's angular velocity and acceleration, and
        the acceleration of the point.
        """
        V = self.vectors
        turn, slide = self._subspace(k)
        w, alpha, a = motion
        turned, slid = V.cross(w, turn), V.cross(w, slide)
        psid = turned, V.plus(V.cross(v, turn), slid)
        linear = V.plus(V.cross(alpha, slide), V.cross(w, slid), V.cross(a, turn))
        linear = V.plus(linear, V.scaled(V.cross(v, turned), S(2)))
        return psid, (V.plus(V.cross(alpha, turn), V.cross(w, turned)), linear)

    def _parent_velocity(
        self, k: int, spin: Sequence[Vector], velocity: Sequence[Vector]
    ) -> Vector:
        """Return the velocity of the parent's point at the origin of link k, in its frame."""
        V, tree = self.vectors, self.tree
        if (p := self.links[k].parent) < 0:
            return ZERO
        return tree.from_parent(k, V.plus(velocity[p], V.cross(spin[p], tree.arm[k])))

    def _subspace(self, k: int) -> Spatial:
        """Return the motion subspace S of joint k."""
        return self.tree.turn(k, S.One), self.tree.slide(k, S.One)

    # --- Coriolis matrices -----------------------------------------------------------------------

    def _coriolis(self, x: Inertia, w: Vector, v: Vector) -> Coriolis:
        """Return G and p of a link alone, with its angular velocity w and its origin's velocity."""
        V = self.vectors
        half = V.tape.scaled(S.Half, V.add(*(x.entry(i, i) for i in range(3))))
        E = [
            [V.add(half if i == j else S.Zero, V.minus(x.entry(i, j))) for j in range(3)]
            for i in range(3)
        ]
        columns = [V.cross(w, row) for row in E]
        G = _sum(V, list(zip(*columns, strict=True)), self._product_of_skews(x.moment, v))
        return G, V.plus(V.scaled(v, x.mass), V.cross(w, x.moment))

    def _coriolis_with(self, first: Coriolis, k: int, second: Coriolis) -> Coriolis:
        """Return the sum of `first`, of link k's parent, and `second`, of link k.

        A change of the origin by r adds [r]x [p]x to G.
        """
        V = self.vectors
        p = self.tree.to_parent(k, second[1])
        G = self.matrix_to_parent(k, second[0])
        moved = self._product_of_skews(self.tree.arm[k], p)
        return _sum(V, first[0], G, moved), V.plus(first[1], p)

    def _product_of_skews(self, a: Vector, b: Vector) -> Matrix:
        """Return [a]x [b]x = b a^T - (a . b) 1."""
        V = self.vectors
        products = [[V.times(x, y) for x in a] for y in b]
        for k, (i, j) in enumerate(AXES):
            products[k][k] = V.minus(V.add(V.times(a[i], b[i]), V.times(a[j], b[j])))
        return products

    # --- wrenches --------------------------------------------------------------------------------

    def _wrenches(
        self, k: int, inertia: Inertia, coriolis: Coriolis, wrench: Spatial,
        psi: tuple[Spatial, Spatial],
    ) -> tuple[Vector, Spatial, Spatial, Spatial]:  # fmt: skip
        """Return the moment r1, whose force is 0, and r2, F1 and F2 of joint k."""
        V, minus_two = self.vectors, S(-2)
        (turn, slide), (G, p), (psid, psidd) = self._subspace(k), coriolis, psi
        moment, force = wrench
        across = V.plus(V.apply(list(zip(*G, strict=True)), turn), V.cross(slide, p))

        def coriolis_times(w: Vector) -> Spatial:
            return V.scaled(V.apply(G, w), minus_two), V.scaled(V.cross(p, w), minus_two)

        spun = V.plus(V.cross(turn, moment), V.cross(slide, force)), V.cross(turn, force)
        heavy = self._inertia_times(inertia, psid)
        F1 = self._add(coriolis_times(psid[0]), self._inertia_times(inertia, psidd), spun)
        F2 = self._add(coriolis_times(turn), heavy, heavy)
        return V.scaled(across, minus_two), self._inertia_times(inertia, (turn, slide)), F1, F2

    def _inertia_times(self, x: Inertia, motion: Spatial) -> Spatial:
        """Return the product of an inertia and a motion."""
        V, (w, v) = self.vectors, motion
        moment = V.plus(V.apply(x.tensor, w), V.cross(x.moment, v))
        return moment, V.plus(V.scaled(v, x.mass), V.cross(w, x.moment))

    def _wrench_to_parent(self, k: int, wrench: Spatial) -> Spatial:
        """Return a wrench at link k's origin in the frame of its parent, about its origin."""
        V, tree = self.vectors, self.tree
        moment, force = (tree.to_parent(k, x) for x in wrench)
        return V.plus(moment, V.cross(tree.arm[k], force)), force

    def _add(self, *wrenches: Spatial) -> Spatial:
        """Return the sum of wrenches."""
        moment, force = (self.vectors.plus(*parts) for parts in zip(*wrenches, strict=True))
        return moment, force

    def _project(self, k: int, wrench: Spatial) -> Expr:
        """Return S . wrench for the motion subspace S of joint k."""
        return self.tree.along_joint(k, wrench[1], wrench[0])

    def _power(self, wrench: Spatial, motion: Spatial) -> Expr:
        """Return the product of a wrench and a motion."""
        return self.vectors.add(*map(self.vectors.dot, wrench, motion))


def _sum(V: Vectors, *matrices: Sequence[Sequence[Expr]]) -> Matrix:
    """Return the sum of 3 x 3 matrices."""
    return [
        [V.add(*parts) for parts in zip(*rows, strict=True)] for rows in zip(*matrices, strict=True)
    ]
