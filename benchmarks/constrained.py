"""Compare closed loops at matched errors with MuJoCo, Pinocchio and Exudyn; write CONSTRAINED.md.

    python benchmarks/constrained.py [--rounds 40] [--only WORD]

Cases of tests/data/constrained.json, whose final positions are known to 27 digits and more. Each
method makes the fewest steps or has the loosest tolerance that reaches the error; then all run in
turns on one pinned core, and the smallest time of each counts. The other programs run the four-bar.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import fourbars
from fourbars import SAMPLE, Peer
from machine import CORES, machine
from searching import adaptive_in_c, fewest, fixed_in_c, quick, timed

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT / "tests"))

from support.constraint_cases import cases, error_of, system  # noqa: E402  (of the tests)

import eomc  # noqa: E402
from eomc import pipeline  # noqa: E402
from eomc.derive import lagrange  # noqa: E402
from eomc.program import program  # noqa: E402

WANTED = (1e-3, 1e-6, 1e-9, 1e-12)
METHODS = ("rk4", "dp8", "gauss16")
FOUR_BAR, ANDREWS = "four_bar_crank_rocker", "andrews_squeezer_forces"
A02, BRICARD = "iftomm_A02_four_bar_N2", "bricard_cube"
CASES = (
    FOUR_BAR, "pendulum_over_the_top", "double_pendulum_cartesian", "slider_crank_bodies",
    "delta_robot", BRICARD, ANDREWS, "iftomm_A02_four_bar_N1", A02,
)  # fmt: skip
LOOSEST, TIGHTEST = 4, 30  # tolerances 10^(-k/2)
WORTH = 0.02  # s: longer runs are not looked for
H = 0.005  # s, of the steps that all take alike
FLOPS = {
    "pendulum_over_the_top": 16, FOUR_BAR: 114, "delta_robot": 247, ANDREWS: 440,
    "iftomm_A02_four_bar_N40": 10_000,
}  # fmt: skip
SHARES = {FOUR_BAR: 0.15, ANDREWS: 0.18}  # of a step's flops, most


@dataclass(frozen=True)
class Way:
    """A run in C: by which method, in how many steps, with which setting; its error."""

    method: str
    setting: str
    steps: int
    run: Callable[[], object]
    error: float

    def __str__(self) -> str:
        return f"{self.method}, {self.setting}"


class Case:
    """A case with its module."""

    def __init__(self, name: str) -> None:
        made = system(name)
        made = replace(made, run=replace(made.run, methods=METHODS, tolerance=1e-9))
        self.name, self.end = name, float(cases()[name]["t_end"])
        folder = ROOT / "build" / "constrained" / "_".join(METHODS)
        self.module: ModuleType = eomc.load(made, folder)
        self.least = math.inf  # of all errors seen
        self.error = cache(self._error)
        self.fitted = cache(self._fitted)

    def off(self, run: Any) -> float:
        """The relative error of a run's end, inf where it stopped."""
        found = error_of(self.name, run.q[-1]) if run.status == "ok" else math.inf
        self.least = min(self.least, found)
        return found if math.isfinite(found) else math.inf

    def _error(self, method: str, steps: int) -> float:
        h = self.end / steps
        return self.off(self.module.simulate(h=h, steps=steps, every=steps, method=method))

    def _fitted(self, k: int) -> tuple[float, int]:
        """The error at a tolerance 10^(-k/2), and the steps."""
        run = self.module.simulate(tol=10.0 ** (-k / 2))
        return self.off(run), run.steps

    def at(self, method: str, steps: int) -> Way:
        run = fixed_in_c(self.module, method, self.end / steps, steps)
        return Way(method, f"{steps} steps", steps, run, self.error(method, steps))

    def ways(self, wanted: float) -> list[Way]:
        """Of each method that which reaches the error, where one does in some time."""
        found: list[Way] = []
        for method in METHODS:

            def worth(steps: int, method: str = method) -> bool:
                return quick(fixed_in_c(self.module, method, self.end / steps, steps)) < WORTH

            if steps := fewest(lambda n, m=method: self.error(m, n), wanted, worth, within=20):
                found.append(self.at(method, steps))
        for k in range(LOOSEST, TIGHTEST + 1):
            error, steps = self.fitted(k)
            if error <= wanted:
                tol = 10.0 ** (-k / 2)
                run = adaptive_in_c(self.module, self.end, tol)
                found.append(Way("adaptive", f"{tol:.0e}, {steps} steps", steps, run, error))
                break
        return found


