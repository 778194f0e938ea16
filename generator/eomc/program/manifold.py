"""The positions at which constraints hold, in numbers: values, steps onto them, forty digits.

Lengths are in the metric of D; a row is in units of sqrt(A D^-1 A^T), its own inverse inertia.
Rows of a loop's axes are replaced by the rotation vector by which they are out: it has the same
zero and slope where the joint is closed, no other zero, and a slope everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.derive import lagrange
from eomc.model.system import System, t
from eomc.program import constrained
from eomc.program.interpret import context, evaluator, exact_evaluator, rounding_evaluator
from eomc.program.lower import lower

Vector = NDArray[np.float64]
Flags = NDArray[np.bool_]

RANK_TOLERANCE = 1e-7  # singular values below are zero, where rows hold to rounding
HALF_TURN = 1e-8  # the square of the cosine of half an angle: it counts as half a turn
AWAY = 4.0  # rad: what a row of axes lacks there
LINEAR = 0.25  # of a step: what rows may differ by from their tangent at its end
LEAP = 0.5  # of a coordinate or rad: a step, at most
SHORTEST = 2.0**-13  # part of a step
ROUNDED = 64  # roundings: what a row of held values may be
SWEEPS = 400  # of Newton's method, damped
NO_SLOPE = 1e-13  # of a loop's row, of its slope beside: it has none, but rounding
NO_MASS = 1e-14  # the least eigenvalue of a D that is scaled to 1: it is singular
BESIDE = 3  # places beside the start
LEAST = 1e-14  # of the inverse inertia of a row: by so much it is always damped
EPS = 2.0**-52
EXACT = 12  # sweeps in forty digits; each gains ten or more
DEEP = 1e-32  # of the terms of a row: it holds in forty digits


def _most(x: Vector) -> float:
    return float(np.max(np.abs(x), initial=0))


@dataclass(frozen=True)
class Place:
    """Rows at q (nq,) and t: phi (m,), 0 for rows of rates; A (m, nq); D (nq, nq).

    Of rows that have rotation errors phi is the rotation vector, and A its slope.
    """

    q: Vector
    t: float
    phi: Vector
    A: Vector
    D: Vector

    @cached_property
    def singular(self) -> bool:
        """Whether D is not positive definite by itself."""
        diagonal = np.diag(self.D)
        if np.all(diagonal > 0):
            scale = 1 / np.sqrt(diagonal)
            with suppress(np.linalg.LinAlgError):
                D = scale[:, None] * (self.D + self.D.T) / 2 * scale
                pivots = np.diag(np.linalg.cholesky(D))
                # of a singular one the least pivot may be far above the least eigenvalue
                return not (np.min(pivots) > 1e-6 and np.linalg.eigvalsh(D)[0] > NO_MASS)
        return True

    @property
    def weights(self) -> Vector:
        """(m,): of the rows in `metric`, where D is singular; powers of two."""
        diagonal, size = np.diag(self.D), np.sum(self.A**2, axis=1)
        known = diagonal > 0
        mass = float(np.mean(diagonal[known])) if np.any(known) else 1.0
        return np.asarray(2.0 ** np.round(np.log2(mass / np.where(size > 0, size, mass))))

    @cached_property
    def metric(self) -> Vector:
        """D, with the rows' own weight where some coordinate has no inertia."""
        return self.metric_of(range(len(self.A)))

    def metric_of(self, rows: Sequence[int]) -> Vector:
        """The same with the weight of some rows.

        A least change with A d given for these rows is the same with and without their weight;
        other rows would change it.
        """
        D, A = (self.D + self.D.T) / 2, self.A[rows]
        if not self.singular:
            return D
        D = D + (A.T * self.weights[rows]) @ A
        values, vectors = np.linalg.eigh(D)
        least = 1e-12 * max(float(values[-1]), 1e-300)
        return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)

    @cached_property
    def sizes(self) -> Vector:
        """(m,): sqrt(A D^-1 A^T) of each row, 1 where that is 0."""
        B = np.linalg.solve(np.linalg.cholesky(self.metric), self.A.T)
        sizes = np.sqrt(np.sum(B**2, axis=0))
        return np.where(sizes > 0, sizes, 1.0)

    @property
    def slopes(self) -> Vector:
        """(m,): sqrt(A D^-1 A^T) of each row."""
        return np.where(np.any(self.A != 0, axis=1), self.sizes, 0.0)

    @cached_property
    def levels(self) -> Vector:
        """(m,): how much a row changes where all coordinates change by themselves."""
        scale = np.sqrt(np.diag(self.metric))
        return self.sizes * float(np.linalg.norm(scale * self.q) + 1e-3 * np.max(scale))

    @cached_property
    def off(self) -> float:
        """How far the rows are from zero, as a length."""
        return float(np.linalg.norm(self.phi / self.sizes))


