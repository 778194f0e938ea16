"""Compare adaptive steps of batches with heyoka's batch integrator; write ADAPTIVE_BATCHES.md.

    python benchmarks/adaptive_batches.py [--rounds 15]

4,096 initial states each, one thread, with errors of at most 1e-9 at the end: each program uses its
loosest tolerance, in steps of sqrt 10, that reaches this for all instances. Then all run in turns
on one pinned core; the smallest time of each counts, called from Python.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import heyoka
import numpy as np
from adaptive import LOOSEST, ROOT, TIGHTEST
from machine import CORES, machine
from searching import Array, timed
from support.cases import scene_text
from taylor import FORMS, Taylor

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

MANY, WANTED, BAR = 4096, 1e-9, 0.35
RIGHT = 1e-16  # tolerance of the reference, where no closed form is known


def orbits() -> tuple[Array, Array]:
    """Nearest points of orbits of eccentricities from 0 to 0.95, period 2 pi."""
    e, zero = np.linspace(0, 0.95, MANY), np.zeros(MANY)
    return np.column_stack([1 - e, zero]), np.column_stack([zero, np.sqrt((1 + e) / (1 - e))])


def pendulums() -> tuple[Array, Array]:
    """Double pendulums up to half a radian from rest, released at rest."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (MANY, 2)), np.zeros((MANY, 2))


CASES: dict[str, tuple[str, Callable[[], tuple[Array, Array]], float]] = {
    "Kepler orbits, e from 0 to 0.95": ("kepler_e0.9_cartesian", orbits, 2 * math.pi),
    "double pendulums": ("double_pendulum_regular", pendulums, 10.0),
}


@dataclass(frozen=True)
class Way:
    """Who runs, how, and the error."""

    who: str
    tol: float
    run: Callable[[], Array]
    error: float


def loosest(who: str, made: Callable[[float], Callable[[], Array]], right: Array) -> Way | None:
    """The first tolerance that reaches the error; None: none does."""
    for k in range(LOOSEST, TIGHTEST + 1):
        run = made(10 ** (-k / 2))
        error = float(np.max(np.abs(run() - right) / np.maximum(1.0, np.abs(right))))
        if error <= WANTED:
            return Way(who, 10 ** (-k / 2), run, error)
    return None


def ways(name: str) -> tuple[Way, list[Way]]:
    """Ours, and heyoka's in all its forms."""
    case, start, end = CASES[name]
    text = scene_text(case).replace("[run]", "[run]\nbatch = true\ntolerance = 1e-9")
    system = from_scene(parse(text, f"{case}.toml"))
    module, theirs = eomc.load(system, ROOT / "build" / "batches"), Taylor(system, end)
    q0, qd0 = start()
    n, width = q0.shape[1], heyoka.recommended_simd_size()
    columns = np.hstack([q0, qd0]).reshape(-1, width, 2 * n).transpose(0, 2, 1).copy()

    def mine(tol: float) -> Callable[[], Array]:
        def run() -> Array:
            done = module.simulate_batch(q0, qd0, duration=end, tol=tol, threads=1)
            ends: Array = done.q[:, -1]
            return ends

        return run

    def taylor(form: str, fast: bool) -> Callable[[float], Callable[[], Array]]:
        def made(tol: float) -> Callable[[], Array]:
            integrator = heyoka.taylor_adaptive_batch(
                theirs.equations(form), columns[0], tol=tol, fast_math=fast
            )

            def run() -> Array:
                ends = np.empty_like(columns)
                for k, x in enumerate(columns):
                    integrator.set_time(0.0)
                    integrator.state[:] = x
                    integrator.propagate_until(end)
                    ends[k] = integrator.state
                return ends.transpose(0, 2, 1).reshape(MANY, 2 * n)[:, :n]

            return run

        return made

    right = q0 if start is orbits else taylor(FORMS[0], False)(RIGHT)()
    own = loosest("eomc", mine, right)
    assert own is not None
    asked = [(form, fast) for form in theirs.forms for fast in (False, True)]
    others = [
        loosest(f"{form}{', fast_math' * fast}", taylor(form, fast), right) for form, fast in asked
    ]
    return own, [way for way in others if way]


HEAD = """\
# Adaptive steps of batches

Written by `python benchmarks/adaptive_batches.py`: {many:,} initial states each, one thread, with an error of at most {wanted:g} of each instance at the end.
Times in us per instance, the smallest of {rounds} rounds in which all programs run in turns on one core. heyoka integrates batches of {width}, in the fastest
of its forms (benchmarks/taylor.py); its compilation is not counted.

{machine}

| system | tol | error | us | heyoka | tol | error | us | ratio, bar {bar:g} |
|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    os.sched_setaffinity(0, {min(CORES)})
    text = HEAD.format(
        many=MANY, wanted=WANTED, rounds=rounds, bar=BAR, width=heyoka.recommended_simd_size(),
        machine=machine(("eomc", "heyoka", "numpy", "sympy")),
    )  # fmt: skip
    for name in CASES:
        own, others = ways(name)
        times = timed([own.run, *(way.run for way in others)], rounds) / MANY
        best = int(np.argmin(times[1:]))
        other, ratio = others[best], times[0] / times[1 + best]
        verdict = "met" if ratio <= BAR else "**missed**"
        text += (
            f"| {name} | {own.tol:.0e} | {own.error:.1e} | {times[0]:.3g} | {other.who} "
            f"| {other.tol:.0e} | {other.error:.1e} | {times[1 + best]:.3g} "
            f"| {ratio:.2f} {verdict} |\n"
        )
        print(text.splitlines()[-1], flush=True)
    (Path(__file__).parent / "ADAPTIVE_BATCHES.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
