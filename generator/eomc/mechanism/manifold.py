"""The constraint manifold in numbers: residuals, Newton steps onto it, refinement, paths along it.

Lengths are in the metric of D. Each constraint equation is scaled by sqrt(A D^-1 A^T), the root of
its inverse effective mass. The axis equations of a loop are replaced by the components of the
rotation error vector: it has the same zero and gradient where the joint is closed, no other zero,
and a gradient that vanishes nowhere.
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
from eomc.program.ir import context, evaluator, exact_evaluator, rounding_evaluator
from eomc.program.lower import lower
from eomc.program.program import constraint_functions
from eomc.runtime import rank

Vector = NDArray[np.float64]
Flags = NDArray[np.bool_]

HALF_TURN_RESIDUAL = 4.0  # rad, assigned to the axis equations at half a turn
MAX_NONLINEARITY = 0.25  # of a step: deviation of the residuals from their tangent
MAX_STEP = 0.5  # of a Newton step, relative to a coordinate, or in rad
MIN_STEP_FRACTION = 2.0**-13  # of the full Newton step
ROUNDING_FACTOR = 64  # rounding errors that a residual of fixed values may have
MAX_ITERATIONS = 400  # of the damped Newton method
ROUNDING = 1e-13  # relative to the terms of a sum: below it, only rounding
NEARBY_COUNT, NEARBY_DISTANCE = 3, 0.1  # of nearby configurations; relative to the coordinates
EPS = 2.0**-52
SINGULAR_MASS_TOLERANCE = ROUNDING_FACTOR * EPS  # least eigenvalue of D scaled to unit diagonal
REFINED_TOLERANCE = 1e-32  # relative to the terms of an equation: satisfied in forty digits
EXACT_ROUNDING = 1e-20  # relative to the terms of a sum in forty digits: below it, only rounding


def _max_abs(x: Vector) -> float:
    return float(np.max(np.abs(x), initial=0))


@dataclass(frozen=True)
class Configuration:
    """The constraint equations of a system, evaluated at the coordinates `q` and the time `t`.

    Attributes
    ----------
    q : (nq,)
        The coordinates.
    t : float
        The time (s).
    phi : (m,)
        Residuals of the constraint equations; 0 for nonholonomic ones. For the axis equations of a
        loop, the components of the rotation error vector (rad).
    A : (m, nq)
        Jacobian of `phi`; for nonholonomic constraints, the coefficients of the velocities.
    D : (nq, nq)
        Mass matrix.
    """

    q: Vector
    t: float
    phi: Vector
    A: Vector
    D: Vector

    @cached_property
    def singular(self) -> bool:
        """Whether the mass matrix D alone is not positive definite."""
        diagonal = np.diag(self.D)
        if np.all(diagonal > 0):
            scale = 1 / np.sqrt(diagonal)
            with suppress(np.linalg.LinAlgError):
                D = scale[:, None] * (self.D + self.D.T) / 2 * scale
                pivots = np.diag(np.linalg.cholesky(D))
                # the least pivot of a singular matrix may be far above its least eigenvalue
                return not (
                    np.min(pivots) > 1e-6 and np.linalg.eigvalsh(D)[0] > SINGULAR_MASS_TOLERANCE
                )
        return True

    @property
    def weights(self) -> Vector:
        """Weight of each constraint equation in the property `metric`, (m,); powers of 2.

        The weights are used if D is singular.
        """
        diagonal, size = np.diag(self.D), np.sum(self.A**2, axis=1)
        known = diagonal > 0
        mass = float(np.mean(diagonal[known])) if np.any(known) else 1.0
        return np.asarray(2.0 ** np.round(np.log2(mass / np.where(size > 0, size, mass))))

    @cached_property
    def metric(self) -> Vector:
        """The matrix (nq, nq) that defines lengths of directions in coordinate space.

        The metric is the mass matrix D. If D is singular, it is D + sum_r weights[r] A_r^T A_r with
        the row A_r of the Jacobian for constraint r.
        """
        return self.metric_of(range(len(self.A)))

    def metric_of(self, rows: Sequence[int]) -> Vector:
        """Return the matrix `metric` (nq, nq) with the weights of some constraint equations only.

        `rows` contains the indices of these equations. The shortest direction d with a prescribed
        A d for the equations does not depend on their weights. It would depend on the weights of
        other equations.
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
        """The scale sqrt(a D^-1 a^T) of each constraint equation with the gradient a, (m,).

        It is the inverse square root of the effective mass of the constraint. The scale is 1 if the
        gradient is 0. If D is singular, `metric` takes its place.
        """
        B = np.linalg.solve(np.linalg.cholesky(self.metric), self.A.T)
        sizes = np.sqrt(np.sum(B**2, axis=0))
        return np.where(sizes > 0, sizes, 1.0)

    @property
    def slopes(self) -> Vector:
        """The norm sqrt(a D^-1 a^T) of the gradient a of each constraint equation, (m,).

        If D is singular, `metric` takes its place.
        """
        return np.where(np.any(self.A != 0, axis=1), self.sizes, 0.0)

    @cached_property
    def levels(self) -> Vector:
        """The order of magnitude of each constraint's change if each q_i changes by |q_i|, (m,)."""
        scale = np.sqrt(np.diag(self.metric))
        return self.sizes * float(np.linalg.norm(scale * self.q) + 1e-3 * np.max(scale))

    @cached_property
    def residual_norm(self) -> float:
        """The Euclidean norm of the constraint residuals, each divided by its scale in `sizes`."""
        return float(np.linalg.norm(self.phi / self.sizes))


