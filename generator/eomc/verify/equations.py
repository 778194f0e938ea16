"""Checks of the equations of motion and of outputs: values, laws that they obey, derivatives.

Values are compared with those of the reference. A law (symmetry, bias = C q̇ + g) is tested on the
module alone, whatever the reference returns. Derivatives of accelerations (`linearize`,
`sensitivity`) and of steps (`discretize`) are compared with difference quotients of order 8: of the
reference's accelerations, and of steps by the method's tableau on these accelerations.
Under constraints the reference projects the ends of the steps onto the constraints.

Outputs are evaluated with dual numbers, along the definitions as they are: each dot(...) is a
tangent in time, of the motion q(s) = q + qd s + qdd s^2/2. Accelerations and multipliers, which
have checks of their own, are the module's; derivatives of multipliers are differences of the
reference's.

A of the closed loop must be A + B du/dx of the open one. Inputs beyond their limits must act as the
limits do, bit by bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import sympy
from sympy import Symbol

from eomc.integrators.tableaux import METHODS
from eomc.model.symbols import Output, resolve_definitions, symbol
from eomc.model.system import System, t
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
from eomc.verify.taylor import Dual, compile_formulas, nested_rates, part_of


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of names, values and laws."""
    yield Check(
        "names, defaults, start", lambda of, _: _metadata_differences(of), tolerance=0,
        states=(None,), unit="differences", portable=True,
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
            "Ddot - 2C + dD/dt skew", _skewness_error, tolerance=1e-6, unit="relative to dD/dt"
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


def relative_differences(
    values: Vector, exact: Vector, scales: Vector, size: Vector, rounding: Vector | float = 0.0
) -> Vector:
    """Return |values - exact|, (nq, k), relative to the largest scaled entry in each matrix row.

    Scaled means that column j of both matrices is multiplied by scales[j]. `size` (nq,) is the size
    of the terms that add up to each acceleration: 1e-4 of it is added to the divisor, since
    difference quotients lose digits. `rounding`, (nq,) or a number, is the rounding error of the
    scaled `exact`, which is subtracted from the difference. An entry is nan if `exact` is not
    finite there, and inf if only `values` is not.
    """
    divisor = np.max(np.abs(exact) * scales, axis=1, initial=0) + 1e-4 * size
    with np.errstate(all="ignore"):
        beyond = np.abs(values - exact) * scales - np.reshape(rounding, (-1, 1))
        difference = np.maximum(beyond, 0) / divisor[:, None]
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
    if (run.discretize or run.linearize == "products") and comparison.compiled:
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
    several = (np.stack([x, x]) for x in (s.q, s.qd))  # which optimised C computes in registers
    A, B = (x[1] for x in of.module.linearize(*several, **arguments))
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
    """Yield the checks of `discretize` and of the adjoint of a run of one step, by each method."""

    @cache
    def exact(method: str, k: int, h: float) -> list[Vector]:
        s, scales = states[k], _variable_scales(comparison, states[k])
        with np.errstate(all="ignore"):
            return [_step_differences(comparison, method, s, h, width * scales) for width in WIDTHS]

    states, run = [e.state for e in comparison.few(4)], comparison.system.run
    adjoint = run.linearize == "products" and not comparison.system.constraints
    for method in comparison.methods:
        required = {"discretize": run.discretize, "adjoint": adjoint}
        for name in (name for name, is_required in required.items() if is_required):

            def error(
                of: Comparison, k: int, method: str = method, name: str = name
            ) -> float | None:
                return _step_error(of, name, method, states[k], partial(exact, method, k))

            yield Check(
                f"{name} by {method}", error, tolerance=max(SLOPE_LIMIT, LIMIT * comparison.eps),
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


def _step_derivatives(of: Comparison, name: str, method: str, s: State, h: float) -> list[Vector]:
    """Return the module's derivatives of a step's end by [q, q̇], by u and by p.

    name: "discretize", or "adjoint" for one adjoint of a run of one step for each row.
    """
    if name == "adjoint":
        run = of.simulate(s, method, h=h, steps=1, t0=s.t)
        units = np.eye(2 * len(s.q)).reshape(-1, 2, len(s.q))  # derivatives by q and qd at the end
        rows = [run.vjp(*([0 * x, x] for x in unit)) for unit in units]
        return [
            np.array([np.hstack([row.q, row.qd]) for row in rows], float),
            np.array([row.u.ravel() for row in rows], float),
            *([np.array([row.p for row in rows], float)] if of.system.parameters else []),
        ]
    arguments = {"h": h, "t": s.t, "u": s.u, "params": s.params, "method": method}
    if _has_parameters(of):
        arguments["parameters"] = True
    return [np.asarray(x, float) for x in of.module.discretize(s.q, s.qd, **arguments)]


def _step_error(
    of: Comparison, name: str, method: str, s: State, exact: Callable[[float], list[Vector]]
) -> float | None:
    """Return the largest error at a state, the best of some widths for each entry.

    name: as in `_step_derivatives`. None if there are no finite differences.
    """
    n, scales = len(s.q), _variable_scales(of, s)
    # shorter steps if the iteration for the stages of an implicit method does not converge
    for h in (part * of.system.run.h for part in (1.0, 0.1, 0.01)):
        near = exact(h)
        if not any(np.isfinite(J).all() for J in near) or _moves_far(of, method, s, h):
            continue
        try:
            derivatives = _step_derivatives(of, name, method, s, h)
        except of.module.MotionError as error:
            if error.status == "no convergence":
                continue
            raise
        # inputs may change a coordinate by 1e-4 of its scale in a step; less is not judged
        ends, size = np.cumsum([x.shape[1] for x in derivatives]), 1e-4 * scales[: 2 * n]
        parts = [slice(end - x.shape[1], end) for end, x in zip(ends, derivatives, strict=True)]
        off = []
        for J, width in zip(near, WIDTHS, strict=True):
            # the step's end has rounding errors of the largest terms that add up to it
            largest = np.max(np.abs(J) * scales, axis=1) + scales[: 2 * n]
            rounding = 8 * np.finfo(float).eps * largest / width
            blocks = zip(derivatives, parts, strict=True)
            off.append(
                np.hstack(
                    [relative_differences(x, J[:, i], scales[i], size, rounding) for x, i in blocks]
                )
            )
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


OUTPUT_SLOPE_LIMIT = 1e-9  # error relative to the largest derivative of the same output
_NONE: Vector = np.zeros(0)


def output_and_limit_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of outputs, of limits of inputs and of the closed loop."""
    if comparison.system.outputs and hasattr(comparison.module, "output"):
        yield from output_checks(comparison)
    if hasattr(comparison.module, "applied"):
        yield from limit_checks(comparison)
        yield from closed_loop_checks(comparison)


def output_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of outputs and of their derivatives.

    Outputs are quantities that the scene defines by formulas.
    """
    formulas, run = Formulas(comparison.system), comparison.system.run
    # derivatives of multipliers are differences of the reference's
    limit = max(1e-6 if formulas.multipliers else OUTPUT_SLOPE_LIMIT, LIMIT * comparison.eps)
    error = partial(output_error, formulas, _outputs)
    yield Check("outputs", error, states=comparison.few(4), portable=True)
    derivatives = {"C, D": False} if run.needs_derivatives else {}
    if derivatives and run.by_parameters and comparison.system.parameters:
        derivatives["by parameters"] = True
    for name, by_parameters in derivatives.items():
        yield Check(
            f"outputs: {name}", partial(_slope_error, formulas, by_parameters), tolerance=limit,
            states=comparison.few(2), unit=UNIT, portable=True,
        )  # fmt: skip


def _outputs(of: Comparison, s: State) -> Vector:
    return np.asarray(of.module.output(s.q, s.qd, s.t, s.u, s.params), float)


def output_error(
    formulas: Formulas, function: Callable[[Comparison, State], Vector], of: Comparison, e: Expected
) -> float:
    """Return the largest error of a function of the module at a state, in units of rounding.

    function: returns the module's values, (ny,), at a state. formulas: evaluate the same values
    from the module's own accelerations and multipliers.
    """
    s = _with_fixed_inputs(of.module, e.state)
    value = function(of, s)
    near = [function(of, x) for x in perturb_each_input(s, of.sampler.defaults)]
    size = np.abs(value) + np.nansum([np.abs(x - value) / NUDGE for x in near], axis=0)
    qdd, forces = _solved(of.module, s)
    exact = formulas.evaluate(s, qdd, forces)
    # terms that cancel with an acceleration leave its rounding error
    for k in range(len(qdd)):
        moved = np.where(np.arange(len(qdd)) == k, 1 + NUDGE, 1.0) * qdd
        size += np.nan_to_num(np.abs(formulas.evaluate(s, moved, forces) - exact) / NUDGE)
    real = np.isfinite(value) | np.isfinite(exact)  # sqrt(x) for x < 0 is not finite in either
    return of.units(value[real], exact[real], size[real]) if np.any(real) else 0.0


def _slope_error(formulas: Formulas, by_parameters: bool, of: Comparison, e: Expected) -> float:
    """Compare C and D, or dy/dp, with differences of the outputs, through A, B or E."""
    module, s = of.module, _with_fixed_inputs(of.module, e.state)
    n, arguments = len(s.q), {"u": s.u, "t": s.t, "params": s.params, "outputs": True}
    derivatives = (module.sensitivity if by_parameters else module.linearize)(
        s.q, s.qd, **arguments
    )
    if by_parameters:
        solved, module_slopes = (np.asarray(x, float) for x in derivatives)
    else:
        A, B, C, D = (np.asarray(x, float) for x in derivatives)
        solved, module_slopes = np.hstack([A[n:], B[n:]]), np.hstack([C, D])
    slopes, m = formulas.slopes(s, *_solved(module, s), by_parameters), module_slopes.shape[1]
    own, by_qdd, by_force = np.split(slopes, [m, m + n], axis=1)
    least: Vector = np.full((1, 1), np.inf)  # a wrong derivative is wrong at every width
    for forces in (
        _multiplier_slopes(of, s, by_parameters) if formulas.multipliers else [by_force[:0]]
    ):
        exact, sizes = own + by_qdd @ solved, abs(own) + abs(by_qdd) @ abs(solved)
        if formulas.multipliers:
            exact, sizes = exact + by_force @ forces, sizes + abs(by_force) @ abs(forces)
        off = np.abs(module_slopes - exact) / (np.max(sizes, axis=1, keepdims=True) + 1e-300)
        least = np.fmin(least, np.where(np.isfinite(module_slopes) | np.isfinite(exact), off, 0.0))
    return float(np.max(least, initial=0))


def _multiplier_slopes(of: Comparison, s: State, by_parameters: bool) -> Iterator[Vector]:
    """Yield derivatives of the multipliers, by differences of several widths.

    They are with respect to q, q̇ and u, (nc, 2 nq + nu), or to the parameters, (nc, np).
    """
    first = 2 * len(s.q) + len(of.system.inputs)
    arguments = (of.reference, s, of.sampler.scale, of.sampler.defaults, "multipliers")
    for slopes, _ in differentiate(*arguments):
        yield slopes[:, first:] if by_parameters else slopes[:, :first]


def _solved(module: Any, s: State) -> tuple[Vector, Vector]:
    """Return the module's accelerations and multipliers at a state."""
    rows = getattr(module, "constraint_names", ())
    return evaluate_module(module, "acceleration", s), evaluate_module(
        module, "multipliers", s
    ) if rows else np.zeros(0)


def _with_fixed_inputs(module: Any, s: State) -> State:
    """Return the state with the signals' values as inputs, which do not depend on it."""
    if s.u is not None or not module.inputs:
        return s
    return replace(s, u=np.asarray(module.signal(s.q, s.qd, s.t, s.params), float))


class Formulas:
    """The outputs of a system, evaluated and differentiated with dual numbers.

    Outputs are quantities that the scene defines by formulas.
    """

    def __init__(self, system: System) -> None:
        self.system, formulas = system, [o.formula for o in system.outputs]
        read = {x for e in formulas for x in e.free_symbols}
        multipliers = tuple(c.multiplier for c in system.constraints)
        # of all constraint equations; none if no output contains a multiplier
        self.multipliers: tuple[Symbol, ...] = multipliers if read & {*multipliers} else ()
        self.parameters = tuple(p.symbol for p in system.parameters)
        self.levels = nested_rates(formulas, system.definitions)
        symbols = (*system.q, *system.qd, *system.qdd, *system.u, *self.multipliers)
        self.symbols: tuple[Symbol, ...] = (*symbols, *self.parameters, t)
        self.function = compile_formulas(
            self.symbols, formulas, system.definitions, max(1, self.levels)
        )

    def evaluate(self, s: State, qdd: Vector, forces: Vector = _NONE) -> Vector:
        """Return the values of the outputs, (ny,), at a state.

        s: the state, with its inputs. qdd: the accelerations, (nq,). forces: the Lagrange
        multipliers, needed if `multipliers` is not empty.
        """
        values = self._values(self._variables(s, qdd, forces))
        return np.array([float(y) for y in values])

    def slopes(
        self, s: State, qdd: Vector, forces: Vector = _NONE, by_parameters: bool = False
    ) -> Vector:
        """Return the derivatives of the outputs, (ny, 3 nq + nu + nc).

        The columns are derivatives with respect to q, q̇, u, q̈ and the nc multipliers; nc is 0 if
        no output contains one. With `by_parameters`, the parameters replace q, q̇ and u. qdd,
        forces: as in `evaluate`.
        """
        system, variables = self.system, self._variables(s, qdd, forces)
        own = self.parameters if by_parameters else (*system.q, *system.qd, *system.u)
        by = (*own, *system.qdd, *self.multipliers)
        variables = {x: Dual(value) for x, value in variables.items()}
        variables |= {
            x: Dual(variables[x].value, e) for x, e in zip(by, np.eye(len(by)), strict=True)
        }
        values = (part_of(y, "tangent") for y in self._values(variables))
        return np.array([np.broadcast_to(y, len(by)) for y in values]).reshape(-1, len(by))

    def _variables(self, s: State, qdd: Vector, forces: Vector) -> dict[Symbol, Any]:
        u = () if s.u is None else s.u
        params = {p.name: p.value for p in self.system.parameters} | dict(s.params or {})
        values = (*s.q, *s.qd, *qdd, *u, *(forces if self.multipliers else ()), *params.values())
        return dict(zip(self.symbols, map(np.float64, (*values, s.t)), strict=True))

    def _values(self, variables: Mapping[Symbol, Any]) -> list[Any]:
        """Return the outputs, for accelerations that are constant in time."""
        system = self.system
        rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True))}
        for _ in range(self.levels):
            variables = {
                x: Dual(value, 1.0 if x == t else variables.get(rates.get(x)))
                for x, value in variables.items()
            }
        with np.errstate(all="ignore"):
            values = self.function(*variables.values())
        return [part_of(y, *["value"] * self.levels) for y in values]


