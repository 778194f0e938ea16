"""Measure the cost of accuracy: computing time against error for every stepper of a scene.

Every stepper runs with steps h = T/2^k, and adaptive steps with a series of tolerances; each run is
compared with the scene's reference solution. The error is the largest over x = [q; q̇], relative to
the largest value of each component along the motion. The energy error is that of Jacobi's integral,
relative to the change of K and P. Stability limits are computed from the eigenvalues of the
linearised motion.
"""

from __future__ import annotations

import hashlib
import math
import os
import statistics
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base.errors import EomcError, SceneError
from eomc.integrators.tableaux import GAUSS16, METHODS
from eomc.model.mechanics import nonsmooth_functions
from eomc.model.system import System
from eomc.report import reference_solution
from eomc.report.reference_solution import ReferenceSolution
from eomc.runtime.estimate import growth as growth_factor
from eomc.runtime.estimate import mean_mass_matrix, norm_root
from eomc.runtime.package import model_of
from eomc.verify.reference import Vector

Complex = NDArray[np.complex128]

ROW_COUNT = 256  # rows at which runs are compared with the reference
DIGITS = range(3, 16)
ADAPTIVE = "adaptive"  # name of adaptive steps among the methods
TOLERANCES = tuple(10.0**-k for k in range(3, 16))
MAX_RUN_SECONDS = 0.5  # computing time of one run, after which no finer run is made
TIMING_REPEATS = 5
USELESS_ERROR = 1.0  # an error as large as the motion
ROUNDING_RATIO = 0.7  # halving h reduces the error by less where rounding limits it
LARGE_CONDITION = 1e8  # condition number of D, diagonal scaled to 1, above which a remark is made


@dataclass(frozen=True, eq=False)
class WorkPrecisionPoint:
    """Accuracy and computing time of one run, with fixed steps or with adaptive steps.

    Errors of positions and velocities are relative to the largest value of each component along the
    motion. They are inf if the run ended early.

    Attributes
    ----------
    method
        Name of the stepper (integration method).
    h
        Step size in s; for adaptive steps, the mean step size.
    steps
        Number of steps.
    status
        "ok", or why the run ended early.
    q, qd, end
        Error of the final positions, error of the final velocities, and the larger of these two.
    along
        Largest error of positions and velocities at any stored time.
    energy, energies
        Largest error of the energy, and its errors at the stored times.
    seconds
        Computing time in s.
    evaluations
        Number of evaluations of the accelerations.
    tol
        Tolerance of adaptive steps; nan for fixed steps.
    """

    method: str
    h: float
    steps: int
    status: str
    q: float
    qd: float
    end: float
    along: float
    energy: float
    energies: Vector
    seconds: float
    evaluations: int
    tol: float = math.nan

    @property
    def adaptive(self) -> bool:
        """True if the run has adaptive steps."""
        return not math.isnan(self.tol)


@dataclass(frozen=True)
class WorkPrecisionCurve:
    """Results of one stepper (integration method): its runs from coarse to fine, and their summary.

    For adaptive steps, all numbers but `order` are nan. Step sizes h are in s.

    Attributes
    ----------
    method
        Name of the stepper.
    order
        Nominal order of the method.
    points
        The runs.
    observed
        Order of convergence observed in the runs; nan if too few errors are above rounding.
    usable_h
        Largest h among the runs for which the relative error is below 1, also in all finer runs.
    stable_to
        Largest stable h, computed from the eigenvalues of the linearised motion; inf if every h is
        stable. `usable_h` is smaller, since errors accumulate in stable steps too. For regular
        motions it is 0.4 to 0.8 times `stable_to`. It is a tenth of `stable_to` or less if
        perturbations grow, or if the fast part of the motion is short.
    rounding
        Step size below which smaller steps do not reduce the error; nan if no run is so fine.
    """

    method: str
    order: int
    points: tuple[WorkPrecisionPoint, ...]
    observed: float
    usable_h: float
    stable_to: float
    rounding: float


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


