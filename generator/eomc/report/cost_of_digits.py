"""What every digit of a scene costs: speed against error, and where each stepper breaks.

Every stepper that a scene can use runs at steps h = T/2^k and is compared with the scene's
reference solution. Errors are those of the worst of x = [q; qd], relative to its largest value
along the motion; energy errors are jacobi's, relative to what K and P change by. Also measured is
the linearised motion: eigenvalues of d[qd; qdd]/dx along the reference solution, compared with each
stepper's stability limits, and the growth of a small difference.
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
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base.errors import EomcError, SceneError
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System
from eomc.report import reference_solution
from eomc.report.reference_solution import Reference
from eomc.verify.oracle import Vector

Complex = NDArray[np.complex128]

ROWS = 256  # at which runs are compared with the reference
SEGMENTS = 64  # over which the growth of differences is put together
DIGITS = range(3, 16)
LONGEST = 0.5  # s of computing of one run: no finer step after it
REPEATS = 5
NUDGE = 1e-6  # of each scale, for differences
LOST = 1.0  # an error as large as the motion
ROUNDED = 0.7  # halving h leaves more of the error: rounding or the reference's digits decide
CONDITION = 1e8  # of D with its diagonal scaled to 1: as many digits are lost
WILD = 30.0  # growth over the second half of the motion; regular motions grow by 2 to 4
EPSILON = 2.0**-53


@dataclass(frozen=True, eq=False)
class Point:
    """One run: N steps of h. Errors are relative; inf where it did not get to the end.

    q, qd, end: of the last state, positions and velocities apart and together; along: the largest
    at any row; energy: likewise, energies: over time. evaluations: of accelerations.
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


@dataclass(frozen=True)
class Line:
    """One stepper: its runs from coarse to fine, and what follows from them.

    observed: the order, nan where too few errors are clear of rounding. usable_h: the largest h
    measured that kept its error below 1 and so did all finer ones; stable_to: the one that
    eigenvalues allow, inf for any. Up to it a small difference does not grow by the method's
    doing (`check` tests that), but errors add up over the whole motion: usable_h is 0.4 to 0.8 of
    it for regular motions, a tenth or less where differences grow or the fast part is short.
    rounding: h from which on finer steps don't help, or nan.
    """

    method: str
    order: int
    points: tuple[Point, ...]
    observed: float
    usable_h: float
    stable_to: float
    rounding: float


@dataclass(frozen=True)
class Growth:
    """By what a difference at the start has grown, amplification (n,) at t (n,).

    rate: of its growth over the second half, 1/s; wild: whether that is exponential. horizon: when
    a rounding of the start has become a tenth of the motion, inf where it does not.
    """

    t: Vector
    amplification: Vector
    rate: float
    wild: bool
    horizon: float


@dataclass(frozen=True)
class Report:
    """What was measured. digits: of the reference; skipped: steppers the scene can't use, why."""

    scene: str
    title: str
    duration: float
    digits: float
    lines: tuple[Line, ...]
    growth: Growth
    eigenvalue: complex
    condition: tuple[float, float, Vector]
    corners: str
    events: str
    t: Vector
    coordinates: tuple[str, ...]
    skipped: Mapping[str, str]

    @property
    def points(self) -> tuple[Point, ...]:
        """All runs."""
        return tuple(p for line in self.lines for p in line.points)

    def best(self, digits: float) -> Point | None:
        """The quickest run with that many digits all along the motion."""
        good = (p for p in self.points if p.along <= 10.0**-digits)
        return min(good, key=lambda p: p.seconds, default=None)

    @property
    def finest(self) -> Point:
        """The run with the smallest error."""
        return min(self.points, key=lambda p: p.along)


