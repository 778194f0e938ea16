"""Checks of `project`, and of constrained systems whose mass matrix has no positive eigenvalue.

States are displaced from the constraints, and `project` must return them to where the reference
does, with and without fixed coordinates. States that can't be projected must be refused and left
unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from eomc.verify import kkt
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.rows_refusals import FACTORS, Refusals
from eomc.verify.rows_runs import parameters, run_in_c
from eomc.verify.sampling import Expected, State, evaluate_module

DISPLACEMENTS = (
    1e-6,
    1e-3,
    1e-2,
)  # of a state from the constraints, relative to the state's scale
FAR_FACTORS = (3.0, 30.0, 300.0)  # times the scale: the projection may not converge
VIOLATION = 0.1  # relative to the scale, of states that are fixed as a whole
MIN_SINGULAR_VALUE = 1e-4  # of the scaled KKT matrix without what is held: its least singular value
RESIDUAL_TOLERANCE = 1e-9  # of the terms of a row: single precision apart
OK, SINGULAR, NOT_FINITE, _, _, LOCKED = range(6)


def report(of: Comparison, module: Any, form: str) -> None:
    """Append checks of the module's function `project` to the report of `eomc check`.

    of: the comparison with its states, to whose report the checks are appended. module: the module
    of the optimised or the portable C code. form: prefix of the checks' names.
    """
    rows = ProjectionChecks(of, module)
    of.row(f"{form}project", LIMIT, "units of rounding", partial(rows.projected, False))
    of.row(f"{form}project, held", LIMIT, "units of rounding", partial(rows.projected, True))
    of.row(f"{form}project: refusals", 0, "calls that end otherwise", rows.refusals)


def of_inertia(of: Comparison, refusals: Refusals) -> None:
    """Append a check of the refusal of parameters without inertia to the report.

    With these parameters D has no positive eigenvalue. of: the comparison with its states, to whose
    report the check is appended. refusals: the checks of refusals.
    """
    checks = MasslessParameters(of, refusals)
    row = of.row
    row("no inertia: refusals", 0, "calls that do not refuse", checks.refuse)
    if not checks.states:
        last = of.rows[-1]
        of.rows[-1] = replace(last, unit=f"{last.unit}: no parameters take all inertia away")


@dataclass(frozen=True)
class ProjectionChecks:
    """Checks of the function `project`, which moves a state onto the constraints.

    of: the comparison, which supplies states and reference. module: the module of the optimised or
    the portable C code.
    """

    of: Comparison
    module: Any

    def projected(self, with_fixed: bool) -> float | Measurement:
        """Return the largest error of the states that `project` returns, in units of rounding.

        States displaced from the constraints are projected by the module and by the reference.
        with_fixed: whether one coordinate and its velocity are kept fixed. Nothing is judged (a
        Measurement with the reason) if there is no state to compare.
        """
        of = self.of
        scale = of.sampler.scale
        random = np.random.default_rng(11)

        def error(e: Expected, part: float) -> float | None:
            offset = part * scale * random.uniform(-1, 1, scale.shape)
            fixed = self._redundant_coordinate(e.state, random) if with_fixed else ()
            if fixed is None:
                return None
            s = replace(e.state, q=e.state.q + offset[0], qd=e.state.qd + offset[1])
            expected_state = self._expected_projection(s, fixed)
            if not np.all(np.isfinite(expected_state.q)) or not of.sampler.regular(expected_state):
                return None
            if of.sampler.wrong_rotations(expected_state):
                return None
            expected = of.sampler.expected(expected_state)
            if expected is None:
                return None
            result = self.module.project(
                s.q, s.qd, t=s.t, params=s.params, fixed=self._names(fixed)
            )
            size = np.abs([expected_state.q, expected_state.qd]) + scale + expected.size["place"]
            displacement = np.abs(np.array([expected_state.q - s.q, expected_state.qd - s.qd]))
            if np.any(displacement > (100 if fixed else 10) * part * scale):  # there may be several
                return None
            start = np.array([s.q, s.qd], of.dtype)
            unchanged = all(np.array_equal(np.array(result)[:, i], start[:, i]) for i in fixed)
            error = of.units(result, np.array([expected_state.q, expected_state.qd]), size)
            return error if unchanged else np.inf

        errors = [error(e, part) for e in of.few(6) for part in DISPLACEMENTS]
        why = "no state that is moved away has a place nearby"
        return largest(errors, "nothing can be held" if with_fixed else why)

    def _expected_projection(self, s: State, fixed: tuple[int, ...]) -> State:
        """Return the reference's projection of a state."""
        with np.errstate(all="ignore"):
            if not fixed:
                return self.of.sampler.project(s, nearest=True)
            q, qd = self.of.reference.project(s.q, s.qd, s.t, s.params, fixed)
        return replace(s, q=q, qd=qd)

    def _redundant_coordinate(
        self, s: State, random: np.random.Generator
    ) -> tuple[int, ...] | None:
        """Return a coordinate that can be fixed; None if the constraints determine every one."""
        D = self.of.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
        A = self.of.sampler.rows("constraint_jacobian", s)
        for i in random.permutation(len(s.q)).tolist():
            if kkt.is_regular(*kkt.with_fixed_coordinates(D, A, (i,)), MIN_SINGULAR_VALUE):
                return (i,)
        return None

    def _names(self, fixed: tuple[int, ...]) -> list[str]:
        names = [c.name for c in self.of.system.coordinates]
        return [name for i in fixed for name in (names[i], f"{names[i]}_dot")]

    def refusals(self) -> float:
        """Return the number of wrong results of `project` for states that are hard to project.

        A state that can't be projected must be refused (an error is returned) and left unchanged. A
        state far from the constraints must be refused or satisfy the constraints afterwards.
        """
        random = np.random.default_rng(13)
        scale = self.of.sampler.scale
        wrong = 0
        for e in self.of.few(4):
            wrong += sum(
                self._fails_to_refuse(s, fixed)
                for s, fixed in self._unreachable_states(e.state, scale)
            )
            for part in FAR_FACTORS:
                offset = part * scale * random.uniform(-1, 1, scale.shape)
                wrong += not self._is_projected_or_refused(
                    replace(e.state, q=e.state.q + offset[0], qd=offset[1])
                )
                near = replace(e.state, q=e.state.q / part + 1e-3 * offset[0])
                wrong += not self._is_projected_or_refused(
                    near
                )  # to the origin, where rows may turn over
        return float(wrong)

    def _unreachable_states(
        self, s: State, scale: Vector
    ) -> Iterator[tuple[State, tuple[int, int]]]:
        """Yield states that can't be projected, with flags: are positions, velocities fixed?"""
        rows = np.array([c.holonomic for c in self.of.system.constraints])
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
        status, unchanged, _ = self._project_in_c(s, fixed)
        return status not in (SINGULAR, NOT_FINITE, LOCKED) or not unchanged

    def _is_projected_or_refused(self, s: State) -> bool:
        """Return whether a state satisfies the constraints afterwards, or is refused unchanged."""
        status, unchanged, projected = self._project_in_c(s, (0, 0))
        if status:
            return unchanged
        holds = 1e-3 if self.of.dtype == np.float32 else RESIDUAL_TOLERANCE
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", projected))
        rows = np.array([c.holonomic for c in self.of.system.constraints])
        off = np.abs(evaluate_module(self.module, "constraints", projected))[rows]
        level = (A @ (np.abs(projected.q) + self.of.sampler.spread + np.max(np.abs(projected.q))))[
            rows
        ]
        return bool(np.all(np.isfinite(projected.q)) and np.all(off <= holds * level))

    def _project_in_c(self, s: State, fixed: tuple[int, int]) -> tuple[int, bool, State]:
        """Return the C function's status, whether the state is unchanged, and the new state."""
        model = self.module._model
        q, qd = (np.array(x, model.dtype) for x in (s.q, s.qd))
        before = np.array([q, qd])
        flags = [x for x in fixed for _ in s.q] if any(fixed) else None
        fixed_flags = model._ffi.NULL if flags is None else model._ffi.new("int[]", flags)
        code = model._lib.project(
            1, model._pointer(q), model._pointer(qd), s.t, fixed_flags,
            model._pointer(parameters(model, s)), model._c[2],
        )  # fmt: skip
        unchanged = np.array_equal(before, np.array([q, qd]), equal_nan=True)
        return int(code & 7), unchanged, replace(s, q=q.astype(float), qd=qd.astype(float))