def closed_loop_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the check of the linearised closed loop.

    The loop is closed by the signals, the scene's formulas for inputs. There is no check if no
    signal depends on the state or if a signal has discontinuities.
    """
    system = comparison.system
    if system.run.needs_derivatives and _is_feedback(system):
        signals = tuple(Output(i.name, i.signal) for i in system.inputs)
        formulas = Formulas(replace(system, outputs=signals, inputs=()))
        yield Check(
            "closed loop", partial(_closed_loop_error, formulas), states=comparison.few(2),
            tolerance=max(OUTPUT_SLOPE_LIMIT, LIMIT * comparison.eps), unit=UNIT, portable=True,
        )  # fmt: skip


def _is_feedback(system: System) -> bool:
    """Return whether a signal depends on the state, and none has discontinuities."""
    known = resolve_definitions(system.definitions)
    signals = sympy.Tuple(*(i.signal.xreplace(known) for i in system.inputs))
    moves = signals.free_symbols & {*system.q, *system.qd}
    return bool(moves) and not signals.has(sympy.sign, sympy.Heaviside)


def _closed_loop_error(formulas: Formulas, of: Comparison, e: Expected) -> float:
    """Compare A of the closed loop with A + B du/dx, from the module's own A and B."""
    s, n = replace(e.state, u=None), 2 * len(e.state.q)
    matrices = [
        x
        for closed in (False, True)
        for x in of.module.linearize(s.q, s.qd, t=s.t, params=s.params, closed=closed)
    ]
    A, B, closed_loop = (np.asarray(x, float) for x in matrices[:3])
    K = formulas.slopes(s, np.zeros(len(s.q)))[:, :n]
    size = np.max(abs(A) + abs(B) @ abs(K), axis=1, keepdims=True)
    return float(np.max(abs(closed_loop - A - B @ K) / (size + 1e-300)))


