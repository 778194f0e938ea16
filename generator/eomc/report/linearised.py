"""The linearised motion along a reference solution: eigenvalues, and how differences grow.

Eigenvalues are those of d[qd; qdd]/dx, x = [q; qd], by central differences of the module.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.report.reference_solution import Reference
from eomc.runtime.growth import growth as multiplied
from eomc.runtime.growth import mean_mass_matrix, norm_root
from eomc.verify.oracle import Vector

Complex = NDArray[np.complex128]

SEGMENTS = 64  # over which the growth of differences is put together
NUDGE = 1e-6  # of each scale, for differences
WILD = 30.0  # growth over the second half of the motion; regular motions grow by 2 to 4
EPSILON = 2.0**-53


@dataclass(frozen=True)
class Growth:
    """The growth of a difference of the start, amplification (n,) at t (n,).

    rate: of its growth over the second half beside that of the motion itself, 1/s; wild: whether
    that is exponential. horizon: when a rounding has become a tenth of the motion, inf where it
    does not.
    """

    t: Vector
    amplification: Vector
    rate: float
    wild: bool
    horizon: float


def simulate(module: ModuleType, **how: Any) -> Any:
    """A run of the module, whatever its end, without a word."""
    # failures and advice are what is measured here
    quiet = warnings.catch_warnings(action="ignore", category=RuntimeWarning)
    with quiet, np.errstate(all="ignore"):
        return module.simulate(**how)


def at_rows(function: Any, reference: Reference, *, velocities: bool = True) -> Vector:
    """A function of the module at the reference's states, each at its time."""
    n = reference.q.shape[1]
    x = reference.halves[0]
    given = (
        ((row[:n], row[n:]) if velocities else (row[:n],), t)
        for row, t in zip(x, reference.t, strict=True)
    )
    return np.array([function(*state, t=float(t)) for state, t in given])


def stable_step(values: Complex, limits: tuple[float, float]) -> float:
    """The largest stable h for eigenvalues l: (h Im l/limit_1)^2 + (h Re l/limit_2)^2 <= 1.

    limits: of h omega, undamped, and h lambda, decaying; the ellipse through both lies close to
    most methods' regions. What grows by itself does not count. inf: any h.
    """
    turn = np.abs(values.imag) / limits[0]
    decay = np.maximum(-values.real, 0.0) / limits[1]
    most = float(np.max(np.hypot(turn, decay), initial=0.0))
    return 1 / most if most > 0 else math.inf


def spectrum(
    module: ModuleType, reference: Reference
) -> tuple[Complex, float, tuple[float, Vector]]:
    """Eigenvalues of d[qd; qdd]/d[q; qd] along the reference; the largest condition of D, t, q."""
    n, scale = reference.q.shape[1], reference.scale
    worst, place = 0.0, (0.0, reference.halves[0][0, :n])
    values: list[Complex] = []
    for x, t in zip(reference.halves[0], reference.t, strict=True):
        D = np.asarray(module.D(x[:n], t=float(t)))
        size = np.sqrt(np.abs(np.diag(D)))
        condition = (
            float(np.linalg.cond(D / np.outer(size, size))) if np.all(size > 0) else math.inf
        )
        if condition > worst:
            worst, place = condition, (float(t), x[:n].copy())
        by = np.diag(scale * NUDGE)
        states = np.vstack([x + by, x - by])
        try:
            a = module.acceleration(states[:, :n], states[:, n:], t=float(t))
        except ArithmeticError:  # MotionError: no linearisation where there is no motion
            continue
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:] = np.eye(n)
        A[n:] = ((a[: 2 * n] - a[2 * n :]) / (2 * NUDGE * scale[:, None])).T
        if np.all(np.isfinite(A)):
            values.append(np.asarray(np.linalg.eigvals(A), complex))
    return np.concatenate(values) if values else np.zeros(0, complex), worst, place


def _on_rows(module: ModuleType, x: Vector, t: float) -> Vector:
    """The state nearest to [q; qd] that obeys the constraints, if there are; nothing is held."""
    if not module._model.constraint_names:
        return x
    n = len(x) // 2
    return np.hstack(module.project(x[:n], x[n:], t=t))


def growth(module: ModuleType, reference: Reference, method: str, steps: int) -> Growth:
    """The norm of the product of transition matrices from row to row of the reference.

    By runs of a method, of so many steps in all; the norm is that of `runtime.growth`.
    """
    n, scale = reference.q.shape[1], reference.scale
    stride = (len(reference.t) - 1) // SEGMENTS
    steps = max(1, min(steps, 2**16) // SEGMENTS)
    products = [np.eye(2 * n)]
    duration = float(reference.t[-1])
    for k in range(SEGMENTS):
        x, t0 = reference.halves[0][k * stride], float(reference.t[k * stride])
        ends = []
        for by in (np.zeros(2 * n), *np.diag(scale * NUDGE)):
            y = _on_rows(module, x + by, t0)
            run = simulate(
                module, method=method, q0=y[:n], qd0=y[n:], h=duration / SEGMENTS / steps,
                steps=steps, every=steps, t0=t0,
            )  # fmt: skip
            ends.append(np.hstack([run.q[-1], run.qd[-1]]) / scale)
        with np.errstate(all="ignore"):
            products.append(((np.array(ends[1:]) - ends[0]).T / NUDGE) @ products[-1])
    x, t = reference.halves[0][::stride], reference.t[::stride]
    D = mean_mass_matrix(module, x[:, :n], t)
    moved = np.moveaxis(np.array(products), 2, 0) * scale  # by one scale of each at the start
    root = norm_root(D, [*moved], duration)
    start = np.diag(scale)
    factors = [multiplied(root, start, (scale * P.T).T) for P in products]
    grown = np.maximum.accumulate(np.maximum(factors, 1.0))
    sizes = np.linalg.norm((x - x[0]) @ root.T, axis=1)  # of the motion itself
    return _judged(t, grown, np.maximum.accumulate(sizes), np.linalg.norm(x @ root.T, axis=1))


def _judged(t: Vector, grown: Vector, sizes: Vector, values: Vector) -> Growth:
    """Growth, and whether it is exponential beside that of the motion, which may run away itself.

    sizes: how far the motion has come until each time, values: how large the state is, in the norm.
    """
    half, duration = len(t) // 2, float(t[-1])
    own = grown[-1] / max(sizes[-1] / sizes[half], 1.0) if sizes[half] > 0 else grown[-1]
    rise = math.log(own / grown[half]) if math.isfinite(own) else math.inf
    rate, wild = rise / (duration / 2), rise > math.log(WILD)
    # of a rounding at any time on the way
    carried = EPSILON * grown * np.maximum.accumulate(values / grown)
    most = 0.1 * (sizes[-1] or values.max() or 1.0)
    lost = np.flatnonzero(~(carried <= most))
    horizon = math.inf
    if len(lost):
        horizon = float(t[lost[0]])
    elif wild and rate > 0:
        horizon = float(duration + math.log(most / carried[-1]) / rate)
    return Growth(t=t, amplification=grown, rate=rate, wild=wild, horizon=horizon)
