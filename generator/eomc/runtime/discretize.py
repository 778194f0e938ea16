"""The derivatives of steps, one or as many as a control period has."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import empty

from .arguments import Array, as_number
from .functions import for_each, row_times
from .status import SAID, STATUS, MotionError, state_text
from .stepping import Stepping


def discretize(
    model: Stepping, method: str, q: Array, qd: Array, h: float, hold: int | None, t: Any, u: Any,
    params: Any,
) -> tuple[Array, Array]:  # fmt: skip
    """(Phi, Gamma) of a step, or where `hold` is given of so many under inputs that are held.

    q, qd: (nq,) or (n, nq), checked; u, params: of all, or a row for each state.
    Raises MotionError, ValueError.
    """
    if not hasattr(model._lib, f"{method}_derivative"):
        raise ValueError(
            f"discretize: {model.name} was built without it: a scene asks with [run] "
            "discretize = true"
        )
    rows, n = q.shape[:-1], model.nq
    Phi = empty((*rows, 2 * n, 2 * n), model.dtype)
    Gamma = empty((*rows, 2 * n, model.nu), model.dtype)
    times = row_times(t, rows)
    each = for_each(model, len(q), u, params) if rows else None
    if times is None and hold is None and each is None:
        _step(model, method, (Phi, Gamma), q, qd, h, as_number(t, "t"), u, params)
        return Phi, Gamma
    for k in np.ndindex(rows):
        now = as_number(t if times is None else times[k], "t")
        out, (u, params) = (Phi[k], Gamma[k]), (u, params) if each is None else each[k[0]]
        if hold is None:
            _step(model, method, out, q[k], qd[k], h, now, u, params)
        else:
            out[0][...], out[1][...] = _period(model, method, q[k], qd[k], h, hold, now, u, params)
    return Phi, Gamma


def _step(
    model: Stepping, method: str, out: tuple[Array, Array], q: Array, qd: Array, h: float, t: float,
    u: Any, params: Any,
) -> None:  # fmt: skip
    """Fill (Phi, Gamma) of one step from each state."""
    derivative, status = getattr(model._lib, f"{method}_derivative"), model._ffi.new("int *")
    Phi, Gamma = (model._pointer(x) if x.size else model._ffi.NULL for x in out)
    inputs, p = model._given(u, params)
    count, at, moving = q.size // model.nq, model._pointer(q), model._pointer(qd)
    done = derivative(count, Phi, Gamma, at, moving, t, h, inputs, p, status)
    if status[0]:
        said = STATUS[status[0]]
        where = state_text(*(x.reshape(-1, model.nq)[done] for x in (q, qd)))
        what = "a derivative is not finite there" if said == "not finite" else SAID[said]
        raise MotionError(f"no derivative of a step from t = {t:.9g}, {where}: {what}", said)


def _period(
    model: Stepping, method: str, q: Array, qd: Array, h: float, hold: int, t: float, u: Any,
    params: Any,
) -> tuple[Array, Array]:  # fmt: skip
    """(Phi, Gamma) of `hold` steps from a state: u, or the signals at their start, held."""
    n, held, K = model.nq, model._inputs(u), None
    if held is None and model.nu:
        held = model.signal(q, qd, t, params)
        if hasattr(model._lib, "signal_slopes"):
            K = model._feedback(q, qd, None, t, params)
    Phi, Gamma = np.eye(2 * n, dtype=model.dtype), np.zeros((2 * n, model.nu), model.dtype)
    for k in range(hold):
        now = t + k * h
        A, B = discretize(model, method, q, qd, h, None, now, held, params)
        Phi, Gamma = A @ Phi, A @ Gamma + B
        if k + 1 < hold:
            q, qd = model.step(q, qd, h, now, held, params, method)
    return (Phi if K is None else Phi + Gamma @ K), Gamma
