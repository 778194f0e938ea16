"""The result of one measurement of `check`: a number, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Measurement:
    """A measured value, or the reason `why` nothing can be judged.

    With a reason, the report's row passes; the value inf then means that there is nothing to test.
    unit, limit: replace those of the row if the value is of another quantity than the row's.
    """

    value: float
    why: str = ""
    unit: str = ""
    limit: float = math.inf


def largest(errors: Iterable[float | None], why: str) -> float | Measurement:
    """Return the largest of the errors; None in place of an error means nothing to compare.

    The result is nan if one of the errors is nan. If all are None, it is a Measurement with the
    reason `why`, which is not judged.
    """
    known = [x for x in errors if x is not None]
    return float(np.max(known)) if known else Measurement(math.nan, why)


def units(values: Any, expected: Any, size: Any, eps: float) -> float:
    """Return the largest error of some values, |values - expected| / (eps size), in roundings.

    eps is the relative rounding error of a number. size: the size of the terms that make up each
    value. The result is 0 if there are no values and nan if one is nan. Raises ValueError if the
    shapes differ.
    """
    difference = np.abs(np.asarray(values, float) - expected)
    if difference.shape != np.shape(expected):
        raise ValueError(f"shape {np.shape(values)} where {np.shape(expected)} is meant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(
            np.max(np.where(difference == 0, 0, difference / (eps * np.asarray(size))), initial=0)
        )
