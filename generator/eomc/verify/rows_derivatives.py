"""Rows of `check` about derivatives of the accelerations."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify import derivatives
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import NUDGE, Expected, State, evaluate_module, perturb_each_input

SLOPE_LIMIT = 1e-6  # of the largest derivative, by differences of the reference


def report(check: Comparison) -> None:
    """Append checks of the derivatives of accelerations to the report of `eomc check`.

    The module's functions are `linearize` and `sensitivity`. They are checked if the scene requires
    them or an implicit method uses them.
    """
    limit = max(SLOPE_LIMIT, LIMIT * check.eps)
    for name in ("linearize", "sensitivity"):
        if _has(check, name):
            find = partial(slopes, check, name)
            check.row(name, limit, "of the largest derivative", find)


def _has(check: Comparison, name: str) -> bool:
    run = check.system.run
    if name == "sensitivity":
        return run.linearize == "parameters" and bool(check.system.parameters)
    return run.needs_derivatives or any(METHODS[method].newton for method in check.methods)


def slopes(check: Comparison, name: str) -> float | Measurement:
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
        derivatives_ = module_derivatives(check, name, s)
        if derivatives_ is None:
            return math.inf  # not even dq/dt = qd
        part = slice(0, 2 * n + nu) if name == "linearize" else slice(2 * n + nu, None)
        with np.errstate(all="ignore"):
            exact = derivatives.differentiate(check.reference, s, scale, check.sampler.defaults)
            off = [
                derivatives.relative_differences(derivatives_, J[:, part], by[part], size)
                for J, by in exact
            ]
        least = np.fmin.reduce(off)  # each entry's: what is wrong is so at every width
        if check.dtype != np.float64:
            least /= max(1.0, _growth(check, name, e, derivatives_))
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


def _growth(check: Comparison, name: str, e: Expected, derivatives_: Vector) -> float:
    """How many roundings single precision makes of the derivatives, of the largest.

    As many as a rounding of every input makes, and as the accelerations have lost there, to
    sums that cancel.
    """
    near = [
        module_derivatives(check, name, x)
        for x in perturb_each_input(e.state, check.sampler.defaults)
    ]
    moved = sum(np.abs(x - derivatives_) for x in near if x is not None)
    sure = e.value["acceleration"]
    cancelled_digits = (
        np.abs(evaluate_module(check.module, "acceleration", e.state) - sure) / check.eps
    )
    parts = (moved / NUDGE, derivatives_), (cancelled_digits, sure)
    return float(max(np.max(x, initial=0) / (np.max(np.abs(y)) + 1e-300) for x, y in parts))
