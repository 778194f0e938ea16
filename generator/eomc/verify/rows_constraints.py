"""Rows of `check` about constraints: residuals, Jacobian A, multipliers, projection, reactions.

They use states that the reference has projected onto the constraints, states along a run, and both
forms of C. Multipliers and accelerations are compared with those of a dense KKT matrix in NumPy
(`kkt`), a corrected step in `comparison` with a step that Newton's method projects. Of the module
alone it is tested whether multipliers have power only where constraints depend on time, whether A
is the derivative of the constraint equations, and whether reactions have the power of multipliers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.scene.assembly import LoopJoint
from eomc.verify import rows_projection
from eomc.verify.comparison import Comparison
from eomc.verify.reference import STENCIL, Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.rows_bodies import Line, widths
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
WORK = 1e-9  # of what multipliers do: velocities of bodies are good to 1e-12
ROUNDED = 30  # roundings of multipliers and forces, where those are more: in single precision
STATES = 4
STEPS = 200  # of a run that is to stay on the rows
SHARE = 0.02  # of how far things go, in a step of it
MAX_RESIDUAL = 450.0  # units: what rows may be along it, 1e-13 of their terms
SLOPE = 1e-7  # of A: differences of order 8, in 16 digits; a wrong sign makes 1
SLIGHT = 1e-4  # of how far things go: a difference for the size of a slope
UNITS = "units of rounding"


def report(check: Comparison) -> None:
    """Append checks of constraints to the report of `eomc check`, if the scene has constraints."""
    rows = FormRows(check, check.module)
    for name in VALUES:
        check.row(name, LIMIT, UNITS, partial(check.value, name))
    if check.dtype == np.float64:  # single precision leaves differences too few digits
        check.row("A beside differences", SLOPE, "of A", rows.slopes)
        if check.system.run.needs_derivatives and not check.system.modes:
            check.row("tangent", SLOPE, "of the rows' slopes", rows.tangent)
    check.row("power of multipliers", LIMIT, UNITS, rows.power)
    if check.system.reactions:
        limit = max(WORK, ROUNDED * check.eps)
        check.row("reactions: virtual work", limit, "of its size", rows.reactions)
    for module, form in check.forms:
        own = FormRows(check, module)
        if form:
            find = partial(_values, check, module)
            check.row("plain C: constraints", LIMIT, UNITS, find)
        rows_projection.report(check, module, form)
        for method in check.methods:
            measure = partial(own.residual_along_run, method)
            check.row(f"{form}{method} on the constraints", MAX_RESIDUAL, UNITS, measure)


def _values(check: Comparison, module: Any) -> float:
    """Return the largest error of all values of another form at all states."""

    def error(e: Expected) -> float:
        entries = ((evaluate_module(module, n, e.state), e.value[n], e.size[n]) for n in VALUES)
        return float(np.max([check.units(*each) for each in entries]))

    return check.largest(error)


class FormRows:
    """Checks of constraints for one module, compiled from the optimised or the portable C code.

    holonomic: for each constraint equation, whether it restricts positions (holonomic) rather than
    velocities.
    """

    def __init__(self, check: Comparison, module: Any) -> None:
        self.check, self.module, self.system = check, module, check.system
        self.holonomic = np.array([c.holonomic for c in check.system.constraints])

    def slopes(self) -> float:
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

    def tangent(self) -> float:
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

    def power(self) -> float:
        """Return the largest error of the power of the multipliers, λ·(A q̇), in units of rounding.

        A q̇ + b are the rates of the constraint equations, and must be zero. The expected power is
        therefore -λ·b, which is 0 unless constraints depend on time.
        """

        def error(e: Expected) -> float:
            s = e.state
            names = ("multipliers", "constraint_jacobian")
            multipliers, A = (evaluate_module(self.module, n, s) for n in names)
            b = evaluate_module(self.module, "constraint_rates", replace(s, qd=0 * s.qd))
            work, done = multipliers * (A @ s.qd), -multipliers * b
            size = np.abs(multipliers) * e.size["constraint_rates"]
            size = size + e.size["multipliers"] * (np.abs(A) @ np.abs(s.qd))
            return self.check.units(work, done, size)

        return self.check.largest(error)

    def reactions(self) -> float:
        """Return the largest relative error of the virtual work of reactions over some states.

        Reactions are the force and moment at the point of a closed loop: they act on the loop's
        second body and, reversed, on the first one. When one coordinate moves, their work must
        equal that of the loop's multipliers, λ·A. Velocities of the bodies are computed from the
        scene file.
        """
        return self.check.largest(self._work, STATES)

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
                line = Line(
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
            with np.errstate(divide="ignore"):  # no longer than a stepper follows
                longest = SHARE * float(np.min(check.sampler.spread / np.abs(s.qd)))
            how = {"h": min(check.system.run.h, longest), "steps": STEPS, "every": STEPS // 40}
            run = simulate(self.module, s, t0=s.t, method=method, **how)
            for at in states_of_run(run, s)[1:]:  # of a run that stops early the rows up to there
                far = np.abs([at.q - s.q, at.qd - s.qd])
                if np.any(far >= MAX_DISTANCE * check.sampler.scale):  # as h is too long
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
        if (
            residual > MAX_RESIDUAL
        ):  # where rows all but depend on each other, those left out hold less
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
            step, x = SLIGHT * self.check.sampler.spread[i], s.q.copy()
            x[i] += step
            change = evaluate_module(self.module, "constraint_rates", replace(s, q=x))
            change = change - evaluate_module(self.module, "constraint_rates", s)
            total += np.abs(change) / step * abs(q)
        return total
