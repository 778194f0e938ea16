"""The error of a run by a tolerance or among events: beside a finer one, and a moved start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .adaptive_arguments import LEAST
from .arguments import Array
from .estimate import Estimate, moving, scales
from .fitted import Fitted
from .periods import Periods
from .status import FULL, REMEDY

ORDER = 16
_TENTH = 0.1  # of a coordinate's scale: a result more wrong than that is none
_FULL = 0.01  # of a scale: a difference that has become so large grows no more as it did
_LITTLE = 4.0  # roundings, by which a start is moved where more fills the scale
_TAIL = 40  # a part of the rows, over which a difference does not vanish
_FINER = 100.0  # the tolerance over that of the run by which an error is found
_LEAST = 512  # steps of that, at least
_LONGER = 100  # times the steps, which a moved start takes at most


def error_of(
    own: Fitted, run: Callable[..., Fitted],
    progress: Callable[[int, int], None] | None,
) -> Estimate:  # fmt: skip
    """The error of a run, beside one of a hundredth of its tolerance in shorter steps, and from a
    moved start.

    With events, at least what the motion makes of a rounding; where differences fill the scales,
    that is seen from a start moved by some roundings, by the least tolerance.
    Raises MemoryError where its own rows are as many as there is room for.
    """
    if own.status == FULL:
        raise MemoryError(f"estimate: {REMEDY}")
    model, x = own._model, own.x.astype(float)
    u: Any = Periods(own._u, own._period, own._periods) if own._period else own._u
    eps, least = float(np.finfo(model.dtype).eps) / 2, LEAST[model.dtype.itemsize]
    scale = scales(x, float(np.ptp(own.t)), eps, len(model.still))
    size = max(1e4 * eps, 100 * own.tol)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], x.shape[1])

    # rows beside a jump may be on either side of it in another run
    jumps = np.isin(own.t, own.t[1:][np.diff(own.t) == 0])
    kept = np.flatnonzero(~jumps & (own.t > own.t0))
    beside = np.maximum.accumulate(np.where(jumps, 0, np.arange(len(x))))

    def again(tol: float, start: Array, h_most: float, steps: float = np.inf) -> Array:
        nq, out, start = model.nq, np.full_like(x, np.nan), start.astype(model.dtype)
        out[own.t == own.t0] = start
        if len(kept):
            made = run(
                model, start[:nq], start[nq:], own.t0, float(own.t[-1]), tol, own.t[kept], u,
                own._params, h_most, progress, own._stiff, steps, own._by,
            )  # fmt: skip
            if made.status == "interrupted":
                raise KeyboardInterrupt
            out[kept[: len(made)]] = made.x
            if own.stopped and made.stopped == own.stopped:  # a hair sooner or later
                found = made.events[own.stopped]
                out[-1] = np.concatenate([found.q[-1], found.qd[-1]])
        return out[beside]

    begin = np.ravel(own._begin).astype(float)
    tol, shorter = _finer(own, least)
    finer = again(tol, begin, shorter)
    if own.status == "ok" and not np.isfinite(finer).all():  # short ones near singular positions
        finer = again(tol, begin, own._h_most)
    modes, moves = np.array(model._rows.modes, int).reshape(-1, 2), moving(model)
    moves[model.nq + modes[:, 1]] = begin[modes[:, 0]] != 0  # nor is what sticks moved
    x = x[beside]

    def grown(base: Array, size: float, tol: float) -> Array:
        """What a start moved by one scale would become at each row, if that were little."""
        moved = begin + moves * size * scale * signs  # where that is another motion, not to its end
        most = _LONGER * (own.steps + own.rejected) + _LONGER**2
        return _filled(np.abs(again(tol, moved, own._h_most, most) - base)) / size

    rows = grown(x, size, own.tol)
    left, rounding = np.where(np.isfinite(finer), np.abs(x - finer), np.inf), eps * np.abs(x)
    if len(own._happened[0]) or (left > _TENTH * scale).any():
        # flights between jumps may be exact by any tolerance: what rounding makes of them tells
        full = np.maximum.accumulate(np.max(rows / scale, axis=1) * size > _FULL)
        if full.any():  # where so little fills the scale, rounding fills a quarter of it
            near = grown(again(least, begin, own._h_most), _LITTLE * eps, least)
            rows = np.where(full[:, None], np.maximum(rows, near), rows)
        rounding = np.maximum(rounding, eps * rows)
    exact = [*modes[:, 0], *(model.nq + modes[:, 0])]
    for some in (left, rounding):
        some[:, exact] = some[own.t == own.t0] = 0.0
    error = np.maximum(left, rounding)
    amplification = float(np.max(rows[-1] / scale))
    with np.errstate(divide="ignore"):
        digits = np.clip(-np.log10(error[-1] / scale), 0.0, -np.log10(eps)) + 0.0
    names = [*model.coordinates, *(f"{c}_dot" for c in model.coordinates)]
    end, right = (dict(zip(names, map(float, x), strict=True)) for x in (error[-1], digits))
    return Estimate(
        error[:, : model.nq], error[:, model.nq :], end, right,
        model.orders[own._by] if own._by else ORDER, float("nan"),
        amplification, _verdict(own, left / scale, rounding / scale, amplification),
    )  # fmt: skip


def _finer(own: Fitted, least: float) -> tuple[float, float]:
    """Tolerance and longest step of a run to compare with: in other steps where there is no smaller
    tolerance too, as rounding differs, and what comes and goes between two nodes shows. Of fixed
    steps a quarter of their size."""
    if own._by:
        return own.tol, own.h / 4
    tol = max(own.tol / _FINER, least) if own.tol >= 2 * least else 4 * least
    longest = (own.h / 2, float(np.ptp(own.t)) / _LEAST, own._h_most)
    return tol, min((h for h in longest if h > 0), default=0.0)


def _filled(rows: Array) -> Array:
    """Differences at rows; behind those that a run came to the last of them."""
    there = np.isfinite(rows).all(axis=1)
    found: Array = np.nan_to_num(
        rows[np.maximum.accumulate(np.where(there, np.arange(len(rows)), 0))]
    )
    found[-1] = found[-1 - len(rows) // _TAIL :].max(axis=0)  # it may vanish for a moment
    return found


def _verdict(own: Fitted, left: Array, rounding: Array, amplification: float) -> str:
    """What speaks against the run; its differences, and rounding, relative to the scales."""
    words = []
    if own.status not in ("ok", "accumulated"):
        words.append(f"the run stopped at t = {own.t[-1]:.6g} s")
    lost, wrong = (np.asarray((x > _TENTH).any(axis=1)) for x in (rounding, left))
    if lost[-1]:
        words.append(
            f"chaotic: a difference at the start grows {amplification:.1g} times or more, and "
            f"rounding with it; no run in {own._model.dtype} means anything from "
            f"t = {own.t[int(np.argmax(lost))]:.4g} s on"
        )
    if wrong.any():
        row = int(np.argmax(wrong))
        words.append(
            f"the error exceeds a tenth of the motion from t = {own.t[row]:.4g} s on: take a "
            f"{'smaller h' if own._by else 'tighter tolerance'}, or a shorter duration"
        )
    return "; ".join(words)
