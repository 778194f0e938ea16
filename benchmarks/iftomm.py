"""Run A01 to A05 of the IFToMM library with its error criteria; write IFTOMM.md.

    python benchmarks/iftomm.py [--only A02]

The library states admissible errors for A01 and A02. Reference positions along those runs are
computed from the same motion in one coordinate, whose end is known to 30 digits
(tests/data/cases.json).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from machine import CORES, machine
from searching import Array, fewest, quick

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT / "tests"))

from support import cases, constraint_cases  # noqa: E402  (of the tests)

import eomc  # noqa: E402
from eomc.model.system import System, from_scene  # noqa: E402
from eomc.scene.read import parse  # noqa: E402

LOW, HIGH = 1e-1, 1e-3  # errors that the library admits
THRESHOLD = 1e-3  # what a number counts at least in its own error
WORTH = 0.3  # s: longer runs are not looked for
FINE = 128  # steps of the reference between outputs, in one coordinate
PENDULUM = """eomc = 1
name = "a01"
[coordinates]
x = { start = 1.0 }
y = { start = 0.0 }
[constraints]
rod = "x**2 + y**2 - 1"
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[run]
h = 0.01
duration = 10.0
"""
SQUEEZER, CUBE = "andrews_squeezer_forces", "bricard_cube"
FOUR_BARS, GOVERNOR = "iftomm_A02_four_bar_N{}", "iftomm_A05_governor"


@dataclass(frozen=True)
class Problem:
    """What is run how long, with so many outputs; its error; which errors are admitted."""

    name: str
    made: System
    methods: tuple[str, ...]
    end: float
    outputs: int
    error: Callable[[Any], float]
    admitted: dict[str, float]
    published: str
    adaptive: bool = True

    @property
    def module(self) -> ModuleType:
        return _module(self.made, self.methods, self.adaptive)


@cache
def _module(made: System, methods: tuple[str, ...], adaptive: bool) -> ModuleType:
    run = replace(made.run, methods=methods, tolerance=1e-9 if adaptive else None)
    found: ModuleType = eomc.load(replace(made, run=run), ROOT / "build" / "iftomm")
    return found


@cache
def angle(case: str, end: float, outputs: int) -> tuple[Array, Array]:
    """The one coordinate of a case and its rate at the outputs."""
    module = _module(cases.case_system(case), ("gauss16",), False)
    steps = FINE * outputs
    run = module.simulate(h=end / steps, steps=steps, every=FINE)
    return run.q[:, 0], run.qd[:, 0]


def along(case: str, rates: bool, outputs: int, run: Any) -> float:
    """The library's error of the first point: its place, and velocity if `rates`.

    The root of the mean square of each number's error in parts of itself, or of THRESHOLD.
    """
    if run.status != "ok" or len(run) != outputs + 1:
        return math.inf
    phi, speed = angle(case, float(run.t[-1]), outputs)
    place = np.column_stack([np.cos(phi), np.sin(phi)])
    right = [place, speed[:, None] * place[:, ::-1] * [-1, 1]] if rates else [place]
    found = [run.q[:, :2], run.qd[:, :2]] if rates else [run.q[:, :2]]
    off = np.hstack(found) - np.hstack(right)
    return float(np.sqrt(np.mean((off / np.maximum(np.abs(np.hstack(right)), THRESHOLD)) ** 2)))


def at_end(case: str, of: Any, row: int, run: Any) -> float:
    """The error of a row beside the digits that are known, in parts of the largest."""
    if run.status != "ok":
        return math.inf
    right = np.array(of.cases()[case]["q_ref"], float)
    return float(np.max(np.abs(run.q[row] - right)) / max(1, np.max(np.abs(right))))


def problems() -> Iterator[Problem]:
    """In the library's order; behind its own runs those that have a published time."""
    rod = from_scene(parse(PENDULUM, "a01.toml"))
    all_methods = ("rk4", "dp8", "gauss16")
    both, high = {"low": LOW, "high": HIGH}, {"1e-3": HIGH}
    pendulum = partial(along, "iftomm_A01_pendulum_minimal", False)
    yield Problem("A01, 2000 s", rod, all_methods, 2000.0, 4000, partial(pendulum, 4000), both, "")
    yield Problem("A01, 10 s", rod, all_methods, 10.0, 20, partial(pendulum, 20), high, "0.637 s")
    for n, end, outputs, admitted, published in (
        (40, 20.0, 400, both, ""),
        (2, 10.0, 200, high, "0.455 s"),
    ):
        case = FOUR_BARS.format(n)
        error = partial(along, case, True, outputs)
        made, few = constraint_cases.system(case), ("rk4", "dp8")
        name = f"A02, N = {n}, {end:g} s"
        yield Problem(name, made, few, end, outputs, error, admitted, published, False)
    made = constraint_cases.system(SQUEEZER)
    error = partial(at_end, SQUEEZER, constraint_cases, 3)  # of five rows: 0.03 s
    yield Problem("A03, 0.05 s", made, all_methods, 0.05, 5, error, high, "0.384 s")
    made = constraint_cases.system(CUBE)
    error = partial(at_end, CUBE, constraint_cases, -1)
    yield Problem("A04, 10 s", made, all_methods, 10.0, 1, error, high, "0.258 s")
    error = partial(at_end, GOVERNOR, cases, -1)
    stiff = ("gauss8", "gauss16")
    made = cases.case_system(GOVERNOR)
    yield Problem("A05, 10 s", made, stiff, 10.0, 1, error, high, "0.233 s")


