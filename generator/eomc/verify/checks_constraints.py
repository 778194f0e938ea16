"""Checks of constraints: residuals, Jacobian A, multipliers, projection, reactions.

They use states that the reference has projected onto the constraints, states along a run, and both
forms of C. Multipliers and accelerations are compared with those of a dense KKT matrix in NumPy
(`kkt`), a corrected step in `comparison` with a step that Newton's method projects. Of the module
alone it is tested whether multipliers have power only where constraints depend on time, whether A
is the derivative of the constraint equations, and whether reactions have the power of multipliers.

States are also displaced from the constraints, and the module's `project` must return them to where
the reference does, with and without fixed coordinates. States that can't be projected, and mass
matrices without a positive eigenvalue, must be refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from eomc.runtime.package import model_of
from eomc.scene.assembly import LoopJoint
from eomc.verify import kkt
from eomc.verify.checks_bodies import MotionLine, widths
from eomc.verify.checks_refusals import FACTORS, LOCKED, NOT_FINITE, OK, SINGULAR, RefusalChecks
from eomc.verify.checks_runs import parameters, run_in_c
from eomc.verify.comparison import Comparison
from eomc.verify.reference import STENCIL, Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import (
    EPS,
    MAX_DISTANCE,
    Expected,
    State,
    evaluate_module,
    simulate,
    states_of_run,
)

VALUES = ("constraints", "constraint_rates", "constraint_jacobian", "multipliers")
WORK_TOLERANCE = 1e-9  # relative error of virtual work; velocities of bodies are exact to 1e-12
MAX_RESIDUAL = 450.0  # units of rounding: residual of constraints in a run, 1e-13 of their terms
SLOPE_LIMIT = 1e-7  # relative error of A, by differences of order 8; a wrong sign makes 1
UNITS = "units of rounding"


def report(check: Comparison) -> None:
    """Append checks of constraints to the report of `eomc check`.

    The system must have constraints.
    """
    checks = ConstraintChecks(check, check.module)
    for name in VALUES:
        check.add_check(name, LIMIT, UNITS, partial(check.value_error, name))
    if check.dtype == np.float64:  # difference quotients need its digits
        check.add_check("A beside differences", SLOPE_LIMIT, "of A", checks.jacobian_error)
        if check.system.run.needs_derivatives and not check.system.modes:
            check.add_check("tangent", SLOPE_LIMIT, "of the rows' slopes", checks.tangent_error)
    check.add_check("power of multipliers", LIMIT, UNITS, checks.power_error)
    if check.system.reactions:
        limit = max(WORK_TOLERANCE, 30 * check.eps)  # the latter in single precision
        check.add_check("reactions: virtual work", limit, "of its size", checks.reaction_error)
    for module, form in check.forms:
        own = ConstraintChecks(check, module)
        if form:
            find = partial(_values, check, module)
            check.add_check("plain C: constraints", LIMIT, UNITS, find)
        report_projection(check, module, form)
        for method in check.methods:
            measure = partial(own.residual_along_run, method)
            check.add_check(f"{form}{method} on the constraints", MAX_RESIDUAL, UNITS, measure)


def _values(check: Comparison, module: Any) -> float:
    """Return the largest error of all values of another form at all states."""

    def error(e: Expected) -> float:
        entries = ((evaluate_module(module, n, e.state), e.value[n], e.size[n]) for n in VALUES)
        return float(np.max([check.units(*each) for each in entries]))

    return check.largest(error)


class ConstraintChecks:
    """Checks of constraints for one module, compiled from the optimised or the portable C code.

    holonomic: for each constraint equation, whether it restricts positions (holonomic) rather than
    velocities.
    """

    def __init__(self, check: Comparison, module: Any) -> None:
        self.check, self.module, self.system = check, module, check.system
        self.holonomic = np.array([c.holonomic for c in check.system.constraints])

    def jacobian_error(self) -> float:
        """Return the largest relative error of the module's constraint Jacobian A over the states.

        The exact A is a difference quotient of the constraint equations, with respect to q for
        holonomic and with respect to q̇ for nonholonomic equations. Steps of several widths are
        used and the one with the smallest error counts, since no width makes a wrong A right.
        """
        check, spread = self.check, self.check.sampler.spread
        moving = [i for i, q in enumerate(self.system.q) if q in self.system.rates]

        def error(e: Expected) -> float:
            s = e.state
            A = evaluate_module(self.module, "constraint_jacobian", s)
            size = (
                np.abs(A) + np.max(np.abs(A), axis=1, keepdims=True) + e.size["constraint_jacobian"]
            )

            def off(width: float) -> float:
                differences = np.zeros_like(A)
                for i in moving:
                    step = width * spread[i]
                    for field, rows in (("q", self.holonomic), ("qd", ~self.holonomic)):
                        if np.any(rows):
                            differences[rows, i] = self._slope(s, field, i, step)[rows]
                return float(np.max(np.abs(differences - A) / size))

            return min(off(width) for width in (0.1, 0.03, 0.01, 0.003, 1e-3))

        return check.largest(error)

    def tangent_error(self) -> float:
        """Return how much constraints and their rates change along the module's tangent directions.

        The module's function `tangent` returns directions in [q; q̇] along which the constraints
        stay satisfied, so that the change must be zero. The result is relative to the sum of the
        absolute values of the terms of the change.
        """
        moving = [i for i, q in enumerate(self.system.q) if q in self.system.rates]
        steps = {"q": self.check.sampler.spread, "qd": self.check.sampler.speed}

        def error(e: Expected) -> float:
            s, n = e.state, len(self.system.q)
            T = self.module.tangent(s.q, s.qd, t=s.t, params=s.params)

            def off(width: float) -> float:
                J = np.zeros((2, len(self.holonomic), 2 * n))
                for half, (field, sizes) in enumerate(steps.items()):
                    for i in moving:
                        at = field, i, width * sizes[i]
                        if field == "q":
                            J[0, self.holonomic, i] = self._slope(s, *at)[self.holonomic]
                        J[1, :, half * n + i] = self._slope(s, *at, name="constraint_rates")
                size = np.abs(J) @ np.abs(T) + np.max(np.abs(J), axis=2, keepdims=True)
                return float(np.max(np.abs(J @ T) / (size + 1e-300), initial=0))

            return min(off(width) for width in (0.1, 0.03, 0.01, 0.003, 1e-3))

        return self.check.largest(error, 2)

    def _slope(
        self, s: State, field: str, i: int, step: float, name: str = "constraints"
    ) -> Vector:
        total = np.zeros(len(self.system.constraints))
        for n, weight in STENCIL:
            for k in (n, -n):
                x = getattr(s, field).copy()
                x[i] += k * step
                at = replace(s, **{field: x})
                total += (
                    (weight if k > 0 else -weight) * evaluate_module(self.module, name, at) / step
                )
        return total

    def power_error(self) -> float:
        """Return the largest error of the power of the multipliers, λ·(A q̇), in units of rounding.

        A q̇ + b are the rates of the constraint equations, and must be zero. The expected power is
        therefore -λ·b, which is 0 unless constraints depend on time.
        """

        def error(e: Expected) -> float:
            s = e.state
            names = ("multipliers", "constraint_jacobian")
            multipliers, A = (evaluate_module(self.module, n, s) for n in names)
            b = evaluate_module(self.module, "constraint_rates", replace(s, qd=0 * s.qd))
            work, power = multipliers * (A @ s.qd), -multipliers * b
            size = np.abs(multipliers) * e.size["constraint_rates"]
            size = size + e.size["multipliers"] * (np.abs(A) @ np.abs(s.qd))
            return self.check.units(work, power, size)

        return self.check.largest(error)

    def reaction_error(self) -> float:
        """Return the largest relative error of the virtual work of reactions over some states.

        Reactions are the force and moment at the point of a closed loop: they act on the loop's
        second body and, reversed, on the first one. When one coordinate moves, their work must
        equal that of the loop's multipliers, λ·A. Velocities of the bodies are computed from the
        scene file.
        """
        return self.check.largest(self._work, 4)

    def _work(self, e: Expected) -> float:
        s, scene = e.state, self.system.scene
        assert scene is not None and scene.assembly is not None
        reactions = self.module.reactions(s.q, s.qd, t=s.t, u=s.u, params=s.params)
        multipliers, A = (
            evaluate_module(self.module, n, s) for n in ("multipliers", "constraint_jacobian")
        )
        loops = {loop.name: loop for loop in scene.assembly.loops}
        spread, worst = self.check.sampler.spread, 0.0
        for name in (r.name for r in self.system.reactions):
            rows = [k for k, c in enumerate(self.system.constraints) if c.loop == name]
            force = np.asarray(reactions[name], float)
            expected = multipliers[rows] @ A[rows]
            size = np.abs(multipliers[rows]) @ np.abs(A[rows])
            least = float(np.max(size, initial=0)) or 1.0
            for j, moving in enumerate(np.diag(np.maximum(spread, 1))):
                powers = (
                    self._reaction_power(loops[name], s, moving, x, force)
                    for x in widths(spread, moving)
                )
                off = (abs(power - expected[j]) for power in powers if not math.isnan(power))
                worst = max(worst, min(off, default=math.inf) / least)
        return worst

    def _reaction_power(
        self, loop: LoopJoint, s: State, moving: Vector, width: float, force: Vector
    ) -> float:
        """Return a reaction's power at velocities `moving`, less that at rest, per their sum."""
        total, scene = 0.0, self.system.scene
        assert scene is not None
        for sign, qd in ((1, moving), (-1, 0 * moving)):
            with np.errstate(all="ignore"):
                line = MotionLine(
                    scene, self.check.sampler.with_discrete_parameters(replace(s, qd=qd)), width
                )
                m, second = line.middle, line.frames[loop.bodies[1]]
                point = line.vector(loop.points[1]) if loop.points else np.zeros(3)
                at = second.point(point)[m]
                v, w = (x[m] for x in line.motion(second, point))
                first = line.frames[loop.bodies[0]]
                v0, w0 = (x[m] for x in line.motion(first, np.zeros(3)))
            v, w = v - (v0 + np.cross(w0, at - first.at[m])), w - w0
            twist = [*v[:2], w[2]] if self.system.plane else [*v, *w]
            total += sign * float(force @ np.array(twist))
        return float(total / np.sum(moving))

    def residual_along_run(self, method: str) -> float | Measurement:
        """Return the largest residual of constraints and of their rates along runs, in roundings.

        The runs by `method` start at a few states.
        """
        check = self.check
        errors: list[float | None] = []
        for e in check.few(3):
            s = replace(e.state, u=None)
            with np.errstate(divide="ignore"):  # coordinates move by 2 % of their range in a step
                longest = 0.02 * float(np.min(check.sampler.spread / np.abs(s.qd)))
            how = {"h": min(check.system.run.h, longest), "steps": 200, "every": 5}
            run = simulate(self.module, s, t0=s.t, method=method, **how)
            for at in states_of_run(run, s)[1:]:  # fewer if the run stops early
                far = np.abs([at.q - s.q, at.qd - s.qd])
                if np.any(far >= MAX_DISTANCE * check.sampler.scale):  # h is too long
                    break
                errors += [self._off(at, "constraints"), self._off(at, "constraint_rates")]
        return largest(errors, "no step is taken, or all lead too far")

    def _off(self, s: State, name: str) -> float | None:
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", s))
        off = np.abs(evaluate_module(self.module, name, s))
        if name == "constraints":
            off, A = off[self.holonomic], A[self.holonomic]
            scale = np.abs(s.q) + self.check.sampler.spread
        else:
            scale = np.abs(s.qd) + self.check.sampler.speed
        if not len(off):
            return None
        turned = self._rate_sensitivity(s) if name == "constraint_rates" else 0.0
        size = A @ scale + turned
        residual = self.check.units(off, 0 * off, size)
        # redundant equations have larger residuals where the others are almost dependent
        if residual > MAX_RESIDUAL:
            residual = self.check.units(
                off, 0 * off, size + self._reference_residual(name, s)[: len(off)]
            )
        return residual

    def _reference_residual(self, name: str, s: State) -> Vector:
        """Return the residual that the reference leaves near a state, in units."""
        q, qd = self.check.sampler.rounded(s)
        with np.errstate(all="ignore"):
            q, qd = self.check.reference.corrected(q, qd, s.t, s.params)
            residuals = [
                self.check.reference.evaluate(name, *x, s.t, None, s.params)
                for x in zip(q, qd, strict=True)
            ]
        return np.asarray(np.nan_to_num(np.max(np.abs(residuals), axis=0)) / EPS)

    def _rate_sensitivity(self, s: State) -> Vector:
        """Return how rates of constraints change with each coordinate, times the coordinate's size.

        A predicted sine is as precise as its angle, which may be large.
        """
        total = np.zeros(len(self.system.constraints))
        for i, q in enumerate(s.q):
            step, x = 1e-4 * self.check.sampler.spread[i], s.q.copy()
            x[i] += step
            change = evaluate_module(self.module, "constraint_rates", replace(s, q=x))
            change = change - evaluate_module(self.module, "constraint_rates", s)
            total += np.abs(change) / step * abs(q)
        return total


