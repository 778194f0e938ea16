"""Builds, runs and checks in a loop: memory, handles, threads and files stay as they are.

    python tests/hostile/endurance.py --minutes 15

One process reads, derives and builds scenes that are new each round, runs and checks modules that
it loaded once, and is refused what is wrong. A fork loads and checks what was built: Python never
unloads an extension. After two fifths of the rounds, when caches are full, nothing may grow.

A leak is what is in use: Python's blocks and what malloc has given out are judged, and the pages of
the process itself once malloc has given back what is free. That is 5 to 9 MB of 96, of which pages
are touched sooner or later; pages of libraries are the kernel's to keep or drop.
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

from cases import SCENES
from forks import in_a_fork

import eomc
from eomc.base.errors import SceneError
from eomc.verify.check import check

EVENT = '[[event]]\nname = "low"\nwhen = "theta"\n'
ASKED = 'batch = true\nlinearize = true\nmethod = ["rk4", "dp8"]\n'
BUILT = {  # under [run], and at the end
    "simple_pendulum": ("", EVENT),
    "cartpole_driven": (ASKED, ""),
    "pendulum_xy": ("", ""),
    "suspension": ("", ""),
}
MORE = 0.01  # of memory, objects and heap, from the third fifth of the rounds to the last
LEAST = 1 << 20  # bytes that allocators hold or not
WRONG = 'eomc = 1\nname = "wrong"\n[coordinates]\nx = { start = "y" }\n[energy]\nkinetic = "x"'


@dataclass(frozen=True)
class Sample:
    """What this process has: its own bytes in memory, objects, bytes in use of C's heap, and more.

    memory: without what malloc holds and nobody uses. objects: blocks of Python's allocator. heap:
    0 where the C library does not tell. handles that are open, threads, children, files left.
    """

    memory: int
    objects: int
    heap: int
    handles: int
    threads: int
    children: int
    files: int


class _MallInfo(ctypes.Structure):
    """What mallinfo2 of glibc returns, all of size_t."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks",
            "fordblks", "keepcost",
        )
    )  # fmt: skip


def _heap() -> int:
    """Bytes that malloc has given out, mapped ones too; what is free is given back."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallinfo2"):
        return 0
    libc.malloc_trim(0)
    libc.mallinfo2.restype = _MallInfo
    info = libc.mallinfo2()
    return int(info.uordblks + info.hblkhd)


def sample(folder: Path) -> Sample:
    """Now. folder: where all files of the loop lie, temporary ones too."""
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
        # builds of other versions of a scene are kept up to a number: tests/toolchain/test_cache.py
        sum(1 for file in folder.rglob("*") if ".builds" not in file.parts),
    )


def grown(samples: Sequence[Sample]) -> list[str]:
    """What has grown from the third fifth of the samples to the last, in words."""
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
        self.made = {name: eomc.read(self.scene(name, 0)) for name in BUILT}
        self.loaded = {name: eomc.load(made, folder / "own") for name, made in self.made.items()}
        self.samples: list[Sample] = []

    def scene(self, name: str, number: int) -> Path:
        """The file of a scene, another one for each number."""
        run, end = BUILT[name]
        text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
        assert "\n[run]\n" in text and "[constants]" not in text
        text = text.replace("\n[run]\n", f"\n[run]\ntolerance = 1e-8\n{run}")
        file = self.folder / f"{name}.toml"
        file.write_text(f"{text}\n{end}\n[constants]\nlap = {number}\n", encoding="utf-8")
        return file

    def round(self) -> None:
        """Each scene built anew, one checked in a fork; each loaded module run, one checked."""
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
                report = check(self.made[name], module, states=4)
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


def ran(folder: Path, seconds: float) -> list[Sample]:
    """Samples of rounds for so long, ten at least."""
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    loop, end = Loop(folder), time.monotonic() + seconds
    while time.monotonic() < end or len(loop.samples) < 10:
        loop.round()
    return loop.samples


def main(arguments: Sequence[str]) -> int:
    """1 where something has grown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=15)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        samples = ran(Path(folder), 60 * given.minutes)
    fifth = len(samples) // 5
    for at in (0, fifth, 2 * fifth, 3 * fifth, 4 * fifth, len(samples) - 1):
        print(f"round {at}: {samples[at]}")
    print(f"{len(samples)} rounds: " + ("; ".join(grown(samples)) or "flat"))
    return int(bool(grown(samples)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
