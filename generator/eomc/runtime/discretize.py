"""Derivatives of one step, or of the steps of a control period."""

from __future__ import annotations

from typing import Any

from numpy import empty

from .arguments import Array, StateArguments
from .package import option
from .slices import slices
from .status import STATUS, STATUS_MESSAGES, MotionError, state_text
from .stepping import Stepping

_STEPS = 20_000  # steps times coordinates cubed in one call of C, some ms at most


def discretize(
    model: Stepping, method: str, q: Array, qd: Array, h: float, hold: int | None, t: Any, u: Any,
    params: Any,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the derivatives of the state after a step with respect to the state and the inputs.

    A small change of the state x = [q; qd] before the step, dx, and of the inputs, du, changes the
    state after the step by dx_next = Phi dx + Gamma du.

    Parameters
    ----------
    method : str
        Name of the integration method.
    q, qd : (nq,) or (n, nq) arrays
        State before the step, or n states, already checked.
    h : float
        Step size, s.
    hold : int or None
        Number of steps over which the inputs are constant and whose total effect is differentiated.
        None: one step.
    t, u, params
        Time, inputs and parameters: the same for all states, or a row for each state. If u is None,
        the inputs are the scene's signals (formulas for the inputs). They are evaluated within the
        step, or with `hold` only at the start of the first step.

    Returns
    -------
    Phi : (2 nq, 2 nq) or (n, 2 nq, 2 nq) array
    Gamma : (2 nq, nu) or (n, 2 nq, nu) array

    Raises
    ------
    ValueError
        If the module was built without these derivatives, or an argument is invalid.
    MotionError
        If a step fails or a derivative is not finite.
    """
    if not hasattr(model._lib, f"{method}_derivative"):
        raise ValueError(
            f"discretize: {model.name} was built without it: build it with {option('discretize')}"
        )
    rows, n = q.shape[:-1], model.nq
    Phi = empty((*rows, 2 * n, 2 * n), model.dtype)
    Gamma = empty((*rows, 2 * n, model.nu), model.dtype)
    K = None
    if hold is not None and u is None and model.nu:
        u = model.signal(q, qd, t, params)
        if hasattr(model._lib, "signal_slopes"):
            K = model._feedback(q, qd, None, t, params)
    steps, acts = hold or 1, StateArguments(model, rows, t, u, params)
    derivative, null = getattr(model._lib, f"{method}_derivative"), model._c[2]
    to_Phi, to_Gamma, from_q, from_qd = (
        model._pointer(x) if x.size else null for x in (Phi, Gamma, q, qd)
    )
    for k, many in slices(q.size // n, _STEPS // (steps * n**3) + 1):
        now, inputs, p, own = acts.pointers(k)
        code = derivative(
            many, to_Phi + 4 * n**2 * k, to_Gamma + 2 * n * model.nu * k if model.nu else null,
            from_q + n * k, from_qd + n * k, now, h, steps, inputs, p, own,
        )  # fmt: skip
        if code & 7:
            done, step = divmod(code >> 3, steps)
            _refuse(q.reshape(-1, n)[k + done], qd.reshape(-1, n)[k + done],
                    acts.time(k + done), step, STATUS[code & 7])  # fmt: skip
    return (Phi if K is None else Phi + Gamma @ K), Gamma


def _refuse(q: Array, qd: Array, t: float, step: int, status: str) -> None:
    """Raise MotionError for a state without a derivative; step: number of steps before it."""
    what = "a derivative is not finite there" if status == "not finite" else STATUS_MESSAGES[status]
    later = f" {step} steps later" if step else ""
    raise MotionError(
        f"no derivative of a step{later} from t = {t:.9g}, {state_text(q, qd)}: {what}", status
    )