def ways(p: Problem, wanted: float) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Of each method the run that reaches the error in the fewest steps, with a row an output."""
    for method in p.methods:

        def run(k: int, method: str = method) -> Any:
            steps = k * p.outputs
            how = {"h": p.end / steps, "steps": steps, "every": k, "method": method}
            return p.module.simulate(**how)

        def worth(k: int, run: Any = run) -> bool:
            return quick(partial(run, k)) < WORTH

        if k := fewest(lambda k, run=run: p.error(run(k)), wanted, worth):  # type: ignore[misc]
            yield f"{method}, {k * p.outputs} steps", partial(run, k)
    if p.adaptive:
        times = np.linspace(0, p.end, p.outputs + 1)
        for tol in (10.0 ** (-k / 2) for k in range(4, 25)):
            fitted = partial(p.module.simulate, tol=tol, times=times)
            if p.error(fitted()) <= wanted:
                yield f"adaptive, {tol:.0e}", fitted
                break


def line(p: Problem, name: str, wanted: float) -> str:
    """Return a row of the table: the fastest run with an admissible error."""
    found = [(quick(run), told, run) for told, run in ways(p, wanted)]
    if not found:
        return f"| {p.name} | {name} | not reached | | | | {p.published} |"
    spent, told, way = min(found, key=lambda x: x[0])
    run = way()
    drift = drifted(p, run)
    return (
        f"| {p.name} | {name} | {told} | {p.error(run):.1e} | {drift} | {spent * 1e3:.3g} ms "
        f"| {p.published} |"
    )


def drifted(p: Problem, run: Any) -> str:
    """Return the largest change of the energy, J; for A03 minus the work of the motor."""
    given = 0.0
    if p.name.startswith("A03"):
        given = p.module.defaults["mom"] * (run.q[:, 0] - run.q[0, 0])
    elif p.name.startswith("A05"):
        return "–"
    return f"{np.max(np.abs(run.energy - run.energy[0] - given)):.1e} J"


HEAD = """\
# IFToMM benchmarks A01 to A05

Written by `python benchmarks/iftomm.py`: the basic problems of the IFToMM library of multibody benchmarks, A01 to A04 with constraints. Times of whole runs from
Python with one row per output, the smallest of up to 15.

{machine}

| problem | admissible error | fastest | error | energy | run | OpenSim 3.2 |
|---|---|---|---|---|---|---|
"""  # noqa: E501
TAIL = """
- Admissible error: for A01 and A02 those of the library, {low:g} (low) and {high:g} (high), with 4000 and 400 outputs and a threshold of {threshold:g}: the root mean
  square, over outputs and components, of errors relative to the component or to the threshold. A01: the position of the point, A02: position and velocity
  of B0. The library's definition of the mean was not available; this is the usual one.
- For A03, A04 and A05 neither the library's admissible errors nor its result files were available. They are listed with 1e-3: the final positions compared with a known
  solution, relative to the largest coordinate; for A03 at 0.03 s.
- OpenSim 3.2: times published by the authors of MBS-BOS (i5-4570 at 3.2 GHz, Windows 8.1; A05's as in `tests/data/cases.json`), at its own accuracy, which is not
  the error in this table. Its A04 has rods 0.1 m thick, here they are thin. Other times of the library were not available. Because the processors differ, only the
  order of magnitude is significant.
- Energy: its largest change at the outputs; for A03 minus the work of the motor. A05 loses energy in its dampers, and has no constraints here: three coordinates by
  symmetry.
"""  # noqa: E501


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="a word in the problem's name; no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(CORES)})
    warnings.simplefilter("ignore", RuntimeWarning)  # of steps that are too long
    text = HEAD.format(machine=machine(("eomc", "numpy")))
    for p in problems():
        for name, wanted in p.admitted.items() if options.only in p.name else ():
            text += (made := line(p, name, wanted)) + "\n"
            print(made, flush=True)
    if not options.only:
        text += TAIL.format(low=LOW, high=HIGH, threshold=THRESHOLD)
        (HERE / "IFTOMM.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