class TangentSpace:
    """The directions of motion along which the given constraints stay satisfied to first order.

    `configuration` is the point of the space of coordinates, `free` marks the coordinates that may
    change, and `rows` contains the indices of the constraints. The length of a direction d is
    sqrt(d^T M d), where M is the `metric` of the configuration.
    """

    def __init__(self, configuration: Configuration, free: Flags, rows: Sequence[int]) -> None:
        self.configuration, self.free, self.rows = configuration, np.flatnonzero(free), list(rows)
        metric = configuration.metric_of(self.rows)
        self.L = np.linalg.cholesky(metric[self.free][:, self.free])
        A = configuration.A[self.rows][:, self.free] / configuration.sizes[self.rows, None]
        self.B = np.linalg.solve(self.L, A.T).T

    @cached_property
    def parts(self) -> tuple[Vector, Vector, Vector]:
        """The singular value decomposition (U, s, V) of B = U diag(s) V^T.

        B is the Jacobian of the constraint equations, each divided by its scale, with respect to
        coordinates in which the metric is the identity.
        """
        U, s, V = np.linalg.svd(self.B, full_matrices=False)
        return np.asarray(U), np.asarray(s), np.asarray(V.T)

    @property
    def rank(self) -> int:
        """The rank of the gradients of the constraint equations."""
        return int(rank.count(self.parts[1]))

    def _inverse(self, values: Vector, damping: float) -> Vector:
        """Return (B B^T + damping)^-1 values, with a damping of ROUNDING at least."""
        whole = self.B @ self.B.T + max(damping, ROUNDING) * np.eye(len(self.rows))
        return np.asarray(np.linalg.solve(whole, values))

    def _from_metric(self, y: Vector) -> Vector:
        """Return the direction (nq,) with components y in an orthonormal basis of the metric."""
        whole = np.zeros(len(self.configuration.q))
        whole[self.free] = np.linalg.solve(self.L.T, y)
        return whole

    def correction(self, values: Vector, damping: float = 0.0) -> Vector:
        """Return the minimum-norm direction (nq,) along which the residuals change by -values.

        `values` contains a residual for each constraint equation of the system. A positive
        `damping` makes the direction shorter if the gradients are nearly dependent.
        """
        aim = values[self.rows] / self.configuration.sizes[self.rows]
        return -self._from_metric(self.B.T @ self._inverse(aim, damping))

    def truncated_correction(self, values: Vector) -> Vector:
        """Return the direction (nq,) along which residuals change by -values, by least squares.

        `values` contains a residual for each constraint equation of the system. Of all
        least-squares solutions the shortest is returned. It is computed by a singular value
        decomposition in which the smallest singular values are left out.
        """
        U, s, V = (part[..., : self.rank] for part in self.parts)
        aim = values[self.rows] / self.configuration.sizes[self.rows]
        return -self._from_metric(V @ (U.T @ aim / s))

    def projected(self, direction: Vector) -> Vector:
        """Return the direction (nq,) in the tangent space that is closest to `direction`, (nq,).

        Distances are lengths in the metric of the configuration.
        """
        y = self.L.T @ direction[self.free]
        for _ in range(2):
            y = y - self.B.T @ self._inverse(self.B @ y, 0.0)
        return self._from_metric(y)

    def length(self, direction: Vector) -> float:
        """Return the length of a direction (nq,) in the metric of the configuration.

        Components along coordinates that are not free are ignored.
        """
        return float(np.linalg.norm(self.L.T @ direction[self.free]))


