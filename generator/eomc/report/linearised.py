"""The linearised motion along a reference solution: eigenvalues and growth of perturbations.

The eigenvalues are those of ∂[q̇; q̈]/∂x, x = [q; q̇], by central differences of the module's
accelerations.
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
from eomc.verify.reference import Vector

Complex = NDArray[np.complex128]

SEGMENT_COUNT = 64  # of the motion, each with one transition matrix
DIFFERENCE_STEP = 1e-6  # relative to the scale of each coordinate and velocity
CHAOS_GROWTH = (
    30.0  # over the second half of the motion; perturbations of regular motions grow 2 to 4 times
)
EPSILON = 2.0**-53


@dataclass(frozen=True)
class Growth:
    """Growth of a small perturbation of the initial state along a motion.

    Attributes
    ----------
    t
        Times (n,) in s.
    amplification
        Factors (n,) by which the perturbation has grown up to the times `t`.
    rate
        Mean exponential growth rate of the perturbation in 1/s, over the second half of the motion.
        If the distance of the motion from its start grows too, the perturbation is first divided
        by the factor of that growth.
    wild
        True if this growth is exponential, as in chaotic motion.
    horizon
        Time in s at which rounding errors have grown to a tenth of the size of the motion; inf if
        they do not grow that far.
    """

    t: Vector
    amplification: Vector
    rate: float
    wild: bool
    horizon: float


def simulate(module: ModuleType, **options: Any) -> Any:
    """Return the run of `module.simulate(**options)`, with all its warnings suppressed."""
    # failures and advice are what is measured here
    quiet = warnings.catch_warnings(action="ignore", category=RuntimeWarning)
    with quiet, np.errstate(all="ignore"):
        return module.simulate(**options)


def at_rows(function: Any, reference: Reference, *, velocities: bool = True) -> Vector:
    """Evaluate a function of a generated module at each state and time of a reference solution.

    function: called as function(q, qd, t=t), or as function(q, t=t) if `velocities` is False.
    Returns the array of the values, one for each time of the reference.
    """
    n = reference.q.shape[1]
    x = reference.halves[0]
    states = (
        ((row[:n], row[n:]) if velocities else (row[:n],), t)
        for row, t in zip(x, reference.t, strict=True)
    )
    return np.array([function(*state, t=float(t)) for state, t in states])


def stable_step(values: Complex, limits: tuple[float, float]) -> float:
    """Return the largest step size h in s that is stable for all eigenvalues λ (1/s) in `values`.

    A step is stable if (h Im λ/limits[0])² + (h Re λ/limits[1])² <= 1. limits: largest stable h ω
    of the method for undamped solutions, and largest stable h |λ| for decaying ones; this ellipse
    through both approximates the stability region of most methods. The real part of an eigenvalue
    is ignored if it is positive. Returns inf if every step size is stable.
    """
    turn = np.abs(values.imag) / limits[0]
    decay = np.maximum(-values.real, 0.0) / limits[1]
    fastest = float(np.max(np.hypot(turn, decay), initial=0.0))
    return 1 / fastest if fastest > 0 else math.inf


def spectrum(
    module: ModuleType, reference: Reference
) -> tuple[Complex, float, tuple[float, Vector]]:
    """Compute eigenvalues of the linearised motion and condition numbers of the mass matrix D.

    Returns three values: the eigenvalues (1/s) of ∂[q̇; q̈]/∂[q; q̇] at all states of the reference
    solution, in one array; the largest condition number of D, scaled to a diagonal of ones; and the
    time and coordinates (t, q) at which it occurs.
    """
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
        displacement = np.diag(scale * DIFFERENCE_STEP)
        states = np.vstack([x + displacement, x - displacement])
        try:
            a = module.acceleration(states[:, :n], states[:, n:], t=float(t))
        except ArithmeticError:  # MotionError: no linearisation where there is no motion
            continue
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:] = np.eye(n)
        A[n:] = ((a[: 2 * n] - a[2 * n :]) / (2 * DIFFERENCE_STEP * scale[:, None])).T
        if np.all(np.isfinite(A)):
            values.append(np.asarray(np.linalg.eigvals(A), complex))
    return np.concatenate(values) if values else np.zeros(0, complex), worst, place


def _project(module: ModuleType, x: Vector, t: float) -> Vector:
    """Project the state x = [q; q̇] onto the constraints, if the module has any."""
    if not module._model.constraint_names:
        return x
    n = len(x) // 2
    return np.hstack(module.project(x[:n], x[n:], t=t))


def growth(module: ModuleType, reference: Reference, method: str, steps: int) -> Growth:
    """Return the growth of a perturbation of the initial state along a reference solution.

    The motion is divided into segments, and the transition matrix of each segment is computed by
    differences of runs of the generated `module` from perturbed states. The growth up to a time is
    the norm of the product of these matrices; `runtime.growth` defines the norm. method: stepper of
    the runs. steps: number of steps over the whole motion.
    """
    n, scale = reference.q.shape[1], reference.scale
    stride = (len(reference.t) - 1) // SEGMENT_COUNT
    steps = max(1, min(steps, 2**16) // SEGMENT_COUNT)
    products = [np.eye(2 * n)]
    duration = float(reference.t[-1])
    for k in range(SEGMENT_COUNT):
        x, t0 = reference.halves[0][k * stride], float(reference.t[k * stride])
        ends = []
        for displacement in (np.zeros(2 * n), *np.diag(scale * DIFFERENCE_STEP)):
            y = _project(module, x + displacement, t0)
            run = simulate(
                module, method=method, q0=y[:n], qd0=y[n:], h=duration / SEGMENT_COUNT / steps,
                steps=steps, every=steps, t0=t0,
            )  # fmt: skip
            ends.append(np.hstack([run.q[-1], run.qd[-1]]) / scale)
        with np.errstate(all="ignore"):
            products.append(((np.array(ends[1:]) - ends[0]).T / DIFFERENCE_STEP) @ products[-1])
    x, t = reference.halves[0][::stride], reference.t[::stride]
    D = mean_mass_matrix(module, x[:, :n], t)
    moved = np.moveaxis(np.array(products), 2, 0) * scale  # by one scale of each at the start
    root = norm_root(D, [*moved], duration)
    start = np.diag(scale)
    factors = [multiplied(root, start, (scale * P.T).T) for P in products]
    amplification = np.maximum.accumulate(np.maximum(factors, 1.0))
    sizes = np.linalg.norm((x - x[0]) @ root.T, axis=1)  # of the motion itself
    return _judged(
        t, amplification, np.maximum.accumulate(sizes), np.linalg.norm(x @ root.T, axis=1)
    )


def _judged(t: Vector, amplification: Vector, sizes: Vector, values: Vector) -> Growth:
    """Return the growth, which counts as exponential relative to that of the motion only.

    sizes: largest distance of the motion from its start so far; values: size of the state; both in
    the norm.
    """
    half, duration = len(t) // 2, float(t[-1])
    own = (
        amplification[-1] / max(sizes[-1] / sizes[half], 1.0)
        if sizes[half] > 0
        else amplification[-1]
    )
    rise = math.log(own / amplification[half]) if math.isfinite(own) else math.inf
    rate, wild = rise / (duration / 2), rise > math.log(CHAOS_GROWTH)
    # of a rounding at any time on the way
    propagated = EPSILON * amplification * np.maximum.accumulate(values / amplification)
    most = 0.1 * (sizes[-1] or values.max() or 1.0)
    unreliable = np.flatnonzero(~(propagated <= most))
    horizon = math.inf
    if len(unreliable):
        horizon = float(t[unreliable[0]])
    elif wild and rate > 0:
        horizon = float(duration + math.log(most / propagated[-1]) / rate)
    return Growth(t=t, amplification=amplification, rate=rate, wild=wild, horizon=horizon)
