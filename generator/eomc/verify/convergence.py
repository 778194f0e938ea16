"""Checks of a module's methods by runs with several step sizes: orders, power balances, advised h.

The rules are such that a correct module passes where nothing can be measured, and a wrong one fails
wherever a measurement is possible:

- The order is the best of several halvings of h, over time spans from short to long. A wrong
  stepper converges slowly, to errors far above rounding, and more slowly with each halving.
  Therefore a low order counts if two successive spans agree on it. Nothing is judged if there are
  too few halvings between rounding and a hundredth of the motion, as for high orders and a stiff
  motion.
- A power balance closes at the order of the method and of Simpson's rule, or down to rounding. A
  wrong power leaves a residual that no halving changes.
- A step size that the module advises is compared with runs. If runs leave the state that the advice
  is for, as with stiff friction near rest, it is compared with the eigenvalues of the linearised
  motion, from differences of the accelerations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from eomc.integrators.tableaux import METHODS, RK4
from eomc.verify import one_step
from eomc.verify.reference import Vector
from eomc.verify.report import Measurement
from eomc.verify.sampling import (
    MAX_DISTANCE,
    NUDGE,
    State,
    evaluate_module,
    projected_start,
    simulate,
    states_of_run,
)

EPS = 2.0**-52
MAX_OBSERVABLE_ORDER = 8  # with higher orders, two halvings of h lead from 1e-2 to rounding
ORDER_MARGIN = 0.5  # an observed order may be lower than the order of the method by this
NOISE_FACTOR = 30.0  # differences above this multiple of rounding errors are due to the method
ORDER_TOLERANCE = 0.3  # orders that differ by less are the same
COUNTS = (6, 12, 24, 48, 96)  # numbers of steps over one time span
# log2 of spans over 48 h, down to where all differences are rounding error
START_POWERS = (-2, -4, -7, -10, -14, -20)


class _End(Protocol):
    """Scaled final states (2, nq) of runs from a state; None if a run stops early."""

    def __call__(self, s: State, *, span: float, steps: int) -> Vector | None: ...


@dataclass(frozen=True)
class Place:
    """An initial state for runs, with the size of its energy.

    energy: that size, in J. A rounding error of the energy is eps times it.
    """

    state: State
    energy: float


@dataclass(frozen=True)
class _Ladder:
    """Differences of final states over one time span as h is halved again and again.

    span: duration of the runs, s. differences: change by each halving of h, relative to the scale
    of the motion. noise: the part that is due to rounding.
    """

    span: float
    differences: tuple[float, ...]
    noise: float

    @property
    def orders(self) -> Iterator[tuple[float, bool]]:
        """Yield the observed order of each halving of h, and whether it is exact or a lower bound.

        Each pair is (order, exact). Halvings whose coarser difference is mere rounding are left
        out. The order is a lower bound if the finer difference is mere rounding.
        """
        for a, b in pairwise(self.differences):
            # above 1e-2 of the motion, differences are not yet proportional to a power of h
            if NOISE_FACTOR * self.noise < a < 1e-2:
                yield math.log2(a / max(b, self.noise)), b > NOISE_FACTOR * self.noise

    @property
    def exact(self) -> bool:
        """Whether all differences are due to rounding."""
        return max(self.differences) <= NOISE_FACTOR * self.noise

    def best(self, least: float) -> float:
        """Return the largest observed order that is at least `least`; nan if there is none.

        An order does not count if a later halving of h has an order below half of `least`.
        """
        observed = list(self.orders)
        for k, (order, _) in enumerate(observed):
            if order >= least and all(p >= least / 2 for p, clear in observed[k + 1 :] if clear):
                return max(p for p, _ in observed[k:])
        return math.nan

    @property
    def agreed_order(self) -> float:
        """Order of the last two halvings of h above rounding, if they agree; otherwise nan."""
        observed = [p for p, clear in self.orders if clear]
        if len(observed) < 2 or abs(observed[-1] - observed[-2]) > ORDER_TOLERANCE:
            return math.nan
        return observed[-1]


class Convergence:
    """Checks of one module by runs with several step sizes: orders of convergence, power balance.

    Parameters
    ----------
    module : module
        The compiled module.
    methods : sequence of str
        Its integration methods.
    places : sequence of Place
        Initial states of the runs, with the scene's own parameters.
    start : State
        The initial state of the scene.
    scale : (2, nq) array
        Typical sizes of q and of q̇.
    h, duration : float
        Step size and duration of the scene's run, s.
    """

    def __init__(
        self, module: Any, methods: Sequence[str], places: Sequence[Place], start: State,
        scale: Vector, h: float, duration: float,
    ) -> None:  # fmt: skip
        self.module, self.methods, self.places, self.start = module, tuple(methods), places, start
        self.scale, self.h, self.duration = scale, h, duration

    def run(self, s: State, method: str, **how: Any) -> Any:
        """Return the module's run by `method` from the state `s`, even if the run stops early.

        how: further arguments of the module's `simulate`, such as h and steps.
        """
        if method != self.methods[0]:
            how["method"] = method
        if getattr(self.module, "constraint_names", ()):  # they may depend on time
            how.setdefault("t0", s.t)
            s = projected_start(self.module, s)
        return simulate(self.module, s, **how)

    def end(self, s: State, method: str, span: float, steps: int) -> Vector | None:
        """Return the final state of a run by `method` from `s`, divided by the scale, (2, nq).

        The run has `steps` steps over `span` seconds. The scale consists of typical sizes of q and
        q̇. The result is None if the run stops early.
        """
        run = self.run(s, method, h=span / steps, steps=steps, every=steps)
        if str(run.status) != "ok":
            return None
        return np.array([run.q[-1], run.qd[-1]]) / self.scale

    def noise(self, at: Place, end: _End, span: float, steps: int, there: Vector) -> float:
        """Return how far rounding moves the final state of a run, divided by the scale.

        Runs start at states that differ from that of `at` by one rounding error. The result is the
        largest change of the final state, and at least one rounding error.

        Parameters
        ----------
        at : Place
            The initial state of the run.
        end : callable
            Returns the scaled final state of a run of `steps` steps over `span` seconds.
        span : float
            Duration of the run, s.
        steps : int
            Number of steps.
        there : (2, nq) array
            The scaled final state of the run from `at`.
        """
        s = at.state
        size = np.abs(np.array([s.q, s.qd])) + np.abs(there) * self.scale
        least = EPS * float(np.max(size / self.scale))
        random = np.random.default_rng(steps)
        for _ in range(2):
            by = random.choice([-EPS, EPS], size.shape) * size
            near = end(replace(s, q=s.q + by[0], qd=s.qd + by[1]), span=span, steps=steps)
            if near is not None:
                least = max(least, float(np.max(np.abs(near - there))))
        return least

    # --- orders -----------------------------------------------------------------------------------

    def order(self, method: str) -> Measurement:
        """Return the observed order of convergence of `method`: the best over the initial states.

        The value is inf if all differences are rounding errors, and nan, with a reason, if the
        order can't be judged. Raises RuntimeError if from one of the initial states no run reaches
        its end.
        """
        least = min(METHODS[method].order, MAX_OBSERVABLE_ORDER) - ORDER_MARGIN
        orders = []
        for at in self.places:
            orders.append(self._order(at, method, least))
            if math.isfinite(orders[-1]) and orders[-1] >= least:
                break  # a wrong stepper has a low order at every state
        return _pick_order(orders, max, "too few halvings between rounding and a hundredth")

    def _order(self, at: Place, method: str, least: float) -> float:
        """Return the best order over a few spans; else over longer and longer spans.

        These begin with the shortest that shows a difference. A low order counts if two successive
        spans agree on it: over longer ones, any method may have order 1, where steps leap over a
        kink of the forces.
        """
        ladders: dict[int, _Ladder | None] = {}
        end = partial(self.end, method=method)

        def ladder(power: int) -> _Ladder | None:
            if power not in ladders:
                ladders[power] = self._ladder(at, end, 48 * self.h * 2.0**power)
            return ladders[power]

        for power in (0, -1, 1, -2, 2):  # log2 of spans over 48 h
            if (one := ladder(power)) and not math.isnan(best := one.best(least)):
                return best
        low = next((k for k in START_POWERS if (one := ladder(k)) and one.exact), START_POWERS[-1])
        before, moved, nonsmooth = math.nan, False, False
        for power in range(low, 9):  # spans up to 2^8 times 48 h
            if not (one := ladder(power)):
                continue
            if not math.isnan(best := one.best(least)):
                return best
            if abs(one.agreed_order - before) <= ORDER_TOLERANCE:  # False for nan
                nonsmooth = nonsmooth or self._has_kink(at, method, one.span)
                if not nonsmooth:  # if it is, so are longer spans
                    return one.agreed_order
            before, moved = one.agreed_order, moved or not one.exact
        if not any(ladders.values()):
            raise RuntimeError(f"no run by {method} gets to its end")
        return math.nan if moved else math.inf

    def _has_kink(self, at: Place, method: str, span: float) -> bool:
        """Return whether another method has a low order over the span too: it contains a kink.

        RK4 on the module's accelerations is one, beside those that the module has.
        """
        others: list[tuple[str, _End]] = [
            (m, partial(self.end, method=m)) for m in self.methods if m != method
        ]
        if not getattr(self.module, "constraint_names", ()):
            others.append((RK4.name, self._end_by_hand))
        for name, end in others:
            least = min(METHODS[name].order, MAX_OBSERVABLE_ORDER) - ORDER_MARGIN
            one = self._ladder(at, end, span)
            if one and math.isnan(one.best(least)) and sum(clear for _, clear in one.orders) > 1:
                return True
        return False

    def _end_by_hand(self, s: State, span: float, steps: int) -> Vector | None:
        """Return the same as `end`, by RK4 in Python."""

        def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
            return self.module_value("acceleration", replace(s, q=q, qd=qd, t=t))

        x, h = np.array([s.q, s.qd]), span / steps
        with np.errstate(all="ignore"):
            for k in range(steps):
                x = one_step.step(RK4, acceleration, x[0], x[1], s.t + k * h, h)
        return x / self.scale if np.isfinite(x).all() else None

    def _ladder(self, at: Place, end: _End, span: float) -> _Ladder | None:
        ends = [end(at.state, span=span, steps=n) for n in COUNTS]
        known = [end for end in ends if end is not None]
        if ends[2] is None or any(e is None for e in ends[-len(known) :]):
            return None
        off = tuple(float(np.max(np.abs(b - a))) for a, b in pairwise(known))
        return _Ladder(span, off, self.noise(at, end, span, COUNTS[2], ends[2]))

    # --- two methods ------------------------------------------------------------------------------

    def compare_methods(self, method: str) -> Measurement:
        """Return how far final states by `method` differ from those by the module's first method.

        The unit is the sum of the changes of both final states when h is halved. For each initial
        state, runs of two durations are compared and the smaller result counts, since for one
        duration these changes may vanish by chance. The result is the median over the initial
        states.
        """
        ratios = [self._method_difference(at, method) for at in self.places]
        known = [x for x in ratios if not math.isnan(x)]
        if known:
            return Measurement(float(np.median(known)))
        return Measurement(math.nan, "no span is short enough for the two methods' steps")

    def _method_difference(self, at: Place, method: str) -> float:
        ratios: list[float] = []
        for power in range(0, -20, -2):
            span = 24 * self.h * 2.0**power
            ends = [
                self.end(at.state, name, span, n)
                for name in (self.methods[0], method)
                for n in (24, 48)
            ]
            if any(end is None for end in ends):
                continue
            one, two, far, other = (np.asarray(end) for end in ends)
            change = np.abs(two - one) + np.abs(other - far)
            if float(np.max(change)) > 1e-3:  # the methods have not converged
                continue
            noise = self.noise(at, partial(self.end, method=method), span, 48, other)
            ratios.append(
                float(np.max(np.abs(two - other)) / (np.max(change) + 2 * NOISE_FACTOR * noise))
            )
            if len(ratios) == 2 or ratios[-1] <= 1:
                break
        return min(ratios, default=math.nan)

    # --- power ------------------------------------------------------------------------------------

    @property
    def _best_method(self) -> str:
        """Return the method for power balances: rk4, or the one of the highest order."""
        names = self.methods
        return "rk4" if "rk4" in names else max(names, key=lambda name: METHODS[name].order)

    @property
    def closing_limit(self) -> float:
        """Least accepted order of the power balance: half the order of the method, at most 2."""
        return min(METHODS[self._best_method].order, 4) / 2

    def closing(self) -> Measurement:
        """Return the order in h at which the error of the power balance vanishes.

        The error is jacobi(T) - jacobi(0) - ∫ power dt over a run; jacobi is the Jacobi energy
        function. The smallest order over the initial states counts. It is inf if the error is
        rounding only.
        """
        orders = [self._closing(at) for at in self.places]
        return _pick_order(orders, min, "the balance is neither closed nor left open")

    def _closing(self, at: Place) -> float:
        """Return the order of the balance over spans of increasing length, until it has a residual.

        A residual that two halvings of h do not change, in two successive spans, means a wrong
        power (order 0), or rounding within formulas, which differs near the state.
        """
        rest, closed = 0.0, False
        for power in (-6, -4, -2, 0, 1, 3, 5, 7, 9, 11):  # log2 of spans over h
            gaps, exact = self._gaps(at, self.h * 2.0**power)
            if exact:
                closed, rest = True, 0.0
            if exact or len(gaps) < 3:
                continue
            a, b, c = gaps
            if abs(c - b) <= 0.1 * abs(c) and abs(b - a) <= 0.3 * abs(b):
                grows = rest and 1.2 < c / rest < 20  # with the span, or with its square
                if grows and self._gap_persists(at, self.h * 2.0**power, c):
                    return math.log2(abs(a / c)) / 2
                rest = c
                continue
            rest = 0.0
            order = math.log2(abs(a / c)) / 2 if a else math.nan
            if order >= self.closing_limit and abs(b) < abs(a):
                return order
        return math.inf if closed else math.nan

    def _gap_persists(self, at: Place, span: float, rest: float) -> bool:
        """Return whether the balance has the same residual near that state."""
        s = at.state
        # a change by 1e-3 hardly changes smooth functions, but it changes their rounding errors
        factors = (1 - 1e-3, 1 + 1e-3)
        near = (replace(at, state=replace(s, q=s.q * k, qd=s.qd * k)) for k in factors)
        gaps = [self._gaps(x, span)[0][-1:] for x in near]
        return all(x and abs(x[0] - rest) <= 0.1 * abs(rest) for x in gaps)

    def _gaps(self, at: Place, span: float) -> tuple[list[float], bool]:
        """Return the residual of the balance for 16, 32 and 64 steps, and whether one closes."""
        s, gaps = at.state, []
        for n in (16, 32, 64):
            run = self.run(s, self._best_method, h=span / n, steps=n)
            if str(run.status) != "ok":
                return [], False
            states = states_of_run(run, s)
            power = np.array([self.module_value("power", row) for row in states])
            simpson = np.array([1, *(4, 2) * (n // 2 - 1), 4, 1]) * span / n / 3
            after, before = (self.module_value("jacobi", states[i]) for i in (-1, 0))
            gaps.append(float(after - before - simpson @ power))
            names = ("kinetic_energy", "potential_energy")
            sizes = [np.abs(self.module_value(name, states[i])) for name in names for i in (0, -1)]
            energy = at.energy + float(simpson @ np.abs(power) + sum(sizes))
            if abs(gaps[-1]) <= 1e3 * EPS * energy:
                return gaps, True
        return (gaps if np.all(np.isfinite(gaps)) else []), False

    def module_value(self, name: str, s: State) -> Vector:
        """Return the module's value `name`, such as "power" or "jacobi", at the state `s`."""
        return evaluate_module(self.module, name, s)


