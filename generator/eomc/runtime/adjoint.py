"""Gradients of functions of a run's rows, by the discrete adjoint of its steps."""

from __future__ import annotations

from math import isqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, as_numbers
from .package import option
from .requests import Request
from .status import STATUS, refuse

# Coordinates times steps up to which a run with few rows is repeated with a row after each step:
# the states take 64 MB in double precision. The rows of longer runs are the checkpoints.
MAX_REPEATED_NUMBERS = 2**22


class RunGradient(NamedTuple):
    """Derivatives of a scalar function of the rows of a run.

    Attributes
    ----------
    q, qd : (nq,) arrays
        With respect to the initial coordinates and velocities.
    u : array of the shape of the inputs
        With respect to the inputs: a row for each control period of a table, (nu,) for constant
        inputs. If the scene's signals are the inputs, a row for each step, with respect to what is
        added to the signals in that step.
    p : (np,) array
        With respect to the parameters, at a constant start.
    """

    q: Array
    qd: Array
    u: Array
    p: Array


def pull_back(
    run: Any, request: Request, q_bar: ArrayLike | None, qd_bar: ArrayLike | None
) -> RunGradient:
    """Return the gradient of a function with the derivatives q_bar, qd_bar at the rows of a run.

    See `Trajectory.vjp`. request: that of the run, without a function of inputs.
    """
    info, c, name = run.model.info, run.model.c, f"{request.method}_adjoint"
    if reason := _refusal(run, request, hasattr(c.lib, name)):
        raise ValueError(f"vjp: {reason}")
    n, m, u = info.nq, info.nu, request.u
    bars = [_seeds(x, of, run.q) for x, of in ((q_bar, "q_bar"), (qd_bar, "qd_bar"))]
    if request.every > 1 and request.steps * n <= MAX_REPEATED_NUMBERS:
        steps = np.minimum(np.arange(len(run)) * request.every, request.steps)
        run = run.repeat(None)
        request = request.replace(every=1)
        bars = [_at_rows(x, steps, run.q) for x in bars]
    rows = [np.ascontiguousarray(x) for x in (run.q, run.qd)]
    hold, periods = 1, request.steps
    if u is not None:
        is_table = u.ndim == 2
        hold, periods = (request.hold, len(u)) if is_table else (max(1, request.steps), 1)
    sizes = n, n, (periods, m), len(info.parameters)
    q0_bar, qd0_bar, u_bar, p_bar = (np.zeros(size, info.dtype) for size in sizes)
    parts = isqrt(min(request.every, request.steps)) + 2
    work = np.empty(parts * (info.method_table[request.method].stages + 4) * n, info.dtype)
    p = np.ascontiguousarray(request.p)
    status = getattr(c.lib, name)(
        *map(c.pointer, (q0_bar, qd0_bar, u_bar, p_bar, *rows, *bars)), request.t0, request.h,
        request.steps, request.every, c.pointer(u), hold, c.pointer(p), c.pointer(work),
    )  # fmt: skip
    if status:
        what = "" if STATUS[status] == "singular" else "a derivative along the run is not finite"
        refuse(STATUS[status], run.q[0], run.qd[0], 0, what and f"{what}, in the run from there")
    return RunGradient(q0_bar, qd0_bar, u_bar if u is None else u_bar.reshape(u.shape), p_bar)


def _seeds(values: ArrayLike | None, name: str, rows: Array) -> Array:
    """Return the derivatives by the rows as an array of their shape; zeros for None."""
    if values is None:
        return np.zeros_like(rows)
    array = as_numbers(values, name, rows.dtype)
    if array.shape != rows.shape:
        raise ValueError(f"{name}: shape {array.shape}, expected {rows.shape}, that of the rows")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: not all numbers are finite")
    return array


def _at_rows(values: Array, indices: Array, rows: Array) -> Array:
    """Return an array of the shape of `rows` with the values at these rows, and zeros elsewhere."""
    full = np.zeros_like(rows)
    full[indices] = values
    return full


def _refusal(run: Any, request: Request, has_function: bool) -> str:
    """Return why a run has no adjoint, or "" if it has one."""
    info, lib = run.model.info, run.model.c.lib
    if not hasattr(lib, "acceleration_vjp"):
        built = option("linearize", '"products"')
        return f"{info.name} was built without the products that it needs: build it with {built}"
    if info.constraints.names:
        return "runs with constraints have no adjoint"
    if not request.h:
        return "adaptive steps have no adjoint: give h= and an explicit method"
    if not has_function:
        return f"'{request.method}' has no adjoint: run with an explicit method, such as 'rk4'"
    if request.times is not None:
        return "rows at requested times have no adjoint: give every= instead of times="
    if run.status != "ok":
        return f"the run did not reach its end: {run.message}"
    if run.event_data is not None and len(run.event_data[0]):
        return (
            "runs with events have no adjoint, and events occurred in this one: run up to the first"
        )
    if len(run) != 1 + -(-request.steps // request.every):
        return "the rows of the run are not those after its steps"
    if np.ndim(request.u) == 2 and len(request.u) * request.hold < request.steps:
        return "the table of inputs is shorter than the run"
    if request.u is None and info.nu and not hasattr(lib, "signal_vjp"):
        return "a signal of the scene jumps (sign or heaviside): give u, or make it smooth"
    return ""
