"""Where a motion rests, or goes on steadily: Newton's method on the forces.

Constraints bear forces: what their multipliers can't is what has to vanish, and rates of rows too.
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

_MOST = 100  # steps of Newton's method
_RANK_TOLERANCE = 1e-9  # of the largest singular value of A: a row that is none here
_SHORTEST = 2.0**-20  # part of a step that is tried
_TRIES, _STRIDE = 24, 0.2  # of Newton's method; rad, or of a coordinate: a step between them

_Of = Callable[[Array], Array]


class Equilibrium(NamedTuple):
    """A state and inputs at which the accelerations are zero.

    Attributes
    ----------
    q, qd : (nq,) arrays
        Positions and velocities.
    u : (nu,) array, or None
        Inputs; None where the scene has none.
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
    """(q, qd, u) where tau + A^T lambda = C qd + g, from a guess, what is not `free` as it was.

    Forces, not accelerations: D couples these, and may be singular. Their slopes are differences,
    which cost a step some digits and the result none. Where more is free than they determine, each
    step is the shortest. u None: the signals, also where they depend on the state. Under
    constraints what multipliers can't bear counts, and so do rates that rows don't allow, or don't
    as the motion goes on; steps are along rows of positions.
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

    def held(z: Array) -> Array | None:
        return None if u is None else z[2 * n :]

    def whole(z: Array) -> Array:
        at, moving = z[:n], z[n : 2 * n]
        tau = model.tau(at, moving, t, held(z), params)
        found: Array = tau.astype(float) - model.bias(at, moving, t=t, params=params)
        return found

    def rest(z: Array) -> Array:
        return rows.left(z, whole(z)) if rows else whole(z)

    eps = float(np.finfo(model.dtype).eps)
    onto = rows.onto if rows else lambda z: z

    def D(z: Array) -> Array:
        found: Array = model.D(z[:n], t=t, params=params)
        return found.astype(float)

    def ways(z: Array) -> Array:
        return rows.along(z) if rows else np.eye(len(z))[moved]  # (k, len(z))

    z, downhill, tried = onto(z), None, list[tuple[Array, Array]]()
    for _ in range(_TRIES):
        z, now, sizes = _newton(z, n, rest, onto, ways, eps)
        sizes[:n] = np.max(sizes[:n], initial=0) + (np.max(np.abs(whole(z))) if rows else 0.0)
        if rows:
            sizes[n:] += rows.sizes(z)
        much = now * ~(np.abs(now) <= np.sqrt(eps) * sizes)  # rounding leaves less
        tried.append((z, much))
        if not much.any():
            break
        downhill = _downhill(model, z if downhill is None else downhill, ways, whole, onto, D)
        if downhill is None:
            break
        z = downhill
    if much.any():
        z, much = tried[0]
    _refuse(model, z, much, (q, qd), held(z), t, params)
    at, moving = (x.astype(model.dtype) for x in (z[:n], z[n : 2 * n]))
    if u is not None:
        return Equilibrium(at, moving, z[2 * n :].astype(model.dtype))
    signals = np.asarray(model.signal(at, moving, t, params)) if model.nu else None
    return Equilibrium(at, moving, signals)


def _newton(
    z: Array, n: int, rest: _Of, onto: _Of, ways_of: _Of, eps: float
) -> tuple[Array, Array, Array]:
    """Where Newton's method on `rest` ends from z, what is left there, and the sizes of its terms.

    ways_of: the directions, (k, len(z)), in which z may go; onto: back on rows from there.
    """
    now = rest(z)
    sizes = np.full(len(now), np.inf)
    for _ in range(_MOST):
        ways = ways_of(z)
        reach = np.maximum(1.0, np.abs(ways) @ np.abs(z))
        near = np.cbrt(eps) * reach[:, None] * ways
        columns = [rest(onto(z + e)) - rest(onto(z - e)) for e in near]
        slope = np.reshape(columns, (-1, len(now))).T / (2 * np.cbrt(eps) * reach)
        sizes = np.abs(slope) @ reach
        if not np.isfinite(sizes.sum() + now @ now) or not len(ways):
            break
        along = -np.linalg.lstsq(slope, now, rcond=1e-11)[0]
        step = along @ ways
        fall = 1e-3 * (now @ slope @ along)  # what is asked for of one that is taken whole
        # a coordinate by 1, or its own size, at most: angles come round
        part = 1 / max(1.0, *(np.abs(step[:n]) / np.maximum(1.0, np.abs(z[:n]))))
        while part > _SHORTEST:
            there = _tried(onto, z + part * step)
            left = None if there is None else rest(there)
            if left is not None and left @ left < now @ now + part * fall:
                break
            part /= 2
        else:
            break
        assert there is not None and left is not None
        z, now = there, left
    return z, now, sizes


def _downhill(
    model: Constrained, z: Array, ways_of: _Of, forces: _Of, onto: _Of, inertia: _Of
) -> Array | None:
    """A step from z as the forces push what is at rest; None where they push nothing.

    Newton's method ends where forces are least, as halfway between two positions of rest.
    """
    n, ways = model.nq, ways_of(z)
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
    model: Constrained, z: Array, much: Array, begun: tuple[Array, Array], u: Array | None,
    t: float, params: Any,
) -> None:  # fmt: skip
    """Raise MotionError where a search ends with too much left."""
    q, qd = z[: model.nq], z[model.nq : 2 * model.nq]
    why = _too_much(model, much) if much.any() else _slips(model, q, qd, u, t, params)
    if not why:
        return
    found = f"q = {np.array2string(q, precision=6, threshold=12)}"
    if np.any(qd != begun[1]):
        found = state_text(q, qd)
    raise MotionError(
        f"no equilibrium found from {state_text(*begun)}: the search ends at {found}, where "
        f"{why}{_beyond(model, q, qd, u, t, params)}; start elsewhere, or let "
        f"another coordinate, rate (free=[..., '{model._states[model.nq]}']) or input be free",
        "no convergence",
    )


def _too_much(model: Constrained, left: Array) -> str:
    """What keeps a state from being an equilibrium: rates that rows don't allow, or a force."""
    n = model.nq
    rates, changes = np.split(left[n:], 2)
    for found, words in ((rates, "break {} by {:.3g}"), (changes, "break {}, by {:.3g} a second")):
        if found.any():
            worst = int(np.argmax(np.abs(found)))
            return f"the rates {words.format(model.constraint_names[worst], found[worst])}"
    worst = int(np.argmax(np.abs(left[:n])))
    return f"a force of {left[worst]:.3g} is left on {model.coordinates[worst]}"


