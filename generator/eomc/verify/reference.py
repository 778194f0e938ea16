"""The interface of independent references, with RK4 in plain Python.

`symbolic.SymbolicReference` evaluates expressions written out, `taylor.TaylorReference` uses Taylor
arithmetic along the definitions. Both take many states at once, as leading rows of their arguments.
Constraints are solved by `kkt`. `DiscreteReference` adds the parameters that jumps at events set to
one of the two, as discrete variables: each has D = 1, no other entry in its rows, and the kinetic
energy s_dot**2/2.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eomc.base.errors import EomcError
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
        return self.value(name, q, qd, t, u, self._values(params))

    def acceleration(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Params = None,
    ) -> Vector:
        """Return q̈ (nq,) from D q̈ = τ - bias or, under constraints, D q̈ = τ - bias + Aᵀλ.

        Arguments are as in `evaluate`. The result is nan if D is singular.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        return self._acceleration(q, qd, t, u, self._values(params))

    def multipliers(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Params = None,
    ) -> Vector:
        """Return the Lagrange multipliers of the m constraint equations, (m,).

        They are the λ of D q̈ = τ - bias + Aᵀλ. The multipliers of redundant equations are 0.
        Arguments are as in `evaluate`.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        _, solved = self._constrained(q, qd, t, u, self._values(params))
        return np.asarray(solved @ self.solved)

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
        converge.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        project_one = partial(self._project_state, fixed=fixed, nearest=nearest)
        return self._map_states(project_one, q, qd, np.asarray(t, float), self._values(params))

    def corrected(
        self, q: Vector, qd: Vector, t: ArrayLike, params: Params = None
    ) -> tuple[Vector, Vector]:
        """Return q and qd after a step, moved onto the constraints as by generated code.

        q, qd: (nq,), or (b, nq) for b states.
        """
        return self._corrected(q, qd, t, self._values(params))

    def step(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        h: float,
        t: ArrayLike = 0.0,
        u: ArrayLike | None = None,
        params: Params = None,
    ) -> tuple[Vector, Vector]:
        """Return q and qd at t + h by one step of the classical Runge-Kutta method of order 4.

        The result is corrected onto the constraints. With `u`, inputs are held constant over the
        step; without, they are the scene's signals at every stage.
        """
        q, qd = np.asarray(q, float), np.asarray(qd, float)
        return self._step(q, qd, h, np.asarray(t, float), u, self._values(params))

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
        values = self._values(params)
        rows = [(t0, q, qd)]
        for n in range(steps):
            q, qd = self._step(q, qd, h, t0 + n * h, u, values)
            rows.append((t0 + (n + 1) * h, q, qd))
        times, qs, qds = zip(*rows, strict=True)
        return np.array(times), np.array(qs), np.array(qds)

    @cached_property
    def _defaults(self) -> Values:
        return tuple(p.value for p in self.system.parameters)

    def _values(self, params: Params) -> Values:
        """Return the parameters in the system's order, with `params` in place of defaults."""
        if not params:
            return self._defaults
        values = {p.name: p.value for p in self.system.parameters}
        for name in params:
            if name not in values:
                raise EomcError(f"'{name}' is not a parameter{suggest(name, values)}")
        return tuple((values | dict(params)).values())

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

    def _acceleration(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Vector:
        if self.system.constraints:
            return self._constrained(q, qd, t, u, values)[0]
        D, force = self.mass_and_force(q, qd, t, u, values)
        try:
            return np.asarray(np.linalg.solve(D, force[..., None])[..., 0])
        except np.linalg.LinAlgError:  # D is singular at one of the states at least
            accelerations = np.full(force.shape, np.nan)
            for k in np.ndindex(force.shape[:-1]):
                with suppress(np.linalg.LinAlgError):
                    accelerations[k] = np.linalg.solve(D[k], force[k])
            return accelerations

    def _constrained(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        """Return q̈ and the multipliers of the independent constraints that are solved for."""
        D, force = self.mass_and_force(q, qd, t, u, values)
        A, gamma = (
            self.value(name, q, qd, t, u, values) for name in ("constraint_jacobian", "gamma")
        )
        return kkt.solve(D, self.solved @ A, force, -gamma @ self.solved.T)

    def _map_states(
        self, function: Callable[..., tuple[Vector, Vector]], q: Vector, qd: Vector, t: Any,
        values: Values,
    ) -> tuple[Vector, Vector]:  # fmt: skip
        """Apply `function` to each state and return the stacked results."""
        if q.ndim == 1:
            return function(q, qd, t, values)
        times, *each = (by_rows(x, len(q)) for x in (t, *values))
        params = zip(*each, strict=True) if each else [()] * len(q)
        ends = np.array([function(*state) for state in zip(q, qd, times, params, strict=True)])
        return ends[:, 0], ends[:, 1]

    def _constraint_values(
        self, name: str, q: Vector, qd: Vector, t: Any, values: Values
    ) -> Vector:
        """Return D, or the value `name` of the independent constraints that are solved for."""
        u = np.zeros((*q.shape[:-1], len(self.system.inputs)))
        value = np.asarray(self.value(name, q, qd, t, u, values))
        if name == "D":
            return value
        matrix = name == "constraint_jacobian"
        return np.asarray(self.solved @ value if matrix else value @ self.solved.T)

    def _project_state(
        self,
        q: Vector,
        qd: Vector,
        t: Any,
        values: Values,
        fixed: tuple[int, ...],
        nearest: bool,
    ) -> tuple[Vector, Vector]:
        """Apply `project` to one state; nonholonomic constraints alone do not restrict q."""
        positions = self._holonomic > 0

        def rows(x: Vector) -> tuple[Vector, Vector, Vector]:
            D, A, off = (self._constraint_values(name, x, qd, t, values) for name in ROWS)
            return *kkt.with_fixed_coordinates(D, A[positions], fixed), off[positions]

        if np.any(positions):
            project = kkt.project_to_nearest if nearest else kkt.project
            q, last_correction = project(q, rows)
            if not last_correction < 1e-10:
                return np.full_like(q, np.nan), np.full_like(q, np.nan)
        D, A = (self._constraint_values(name, q, qd, t, values) for name in ROWS[:2])
        D, A = kkt.with_fixed_coordinates(D, A, fixed)
        for _ in range(2):  # linear in qd; the second time corrects rounding errors
            by, _ = kkt.solve(
                D, A, np.zeros(len(q)), -self._constraint_values(RATES, q, qd, t, values)
            )
            qd = qd + by
        return q, qd

    def _corrected(self, q: Vector, qd: Vector, t: Any, values: Values) -> tuple[Vector, Vector]:
        """Correct q and q̇ after a step together, until corrections of q are small.

        Both use the matrix before the correction; the velocities are those to the first order in
        the correction. The results are nan for a state that does not converge.
        """
        if q.ndim == 1:
            q, qd = self._corrected(q[None], qd[None], t, values)
            return q[0], qd[0]
        ends = np.full((2, *q.shape), np.nan)
        remaining = np.arange(len(q))  # states that have not converged
        t, *each = (np.broadcast_to(x, len(q)) for x in (t, *values))
        for _ in range(12):
            dq, dqd = self._correction(q, qd, t, tuple(each))
            q, qd = q + dq, qd + dqd
            size = np.abs(q) + 1e-3 * np.max(np.abs(q), axis=-1, keepdims=True)
            # the square of such a correction is rounding only
            small = np.all(np.abs(dq) <= 1e-8 * size, axis=-1)
            ends[:, remaining[small]] = q[small], qd[small]
            going_on = ~small & np.all(np.isfinite(q), axis=-1)
            if not np.any(going_on):
                break
            remaining, q, qd, t, *each = (x[going_on] for x in (remaining, q, qd, t, *each))
        return ends[0], ends[1]

    def _correction(self, q: Vector, qd: Vector, t: Vector, values: Values) -> Vector:
        """Return one Newton correction of q and of q̇, (2, b, nq)."""
        rest = np.zeros_like(q)
        D, A, off = (self._constraint_values(name, q, qd, t, values) for name in ROWS)
        dq, _ = kkt.solve(D, A, rest, -self._holonomic * off)
        far = np.max(np.abs(dq), axis=-1, keepdims=True)
        part = np.minimum(1 / 16, DIFFERENCE_STEP / np.maximum(far, DIFFERENCE_STEP))
        slope = np.zeros_like(off)
        for k, weight in STENCIL:
            ends = [
                self._constraint_values(RATES, q + x * dq, qd, t, values)
                for x in (-k * part, k * part)
            ]
            slope += weight / part * (ends[1] - ends[0])
        moved = self._constraint_values(RATES, q, qd, t, values) + slope
        dqd, _ = kkt.solve(D, A, rest, -moved)
        return np.stack([dq, dqd])

    def mass_and_force(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        """Return D (nq, nq) and the force τ - bias (nq,), with the arguments of `value`."""
        D, bias, tau = (self.value(name, q, qd, t, u, values) for name in ("D", "bias", "tau"))
        return D, tau - bias

    def _step(
        self, q: Vector, qd: Vector, h: float, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        v1, a1 = qd, self._acceleration(q, qd, t, u, values)
        v2 = qd + h / 2 * a1
        a2 = self._acceleration(q + h / 2 * v1, v2, t + h / 2, u, values)
        v3 = qd + h / 2 * a2
        a3 = self._acceleration(q + h / 2 * v2, v3, t + h / 2, u, values)
        v4 = qd + h * a3
        a4 = self._acceleration(q + h * v3, v4, t + h, u, values)
        q = q + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        qd = qd + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return self._corrected(q, qd, np.add(t, h), values) if self.system.constraints else (q, qd)


def by_rows(x: ArrayLike, rows: int) -> list[Any]:
    """Return a list of `rows` values: the entries of x, or x repeated if it is a single number."""
    each: list[Any] = [np.asarray(x).tolist()] * rows
    return each if np.ndim(x) == 0 else np.broadcast_to(x, rows).tolist()


VECTORS = ("g", "bias", "tau", "friction")
WITH_KINETIC_ENERGY = ("kinetic", "energy", "jacobi")


class DiscreteReference(ReferenceModel):
    """Reference of a system with discrete variables: parameters that jumps at events set.

    A reference is the independent evaluation of the equations in Python. system: the system, with
    the discrete variables as additional coordinates. core: the reference of the same system with
    the discrete variables as parameters.
    """

    def __init__(self, system: System, core: ReferenceModel) -> None:
        self.system, self.core = system, core
        names = [c.name for c in system.coordinates]
        self.continuous_indices = [k for k, name in enumerate(names) if name not in system.discrete]
        self.discrete_indices = [k for k, name in enumerate(names) if name in system.discrete]

    def terms(self, name: str, s: Mapping[str, Any]) -> float:
        """Return the sum of the absolute values of all terms of "energy" or "power" at a state.

        s: the arguments of `evaluate` by name. See `ReferenceModel.terms`.
        """
        q, qd = np.asarray(s["q"]), np.asarray(s["qd"])
        values = {self.system.coordinates[k].name: float(q[k]) for k in self.discrete_indices}
        params = {**(s.get("params") or {}), **values}
        own = {
            **s,
            "q": q[self.continuous_indices],
            "qd": qd[self.continuous_indices],
            "params": params,
        }
        added = float(np.sum(qd[self.discrete_indices] ** 2)) / 2 if name == "energy" else 0.0
        return self.core.terms(name, own) + added

    def value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value of `name`; see `ReferenceModel.value`."""
        value = np.asarray(self.core.value(name, *self._core_arguments(q, qd, t, u, values)))
        if name in WITH_KINETIC_ENERGY:
            value = value + np.sum(qd[..., self.discrete_indices] ** 2, axis=-1) / 2
        elif name in VECTORS or name == "constraint_jacobian":
            value = self._with_discrete_columns(value)
        elif name in ("D", "C"):
            value = self._with_discrete_block(value, float(name == "D"))
        return value[()]

    def mass_and_force(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        """Return D and τ - bias; see `ReferenceModel.mass_and_force`."""
        D, force = self.core.mass_and_force(*self._core_arguments(q, qd, t, u, values))
        return self._with_discrete_block(D, 1.0), self._with_discrete_columns(force)

    def _core_arguments(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector, Any, ArrayLike | None, Values]:
        """Return the arguments of the core reference, discrete variables among the parameters."""
        discrete = (q[..., k] for k in self.discrete_indices)
        return (
            q[..., self.continuous_indices],
            qd[..., self.continuous_indices],
            t,
            u,
            (*values, *discrete),
        )

    def _with_discrete_columns(self, columns: Vector) -> Vector:
        """Return the values with zeros for the discrete variables, (..., nq)."""
        result = np.zeros(
            (*columns.shape[:-1], len(self.continuous_indices) + len(self.discrete_indices))
        )
        result[..., self.continuous_indices] = columns
        return result

    def _with_discrete_block(self, matrix: Vector, diagonal: float) -> Vector:
        """Return the matrix (..., nq, nq) with `diagonal` on the discrete variables' diagonal."""
        result = np.swapaxes(
            self._with_discrete_columns(np.swapaxes(self._with_discrete_columns(matrix), -1, -2)),
            -1,
            -2,
        )
        result[..., self.discrete_indices, self.discrete_indices] = diagonal
        return result
