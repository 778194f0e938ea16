"""Checks of batches: order, size, shared and own parameters, instances that fail.

A batch is a run of many instances side by side. No bit of an instance's motion depends on the other
instances. So batches are compared with one another bit by bit, and with single runs, from which
they differ by rounding.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify.comparison import Check, Measurement, largest
from eomc.verify.reference import Vector
from eomc.verify.sampling import State
from support.template_checks.refusals import SINGULAR
from support.template_checks.runs import (
    EVERY,
    LONG,
    TURNS,
    RunChecks,
    RunResult,
    measured,
    run_in_c,
)

COUNT = 150  # instances: at least one full tile, and one that is not full
STEPS = 7
ALIKE = 1e3  # largest difference of a batch and single runs, in units of rounding


class BatchChecks:
    """Checks of batches: COUNT instances of a system, run side by side by fixed steps.

    runs: the checks of single runs. singular: states at which the mass matrix D is singular.
    """

    def __init__(self, runs: RunChecks, singular: list[State]) -> None:
        self.check, self.model, self.h = runs.check, runs.model, runs.h
        self.module, self.runs = self.check.module, runs
        self.random = np.random.default_rng(9)
        self.singular = singular
        self.instances = self.sample_instances()
        # direction of perturbed states, with different random parts so that no changes cancel
        shape, random = (2, self.model.info.nq), np.random.default_rng(10)
        self.direction = random.uniform(0.5, 1.5, shape) * random.choice([-1, 1], shape)

    def checks(self) -> Iterator[Check]:
        """Yield the checks of batches.

        They concern the values, the equality of bits with single runs, and instances that fail.
        """
        for method in self.check.methods:
            name = f"batch of {method}"
            error = partial(self.compare_with_single_steps, method)
            yield measured(name, ALIKE, "units of rounding, from single runs", error)
            find = partial(self.differing_batches, method)
            yield measured(f"{name}: places", 0, "batches with other bits", find)
            if not self.check.system.constraints:  # these would move the failing initial states
                find = partial(self.wrong_failures, method)
                yield measured(f"{name}: failures", 0, "instances that end otherwise", find)

    def sample_instances(self) -> list[State]:
        """Return COUNT initial states with different parameters, all with a regular mass matrix D.

        Some have angles of many turns. Some have velocities so high that the C code can't update
        sines within a step from the previous ones.
        """
        sampler, instances = self.check.sampler, []
        t = self.runs.states[-1].t
        own = [e.state for e in self.check.expected]
        for k in range(COUNT):
            s = own[k % len(own)]
            near = 1 + 1e-3 * self.random.standard_normal((2, len(s.q)))
            x = np.array([s.q, s.qd]) * near
            if k % 29 == 7:
                x[0] += sampler.angles * 2 * np.pi * np.round(TURNS / 2 / np.pi)
            if k % 7 == 3:  # angles move too far to update sines by rotations
                x[1] = x[1] + self.random.choice(LONG) * sampler.spread / self.h
            params = s.params or sampler.defaults
            instance = replace(s, q=x[0], qd=x[1], t=t, u=None, params=params)
            instances.append(self.project(instance, replace(s, t=t, u=None, params=params)))
        return instances

    def project(self, s: State, near: State) -> State:
        """Return the state `s` projected onto the constraints.

        If the projection fails, return that of the state `near`; if that fails too, return the
        scene's initial state.
        """
        if not self.check.system.constraints:
            return s
        sampler = self.check.sampler
        start = replace(sampler.start, t=0.0, params=sampler.defaults)
        onto = (sampler.project(x) for x in (s, near))
        return next((x for x in onto if np.all(np.isfinite(x.q))), replace(start, t=near.t))

    def simulate(
        self, method: str, states: list[State], u: Vector | None, *, own: bool = True,
        every: int = 1, h: float = 0.0,
    ) -> Any:  # fmt: skip
        """Return the run of a batch from the initial states `states`, by STEPS steps of `method`.

        u: inputs of the instances, (n, nu), or (n, STEPS, nu) with values for each step; None for
        the scene's signals, its formulas for the inputs. own: whether each instance has its state's
        parameters; otherwise all have those of the first state. every: only each `every`-th state
        is stored. h: step size, s; 0 for the scene's.
        """
        names = self.check.sampler.defaults
        params: Any = states[0].params
        if own:
            params = {x: np.array([(s.params or names)[x] for s in states]) for x in names}
        quiet = warnings.catch_warnings(action="ignore", category=RuntimeWarning)
        with np.errstate(all="ignore"), quiet:
            return self.module.simulate_batch(
                np.array([s.q for s in states]), np.array([s.qd for s in states]), h or self.h,
                steps=STEPS, every=every, params=params, u=u, threads=1, method=method,
                t0=states[0].t,
            )  # fmt: skip

    def input_kinds(self) -> list[Vector | None]:
        """Return the kinds of inputs with which batches are tried, as arguments of `simulate`.

        They are None for the scene's signals (its formulas for inputs), constant inputs (COUNT,
        nu), and inputs that change from step to step (COUNT, STEPS, nu). Without inputs, the list
        is [None].
        """
        if not self.model.info.nu:
            return [None]
        shape = (COUNT, STEPS, self.model.info.nu)
        rows = self.random.normal(size=shape).astype(self.model.info.dtype)
        return [None, rows[:, 0], rows]

    def compare_with_single_steps(self, method: str) -> float | Measurement:
        """Return the largest difference between steps in a batch and single steps, in roundings.

        Each single step starts at the state that an instance had in the batch before its step.
        Whole runs are not compared: if steps are too long for the motion, runs diverge by rounding
        alone.
        """
        errors: list[float | None] = []
        for u in self.input_kinds():
            runs = self.simulate(method, self.instances, u)
            for k, s in enumerate(self.instances):
                rows = np.stack([runs.q[k], runs.qd[k]])
                for n in range(int(runs.steps[k])):
                    row = u if u is None or u.ndim == 2 else u[:, n]
                    at = replace(s, q=rows[0, n], qd=rows[1, n], t=s.t + n * self.h,
                                 u=None if row is None else row[k])  # fmt: skip
                    errors.append(self.step_error(method, at, rows[:, n + 1]))
        return largest(errors, "no step of an instance has digits to compare")

    def step_error(self, method: str, s: State, end: Vector) -> float | None:
        """Return the difference between a step in a batch and a single step, in units of rounding.

        s: the state before the step. end: q and q̇ after the step in the batch, (2, nq). The result
        is None if rounding errors leave no digit to compare.
        """
        x, nudge = np.array([s.q, s.qd], float), self.check.eps ** (1 / 3)
        spread = self.runs.sampler.scale
        wide = float(np.max(1 + np.abs(x) / spread))  # magnifies rounding errors
        if wide * self.check.eps > nudge:
            return None
        alone = run_in_c(self.model, method, s, self.h, 1)
        q, qd = x + nudge * spread * self.direction
        moved = run_in_c(self.model, method, replace(s, q=q, qd=qd), self.h, 1)
        if alone.status or moved.status:
            return None
        # change of each number by a perturbation of the size of the spread
        grown = np.max(np.abs(moved.rows - alone.rows), axis=1) / nudge
        size = wide * (grown + np.abs(alone.rows[:, 1]))
        return self.check.units(end, alone.rows[:, 1], size)

    def differing_batches(self, method: str) -> float:
        """Return the number of batch runs in which some instance does not have the expected bits.

        The expected bits are those of a run of all instances together. They are compared with runs
        of the instances in another order, of fewer instances, with fewer stored states, and with
        single calls of `step_batch`. Without constraints, instances with long steps are also run
        beside other neighbours. Runs with shared and with own parameters may differ by rounding.
        """
        wrong = 0
        for u in self.input_kinds():
            whole = self.simulate(method, self.instances, u)
            order = self.random.permutation(COUNT)
            parts = [order, *(order[:n] for n in (1, 3, 9))]
            for part in parts:
                other = self.simulate(
                    method, [self.instances[k] for k in part], None if u is None else u[part]
                )
                wrong += not _are_permuted(other, whole, part)
            sparse = self.simulate(method, self.instances, u, every=EVERY)
            stored = np.minimum(EVERY * np.arange(sparse.q.shape[1]), STEPS)
            good = whole.status_codes == 0
            wrong += not np.array_equal(sparse.q[good], whole.q[good][:, stored])
            wrong += not np.array_equal(sparse.qd[good], whole.qd[good][:, stored])
            alike = [replace(s, params=self.instances[0].params) for s in self.instances]
            alike = [self.project(s, self.instances[0]) for s in alike]
            one, other = (self.simulate(method, alike, u, own=own) for own in (False, True))
            by = [self.simulate(method, self.with_rounding_errors(alike), u) for _ in range(2)]
            wrong += not self.differ_by_rounding_only(one, other, by)
            wrong += not self.first_step_agrees(method, whole, u)
        if self.check.system.constraints:
            return float(wrong)
        return float(
            wrong
            + sum(
                self.differs_with_neighbours(method, states, h)
                for states, h in self.long_step_cases()
            )
        )

    def with_rounding_errors(self, states: list[State]) -> list[State]:
        """Return copies of the states with each number of q and q̇ changed by about one rounding."""
        eps, n = self.check.eps, len(states[0].q)
        signs = self.random.choice([-eps, eps], (len(states), 2, n))
        moved = [
            np.array([s.q, s.qd]) + by * (np.abs([s.q, s.qd]) + self.runs.sampler.scale)
            for s, by in zip(states, signs, strict=True)
        ]
        return [replace(s, q=x[0], qd=x[1]) for s, x in zip(states, moved, strict=True)]

    def differ_by_rounding_only(self, one: Any, other: Any, rounded: Sequence[Any]) -> bool:
        """Return whether two batch runs, `one` and `other`, differ by rounding only.

        In one of them all instances share their parameters, in the other each has its own. Results
        may differ by rounding since a compiler may compute products of shared parameters before its
        loop. rounded: batch runs from initial states that are changed by one rounding; they show
        the effect of rounding.
        """
        spread = self.runs.sampler.scale[:, None, None]
        rows, others, *near = (np.array([x.q, x.qd], float) for x in (one, other, *rounded))
        with np.errstate(all="ignore"):
            noise = np.max([np.abs(x - others) for x in near], axis=0)
            size = STEPS * self.check.eps * (np.abs(others) + spread) + noise
            alike = (rows == others) | (np.abs(rows - others) <= ALIKE * size)
        alike |= (np.isnan(rows) & np.isnan(others)) | ~np.isfinite(noise)
        codes = one.status_codes == other.status_codes
        codes |= np.any([x.status_codes != other.status_codes for x in rounded], axis=0)
        return bool(np.all(alike) and np.all(codes))

    def long_step_cases(self) -> Iterator[tuple[list[State], float]]:
        """Yield pairs of initial states for a batch and a step size h (s) that is long for them.

        In such a step some angle moves too far for the C code to update its sine from the previous
        one: in some cases because of its velocity, in others because of its acceleration.
        """
        sampler, first = self.check.sampler, self.instances[0]
        fast = [replace(s, qd=s.qd + 0.7 * sampler.spread / self.h) for s in self.instances]
        yield fast, self.h
        for part in LONG:
            rest = [replace(s, qd=0 * s.qd) for s in self.instances]
            yield rest, self.runs.large_step(replace(first, qd=0 * first.qd), part)

    def differs_with_neighbours(self, method: str, states: list[State], h: float) -> int:
        """Return 1 if the bits of instances change when they get other neighbours, else 0.

        states: initial states of the instances, which are run by `method` with steps of h seconds.
        In the second run an instance with short steps is placed beside each of them.
        """
        mixed = [s for pair in zip(states, self.instances, strict=True) for s in pair]
        alone, other = (self.simulate(method, x, None, h=h) for x in (states, mixed))
        return not _are_permuted(alone, other, 2 * np.arange(COUNT))

    def first_step_agrees(self, method: str, whole: Any, u: Vector | None) -> bool:
        """Return whether one call of `step_batch` gives the bits of the first step of a batch run.

        whole: the batch run by `method`. u: its inputs, or None for the scene's signals.
        """
        q, qd = (np.array(x[:, 0]) for x in (whole.q, whole.qd))
        names = self.check.sampler.defaults
        params = {x: np.array([(s.params or names)[x] for s in self.instances]) for x in names}
        inputs = None if u is None else np.ascontiguousarray(u[:, 0] if u.ndim == 3 else u)
        failed = self.module.step_batch(
            q, qd, self.h, t=self.instances[0].t, u=inputs, params=params, method=method
        )
        good = failed == 0
        return bool(
            np.array_equal(q[good], whole.q[good, 1])
            and np.array_equal(qd[good], whole.qd[good, 1])
        )

    def wrong_failures(self, method: str) -> float:
        """Return the number of errors in batch runs in which some instances fail.

        It is an error if an instance that does not fail has other bits than in a batch without
        failing ones, or if a failing instance ends otherwise than in a single run.
        """
        states, bad = list(self.instances), [0, *range(5, COUNT, 11)]
        fast = 1e-3 * float(np.finfo(self.model.info.dtype).max)
        for n, k in enumerate(bad):
            if n % 2 and self.singular:
                s = self.singular[n % len(self.singular)]
                states[k] = replace(states[k], q=s.q, qd=s.qd, params=s.params)
            else:
                states[k] = replace(states[k], qd=states[k].qd + (1 + n) * fast)
        wrong = 0
        good = np.setdiff1d(np.arange(COUNT), bad)
        for u in self.input_kinds():
            for every in (1, EVERY):
                whole = self.simulate(method, self.instances, u, every=every)
                other = self.simulate(method, states, u, every=every)
                wrong += not np.array_equal(other.q[good], whole.q[good], equal_nan=True)
                wrong += not np.array_equal(other.qd[good], whole.qd[good], equal_nan=True)
            whole = self.simulate(method, states, u)
            for k in bad:
                at = replace(states[k], u=None if u is None else u[k])
                wrong += self.fails_differently(method, whole, k, at)
            none = self.simulate(method, [states[k] for k in bad], None if u is None else u[bad])
            wrong += not _are_permuted(none, whole, np.array(bad))
        return float(wrong + self.singular_starts_that_move(method))

    def singular_starts_that_move(self, method: str) -> int:
        """Return how many instances with a singular mass matrix D are not stopped at their start.

        The batch run by `method` must give each of them the error code for a singular D and make no
        step.
        """
        starts = self.singular[:: 1 + len(self.singular) // COUNT]
        states = [replace(self.instances[0], q=s.q, qd=s.qd, params=s.params) for s in starts]
        if not states:
            return 0
        batch = self.simulate(method, states, None)
        return int(np.sum((batch.status_codes != SINGULAR) | (batch.steps != 0)))

    def fails_differently(self, method: str, whole: Any, k: int, s: State) -> bool:
        """Return whether a failing instance of a batch run ends otherwise than in a single run.

        whole: the batch run by `method`. k: index of the failing instance. s: its initial state,
        with its inputs.
        """
        alone = run_in_c(self.model, method, s, self.h, STEPS)
        steps, status = int(whole.steps[k]), int(whole.status_codes[k])
        rows = np.stack([whole.q[k], whole.qd[k]])
        stored = rows[:, : steps + 1]
        if not np.all(np.isfinite(stored)) or not np.all(np.isnan(rows[:, steps + 1 :])):
            return True
        start = np.array([s.q, s.qd], rows.dtype)
        if (status == 0) != (steps == STEPS) or not np.array_equal(rows[:, 0], start):
            return True
        # a run that continues at such a speed has no correct digit
        if (
            alone.status != 0
            and 0 < steps <= alone.steps
            and self.differs_beyond_rounding(method, s, stored, alone)
        ):
            return True
        # rounding may decide whether a later step fails, but not a first step
        return alone.steps == 0 and not METHODS[method].implicit and (
            steps != 0 or status != alone.status
        )  # fmt: skip

    def differs_beyond_rounding(
        self, method: str, s: State, stored: Vector, alone: RunResult
    ) -> bool:
        """Return whether an instance's last state in a batch differs by more than rounding.

        It is compared with the same state of a single run. s: the initial state. stored: q and q̇
        of the instance in the batch, (2, n, nq). alone: the single run. How much rounding may
        change the state follows from runs with slightly changed initial velocities.
        """
        known, far = alone.rows[:, stored.shape[1] - 1], 1e-3
        near = [
            run_in_c(
                self.model, method, replace(s, qd=s.qd * (1 + k * self.check.eps)), self.h, STEPS
            )
            for k in (-3, -2, -1, 1, 2, 3)
        ]
        with np.errstate(all="ignore"):  # runs may end earlier
            rounded = np.max([np.abs(x.rows[:, stored.shape[1] - 1] - known) for x in near], axis=0)
            off = np.abs(stored[:, -1] - known)
            return bool(np.any(off > far * np.abs(known) + 10 * rounded))


def _are_permuted(one: Any, other: Any, order: Any) -> bool:
    """Whether instance k of one is instance order[k] of the other."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name)[order], equal_nan=True)
        for name in ("q", "qd", "steps", "status_codes")
    )