def _pick_order(
    values: Iterable[float], pick: Callable[[Iterable[float]], float], why: str
) -> Measurement:
    """Return the order that `pick` selects from several places; inf if all are exact."""
    known = [x for x in values if not math.isnan(x)]
    orders = [x for x in known if math.isfinite(x)]
    if orders:
        return Measurement(pick(orders))
    return Measurement(math.inf) if known else Measurement(math.nan, why)


# --- advised step sizes ---------------------------------------------------------------------------

# Step sizes of the runs with which an advised h is compared, as multiples of that h. The advice is
# for the motion linearised at one state, and the motion leaves that state.
PARTS = (1 / 8, 1 / 4, 1 / 2, 1, 2)
UNSTABLE_GROWTH = 1e3  # growth of a difference, relative to that with fine steps: unstable
MAX_END_ERROR = 0.1  # relative to the motion: a run with longer steps than advised is wrong
# change of the initial state, relative to the motion; so small that it grows linearly with stiff
# forces too
SMALL_PERTURBATION = 1e-9
ZERO_TOLERANCE = 1e-9  # relative to the largest singular value: smaller ones are 0


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
        near = Measurement(ratio, unit=unit, limit=2) if ratio <= 2 else None
        if near and longest > self.duration:
            return near
        fine, grown = self._ends(method, longest, 1 / 64)
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
        steps = min(2000, math.ceil(self.duration / self.h))
        every = max(1, steps * max(1, len(start.q) // 8) // 256)  # at most 256 states
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
        one, other = (self.runs.module_value("acceleration", x) for x in (s, at_rest))
        return not np.array_equal(one, other)

    def _warns(self, method: str, s: State, h: float) -> bool:
        """True if the module advises against h at a state."""
        message = self.runs.module.advice(s.q, s.qd, h, params=s.params, method=method, t0=s.t)
        return message is not None

    def _ends(self, method: str, longest: float, part: float) -> tuple[Vector, float]:
        """Return the scaled final state of a run over 8 times `longest` seconds, and the growth.

        The growth is the larger of that of a small difference of the initial state and of a tiny
        one, for which stiff forces, which are soon at their bounds, are linear.
        """
        s = self.stiffest_state
        signs = np.random.default_rng(1).choice([-1.0, 1.0], self.scale.shape)
        # near singular positions, a state off the constraints may have no projection
        directions = self._constrained_directions(s)
        signs = (directions @ (directions.T @ signs.ravel())).reshape(signs.shape)
        steps, ends = round(8 / part), []
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
                    self.runs.module_value("acceleration", replace(s, q=moved[0], qd=moved[1]))
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
                for by in (1e-5, -1e-5)
            )
            rates[:, k] = (next(ends) - next(ends)) / 2e-5
        follow = -np.linalg.pinv(A * fast, rcond=ZERO_TOLERANCE) @ rates
        whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
        return np.asarray(np.linalg.qr(whole)[0])


def _null_space(A: Vector) -> Vector:
    """Return an orthonormal basis of the null space of A, (n, k)."""
    _, sizes, rows = np.linalg.svd(A)
    return np.asarray(rows[np.sum(sizes > ZERO_TOLERANCE * np.max(sizes, initial=0)) :].T)