@dataclass(frozen=True)
class Rival:
    """A peer at a number of steps; reached: whether its error is the wanted one."""

    peer: Peer
    steps: int
    error: float
    reached: bool


def rival(group: Sequence[Peer], found: dict[Peer, Callable[[int], float]], wanted: float) -> Rival:
    """The peer's setting with the fewest steps, or the one with the least error."""
    best: list[Rival] = []
    seen: list[Rival] = []
    for peer in group:

        def error(steps: int, peer: Peer = peer) -> float:
            off = found[peer](steps)
            seen.append(Rival(peer, steps, off, off <= wanted))
            return off

        if steps := fewest(error, wanted, lambda n, peer=peer: n <= peer.most, within=20):
            best.append(Rival(peer, steps, error(steps), True))
    return min(best, key=lambda x: x.steps) if best else min(seen, key=lambda x: x.error)


def errors(peer: Peer, end: float) -> Callable[[int], float]:
    """Of its runs by the number of steps."""

    @cache
    def error(steps: int) -> float:
        off = error_of(FOUR_BAR, peer.run(end / steps, steps)())
        return off if math.isfinite(off) else math.inf

    return error


# --- tables --------------------------------------------------------------------------------------

Found = dict[float, list[tuple[Way, float]]]  # by the wanted error: ways and their us


def own(case: Case, rounds: int) -> Found:
    """All our ways of a case, timed in turns."""
    ways = {wanted: case.ways(wanted) for wanted in WANTED}
    flat = [way.run for some in ways.values() for way in some]
    times = iter(timed(flat, rounds))
    return {wanted: [(way, float(next(times))) for way in some] for wanted, some in ways.items()}


def lines(case: Case, found: Found) -> list[str]:
    """A line for each wanted error."""
    made: list[str] = []
    for wanted, ways in found.items():
        if not ways:
            made.append(
                f"| {case.name} | {wanted:.0e} | not reached | {case.least:.1e} | | | | | | |"
            )
            continue
        way, us = min(ways, key=lambda entry: entry[1])
        each = {w.method: f"{t:.4g}" for w, t in ways}
        columns = " | ".join(each.get(m, "–") for m in (*METHODS, "adaptive"))
        made.append(
            f"| {case.name} | {wanted:.0e} | {way} | {way.error:.1e} | {us:.4g} "
            f"| {us / way.steps:.3f} | {columns} |"
        )
    return made


def against(case: Case, groups: Sequence[Sequence[Peer]], rounds: int) -> list[str]:
    """The four-bar at matched errors: our quickest way and all peers, in turns."""
    known = {peer: errors(peer, case.end) for group in groups for peer in group}
    made: list[str] = []
    said: set[Peer] = set()  # whose least error is
    for wanted in WANTED:
        ways = case.ways(wanted)
        rivals = [rival(group, known, wanted) for group in groups]
        samples = [x.peer.sample(case.end / x.steps) for x in rivals]
        times = timed([*(way.run for way in ways), *samples], rounds)
        best = min(range(len(ways)), key=lambda i: times[i])
        way, us = ways[best], float(times[best])
        made.append(f"| {wanted:.0e} | eomc, {way} | {way.error:.1e} | {us:.4g} "
                    f"| {us / way.steps:.3f} | 1 |")  # fmt: skip
        for x, sampled in zip(rivals, times[len(ways) :], strict=True):
            step = float(sampled) / SAMPLE
            if x.peer in said:
                continue
            if not x.reached:
                said.add(x.peer)
            told = "" if x.reached else ", not reached"
            made.append(
                f"| {wanted:.0e} | {x.peer.name}, {x.peer.setting}, {x.steps} steps{told} "
                f"| {x.error:.1e} | {step * x.steps:.4g} | {step:.2f} "
                f"| {us / (step * x.steps):.1e} |"
            )
    return made


