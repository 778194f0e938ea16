"""How far a run may be trusted: its error by step doubling."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .growth import growth, mean_mass_matrix, norm_root, other_directions
from .package import reduced
from .stepping import Stepping
from .trajectory_data import Trajectory

Array = NDArray[Any]

_FINEST = 16  # h/16 is the shortest step taken to see a run converge
_LONG = 2_000_000  # steps of a run beyond which no more than h/4 is taken
_ROWS = 200  # from which on a run's own rows show how large each coordinate becomes
_TENTH = 0.1  # of a coordinate's scale: a result more wrong than that is none
_FULL = 0.01  # of a scale: a difference that has become so large grows no more as it did
_SMOOTH = 1e6  # growth beyond which a difference may as well have met a jump of the forces
_REST = 64.0  # roundings of a position: velocities that move it by less are none
_WALK = 0.3  # rms of the rounding of a sum, in units of eps/2 times its size (1/sqrt(12) to 1/2)


@dataclass(frozen=True)
class Estimate:
    """A run's own error, |q - exact| and |qd - exact| by step doubling, and what it is worth.

    q, qd (n, nq): at every row, in the coordinates' units; inf where a finer run stopped before.
    end: of the last row, by name, velocities as theta_dot. digits: how many of each coordinate are
    right there, relative to its scale, its largest value along the run. order: the method's;
    observed: log2 of what halving h divides the differences by, nan where only rounding is seen.
    amplification: the largest factor by which the motion has multiplied a small difference of the
    start at the end, in the norm |d|^2 = dqd' D dqd + (dq/T)' D (dq/T), with the mean mass matrix
    D and the times T = |dq|/|dqd| of such differences (docs/python.md): 1 of an oscillator. At
    least so large, where the difference becomes as large as the motion.
    verdict: why the motion is not resolved, in words, or "".
    events: by name the error in time of each event of the run, (n,), s; inf where a finer run does
    not detect the event. missed: by name the times of events that a finer run detects and this one
    does not, (n,), s.
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
        """Whether nothing speaks against the figures."""
        return not self.verdict

    @property
    def warning(self) -> str:
        """What is to be said of a run that is not resolved, or ""."""
        return f"this motion is not resolved: {self.verdict}" if self.verdict else ""

    def __str__(self) -> str:
        """The end in a line: errors, right digits, what the motion makes of a difference."""
        ends = ", ".join(
            f"{name} {self.end[name]:.1g} ({digits:.0f} digits)"
            for name, digits in self.digits.items()
        )
        grown = f"a difference at the start has become {self.amplification:.2g} times as large"
        return f"error at the end about {'; '.join(x for x in (ends, grown, self.warning) if x)}"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("estimate.Estimate", *self.__dict__.values())


def estimate(run: Trajectory, progress: Callable[[int, int], None] | None = None) -> Estimate:
    """The error of a run, from the same run at h/2 and h/4, and finer ones where they differ.

    What the finest run leaves is taken from the last difference and the observed order, and
    nothing falls below what rounding adds up to. Costs eight to twelve times the run, or forty
    where it does not converge.
    """
    if not run.steps:
        return _nothing(run)
    model, own = run._model, run.x.astype(float)
    order, again = model.orders[run.method], _Again(run, progress)
    eps = float(np.finfo(model.dtype).eps) / 2
    counts = _counts(run, run.every, len(run))
    scale, grown, amplification = _growth(run, own, eps, again)
    rounding = eps * np.maximum(grown, np.abs(own))  # of one step, carried to each row
    walk = _WALK * rounding * np.sqrt(counts)[:, None]
    one = min(_size(rounding / scale), _SMOOTH * eps)
    found, observed, stopped = _finer(run, own, scale, one, eps, again)

    with np.errstate(invalid="ignore"):
        whole = np.abs(own - found[-1])
        rest = np.abs(found[-2] - found[-1])
    sure = min(max(observed, 0.5), float(order)) if math.isfinite(observed) else float(order)
    error = whole + rest / (2**sure - 1)
    # a difference may vanish for a moment where two roundings agree, but not for long
    least = np.maximum(eps * np.abs(own), np.minimum(walk, _around(np.maximum(whole, rest))))
    error = np.maximum(error, np.where(counts[:, None] > 0, least, 0.0))
    error[~np.isfinite(error)] = np.inf

    names = [*model.coordinates, *(f"{c}_dot" for c in model.coordinates)]
    with np.errstate(divide="ignore"):
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -math.log10(eps)) + 0.0  # no -0
    if (walk[-1] > _TENTH * scale).any() and _leaps(run, scale, eps, again):
        walk *= 0.0
    words = _verdict(
        run, names, error / scale, walk / scale, observed, order, amplification, stopped
    )
    return Estimate(
        q=error[:, : model.nq],
        qd=error[:, model.nq :],
        end=dict(zip(names, map(float, error[-1]), strict=True)),
        digits=dict(zip(names, map(float, digits), strict=True)),
        order=order,
        observed=observed,
        amplification=amplification,
        verdict="; ".join(words),
    )


