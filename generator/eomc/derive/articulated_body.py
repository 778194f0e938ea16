"""Accelerations of a kinematic tree by the articulated-body algorithm, without the mass matrix.

The joints are eliminated from the leaves to the base. Seen from its parent, a link resists with its
articulated inertia I^A less U U^T/d, the share that the joint does not transmit, where U = I^A s
for the joint axis s and d = s . U. Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7.
Here the forces at qdd = 0 (newton_euler.py) already contain gravity and all velocity terms, so the
articulated bias forces need no velocity terms of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sympy import Expr, S

from eomc.derive.newton_euler import ZERO, Inertia, Rows, TreeDynamics, Vector, symmetric_matrix
from eomc.derive.tape import Stage

Column = tuple[Sequence[Expr], Sequence[Expr]]  # U = I s of a joint axis s: moment, force
Pairs = tuple[tuple[Expr, Expr], ...]


class MasslessError(Exception):
    """Raised when a joint has no inertia along its axis, so that its acceleration is undetermined.

    The attribute `link` is the index of the link that the joint moves.
    """

    def __init__(self, link: int) -> None:
        self.link = link


def accelerations(dynamics: TreeDynamics, drive: Sequence[Expr]) -> tuple[list[Expr], Pairs]:
    """Return the joint accelerations of a kinematic tree by the articulated-body algorithm.

    Parameters
    ----------
    dynamics : TreeDynamics
        The kinematic tree with the inertias of its links.
    drive : sequence of Expr
        For each joint, the generalized force along it (force in N or moment in N m). Inertial and
        other forces of everything that is not part of the tree are already subtracted.

    Returns
    -------
    qdd : list of Expr
        The acceleration along each joint (rad/s^2 or m/s^2).
    pivots : tuple of (Expr, Expr)
        For each joint, the pivot d (its articulated inertia along the axis) and the magnitude of
        the terms that d was computed from. A small ratio of the two indicates cancellation.

    Raises
    ------
    MasslessError
        If a joint has no inertia along its axis.
    """
    return _Articulated(dynamics).solve(drive)


@dataclass
class _Inertia:
    """Articulated inertia about a point: moment = J alpha + H a, force = H^T alpha + M a."""

    J: Rows
    H: Rows
    M: Rows


class _Articulated:
    """The articulated-body algorithm: one pass eliminates the joints, another gives qdd."""

    def __init__(self, dynamics: TreeDynamics) -> None:
        self.dynamics, self.links = dynamics, dynamics.links
        self.tree, self.vectors = dynamics.tree, dynamics.vectors

    def solve(self, drive: Sequence[Expr]) -> tuple[list[Expr], Pairs]:
        r, V, tree = self.dynamics, self.vectors, self.tree
        n = r.n
        at_rest = r.forces(tree.speed, [S.Zero] * n)
        f, m = list(at_rest.force), list(at_rest.moment)
        bodies = [self._rigid_body_inertia(x) for x in r.inertia]
        size: list[Expr] = [S.Zero] * n
        pivots: list[tuple[Expr, Expr]] = []
        inverse: list[Expr] = [S.Zero] * n
        columns: list[Column] = [(ZERO, ZERO)] * n
        joint_force: list[Expr] = [S.Zero] * n
        for k in reversed(range(n)):
            link, body, a = self.links[k], bodies[k], self.links[k].axis
            columns_of_inertia = (body.J[a], [row[a] for row in body.H]), (body.H[a], body.M[a])
            u_m, u_f = (
                V.plus(V.scaled(by_turn, tree.angular[k]), V.scaled(by_slide, tree.linear[k]))
                for by_turn, by_slide in columns_of_inertia
            )
            d = V.add(tree.along_joint(k, u_f, u_m), r.armature[k])
            if d == 0:
                raise MasslessError(k)
            is_constant = V.tape.stage_of(d) <= Stage.PARAMETER
            pivots.append((d, d if is_constant else V.add(d, size[k])))
            inverse[k] = V.define(1 / d)
            columns[k] = (u_m, u_f)
            joint_force[k] = V.add(drive[k], V.minus(tree.along_joint(k, f[k], m[k])))
            if link.parent < 0:
                continue
            reduced = self._without_joint_motion(k, body, columns[k], inverse[k])
            ratio = V.times(joint_force[k], inverse[k])
            m[k] = V.plus(m[k], V.scaled(u_m, ratio))
            f[k] = V.plus(f[k], V.scaled(u_f, ratio))
            p = link.parent
            size[p] = V.add(size[p], self._unreduced_size(k, body))
            bodies[p] = self._sum(bodies[p], self._to_parent_frame(k, reduced))
            force, moment = tree.to_parent(k, f[k]), tree.to_parent(k, m[k])
            f[p] = V.plus(f[p], force)
            m[p] = V.plus(m[p], moment, V.cross(tree.arm[k], force))
        return self._outwards(columns, inverse, joint_force), tuple(pivots)

    def _outwards(
        self, columns: Sequence[Column], inverse: Sequence[Expr], joint_force: Sequence[Expr]
    ) -> list[Expr]:
        """Return qdd_k = (u_k - U_k . a)/d_k; a: the parent's spatial acceleration in frame k."""
        V, tree = self.vectors, self.tree
        out: list[Expr] = []
        alphas: list[Vector] = []
        origins: list[Vector] = []
        for k, link in enumerate(self.links):
            alpha, acceleration = ZERO, ZERO
            if (p := link.parent) >= 0:
                alpha = tree.from_parent(k, alphas[p])
                acceleration = tree.from_parent(
                    k, V.plus(origins[p], V.cross(alphas[p], tree.arm[k]))
                )
            u_m, u_f = columns[k]
            remaining = V.add(
                joint_force[k], V.minus(V.dot(u_m, alpha)), V.minus(V.dot(u_f, acceleration))
            )
            qdd = V.times(remaining, inverse[k])
            out.append(qdd)
            alphas.append(V.plus(alpha, tree.turn(k, qdd)))
            origins.append(V.plus(acceleration, tree.slide(k, qdd)))
        return out

    def _unreduced_size(self, k: int, body: _Inertia) -> Expr:
        """Return the scale of link k's inertia if its parent has none of its own, else 0.

        A parent with inertia or armature along its joint has a pivot that cannot vanish.
        """
        V, tree = self.vectors, self.tree
        p = self.links[k].parent
        parent = self.links[p]
        along_axis = parent.angular * parent.inertia[parent.axis], parent.linear * parent.mass
        if any(x != 0 for x in along_axis) or self.dynamics.armature[p] != 0:
            return S.Zero
        mass = [body.M[i][i] for i in range(3)]
        size = V.times(V.times(tree.linear[p], tree.linear[p]), V.add(*mass))
        if tree.angular[p] == 0:
            return size
        distance_squared = V.dot(tree.arm[k], tree.arm[k])
        turned = (V.times(distance_squared, m) for m in mass)
        return V.add(size, *(body.J[i][i] for i in range(3)), *turned)

    def _rigid_body_inertia(self, x: Inertia) -> _Inertia:
        """Return the articulated inertia of a single rigid body."""
        hx, hy, hz = x.moment
        minus = self.vectors.minus
        H = [[S.Zero, minus(hz), hy], [hz, S.Zero, minus(hx)], [minus(hy), hx, S.Zero]]
        J = [[x.entry(i, j) for j in range(3)] for i in range(3)]
        M = [[x.mass if i == j else S.Zero for j in range(3)] for i in range(3)]
        return _Inertia(J, H, M)

    def _without_joint_motion(
        self, k: int, body: _Inertia, column: Column, inverse: Expr
    ) -> _Inertia:
        """Return I - U U^T/d. Without armature, (I - U U^T/d) S is exactly zero.

        For a rotation or a translation, these are entries of the result.
        """
        V = self.vectors
        link = self.links[k]
        u_m, u_f = column
        w_m, w_f = V.scaled(u_m, inverse), V.scaled(u_f, inverse)

        def minus_product(old: Expr, a: Expr, b: Expr) -> Expr:
            return V.add(old, V.minus(V.times(a, b)))

        J = symmetric_matrix(lambda i, j: minus_product(body.J[i][j], w_m[i], u_m[j]))
        M = symmetric_matrix(lambda i, j: minus_product(body.M[i][j], w_f[i], u_f[j]))
        H = [[minus_product(body.H[i][j], w_m[i], u_f[j]) for j in range(3)] for i in range(3)]
        if self.dynamics.armature[k] == 0:
            a = link.axis
            for i in range(3):
                if link.linear == 0:
                    J[a][i] = J[i][a] = H[a][i] = S.Zero
                elif link.angular == 0:
                    M[a][i] = M[i][a] = H[i][a] = S.Zero
        return _Inertia(J, H, M)

    def _sum(self, first: _Inertia, second: _Inertia) -> _Inertia:
        """Return the sum of two inertias about the same origin in the same frame."""
        add = self.vectors.add

        def add_matrices(a: Rows, b: Rows) -> Rows:
            return [list(map(add, p, q)) for p, q in zip(a, b, strict=True)]

        return _Inertia(
            add_matrices(first.J, second.J),
            add_matrices(first.H, second.H),
            add_matrices(first.M, second.M),
        )

    def _to_parent_frame(self, k: int, x: _Inertia) -> _Inertia:
        """Transform an inertia from link k's frame to its parent's frame and origin."""
        V, tree = self.vectors, self.tree
        pairs = ((x.J, True), (x.H, False), (x.M, True))
        x = _Inertia(*(self.dynamics.matrix_to_parent(k, m, symmetric) for m, symmetric in pairs))
        arm = tree.arm[k]
        if arm == ZERO:
            return x
        columns = [V.cross(arm, column) for column in x.M]
        H = [[V.add(x.H[i][j], columns[j][i]) for j in range(3)] for i in range(3)]
        from_right = [V.cross(row, arm) for row in H]
        from_left = [V.cross(arm, row) for row in x.H]
        J = symmetric_matrix(
            lambda i, j: V.add(x.J[i][j], V.minus(from_right[i][j]), from_left[j][i])
        )
        return _Inertia(J, H, x.M)
