"""Error of a run by fixed steps, from step doubling, and growth of small differences.

The growth is the factor by which a motion multiplies a small difference of its start. The size of a
difference d = [dq; dqd] is |d|^2 = dqd' D dqd + (dq/T)' D (dq/T), where D is the mean mass matrix
along the motion, and T_i is the time in which a difference of q_i changes: the median of
|dq_i|/|dqd_i| along the motion, at most its duration. So it depends neither on the origin of a
coordinate, nor on units, nor on how far anything moves; of a harmonic oscillator, for which
T = 1/omega, it is constant along the motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .interfaces import CompiledModel
from .package import reduced
from .trajectory_data import Trajectory

Array = NDArray[Any]

_MAX_REFINEMENT = 16  # the shortest step of the convergence test is h/16
_MAX_STEPS = 2_000_000  # refinements of h beyond h/4 have at most so many steps
_MIN_ROWS = 200  # runs with fewer rows are repeated to find the scale of each coordinate
UNRESOLVED_ERROR = 0.1  # errors above this fraction of a coordinate's scale count as unresolved
SATURATED_DIFFERENCE = 0.01  # differences above this fraction of the scale no longer grow linearly
_MAX_SMOOTH_GROWTH = 1e6  # larger growth may come from a discontinuity of the forces
_REST_ROUNDINGS = 64.0  # velocities that move a position by fewer ulp count as zero
_GROWTH_STATES = 16  # number of rows of which the mean mass matrix is formed
_DEFINITE = 1e-12  # smallest eigenvalue of D, relative to the largest
_MIN_DISTANCE = 1e-6  # relative tolerance of the rank of the initial differences
_DIRECTIONS = 4  # initial differences, each of which costs a run
_ROUNDING_RMS = 0.3  # rms rounding error of a sum, relative to eps/2 times its size


@dataclass(frozen=True)
class Estimate:
    """Error estimate of a run, from repetitions with shorter steps, and its reliability.

    Attributes
    ----------
    q, qd : (n, nq) arrays
        Estimates of |q - exact| and |qd - exact| at every row of the run, in the units of the
        coordinates and per s; inf where a run with shorter steps stopped before the row.
    end : dict
        The same estimates at the last row, by name; velocities have names such as "theta_dot".
    digits : dict
        Number of correct decimal digits at the last row, by name. It is -log10 of the error divided
        by the scale of the variable, which is its largest absolute value along the run.
    order : int
        Order of the method.
    observed : float
        Observed order: log2 of the factor by which halving h reduces the differences between runs;
        nan if these differences are rounding errors.
    amplification : float
        Largest factor by which the motion multiplies a small difference of the initial states until
        the end of the run. It is 1 for a harmonic oscillator. It is a lower bound if the difference
        becomes as large as the motion itself. The norm of a difference d = [dq; dqd] is
        |d|^2 = dqd' D dqd + (dq/T)' D (dq/T) with the mean mass matrix D and the times
        T = |dq|/|dqd| (docs/python.md).
    verdict : str
        The reasons why the motion is not resolved; "" if it is resolved.
    events : mapping
        Error in time of each occurrence of an event, (n,), s, by the event's name; inf if a run
        with shorter steps does not detect it.
    missed : mapping
        Times (n,), s, of occurrences that only a run with shorter steps detects, by the event's
        name.
    """

    q: Array
    qd: Array
    end: dict[str, float]
    digits: dict[str, float]
    order: int
    observed: float
    amplification: float
    verdict: str
    events: Mapping[str, Array] = field(default_factory=dict)
    missed: Mapping[str, Array] = field(default_factory=dict)

    @property
    def resolved(self) -> bool:
        """True if the run resolves the motion, that is, if `verdict` is empty."""
        return not self.verdict

    @property
    def warning(self) -> str:
        """Text of a warning that the run does not resolve the motion; "" if it does."""
        return f"this motion is not resolved: {self.verdict}" if self.verdict else ""

    def __str__(self) -> str:
        """One line on the end: errors, correct digits, amplification of a difference."""
        ends = ", ".join(
            f"{name} {self.end[name]:.1g} ({digits:.0f} digits)"
            for name, digits in self.digits.items()
        )
        grown = f"a difference at the start has become {self.amplification:.2g} times as large"
        return f"error at the end about {'; '.join(x for x in (ends, grown, self.warning) if x)}"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("estimate.Estimate", *self.__dict__.values())


def estimate(run: Trajectory, progress: Callable[[int, int], None] | None = None) -> Estimate:
    """Estimate the error of a run by repeating it with steps h/2, h/4 and so on until convergence.

    The error of the finest repetition follows from the last difference and the observed order. The
    estimate is at least the accumulated rounding error. The cost is eight to twelve times that of
    the run, or forty times if the repetitions do not converge.

    progress: function that is called with (completed steps, expected number of steps).
    """
    if not run.steps:
        return _zero_error(run)
    model, own = run.model, run.x.astype(float)
    order, repeat = model.info.method_table[run.method].order, _Repetition(run, progress)
    eps = float(np.finfo(model.info.dtype).eps) / 2
    counts = _counts(run, run.every, len(run))
    scale, grown, amplification = _growth(run, own, eps, repeat)
    rounding = eps * np.maximum(grown, np.abs(own))  # of one step, propagated to each row
    walk = _ROUNDING_RMS * rounding * np.sqrt(counts)[:, None]
    one = min(_rms(rounding / scale), _MAX_SMOOTH_GROWTH * eps)
    solutions, observed, stopped = _finer(run, own, scale, one, eps, repeat)

    with np.errstate(invalid="ignore"):
        whole = np.abs(own - solutions[-1])
        rest = np.abs(solutions[-2] - solutions[-1])
    sure = min(max(observed, 0.5), float(order)) if math.isfinite(observed) else float(order)
    error = whole + rest / (2**sure - 1)
    # two rounding errors may agree at a row by chance, so the largest difference nearby counts
    least = np.maximum(eps * np.abs(own), np.minimum(walk, _local_maximum(np.maximum(whole, rest))))
    error = np.maximum(error, np.where(counts[:, None] > 0, least, 0.0))
    error[~np.isfinite(error)] = np.inf

    names = [*model.info.coordinates, *(f"{c}_dot" for c in model.info.coordinates)]
    with np.errstate(divide="ignore"):
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -math.log10(eps)) + 0.0  # no -0
    if (walk[-1] > UNRESOLVED_ERROR * scale).any() and _is_discontinuous(run, scale, eps, repeat):
        walk *= 0.0
    words = _verdict(
        run, names, error / scale, walk / scale, observed, order, amplification, stopped
    )
    return Estimate(
        q=error[:, : model.info.nq],
        qd=error[:, model.info.nq :],
        end=dict(zip(names, map(float, error[-1]), strict=True)),
        digits=dict(zip(names, map(float, digits), strict=True)),
        order=order,
        observed=observed,
        amplification=amplification,
        verdict="; ".join(words),
    )


class _Repetition:
    """Repeat a run in shorter steps or from a perturbed start, and report the progress of all."""

    def __init__(self, run: Trajectory, progress: Callable[[int, int], None] | None) -> None:
        self.run, self.progress, self.spent = run, progress, 0

    def __call__(self, parts: int, every: int, nudge: Array | None = None) -> Trajectory:
        """Repeat the run in steps of h/parts with rows after `every` steps; nudge: of x(t0)."""
        progress = None if self.progress is None else self._report
        refined: Trajectory = self.run.repeat(parts, every, nudge, progress)
        self.spent += parts * self.run.steps
        if refined.status == "interrupted":
            raise KeyboardInterrupt
        return refined

    def _report(self, steps: int, _: int) -> None:
        total = 12 * self.run.steps
        if self.progress is not None:
            self.progress(min(self.spent + steps, total), total)


def _growth(
    run: Trajectory, own: Array, eps: float, repeat: _Repetition
) -> tuple[Array, Array, float]:
    """Return the scales (2 nq,), the linearised differences (n, 2 nq) and their growth to the end.

    The differences are those at each row after a perturbation of the start by one scale.
    """
    model, every, base, times = run.model, run.every, own, run.t
    if len(run) < _MIN_ROWS:
        every = max(1, run.steps // _MIN_ROWS)
        refined = repeat(1, every)
        base, times = refined.x.astype(float), refined.t
    scale = scales(base, float(np.ptp(run.t)), eps, len(model.info.discrete_coordinates))
    moves = moving_mask(model)
    signs = moves * np.random.default_rng(1).choice([-1.0, 1.0], own.shape[1])

    def moved(nudge: Array) -> Array:
        """Return the difference at each row after a perturbation of the start."""
        x = repeat(1, every, nudge).x.astype(float)
        both = min(len(base), len(x))
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(x[:both] - base[:both])

    walked = eps * math.sqrt(run.steps)
    size = max(20 * walked, 1e4 * eps)
    differences = [moved(size * scale * signs)]
    grown = _local_maximum(np.abs(differences[0])) / size
    full = np.maximum.accumulate(np.max(grown / scale, axis=1) * size > SATURATED_DIFFERENCE)
    if full.any():
        # a smaller perturbation, though with more rounding error relative to it
        less = max(2 * walked, 30 * eps)
        differences.append(moved(less * scale * signs))
        finer = _local_maximum(np.abs(differences[1])) / less
        both = min(len(grown), len(finer))
        grown = np.where(full[:both, None], np.maximum(grown[:both], finer[:both]), grown[:both])
    D = mean_mass_matrix(model, base[:, : model.info.nq], times, run.parameter_values)
    place = base[0], float(run.t[0]), run.parameter_values
    amplification = growth_of(model, D, differences, float(np.ptp(run.t)), moves, place, moved)
    counts, steps = _counts(run, run.every, len(run)), _counts(run, every, len(grown))
    rows = np.stack([np.interp(counts, steps, column) for column in grown.T], axis=1)
    return scale, rows, amplification


def growth_of(
    model: CompiledModel, D: Array, differences: list[Array], duration: float, moves: Array,
    place: tuple[Array, float, Array], moved: Callable[[Array], Array],
) -> float:  # fmt: skip
    """Return the factor by which a motion multiplies small differences of its initial state.

    It is the largest factor over the given differences and further directions, in the norm of this
    module.

    Parameters
    ----------
    D : (nq, nq) array
        Mean mass matrix along the motion.
    differences : list of (rows, 2 nq) arrays
        Differences of the states along the motion; the first has the least rounding error.
    duration : float
        Duration of the motion, s.
    moves : (2 nq,) array
        1 for states that may be perturbed, 0 for those that only jumps change.
    place : tuple
        Initial state (2 nq,), initial time, s, and parameters.
    moved : callable
        Function that repeats the run from a perturbed start. It takes the perturbation (2 nq,) of
        the initial state and returns the resulting differences of the states, (rows, 2 nq).
    """
    n, (start, t0, p) = model.info.nq - len(model.info.discrete_coordinates), place
    free = [*range(n), *range(model.info.nq, model.info.nq + n)]

    def allowed(nudge: Array) -> Array:
        """Project a perturbation onto the constraints."""
        if not model.info.constraints.names:
            return nudge
        try:
            x = start + nudge
            solutions = model.constraints.project(
                x[: model.info.nq], x[model.info.nq :], t=t0, params=p
            )
        except (ArithmeticError, ValueError):
            return nudge
        return np.asarray(np.concatenate(solutions) - start, float)

    with np.errstate(all="ignore"):
        own = [x[:, free] for x in differences]
        root = norm_root(D[:n, :n], own, duration)
        first = [allowed(x[0])[free] for x in differences]
        factors = [
            growth(root, a[:, None], x[-1][:, None]) for a, x in zip(first, own, strict=True)
        ]
        rank = int(np.sum(moves[free]))
        for d in other_directions(root, first[0], moves[free], rank):
            nudge = np.zeros(2 * model.info.nq)
            nudge[free] = d
            nudge = allowed(nudge)
            solutions = moved(nudge)[:, free]
            own.append(solutions)
            first.append(solutions[0] if not model.info.constraints.names else nudge[free])
        chosen = [0, *range(len(differences), len(first))]
        common = min(len(own[k]) for k in chosen) - 1
        ends = [first[k] for k in chosen], [own[k][common] for k in chosen]
        return max(*factors, growth(root, *(np.stack(x, axis=1) for x in ends)))


def _is_discontinuous(run: Trajectory, scale: Array, eps: float, repeat: _Repetition) -> bool:
    """Return True if the final differences do not depend on the size of the initial ones.

    Then forces are discontinuous, as -sign(qd) at rest: the perturbed state chatters with an
    amplitude set by the step, which is no sign of chaos. In a chaotic motion a hundredth of the
    initial difference yields a hundredth of the later one, until it reaches the scale.
    """
    every = run.every if len(run) >= _MIN_ROWS else max(1, run.steps // _MIN_ROWS)
    size = max(20 * eps * math.sqrt(run.steps), 1e4 * eps)
    nudges = (part * size * scale * moving_mask(run.model) for part in (0.0, 1.0, 0.01))
    base, *moved = (repeat(1, every, nudge).x.astype(float) for nudge in nudges)
    rows = min(len(base), *map(len, moved))
    with np.errstate(over="ignore", invalid="ignore"):
        large, small = (np.max(np.abs(x[:rows] - base[:rows]) / scale, axis=1) for x in moved)
    row = int(np.argmax(large > SATURATED_DIFFERENCE))
    return bool(small[row] > large[row] / 3)


def _finer(
    run: Trajectory, own: Array, scale: Array, one: float, eps: float, repeat: _Repetition
) -> tuple[list[Array], float, Trajectory | None]:
    """Return the rows at h, h/2, h/4, ... until they converge, the observed order, a stopped run.

    one: rounding error of one step relative to the scales.
    """
    solutions, order = [own], run.model.info.method_table[run.method].order
    stopped: Trajectory | None = None
    parts, last = 1, math.inf
    while True:
        parts *= 2
        refined = repeat(parts, run.every * parts)
        if refined.status != "ok":
            stopped = stopped or refined
        solutions.append(_padded(refined, len(run), parts * run.every))
        now = _rms((solutions[-1] - solutions[-2]) / scale)
        if parts > 2:
            has_differences = min(now, last) > 0 and max(now, last) < math.inf
            observed = math.log2(last / now) if has_differences else math.nan
            count = run.steps * parts
            # rounding errors add up as a random walk, or as a drift if all have the same sign
            least = max(10 * one * math.sqrt(count), min(one * count, math.sqrt(eps)))
            if observed > order - 1 or stopped:
                return solutions, observed, stopped
            if now <= least:
                return solutions, math.nan, None
            if 2 * parts > _MAX_REFINEMENT or 2 * count > _MAX_STEPS:
                return solutions, observed, None
        last = now


def _zero_error(run: Trajectory) -> Estimate:
    """Return the estimate of a run without steps: its only row, the start, has no error."""
    names = [*run.model.info.coordinates, *(f"{c}_dot" for c in run.model.info.coordinates)]
    none = np.zeros_like(run.q, dtype=float)
    full = -math.log10(float(np.finfo(run.model.info.dtype).eps) / 2)
    order = run.model.info.method_table[run.method].order
    zero, digits = dict.fromkeys(names, 0.0), dict.fromkeys(names, full)
    return Estimate(none, none.copy(), zero, digits, order, math.nan, 1.0, "")


def _counts(run: Trajectory, every: int, rows: int) -> Array:
    """Return the number of steps completed at each row."""
    return np.minimum(np.arange(rows) * every, run.steps)


def moving_mask(model: CompiledModel) -> Array:
    """Return a mask (2 nq,) of the states [q; qd]: 1 for those that may be perturbed, else 0.

    States that only jumps change may not be perturbed.
    """
    return np.tile(
        np.arange(model.info.nq) < model.info.nq - len(model.info.discrete_coordinates), 2
    ).astype(float)


def scales(x: Array, duration: float, eps: float, discrete: int = 0) -> Array:
    """Return the scale (2 nq,) of each column of the states x, (rows, 2 nq).

    A scale is the largest absolute value of the column, but at least a millionth of the largest
    position (for positions) or velocity (for velocities). If all positions, or all velocities, are
    0, the largest of all states takes the place of their largest value. At rest, velocities change
    no position beyond its rounding error during the run; the scale of velocities is then the
    largest position divided by the duration.

    duration: of the run, s. eps: unit roundoff. discrete: number of the last coordinates, which
    only jumps change; their scale is their own largest absolute value, or 1 if that is 0.
    """
    whole = np.max(np.abs(x), axis=0).reshape(2, -1)
    n = whole.shape[1] - discrete
    largest = whole[:, :n].ravel()
    most = np.max(largest.reshape(2, -1), axis=1)
    if 0 < most[1] * duration <= _REST_ROUNDINGS * eps * most[0]:
        largest[len(largest) // 2 :] = most[1] = most[0] / duration
    halves = np.repeat(most, n)
    rest = np.where(halves > 0, halves, np.max(largest))
    scale = np.where(whole > 0, whole, 1.0)
    scale[:, :n] = np.maximum(largest, np.where(rest > 0, 1e-6 * rest, 1.0)).reshape(2, -1)
    return scale.ravel()


def _local_maximum(x: Array) -> Array:
    """Return the largest value of each column within a window of up to 7.5 % of the rows."""
    starts = np.unique(np.linspace(0, len(x), 40, endpoint=False).astype(int))
    blocks = np.maximum.reduceat(x, starts, axis=0)
    wide = blocks.copy()
    wide[1:] = np.maximum(wide[1:], blocks[:-1])
    wide[:-1] = np.maximum(wide[:-1], blocks[1:])
    around: Array = np.repeat(wide, np.diff([*starts, len(x)]), axis=0)
    return around


def _rms(x: Array) -> float:
    """Return the root mean square over all rows, inf if a value is nan."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.nan_to_num(np.sqrt(np.mean(np.square(x))), nan=np.inf))


