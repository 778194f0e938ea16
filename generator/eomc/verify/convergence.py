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
- A step size that the module advises is compared with the eigenvalues of the linearised motion,
  from differences of the accelerations. Stability limits of methods are tested with their tableaux.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from eomc.integrators.tableaux import METHODS, RK4
from eomc.runtime import rank
from eomc.verify import reference
from eomc.verify.comparison import Check, Comparison, Measurement
from eomc.verify.reference import Vector, differences
from eomc.verify.sampling import EPS, Expected, State, states_of_run

NOISE_FACTOR = 30.0  # differences above this multiple of rounding errors are due to the method
ORDER_TOLERANCE = 0.3  # orders that differ by less are the same
COUNTS = (6, 12, 24, 48, 96)  # numbers of steps over one time span
# log2 of spans over 48 h, down to where all differences are rounding error
START_POWERS = (-2, -4, -7, -10, -14, -20)


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of orders, of the power balance and of advised step sizes.

    There are none in single precision, in which differences have too few digits.
    """
    if comparison.dtype != np.float64:
        return
    runs = Convergence(comparison)
    excuse = f" not expected with {comparison.corners}" if comparison.corners else ""

    def order_check(
        name: str, measure: Callable[[], float | Measurement], least: float, unit: str
    ) -> Check:
        return Check(
            name, lambda *_: measure(), tolerance=least, states=(None,), unit=unit, minimum=True,
            excuse=excuse and unit + excuse,
        )  # fmt: skip

    for method in comparison.methods:
        measure = partial(runs.order, method)
        yield order_check(f"order of {method}", measure, least_order(method), "observed order")
    unit = "observed order"
    yield order_check("power balance", runs.closing, runs.closing_limit, unit)
    yield from advice_checks(comparison)


def advice_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of the step sizes h that the module advises, for each method.

    They are compared with the step sizes that follow from the eigenvalues of the linearised motion.
    Under constraints only the initial state counts: far from it, what is linearised differs.
    """
    corners = comparison.corners
    states = comparison.expected[:1] if comparison.system.constraints else comparison.few(4)
    for method in comparison.methods:
        if math.isfinite(min(METHODS[method].limits)):
            yield Check(
                f"h of {method}", partial(step_size_ratio, method), tolerance=2,
                states=states, unit="times the h of the eigenvalues",
                excuse=f"not applicable with {corners}" if corners else "",
            )  # fmt: skip


def least_order(method: str) -> float:
    """Return the least accepted order of a method: half an order less than its own, at most 8.

    With higher orders, two halvings of h lead from 1e-2 to rounding.
    """
    return min(METHODS[method].order, 8) - 0.5


