"""Row of `check` about sines and cosines near their zeros, as far as they are inlined.

Near a multiple of a quarter turn, an error of 1e-17 in the reduction of an angle is lost in most
sums, but not in an entry of D or g that is one sine times something else. The reference shows which
entries are: at neighbouring doubles they are proportional to the sine, and larger than what is
left of constants that cancel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import Measurement
from eomc.verify.sampling import Expected

LIMIT = 100.0  # units; a constant of the reduction that is off makes 1e9
QUARTERS = (1, 2, -3, 4, -7, 1024, -99_999, 667_542)  # the last ones near 2^20 rad
# doubles beside each; some far, as from one to the next what a sum rounds may hardly change
NEIGHBOURS = (-613, -2, -1, 0, 1, 2, 389)
PROPORTION_TOLERANCE = 1e-6  # an entry over its sine, at neighbours
CLEAR = 0.1  # of an error: what neighbours may differ by, where it is no rounding of a sum
Errors = dict[tuple[str, int], float]  # of entries of D and g
# of other coordinates, which change what sums round, no sine: also the power of two whose roundings
# a sum has that all but cancels; in no proportion to each other, as roundings recur
MOVES = (1e-6, -0.43, 0.31, 0.77, -0.68)


def report(check: Comparison) -> None:
    """Append a check of sines near their zeros to the report of `eomc check`, if there are angles.

    There is none in single precision, which takes its sines from double precision.
    """
    if np.any(check.sampler.angles) and check.dtype == np.float64:
        check.row("sines that vanish", LIMIT, "units of rounding", lambda: vanishing(check))


def vanishing(check: Comparison) -> float | Measurement:
    """Return the largest relative error of entries of D and g near zeros of a sine, in roundings.

    The entries are those that are proportional to one sine, so that they vanish with it. An entry
    counts if it vanishes at all multiples of a quarter turn at which the sine does. One that
    vanishes at some of them only may be a sum that cancels there, such as 1 - tanh(x)**2 for large
    x.
    """
    e, errors = check.few(2)[-1], list[float]()
    for i in map(int, np.flatnonzero(check.sampler.angles)):
        for odd in (0, 1):
            places = [n for n in QUARTERS if n % 2 == odd]
            error_tables = [dict(_entry_errors(check, i, n, e)) for n in places]
            common = set.intersection(*map(set, error_tables))
            for quarters, here in zip(places, error_tables, strict=True):
                errors += _sure(check, i, quarters, e, {k: here[k] for k in common})
    if not errors:
        return Measurement(math.inf, "no entry of D or g is one sine times something")
    return max(errors)


def _sure(check: Comparison, i: int, quarters: int, e: Expected, errors: Errors) -> Iterable[float]:
    """Return the errors that stay the same, relative to the entry, if other coordinates move."""
    if max(errors.values(), default=0.0) <= LIMIT:
        return errors.values()
    again = [dict(_entry_errors(check, i, quarters, other)) for other in _moved(e)]
    each = {k: [x, *(a.get(k, 0.0) for a in again)] for k, x in errors.items()}
    return [min(x) for x in each.values() if np.ptp(x) <= CLEAR * max(x)]


def _moved(e: Expected) -> Iterator[Expected]:
    s = e.state
    for by in MOVES:
        yield replace(e, state=replace(s, q=s.q * (1 + by), t=s.t * (1 + by)))


def _entry_errors(
    check: Comparison, i: int, quarters: int, e: Expected
) -> Iterator[tuple[tuple[str, int], float]]:
    """Return the errors of entries with coordinate i near this number of quarter turns."""
    s, angle = e.state, quarters * (math.pi / 2)
    angles = angle + np.array(NEIGHBOURS) * math.ulp(angle)
    sines = np.array([math.cos(x) if quarters % 2 else math.sin(x) for x in angles.tolist()])
    states = [replace(s, q=np.where(np.arange(len(s.q)) == i, x, s.q)) for x in angles]
    for name in ("D", "g"):
        with np.errstate(all="ignore"):
            known = [check.reference.evaluate(name, x.q, x.qd, x.t, None, x.params) for x in states]
            expected = np.reshape(known, (len(states), -1))
            parts = expected / sines[:, None]
            values = np.reshape([check.ask(name, x) for x in states], expected.shape)
            least = LIMIT * check.eps * np.ravel(e.size[name])
            for k, (part, entry, value) in enumerate(
                zip(parts.T, expected.T, values.T, strict=True)
            ):
                if np.all(np.abs(part) > least[k]) and np.ptp(
                    part
                ) <= PROPORTION_TOLERANCE * np.max(np.abs(part)):
                    yield (name, k), _error(value - entry, entry, check.eps)


def _error(off: Vector, entry: Vector, eps: float) -> float:
    """Return the relative error of an entry, in units of rounding.

    It is 0 if it is neither constant at all neighbours nor proportional to the entry: then the
    module computes the same entry by a sum that cancels.
    """
    errors = [
        float(np.max(np.abs(x))) if np.ptp(x) <= CLEAR * np.max(np.abs(x)) else 0.0
        for x in (off / np.median(np.abs(entry)), off / entry)
    ]
    small = float(np.max(np.abs(off / entry)))
    return small / eps if small <= LIMIT * eps else max(errors) / eps
