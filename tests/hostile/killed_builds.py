"""Builds that are killed, at each change of a file and at random moments, and builds on full disks.

    python tests/hostile/killed_builds.py                  at every change, then at 100 moments
    python tests/hostile/killed_builds.py --moments 1000
    python tests/hostile/killed_builds.py --full 40        on disks with decreasing space

A valid module exists, and its scene has changed. After each kill the module must be the old or the
new one, complete; the next build makes the new one, and the next build that compiles removes all
other files. A disk may be out of bytes or of inodes; the build reports it and leaves no files. The
disk is in memory, mounted in its own namespace (unshare, Linux).
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.builds import CHANGED, TEXT, gravity, leftovers
from support.forks import in_a_fork

import eomc

RENAMES = {"os.rename"}
CHANGES = RENAMES | {
    "os.remove",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.chmod",
    "open",
}
WRITES = os.O_WRONLY | os.O_RDWR
ALONE = ["unshare", "--map-root-user", "--mount"]
OLD = 8.2548  # its g at 1 rad


class Killed:
    """A folder with a module, and builds in forked processes that are killed."""

    def __init__(self, folder: Path) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        self.scene, self.root = folder / "simple_pendulum.toml", folder / "build"
        self.outcomes: Counter[str] = Counter()

    def renew(self) -> None:
        """Restore the old module and a scene that has changed."""
        if self.root.exists() and leftovers(self.root):
            time.sleep(1)  # compilers of a killed build continue to write
        self.scene.write_text(TEXT, encoding="utf-8")
        eomc.build(self.scene, self.root)
        assert leftovers(self.root) == [], leftovers(self.root)
        self.scene.write_text(CHANGED, encoding="utf-8")

    def at_change(self, n: int, kinds: set[str]) -> bool:
        """Kill a build just before its n-th change of a file; return True if there was one."""
        self.renew()

        def build() -> None:
            count = 0

            def audit(event: str, args: tuple[Any, ...]) -> None:
                nonlocal count
                if event not in kinds or (event == "open" and not (args[2] or 0) & WRITES):
                    return
                count += 1
                if count == n:
                    os.kill(os.getpid(), signal.SIGKILL)

            sys.addaudithook(audit)
            eomc.build(self.scene, self.root)

        how, _ = in_a_fork(build, 60)
        if how == "done":
            return False
        assert how == "killed", how
        self.judge(f"change {n}")
        return True

    def at_moment(self, seconds: float) -> None:
        """Kill a build after some seconds, unless it has ended."""
        self.renew()
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)
            eomc.build(self.scene, self.root)
            os._exit(0)
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        self.judge(f"{seconds:.3f} s")

    def on_full_disks(self, steps: int) -> str:
        """Build with decreasing space, then with fewer inodes; return a summary."""
        self.root.mkdir(exist_ok=True)
        self._mount("size=64m,nr_inodes=4096")
        for step in range(steps):
            for kind in ("size", "nr_inodes"):
                self.renew()
                now = os.statvfs(self.root)
                used = {"size": (now.f_blocks - now.f_bfree) * now.f_frsize,
                        "nr_inodes": now.f_files - now.f_ffree}[kind]  # fmt: skip
                limit = f"{kind}={int(used * (1 + 2.5 * step / steps)) + 1}"
                self._mount(f"remount,{limit}")
                how, words = in_a_fork(lambda: eomc.build(self.scene, self.root).name, 60)
                assert how == "done" or "No space left on device" in str(words), (limit, words)
                assert leftovers(self.root) == [], (limit, leftovers(self.root))
                self._mount("remount,size=64m,nr_inodes=4096")
                before = self.outcomes["new"]
                self.judge(limit)
                assert (self.outcomes["new"] > before) == (how == "done"), (limit, words)
        return f"{steps} sizes and {steps} numbers of files: {dict(self.outcomes)}"

    def _mount(self, options: str) -> None:
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", self.root], check=True)

    def judge(self, when: str) -> None:
        """Check that the module is the old or the new one, and that the next build makes the new
        one.
        """
        value = gravity(self.root)
        kind = "old" if abs(value - OLD) < 1e-3 else "new" if abs(value - 2 * OLD) < 2e-3 else ""
        assert kind, f"at {when} the module was neither: g = {value}"
        self.outcomes[kind] += 1
        eomc.build(self.scene, self.root)
        assert abs(gravity(self.root) - 2 * OLD) < 2e-3, when

    def everything(self, kinds: set[str], moments: int, seed: int) -> str:
        """Run all tests; return a summary."""
        changes = 0
        while self.at_change(changes + 1, kinds):
            changes += 1
        began = time.perf_counter()
        self.renew()
        eomc.build(self.scene, self.root)
        whole = (time.perf_counter() - began) / 2
        draw = random.Random(seed)
        for _ in range(moments):
            self.at_moment(draw.uniform(0, 1.1 * whole))
        summary = ", ".join(f"{n} {what}" for what, n in self.outcomes.most_common())
        return f"killed at {changes} changes of files and {moments} moments: {summary}"


def main(arguments: Sequence[str]) -> int:
    """Run all; raise AssertionError if data is lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--moments", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--full", type=int, metavar="N", help="so many sizes of full disks")
    parser.add_argument("--renames", action="store_true", help="at renames alone, not each change")
    options = parser.parse_args(arguments)
    if options.full and "EOMC_ALONE" not in os.environ:
        own = [sys.executable, __file__, *arguments]
        return subprocess.run([*ALONE, *own], env=os.environ | {"EOMC_ALONE": "1"}).returncode
    with tempfile.TemporaryDirectory() as folder:
        if options.full:
            killed = Killed(Path(folder))
            try:
                print(killed.on_full_disks(options.full))
            finally:
                subprocess.run(["umount", killed.root], check=True)
            return 0
        kinds = RENAMES if options.renames else CHANGES
        print(Killed(Path(folder)).everything(kinds, options.moments, options.seed))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
