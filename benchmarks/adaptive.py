"""Compare adaptive steps with heyoka's Taylor integrator and with fixed steps; write ADAPTIVE.md.

    python benchmarks/adaptive.py [--rounds 40] [--only WORD]

Cases of tests/data/cases.json without constraints, with errors of at most 1e-9 and 1e-12 at the
end. Each program uses its loosest tolerance, in steps of sqrt 10, or longest step that reaches the
error, in its fastest form. Then all run in turns on one pinned core; the smallest time of each
counts.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from machine import CORES, machine
from searching import Array, adaptive_in_c, fewest, quick, timed
from taylor import Options, Taylor

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT / "tests"))

from support.cases import cases, scene_text  # noqa: E402

import eomc  # noqa: E402
from eomc.model.system import from_scene  # noqa: E402
from eomc.scene.read import parse  # noqa: E402

TARGETS = (1e-9, 1e-12)
EACH, MEDIAN = 0.8, 0.4  # bars: our time over heyoka's
METHODS = ("rk4", "dp8", "gauss8", "gauss16")
LONG = 0.15  # s, of a run; the search takes dozens
WORTH = 1.0  # s: fixed steps that take longer are not looked for
NONE = 1e-3  # who errs by more at every tolerance has no answer
LOOSEST, TIGHTEST = 4, 30  # tolerances 10^(-k/2), all that eomc takes
JUMPS = ("coulomb_friction",)  # whose right-hand side jumps, which heyoka can't say


@dataclass(frozen=True)
class Way:
    """Who runs, with which setting, the call, and its error."""

    setting: str
    run: Callable[[], object]
    error: float


class Search:
    """Errors by tolerance 10^(-k/2), each computed once."""

    def __init__(self, error: Callable[[float], float]) -> None:
        self.error = cache(lambda k: error(10.0 ** (-k / 2)))

    def loosest(self, wanted: float) -> int | None:
        """The first k that reaches it; None: none does."""
        return next((k for k in range(LOOSEST, TIGHTEST + 1) if self.error(k) <= wanted), None)

    def floor(self) -> float:
        """The least error of all."""
        return min(self.error(k) for k in range(LOOSEST, TIGHTEST + 1))


class Case:
    """A case with its module and heyoka's integrators."""

    def __init__(self, name: str) -> None:
        self.name = name
        asked = f"[run]\nmethod = {list(METHODS)}\ntolerance = 1e-9"
        text = scene_text(name).replace("[run]", asked.replace("'", '"'))
        system = from_scene(parse(text, f"{name}.toml"))
        self.module: ModuleType = eomc.load(system, ROOT / "build" / "adaptive")
        self.end = float(cases()[name]["t_end"])
        self.right = np.array(cases()[name]["q_ref"], float)
        self.theirs = Taylor(system, self.end)
        self.mine = Search(lambda tol: self.error(self.module.simulate(tol=tol)))
        self.heyoka = Search(lambda tol: self.off(self.theirs.run(tol, self.first)()))
        self.fewest: dict[str, int] = {}

    @property
    def first(self) -> Options:
        """With which tolerances are looked for."""
        return Options(compact_mode=self.theirs.n > 4)

    def off(self, q: Array) -> float:
        """max_i |q_i - q_ref_i| / max(1, max_i |q_ref_i|)."""
        found = float(np.max(np.abs(q - self.right)) / max(1.0, np.max(np.abs(self.right))))
        return found if math.isfinite(found) else math.inf

    def error(self, run: Any) -> float:
        """That of a run at the end, inf where it stopped."""
        return self.off(run.q[-1]) if run.status == "ok" else math.inf

    def fixed(self, wanted: float, least: float) -> Way | None:
        """The quickest method at its longest step; None: none within some time."""
        found: list[Way] = []
        bound = max(WORTH, 3 * least)
        for method in METHODS:

            def run(steps: int, method: str = method) -> Any:
                h = self.end / steps
                return self.module.simulate(h=h, steps=steps, every=steps, method=method)

            off = cache(lambda steps, run=run: self.error(run(steps)))
            bad = cache(lambda steps, run=run, limit=bound: quick(partial(run, steps)) < limit)
            if steps := fewest(off, wanted, bad, within=20):
                call = partial(run, steps)
                found.append(Way(f"{method} {steps}", call, off(steps)))
                bound = min(bound, 2 * quick(call))
        return min(found, key=lambda way: quick(way.run)) if found else None

    def taylor(self, k: int, wanted: float) -> tuple[Way, Options]:
        """heyoka at a tolerance in its quickest form."""
        tol, found = 10.0 ** (-k / 2), list[tuple[float, Way, Options]]()
        for options in self.theirs.options():
            run = self.theirs.run(tol, options)
            if (error := self.off(run())) <= wanted or options == self.first:
                found.append((quick(run), Way(f"{tol:.0e}", run, error), options))
        found.sort(key=lambda entry: entry[0])
        # the machine is noisy: the best two once more, by turns
        again = [min(quick(way.run) for _ in range(3)) for _, way, _ in found[:2]]
        return found[int(np.argmin(again))][1:]


