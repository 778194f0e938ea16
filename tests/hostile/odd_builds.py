"""Builds in unusual environments: concurrent, no HOME, umasks, clocks, two generators, two Pythons.

    python tests/hostile/odd_builds.py
    python tests/hostile/odd_builds.py --python PATH    another Python that has eomc, too

Each build succeeds or reports the reason; the module is an old or a new one, complete, and no other
files remain. Clocks date the existing module. Commands run without root's permission to override
file modes if setpriv (Linux) can drop it.
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

from killed_builds import OLD
from support.builds import CHANGED, TEXT, gravity, leftovers

import eomc
from eomc.toolchain import cache

AT_ONCE, TURNS = 20, 4
UMASKS = (0o000, 0o022, 0o077, 0o277, 0o777)
# Before 1970 west of UTC; beyond 31 and 32 bits; the year 2400.
CLOCKS = (0, 1, 2**31, 2**32 + 10, 13_569_465_600)
RIGHTS = "-dac_override,-dac_read_search"


class UnusualBuilds:
    """A folder with a module, its scene, and a different scene of the same name."""

    def __init__(self, folder: Path) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        self.folder, self.root = folder, folder / "build"
        self.scene, self.other = (folder / f / "simple_pendulum.toml" for f in ("one", "other"))
        for file, text in ((self.scene, TEXT), (self.other, CHANGED)):
            file.parent.mkdir()
            file.write_text(text, encoding="utf-8")
        self.renew()

    def renew(self) -> None:
        """Build the first scene."""
        eomc.build(self.scene, self.root)
        assert self.module_kind() == "old"

    def module_kind(self) -> str:
        """Return whose module exists; no other files may remain."""
        g = gravity(self.root)
        kind = "old" if abs(g - OLD) < 1e-3 else "new" if abs(g - 2 * OLD) < 2e-3 else ""
        libraries = list((self.root / "simple_pendulum").glob("_simple_pendulum_*"))
        assert kind and leftovers(self.root) == [] and len(libraries) == 1, (g, libraries)
        return kind

    def run_concurrently(self, works: Sequence[Callable[[], object]]) -> None:
        """Run all at the same time, in processes; none may fail."""
        running = [get_context("fork").Process(target=work) for work in works]
        for process in running:
            process.start()
        for process in running:
            process.join(120)
        assert [p.exitcode for p in running] == [0] * len(running)

    def build(self, scene: Path, generator: str = "") -> None:
        """Build, with another version of the generator if one is named."""
        if generator:
            cache.generator_digest = lambda: generator  # type: ignore[assignment]
        eomc.build(scene, self.root)

    def command(
        self, *words: object, python: str = sys.executable, umask: int = -1, **variables: str | None
    ) -> tuple[int, str]:
        """Run `eomc`; return its status and output. variables: of the environment, None removes
        one.
        """
        environment = {**os.environ, **variables}
        rights = ["setpriv", f"--bounding-set={RIGHTS}"] if _setpriv() else []
        process = subprocess.run(
            [*rights, Path(python).parent / "eomc", *map(str, words), "--build", self.root],
            env={k: v for k, v in environment.items() if v is not None}, umask=umask,
            cwd=self.folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120,
        )  # fmt: skip
        assert "Traceback" not in process.stderr, process.stderr
        return process.returncode, process.stderr

    # --- unusual environments -----------------------------------------------------------------

    def at_once(self) -> str:
        """Build one scene in many processes; then two scenes of one name with two generators."""
        self.run_concurrently([lambda: self.build(self.other)] * AT_ONCE)
        assert self.module_kind() == "new"
        works = [
            lambda k=k: self.build((self.scene, self.other)[k % 2], f"version {k % 4 // 2}")
            for k in range(AT_ONCE)
        ]
        self.run_concurrently(works)
        self.module_kind()
        return f"{AT_ONCE} builds of one scene, {AT_ONCE} of two by two generators"

    def generators(self) -> str:
        """Alternate between generators."""
        for turn in range(2 * TURNS):
            self.run_concurrently([lambda turn=turn: self.build(self.other, f"version {turn % 2}")])
            assert self.module_kind() == "new"
        return f"{2 * TURNS} builds by two generators in turns"

    def homes(self) -> str:
        """No HOME, a missing one, and one that is a file."""
        homes = (None, "/nowhere/at/all", str(self.scene))
        for home in homes:
            self.renew()
            assert self.command("build", self.other, HOME=home) == (0, "")
            assert self.module_kind() == "new"
            assert self.command("run", self.other, HOME=home)[0] == 0
        return f"{len(homes)} builds and runs without a good HOME"

    def umasks(self) -> str:
        """Umasks that make the user's own files unreadable or unwritable lead to an error
        message.
        """
        messages = []
        for umask in UMASKS:
            self.renew()
            status, words = self.command("build", self.other, umask=umask)
            assert self.module_kind() == ("old" if status else "new"), (oct(umask), words)
            assert status in (0, 2) and (not status or "Permission denied" in words), words
            messages.append(f"{umask:03o} {'refused' if status else 'built'}")
        return "umasks " + ", ".join(messages)

    def clocks(self) -> str:
        """Python recognises stale bytecode by the date of its source."""
        for stamp in CLOCKS:
            self.renew()
            for file in (self.root / "simple_pendulum").rglob("*"):
                os.utime(file, (stamp, stamp))
            assert self.module_kind() == "old"
            eomc.build(self.other, self.root)
            assert self.module_kind() == "new", stamp
        return f"{len(CLOCKS)} dates of the old module"

    def pythons(self, other: str) -> str:
        """Alternate, then run at the same time: each Python runs the module that it has built."""
        for turn in range(2 * TURNS):
            python = (sys.executable, other)[turn % 2]
            status, words = self.command("run", self.other, python=python)
            assert status == 0, words
        both = [
            lambda python=python: self.command("run", self.other, python=python)[0] and sys.exit(1)
            for python in (sys.executable, other) * TURNS
        ]
        self.run_concurrently(both)
        self.renew()
        return f"{4 * TURNS} runs by two Pythons, in turns and at once"


def _setpriv() -> bool:
    command = ["setpriv", f"--bounding-set={RIGHTS}", "true"]
    return bool(shutil.which("setpriv")) and subprocess.run(command, check=False).returncode == 0


def main(arguments: Sequence[str]) -> int:
    """Run all; raise AssertionError if data is lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", help="another, beside which `eomc` lies")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        odd = UnusualBuilds(Path(folder))
        for work in (odd.at_once, odd.generators, odd.homes, odd.umasks, odd.clocks):
            odd.renew()
            print(work(), flush=True)
        if options.python:
            print(odd.pythons(os.path.abspath(options.python)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
