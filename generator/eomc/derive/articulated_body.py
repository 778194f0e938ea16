"""Accelerations of a tree without its mass matrix: articulated bodies.

Each joint is eliminated on the way inwards: what is beyond it resists the parent with its
inertia less what the joint gives way. Source: Featherstone, *Rigid Body Dynamics Algorithms*,
ch. 7. Here the forces at qdd = 0 (newton_euler.py) hold all that velocities and gravity do, so no
term of theirs is left: each link's wrench is that force plus its inertia times what qdd adds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

from sympy import Expr, S

from eomc.derive.newton_euler import Inertia, Recursion
from eomc.derive.tape import Stage
from eomc.derive.vectors import AXES, ZERO, Vector
from eomc.model.exact import Matrix

Rows = list[list[Expr]]
Column = tuple[Sequence[Expr], Sequence[Expr]]  # of an inertia along a joint: moment, force
Pairs = tuple[tuple[Expr, Expr], ...]


class MasslessError(Exception):
    """Nothing resists the motion of a joint."""

    def __init__(self, link: int) -> None:
        self.link = link


def accelerations(recursion: Recursion, drive: Sequence[Expr]) -> tuple[list[Expr], Pairs]:
    """qdd by link, and each pivot paired with a value of its size without cancellation.

    drive: the generalized forces by link, less what is not the tree's. Raises MasslessError where
    a joint moves nothing.
    """
    return _Articulated(recursion).solve(drive)


@dataclass
class _Inertia:
    """An articulated inertia: moment = J alpha + H a, force = H^T alpha + M a."""

    J: Rows
    H: Rows
    M: Rows


class _Articulated:
    """The sweep inwards, which eliminates, and the one outwards."""

    def __init__(self, recursion: Recursion) -> None:
        self.r = recursion
        self.links = recursion.links

    def solve(self, drive: Sequence[Expr]) -> tuple[list[Expr], Pairs]:
        r, n = self.r, self.r.n
        given = r.forces(r.speed, [S.Zero] * n)
        f, m = list(given.force), list(given.moment)
        bodies = [self._rigid(x) for x in r.inertia]
        size: list[Expr] = [S.Zero] * n
        pivots: list[tuple[Expr, Expr]] = []
        inverse: list[Expr] = [S.Zero] * n
        columns: list[Column] = [(ZERO, ZERO)] * n
        left: list[Expr] = [S.Zero] * n
        for k in reversed(range(n)):
            link, body, a = self.links[k], bodies[k], self.links[k].axis
            if link.turns:
                u_m, u_f = body.J[a], body.H[a]
            else:
                u_m, u_f = [row[a] for row in body.H], body.M[a]
            own = (u_m if link.turns else u_f)[a]
            d = r.add(own, r.armature[k])
            if d == 0:
                raise MasslessError(k)
            known = r.tape.stage_of(d) <= Stage.PARAMETER
            pivots.append((d, d if known else r.add(d, size[k])))
            inverse[k] = r.define(1 / d)
            columns[k] = (u_m, u_f)
            left[k] = r.add(drive[k], r.minus((m if link.turns else f)[k][a]))
            if link.parent < 0:
                continue
            reduced = self._reduced(k, body, columns[k], inverse[k])
            ratio = r.times(left[k], inverse[k])
            m[k] = r.plus(m[k], r.scaled(u_m, ratio))
            f[k] = r.plus(f[k], r.scaled(u_f, ratio))
            p = link.parent
            size[p] = r.add(size[p], self._size(k, body))
            bodies[p] = self._sum(bodies[p], self._carried(k, reduced))
            force, moment = r.inwards(k, f[k]), r.inwards(k, m[k])
            f[p] = r.plus(f[p], force)
            m[p] = r.plus(m[p], moment, r.cross(r.arm[k], force))
        return self._outwards(columns, inverse, left), tuple(pivots)

    def _outwards(
        self, columns: Sequence[Column], inverse: Sequence[Expr], left: Sequence[Expr]
    ) -> list[Expr]:
        """qdd_k = (u - U . a) / d on the way outwards."""
        r = self.r
        out: list[Expr] = []
        alphas: list[Vector] = []
        origins: list[Vector] = []
        for k, link in enumerate(self.links):
            alpha, at = ZERO, ZERO
            if (p := link.parent) >= 0:
                alpha = r.outwards(k, alphas[p])
                at = r.outwards(k, r.plus(origins[p], r.cross(alphas[p], r.arm[k])))
            u_m, u_f = columns[k]
            rest = r.add(left[k], r.minus(r.dot(u_m, alpha)), r.minus(r.dot(u_f, at)))
            qdd = r.times(rest, inverse[k])
            out.append(qdd)
            own = r.on_axis(k, qdd)
            alphas.append(r.plus(alpha, own) if link.turns else alpha)
            origins.append(at if link.turns else r.plus(at, own))
        return out

    def _size(self, k: int, body: _Inertia) -> Expr:
        """The size of what k hands on unreduced, to a parent without inertia of its own.

        With some along its joint no pivot can vanish.
        """
        r, p = self.r, self.links[k].parent
        parent = self.links[p]
        own = parent.inertia[parent.axis] if parent.turns else parent.mass
        if own != 0 or r.armature[p] != 0:
            return S.Zero
        mass = [body.M[i][i] for i in range(3)]
        if not parent.turns:
            return r.add(*mass)
        across = r.dot(r.arm[k], r.arm[k])
        return r.add(*(body.J[i][i] for i in range(3)), *(r.times(across, m) for m in mass))

    def _rigid(self, x: Inertia) -> _Inertia:
        hx, hy, hz = x.moment
        less = self.r.minus
        H = [[S.Zero, less(hz), hy], [hz, S.Zero, less(hx)], [less(hy), hx, S.Zero]]
        J = [[x.entry(i, j) for j in range(3)] for i in range(3)]
        M = [[x.mass if i == j else S.Zero for j in range(3)] for i in range(3)]
        return _Inertia(J, H, M)

    def _reduced(self, k: int, body: _Inertia, column: Column, inverse: Expr) -> _Inertia:
        """I - U U^T / d; without armature exactly zero along the joint."""
        r, link = self.r, self.links[k]
        u_m, u_f = column
        w_m, w_f = r.scaled(u_m, inverse), r.scaled(u_f, inverse)

        def less(old: Expr, a: Expr, b: Expr) -> Expr:
            return r.add(old, r.minus(r.times(a, b)))

        J = self._symmetric(lambda i, j: less(body.J[i][j], w_m[i], u_m[j]))
        M = self._symmetric(lambda i, j: less(body.M[i][j], w_f[i], u_f[j]))
        H = [[less(body.H[i][j], w_m[i], u_f[j]) for j in range(3)] for i in range(3)]
        if r.armature[k] == 0:
            a = link.axis
            for i in range(3):
                if link.turns:
                    J[a][i] = J[i][a] = H[a][i] = S.Zero
                else:
                    M[a][i] = M[i][a] = H[i][a] = S.Zero
        return _Inertia(J, H, M)

    def _symmetric(self, entry: Callable[[int, int], Expr]) -> Rows:
        rows = [[S.Zero] * 3 for _ in range(3)]
        for i, j in combinations_with_replacement(range(3), 2):
            rows[i][j] = rows[j][i] = entry(i, j)
        return rows

    def _sum(self, one: _Inertia, other: _Inertia) -> _Inertia:
        add = self.r.add

        def both(a: Rows, b: Rows) -> Rows:
            return [list(map(add, p, q)) for p, q in zip(a, b, strict=True)]

        return _Inertia(both(one.J, other.J), both(one.H, other.H), both(one.M, other.M))

    def _carried(self, k: int, x: _Inertia) -> _Inertia:
        """To the parent's frame and about its origin."""
        r = self.r
        if self.links[k].turns:
            x = _Inertia(*(self._by_angle(k, m) for m in (x.J, x.H, x.M)))
        R = r.rotation[k]
        if not all(R[i][j] == (i == j) for i in range(3) for j in range(3)):
            x = _Inertia(
                *(self._rotated(R, m, same) for m, same in ((x.J, True), (x.H, False), (x.M, True)))
            )
        arm = r.arm[k]
        if arm == ZERO:
            return x
        columns = [r.cross(arm, column) for column in x.M]
        H = [[r.add(x.H[i][j], columns[j][i]) for j in range(3)] for i in range(3)]
        from_right = [r.cross(row, arm) for row in H]
        from_left = [r.cross(arm, row) for row in x.H]
        J = self._symmetric(
            lambda i, j: r.add(x.J[i][j], r.minus(from_right[i][j]), from_left[j][i])
        )
        return _Inertia(J, H, x.M)

    def _by_angle(self, k: int, m: Rows) -> Rows:
        """R m R^T for the joint's angle."""
        r = self.r
        i, j = AXES[self.links[k].axis]
        a = self.links[k].axis
        out = [list(row) for row in m]
        across = r.add(m[i][j], m[j][i])
        t, off = r.half_turn(k, m[i][i], m[j][j], across)
        change = r.add(off, r.minus(across))
        out[i][i], out[j][j] = r.add(m[i][i], r.minus(t)), r.add(m[j][j], t)
        out[i][j], out[j][i] = r.add(m[i][j], change), r.add(m[j][i], change)

        def rotated(x: Expr, y: Expr) -> tuple[Expr, Expr]:
            v = list(ZERO)
            v[i], v[j] = x, y
            v = list(r.turn(k, (v[0], v[1], v[2])))
            return v[i], v[j]

        out[a][i], out[a][j] = rotated(m[a][i], m[a][j])
        out[i][a], out[j][a] = rotated(m[i][a], m[j][a])
        return out

    def _rotated(self, R: Matrix, m: Rows, symmetric: bool) -> Rows:
        r = self.r
        columns = list(zip(*(r.apply(R, row) for row in m), strict=True))  # of m R^T
        if symmetric:
            return self._symmetric(lambda i, j: r.dot(R[i], columns[j]))
        return [[r.dot(row, column) for column in columns] for row in R]
