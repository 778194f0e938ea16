"""Speed against error: what every digit of a scene costs, and where each stepper breaks.

Every stepper that a scene can use runs at steps h = T/2^k against the scene's `truth`. Errors are
those of the worst of x = [q; qd], relative to its largest value along the motion; energy errors
are jacobi's, against that of the truth, relative to what K and P change by. Beside it stands what
the linearised motion advises: eigenvalues of d[qd; qdd]/dx along the truth, against each stepper's
stability limits, and the growth of a small difference.
"""

from __future__ import annotations

import hashlib
import io
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
from markupsafe import Markup
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError, SceneError
from eomc.emit.render import environment
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System
from eomc.report import reference_solution as truths
from eomc.report.reference_solution import Truth
from eomc.verify.oracle import Vector

Complex = NDArray[np.complex128]

ROWS = 256  # at which runs are compared with the truth
SEGMENTS = 64  # over which the growth of differences is put together
DIGITS = range(3, 16)
LONGEST = 0.5  # s of computing of one run: no finer step after it
REPEATS = 5
NUDGE = 1e-6  # of each scale, for differences
LOST = 1.0  # an error as large as the motion
ROUNDED = 0.7  # halving h leaves more of the error: rounding or the truth's digits decide
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


EXPLAINED = """\
Usable h: the largest measured with an error below 1 all along. Stable to: by the eigenvalues of
the linearised motion; steps up to it let no difference grow, though their errors may add up to
more than the motion. Rounding from: the h below which finer steps don't help."""