# --- projection onto the constraints --------------------------------------------------------------

VIOLATION = 0.1  # displacement of fixed states from the constraints, relative to the scale


def report_projection(check: Comparison, module: Any, form: str) -> None:
    """Append checks of the module's function `project` to the report of `eomc check`.

    module: the module of the optimised or the portable C code. form: prefix of the checks' names.
    """
    checks = ProjectionChecks(check, module)
    check.add_check(f"{form}project", LIMIT, UNITS, partial(checks.projection_error, False))
    check.add_check(f"{form}project, held", LIMIT, UNITS, partial(checks.projection_error, True))
    check.add_check(
        f"{form}project: refusals", 0, "calls that end otherwise", checks.wrong_refusals
    )


def report_massless(check: Comparison, refusals: RefusalChecks) -> None:
    """Append a check of the refusal of parameters without inertia to the report.

    With these parameters D has no positive eigenvalue. refusals: the checks of refusals.
    """
    checks = MasslessChecks(check, refusals)
    check.add_check("no inertia: refusals", 0, "calls that do not refuse", checks.missing_refusals)
    if not checks.states:
        last = check.results[-1]
        check.results[-1] = replace(last, unit=f"{last.unit}: no parameters take all inertia away")


@dataclass(frozen=True)
class ProjectionChecks:
    """Checks of the function `project`, which moves a state onto the constraints.

    check: the comparison, which supplies states and reference. module: the module of the optimised
    or the portable C code.
    """

    check: Comparison
    module: Any

    def projection_error(self, with_fixed: bool) -> float | Measurement:
        """Return the largest error of the states that `project` returns, in units of rounding.

        States displaced from the constraints are projected by the module and by the reference.
        with_fixed: whether one coordinate and its velocity are kept fixed. Nothing is judged (a
        Measurement with the reason) if there is no state to compare.
        """
        check = self.check
        scale = check.sampler.scale
        random = np.random.default_rng(11)

        def error(e: Expected, part: float) -> float | None:
            offset = part * scale * random.uniform(-1, 1, scale.shape)
            fixed = self._redundant_coordinate(e.state, random) if with_fixed else ()
            if fixed is None:
                return None
            s = replace(e.state, q=e.state.q + offset[0], qd=e.state.qd + offset[1])
            expected_state = self._expected_projection(s, fixed)
            if not np.all(np.isfinite(expected_state.q)) or not check.sampler.regular(
                expected_state
            ):
                return None
            if check.sampler.wrong_rotations(expected_state):
                return None
            expected = check.sampler.expected(expected_state)
            if expected is None:
                return None
            result = self.module.project(
                s.q, s.qd, t=s.t, params=s.params, fixed=self._names(fixed)
            )
            size = np.abs([expected_state.q, expected_state.qd]) + scale + expected.size["place"]
            displacement = np.abs(np.array([expected_state.q - s.q, expected_state.qd - s.qd]))
            if np.any(displacement > (100 if fixed else 10) * part * scale):  # another solution
                return None
            start = np.array([s.q, s.qd], check.dtype)
            unchanged = all(np.array_equal(np.array(result)[:, i], start[:, i]) for i in fixed)
            error = check.units(result, np.array([expected_state.q, expected_state.qd]), size)
            return error if unchanged else np.inf

        # displacements from the constraints, relative to the scale of the states
        errors = [error(e, part) for e in check.few(6) for part in (1e-6, 1e-3, 1e-2)]
        why = "no state that is moved away has a place nearby"
        return largest(errors, "nothing can be held" if with_fixed else why)

    def _expected_projection(self, s: State, fixed: tuple[int, ...]) -> State:
        """Return the reference's projection of a state."""
        with np.errstate(all="ignore"):
            if not fixed:
                return self.check.sampler.project(s, nearest=True)
            q, qd = self.check.reference.project(s.q, s.qd, s.t, s.params, fixed)
        return replace(s, q=q, qd=qd)

    def _redundant_coordinate(
        self, s: State, random: np.random.Generator
    ) -> tuple[int, ...] | None:
        """Return a coordinate that can be fixed; None if the constraints determine every one."""
        D = self.check.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
        A = self.check.sampler.rows("constraint_jacobian", s)
        for i in random.permutation(len(s.q)).tolist():
            if kkt.is_regular(*kkt.with_fixed_coordinates(D, A, (i,)), 1e-4):
                return (i,)
        return None

    def _names(self, fixed: tuple[int, ...]) -> list[str]:
        names = [c.name for c in self.check.system.coordinates]
        return [name for i in fixed for name in (names[i], f"{names[i]}_dot")]

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
