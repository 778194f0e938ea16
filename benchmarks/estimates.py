"""How right runs are about their own error: the estimate beside the true one, over the library.

    python benchmarks/estimates.py [--most STEPS] [CASE ...]

For every case of tests/data/cases.json without constraints and every step size measured there: the
largest error of q at t_end, what `run.error` says, and their ratio. An answer is wrong where it is
off by more than a tenth of the largest value of a coordinate; no such may go without a verdict.
Building all cases takes a minute or two, running them some three.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from support.cases import case_system, cases  # noqa: E402

import eomc  # noqa: E402


@dataclass(frozen=True)
class Row:
    """One case at one step size. error, estimate: largest of q at the end. relative: the true
    error of the worst coordinate over its largest value."""

    name: str
    h: float
    steps: int
    status: str
    error: float
    estimate: float
    relative: float
    observed: float
    verdict: str

    @property
    def close(self) -> bool:
        """Whether the estimate is within a factor of ten."""
        return self.error / 10 <= self.estimate <= self.error * 10

    @property
    def silent(self) -> bool:
        """Whether the answer is wrong and nothing says so."""
        return self.relative > 0.1 and not self.verdict


def judged(name: str, module: Any, h: float, steps: int) -> Row:
    """A run and its estimate beside the trusted end state."""
    case = cases()[name]
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        run = module.simulate(h=h, steps=steps, every=max(1, steps // 400))
    if run.status != "ok":
        return Row(name, h, steps, run.status, np.nan, np.nan, np.nan, np.nan, run.message)
    found = run.estimate()
    off = np.abs(run.q[-1] - np.array(case["q_ref"], float))
    size = np.maximum(np.max(np.abs(run.q), axis=0), 1e-6 * np.max(np.abs(run.q)))
    return Row(
        name, h, steps, run.status, float(off.max()), float(found.q[-1].max()),
        float((off / size).max()), found.observed, found.verdict,
    )  # fmt: skip


def rows(names: list[str], most: int) -> Iterator[Row]:
    """Every pair of case and step size, in the library's order."""
    for name, case in cases().items():
        if case["constraints"] or (names and name not in names):
            continue
        module = eomc.load(case_system(name), ROOT / "build" / "estimates")
        for measured in case["rk4_measured"]:
            if measured["steps"] <= most:
                yield judged(name, module, measured["h"], measured["steps"])
            else:
                print(f"{name:30} {measured['h']:8.2g}  left out: {measured['steps']} steps")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--most", type=float, default=1e9, help="steps of a run")
    given = parser.parse_args()
    ended, close, silent = 0, 0, []
    print(f"{'case':30} {'h':>8} {'error':>9} {'estimate':>9} {'ratio':>7} {'order':>6}")
    for row in rows(given.cases, int(given.most)):
        if row.status != "ok":
            print(f"{row.name:30} {row.h:8.2g}  {row.status}")
            continue
        ended, close = ended + 1, close + row.close
        silent += [f"{row.name} h = {row.h:g}"] if row.silent else []
        print(
            f"{row.name:30} {row.h:8.2g} {row.error:9.2e} {row.estimate:9.2e} "
            f"{row.estimate / row.error:7.2f} {row.observed:6.1f}  {row.verdict}",
            flush=True,
        )
    print(f"within a factor of ten: {close} of {ended} ({100 * close / max(1, ended):.1f} %)")
    print(f"wrong by more than a tenth and not told: {', '.join(silent) or 'none'}")


if __name__ == "__main__":
    main()
