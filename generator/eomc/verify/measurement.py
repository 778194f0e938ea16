"""What a row of `check` finds: a number, or the reason why none can be had."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Measurement:
    """What was found; inf where there is nothing to measure. why: nothing is judged, and why.

    unit, limit: of another measure than the row's own, at most the limit.
    """

    value: float
    why: str = ""
    unit: str = ""
    limit: float = math.inf


def largest(errors: Iterable[float | None], why: str) -> float | Measurement:
    """The largest of those that there are, nan before all; with none, not judged and why."""
    known = [x for x in errors if x is not None]
    return float(np.max(known)) if known else Measurement(math.nan, why)


def units(values: Any, expected: Any, size: Any, eps: float) -> float:
    """The largest difference in units of rounding, nan where something is not a number."""
    difference = np.abs(np.asarray(values, float) - expected)
    if difference.shape != np.shape(expected):
        raise ValueError(f"shape {np.shape(values)} where {np.shape(expected)} is meant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(
            np.max(np.where(difference == 0, 0, difference / (eps * np.asarray(size))), initial=0)
        )
