"""Adaptive steps where forces jump or bend: errors against ends in closed form, and what they cost.

    python benchmarks/corners.py

Scenes of tests/support/nonsmooth_cases.py from 24 starts each: of the errors at the end, over the
tolerance, the median and the largest, and the median of evaluations. Below that, what the watch
costs where nothing bends: a pendulum whose drive never reaches its limits, beside the same without
them; of 40 runs in turns the least time. Then friction that is small beside the other forces, by
the largest errors of 24 starts. Last, a steep smooth force in place of a jump.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from support.nonsmooth_cases import CASES, PENDULUM, RUBBED, rubbed  # noqa: E402

import eomc  # noqa: E402

TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)
STARTS, ROUNDS = 24, 40
FREE = PENDULUM.replace("-20*sin", "-1.4*sin").replace(", limits = [-1.5, 1.5]", "")
IDLE = PENDULUM.replace("-20*sin", "-1.4*sin").replace("limited", "idle")
STEEP = RUBBED.replace("sign(x_dot)", "tanh(x_dot/0.001)").replace("rubbed", "steep")


def built(text: str, root: str) -> ModuleType:
    """The module of a scene's text."""
    path = Path(root) / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return eomc.load(path, root)


def seconds(module: ModuleType, tol: float) -> float:
    """What a run takes."""
    begun = time.perf_counter()
    module.simulate(tol=tol)
    return time.perf_counter() - begun


def cases(root: str) -> None:
    """The errors of the scenes with corners."""
    print("forces      tol    error/tol: median  largest   evaluations")
    for name, case in CASES.items():
        module = built(case.text, root)
        starts = np.random.default_rng(7).uniform(*case.starts, STARTS)
        ends = [case.end(float(start)) for start in starts]
        for tol in TOLERANCES:
            runs = [module.simulate(q0=[x, *module.start[0][1:]], tol=tol) for x in starts]
            off = [abs(r.q[-1, 0] - end) / tol for r, end in zip(runs, ends, strict=True)]
            most = np.median([r.evaluations for r in runs])
            print(f"{name:11} {tol:.0e} {np.median(off):18.2g} {max(off):8.2g} {most:13.0f}")


def idle(root: str) -> None:
    """Corners that are never reached, beside none."""
    print("\nlimits never reached, over none: evaluations, time")
    modules = [built(text, root) for text in (IDLE, FREE)]
    for tol in TOLERANCES:
        least = np.min([[seconds(m, tol) for m in modules] for _ in range(ROUNDS)], axis=0)
        work = [m.simulate(tol=tol).evaluations for m in modules]
        print(f"{tol:.0e} {work[0] / work[1]:.2f} {least[0] / least[1]:.2f}")


def small(root: str) -> None:
    """Friction far below the other forces."""
    print("\nsmall friction: largest error/tol at", *(f"{tol:.0e}" for tol in TOLERANCES))
    starts = np.random.default_rng(3).uniform(0.5, 2.0, STARTS)
    for mu in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        text = RUBBED.replace("0.3", f"{mu:g}").replace("rubbed", f"small{-math.log10(mu):.0f}")
        module, found = built(text, root), list[str]()
        for tol in TOLERANCES:
            ends = [(module.simulate(q0=[x], tol=tol).q[-1, 0], rubbed(x, mu)) for x in starts]
            found.append(f"{max(abs(a - b) for a, b in ends) / tol:.2g}")
        print(f"{mu:.0e}", *found)


def steep(root: str) -> None:
    """A smooth force that is as good as a jump to long steps."""
    print("\ntanh(v/0.001): error/tol")
    module = built(STEEP, root)
    end = module.simulate(tol=1e-14, max_step=1e-3).q[-1, 0]
    for tol in TOLERANCES:
        print(f"{tol:.0e} {abs(module.simulate(tol=tol).q[-1, 0] - end) / tol:.2g}")


if __name__ == "__main__":
    warnings.simplefilter("ignore", RuntimeWarning)
    with tempfile.TemporaryDirectory() as root:
        cases(root)
        idle(root)
        small(root)
        steep(root)
