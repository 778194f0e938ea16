"""What each trick of the fast form is worth: the same scene with it and without, in turns.

    python benchmarks/tricks.py [--rounds 15]

A trick is taken away by changing the generator in this process, so both modules come from the same
tree. Ratios are without/with, medians of the ratios within the rounds, in processor time of the
thread; below 1.1 a trick is worth nothing in that row. Both ends agree to 1e-9 of their size.
`gauss16` is taken away as a user would: the quickest of the other methods takes its place, each at
its longest step that ends within 1e-9, or 1e-12, of `gauss16` in steps of an eighth. Sines side by
side are of functions of the Panda's bodies (bodies.py), a thousand calls at fifty states.
"""

from __future__ import annotations

import argparse
import importlib
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import PropertyMock, patch

import bodies
import numpy as np
import physics
import work

import eomc
from eomc.derive import link_multipliers
from eomc.emit.common import adaptive, c_expression
from eomc.emit.optimised import files, lanes
from eomc.emit.optimised.files import Steppers
from eomc.emit.optimised.lanes import Accelerations

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SPAN = 5.0  # s, of the runs for an error
METHODS = ("rk4", "dp8", "gauss4", "gauss6", "gauss8", "gauss16")
SIDE_BY_SIDE = "adaptive steps of 4,096 side by side"
Change = Callable[[], Any]


def without_prediction() -> Any:
    return patch.object(Steppers, "predicts_angles", new_callable=PropertyMock, return_value=False)


def without_two_points() -> Any:
    return patch.object(Accelerations, "parts", new_callable=PropertyMock, return_value=None)


def without_registers() -> Any:
    return patch.object(lanes, "MIN_SIMD_ANGLES", 1000)


def without_multipliers() -> Any:
    unsuited = link_multipliers.UnsuitedError("left out")
    return patch.object(link_multipliers, "solution", side_effect=unsuited)


def without_side_by_side() -> Any:
    return patch.object(c_expression, "MIN_SIMD_ANGLES", 1000)


def without_lanes() -> Any:
    return patch.object(adaptive, "MAX_BATCH_OPERATIONS", 0)


def with_lanes() -> Any:
    """Of scenes of any size."""
    return patch.object(adaptive, "MAX_BATCH_OPERATIONS", 10**6)


def without_exponentials() -> Any:
    return patch.object(files, "LANE_FUNCTIONS", frozenset())


@contextmanager
def without_short_calls(package: str = "eomc.runtime") -> Iterator[None]:
    """Check all arguments in each call, and make runs by the general loop.

    package: the runtime, of which each built module has a copy.
    """
    modules = [
        importlib.import_module(f"{package}.{name}") for name in ("integrator", "integration")
    ]
    with ExitStack() as stack:
        for module in modules:
            stack.enter_context(patch.object(module, "run_at_once", return_value=None))
        plain = modules[0].PlainSteps
        stack.enter_context(patch.object(plain, "find", return_value=None))
        yield


def with_friction(case: work.Case, names: Sequence[str]) -> work.Case:
    """In each of the coordinates, smoothed."""
    forces = "".join(f'{x} = "-0.1*tanh({x}_dot/0.05)"\n' for x in names)
    return replace(case, scene=case.scene.replace("[run]", f"[forces]\n{forces}\n[run]"))


