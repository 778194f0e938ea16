"""Results of checks: measured numbers, and the report with one line for each check."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Measurement:
    """A measured value, or the reason `why` nothing can be judged.

    With a reason, the check passes; the value inf then means that there is nothing to test. unit,
    limit: replace those of the check if the value is of another quantity than the check's.
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


# Limit of errors in units of rounding. Values of correct modules have errors below 1 unit, stiff
# runs some tens. A wrong sign makes 1e15, or 1e5 in a term that is 1e-10 of the result.
LIMIT = 1e3


@dataclass(frozen=True)
class CheckResult:
    """One line of the report: a check with its measured error, its limit, and the unit of both.

    passed: whether the check has passed. judged: False if nothing could be judged; the check then
    counts as passed and `unit` gives the reason.
    """

    name: str
    error: float
    limit: float
    passed: bool
    unit: str
    judged: bool = True


@dataclass(frozen=True)
class CheckReport:
    """The report of `eomc check`: the results of all checks, and how they were obtained.

    scene: name of the scene. states: number of states used. rejected: number of random states left
    out since their mass matrix D was not regular. reference: how the expected values were computed,
    either "equations written out" (formulas) or "Taylor arithmetic" (numerical).
    """

    scene: str
    results: tuple[CheckResult, ...]
    states: int
    rejected: int
    reference: str

    @property
    def passed(self) -> bool:
        """True if every check has passed."""
        return all(result.passed for result in self.results)

    def table(self) -> str:
        """Return the results as a text table, 100 columns wide, for a terminal."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        used = f"{self.states} random states" + f", {self.rejected} rejected" * bool(self.rejected)
        title = f"{self.scene}: {used}, against {self.reference}"
        table = Table(box=SIMPLE_HEAD, title=title, title_justify="left")
        table.add_column()
        table.add_column()
        table.add_column("found", justify="right")
        table.add_column("limit", justify="right")
        table.add_column("in")
        for x in self.results:
            mark = ("ok" if x.judged else "?") if x.passed else "FAILED"
            table.add_row(mark, x.name, f"{x.error:.3g}", f"{x.limit:g}", x.unit)
        text = io.StringIO()
        Console(file=text, width=100).print(table)
        return "\n".join(line.rstrip() for line in text.getvalue().splitlines()).strip("\n")

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a dict that can be written as JSON.

        An error that is not finite becomes None.
        """
        rows = [asdict(row) for row in self.results]
        for row in rows:
            row["error"] = row["error"] if math.isfinite(row["error"]) else None
        return {
            "scene": self.scene,
            "passed": self.passed,
            "states": self.states,
            "rejected": self.rejected,
            "reference": self.reference,
            "rows": rows,
        }
