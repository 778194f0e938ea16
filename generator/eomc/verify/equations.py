"""Checks of the equations of motion: values, the laws that they must obey, and derivatives.

Values are compared with those of the reference. A law (symmetry, bias = C q̇ + g) is tested on the
module alone, whatever the reference returns. Derivatives of accelerations (`linearize`,
`sensitivity`) and of steps (`discretize`) are compared with difference quotients of order 8: of the
reference's accelerations, and of steps by the method's tableau on these accelerations.
Under constraints the reference projects the ends of the steps onto the constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify.comparison import LIMIT, Check, Comparison, Values
from eomc.verify.reference import ReferenceModel, Vector, differences, runge_kutta_step
from eomc.verify.sampling import (
    MAX_DISTANCE,
    NUDGE,
    VALUES,
    Expected,
    State,
    evaluate_module,
    perturb_each_input,
)


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of names, values and laws."""
    yield Check(
        "names, defaults, start", lambda of, _: _metadata_differences(of), tolerance=0,
        states=(None,), unit="that differ", portable=True,
    )  # fmt: skip
    states = [*comparison.expected, *comparison.unusual_states]
    for name in (*VALUES, "acceleration"):
        yield value_check(comparison, name, states)
    yield Check("D = D^T", ours("D"), lambda of, e: ours("D")(of, e).T, rounding("D"))
    constrained = bool(comparison.system.constraints)
    if not constrained:  # otherwise D may be singular
        unit = "least eigenvalue of D, scaled"
        yield Check("D > 0", _least_eigenvalue, tolerance=0, unit=unit, minimum=True)
    yield Check("bias = C qd + g", _assembled_bias, ours("bias"), rounding("bias"))
    force = "tau + A^T lambda" if constrained else "tau"
    yield Check(f"D qdd + bias = {force}", _inertia_and_bias, _forces, rounding("motion"))
    if comparison.dtype == np.float64:  # difference quotients need its digits
        # differences are exact to 1e-10; a wrong sign in C makes an error of 1
        yield Check(
            "Ddot - 2C + dD/dt skew", _skewness_error, tolerance=1e-6, unit="of D's rate"
        )  # fmt: skip


def value_check(comparison: Comparison, name: str, states: list[Expected]) -> Check:
    """Return the check of the module's function `name` at the states, in units of rounding."""
    # energies relative to their typical size, since k - k cos(q) may be 0 at a state
    sizes = [e.size[name] for e in comparison.expected]
    typical = np.median(sizes) if "energy" in name else 0.0
    return Check(
        name, ours(name), lambda of, e: e.value[name],
        lambda of, e: of.eps * np.maximum(e.size[name], typical), states=states, portable=True,
    )  # fmt: skip


def ours(name: str) -> Values:
    """Return a function that evaluates a function of the module at a state."""
    return lambda of, e: evaluate_module(of.module, name, e.state)


def rounding(name: str) -> Values:
    """Return a function that computes one rounding error of the value `name` at a state."""
    return lambda of, e: of.eps * np.asarray(e.size[name])


def _metadata_differences(of: Comparison) -> float:
    """Return how many names, defaults and initial values differ between module and system."""
    s, m, start = of.system, of.module, of.sampler.start
    pairs = [
        (tuple(m.coordinates), tuple(c.name for c in s.coordinates)),
        (tuple(m.parameters), tuple(p.name for p in s.parameters)),
        (tuple(m.inputs), tuple(i.name for i in s.inputs)),
        (dict(m.defaults), of.sampler.defaults),
        *(
            (np.asarray(a).tolist(), b.astype(of.dtype).tolist())
            for a, b in zip(m.start, (start.q, start.qd), strict=True)
        ),
    ]
    return float(sum(theirs != ours for theirs, ours in pairs))


def _least_eigenvalue(of: Comparison, e: Expected) -> float:
    """Return the least eigenvalue of D_ij / sqrt(D_ii D_jj)."""
    D = evaluate_module(of.module, "D", e.state)
    diagonal = np.diag(D)
    if np.any(diagonal <= 0):
        return float(np.min(diagonal))
    return float(np.linalg.eigvalsh(D / np.sqrt(np.outer(diagonal, diagonal)))[0])


def _values(of: Comparison, e: Expected, *names: str) -> list[Vector]:
    return [evaluate_module(of.module, name, e.state) for name in names]


def _assembled_bias(of: Comparison, e: Expected) -> Vector:
    C, g = _values(of, e, "C", "g")
    return C @ e.state.qd + g


def _inertia_and_bias(of: Comparison, e: Expected) -> Vector:
    D, qdd, bias = _values(of, e, "D", "acceleration", "bias")
    return D @ qdd + bias


