"""Equilibria, steady motions, and the actuator forces that a motion requires."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, Parameters, Start, as_number, not_one_of
from .interfaces import CompiledModel
from .package import Component, reduced
from .starts import initial_state_for_parameters, values_by_name
from .status import MotionError, state_text

# relative to the largest singular value: rows below it are linearly dependent
_DEPENDENT = {"float64": 1e-9, "float32": 1e-4}
# largest residual of the force balance and of the constraint rows, relative to their terms
_RESIDUAL = {"float64": 1e-6, "float32": 1e-3}


def actuated_coordinates(model: CompiledModel, drives: Sequence[str] | None) -> list[int]:
    """Return the sorted indices of the coordinates along which actuators act.

    drives: names of these coordinates; None: all coordinates. Raises ValueError for unknown names.
    """
    if drives is None:
        return [*range(model.info.nq)]
    names = (drives,) if isinstance(drives, str) else tuple(drives)
    for name in names:
        if name not in model.info.coordinates:
            raise ValueError(not_one_of("drives", str(name), model.info.coordinates))
    return sorted({model.info.coordinates.index(name) for name in names})


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

    @classmethod
    def from_states(
        cls,
        model: CompiledModel,
        q: Array,
        qd: Array,
        qdd: Array,
        force: Array,
        t: Any,
        params: Any,
    ) -> Motion:
        """Evaluate D, A and the accelerations `free` at the states, and return the motion.

        q, qd, qdd: (nq,) or (n, nq), positions, velocities and accelerations. force: required sum
        of actuator and constraint forces, of the same shape. t: time, s. params: parameters. Raises
        MotionError if an acceleration does not exist.
        """
        D, A, free = (
            model.functions.D(q, t=t, params=params),
            np.zeros((*q.shape[:-1], 0, model.info.nq)),
            qdd,
        )
        if len(model.info.constraints.names) > len(model.info.constraints.redundant):
            A = model.constraints.constraint_jacobian(q, t=t, params=params)
            free = model.functions.acceleration(q, qd, t, params=params)
        return cls(q, qd, *(np.asarray(x, float) for x in (qdd, force, D, A, free)))

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
    rows, least = model.info.constraints, _DEPENDENT[kind]
    solved = [k for k in range(len(rows.names)) if k not in rows.redundant]
    A = motion.A[solved] if solved else motion.A
    if solved:
        _check_constraints(A, [rows.names[k] for k in solved], motion, _RESIDUAL[kind])
    if not all(np.isfinite(x).all() for x in (D, A, force)):
        words = "D, a force or a constraint's slope is not finite there"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "not finite")
    tangent = _null_space(A, least)
    B, right = tangent.T[:, which], tangent.T @ force
    try:
        L = np.linalg.cholesky(np.linalg.inv(_regularised(D, A))[np.ix_(which, which)])
    except np.linalg.LinAlgError:
        words = "D is not positive definite there, so no force is the least"
        raise MotionError(f"at {state_text(motion.q, motion.qd)}: {words}", "singular") from None
    solution = np.linalg.lstsq(np.linalg.solve(L, B.T).T, right, rcond=least)[0]
    tau = np.zeros(model.info.nq)
    tau[which] = np.linalg.solve(L.T, solution)
    if np.any(np.abs(B @ tau[which] - right) > _RESIDUAL[kind] * np.max(np.abs(force), initial=0)):
        names = ", ".join(model.info.coordinates[k] for k in which) or "nothing"
        where = state_text(motion.q, motion.qd)
        raise ValueError(
            f"drives: forces along {names} can't give this motion at {where}: name"
            f" others, or more; there are {len(right)} freedoms"
        )
    multipliers = np.zeros(len(rows.names))
    multipliers[solved] = np.linalg.lstsq(A.T, force - tau, rcond=least)[0]
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


def _null_space(A: Array, least: float) -> Array:
    """Return an orthonormal basis (nq, k) of the null space of A."""
    if not len(A):
        return np.eye(A.shape[1])
    _, sizes, directions = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=1)[:, None], 1e-300))
    return np.asarray(directions[int((sizes > least * sizes[0]).sum()) :].T)


def _regularised(D: Array, A: Array) -> Array:
    """Return D, plus a multiple of A^T A if D is singular."""
    if np.linalg.cond(D) < 1e12:
        return D
    return np.asarray(D + A.T @ A * (np.trace(D) / np.sum(A**2)))


_MOST = 100  # maximum number of Newton steps
_RANK_TOLERANCE = 1e-9  # relative to the largest singular value of A: rank tolerance
_SHORTEST = 2.0**-20  # smallest fraction of a Newton step in the line search
_TRIES, _STRIDE = 24, 0.2  # restarts of Newton's method; step between them, rad or relative

_Function = Callable[[Array], Array]


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


def equilibrium(
    model: CompiledModel, q: Array, qd: Array, u: Array | None, free: Collection[str], t: float,
    params: Any,
) -> Equilibrium:  # fmt: skip
    """Solve tau + A^T lambda = C qd + g for the variables in `free`, by Newton's method.

    q, qd, u: initial guess of the variables in `free`, and the values of all other variables. If u
    is None, the inputs are the scene's signals. free: names of coordinates, velocities (such as
    "theta_dot") and inputs. t: time, s. Raises MotionError if no solution is found, ValueError for
    an unknown name.

    The residual is a force, not an acceleration, since D may be singular. The Jacobian is a finite
    difference; its error slows convergence but does not affect the result. Newton steps of
    underdetermined systems are those of minimum norm.

    With constraints, the residual has three parts: the forces that multipliers cannot balance, the
    residuals of the velocity constraints, and the time derivatives of these residuals. Steps are
    tangent to the position constraints.
    """
    n, known = model.info.nq, (*model.info.states, *model.info.inputs)
    if strange := [name for name in free if name not in known]:
        raise ValueError(not_one_of("free", strange[0], known))
    moved = np.array([name in free for name in known])
    if u is None and np.any(moved[2 * n :]):
        u = np.asarray(model.functions.signal(q, qd, t, params))
    z = np.concatenate([q, qd, np.empty(0) if u is None else u]).astype(float)
    moved = moved[: len(z)]
    rows = _Rows(model, moved, t, params) if model.info.constraints.names else None

    def inputs(z: Array) -> Array | None:
        """Return the inputs in z = [q; qd; u]; None for the signals of the scene."""
        return None if u is None else z[2 * n :]

    def forces(z: Array) -> Array:
        """Return tau - C qd - g (nq,) at z."""
        at, moving = z[:n], z[n : 2 * n]
        tau = model.functions.tau(at, moving, t, inputs(z), params)
        values: Array = tau.astype(float) - model.functions.bias(at, moving, t=t, params=params)
        return values

    def residual(z: Array) -> Array:
        """Return the residual at z = [q; qd; u], the vector that Newton's method reduces to zero.

        It is tau - C qd - g (nq,) without constraints, else `_Rows.residual`, (nq + 2 nc,).
        """
        return rows.residual(z, forces(z)) if rows else forces(z)

    eps = float(np.finfo(model.info.dtype).eps)
    onto = rows.onto if rows else lambda z: z

    def D(z: Array) -> Array:
        """Return the mass matrix (nq, nq) at z."""
        matrix: Array = model.functions.D(z[:n], t=t, params=params)
        return matrix.astype(float)

    def directions(z: Array) -> Array:
        """Return the directions (k, len(z)) in which z = [q; qd; u] may change, one in each row."""
        return rows.tangent_basis(z) if rows else np.eye(len(z))[moved]  # (k, len(z))

    z, downhill, tried = onto(z), None, list[tuple[Array, Array]]()
    for _ in range(_TRIES):
        z, now, sizes = _newton(z, n, residual, onto, directions, eps)
        sizes[:n] = np.max(sizes[:n], initial=0) + (np.max(np.abs(forces(z))) if rows else 0.0)
        if rows:
            sizes[n:] += rows.sizes(z)
        much = now * ~(np.abs(now) <= np.sqrt(eps) * sizes)  # a smaller residual is rounding error
        tried.append((z, much))
        if not much.any():
            break
        downhill = _downhill(
            model, z if downhill is None else downhill, directions, forces, onto, D
        )
        if downhill is None:
            break
        z = downhill
    if much.any():
        z, much = tried[0]
    _refuse(model, z, much, (q, qd), inputs(z), t, params)
    at, moving = (x.astype(model.info.dtype) for x in (z[:n], z[n : 2 * n]))
    if u is not None:
        return Equilibrium(at, moving, z[2 * n :].astype(model.info.dtype))
    signals = np.asarray(model.functions.signal(at, moving, t, params)) if model.info.nu else None
    return Equilibrium(at, moving, signals)


def _newton(
    z: Array, n: int, residual: _Function, onto: _Function, directions_of: _Function, eps: float
) -> tuple[Array, Array, Array]:
    """Minimise `residual` from z by Newton's method; return (z, residual, sizes of its terms).

    directions_of: directions (k, len(z)) in which z may change; onto: projection on constraints.
    """
    now = residual(z)
    sizes = np.full(len(now), np.inf)
    for _ in range(_MOST):
        ways = directions_of(z)
        reach = np.maximum(1.0, np.abs(ways) @ np.abs(z))
        near = np.cbrt(eps) * reach[:, None] * ways
        columns = [residual(onto(z + e)) - residual(onto(z - e)) for e in near]
        slope = np.reshape(columns, (-1, len(now))).T / (2 * np.cbrt(eps) * reach)
        sizes = np.abs(slope) @ reach
        if not np.isfinite(sizes.sum() + now @ now) or not len(ways):
            break
        along = -np.linalg.lstsq(slope, now, rcond=1e-11)[0]
        step = along @ ways
        fall = 1e-3 * (now @ slope @ along)  # sufficient decrease for a full step
        # a coordinate changes by 1, or its own size, at most, since angles are periodic
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > _SHORTEST:
            there = _tried(onto, z + part * step)
            new = None if there is None else residual(there)
            if new is not None and new @ new < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        assert there is not None and new is not None
        z, now = there, new
    return z, now, sizes


def _downhill(
    model: CompiledModel,
    z: Array,
    directions_of: _Function,
    forces: _Function,
    onto: _Function,
    inertia: _Function,
) -> Array | None:
    """Return a step from z along the accelerations from rest; None if they vanish.

    It leaves local minima of the residual, as halfway between two equilibria.
    """
    n, ways = model.info.nq, directions_of(z)
    ways = ways[:, :n][np.any(ways[:, :n], axis=1)]
    if not len(ways):
        return None
    D, pushes = ways @ inertia(z) @ ways.T, ways @ forces(z)[:n]
    if not (np.isfinite(D).all() and np.isfinite(pushes).all()):
        return None
    step = np.linalg.lstsq(D, pushes, rcond=1e-11)[0] @ ways
    size = np.max(np.abs(step) / np.maximum(1.0, np.abs(z[:n])), initial=0.0)
    if not 0 < size < np.inf:
        return None
    return _tried(onto, z + np.concatenate([_STRIDE / size * step, np.zeros(len(z) - n)]))


def _refuse(
    model: CompiledModel, z: Array, much: Array, guess: tuple[Array, Array], u: Array | None,
    t: float, params: Any,
) -> None:  # fmt: skip
    """Raise MotionError if the search ended with a residual above rounding error."""
    q, qd = z[: model.info.nq], z[model.info.nq : 2 * model.info.nq]
    why = _too_much(model, much) if much.any() else _slips(model, q, qd, u, t, params)
    if not why:
        return
    end = f"q = {np.array2string(q, precision=6, threshold=12)}"
    if np.any(qd != guess[1]):
        end = state_text(q, qd)
    raise MotionError(
        f"no equilibrium found from {state_text(*guess)}: the search ends at {end}, where "
        f"{why}{_beyond(model, q, qd, u, t, params)}; start elsewhere, or let "
        f"another coordinate, rate (free=[..., '{model.info.states[model.info.nq]}']) or input "
        "be free",
        "no convergence",
    )


def _too_much(model: CompiledModel, left: Array) -> str:
    """Describe the largest residual: of a velocity constraint, or of a force."""
    n = model.info.nq
    rates, changes = np.split(left[n:], 2)
    for values, words in ((rates, "break {} by {:.3g}"), (changes, "break {}, by {:.3g} a second")):
        if values.any():
            worst = int(np.argmax(np.abs(values)))
            return f"the rates {words.format(model.info.constraints.names[worst], values[worst])}"
    worst = int(np.argmax(np.abs(left[:n])))
    return f"a force of {left[worst]:.3g} is left on {model.info.coordinates[worst]}"


def _slips(
    model: CompiledModel, q: Array, qd: Array, u: Array | None, t: float, params: Any
) -> str:
    """Describe a joint whose static friction is exceeded; "" if there is none."""
    if not model.info.constraints.modes:
        return ""
    holds = dict(
        zip(
            model.info.constraints.names,
            model.constraints.multipliers(q, qd, t, u, params),
            strict=True,
        )
    )
    for at, of in model.info.constraints.modes:
        name, sliding = model.info.coordinates[of], q.copy()
        sliding[at] = 1.0
        friction, rest = (model.functions.tau(x, qd, t, u, params)[of] for x in (sliding, q))
        most, force = abs(friction - rest), abs(holds[f"{name}_sticks"])
        if not q[at] and force > most * (1 + 1e-6):
            return f"{name} slips, as {force:.3g} is more than its friction holds, {most:.3g}"
    return ""


def _beyond(
    model: CompiledModel, q: Array, qd: Array, u: Array | None, t: float, params: Any
) -> str:
    """Describe the inputs that exceed their limits; "" if there are none."""
    if not model.functions.has_limits:
        return ""
    requested = model.functions.signal(q, qd, t, params) if u is None else u
    cut = requested != model.functions.applied(q, qd, t, u, params)
    names = [name for name, far in zip(model.info.inputs, cut, strict=True) if far]
    return f", with {', '.join(names)} beyond {'their' if names[1:] else 'its'} limits" * bool(
        names
    )


def _tried(onto: _Function, z: Array) -> Array | None:
    """Return `onto(z)`; None if the projection fails."""
    try:
        return onto(z)
    except MotionError:
        return None


@dataclass(frozen=True)
class _Rows:
    """Constraint equations of a model as functions of z = [q; qd; u], (len(z),).

    moved: mask (len(z),) of the free variables. t: time, s.
    """

    model: CompiledModel
    moved: Array
    t: float
    params: Any

    def onto(self, z: Array) -> Array:
        """Return z = [q; qd; u] with its free coordinates projected onto the constraints.

        Raises MotionError if the projection fails.
        """
        n = self.model.info.nq
        fixed = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model.constraints.project_fixed(z[:n], np.zeros(n), self.t, self.params, fixed)
        return np.concatenate([q, z[n:]])

    def tangent_basis(self, z: Array) -> Array:
        """Return an orthonormal basis (k, len(z)) of directions in which z = [q; qd; u] may change.

        Free coordinates change tangentially to the position constraints. Each free velocity or
        input adds one direction.
        """
        n, moved = self.model.info.nq, np.flatnonzero(self.moved[: self.model.info.nq])
        _, s, V = np.linalg.svd(self._slopes(z)[: self.model.info.constraints.holonomic, moved])
        rank = int(np.sum(s > _RANK_TOLERANCE * np.max(s, initial=0)))
        ways = np.zeros((len(moved) - rank, len(z)))
        ways[:, moved] = V[rank:]
        return np.concatenate([ways, np.eye(len(z))[n:][self.moved[n:]]])

    def residual(self, z: Array, forces: Array) -> Array:
        """Return the three parts of the residual of a scene with constraints, joined to one vector.

        z: [q; qd; u]. forces: tau - C qd - g at z, (nq,). The parts are:
        the part of `forces` that no A^T lambda can balance, (nq,);
        the residuals of the velocity constraints, (nc,);
        the time derivatives of these residuals, for constant velocities, (nc,), as a central
        difference.
        """
        A, (q, qd) = self._slopes(z), self._halves(z)
        forces = forces - A.T @ np.linalg.lstsq(A.T, forces, rcond=_RANK_TOLERANCE)[0]
        short = np.cbrt(np.finfo(self.model.info.dtype).eps) / self._pace(z)
        before, now, then = (
            self.model.constraints.constraint_rates(q + e * qd, qd, self.t + e, self.params).astype(
                float
            )
            for e in (-short, 0.0, short)
        )
        return np.concatenate([forces, now, (then - before) / (2 * short)])

    def sizes(self, z: Array) -> Array:
        """Return the magnitudes (2 nc,) of the terms in the last 2 nc entries of `residual`.

        These entries are the residuals of the velocity constraints and their time derivatives. The
        magnitudes are the scales of these entries. z: [q; qd; u].
        """
        sizes = np.abs(self._slopes(z)) @ np.abs(self._halves(z)[1])
        return np.concatenate([sizes, sizes * self._pace(z)])

    def _halves(self, z: Array) -> tuple[Array, Array]:
        n = self.model.info.nq
        return z[:n], z[n : 2 * n]

    def _pace(self, z: Array) -> float:
        """Return the relative rate of change of the state, 1/s."""
        q, qd = self._halves(z)
        return float(np.max(np.abs(qd) / np.maximum(1.0, np.abs(q)), initial=1.0))

    def _slopes(self, z: Array) -> Array:
        q, t = z[: self.model.info.nq], self.t
        A: Array = self.model.constraints.constraint_jacobian(q, t=t, params=self.params).astype(
            float
        )
        return A


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
        which = actuated_coordinates(self.model, drives)
        force = self.model.frames.inverse_dynamics(q, qd, qdd, f_ext, t=t, params=params)
        force = force - self.model.functions.tau(
            q, qd, t, np.zeros(self.info.nu) if self.info.nu else None, params
        )
        at, moving = self.arguments.state(q, qd)
        each = self.arguments.for_each_state(qdd, "qdd", (self.info.nq,), at)
        tau = np.empty_like(at)
        multipliers = np.empty((*at.shape[:-1], len(self.info.constraints.names)), at.dtype)
        motion = Motion.from_states(self.model, at, moving, each, force, t, params)
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
        if isinstance(free, str):
            free = (free,)
        if not (free is None or isinstance(free, Iterable)):
            raise ValueError(
                f"free: {free!r} is no list of names: "
                f"{', '.join((*self.info.states, *self.info.inputs))}"
            )
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
        at, moving = self.arguments.one_state(
            *initial_state_for_parameters(self.model, q, moving, self.arguments.parameters(params))
        )
        moves = [
            name for name in self.info.coordinates if name not in self.info.discrete_coordinates
        ]
        names = moves if free is None else tuple(free)
        inputs = self.arguments.inputs(u)
        return equilibrium(self.model, at, moving, inputs, names, as_number(t, "t"), params)
