"""System calls that fail in builds and runs: user quotas, full disks, damaged disks.

    python tests/hostile/failing_calls.py               each call, and all calls from each on
    python tests/hostile/failing_calls.py --every 8     every eighth of them

strace (Linux) lists the calls of a first build that change or read a file of the build's folder.
Each of these then fails in a build of its own, alone or with all later calls of its kind, as with a
quota. The build must report the error or succeed; the module that exists afterwards is the old or
the new one, complete; no other or temporary files remain; the next build makes the new one. The
same holds for calls of the compilers, and for the file that `eomc run --out` replaces.
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

from killed_builds import OLD
from support.builds import CHANGED, TEXT, gravity, leftovers, script

import eomc
from eomc.cli.main import main as command
from eomc.toolchain import compiler

CHANGES = ("openat", "write", "rename", "mkdir")
QUOTA, FULL, DAMAGED = "EDQUOT", "ENOSPC", "EIO"
# If every later openat failed, reading would fail too, unlike with a quota.
FAULTS = [(call, QUOTA, then) for call in CHANGES for then in ("", "+") if call + then != "openat+"]
FAULTS += [("rename", FULL, ""), ("mkdir", FULL, ""), ("read", DAMAGED, "")]
COMPILERS = [("write", QUOTA, "+"), ("write", FULL, ""), ("read", DAMAGED, "")]
# prctl(PR_SET_PTRACER, PR_SET_PTRACER_ANY), because Yama may forbid tracing
ANY_TRACER = 0x59616D61, -1
ANSWER = 1 << 16  # bytes
NEVER = 65_535  # the largest number that strace accepts


@dataclass(frozen=True)
class Call:
    """The n-th call of that name, counted from 1."""

    name: str
    n: int


def run_traced(work: Callable[[], object], how: Sequence[str]) -> tuple[str, str]:
    """Return ("done" or "raised", text) of `work`, run in a forked process under strace.

    The result is passed through shared memory, because system calls might fail.
    """
    answer = mmap.mmap(-1, ANSWER)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with suppress(OSError, AttributeError):
            import ctypes

            ctypes.CDLL(None).prctl(*ANY_TRACER, 0, 0, 0)
        os.read(reading, 1)  # until strace is attached
        try:
            result = ["done", str(work())]
        except BaseException as fault:
            result = ["raised", f"{type(fault).__name__}: {fault}"]
        text = json.dumps(result).encode()
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
    """Yield successful calls that change or read a file under `folder`, from a log of strace."""
    counts: Counter[str] = Counter()
    for line in log.read_text(errors="replace").splitlines():
        match = re.match(r"(\w+)\((.*)\) = (-?\d+)", line)
        if not match:
            continue
        name, arguments, result = match.groups()
        counts[name] += 1
        only_read = name == "openat" and "O_CREAT" not in arguments
        if str(folder) in arguments and int(result) >= 0 and not only_read:
            yield Call(name, counts[name])


EMPTY_ZIP = b"PK\x05\x06" + bytes(18)


def files(folder: Path) -> list[Path]:
    """Return all files below but bytecode and stored builds of other versions."""
    paths = (f for f in folder.rglob("*") if ".builds" not in f.relative_to(folder).parts)
    return [f for f in paths if f.is_file() and f.suffix != ".pyc"]


class Failing:
    """A folder with a module, a scene that has changed, and builds in which calls fail."""

    def __init__(self, folder: Path) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        sys.pycache_prefix = None  # bytecode is removed by `renew` with the module
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
        eomc.build(self.scene, self.root)  # and imports everything

    def renew(self) -> None:
        """Restore the old module as it was built, and remove temporary files."""
        shutil.rmtree(self.root, ignore_errors=True)
        for file in self.temporary.iterdir():
            file.unlink(missing_ok=True)
        shutil.copytree(self.kept, self.root)

    def list_calls(self, work: Callable[[], object], folder: Path) -> list[Call]:
        """Return the calls of `work` that touch a file under `folder`."""
        names = ",".join((*CHANGES, "read"))
        run_traced(work, ["-y", "-s", "0", "-o", str(self.log), "-e", f"trace={names}"])
        return list(calls(self.log, folder))

    def fail(
        self, work: Callable[[], object], folder: Path, call: Call, error: str, then: str
    ) -> tuple[str, str]:
        """Run `work` with that call failing and, if `then` is "+", all later ones of its name.

        The result is ("elsewhere", text) if it became another call, because pipes of compilers are
        read in a varying number of parts.
        """
        inject = f"inject={call.name}:error={error}:when={call.n}{then}"
        log = ["-y", "-s", "0", "-o", str(self.log)]
        how, words = run_traced(work, [*log, "-e", f"trace={call.name}", "-e", inject])
        lines = self.log.read_text(errors="replace").splitlines()
        hit = next((line for line in lines if "(INJECTED)" in line), "")
        return (how if str(folder) in hit else "elsewhere"), words

    # --- builds -------------------------------------------------------------------------------

    def build(self) -> str:
        return eomc.build(self.scene, self.root).name

    def builds(self, every: int) -> str:
        """Let each call of the build itself fail."""
        self.renew()
        build_calls, tried = self.list_calls(self.build, self.root), Counter[str]()
        for name, error, then in FAULTS:
            for call in [c for c in build_calls if c.name == name][::every]:
                self.renew()
                how, words = self.fail(self.build, self.root, call, error, then)
                if how == "elsewhere":
                    self.outcomes[how] += 1
                    continue
                self.judge(f"{name} {call.n}{then} {error}", how, words, error)
                tried[f"{name}{then}"] += 1
        return ", ".join(f"{n} {name}" for name, n in tried.items())

    def compilers(self, most: int) -> str:
        """Let the n-th call of each process of a compiler fail, for at most so many n."""
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
                    how, words = run_traced(self.build, ["-o", "/dev/null", "-e", "trace=none"])
                finally:
                    del os.environ["CC"]
                self.judge(f"compilers: {name} {n}{then} {error}", how, words, "")
                assert how == "done" or n < NEVER, words
                tried[f"{name}{then}"] += 1
        return ", ".join(f"{n} {name}" for name, n in tried.items())

    def judge(self, when: str, how: str, words: str, error: str) -> None:
        """Check the message, that the module is the old or the new one, and that the next build
        repairs it.
        """
        message = os.strerror(getattr(errno, error)) if error else ""
        if how == "raised":
            assert re.match(r"(EomcError|FolderError|SceneError): ", words), (when, words)
            assert message in words, words
            # Without renaming, the old module is not restored.
            if "rename" not in when or "+" not in when:
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
        """Check that each file is as before, including its date."""
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
        """Run `eomc run --out` with an existing module; return its status and error output."""
        stderr = StringIO()
        words = ["run", self.scene, "--build", self.root, "--duration", "0.2", "--out", out]
        with redirect_stdout(StringIO()), redirect_stderr(stderr):
            try:
                command.main(args=[str(w) for w in words], prog_name="eomc")
            except SystemExit as end:
                return f"{end.code or 0} {stderr.getvalue()}"
        return f"0 {stderr.getvalue()}"

    def runs(self, every: int) -> str:
        """Let each call on an existing file of results fail: it must contain the old or the new
        ones.
        """
        place, tried = self.folder / "rows", Counter[str]()
        place.mkdir()
        # The replaced file has the same format: others are refused.
        for suffix, old in ((".csv", b"old"), (".npz", EMPTY_ZIP)):
            out = place / f"rows{suffix}"
            self.renew()
            eomc.build(self.scene, self.root)
            self.run(out)
            whole = _content(out)
            run_calls = self.list_calls(lambda out=out: self.run(out), place)
            for name, error, then in FAULTS:
                # Reads belong to the check of the replaced file, whose errors end in a refusal.
                for call in [c for c in run_calls if c.name == name != "read"][::every]:
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
    """Return the content; of an archive its members, because archives contain dates."""
    data = file.read_bytes()
    if data[:2] != b"PK":
        return data
    import zipfile

    with zipfile.ZipFile(file) as archive:
        return b"".join(archive.read(name) for name in sorted(archive.namelist()))


def main(arguments: Sequence[str]) -> int:
    """Run all; raise AssertionError if data is lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th call alone")
    parser.add_argument(
        "--compilers", type=int, default=12, metavar="N", help="their first N calls"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        failing = Failing(Path(folder))
        print(f"builds: {failing.builds(options.every)}: {dict(failing.outcomes)}", flush=True)
        failing.outcomes.clear()
        count = failing.compilers(options.compilers)
        print(f"compilers: {count}: {dict(failing.outcomes)}", flush=True)
        print(f"runs: {failing.runs(options.every)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