def _forces(of: Comparison, e: Expected) -> Vector:
    (tau,) = _values(of, e, "tau")
    if of.system.constraints:
        multipliers, A = _values(of, e, "multipliers", "constraint_jacobian")
        tau = tau + multipliers @ A
    return tau


def _skewness_error(of: Comparison, e: Expected) -> float:
    """Return the largest entry of N + Nᵀ, N = Ḋ - 2C + ∂D/∂t, relative to Ḋ.

    N must be skew-symmetric. Ḋ and ∂D/∂t are difference quotients of order 8 of the module's D,
    with steps of several widths. The width with the smallest result counts: if C is wrong, no
    width makes N + Nᵀ vanish.
    """
    s = e.state
    rate = np.max(np.abs(s.qd) / of.sampler.spread) or 1.0
    (C,) = _values(of, e, "C")

    def rate_of_D(qd: Vector, width: float) -> Vector:
        def D(rows: Vector) -> list[Vector]:
            states = (replace(s, q=s.q + x * qd, t=s.t + float(x)) for (x,) in rows)
            return [of.module_value("D", state) for state in states]

        return differences(D, np.zeros(1), np.array([width])).reshape(C.shape)

    def residual(width: float) -> float:
        A = rate_of_D(s.qd, width) + rate_of_D(0 * s.qd, width) - 2 * C
        return float(np.max(np.abs(A + A.T) / (rate * e.size["D"] + np.abs(C))))

    residuals = (residual(part / rate) for part in (0.03, 0.003, 3e-4, 3e-5))
    return min((x for x in residuals if not np.isnan(x)), default=np.nan)


# --- derivatives of accelerations -----------------------------------------------------------------

WIDTHS = (0.03, 0.003, 3e-4, 3e-5, 3e-6)  # of differences, relative to the scale of a variable


def differentiate(
    reference: ReferenceModel, s: State, scale: Vector, defaults: Mapping[str, float],
    name: str = "acceleration",
) -> Iterator[tuple[Vector, Vector]]:  # fmt: skip
    """Yield derivatives of the reference's accelerations at a state, as difference quotients.

    Each item is a pair (J, scales), one for each step width in WIDTHS. J (nq, 2 nq + nu + np)
    contains the derivatives with respect to q, q̇, the inputs u and the parameters p. scales are
    typical sizes of these variables; the steps are WIDTHS times these. Inputs are constant: those
    of the state or, if it has none, the values of the scene's signals.

    Parameters
    ----------
    reference : ReferenceModel
        The independent evaluation of the system in Python.
    s : State
        The state.
    scale : (2, nq) array
        Typical sizes of q and q̇.
    defaults : mapping
        Parameter values, used if the state has none.
    name : str
        Method of the reference to be differentiated in place of `acceleration`.
    """
    n, params = len(s.q), dict(s.params or defaults)
    u = np.zeros(0)
    if reference.system.inputs:
        u = np.asarray(reference.evaluate("signals", s.q, s.qd, s.t, None, s.params), float)
        u = u if s.u is None else s.u
    x = np.concatenate([s.q, s.qd, u, list(params.values())])
    scales = np.concatenate(
        [scale.ravel(), np.maximum(1.0, np.abs(u)), np.abs(x[2 * n + len(u) :])]
    )
    scales = np.where(scales > 0, scales, 1.0)

    def rates(rows: Vector) -> Vector:
        q, qd, us, values = np.split(rows, [n, 2 * n, 2 * n + len(u)], axis=1)
        arguments: dict[str, Any] = {
            "u": us if len(u) else None,
            "params": dict(zip(params, values.T, strict=True)),
        }
        return np.asarray(getattr(reference, name)(q, qd, np.full(len(q), s.t), **arguments))

    for width in WIDTHS:
        yield differences(rates, x, width * scales), scales


def relative_differences(values: Vector, exact: Vector, scales: Vector, size: Vector) -> Vector:
    """Return |values - exact|, (nq, k), relative to the largest scaled entry in each matrix row.

    Scaled means that column j of both matrices is multiplied by scales[j]. `size` (nq,) is the size
    of the terms that add up to each acceleration: 1e-4 of it is added to the divisor, since
    difference quotients lose digits. An entry is nan if `exact` is not finite there, and inf if
    only `values` is not.
    """
    divisor = np.max(np.abs(exact) * scales, axis=1, initial=0) + 1e-4 * size
    with np.errstate(all="ignore"):
        difference = np.abs(values - exact) * scales / divisor[:, None]
    difference = np.where(values == exact, 0, difference)
    return np.asarray(
        np.where(np.isfinite(exact), np.where(np.isfinite(values), difference, np.inf), np.nan)
    )


SLOPE_LIMIT = 1e-6  # error relative to the largest derivative, by differences of the reference
UNIT = "of the largest derivative"
PRODUCTS = ("acceleration_jvp", "acceleration_vjp")


