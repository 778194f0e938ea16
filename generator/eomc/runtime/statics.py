"""Equilibria, steady motions, and the actuator forces that a motion requires."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from . import rank
from .arguments import Array, Parameters, Start, as_names, as_number
from .info import SceneInfo
from .interfaces import CompiledModel
from .package import Component, reduced
from .requests import initial_state_for_parameters, values_by_name
from .status import MotionError, refuse, state_text

_DEPENDENT = 1e-11  # singular values of finite differences below it, relative to the largest, are 0
# largest residual of the force balance and of the constraint rows, relative to their terms
_RESIDUAL = {"float64": 1e-6, "float32": 1e-3}


class Motion(NamedTuple):
    """States of a motion and the generalized forces that it requires.

    The shapes are those for one state; for n states all arrays have a first axis n. All arrays but
    q and qd are of type float64.

    Attributes
    ----------
    q, qd, qdd : (nq,) arrays
        Positions, velocities and accelerations.
    force : (nq,) array
        Required sum of the actuator forces and the constraint forces.
    D : (nq, nq) array
        Mass matrix.
    A : (nc, nq) array
        Jacobian of the constraint equations; (0, nq) without constraints.
    free : (nq,) array
        The accelerations that `CompiledModel.acceleration` computes at the states; they satisfy the
        constraint equations. For scenes without constraints they are qdd.
    """

    q: Array
    qd: Array
    qdd: Array
    force: Array
    D: Array
    A: Array
    free: Array

    def state(self, k: tuple[int, ...]) -> Motion:
        """Return the motion at the single state with index k, such as (3,); () for one state."""
        return Motion(*(x[k] for x in self))


def drive_forces(model: CompiledModel, which: list[int], motion: Motion) -> tuple[Array, Array]:
    """Separate the forces that a motion requires into actuator and constraint forces.

    The solution (tau, lambda) satisfies tau + A^T lambda = force at one state. If it is not unique,
    the one with the smallest tau^T D^-1 tau is returned, which does not depend on the units of the
    coordinates.

    Parameters
    ----------
    which : list of int
        Indices of the coordinates along which actuators act.
    motion : Motion
        Motion at one state.

    Returns
    -------
    tau : (nq,) array
        Actuator forces; 0 for the other coordinates.
    lambda : (nc,) array
        Lagrange multipliers; 0 for redundant constraints.

    Raises
    ------
    ValueError
        If there is no solution, or the accelerations violate a constraint.
    MotionError
        If D is not positive definite or a value is not finite.
    """
    kind, force, D = str(model.info.dtype), motion.force, motion.D
    rows, least = model.info.constraints, rank.tolerance(kind)
    solved = [k for k in range(len(rows.names)) if k not in rows.redundant]
    A = motion.A[solved] if solved else motion.A
    if solved:
        _check_constraints(A, [rows.names[k] for k in solved], motion, _RESIDUAL[kind])
    if not all(np.isfinite(x).all() for x in (D, A, force)):
        what = "D, a force or a constraint's slope is not finite there"
        refuse("not finite", motion.q, motion.qd, what=what)
    tangent = rank.null_space(A, kind)
    B, right = tangent.T[:, which], tangent.T @ force
    try:
        L = np.linalg.cholesky(np.linalg.inv(_regularised(D, A))[np.ix_(which, which)])
    except np.linalg.LinAlgError:
        what = "D is not positive definite there, so no force is the least"
        refuse("singular", motion.q, motion.qd, what=what)
    solution = np.linalg.lstsq(np.linalg.solve(L, B.T).T, right, rcond=least)[0]
    tau = np.zeros(model.info.nq)
    tau[which] = np.linalg.solve(L.T, solution)
    if np.any(np.abs(B @ tau[which] - right) > _RESIDUAL[kind] * np.max(np.abs(force), initial=0)):
        names = ", ".join(model.info.coordinates[k] for k in which) or "nothing"
        where = state_text(motion.q, motion.qd)
        raise ValueError(
            f"drives: forces along {names} can't give this motion at {where}: name"
            f" others, or more; there are {len(right)} degrees of freedom"
        )
    multipliers = np.zeros(len(rows.names))
    sizes = np.maximum(np.linalg.norm(A, axis=1), np.finfo(float).tiny)
    multipliers[solved] = np.linalg.lstsq((A.T / sizes), force - tau, rcond=least)[0] / sizes
    return tau, multipliers


def _check_constraints(A: Array, names: list[str], motion: Motion, tolerance: float) -> None:
    """Raise ValueError if the accelerations violate the constraints."""
    qdd, free = motion.qdd, motion.free
    actual, required = A @ qdd, A @ free
    residual = np.abs(actual - required)
    limit = np.abs(A) @ (np.abs(qdd) + np.abs(free))
    worst = int(np.argmax(residual / np.maximum(limit, 1e-300)))
    if residual[worst] > tolerance * limit[worst]:
        raise ValueError(
            f"qdd: leaves the constraint {names[worst]}: its row of A qdd, of "
            f"constraint_jacobian(q), is {actual[worst]:.6g} and has to be {required[worst]:.6g}"
        )


def _regularised(D: Array, A: Array) -> Array:
    """Return D, plus a multiple of A^T A if D is singular."""
    if np.linalg.cond(D) < 1e12:
        return D
    return np.asarray(D + A.T @ A * (np.trace(D) / np.sum(A**2)))


class Equilibrium(NamedTuple):
    """State and inputs of an equilibrium (all accelerations are zero) or of a steady motion.

    Attributes
    ----------
    q, qd : (nq,) arrays
        Positions and velocities.
    u : (nu,) array, or None
        Inputs; None if the scene has none.
    """

    q: Array
    qd: Array
    u: Array | None

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("statics.Equilibrium", *self)


@dataclass(frozen=True)
class _Equations:
    """Equations of an equilibrium, tau + A^T lambda = C qd + g, as functions of z = [q; qd; u].

    The residual is a force, not an acceleration, since D may be singular. With constraints it has
    two further parts: the residuals of the velocity constraints, and the time derivatives of these
    residuals. Steps are tangent to the position constraints.

    moved: mask (len(z),) of the variables that are solved for. t: time, s. z has no inputs if they
    are the scene's signals.
    """

    model: CompiledModel
    moved: Array
    t: float
    params: Any

    @property
    def eps(self) -> float:
        """Relative spacing of the numbers of the module."""
        return float(np.finfo(self.model.info.dtype).eps)

    def split(self, z: Array) -> tuple[Array, Array, Array | None]:
        """Return positions, velocities and inputs; None for the signals of the scene."""
        n = self.model.info.nq
        return z[:n], z[n : 2 * n], z[2 * n :] if len(z) > 2 * n else None

    def forces(self, z: Array) -> Array:
        """Return tau - C qd - g, (nq,)."""
        functions, (q, qd, u) = self.model.functions, self.split(z)
        tau = functions.tau(q, qd, self.t, u, self.params).astype(float)
        return np.asarray(tau - functions.bias(q, qd, self.t, self.params))

    def jacobian(self, z: Array) -> Array:
        """Return the Jacobian A of the constraint equations, (nc, nq)."""
        if not self.model.info.constraints.names:
            return np.zeros((0, self.model.info.nq))
        A = self.model.constraints.constraint_jacobian(self.split(z)[0], self.t, self.params)
        return A.astype(float)

    def residual(self, z: Array) -> Array:
        """Return the vector (nq + 2 nc,) that Newton's method reduces to zero.

        Its parts are: the part of the forces that no A^T lambda can balance, (nq,); the residuals
        of the velocity constraints, (nc,); the time derivatives of these residuals, for constant
        velocities, (nc,), as a central difference.
        """
        forces, (q, qd, _) = self.forces(z), self.split(z)
        if not self.model.info.constraints.names:
            return forces
        tangent = rank.null_space(self.jacobian(z), self.model.info.dtype)
        short = np.cbrt(self.eps) / self._pace(z)
        rates = self.model.constraints.constraint_rates
        before, now, then = (
            rates(q + e * qd, qd, self.t + e, self.params).astype(float)
            for e in (-short, 0.0, short)
        )
        return np.concatenate([tangent @ (tangent.T @ forces), now, (then - before) / (2 * short)])

    def sizes(self, z: Array, terms: Array) -> Array:
        """Return the magnitudes of the terms of the residual, from those of its derivatives."""
        n, sizes = self.model.info.nq, terms.copy()
        sizes[:n] = np.max(sizes[:n], initial=0)
        if self.model.info.constraints.names:
            rates = np.abs(self.jacobian(z)) @ np.abs(self.split(z)[1])
            sizes[:n] += np.max(np.abs(self.forces(z)))
            sizes[n:] += np.concatenate([rates, rates * self._pace(z)])
        return sizes

    def _pace(self, z: Array) -> float:
        """Return the relative rate of change of the state, 1/s."""
        q, qd, _ = self.split(z)
        return float(np.max(np.abs(qd) / np.maximum(1.0, np.abs(q)), initial=1.0))

    def project(self, z: Array) -> Array:
        """Project the free coordinates onto the constraints; raise MotionError if that fails."""
        n = self.model.info.nq
        if not self.model.info.constraints.names:
            return z
        fixed = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model.constraints.project_fixed(z[:n], np.zeros(n), self.t, self.params, fixed)
        return np.concatenate([q, z[n:]])

    def moved_by(self, z: Array, step: Array) -> Array | None:
        """Return z + step, projected onto the constraints; None if the projection fails."""
        try:
            return self.project(z + step)
        except MotionError:
            return None

    def directions(self, z: Array) -> Array:
        """Return orthonormal directions (k, len(z)) in which z may change, one in each row.

        Free coordinates change tangentially to the position constraints. Each free velocity or
        input adds one direction.
        """
        n, free = self.model.info.nq, np.flatnonzero(self.moved[: self.model.info.nq])
        A = self.jacobian(z)[: self.model.info.constraints.holonomic, free]
        basis = rank.null_space(A, self.model.info.dtype).T
        directions = np.zeros((len(basis), len(z)))
        directions[:, free] = basis
        return np.concatenate([directions, np.eye(len(z))[n:][self.moved[n:]]])


def _equilibrium(equations: _Equations, guess: Array) -> Array:
    """Solve the equations from a guess by Newton's method; raise MotionError without a solution.

    The Jacobian is a finite difference; its error slows convergence but does not affect the result.
    Newton steps of underdetermined systems are those of minimum norm. If they end in a local
    minimum of the residual, they begin again downhill from it.
    """
    max_restarts = 24
    z, downhill, first = equations.project(guess), None, None
    for _ in range(max_restarts):
        z, residual, terms = _newton(equations, z)
        # a smaller residual is rounding error
        is_rounding = np.abs(residual) <= np.sqrt(equations.eps) * equations.sizes(z, terms)
        excess = np.where(is_rounding, 0.0, residual)
        first = first or (z, excess)
        if not excess.any():
            break
        downhill = _downhill(equations, z if downhill is None else downhill)
        if downhill is None:
            break
        z = downhill
    if excess.any() and first:
        z, excess = first
    _refuse(equations, z, excess, guess)
    return z


def _newton(equations: _Equations, z: Array) -> tuple[Array, Array, Array]:
    """Minimise the residual from z by Newton's method; return z, it and the sizes of its terms."""
    max_steps, min_fraction = 100, 2.0**-20  # of a step in the line search
    n, width = equations.model.info.nq, np.cbrt(equations.eps)
    now = equations.residual(z)
    sizes = np.full(len(now), np.inf)
    for _ in range(max_steps):
        directions = equations.directions(z)
        reach = np.maximum(1.0, np.abs(directions) @ np.abs(z))
        ends = [
            [equations.residual(equations.project(z + side * e)) for side in (1, -1)]
            for e in width * reach[:, None] * directions
        ]
        columns = [after - before for after, before in ends]
        slope = np.reshape(columns, (-1, len(now))).T / (2 * width * reach)
        sizes = np.abs(slope) @ reach
        if not np.isfinite(sizes.sum() + now @ now) or not len(directions):
            break
        along = -np.linalg.lstsq(slope, now, rcond=_DEPENDENT)[0]
        step = along @ directions
        fall = 1e-3 * (now @ slope @ along)  # sufficient decrease for a full step
        # a coordinate changes by 1, or its own size, at most, since angles are periodic
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > min_fraction:
            there = equations.moved_by(z, part * step)
            new = None if there is None else equations.residual(there)
            if new is not None and new @ new < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        assert there is not None and new is not None
        z, now = there, new
    return z, now, sizes


