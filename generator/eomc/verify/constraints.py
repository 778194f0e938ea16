"""Checks of constraints: residuals, Jacobian A, multipliers, projection, reactions.

They use states that the reference has projected onto the constraints, states along a run, and both
forms of C. Multipliers and accelerations are compared with those of a dense KKT matrix in NumPy
(`kkt`). Of the module alone it is tested whether multipliers have power only where constraints
depend on time, whether A is the derivative of the constraint equations, and whether reactions have
the power of multipliers.

States are also displaced from the constraints, and the module's `project` must return them to where
the reference does, with and without fixed coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eomc.scene.scene import LoopJoint
from eomc.verify import kkt
from eomc.verify.bodies import BodyMotion, number
from eomc.verify.comparison import Check, Comparison, largest
from eomc.verify.equations import value_check
from eomc.verify.reference import Vector, differences
from eomc.verify.sampling import EPS, MAX_DISTANCE, Expected, State, states_of_run

VALUES = ("constraints", "constraint_rates", "constraint_jacobian", "multipliers")
WORK_TOLERANCE = 1e-9  # relative error of virtual work; velocities of bodies are exact to 1e-12
MAX_RESIDUAL = 450.0  # units of rounding: residual of constraints in a run, 1e-13 of their terms
SLOPE_LIMIT = 1e-7  # relative error of A, by differences of order 8; a wrong sign makes 1


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of constraints, if the system has some."""
    system, eps = comparison.system, comparison.eps
    if not system.constraints:
        return
    states = [*comparison.expected, *comparison.unusual_states]
    for name in VALUES:
        yield value_check(comparison, name, states)
    if comparison.dtype == np.float64:  # difference quotients need its digits
        yield Check(
            "A and finite differences", jacobian_error, tolerance=SLOPE_LIMIT, unit="relative to A"
        )
        if system.run.needs_derivatives and not system.modes:
            yield Check(
                "tangent", tangent_error, tolerance=SLOPE_LIMIT, states=comparison.few(2),
                unit="relative to A",
            )  # fmt: skip
    yield Check("power of multipliers", power_error)
    if system.reactions:
        yield Check(
            "reactions: virtual work", reaction_error, tolerance=max(WORK_TOLERANCE, 30 * eps),
            states=comparison.few(4), unit="relative",
        )  # fmt: skip
    yield from projection_checks(comparison)
    for method in comparison.methods if comparison.compiled else ():
        yield Check(
            f"{method} on the constraints", partial(residual_along_run, method),
            tolerance=MAX_RESIDUAL, states=comparison.few(3), portable=True,
            why="no step is possible, or all are too long",
        )  # fmt: skip


def jacobian_error(of: Comparison, e: Expected) -> float:
    """Return the largest relative error of the module's constraint Jacobian A at a state.

    The exact A is a difference quotient of the constraint equations, with respect to q for
    holonomic and with respect to q̇ for nonholonomic equations. Steps of several widths are used and
    the one with the smallest error counts, since no width makes a wrong A right.
    """
    s, holonomic = e.state, _holonomic(of)
    A = of.module_value("constraint_jacobian", s)
    size = np.abs(A) + np.max(np.abs(A), axis=1, keepdims=True) + e.size["constraint_jacobian"]

    def off(width: float) -> float:
        by_q, by_qd = np.hsplit(_slopes(of, s, "constraints", width), 2)
        exact = np.where(holonomic[:, None], by_q, by_qd)
        return float(np.max(np.abs(exact - A) / size))

    return min(off(width) for width in (0.1, 0.03, 0.01, 0.003, 1e-3))


def tangent_error(of: Comparison, e: Expected) -> float:
    """Return how much constraints and their rates change along the module's tangent directions.

    The module's function `tangent` returns directions in [q; q̇] along which the constraints stay
    satisfied, so that the change must be zero. The result is relative to the sum of the absolute
    values of the terms of the change.
    """
    s, holonomic = e.state, _holonomic(of)
    T = of.module.tangent(s.q, s.qd, t=s.t, params=s.params)

    def off(width: float) -> float:
        J = np.stack([_slopes(of, s, name, width) for name in ("constraints", "constraint_rates")])
        J[0, ~holonomic] = 0
        size = np.abs(J) @ np.abs(T) + np.max(np.abs(J), axis=2, keepdims=True)
        return float(np.max(np.abs(J @ T) / (size + 1e-300), initial=0))

    return min(off(width) for width in (0.1, 0.03, 0.01, 0.003, 1e-3))


def _holonomic(of: Comparison) -> NDArray[np.bool_]:
    """Return for each constraint equation whether it restricts positions (holonomic)."""
    return np.array([c.holonomic for c in of.system.constraints])