@dataclass(frozen=True)
class Alike:
    """Steps of one length: the error of a run and us of a step, by name."""

    error: dict[str, float]
    step: dict[str, float]

    def __str__(self) -> str:
        return "\n".join(
            f"| {name} | {error:.1e} | {self.step[name]:.3f} |"
            for name, error in self.error.items()
        )


def alike(case: Case, groups: Sequence[Sequence[Peer]], rounds: int) -> Alike:
    """RK4 in steps of H and what peers do in the same."""
    steps = round(case.end / H)
    way = case.at("rk4", steps)
    peers = [peer for group in groups for peer in group]
    times = timed([way.run, *(peer.sample(H) for peer in peers)], rounds)
    names = ["eomc, RK4", *(f"{peer.name}, {peer.setting}" for peer in peers)]
    off = [way.error, *(errors(peer, case.end)(steps) for peer in peers)]
    each = [times[0] / steps, *(times[1:] / SAMPLE)]
    return Alike(
        dict(zip(names, off, strict=True)), dict(zip(names, map(float, each), strict=True))
    )


# --- bars ----------------------------------------------------------------------------------------


def bar(what: str, measured: float, most: float, unit: str = "", said: str = "") -> str:
    met = "met" if measured <= most else "**missed**"
    return f"| {what} | {measured:.3g}{unit}{said} | {most:.3g}{unit} | {met} |"


def named(step: dict[str, float], word: str) -> float:
    """Return the smallest value whose name begins with `word`."""
    return min(value for name, value in step.items() if name.startswith(word))


def of_steps(same: Alike) -> list[str]:
    """Return the rows of the four-bar linkage with equal steps."""
    us, rk4 = same.step["eomc, RK4"], "MuJoCo, RK4"
    better = same.error[rk4] / same.error["eomc, RK4"]
    return [
        bar("four-bar, RK4 step with projection", us, 0.35, " us"),
        bar("the same, divided by MuJoCo's RK4 step", us / same.step[rk4], 1 / 60),
        bar("our error, divided by MuJoCo's", 1 / better, 1 / 40),
        bar(
            "the step, divided by four calls of Pinocchio",
            us / named(same.step, "Pinocchio"),
            1 / 15,
        ),
    ]


def of_runs(made: dict[str, Case], rounds: int) -> list[str]:
    """Return the rows of whole runs in C: with the given number of steps, and the fastest run."""
    made_of = (
        ("Andrews' squeezer, 0.03 s", ANDREWS, 300, 1e-7, 0.5),
        ("A02, N = 2, 10 s", A02, 500, 1e-3, 1.0),
        ("Bricard, 10 s", BRICARD, 500, 1e-3, 5.0),
    )
    rows: list[str] = []
    for what, name, steps, wanted, most in made_of:
        case = made[name]
        plain, ways = case.at("rk4", steps), case.ways(wanted)
        times = timed([plain.run, *(way.run for way in ways)], rounds) / 1e3
        best = min(range(len(ways)), key=lambda i: times[1 + i])
        way = ways[best]
        rows.append(
            bar(f"{what}, {plain}", float(times[0]), most, " ms", f", error {plain.error:.1e}")
        )
        rows.append(
            bar(
                f"{what}, fastest with an error of at most {wanted:.0e}: {way}",
                float(times[1 + best]), most, " ms", f", error {way.error:.1e}",
            )
        )  # fmt: skip
    return rows


def of_flops() -> list[str]:
    """Return the rows of operations that the generator counts, without sines."""
    largest = next(reversed(FLOPS))
    begun = time.process_time()
    pipeline.sources(system(largest))
    spent = time.process_time() - begun
    rows = [bar(f"processor time to derive and generate {largest}", spent, 15, " s")]
    for name, most in FLOPS.items():
        made = program.build(lagrange.derive(system(name)))
        flops = made["acceleration"].cost.flops
        rows.append(bar(f"flops of the accelerations, {name}", flops, most))
        if name in SHARES:
            one = made["projection"].cost.flops
            share = one / (4 * flops + one)
            what = f"share of the projection in the flops of an RK4 step, {name}"
            rows.append(bar(what, share, SHARES[name], "", f" ({one} of {4 * flops + one})"))
    return rows


# --- the page ------------------------------------------------------------------------------------

