"""The same numbers everywhere: compilers, levels, registers, forms, precisions, batches, threads.

    python tests/hostile/agreement.py            the table of all scenes
    python tests/hostile/agreement.py cartpole

Each way of compiling a scene is compared with the reference, SymPy's derivation evaluated by NumPy:
accelerations at random states, relative to the largest of their state, and the end of a run of RK4,
relative to how far things are; both in units of the last digit. A batch is compared with the runs
one by one, and with itself in three threads, which has to be the same bits.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from cases import SCENES
from random_scenes import EXTENSION, built

import eomc
from eomc.model.from_scene import from_scene
from eomc.program.assembly import assembled
from eomc.scene.read import parse
from eomc.verify import symbolic

NAMES = ("cartpole", "double_pendulum", "furuta_pendulum", "spring_pendulum", "four_bar")
PLAIN = ("-fno-math-errno", "-fno-trapping-math")
STATES, STEPS = 40, 200
LIMIT = 100.0  # units of the last digit


def ways() -> Iterator[tuple[str, str, str]]:
    """A compiler, its flags, and a name for both."""
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    found = {name: shutil.which(name) for name in ("gcc", "clang-14", "clang")}
    for name, path in found.items():
        if path is None or (name == "clang" and found["clang-14"]):
            continue
        for level in ("-O0", "-O1", "-O2", "-O3"):
            yield path, f"{level} -march=native", f"{name} {level} native"
        yield path, "-O2 -march=x86-64", f"{name} -O2 SSE2"
        if "avx2" in flags and "fma" in flags:
            yield path, "-O2 -march=haswell", f"{name} -O2 AVX2"
        if "avx512f" in flags:
            yield path, "-O2 -march=skylake-avx512", f"{name} -O2 AVX-512"


class Scene:
    """One scene in one precision, and what the reference says of it."""

    def __init__(self, name: str, real: str) -> None:
        text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
        more = f'[run]\nbatch = true\nreal = "{real}"\n'
        made = from_scene(parse(text.replace("[run]\n", more), f"{name}.toml"))
        self.system = assembled(made)
        self.sources = eomc.sources(self.system, EXTENSION)
        answer = symbolic.derive(self.system)
        draw, n = np.random.default_rng(1), len(self.system.coordinates)
        start = np.array([(c.start, c.rate) for c in self.system.coordinates]).T
        states = start[0] + draw.uniform(-1, 1, (STATES, n)), draw.normal(size=(STATES, n))
        if self.system.constraints:  # somewhere on them
            q, qd = answer.project(start[0] + states[0] / 20, states[1])
            fine = np.isfinite(q).all(1) & (np.abs(q - start[0]).max(1) < 1)
            states = q[fine], qd[fine]
        kind = np.float32 if real == "float" else np.float64
        self.q, self.qd = (np.asarray(x, kind).astype(float) for x in states)
        self.a = answer.acceleration(self.q, self.qd, np.zeros(len(self.q)))
        _, q, qd = answer.simulate(steps=STEPS, every=STEPS)
        self.end = np.array([q[-1], qd[-1]])
        self.eps = float(np.finfo(kind).eps)

    def off(self, m: ModuleType) -> tuple[float, float, float, bool]:
        """Accelerations, a run and a batch, in last digits; whether threads give the same bits."""
        call: Any = m
        found = np.array([call.acceleration(*s) for s in zip(self.q, self.qd, strict=True)], float)
        a = np.max(np.abs(found - self.a) / np.max(np.abs(self.a), axis=1, keepdims=True))
        run = call.simulate(steps=STEPS, every=STEPS, method="rk4")
        end = np.array([run.q[-1], run.qd[-1]], float)
        r = np.max(np.abs(end - self.end) / np.max(np.abs(self.end), axis=1, keepdims=True))
        one, three = (
            call.simulate_batch(self.q, self.qd, steps=20, every=20, threads=t) for t in (1, 3)
        )
        each = [call.simulate(*s, steps=20, every=20) for s in zip(self.q, self.qd, strict=True)]
        ends = np.array([x.q[-1] for x in each], float)
        b = np.max(np.abs(np.asarray(one.q[:, -1], float) - ends) / (1 + np.abs(ends)))
        same = np.array_equal(one.q, three.q) and np.array_equal(one.qd, three.qd)
        return a / self.eps, r / self.eps, b / self.eps, same


def main(arguments: Sequence[str]) -> int:
    """1 where something is farther off than LIMIT."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", help=" ".join(NAMES))
    parser.add_argument("--brief", action="store_true", help="three ways of compiling alone")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    bad = 0
    print("units of the last digit: accelerations, run, batch beside runs; threads the same bits\n")
    for name in given.scenes or NAMES:
        for real in ("double", "float"):
            made = Scene(name, real)
            rows = list(ways())
            for cc, flags, called in [rows[0], rows[3], rows[4]] if given.brief else rows:
                for form in ("plain", "fast"):
                    os.environ["CC"], os.environ["EOMC_CFLAGS"] = cc, " ".join([flags, *PLAIN])
                    with tempfile.TemporaryDirectory() as place:
                        *off, same = made.off(built(made.sources, Path(place) / "x", form))
                    wrong = bool(max(off) > LIMIT) or not same
                    bad += wrong
                    told = "".join(f"{x:9.3g}" for x in off)
                    what = f"{name:16} {real:7} {form:6} {called:22}"
                    print(
                        f"{what}{told}  {'same' if same else 'OTHER'}{'  FAR' * wrong}", flush=True
                    )
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