def _slopes(of: Comparison, s: State, name: str, width: float) -> Vector:
    """Return the derivatives of a function of the module by q and q̇, (m, 2 nq).

    They are differences with steps of `width` times the scale; by discrete variables they are 0.
    """

    def values(rows: Vector) -> list[Vector]:
        return [
            of.module_value(name, replace(s, q=q, qd=qd))
            for q, qd in rows.reshape(len(rows), 2, -1)
        ]

    slopes = differences(values, np.concatenate([s.q, s.qd]), width * of.sampler.scale.ravel())
    moving = [q in of.system.rates for q in of.system.q]
    return np.asarray(slopes * np.tile(moving, 2))


def power_error(of: Comparison, e: Expected) -> float:
    """Return the error of the power of the multipliers, λ·(A q̇), in units of rounding.

    A q̇ + b are the rates of the constraint equations, and must be zero. The expected power is
    therefore -λ·b, which is 0 unless constraints depend on time.
    """
    s = e.state
    multipliers, A = (of.module_value(n, s) for n in ("multipliers", "constraint_jacobian"))
    b = of.module_value("constraint_rates", replace(s, qd=0 * s.qd))
    size = np.abs(multipliers) * e.size["constraint_rates"]
    size = size + e.size["multipliers"] * (np.abs(A) @ np.abs(s.qd))
    return of.units(multipliers * (A @ s.qd), -multipliers * b, size)


def reaction_error(of: Comparison, e: Expected) -> float:
    """Return the largest relative error of the virtual work of reactions at a state.

    Reactions are the force and moment at the point of a closed loop: they act on the loop's second
    body and, reversed, on the first one. When one coordinate moves, their work must equal that of
    the loop's multipliers, λ·A. Velocities of the bodies are computed from the scene file.
    """
    s, scene = e.state, of.system.scene
    assert scene is not None and scene.assembly is not None
    reactions = of.module.reactions(s.q, s.qd, t=s.t, u=s.u, params=s.params)
    multipliers, A = (of.module_value(n, s) for n in ("multipliers", "constraint_jacobian"))
    loops = {loop.name: loop for loop in scene.assembly.loops}
    errors = [0.0]
    for name in (r.name for r in of.system.reactions):
        rows = [k for k, c in enumerate(of.system.constraints) if c.loop == name]
        force = np.asarray(reactions[name], float)
        expected = multipliers[rows] @ A[rows]
        size = np.abs(multipliers[rows]) @ np.abs(A[rows])
        least = float(np.max(size, initial=0)) or 1.0
        for j, direction in enumerate(np.eye(len(s.q))):
            powers = (
                force @ _loop_twist(of, loops[name], replace(s, qd=qd))
                for qd in (direction, 0 * direction)  # motion due to time alone does no work
            )
            errors.append(abs(next(powers) - next(powers) - expected[j]) / least)
    return float(np.nan_to_num(np.max(errors), nan=math.inf))


def _loop_twist(of: Comparison, loop: LoopJoint, s: State) -> Vector:
    """Return the twist of a loop's second body at the loop's point, relative to the first body."""
    assert of.system.scene is not None
    motion = BodyMotion(of.system.scene, of.sampler.with_discrete_parameters(s))
    first, second = (motion.frames[name] for name in loop.bodies)
    point = motion.vector(loop.points[1]) if loop.points else np.zeros(3)
    twist, base = motion.twist(second, point), motion.twist(first, np.zeros(3))
    arm = number(second.point(point)) - number(first.at)
    twist = twist - base - [*np.cross(base[3:], arm), 0, 0, 0]
    return np.asarray(twist[[0, 1, 5]] if of.system.plane else twist)


def residual_along_run(method: str, of: Comparison, e: Expected) -> float | None:
    """Return the largest residual of constraints and of their rates along a run, in roundings."""
    s, scale = replace(e.state, u=None), of.sampler.scale
    with np.errstate(divide="ignore"):  # coordinates move by 2 % of their range in a step
        longest = 0.02 * float(np.min(scale[0] / np.abs(s.qd)))
    h = min(of.system.run.h, longest)
    run = of.simulate(s, method, h=h, steps=200, every=5)
    errors: list[float | None] = []
    for at in states_of_run(run, s)[1:]:  # fewer if the run stops early
        if np.any(np.abs([at.q - s.q, at.qd - s.qd]) >= MAX_DISTANCE * scale):  # h is too long
            break
        errors += [_residual(of, at, name) for name in ("constraints", "constraint_rates")]
    error = largest(errors, "")
    return error if isinstance(error, float) else None


