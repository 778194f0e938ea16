"""Checks of derivatives: of accelerations (`linearize`, `sensitivity`) and of steps (`discretize`).

They are compared with difference quotients of order 8: of the reference's accelerations, and of
steps by the method's tableau (`one_step`) on these accelerations. Under constraints the reference
projects the ends of the steps onto the constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify import one_step
from eomc.verify.comparison import Comparison
from eomc.verify.reference import STENCIL, ReferenceModel, Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import (
    MAX_DISTANCE,
    NUDGE,
    Expected,
    State,
    evaluate_module,
    perturb_each_input,
)

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
    for width in WIDTHS:
        steps = np.concatenate([k * np.diag(width * scales) for m, _ in STENCIL for k in (m, -m)])
        rows = x + steps
        arguments: dict[str, Any] = {
            "u": rows[:, 2 * n : 2 * n + len(u)] if len(u) else None,
            "params": dict(zip(params, rows[:, 2 * n + len(u) :].T, strict=True)),
        }
        t = np.full(len(rows), s.t)
        a = getattr(reference, name)(rows[:, :n], rows[:, n : 2 * n], t, **arguments)
        forward, back = np.moveaxis(a.reshape(len(STENCIL), 2, len(x), -1), 1, 0)
        weights = np.array([w for _, w in STENCIL])
        yield np.tensordot(weights, forward - back, 1).T / (width * scales), scales


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


# --- derivatives of accelerations -----------------------------------------------------------------

SLOPE_LIMIT = 1e-6  # error relative to the largest derivative, by differences of the reference


def report_acceleration_derivatives(check: Comparison) -> None:
    """Append checks of the derivatives of accelerations to the report of `eomc check`.

    The module's functions are `linearize` and `sensitivity`. They are checked if the scene requires
    them or an implicit method uses them.
    """
    limit = max(SLOPE_LIMIT, LIMIT * check.eps)
    for name in ("linearize", "sensitivity"):
        if _is_required(check, name):
            find = partial(largest_error, check, name)
            check.add_check(name, limit, "of the largest derivative", find)


def _is_required(check: Comparison, name: str) -> bool:
    run = check.system.run
    if name == "sensitivity":
        return run.linearize == "parameters" and bool(check.system.parameters)
    return run.needs_derivatives or any(METHODS[method].newton for method in check.methods)


def largest_error(check: Comparison, name: str) -> float | Measurement:
    """Return the largest relative error of the module's derivatives of accelerations.

    name: "linearize" (derivatives with respect to q, q̇ and u) or "sensitivity" (with respect to
    the parameters). The exact values are difference quotients of the reference's accelerations with
    steps of several widths. For each entry the width with the smallest error counts, since no width
    makes a wrong entry right.
    """
    scale = check.sampler.scale
    n, nu = len(check.system.q), len(check.system.inputs)
    known: list[float | None] = []
    far = [e for e in check.sampler.far_states() if check.has_finite_accelerations(e.state)]
    for e in (*check.few(check.effort.few), *far):
        s, size = e.state, e.size["acceleration"] + NUDGE * scale[1] ** 2 / scale[0]
        derivatives = module_derivatives(check, name, s)
        if derivatives is None:
            return math.inf  # dq/dt = qd is violated
        part = slice(0, 2 * n + nu) if name == "linearize" else slice(2 * n + nu, None)
        with np.errstate(all="ignore"):
            exact = differentiate(check.reference, s, scale, check.sampler.defaults)
            off = [relative_differences(derivatives, J[:, part], by[part], size) for J, by in exact]
        least = np.fmin.reduce(off)  # a wrong entry is wrong at every width
        if check.dtype != np.float64:
            least /= max(1.0, _rounding_growth(check, name, e, derivatives))
        known.append(float(np.max(least, initial=0)) if np.all(least >= 0) else None)
    return largest(known, "no state has finite differences")


def module_derivatives(check: Comparison, name: str, s: State) -> Vector | None:
    """Return the module's derivatives of accelerations at a state, (nq, k).

    name: "linearize", with k = 2 nq + nu columns for q, q̇ and u, or "sensitivity", with one column
    for each parameter. The result is None if the module's matrices A and B contradict dq/dt = q̇.
    """
    n, arguments = len(check.system.q), {"u": s.u, "t": s.t, "params": s.params}
    if name == "sensitivity":
        return np.asarray(check.module.sensitivity(s.q, s.qd, **arguments))
    A, B = check.module.linearize(s.q, s.qd, **arguments)
    if not np.array_equal(A[:n], np.eye(n, 2 * n, n)) or np.any(B[:n]):
        return None
    return np.hstack([A[n:], B[n:]])


def _rounding_growth(check: Comparison, name: str, e: Expected, derivatives: Vector) -> float:
    """How many roundings single precision makes of the derivatives, of the largest.

    As many as a rounding of every input makes, and as the accelerations have lost there, to
    sums that cancel.
    """
    near = [
        module_derivatives(check, name, x)
        for x in perturb_each_input(e.state, check.sampler.defaults)
    ]
    moved = sum(np.abs(x - derivatives) for x in near if x is not None)
    sure = e.value["acceleration"]
    cancelled_digits = (
        np.abs(evaluate_module(check.module, "acceleration", e.state) - sure) / check.eps
    )
    parts = (moved / NUDGE, derivatives), (cancelled_digits, sure)
    return float(max(np.max(x, initial=0) / (np.max(np.abs(y)) + 1e-300) for x, y in parts))


# --- derivatives of steps -------------------------------------------------------------------------

Differences = Callable[[str, int, float], list[Vector]]  # for a method, state index and step size


def report_step_derivatives(check: Comparison) -> None:
    """Append checks of `discretize` to the report of `eomc check`, one for each method.

    There are none if the scene does not require this function, which linearises one step.
    """
    if not check.system.run.discretize:
        return
    limit = max(SLOPE_LIMIT, LIMIT * check.eps)
    few = [e.state for e in check.few(4)]

    @cache
    def exact(method: str, k: int, h: float) -> list[Vector]:
        with np.errstate(all="ignore"):
            scales = _variable_scales(check, few[k])
            return [_step_differences(check, method, few[k], h, width * scales) for width in WIDTHS]

    for module, form in check.forms:
        for method in check.methods:
            measure = partial(_largest_step_error, check, module, method, few, exact)
            check.add_check(
                f"{form}discretize by {method}", limit, "of the largest derivative", measure
            )


def _largest_step_error(
    check: Comparison, module: Any, method: str, few: list[State], exact: Differences
) -> float | Measurement:
    errors = (
        _step_error(check, module, method, s, partial(exact, method, k)) for k, s in enumerate(few)
    )
    return largest(errors, "no state has finite differences")


def _variable_scales(check: Comparison, s: State) -> Vector:
    """Return typical sizes of q, q̇ and u, (2 nq + nu,)."""
    n, nu = len(s.q), len(check.system.inputs)
    scales = np.concatenate([check.sampler.spread, check.sampler.speed, np.ones(nu)])
    if s.u is not None:
        scales[2 * n :] = np.maximum(1.0, np.abs(s.u))
    return scales


def _step_error(
    check: Comparison, module: Any, method: str, s: State, exact: Callable[[float], list[Vector]]
) -> float | None:
    """Return the largest error at a state, the best of some widths for each entry.

    None if there are no finite differences.
    """
    n, scales = len(s.q), _variable_scales(check, s)
    # shorter steps if the iteration for the stages of an implicit method does not converge
    for h in (part * check.system.run.h for part in (1.0, 0.1, 0.01)):
        near = exact(h)
        if not any(np.isfinite(J).all() for J in near) or _moves_far(check, method, s, h):
            continue
        arguments = {"h": h, "t": s.t, "u": s.u, "params": s.params, "method": method}
        derivatives = [np.asarray(x, float) for x in module.discretize(s.q, s.qd, **arguments)]
        # inputs may change a coordinate by 1e-4 of its scale in a step; less is not judged
        parts, size = (slice(0, 2 * n), slice(2 * n, None)), 1e-4 * scales[: 2 * n]
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


def _moves_far(check: Comparison, method: str, s: State, h: float) -> bool:
    """Return whether a step moves the state so far that no width of differences is suitable."""
    run = check.simulate(s, method=method, h=h, steps=1, t0=s.t)
    moved = np.abs(np.subtract([run.q[-1], run.qd[-1]], [s.q, s.qd]))
    return not bool(np.all(moved < MAX_DISTANCE * check.sampler.scale))


def _step_differences(check: Comparison, method: str, s: State, h: float, by: Vector) -> Vector:
    """Return derivatives of a step's end with respect to q, q̇ and u, (2 nq, 2 nq + nu).

    They are differences of the reference's steps. Changes of u are added to the signals if the
    state has no inputs.
    """
    n, nu = len(s.q), len(check.system.inputs)
    moved = np.concatenate([k * np.diag(by) for m, _ in STENCIL for k in (m, -m)])
    x = moved + np.concatenate([s.q, s.qd, np.zeros(nu)])

    def acceleration(q: Vector, qd: Vector, t: float) -> Vector:
        u, now = None, np.full(len(q), t)
        if nu:
            own = check.reference.evaluate("signals", q, qd, now, None, s.params)
            u = x[:, 2 * n :] + (own if s.u is None else s.u)
        return check.reference.acceleration(q, qd, now, u, s.params)

    ends = one_step.step(METHODS[method], acceleration, x[:, :n], x[:, n : 2 * n], s.t, h)
    if check.system.constraints:
        ends = np.array(check.reference.corrected(ends[0], ends[1], s.t + h, s.params))
    rows = np.moveaxis(ends, 0, 1).reshape(len(STENCIL), 2, len(by), 2 * n)
    forward, back = np.moveaxis(rows, 1, 0)
    weights = np.array([w for _, w in STENCIL])
    return np.asarray((np.tensordot(weights, forward - back, 1) / by[:, None]).T)