def derivative_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of `linearize`, `sensitivity`, the products and `discretize`.

    They are checked if the scene requires them or an implicit method uses them.
    """
    run, limit = comparison.system.run, max(SLOPE_LIMIT, LIMIT * comparison.eps)
    linearizes = run.needs_derivatives or any(METHODS[m].newton for m in comparison.methods)
    by_parameters = run.by_parameters and comparison.system.parameters
    far = comparison.sampler.far_states() if linearizes or by_parameters else []
    states = [*comparison.few(4), *far]
    required_of = {"linearize": linearizes, "sensitivity": by_parameters}
    required_of |= dict.fromkeys(PRODUCTS, run.linearize == "products")
    for name, required in required_of.items():
        if required:
            yield Check(
                name, partial(acceleration_error, name), tolerance=limit, states=states, unit=UNIT,
                portable=True, why="no state has finite differences",
            )  # fmt: skip
    if run.discretize and comparison.compiled:
        yield from step_derivative_checks(comparison)


def acceleration_error(name: str, of: Comparison, e: Expected) -> float | None:
    """Return the largest relative error of the module's derivatives of accelerations at a state.

    name: "linearize" (derivatives with respect to q, q̇ and u), "sensitivity" (with respect to the
    parameters), or one of PRODUCTS (with respect to all). The exact values are difference quotients
    of the reference's accelerations with steps of several widths. For each entry the width with the
    smallest error counts, since no width makes a wrong entry right. The result is None if
    accelerations or differences are not finite.
    """
    if not of.has_finite_accelerations(e.state):
        return None
    scale, s = of.sampler.scale, e.state
    first = 2 * len(s.q) + len(of.system.inputs)
    size = e.size["acceleration"] + NUDGE * scale[1] ** 2 / scale[0]
    derivatives = module_derivatives(of, name, s)
    if derivatives is None:
        return math.inf  # dq/dt = qd is violated
    parts = {"linearize": slice(0, first), "sensitivity": slice(first, None)}
    part = parts.get(name, slice(None))
    with np.errstate(all="ignore"):
        exact = differentiate(of.reference, s, scale, of.sampler.defaults)
        off = [relative_differences(derivatives, J[:, part], by[part], size) for J, by in exact]
    least = np.fmin.reduce(off)  # a wrong entry is wrong at every width
    if of.dtype != np.float64:
        least /= max(1.0, rounding_growth(of, name, e, derivatives))
    return float(np.max(least, initial=0)) if np.all(least >= 0) else None


def module_derivatives(of: Comparison, name: str, s: State) -> Vector | None:
    """Return the module's derivatives of accelerations at a state, (nq, k).

    name: "linearize", with k = 2 nq + nu columns for q, q̇ and u; "sensitivity", with one column
    for each parameter; or one of PRODUCTS, with all these columns, from products with unit vectors.
    The result is None if the module's matrices A and B contradict dq/dt = q̇.
    """
    n, arguments = len(of.system.q), {"u": s.u, "t": s.t, "params": s.params}
    if name == "sensitivity":
        return np.asarray(of.module.sensitivity(s.q, s.qd, **arguments))
    if name in PRODUCTS:
        sizes = (n, n, len(of.system.inputs), len(of.system.parameters))
        count = n if name == "acceleration_vjp" else sum(sizes)
        q, qd = (np.tile(x, (count, 1)) for x in (s.q, s.qd))
        if name == "acceleration_vjp":
            return np.hstack(of.module.acceleration_vjp(q, qd, np.eye(n), **arguments))
        columns = np.split(np.eye(count), np.cumsum(sizes)[:-1], axis=1)
        return np.asarray(of.module.acceleration_jvp(q, qd, columns, **arguments)).T
    A, B = of.module.linearize(s.q, s.qd, **arguments)
    if not np.array_equal(A[:n], np.eye(n, 2 * n, n)) or np.any(B[:n]):
        return None
    return np.hstack([A[n:], B[n:]])


def rounding_growth(of: Comparison, name: str, e: Expected, derivatives: Vector) -> float:
    """How many roundings single precision makes of the derivatives, of the largest.

    As many as a rounding of every input makes, and as the accelerations have lost there, to
    sums that cancel.
    """
    near = [
        module_derivatives(of, name, x) for x in perturb_each_input(e.state, of.sampler.defaults)
    ]
    moved = sum(np.abs(x - derivatives) for x in near if x is not None)
    sure = e.value["acceleration"]
    cancelled_digits = np.abs(evaluate_module(of.module, "acceleration", e.state) - sure) / of.eps
    parts = (moved / NUDGE, derivatives), (cancelled_digits, sure)
    return float(max(np.max(x, initial=0) / (np.max(np.abs(y)) + 1e-300) for x, y in parts))


# --- derivatives of steps -------------------------------------------------------------------------


def step_derivative_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of `discretize`, which linearises one step, one for each method."""

    @cache
    def exact(method: str, k: int, h: float) -> list[Vector]:
        s, scales = states[k], _variable_scales(comparison, states[k])
        with np.errstate(all="ignore"):
            return [_step_differences(comparison, method, s, h, width * scales) for width in WIDTHS]

    states = [e.state for e in comparison.few(4)]
    for method in comparison.methods:

        def error(of: Comparison, k: int, method: str = method) -> float | None:
            return _step_error(of, method, states[k], partial(exact, method, k))

        yield Check(
            f"discretize by {method}", error, tolerance=max(SLOPE_LIMIT, LIMIT * comparison.eps),
            states=range(len(states)), unit=UNIT, portable=True,
            why="no state has finite differences",
        )  # fmt: skip


