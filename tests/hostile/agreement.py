"""Compare results across compilers, levels, vector widths, machines, Pythons, forms and precisions.

    python tests/hostile/agreement.py                 the table of all scenes
    python tests/hostile/agreement.py cartpole
    python tests/hostile/agreement.py --python PATH   with rows of another Python that has eomc

Each way of compiling a scene is compared with the reference, SymPy's derivation evaluated by NumPy:
accelerations at random states, relative to the largest of their state, and the end of a run of RK4,
relative to the scale of the state; both in units in the last place. A batch is compared with
separate runs, and with a run in three threads, which must give equal bits. Other machines are those
whose cross compiler and QEMU are installed; there a batch runs in three parts instead of threads.
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
from support.cases import SCENES
from support.random_scenes import EXTENSION, built

import eomc
from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain import compiler
from eomc.toolchain.files import write_files
from eomc.verify import symbolic

NAMES = ("cartpole", "double_pendulum", "furuta_pendulum", "spring_pendulum", "four_bar")
PLAIN = ("-fno-math-errno", "-fno-trapping-math")
STATES, STEPS, FEW = 40, 200, 20
LIMIT = 100.0  # units in the last place


def compiler_variants() -> Iterator[tuple[str, str, str]]:
    """Yield a compiler, its flags, and a name for both."""
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    compilers = {name: shutil.which(name) for name in ("gcc", "clang-14", "clang")}
    for name, path in compilers.items():
        if path is None or (name == "clang" and compilers["clang-14"]):
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


def cross_compiler_variants() -> Iterator[tuple[str, str, str, str]]:
    """Yield a cross compiler, its flags, the emulator of its programs, and a name for all."""
    for machine, (gcc, qemu) in MACHINES.items():
        compiler, run = shutil.which(gcc), shutil.which(qemu)
        if compiler and run:
            for level in ("-O0", "-O2", "-O3"):
                yield compiler, level, run, f"gcc {level} {machine}"


class Scene:
    """One scene in one precision, and the values of the reference."""

    def __init__(self, name: str, real: str) -> None:
        text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
        more = f'[run]\nbatch = true\nreal = "{real}"\n'
        system = from_scene(parse(text.replace("[run]\n", more), f"{name}.toml"))
        self.system = assembled(system)
        self.sources = eomc.sources(self.system, EXTENSION)
        answer = symbolic.derive(self.system)
        draw, n = np.random.default_rng(1), len(self.system.coordinates)
        start = np.array([(c.start, c.rate) for c in self.system.coordinates]).T
        states = start[0] + draw.uniform(-1, 1, (STATES, n)), draw.normal(size=(STATES, n))
        if self.system.constraints:  # states that satisfy the constraints
            q, qd = answer.project(start[0] + states[0] / 20, states[1])
            fine = np.isfinite(q).all(1) & (np.abs(q - start[0]).max(1) < 1)
            states = q[fine], qd[fine]
        kind = np.float32 if real == "float" else np.float64
        self.q, self.qd = (np.asarray(x, kind).astype(float) for x in states)
        self.a = answer.acceleration(self.q, self.qd, np.zeros(len(self.q)))
        _, q, qd = answer.simulate(steps=STEPS)
        self.end = np.array([q[-1], qd[-1]])
        self.real, self.eps = real, float(np.finfo(kind).eps)

    def errors(self, m: ModuleType) -> tuple[float, float, float, bool]:
        """Return errors of accelerations, a run and a batch, and whether threads give equal
        bits.
        """
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

    def errors_on_another_machine(
        self, gcc: str, flags: str, run: str, form: str, place: Path
    ) -> tuple[float, float, float, bool]:
        """Return the same for a program for another machine, run by an emulator."""
        at, name, n = "fast/" if form == "fast" else "", self.system.name, self.q.shape[1]
        write_files(self.sources.embeddable, place)
        words = [compiler.standard(form), *flags.split(), *PLAIN, "-static", f"-I{place / at}"]
        macros = {"HEADER": f"<{name}.h>", "SCENE": name, "SIZE": n, "NUMBER": self.real}
        macros["INPUTS"] = len(self.system.inputs)
        words += [f"-D{macro}={value}" for macro, value in macros.items()]
        files = [Path(__file__).with_suffix(".c"), place / f"{at}{name}.c"]
        subprocess.run([gcc, *words, *files, "-lm", "-o", place / "run"], check=True)
        sizes = map(str, (len(self.q), STEPS, repr(self.system.run.h), FEW))
        states = "\n".join(map(repr, np.hstack([self.q, self.qd]).ravel().tolist()))
        process = subprocess.run(
            [run, place / "run", *sizes], input=states, capture_output=True, text=True, check=True
        )
        *numbers, same = map(float, process.stdout.split())
        k = self.q.size
        a, end, *batch = np.split(np.array(numbers), [k, k + 2 * n, 2 * k + 2 * n])
        one, each = (x.reshape(-1, n) for x in batch)
        return *self._judged(a.reshape(-1, n), end.reshape(2, n), one, each), same == 1

    def _judged(
        self, a: np.ndarray, end: np.ndarray, batch: np.ndarray, each: np.ndarray
    ) -> tuple[float, float, float]:
        """Return the errors of accelerations, of the end of a run, and of a batch relative to
        single runs.
        """
        off_a = np.max(np.abs(a - self.a) / np.max(np.abs(self.a), axis=1, keepdims=True))
        off_run = np.max(np.abs(end - self.end) / np.max(np.abs(self.end), axis=1, keepdims=True))
        off_batch = np.max(np.abs(batch - each) / (1 + np.abs(each)))
        return off_a / self.eps, off_run / self.eps, off_batch / self.eps


def print_row(what: str, errors: Sequence[float], same: bool) -> bool:
    """Print a row; return True if all errors are within the limit."""
    fine = bool(max(errors) <= LIMIT) and same
    numbers = "".join(f"{x:9.3g}" for x in errors)
    print(f"{what}{numbers}  {'same' if same else 'OTHER'}{'' if fine else '  FAR'}", flush=True)
    return fine


def main(arguments: Sequence[str]) -> int:
    """Return 1 if an error exceeds LIMIT or threads change bits."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", help=" ".join(NAMES))
    parser.add_argument("--brief", action="store_true", help="three ways of compiling alone")
    parser.add_argument("--python", action="append", default=[], help="another, which has eomc")
    parser.add_argument("--own", action="store_true", help="one way, of this Python, and no title")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    fine = True
    if not options.own:
        what = "accelerations, run, batch beside runs; threads the same bits"
        print(f"units of the last digit: {what}\n", flush=True)
    rows, others = list(compiler_variants()), list(cross_compiler_variants())
    if options.own:
        version = ".".join(map(str, sys.version_info[:2]))
        (cc, flags, called), others = rows[2], []
        rows = [(cc, flags, f"{called}, {version}")]
    elif options.brief:
        rows, others = [rows[0], rows[3], rows[4]], others[1:2]
    for name in options.scenes or NAMES:
        for real in ("double", "float"):
            scene = Scene(name, real)
            for form in ("plain", "fast"):
                what = f"{name:16} {real:7} {form:6}"
                for cc, flags, called in rows:
                    os.environ["CC"], os.environ["EOMC_CFLAGS"] = cc, " ".join([flags, *PLAIN])
                    with tempfile.TemporaryDirectory() as place:
                        *errors, same = scene.errors(built(scene.sources, Path(place) / "x", form))
                    fine &= print_row(f"{what} {called:26}", errors, same)
                for gcc, flags, run, called in others:
                    with tempfile.TemporaryDirectory() as place:
                        *errors, same = scene.errors_on_another_machine(
                            gcc, flags, run, form, Path(place)
                        )
                    fine &= print_row(f"{what} {called:26}", errors, same)
        for python in options.python:
            own = subprocess.run([python, __file__, name, "--own"], check=False)
            fine &= own.returncode == 0
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
