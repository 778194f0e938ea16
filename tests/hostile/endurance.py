"""Build, run and check in a loop: memory, handles, threads and files must stay constant.

    python tests/hostile/endurance.py --minutes 15

One process reads, derives and builds scenes that are new in each round, runs and checks modules
that it loaded once, and reads invalid scenes. A forked process loads and checks the new builds,
because Python never unloads an extension. After two fifths of the rounds, when caches are full,
nothing may grow. Memory in use is judged: Python's blocks and malloc's allocations, and the pages
of the process itself after malloc has returned free ones. These are 5 to 9 MB of 96, of which pages
are touched sooner or later; the kernel may keep or drop pages of libraries.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.cases import SCENES
from support.forks import in_a_fork

import eomc
from eomc.base.errors import SceneError
from eomc.verify.check import check

EVENT = '[[event]]\nname = "low"\nwhen = "theta"\n'
OPTIONS = 'batch = true\nlinearize = true\nmethod = ["rk4", "dp8"]\n'
BUILT = {  # under [run], and at the end
    "simple_pendulum": ("", EVENT),
    "cartpole_driven": (OPTIONS, ""),
    "pendulum_xy": ("", ""),
    "suspension": ("", ""),
}
MORE = 0.01  # growth of memory, objects and heap, from the third fifth of the rounds to the last
LEAST = 1 << 20  # bytes, allowed noise of allocators
WRONG = 'eomc = 1\nname = "wrong"\n[coordinates]\nx = { start = "y" }\n[energy]\nkinetic = "x"'


@dataclass(frozen=True)
class Sample:
    """Resources of this process: memory, objects, allocated bytes of the C heap, and more.

    memory: without free memory that malloc holds. objects: blocks of Python's allocator. heap: 0 if
    the C library does not report it. Also open handles, threads, child processes, and files.
    """

    memory: int
    objects: int
    heap: int
    handles: int
    threads: int
    children: int
    files: int


class _MallInfo(ctypes.Structure):
    """Result of glibc's mallinfo2, all of type size_t."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks",
            "fordblks", "keepcost",
        )
    )  # fmt: skip


def _heap() -> int:
    """Return the bytes allocated by malloc, including mapped ones, after free memory is
    returned.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallinfo2"):
        return 0
    libc.malloc_trim(0)
    libc.mallinfo2.restype = _MallInfo
    info = libc.mallinfo2()
    return int(info.uordblks + info.hblkhd)


def sample(folder: Path) -> Sample:
    """Return the current sample. folder: contains all files of the loop, also temporary ones."""
    gc.collect()
    objects, heap = sys.getallocatedblocks(), _heap()
    status = Path("/proc/self/status").read_text(encoding="ascii")
    tasks = list(Path("/proc/self/task").iterdir())
    return Sample(
        1024 * int(status.split("RssAnon:")[1].split()[0]),
        objects,
        heap,
        len(list(Path("/proc/self/fd").iterdir())),
        len(tasks),
        sum(len((task / "children").read_text(encoding="ascii").split()) for task in tasks),
        # Builds of other versions of a scene are stored up to a limit:
        # tests/toolchain/test_cache.py.
        sum(1 for file in folder.rglob("*") if ".builds" not in file.parts),
    )


def growth_messages(samples: Sequence[Sample]) -> list[str]:
    """Return messages about growth from the third fifth of the samples to the last."""
    fifth = len(samples) // 5
    early, late = samples[2 * fifth : 3 * fifth], samples[-fifth:]
    slack = {"memory": LEAST, "objects": 0, "heap": 0}
    words = []
    for field in fields(Sample):
        before, after = (
            statistics.median(getattr(s, field.name) for s in part) for part in (early, late)
        )
        more = max(slack[field.name], MORE * before) if field.name in slack else 0
        if after > before + more:
            words.append(f"{field.name}: {before:.0f} -> {after:.0f}")
    return words


class Loop:
    """Rounds in a folder of their own, with a sample after each."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.root = folder, folder / "build"
        os.environ["EOMC_CFLAGS"] = "-O0"
        self.systems = {name: eomc.read(self.scene(name, 0)) for name in BUILT}
        self.loaded = {
            name: eomc.load(system, folder / "own") for name, system in self.systems.items()
        }
        self.samples: list[Sample] = []

    def scene(self, name: str, number: int) -> Path:
        """Write the file of a scene, which differs for each number."""
        run, end = BUILT[name]
        text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
        assert "\n[run]\n" in text and "[constants]" not in text
        text = text.replace("\n[run]\n", f"\n[run]\ntolerance = 1e-8\n{run}")
        file = self.folder / f"{name}.toml"
        file.write_text(f"{text}\n{end}\n[constants]\nlap = {number}\n", encoding="utf-8")
        return file

    def round(self) -> None:
        """Build each scene again, check one in a forked process; run each loaded module, check
        one.
        """
        number = len(self.samples)
        for k, name in enumerate(BUILT):
            file = self.scene(name, number + 1)
            assert eomc.build(file, self.root).fresh
            assert not eomc.build(file, self.root).fresh
            if (number + k) % len(BUILT) == 0:
                how, words = in_a_fork(lambda file=file: self._checked(file), 300)
                assert (how, words) == ("done", ""), words
        for name, module in self.loaded.items():
            self._run(module)
            if number % len(BUILT) == list(BUILT).index(name):
                report = check(self.systems[name], module, states=4)
                assert report.passed, report.table()
        self.samples.append(sample(self.folder))

    def _checked(self, file: Path) -> str:
        module = eomc.load(file, self.root)
        report = check(eomc.read(file), module, states=4)
        return "" if report.passed else report.table()

    def _run(self, module: ModuleType) -> None:
        for method in module.methods:
            run = module.simulate(steps=400, method=method)
            assert run.status == "ok", run.status
        assert module.simulate(duration=0.5, tol=1e-8).status == "ok"
        if hasattr(module, "simulate_batch"):
            starts = np.tile(module.simulate(steps=1).q[0], (40, 1))
            module.simulate_batch(starts, np.zeros_like(starts), steps=50, threads=2)
        for wrong in ({"steps": -1}, {"steps": 3, "method": "none"}, {"q": [np.nan]}):
            try:
                module.simulate(**wrong)
            except (ValueError, TypeError):
                continue
            raise AssertionError(f"{wrong} was taken")
        file = self.folder / "wrong.toml"
        file.write_text(WRONG, encoding="utf-8")
        try:
            eomc.build(file, self.root)
        except SceneError:
            return
        raise AssertionError("a wrong scene was built")


def run_rounds(folder: Path, seconds: float) -> list[Sample]:
    """Return samples of at least ten rounds, and of all rounds within the time."""
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    loop, end = Loop(folder), time.monotonic() + seconds
    while time.monotonic() < end or len(loop.samples) < 10:
        loop.round()
    return loop.samples


def main(arguments: Sequence[str]) -> int:
    """Return 1 if something has grown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=15)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        samples = run_rounds(Path(folder), 60 * options.minutes)
    fifth = len(samples) // 5
    for at in (0, fifth, 2 * fifth, 3 * fifth, 4 * fifth, len(samples) - 1):
        print(f"round {at}: {samples[at]}")
    print(f"{len(samples)} rounds: " + ("; ".join(growth_messages(samples)) or "flat"))
    return int(bool(growth_messages(samples)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
