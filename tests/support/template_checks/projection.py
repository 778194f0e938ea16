"""Checks of refusals by `project`, and of parameters without inertia."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eomc.runtime.package import model_of
from eomc.verify.comparison import Check, Comparison
from eomc.verify.reference import Vector
from eomc.verify.sampling import State, evaluate_module
from support.template_checks.refusals import (
    FACTORS,
    LOCKED,
    NOT_FINITE,
    OK,
    SINGULAR,
    RefusalChecks,
)
from support.template_checks.runs import measured, parameters, run_in_c

VIOLATION = 0.1  # displacement of fixed states from the constraints, relative to the scale


def checks(check: Comparison, refusals: RefusalChecks) -> Iterator[Check]:
    """Yield checks of refusals by `project` and of states without inertia, under constraints."""
    if not check.system.constraints:
        return
    for form in check.forms:
        prefix = "" if form.module is check.module else "plain C: "
        find = ProjectionChecks(check, form.module).wrong_refusals
        yield measured(f"{prefix}project: refusals", 0, "calls that end otherwise", find)
    massless = MasslessChecks(check, refusals)
    unit = "calls that do not refuse"
    yield measured("no inertia: refusals", 0, unit, massless.missing_refusals)


@dataclass(frozen=True)
class ProjectionChecks:
    """Checks of the function `project`, which moves a state onto the constraints.

    check: the comparison, which supplies states and reference. module: the module of the optimised
    or the portable C code.
    """

    check: Comparison
    module: Any

    def wrong_refusals(self) -> float:
        """Return the number of wrong results of `project` for states that are hard to project.

        A state that can't be projected must be refused (an error is returned) and left unchanged. A
        state far from the constraints must be refused or satisfy the constraints afterwards.
        """
        random = np.random.default_rng(13)
        scale = self.check.sampler.scale
        wrong = 0
        for e in self.check.few(4):
            wrong += sum(
                self._fails_to_refuse(s, fixed)
                for s, fixed in self._unreachable_states(e.state, scale)
            )
            for part in (3.0, 30.0, 300.0):  # times the scale: projections may not converge
                offset = part * scale * random.uniform(-1, 1, scale.shape)
                wrong += not self._is_projected_or_refused(
                    replace(e.state, q=e.state.q + offset[0], qd=offset[1])
                )
                # near the origin, the gradient of an equation may vanish
                near = replace(e.state, q=e.state.q / part + 1e-3 * offset[0])
                wrong += not self._is_projected_or_refused(near)
        return float(wrong)

    def _unreachable_states(
        self, s: State, scale: Vector
    ) -> Iterator[tuple[State, tuple[int, int]]]:
        """Yield states that can't be projected, with flags: are positions, velocities fixed?"""
        rows = np.array([c.holonomic for c in self.check.system.constraints])
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", s))
        off = replace(s, q=s.q + VIOLATION * scale[0])
        residual = np.abs(evaluate_module(self.module, "constraints", off))
        if np.any((residual > VIOLATION / 10 * (A @ scale[0]))[rows]):
            yield off, (1, 1)
        off = replace(s, qd=s.qd + VIOLATION * scale[1])
        residual = np.abs(evaluate_module(self.module, "constraint_rates", off))
        if np.any(residual > VIOLATION / 10 * (A @ scale[1])):
            yield off, (0, 1)
        q, qd = s.q.copy(), s.qd.copy()
        q[0] = qd[-1] = np.nan
        yield replace(s, q=q), (0, 0)
        yield replace(s, qd=qd), (0, 0)

    def _fails_to_refuse(self, s: State, fixed: tuple[int, int]) -> bool:
        """Return whether `project` does not refuse a state, or changes it."""
        status, unchanged, _ = self.project_in_c(s, fixed)
        return status not in (SINGULAR, NOT_FINITE, LOCKED) or not unchanged

    def _is_projected_or_refused(self, s: State) -> bool:
        """Return whether a state satisfies the constraints afterwards, or is refused unchanged."""
        status, unchanged, projected = self.project_in_c(s, (0, 0))
        if status:
            return unchanged
        holds = 1e-3 if self.check.dtype == np.float32 else 1e-9  # of the terms of a constraint
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", projected))
        rows = np.array([c.holonomic for c in self.check.system.constraints])
        off = np.abs(evaluate_module(self.module, "constraints", projected))[rows]
        level = (
            A @ (np.abs(projected.q) + self.check.sampler.spread + np.max(np.abs(projected.q)))
        )[rows]
        return bool(np.all(np.isfinite(projected.q)) and np.all(off <= holds * level))

    def project_in_c(self, s: State, fixed: tuple[int, int]) -> tuple[int, bool, State]:
        """Return the C function's status, whether the state is unchanged, and the new state."""
        model = model_of(self.module)
        q, qd = (np.array(x, model.info.dtype) for x in (s.q, s.qd))
        before = np.array([q, qd])
        flags = [x for x in fixed for _ in s.q] if any(fixed) else None
        fixed_flags = model.c.ffi.NULL if flags is None else model.c.ffi.new("int[]", flags)
        code = model.c.lib.project(
            1, model.c.pointer(q), model.c.pointer(qd), s.t, fixed_flags,
            model.c.pointer(parameters(model, s)), model.c.tools[2],
        )  # fmt: skip
        unchanged = np.array_equal(before, np.array([q, qd]), equal_nan=True)
        return int(code & 7), unchanged, replace(s, q=q.astype(float), qd=qd.astype(float))


class MasslessChecks:
    """Checks of refusals at states and parameters with which D has no positive eigenvalue.

    check: the comparison, which supplies states and reference. refusals: the checks of refusals.
    """

    def __init__(self, check: Comparison, refusals: RefusalChecks) -> None:
        self.check, self.refusals = check, refusals
        self.states = list(self._massless_states())

    def _massless_states(self) -> Iterator[State]:
        defaults = self.check.sampler.defaults
        changes = [{n: f * (x or 1.0)} for n, x in defaults.items() for f in FACTORS[:4]]
        changes += [{n: f * x for n, x in defaults.items()} for f in (0.0, -1.0)]
        for change in changes:
            for e in self.check.few(2):
                s = replace(e.state, params={**defaults, **change}, u=None)
                with np.errstate(all="ignore"):
                    D = self.check.reference.evaluate("D", s.q, s.qd, s.t, None, s.params)
                if np.all(np.isfinite(D)) and np.linalg.eigvalsh(D)[-1] <= 0:
                    yield s

    def missing_refusals(self) -> float:
        """Return the number of calls without inertia that return no error or write to outputs.

        The calls are `acceleration`, a run by each method, and `project`, with parameters with
        which D has no positive eigenvalue.
        """
        wrong = 0
        for s in self.states[:12]:
            status, clean = self.refusals.accelerate(s)
            wrong += status != SINGULAR or not clean
            for method in self.check.methods:
                run = run_in_c(model_of(self.check.module), method, s, self.check.system.run.h, 3)
                wrong += run.steps != 0 or run.status != SINGULAR
            for q in (s.q + 1e-3 * self.check.sampler.spread, s.q):
                x = replace(s, q=q, qd=s.qd + 1e-3 * self.check.sampler.speed)
                projection = ProjectionChecks(self.check, self.check.module)
                status, unchanged, _ = projection.project_in_c(x, (0, 0))
                # OK if the equations hold everywhere, as with lengths of 0
                wrong += status not in (OK, SINGULAR) or not unchanged
        return float(wrong)