@dataclass(frozen=True)
class Line:
    """A line of the table; least times in us. said: which floor the target is."""

    name: str
    wanted: float
    said: str
    ours: str
    mine: Way
    fixed: Way | None
    theirs: Way | None
    how: str
    times: Array

    @property
    def ratio(self) -> float:
        """Our time over heyoka's, nan where that has no answer."""
        return float(self.times[0] / self.times[3])

    @property
    def met(self) -> bool:
        return not self.ratio > EACH

    def __str__(self) -> str:
        own, alone, fixed, other = (f"{x:.4g}" for x in self.times)
        steps = f"{self.fixed.setting} | {fixed}" if self.fixed else f"over {WORTH:g} s | "
        heyoka = "no answer | | | |"
        if self.theirs is not None:
            heyoka = (
                f"{self.how} | {self.theirs.setting} | {self.theirs.error:.1e} | {other} "
                f"| {self.ratio:.2f}{'' if self.met else ' **lost**'} |"
            )
        return (
            f"| {self.name} | {self.wanted:.0e}{self.said} | {self.ours} | {self.mine.setting} "
            f"| {self.mine.error:.1e} | {own} | {alone} | {steps} | {heyoka}"
        )


def lines(name: str, rounds: int, most: float) -> Iterator[Line | str]:
    """A line for each target; a sentence where there is none."""
    case = Case(name)
    if any(quick(run) > most for run in (
        partial(case.module.simulate, tol=1e-9), case.theirs.run(1e-9, case.first)
    )):  # fmt: skip
        yield f"{name} (a run to 1e-9 takes over {most:g} s)"
        return
    before = 0.0
    for target in TARGETS:
        wanted, said = target, ""
        mine, heyoka = case.mine.loosest(target), case.heyoka.loosest(target)
        if mine is None or heyoka is None:
            floors = {
                who: search.floor()
                for who, search, k in (("ours", case.mine, mine), ("heyoka", case.heyoka, heyoka))
                if k is None
            }
            if floors.get("ours", 0.0) > NONE:
                yield f"{name} (not solvable in double precision)"
                return
            answered = {who: floor for who, floor in floors.items() if floor <= NONE}
            if answered:
                who = max(answered, key=lambda who: answered[who])
                wanted = float(f"{2 * answered[who]:.0e}")
                said = f" (floor{'' if len(answered) == 2 else ' of ' + who})"
            if wanted == before:
                continue
            mine, heyoka = case.mine.loosest(wanted), case.heyoka.loosest(wanted)
        before = wanted
        assert mine is not None
        yield line(case, wanted, said, mine, heyoka, rounds)


