"""Error of a run, from repetitions with shorter steps, and growth of small differences.

Runs by steps of equal size are repeated with half the step size until they converge. Adaptive runs,
and runs with events, are compared with one run of a hundredth of the tolerance and shorter steps.
Runs from a perturbed start show how rounding errors grow.

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
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .interfaces import CompiledModel
from .package import reduced
from .requests import MIN_TOLERANCE
from .status import FULL, REMEDY

Array = NDArray[Any]

_UNRESOLVED_ERROR = 0.1  # errors above this fraction of a coordinate's scale count as unresolved
_SATURATED_DIFFERENCE = 0.01  # differences above this fraction of the scale grow less than linearly
_MIN_ROWS = 200  # runs with fewer rows are repeated to find the scale of each coordinate
_MIN_DISTANCE = 1e-6  # relative tolerance of the rank of the initial differences
_COMPLETE_STATUSES = ("ok", "accumulated")  # of runs that reached the end of their motion


@dataclass(frozen=True)
class Estimate:
    """Error estimate of a run, from repetitions with shorter steps, and its reliability.

    Attributes
    ----------
    q, qd : (n, nq) arrays
        Estimates of the absolute errors of q and qd at every row of the run, in the units of the
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
        becomes as large as the motion itself. The square of the norm of a difference [dq; dqd]
        is dqd' D dqd + (dq/T)' D (dq/T) with the mean mass matrix D and the times
        T = norm(dq)/norm(dqd) (docs/python.md).
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
        growth = f"perturbations grow by a factor of {self.amplification:.2g}"
        parts = "; ".join(x for x in (ends, growth, self.warning) if x)
        return f"estimated error at the end: {parts}"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("estimate.Estimate", *self.__dict__.values())


def estimate(run: Any, progress: Callable[[int, int], None] | None = None) -> Estimate:
    """Estimate the error of a run by repeating it in shorter steps or with a tighter tolerance.

    The cost for steps of equal size is eight to twelve times that of the run, or forty times if the
    repetitions do not converge.

    progress: function that is called with (completed steps, expected number of steps); for steps of
    various sizes, in each repetition, with (simulated thousandths, 1000).

    Raises MemoryError if the run ended because its rows fill the memory.
    """
    if run.status == FULL:
        raise MemoryError(f"estimate: {REMEDY}")
    if not run.request.has_equal_steps:
        return _Reference(run, progress).estimate()
    if run.times is not None:
        return _at_rows(run, progress)
    if not run.steps:  # its only row is the start
        none = np.zeros((1, 2 * run.model.info.nq))
        return _estimate(run, none, np.ones(none.shape[1]), 1.0, [])
    return _Halving(run, progress).estimate()