def limit_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the check of limits of inputs, if the scene has limits."""
    if any(x is not None for i in comparison.system.inputs for x in i.limits):
        yield Check(
            "limits of inputs", _differing_results, tolerance=0, states=comparison.few(4),
            unit="differences", portable=True,
        )  # fmt: skip


def _differing_results(of: Comparison, e: Expected) -> float:
    """Return how many inputs, accelerations and steps differ from those at the limits."""
    differing, s = 0, e.state
    least, most = limits(of.system, s.params or of.sampler.defaults)
    for beyond in _beyond(least, most):
        both = [
            list(_results_with_inputs(of.module, s, u))
            for u in (beyond, np.clip(beyond, least, most))
        ]
        differing += sum(not np.array_equal(a, b) for a, b in zip(*both, strict=True))
    return float(differing)


def limits(system: System, params: Mapping[str, float]) -> tuple[Vector, Vector]:
    """Return the smallest and the largest permitted values of the inputs, both (nu,).

    An input without a limit has the value -inf or inf there. params: values of the parameters,
    which the formulas of the limits may contain.
    """
    values = {symbol(name): value for name, value in params.items()}
    ends = [
        [
            far if x is None else float(x.xreplace(values))
            for x, far in zip(i.limits, (-np.inf, np.inf), strict=True)
        ]
        for i in system.inputs
    ]
    least, most = np.array(ends).T
    return least, most


def _beyond(least: Vector, most: Vector) -> Iterator[Vector]:
    """Yield inputs of which some are below, some above and some between their limits."""
    width = np.where(np.isfinite(most - least), most - least, 1.0)
    low = np.where(np.isfinite(least), least, np.where(np.isfinite(most), most, 0) - 2 * width)
    high = np.where(np.isfinite(most), most, low + 2 * width)
    for turn in range(3):
        where = (np.arange(len(low)) + turn) % 3
        yield np.choose(where, [low - 3 * width, high + 3 * width, (low + high) / 2])


def _results_with_inputs(module: Any, s: State, u: Vector) -> Iterator[Vector]:
    arguments = {"t": s.t, "u": u, "params": s.params}
    yield module.applied(s.q, s.qd, **arguments)
    yield module.acceleration(s.q, s.qd, **arguments)
    for method in module.methods:
        yield np.array(module.step(s.q, s.qd, method=method, **arguments))