HEAD = """\
# Constraints and closed loops

Written by `python benchmarks/constrained.py`: cases of `tests/data/constrained.json`, whose final positions are known to 27 digits and more. *Error*:
max |q - q_ref| / max(1, max |q_ref|) at the end. Times in us, the smallest of up to {rounds} rounds in which all programs of a group run in turns on one core.

{machine}
"""  # noqa: E501
OWN = """
## At matched errors

Whole runs in C, with positions and velocities projected after each step. Each method makes the fewest steps, within 5 %, or has the loosest tolerance, in
steps of sqrt 10, that reaches the error. The fastest is named, with its time per run and per step. The last columns are the times of a run by each method
(–: no run of less than {worth:g} ms reaches the error); *not reached*: the smallest error. The linkages of A02 are repeatedly in singular positions,
where the error depends on how close to the position a step ends.

| case | required | fastest | error | run | step | rk4 | dp8 | gauss16 | adaptive |
|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501
PEERS = """
## Four-bar linkage, comparison with other programs

`four_bar_crank_rocker`, 10 s. *Ratio*: our run divided by theirs. The time of a run of another program is that of a step, measured over the first {sample}
steps, times their number. *Not reached*: its smallest error, listed once, with up to this many steps: {most}.

| required | program, method | error | run | step | ratio |
|---|---|---|---|---|---|
"""  # noqa: E501
SAME = """
### With steps of {h:g} s

| program, method | error | step |
|---|---|---|
"""
BARS = """
## Required values

| quantity | measured | bar | |
|---|---|---|---|
"""
TAIL = """
- MuJoCo: a tree of three hinges, closed by `connect` of two sites; solref 2 h, solimp 0.9999, as its documentation recommends for stiff constraints;
  Newton's solver to 1e-15, without contacts; `mj_step(nstep=...)`. Its error changes sign near 7,000 steps of RK4, is 3e-6 with 10,000 and below 1e-6
  from some 30,000 on.
- Pinocchio: the same tree, a 3D `RigidConstraintModel`, mu = {mu:g}, at most {iterations} proximal iterations, RK4 in Python with the best of three gains of
  Baumgarte's method. Its time is that of four calls of `constraintDynamics` per step, from Python; the rest of the loop is not counted.
- Exudyn: three free bodies in the plane, four hinges; its explicit methods do not support such constraints. The best of generalized alpha with spectral radii
  of 0.9 and 0.5, and the trapezoidal rule with constraints on velocities; Newton's method to 1e-10, without output.
- Flops: additions, multiplications and divisions of one evaluation, without sines and parameter-only expressions. The projection has its own
  factorisation, at the state that it corrects.
"""  # noqa: E501


def page(rounds: int) -> str:
    packages = ("eomc", "exudyn", "mujoco", "pin", "numpy")
    text = HEAD.format(rounds=rounds, machine=machine(packages)) + OWN.format(worth=WORTH * 1e3)
    made = {name: Case(name) for name in CASES}
    for case in made.values():
        text += "\n".join(lines(case, own(case, rounds))) + "\n"
        print(text.split("\n\n")[-1], flush=True)
    case = made[FOUR_BAR]
    groups = fourbars.peers(fourbars.Rods.of(cases()[FOUR_BAR]))
    most = ", ".join(
        f"{group[0].most:,} ({group[0].name}, {group[0].setting.split(',')[0]})" for group in groups
    )
    text += PEERS.format(sample=SAMPLE, most=most)
    text += "\n".join(against(case, groups, rounds)) + "\n"
    same = alike(case, groups, rounds)
    text += SAME.format(h=H) + f"{same}\n" + BARS
    text += "\n".join([*of_steps(same), *of_runs(made, rounds), *of_flops()]) + "\n"
    return text + TAIL.format(mu=fourbars.MU, iterations=fourbars.ITERATIONS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--only", default="", help="a word in the case; ours alone, no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(CORES)})
    warnings.simplefilter("ignore", RuntimeWarning)  # of steps that are too long
    if options.only:
        for name in CASES:
            if options.only in name:
                case = Case(name)
                print("\n".join(lines(case, own(case, options.rounds))), flush=True)
        return
    text = page(options.rounds)
    (HERE / "CONSTRAINED.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
