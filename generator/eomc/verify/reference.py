"""The interface of independent references, with Runge-Kutta steps and constraints in plain Python.

`symbolic.SymbolicReference` evaluates expressions written out, `taylor.TaylorReference` uses dual
numbers along the definitions. Both take many states at once, as leading rows of their arguments.
Constraints are solved by `kkt`. Parameters that jumps at events set are discrete variables, which
have the kinetic energy s_dot**2/2: each has D = 1, and no other entry in its rows and columns.

`runge_kutta_step` is a step of any method by its tableau, for a given acceleration function.
Generated steppers are compared with it. It stores all stages, and has nothing in common with the
templates except the coefficients of the methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eomc.base.errors import EomcError
from eomc.integrators.tableaux import RK4, Method
from eomc.model.system import System
from eomc.scene.formulas import suggest
from eomc.verify import kkt

ROWS, RATES = ("D", "constraint_jacobian", "constraints"), "constraint_rates"
# multiples of the width, and weights, of central differences of order 8 (Fornberg, 1988)
STENCIL = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
DIFFERENCE_STEP = 0.02  # largest change of a coordinate in differences, m or rad

Vector = NDArray[np.float64]
Params = Mapping[str, Any] | None  # parameter values in place of defaults, by name
Values = tuple[Any, ...]  # of all parameters, in the system's order: numbers, or arrays (b,)

MATRICES = ("D", "C", "constraint_jacobian")
VECTORS = ("g", "bias", "tau", "friction")
SCALARS = ("kinetic", "potential", "energy", "jacobi", "power", "energy_terms", "power_terms")


class ReferenceModel(ABC):
    """Independent evaluation in Python of a system's equations of motion D q̈ + bias = τ.

    Checks compare compiled modules with it. All methods take one state or b states at once. For one
    state, q and qd are (nq,) and u is (nu,). For b states, q and qd are (b, nq), u is (b, nu), t
    and each value in params are one number or (b,), and each result has a leading dimension b.
    """

    system: System

    def terms(self, name: str, s: Mapping[str, Any]) -> float:
        """Return the sum of the absolute values of all terms of "energy" or "power" at a state.

        name: which of the two; products are multiplied out. s: the arguments of `evaluate` by name.
        The result is 0 if this reference does not have the expressions as formulas.
        """
        return 0.0

    @abstractmethod
    def value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value of `name` at one state or at b states.

        Arguments and results are as in `evaluate`, but q, qd and t are arrays, and `values` are
        those of all parameters, in the order of the system. u is None for the scene's signals.
        """

    def evaluate(
        self,
        name: str,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Params = None,
    ) -> Any:
        """Return the value of `name` at a state: a float, a vector or a matrix.

        Parameters
        ----------
        name : str
            D or C (nq, nq); g, bias or tau (nq,); kinetic, potential, energy, jacobi or power; or
            signals (nu,), as in `symbolic.derive`. For the m constraint equations: constraints,
            constraint_rates or gamma (m,), or constraint_jacobian (m, nq).
        q, qd : (nq,) array
            Coordinates, m or rad each, and their velocities; zero velocities if qd is None.
        t : float
            Time, s.
        u : (nu,) array, optional
            Inputs; by default the scene's signals.
        params : mapping, optional
            Parameter values in place of their defaults.

        The result is nan if a formula has no real value. Raises EomcError if params contains a name
        that is not a parameter.
        """
        q = np.asarray(q, float)
        qd = np.zeros_like(q) if qd is None else np.asarray(qd, float)
        moving = np.ones(q.shape[-1])
        moving[self._discrete] = 0.0
        value = self.value(name, q, moving * qd, t, u, self._values(params))
        if name in ("kinetic", "energy", "jacobi"):
            value = value + np.sum(qd[..., self._discrete] ** 2, axis=-1) / 2
        return self.without_discrete_rows(name, value)

    @cached_property
    def _discrete(self) -> list[int]:
        """Indices of the discrete variables, on whose velocities only energies depend."""
        names = self.system.discrete
        return [k for k, c in enumerate(self.system.coordinates) if c.name in names]

    def without_discrete_rows(self, name: str, value: Any) -> Any:
        """Return the value of `name` with the rows and columns of discrete variables cleared."""
        k = self._discrete
        if k and name in (*VECTORS, *MATRICES):
            value[..., k] = 0.0
            if name in ("D", "C"):
                value[..., k, :] = 0.0
                value[..., k, k] = float(name == "D")
        return value

    def mass_and_force(
        self, q: ArrayLike, qd: ArrayLike, t: ArrayLike = 0.0, u: ArrayLike | None = None,
        params: Params = None,
    ) -> tuple[Vector, Vector]:  # fmt: skip
        """Return D (nq, nq) and the force τ - bias (nq,), with the arguments of `evaluate`."""
        D, bias, tau = (self.evaluate(name, q, qd, t, u, params) for name in ("D", "bias", "tau"))
        return D, tau - bias

    def acceleration(
        self, q: ArrayLike, qd: ArrayLike, t: ArrayLike = 0.0, u: ArrayLike | None = None,
        params: Params = None,
    ) -> Vector:  # fmt: skip
        """Return q̈ (nq,) from D q̈ = τ - bias or, under constraints, D q̈ = τ - bias + Aᵀλ.

        Arguments are as in `evaluate`. The result is nan if D is singular.
        """
        if self.system.constraints:
            return self._constrained(q, qd, t, u, params)[0]
        D, force = self.mass_and_force(q, qd, t, u, params)
        try:
            return np.asarray(np.linalg.solve(D, force[..., None])[..., 0])
        except np.linalg.LinAlgError:  # D is singular at one of the states at least
            accelerations = np.full(force.shape, np.nan)
            for k in np.ndindex(force.shape[:-1]):
                with suppress(np.linalg.LinAlgError):
                    accelerations[k] = np.linalg.solve(D[k], force[k])
            return accelerations

    def multipliers(
        self, q: ArrayLike, qd: ArrayLike, t: ArrayLike = 0.0, u: ArrayLike | None = None,
        params: Params = None,
    ) -> Vector:  # fmt: skip
        """Return the Lagrange multipliers of the m constraint equations, (m,).

        They are the λ of D q̈ = τ - bias + Aᵀλ. The multipliers of redundant equations are 0.
        Arguments are as in `evaluate`.
        """
        return np.asarray(self._constrained(q, qd, t, u, params)[1] @ self.solved)

    def _constrained(
        self, q: ArrayLike, qd: ArrayLike, t: ArrayLike, u: ArrayLike | None, params: Params
    ) -> tuple[Vector, Vector]:
        """Return q̈ and the multipliers of the independent constraints that are solved for."""
        D, force = self.mass_and_force(q, qd, t, u, params)
        A, gamma = (
            self.evaluate(name, q, qd, t, u, params) for name in ("constraint_jacobian", "gamma")
        )
        return kkt.solve(D, self.solved @ A, force, -gamma @ self.solved.T)

    def project(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        t: ArrayLike = 0.0,
        params: Params = None,
        fixed: tuple[int, ...] = (),
        nearest: bool = True,
    ) -> tuple[Vector, Vector]:
        """Return q and qd projected onto the constraints, by Newton's method in the metric of D.

        fixed: indices of coordinates whose position and velocity do not change. nearest: whether
        the resulting q must be the nearest one in that metric; otherwise each single Newton
        correction is the shortest, but not their sum. The results are nan if the iteration does not
        converge. Nonholonomic constraints alone do not restrict q.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        if q.ndim > 1:
            times, each = _by_states(t, params, len(q))
            states = [
                self.project(*x, {name: values[k] for name, values in each.items()}, fixed, nearest)
                for k, x in enumerate(zip(q, qd, times, strict=True))
            ]
            ends = np.array(states)
            return ends[:, 0], ends[:, 1]
        positions = self._holonomic > 0

        def rows(x: Vector) -> tuple[Vector, Vector, Vector]:
            D, A, off = (self.solved_values(name, x, qd, t, params) for name in ROWS)
            return *kkt.with_fixed_coordinates(D, A[positions], fixed), off[positions]

        if np.any(positions):
            project = kkt.project_to_nearest if nearest else kkt.project
            q, last_correction = project(q, rows)
            if not last_correction < 1e-10:
                return np.full_like(q, np.nan), np.full_like(q, np.nan)
        D, A = (self.solved_values(name, q, qd, t, params) for name in ROWS[:2])
        D, A = kkt.with_fixed_coordinates(D, A, fixed)
        for _ in range(2):  # linear in qd; the second time corrects rounding errors
            off = self.solved_values(RATES, q, qd, t, params)
            qd = qd + kkt.solve(D, A, np.zeros(len(q)), -off)[0]
        return q, qd

    def corrected(
        self, q: Vector, qd: Vector, t: ArrayLike, params: Params = None
    ) -> tuple[Vector, Vector]:
        """Return q and qd after a step, moved onto the constraints as by generated code.

        q, qd: (nq,), or (b, nq) for b states. Both are corrected together, until corrections of q
        are small. Both corrections use the matrix before the correction; the velocities are those
        to the first order in the correction. The results are nan for a state that does not
        converge.
        """
        if q.ndim == 1:
            q, qd = self.corrected(q[None], qd[None], t, params)
            return q[0], qd[0]
        ends = np.full((2, *q.shape), np.nan)
        remaining = np.arange(len(q))  # states that have not converged
        times, each = _by_states(t, params, len(q))
        for _ in range(12):
            dq, dqd = self._correction(q, qd, times, each)
            q, qd = q + dq, qd + dqd
            size = np.abs(q) + 1e-3 * np.max(np.abs(q), axis=-1, keepdims=True)
            # the square of such a correction is rounding only
            small = np.all(np.abs(dq) <= 1e-8 * size, axis=-1)
            ends[:, remaining[small]] = q[small], qd[small]
            going_on = ~small & np.all(np.isfinite(q), axis=-1)
            if not np.any(going_on):
                break
            remaining, q, qd, times = (x[going_on] for x in (remaining, q, qd, times))
            each = {name: x[going_on] for name, x in each.items()}
        return ends[0], ends[1]

    def _correction(self, q: Vector, qd: Vector, t: Vector, params: Params) -> Vector:
        """Return one Newton correction of q and of q̇, (2, b, nq)."""
        rest = np.zeros_like(q)
        D, A, off = (self.solved_values(name, q, qd, t, params) for name in ROWS)
        dq, _ = kkt.solve(D, A, rest, -self._holonomic * off)
        far = np.max(np.abs(dq), axis=-1, keepdims=True)
        part = np.minimum(1 / 16, DIFFERENCE_STEP / np.maximum(far, DIFFERENCE_STEP))
        slope = np.zeros_like(off)
        for k, weight in STENCIL:
            ends = [
                self.solved_values(RATES, q + x * dq, qd, t, params) for x in (-k * part, k * part)
            ]
            slope += weight / part * (ends[1] - ends[0])
        moved = self.solved_values(RATES, q, qd, t, params) + slope
        dqd, _ = kkt.solve(D, A, rest, -moved)
        return np.stack([dq, dqd])

    def solved_values(
        self, name: str, q: Vector, qd: ArrayLike, t: ArrayLike, params: Params
    ) -> Vector:
        """Return residuals, rates or Jacobian of the r sums of constraint equations in `solved`.

        name: "constraints" or "constraint_rates", (r,), or "constraint_jacobian", (r, nq); or "D".
        """
        u = np.zeros((*q.shape[:-1], len(self.system.inputs)))
        value = np.asarray(self.evaluate(name, q, qd, t, u, params))
        if name == "D":
            return value
        matrix = name == "constraint_jacobian"
        return np.asarray(self.solved @ value if matrix else value @ self.solved.T)

    def step(
        self, q: ArrayLike, qd: ArrayLike, h: float, t: ArrayLike = 0.0, u: ArrayLike | None = None,
        params: Params = None,
    ) -> tuple[Vector, Vector]:  # fmt: skip
        """Return q and qd at t + h by one step of the classical Runge-Kutta method of order 4.

        The result is corrected onto the constraints. With `u`, inputs are held constant over the
        step; without, they are the scene's signals at every stage.
        """

        def acceleration(q: Vector, qd: Vector, t: ArrayLike) -> Vector:
            return self.acceleration(q, qd, t, u, params)

        x = np.asarray(q, float), np.asarray(qd, float)
        end, end_qd = runge_kutta_step(RK4, acceleration, *x, np.asarray(t, float), h)
        if not self.system.constraints:
            return end, end_qd
        return self.corrected(end, end_qd, np.add(t, h), params)

    def simulate(
        self,
        q0: ArrayLike | None = None,
        qd0: ArrayLike | None = None,
        h: float | None = None,
        steps: int | None = None,
        u: ArrayLike | None = None,
        params: Params = None,
        t0: float = 0.0,
    ) -> tuple[Vector, Vector, Vector]:
        """Return a run of n steps by RK4: times t (n + 1,), and q and q̇, both (n + 1, nq).

        q0, qd0, h (s) and steps default to the scene's initial state, step size and duration. t0:
        initial time, s. The first row is the initial state. For b initial states (b, nq), the
        results q and q̇ are (n + 1, b, nq).
        """
        start = self.system.coordinates
        q = np.array([c.start for c in start] if q0 is None else q0, float)
        qd = np.array([c.rate for c in start] if qd0 is None else qd0, float)
        h = self.system.run.h if h is None else h
        steps = round(self.system.run.duration / h) if steps is None else steps
        times, states = t0 + h * np.arange(steps + 1), [(q, qd)]
        for t in times[:-1]:
            states.append(self.step(*states[-1], h, t, u, params))
        qs, qds = zip(*states, strict=True)
        return np.array(times, float), np.array(qs), np.array(qds)

    def _values(self, params: Params) -> Values:
        """Return the parameters in the system's order, with `params` in place of defaults."""
        values = {p.name: p.value for p in self.system.parameters}
        for name in params or ():
            if name not in values:
                raise EomcError(f"'{name}' is not a parameter{suggest(name, values)}")
        return tuple((values | dict(params or {})).values())

    @cached_property
    def solved(self) -> Vector:
        """Weights (r, m) of r independent sums of the m constraint equations.

        The equations of motion are solved with these r sums, which leave out redundant equations.
        In most systems each sum is just one of the constraint equations.
        """
        rows = self.system.solved
        sums = np.zeros((len(rows), len(self.system.constraints)))
        for k, row in enumerate(rows):
            for at, weight in row:
                sums[k, at] = weight
        return sums

    @cached_property
    def switched(self) -> Vector:
        """For each of the r sums in `solved`, whether it applies only while a coordinate sticks."""
        rows = self.system.constraints
        return np.array([any(rows[k].switched for k, _ in row) for row in self.system.solved])

    @cached_property
    def _holonomic(self) -> Vector:
        """For each of the r sums in `solved`, 1 if it is holonomic, else 0."""
        rows = self.system.constraints
        return np.array([float(rows[row[0][0]].holonomic) for row in self.system.solved])