class Manifold:
    """Methods that evaluate and solve the constraint equations of a system.

    The parameters have their default values. The set of all coordinates that satisfy the equations
    is the constraint manifold.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        derived = lagrange.derive(system)
        functions = {f.name: f for f in constraint_functions(derived)}
        e = derived.lagrange or derived.newton_euler
        assert e is not None
        D = lower("D", e.tape, [x for row in e.D for x in row], system.names)
        self.functions = {**functions, "D": D}
        self.parameters = {p.name: p.value for p in system.parameters}
        self._names = [x.name for x in (*system.q, *system.qd)]
        self._fixed = {**self.parameters, **dict.fromkeys((u.name for u in system.u), 0.0)}
        self.holonomic = [k for k, c in enumerate(system.constraints) if c.holonomic]
        self.rotations = system.rotations
        self.rows = range(len(system.constraints))
        self.timed = any(
            t.name in functions[name].uses for name in ("constraints", "constraint_rates")
        )
        self._plain: dict[str, Callable[..., Any]] = {}
        self._exact: dict[str, Callable[..., Any]] = {}
        self._rounding: dict[str, Callable[..., list[float]]] = {}

    @cached_property
    def reads(self) -> Flags:
        """Flags (m, nq): whether constraint i depends on coordinate j or its velocity."""
        outputs = self.functions["constraint_jacobian"].outputs
        return np.array([o.coefficient != 0 for o in outputs]).reshape(len(self.rows), -1)

    def _values(self, q: Sequence[Any], qd: Sequence[Any], time: Any) -> dict[str, Any]:
        moving = dict(zip(self._names, (*q, *qd), strict=True))
        return {**self._fixed, t.name: time, **moving}

    def value(self, name: str, q: Vector, qd: Vector, time: float) -> Vector:
        """Return the results of the generated function with the given name at a state, in doubles.

        `name` is that of a function such as "constraints" or "D". All results are NaN if the
        function cannot be evaluated at the state.
        """
        if name not in self._plain:
            self._plain[name] = evaluator(self.functions[name])
        try:
            return np.array(self._plain[name](self._values(q.tolist(), qd.tolist(), time))[0])
        except (ArithmeticError, ValueError):
            return np.full(len(self.functions[name].outputs), np.nan)

    def exact_value(self, name: str, q: Sequence[Any], qd: Sequence[Any], time: float) -> list[Any]:
        """Return the results of the generated function with the given name, in forty digits.

        `name` is that of a function such as "constraints". Raises ArithmeticError or ValueError if
        the function cannot be evaluated at the state.
        """
        if name not in self._exact:
            self._exact[name] = exact_evaluator(self.functions[name])
        values: list[Any] = self._exact[name](self._values(q, qd, time))
        return values

    def has_values(self, q: Vector, time: float = 0.0) -> bool:
        """Return True if constraints, their Jacobian and the mass matrix are finite at q and t."""
        names = ("constraints", "constraint_jacobian", "D")
        return all(np.all(np.isfinite(self.value(name, q, 0 * q, time))) for name in names)

    def configuration(self, q: Vector, time: float = 0.0) -> Configuration | None:
        """Return the constraint equations, their Jacobian and the mass matrix at `q` and `time`.

        None is returned if one of them is not finite.
        """
        n, rest, phi = len(q), np.zeros(len(q)), self._residuals(q, time)
        A = self.value("constraint_jacobian", q, rest, time).reshape(-1, n)
        for rows, vector, slopes in self._rotation_vectors(q, time):
            phi[rows], A[rows] = vector, slopes
        D = self.value("D", q, rest, time).reshape(n, n)
        if not all(np.all(np.isfinite(x)) for x in (phi, A, D)):
            return None
        level = self._of_loops & (np.linalg.norm(A, axis=1) <= ROUNDING * self.typical_gradients)
        A[level] = 0.0
        return Configuration(q, time, phi, A, D)

    def nearby(self, q: Vector, time: float, size: float | None = None) -> list[Configuration]:
        """Return configurations at random coordinates near `q`, (nq,), where they have values.

        `size` is the scale of the coordinates, by default the largest of `q`.
        """
        random = np.random.default_rng(29)
        distance = NEARBY_DISTANCE * (size or _max_abs(q) or 1.0)
        samples = q + distance * random.normal(size=(NEARBY_COUNT, len(q)))
        return [p for x in samples if (p := self.configuration(x, time)) is not None]

    @cached_property
    def _of_loops(self) -> Flags:
        """Flags (m,) of the loop equations, whose gradients are of comparable size."""
        return np.array([bool(c.loop) for c in self.system.constraints])

    @cached_property
    def typical_gradients(self) -> Vector:
        """The typical norm of the gradient of each constraint, (m,).

        It is the largest Euclidean norm of the gradient at several random positions near the start.
        """
        random, n = np.random.default_rng(3), len(self.system.q)
        start = np.array([c.start for c in self.system.coordinates])
        norms = np.zeros((NEARBY_COUNT, len(self.rows)))
        for k in range(NEARBY_COUNT):
            q = start + random.uniform(-1, 1, n)
            A = self.value("constraint_jacobian", q, np.zeros(n), 0.0).reshape(-1, n)
            norms[k] = np.linalg.norm(np.nan_to_num(A, posinf=0, neginf=0), axis=1)
        return np.asarray(np.max(norms, axis=0))

    def _residuals(self, q: Vector, time: float) -> Vector:
        """Return the residuals (m,) of the holonomic constraints, 0 for the others."""
        phi = self.value("constraints", q, np.zeros(len(q)), time)
        phi[len(self.holonomic) :] = 0
        for rows, vector, _ in self._rotation_vectors(q, time):
            phi[rows] = vector
        return phi

    def _rotation_vectors(
        self, q: Vector, time: float
    ) -> Iterator[tuple[list[int], Vector, Vector]]:
        """Yield, for each loop, the axis equations, the rotation error vector a n and its Jacobian.

        GeneratedFunction from e = 2 tan(a/2) n, whose gradient along n grows as 1/cos(a/2)^2.
        """
        if not self.rotations:
            return
        count = sum(map(len, self.rotations))
        values = self.value("rotation_errors", q, np.zeros(len(q)), time)
        errors, halves, first = values[:count], values[count : 2 * count], 0
        slopes = values[2 * count :].reshape(count, -1)
        for rows in self.rotations:
            part = slice(first, first := first + len(rows))
            e, J = errors[part], slopes[part]
            tangent = float(np.linalg.norm(e)) / 2
            if not halves[part.start] > EPS**0.5:  # half a turn: no direction reduces the error
                e, J = np.full(len(rows), HALF_TURN_RESIDUAL), np.zeros_like(J)
            elif tangent > 0:
                n, scale = e / (2 * tangent), np.arctan(tangent) / tangent
                along = np.outer(n, n @ J)
                J = scale * (J - along) + along / (1 + tangent**2)
                e = scale * e
            yield list(rows), e, J

    def rounding(self, q: Vector, qd: Vector, time: float, name: str = "constraints") -> Vector:
        """Return first-order rounding errors of the constraint residuals at a state, (m,).

        `name` is the generated function whose results are considered: "constraints" for residuals,
        "constraint_rates" for their rates. All errors are 0 if the function cannot be evaluated.
        """
        if name not in self._rounding:
            self._rounding[name] = rounding_evaluator(self.functions[name])
        try:
            bounds = self._rounding[name](self._values(q.tolist(), qd.tolist(), time))
        except (ArithmeticError, ValueError):
            return np.zeros(len(self.rows))
        return EPS * np.array(bounds)

    def gauss_newton(
        self, q: Vector, free: Flags, time: float = 0.0, strict: bool = True
    ) -> tuple[Configuration | None, bool]:
        """Solve the holonomic constraints for the free coordinates by a damped Gauss-Newton method.

        Each step is the shortest one, where D defines lengths.

        Parameters
        ----------
        q : (nq,)
            Where the iteration starts.
        free : (nq,)
            For each coordinate, whether it may change.
        strict : bool
            If True, steps are shortened until the residuals change nearly linearly along them, so
            that the iteration stays on the branch of solutions near `q`. If False, steps are
            shortened only until the residuals decrease.

        Returns
        -------
        configuration : Configuration or None
            The last configuration; None if the constraints cannot be evaluated at q.
        converged : bool
            Whether the iteration converged.
        """
        configuration = self.configuration(q, time)
        if configuration is None:
            return None, False
        for _ in range(MAX_ITERATIONS):
            if configuration.residual_norm == 0:
                return configuration, True
            frame = TangentSpace(configuration, free, self.holonomic)
            unit = float(np.sqrt(np.trace(frame.L @ frame.L.T) / max(1, len(frame.free))))
            step = frame.correction(
                configuration.phi,
                1e-2 * min(1.0, configuration.residual_norm / unit if unit else 0.0),
            )
            change = float(np.linalg.norm(configuration.A @ step / configuration.sizes))
            tiny = np.max(
                np.abs(step) / (np.abs(configuration.q) + 1e-3 + np.max(np.abs(configuration.q)))
            )
            if change < 1e-4 * configuration.residual_norm:
                return configuration, self.rounded(configuration)
            shorter = self._shortened(configuration, step, strict, MAX_STEP * (1 + _max_abs(q)))
            if shorter is None:
                return configuration, self.rounded(configuration)
            if tiny < 1e-13 and shorter.residual_norm > configuration.residual_norm / 4:
                return (
                    shorter
                    if shorter.residual_norm < configuration.residual_norm
                    else configuration
                ), True
            configuration = shorter
        return configuration, False

    def rounded(self, configuration: Configuration) -> bool:
        """Return True if the residuals of a configuration do not exceed their rounding errors."""
        off, limit = np.abs(configuration.phi), EPS * configuration.levels
        if not np.all(off <= ROUNDING_FACTOR * limit):
            limit = np.maximum(
                self.rounding(configuration.q, 0 * configuration.q, configuration.t), limit
            )
        return bool(np.all(off <= ROUNDING_FACTOR * limit))

    def _shortened(
        self, configuration: Configuration, step: Vector, strict: bool, longest: float
    ) -> Configuration | None:
        # equations in sines have many roots: a step over several turns could reach any of them
        part, change = min(1.0, longest / max(longest, _max_abs(step))), configuration.A @ step
        while part > MIN_STEP_FRACTION:
            q = configuration.q + part * step
            phi, aim = self._residuals(q, configuration.t), configuration.phi + part * change
            aim[len(self.holonomic) :] = 0
            nonlinearity = float(np.linalg.norm((phi - aim) / configuration.sizes))
            norm = float(np.linalg.norm(phi / configuration.sizes))
            if norm < (1 - part / 8) * configuration.residual_norm and (
                not strict or nonlinearity <= MAX_NONLINEARITY * part * configuration.residual_norm
            ):
                there = self.configuration(q, configuration.t)
                if there is not None:
                    return there
            part /= 2
        return None

    def closest_configuration(
        self, configuration: Configuration, guess: Vector, free: Flags
    ) -> Configuration:
        """Return the configuration locally closest to a guess that satisfies the constraints.

        `configuration` satisfies the constraints, and `guess` (nq,) are the desired coordinates.
        From the configuration, steps are made towards the guess along the constraint manifold until
        the distance no longer decreases. Only the coordinates marked in `free` change.
        """
        for _ in range(100):
            frame = TangentSpace(configuration, free, self.holonomic)
            way = frame.projected(guess - configuration.q)
            far = frame.length(guess - configuration.q)
            if frame.length(way) <= 1e-9 * far or far == 0:
                return configuration
            part = 1.0
            while part > MIN_STEP_FRACTION:
                there, converged = self.gauss_newton(
                    configuration.q + part * way, free, configuration.t
                )
                if converged and there is not None and frame.length(guess - there.q) < far:
                    break
                part /= 2
            else:
                return configuration
            assert there is not None
            configuration = there
        return configuration

    def refine(self, configuration: Configuration, free: Flags) -> tuple[list[Any], bool]:
        """Return coordinates that satisfy the holonomic constraints to forty digits.

        The iteration starts at `configuration`, a solution in doubles, and changes the coordinates
        marked in `free`. Returns the coordinates, and whether the iteration converged.
        """
        rest = [0] * len(configuration.q)

        def phi(q: list[Any]) -> list[Any]:
            values = self.exact_value("constraints", q, rest, configuration.t)
            return [*values[: len(self.holonomic)], *[0] * (len(values) - len(self.holonomic))]

        return _refined(
            configuration.q,
            phi,
            TangentSpace(configuration, free, self.holonomic),
            configuration.levels,
        )

    def rates(
        self, configuration: Configuration, q: list[Any], qd: Vector, free: Flags
    ) -> tuple[list[Any], bool]:
        """Return velocities that satisfy the constraints to forty digits.

        The velocities marked in `free` differ from `qd` as little as possible. `q` are the
        coordinates of the configuration in forty digits. Returns the velocities, and whether the
        iteration converged.
        """

        def rates(qd: list[Any]) -> list[Any]:
            return self.exact_value("constraint_rates", q, qd, configuration.t)

        level = replace(configuration, q=qd).levels
        return _refined(qd, rates, TangentSpace(configuration, free, self.rows), level)


def _refined(
    start: Vector, of: Callable[[list[Any]], list[Any]], frame: TangentSpace, level: Vector
) -> tuple[list[Any], bool]:
    """Return a root of `of` in forty digits and whether it converged, from a start in doubles.

    Corrections are computed in doubles; each gains ten digits or more, and iteration ends when they
    do not even halve the residual. level: the scale of each residual.
    """
    mp = context()
    x, best, last = [mp.mpf(value) for value in start.tolist()], None, np.inf
    while last >= REFINED_TOLERANCE:
        off = np.array([float(row) for row in of(x)])
        size = float(np.max(np.abs(off) / level, initial=0))
        if not size < last / 2:
            break
        best, last = x, size
        x = [
            a + mp.mpf(d) for a, d in zip(x, frame.truncated_correction(off).tolist(), strict=True)
        ]
    return best or x, last < REFINED_TOLERANCE


# --- paths, in steps small enough to stay on one branch -------------------------------------------

STEPS, MAX_DIRECTIONS = 6, 4  # steps between samples; directions tried per sample
INITIAL_PATH_STEP, MAX_PATH_STEP = 0.1, 0.3  # in the units of the coordinates
MAX_CORRECTION = 0.1  # of the return to the manifold, relative to the step


def random_walk(
    manifold: Manifold, start: Configuration, positions: int
) -> Iterator[Configuration]:
    """Yield configurations that satisfy the constraints, by small steps in random directions.

    The walk begins at `start`. At most `positions` configurations are yielded, fewer if the system
    cannot move. If the constraints depend on time, the time of the configurations increases.
    """
    random = np.random.default_rng(17)
    free = np.ones(len(start.q), dtype=bool)
    span = manifold.system.run.duration if manifold.timed else 0.0
    configuration, step, count = start, INITIAL_PATH_STEP, 0
    for _ in range(MAX_DIRECTIONS * positions):
        direction = random.normal(size=len(start.q))
        has_moved, steps = False, 0
        for _ in range(8 * STEPS):
            frame = TangentSpace(configuration, free, manifold.holonomic)
            unit = np.sqrt(np.diag(configuration.metric))
            tangent = frame.projected(direction / unit)
            size = float(np.max(np.abs(tangent), initial=0))
            drift = span / positions / STEPS * min(1.0, step / INITIAL_PATH_STEP)
            if size <= 1e-12 * float(np.max(1 / unit)) and not drift:
                return  # no freedom
            tangent = tangent * (step / size) if size > 0 else tangent
            next_configuration = step_on_manifold(manifold, configuration, tangent, drift, free)
            if next_configuration is None:
                step /= 2
                if step < 1e-9:
                    break
                continue
            configuration, has_moved, steps, step = (
                next_configuration,
                True,
                steps + 1,
                min(MAX_PATH_STEP, 1.5 * step),
            )
            if steps == STEPS:
                break
        if not has_moved:  # at a singular configuration few directions are possible
            step = INITIAL_PATH_STEP
            continue
        q, converged = manifold.refine(configuration, free)
        if converged:
            configuration = (
                manifold.configuration(np.array([float(x) for x in q]), configuration.t)
                or configuration
            )
        yield configuration
        count += 1
        if count == positions:
            return


def trace_branch(
    manifold: Manifold, start: Configuration, max_step: float = MAX_PATH_STEP, sign: int = 1
) -> Iterator[Configuration]:
    """Yield configurations that satisfy the constraints, along a curve from `start`.

    Each configuration is a small step from the last. No coordinate changes by more than about
    `max_step` in a step. `sign` (1 or -1) selects one of the two directions at the start.
    """
    free, configuration, step = np.ones(len(start.q), dtype=bool), start, INITIAL_PATH_STEP
    tangent = np.random.default_rng(17).normal(size=len(start.q)) / np.sqrt(np.diag(start.metric))
    tangent = sign * tangent
    while step > 1e-9:
        tangent = TangentSpace(configuration, free, manifold.holonomic).projected(tangent)
        size = float(np.max(np.abs(tangent), initial=0))
        if size == 0:
            return
        next_configuration = step_on_manifold(
            manifold, configuration, tangent * (step / size), 0.0, free
        )
        if next_configuration is None:
            step /= 2
            continue
        configuration, step = next_configuration, min(max_step, 1.5 * step)
        yield configuration


def step_on_manifold(
    manifold: Manifold, place: Configuration, tangent: Vector, drift: float, free: Flags
) -> Configuration | None:
    """Return the configuration after the step `tangent` (nq,), corrected to satisfy constraints.

    The step begins at the configuration `place`. `drift` is the increase of time (s), and `free`
    marks the coordinates that the correction may change. None is returned if the step may be too
    long to stay on the same branch of solutions.
    """
    predicted = manifold.configuration(place.q + tangent, place.t + drift)
    if predicted is None:
        return None
    frame = TangentSpace(predicted, free, manifold.holonomic)
    length = frame.length(tangent) + 1e-9 * frame.length(np.ones(len(tangent)))
    if not drift and frame.length(frame.correction(predicted.phi)) > MAX_CORRECTION * length:
        return None
    corrected, converged = manifold.gauss_newton(predicted.q, free, predicted.t)
    if not converged or corrected is None:
        return None
    return (
        corrected
        if drift or frame.length(corrected.q - predicted.q) <= 2 * MAX_CORRECTION * length
        else None
    )