def line(case: Case, wanted: float, said: str, k: int, other: int | None, rounds: int) -> Line:
    tol = 10.0 ** (-k / 2)
    call = partial(case.module.simulate, tol=tol)
    run = call()
    own = Way(f"{tol:.0e}", call, case.mine.error(k))
    theirs, how = None, ""
    if other is not None:
        theirs, options = case.taylor(other, wanted)
        order, steps = case.theirs.steps(10.0 ** (-other / 2), options)
        how = f"{order} x {steps}, {options}"
    fixed = case.fixed(wanted, quick(call))
    ways = [
        call,
        adaptive_in_c(case.module, case.end, tol),
        fixed and fixed.run,
        theirs and theirs.run,
    ]
    times = timed(ways, rounds)
    ours = f"{run.steps}+{run.rejected}, {run.evaluations}"
    return Line(case.name, wanted, said, ours, own, fixed, theirs, how, times)


# --- the page ------------------------------------------------------------------------------------

HEAD = """\
# Adaptive steps

Written by `python benchmarks/adaptive.py`: the cases of `tests/data/cases.json` without constraints, with errors of at most {targets} at the end:
max |q - q_ref| / max(1, max |q_ref|). Times of whole runs in us, the smallest of {rounds} rounds in which all programs run in turns on one core.
*Ratio*: time of `module.simulate(tol=...)` divided by that of heyoka's `taylor_adaptive`.

{machine}

| case | target | ours: steps+rejected, evaluations | tol | error | us | in C | fixed: method, steps | us | heyoka: order x steps, form | tol | error | us | ratio |
|---|---|---|---|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501
TAIL = """
- *Target*: if rounding errors prevent one of the two from reaching the target, it is twice the smallest error that this one reaches at any
  tolerance ("floor"); a second row with the same target is left out.
- Ours: the loosest tolerance, in steps of sqrt 10, that reaches the target. *In C*: the same loop without rows, called directly.
- Fixed: the fastest of {methods}, each with the longest step that reaches the target, within 5 %.
- heyoka: the loosest tolerance, in the same steps. Accelerations are derived from the same K and P by SymPy, with parameters as constants, expanded or
  simplified, solved by Cramer's rule or LDL^T, or by its own `lagrangian`; with and without `fast_math`, above four coordinates also in compact mode.
  The fastest of these counts. Compilation is not counted.
- Left out: {left}.
"""  # noqa: E501


def findings(found: list[Line]) -> str:
    """Return the summary: how many cases meet the bars, and which do not."""
    rated = [line.ratio for line in found if line.theirs is not None]
    lost = [f"{x.name} to {x.wanted:.0e} ({x.ratio:.2f})" for x in found if not x.met]
    alone = [x.name for x in found if x.theirs is None]
    middle = float(np.median(rated)) if rated else math.nan
    return (
        f"\nRatio at most {EACH:g}: {len(found) - len(lost)} of {len(found)}. "
        f"Median {middle:.2f}, bar {MEDIAN:g} {'met' if middle <= MEDIAN else '**missed**'}.\n\n"
        f"Ratio above {EACH:g} (**lost**): {', '.join(lost) or 'none'}.\n"
        + (f"\nheyoka does not reach the target: {', '.join(alone)}.\n" if alone else "")
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--most", type=float, default=LONG, help="s of a run; left out above")
    parser.add_argument("--only", default="", help="a word in the case; writes no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(CORES)})
    warnings.simplefilter("ignore", RuntimeWarning)  # of steps that are too long
    found: list[Line] = []
    left = [f"{name} (discontinuous right-hand side)" for name in JUMPS]
    for name, case in cases().items():
        if case["constraints"] or name in JUMPS or options.only not in name:
            continue
        for line in lines(name, options.rounds, options.most):
            print(line, flush=True)
            if isinstance(line, str):
                left.append(line)
            else:
                found.append(line)
    print(findings(found))
    if not options.only:
        packages = ("eomc", "heyoka", "numpy", "sympy")
        text = HEAD.format(
            targets=" and ".join(f"{x:g}" for x in TARGETS), rounds=options.rounds,
            machine=machine(packages),
        )  # fmt: skip
        text += "\n".join(map(str, found)) + "\n" + findings(found)
        text += TAIL.format(methods=", ".join(METHODS), left="; ".join(left))
        (HERE / "ADAPTIVE.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
