"""Calls of the system that fail in builds and runs: quotas of users, full disks, damaged ones.

    python tests/hostile/failing_calls.py               each call, and all from each on
    python tests/hostile/failing_calls.py --every 8     each eighth of them

A first build is watched by strace (Linux), which lists the calls that change or read a file of the
build's folder. Each of these then fails in a build of its own, or fails with all like it that come
after, as a quota has it. The build says so or succeeds; the module that is there is the old one or
the new one, whole; nothing is left beside it, nor among temporary files; the next build makes the
new one. So with what the compilers call, and with the file that `eomc run --out` replaces.
"""

from __future__ import annotations

import argparse
import errno
import json
import mmap
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from builds import CHANGED, TEXT, gravity, leftovers, script
from killed_builds import OLD

import eomc
from eomc.cli.main import main as command
from eomc.toolchain import compiler

CHANGES = ("openat", "write", "rename", "mkdir")
QUOTA, FULL, DAMAGED = "EDQUOT", "ENOSPC", "EIO"
# an openat that fails from then on would also fail where files are only read, as no quota does
FAULTS = [(call, QUOTA, then) for call in CHANGES for then in ("", "+") if call + then != "openat+"]
FAULTS += [("rename", FULL, ""), ("mkdir", FULL, ""), ("read", DAMAGED, "")]
COMPILERS = [("write", QUOTA, "+"), ("write", FULL, ""), ("read", DAMAGED, "")]
ANY_TRACER = 0x59616D61, -1  # prctl(PR_SET_PTRACER, PR_SET_PTRACER_ANY): Yama may forbid it
ANSWER = 1 << 16  # bytes
NEVER = 65_535  # the largest that strace takes


@dataclass(frozen=True)
class Call:
    """The n-th call of that name, from 1 on."""

    name: str
    n: int


def watched(work: Callable[[], object], how: Sequence[str]) -> tuple[str, str]:
    """What `work` returns or raises, from a fork that strace watches: ("done" or "raised", words).

    No call of the system tells of it: that might fail.
    """
    answer = mmap.mmap(-1, ANSWER)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with suppress(OSError, AttributeError):
            import ctypes

            ctypes.CDLL(None).prctl(*ANY_TRACER, 0, 0, 0)
        os.read(reading, 1)  # until it is watched
        try:
            told = ["done", str(work())]
        except BaseException as fault:
            told = ["raised", f"{type(fault).__name__}: {fault}"]
        text = json.dumps(told).encode()
        answer[: len(text)] = text
        os._exit(0)
    strace = subprocess.Popen(
        ["strace", "-qq", *how, "-p", str(child)], stderr=subprocess.PIPE, text=True
    )
    status = Path(f"/proc/{child}/status")
    try:
        end = time.monotonic() + 20
        while "TracerPid:\t0\n" in status.read_text():
            if strace.poll() is not None or time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
                words = strace.stderr.read() if strace.stderr and strace.poll() else "too late"
                raise RuntimeError(f"strace can't watch here: {words}")
            time.sleep(0.001)
        os.write(writing, b"x")
    finally:
        os.waitpid(child, 0)
        strace.wait()
        os.close(reading)
        os.close(writing)
    kind, words = json.loads(answer[:].rstrip(b"\0"))
    return kind, words


def calls(log: Path, folder: Path) -> Iterator[Call]:
    """Those that change or read a file under `folder` and succeed, of a log of strace's."""
    counts: Counter[str] = Counter()
    for line in log.read_text(errors="replace").splitlines():
        found = re.match(r"(\w+)\((.*)\) = (-?\d+)", line)
        if not found:
            continue
        name, arguments, result = found.groups()
        counts[name] += 1
        only_read = name == "openat" and "O_CREAT" not in arguments
        if str(folder) in arguments and int(result) >= 0 and not only_read:
            yield Call(name, counts[name])


EMPTY_ZIP = b"PK\x05\x06" + bytes(18)


def files(folder: Path) -> list[Path]:
    """All below but bytecode and the builds of other versions that are kept."""
    found = (f for f in folder.rglob("*") if ".builds" not in f.relative_to(folder).parts)
    return [f for f in found if f.is_file() and f.suffix != ".pyc"]