@dataclass(frozen=True)
class Line:
    """One stepper: its runs from coarse to fine, and what follows from them.

    observed: the order, nan where too few errors are clear of rounding. stable: the largest h
    measured that kept its error below 1 and so did all finer ones; advised: the one that
    eigenvalues allow, inf for any. Up to it a small difference does not grow by the method's
    doing (`check` tests that), but errors add up over the whole motion: stable is 0.4 to 0.8 of
    it for regular motions, a tenth or less where differences grow or the fast part is short.
    rounding: h from which on finer steps don't help, or nan.
    """

    method: str
    order: int
    points: tuple[Point, ...]
    observed: float
    stable: float
    advised: float
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
    """What was measured on one scene. digits: of the truth; skipped: steppers it can't use, why."""

    scene: str
    title: str
    duration: float
    digits: float
    lines: tuple[Line, ...]
    growth: Growth
    eigenvalue: complex
    condition: tuple[float, float, Vector]
    corners: str
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

    def recommendation(self, digits: float) -> str:
        """For 6 digits up to t = 10 s: dp8 with h = 40 ms, 0.1 ms of computing."""
        found, what = self.best(digits), f"for {digits:g} digits up to t = {self.duration:g} s"
        if found is None:
            p = self.finest
            if not p.along < LOST:
                return f"{what}: no stepper follows this motion to its end"
            return (
                f"{what}: out of reach here; the most is {-math.log10(p.along):.1f} digits, by "
                f"{p.method} with h = {_time(p.h)}, {_time(p.seconds)} of computing"
            )
        return (
            f"{what}: {found.method} with h = {_time(found.h)} "
            f"({self.duration:g} s/{found.steps}), {_time(found.seconds)} of computing, "
            f"{found.evaluations} evaluations"
        )

    def recommendations(self) -> list[str]:
        """One for each run that is the best for some digits, and one for what is out of reach."""
        told: dict[Point | None, str] = {}
        for digits in DIGITS:
            found = self.best(digits)
            told.pop(found, None)  # the most digits that it is the best for
            told[found] = self.recommendation(digits)
            if found is None:
                break
        return list(told.values())

    def remarks(self) -> list[str]:
        """What a person should know of this scene, in sentences."""
        g, told = self.growth, []
        told.append(
            f"A small difference at the start grows {g.amplification[-1]:.2g}-fold in "
            f"{self.duration:g} s"
            + (f", at the end by a factor e in {_time(1 / g.rate)} (chaos)." if g.wild else ".")
        )
        if math.isfinite(g.horizon):
            told.append(
                f"Beyond t = {g.horizon:.3g} s no run in doubles means anything: the rounding of "
                "the start alone has grown to a tenth of the motion."
            )
        if self.digits < 25:
            told.append(
                f"The reference solution is known to {self.digits:.0f} digits only; smaller "
                "errors are not told apart."
            )
        condition, at, q = self.condition
        where = ", ".join(f"{c} = {x:.4g}" for c, x in zip(self.coordinates, q, strict=True))
        place = f"at t = {at:.4g} s, {where if len(q) <= 6 else f'{len(q)} coordinates'}"
        if condition > CONDITION:
            told.append(
                f"D is nearly singular {place}: condition number {condition:.2g}, so "
                f"{math.log10(condition):.0f} digits of the accelerations are lost there."
            )
        else:
            told.append(f"D is regular: its condition number is at most {condition:.2g}, {place}.")
        if self.corners:
            told.append(
                f"Forces or energies jump or bend ({self.corners}): past a jump every fixed step "
                "is of order 1, whatever its method."
            )
        for name, why in self.skipped.items():
            told.append(f"{name} is not for this scene: {why}")
        return told

    def table(self) -> str:
        """Steppers, recommendations and remarks as text, for a terminal."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        title = f"{self.scene}: up to t = {self.duration:g} s, against {self.digits:.0f} digits"
        table = Table(box=SIMPLE_HEAD, title=title, title_justify="left")
        for head in ("stepper", "order", "observed", "usable h", "stable to", "smallest error",
                     "at h", "computing", "rounding from"):  # fmt: skip
            table.add_column(head, justify="left" if head == "stepper" else "right")
        for row in self.rows():
            table.add_row(*row)
        text = io.StringIO()
        Console(file=text, width=110).print(table)
        lines = [line.rstrip() for line in text.getvalue().splitlines()]
        told = [EXPLAINED, "", *self.recommendations(), "", *self.remarks()]
        return "\n".join([*lines, *told]).strip("\n")

    def rows(self) -> list[tuple[str, ...]]:
        """One for each stepper: the texts of the table."""
        made: list[tuple[str, ...]] = []
        for line in self.lines:
            p = min(line.points, key=lambda p: p.along)
            made.append(
                (
                    line.method,
                    str(line.order),
                    _figure(line.observed, "{:.1f}"),
                    _time(line.stable),
                    "any" if math.isinf(line.advised) else _time(line.advised),
                    _figure(p.along, "{:.1e}"),
                    _time(p.h),
                    _time(p.seconds),
                    _time(line.rounding),
                )
            )
        return made

    def as_dict(self) -> dict[str, Any]:
        """For JSON; numbers that are not finite are None."""

        def number(x: float | None) -> float | None:
            return x if x is not None and math.isfinite(x) else None

        def point(p: Point) -> dict[str, Any]:
            return {
                "method": p.method, "h": p.h, "steps": p.steps, "status": p.status,
                "error_q": number(p.q), "error_qd": number(p.qd), "error_end": number(p.end),
                "error_along": number(p.along), "error_energy": number(p.energy),
                "seconds": p.seconds, "seconds_per_second": p.seconds / self.duration,
                "evaluations": p.evaluations,
            }  # fmt: skip

        best = {str(d): self.best(d) for d in DIGITS}
        condition, at, q = self.condition
        return {
            "scene": self.scene,
            "duration": self.duration,
            "truth_digits": self.digits,
            "steppers": [
                {
                    "method": line.method, "order": line.order, "observed": number(line.observed),
                    "stable_h": number(line.stable), "advised_h": number(line.advised),
                    "rounding_h": number(line.rounding), "runs": [point(p) for p in line.points],
                }
                for line in self.lines
            ],
            "best": {d: point(p) if p else None for d, p in best.items()},
            "recommendations": self.recommendations(),
            "remarks": self.remarks(),
            "growth": {
                "t": self.growth.t.tolist(),
                "amplification": [number(x) for x in self.growth.amplification.tolist()],
                "rate": number(self.growth.rate), "chaotic": self.growth.wild,
                "horizon": number(self.growth.horizon),
            },
            "fastest_eigenvalue": [self.eigenvalue.real, self.eigenvalue.imag],
            "condition": {"largest": number(condition), "t": at, "q": q.tolist()},
            "corners": self.corners,
            "skipped": dict(self.skipped),
        }  # fmt: skip


def report(
    scene: System | str | os.PathLike[str],
    root: str | os.PathLike[str] = "build",
    *,
    longest: float = LONGEST,
    methods: Sequence[str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """The measurement of one scene, from its start to its duration.

    methods: all steppers where None. longest: s of computing of a run, after which no finer one is
    made. progress: called with (done, total). Raises EomcError as `truth.of` does.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    truth = truths.of(system, rows=ROWS, root=root)
    wanted = tuple(METHODS) if methods is None else tuple(methods)
    module, skipped = variant(system, wanted, Path(root) / system.name / "report")
    values, at, place = _spectrum(module, truth)
    against = _Against(truth, _at_rows(module.jacobi, truth), _energy_scale(module, truth))
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
        digits=float(truth.digits[-1]),
        lines=tuple(lines),
        growth=_growth(module, truth, finest),
        eigenvalue=complex(fastest),
        condition=(at, *place),
        corners=truths.corners(system),
        t=truth.t,
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
    """The truth, Jacobi's integral along it, and what K and P change by."""

    truth: Truth
    jacobi: Vector
    energy: float


