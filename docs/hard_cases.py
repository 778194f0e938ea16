"""Write docs/hard-cases.md: the best method and its error for each case of tests/data/cases.json.

python docs/hard_cases.py [CASE...]      write the table, or print the rows of these cases
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
from support.cases import case_system, cases  # noqa: E402

from eomc.base.errors import EomcError  # noqa: E402
from eomc.integrators.tableaux import METHODS  # noqa: E402
from eomc.report import cost_of_digits  # noqa: E402

LONGEST = 0.5  # s, computing time of one run
LONG = 4  # factor of LONGEST while fewer than six digits are correct
PATIENCE = 3  # consecutive halvings of h without improvement, once an error is small
LEAST_ORDER = 4  # methods of lower order do not reach many digits
LUCK = 10.0  # an error that grows by this factor with half the step was small by chance
NEAR = 3.0  # the fastest run within this factor of the smallest error or the floor is shown

INTRODUCTION = """# Hard cases

Systems with known solutions, and the accuracy of each integration method: every case of
`tests/data/cases.json` without constraints, with every suitable method of order 4 and more, at
h = t_end/2^k, within {longest:g} s of computing time. The table shows the fastest run whose error
is within a factor of {near:g} of the smallest error, or of the floor if that is larger; a run whose
error increases much with half the step is left out.

- *Error*: max |q - q_ref|/max(1, max |q_ref|) at the end, compared with a solution of 30 digits.
- *Floor*: the effect of rounding the initial state to doubles (`double_floor`).
- *Evaluations*: of the accelerations, including those of every iteration.
- *Computing time*: of one run on two shared cores, x86-64.

`tests/physics/test_refs.py` lists which cases reach ten times the floor, and why the others do not.

`python docs/hard_cases.py` writes this file.

"""


@dataclass(frozen=True)
class Best:
    """The best run of a case: method, step size, error and cost."""

    method: str
    h: float
    error: float
    evaluations: int
    seconds: float


def best(name: str) -> Best | None:
    """Return the fastest run near the smallest error or the floor; None if none ends."""
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
    """Return the row of a case in the table."""
    floor = cases()[name]["double_floor"]
    told = "-" if floor is None else f"{floor:.1e}"
    try:
        found = best(name)
    except EomcError as fault:
        return f"| {name} | {str(fault).splitlines()[0]} | | | {told} | | |"
    if found is None:
        return f"| {name} | no run reaches the end in {LONGEST:g} s | | | {told} | | |"
    return (
        f"| {name} | {found.method} | {found.h:.3g} | {found.error:.1e} | {told} "
        f"| {found.evaluations} | {found.seconds * 1e3:.3g} ms |"
    )


def main(wanted: list[str]) -> None:
    """Print each row; write the file if all cases are run."""
    known = [name for name, case in cases().items() if not case["constraints"]]
    rows = []
    for name in wanted or known:
        rows.append(row(name))
        print(rows[-1], flush=True)
    if wanted:
        return
    head = "| case | method | h, s | error | floor | evaluations | computing time |\n"
    text = INTRODUCTION.format(longest=LONGEST, near=NEAR) + head
    text += "|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    (ROOT / "docs" / "hard-cases.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