class _End(Protocol):
    """Scaled final states (2, nq) of runs from a state; None if a run stops early."""

    def __call__(self, s: State, *, span: float, steps: int) -> Vector | None: ...


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

    places: initial states of the runs, with the scene's own parameters.
    """

    def __init__(self, of: Comparison) -> None:
        self.of, self.module, self.methods = of, of.module, of.methods
        self.scale, self.h, self.duration = (
            of.sampler.scale,
            of.system.run.h,
            of.system.run.duration,
        )
        own = [e for e in of.expected if e.state.params is None]
        typical = own[1:4] or of.expected[:3]  # away from the start
        self.places = [
            replace(e, state=replace(e.state, t=of.start_time(e.state))) for e in typical
        ]

    def end(self, s: State, method: str, span: float, steps: int) -> Vector | None:
        """Return the final state of a run by `method` from `s`, divided by the scale, (2, nq).

        The run has `steps` steps over `span` seconds. The scale consists of typical sizes of q and
        q̇. The result is None if the run stops early.
        """
        run = self.of.simulate(s, method, h=span / steps, steps=steps, every=steps)
        if str(run.status) != "ok":
            return None
        return np.asarray(np.array([run.q[-1], run.qd[-1]]) / self.scale)

    def noise(self, at: Expected, end: _End, span: float, steps: int, there: Vector) -> float:
        """Return how far rounding moves the final state of a run, divided by the scale.

        Runs start at states that differ from that of `at` by one rounding error. The result is the
        largest change of the final state, and at least one rounding error.

        Parameters
        ----------
        at : Expected
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

    def order(self, method: str) -> float | Measurement:
        """Return the observed order of convergence of `method`: the best over the initial states.

        The value is inf if all differences are rounding errors, and nan, with a reason, if the
        order can't be judged. Raises RuntimeError if from one of the initial states no run reaches
        its end.
        """
        least = least_order(method)
        orders = []
        for at in self.places:
            orders.append(self._order(at, method, least))
            if math.isfinite(orders[-1]) and orders[-1] >= least:
                break  # a wrong stepper has a low order at every state
        return _pick_order(orders, max, "too few halvings between rounding and a hundredth")

    def _order(self, at: Expected, method: str, least: float) -> float:
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

    def _has_kink(self, at: Expected, method: str, span: float) -> bool:
        """Return whether another method has a low order over the span too: it contains a kink.

        RK4 on the module's accelerations is one, beside those that the module has.
        """
        others: list[tuple[str, _End]] = [
            (m, partial(self.end, method=m)) for m in self.methods if m != method
        ]
        if not self.of.system.constraints:
            others.append((RK4.name, self._end_by_hand))
        for name, end in others:
            least = least_order(name)
            one = self._ladder(at, end, span)
            if one and math.isnan(one.best(least)) and sum(clear for _, clear in one.orders) > 1:
                return True
        return False

    def _end_by_hand(self, s: State, span: float, steps: int) -> Vector | None:
        """Return the same as `end`, by RK4 in Python."""

        def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
            return self.of.module_value("acceleration", replace(s, q=q, qd=qd, t=t))

        x, h = np.array([s.q, s.qd]), span / steps
        with np.errstate(all="ignore"):
            for k in range(steps):
                x = reference.runge_kutta_step(RK4, acceleration, x[0], x[1], s.t + k * h, h)
        return x / self.scale if np.isfinite(x).all() else None

    def _ladder(self, at: Expected, end: _End, span: float) -> _Ladder | None:
        ends = [end(at.state, span=span, steps=n) for n in COUNTS]
        known = [end for end in ends if end is not None]
        if ends[2] is None or any(e is None for e in ends[-len(known) :]):
            return None
        off = tuple(float(np.max(np.abs(b - a))) for a, b in pairwise(known))
        return _Ladder(span, off, self.noise(at, end, span, COUNTS[2], ends[2]))

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

    def closing(self) -> float | Measurement:
        """Return the order in h at which the error of the power balance vanishes.

        The error is jacobi(T) - jacobi(0) - ∫ power dt over a run; jacobi is the Jacobi energy
        function. The smallest order over the initial states counts. It is inf if the error is
        rounding only.
        """
        orders = [self._closing(at) for at in self.places]
        return _pick_order(orders, min, "the balance is neither closed nor left open")

    def _closing(self, at: Expected) -> float:
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

    def _gap_persists(self, at: Expected, span: float, rest: float) -> bool:
        """Return whether the balance has the same residual near that state."""
        s = at.state
        # a change by 1e-3 hardly changes smooth functions, but it changes their rounding errors
        factors = (1 - 1e-3, 1 + 1e-3)
        near = (replace(at, state=replace(s, q=s.q * k, qd=s.qd * k)) for k in factors)
        gaps = [self._gaps(x, span)[0][-1:] for x in near]
        return all(x and abs(x[0] - rest) <= 0.1 * abs(rest) for x in gaps)

    def _gaps(self, at: Expected, span: float) -> tuple[list[float], bool]:
        """Return the residual of the balance for 16, 32 and 64 steps, and whether one closes."""
        s, gaps = at.state, []
        for n in (16, 32, 64):
            run = self.of.simulate(s, self._best_method, h=span / n, steps=n)
            if str(run.status) != "ok":
                return [], False
            states = states_of_run(run, s)
            power = np.array([self.of.module_value("power", row) for row in states])
            simpson = np.array([1, *(4, 2) * (n // 2 - 1), 4, 1]) * span / n / 3
            after, before = (self.of.module_value("jacobi", states[i]) for i in (-1, 0))
            gaps.append(float(after - before - simpson @ power))
            names = ("kinetic_energy", "potential_energy")
            sizes = [
                np.abs(self.of.module_value(name, states[i])) for name in names for i in (0, -1)
            ]
            energy = float(at.size["jacobi"]) + float(simpson @ np.abs(power) + sum(sizes))
            if abs(gaps[-1]) <= 1e3 * EPS * energy:
                return gaps, True
        return (gaps if np.all(np.isfinite(gaps)) else []), False


def _pick_order(
    values: Iterable[float], pick: Callable[[Iterable[float]], float], why: str
) -> float | Measurement:
    """Return the order that `pick` selects from several places; inf if all are exact."""
    known = [x for x in values if not math.isnan(x)]
    orders = [x for x in known if math.isfinite(x)]
    if orders:
        return pick(orders)
    exact = "every run is exact up to rounding"
    return Measurement(math.inf, exact) if known else Measurement(math.nan, why)


# --- advised step sizes ---------------------------------------------------------------------------

DIFFERENCE_WIDTH = 3e-7  # of differences, relative to the scale: stiff forces are linear there


def step_size_ratio(method: str, of: Comparison, e: Expected) -> float | Measurement:
    """Return the advised h over that of the linearised motion, or the inverse if it is larger.

    The advised h is the longest without a warning of the module at the state of `e`. Both are at
    most a thousand times the duration of the scene. There is nothing to compare without a warning,
    and for Euler's method if accelerations depend on velocities.
    """
    s, most = e.state, 1e3 * of.system.run.duration
    at_rest = replace(s, qd=0 * s.qd)
    own, other = (of.module_value("acceleration", x) for x in (s, at_rest))
    if method == "euler" and not np.array_equal(own, other):
        return Measurement(math.inf, "the method is for forces that depend on positions alone")
    advised = _longest_advised(of.module, method, s, most)
    if advised == most:
        return Measurement(math.inf, "nothing limits h")
    stable = min(most, _longest_stable(of, method, s))
    return max(advised / stable, stable / advised)


def _longest_advised(module: Any, method: str, s: State, most: float) -> float:
    """Return the longest h without a warning of the module, to 5 %, or `most`."""

    def is_advised(h: float) -> bool:
        how = {"u": s.u, "params": s.params, "method": method, "t0": s.t}
        return module.advice(s.q, s.qd, h, **how) is None

    low = most
    while not is_advised(low):
        low /= 2
    high = min(most, 2 * low)
    while high > 1.05 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_advised(middle) else (low, middle)
    return low


def _longest_stable(of: Comparison, method: str, s: State) -> float:
    """Return the longest stable h, s, of the motion linearised at a state, by differences.

    Under constraints the longer of two steps counts: along the constraints, since each step is
    corrected onto them, though they turn with the motion; and along all directions.
    """
    candidates = [_constrained_directions(of, s)]
    if of.system.constraints:
        candidates.append(np.eye(2 * len(s.q)))
    return max(_eigenvalue_limit(of, method, s, directions) for directions in candidates)


def _eigenvalue_limit(of: Comparison, method: str, s: State, directions: Vector) -> float:
    """Return the longest stable h, s, for changes of [q; q̇] in the span of `directions`."""
    x, scale = np.array([s.q, s.qd]), of.sampler.scale

    def rates(rows: Vector) -> list[Vector]:
        states = x + (rows @ directions.T).reshape(-1, *x.shape) * scale
        return [
            np.array([qd, of.module_value("acceleration", replace(s, q=q, qd=qd))]) / scale
            for q, qd in states
        ]

    zeros = np.zeros(directions.shape[1])
    try:
        slopes = differences(rates, zeros, zeros + DIFFERENCE_WIDTH)
    except ArithmeticError:  # off the constraints there may be none
        return 0.0
    values = np.linalg.eigvals(directions.T @ slopes)
    turning, decay = METHODS[method].limits
    fastest = max(np.max(np.abs(values.imag)) / turning, np.max(-values.real) / decay)
    return 1 / float(fastest) if fastest > 0 else math.inf


def _constrained_directions(of: Comparison, s: State) -> Vector:
    """Return directions of [q; q̇] tangent to the constraints in units of the scale, (2 nq, k).

    The columns are orthonormal. Velocities change with positions so that rates of constraints
    stay zero.
    """
    n, (far, fast) = len(s.q), of.sampler.scale
    if not of.system.constraints:
        return np.eye(2 * n)
    A = of.module_value("constraint_jacobian", s)
    holonomic = [c.holonomic for c in of.system.constraints]
    of_q, of_qd = rank.null_space(A[holonomic] * far), rank.null_space(A * fast)

    def rates(rows: Vector) -> list[Vector]:
        states = s.q + (rows @ of_q.T) * far
        return [of.module_value("constraint_rates", replace(s, q=q)) for q in states]

    slopes = differences(rates, zeros := np.zeros(len(of_q.T)), zeros + 1e-5)
    follow = -np.linalg.pinv(A * fast, rcond=rank.tolerance()) @ slopes
    whole = np.block([[of_q, np.zeros((n, of_qd.shape[1]))], [follow, of_qd]])
    return np.asarray(np.linalg.qr(whole)[0])
