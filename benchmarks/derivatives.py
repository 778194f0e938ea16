"""Time of derivatives of accelerations and of steps, in units of the module's own accelerations.

    python benchmarks/derivatives.py                       # every scene
    python benchmarks/derivatives.py chain8 ur10 --states 500 2000 --rounds 9

Scenes: a cart-pole; points, chains of point masses, whose accelerations take link multipliers;
chain, of rods; robots. Prints for each scene and number of states a call:

- acc: time of `acceleration` a state, ns;
- linearize: `linearize`, in accelerations;
- vjp, jvp: `acceleration_vjp` and `acceleration_jvp`, in accelerations, parameters included;
- RK4: `discretize` by RK4, in accelerations and in `linearize`;
- gradient: `run.vjp`, the gradient of a function of the rows of a run of 1,000 steps by RK4 with
  respect to start, inputs and parameters, in runs; then its relative difference from differences
  of runs along one direction (of order 8, in doubles);
- faults: page faults a state of `linearize`; the allocator then returns memory after each call;
- error: the largest difference of A and B from differences of the accelerations (of order 8, in
  doubles, accurate to some 1e-10), relative to the largest entry.

The ratios are those of the shortest of `rounds` calls, which alternate. Robots come from
example-robot-data (pip install '.[robots]').
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from robots import CASES, chain, robot

import eomc
from eomc.base import resources

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support import point_masses as point_mass_scenes


def point_masses(links: int) -> str:
    """Return a chain of massless links between point masses, with the angles to the vertical."""
    text = point_mass_scenes.links([*range(-1, links - 1)])
    return text.replace('name = "links"', f'name = "points{links}"')


SCENES: dict[str, Callable[[], str]] = {
    "cartpole": lambda: resources.scenes()["cartpole"].read_text(encoding="utf-8"),
    **{f"points{n}": partial(point_masses, n) for n in (5, 8, 12)},
    **{f"chain{n}": partial(chain, n) for n in (5, 8, 12)},
    "ur10": partial(robot, "ur_description/urdf/ur10_robot.urdf"),
    "panda": partial(robot, "panda_description/urdf/panda.urdf"),  # 8 coordinates: fingers mimic
    "solo12": CASES["quadruped"].text,
}
STENCIL = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))  # central differences of order 8


def load(name: str, root: Path) -> Any:
    """Return the module of a scene with the derivatives."""
    options, text = '[run]\nlinearize = "products"\ndiscretize = true\n', SCENES[name]()
    has_run = "[run]\n" in text
    text = text.replace("[run]\n", options) if has_run else f"{text}\n{options}"
    path = root / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return eomc.load(path, root)


def count_faults(call: Callable[[], Any]) -> int:
    """Return the page faults of one call."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    call()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def shortest(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Return the shortest time of each call, s; the calls alternate."""
    times = dict.fromkeys(calls, np.inf)
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name] = min(times[name], time.perf_counter() - start)
    return times


def difference_error(m: Any, q: Any, qd: Any, u: Any, width: float = 4e-3) -> float:
    """Return the largest relative difference of A, B from differences of the accelerations."""
    errors, n = [], m.nq
    matrices = m.linearize(q[:5], qd[:5], u=u[:5] if m.nu else None)
    for *state, A, B in zip(q[:5], qd[:5], u[:5], *matrices, strict=True):
        x = np.concatenate(state)

        def qdd(x: Any) -> Any:
            return m.acceleration(x[:n], x[n : 2 * n], u=x[2 * n :] if m.nu else None)

        exact = np.hstack([A[n:], B[n:]])
        near = [
            sum(w * (qdd(x + k * e) - qdd(x - k * e)) for k, w in STENCIL) / width
            for e in width * np.eye(len(x))
        ]
        errors.append(np.abs(exact - np.transpose(near)).max() / np.abs(exact).max())
    return float(max(errors))


def gradient(m: Any, rounds: int) -> str:
    """Return the time of the gradient of a run, in runs, and its relative error."""
    random, steps = np.random.default_rng(2), 1000
    q, qd, dq, dqd, w = random.uniform(-0.5, 0.5, (5, m.nq))
    u, du = random.uniform(-1, 1, (2, steps, m.nu))

    def simulate(x: float = 0.0) -> Any:
        inputs = u + x * du if m.nu else None
        return m.simulate(q + x * dq, qd + x * dqd, h=1e-4, steps=steps, u=inputs)

    run = simulate()
    q_bar, qd_bar = np.tile(w, (2, steps + 1, 1))
    pull_back = partial(run.vjp, q_bar, qd_bar)
    times, bars = shortest({"run": simulate, "vjp": pull_back}, rounds), pull_back()
    exact = bars.q @ dq + bars.qd @ dqd + (np.sum(bars.u * du) if m.nu else 0.0)

    def loss(x: float) -> float:
        states = simulate(x)
        return float(np.sum(w * states.q) + np.sum(w * states.qd))

    width = 1e-3
    near = sum(c * (loss(k * width) - loss(-k * width)) for k, c in STENCIL) / width
    return f"{times['vjp'] / times['run']:.1f}, {abs(exact / near - 1):.0e}"


def rows(name: str, m: Any, states: list[int], rounds: int) -> None:
    """Print the rows of a scene."""
    random = np.random.default_rng(1)
    for count in states:
        q, qd = random.uniform(-1, 1, (2, count, m.nq))
        u = random.uniform(-1, 1, (count, m.nu))
        inputs = {"u": u} if m.nu else {}
        calls: dict[str, Callable[[], Any]] = {
            "acc": partial(m.acceleration, q, qd, **inputs),
            "linearize": partial(m.linearize, q, qd, **inputs),
            "vjp": partial(m.acceleration_vjp, q, qd, q, **inputs),
            "jvp": partial(m.acceleration_jvp, q, qd, (q, qd, u), **inputs),
            "discretize": partial(m.discretize, q, qd, 1e-3, **inputs),
        }
        times = shortest(calls, rounds)
        one, linear = times["acc"], times["linearize"]
        ratios = {key: f"{t / one:.1f}" for key, t in times.items()}
        faults = count_faults(calls["linearize"]) / count
        print(
            f"| {name} | {count} | {one / count * 1e9:.0f} ns | {ratios['linearize']} "
            f"| {ratios['vjp']} | {ratios['jvp']} "
            f"| {ratios['discretize']} = "
            f"{times['discretize'] / linear:.1f} linearize | {gradient(m, rounds)} "
            f"| {faults:.2f} | {difference_error(m, q, qd, u):.0e} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(SCENES)}; all by default")
    parser.add_argument("--states", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    print("| scene | states | acc | linearize | vjp | jvp | RK4 | gradient | faults | error |")
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in options.names or SCENES:
        with tempfile.TemporaryDirectory() as folder:
            rows(name, load(name, Path(folder)), options.states, options.rounds)


if __name__ == "__main__":
    main()