def _line(
    module: ModuleType,
    against: _Against,
    name: str,
    values: Complex,
    duration: float,
    longest: float,
) -> Line:
    """All runs of one stepper, from steps too long to steps that rounding or time forbids."""
    method = METHODS[name]
    advised = advice(values, method.limits)
    speed = float(np.max(np.abs(values), initial=0.0)) or 1.0 / duration
    coarse = min(advised, 12.0 / speed)
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
    stable = math.nan
    for p in reversed(points):
        if not p.along < LOST:
            break
        stable = p.h
    return Line(
        method=name,
        order=method.order,
        points=tuple(points),
        observed=statistics.median(clear) if clear else math.nan,
        stable=stable,
        advised=advised,
        rounding=points[knee].h if settled else math.nan,
    )


def _simulate(module: ModuleType, method: str, **how: Any) -> Any:
    with warnings.catch_warnings():  # failures and advice are what is measured here
        warnings.simplefilter("ignore", RuntimeWarning)
        with np.errstate(all="ignore"):
            return module.simulate(method=method, **how)


def _point(module: ModuleType, against: _Against, name: str, duration: float, steps: int) -> Point:
    """A run compared with the truth, and its time: the median of some without rows."""
    truth = against.truth
    h, rows = duration / steps, len(truth.t) - 1
    every = max(1, steps // rows)
    run = _simulate(module, name, h=h, steps=steps, every=every)
    n, energies = len(module.coordinates), np.full(0, math.inf)
    q = qd = along = energy = math.inf
    stride = max(1, rows // steps)
    if run.status == "ok":
        with np.errstate(all="ignore"):
            off = np.abs(truth.off(run.q, run.qd, slice(None, None, stride))) / truth.scale
            q, qd = float(np.max(off[-1, :n])), float(np.max(off[-1, n:]))
            # what the truth does not know counts as error
            unknown = np.max(10.0**-truth.digits)
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


def _at_rows(function: Any, truth: Truth, *, velocities: bool = True) -> Vector:
    """A function of the module at the truth's states, each at its time."""
    n = truth.q.shape[1]
    x = truth.halves[0]
    given = (
        ((row[:n], row[n:]) if velocities else (row[:n],), t)
        for row, t in zip(x, truth.t, strict=True)
    )
    return np.array([function(*state, t=float(t)) for state, t in given])


def _energy_scale(module: ModuleType, truth: Truth) -> float:
    """What K and P change by along the motion, J; 1 where nothing moves."""
    K = _at_rows(module.kinetic_energy, truth)
    P = _at_rows(module.potential_energy, truth, velocities=False)
    return float(np.max(np.abs(K)) + np.ptp(P)) or 1.0


# --- the linearised motion ----------------------------------------------------------------------


def advice(values: Complex, limits: tuple[float, float]) -> float:
    """The largest stable h for eigenvalues l: (h Im l/limit_1)^2 + (h Re l/limit_2)^2 <= 1.

    limits: of h omega, undamped, and h lambda, decaying; the ellipse through both lies close to
    most methods' regions. What grows by itself does not count. inf: any h.
    """
    turn = np.abs(values.imag) / limits[0]
    decay = np.maximum(-values.real, 0.0) / limits[1]
    most = float(np.max(np.hypot(turn, decay), initial=0.0))
    return 1 / most if most > 0 else math.inf


def _spectrum(module: ModuleType, truth: Truth) -> tuple[Complex, float, tuple[float, Vector]]:
    """Eigenvalues of d[qd; qdd]/d[q; qd] along the truth; the largest condition of D, t and q."""
    n, scale = truth.q.shape[1], truth.scale
    worst, place = 0.0, (0.0, truth.halves[0][0, :n])
    values: list[Complex] = []
    for x, t in zip(truth.halves[0], truth.t, strict=True):
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


def _growth(module: ModuleType, truth: Truth, finest: Point) -> Growth:
    """The norm of the product of transition matrices from row to row of the truth."""
    n, scale = truth.q.shape[1], truth.scale
    stride = (len(truth.t) - 1) // SEGMENTS
    steps = max(1, min(finest.steps, 2**16) // SEGMENTS)
    product = np.eye(2 * n)
    largest = [1.0]
    duration = truth.t[-1]
    for k in range(SEGMENTS):
        x, t0 = truth.halves[0][k * stride], float(truth.t[k * stride])
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
    t, grown = truth.t[::stride], np.array(largest)
    half = math.log(grown[-1] / grown[SEGMENTS // 2]) if math.isfinite(grown[-1]) else math.inf
    rate, wild = half / (duration / 2), half > math.log(WILD)
    lost = np.flatnonzero(grown * EPSILON > 0.1)
    horizon = math.inf
    if len(lost):
        horizon = float(t[lost[0]])
    elif wild and rate > 0:
        horizon = float(duration + math.log(0.1 / EPSILON / grown[-1]) / rate)
    return Growth(t=t, amplification=grown, rate=rate, wild=wild, horizon=horizon)


# --- texts and pictures -------------------------------------------------------------------------


def _figure(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "-"


def _time(seconds: float) -> str:
    """Seconds with a unit: 2 s, 4.88 ms, 12.3 us."""
    if not math.isfinite(seconds):
        return "-"
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def page(report: Report) -> str:
    """The report as one HTML page with its pictures in it. Raises EomcError without matplotlib."""
    shown = report.best(6) or report.finest
    runs = [
        (
            p.method, _time(p.h), str(p.steps), p.status, _figure(p.q, "{:.1e}"),
            _figure(p.qd, "{:.1e}"), _figure(p.along, "{:.1e}"), _figure(p.energy, "{:.1e}"),
            str(p.evaluations), _time(p.seconds),
            _time(p.seconds / report.duration),
        )
        for p in report.points
    ]  # fmt: skip
    return (
        environment()
        .get_template("report/report.html.jinja")
        .render(
            report=report,
            title=texts.html(report.title),
            rows=report.rows(),
            explained=EXPLAINED,
            runs=runs,
            work=_svg(lambda axes: _work(axes, report), (8.6, 5.0)),
            energy=_svg(lambda axes: _energy(axes, report, shown), (8.6, 3.6)),
            growth=_svg(lambda axes: _grown(axes, report), (8.6, 3.0)),
            shown=_time(shown.seconds),
            digits=f"{report.digits:.0f}",
            duration=f"{report.duration:g}",
        )
    )


def _svg(draw: Callable[[Any], None], size: tuple[float, float]) -> Markup:
    """A picture as text of SVG, the same for the same report."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise EomcError("the page of a report needs matplotlib: pip install matplotlib") from None
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "eomc", "font.size": 10}):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot()
        axes.grid(color="#DDDDDD", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        draw(axes)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None}, transparent=True)
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])


def _styles(report: Report) -> dict[str, tuple[str, str]]:
    from eomc.report.plot import COLOURS, INK

    colours = (*COLOURS, INK, "#999999")
    marks = "osD^vPX*"
    return {
        line.method: (colours[k % len(colours)], marks[k % len(marks)])
        for k, line in enumerate(report.lines)
    }


def _work(axes: Any, report: Report) -> None:
    """Error against time, the best stepper for each number of digits marked."""
    styles = _styles(report)
    for line in report.lines:
        colour, mark = styles[line.method]
        good = [p for p in line.points if p.along < LOST]
        axes.loglog(
            [p.seconds for p in good], [p.along for p in good], color=colour, marker=mark,
            markersize=4, linewidth=1.2, label=line.method,
        )  # fmt: skip
    marked: dict[tuple[str, int], tuple[Point, list[int]]] = {}
    for digits in DIGITS:
        if found := report.best(digits):
            marked.setdefault((found.method, found.steps), (found, []))[1].append(digits)
    for p, reached in marked.values():
        axes.plot(
            p.seconds, p.along, marker="o", markersize=12, markerfacecolor="none",
            markeredgecolor=styles[p.method][0], markeredgewidth=1.6,
        )  # fmt: skip
        axes.annotate(
            f"{reached[-1]}", (p.seconds, p.along), xytext=(-9, -9), ha="right", va="center",
            textcoords="offset points", fontweight="bold", color=styles[p.method][0],
        )  # fmt: skip
    axes.set_xlabel("computing time of the whole run, s")
    axes.set_ylabel("largest relative error along the run")
    axes.legend(frameon=False)


def _energy(axes: Any, report: Report, shown: Point) -> None:
    """Energy errors over time, each stepper at about the same computing time."""
    styles = _styles(report)
    for line in report.lines:
        good = [p for p in line.points if p.along < LOST]
        if not good:
            continue
        p = min(good, key=lambda p: abs(math.log(p.seconds / shown.seconds)))
        t = report.t[:: max(1, (len(report.t) - 1) // p.steps)]
        axes.semilogy(
            t, np.maximum(p.energies, 1e-17), color=styles[line.method][0], linewidth=1.0,
            label=f"{line.method}, h = {_time(p.h)}",
        )  # fmt: skip
    axes.set_xlabel("t, s")
    axes.set_ylabel("relative energy error")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _grown(axes: Any, report: Report) -> None:
    """By what a difference at the start has grown."""
    g = report.growth
    axes.semilogy(g.t, g.amplification, color="#333333", linewidth=1.4)
    axes.set_xlabel("t, s")
    axes.set_ylabel("growth of a small difference")
    if report.t[-1] > g.horizon:
        axes.axvline(g.horizon, color="#D55E00", linewidth=1.2, linestyle="--")