TODA = """
eomc = 1
name = "toda"
[coordinates]
q1 = {}
q2 = {}
q3 = {}
[energy]
kinetic = "(q1_dot**2 + q2_dot**2 + q3_dot**2)/2"
potential = "exp(q1 - q2) + exp(q2 - q3) + exp(q3 - q1)"
[run]
h = 0.02
"""
CASES = work.CASES | {
    "Toda lattice": work.Case(
        TODA, physics.chain, np.array([0.5, -0.2, 0.1, 0.3, 1.1, -1.4]), 0.02, 5000
    ),
    "cart-pole with friction": with_friction(work.CASES["cart-pole"], ("x", "theta")),
    "chain of 5 with friction": with_friction(
        work.CASES["chain of 5"], [f"a{k}" for k in range(1, 6)]
    ),
}
FOUR_BAR = """
eomc = 1
name = "energies"
[coordinates]
q1 = { start = 0.5, rate = 6.0 }
q2 = { start = 0.7, guess = true }
q3 = { start = 1.6, guess = true }
[energy]
kinetic = "0.016*q1_dot**2 + 0.75*(0.16*q1_dot**2 + q2_dot**2/3 + K) + 0.352/3*q3_dot**2"
potential = "9.81*(0.72*sin(q1) + 0.75*sin(q2) + 0.44*sin(q3))"
[definitions]
K = "0.4*cos(q1 - q2)*q1_dot*q2_dot"
[constraints]
along = "0.4*cos(q1) + cos(q2) - 0.8*cos(q3) - 0.9"
across = "0.4*sin(q1) + sin(q2) - 0.8*sin(q3)"
[run]
"""
LINKAGES = {"four-bar by its energies": FOUR_BAR} | {
    name: (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    for name in ("four_bar", "delta_robot", "bricard", "andrews_squeezer")
}
CASES |= {
    name: work.Case(text, physics.chain, np.array([]), 1e-4, 2000)
    for name, text in LINKAGES.items()
}
EXPONENTIALS = ("Toda lattice", "cart-pole with friction", "chain of 5 with friction")

# trick, what takes it away, the cases that it could change, what else is asked for under [run]
TRICKS: tuple[tuple[str, Change, tuple[str, ...], str], ...] = (
    ("predicted angles", without_prediction, ("cart-pole", "double pendulum"), ""),
    ("two points", without_two_points, ("chain of 5", "chain of 10", "chain of 20",
     "bricard", "andrews_squeezer"), ""),
    ("angles in a register", without_registers, tuple(LINKAGES)[:3], ""),
    ("link multipliers", without_multipliers, ("chain of 5", "chain of 10", "chain of 20"), ""),
    ("link multipliers, 4,096 at once", without_multipliers, ("chain of 5", "chain of 10"),
     "batch = true\n"),
    (SIDE_BY_SIDE, without_lanes, ("cart-pole", "double pendulum", "chain of 5"),
     "batch = true\ntolerance = 1e-9\n"),
    ("exp and tanh", without_exponentials, EXPONENTIALS, "tolerance = 1e-9\n"),
    ("exp and tanh, 4,096 at once", without_exponentials, EXPONENTIALS, "batch = true\n"),
    ("exp and tanh, adaptive steps of 4,096", without_exponentials, EXPONENTIALS,
     "batch = true\ntolerance = 1e-9\n"),
)  # fmt: skip


@contextmanager
def built(case: work.Case, change: Any, extra: str, name: str) -> Iterator[ModuleType]:
    """A module of the case under another name, with the generator changed while it is made."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        lines = case.scene.splitlines()
        at = next(k for k, line in enumerate(lines) if line.startswith("name"))
        lines[at] = f'name = "{name}"'
        path.write_text("\n".join(lines) + "\n" + extra, encoding="utf-8")
        with change:
            yield eomc.load(path, folder)


def seconds(job: Callable[[], Any]) -> float:
    begun = time.thread_time()
    job()
    return time.thread_time() - begun


def ratio(one: Callable[[], Any], other: Callable[[], Any], rounds: int) -> float:
    """The time of `one` over that of `other`."""
    pairs = []
    for k in range(rounds):
        jobs = (one, other) if k % 2 else (other, one)
        times = [seconds(job) for job in jobs]
        pairs.append(times if k % 2 else times[::-1])
    return float(np.median([a / b for a, b in pairs]))


def run(module: ModuleType, case: work.Case, extra: str) -> Callable[[], Any]:
    """A run of the case, or short ones of 4,096 instances."""
    n = len(case.x0) // 2
    if "batch" in extra:
        q, qd = np.tile(case.x0[:n], (4096, 1)), np.tile(case.x0[n:], (4096, 1))
        q += np.linspace(0, 1e-3, 4096)[:, None]
    if "batch" in extra and "tolerance" in extra:
        return lambda: module.simulate_batch(q, qd, duration=1.0, threads=1)
    if "tolerance" in extra:
        return lambda: module.simulate(case.x0[:n], case.x0[n:], duration=4000 * case.h, tol=1e-9)
    if extra:
        return lambda: module.simulate_batch(q, qd, case.h, steps=20, every=20, threads=1)
    steps = min(case.steps, 4000)
    start = (case.x0[:n], case.x0[n:]) if n else module.start
    return lambda: module.simulate(*start, case.h, steps=steps, every=steps)


def tricks(rounds: int) -> Iterator[str]:
    for k, (trick, change, names, extra) in enumerate(TRICKS):
        whole = with_lanes if trick == SIDE_BY_SIDE else nullcontext
        for name in names:
            case = CASES[name]
            with (
                built(case, whole(), extra, f"with_{k}") as full,
                built(case, change(), extra, f"without_{k}") as less,
            ):
                jobs = [run(module, case, extra) for module in (less, full)]
                ends = [np.asarray(job().q)[..., -1, :] for job in jobs]
                apart = float(np.max(np.abs(ends[0] - ends[1])))
                if not apart < 1e-9 * max(1.0, float(np.max(np.abs(ends[0])))):
                    raise SystemExit(f"{trick}, {name}: ends {apart:.1e} apart")
                yield f"| {trick} | {name} | {ratio(*jobs, rounds):.2f} |"


def sines(rounds: int) -> Iterator[str]:
    """Of functions of bodies: a thousand calls at fifty states."""
    text, random = bodies.scene(bodies.LINKS), np.random.default_rng(0)
    motion = tuple(random.uniform(-2, 2, (3, bodies.STATES, 7)))
    with tempfile.TemporaryDirectory() as folder:
        full = bodies.module(text, Path(folder), "full")
        with without_side_by_side():
            renamed = re.sub('^name += "panda"', 'name = "less"', text, count=1, flags=re.M)
            less = bodies.module(renamed, Path(folder), "less")
        if less is full:
            raise SystemExit("sines side by side: one module in place of two")
        for name, shape in (("frame_poses", (7, 12)), ("inverse_dynamics", (7,))):
            calls = [bodies.in_c(m, name, shape, motion) for m in (less, full)]
            jobs = [lambda call=call: [call() for _ in range(1000)] for call, _ in calls]
            factor = ratio(*jobs, rounds)
            (_, one), (_, other) = calls
            if not np.max(np.abs(one - other)) < 1e-9 * np.max(np.abs(one)):
                raise SystemExit(f"sines side by side, {name}: results apart")
            yield f"| sines side by side | {name} of the Panda | {factor:.2f} |"


def end(m: ModuleType, case: work.Case, method: str, steps: int) -> np.ndarray:
    """The state after SPAN seconds."""
    n = len(case.x0) // 2
    made = m.simulate(
        case.x0[:n], case.x0[n:], SPAN / steps, steps=steps, every=steps, method=method
    )
    return np.asarray(made.x[-1])


def longest(m: ModuleType, case: work.Case, sure: np.ndarray, limit: float) -> dict[str, int]:
    """For each method the fewest steps that end within the limit."""
    found = {}
    for method in METHODS:
        for steps in np.unique(np.geomspace(16, 200_000, 120).astype(int)):
            off = np.max(np.abs(end(m, case, method, int(steps)) - sure)) / np.max(np.abs(sure))
            if off < limit:
                found[method] = int(steps)
                break
    return found


def gauss16(rounds: int) -> Iterator[str]:
    extra = "method = [" + ", ".join(f'"{m}"' for m in METHODS) + "]\n"
    for name in ("cart-pole", "double pendulum", "chain of 5"):
        case = work.CASES[name]
        with built(case, nullcontext(), extra, "methods") as m:
            sure = end(m, case, "gauss16", 4096)
            for limit in (1e-9, 1e-12):
                steps = longest(m, case, sure, limit)
                ways = {w: partial(end, m, case, w, n) for w, n in steps.items()}
                others = [w for w in ways if w != "gauss16"]
                best = min(others, key=lambda w, ways=ways: seconds(ways[w]))  # type: ignore[misc]
                found = ratio(ways[best], ways["gauss16"], rounds)
                yield f"| gauss16 | {name}, error {limit:.0e}, else {best} | {found:.2f} |"


def calls(rounds: int) -> Iterator[str]:
    """A thousand short runs, with the short calls of C and without."""
    case, extra = work.CASES["cart-pole"], "tolerance = 1e-9\n"
    ways: dict[str, dict[str, float]] = {
        "simulate(steps=10)": {"steps": 10, "h": 0.005}, "simulate() of 0.5 s": {"duration": 0.5}
    }  # fmt: skip
    with (
        built(case, nullcontext(), extra, "with_calls") as full,
        built(case, nullcontext(), extra, "without_calls") as less,
        without_short_calls(f"{less.__name__}._runtime"),
    ):
        for name, how in ways.items():
            one, other = (m.simulate(**how).q for m in (less, full))
            if not np.array_equal(one, other):
                raise SystemExit(f"short calls, {name}: runs differ")
            jobs = [lambda m=m, how=how: [m.simulate(**how) for _ in range(1000)]
                    for m in (less, full)]  # fmt: skip
            yield f"| short calls | {name}, cart-pole | {ratio(*jobs, rounds):.2f} |"


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--rounds", type=int, default=15)
    rounds = asked.parse_args().rounds
    warnings.simplefilter("ignore", RuntimeWarning)  # steps too long end runs early
    print("| trick | row | time without, over with |\n|---|---|---|")
    for rows in (tricks(rounds), sines(rounds), gauss16(rounds), calls(rounds)):
        for row in rows:
            print(row, flush=True)


if __name__ == "__main__":
    main()