class _Again:
    """The same run in shorter steps or from a moved start, and how far all of them have come."""

    def __init__(self, run: Trajectory, progress: Callable[[int, int], None] | None) -> None:
        self.run, self.progress, self.spent = run, progress, 0

    def __call__(self, parts: int, every: int, nudge: Array | None = None) -> Trajectory:
        """In steps of h/parts, keeping every so many of them."""
        progress = None if self.progress is None else self._report
        made: Trajectory = self.run._again(parts, every, nudge, progress)
        self.spent += parts * self.run.steps
        if made.status == "interrupted":
            raise KeyboardInterrupt
        return made

    def _report(self, done: int, _: int) -> None:
        total = 12 * self.run.steps
        if self.progress is not None:
            self.progress(min(self.spent + done, total), total)


def _growth(run: Trajectory, own: Array, eps: float, again: _Again) -> tuple[Array, Array, float]:
    """The scales (2 nq,), what a start moved by one scale would become at each row if that were
    little, (n, 2 nq), and the growth of a small difference until the end."""
    model, every, base, times = run._model, run.every, own, run.t
    if len(run) < _ROWS:
        every = max(1, run.steps // _ROWS)
        made = again(1, every)
        base, times = made.x.astype(float), made.t
    scale = scales(base, float(np.ptp(run.t)), eps, len(model.discrete_coordinates))
    moves = moving(model)
    signs = moves * np.random.default_rng(1).choice([-1.0, 1.0], own.shape[1])

    def moved(nudge: Array) -> Array:
        """The difference that a nudge of the start makes at each row, itself at the first."""
        x = again(1, every, nudge).x.astype(float)
        both = min(len(base), len(x))
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(x[:both] - base[:both])

    walked = eps * math.sqrt(run.steps)
    size = max(20 * walked, 1e4 * eps)
    differences = [moved(size * scale * signs)]
    grown = _around(np.abs(differences[0])) / size
    full = np.maximum.accumulate(np.max(grown / scale, axis=1) * size > _FULL)
    if full.any():
        # moved by less, though rounding shows: where that fills the scale, rounding fills a tenth
        less = max(2 * walked, 30 * eps)
        differences.append(moved(less * scale * signs))
        finer = _around(np.abs(differences[1])) / less
        both = min(len(grown), len(finer))
        grown = np.where(full[:both, None], np.maximum(grown[:both], finer[:both]), grown[:both])
    D = mean_mass_matrix(model, base[:, : model.nq], times, run._params)
    place = base[0], float(run.t[0]), run._params
    amplification = growth_of(model, D, differences, float(np.ptp(run.t)), moves, place, moved)
    counts, steps = _counts(run, run.every, len(run)), _counts(run, every, len(grown))
    rows = np.stack([np.interp(counts, steps, column) for column in grown.T], axis=1)
    return scale, rows, amplification


def growth_of(
    model: Stepping, D: Array, differences: list[Array], duration: float, moves: Array,
    place: tuple[Array, float, Array], moved: Callable[[Array], Array],
) -> float:  # fmt: skip
    """The growth of a small difference, from what is known and from other directions.

    differences: along the motion, (rows, 2 nq) each, of which the first is the least rounded;
    place: the start (2 nq,), its time and parameters. moved: finds another difference from a nudge
    of the start, (2 nq,).
    """
    n, (start, t0, p) = model.nq - len(model.discrete_coordinates), place
    free = [*range(n), *range(model.nq, model.nq + n)]

    def allowed(nudge: Array) -> Array:
        """The nearest nudge that obeys the constraints."""
        if not model.constraint_names:
            return nudge
        try:
            x = start + nudge
            found = model.project(x[: model.nq], x[model.nq :], t=t0, params=p)
        except (ArithmeticError, ValueError):
            return nudge
        return np.asarray(np.concatenate(found) - start, float)

    with np.errstate(all="ignore"):
        own = [x[:, free] for x in differences]
        root = norm_root(D[:n, :n], own, duration)
        first = [allowed(x[0])[free] for x in differences]
        factors = [
            growth(root, a[:, None], x[-1][:, None]) for a, x in zip(first, own, strict=True)
        ]
        rank = int(np.sum(moves[free]))
        for d in other_directions(root, first[0], moves[free], rank):
            nudge = np.zeros(2 * model.nq)
            nudge[free] = d
            nudge = allowed(nudge)
            found = moved(nudge)[:, free]
            own.append(found)
            first.append(found[0] if not model.constraint_names else nudge[free])
        chosen = [0, *range(len(differences), len(first))]
        common = min(len(own[k]) for k in chosen) - 1
        ends = [first[k] for k in chosen], [own[k][common] for k in chosen]
        return max(*factors, growth(root, *(np.stack(x, axis=1) for x in ends)))


def _leaps(run: Trajectory, scale: Array, eps: float, again: _Again) -> bool:
    """Whether differences at the start are as large as they become however small they were.

    Forces jump there, as by -sign(qd) at rest: what is moved chatters by what a step brings. That
    says nothing of a run that comes to rest and stays; where a motion is chaotic a difference a
    hundredth as large is, while it fills no scale, a hundredth as large.
    """
    every = run.every if len(run) >= _ROWS else max(1, run.steps // _ROWS)
    size = max(20 * eps * math.sqrt(run.steps), 1e4 * eps)
    nudges = (part * size * scale * moving(run._model) for part in (0.0, 1.0, 0.01))
    base, *moved = (again(1, every, nudge).x.astype(float) for nudge in nudges)
    rows = min(len(base), *map(len, moved))
    with np.errstate(over="ignore", invalid="ignore"):
        large, small = (np.max(np.abs(x[:rows] - base[:rows]) / scale, axis=1) for x in moved)
    row = int(np.argmax(large > _FULL))
    return bool(small[row] > large[row] / 3)


def _finer(
    run: Trajectory, own: Array, scale: Array, one: float, eps: float, again: _Again
) -> tuple[list[Array], float, Trajectory | None]:
    """The rows at h, h/2, h/4 and on until they converge; the order seen; a run that stopped.

    one: the rounding of one step relative to the scales.
    """
    found, order = [own], run._model.orders[run.method]
    stopped: Trajectory | None = None
    parts, last = 1, math.inf
    while True:
        parts *= 2
        made = again(parts, run.every * parts)
        if made.status != "ok":
            stopped = stopped or made
        found.append(_padded(made, len(run), parts * run.every))
        now = _size((found[-1] - found[-2]) / scale)
        if parts > 2:
            seen = min(now, last) > 0 and max(now, last) < math.inf
            observed = math.log2(last / now) if seen else math.nan
            count = run.steps * parts
            # roundings walk; where they are all alike they drift, up to some last digits
            least = max(10 * one * math.sqrt(count), min(one * count, math.sqrt(eps)))
            if observed > order - 1 or stopped:
                return found, observed, stopped
            if now <= least:
                return found, math.nan, None
            if 2 * parts > _FINEST or 2 * count > _LONG:
                return found, observed, None
        last = now


def _nothing(run: Trajectory) -> Estimate:
    """The start itself has no error."""
    names = [*run._model.coordinates, *(f"{c}_dot" for c in run._model.coordinates)]
    none = np.zeros_like(run.q, dtype=float)
    full = -math.log10(float(np.finfo(run._model.dtype).eps) / 2)
    order = run._model.orders[run.method]
    zero, digits = dict.fromkeys(names, 0.0), dict.fromkeys(names, full)
    return Estimate(none, none.copy(), zero, digits, order, math.nan, 1.0, "")


def _counts(run: Trajectory, every: int, rows: int) -> Array:
    """The steps done at each row."""
    return np.minimum(np.arange(rows) * every, run.steps)


def moving(model: Stepping) -> Array:
    """(2 nq,): 1 of what moves and is nudged, 0 of what jumps alone change."""
    return np.tile(np.arange(model.nq) < model.nq - len(model.discrete_coordinates), 2).astype(
        float
    )


def scales(x: Array, duration: float, eps: float, still: int = 0) -> Array:
    """The largest value of each column; those that only rounding moves count as a millionth of the
    largest position, or velocity, or of the state where all of these are 0.

    At rest, where velocities move no position beyond its rounding in that time, theirs is the one
    that would move the largest by its own size. still: the number of last coordinates that jumps
    alone change, which count by themselves.
    """
    whole = np.max(np.abs(x), axis=0).reshape(2, -1)
    n = whole.shape[1] - still
    largest = whole[:, :n].ravel()
    most = np.max(largest.reshape(2, -1), axis=1)
    if 0 < most[1] * duration <= _REST * eps * most[0]:
        largest[len(largest) // 2 :] = most[1] = most[0] / duration
    halves = np.repeat(most, n)
    rest = np.where(halves > 0, halves, np.max(largest))
    scale = np.where(whole > 0, whole, 1.0)
    scale[:, :n] = np.maximum(largest, np.where(rest > 0, 1e-6 * rest, 1.0)).reshape(2, -1)
    return scale.ravel()


def _around(x: Array) -> Array:
    """The largest value of each column within some hundredths of the rows before and behind."""
    starts = np.unique(np.linspace(0, len(x), 40, endpoint=False).astype(int))
    blocks = np.maximum.reduceat(x, starts, axis=0)
    wide = blocks.copy()
    wide[1:] = np.maximum(wide[1:], blocks[:-1])
    wide[:-1] = np.maximum(wide[:-1], blocks[1:])
    around: Array = np.repeat(wide, np.diff([*starts, len(x)]), axis=0)
    return around


def _size(x: Array) -> float:
    """Root mean square over all rows, inf where there are gaps."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.nan_to_num(np.sqrt(np.mean(np.square(x))), nan=np.inf))


def _padded(run: Trajectory, rows: int, every: int) -> Array:
    """The states of a finer run at the run's own rows: nan from where it stopped."""
    out = np.full((rows, 2 * run._model.nq), np.nan)
    kept = rows if run.status == "ok" else min(rows, 1 + run.steps // every)
    out[:kept] = run.x[:kept]
    return out


def rounding_words(model: Stepping, amplification: float, lost: float) -> str:
    """Why rounding is a tenth of the motion from the time `lost` on."""
    if amplification * math.sqrt(float(np.finfo(model.dtype).eps)) > 1:
        return (
            f"chaotic: a difference at the start grows {amplification:.1g} times or more, and "
            f"rounding with it; no run in {model.dtype} means anything from t = {lost:.4g} s on"
        )
    return (
        f"rounding of {model.dtype} is a tenth of the motion from t = {lost:.4g} s on, which is "
        "small beside its coordinates: measure these from a nearer origin"
    )


def _verdict(
    run: Trajectory, names: Sequence[str], relative: Array, walk: Array, observed: float,
    order: int, amplification: float, stopped: Trajectory | None,
) -> list[str]:  # fmt: skip
    """What speaks against the run, one reason a string."""
    words = []
    if run.status != "ok":
        words.append(f"the run stopped at t = {run.t[-1]:.6g} s")
    if stopped is not None:
        words.append(
            f"with steps of {abs(stopped.h):.3g} s it stops at t = {stopped.t[-1]:.6g} s "
            f"({stopped.status})"
        )
    if (walk[-1] > _TENTH).any():
        lost = run.t[int(np.argmax((walk > _TENTH).any(axis=1)))]
        words.append(rounding_words(run._model, amplification, float(lost)))
    wrong = relative > _TENTH
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