def _downhill(equations: _Equations, z: Array) -> Array | None:
    """Return a step from z along the accelerations from rest; None if they vanish.

    It leaves local minima of the residual, as halfway between two equilibria.
    """
    stride = 0.2  # rad or relative
    n, directions = equations.model.info.nq, equations.directions(z)
    directions = directions[:, :n][np.any(directions[:, :n], axis=1)]
    D = equations.model.functions.D(z[:n], equations.t, equations.params).astype(float)
    D, forces = directions @ D @ directions.T, directions @ equations.forces(z)
    if not (len(D) and np.isfinite(D).all() and np.isfinite(forces).all()):
        return None
    step = np.linalg.lstsq(D, forces, rcond=_DEPENDENT)[0] @ directions
    size = np.max(np.abs(step) / np.maximum(1.0, np.abs(z[:n])), initial=0.0)
    if not 0 < size < np.inf:
        return None
    return equations.moved_by(z, np.concatenate([stride / size * step, np.zeros(len(z) - n)]))


def _refuse(equations: _Equations, z: Array, excess: Array, guess: Array) -> None:
    """Raise MotionError if the search ended with a residual above rounding error."""
    info, (q, qd, _) = equations.model.info, equations.split(z)
    why = _largest_residual(info, excess) if excess.any() else _slip(equations, z)
    if not why:
        return
    q0, qd0, _ = equations.split(guess)
    end = f"q = {np.array2string(q, precision=6, threshold=12)}"
    if np.any(qd != qd0):
        end = state_text(q, qd)
    raise MotionError(
        f"no equilibrium found from {state_text(q0, qd0)}: the search ends at {end}, where "
        f"{why}{_exceeded_limits(equations, z)}; start elsewhere, or let another coordinate, rate "
        f"(free=[..., '{info.states[info.nq]}']) or input be free",
        "no convergence",
    )