class Frame:
    """Directions at a place, of the coordinates `free`, along and across the rows `rows`."""

    def __init__(self, place: Place, free: Flags, rows: Sequence[int]) -> None:
        self.place, self.free, self.rows = place, np.flatnonzero(free), list(rows)
        metric = place.metric_of(self.rows)
        self.L = np.linalg.cholesky(metric[self.free][:, self.free])
        A = place.A[self.rows][:, self.free] / place.sizes[self.rows, None]
        self.B = np.linalg.solve(self.L, A.T).T

    @cached_property
    def parts(self) -> tuple[Vector, Vector, Vector]:
        """U, s and V^T of B = U diag(s) V^T."""
        U, s, V = np.linalg.svd(self.B, full_matrices=False)
        return np.asarray(U), np.asarray(s), np.asarray(V)

    def _inverse(self, values: Vector, damping: float) -> Vector:
        """(B B^T + damping)^-1 values; the little that is always damped leaves rows as they are."""
        whole = self.B @ self.B.T + max(damping, LEAST) * np.eye(len(self.rows))
        return np.asarray(np.linalg.solve(whole, values))

    def back(self, y: Vector) -> Vector:
        """(nq,): the direction of which y is the coordinates' part in the metric."""
        whole = np.zeros(len(self.place.q))
        whole[self.free] = np.linalg.solve(self.L.T, y)
        return whole

    def onto(self, values: Vector, damping: float = 0.0) -> Vector:
        """(nq,): the least direction along which the rows change by -values, nearly, damped."""
        aim = values[self.rows] / self.place.sizes[self.rows]
        return -self.back(self.B.T @ self._inverse(aim, damping))

    def exactly_onto(self, values: Vector) -> Vector:
        """The same as far as they can, rows that depend on others left to these."""
        U, s, V = self.parts
        aim = values[self.rows] / self.place.sizes[self.rows]
        return -self.back(V.T @ (U.T @ aim / np.where(s > RANK_TOLERANCE, s, np.inf)))

    def along(self, direction: Vector) -> Vector:
        """(nq,): what of a direction leaves the rows as they are."""
        y = self.L.T @ direction[self.free]
        for _ in range(2):
            y = y - self.B.T @ self._inverse(self.B @ y, 0.0)
        return self.back(y)

    def length(self, direction: Vector) -> float:
        """Of a direction of free coordinates."""
        return float(np.linalg.norm(self.L.T @ direction[self.free]))