def _has_parameters(of: Comparison) -> bool:
    """Return True if steps have derivatives with respect to parameters."""
    return of.system.run.by_parameters and bool(of.system.parameters)


def _parameter_values(of: Comparison, s: State) -> dict[str, float]:
    """Return the parameters at a state by name; {} if steps have no derivatives by them."""
    return dict(s.params or of.sampler.defaults) if _has_parameters(of) else {}


def _variable_scales(of: Comparison, s: State) -> Vector:
    """Return typical sizes of q, q̇, u and p, (2 nq + nu + np,)."""
    values = np.abs([*_parameter_values(of, s).values()])
    u = np.ones(len(of.system.inputs)) if s.u is None else np.maximum(1.0, np.abs(s.u))
    return np.concatenate(
        [of.sampler.spread, of.sampler.speed, u, np.where(values > 0, values, 1.0)]
    )


def _step_error(
    of: Comparison, method: str, s: State, exact: Callable[[float], list[Vector]]
) -> float | None:
    """Return the largest error at a state, the best of some widths for each entry.

    None if there are no finite differences.
    """
    n, scales = len(s.q), _variable_scales(of, s)
    # shorter steps if the iteration for the stages of an implicit method does not converge
    for h in (part * of.system.run.h for part in (1.0, 0.1, 0.01)):
        near = exact(h)
        if not any(np.isfinite(J).all() for J in near) or _moves_far(of, method, s, h):
            continue
        arguments = {"h": h, "t": s.t, "u": s.u, "params": s.params, "method": method}
        if _has_parameters(of):
            arguments["parameters"] = True
        derivatives = [np.asarray(x, float) for x in of.module.discretize(s.q, s.qd, **arguments)]
        # inputs may change a coordinate by 1e-4 of its scale in a step; less is not judged
        ends, size = np.cumsum([x.shape[1] for x in derivatives]), 1e-4 * scales[: 2 * n]
        parts = [slice(end - x.shape[1], end) for end, x in zip(ends, derivatives, strict=True)]
        off = [
            np.hstack(
                [
                    relative_differences(x, J[:, i], scales[i], size)
                    for x, i in zip(derivatives, parts, strict=True)
                ]
            )
            for J in near
        ]
        return float(np.nan_to_num(np.max(np.fmin.reduce(off)), nan=math.inf))
    return None


def _moves_far(of: Comparison, method: str, s: State, h: float) -> bool:
    """Return whether a step moves the state so far that no width of differences is suitable."""
    run = of.simulate(s, method, h=h, steps=1, t0=s.t)
    moved = np.abs(np.subtract([run.q[-1], run.qd[-1]], [s.q, s.qd]))
    return not bool(np.all(moved < MAX_DISTANCE * of.sampler.scale))


def _step_differences(of: Comparison, method: str, s: State, h: float, by: Vector) -> Vector:
    """Return derivatives of a step's end by q, q̇, u and p, (2 nq, 2 nq + nu + np).

    They are differences of the reference's steps. Changes of u are added to the signals if the
    state has no inputs.
    """
    n, nu, reference = len(s.q), len(of.system.inputs), of.reference
    values = _parameter_values(of, s)

    def ends(rows: Vector) -> Vector:
        params: Any = s.params
        if values:
            params = dict(zip(values, rows[:, 2 * n + nu :].T, strict=True))

        def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
            u, now = None, np.full(len(q), t)
            if nu:
                own = reference.evaluate("signals", q, qd, now, None, params)
                u = rows[:, 2 * n : 2 * n + nu] + (own if s.u is None else s.u)
            return reference.acceleration(q, qd, now, u, params)

        q, qd = runge_kutta_step(
            METHODS[method], acceleration, rows[:, :n], rows[:, n : 2 * n], s.t, h
        )
        if of.system.constraints:
            q, qd = reference.corrected(q, qd, s.t + h, params)
        return np.hstack([q, qd])

    x = np.concatenate([s.q, s.qd, np.zeros(nu), list(values.values())])
    return differences(ends, x, by)
