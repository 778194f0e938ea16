"""The RK4 loop in C against the same loop in pure Python, and what a build takes.

    python benchmarks/loop.py [SCENE ...]

Both loops run the same scene from the same start with the same steps, interleaved, best of
several rounds; the difference of their last states stands beside the ratio, and so does the error
of both, from the same run at half the step.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import eomc
from eomc.verify import symbolic

HERE = Path(__file__).resolve().parent.parent


def loop(scene: Path, root: str, rounds: int, steps: int) -> None:
    system = eomc.read(scene)
    module = eomc.load(scene, root)
    plain = symbolic.derive(system)
    h = system.run.h
    many = 200 * steps
    best_c = best_python = float("inf")
    for _ in range(rounds):
        begun = time.perf_counter()
        module.simulate(h=h, steps=many, every=many)
        best_c = min(best_c, (time.perf_counter() - begun) / many)
        begun = time.perf_counter()
        _, q, qd = plain.simulate(h=h, steps=steps)
        best_python = min(best_python, (time.perf_counter() - begun) / steps)
    run = module.simulate(h=h, steps=steps, every=steps)
    halved = module.simulate(h=h / 2, steps=2 * steps, every=2 * steps)
    difference = max(np.max(np.abs(run.q[-1] - q[-1])), np.max(np.abs(run.qd[-1] - qd[-1])))
    error = 16 / 15 * max(np.max(np.abs(run.x[-1] - halved.x[-1])), 0.0)
    print(
        f"{scene.stem:20} {best_c * 1e9:8.1f} ns {best_python * 1e6:8.1f} us "
        f"{best_python / best_c:8.0f} {difference:12.1e} {error:12.1e}"
    )


def builds(scene: Path, rounds: int) -> None:
    command = [sys.executable, "-m", "eomc.cli.main", "build", str(scene), "--quiet", "--build"]
    fresh, same = [], []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as root:
            for times in (fresh, same):
                begun = time.perf_counter()
                subprocess.run([*command, root], check=True)
                times.append(time.perf_counter() - begun)
    print(f"{scene.stem:20} from nothing {min(fresh):.2f} s, nothing changed {min(same):.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=[HERE / "scenes" / "cartpole.toml"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2000)
    options = parser.parse_args()
    columns = f"{'C':>11} {'Python':>11} {'ratio':>8} {'difference':>12} {'error':>12}"
    print(f"{'one RK4 step':20} {columns}")
    with tempfile.TemporaryDirectory() as root:
        for scene in options.scenes:
            loop(scene, root, options.rounds, options.steps)
    print("\neomc build, start of Python included")
    for scene in options.scenes:
        builds(scene, 3)


if __name__ == "__main__":
    main()
