"""A Poincaré section of the double pendulum, against heyoka's and SciPy's events.

    python benchmarks/sections.py [--crossings 100000]

`double_pendulum_regular` of tests/data/cases.json, where its second angle grows through zero. Each
takes its loosest tolerance, in steps of sqrt 10, at which the first 20 crossings have their times
to 1e-9, and of heyoka's forms the quickest. Then both run in turns on one pinned core; of each the
least time of three counts. SciPy has a hundredth of the crossings, its time times a hundred.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import heyoka
import numpy as np
from adaptive import LOOSEST, ROOT, TIGHTEST
from machine import CORES, machine
from scipy.integrate import solve_ivp
from searching import Array
from support.cases import scene_text
from taylor import Options, Taylor

import eomc
from eomc.pipeline import read

CASE, WANTED, FIRST = "double_pendulum_regular", 1e-9, 20
BARS = {"heyoka": 0.1, "SciPy": 0.01}
SECTION = {"section": {"when": "q2", "direction": "rising"}}
Crossings = Callable[[float, float], Array]  # of a duration and a tolerance


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--crossings", type=int, default=100_000)
    wanted = options.parse_args().crossings
    os.sched_setaffinity(0, {max(CORES)})
    file = ROOT / "build" / "sections" / f"{CASE}.toml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(scene_text(CASE).replace("[run]", "[run]\ntolerance = 1e-9"))
    module = eomc.load(file, file.parent)
    taylor = Taylor(read(file), 1.0)

    def ours(duration: float, tol: float) -> Array:
        run = module.simulate(duration=duration, tol=tol, events=SECTION)
        return run.events["section"].t

    right = ours(100.0, 1e-15)[:FIRST]
    each = (right[-1] - right[0]) / (FIRST - 1)  # s, from one to the next
    all_of_them = each * (wanted + 0.5)
    forms = [form for form in taylor.options() if not form.compact_mode]
    theirs = min((heyokas(taylor, form) for form in forms), key=lambda run: quick(run, right))
    scipys = scipy_run(module)
    tols = [loosest(run, right) for run in (ours, theirs, scipys)]
    times = np.full((3, 2), np.inf)
    for row in times:
        for k, run in enumerate((ours, theirs)):
            begun = time.perf_counter()
            found = len(run(all_of_them, tols[k]))
            row[k] = time.perf_counter() - begun
            assert abs(found - wanted) <= 1e-3 * wanted + 1, found
    begun = time.perf_counter()
    scipys(all_of_them / 100, tols[2])
    slow = 100 * (time.perf_counter() - begun)
    mine, other = times.min(axis=0)
    print(machine(("eomc", "heyoka", "scipy", "numpy", "sympy")))
    print(f"{wanted} crossings, the first {FIRST} to {WANTED:.0e}: eomc {mine:.3f} s", end="")
    for (who, bar), seconds in zip(BARS.items(), (other, slow), strict=True):
        met = "met" if mine / seconds <= bar else "missed"
        print(f"; {who} {seconds:.2f} s, ratio {mine / seconds:.2g}, bar {bar} {met}", end="")
    print(f"; tolerances {tols[0]:.0e}, {tols[1]:.0e}, {tols[2]:.0e}")


def loosest(run: Crossings, right: Array) -> float:
    """The first tolerance at which the crossings have their times."""
    for k in range(LOOSEST, TIGHTEST + 1):
        found = run(float(right[-1]) + 1e-3, 10 ** (-k / 2))[: len(right)]
        if len(found) == len(right) and np.max(np.abs(found - right)) <= WANTED:
            return float(10 ** (-k / 2))
    raise SystemExit("no tolerance reaches the error")


def quick(run: Crossings, right: Array) -> float:
    """Seconds of a run of some hundred crossings."""
    tol, best = loosest(run, right), np.inf
    for _ in range(3):
        begun = time.perf_counter()
        run(10 * float(right[-1]), tol)
        best = min(best, time.perf_counter() - begun)
    return best


def heyokas(taylor: Taylor, form: Options) -> Crossings:
    """heyoka's events: a callback notes the time and the state, as its documentation has it."""
    made: dict[float, tuple[Any, list[Any]]] = {}

    def run(duration: float, tol: float) -> Array:
        if tol not in made:
            noted: list[Any] = []
            equations = taylor.equations(form.form)

            def note(integrator: Any, t: float, side: int) -> None:
                integrator.update_d_output(t)
                noted.append((t, *integrator.d_output))

            event = heyoka.nt_event(
                equations[1][0], note, direction=heyoka.event_direction.positive
            )
            integrator = heyoka.taylor_adaptive(
                equations, taylor.x0, tol=tol, fast_math=form.fast_math, nt_events=[event]
            )
            made[tol] = integrator, noted
        integrator, noted = made[tol]
        integrator.time = 0.0
        integrator.state[:] = taylor.x0
        noted.clear()
        integrator.propagate_until(duration)
        return np.array(noted)[:, 0]

    return run


def scipy_run(module: Any) -> Crossings:
    """solve_ivp's events, by DOP853 over the compiled accelerations."""
    start = np.concatenate(module.start)
    n = module.nq

    def rates(t: float, x: Array) -> Array:
        return np.concatenate([x[n:], module.acceleration(x[:n], x[n:])])

    def section(t: float, x: Array) -> float:
        return float(x[1])

    section.direction = 1.0  # type: ignore[attr-defined]

    def run(duration: float, tol: float) -> Array:
        found = solve_ivp(
            rates, (0.0, duration), start, "DOP853", events=section, rtol=max(tol, 1e-13), atol=tol
        )
        return found.t_events[0]

    return run


if __name__ == "__main__":
    main()