@dataclass(frozen=True)
class WorkPrecisionReport:
    """Cost of accuracy of one scene: the results of all steppers and properties of the motion.

    Attributes
    ----------
    scene, title, coordinates
        Name of the scene, its title, and the names of its coordinates.
    duration
        Simulated time in s.
    digits
        Number of correct digits of the reference solution at the end.
    lines
        Results of each stepper (integration method).
    growth
        Growth of a small perturbation of the initial state.
    eigenvalue
        Eigenvalue of the linearised motion with the largest magnitude at any time, in 1/s.
    condition
        Largest condition number of the mass matrix D, with the time t and the coordinates q at
        which it occurs.
    corners
        Names of the non-smooth functions in the equations, as text.
    events
        Names of the scene's events.
    t
        Stored times of the reference solution in s.
    skipped
        Dict from the name of a stepper that can't be used to the reason.
    """

    scene: str
    title: str
    duration: float
    digits: float
    lines: tuple[WorkPrecisionCurve, ...]
    growth: Growth
    eigenvalue: complex
    condition: tuple[float, float, Vector]
    corners: str
    events: str
    t: Vector
    coordinates: tuple[str, ...]
    skipped: Mapping[str, str]

    @property
    def points(self) -> tuple[WorkPrecisionPoint, ...]:
        """The runs of all steppers, each as a `WorkPrecisionPoint`."""
        return tuple(p for line in self.lines for p in line.points)

    def best(self, digits: float) -> WorkPrecisionPoint | None:
        """Return the fastest run with at least `digits` correct digits at all times, or None."""
        good = (p for p in self.points if p.along <= 10.0**-digits)
        return min(good, key=lambda p: p.seconds, default=None)

    @property
    def finest(self) -> WorkPrecisionPoint:
        """The most accurate run: that with the smallest value of `WorkPrecisionPoint.along`."""
        return min(self.points, key=lambda p: p.along)


