"""Forward sensitivities of a run: derivatives of its rows by the start, the inputs and parameters.

They are products of the derivatives of the steps (the variational equations of the method).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .arguments import Array, as_flag, as_step_size
from .package import named_outputs
from .requests import period_starts

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
