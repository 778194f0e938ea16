"""Writes docs/hard-cases.md: every case of tests/data/cases.json, its best stepper and its error.

python docs/hard_cases.py [CASE...]      the table of all, or those cases printed
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from cases import case_system, cases  # noqa: E402

from eomc.base.errors import EomcError  # noqa: E402
from eomc.integrators.tableaux import METHODS  # noqa: E402
from eomc.report import cost_of_digits  # noqa: E402

LONGEST = 0.5  # s of computing of one run
LONG = 4  # times that, while fewer than six digits are found
PATIENCE = 3  # halvings of h in a row that may bring nothing, once an error is small
LEAST_ORDER = 4  # lower ones are no way to many digits
LUCK = 10.0  # times worse with half the step: then an error was small by chance
NEAR = 3.0  # times the smallest error or the floor: the quickest run of those counts

INTRODUCTION = """# Hard cases

Every case of `tests/data/cases.json` without constraints, run with every stepper of order 4 and
more that it can use, at h = t_end/2^k, as far as {longest:g} s of computing go. Shown is the
quickest run whose error is within a factor of {near:g} of the smallest, or of the floor where that
is larger, runs left out that half the step makes much worse. Error: max |q - q_ref|/max(1, max
|q_ref|) at the end, against 30 digits. Floor: what rounding of the start alone makes of it in
doubles (`double_floor`). Evaluations: of accelerations, those of every sweep of an iteration
counted. Computing: of one run on two shared cores, x86-64. Which cases come within ten times the
floor, which do not and why, is in `tests/physics/test_refs.py`.

`python docs/hard_cases.py` writes this file.

"""


@dataclass(frozen=True)
class Best:
    """The run that counts: its stepper, h and error, what it took."""

    method: str
    h: float
    error: float
    evaluations: int
    seconds: float


def best(name: str) -> Best | None:
    """The quickest run near the smallest error or the floor; None: none gets to the end."""
    case = cases()[name]
    system = case_system(name)
    methods = tuple(m.name for m in METHODS.values() if m.order >= LEAST_ORDER)
    module, _ = cost_of_digits.build_variant(system, methods, ROOT / "build" / "hard_cases")
    runs = [run for method in module.methods for run in _runs(module, method, case)]
    if not runs:
        return None
    least = max(min(run.error for run in runs), case["double_floor"] or 0.0)
    return min((r for r in runs if r.error <= NEAR * least), key=lambda r: r.seconds)


def _runs(module: ModuleType, method: str, case: dict[str, Any]) -> list[Best]:
    t_end, exact = float(case["t_end"]), np.array(case["q_ref"], float)
    found: list[Best] = []
    power = 4
    while power < 40:
        steps = 2**power
        power += 1
        begun = time.perf_counter()
        with (
            warnings.catch_warnings(action="ignore", category=RuntimeWarning),
            np.errstate(all="ignore"),
        ):
            run = module.simulate(h=t_end / steps, steps=steps, every=steps, method=method)
        seconds = time.perf_counter() - begun
        error = float(np.max(np.abs(run.q[-1] - exact)) / max(1.0, np.max(np.abs(exact))))
        if run.status == "ok" and np.isfinite(error) and error < 1:
            found.append(Best(method, t_end / steps, error, run.evaluations, seconds))
            errors = [r.error for r in found]
            if min(errors) < 1e-9 and len(errors) - 1 - int(np.argmin(errors)) >= PATIENCE:
                break
        lost = min((r.error for r in found), default=1.0) > 1e-6
        if seconds > LONGEST * (LONG if lost else 1):
            break
    followed = [b.error <= LUCK * a.error for a, b in pairwise(found)]
    return [run for run, good in zip(found, followed, strict=False) if good]


def row(name: str) -> str:
    """The case as a row of the table."""
    floor = cases()[name]["double_floor"]
    told = "-" if floor is None else f"{floor:.1e}"
    try:
        found = best(name)
    except EomcError as fault:
        return f"| {name} | {str(fault).splitlines()[0]} | | | {told} | | |"
    if found is None:
        return f"| {name} | none gets to the end in {LONGEST:g} s | | | {told} | | |"
    return (
        f"| {name} | {found.method} | {found.h:.3g} | {found.error:.1e} | {told} "
        f"| {found.evaluations} | {found.seconds * 1e3:.3g} ms |"
    )


def main(wanted: list[str]) -> None:
    """Print rows as they are made; write the file where all are."""
    known = [name for name, case in cases().items() if not case["constraints"]]
    rows = []
    for name in wanted or known:
        rows.append(row(name))
        print(rows[-1], flush=True)
    if wanted:
        return
    head = "| case | stepper | h, s | error | floor | evaluations | computing |\n"
    text = INTRODUCTION.format(longest=LONGEST, near=NEAR) + head
    text += "|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    (ROOT / "docs" / "hard-cases.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
