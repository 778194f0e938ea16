"""What every digit of a scene costs: speed against error, and where each stepper breaks.

Every stepper that a scene can use runs at steps h = T/2^k, adaptive steps by tolerances, and is
compared with the scene's reference solution. Errors are those of the worst of x = [q; qd], relative
to its largest value along the motion; energy errors are jacobi's, relative to what K and P change
by. Steppers' stability limits are compared with the eigenvalues of the linearised motion.
"""

from __future__ import annotations

import hashlib
import math
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from eomc import pipeline
from eomc.base.errors import EomcError, SceneError
from eomc.integrators.tableaux import GAUSS16, METHODS
from eomc.model.corners import corners
from eomc.model.system import System
from eomc.report import reference_solution
from eomc.report.linearised import (
    Complex,
    Growth,
    at_rows,
    growth,
    simulate,
    spectrum,
    stable_step,
)
from eomc.report.reference_solution import Reference
from eomc.verify.oracle import Vector

ROWS = 256  # at which runs are compared with the reference
DIGITS = range(3, 16)
ADAPTIVE = "adaptive"  # among methods: steps that a tolerance chooses
TOLERANCES = tuple(10.0**-k for k in range(3, 16))
LONGEST = 0.5  # s of computing of one run: no finer step after it
REPEATS = 5
LOST = 1.0  # an error as large as the motion
ROUNDED = 0.7  # halving h leaves more of the error: rounding or the reference's digits decide
CONDITION = 1e8  # of D with its diagonal scaled to 1: as many digits are lost


@dataclass(frozen=True, eq=False)
class Point:
    """One run: N steps of h, or by a tolerance tol, h on the average; tol is nan of fixed steps.

    Errors are relative; inf where it did not get to the end.

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
    tol: float = math.nan

    @property
    def adaptive(self) -> bool:
        """Whether its steps are chosen by a tolerance."""
        return not math.isnan(self.tol)


@dataclass(frozen=True)
class Line:
    """One stepper: its runs from coarse to fine, and what follows from them.

    Of adaptive steps order is the method's, the rest nan.

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

    methods: all steppers where None, "adaptive" among them. longest: s of computing of a run,
    after which no finer one is made. progress: called with (done, total). Raises EomcError as
    `reference_solution.of` does.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    wanted = (*METHODS, ADAPTIVE) if methods is None else tuple(methods)
    total = len(wanted) + 2  # the reference and the building besides, which take their time
    progress(0, total)
    reference = reference_solution.of(system, rows=ROWS, root=root)
    progress(1, total)
    module, skipped = variant(system, wanted, Path(root) / system.name / "report")
    values, at, place = spectrum(module, reference)
    against = _Against(
        reference, at_rows(module.jacobi, reference), _energy_scale(module, reference)
    )
    lines = []
    for k, name in enumerate(module.methods):
        progress(k + 2, total)
        lines.append(_line(module, against, name, values, system.run.duration, longest))
    if module._model.tolerance:
        lines.append(_adaptive(module, against, system.run.duration, longest))
    progress(total, total)
    points = [p for line in lines for p in line.points]
    finest = min((p for p in points if not p.adaptive), key=lambda p: p.along)
    fastest = max(values, key=abs, default=0j)
    return Report(
        scene=system.name,
        title=system.title or system.name,
        duration=system.run.duration,
        digits=float(reference.digits[-1]),
        lines=tuple(lines),
        growth=growth(module, reference, finest.method, finest.steps),
        eigenvalue=complex(fastest),
        condition=(at, *place),
        corners=corners(system),
        events=", ".join(e.name for e in system.events),
        t=reference.t,
        coordinates=tuple(module.coordinates),
        skipped=skipped,
    )


def variant(system: System, wanted: Sequence[str], root: Path) -> tuple[ModuleType, dict[str, str]]:
    """The scene with all steppers that it can use, and why it can't use the others.

    Without its events, which fixed steps and the reference pass over.
    """

    def made(methods: Sequence[str]) -> System:
        # another digest, since it is another module than the scene's own
        digest = hashlib.sha256(f"{system.digest} report {methods}".encode()).hexdigest()
        fixed = tuple(name for name in methods if name != ADAPTIVE) or ("rk4",)
        tolerance = TOLERANCES[-1] if ADAPTIVE in methods else None
        run = replace(system.run, methods=fixed, batch=False, tolerance=tolerance)
        return replace(system, run=run, digest=digest, events=())

    try:
        return pipeline.load(made(wanted), root), {}
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
    if not set(usable) - {ADAPTIVE}:
        raise EomcError(f"{system.name}: no stepper can be used: {next(iter(skipped.values()))}")
    return pipeline.load(made(usable), root), skipped


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


def _adaptive(module: ModuleType, against: _Against, duration: float, longest: float) -> Line:
    """All runs by tolerances, from loose to tight."""
    points: list[Point] = []
    for tol in TOLERANCES:
        points.append(_point_of_tolerance(module, against, duration, tol))
        if points[-1].seconds > longest:
            break
    order = 2 * len(GAUSS16.c)  # whose sweeps go to the end
    return Line(ADAPTIVE, order, tuple(points), math.nan, math.nan, math.nan, math.nan)


def _point(module: ModuleType, against: _Against, name: str, duration: float, steps: int) -> Point:
    """A run by fixed steps."""
    h, rows = duration / steps, len(against.reference.t) - 1
    every = max(1, steps // rows)
    run = simulate(module, method=name, h=h, steps=steps, every=every)
    again = partial(simulate, module, method=name, h=h, steps=steps, every=steps)
    return replace(_judged(module, against, run, again, max(1, rows // steps)), h=h, steps=steps)


def _point_of_tolerance(
    module: ModuleType, against: _Against, duration: float, tol: float
) -> Point:
    """A run by a tolerance."""
    run = simulate(module, tol=tol, times=against.reference.t)
    again = partial(simulate, module, tol=tol, duration=duration)  # a row a step, which are few
    return replace(_judged(module, against, run, again, 1), method=ADAPTIVE, tol=tol)


def _judged(
    module: ModuleType, against: _Against, run: Any, again: Callable[[], Any], stride: int
) -> Point:
    """A run compared with every so many rows of the reference, and its time.

    That is the median of some runs `again` without rows.
    """
    reference = against.reference
    n, energies = len(module.coordinates), np.full(0, math.inf)
    q = qd = along = energy = math.inf
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
        timed = again()
        spent.append(time.perf_counter() - begun)
        if sum(spent) > 0.5:
            break

    def known(x: float) -> float:
        return x if math.isfinite(x) else math.inf

    return Point(
        method=run.method, h=run.h, steps=run.steps, status=run.status, q=known(q), qd=known(qd),
        end=known(max(q, qd)), along=known(along), energy=known(energy), energies=energies,
        seconds=statistics.median(spent), evaluations=timed.evaluations,
    )  # fmt: skip


def _energy_scale(module: ModuleType, reference: Reference) -> float:
    """What K and P change by along the motion, J; 1 where nothing moves."""
    K = at_rows(module.kinetic_energy, reference)
    P = at_rows(module.potential_energy, reference, velocities=False)
    return float(np.max(np.abs(K)) + np.ptp(P)) or 1.0