def measure(
    scene: System | str | os.PathLike[str],
    root: str | os.PathLike[str] = "build",
    *,
    longest: float = LONGEST,
    methods: Sequence[str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """The measurement of one scene, from its start to its duration.

    methods: all steppers where None. longest: s of computing of a run, after which no finer one is
    made. progress: called with (done, total). Raises EomcError as `reference_solution.of` does.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    reference = reference_solution.of(system, rows=ROWS, root=root)
    wanted = tuple(METHODS) if methods is None else tuple(methods)
    module, skipped = variant(system, wanted, Path(root) / system.name / "report")
    values, at, place = _spectrum(module, reference)
    against = _Against(
        reference, _at_rows(module.jacobi, reference), _energy_scale(module, reference)
    )
    lines = []
    for k, name in enumerate(module.methods):
        progress(k, len(module.methods))
        lines.append(_line(module, against, name, values, system.run.duration, longest))
    progress(len(module.methods), len(module.methods))
    points = [p for line in lines for p in line.points]
    finest = min(points, key=lambda p: p.along)
    fastest = max(values, key=abs, default=0j)
    return Report(
        scene=system.name,
        title=system.title or system.name,
        duration=system.run.duration,
        digits=float(reference.digits[-1]),
        lines=tuple(lines),
        growth=_growth(module, reference, finest),
        eigenvalue=complex(fastest),
        condition=(at, *place),
        corners=reference_solution.corners(system),
        events=", ".join(e.name for e in system.events),
        t=reference.t,
        coordinates=tuple(module.coordinates),
        skipped=skipped,
    )


def variant(system: System, wanted: Sequence[str], root: Path) -> tuple[ModuleType, dict[str, str]]:
    """The scene with all steppers that it can use, and why it can't use the others."""

    def made(methods: tuple[str, ...]) -> System:
        # another digest, since it is another module than the scene's own
        digest = hashlib.sha256(f"{system.digest} report {methods}".encode()).hexdigest()
        run = replace(system.run, methods=methods, batch=False)
        return replace(system, run=run, digest=digest)

    try:
        return pipeline.load(made(tuple(wanted)), root), {}
    except EomcError:
        pass
    usable, skipped = [], {}
    for name in wanted:
        try:
            pipeline.sources(made((name,)))
            usable.append(name)
        except SceneError as fault:
            skipped[name] = "; ".join(p.message for p in fault.problems)
        except EomcError as fault:
            skipped[name] = str(fault)
    if not usable:
        raise EomcError(f"{system.name}: no stepper can be used: {next(iter(skipped.values()))}")
    return pipeline.load(made(tuple(usable)), root), skipped


# --- runs ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Against:
    """The reference, Jacobi's integral along it, and what K and P change by."""

    reference: Reference
    jacobi: Vector
    energy: float


def _line(
    module: ModuleType, against: _Against, name: str, values: Complex, duration: float,
    longest: float,
) -> Line:  # fmt: skip
    """All runs of one stepper, from steps too long to steps that rounding or time forbids."""
    method = METHODS[name]
    stable_to = stable_step(values, method.limits)
    speed = float(np.max(np.abs(values), initial=0.0)) or 1.0 / duration
    coarse = min(stable_to, 12.0 / speed)
    power = max(3, math.floor(math.log2(duration / coarse)) - 1)
    points: list[Point] = []
    while power <= 26:
        p = _point(module, against, name, duration, 2**power)
        points.append(p)
        power += 1
        if p.seconds > longest:
            break
        best = min(x.along for x in points[:-2]) if len(points) > 2 else math.inf
        # twice in a row no better than before: rounding; or an error that no step mends
        if best < 1e-9 and min(x.along for x in points[-2:]) > ROUNDED * best:
            break
    errors = [p.along for p in points]
    finest = int(np.argmin(errors))
    floor = errors[finest]
    clear = [
        math.log2(a / b) for a, b in pairwise(errors) if a < 0.01 and b > 300 * floor > 0 and b < a
    ]
    # the first that no finer step makes much better, and how many were tried
    knee = next((k for k, e in enumerate(errors) if ROUNDED * e <= floor), finest)
    tried = len(points) - 1 - knee
    settled = math.isfinite(floor) and (tried > 1 or (tried == 1 and floor < 1e-9))
    usable_h = math.nan
    for p in reversed(points):
        if not p.along < LOST:
            break
        usable_h = p.h
    return Line(
        method=name,
        order=method.order,
        points=tuple(points),
        observed=statistics.median(clear) if clear else math.nan,
        usable_h=usable_h,
        stable_to=stable_to,
        rounding=points[knee].h if settled else math.nan,
    )


def _simulate(module: ModuleType, method: str, **how: Any) -> Any:
    with warnings.catch_warnings():  # failures and advice are what is measured here
        warnings.simplefilter("ignore", RuntimeWarning)
        with np.errstate(all="ignore"):
            return module.simulate(method=method, **how)


def _point(module: ModuleType, against: _Against, name: str, duration: float, steps: int) -> Point:
    """A run compared with the reference, and its time: the median of some without rows."""
    reference = against.reference
    h, rows = duration / steps, len(reference.t) - 1
    every = max(1, steps // rows)
    run = _simulate(module, name, h=h, steps=steps, every=every)
    n, energies = len(module.coordinates), np.full(0, math.inf)
    q = qd = along = energy = math.inf
    stride = max(1, rows // steps)
    if run.status == "ok":
        with np.errstate(all="ignore"):
            off = np.abs(reference.off(run.q, run.qd, slice(None, None, stride))) / reference.scale
            q, qd = float(np.max(off[-1, :n])), float(np.max(off[-1, n:]))
            # what the reference does not know counts as error
            unknown = np.max(10.0**-reference.digits)
            along = float(max(np.max(off), unknown))
            energies = np.abs(run.jacobi - against.jacobi[::stride]) / against.energy
            energy = float(np.max(energies))
    spent = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        timed = _simulate(module, name, h=h, steps=steps, every=steps)
        spent.append(time.perf_counter() - begun)
        if sum(spent) > 0.5:
            break

    def known(x: float) -> float:
        return x if math.isfinite(x) else math.inf

    return Point(
        method=name, h=h, steps=steps, status=run.status, q=known(q), qd=known(qd),
        end=known(max(q, qd)), along=known(along), energy=known(energy), energies=energies,
        seconds=statistics.median(spent), evaluations=timed.evaluations,
    )  # fmt: skip


def _at_rows(function: Any, reference: Reference, *, velocities: bool = True) -> Vector:
    """A function of the module at the reference's states, each at its time."""
    n = reference.q.shape[1]
    x = reference.halves[0]
    given = (
        ((row[:n], row[n:]) if velocities else (row[:n],), t)
        for row, t in zip(x, reference.t, strict=True)
    )
    return np.array([function(*state, t=float(t)) for state, t in given])


def _energy_scale(module: ModuleType, reference: Reference) -> float:
    """What K and P change by along the motion, J; 1 where nothing moves."""
    K = _at_rows(module.kinetic_energy, reference)
    P = _at_rows(module.potential_energy, reference, velocities=False)
    return float(np.max(np.abs(K)) + np.ptp(P)) or 1.0


# --- the linearised motion ----------------------------------------------------------------------


def stable_step(values: Complex, limits: tuple[float, float]) -> float:
    """The largest stable h for eigenvalues l: (h Im l/limit_1)^2 + (h Re l/limit_2)^2 <= 1.

    limits: of h omega, undamped, and h lambda, decaying; the ellipse through both lies close to
    most methods' regions. What grows by itself does not count. inf: any h.
    """
    turn = np.abs(values.imag) / limits[0]
    decay = np.maximum(-values.real, 0.0) / limits[1]
    most = float(np.max(np.hypot(turn, decay), initial=0.0))
    return 1 / most if most > 0 else math.inf


def _spectrum(
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


def _growth(module: ModuleType, reference: Reference, finest: Point) -> Growth:
    """The norm of the product of transition matrices from row to row of the reference."""
    n, scale = reference.q.shape[1], reference.scale
    stride = (len(reference.t) - 1) // SEGMENTS
    steps = max(1, min(finest.steps, 2**16) // SEGMENTS)
    product = np.eye(2 * n)
    largest = [1.0]
    duration = reference.t[-1]
    for k in range(SEGMENTS):
        x, t0 = reference.halves[0][k * stride], float(reference.t[k * stride])
        ends = []
        for by in (np.zeros(2 * n), *np.diag(scale * NUDGE)):
            y = x + by
            run = _simulate(
                module, finest.method, q0=y[:n], qd0=y[n:], h=duration / SEGMENTS / steps,
                steps=steps, every=steps, t0=t0,
            )  # fmt: skip
            ends.append(np.hstack([run.q[-1], run.qd[-1]]) / scale)
        with np.errstate(all="ignore"):
            product = ((np.array(ends[1:]) - ends[0]).T / NUDGE) @ product
            now = float(np.max(np.sum(np.abs(product), axis=1)))
        largest.append(max(largest[-1], now if math.isfinite(now) else math.inf))
    t, grown = reference.t[::stride], np.array(largest)
    half = math.log(grown[-1] / grown[SEGMENTS // 2]) if math.isfinite(grown[-1]) else math.inf
    rate, wild = half / (duration / 2), half > math.log(WILD)
    lost = np.flatnonzero(grown * EPSILON > 0.1)
    horizon = math.inf
    if len(lost):
        horizon = float(t[lost[0]])
    elif wild and rate > 0:
        horizon = float(duration + math.log(0.1 / EPSILON / grown[-1]) / rate)
    return Growth(t=t, amplification=grown, rate=rate, wild=wild, horizon=horizon)