def differences(function: Callable[[Vector], Any], x: Vector, steps: Vector) -> Vector:
    """Return the derivatives (k, n) of a function at x (n,), by central differences of order 8.

    function: returns k values for each row of an array (m, n). steps (n,): the widths.
    """
    rows = x + np.concatenate([k * np.diag(steps) for m, _ in STENCIL for k in (m, -m)])
    values = np.asarray(function(rows)).reshape(len(STENCIL), 2, len(x), -1)
    forward, back = np.moveaxis(values, 1, 0)
    weights = np.array([weight for _, weight in STENCIL])
    return np.asarray((np.tensordot(weights, forward - back, 1) / steps[:, None]).T)


def _by_states(t: ArrayLike, params: Params, count: int) -> tuple[Vector, dict[str, Vector]]:
    """Return the time and the parameters as arrays with an entry for each of the states."""
    each = {name: np.broadcast_to(x, count) for name, x in (params or {}).items()}
    return np.broadcast_to(t, count), each


def by_rows(x: ArrayLike, rows: int) -> list[Any]:
    """Return a list of `rows` values: the entries of x, or x repeated if it is a single number."""
    each: list[Any] = [np.asarray(x).tolist()] * rows
    return each if np.ndim(x) == 0 else np.broadcast_to(x, rows).tolist()


