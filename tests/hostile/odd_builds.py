"""Builds in odd surroundings: many at once, no HOME, umasks, clocks, two generators, two Pythons.

    python tests/hostile/odd_builds.py
    python tests/hostile/odd_builds.py --python PATH    another Python that has eomc, too

Each ends well or says why; the module that is there is an old one or a new one, whole, and nothing
is left beside it. Clocks are those that dated the module that was there. Commands go without the
rights of root to read and write what modes forbid, where setpriv (Linux) can take them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from builds import CHANGED, TEXT, gravity, leftovers
from killed_builds import OLD

import eomc
from eomc.toolchain import cache

AT_ONCE, TURNS = 20, 4
UMASKS = (0o000, 0o022, 0o077, 0o277, 0o777)
# before 1970 began anywhere but in UTC; what 31 and 32 bits can't say; the year 2400
CLOCKS = (0, 1, 2**31, 2**32 + 10, 13_569_465_600)
RIGHTS = "-dac_override,-dac_read_search"


class Odd:
    """A folder with a module, its scene, and one of the same name that is another."""

    def __init__(self, folder: Path) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        self.folder, self.root = folder, folder / "build"
        self.scene, self.other = (folder / f / "simple_pendulum.toml" for f in ("one", "other"))
        for file, text in ((self.scene, TEXT), (self.other, CHANGED)):
            file.parent.mkdir()
            file.write_text(text, encoding="utf-8")
        self.renew()

    def renew(self) -> None:
        """The first scene's module."""
        eomc.build(self.scene, self.root)
        assert self.found() == "old"

    def found(self) -> str:
        """Whose module is there; nothing is beside it."""
        g = gravity(self.root)
        kind = "old" if abs(g - OLD) < 1e-3 else "new" if abs(g - 2 * OLD) < 2e-3 else ""
        libraries = list((self.root / "simple_pendulum").glob("_simple_pendulum_*"))
        assert kind and leftovers(self.root) == [] and len(libraries) == 1, (g, libraries)
        return kind

    def together(self, works: Sequence[Callable[[], object]]) -> None:
        """All at once, in processes; none fails."""
        running = [get_context("fork").Process(target=work) for work in works]
        for process in running:
            process.start()
        for process in running:
            process.join(120)
        assert [p.exitcode for p in running] == [0] * len(running)

    def build(self, scene: Path, generator: str = "") -> None:
        """By another version of the generator, where one is named."""
        if generator:
            cache.generator_digest = lambda: generator  # type: ignore[assignment]
        eomc.build(scene, self.root)

    def command(
        self, *words: object, python: str = sys.executable, umask: int = -1, **given: str | None
    ) -> tuple[int, str]:
        """The status and the words of `eomc`; given: of the environment, None: without it."""
        environment = {**os.environ, **given}
        rights = ["setpriv", f"--bounding-set={RIGHTS}"] if _setpriv() else []
        done = subprocess.run(
            [*rights, Path(python).parent / "eomc", *map(str, words), "--build", self.root],
            env={k: v for k, v in environment.items() if v is not None}, umask=umask,
            cwd=self.folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120,
        )  # fmt: skip
        assert "Traceback" not in done.stderr, done.stderr
        return done.returncode, done.stderr

    # --- what is odd --------------------------------------------------------------------------

    def at_once(self) -> str:
        """So many of one scene; then of two scenes of one name, by two generators."""
        self.together([lambda: self.build(self.other)] * AT_ONCE)
        assert self.found() == "new"
        works = [
            lambda k=k: self.build((self.scene, self.other)[k % 2], f"version {k % 4 // 2}")
            for k in range(AT_ONCE)
        ]
        self.together(works)
        self.found()
        return f"{AT_ONCE} builds of one scene, {AT_ONCE} of two by two generators"

    def generators(self) -> str:
        """In turns."""
        for turn in range(2 * TURNS):
            self.together([lambda turn=turn: self.build(self.other, f"version {turn % 2}")])
            assert self.found() == "new"
        return f"{2 * TURNS} builds by two generators in turns"

    def homes(self) -> str:
        """None, one that is not there, one that is a file."""
        homes = (None, "/nowhere/at/all", str(self.scene))
        for home in homes:
            self.renew()
            assert self.command("build", self.other, HOME=home) == (0, "")
            assert self.found() == "new"
            assert self.command("run", self.other, HOME=home)[0] == 0
        return f"{len(homes)} builds and runs without a good HOME"

    def umasks(self) -> str:
        """Those that forbid the user to read or write what he has made are told by what fails."""
        told = []
        for umask in UMASKS:
            self.renew()
            status, words = self.command("build", self.other, umask=umask)
            assert self.found() == ("old" if status else "new"), (oct(umask), words)
            assert status in (0, 2) and (not status or "Permission denied" in words), words
            told.append(f"{umask:03o} {'refused' if status else 'built'}")
        return "umasks " + ", ".join(told)

    def clocks(self) -> str:
        """Python knows bytecode by the date of its source."""
        for stamp in CLOCKS:
            self.renew()
            for file in (self.root / "simple_pendulum").rglob("*"):
                os.utime(file, (stamp, stamp))
            assert self.found() == "old"
            eomc.build(self.other, self.root)
            assert self.found() == "new", stamp
        return f"{len(CLOCKS)} dates of the old module"

    def pythons(self, other: str) -> str:
        """In turns, then at once: each runs the module that it has built."""
        for turn in range(2 * TURNS):
            python = (sys.executable, other)[turn % 2]
            status, words = self.command("run", self.other, python=python)
            assert status == 0, words
        both = [
            lambda python=python: self.command("run", self.other, python=python)[0] and sys.exit(1)
            for python in (sys.executable, other) * TURNS
        ]
        self.together(both)
        self.renew()
        return f"{4 * TURNS} runs by two Pythons, in turns and at once"


def _setpriv() -> bool:
    asked = ["setpriv", f"--bounding-set={RIGHTS}", "true"]
    return bool(shutil.which("setpriv")) and subprocess.run(asked, check=False).returncode == 0


def main(arguments: Sequence[str]) -> int:
    """An AssertionError where something is lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", help="another, beside which `eomc` lies")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        odd = Odd(Path(folder))
        for work in (odd.at_once, odd.generators, odd.homes, odd.umasks, odd.clocks):
            odd.renew()
            print(work(), flush=True)
        if given.python:
            print(odd.pythons(os.path.abspath(given.python)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