def measure(
    scene: System | str | os.PathLike[str],
    root: str | os.PathLike[str] = "build",
    *,
    longest: float = MAX_RUN_SECONDS,
    methods: Sequence[str] | None = None,
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> WorkPrecisionReport:
    """Measure computing time and error of all steppers for one scene.

    Each run starts from the scene's initial state and lasts for the scene's duration.

    Parameters
    ----------
    scene : System or path
        A system, or the path of a scene file.
    root : path, optional
        Build directory.
    longest : float, optional
        Computing time of a run in s, after which no finer run is made.
    methods : sequence of str, optional
        Steppers, "adaptive" among them; all by default.
    progress : callable, optional
        Called as progress(completed, total) with the numbers of completed and of all measurements.

    Returns
    -------
    WorkPrecisionReport

    Raises
    ------
    EomcError
        If the reference solution can't be computed (see `reference_solution.solve`).
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    names = (*METHODS, ADAPTIVE) if methods is None else tuple(methods)
    total = len(names) + 2  # the reference and the building besides, which take their time
    progress(0, total)
    reference = reference_solution.solve(system, rows=ROW_COUNT, root=root)
    progress(1, total)
    module, skipped = build_variant(system, names, Path(root) / system.name / "report")
    values, at, place = compute_spectrum(module, reference)
    baseline = _Baseline(
        reference, evaluate_along(module.jacobi, reference), _energy_scale(module, reference)
    )
    lines = []
    for k, name in enumerate(module.methods):
        progress(k + 2, total)
        lines.append(_line(module, baseline, name, values, system.run.duration, longest))
    if model_of(module).info.tolerance:
        lines.append(_adaptive(module, baseline, system.run.duration, longest))
    progress(total, total)
    points = [p for line in lines for p in line.points]
    finest = min((p for p in points if not p.adaptive), key=lambda p: p.along)
    fastest = max(values, key=abs, default=0j)
    return WorkPrecisionReport(
        scene=system.name,
        title=system.title or system.name,
        duration=system.run.duration,
        digits=float(reference.digits[-1]),
        lines=tuple(lines),
        growth=measure_growth(module, reference, finest.method, finest.steps),
        eigenvalue=complex(fastest),
        condition=(at, *place),
        corners=nonsmooth_functions(system),
        events=", ".join(e.name for e in system.events),
        t=reference.t,
        coordinates=tuple(module.coordinates),
        skipped=skipped,
    )


def build_variant(
    system: System, names: Sequence[str], root: Path
) -> tuple[ModuleType, dict[str, str]]:
    """Build a Python module of a system with several steppers (integration methods).

    names: the steppers. Those that can't integrate the system are left out. root: build directory.
    Returns the loaded module, and a dict from each stepper that was left out to the reason. The
    module has no events, since neither fixed steps nor the reference solution detect them. Raises
    EomcError if no stepper can be used.
    """

    def with_methods(methods: Sequence[str]) -> System:
        # another digest, since it is another module than the scene's own
        digest = hashlib.sha256(f"{system.digest} report {methods}".encode()).hexdigest()
        fixed = tuple(name for name in methods if name != ADAPTIVE) or ("rk4",)
        tolerance = TOLERANCES[-1] if ADAPTIVE in methods else None
        run = replace(system.run, methods=fixed, batch=False, tolerance=tolerance)
        return replace(system, run=run, digest=digest, events=())

    try:
        return pipeline.load(with_methods(names), root), {}
    except EomcError:
        pass
    usable, skipped = [], {}
    for name in names:
        try:
            pipeline.sources(with_methods((name,)))
            usable.append(name)
        except SceneError as fault:
            skipped[name] = "; ".join(p.message for p in fault.problems)
        except EomcError as fault:
            skipped[name] = str(fault)
    if not set(usable) - {ADAPTIVE}:
        raise EomcError(f"{system.name}: no stepper can be used: {next(iter(skipped.values()))}")
    return pipeline.load(with_methods(usable), root), skipped


# --- runs -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Baseline:
    """Reference solution, Jacobi's integral along it, and the scale of energy errors in J."""

    reference: ReferenceSolution
    jacobi: Vector
    energy: float


def fewest_steps(values: Complex, stable_to: float, duration: float) -> int:
    """Return the number of steps of the first run of a stepper: a power of two, at least eight.

    Its steps are about twice as long as stable ones and as those of 12 rad of the fastest mode.
    values: the modes at the start, rad/s. stable_to: the largest stable step, s.
    """
    speed = float(np.max(np.abs(values), initial=0.0)) or 1.0 / duration
    coarse = min(stable_to, 12.0 / speed)
    return int(2 ** max(3, math.floor(math.log2(duration / coarse)) - 1))


def _line(
    module: ModuleType, baseline: _Baseline, name: str, values: Complex, duration: float,
    longest: float,
) -> WorkPrecisionCurve:  # fmt: skip
    """Run one stepper with decreasing h, from unstable steps to the limit of rounding or time."""
    method = METHODS[name]
    stable_to = stable_step(values, method.limits)
    steps = fewest_steps(values, stable_to, duration)
    points: list[WorkPrecisionPoint] = []
    while steps <= 2**26:
        p = _point(module, baseline, name, duration, steps)
        points.append(p)
        steps *= 2
        if p.seconds > longest:
            break
        best = min(x.along for x in points[:-2]) if len(points) > 2 else math.inf
        # twice in a row no better than before: rounding; or an error that no step mends
        if best < 1e-9 and min(x.along for x in points[-2:]) > ROUNDING_RATIO * best:
            break
    errors = [p.along for p in points]
    finest = int(np.argmin(errors))
    floor = errors[finest]
    clear = [
        math.log2(a / b) for a, b in pairwise(errors) if a < 0.01 and b > 300 * floor > 0 and b < a
    ]
    # the first that no finer step makes much better, and how many were tried
    knee = next((k for k, e in enumerate(errors) if ROUNDING_RATIO * e <= floor), finest)
    tried = len(points) - 1 - knee
    saturated = math.isfinite(floor) and (tried > 1 or (tried == 1 and floor < 1e-9))
    usable_h = math.nan
    for p in reversed(points):
        if not p.along < USELESS_ERROR:
            break
        usable_h = p.h
    return WorkPrecisionCurve(
        method=name,
        order=method.order,
        points=tuple(points),
        observed=statistics.median(clear) if clear else math.nan,
        usable_h=usable_h,
        stable_to=stable_to,
        rounding=points[knee].h if saturated else math.nan,
    )


def _adaptive(
    module: ModuleType, baseline: _Baseline, duration: float, longest: float
) -> WorkPrecisionCurve:
    """Run adaptive steps with all tolerances, from loose to tight."""
    points: list[WorkPrecisionPoint] = []
    for tol in TOLERANCES:
        points.append(_point_of_tolerance(module, baseline, duration, tol))
        if points[-1].seconds > longest:
            break
    order = 2 * len(GAUSS16.c)  # whose sweeps go to the end
    return WorkPrecisionCurve(
        ADAPTIVE, order, tuple(points), math.nan, math.nan, math.nan, math.nan
    )


def _point(
    module: ModuleType, baseline: _Baseline, name: str, duration: float, steps: int
) -> WorkPrecisionPoint:
    """Return the result of a run with fixed steps."""
    h, rows = duration / steps, len(baseline.reference.t) - 1
    every = max(1, steps // rows)
    run = simulate(module, method=name, h=h, steps=steps, every=every)
    repeat = partial(simulate, module, method=name, h=h, steps=steps, every=steps)
    return replace(_compare(module, baseline, run, repeat, max(1, rows // steps)), h=h, steps=steps)


def _point_of_tolerance(
    module: ModuleType, baseline: _Baseline, duration: float, tol: float
) -> WorkPrecisionPoint:
    """Return the result of a run with adaptive steps."""
    run = simulate(module, tol=tol, times=baseline.reference.t)
    repeat = partial(simulate, module, tol=tol, duration=duration)  # a row a step, which are few
    return replace(_compare(module, baseline, run, repeat, 1), method=ADAPTIVE, tol=tol)


def _compare(
    module: ModuleType, baseline: _Baseline, run: Any, repeat: Callable[[], Any], stride: int
) -> WorkPrecisionPoint:
    """Compare a run with every `stride`-th row of the reference, and time it.

    The time is the median of several runs by `repeat`, which store no intermediate rows.
    """
    reference = baseline.reference
    n, energies = len(module.coordinates), np.full(0, math.inf)
    q = qd = along = energy = math.inf
    if run.status == "ok":
        with np.errstate(all="ignore"):
            error = (
                np.abs(reference.error_of(run.q, run.qd, slice(None, None, stride)))
                / reference.scale
            )
            q, qd = float(np.max(error[-1, :n])), float(np.max(error[-1, n:]))
            # what the reference does not know counts as error
            unknown = np.max(10.0**-reference.digits)
            along = float(max(np.max(error), unknown))
            energies = np.abs(run.jacobi - baseline.jacobi[::stride]) / baseline.energy
            energy = float(np.max(energies))
    durations = []
    for _ in range(TIMING_REPEATS):
        started_at = time.perf_counter()
        timed = repeat()
        durations.append(time.perf_counter() - started_at)
        if sum(durations) > 0.5:
            break

    def finite(x: float) -> float:
        return x if math.isfinite(x) else math.inf

    return WorkPrecisionPoint(
        method=run.method, h=run.h, steps=run.steps, status=run.status, q=finite(q), qd=finite(qd),
        end=finite(max(q, qd)), along=finite(along), energy=finite(energy), energies=energies,
        seconds=statistics.median(durations), evaluations=timed.evaluations,
    )  # fmt: skip


def simulate(module: ModuleType, **options: Any) -> Any:
    """Return the run of `module.simulate(**options)`; warnings are suppressed."""
    # failures and advice are what is measured here
    quiet = warnings.catch_warnings(action="ignore", category=RuntimeWarning)
    with quiet, np.errstate(all="ignore"):
        return module.simulate(**options)


def _energy_scale(module: ModuleType, reference: ReferenceSolution) -> float:
    """Return the largest K plus the range of P along the motion, in J; 1 if nothing moves."""
    K = evaluate_along(module.kinetic_energy, reference)
    P = evaluate_along(module.potential_energy, reference, velocities=False)
    return float(np.max(np.abs(K)) + np.ptp(P)) or 1.0


# --- the linearised motion ------------------------------------------------------------------------
#
# The eigenvalues are those of ∂[q̇; q̈]/∂x, x = [q; q̇], by central differences of the module's
# accelerations.

SEGMENT_COUNT = 64  # of the motion, each with one transition matrix
DIFFERENCE_STEP = 1e-6  # relative to the scale of each coordinate and velocity
CHAOS_GROWTH = (
    30.0  # over the second half of the motion; perturbations of regular motions grow 2 to 4 times
)
EPSILON = 2.0**-53


def evaluate_along(
    function: Any, reference: ReferenceSolution, *, velocities: bool = True
) -> Vector:
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


def compute_spectrum(
    module: ModuleType, reference: ReferenceSolution
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
    if not model_of(module).info.constraints.names:
        return x
    n = len(x) // 2
    return np.hstack(module.project(x[:n], x[n:], t=t))


def measure_growth(
    module: ModuleType, reference: ReferenceSolution, method: str, steps: int
) -> Growth:
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
    D = mean_mass_matrix(model_of(module), x[:, :n], t)
    moved = np.moveaxis(np.array(products), 2, 0) * scale  # by one scale of each at the start
    root = norm_root(D, [*moved], duration)
    start = np.diag(scale)
    factors = [growth_factor(root, start, (scale * P.T).T) for P in products]
    amplification = np.maximum.accumulate(np.maximum(factors, 1.0))
    sizes = np.linalg.norm((x - x[0]) @ root.T, axis=1)  # of the motion itself
    return _classify_growth(
        t, amplification, np.maximum.accumulate(sizes), np.linalg.norm(x @ root.T, axis=1)
    )


def _classify_growth(t: Vector, amplification: Vector, sizes: Vector, values: Vector) -> Growth:
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
