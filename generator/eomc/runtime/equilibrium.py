"""Equilibria and steady motions, by Newton's method on the forces.

With constraints, the residual is the part of the forces that multipliers cannot balance, and the
residuals of the velocity constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, not_one_of
from .constrained import Constrained
from .package import reduced
from .status import MotionError, state_text

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
        return reduced("equilibrium.Equilibrium", *self)


def equilibrium(
    model: Constrained, q: Array, qd: Array, u: Array | None, free: Collection[str], t: float,
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
    n, known = model.nq, (*model._states, *model.inputs)
    if strange := [name for name in free if name not in known]:
        raise ValueError(not_one_of("free", strange[0], known))
    moved = np.array([name in free for name in known])
    if u is None and np.any(moved[2 * n :]):
        u = np.asarray(model.signal(q, qd, t, params))
    z = np.concatenate([q, qd, np.empty(0) if u is None else u]).astype(float)
    moved = moved[: len(z)]
    rows = _Rows(model, moved, t, params) if model.constraint_names else None

    def inputs(z: Array) -> Array | None:
        """Return the inputs in z = [q; qd; u]; None for the signals of the scene."""
        return None if u is None else z[2 * n :]

    def forces(z: Array) -> Array:
        """Return tau - C qd - g (nq,) at z."""
        at, moving = z[:n], z[n : 2 * n]
        tau = model.tau(at, moving, t, inputs(z), params)
        values: Array = tau.astype(float) - model.bias(at, moving, t=t, params=params)
        return values

    def residual(z: Array) -> Array:
        """Return the residual at z = [q; qd; u], the vector that Newton's method reduces to zero.

        It is tau - C qd - g (nq,) without constraints, else `_Rows.residual`, (nq + 2 nc,).
        """
        return rows.residual(z, forces(z)) if rows else forces(z)

    eps = float(np.finfo(model.dtype).eps)
    onto = rows.onto if rows else lambda z: z

    def D(z: Array) -> Array:
        """Return the mass matrix (nq, nq) at z."""
        matrix: Array = model.D(z[:n], t=t, params=params)
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
    at, moving = (x.astype(model.dtype) for x in (z[:n], z[n : 2 * n]))
    if u is not None:
        return Equilibrium(at, moving, z[2 * n :].astype(model.dtype))
    signals = np.asarray(model.signal(at, moving, t, params)) if model.nu else None
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
    model: Constrained,
    z: Array,
    directions_of: _Function,
    forces: _Function,
    onto: _Function,
    inertia: _Function,
) -> Array | None:
    """Return a step from z along the accelerations from rest; None if they vanish.

    It leaves local minima of the residual, as halfway between two equilibria.
    """
    n, ways = model.nq, directions_of(z)
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
    model: Constrained, z: Array, much: Array, guess: tuple[Array, Array], u: Array | None,
    t: float, params: Any,
) -> None:  # fmt: skip
    """Raise MotionError if the search ended with a residual above rounding error."""
    q, qd = z[: model.nq], z[model.nq : 2 * model.nq]
    why = _too_much(model, much) if much.any() else _slips(model, q, qd, u, t, params)
    if not why:
        return
    end = f"q = {np.array2string(q, precision=6, threshold=12)}"
    if np.any(qd != guess[1]):
        end = state_text(q, qd)
    raise MotionError(
        f"no equilibrium found from {state_text(*guess)}: the search ends at {end}, where "
        f"{why}{_beyond(model, q, qd, u, t, params)}; start elsewhere, or let "
        f"another coordinate, rate (free=[..., '{model._states[model.nq]}']) or input be free",
        "no convergence",
    )


def _too_much(model: Constrained, left: Array) -> str:
    """Describe the largest residual: of a velocity constraint, or of a force."""
    n = model.nq
    rates, changes = np.split(left[n:], 2)
    for values, words in ((rates, "break {} by {:.3g}"), (changes, "break {}, by {:.3g} a second")):
        if values.any():
            worst = int(np.argmax(np.abs(values)))
            return f"the rates {words.format(model.constraint_names[worst], values[worst])}"
    worst = int(np.argmax(np.abs(left[:n])))
    return f"a force of {left[worst]:.3g} is left on {model.coordinates[worst]}"


def _slips(model: Constrained, q: Array, qd: Array, u: Array | None, t: float, params: Any) -> str:
    """Describe a joint whose static friction is exceeded; "" if there is none."""
    if not model._rows.modes:
        return ""
    holds = dict(zip(model.constraint_names, model.multipliers(q, qd, t, u, params), strict=True))
    for at, of in model._rows.modes:
        name, sliding = model.coordinates[of], q.copy()
        sliding[at] = 1.0
        friction, rest = (model.tau(x, qd, t, u, params)[of] for x in (sliding, q))
        most, force = abs(friction - rest), abs(holds[f"{name}_sticks"])
        if not q[at] and force > most * (1 + 1e-6):
            return f"{name} slips, as {force:.3g} is more than its friction holds, {most:.3g}"
    return ""


def _beyond(model: Constrained, q: Array, qd: Array, u: Array | None, t: float, params: Any) -> str:
    """Describe the inputs that exceed their limits; "" if there are none."""
    if not model.has_limits:
        return ""
    requested = model.signal(q, qd, t, params) if u is None else u
    cut = requested != model.applied(q, qd, t, u, params)
    names = [name for name, far in zip(model.inputs, cut, strict=True) if far]
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

    model: Constrained
    moved: Array
    t: float
    params: Any

    def onto(self, z: Array) -> Array:
        """Return z = [q; qd; u] with its free coordinates projected onto the constraints.

        Raises MotionError if the projection fails.
        """
        n = self.model.nq
        fixed = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model._projected(z[:n], np.zeros(n), self.t, self.params, fixed)
        return np.concatenate([q, z[n:]])

    def tangent_basis(self, z: Array) -> Array:
        """Return an orthonormal basis (k, len(z)) of directions in which z = [q; qd; u] may change.

        Free coordinates change tangentially to the position constraints. Each free velocity or
        input adds one direction.
        """
        n, moved = self.model.nq, np.flatnonzero(self.moved[: self.model.nq])
        _, s, V = np.linalg.svd(self._slopes(z)[: self.model._rows.holonomic, moved])
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
        short = np.cbrt(np.finfo(self.model.dtype).eps) / self._pace(z)
        before, now, then = (
            self.model.constraint_rates(q + e * qd, qd, self.t + e, self.params).astype(float)
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
        n = self.model.nq
        return z[:n], z[n : 2 * n]

    def _pace(self, z: Array) -> float:
        """Return the relative rate of change of the state, 1/s."""
        q, qd = self._halves(z)
        return float(np.max(np.abs(qd) / np.maximum(1.0, np.abs(q)), initial=1.0))

    def _slopes(self, z: Array) -> Array:
        q, t = z[: self.model.nq], self.t
        A: Array = self.model.constraint_jacobian(q, t=t, params=self.params).astype(float)
        return A