def _at_rows(run: Any, progress: Callable[[int, int], None] | None) -> Estimate:
    """Estimate the error after steps, and interpolate it linearly to the requested times."""
    max_rows = 4096
    request = run.request.replace(times=None)
    if run.status != "ok":
        request = request.replace(steps=run.steps)
    request = request.replace(every=max(1, request.steps // max_rows))
    whole = run.model.integrator.integrate(request)
    error = estimate(whole, progress)
    q, qd = (_interpolated(run.t, whole.t, x) for x in (error.q, error.qd))
    return replace(error, q=q, qd=qd)


def _interpolated(t: Array, times: Array, values: Array) -> Array:
    """Interpolate the columns of `values` (m, k), given at `times` (m,), linearly to t (n,)."""
    return np.stack([np.interp(t, times, column) for column in values.T], axis=1)


def _estimate(
    run: Any, error: Array, scale: Array, amplification: float, words: list[str],
    observed: float = math.nan,
) -> Estimate:  # fmt: skip
    """Return the estimate of a run from its error at the rows, (n, 2 nq), and its verdict."""
    info = run.model.info
    with np.errstate(divide="ignore"):
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -math.log10(_roundoff(run))) + 0.0
    end, correct = (dict(zip(info.states, x.tolist(), strict=True)) for x in (error[-1], digits))
    q, qd = np.split(error, 2, axis=1)
    verdict = "; ".join(words)
    return Estimate(q, qd, end, correct, _order(run), observed, amplification, verdict)


def _order(run: Any) -> int:
    """Return the order of the method of a run."""
    return 16 if run.tol else int(run.model.info.method_table[run.method].order)


def _roundoff(run: Any) -> float:
    """Return the unit roundoff of the numbers of a run."""
    return float(np.finfo(run.model.info.dtype).eps) / 2


class _Repetitions:
    """Repetitions of a run in other steps or from a perturbed start.

    Attributes
    ----------
    run : Trajectory
        The run that is repeated.
    begin : (2 nq,) array
        Its initial state [q; qd].
    moves : (2 nq,) array
        1 for states that may be perturbed, 0 for those that only jumps change.
    times, base : (m,) and (m, 2 nq) arrays
        Times, s, at which perturbed runs are compared with the run, and the states of the run.
    scale : (2 nq,) array
        Magnitude of the motion in each state.
    """

    times: Array
    base: Array
    scale: Array

    def __init__(self, run: Any, progress: Callable[[int, int], None] | None) -> None:
        self.run, self.progress, self.eps = run, progress, _roundoff(run)
        self.begin = np.concatenate([run.request.q, run.request.qd]).astype(float)
        n = run.model.info.nq
        self.moves = np.tile(np.arange(n) < n - run.model.info.discrete_count, 2).astype(float)

    def repeat(self, start: Array, **changes: Any) -> Any:
        """Repeat the run from a start [q; qd], with other values of fields of its request."""
        model = self.run.model
        q, qd = start.astype(model.info.dtype).reshape(2, -1)
        request = self.run.request.replace(q=q, qd=qd, **changes)
        repeated = model.integrator.integrate(request, self.progress)
        if repeated.status == "interrupted":
            raise KeyboardInterrupt
        return repeated

    def differences(self, nudge: Array, refined: bool = False) -> Array:
        """Return the changes of the states at `times` that a perturbation of the start causes.

        There are fewer rows if the perturbed run stops early. refined: whether to take the smallest
        tolerance.
        """
        raise NotImplementedError

    def sizes(self, differences: Array) -> Array:
        """Return the sizes of differences along the run without the zeros at which they vanish."""
        raise NotImplementedError

    def propagate(self, size: float, smaller: float | None) -> tuple[list[Array], Array]:
        """Return the differences that perturbations cause, and their sizes for one of one scale.

        size: perturbation relative to the scales. smaller: perturbation that is taken as well if
        the differences become too large to grow linearly; it has more rounding error relative to
        it.
        """
        signs = np.random.default_rng(1).choice([-1.0, 1.0], len(self.begin))
        nudge = self.moves * self.scale * signs
        differences = [self.differences(size * nudge)]
        grown = self.sizes(differences[0]) / size
        full = np.maximum.accumulate(
            np.max(grown / self.scale, axis=1) * size > _SATURATED_DIFFERENCE
        )
        if smaller is not None and full.any():
            differences.append(self.differences(smaller * nudge, refined=True))
            finer = self.sizes(differences[1]) / smaller
            rows = slice(min(len(grown), len(finer)))
            most = np.maximum(grown[rows], finer[rows])
            grown = np.where(full[rows, None], most, grown[rows])
        return differences, grown

    def amplification(self, differences: list[Array]) -> float:
        """Return the factor by which the motion multiplies small differences of its initial state.

        It is the largest factor over the given differences and further directions, in the norm of
        this module. differences: arrays (rows, 2 nq) along the motion; the first has the least
        rounding error.
        """
        model, constraints = self.run.model, self.run.model.info.constraints.names
        n, nq = model.info.nq - model.info.discrete_count, model.info.nq
        free = [*range(n), *range(nq, nq + n)]
        D = mean_mass_matrix(model, self.base[:, :nq], self.times, self.run.request.p)[:n, :n]
        with np.errstate(all="ignore"):
            own = [_finite(x)[:, free] for x in differences]
            root = norm_root(D, own, float(np.ptp(self.times)))
            first = [self._on_constraints(x[0])[free] for x in map(_finite, differences)]
            ends = [(a, x[-1]) for a, x in zip(first, own, strict=True)]
            factors = [growth(root, a[:, None], b[:, None]) for a, b in ends]
            own, first = own[:1], first[:1]
            rank = int(np.sum(self.moves[free]))
            for d in other_directions(root, first[0], self.moves[free], rank):
                nudge = np.zeros(2 * nq)
                nudge[free] = d
                nudge = self._on_constraints(nudge)
                own.append(_finite(self.differences(nudge))[:, free])
                first.append(nudge[free] if constraints else own[-1][0])
            last = min(map(len, own)) - 1
            ends_of_all = np.stack(first, axis=1), np.stack([x[last] for x in own], axis=1)
            return max(*factors, growth(root, *ends_of_all))

    def _on_constraints(self, nudge: Array) -> Array:
        """Return a perturbation of the start, projected onto the constraints."""
        model, run = self.run.model, self.run
        if not model.info.constraints.names:
            return nudge
        x = self.base[0] + nudge
        try:
            q, qd = model.constraints.project(*np.split(x, 2), t=run.t0, params=run.request.p)
        except (ArithmeticError, ValueError):
            return nudge
        return np.asarray(np.concatenate([q, qd]) - self.base[0], float)


class _Halving(_Repetitions):
    """Repetitions of a run of steps of equal size, with h/2, h/4 and so on until they converge."""

    def __init__(self, run: Any, progress: Callable[[int, int], None] | None) -> None:
        super().__init__(run, None)
        self.spent, total = 0, 12 * run.steps
        if progress is not None:
            self.progress = lambda steps, _: progress(min(self.spent + steps, total), total)
        self.own, self.every = run.x.astype(float), run.every
        self.base, self.times = self.own, run.t
        if len(run) < _MIN_ROWS:
            self.every = max(1, run.steps // _MIN_ROWS)
            whole = self.in_parts(1, self.every)
            self.base, self.times = whole.x.astype(float), whole.t
        duration, discrete = float(np.ptp(run.t)), run.model.info.discrete_count
        self.scale = scales(self.base, duration, self.eps, discrete)

    def in_parts(self, parts: int, every: int, nudge: Any = 0.0) -> Any:
        """Repeat the run in steps of h/parts with rows after `every` steps; nudge: of the start."""
        request, steps = self.run.request, self.run.steps * parts
        repeated = self.repeat(
            self.begin + nudge, h=request.h / parts, steps=steps, every=every, times=None
        )
        self.spent += steps
        return repeated

    def differences(self, nudge: Array, refined: bool = False) -> Array:
        """Return the changes of the states at `times` that a perturbation of the start causes."""
        x = self.in_parts(1, self.every, nudge).x.astype(float)
        rows = slice(min(len(self.base), len(x)))
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(x[rows] - self.base[rows])

    def sizes(self, differences: Array) -> Array:
        """Return the largest sizes of differences nearby."""
        return _local_maximum(np.abs(differences))

    def estimate(self) -> Estimate:
        """Estimate the error: that of the finest repetition follows from the observed order."""
        run, own, eps, scale, order = self.run, self.own, self.eps, self.scale, _order(self.run)
        walked, rounding_rms = eps * math.sqrt(run.steps), 0.3  # rms relative to eps times the size
        size = max(20 * walked, 1e4 * eps)
        differences, grown = self.propagate(size, max(2 * walked, 30 * eps))
        amplification = self.amplification(differences)
        # of one step, propagated to each row
        rounding = _interpolated(run.t, self.times[: len(grown)], grown)
        rounding = eps * np.maximum(rounding, np.abs(own))
        counts = np.minimum(np.arange(len(run)) * run.every, run.steps)[:, None]
        walk = rounding_rms * rounding * np.sqrt(counts)
        # larger growth may come from a discontinuity of the forces
        one = min(_rms(rounding / scale), 1e6 * eps)
        solutions, observed, stopped = self._converge(one)

        with np.errstate(invalid="ignore"):
            whole = np.abs(own - solutions[-1])
            rest = np.abs(solutions[-2] - solutions[-1])
        sure = min(max(observed, 0.5), float(order)) if math.isfinite(observed) else float(order)
        error = whole + rest / (2**sure - 1)
        # two rounding errors may agree at a row by chance, so the largest difference nearby counts
        least = np.minimum(walk, _local_maximum(np.maximum(whole, rest)))
        error = np.maximum(error, np.where(counts > 0, np.maximum(eps * np.abs(own), least), 0.0))
        error[~np.isfinite(error)] = np.inf

        if (walk[-1] > _UNRESOLVED_ERROR * scale).any() and self._is_discontinuous(size):
            walk *= 0.0
        words = []
        if stopped is not None:
            words.append(
                f"with steps of {abs(stopped.h):.3g} s it stops at t = {stopped.t[-1]:.6g} s "
                f"({stopped.status})"
            )
        words = _verdict(run, error / scale, walk / scale, amplification, words)
        if observed < order - 1:
            words.append(
                f"halving h divides the differences by 2^{observed:.1f}, where {run.method} should "
                f"by 2^{order}: h is too long yet, forces jump, or rounding decides"
            )
        return _estimate(run, error, scale, amplification, words, observed)

    def _converge(self, one: float) -> tuple[list[Array], float, Any]:
        """Return the rows at h, h/2, ... until they converge, the observed order, a stopped run.

        one: rounding error of one step relative to the scales.
        """
        max_refinement, max_steps = 16, 2_000_000  # of a repetition beyond h/4
        run, solutions, order, stopped = self.run, [self.own], _order(self.run), None
        parts, last = 1, math.inf
        while True:
            parts *= 2
            refined = self.in_parts(parts, run.every * parts)
            rows = np.full_like(self.own, np.nan)
            count = len(run)
            if refined.status != "ok":
                stopped = stopped or refined
                count = min(count, 1 + refined.steps // (parts * run.every))
            rows[:count] = refined.x[:count]
            solutions.append(rows)
            now = _rms((rows - solutions[-2]) / self.scale)
            if parts > 2:
                has_differences = min(now, last) > 0 and max(now, last) < math.inf
                observed = math.log2(last / now) if has_differences else math.nan
                steps = run.steps * parts
                # rounding errors add up as a random walk, or as a drift if all have the same sign
                drift = min(one * steps, math.sqrt(self.eps))
                if observed > order - 1 or stopped:
                    return solutions, observed, stopped
                if now <= max(10 * one * math.sqrt(steps), drift):
                    return solutions, math.nan, None
                if 2 * parts > max_refinement or 2 * steps > max_steps:
                    return solutions, observed, None
            last = now

    def _is_discontinuous(self, size: float) -> bool:
        """Return True if the final differences do not depend on the size of the initial ones.

        Then forces are discontinuous, as -sign(qd) at rest: the perturbed state chatters with an
        amplitude set by the step, which is no sign of chaos. In a chaotic motion a hundredth of the
        initial difference yields a hundredth of the later one, until it reaches the scale. size:
        the initial difference relative to the scales.
        """
        nudge = size * self.scale * self.moves
        differences = [self.differences(part * nudge) for part in (1.0, 0.01)]
        rows = slice(min(map(len, differences)))
        with np.errstate(over="ignore", invalid="ignore"):
            large, small = (np.max(np.abs(x[rows]) / self.scale, axis=1) for x in differences)
        row = int(np.argmax(large > _SATURATED_DIFFERENCE))
        return bool(small[row] > large[row] / 3)


class _Reference(_Repetitions):
    """Repetitions of an adaptive run, or of a run with fixed steps and events.

    Attributes
    ----------
    rows : (n,) array
        Row of the run that each row is compared by: itself, or at a jump, which another run may
        make on either side of it, the last row before that is not at one.
    reached : float
        Time at which the run ended, s.
    least : float
        Smallest tolerance of the module.
    """

    def __init__(self, run: Any, progress: Callable[[int, int], None] | None) -> None:
        super().__init__(run, progress)
        info, x = run.model.info, run.x.astype(float)
        self.least = MIN_TOLERANCE[info.dtype.itemsize]
        self.reached = float(run.events[run.stopped].t[-1] if run.stopped else run.t[-1])
        jumps = np.isin(run.t, run.t[1:][np.diff(run.t) == 0])
        self.rows = np.maximum.accumulate(np.where(jumps, 0, np.arange(len(x))))
        self.x = x[self.rows]
        self.modes = np.array(info.constraints.modes, int).reshape(-1, 2)
        # nor are the velocities of sticking friction perturbed
        self.moves[info.nq + self.modes[:, 1]] = self.begin[self.modes[:, 0]] != 0
        self.scale = scales(x, float(np.ptp(run.t)), self.eps, info.discrete_count)
        own = np.flatnonzero(~jumps & (run.t > run.t0))
        self.times = np.concatenate([[run.t0], run.t[own].astype(float)])
        self.base = np.concatenate([self.begin[None], x[own]])
        if len(own) < _MIN_ROWS:
            between = np.linspace(run.t0, run.t[-1], _MIN_ROWS + 1)[1:-1].astype(info.dtype)
            self.times = np.unique(np.concatenate([self.times, between.astype(float)]))
            self.base = np.concatenate(run(self.times), axis=1).astype(float)

    def states(
        self, start: Array, tol: float, step_limit: float, max_steps: float = np.inf,
        end: float | None = None,
    ) -> tuple[Array, Any]:  # fmt: skip
        """Repeat the run; return its states at `times`, (m, 2 nq), and the new run or None.

        start: initial state [q; qd]. tol: tolerance. step_limit: longest step, s, or size of fixed
        steps. max_steps: number of steps after which the new run ends early. end: end time, s;
        None: that of the run. States after an early end are nan.
        """
        run = self.run
        dtype = run.model.info.dtype
        states = np.full((len(self.times), len(start)), np.nan)
        states[0] = start.astype(dtype)
        if len(states) == 1:
            return states, None
        repeated = self.repeat(
            start, t_end=float(run.t[-1]) if end is None else end, tol=tol, max_steps=max_steps,
            times=self.times[1:].astype(dtype),
            **{"h" if run.request.h else "max_step": step_limit},
        )  # fmt: skip
        states[1 : 1 + len(repeated)] = repeated.x
        if run.stopped and repeated.stopped == run.stopped and self.times[-1] == self.reached:
            event = repeated.events[run.stopped]
            states[-1] = np.concatenate([event.q[-1], event.qd[-1]])
        return states, repeated

    def at_rows(self, states: Array) -> Array:
        """Select from the states at `times` those at the rows of the run, (n, 2 nq)."""
        times = self.run.t[self.rows].astype(float)
        return np.asarray(states[np.searchsorted(self.times, times)])

    def differences(self, nudge: Array, refined: bool = False) -> Array:
        """Return the changes of the states at `times` that a perturbation of the start causes."""
        run, ratio = self.run, 100
        # the perturbed motion may differ, so its steps are limited
        max_steps = ratio * (run.steps + run.rejected) + ratio**2
        tol, limit = self.least if refined else run.tol, run.request.step_limit
        base = self.states(self.begin, tol, limit)[0] if refined else self.base
        return self.states(self.begin + nudge, tol, limit, max_steps)[0] - base

    def sizes(self, differences: Array) -> Array:
        """Return the sizes at the rows of the run; rows that are not finite have those before."""
        rows = np.abs(self.at_rows(differences))
        is_finite = np.isfinite(rows).all(axis=1)
        filled: Array = np.nan_to_num(
            rows[np.maximum.accumulate(np.where(is_finite, np.arange(len(rows)), 0))]
        )
        # the difference may vanish for a moment
        filled[-1] = filled[-1 - len(rows) // 40 :].max(axis=0)
        return filled

    def reference(self) -> tuple[Array, Any]:
        """Repeat the run with a hundredth of the tolerance and shorter steps.

        Fixed steps are h / 4. If the tolerance cannot be reduced, a larger one leads to other steps
        with other rounding errors. Return the states of the new run at the rows of the run, (n, 2
        nq), and the new run.
        """
        run, end, min_steps, min_extra_steps = self.run, None, 512, 10
        if run.stopped:  # shorter steps may detect that event later, or not at all
            extra = max(self.reached - run.t0, min_extra_steps * run.h)
            end = min(run.request.t_end, self.reached + extra)
        tol, limit, longest = run.tol, run.h / 4, run.h / 2
        if tol:
            tol = max(tol / 100, self.least) if tol >= 2 * self.least else 4 * self.least
            longest = run.request.max_step
            limits = run.h / 2, float(np.ptp(run.t)) / min_steps, longest
            limit = min((h for h in limits if h > 0), default=0.0)
        states, other = self.states(self.begin, tol, limit, end=end)
        if run.status == "ok" and other is not None and other.status not in _COMPLETE_STATUSES:
            # its steps were too short near singular positions
            states, other = self.states(self.begin, tol, longest, end=end)
        return self.at_rows(states), other

    def estimate(self) -> Estimate:
        """Estimate the error: the difference from the reference run.

        For runs with events, or with large errors, it is at least the propagated rounding error;
        motion between jumps may be exact for any tolerance.
        """
        run, x, scale, eps = self.run, self.x, self.scale, self.eps
        finer, other = self.reference()
        left, rounding = np.where(np.isfinite(finer), np.abs(x - finer), np.inf), eps * np.abs(x)
        events = _Events.compare(run, other, left, scale)
        if events.end is not None:
            left[-1] = np.abs(x[-1] - events.end)
        elif not events.stops:
            left[-1] = np.inf
        is_rounding = any(map(len, run.events.values())) or (left > _UNRESOLVED_ERROR * scale).any()
        differences, grown = self.propagate(
            max(1e4 * eps, 100 * run.tol), 4 * eps if is_rounding else None
        )
        if is_rounding:
            rounding = np.maximum(rounding, eps * grown)
        exact = [*self.modes[:, 0], *(run.model.info.nq + self.modes[:, 0])]
        for some in (left, rounding):
            some[:, exact] = some[run.t == run.t0] = 0.0
        amplification = self.amplification(differences)
        words = events.words(run)
        # the words on events say why states are missing
        error = np.where(np.isfinite(left), left, 0.0) if words else left
        words = _verdict(run, error / scale, rounding / scale, amplification, words)
        estimated = _estimate(run, np.maximum(left, rounding), scale, amplification, words)
        return replace(estimated, events=events.errors, missed=events.missed)


def _finite(rows: Array) -> Array:
    """Return the rows of a difference between two runs at which both runs have states."""
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _verdict(
    run: Any, error: Array, rounding: Array, amplification: float, words: list[str]
) -> list[str]:
    """Return the reasons why a run is not resolved.

    error, rounding: relative to the scale of each state, at the rows, (n, 2 nq). words: reasons
    that precede those of these errors.
    """
    if run.status not in _COMPLETE_STATUSES:
        words = [f"the run stopped at t = {run.t[-1]:.6g} s", *words]
    is_rounding, wrong = (np.any(x > _UNRESOLVED_ERROR, axis=1) for x in (rounding, error))
    if is_rounding[-1]:
        t_limit = float(run.t[int(np.argmax(is_rounding))])
        words = [*words, rounding_words(run.model, amplification, t_limit)]
    if wrong.any():
        row = int(np.argmax(wrong))
        what, remedy = "the error exceeds a tenth of the motion", "tighter tolerance"
        if run.request.has_equal_steps:
            name = run.model.info.states[int(np.argmax(error[row]))]
            what = f"the error of {name} exceeds a tenth of its size"
        if not run.tol:
            remedy = "smaller h"
        end = f"from t = {run.t[row]:.4g} s on: take a {remedy}, or a shorter duration"
        words = [*words, f"{what} {end}"]
    return words


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
    rest_roundings = 64.0  # velocities that move a position by fewer count as zero
    if 0 < most[1] * duration <= rest_roundings * eps * most[0]:
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


def mean_mass_matrix(model: Any, q: Array, t: Array, params: Any = None) -> Array:
    """Return the mean (n, n) of the mass matrices D at some of the states q (rows, n).

    t: their times (rows,), s. params: parameters of the model; None: those of the scene.
    """
    rows = np.unique(np.linspace(0, len(q) - 1, 16).astype(int))
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
    values = np.maximum(values, _MIN_DISTANCE**2 * max(float(values[-1]), np.finfo(float).tiny))
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
    max_directions = 4  # each costs a run
    random, directions = np.random.default_rng(2), [first]
    size = float(np.linalg.norm(root @ first))
    widths = np.linalg.norm(root, axis=0)
    for _ in range(min(rank, max_directions) - 1):
        d = moves * random.standard_normal(len(first)) / widths
        for other in directions:
            w = root @ other
            d = d - other * float(w @ (root @ d)) / max(float(w @ w), np.finfo(float).tiny)
        length = float(np.linalg.norm(root @ d))
        if not 0 < length < np.inf:
            break
        directions.append(moves * d * (size / length))
    return directions[1:]


@dataclass(frozen=True)
class _Events:
    """Differences between the events of a run and those of a reference run with shorter steps.

    errors: by name, the absolute difference between the times of each event in both runs, s; inf
    for events that the reference run does not detect.
    missed: by name, the times, s, of events that only the reference run detects.
    false: by name, the times, s, of events that only the run detects.
    stops: whether both runs end in the same way.
    end: last state [q; qd] of the reference run if an event stops it at the end of the run, else
    None.
    """

    errors: dict[str, Array]
    missed: dict[str, Array]
    false: dict[str, Array]
    stops: bool
    end: Array | None

    @classmethod
    def compare(cls, own: Any, other: Any | None, left: Array, scale: Array) -> _Events:
        """Pair the events of a run with those of a reference run and return their differences.

        Events are compared up to the time at which the states of the two runs differ by a tenth of
        the motion. Two events count as the same event under two conditions. They are nearest to one
        another in time. Their distance in time is at most a step, or at most the time shift that
        the difference of the states implies.

        own: the run. other: the reference run, None if there is none. left: absolute difference of
        the states of both runs at the rows, (n, 2 nq). scale: magnitude of the motion in each
        state, (2 nq,).
        """
        # limits: of the shift of an event relative to the shift that differing states imply; of a
        # span, within which times are at its end; of the time to an accumulation point, within
        # which jumps differ in number between runs
        shift_factor, end_tolerance, zeno_fraction = 4.0, 1e-9, 0.01
        names = own.model.info.events
        if other is None or not names:
            return cls({}, {}, {}, True, None)
        reached, other_end = (float(r.events[r.stopped].t[-1] if r.stopped else r.t[-1])
                         for r in (own, other))  # fmt: skip
        relative_difference = np.where(np.isfinite(left), left, 0.0) / scale
        wrong = np.flatnonzero((left > _UNRESOLVED_ERROR * scale).any(axis=1))
        alike = slice(0, wrong[0] if len(wrong) else len(left))
        speed = np.max(np.abs(own.qd.astype(float)), axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            late = np.max(left[alike, : len(speed)], axis=0, initial=0.0) / speed
        shift = shift_factor * float(np.max(late[np.isfinite(late)], initial=0.0))
        gap = max(own.h, min(shift, _UNRESOLVED_ERROR * abs(reached - own.t0)))
        # an event so near the end of one run may lie just after the end of the other
        edge = abs(reached - own.t0) * max(
            float(np.max(relative_difference[alike], initial=0.0)), end_tolerance
        )
        until = float(own.t[wrong[0]]) if len(wrong) else reached - edge
        whole = (
            r.limit - zeno_fraction * (r.limit - r.t0) for r in (own, other) if r.limit == r.limit
        )
        until = min(until, *whole, np.inf)
        # sticking of friction is a part of the state; its error is one of the state
        coordinates = (own.model.info.coordinates[k] for _, k in own.model.info.constraints.modes)
        stick = {f"{c}_{what}" for c in coordinates for what in ("stops", "slips")}
        errors, missed, false = {}, {}, {}
        for name in names:
            a, b = (r.events[name].t.astype(float) for r in (own, other))
            mine, others = _paired(a, b, gap)
            errors[name] = np.full(len(a), np.inf)
            errors[name][mine] = np.abs(a[mine] - b[others])
            if name not in stick:
                alone = np.delete(b, others), np.delete(a, mine)
                missed[name] = alone[0][alone[0] <= until]
                false[name] = alone[1][alone[1] <= min(until, other_end - edge)]
        at_end = bool(other.stopped) and not own.stopped and other_end >= reached - edge
        before_end = bool(own.stopped) and not other.stopped and other_end <= reached + edge
        same = own.stopped == other.stopped and (
            not own.stopped or bool(np.isfinite(errors[own.stopped][-1]))
        )
        event = other.events[other.stopped] if at_end else None
        return cls(
            errors,
            {name: t for name, t in missed.items() if len(t)},
            {name: t for name, t in false.items() if len(t)},
            same or at_end or before_end or other.status not in _COMPLETE_STATUSES,
            None if event is None else np.concatenate([event.q[-1], event.qd[-1]]).astype(float),
        )

    def words(self, own: Any) -> list[str]:
        """Return phrases on events of the run `own` that were missed or falsely detected.

        The list is empty if the events of both runs agree.
        """
        finer, remedy = "shorter steps", "a smaller h"
        if own.tol:
            finer, remedy = "a tighter tolerance", "a tighter tolerance, or a shorter max_step"
        messages = []
        if self.missed:
            messages.append(
                f"{_listed(self.missed)}, detected by {finer}, was missed: take {remedy}"
            )
        if self.false:
            messages.append(f"{_listed(self.false)}, is not detected by {finer}: take {remedy}")
        if not (self.stops or messages):
            messages.append(f"{finer} end the run elsewhere: take {remedy}")
        return messages


def _listed(events: dict[str, Array]) -> str:
    """Describe the first of these events and the number of others."""
    name = min(events, key=lambda each: float(events[each][0]))
    more = sum(map(len, events.values())) - 1
    return f"event '{name}' at t = {events[name][0]:.9g} s{f' (and {more} more)' if more else ''}"


def _paired(a: Array, b: Array, gap: float) -> tuple[Array, Array]:
    """Return the indices of times of a and b that are mutually nearest and within `gap`."""
    if len(a) == len(b) and (np.abs(a - b) <= gap).all():
        return np.arange(len(a)), np.arange(len(b))
    if not (len(a) and len(b)):
        return np.empty(0, int), np.empty(0, int)

    def nearest(some: Array, to: Array) -> Array:
        k = np.clip(np.searchsorted(some, to), 1, max(len(some) - 1, 1))
        k = np.minimum(k, len(some) - 1)
        return np.asarray(np.where(np.abs(some[k - 1] - to) <= np.abs(some[k] - to), k - 1, k))

    at = nearest(b, a)
    mutual = (nearest(a, b)[at] == np.arange(len(a))) & (np.abs(a - b[at]) <= gap)
    return np.flatnonzero(mutual), at[mutual]
