"""Checks of the templates of adaptive steps: refusals, limits of the step size, batches.

A run that can't continue returns a status, and the state is the last good one. A batch is computed
by other C functions than a single run; the two agree within the tolerance. In another place of the
batch, in other calls, or next to instances that fail, an instance has the same bits.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eomc.runtime.package import model_of
from eomc.verify.comparison import Check, Comparison, Measurement, largest
from eomc.verify.reference import Vector
from eomc.verify.runs import TIME_ROUNDINGS, TOLERANCE_ROUNDINGS
from eomc.verify.sampling import State, simulate
from support.template_checks.refusals import (
    NOT_FINITE,
    OK,
    REFUSED,
    SINGULAR,
    RefusalChecks,
    with_nonfinite_entries,
)
from support.template_checks.runs import measured, parameters


def resolves_steps(check: Comparison, s: State, h: float) -> bool:
    """Return whether times near s.t are precise enough for steps of h seconds.

    In single precision, for instance, times have only 7 digits.
    """
    # the C function refuses steps of a few roundings, and begins with a fraction of the first step
    return h > 16 * TIME_ROUNDINGS * check.eps * (abs(s.t) + h)


# --- refusals and step sizes ----------------------------------------------------------------------

MAX_STEPS = 40  # of a run
COARSE_TOLERANCE = 1e-3


@dataclass(frozen=True)
class AdaptiveRunResult:
    """Results of an adaptive run by the C function.

    status: 0, or the code of the error. rows: states at the ends of steps, (n, 2 nq). times: their
    times, (n,), s. x: the last state, (2 nq,).
    """

    status: int
    rows: Vector
    times: Vector
    x: Vector

    @property
    def refuses_cleanly(self) -> bool:
        """Whether the run has returned an error and made no step."""
        return self.status != OK and not len(self.rows)


def refusal_checks(check: Comparison, refusals: RefusalChecks) -> Iterator[Check]:
    """Yield checks of adaptive runs: refusals, and the limit of the step size.

    There are none if the scene has no tolerance. refusals: the checks of refusals by fixed steps,
    which have found states with a singular mass matrix D.
    """
    if check.system.run.tolerance is not None:
        adaptive, unit = AdaptiveRefusalChecks(check, refusals), "runs that end otherwise"
        yield measured("adaptive steps: refusals", 0, unit, adaptive.wrong_refusals)
        yield measured("adaptive steps: longest", 0, unit, adaptive.step_limit_violations)


class AdaptiveRefusalChecks:
    """Checks of what single adaptive runs by the C function refuse, and of their step sizes.

    refusals: the checks of refusals by fixed steps, which have found states with a singular D.
    """

    def __init__(self, check: Comparison, refusals: RefusalChecks) -> None:
        self.check, self.model, self.refusals = check, model_of(check.module), refusals
        self.state = check.few(2)[-1].state

    def drive(
        self, s: State, span: float, tol: float, max_step: float = 0.0, stiff: bool = False,
        each: int = MAX_STEPS,
    ) -> AdaptiveRunResult:  # fmt: skip
        """Return an adaptive run of `span` seconds by the C function, of at most MAX_STEPS steps.

        s: initial state. tol: tolerance. max_step: limit of the step size, s; 0 for none. stiff:
        whether to begin with Newton's method. each: number of steps per call of the C function.
        """
        model, many, pointer = self.model, 2 * MAX_STEPS, self.model.c.pointer
        info, ffi, null = model.info, model.c.ffi, model.c.null
        q, qd = (np.array(x, info.dtype) for x in (s.q, s.qd))
        rows, times = np.full((2, many, info.nq), np.nan, info.dtype), np.zeros(many, info.dtype)
        u = None if s.u is None else np.array(s.u, info.dtype)
        options = ffi.new("run_options *", {"t0": s.t, "t_end": s.t + span, "tol": tol})
        options.max_step, options.stiff, options.steps = max_step, stiff, each
        work, p, status = ffi.new("run_work *"), parameters(model, s), OK
        output = ffi.addressof(work, "output")
        for _ in range(0, MAX_STEPS, each):
            is_stopped = bool(info.events) and output.stopped
            if status != OK or (output.has_started and output.t >= options.t_end) or is_stopped:
                break
            code = model.c.lib.integrate(
                options, output, work, pointer(q), pointer(qd), null, many, pointer(u), 0,
                pointer(p), *model.integrator.no_events, pointer(times), pointer(rows[0]),
                pointer(rows[1]),
            )  # fmt: skip
            status = code & 7
        n, x = output.rows, np.array(list(work.x), info.dtype)
        # without the start
        return AdaptiveRunResult(status, np.hstack([rows[0, 1:n], rows[1, 1:n]]), times[1:n], x)

    def wrong_refusals(self) -> float:
        """Return the number of adaptive runs that are not refused correctly, or store nan or inf.

        Some runs start where the mass matrix D is singular or at nan or inf; they must return an
        error and make no step. Others start with numbers so large that a step overflows; they must
        store finite states only.
        """
        h, tol = self.check.system.run.h, COARSE_TOLERANCE
        wrong = 0
        for s in _every_nth(self.refusals.singular, 8):
            for stiff in (False, True):
                run = self.drive(s, 10 * h, tol, stiff=stiff)
                wrong += not (run.refuses_cleanly and run.status == SINGULAR)
                wrong += not np.array_equal(run.x, np.asarray([s.q, s.qd], run.x.dtype).ravel())
        for *_, odd in with_nonfinite_entries(self.state):
            run = self.drive(odd, 10 * h, tol)
            wrong += not run.refuses_cleanly or run.status not in REFUSED
        return float(wrong + self.overflow_errors())

    def overflow_errors(self) -> int:
        """Return the number of runs that store states that are not finite.

        Their initial states are so large that a step may overflow.
        """
        wrong, huge = 0, float(np.finfo(self.model.info.dtype).max) / 2
        for unit in np.eye(len(self.state.q)):
            for size in (1e7, huge):  # the vectorised sines are for angles below 1e7 rad
                for stiff in (False, True):
                    far = replace(self.state, q=size * unit, qd=1.01 * size * unit)
                    run = self.drive(far, 1.0, COARSE_TOLERANCE, stiff=stiff)
                    wrong += not (np.all(np.isfinite(run.rows)) and np.all(np.isfinite(run.x)))
        return wrong

    def step_limit_violations(self) -> float | Measurement:
        """Return the number of errors in adaptive runs with a limit of the step size.

        No step may exceed the limit, the last step must end at the given time, and a run in several
        calls must equal the run in one call.
        """
        errors = (self.step_limit_errors(e.state) for e in self.check.few(2))
        return largest(errors, "time tells no parts of a first step")

    def step_limit_errors(self, s: State) -> float | None:
        """Return the number of errors in one adaptive run from `s` with a limit of the step size.

        The result is None if times are not precise enough for such steps.
        """
        first = self.drive(s, self.check.system.run.duration, COARSE_TOLERANCE)
        later = first.times[first.times > s.t]  # the state may jump at once
        span = float(later[0]) - s.t if len(later) else 0.0
        parts = 7  # steps in place of the first one, because of the limit
        if not resolves_steps(self.check, s, span / parts):
            return None
        run, cut = (
            self.drive(s, span, COARSE_TOLERANCE, max_step=span / parts, each=n)
            for n in (MAX_STEPS, 1)
        )
        sizes = np.diff(np.concatenate([[s.t], run.times]))
        rounding = TIME_ROUNDINGS * self.check.eps * (abs(s.t) + span)
        late = bool(np.any(sizes > span / parts + rounding)) or len(run.times) < parts
        end = np.asarray(s.t + span, run.times.dtype)
        there = run.status == OK and run.times[-1] == end
        return float(late) + float(not there) + float(not np.array_equal(run.rows, cut.rows))


# --- batches --------------------------------------------------------------------------------------

INSTANCES = 19  # more than twice the lanes of any register
BATCH_STEPS = 4  # of a run that is compared with the run of a single instance
BATCH_LIMIT, BATCH_UNIT = 1.0, "tolerances a step"


@dataclass
class AdaptiveBatchResult:
    """Results of the C function `integrate_batch` for n instances of the system.

    Attributes
    ----------
    x : (n, 2 nq) array
        Final states.
    t : (n,) array
        Their times, s.
    rows : (n, 4, nq) array
        q at two times, then q̇ at these times.
    counts : (n, 6) array
        Numbers of steps, rejected steps, evaluations, stiff steps and events; a checksum of the
        events.
    status : (n,) array
        Error codes; 0 if there is no error.
    """

    x: Vector
    t: Vector
    rows: Vector
    counts: Vector
    status: Vector

    def __getitem__(self, which: Any) -> list[Vector]:
        return [x[which] for x in (self.x, self.t, self.rows, self.counts, self.status)]


def batch_checks(check: Comparison, singular: list[State]) -> Iterator[Check]:
    """Yield checks of batches with adaptive steps.

    There are none if the scene has no tolerance or no batches. singular: states at which the mass
    matrix D is singular; a batch must refuse them.
    """
    if check.system.run.tolerance is None or not check.system.run.batch:
        return
    first = AdaptiveBatchChecks(check, singular)
    name = "adaptive steps of many"
    yield measured(name, BATCH_LIMIT, BATCH_UNIT, first.compare_with_single_runs)
    for form in check.forms:
        prefix = "" if form.module is check.module else "plain C: "
        many = AdaptiveBatchChecks(check, singular, form.module)
        yield measured(f"{prefix}{name}: bits", 0, "instances", many.differing_instances)
        yield measured(f"{prefix}{name}: refusals", 0, "instances", many.wrong_refusals)


class EventRecorder:
    """Buffers for the events of `count` instances in a batch, and a digest of the events so far.

    digests: for each instance, the number of its events and a checksum of them. room: the buffers
    as arguments of the C function.
    """

    def __init__(self, model: Any, count: int) -> None:
        self.digests: list[list[int]] = [[0, 0] for _ in range(count)]
        self.room: tuple[Any, ...] = ()
        if not model.info.events:
            return
        each = 64 + len(model.info.events)  # room for the events of an instance in one call
        self.which = np.zeros((count, each), "i")
        self.rows = np.zeros((count, each, 1 + 2 * model.info.nq), model.info.dtype)
        which = model.c.ffi.from_buffer("int[]", self.which)
        self.room = each, which, model.c.pointer(self.rows)

    def record(self, counts: Vector) -> None:
        """Add the events that the last call of the C function stored to the digests.

        counts: their number, for each instance.
        """
        for k, n in enumerate(counts):
            number, digest = self.digests[k]
            for which, row in zip(self.which[k, :n], self.rows[k, :n], strict=True):
                number, digest = number + 1, zlib.crc32(which.tobytes() + row.tobytes(), digest)
            self.digests[k] = [number, digest]


class AdaptiveBatchChecks:
    """Checks of adaptive runs of a batch of COUNT instances, all of which start near one state.

    singular: states at which D is singular. module: the module of the optimised (default) or the
    portable C code.
    """

    def __init__(self, check: Comparison, singular: list[State], module: Any = None) -> None:
        self.check, self.module, self.singular = check, module or check.module, singular
        self.model = model_of(self.module)
        self.tol = 1e-12 if self.model.info.dtype == np.float64 else 1e-6
        states = [e.state for e in reversed(check.few(2))]
        self.state = s = next(filter(self.resolves_steps, states), states[0])
        random, sampler = np.random.default_rng(3), check.sampler
        self.starts = [
            sampler.project(replace(s, q=s.q + dq, qd=s.qd + dv))
            for dq, dv in zip(
                1e-2 * sampler.spread * random.standard_normal((INSTANCES, len(s.q))),
                1e-2 * sampler.speed * random.standard_normal((INSTANCES, len(s.q))), strict=True,
            )
        ]  # fmt: skip

    def single_run(self, s: State, **span: Any) -> Any:
        """Return the adaptive run of a single instance from the state `s`.

        span: the `duration` or the `times` of the run, as arguments of the module's `simulate`.
        """
        return simulate(self.module, s, tol=self.tol, t0=s.t, **span)

    def span(self, s: State) -> float:
        """Return the duration of the first STEPS adaptive steps from the state `s`, in s.

        The result is 0 if the run makes no step.
        """
        run = self.single_run(s, duration=self.check.system.run.duration)
        return float(run.t[min(BATCH_STEPS, len(run) - 1)]) - s.t if len(run) else 0.0

    def resolves_steps(self, s: State) -> bool:
        """Return whether times near s.t are precise enough for the adaptive steps from `s`."""
        return resolves_steps(self.check, s, self.span(s) / BATCH_STEPS)

    def compare_with_single_runs(self) -> float | Measurement:
        """Return the largest difference between states of the batch and those of single runs.

        States at two times are compared. The unit is the tolerance, times the number of steps.
        """
        s, T = self.state, self.span(self.state)
        if not self.resolves_steps(s):
            return Measurement(math.nan, "times tell no steps")
        times = s.t + T * np.array([0.4, 1.0])
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            q, qd = (np.array([getattr(x, name) for x in self.starts]) for name in ("q", "qd"))
            many = self.module.simulate_batch(
                q, qd, times=times, tol=self.tol, t0=s.t, params=s.params,
                u=None if s.u is None else np.tile(s.u, (INSTANCES, 1)), threads=1,
            )  # fmt: skip
        return largest(
            (self.end_error(many, k, times) for k in range(INSTANCES)), "no instance has a step"
        )

    def end_error(self, many: Any, k: int, times: Vector) -> float | None:
        """Return the largest difference between instance k of a batch run and its single run.

        many: the batch run, which has stored the states at `times`; the single run stores them too.
        The unit is the tolerance, times the number of steps. The result is None if the single run
        stops early.
        """
        one = self.single_run(self.starts[k], times=times)
        if one.status != "ok" or len(one) < len(times):
            return None
        x = np.hstack([many.q[k], many.qd[k]]).astype(float)
        scale = np.abs(one.x).max(axis=0) + self.check.sampler.scale.ravel()
        allowed = (self.tol + TOLERANCE_ROUNDINGS * self.check.eps) * (one.steps + 1)
        return float(np.nan_to_num(np.max(np.abs(x - one.x) / scale) / allowed, nan=math.inf))

    def drive(
        self, starts: list[State], span: float, steps: int, *, stiff: bool = False,
        longest: float = 0.0,
    ) -> AdaptiveBatchResult:  # fmt: skip
        """Return the results of an adaptive batch run by the C function.

        starts: initial states of the instances. The run begins at the time of the checked state and
        lasts `span` seconds. steps: largest number of steps of each instance per call; calls are
        repeated until all instances are finished. stiff: whether to begin with Newton's method.
        longest: limit of the step size, s; 0 for none.
        """
        model, n, s = self.model, len(starts), starts[0]
        info, ffi, pointer, lib = model.info, model.c.ffi, model.c.pointer, model.c.lib
        q, qd = (np.array([getattr(x, k) for x in starts], info.dtype) for k in ("q", "qd"))
        end = self.state.t + span
        times = np.array([self.state.t + 0.6 * span, end], info.dtype)
        rows = np.full((2, n, 2, info.nq), np.nan, info.dtype)
        u = None if s.u is None else np.array([x.u for x in starts], info.dtype)
        p = np.array([parameters(model, x) for x in starts], info.dtype)
        options = ffi.new("run_options *", {"t0": s.t, "t_end": end, "tol": self.tol, "rows": 2})
        options.max_step, options.stiff, options.steps = longest, stiff, steps
        options.times = pointer(times)
        if u is not None:
            options.u_instance = info.nu
        if model.batch.has_own_parameters:
            options.p_instance = 1
        recorder = EventRecorder(model, n)
        memory, outputs = ffi.new("run_memory[]", n), ffi.new("run_output[]", n)
        results: Any = np.frombuffer(ffi.buffer(outputs), model.batch.result_type)
        results["has_started"], results["t"] = 1, [x.t for x in starts]
        lib.begin_batch(n, pointer(rows[0]), pointer(rows[1]), 2, *recorder.room, memory, outputs)
        for _ in range(100_000):
            remaining = lib.integrate_batch(
                options, n, pointer(q), pointer(qd), model.c.null, pointer(u), pointer(p), outputs
            )
            if recorder.room:
                recorder.record(results["events"])
            if not remaining:
                break
        numbers = [results[k] for k in ("steps", "rejected", "evaluations", "stiff_steps")]
        counts = np.column_stack([*numbers, np.array(recorder.digests)])
        return AdaptiveBatchResult(
            np.hstack([q, qd]), results["t"].copy(), np.hstack([rows[0], rows[1]]), counts,
            results["status"].copy(),
        )  # fmt: skip

    def differing_instances(self) -> float:
        """Return the number of instances whose bits depend on the other instances or on the calls.

        Each instance is run several times: at another place in the batch, in calls of fewer steps
        and, for some instances, without others. All of these runs must give the same bits.
        """
        wrong, T = 0, self.span(self.state)
        for stiff, longest in ((False, 0.3 * T), (False, 0.0), (True, 0.0)):
            how: Any = {"stiff": stiff, "longest": longest}
            whole, few = (self.drive(self.starts, T, n, **how) for n in (1000, 1))
            back = self.drive(self.starts[::-1], T, 3, **how)
            single = [self.drive([x], T, 1000, **how) for x in self.starts[:3]]
            for k in range(INSTANCES):
                others = [
                    few[k],
                    back[INSTANCES - 1 - k],
                    *([single[k][0]] if k < len(single) else []),
                ]
                wrong += any(_have_different_bits(whole[k], other) for other in others)
        return float(wrong)

    def wrong_refusals(self) -> float:
        """Return the number of errors in a batch of which some instances must be refused.

        These instances start at nan or where D is singular. It is an error if such an instance is
        not refused, and if the result of another instance changes because of it.
        """
        T, rest = self.span(self.state), self.starts[3:]
        odd = [replace(self.state, t=math.nan), replace(self.state, q=self.state.q * math.nan)]
        known = _every_nth(self.singular, 4)
        odd += [replace(x, t=self.state.t, u=self.state.u) for x in known]
        result, expected = (self.drive(x, T, 1000) for x in ([*odd, *rest], rest))
        wrong = sum(
            _have_different_bits(result[k + len(odd)], expected[k]) for k in range(len(rest))
        )
        wrong += int(result.status[0] != NOT_FINITE) + int(result.status[1] == 0)
        wrong += sum(code not in (SINGULAR, NOT_FINITE) for code in result.status[2 : len(odd)])
        return float(wrong)


def _every_nth(states: list[State], count: int) -> list[State]:
    """Return about `count` of the states, evenly spaced in the list."""
    return states[:: max(1, len(states) // count)]


def _have_different_bits(one: list[Vector], other: list[Vector]) -> bool:
    return not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
