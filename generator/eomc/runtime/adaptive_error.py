"""The error of adaptive steps: the same run with a tighter tolerance, and from a moved start."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from .adaptive_memory import FULL, REMEDY
from .arguments import Array
from .estimate import Estimate, scales
from .periods import Periods

if TYPE_CHECKING:
    from .adaptive import AdaptiveRun

LEAST = {8: 1e-15, 4: 5e-7}  # tolerances, by bytes of a number
ORDER = 16
_TENTH = 0.1  # of a coordinate's scale: a result more wrong than that is none
_FINER = 100.0  # the tolerance over that of the run by which an error is found


def error_of(
    own: AdaptiveRun, run: Callable[..., AdaptiveRun],
    progress: Callable[[int, int], None] | None,
) -> Estimate:  # fmt: skip
    """The error of a run, beside one of a hundredth of its tolerance, and from a moved start.

    Raises MemoryError where its own rows are as many as there is room for.
    """
    if own.status == FULL:
        raise MemoryError(f"estimate: {REMEDY}")
    model, x = own._model, own.x.astype(float)
    u = Periods(own._u, own._period) if own._period else own._u
    eps = float(np.finfo(model.dtype).eps) / 2
    least = LEAST[model.dtype.itemsize]
    scale = scales(x)
    size = max(1e4 * eps, 100 * own.tol)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], x.shape[1])

    # rows beside a jump may be on either side of it in another run
    jumps = np.isin(own.t, own.t[1:][np.diff(own.t) == 0])
    kept = np.flatnonzero(~jumps & (own.t > own.t0))
    beside = np.maximum.accumulate(np.where(jumps, 0, np.arange(len(x))))

    def again(tol: float, start: Array) -> Array:
        nq, out, start = model.nq, np.full_like(x, np.nan), start.astype(model.dtype)
        out[own.t == own.t0] = start
        if len(kept):
            made = run(
                model, start[:nq], start[nq:], own.t0, float(own.t[-1]), tol, own.t[kept], u,
                own._params, own._h_most, progress, own._stiff,
            )  # fmt: skip
            if made.status == "interrupted":
                raise KeyboardInterrupt
            out[kept[: len(made)]] = made.x
            if own.stopped and made.stopped == own.stopped:  # a hair sooner or later
                found = made.events[own.stopped]
                out[-1] = np.concatenate([found.q[-1], found.qd[-1]])
        return out[beside]

    begin = np.ravel(own._begin).astype(float)
    finer = again(max(own.tol / _FINER, least), begin)
    modes, moves = np.array(model._rows.modes, int).reshape(-1, 2), np.ones(x.shape[1])
    for at, of in modes:  # which are not moved, nor what sticks, and have no error
        moves[[at, model.nq + at]] = 0
        moves[model.nq + of] = begin[at] != 0
    moved = again(own.tol, begin + moves * size * scale * signs)
    x = x[beside]
    error = np.maximum(np.abs(x - finer), eps * np.abs(x))
    error[:, modes[:, 0]] = error[:, model.nq + modes[:, 0]] = 0.0
    error[own.t == own.t0] = 0.0
    error[~np.isfinite(error)] = np.inf
    with np.errstate(invalid="ignore", divide="ignore"):
        grown = float(np.nanmax(np.abs(moved[-1] - x[-1]) / scale)) / size
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -np.log10(eps)) + 0.0
    names = [*model.coordinates, *(f"{c}_dot" for c in model.coordinates)]
    end, right = (dict(zip(names, map(float, x), strict=True)) for x in (error[-1], digits))
    words = []
    if own.status not in ("ok", "accumulated"):
        words.append(f"the run stopped at t = {own.t[-1]:.6g} s")
    if grown * eps > _TENTH:
        words.append(f"chaotic: a difference at the start grows {grown:.1g} times or more")
    if (error > _TENTH * scale).any():
        row = int(np.argmax((error > _TENTH * scale).any(axis=1)))
        words.append(
            f"the error exceeds a tenth of the motion from t = {own.t[row]:.4g} s on: take a "
            "tighter tolerance, or a shorter duration"
        )
    return Estimate(
        error[:, : model.nq], error[:, model.nq :], end, right, ORDER, float("nan"), grown,
        "; ".join(words),
    )  # fmt: skip
