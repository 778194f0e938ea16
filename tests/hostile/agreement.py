"""The same numbers everywhere: compilers, levels, registers, machines, Pythons, forms, precisions.

    python tests/hostile/agreement.py                 the table of all scenes
    python tests/hostile/agreement.py cartpole
    python tests/hostile/agreement.py --python PATH   with rows of another Python that has eomc

Each way of compiling a scene is compared with the reference, SymPy's derivation evaluated by NumPy:
accelerations at random states, relative to the largest of their state, and the end of a run of RK4,
relative to how far things are; both in units of the last digit. A batch is compared with the runs
one by one, and with itself in three threads, which has to be the same bits. Other machines are
those whose cross compiler and QEMU are installed; there a batch goes in three parts, not threads.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
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
from eomc.toolchain import compiler
from eomc.toolchain.files import write_files
from eomc.verify import symbolic

NAMES = ("cartpole", "double_pendulum", "furuta_pendulum", "spring_pendulum", "four_bar")
PLAIN = ("-fno-math-errno", "-fno-trapping-math")
STATES, STEPS, FEW = 40, 200, 20
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


MACHINES = {
    "aarch64": ("aarch64-linux-gnu-gcc", "qemu-aarch64-static"),
    "riscv64": ("riscv64-linux-gnu-gcc", "qemu-riscv64-static"),
    "s390x": ("s390x-linux-gnu-gcc", "qemu-s390x-static"),
}


def elsewhere() -> Iterator[tuple[str, str, str, str]]:
    """A cross compiler, its flags, what runs its programs, and a name for all."""
    for machine, (gcc, qemu) in MACHINES.items():
        found, run = shutil.which(gcc), shutil.which(qemu)
        if found and run:
            for level in ("-O0", "-O2", "-O3"):
                yield found, level, run, f"gcc {level} {machine}"


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
        _, q, qd = answer.simulate(steps=STEPS)
        self.end = np.array([q[-1], qd[-1]])
        self.real, self.eps = real, float(np.finfo(kind).eps)

    def off(self, m: ModuleType) -> tuple[float, float, float, bool]:
        """Accelerations, a run and a batch, in last digits; whether threads give the same bits."""
        call: Any = m
        a = np.array([call.acceleration(*s) for s in zip(self.q, self.qd, strict=True)], float)
        run = call.simulate(steps=STEPS, every=STEPS, method="rk4")
        one, three = (
            call.simulate_batch(self.q, self.qd, steps=FEW, every=FEW, threads=t) for t in (1, 3)
        )
        each = [call.simulate(*s, steps=FEW, every=FEW) for s in zip(self.q, self.qd, strict=True)]
        same = np.array_equal(one.q, three.q) and np.array_equal(one.qd, three.qd)
        batch = np.asarray(one.q[:, -1], float), np.array([x.q[-1] for x in each], float)
        return *self._judged(a, np.array([run.q[-1], run.qd[-1]], float), *batch), same

    def off_elsewhere(
        self, gcc: str, flags: str, run: str, form: str, place: Path
    ) -> tuple[float, float, float, bool]:
        """The same of a program for another machine, which an emulator runs."""
        at, name, n = "fast/" if form == "fast" else "", self.system.name, self.q.shape[1]
        write_files(self.sources.embeddable, place)
        words = [compiler.standard(form), *flags.split(), *PLAIN, "-static", f"-I{place / at}"]
        given = {"HEADER": f"<{name}.h>", "SCENE": name, "SIZE": n, "NUMBER": self.real}
        given["INPUTS"] = len(self.system.inputs)
        words += [f"-D{macro}={value}" for macro, value in given.items()]
        files = [Path(__file__).with_suffix(".c"), place / f"{at}{name}.c"]
        subprocess.run([gcc, *words, *files, "-lm", "-o", place / "run"], check=True)
        asked = map(str, (len(self.q), STEPS, repr(self.system.run.h), FEW))
        states = "\n".join(map(repr, np.hstack([self.q, self.qd]).ravel().tolist()))
        done = subprocess.run(
            [run, place / "run", *asked], input=states, capture_output=True, text=True, check=True
        )
        *numbers, same = map(float, done.stdout.split())
        k = self.q.size
        a, end, *batch = np.split(np.array(numbers), [k, k + 2 * n, 2 * k + 2 * n])
        one, each = (x.reshape(-1, n) for x in batch)
        return *self._judged(a.reshape(-1, n), end.reshape(2, n), one, each), same == 1

    def _judged(
        self, a: np.ndarray, end: np.ndarray, batch: np.ndarray, each: np.ndarray
    ) -> tuple[float, float, float]:
        """In last digits, of accelerations, the end of a run, a batch beside runs one by one."""
        off_a = np.max(np.abs(a - self.a) / np.max(np.abs(self.a), axis=1, keepdims=True))
        off_run = np.max(np.abs(end - self.end) / np.max(np.abs(self.end), axis=1, keepdims=True))
        off_batch = np.max(np.abs(batch - each) / (1 + np.abs(each)))
        return off_a / self.eps, off_run / self.eps, off_batch / self.eps


def told(what: str, off: Sequence[float], same: bool) -> bool:
    """Print a row; whether all is near enough."""
    fine = bool(max(off) <= LIMIT) and same
    numbers = "".join(f"{x:9.3g}" for x in off)
    print(f"{what}{numbers}  {'same' if same else 'OTHER'}{'' if fine else '  FAR'}", flush=True)
    return fine


def main(arguments: Sequence[str]) -> int:
    """1 where something is farther off than LIMIT, or threads give other bits."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", help=" ".join(NAMES))
    parser.add_argument("--brief", action="store_true", help="three ways of compiling alone")
    parser.add_argument("--python", action="append", default=[], help="another, which has eomc")
    parser.add_argument("--own", action="store_true", help="one way, of this Python, and no title")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    fine = True
    if not given.own:
        what = "accelerations, run, batch beside runs; threads the same bits"
        print(f"units of the last digit: {what}\n", flush=True)
    rows, others = list(ways()), list(elsewhere())
    if given.own:
        version = ".".join(map(str, sys.version_info[:2]))
        (cc, flags, called), others = rows[2], []
        rows = [(cc, flags, f"{called}, {version}")]
    elif given.brief:
        rows, others = [rows[0], rows[3], rows[4]], others[1:2]
    for name in given.scenes or NAMES:
        for real in ("double", "float"):
            made = Scene(name, real)
            for form in ("plain", "fast"):
                what = f"{name:16} {real:7} {form:6}"
                for cc, flags, called in rows:
                    os.environ["CC"], os.environ["EOMC_CFLAGS"] = cc, " ".join([flags, *PLAIN])
                    with tempfile.TemporaryDirectory() as place:
                        *off, same = made.off(built(made.sources, Path(place) / "x", form))
                    fine &= told(f"{what} {called:26}", off, same)
                for gcc, flags, run, called in others:
                    with tempfile.TemporaryDirectory() as place:
                        *off, same = made.off_elsewhere(gcc, flags, run, form, Path(place))
                    fine &= told(f"{what} {called:26}", off, same)
        for python in given.python:
            own = subprocess.run([python, __file__, name, "--own"], check=False)
            fine &= own.returncode == 0
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