def _largest_residual(info: SceneInfo, residual: Array) -> str:
    """Describe the largest residual: of a velocity constraint, or of a force."""
    forces, rates, changes = np.split(residual, [info.nq, (info.nq + len(residual)) // 2])
    for values, words in ((rates, "break {} by {:.3g}"), (changes, "break {}, by {:.3g} a second")):
        if values.any():
            worst = int(np.argmax(np.abs(values)))
            return f"the rates {words.format(info.constraints.names[worst], values[worst])}"
    worst = int(np.argmax(np.abs(forces)))
    return f"a force of {forces[worst]:.3g} is left on {info.coordinates[worst]}"


def _slip(equations: _Equations, z: Array) -> str:
    """Describe a joint whose static friction is exceeded; "" if there is none."""
    model, (q, qd, u) = equations.model, equations.split(z)
    others = equations.t, u, equations.params
    if not model.info.constraints.modes:
        return ""
    values = model.constraints.multipliers(q, qd, *others)
    multipliers = dict(zip(model.info.constraints.names, values, strict=True))
    for at, of in model.info.constraints.modes:
        name, sliding = model.info.coordinates[of], q.copy()
        sliding[at] = 1.0
        friction, rest = (model.functions.tau(x, qd, *others)[of] for x in (sliding, q))
        most, force = abs(friction - rest), abs(multipliers[f"{name}_sticks"])
        if not q[at] and force > most * (1 + 1e-6):
            return f"{name} slips, as {force:.3g} is more than its friction holds, {most:.3g}"
    return ""


def _exceeded_limits(equations: _Equations, z: Array) -> str:
    """Describe the inputs that exceed their limits; "" if there are none."""
    functions, (q, qd, u) = equations.model.functions, equations.split(z)
    if not functions.has_limits:
        return ""
    t, params = equations.t, equations.params
    requested = functions.signal(q, qd, t, params) if u is None else u
    beyond = requested != functions.applied(q, qd, t, u, params)
    names = [name for name, far in zip(equations.model.info.inputs, beyond, strict=True) if far]
    if not names:
        return ""
    return f", with {', '.join(names)} beyond {'their' if names[1:] else 'its'} limits"


class Statics(Component):
    """A compiled scene with methods for inverse problems.

    The problems are the actuator forces that a motion requires, and equilibria.
    """

    path = "statics"

    def __init__(self, model: CompiledModel) -> None:
        self.model, self.info, self.arguments = model, model.info, model.arguments

    def drive_forces(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, drives: Sequence[str] | None = None,
        f_ext: Mapping[str, ArrayLike] | ArrayLike | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the actuator forces tau and the multipliers lambda that a given motion requires.

        tau + A^T lambda equals `inverse_dynamics` minus friction and all other forces of the scene
        at zero inputs. If there are more drives than degrees of freedom, the solution with the
        smallest tau^T D^-1 tau is returned.

        Parameters
        ----------
        q, qd, qdd : (nq,) or (n, nq) array_like
            State and accelerations of the motion.
        drives : sequence of str, optional
            Coordinates along which actuators act; by default all. tau is 0 along the others.
        f_ext : mapping or array_like, optional
            External wrenches (force and moment) on frames, in the form of `wrenches` in
            `frame_forces`.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        tau : (nq,) or (n, nq) array
            Actuator forces along the coordinates, N or N m.
        multipliers : (nc,) or (n, nc) array
            Lagrange multiplier of each constraint equation.

        Raises
        ------
        ValueError
            If the drives cannot produce this motion, or the constraints do not allow `qdd`.
        MotionError
            If D is not positive definite or a value is not finite.
        """
        coordinates, rows = self.info.coordinates, self.info.constraints
        names = coordinates if drives is None else as_names("drives", drives, coordinates)
        which = sorted({coordinates.index(name) for name in names})
        force = self.model.frames.inverse_dynamics(q, qd, qdd, f_ext, t=t, params=params)
        force = force - self.model.functions.tau(
            q, qd, t, np.zeros(self.info.nu) if self.info.nu else None, params
        )
        at, moving = self.arguments.state(q, qd)
        each = self.arguments.for_each_state(qdd, "qdd", (self.info.nq,), at)
        tau = np.empty_like(at)
        multipliers = np.empty((*at.shape[:-1], len(rows.names)), at.dtype)
        D, A = self.model.functions.D(at, t, params), np.zeros((*at.shape[:-1], 0, self.info.nq))
        free = each
        if len(rows.names) > len(rows.redundant):
            A = self.model.constraints.constraint_jacobian(at, t, params)
            free = self.model.functions.acceleration(at, moving, t, params=params)
        motion = Motion(at, moving, *(np.asarray(x, float) for x in (each, force, D, A, free)))
        for k in np.ndindex(at.shape[:-1]):
            tau[k], multipliers[k] = drive_forces(self.model, which, motion.state(k))
        return tau, multipliers

    def equilibrium(
        self, q: Start = None, qd: Start = 0.0, t: float = 0.0, u: Any = None,
        params: Parameters = None, *, free: Collection[str] | None = None,
    ) -> Equilibrium:  # fmt: skip
        """Find a state and inputs at which the accelerations are zero, by Newton's method.

        Parameters
        ----------
        q : (nq,) array or dict, optional
            Positions, or their guess. Values that are not given are the initial values of the
            scene.
        qd : float, (nq,) array or dict
            Velocities, or their guess. Values that are not given are 0.
        t : float
            Time, s.
        u : (nu,) array or dict, optional
            Inputs, or their guess; by default the scene's signals.
        params : optional
            Parameters that differ from those of the scene.
        free : collection of str, optional
            Names of the coordinates, velocities (such as "theta_dot") and inputs that are solved
            for; by default all coordinates that have velocities. All other values stay as they are
            given. If `free` contains velocities, such as "charge_dot", the result is a steady
            motion, provided that no force changes along it.

        Returns
        -------
        Equilibrium
            The named tuple (q, qd, u).

        Raises
        ------
        MotionError
            If no equilibrium is found; its status is "no convergence".
        """
        known = (*self.info.states, *self.info.inputs)
        rates: Any = qd
        by_name = values_by_name(self.model, rates, 1)
        if by_name is not None:
            moving = np.zeros(self.info.nq)
            for name, value in by_name.items():
                moving[self.info.coordinates.index(name)] = value
        elif not isinstance(rates, (list, tuple)) and not np.ndim(rates):
            moving = np.full(self.info.nq, as_number(rates, "qd"))
        else:
            moving = self.info.with_discrete(rates, 1)
        q = self.info.with_discrete(q, 0)
        at, moving = self.arguments.state(
            *initial_state_for_parameters(self.model, q, moving, self.arguments.parameters(params)),
            many=False,
        )
        names = self.info.coordinates[: self.info.nq - self.info.discrete_count]
        if free is not None:
            names = as_names("free", free, known)
        moved, t = np.array([name in names for name in known]), as_number(t, "t")
        inputs, signal = self.arguments.inputs(u), self.model.functions.signal
        if inputs is None and np.any(moved[2 * self.info.nq :]):
            inputs = np.asarray(signal(at, moving, t, params))
        z = np.concatenate([at, moving, np.empty(0) if inputs is None else inputs]).astype(float)
        equations = _Equations(self.model, moved[: len(z)], t, params)
        q, qd, u = equations.split(_equilibrium(equations, z))
        q, qd = (x.astype(self.info.dtype) for x in (q, qd))
        if u is None:
            u = np.asarray(signal(q, qd, t, params)) if self.info.nu else None
        return Equilibrium(q, qd, u if u is None else u.astype(self.info.dtype))