MAX_SWEEPS = 20  # iterations for the stages of an implicit method, with a contraction by 1/7
CONVERGENCE_TOLERANCE = 4 * 2.0**-52  # relative change of the stages by the last iteration

Acceleration = Callable[[Vector, Vector, Any], Vector]


def runge_kutta_step(
    m: Method, acceleration: Acceleration, q: Vector, qd: Vector, t: Any, h: float
) -> Vector:
    """Return q and q̇ at t + h by one step of the Runge-Kutta method `m`, (2, ..., nq).

    q and qd are (..., nq), t is a number or (...,). acceleration: a function of q, q̇ and t that
    returns q̈ of the same shape. For a single state and an implicit method, it is also called with
    all stages at once, (stages, nq) and t (stages,). The result is nan if h is so long that the
    fixed-point iteration for the stages does not converge.
    """
    q, qd = np.asarray(q, float), np.asarray(qd, float)
    A, AA = (_square(rows, m.stages) for rows in (m.a, m.a_squared))
    b, b_a, c = (np.array([float(x) for x in row]) for row in (m.b, m.b_a, m.c))

    def at_stage(i: int, a: Vector) -> Vector:
        place = q + c[i] * h * qd + h**2 * np.tensordot(AA[i], a, 1)
        return acceleration(place, qd + h * np.tensordot(A[i], a, 1), t + c[i] * h)

    def at_stages(a: Vector) -> Vector:
        if q.ndim > 1:
            return np.array([at_stage(i, a) for i in range(m.stages)])
        return acceleration(q + h * np.outer(c, qd) + h**2 * AA @ a, qd + h * A @ a, t + c * h)

    a = np.zeros((m.stages, *q.shape))
    if not m.implicit:
        for i in range(m.stages):
            a[i] = at_stage(i, a)
    else:
        a[:] = acceleration(q, qd, t)
        for _ in range(MAX_SWEEPS):
            new = at_stages(a)
            change = float(np.max(np.abs(new - a)))
            size = np.abs(qd) / h + np.max(np.abs(new), axis=0)
            a = new
            if not np.isfinite(change):  # one stage has overflowed, and others may follow
                a[:] = np.nan
            if not change > CONVERGENCE_TOLERANCE * float(np.max(size)):
                break
        else:
            a[:] = np.nan
    return np.array([q + h * qd + h**2 * np.tensordot(b_a, a, 1), qd + h * np.tensordot(b, a, 1)])


