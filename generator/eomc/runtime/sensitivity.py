"""Derivatives of a run with respect to its start, inputs and parameters.

Forward sensitivities of the rows are products of the derivatives of the steps (the variational
equations of the method). Gradients of functions of the rows use the discrete adjoint of the steps.
"""

from __future__ import annotations

from math import isqrt
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, as_flag, as_numbers, as_step_size
from .package import named_outputs, option
from .requests import Request, period_starts
from .status import STATUS, refuse

if TYPE_CHECKING:
    from .interfaces import CompiledModel


class Sensitivity(NamedTuple):
    """Derivatives of the rows of a run; k is 2 nq for states [q; qd], and ny for outputs.

    Attributes
    ----------
    start : (n, k, 2 nq) array
        Derivatives by the initial state.
    inputs : (n, k, nu) array
        Derivatives by a constant that is added to each input over the whole run.
    parameters : (n, k, np) array
        Derivatives by the parameters at a constant initial state. np is 0 if the module was built
        without derivatives by parameters.
    """

    start: Array
    inputs: Array
    parameters: Array


def sensitivity(run: Any, outputs: bool, h: float | None, method: str | None) -> Sensitivity:
    """Return the derivatives of the rows of a run; see `Trajectory.sensitivity`."""
    model, request, info = run.model, run.request, run.model.info
    if as_flag(outputs, "outputs") and not info.outputs:
        raise ValueError(f"sensitivity: {info.name} has no outputs: {named_outputs()}")
    if callable(request.u):
        raise ValueError(
            "sensitivity: u is a function, whose derivatives are unknown: give the table of its "
            "values, or let the scene's signals compute the inputs"
        )
    if isinstance(request.u, str):
        raise ValueError(f"sensitivity: {request.u}")
    if (np.diff(run.with_jump_rows().t) == 0).any():
        raise ValueError(
            "sensitivity: the state jumps at events of this run, and sensitivities through jumps "
            "are not available: end the run before the first jump"
        )
    method = info.method_name(method or (request.method if request.h else None))
    h = as_step_size(h, info.dtype) if h is not None else request.h or info.h
    t, q, qd, at = run.t, run.q, run.qd, np.arange(len(run))
    if request.period and len(run):  # inputs change at the starts of control periods
        starts = period_starts(request, len(request.u), np.dtype(float))
        starts = starts[~np.isclose(starts[:, None], t, rtol=0, atol=1e-9 * h).any(axis=1)]
        t = np.union1d(t, starts[starts < t[-1]])
        at = np.searchsorted(t, run.t)
        q, qd = run(t)
    u = request.u
    if u is not None and u.ndim == 2:
        u = u[np.clip(((t - request.t0) / request.period + 1e-9).astype(int), 0, len(u) - 1)]
    rows = np.ascontiguousarray(q), np.ascontiguousarray(qd)
    matrices = model.integrator.propagate(rows, t, u, request.p, h, method, has_rows=True)
    states = Sensitivity(*(x[at] for x in matrices))
    if not outputs:
        return states
    return output_sensitivity(
        model, states, (run.q, run.qd), run.t, u if u is None or u.ndim == 1 else u[at], request.p
    )


def output_sensitivity(
    model: CompiledModel, states: Sensitivity, rows: tuple[Array, Array], t: Any,
    u: Array | None, p: Array,
) -> Sensitivity:  # fmt: skip
    """Return the derivatives of outputs at rows, from those of the states [q; qd] there.

    u: inputs, (nu,) or a row for each state; None: the scene's signals. p: parameters.
    """
    functions = model.functions
    _, _, C, D = functions.linearize(*rows, t, u, p, outputs=True)
    if not (has_parameters := states.parameters.shape[-1] > 0):
        by_p = np.zeros((*C.shape[:2], 0), C.dtype)
    else:
        _, by_p = functions.sensitivity(*rows, t, u, p, outputs=True)
    if u is None and hasattr(model.c.lib, "signal_slopes"):
        C = C + D @ functions.feedback(*rows, None, t, p)
    if u is None and has_parameters and hasattr(model.c.lib, "signal_sensitivity"):
        by_p = by_p + D @ functions.evaluate("signal_sensitivity", *rows, t, None, p)
    return Sensitivity(C @ states.start, C @ states.inputs + D, C @ states.parameters + by_p)


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
    if reason := _refusal(run, request):
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
        infinite = "a derivative along the run from there is not finite"
        what = infinite if STATUS[status] == "not finite" else ""
        refuse(STATUS[status], run.q[0], run.qd[0], 0, what)
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


def _refusal(run: Any, request: Request) -> str:
    """Return why a run has no adjoint, or "" if it has one."""
    info, lib = run.model.info, run.model.c.lib
    if not hasattr(lib, "acceleration_vjp"):
        built = option("linearize", '"products"')
        return f"{info.name} was built without the products that it needs: build it with {built}"
    if info.constraints.names:
        return "runs with constraints have no adjoint"
    if not request.h:
        return "adaptive steps have no adjoint: give h="
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
