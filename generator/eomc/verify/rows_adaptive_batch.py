"""Rows of `check` about adaptive steps of a batch: each instance is compared with a run of its own.

A batch is computed by other C functions than a single run; the two agree within the tolerance. At
another place in the batch, in other calls, or beside instances that fail, an instance has the same
bits.
"""

from __future__ import annotations

import math
import warnings
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import Measurement, largest
from eomc.verify.rows_adaptive import resolves_steps
from eomc.verify.rows_refusals import NOT_FINITE, SINGULAR
from eomc.verify.rows_runs import parameters
from eomc.verify.sampling import State, simulate

COUNT = 19  # instances: more than twice what any register holds
SINGULAR_STATE_COUNT = 4  # singular states
STEPS = 4  # of a run that is compared with that of one alone
TOLERANCE, MAX_STEP_FRACTION = {8: 1e-12, 4: 1e-6}, 0.3  # by bytes of a number; h_most, of a run
LIMIT, UNIT = 1.0, "tolerances a step"
EVENTS = 64  # of a call of each, beside those of a step
ROUNDING = 1e3  # in a tolerance's place, where that is smaller


@dataclass
class BatchResult:
    """Results of the C function `adaptive_batch` for n instances of the system.

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


def report(check: Comparison, singular: list[State]) -> None:
    """Append checks of batches with adaptive steps to the report of `eomc check`.

    There are none if the scene has no tolerance or no batches. singular: states at which the mass
    matrix D is singular; a batch must refuse them.
    """
    if check.system.run.tolerance is None or not check.system.run.batch:
        return
    rows = BatchRows(check, singular)
    check.row("adaptive steps of many", LIMIT, UNIT, rows.compare_with_single_runs)
    for module, form in check.forms:
        many = BatchRows(check, singular, module)
        check.row(f"{form}adaptive steps of many: bits", 0, "instances", many.differing_instances)
        check.row(f"{form}adaptive steps of many: refusals", 0, "instances", many.wrong_refusals)


class EventRecorder:
    """Buffers for the events of `count` instances in a batch, and a digest of the events so far.

    digests: for each instance, the number of its events and a checksum of them. room: the buffers
    as arguments of the C function.
    """

    def __init__(self, model: Any, count: int) -> None:
        self.digests: list[list[int]] = [[0, 0] for _ in range(count)]
        self.room: tuple[Any, ...] = ()
        if not model.events:
            return
        each = EVENTS + len(model.events)
        self.counts, self.which = np.zeros(count, "l"), np.zeros((count, each), "i")
        self.rows = np.zeros((count, each, 1 + 2 * model.nq), model.dtype)
        address, (long, integer) = model._c[0], model._whole
        places = address(long, self.counts), address(integer, self.which)
        self.room = (each, *places, model._pointer(self.rows))

    def record(self) -> None:
        """Add the events that the last call of the C function stored to the digests."""
        for k, n in enumerate(self.counts if self.room else ()):
            number, digest = self.digests[k]
            for which, row in zip(self.which[k, :n], self.rows[k, :n], strict=True):
                number, digest = number + 1, zlib.crc32(which.tobytes() + row.tobytes(), digest)
            self.digests[k] = [number, digest]


class BatchRows:
    """Checks of adaptive runs of a batch of COUNT instances, all of which start near one state.

    singular: states at which D is singular. module: the module of the optimised (default) or the
    portable C code.
    """

    def __init__(self, check: Comparison, singular: list[State], module: Any = None) -> None:
        self.check, self.module, self.singular = check, module or check.module, singular
        self.model = self.module._model
        self.tol = TOLERANCE[self.model.dtype.itemsize]
        states = [e.state for e in reversed(check.few(2))]
        self.state = s = next(filter(self.resolves_steps, states), states[0])
        random, sampler = np.random.default_rng(3), check.sampler
        self.starts = [
            sampler.project(replace(s, q=s.q + dq, qd=s.qd + dv))
            for dq, dv in zip(
                1e-2 * sampler.spread * random.standard_normal((COUNT, len(s.q))),
                1e-2 * sampler.speed * random.standard_normal((COUNT, len(s.q))), strict=True,
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
        return float(run.t[min(STEPS, len(run) - 1)]) - s.t if len(run) else 0.0

    def resolves_steps(self, s: State) -> bool:
        """Return whether times near s.t are precise enough for the adaptive steps from `s`."""
        return resolves_steps(self.check, s, self.span(s) / STEPS)

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
                u=None if s.u is None else np.tile(s.u, (COUNT, 1)), threads=1,
            )  # fmt: skip
        return largest(
            (self.end_error(many, k, times) for k in range(COUNT)), "no instance has a step"
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
        allowed = (self.tol + ROUNDING * self.check.eps) * (one.steps + 1)
        return float(np.nan_to_num(np.max(np.abs(x - one.x) / scale) / allowed, nan=math.inf))

    def drive(
        self, starts: list[State], span: float, steps: int, *, stiff: bool = False,
        longest: float = 0.0,
    ) -> BatchResult:  # fmt: skip
        """Return the results of an adaptive batch run by the C function `adaptive_batch`.

        starts: initial states of the instances. The run begins at the time of the checked state and
        lasts `span` seconds. steps: largest number of steps of each instance per call; calls are
        repeated until all instances are finished. stiff: whether to begin with Newton's method.
        longest: limit of the step size, s; 0 for none.
        """
        model, n, s = self.model, len(starts), starts[0]
        new = model._ffi.new
        q, qd = (np.array([getattr(x, k) for x in starts], model.dtype) for k in ("q", "qd"))
        t = np.array([x.t for x in starts], model.dtype)
        end = self.state.t + span
        times = np.array([self.state.t + 0.6 * span, end], model.dtype)
        rows = np.full((2, n, 2, model.nq), np.nan, model.dtype)
        row_counts, status, memory = np.zeros(n, "l"), np.zeros(n, "i"), new("adaptive_memory[]", n)
        for one in memory if stiff else ():
            one.stiff = 1
        u = None if s.u is None else np.array([x.u for x in starts], model.dtype)
        p = np.array([parameters(model, x) for x in starts], model.dtype)
        address, (long, integer) = model._c[0], model._whole
        recorder = EventRecorder(model, n)
        for _ in range(100_000):
            remaining = model._lib.adaptive_batch(
                n, *map(model._pointer, (q, qd, t)), end, self.tol, longest, model._pointer(u),
                model.nu, steps, model._pointer(times), 2, model._pointer(rows[0]),
                model._pointer(rows[1]), *recorder.room, model._pointer(p), 1, memory,
                address(long, row_counts), address(integer, status),
            )  # fmt: skip
            recorder.record()
            if not remaining:
                break
        counts = [
            [m.steps, m.rejected, m.evaluations, m.stiff_steps, *digest_entry]
            for m, digest_entry in zip(memory, recorder.digests, strict=True)
        ]
        return BatchResult(
            np.hstack([q, qd]), t, np.hstack([rows[0], rows[1]]), np.array(counts), status
        )

    def differing_instances(self) -> float:
        """Return the number of instances whose bits depend on the other instances or on the calls.

        Each instance is run several times: at another place in the batch, in calls of fewer steps
        and, for some instances, without others. All of these runs must give the same bits.
        """
        wrong, T = 0, self.span(self.state)
        for stiff, longest in ((False, MAX_STEP_FRACTION * T), (False, 0.0), (True, 0.0)):
            how: Any = {"stiff": stiff, "longest": longest}
            whole, few = (self.drive(self.starts, T, n, **how) for n in (1000, 1))
            back = self.drive(self.starts[::-1], T, 3, **how)
            single = [self.drive([x], T, 1000, **how) for x in self.starts[:3]]
            for k in range(COUNT):
                others = [few[k], back[COUNT - 1 - k], *([single[k][0]] if k < len(single) else [])]
                wrong += any(_differ(whole[k], other) for other in others)
        return float(wrong)

    def wrong_refusals(self) -> float:
        """Return the number of errors in a batch of which some instances must be refused.

        These instances start at nan or where D is singular. It is an error if such an instance is
        not refused, and if the result of another instance changes because of it.
        """
        T, rest = self.span(self.state), self.starts[3:]
        odd = [replace(self.state, t=math.nan), replace(self.state, q=self.state.q * math.nan)]
        known = self.singular[:: max(1, len(self.singular) // SINGULAR_STATE_COUNT)]
        odd += [replace(x, t=self.state.t, u=self.state.u) for x in known]
        result, expected = (self.drive(x, T, 1000) for x in ([*odd, *rest], rest))
        wrong = sum(_differ(result[k + len(odd)], expected[k]) for k in range(len(rest)))
        wrong += int(result.status[0] != NOT_FINITE) + int(result.status[1] == 0)
        wrong += sum(code not in (SINGULAR, NOT_FINITE) for code in result.status[2 : len(odd)])
        return float(wrong)


def _differ(one: list[Vector], other: list[Vector]) -> bool:
    return not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
