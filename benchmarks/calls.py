"""What a call and an import of a built module cost beside the steps themselves.

    python benchmarks/calls.py [--rounds 25]

- overhead of `simulate(steps=10)`: its time less ten steps' time; a step's time is the slope
  between runs of 2,000 and 12,000 steps, in the same rounds; in processor time of the thread, so
  that others on the same core do not count. On a machine shared with others it comes in two sizes,
  up to 1.8 apart: where somebody else has the other half of the physical core, an interpreter gets
  half of the instructions through, while a chain of dependent multiplications takes no longer;
- overhead of `simulate()` by a tolerance: beside the same steps in C, which keep no rows; with an
  input that is held, too;
- `step_batch` of eight instances, whole: it has no bar, but learning loops pay it in every step;
- import: of a built scene in a fresh process, bytecode in place, after NumPy is there.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import work
from searching import adaptive_in_c

import eomc

SCENES = Path(__file__).resolve().parents[1] / "scenes"
CALL_BAR, FIT_BAR, IMPORT_BAR = 5e-6, 3e-6, 50e-3  # s
IMPORT = """
import sys, time, numpy
sys.path[:0] = [sys.argv[1]]
begun = time.perf_counter()
import cartpole
print(time.perf_counter() - begun)
"""


def quartiles(values: list[float]) -> tuple[float, float, float]:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return float(low), float(middle), float(high)


def seconds(call: Callable[[], object], many: int) -> float:
    """The mean over many calls in a row, processor time."""
    begun = time.thread_time()
    for _ in range(many):
        call()
    return (time.thread_time() - begun) / many


def call_overhead(root: Path, rounds: int) -> tuple[float, float, float]:
    """Quartiles over the rounds of simulate(steps=10) less ten steps, s."""
    module = work.load(work.CASES["cart-pole"], root)
    module.simulate(steps=12_000)
    found = []
    for _ in range(rounds):
        short = seconds(lambda: module.simulate(steps=10), 300)
        few = seconds(lambda: module.simulate(steps=2_000, every=2_000), 3)
        more = seconds(lambda: module.simulate(steps=12_000, every=12_000), 3)
        found.append(short - 10 * (more - few) / 10_000)
    return quartiles(found)


def adaptive_overhead(root: Path, rounds: int, driven: bool = False) -> tuple[float, float, float]:
    """Quartiles over the rounds of simulate() by a tolerance less its loop in C, s.

    driven: with an input that is held.
    """
    if driven:
        text = (SCENES / "cartpole_driven.toml").read_text(encoding="utf-8")
        (root / "driven.toml").write_text(text + "tolerance = 1e-9\n", encoding="utf-8")
        module = eomc.load(root / "driven.toml", root)
    else:
        module = work.load(work.CASES["cart-pole"], root, "tolerance = 1e-9\n")
    u = np.array([0.5]) if driven else None
    bare = adaptive_in_c(module, 1.0, 1e-9, u)

    def run() -> object:
        return module.simulate(duration=1.0, tol=1e-9, u=u)

    run()
    return quartiles([seconds(run, 300) - seconds(bare, 300) for _ in range(rounds)])


def batch_call(root: Path, rounds: int) -> tuple[float, float, float]:
    """Quartiles over the rounds of a step of eight instances, s."""
    case = work.CASES["cart-pole"]
    module = work.load(case, root, "batch = true\n")
    q, qd = (np.tile(x, (8, 1)) for x in case.x0.reshape(2, -1))
    return quartiles([seconds(lambda: module.step_batch(q, qd, 1e-6), 300) for _ in range(rounds)])


def import_time(root: Path, rounds: int) -> tuple[float, float, float]:
    """Quartiles over the rounds of a warm import beyond NumPy's own, s."""
    path = work.write(work.CASES["cart-pole"], root)
    eomc.load(path, path.parent)
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", IMPORT, str(path.parent)]
    found = []
    for _ in range(rounds + 1):
        done = subprocess.run(command, env=kept, capture_output=True, text=True, check=True)
        found.append(float(done.stdout))
    return quartiles(found[1:])  # the first may have written the bytecode


def said(root: Path, rounds: int) -> str:
    """All as lines of a table, with their bars."""
    lines = ["| | median | quartiles | bar |", "|---|---|---|---|"]
    for title, unit, scale, bar, found in (
        ("`simulate(steps=10)` beyond ten steps", "us", 1e6, CALL_BAR, call_overhead(root, rounds)),
        (
            "`simulate()` by a tolerance, beyond its loop in C",
            "us", 1e6, FIT_BAR, adaptive_overhead(root, rounds),
        ),
        (
            "the same with an input that is held",
            "us", 1e6, FIT_BAR, adaptive_overhead(root, rounds, driven=True),
        ),
        ("`step_batch` of eight", "us", 1e6, math.inf, batch_call(root, rounds)),
        (
            "warm import of a built module, beyond NumPy's",
            "ms", 1e3, IMPORT_BAR, import_time(root, min(rounds, 9)),
        ),
    ):  # fmt: skip
        low, middle, high = (scale * x for x in found)
        verdict = "met" if found[1] <= bar else "**missed**"
        wanted = f"{scale * bar:g} {unit} {verdict}" if bar < math.inf else ""
        lines.append(f"| {title} | {middle:.3g} {unit} | {low:.3g} – {high:.3g} | {wanted} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=25)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as root:
        print(said(Path(root), options.rounds), end="")


if __name__ == "__main__":
    main()