def _residual(of: Comparison, s: State, name: str) -> float | None:
    A = np.abs(of.module_value("constraint_jacobian", s))
    off = np.abs(of.module_value(name, s))
    if name == "constraints":
        off, A = off[_holonomic(of)], A[_holonomic(of)]
        scale = np.abs(s.q) + of.sampler.spread
    else:
        scale = np.abs(s.qd) + of.sampler.speed
    if not len(off):
        return None
    size = A @ scale
    residual = of.units(off, 0 * off, size)
    # redundant equations have larger residuals where the others are almost dependent, and a
    # predicted sine is as precise as its angle, which may be large
    if residual > MAX_RESIDUAL:
        if name == "constraint_rates":
            size = size + np.abs(_slopes(of, s, name, 1e-4)[:, : len(s.q)]) @ np.abs(s.q)
        residual = of.units(off, 0 * off, size + _reference_residual(of, name, s)[: len(off)])
    return residual


def _reference_residual(of: Comparison, name: str, s: State) -> Vector:
    """Return the residual that the reference leaves near a state, in units."""
    q, qd = of.sampler.rounded(s)
    with np.errstate(all="ignore"):
        q, qd = of.reference.corrected(q, qd, s.t, s.params)
        residuals = [
            of.reference.evaluate(name, *x, s.t, None, s.params) for x in zip(q, qd, strict=True)
        ]
    return np.asarray(np.nan_to_num(np.max(np.abs(residuals), axis=0)) / EPS)


# --- projection onto the constraints --------------------------------------------------------------


def projection_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of `project`, without and with a coordinate and its velocity kept fixed."""
    # displacements from the constraints, relative to the scale of the states
    cases = [(e, part) for e in comparison.few(6) for part in (1e-6, 1e-3, 1e-2)]
    why = "no state that is moved away has a place nearby"
    for name, with_fixed in (("project", False), ("project, fixed values", True)):
        yield Check(
            name, partial(projection_error, with_fixed, np.random.default_rng(11)), states=cases,
            portable=True, why="no value can be fixed" if with_fixed else why,
        )  # fmt: skip


def projection_error(
    with_fixed: bool, random: np.random.Generator, of: Comparison, case: tuple[Expected, float]
) -> float | None:
    """Return the error of the state that `project` returns, in units of rounding.

    A state displaced from the constraints is projected by the module and by the reference.
    with_fixed: whether one coordinate and its velocity are kept fixed. case: the state, and its
    displacement relative to the scale. The result is None if nothing can be compared.
    """
    (e, part), scale = case, of.sampler.scale
    offset = part * scale * random.uniform(-1, 1, scale.shape)
    fixed = _redundant_coordinate(of, e.state, random) if with_fixed else ()
    if fixed is None:
        return None
    s = replace(e.state, q=e.state.q + offset[0], qd=e.state.qd + offset[1])
    at = _expected_projection(of, s, fixed)
    if not np.all(np.isfinite(at.q)) or of.sampler.wrong_rotations(at):
        return None
    expected = of.sampler.regular_expected(at)
    if expected is None:
        return None
    names = [c.name for c in of.system.coordinates]
    fixed_names = [name for i in fixed for name in (names[i], f"{names[i]}_dot")]
    result = of.module.project(s.q, s.qd, t=s.t, params=s.params, fixed=fixed_names)
    end = np.array([at.q, at.qd])
    displacement = np.abs(end - [s.q, s.qd])
    if np.any(displacement > (100 if fixed else 10) * part * scale):  # another solution
        return None
    start = np.array([s.q, s.qd], of.dtype)
    unchanged = all(np.array_equal(np.array(result)[:, i], start[:, i]) for i in fixed)
    error = of.units(result, end, np.abs(end) + scale + expected.size["place"])
    return error if unchanged else math.inf


def _expected_projection(of: Comparison, s: State, fixed: tuple[int, ...]) -> State:
    """Return the reference's projection of a state."""
    with np.errstate(all="ignore"):
        if not fixed:
            return of.sampler.project(s, nearest=True)
        q, qd = of.reference.project(s.q, s.qd, s.t, s.params, fixed)
    return replace(s, q=q, qd=qd)


def _redundant_coordinate(
    of: Comparison, s: State, random: np.random.Generator
) -> tuple[int, ...] | None:
    """Return a coordinate that can be fixed; None if the constraints determine every one."""
    D = of.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
    A = of.reference.solved_values("constraint_jacobian", s.q, s.qd, s.t, s.params)
    for i in random.permutation(len(s.q)).tolist():
        if kkt.is_regular(*kkt.with_fixed_coordinates(D, A, (i,)), 1e-4):
            return (i,)
    return None