class Manifold:
    """The constraints of a system, at its parameters' defaults."""

    def __init__(self, system: System) -> None:
        self.system = system
        derived = lagrange.derive(system)
        made = {f.name: f for f in constrained.of_rows(derived)}
        e = derived.lagrange or derived.newton_euler
        assert e is not None
        D = lower("D", e.tape, [x for row in e.D for x in row], system.names)
        self.functions = {**made, "D": D}
        self.parameters = {p.name: p.value for p in system.parameters}
        self._names = [x.name for x in (*system.q, *system.qd)]
        self._fixed = {**self.parameters, **dict.fromkeys((u.name for u in system.u), 0.0)}
        self.holonomic = [k for k, c in enumerate(system.constraints) if c.holonomic]
        self.rotations = system.rotations
        self.rows = range(len(system.constraints))
        self.timed = any(t.name in made[name].uses for name in ("constraints", "constraint_rates"))
        self._plain: dict[str, Callable[..., Any]] = {}
        self._exact: dict[str, Callable[..., Any]] = {}
        self._rounding: dict[str, Callable[..., list[float]]] = {}

    @cached_property
    def reads(self) -> Flags:
        """(m, nq): which coordinates, or rates, a row depends on."""
        outputs = self.functions["constraint_jacobian"].outputs
        return np.array([o.coefficient != 0 for o in outputs]).reshape(len(self.rows), -1)

    def _values(self, q: Sequence[Any], qd: Sequence[Any], time: Any) -> dict[str, Any]:
        moving = dict(zip(self._names, (*q, *qd), strict=True))
        return {**self._fixed, t.name: time, **moving}

    def value(self, name: str, q: Vector, qd: Vector, time: float) -> Vector:
        """What a function gives, in doubles; nan where it has no value."""
        if name not in self._plain:
            self._plain[name] = evaluator(self.functions[name])
        try:
            return np.array(self._plain[name](self._values(q.tolist(), qd.tolist(), time))[0])
        except (ArithmeticError, ValueError):
            return np.full(len(self.functions[name].outputs), np.nan)

    def exactly(self, name: str, q: Sequence[Any], qd: Sequence[Any], time: float) -> list[Any]:
        """The same in forty digits."""
        if name not in self._exact:
            self._exact[name] = exact_evaluator(self.functions[name])
        found: list[Any] = self._exact[name](self._values(q, qd, time))
        return found

    def has_values(self, q: Vector, time: float = 0.0) -> bool:
        """Whether the constraints, their slopes and D are finite."""
        names = ("constraints", "constraint_jacobian", "D")
        return all(np.all(np.isfinite(self.value(name, q, 0 * q, time))) for name in names)

    def place(self, q: Vector, time: float = 0.0) -> Place | None:
        """The rows there; None where something has no value."""
        n, rest, phi = len(q), np.zeros(len(q)), self._off(q, time)
        A = self.value("constraint_jacobian", q, rest, time).reshape(-1, n)
        for rows, vector, slopes in self._rotation_vectors(q, time):
            phi[rows], A[rows] = vector, slopes
        D = self.value("D", q, rest, time).reshape(n, n)
        if not all(np.all(np.isfinite(x)) for x in (phi, A, D)):
            return None
        level = self._of_loops & (np.linalg.norm(A, axis=1) <= NO_SLOPE * self.usual)
        A[level] = 0.0
        return Place(q, time, phi, A, D)

    @cached_property
    def _of_loops(self) -> Flags:
        """(m,): the rows of lengths and axes, which have slopes of one size."""
        return np.array([bool(c.loop) for c in self.system.constraints])

    @cached_property
    def usual(self) -> Vector:
        """(m,): the length of each row's slope, over coordinates, beside the start."""
        random, n = np.random.default_rng(3), len(self.system.q)
        start = np.array([c.start for c in self.system.coordinates])
        found = np.zeros((BESIDE, len(self.rows)))
        for k in range(BESIDE):
            q = start + random.uniform(-1, 1, n)
            A = self.value("constraint_jacobian", q, np.zeros(n), 0.0).reshape(-1, n)
            found[k] = np.linalg.norm(np.nan_to_num(A, posinf=0, neginf=0), axis=1)
        return np.asarray(np.max(found, axis=0))

    def _off(self, q: Vector, time: float) -> Vector:
        """(m,): what the rows of positions are there, 0 for the others."""
        phi = self.value("constraints", q, np.zeros(len(q)), time)
        phi[len(self.holonomic) :] = 0
        for rows, vector, _ in self._rotation_vectors(q, time):
            phi[rows] = vector
        return phi

    def _rotation_vectors(
        self, q: Vector, time: float
    ) -> Iterator[tuple[list[int], Vector, Vector]]:
        """The rows of axes of each loop, the rotation vector a n that they lack, and its slopes.

        From e = 2 tan(a/2) n, whose own slope along n grows as 1/cos(a/2)^2.
        """
        if not self.rotations:
            return
        count = sum(map(len, self.rotations))
        found = self.value("rotation_errors", q, np.zeros(len(q)), time)
        errors, halves, first = found[:count], found[count : 2 * count], 0
        slopes = found[2 * count :].reshape(count, -1)
        for rows in self.rotations:
            part = slice(first, first := first + len(rows))
            e, J = errors[part], slopes[part]
            tangent = float(np.linalg.norm(e)) / 2
            if not halves[part.start] > HALF_TURN:  # no direction leads back
                e, J = np.full(len(rows), AWAY), np.zeros_like(J)
            elif tangent > 0:
                n, scale = e / (2 * tangent), np.arctan(tangent) / tangent
                along = np.outer(n, n @ J)
                J = scale * (J - along) + along / (1 + tangent**2)
                e = scale * e
            yield list(rows), e, J

    def rounding(self, q: Vector, qd: Vector, time: float, name: str = "constraints") -> Vector:
        """(m,): the rounding error of each row, to first order; 0 where a row has no value."""
        if name not in self._rounding:
            self._rounding[name] = rounding_evaluator(self.functions[name])
        try:
            bounds = self._rounding[name](self._values(q.tolist(), qd.tolist(), time))
        except (ArithmeticError, ValueError):
            return np.zeros(len(self.rows))
        return EPS * np.array(bounds)

    def descend(
        self, q: Vector, free: Flags, time: float = 0.0, strict: bool = True
    ) -> tuple[Place | None, bool]:
        """Where small ways from q lead, free coordinates moving least, and whether rows hold there.

        Newton's method, damped so that rows go to zero together as nearly as LINEAR (strict), or
        so that they get less.
        """
        place = self.place(q, time)
        if place is None:
            return None, False
        for _ in range(SWEEPS):
            if place.off == 0:
                return place, True
            frame = Frame(place, free, self.holonomic)
            unit = float(np.sqrt(np.trace(frame.L @ frame.L.T) / max(1, len(frame.free))))
            step = frame.onto(place.phi, 1e-2 * min(1.0, place.off / unit if unit else 0.0))
            change = float(np.linalg.norm(place.A @ step / place.sizes))
            tiny = np.max(np.abs(step) / (np.abs(place.q) + 1e-3 + np.max(np.abs(place.q))))
            if change < 1e-4 * place.off:
                return place, self.rounded(place)
            found = self._shortened(place, step, strict, LEAP * (1 + _most(q)))
            if found is None:
                return place, self.rounded(place)
            if tiny < 1e-13 and found.off > place.off / 4:
                return (found if found.off < place.off else place), True
            place = found
        return place, False

    def rounded(self, place: Place) -> bool:
        """Whether rows are as near to zero as doubles can tell."""
        off, limit = np.abs(place.phi), EPS * place.levels
        if not np.all(off <= ROUNDED * limit):
            limit = np.maximum(self.rounding(place.q, 0 * place.q, place.t), limit)
        return bool(np.all(off <= ROUNDED * limit))

    def _shortened(self, place: Place, step: Vector, strict: bool, longest: float) -> Place | None:
        # rows of sines hold again and again: a step across turns leads anywhere
        part, change = min(1.0, longest / max(longest, _most(step))), place.A @ step
        while part > SHORTEST:
            q = place.q + part * step
            phi, aim = self._off(q, place.t), place.phi + part * change
            aim[len(self.holonomic) :] = 0
            bent = float(np.linalg.norm((phi - aim) / place.sizes))
            less = float(np.linalg.norm(phi / place.sizes))
            if less < (1 - part / 8) * place.off and (
                not strict or bent <= LINEAR * part * place.off
            ):
                there = self.place(q, place.t)
                if there is not None:
                    return there
            part /= 2
        return None

    def nearest(self, place: Place, guess: Vector, free: Flags) -> Place:
        """The place at which the free coordinates have moved least from a guess, close by.

        Along the rows towards the guess and back onto them, until that leads no nearer.
        """
        for _ in range(100):
            frame = Frame(place, free, self.holonomic)
            way = frame.along(guess - place.q)
            far = frame.length(guess - place.q)
            if frame.length(way) <= 1e-9 * far or far == 0:
                return place
            part = 1.0
            while part > SHORTEST:
                there, held = self.descend(place.q + part * way, free, place.t)
                if held and there is not None and frame.length(guess - there.q) < far:
                    break
                part /= 2
            else:
                return place
            assert there is not None
            place = there
        return place

    def polished(self, place: Place, free: Flags) -> tuple[list[Any], bool]:
        """q in forty digits, and whether all rows hold there. From a place good to rounding."""
        rest = [0] * len(place.q)

        def phi(q: list[Any]) -> list[Any]:
            found = self.exactly("constraints", q, rest, place.t)
            return [*found[: len(self.holonomic)], *[0] * (len(found) - len(self.holonomic))]

        return _refined(place.q, phi, Frame(place, free, self.holonomic), place.levels)

    def rates(self, place: Place, q: list[Any], qd: Vector, free: Flags) -> tuple[list[Any], bool]:
        """qd in forty digits with the free rates moved least, and whether all rows hold there."""

        def rates(qd: list[Any]) -> list[Any]:
            return self.exactly("constraint_rates", q, qd, place.t)

        level = replace(place, q=qd).levels
        return _refined(qd, rates, Frame(place, free, self.rows), level)


def _refined(
    start: Vector, of: Callable[[list[Any]], list[Any]], frame: Frame, level: Vector
) -> tuple[list[Any], bool]:
    """Numbers that leave rows `of` them at zero in forty digits, and whether all do.

    From doubles, by steps in doubles; level: of each row, what it is compared with.
    """
    mp = context()
    x, best, last = [mp.mpf(value) for value in start.tolist()], None, np.inf
    for _ in range(EXACT):
        off = np.array([float(row) for row in of(x)])
        size = float(np.max(np.abs(off) / level, initial=0))
        if not size < last:
            break
        best, last = x, size
        if size < DEEP:
            break
        x = [a + mp.mpf(d) for a, d in zip(x, frame.exactly_onto(off).tolist(), strict=True)]
    return best or x, last < DEEP