def _padded(run: Trajectory, rows: int, every: int) -> Array:
    """Return the states of a finer run at the rows of the original; nan after it stopped."""
    out = np.full((rows, 2 * run.model.info.nq), np.nan)
    count = rows if run.status == "ok" else min(rows, 1 + run.steps // every)
    out[:count] = run.x[:count]
    return out


def rounding_words(model: CompiledModel, amplification: float, t_limit: float) -> str:
    """Return a sentence that says from which time on rounding errors exceed a tenth of the motion.

    It is part of `Estimate.verdict`. model: the scene, whose number type is named. amplification:
    as in `Estimate`; for a large one the sentence calls the motion chaotic. t_limit: the time, s.
    """
    if amplification * math.sqrt(float(np.finfo(model.info.dtype).eps)) > 1:
        return (
            f"chaotic: a difference at the start grows {amplification:.1g} times or more, and "
            f"rounding with it; no run in {model.info.dtype} means anything from t = "
            f"{t_limit:.4g} s on"
        )
    return (
        f"rounding of {model.info.dtype} is a tenth of the motion from t = {t_limit:.4g} s on, "
        "which is "
        "small beside its coordinates: measure these from a nearer origin"
    )


def _verdict(
    run: Trajectory, names: Sequence[str], relative: Array, walk: Array, observed: float,
    order: int, amplification: float, stopped: Trajectory | None,
) -> list[str]:  # fmt: skip
    """Return the reasons why the run is not resolved."""
    words = []
    if run.status != "ok":
        words.append(f"the run stopped at t = {run.t[-1]:.6g} s")
    if stopped is not None:
        words.append(
            f"with steps of {abs(stopped.h):.3g} s it stops at t = {stopped.t[-1]:.6g} s "
            f"({stopped.status})"
        )
    if (walk[-1] > UNRESOLVED_ERROR).any():
        t_limit = run.t[int(np.argmax((walk > UNRESOLVED_ERROR).any(axis=1)))]
        words.append(rounding_words(run.model, amplification, float(t_limit)))
    wrong = relative > UNRESOLVED_ERROR
    if wrong.any():
        row = int(np.argmax(wrong.any(axis=1)))
        name = names[int(np.argmax(relative[row]))]
        words.append(
            f"the error of {name} exceeds a tenth of its size from t = {run.t[row]:.4g} s on: "
            "take a smaller h, or a shorter duration"
        )
    if observed < order - 1:
        words.append(
            f"halving h divides the differences by 2^{observed:.1f}, where {run.method} should by "
            f"2^{order}: h is too long yet, forces jump, or rounding decides"
        )
    return words


def mean_mass_matrix(model: Any, q: Array, t: Array, params: Any = None) -> Array:
    """Return the mean (n, n) of the mass matrices D at some of the states q (rows, n).

    t: their times (rows,), s. params: parameters of the model; None: those of the scene.
    """
    rows = np.unique(np.linspace(0, len(q) - 1, _GROWTH_STATES).astype(int))
    return np.asarray(
        np.mean([model.functions.D(q[k], t=float(t[k]), params=params) for k in rows], axis=0),
        float,
    )


def norm_root(D: Array, differences: Sequence[Array], duration: float) -> Array:
    """Return the matrix W (2n, 2n) that defines the norm |W d| of a difference d = [dq; dqd].

    |W d|^2 = dqd' D dqd + (dq/T)' D (dq/T). D: mean mass matrix (n, n). differences: arrays
    (rows, 2n) of differences along the motion. The time T of each coordinate is the median of
    |dq|/|dqd| in these, at most `duration`, s.
    """
    values, vectors = np.linalg.eigh((D + D.T) / 2)
    values = np.maximum(values, _DEFINITE * max(float(values[-1]), np.finfo(float).tiny))
    root = np.sqrt(values)[:, None] * vectors.T
    n, rows = len(D), np.concatenate([*differences])
    times = np.full(n, duration or 1.0)
    for k in range(n):
        dq, dqd = np.abs(rows[:, k]), np.abs(rows[:, n + k])
        good = (dq > 0) & (dqd > 0) & (dq < np.inf) & (dqd < np.inf)
        if good.any():
            times[k] = min(times[k], float(np.exp(np.median(np.log(dq[good]) - np.log(dqd[good])))))
    whole = np.zeros((2 * n, 2 * n))
    whole[:n, :n], whole[n:, n:] = root / times, root
    return whole


def growth(root: Array, first: Array, last: Array) -> float:
    """Return the largest factor by which differences of states grow between two times.

    first, last: k differences at the first and at the last time, (2n, k), a column for each. The
    maximum is over all linear combinations of the columns; inf if a value is not finite. root:
    matrix W (2n, 2n) of `norm_root`, which defines the norm.
    """
    if not (np.isfinite(first).all() and np.isfinite(last).all()):
        return float("inf")
    most = float(np.max(np.abs(last), initial=0.0)) or 1.0  # its square may overflow
    inverse = np.linalg.pinv(root @ first, rcond=_MIN_DISTANCE)
    return most * float(np.linalg.norm(root @ (last / most) @ inverse, 2))


def other_directions(root: Array, first: Array, moves: Array, rank: int) -> list[Array]:
    """Return further initial differences, (2n,) each, that are orthogonal to `first` (2n,).

    They are also orthogonal to each other, and as large as `first`, in the norm of `root`, the
    matrix W (2n, 2n) of `norm_root`. moves (2n,): 1 for states that may differ, else 0. rank:
    dimension of the space of differences; there are fewer than `rank` results.
    """
    random, directions = np.random.default_rng(2), [first]
    size = float(np.linalg.norm(root @ first))
    widths = np.linalg.norm(root, axis=0)
    for _ in range(min(rank, _DIRECTIONS) - 1):
        d = moves * random.standard_normal(len(first)) / widths
        for other in directions:
            w = root @ other
            d = d - other * float(w @ (root @ d)) / max(float(w @ w), np.finfo(float).tiny)
        length = float(np.linalg.norm(root @ d))
        if not 0 < length < np.inf:
            break
        directions.append(moves * d * (size / length))
    return directions[1:]
