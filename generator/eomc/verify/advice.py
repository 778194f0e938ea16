"""Compare the step sizes that a module advises with its runs.

If runs leave the state that the advice is for, as with stiff friction near rest, the advised step
is compared with the eigenvalues of the linearised motion, by differences of the accelerations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify.convergence import Convergence
from eomc.verify.measurement import Measurement
from eomc.verify.reference import Vector
from eomc.verify.sampling import MAX_DISTANCE, State, evaluate_module, states_of_run

NUDGE = 1e-6  # relative change at the start, from which growth is estimated
# An advised h is compared with runs of SPAN times its length, in steps of these parts of it. The
# limit is that of the motion as it is linear at one place, and the motion goes on from there.
FINE, PARTS, SPAN = 1 / 64, (1 / 8, 1 / 4, 1 / 2, 1, 2), 8
UNSTABLE_GROWTH = 1e3  # times what a difference grows by in fine steps: unstable
MAX_END_ERROR = (
    0.1  # of the motion: the end of a stable run with steps as long as its limit is no answer
)
SMALL_PERTURBATION = (
    1e-9  # of the motion: a difference this small grows in proportion, where forces are stiff
)
MAX_EIGENVALUE_RATIO = 2.0  # times the limit of the eigenvalues: an advised h further off is wrong
DIFFERENCE_STEP = 1e-5  # of the motion: differences of rates of rows, which are smooth
ZERO_TOLERANCE = 1e-9  # of the largest singular value of a constraint's slopes: none
MAX_PLACES = 256  # along the start of the motion at which h is advised, fewer for large scenes
MAX_PREDICTION_STEPS = 2000  # steps of the scene's h in which these lie


class Advice:
    """Checks of the step sizes h that a compiled module advises, by runs with other step sizes.

    runs: the runs of the module with several step sizes, and the data of its scene. holonomic: for
    each constraint equation, whether it restricts positions (holonomic) rather than velocities.
    """

    def __init__(self, runs: Convergence, holonomic: Sequence[bool] = ()) -> None:
        self.holonomic = np.array(holonomic, bool)
        self.runs, self.start, self.scale, self.h = runs, runs.start, runs.scale, runs.h
        self.duration = runs.duration

    def failing_fraction(self, method: str) -> Measurement:
        """Return the least multiple of the advised h, one of PARTS, with which a run is unstable.

        The runs start at `stiffest_state`. A run is unstable in three cases: it stops early; a
        small difference of the initial state grows UNSTABLE_GROWTH times as much as with fine
        steps; or its steps are longer than advised and its final state is wrong by MAX_END_ERROR of
        the motion. The value is nan if no run is unstable, and inf, with a reason, if there is
        nothing to test.

        In two cases the result is another quantity with its own limit: the ratio of the advised h
        to the h that follows from the eigenvalues of the linearised motion. They are: the runs
        contradict the advice, or the advised h is longer than the motion. In both cases the two
        step sizes must agree; the motion then leaves the region where the advice holds.
        """
        if method == "euler" and self._velocities_matter():
            return Measurement(math.inf, "for forces of positions alone")
        longest = self._longest_advised(method, self.stiffest_state, 1e3 * self.duration)
        if math.isinf(longest):
            return Measurement(math.inf, "no mode turns or decays")
        eigen = self._step_by_eigenvalues(method)
        ratio = max(longest / eigen, eigen / longest)
        unit = "times the eigenvalues' h; runs leave where it holds"
        near = (
            Measurement(ratio, unit=unit, limit=MAX_EIGENVALUE_RATIO)
            if ratio <= MAX_EIGENVALUE_RATIO
            else None
        )
        if near and longest > self.duration:
            return near
        fine, grown = self._ends(method, longest, FINE)
        if not math.isfinite(grown):
            return Measurement(math.inf, "the motion does not go on")
        failing = math.nan
        for part in PARTS:
            end, growth = self._ends(method, longest, part)
            wrong = part > 1 and not float(np.max(np.abs(end - fine))) <= MAX_END_ERROR
            if wrong or not growth <= UNSTABLE_GROWTH * max(1.0, grown):
                failing = part
                break
        return near if near and not failing > PARTS[0] else Measurement(failing)

    @cached_property
    def stiffest_state(self) -> State:
        """State near the start of the motion for which the module advises the shortest h.

        Only states within MAX_DISTANCE times the scale of the initial state count: if steps are too
        long for the motion, later states are as large as 1e40 and differences have no digits left.
        """
        start = self.start
        method = next(m for m in self.runs.methods if math.isfinite(min(METHODS[m].limits)))
        steps = min(MAX_PREDICTION_STEPS, math.ceil(self.duration / self.h))
        every = max(1, steps * max(1, len(start.q) // 8) // MAX_PLACES)
        stiffest, longest = start, 1e3 * self.duration
        run = self.runs.run(start, method, steps=steps, every=every)
        for s in states_of_run(run, start):
            if not np.all(np.abs([s.q - start.q, s.qd - start.qd]) < MAX_DISTANCE * self.scale):
                break
            if (here := self._longest_advised(method, s, longest)) < longest:
                stiffest, longest = s, here
        return stiffest

    def _longest_advised(self, method: str, s: State, most: float) -> float:
        """Return the longest h without a warning of the module, to 5 %; inf if `most` has none."""
        low = most
        while self._warns(method, s, low):
            low /= 2
        if low == most:
            return math.inf
        high = 2 * low
        while high > 1.05 * low:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._warns(method, s, middle) else (middle, high)
        return high

    def _velocities_matter(self) -> bool:
        """True if accelerations depend on velocities."""
        s = self.runs.places[-1].state
        at_rest = replace(s, qd=0 * s.qd)
        one, other = (self.runs.ask("acceleration", x) for x in (s, at_rest))
        return not np.array_equal(one, other)

    def _warns(self, method: str, s: State, h: float) -> bool:
        """True if the module advises against h at a state."""
        message = self.runs.module.advice(s.q, s.qd, h, params=s.params, method=method, t0=s.t)
        return message is not None

    def _ends(self, method: str, longest: float, part: float) -> tuple[Vector, float]:
        """Return the scaled final state of a run over SPAN times `longest` seconds, and the growth.

        The growth is the larger of that of a small difference of the initial state and of a tiny
        one, for which stiff forces, which are soon at their bounds, are linear.
        """
        s = self.stiffest_state
        signs = np.random.default_rng(1).choice([-1.0, 1.0], self.scale.shape)
        directions = self._constrained_directions(
            s
        )  # off the constraints there may be no start near singular positions
        signs = (directions @ (directions.T @ signs.ravel())).reshape(signs.shape)
        steps, ends = round(SPAN / part), []
        for by in (0.0, NUDGE, SMALL_PERTURBATION):
            q, qd = np.array([s.q, s.qd]) + by * signs * self.scale
            how = {"h": part * longest, "steps": steps, "every": steps, "t0": s.t}
            run = self.runs.run(replace(s, q=q, qd=qd), method, **how)
            if str(run.status) != "ok":
                return np.full(self.scale.shape, math.inf), math.inf
            ends.append(np.array([run.q[-1], run.qd[-1]]) / self.scale)
        growths = (
            np.max(np.abs(ends[k] - ends[0])) / by
            for k, by in ((1, NUDGE), (2, SMALL_PERTURBATION))
        )
        return ends[0], float(max(growths))

    def _step_by_eigenvalues(self, method: str) -> float:
        """Return the longest stable h, s, of the motion linearised at `stiffest_state`.

        The derivatives are differences. Under constraints the longer of two steps counts: along the
        constraints, since each step is corrected onto them, though they turn with the motion; and
        along all directions.
        """
        candidates = [self._constrained_directions(self.stiffest_state)]
        if self.holonomic.size:
            candidates.append(np.eye(2 * len(self.stiffest_state.q)))
        return max(self._eigenvalue_limit(method, directions) for directions in candidates)

    def _eigenvalue_limit(self, method: str, directions: Vector) -> float:
        """Return the longest stable h, s, for changes of [q; q̇] in the span of `directions`."""
        s = self.stiffest_state
        n, x = len(s.q), np.array([s.q, s.qd])
        rates = np.zeros_like(directions)
        for k, direction in enumerate(directions.T):
            by = SMALL_PERTURBATION**0.5 * 1e-2 * direction.reshape(2, n) * self.scale
            try:
                ends = [
                    self.runs.ask("acceleration", replace(s, q=moved[0], qd=moved[1]))
                    for moved in (x + by, x - by)
                ]
            except ArithmeticError:  # off the constraints there may be none
                return 0.0
            change = np.array([2 * by[1], ends[0] - ends[1]])
            rates[:, k] = (change / (2 * SMALL_PERTURBATION**0.5 * 1e-2 * self.scale)).ravel()
        values = np.linalg.eigvals(directions.T @ rates)
        turning, decay = METHODS[method].limits
        rate = np.max(np.abs(values.imag)) / turning, np.max(-values.real) / decay
        fastest = float(max(rate))
        return 1 / fastest if fastest > 0 else math.inf

    def _constrained_directions(self, s: State) -> Vector:
        """Return directions of [q; q̇] tangent to the constraints in units of the scale, (2 nq, k).

        The columns are orthonormal. Velocities change with positions so that rates of constraints
        stay zero.
        """
        n, (far, fast) = len(s.q), self.scale
        if not self.holonomic.size:
            return np.eye(2 * n)
        A = evaluate_module(self.runs.module, "constraint_jacobian", s)
        of_q, of_qd = _null_space(A[self.holonomic] * far), _null_space(A * fast)
        rates = np.zeros((len(A), of_q.shape[1]))
        for k, direction in enumerate(of_q.T):
            ends = (
                evaluate_module(
                    self.runs.module, "constraint_rates", replace(s, q=s.q + by * far * direction)
                )
                for by in (DIFFERENCE_STEP, -DIFFERENCE_STEP)
            )
            rates[:, k] = (next(ends) - next(ends)) / (2 * DIFFERENCE_STEP)
        follow = -np.linalg.pinv(A * fast, rcond=ZERO_TOLERANCE) @ rates
        whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
        return np.asarray(np.linalg.qr(whole)[0])


def _null_space(A: Vector) -> Vector:
    """Return an orthonormal basis of the null space of A, (n, k)."""
    _, sizes, rows = np.linalg.svd(A)
    return np.asarray(rows[np.sum(sizes > ZERO_TOLERANCE * np.max(sizes, initial=0)) :].T)
