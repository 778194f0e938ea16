"""Comparison of a compiled module with the reference and with general laws of mechanics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.model.nonsmooth import nonsmooth_functions
from eomc.model.system import System
from eomc.verify import one_step
from eomc.verify.convergence import (
    MAX_OBSERVABLE_ORDER,
    ORDER_MARGIN,
    PARTS,
    Advice,
    Convergence,
    Place,
)
from eomc.verify.reference import Vector
from eomc.verify.report import CheckResult, Measurement, largest, units
from eomc.verify.sampling import (
    EPS,
    LARGE,
    MAX_DISTANCE,
    NUDGE,
    SMALL,
    Expected,
    Sampler,
    State,
    evaluate_module,
    projected_start,
    simulate,
    states_of_run,
)
from eomc.verify.symbolic import reference_for
from eomc.verify.taylor import TaylorReference

GROWTH_LIMIT = 1e4  # a run is compared until an initial difference has grown by this factor
LONG_STEP = 16.0  # a long step, as a multiple of the scene's h
# fractions of a step that are tried until the iteration for its stages converges
STEP_FRACTIONS = tuple(4.0**-k for k in range(7))


def _corrected(e: Expected) -> Vector | float:
    """Return the effect of rounding in constraints on a projected state, (2, nq), or 0."""
    return e.size.get("place", 0.0)


class Comparison:
    """Comparison of one module with the reference: states, expected values, results of checks.

    The reference is the independent evaluation of the equations in Python.

    Parameters
    ----------
    system : System
        The system of which `module` is the compiled form.
    module : module
        The compiled module; an object with the same functions will do.
    random : Generator
        Source of the random states.
    states : int or None
        Number of states; None for the default, which depends on the cost of the reference.
    plain : module, optional
        The module of the portable form of the C code.
    """

    def __init__(
        self, system: System, module: Any, random: np.random.Generator, states: int | None,
        plain: Any = None,
    ) -> None:  # fmt: skip
        self.system, self.module, self.plain = system, module, plain
        self.dtype = np.dtype(getattr(module, "dtype", "float64"))
        self.eps = float(np.finfo(self.dtype).eps)
        self.methods: tuple[str, ...] = getattr(module, "methods", ("rk4",))
        self.reference = reference_for(system)
        self.large = isinstance(self.reference, TaylorReference)
        self.effort = LARGE if self.large else SMALL
        self.sampler = Sampler(self.reference, random, self.effort)
        self.expected = self.sampler.states(self.effort.states if states is None else states)
        self.results: list[CheckResult] = []
        self.reference_runs: dict[
            tuple[int, float, int], tuple[Vector, Vector, Vector, Vector]
        ] = {}

    def add_convergence_checks(self) -> None:
        """Check convergence orders, advised step sizes and the power balance; add the results.

        `convergence.Convergence` and `convergence.Advice` measure them.
        """
        runs, methods = self.convergence, self.methods
        for method in methods:
            least = min(METHODS[method].order, MAX_OBSERVABLE_ORDER) - ORDER_MARGIN
            find = partial(runs.order, method)
            self.add_smooth_check(f"order of {method}", least, "order observed", find)
        for method in methods[1:]:
            unit = "of the two methods' own errors"
            self.add_check(
                f"{method} beside {methods[0]}", 2, unit, partial(runs.compare_methods, method)
            )
        unit = "order at which it closes"
        self.add_smooth_check("power balance", runs.closing_limit, unit, runs.closing)
        for method in methods:
            if math.isfinite(min(METHODS[method].limits)):
                self.add_advice_check(method)

    def add_check(
        self, name: str, limit: float, unit: str, measure: Callable[[], float | Measurement],
        minimum: bool = False,
    ) -> None:  # fmt: skip
        """Measure a number and append the result of the check, one line of the report.

        name: what is checked. limit: largest permitted number; with `minimum`, the number must
        exceed it. unit: description of the number. measure: function that returns the number.

        The check fails if `measure` raises an exception. If `measure` returns a Measurement, this
        may replace unit and limit, or give a reason why nothing is judged; in the latter case the
        check passes.
        """
        try:
            result = measure()
        except Exception as fault:  # an exception of the module is a result of the check
            self.results.append(
                CheckResult(name, math.nan, limit, False, f"{type(fault).__name__}: {fault}")
            )
            return
        error, why = (result.value, result.why) if isinstance(result, Measurement) else (result, "")
        if isinstance(result, Measurement) and result.unit:
            passed = error <= result.limit
            self.results.append(CheckResult(name, error, result.limit, passed, result.unit))
            return
        if why:
            idle = math.isinf(error)
            unit = ("no limit to test: " if idle else "not judged: ") + why
            self.results.append(CheckResult(name, error, limit, True, unit, judged=idle))
            return
        self.results.append(
            CheckResult(name, error, limit, error > limit if minimum else error <= limit, unit)
        )

    def add_smooth_check(
        self, name: str, limit: float, unit: str, measure: Callable[[], Measurement]
    ) -> None:
        """Check a measured order of convergence, which must exceed `limit`; add the result.

        The arguments are those of `add_check`. If the order is too low and the scene has
        discontinuities or kinks, which reduce it, the check is not judged.
        """
        self.add_check(name, limit, unit, measure, minimum=True)
        row = self.results[-1]
        if math.isinf(row.error):
            self.results[-1] = replace(row, unit=unit + ": exact, no error to measure")
        elif not row.passed and self.corners and not math.isnan(row.error):
            note = f"not judged: {unit} not to be expected with {self.corners}"
            self.results[-1] = replace(row, passed=True, unit=note, judged=False)

    def add_advice_check(self, method: str) -> None:
        """Check the step size h that the module advises for `method`; add the result.

        The check passes if runs with an eighth of the advised h are stable and runs with twice that
        h are unstable.
        """
        unit = "of the advised h, where runs are lost"
        find = partial(self.advice.failing_fraction, method)
        self.add_check(f"h of {method}", PARTS[0], unit, find, minimum=True)
        row = self.results[-1]
        if not row.passed and self.corners:
            note = f"not judged: no matter with {self.corners}"
            self.results[-1] = replace(row, passed=True, unit=note, judged=False)

    @cached_property
    def advice(self) -> Advice:
        """Checks of the step sizes that the module advises."""
        return Advice(self.convergence, [c.holonomic for c in self.system.constraints])

    @cached_property
    def convergence(self) -> Convergence:
        """Checks that use runs with several step sizes."""
        own = [e for e in self.expected if e.state.params is None]
        typical = own[1:4] or self.expected[:3]  # the scene's own parameters, away from its start
        return Convergence(
            self.module,
            self.methods,
            [
                Place(replace(e.state, t=self.start_time(e.state)), float(e.size["jacobi"]))
                for e in typical
            ],
            self.expected[0].state,
            self.sampler.scale,
            self.system.run.h,
            self.system.run.duration,
        )

    @cached_property
    def unusual_states(self) -> list[Expected]:
        """Reference values at states that runs hardly reach.

        The module must give correct values at these states as well.
        """
        return self.sampler.unusual_states(1 if self.large else 2)

    @cached_property
    def corners(self) -> str:
        """Names of functions with discontinuities or kinks in the scene, as text for a message.

        The text is "" if there are none.
        """
        return nonsmooth_functions(self.system)

    @property
    def forms(self) -> list[tuple[Any, str]]:
        """Pairs of a module and a prefix of the names of its checks.

        The first pair is the module of the optimised C code with the prefix "". The second is that
        of the portable C code, if there is one, with the prefix "plain C: ".
        """
        plain = [] if self.plain is None else [(self.plain, "plain C: ")]
        return [(self.module, ""), *plain]

    def largest(self, error: Callable[[Expected], float], few: int | None = None) -> float:
        """Return the largest error over all states; nan if one of the errors is nan.

        error: function of a state with its reference values. few: number of states to use, the
        first and the last ones; None for all.
        """
        return float(np.max([error(e) for e in (self.few(few) if few else self.expected)]))

    # comparison with the reference

    def metadata_differences(self) -> float:
        """Return how many names, defaults and initial values differ between module and system."""
        s, m, start = self.system, self.module, self.sampler.start
        pairs = [
            (tuple(m.coordinates), tuple(c.name for c in s.coordinates)),
            (tuple(m.parameters), tuple(p.name for p in s.parameters)),
            (tuple(m.inputs), tuple(i.name for i in s.inputs)),
            (dict(m.defaults), self.sampler.defaults),
            *(
                (np.asarray(a).tolist(), b.astype(self.dtype).tolist())
                for a, b in zip(m.start, (start.q, start.qd), strict=True)
            ),
        ]
        return float(sum(theirs != ours for theirs, ours in pairs))

    def value_error(self, name: str) -> float:
        """Return the largest error of one of the module's values over all states, in roundings.

        name: "acceleration" or a key of VALUES, such as "D" or "energy".
        """
        # energies relative to their typical size, since k - k cos(q) may be 0 at a state
        typical = np.median([e.size[name] for e in self.expected]) if "energy" in name else 0.0

        def error(e: Expected) -> float:
            size = np.maximum(e.size[name], typical)
            return self.units(evaluate_module(self.module, name, e.state), e.value[name], size)

        return float(np.max([error(e) for e in (*self.expected, *self.unusual_states)]))

    def rk4_step_error(self) -> float | Measurement:
        """Return the largest error of one RK4 step with the scene's h, in units of rounding.

        Steps from a few of the states are compared with the reference's steps.
        """
        h, far = self.system.run.h, MAX_DISTANCE * self.sampler.scale

        def reference(**rows: Any) -> Vector:
            return np.stack(self.reference.step(h=h, **rows), axis=1)

        def error(e: Expected) -> float | None:
            s = e.state
            with np.errstate(all="ignore"):
                expected, size = self.sampler.value_and_size(reference, s)
            if not np.all(np.abs(expected - [s.q, s.qd]) < far):
                return None
            step = self.module.step(s.q, s.qd, h=h, t=s.t, u=s.u, params=s.params)
            gain = h * e.size["acceleration"]
            size = size + np.array([h * (np.abs(s.qd) + gain), gain]) + _corrected(e)
            return self.units(step, expected, size)

        return largest(map(error, self.few(self.effort.few)), "all steps are thrown far")

    def step_error(self, method: str) -> float | Measurement:
        """Return the largest error of one step of `method` over a few states, in units of rounding.

        The expected step applies the method's Runge-Kutta tableau to the reference's accelerations.
        Two step sizes are used: the scene's h, and LONG_STEP times that h, with which terms of high
        order in h exceed rounding. A step is shortened if the iteration for the stages of an
        implicit method does not converge.
        """
        errors = (
            self.step_error_from(method, e, h)
            for e in self.few(self.effort.few)
            for h in (self.system.run.h, LONG_STEP * self.system.run.h)
        )
        return largest(errors, "no step from any state is finite")

    def accelerations(self, s: State) -> one_step.Acceleration:
        """Return a function of q, qd and t that computes the reference's accelerations.

        Inputs and parameters are those of `s`. q, qd and the result have the shape (nq,), or (n,
        nq) for n states.
        """

        def acceleration(q: Vector, qd: Vector, t: Vector) -> Vector:
            inputs = None if s.u is None else np.broadcast_to(s.u, (*q.shape[:-1], len(s.u)))
            return self.reference.acceleration(q, qd, t, inputs, s.params)

        return acceleration

    def step_error_from(self, method: str, e: Expected, longest: float) -> float | None:
        """Return the error of one step of the module by `method`, in units of rounding.

        e: the state at which the step begins. longest: the largest step size to be tried, s. Its
        multiples STEP_FRACTIONS are tried in turn until the reference's step stays near the state
        and the module's step succeeds.

        The result is None if there is no such step. It is inf if the module's stages do not
        converge for two step sizes, or if the module refuses the shortest step.
        """
        s, gain, failures, refused = e.state, e.size["acceleration"], 0, False
        for h in (part * longest for part in STEP_FRACTIONS):
            refused = False

            def reference(
                q: Vector, qd: Vector, t: Vector, h: float = h, **arguments: Any
            ) -> Vector:
                def acceleration(q: Vector, qd: Vector, t: Vector) -> Vector:
                    return self.reference.acceleration(q, qd, t, **arguments)

                ends = one_step.step(METHODS[method], acceleration, q, qd, t, h)
                if self.system.constraints:
                    params = arguments.get("params")
                    q, qd = ends
                    ends = np.array(self.reference.corrected(q, qd, t + h, params))
                return np.moveaxis(ends, 0, 1)

            with np.errstate(all="ignore"):
                expected, size = self.sampler.value_and_size(reference, s)
            most = self.sampler.scale * (1 if h > self.system.run.h else MAX_DISTANCE)
            if not np.all(np.abs(expected - [s.q, s.qd]) < most):
                continue
            run = self.simulate(s, method=method, h=h, steps=1, t0=s.t)
            if run.status == "ok":
                size = size + np.array([h * (np.abs(s.qd) + h * gain), h * gain]) + _corrected(e)
                if METHODS[method].newton:  # rounding of q limits the accuracy of stages
                    size[1] += np.abs(s.q) / h
                return self.units([run.q[-1], run.qd[-1]], expected, size)
            refused, failures = True, failures + (run.status == "no convergence")
            if failures == 2:
                break
        return math.inf if failures == 2 or refused else None

    def run_error(self) -> float | Measurement:
        """Return the largest error of two short runs, in units of rounding.

        One run starts at the initial state of the scene, the other at a random state.
        """
        errors = map(self.run_error_from, self.few(2))
        return largest(errors, "a difference grows too much in one step")

    def run_error_from(self, e: Expected, h: float = 0.0, steps: int = 0) -> float | None:
        """Return the error of a run from the state of `e`, in units of rounding.

        The run has `steps` steps of `h` seconds; 0 stands for a default number and for the scene's
        h. The run is compared with the reference's run as long as a small difference of the initial
        state grows by less than GROWTH_LIMIT. The result is None if that is less than one step. The
        unit of rounding grows with this growth and with the number of steps.
        """
        s, h = e.state, h or self.system.run.h
        steps = steps or min(self.effort.run, max(1, round(self.system.run.duration / h)))
        key = id(s), h, steps  # the states live as long as `self`
        if key not in self.reference_runs:
            self.reference_runs[key] = self._reference_run(s, h, steps)
        t, x, growth, rounded = self.reference_runs[key]
        if len(t) < 2:
            return None
        kick = h * e.size["acceleration"]  # its rounding error changes the state after a step
        moved = np.array([self.sampler.spread + h * kick, self.sampler.speed + kick])
        run = self.simulate(s, h=h, steps=len(t) - 1)
        size = growth * moved + np.abs(x) + _corrected(e) + rounded
        size = np.arange(1, len(t) + 1)[:, None, None] * size
        if str(getattr(run.status, "value", run.status)) != "ok":
            raise RuntimeError(f"the run ended with status {run.status}")
        off_time = self.units(run.t, t, np.abs(t) + h)
        return float(np.max([off_time, self.units(np.stack([run.q, run.qd], axis=1), x, size)]))

    def _reference_run(
        self, s: State, h: float, steps: int
    ) -> tuple[Vector, Vector, Vector, Vector]:
        """Return the reference's run while it is certain: t (n,), states, growth, rounding errors.

        The states are (n, 2, nq). growth (n, 1, 1): of a small difference of the initial state. The
        rounding errors, (n, 2, nq), are in units of eps.
        """
        own = self.system.run.h
        spread = self.sampler.scale

        # alternating signs excite fast modes, as rounding errors do
        by = NUDGE * spread * (np.where(np.arange(len(s.q)) % 2, -1, 1) if h > own else 1)
        q, qd = self.sampler.rounded(s, np.add(by, [s.q, s.qd]))
        u = None if s.u is None else np.array([s.u] * len(q))
        with np.errstate(all="ignore"):
            begin = self.start_time(s)
            t, *trajectories = self.reference.simulate(
                q, qd, h, steps, u=u, params=s.params, t0=begin
            )
            x, y, *near = np.moveaxis(np.stack(trajectories, axis=1), 2, 0)
            growth = np.max(np.abs(y - x) / spread, axis=(1, 2)) / NUDGE
            far = np.max(np.abs(x - x[:1]) / spread, axis=(1, 2))
            off = np.max([0 * x, *(np.abs(z - x) / EPS for z in near)], axis=0)
        growth = np.where(far < MAX_DISTANCE, growth, math.inf)  # the run diverges
        growth, off = (np.maximum.accumulate(each) for each in (growth, off))
        known = np.isfinite(off).all(axis=(1, 2))
        sure = int(np.sum(known & (growth < GROWTH_LIMIT)))  # False for nan
        return t[:sure], x[:sure], growth[:sure, None, None], off[:sure]

    def start_time(self, s: State) -> float:
        """Return the time at which runs from the state `s` start, in s.

        It is the state's own time if there are constraints, which may hold at that time only.
        Otherwise it is 0.
        """
        return s.t if self.system.constraints else 0.0

    def simulate(self, s: State, **how: Any) -> Any:
        """Return the module's run from the state `s`, as by its method `simulate`.

        how: further arguments of `simulate`, such as h and steps.
        """
        if begin := self.start_time(s):
            how.setdefault("t0", begin)
        return simulate(self.module, projected_start(self.module, s), **how)

    def run_energy_error(self) -> float:
        """Return the largest error of the energies stored in a run, in units of rounding.

        They are compared with the reference's energies at the states stored in the same run.
        """
        s = self.few(2)[-1].state
        run = self.simulate(s, steps=2)
        far = MAX_DISTANCE * self.sampler.scale
        errors = []
        for row, energy_of_run in zip(states_of_run(run, s), run.energy, strict=True):
            if np.all(np.abs(np.subtract([row.q, row.qd], [s.q, s.qd])) < far):
                energy, size = self.sampler.energy(row)
                errors += [self.units(energy_of_run, energy, size)] if np.isfinite(energy) else []
        return float(np.max(errors, initial=0))

    def module_value(self, name: str, s: State) -> Vector:
        """Return the value of the module's function `name`, such as "D", at the state `s`."""
        return evaluate_module(self.module, name, s)

    def has_finite_accelerations(self, s: State) -> bool:
        """Return whether the module's accelerations at `s` are finite, for single precision.

        In double precision the result is always True.
        """
        if self.dtype == np.float64:
            return True
        try:
            self.module_value("acceleration", s)
        except ArithmeticError:
            return False
        return True

    def few(self, count: int) -> list[Expected]:
        """Return `count` states with their reference values: the first and the last ones."""
        half = count // 2
        return self.expected[:half] + self.expected[half:][-half:]

    def units(self, values: Any, expected: Any, size: Any) -> float:
        """Return the largest error in units of rounding, |values - expected| / (eps size).

        eps is the relative rounding error of the module's numbers.
        """
        return units(values, expected, size, self.eps)

    # properties of the module alone

    def symmetry_error(self) -> float:
        """Return the largest difference of D and Dᵀ over all states, in units of rounding."""

        def error(e: Expected) -> float:
            D = evaluate_module(self.module, "D", e.state)
            return self.units(D, D.T, e.size["D"])

        return self.largest(error)

    def least_eigenvalue(self) -> float:
        """Return the least eigenvalue of D over all states, scaled to a unit diagonal.

        The scaled matrix is D_ij / sqrt(D_ii D_jj).
        """

        def least_eigenvalue(e: Expected) -> float:
            D = evaluate_module(self.module, "D", e.state)
            diagonal = np.diag(D)
            if np.any(diagonal <= 0):
                return float(np.min(diagonal))
            return float(np.linalg.eigvalsh(D / np.sqrt(np.outer(diagonal, diagonal)))[0])

        return -self.largest(lambda e: -least_eigenvalue(e))

    def skewness_error(self) -> float:
        """Return the largest entry of N + Nᵀ over all states, N = Ḋ - 2C + ∂D/∂t, relative to Ḋ.

        N must be skew-symmetric. Ḋ and ∂D/∂t are difference quotients of order 8 of the module's D,
        with steps of several widths. The width with the smallest result counts: if C is wrong, no
        width makes N + Nᵀ vanish.
        """
        stencil = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))

        def error(e: Expected) -> float:
            s = e.state
            rate = np.max(np.abs(s.qd) / self.sampler.spread) or 1.0
            C = evaluate_module(self.module, "C", s)

            def rate_of_D(qd: Vector, width: float) -> Vector:
                at = (
                    self.module_value("D", replace(s, q=s.q + k * width * qd, t=s.t + k * width))
                    for n, _ in stencil
                    for k in (n, -n)
                )
                return sum((w * (next(at) - next(at)) for _, w in stencil), 0 * C) / width

            def residual(width: float) -> float:
                A = rate_of_D(s.qd, width) + rate_of_D(0 * s.qd, width) - 2 * C
                return float(np.max(np.abs(A + A.T) / (rate * e.size["D"] + np.abs(C))))

            residuals = (residual(part / rate) for part in (0.03, 0.003, 3e-4, 3e-5))
            return min((x for x in residuals if not math.isnan(x)), default=math.nan)

        return self.largest(error)

    def bias_error(self) -> float:
        """Return the largest error of bias = C q̇ + g over all states, in units of rounding."""

        def error(e: Expected) -> float:
            bias, C, g = (
                evaluate_module(self.module, name, e.state) for name in ("bias", "C", "g")
            )
            return self.units(C @ e.state.qd + g, bias, e.size["bias"])

        return self.largest(error)

    def motion_error(self) -> float:
        """Return the largest residual of D q̈ + bias = τ over all states, in units of rounding.

        With constraints the right-hand side is τ + Aᵀλ.
        """

        def error(e: Expected) -> float:
            names = ("D", "acceleration", "bias", "tau")
            D, qdd, bias, tau = (evaluate_module(self.module, name, e.state) for name in names)
            if self.system.constraints:
                rows = ("multipliers", "constraint_jacobian")
                multipliers, A = (evaluate_module(self.module, name, e.state) for name in rows)
                tau = tau + multipliers @ A
            return self.units(D @ qdd + bias, tau, e.size["motion"])

        return self.largest(error)
