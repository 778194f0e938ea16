"""Measure the cost of 6, 9 and 12 digits with eomc, heyoka and SciPy; write DIGITS.md.

    python benchmarks/digits.py [--rounds 15] [--only WORD]

The error of a run is the largest, over all its steps and the components of [q; qd], relative to the
component's largest value, compared with a reference solution. Each program uses the longest step or
loosest tolerance that reaches the required error, in its fastest form. Then all run in turns on one
pinned core, and the ratio of our time to theirs is computed within each round.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import heyoka
import numba
import numpy as np
import peers
import physics
from peers import CORES, HERE, Case
from physics import Function, Matrices, Numbers
from runners import Array
from scipy.integrate import ode, odeint, solve_ivp
from searching import fewest, quick

import eomc
from eomc.integrators import tableaux
from eomc.report import reference_solution

END = 10.0  # s; 12 digits exist in doubles until then
WANTED = (1e-6, 1e-9, 1e-12)
NAMES = ("cart-pole", "double pendulum", "chain of 5")
METHODS = [m for m in tableaux.METHODS.values() if m.order >= 4]
BARS = {"heyoka": 0.8, "DOP853": 0.2, "LSODA": 0.2}
MANY, SAMPLE = 4096, 32  # instances of a batch, and of how many the error is taken

Rows = tuple[Array, Array]  # times (n,), states (n, 2 nq)
Error = Callable[[Rows], float]


@dataclass(frozen=True)
class Way:
    """Who runs, with which setting, `run` without arguments, and the error of that."""

    name: str
    setting: str
    run: Callable[[], object]
    error: float


# --- the trusted motion --------------------------------------------------------------------------


def differences(q: Numbers, v: Numbers, sin: Function, cos: Function) -> tuple[Any, Any]:
    """`physics.chain` with sines of differences: fewer products for a Taylor recursion."""
    n = len(q)
    D = [[float(n - i)] * (i + 1) for i in range(n)]
    tau = [sin(q[i]) * (-9.81 * (n - i)) for i in range(n)]
    for i in range(n):
        for j in range(i):
            across = sin(q[i] - q[j]) * D[i][j]
            tau[i] = tau[i] - across * (v[j] * v[j])
            tau[j] = tau[j] + across * (v[i] * v[i])
            D[i][j] = cos(q[i] - q[j]) * D[i][j]
    return D, tau


def equations(matrices: Matrices, n: int) -> list[Any]:
    """The same as a system of heyoka's, in its best form."""
    if matrices is physics.chain:
        matrices = differences
    x = heyoka.make_vars(*[f"x{i}" for i in range(2 * n)])
    rates = [*x[n:], *physics.acceleration(matrices, list(x), heyoka.sin, heyoka.cos)]
    return list(zip(x, rates, strict=True))


def trusted(case: Case) -> tuple[Error, float]:
    """The error of a run, and how far the trusted motion is from the generator's own.

    heyoka in long double at its tightest, whose dense output has the state at any time; compared
    at 17 times with `eomc.report.reference_solution`: another program, arithmetic and method.
    """
    n = len(case.x0) // 2
    tight = heyoka.taylor_adaptive(
        equations(case.matrices, n), case.x0.astype(np.longdouble), fp_type=np.longdouble,
        tol=np.longdouble(1e-19), compact_mode=True,
    )  # fmt: skip
    motion = tight.propagate_until(np.longdouble(END), c_output=True)[4]
    with tempfile.TemporaryDirectory() as root:
        system = eomc.read(peers.write(case, Path(root)))
        given = zip(system.coordinates, case.x0[:n], case.x0[n:], strict=True)
        starts = tuple(replace(c, start=float(q), rate=float(v)) for c, q, v in given)
        own = reference_solution.solve(replace(system, coordinates=starts), END, 16, root)
    high, low = own.halves
    scale = np.abs(motion(np.linspace(0, END, 1000, dtype=np.longdouble))).max(axis=0)

    def error(rows: Rows) -> float:
        t, x = rows
        with np.errstate(invalid="ignore"):
            worst = np.max(np.abs(x - motion(t.astype(np.longdouble))) / scale)
        return float(worst) if t[-1] == END and worst < 1 else math.inf

    apart = (motion(own.t.astype(np.longdouble)) - high) - low
    return error, float(np.max(np.abs(apart) / scale))


