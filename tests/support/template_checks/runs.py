"""Checks of runs: long steps, runs in several calls, stored states, inputs by step, sines.

A run may take another way through the C code than one step from the start does: sines and cosines
are predicted while steps are short, Kahan remainders are kept, and a run in several calls continues
from its workspace. All ways give the same motion, most of them the same bits.

Near a multiple of a quarter turn, an error of 1e-17 in the reduction of an angle is lost in most
sums, but not in an entry of D or g that is one sine times something else. The reference shows which
entries these are: at neighbouring doubles they are proportional to the sine, and larger than the
rest of constants that cancel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import sympy

from eomc.integrators.tableaux import METHODS
from eomc.model.algebra import compile_function
from eomc.model.symbols import needed_definitions
from eomc.model.system import System, dot, t
from eomc.runtime.package import model_of
from eomc.verify.comparison import Check, Comparison, Measurement, largest
from eomc.verify.equations import differentiate
from eomc.verify.reference import Vector
from eomc.verify.runs import run_error, step_error
from eomc.verify.sampling import EPS, MAX_DISTANCE, NUDGE, Expected, State

# steps of a divided run; after a long step, the C code predicts angles again before that many steps
STEPS = 200
CUTS = (1, 2, 5, 38, 129, 130, 131, 177)  # steps after which a call ends
EVERY = 3  # no divisor of STEPS
# Largest move of a coordinate in a long step, relative to its range (half a turn for an angle): too
# far to predict the sine of an angle, and then too far to update it by a rotation.
LONG = (0.02, 0.2, 0.7)
SHORT = 2.0**-14  # rad in half a step: the C code predicts the sines of such angles
SHORT_LIMIT = 20.0  # units of rounding; wrong terms of predicted sines make hundreds
ROW_LIMIT = 20  # error of a row at a given time, in units of rounding; wrong times make 1e10
LONG_STEP_COUNT = 6  # number of long steps, or of steps with inputs of their own
TURNS = 2.0**22  # rad: beyond the range of the inlined sine
# numbers of steps in one step of the scene, for two runs that differ by rounding only; the second
# pair if the steps of the first are too long
FINE = ((1024, 8192), (8192, 65536))
ROUNDED = 8.0  # units of rounding: compensated sums lose 0 or 1, uncompensated ones about 40


def measured(
    name: str, limit: float, unit: str, measure: Callable[[], float | Measurement]
) -> Check:
    """Return a check of one number, which a function without arguments measures."""
    return Check(name, lambda *_: measure(), tolerance=limit, states=(None,), unit=unit)


@dataclass(frozen=True)
class RunResult:
    """Result of a run by the C function.

    rows: stored q and q̇, (2, n, nq); nan where the run ended before. steps: number of steps.
    status: 0, or the code of the error.
    """

    rows: Vector
    steps: int
    status: int

    def is_identical(self, other: RunResult) -> bool:
        """Return whether all bits of two results agree; nan equals nan."""
        return (
            self.steps == other.steps
            and self.status == other.status
            and np.array_equal(self.rows, other.rows, equal_nan=True)
        )


def parameters(model: Any, s: State) -> Vector:
    """Return the values of all parameters at a state, (np,), in the order of the module."""
    values = [(s.params or model.info.defaults)[name] for name in model.info.parameters]
    return np.array(values, model.info.dtype)


@dataclass(frozen=True)
class RunDivision:
    """Division of a run into several calls of the C function.

    Attributes
    ----------
    cuts : sequence of int
        Numbers of steps after which one call ends and the next one continues the run.
    moved : float
        Change of the first coordinate between two calls, relative to 1 + its size.
    fresh_memory : bool
        Whether each call gets a new workspace instead of that of the call before.
    """

    cuts: Sequence[int] = ()
    moved: float = 0.0
    fresh_memory: bool = False


UNDIVIDED = RunDivision()


def fixed_step_options(model: Any, method: str, t: float, h: float, every: int = 1) -> Any:
    """Return the C struct with the options of steps of equal size h, s, from time t, s."""
    options = model.c.ffi.new("run_options *", {"t0": t, "h": h, "every": every})
    if len(model.info.methods) > 1:
        options.method = model.info.methods.index(method)
    if model.info.events:
        options.ignores_events = True
    return options


def run_in_c(
    model: Any, method: str, s: State, h: float, steps: int, *, every: int = 1,
    division: RunDivision = UNDIVIDED,
) -> RunResult:  # fmt: skip
    """Return the result of a run from `s` by the compiled C function for `method`.

    Parameters
    ----------
    model : object
        The compiled module's model, which gives access to its C functions.
    s : State
        Initial state. Its u is (nu,), or (steps, nu) with a value for each step.
    h : float
        Step size, s.
    steps : int
        Number of steps of the whole run.
    every : int
        Only each `every`-th state is stored.
    division : RunDivision
        Division of the run into calls of the C function; by default, one call.
    """
    info, ffi, pointer = model.info, model.c.ffi, model.c.pointer
    q, qd = (np.array(x, info.dtype) for x in (s.q, s.qd))
    rows = np.full((2, 1 - -steps // every, info.nq), np.nan, info.dtype)
    u = None if s.u is None else np.array(s.u, info.dtype)
    stride = 0 if u is None or u.ndim == 1 else info.nu
    options, work = fixed_step_options(model, method, s.t, h, every), ffi.new("run_work *")
    completed_steps, status, p = 0, 0, parameters(model, s)
    for end in (*(c for c in division.cuts if c < steps), steps):
        if division.moved and completed_steps:
            work.x[0] += division.moved * (1 + abs(work.x[0]))  # also if it is large
        if division.fresh_memory and completed_steps:
            old, work = work, ffi.new("run_work *")
            work.x, work.output.steps, work.output.rows = old.x, old.output.steps, old.output.rows
        options.steps = end - completed_steps
        output = ffi.addressof(work, "output")
        code = model.c.lib.integrate(
            options, *((output, work) if division.cuts else (model.c.null, model.c.null)),
            pointer(q), pointer(qd), model.c.null, 1 + steps // every, pointer(u), stride,
            pointer(p), *model.integrator.no_events, model.c.null, pointer(rows[0]),
            pointer(rows[1]),
        )  # fmt: skip
        completed_steps, status = code >> 3, code & 7
        if status:
            break
    return RunResult(rows, completed_steps, status)


def _reads_time(system: System) -> bool:
    """Return whether a formula of a system depends explicitly on time."""
    parts = (
        system.kinetic, system.potential, system.dissipation, *system.forces,
        *(x for pair in system.applied for x in pair), *(i.signal for i in system.inputs),
        *(x for _, x in system.definitions), *(o.formula for o in system.outputs),
        *(c.formula for c in system.constraints),
    )  # fmt: skip
    return any(t in x.free_symbols for x in parts)


class RunChecks:
    """Checks of runs by fixed steps, made with the compiled C functions.

    starts: the scene's initial state and a random state, each with the values of the reference (the
    independent evaluation in Python). states: the same states without these values. turning: such
    states with velocities of several sizes.
    """

    def __init__(self, check: Comparison) -> None:
        self.check, self.model = check, model_of(check.module)
        self.h = check.system.run.h
        self.sampler, self.random = check.sampler, np.random.default_rng(7)
        self.starts = check.few(2)
        self.states = [e.state for e in self.starts]
        self.few = 3 if check.large else LONG_STEP_COUNT  # the reference is expensive
        # the accelerations limit a turning step at low speed, the velocities at high speed
        speeds = (0.1, 1.0, 4.0)
        faster = [
            self.sampler.project(replace(s, qd=k * s.qd)) for s in self.states for k in speeds
        ]
        self.turning = [
            e for s in faster if check.has_finite_accelerations(s) and (e := self._expected(s))
        ]

    def _expected(self, s: State) -> Expected | None:
        with np.errstate(all="ignore"):
            return self.sampler.expected(s)

    def checks(self) -> Iterator[Check]:
        """Yield the checks of runs."""
        of, rounding = self.check, "units of rounding"
        if of.methods[0] == "rk4":
            yield measured("long steps", self.limit, rounding, self.long_step_error)
            yield measured("short steps", SHORT_LIMIT, rounding, self.short_step_error)
        if np.any(self.sampler.angles):
            # wrong terms of sines make hundreds of units
            yield measured("sines around the circle", 20, rounding, self.sine_error)
        if np.any(self.sampler.angles) or _reads_time(of.system):
            unit = f"units, of angles of {TURNS:.3g}"
            yield measured("angles far out", self.limit, unit, self.far_angle_error)
        if self.model.info.nu and of.methods[0] == "rk4":
            yield measured("inputs row by row", self.limit, rounding, self.input_sequence_error)
        unit = "values with entries left"
        yield measured("every entry written", 0, unit, self.incomplete_functions)
        for method in of.methods:
            differences = partial(self.divided_run_differences, method)
            yield measured(f"{method} cut anywhere", 0, "runs with other bits", differences)
            find = partial(self.row_error, method)
            yield measured(f"{method} rows at times", ROW_LIMIT, rounding, find)
            if of.dtype == np.float64 and METHODS[method].order >= 4:
                unit, find = "units of the state", partial(self.rounding_error, method)
                yield measured(f"{method} rounding", ROUNDED, unit, find)

    limit = 1e3

    def incomplete_functions(self) -> float:
        """Return the number of functions of the module that leave some entry of `out` unwritten."""
        s, n, left = self.states[-1], self.model.info.nq, 0
        for name in ("D", "C", "g", "bias", "tau"):
            out = np.full((n, n) if name in "DC" else n, np.nan, self.model.info.dtype)
            place = (s.q,) if name in "Dg" else (s.q, s.qd)
            getattr(self.check.module, name)(*place, t=s.t, params=s.params, out=out)
            left += bool(np.any(np.isnan(out)))
        return float(left)

    def large_step(self, s: State, part: float) -> float:
        """Return a step size, s, in which the fastest coordinate moves by a part of its range.

        s: the state at which the step begins. part: the part, as a fraction of the range that the
        coordinate covers in the motion.
        """
        spread = part * self.sampler.spread
        a = np.asarray(self.check.module.acceleration(s.q, s.qd, s.t, s.u, s.params), float)
        with np.errstate(divide="ignore"):
            h = np.minimum(spread / np.abs(s.qd), np.sqrt(spread / np.abs(a)))
        return float(min(np.min(h), 100 * self.h)) or self.h

    def turning_step(self, s: State, turned: float = 0.3, moved: float = math.inf) -> float:
        """Return a step size h, in s, with which angles turn by a given amount in half a step.

        h is the shorter of two step sizes: the one with which the accelerations at `s` turn some
        angle by `turned` (rad), and the one with which the velocities turn some angle by `moved`
        (rad).
        """
        a = np.asarray(self.check.module.acceleration(s.q, s.qd, s.t, s.u, s.params), float)
        fastest, rate = (
            float(np.max(np.abs(x[self.sampler.angles]), initial=0)) for x in (a, s.qd)
        )
        steps = [math.sqrt(4 * turned / fastest)] if fastest > 0 else []
        steps += [2 * moved / rate] if rate > 0 else []
        return min([*steps, 100 * self.h]) if steps else self.h

    def long_step_error(self) -> float | Measurement:
        """Return the largest error of runs with long steps, in units of rounding.

        In such steps angles move so far that the C code can't update their sines from the previous
        ones and computes them anew. The runs are compared with runs of the reference.
        """
        # between the values of LONG, rotations by all angles that the C code uses
        ladder = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.7)
        parts = ((), LONG) if self.check.large else (LONG, ladder)
        pairs = [
            (e, h)
            for e, some in zip(self.starts, parts, strict=False)
            for h in (
                self.turning_step(e.state),
                *(self.large_step(e.state, part) for part in some),
            )
        ]
        # almost the largest angles by which the C code rotates sines
        pairs += [(e, self.turning_step(e.state, 0.012, 0.11)) for e in self.turning]
        errors = (run_error(self.check, "rk4", e, h, self.few) for e, h in pairs)
        return largest(errors, "a difference grows too much in one long step")

    def short_step_error(self) -> float | Measurement:
        """Return the largest error of runs with short steps, in units of rounding.

        In such steps angles hardly change, so that the C code updates their sines from the previous
        ones. The runs are compared with runs of the reference.
        """
        starts = self.check.few(2 if self.check.large else 8)
        errors = (
            run_error(self.check, "rk4", e, self.turning_step(e.state, SHORT), self.few)
            for e in starts
        )
        return largest(errors, "a difference grows too much in one short step")

    def sine_error(self) -> float:
        """Return the largest error of D, g and bias at angles all around the circle, in roundings.

        At these angles the polynomials for sines and cosines need all of their terms.
        """
        e = self.check.few(2)[-1]
        s, n = e.state, len(e.state.q)
        around = np.linspace(-np.pi, np.pi, 48, endpoint=False)[:, None] + 0.01
        steps = self.random.permutation(n)  # so that angles are not all alike
        q = np.where(self.sampler.angles, s.q + around * (1 + steps % 3), s.q)
        errors = []
        size: dict[str, Vector] = {}
        states = [replace(s, q=row) for row in q]
        with np.errstate(all="ignore"):
            expected = self.expected(states)
        for name in ("D", "g", "bias"):
            known = [x[name] for x in expected if np.all(np.isfinite(x[name]))]
            size[name] = e.size[name] + np.max(np.abs(known), axis=0, initial=0)
        for at, values in zip(states, expected, strict=True):
            for name, width in size.items():
                if np.all(np.isfinite(values[name])):
                    value = self.check.module_value(name, at)
                    errors.append(self.check.units(value, values[name], width))
        return float(np.max(errors, initial=0))

    def expected(self, states: Sequence[State]) -> list[dict[str, Vector]]:
        """Return the reference's D, g and bias, by name, at states that differ in q alone."""
        s, ask = states[0], self.sampler.reference.evaluate
        q, qd = (np.array([getattr(at, x) for at in states]) for x in ("q", "qd"))
        values_by_name = {
            name: ask(name, q, qd, s.t, None, s.params) for name in ("D", "g", "bias")
        }
        return [
            {name: values[k] for name, values in values_by_name.items()} for k in range(len(states))
        ]

    def far_angle_error(self) -> float:
        """Return the largest error of values and steps at angles of many turns and at late times.

        The values are those of the dynamics, such as D and the accelerations; the steps are single
        steps by each method. The error is in units of the effect of one rounding error of the
        angles.

        The C code's own inlined sines do not cover such angles. The time is reduced if formulas
        then contain larger angles, such as t**3, or if single precision does not resolve a step. A
        state is left out if one of its angles exceeds 2/eps, beyond which neighbouring doubles are
        more than a radian apart.
        """
        errors, angle = [], largest_angle(self.check.system)
        for e in self.check.few(2):
            s = e.state
            turns = 2 * np.pi * np.round(TURNS / 2 / np.pi) * self.sampler.angles
            constrained = bool(self.check.system.constraints)  # these may not hold at another time
            t = 2.0**24 if _reads_time(self.check.system) and not constrained else 0.0
            at = replace(s, q=s.q + turns * self.random.choice([-1, 1], len(s.q)), t=s.t + t)
            # beyond 2^26 rad, rounding errors of an angle hide all others
            while t > 1 and (angle(at) > 2.0**26 or not self.resolves_steps(at.t)):
                t /= 2
                at = replace(at, t=s.t + t)
            if angle(at) > 2 / EPS:
                continue
            if constrained and not self.constraints_hold(at):
                continue
            with np.errstate(all="ignore"):
                far = self.sampler.expected(at)
            if far is None or not self.sampler.regular(at):
                continue
            # a spring that is wound up by so many turns makes the motion too fast to compare;
            # errors of its accelerations are relative to the forces of the spring
            wound = 10 * np.max(e.size["acceleration"]) < np.max(np.abs(far.value["acceleration"]))
            wide = max(TURNS, t, angle(at))
            energies = ("kinetic_energy", "potential_energy")
            for name in ("D", "g", "bias", "tau", *energies, "acceleration"):
                near = far if wound and name == "acceleration" else e
                size = wide * near.size[name] + far.size[name]
                errors.append(
                    self.check.units(self.check.module_value(name, at), far.value[name], size)
                )
            if wound:
                continue
            gain = wide * e.size["acceleration"] + far.size["acceleration"]
            far = replace(far, size={**far.size, "acceleration": gain})
            if self.check.methods[0] == "rk4":
                errors.append(self.far_steps(at, gain))
            for method in self.check.methods:
                if method != "rk4":
                    solved = self.with_stage_errors(far) if METHODS[method].implicit else far
                    errors.append(step_error(self.check, method, solved, self.h) or 0.0)
        return float(np.max(errors, initial=0))

    def constraints_hold(self, s: State) -> bool:
        """Return whether the constraints hold at a state with angles that are many turns away.

        Adding whole turns to angles may violate a constraint: two geared angles, for instance, need
        different numbers of turns.
        """
        off, size = self.sampler.value_and_size(
            partial(self.sampler.reference.evaluate, "constraints"), s
        )
        return bool(np.all(np.abs(off) <= 1e3 * self.check.eps * size))

    def with_stage_errors(self, e: Expected) -> Expected:
        """Return a copy of `e` with larger error units of accelerations, for implicit methods.

        The unit grows since the stages of an implicit method are found by iteration: a rounding
        error of q changes the velocities of the stages, and hence their accelerations.
        """
        s, n, rounded = e.state, len(e.state.q), np.abs(e.state.q) / self.h
        scale = self.sampler.scale
        with np.errstate(all="ignore"):
            by = differentiate(self.sampler.reference, s, scale, self.sampler.defaults)
            slopes = np.fmax.reduce([np.abs(J[:, n : 2 * n]) for J, _ in by])
        gain = e.size["acceleration"] + rounded / self.h + slopes @ rounded
        return replace(e, size={**e.size, "acceleration": gain})

    def resolves_steps(self, t: float) -> bool:
        """Return whether times near t (s) are precise enough for 1/64 of the scene's step size."""
        return bool(64 * np.spacing(np.asarray(t, self.check.dtype)) <= self.h)

    def far_steps(self, s: State, acceleration: Vector) -> float:
        """Return the error of a few RK4 steps from `s`, in units of rounding.

        The steps are compared with those of the reference. acceleration (nq,): the size of the
        accelerations, by which their rounding errors are measured. The result is 0 if the steps
        move the state so far that a comparison means nothing.
        """
        h, x, scale = self.h, self.sampler.rounded(s), self.sampler.scale
        u = None if s.u is None else np.array([s.u] * x.shape[1])
        off = np.zeros_like(scale)
        with np.errstate(all="ignore"):
            for n in range(self.few):
                x = np.array(self.sampler.reference.step(x[0], x[1], h, s.t + n * h, u, s.params))
                off = np.fmax(off, np.max(np.abs(x - x[:, :1]), axis=1) / EPS)
            if not np.all(np.abs(x[:, 0] - [s.q, s.qd]) < MAX_DISTANCE * scale):
                return 0.0  # as with the force of a spring that is wound up
        gain = self.few * h * acceleration
        size = np.abs([s.q, s.qd]) + np.array([self.few * h * (np.abs(s.qd) + gain), gain]) + off
        end = run_in_c(self.model, "rk4", s, h, self.few).rows[:, -1]
        return self.check.units(end, x[:, 0], size)

    def input_sequence_error(self) -> float | Measurement:
        """Return the largest error of runs whose inputs change from step to step.

        The error is in units of rounding and relative to a run of the reference. It is inf if the C
        run differs in any bit from that of the Python method `simulate`. Nothing is judged (a
        Measurement with the reason) if the first step of each run already leads too far.
        """
        errors, spread = [], self.sampler.scale
        for s in self.states:
            signals = np.abs(self.sampler.reference.evaluate("signals", s.q, s.qd, s.t))
            scale = np.where(signals > 0, signals, 1)
            u = self.random.normal(size=(LONG_STEP_COUNT, self.model.info.nu)) * scale
            at = replace(s, u=u)
            n, x, growth = self.reference_run(s, u, spread)
            run = run_in_c(self.model, self.check.methods[0], at, self.h, LONG_STEP_COUNT)
            size = np.abs(np.array([s.q, s.qd])) + np.abs(x)
            size = LONG_STEP_COUNT * (size + growth * spread)
            errors.append(self.check.units(run.rows[:, n], x, size) if n else None)
            if np.all(np.isfinite(run.rows)):
                again = self.check.module.simulate(
                    s.q, s.qd, self.h, steps=LONG_STEP_COUNT, u=u.astype(self.model.info.dtype),
                    params=s.params, t0=s.t,
                )  # fmt: skip
                same = np.array_equal([again.q, again.qd], run.rows)
                errors += [] if same else [math.inf]
        return largest(errors, "the first step leads too far")

    def reference_run(self, s: State, u: Vector, spread: Vector) -> tuple[int, Vector, float]:
        """Return a run of the reference with given inputs, as far as the state stays near `s`.

        The results are the number of steps, the state after them (2, nq), and the factor by which a
        small difference of the initial state has grown. u (steps, nu): inputs of each step. spread
        (2, nq): typical sizes of q and q̇.
        """
        x = np.array([s.q, s.qd])[:, None] + [[0.0], [NUDGE]] * spread[:, None]  # (2, 2, nq)
        start = x[:, 0]
        sure = 0, start, 1.0
        with np.errstate(all="ignore"):
            for n, row in enumerate(u):
                t, inputs = s.t + n * self.h, np.array([row, row])
                step = self.sampler.reference.step
                x = np.array(step(x[0], x[1], self.h, t, inputs, s.params))
                if not np.all(np.abs(x[:, 0] - start) < MAX_DISTANCE * spread):
                    break  # the run diverges
                growth = float(np.max(np.abs(x[:, 1] - x[:, 0]) / spread)) / NUDGE
                sure = n + 1, x[:, 0], max(growth, 1.0)
        return sure

    def divided_run_differences(self, method: str) -> float:
        """Return the number of runs whose bits depend on how the run is divided or stored.

        A run by `method` that is divided into several calls, or that stores fewer states, must give
        the same bits as the run in one call.
        """
        wrong = 0
        for s in self.states:
            steps = [self.h, *(self.large_step(s, part) for part in LONG)]
            steps += [self.turning_step(s, part) for part in (SHORT, SHORT / 64)]
            for h in steps:
                for at in (s, *([self.with_input_sequence(s)] if self.model.info.nu else [])):
                    wrong += self.differing_variants(method, at, h)
        return float(wrong)

    def with_input_sequence(self, s: State) -> State:
        """Return a copy of the state with random inputs, (STEPS, nu), that change between steps."""
        u = self.random.normal(size=(STEPS, self.model.info.nu))
        u[::2] = u[1::2]  # inputs that change at every second step only
        return replace(s, u=u)

    def differing_variants(self, method: str, s: State, h: float) -> int:
        """Return how many variants of a run differ from the run in one call in any bit.

        The run starts at `s` with steps of h seconds. The variants are: a run divided into several
        calls; one that stores fewer states; and one whose state is changed between two calls, which
        must then ignore what its workspace contains from the call before.
        """
        whole = run_in_c(self.model, method, s, h, STEPS)
        pieces = run_in_c(self.model, method, s, h, STEPS, division=RunDivision(CUTS))
        few_calls = RunDivision(CUTS[::2])
        sparse = run_in_c(self.model, method, s, h, STEPS, every=EVERY, division=few_calls)
        last = -(-whole.steps // EVERY)
        stored = whole.rows[:, np.minimum(EVERY * np.arange(last + 1), whole.steps)]
        rows = np.full_like(sparse.rows, np.nan)
        rows[:, : last + 1] = stored
        wrong = (not pieces.is_identical(whole)) + (
            not sparse.is_identical(replace(whole, rows=rows))
        )
        # after a change of the state, the workspace of the call before must not be used
        by = max(1e-3 * float(self.sampler.spread[0]), 64 * self.check.eps)
        moved, fresh = (
            run_in_c(self.model, method, s, h, CUTS[3], division=RunDivision(CUTS, by, fresh))
            for fresh in (False, True)
        )
        return wrong + (not moved.is_identical(fresh))

    def row_error(self, method: str) -> float | Measurement:
        """Return the largest error of rows at given times, in units of rounding.

        Rows at the ends of steps are those of the run that stores each step. Rows between are those
        of one shorter step from the row before. Times are rounded.
        """
        of, errors = self.check, list[float]()
        fractions = np.array([0, 0.4, 1, 1.5, 2, 2.75, 3])
        how: dict[str, Any] = {"method": method} if method != of.methods[0] else {}
        for s in self.states:
            run = of.simulate(s, method, h=self.h, steps=3)
            if run.status != "ok":
                continue
            times = run.t[0] + self.h * fractions
            rows = of.simulate(s, method, h=self.h, times=times)
            if rows.status != "ok":
                continue
            latest = np.max(np.abs(times))
            for row, fraction in enumerate(fractions):
                n = int(fraction)
                q, qd = run.q[n], run.qd[n]
                gained = np.abs(np.diff(run.qd[min(n, 2) :][:2], axis=0)[0])
                speed = np.abs(qd) + gained
                size = [np.abs(q) + latest * speed, speed + latest / self.h * gained]
                if fraction > n:
                    how |= {"t": float(run.t[n]), "u": s.u, "params": s.params}
                    q, qd = of.module.step(q, qd, h=float(times[row] - run.t[n]), **how)
                found = [rows.q[row], rows.qd[row]]
                errors.append(of.units(found, np.array([q, qd]), np.array(size)))
        return largest(errors, "no run succeeds")

    def rounding_error(self, method: str) -> float | Measurement:
        """Return how far rounding moves the end of a run of thousands of steps, in roundings.

        Two runs with different, very short steps cover the same time. The method's error is then
        below rounding, so that their difference is due to rounding alone. The result is the median
        over some states, since rounding errors grow fast along some motions.

        Nothing is judged if forces have jumps or kinks, or if they are so steep that still shorter
        steps reduce the difference.
        """
        states, errors = self.check.few(4), list[float]()
        for parts in FINE:
            errors.append(self.run_difference(method, states, parts))
            if errors[-1] <= ROUNDED:
                return errors[-1]
        if corners := self.check.corners:
            return Measurement(errors[-1], f"steps leap over {corners}")
        if errors[-1] < errors[0] / 2:
            return Measurement(errors[-1], "forces are so steep that shorter steps differ less")
        return min(errors)

    def run_difference(
        self, method: str, states: Sequence[Expected], parts: Sequence[int]
    ) -> float:
        """Return the median difference of the final states of two runs, in units of rounding.

        The median is over the initial `states`. Both runs cover the same time by `method`. parts:
        for each of the two runs, the number of its steps in one step of the scene.
        """
        errors, T = [], 2 * self.h
        for e in states:
            s, gain = replace(e.state, u=None), T * e.size["acceleration"]
            one, other = (
                run_in_c(self.model, method, s, self.h / n, 2 * n, every=2 * n) for n in parts
            )
            if not (one.status or other.status):
                size = np.abs([s.q, s.qd]) + np.array([T * (np.abs(s.qd) + gain), gain])
                size = size + e.size.get("place", 0.0)  # rounding errors of the projection
                errors.append(self.check.units(one.rows[:, -1], other.rows[:, -1], size))
        return float(median(errors)) if errors else 0.0


# --- sines near their zeros -----------------------------------------------------------------------

VANISHING_LIMIT = 100.0  # units of rounding; a wrong constant of the reduction makes 1e9
# doubles next to a multiple of a quarter turn, counted from it; some are far, since the rounding of
# a sum may hardly change from one double to the next
NEIGHBOURS = (-613, -2, -1, 0, 1, 2, 389)
# relative difference of errors at neighbours up to which they are not rounding errors of a sum
CONSTANT_TOLERANCE = 0.1
Errors = dict[tuple[str, int], float]  # by name, "D" or "g", and index of an entry
# Relative changes of the other coordinates. They change the rounding errors of sums, also the power
# of two to which sums that almost cancel are rounded, but no error of a sine.
MOVES = (1e-6, -0.43, 0.31, 0.77, -0.68)


def sine_checks(check: Comparison) -> Iterator[Check]:
    """Yield a check of sines near their zeros, if there are angles.

    There is none in single precision, which takes its sines from double precision.
    """
    if np.any(check.sampler.angles) and check.dtype == np.float64:
        find = partial(largest_error_near_zeros, check)
        yield measured("sines that vanish", VANISHING_LIMIT, "units of rounding", find)


def largest_error_near_zeros(check: Comparison) -> float | Measurement:
    """Return the largest relative error of entries of D and g near zeros of a sine, in roundings.

    The entries are those that are proportional to one sine, so that they vanish with it. An entry
    counts if it vanishes at all multiples of a quarter turn at which the sine does. One that
    vanishes at some of them only may be a sum that cancels there, such as 1 - tanh(x)**2 for large
    x.
    """
    e, errors = check.few(2)[-1], list[float]()
    for i in map(int, np.flatnonzero(check.sampler.angles)):
        for odd in (0, 1):
            quarter_turns = (1, 2, -3, 4, -7, 1024, -99_999, 667_542)  # up to 2^20 rad
            places = [n for n in quarter_turns if n % 2 == odd]
            error_tables = [dict(_entry_errors(check, i, n, e)) for n in places]
            common = set.intersection(*map(set, error_tables))
            for quarters, here in zip(places, error_tables, strict=True):
                errors += _persistent_errors(check, i, quarters, e, {k: here[k] for k in common})
    if not errors:
        return Measurement(math.inf, "no entry of D or g is one sine times something")
    return max(errors)


def _persistent_errors(
    check: Comparison, i: int, quarters: int, e: Expected, errors: Errors
) -> Iterable[float]:
    """Return the errors that stay the same, relative to the entry, if other coordinates move."""
    if max(errors.values(), default=0.0) <= VANISHING_LIMIT:
        return errors.values()
    again = [dict(_entry_errors(check, i, quarters, other)) for other in _moved_states(e)]
    each = {k: [x, *(a.get(k, 0.0) for a in again)] for k, x in errors.items()}
    return [min(x) for x in each.values() if np.ptp(x) <= CONSTANT_TOLERANCE * max(x)]


def _moved_states(e: Expected) -> Iterator[Expected]:
    s = e.state
    for by in MOVES:
        yield replace(e, state=replace(s, q=s.q * (1 + by), t=s.t * (1 + by)))


def _entry_errors(
    check: Comparison, i: int, quarters: int, e: Expected
) -> Iterator[tuple[tuple[str, int], float]]:
    """Return the errors of entries with coordinate i near this number of quarter turns."""
    s, angle = e.state, quarters * (math.pi / 2)
    angles = angle + np.array(NEIGHBOURS) * math.ulp(angle)
    sines = np.array([math.cos(x) if quarters % 2 else math.sin(x) for x in angles.tolist()])
    states = [replace(s, q=np.where(np.arange(len(s.q)) == i, x, s.q)) for x in angles]
    for name in ("D", "g"):
        with np.errstate(all="ignore"):
            known = [check.reference.evaluate(name, x.q, x.qd, x.t, None, x.params) for x in states]
            expected = np.reshape(known, (len(states), -1))
            parts = expected / sines[:, None]
            values = np.reshape([check.module_value(name, x) for x in states], expected.shape)
            least = VANISHING_LIMIT * check.eps * np.ravel(e.size[name])
            for k, (part, entry, value) in enumerate(
                zip(parts.T, expected.T, values.T, strict=True)
            ):
                if np.all(np.abs(part) > least[k]) and np.ptp(part) <= 1e-6 * np.max(np.abs(part)):
                    yield (name, k), _relative_error(value - entry, entry, check.eps)


def _relative_error(off: Vector, entry: Vector, eps: float) -> float:
    """Return the relative error of an entry, in units of rounding.

    It is 0 if it is neither constant at all neighbours nor proportional to the entry: then the
    module computes the same entry by a sum that cancels.
    """
    errors = [
        float(np.max(np.abs(x))) if np.ptp(x) <= CONSTANT_TOLERANCE * np.max(np.abs(x)) else 0.0
        for x in (off / np.median(np.abs(entry)), off / entry)
    ]
    small = float(np.max(np.abs(off / entry)))
    return small / eps if small <= VANISHING_LIMIT * eps else max(errors) / eps


def largest_angle(system: System) -> Callable[[State], float]:
    """Return a function that computes the largest angle in the system's formulas at a state, rad.

    An angle is an argument of a sine, cosine or tangent. Its rounding error, relative to its size,
    limits the precision of all results. The function ignores angles that contain a rate dot(...),
    and returns 0 if there are no angles.
    """
    formulas = [
        system.kinetic, system.potential, system.linear_potential, system.dissipation,
        *system.forces, *(e for pair in system.applied for e in pair),
        *(i.signal for i in system.inputs), *(c.formula for c in system.constraints),
    ]  # fmt: skip
    known, free = [], set[sympy.Symbol]()  # definitions without rates
    for name, e in needed_definitions(system.definitions, formulas):
        if not e.has(dot) and not e.free_symbols & free:
            known.append((name, e))
        else:
            free.add(name)
        formulas.append(e)
    angles = {f.args[0] for e in formulas for f in e.atoms(sympy.sin, sympy.cos, sympy.tan)}
    angles = {e for e in angles if not e.has(dot) and not e.free_symbols & free}
    if not angles:
        return lambda s: 0.0
    parameters = [p.symbol for p in system.parameters]
    names = [*system.q, *system.qd, t, *system.u, *parameters]
    evaluate = compile_function(
        names, sorted(angles, key=str), "numpy", needed_definitions(known, [*angles])
    )
    defaults = {p.name: p.value for p in system.parameters}

    def evaluate_largest(s: State) -> float:
        values = s.params or defaults
        u = np.zeros(len(system.u)) if s.u is None else s.u
        with np.errstate(all="ignore"):
            arguments = evaluate(
                *s.q, *s.qd, s.t, *u, *(np.float64(values[p.name]) for p in parameters)
            )
        return float(np.nanmax(np.abs(np.array(arguments, float)), initial=0.0))

    return evaluate_largest