def acceleration_slopes(a: Acceleration, q: Vector, qd: Vector, t: float, scale: Vector) -> Vector:
    """Return the derivatives of the accelerations with respect to q and q̇ at one state, (nq, 2 nq).

    a: a function of q, q̇ and t that returns the accelerations. The derivatives are central
    differences with steps of 1e-5 times `scale` (2, nq), the typical sizes of q and q̇.
    """
    n = len(q)
    by = np.diag(1e-5 * np.ravel(scale))
    moved = np.concatenate([by, -by]) + np.concatenate([q, qd])
    f = a(moved[:, :n], moved[:, n:], np.full(4 * n, t))
    return np.asarray(((f[: 2 * n] - f[2 * n :]) / (2 * np.diag(by)[:, None])).T)


def contraction_factor(m: Method, slopes: Vector, h: float) -> float:
    """Return the factor by which one fixed-point iteration for implicit stages reduces their error.

    m: the implicit method. slopes: the derivatives of the accelerations with respect to q and q̇,
    (nq, 2 nq). h: step size, s. The iteration converges if the factor is below 1.
    """
    return float(np.max(np.abs(np.linalg.eigvals(_sweep(m, slopes, h)))))


def _sweep(m: Method, slopes: Vector, h: float) -> Vector:
    """Return the matrix (S nq, S nq) of fixed-point iteration of the stages' accelerations."""
    A, AA = (_square(rows, m.stages) for rows in (m.a, m.a_squared))
    n = len(slopes)
    return np.asarray(h * np.kron(A, slopes[:, n:]) + h**2 * np.kron(AA, slopes[:, :n]))