# --- who runs ------------------------------------------------------------------------------------


def quickest(ways: list[Way]) -> Way:
    """By turns, since the machine may be slow for a while."""
    turns = [[quick(way.run) for way in ways] for _ in range(1 if len(ways) == 1 else 3)]
    return ways[int(np.argmin(np.min(turns, axis=0)))]


def ours(module: ModuleType, case: Case, error: Error, wanted: float) -> Way:
    """The quickest of our methods, each at its longest step; what iterates at shorter ones too.

    A longer step may want more sweeps than it saves.
    """
    n, found = len(case.x0) // 2, list[Way]()
    bound = math.inf  # beyond which a method has lost
    for method in module.methods:
        simulate = partial(module.simulate, case.x0[:n], case.x0[n:], method=method)

        def off(steps: int, simulate: Callable[..., Any] = simulate) -> float:
            run = simulate(h=END / steps, steps=steps, every=1 + steps // 2000)
            t = np.append(run.t[:-1], END)  # it is n h, which may round elsewhere
            return error((t, run.x)) if run.status == "ok" else math.inf

        def way(steps: int, simulate: Callable[..., Any] = simulate) -> Callable[[], object]:
            return partial(simulate, h=END / steps, steps=steps, every=steps)

        worth = partial(lambda limit, way, steps: quick(way(steps)) < limit, bound, way)
        if least := fewest(off, wanted, worth):
            for more in (1.0, 1.12, 1.25, 1.5) if tableaux.METHODS[method].implicit else (1.0,):
                steps = round(more * least)
                if (reached := off(steps)) <= wanted:
                    found.append(Way("ours", f"{method}, {steps} steps", way(steps), reached))
            bound = min(bound, 2 * quick(found[-1].run))
    return quickest(found)


# tolerance -> what is timed, and the same with rows
Solver = Callable[[float], tuple[Callable[[], object], Callable[[], Rows]]]


def loosest(error: Callable[[float], float], wanted: float) -> tuple[float, float]:
    """The loosest tolerance 10^(-k/4) that reaches the error, and its error; else the best one."""
    low = round(-4 * math.log10(wanted)) - 12  # below k = low nobody was found to reach it
    high, known = 55, dict[int, float]()  # 1.8e-14, below which SciPy does not go
    while high - low > 1:
        middle = min((low + high) // 2, low + 6)
        known[middle] = error(10.0 ** (-middle / 4))
        low, high = (low, middle) if known[middle] <= wanted else (middle, high)
    best = high if high in known else min(known, key=lambda k: known[k])
    return 10.0 ** (-best / 4), known[best]


def adaptive(name: str, solver: Solver, error: Error, wanted: float) -> Way:
    """A solver at its loosest tolerance."""
    tolerance, off = loosest(lambda tol: error(solver(tol)[1]()), wanted)
    return Way(name, f"tol {tolerance:.1e}", solver(tolerance)[0], off)


def taylor(case: Case, fast: bool) -> Solver:
    """heyoka's adaptive Taylor integrator, parameters folded, not compact."""
    n = len(case.x0) // 2

    @cache
    def solver(tolerance: float) -> tuple[Callable[[], object], Callable[[], Rows]]:
        integrator = heyoka.taylor_adaptive(
            equations(case.matrices, n), case.x0, tol=tolerance, fast_math=fast
        )

        def run(callback: Any = None) -> None:
            integrator.time = 0.0
            integrator.state[:] = case.x0
            integrator.propagate_until(END, callback=callback)

        def rows() -> Rows:
            kept: list[tuple[float, Array]] = []

            def keep(now: Any) -> bool:
                kept.append((now.time, now.state.copy()))
                return True

            run(keep)
            return np.array([t for t, _ in kept]), np.array([x for _, x in kept])

        return run, rows

    return solver


def plain(matrices: Matrices, n: int) -> Callable[[float, Array], Array]:
    """The right-hand side as users write it."""

    def rate(_: float, x: Array) -> Array:
        lower, tau = matrices(x[:n], x[n:], math.sin, math.cos)
        D = np.array([[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)])
        return np.concatenate([x[n:], np.linalg.solve(D, np.array(tau))])

    return rate


def compiled(matrices: Matrices, n: int) -> Callable[[float, Array], Array]:
    """The same in straight-line scalars, by numba."""
    lines, results = physics.text(matrices, n)
    body = [*(f"x{i} = y[{i}]" for i in range(2 * n)), *lines, f"out = empty({2 * n})"]
    rates = [*(f"x{n + i}" for i in range(n)), *results]
    body += [f"out[{i}] = {name}" for i, name in enumerate(rates)]
    names: dict[str, Any] = {"sin": math.sin, "cos": math.cos, "empty": np.empty}
    exec("\n ".join(["def rate(t, y):", *body, "return out"]), names)  # text of our own making
    rate = numba.njit(fastmath={"contract"})(names["rate"])
    rate(0.0, np.ones(2 * n))
    return rate


def in_python(rate: Callable[[float, Array], Array], x0: Array, method: str) -> Solver:
    """solve_ivp."""

    def solver(tol: float) -> tuple[Callable[[], object], Callable[[], Rows]]:
        def run() -> Any:
            return solve_ivp(rate, (0.0, END), x0, method, rtol=tol, atol=tol)

        def rows() -> Rows:
            done = run()
            return done.t, done.y.T

        return run, rows

    return solver


def dop853(rate: Callable[[float, Array], Array], x0: Array) -> Solver:
    """The compiled loop of scipy.integrate.ode."""

    def solver(tol: float) -> tuple[Callable[[], object], Callable[[], Rows]]:
        def begun() -> ode:
            return ode(rate).set_integrator("dop853", rtol=tol, atol=tol, nsteps=10**7)

        def run() -> Array:
            return begun().set_initial_value(x0, 0.0).integrate(END)

        def rows() -> Rows:
            kept: list[tuple[float, Array]] = []
            integrator = begun()
            integrator.set_solout(lambda t, x: kept.append((t, np.array(x))))
            integrator.set_initial_value(x0, 0.0).integrate(END)
            return np.array([t for t, _ in kept]), np.array([x for _, x in kept])

        return run, rows

    return solver


def lsoda(rate: Callable[[float, Array], Array], x0: Array) -> Solver:
    """The compiled loop of scipy.integrate.odeint; rows by its own interpolation."""

    def solver(tol: float) -> tuple[Callable[[], object], Callable[[], Rows]]:
        def at(t: Array) -> Array:
            return odeint(rate, x0, t, tfirst=True, rtol=tol, atol=tol, mxstep=10**7)

        grid = np.linspace(0, END, 257)
        return lambda: at(grid[[0, -1]]), lambda: (grid, at(grid))

    return solver


# --- one trajectory ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A line of the table: who against whom, times in us, and the ratio's quartiles."""

    work: str
    wanted: float
    mine: Way
    theirs: Way
    times: tuple[float, float]
    ratio: Array

    @property
    def bar(self) -> float:
        return next(bar for name, bar in BARS.items() if name in self.theirs.name)

    @property
    def met(self) -> bool:
        return bool(self.ratio[1] <= self.bar)

    def __str__(self) -> str:
        low, middle, high = self.ratio
        reached = "" if self.theirs.error <= self.wanted else ", not reached"
        return (
            f"| {self.work} | {-math.log10(self.wanted):.0f} | {self.mine.setting} "
            f"| {self.mine.error:.1e} | {self.times[0]:.4g} | {self.theirs.name} "
            f"| {self.theirs.setting}{reached} | {self.theirs.error:.1e} | {self.times[1]:.4g} "
            f"| {middle:.3g} | {low:.3g} – {high:.3g} "
            f"| {self.bar:g} {'met' if self.met else '**missed**'} |"
        )


def compare(
    work: str, wanted: float, mine: Way, theirs: list[Way], rounds: int, instances: int = 1
) -> list[Line]:
    """All in turns, each for some milliseconds; who is slow only in the first rounds."""
    ways = [mine, *theirs]
    first = [quick(way.run) for way in ways]
    counts = [max(1, round(3e-3 / spent)) for spent in first]
    times = np.full((rounds, len(ways)), np.nan)
    for k in range(rounds):
        for i, way in enumerate(ways):
            if k < 3 or first[i] * rounds < 10:
                begun = time.perf_counter()
                for _ in range(counts[i]):
                    way.run()
                times[k, i] = (time.perf_counter() - begun) / counts[i] / instances * 1e6
    middle = np.nanmedian(times, axis=0)
    lines = []
    for i, way in enumerate(theirs, 1):
        ratio = np.nanpercentile(times[:, 0] / times[:, i], [25, 50, 75])
        lines.append(Line(work, wanted, mine, way, (middle[0], middle[i]), ratio))
        print(lines[-1], flush=True)
    return lines


def single(name: str, root: Path, rounds: int) -> Iterator[Line]:
    case, n = peers.CASES[name], len(peers.CASES[name].x0) // 2
    error, apart = trusted(case)
    print(f"{name}: trusted to {apart:.1e}", flush=True)
    assert apart < 0.01 * min(WANTED), f"{name}: no trusted motion, {apart}"
    module = peers.load(case, root, f"method = {[m.name for m in METHODS]}\n")
    by_hand, slow = compiled(case.matrices, n), plain(case.matrices, n)
    forms = [taylor(case, fast) for fast in (False, True)]
    solvers = {
        "DOP853, numba": dop853(by_hand, case.x0),
        "LSODA, numba": lsoda(by_hand, case.x0),
        "DOP853, plain": in_python(slow, case.x0, "DOP853"),
        "LSODA, plain": in_python(slow, case.x0, "LSODA"),
    }
    for wanted in WANTED:
        mine = ours(module, case, error, wanted)
        theirs = [quickest([adaptive("heyoka", form, error, wanted) for form in forms])]
        theirs += [adaptive(who, solver, error, wanted) for who, solver in solvers.items()]
        yield from compare(name, wanted, mine, theirs, rounds)


# --- a batch -------------------------------------------------------------------------------------


def batch(name: str, root: Path, rounds: int) -> Iterator[Line]:
    """4,096 starts about the case's, by 0.1 in every component, to 9 digits at the end."""
    case, wanted = peers.CASES[name], 1e-9
    n = len(case.x0) // 2
    spread = 0.1 * np.random.default_rng(1).standard_normal((MANY, 2 * n))
    x = case.x0 + spread
    tight = heyoka.taylor_adaptive(equations(case.matrices, n), case.x0, tol=1e-17)
    right = np.empty((SAMPLE, 2 * n))
    for k in range(SAMPLE):
        tight.time, tight.state[:] = 0.0, x[k]
        tight.propagate_until(END)
        right[k] = tight.state
    scale = np.abs(right).max(axis=0)

    def error(last: Array) -> float:
        return float(np.nan_to_num(np.abs(last - right) / scale, nan=np.inf).max())

    explicit = [m.name for m in METHODS if not m.implicit]
    module = peers.load(case, root, f"batch = true\nmethod = {explicit}\n")
    found: list[Way] = []
    for method in module.methods:

        def simulate(steps: int, many: int = MANY, method: str = method) -> Array:
            done = module.simulate_batch(
                x[:many, :n], x[:many, n:], END / steps, steps=steps, every=steps, threads=1,
                method=method,
            )  # fmt: skip
            return np.hstack([done.q[:, -1], done.qd[:, -1]])

        def off(steps: int, simulate: Callable[..., Array] = simulate) -> float:
            return error(simulate(steps, SAMPLE))

        steps = fewest(off, wanted, lambda _: True)
        found.append(Way("ours", f"{method}, {steps} steps", partial(simulate, steps), off(steps)))
    width = heyoka.recommended_simd_size()
    columns = np.ascontiguousarray(x.reshape(-1, width, 2 * n).transpose(0, 2, 1))

    def taylor_batch(tolerance: float, fast: bool) -> Callable[[int], Array]:
        integrator = heyoka.taylor_adaptive_batch(
            equations(case.matrices, n), columns[0], tol=tolerance, fast_math=fast
        )

        def run(many: int = MANY) -> Array:
            last = np.empty((many // width, 2 * n, width))
            for k in range(many // width):
                integrator.set_time(0.0)
                integrator.state[:] = columns[k]
                integrator.propagate_until(END)
                last[k] = integrator.state
            return last.transpose(0, 2, 1).reshape(many, 2 * n)

        return run

    theirs = []
    for fast in (False, True):
        form = cache(partial(taylor_batch, fast=fast))
        tolerance, off = loosest(lambda tol, form=form: error(form(tol)(SAMPLE)), wanted)
        setting = f"tol {tolerance:.1e}"
        theirs.append(Way(f"heyoka, batches of {width}", setting, form(tolerance), off))
    yield from compare(
        f"{MANY:,} times {name}", wanted, quickest(found), [quickest(theirs)], rounds, MANY
    )


# --- the page ------------------------------------------------------------------------------------

HEAD = """\
# Cost of correct digits

Written by `python benchmarks/digits.py`. Times of whole runs over {end:g} s, called from Python, in us (of a batch, us per instance), medians of {rounds} rounds
in which all programs run in turns on one core.

- *Ratio*: ours/theirs, with median and quartiles of the ratios within the rounds. Below 1, eomc is faster.
- *Bar*: the required ratio.
- *Error*: the largest over all steps and components of [q; qd], relative to the largest value of the component; of a batch, at the end, in its first
  {sample} instances.

{machine}

| task | digits | ours | error | us | compared with | setting | error | us | ratio | quartiles | bar |
|---|---|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501
TAIL = """
- The reference solution is heyoka's in long double at a tolerance of 1e-19, with its dense output. At 17 times it agrees to 1e-14 or better with
  `eomc.report.reference_solution`, a Gauss–Legendre method of order 40 in `__float128`.
- Ours: the fastest of {methods}, each with the longest step that reaches the error, to 2 %; `simulate` and `simulate_batch` with all checks.
- heyoka: the adaptive Taylor integrator with parameters as constants, not in compact mode, the faster one of with and
  without `fast_math`; compilation is not counted. A batch uses groups of its recommended SIMD width.
- SciPy, numba: the compiled right-hand side of `benchmarks/physics.py` in the compiled loops of `ode` ("dop853") and `odeint` (LSODA), its most efficient
  form. Plain: NumPy and `solve_ivp`, the usual form.
- Tolerances are tried in steps of 10^(1/4), absolute and relative alike. The loosest that reaches the error counts, or the one with the smallest error if
  none does.
"""  # noqa: E501


def findings(lines: list[Line]) -> str:
    missed = [
        f"{line.work} to {-math.log10(line.wanted):.0f} digits, compared with {line.theirs.name} "
        f"({line.ratio[1]:.2g}, bar {line.bar:g})"
        for line in lines
        if not line.met
    ]
    return f"\nBars missed: {'; '.join(missed) or 'none'}.\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--only", default="", help="a word in what is run; writes no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(CORES)})
    warnings.simplefilter("ignore", (RuntimeWarning, UserWarning))  # of steps that are too long
    lines: list[Line] = []
    with tempfile.TemporaryDirectory() as root:
        for run in (single, batch):
            for name in NAMES:
                if options.only in f"{run.__name__} {name}":
                    lines += run(name, Path(root), options.rounds)
    print(findings(lines))
    if not options.only:
        text = HEAD.format(end=END, rounds=options.rounds, sample=SAMPLE, machine=peers.machine())
        text += "\n".join(map(str, lines)) + "\n" + findings(lines)
        text += TAIL.format(methods=", ".join(m.name for m in METHODS))
        (HERE / "DIGITS.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