def _slips(model: Constrained, q: Array, qd: Array, u: Array | None, t: float, params: Any) -> str:
    """What friction that sticks can't hold, in words; "" where all holds."""
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
    """Which inputs ask for more than their limits let act, in words."""
    if not model.has_limits:
        return ""
    asked = model.signal(q, qd, t, params) if u is None else u
    cut = asked != model.applied(q, qd, t, u, params)
    names = [name for name, far in zip(model.inputs, cut, strict=True) if far]
    return f", with {', '.join(names)} beyond {'their' if names[1:] else 'its'} limits" * bool(
        names
    )


def _tried(onto: _Of, z: Array) -> Array | None:
    """`onto` of a state; None where the rows have none near."""
    try:
        return onto(z)
    except MotionError:
        return None


@dataclass(frozen=True)
class _Rows:
    """Constraints of a model around z = [q; qd; u], (len(z),), of which `moved` may be changed."""

    model: Constrained
    moved: Array
    t: float
    params: Any

    def onto(self, z: Array) -> Array:
        """z with its free coordinates moved onto the rows. Raises MotionError."""
        n = self.model.nq
        held = [not x for x in self.moved[:n]] + [False] * n
        q, _ = self.model._projected(z[:n], np.zeros(n), self.t, self.params, held)
        return np.concatenate([q, z[n:]])

    def along(self, z: Array) -> Array:
        """(k, len(z)): the ways that rows of positions leave to what is free, orthonormal."""
        n, moved = self.model.nq, np.flatnonzero(self.moved[: self.model.nq])
        _, s, V = np.linalg.svd(self._slopes(z)[: self.model._rows.holonomic, moved])
        rank = int(np.sum(s > _RANK_TOLERANCE * np.max(s, initial=0)))
        ways = np.zeros((len(moved) - rank, len(z)))
        ways[:, moved] = V[rank:]
        return np.concatenate([ways, np.eye(len(z))[n:][self.moved[n:]]])

    def left(self, z: Array, forces: Array) -> Array:
        """What no multipliers can bear of the forces (nq,), what the rates of rows lack, (nc,).

        Then how fast that would change if the velocities did not, (nc,), by a difference.
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
        """Of what `left` has of rows, (2 nc,): terms that are linear in the velocities."""
        sizes = np.abs(self._slopes(z)) @ np.abs(self._halves(z)[1])
        return np.concatenate([sizes, sizes * self._pace(z)])

    def _halves(self, z: Array) -> tuple[Array, Array]:
        n = self.model.nq
        return z[:n], z[n : 2 * n]

    def _pace(self, z: Array) -> float:
        """How fast a state changes, 1/s."""
        q, qd = self._halves(z)
        return float(np.max(np.abs(qd) / np.maximum(1.0, np.abs(q)), initial=1.0))

    def _slopes(self, z: Array) -> Array:
        q, t = z[: self.model.nq], self.t
        A: Array = self.model.constraint_jacobian(q, t=t, params=self.params).astype(float)
        return A