def step_by_newton(
    m: Method, acceleration: Acceleration, q: Vector, qd: Vector, t: float, h: float
) -> tuple[Vector, int]:
    """Return q and q̇ at t + h by one implicit step, (2, nq), and the number of Newton iterations.

    m: the implicit method. acceleration: a function of q, q̇ and t that returns q̈. Newton's method
    for the stages uses the derivatives at the start of the step, and the acceleration there as
    first guess. The state is nan if the method has not converged after MAX_SWEEPS iterations.
    """
    n, S = len(q), m.stages
    A, AA = (_square(rows, S) for rows in (m.a, m.a_squared))
    b, b_a, c = (np.array([float(x) for x in row]) for row in (m.b, m.b_a, m.c))
    first = acceleration(q[None], qd[None], np.array([t]))[0]
    scale = np.array([np.abs(q) + 1, np.abs(qd) + 1])
    J = acceleration_slopes(acceleration, q, qd, t, scale)
    M = np.eye(S * n) - _sweep(m, J, h)
    a, count, last = np.tile(first, (S, 1)), 0, np.inf
    while count < MAX_SWEEPS:
        places = q + h * np.outer(c, qd) + h**2 * AA @ a
        f = acceleration(places, qd + h * A @ a, t + c * h)
        if not np.all(np.isfinite(f)):
            break
        d = np.linalg.solve(M, np.ravel(f - a)).reshape(S, n)
        a, count = a + d, count + 1
        change = float(np.max(np.abs(d)))
        size = np.max(np.abs(qd)) / h + np.max(np.abs(q)) / h**2 + np.max(np.abs(a))
        if change <= CONVERGENCE_TOLERANCE * float(size) or (
            change <= 1e-10 * float(size) and change > last / 2  # rounding only
        ):
            ends = [q + h * qd + h**2 * b_a @ a, qd + h * b @ a]
            return np.array(ends), count
        last = change
    return np.full((2, n), np.nan), MAX_SWEEPS


def _square(rows: tuple[tuple[Any, ...], ...], n: int) -> Vector:
    """Return the rows of a triangular or square tableau as an (n, n) array."""
    full = np.zeros((n, n))
    for i, row in enumerate(rows):
        full[i, : len(row)] = [float(x) for x in row]
    return full