class Failing:
    """A folder with a module, a scene that has changed, and builds in which calls fail."""

    def __init__(self, folder: Path) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        sys.pycache_prefix = None  # bytecode goes with the module that `renew` removes
        self.folder = folder.resolve()
        self.root, self.kept = self.folder / "build", self.folder / "kept"
        self.scene, self.log = self.folder / "simple_pendulum.toml", self.folder / "log"
        self.temporary = self.folder / "temporary"
        self.temporary.mkdir()
        os.environ["TMPDIR"] = tempfile.tempdir = str(self.temporary)
        self.outcomes: Counter[str] = Counter()
        self.scene.write_text(TEXT, encoding="utf-8")
        eomc.build(self.scene, self.kept)
        self.scene.write_text(CHANGED, encoding="utf-8")
        self.renew()
        eomc.build(self.scene, self.root)  # and all is imported

    def renew(self) -> None:
        """The old module, as it was built, and no temporary files."""
        shutil.rmtree(self.root, ignore_errors=True)
        for file in self.temporary.iterdir():
            file.unlink(missing_ok=True)
        shutil.copytree(self.kept, self.root)

    def listed(self, work: Callable[[], object], folder: Path) -> list[Call]:
        """The calls of `work` that touch a file under `folder`."""
        names = ",".join((*CHANGES, "read"))
        watched(work, ["-y", "-s", "0", "-o", str(self.log), "-e", f"trace={names}"])
        return list(calls(self.log, folder))

    def fail(
        self, work: Callable[[], object], folder: Path, call: Call, error: str, then: str
    ) -> tuple[str, str]:
        """What comes of it where that call fails, and, by "+", those of its name after it.

        ("elsewhere", words) where pipes of compilers, which are read in more or fewer parts each
        time, made it another call.
        """
        inject = f"inject={call.name}:error={error}:when={call.n}{then}"
        log = ["-y", "-s", "0", "-o", str(self.log)]
        how, words = watched(work, [*log, "-e", f"trace={call.name}", "-e", inject])
        lines = self.log.read_text(errors="replace").splitlines()
        hit = next((line for line in lines if "(INJECTED)" in line), "")
        return (how if str(folder) in hit else "elsewhere"), words

    # --- builds -------------------------------------------------------------------------------

    def build(self) -> str:
        return eomc.build(self.scene, self.root).name

    def builds(self, every: int) -> str:
        """Each call of Python's own."""
        self.renew()
        found, tried = self.listed(self.build, self.root), Counter[str]()
        for name, error, then in FAULTS:
            for call in [c for c in found if c.name == name][::every]:
                self.renew()
                how, words = self.fail(self.build, self.root, call, error, then)
                if how == "elsewhere":
                    self.outcomes[how] += 1
                    continue
                self.judge(f"{name} {call.n}{then} {error}", how, words, error)
                tried[f"{name}{then}"] += 1
        return ", ".join(f"{n} {name}" for name, n in tried.items())

    def compilers(self, most: int) -> str:
        """The n-th call of each process of a compiler, at most so many; the last does not come."""
        tried: Counter[str] = Counter()
        real = " ".join(compiler.find_compiler().command)
        for name, error, then in COMPILERS:
            for n in (*range(1, most + 1), NEVER):
                inject = f"-e trace={name} -e inject={name}:error={error}:when={n}{then}"
                text = f"""case " $* " in
                *" -c "*|*" -shared "*) exec strace -f -qq -o /dev/null {inject} {real} "$@";;
                *) exec {real} "$@";; esac"""
                self.renew()
                os.environ["CC"] = script(self.folder / "cc", text)
                try:
                    how, words = watched(self.build, ["-o", "/dev/null", "-e", "trace=none"])
                finally:
                    del os.environ["CC"]
                self.judge(f"compilers: {name} {n}{then} {error}", how, words, "")
                assert how == "done" or n < NEVER, words
                tried[f"{name}{then}"] += 1
        return ", ".join(f"{n} {name}" for name, n in tried.items())

    def judge(self, when: str, how: str, words: str, error: str) -> None:
        """Words, and the old module or the new one; mended by the next build."""
        said = os.strerror(getattr(errno, error)) if error else ""
        if how == "raised":
            assert re.match(r"(EomcError|FolderError|SceneError): ", words), (when, words)
            assert said in words, words
            if "rename" not in when or "+" not in when:  # nothing moves back where nothing moves
                self.as_before(when)
        g = gravity(self.root)
        kind = "old" if abs(g - OLD) < 1e-3 else "new" if abs(g - 2 * OLD) < 2e-3 else ""
        assert kind, f"{when}: the module was neither: g = {g}"
        assert how == "raised" or kind == "new", (when, how, kind)
        self.nothing_left(when)
        self.outcomes[f"{kind}, {how}"] += 1
        eomc.build(self.scene, self.root)
        assert abs(gravity(self.root) - 2 * OLD) < 2e-3, when

    def as_before(self, when: str) -> None:
        """Each file, with its date."""
        one, other = (
            {f.relative_to(folder): (f.read_bytes(), f.stat().st_mtime_ns) for f in files(folder)}
            for folder in (self.kept, self.root)
        )
        assert one == other, (when, [f for f in one.keys() | other if one.get(f) != other.get(f)])

    def nothing_left(self, when: str) -> None:
        libraries = list((self.root / "simple_pendulum").glob("_simple_pendulum_*"))
        left = [*leftovers(self.root), *os.listdir(self.temporary)]
        assert left == [] and len(libraries) == 1, (when, left, libraries)

    # --- runs ---------------------------------------------------------------------------------

    def run(self, out: Path) -> str:
        """`eomc run --out` of a module that is there: its status, and what it says."""
        told = StringIO()
        words = ["run", self.scene, "--build", self.root, "--duration", "0.2", "--out", out]
        with redirect_stdout(StringIO()), redirect_stderr(told):
            try:
                command.main(args=[str(w) for w in words], prog_name="eomc")
            except SystemExit as end:
                return f"{end.code or 0} {told.getvalue()}"
        return f"0 {told.getvalue()}"

    def runs(self, every: int) -> str:
        """Each call on a file of rows that was there before: the old rows, or the new ones."""
        place, tried = self.folder / "rows", Counter[str]()
        place.mkdir()
        # what is replaced is a file of the same kind: others are refused
        for suffix, old in ((".csv", b"old"), (".npz", EMPTY_ZIP)):
            out = place / f"rows{suffix}"
            self.renew()
            eomc.build(self.scene, self.root)
            self.run(out)
            whole = _content(out)
            found = self.listed(lambda out=out: self.run(out), place)
            for name, error, then in FAULTS:
                # reads are those of the check of what is replaced, whose faults end in a refusal
                for call in [c for c in found if c.name == name != "read"][::every]:
                    out.write_bytes(old)
                    before = _content(out)
                    how, words = self.fail(lambda out=out: self.run(out), place, call, error, then)
                    assert how == "done", (how, words)
                    when, now = f"{out.name} {name} {call.n}{then} {error}", _content(out)
                    fine = (words.startswith("0 ") and now == whole) or (
                        words.startswith(("1 ", "2 "))
                        and now == before
                        and os.strerror(getattr(errno, error)) in words
                        and "Traceback" not in words
                    )
                    assert fine, (when, words, now[:40])
                    assert os.listdir(place) == [out.name], (when, os.listdir(place))
                    self.nothing_left(when)
                    tried[f"{name}{then}"] += 1
            out.unlink()
        return ", ".join(f"{n} {name}" for name, n in tried.items())


def _content(file: Path) -> bytes:
    """Of an archive what it holds: it is dated."""
    data = file.read_bytes()
    if data[:2] != b"PK":
        return data
    import zipfile

    with zipfile.ZipFile(file) as archive:
        return b"".join(archive.read(name) for name in sorted(archive.namelist()))


def main(arguments: Sequence[str]) -> int:
    """An AssertionError where something was lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th call alone")
    parser.add_argument(
        "--compilers", type=int, default=12, metavar="N", help="their first N calls"
    )
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        failing = Failing(Path(folder))
        print(f"builds: {failing.builds(given.every)}: {dict(failing.outcomes)}", flush=True)
        failing.outcomes.clear()
        told = failing.compilers(given.compilers)
        print(f"compilers: {told}: {dict(failing.outcomes)}", flush=True)
        print(f"runs: {failing.runs(given.every)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
