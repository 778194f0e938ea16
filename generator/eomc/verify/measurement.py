"""The result of one measurement of `check`: a number, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Measurement:
    """A measured value; inf if there is nothing to measure, with the reason in `why`.

    unit, limit: replace those of the row, if another quantity was measured.
    """

    value: float
    why: str = ""
    unit: str = ""
    limit: float = math.inf


def largest(errors: Iterable[float | None], why: str) -> float | Measurement:
    """Return the largest known error, nan if any is; not judged, with `why`, if none is known."""
    known = [x for x in errors if x is not None]
    return float(np.max(known)) if known else Measurement(math.nan, why)


def units(values: Any, expected: Any, size: Any, eps: float) -> float:
    """Return the largest difference in units of rounding; nan if a value is not a number."""
    difference = np.abs(np.asarray(values, float) - expected)
    if difference.shape != np.shape(expected):
        raise ValueError(f"shape {np.shape(values)} where {np.shape(expected)} is meant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(
            np.max(np.where(difference == 0, 0, difference / (eps * np.asarray(size))), initial=0)
        )