class MasslessParameters:
    """Checks of refusals at states and parameters with which D has no positive eigenvalue.

    of: the comparison, which supplies states and reference. refusals: the checks of refusals.
    """

    def __init__(self, of: Comparison, refusals: Refusals) -> None:
        self.of, self.refusals = of, refusals
        self.states = list(self._massless_states())

    def _massless_states(self) -> Iterator[State]:
        defaults = self.of.sampler.defaults
        changes = [{n: f * (x or 1.0)} for n, x in defaults.items() for f in FACTORS[:4]]
        changes += [{n: f * x for n, x in defaults.items()} for f in (0.0, -1.0)]
        for change in changes:
            for e in self.of.few(2):
                s = replace(e.state, params={**defaults, **change}, u=None)
                with np.errstate(all="ignore"):
                    D = self.of.reference.evaluate("D", s.q, s.qd, s.t, None, s.params)
                if np.all(np.isfinite(D)) and np.linalg.eigvalsh(D)[-1] <= 0:
                    yield s

    def refuse(self) -> float:
        """Return the number of calls without inertia that return no error or write to outputs.

        The calls are `acceleration`, a run by each method, and `project`, with parameters with
        which D has no positive eigenvalue.
        """
        wrong = 0
        for s in self.states[:12]:
            status, clean = self.refusals.accelerate(s)
            wrong += status != SINGULAR or not clean
            for method in self.of.methods:
                run = run_in_c(self.of.module._model, method, s, self.of.system.run.h, 3)
                wrong += run.steps != 0 or run.status != SINGULAR
            for q in (s.q + 1e-3 * self.of.sampler.spread, s.q):
                x = replace(s, q=q, qd=s.qd + 1e-3 * self.of.sampler.speed)
                status, unchanged, _ = ProjectionChecks(self.of, self.of.module)._project_in_c(
                    x, (0, 0)
                )
                wrong += (
                    status not in (OK, SINGULAR) or not unchanged
                )  # OK: rows hold without lengths
        return float(wrong)
