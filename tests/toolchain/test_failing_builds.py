"""A build that fails, or is ended, leaves what was there, and says why."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from builds import FRESH, TEXT, gravity, leftovers, marks, script, started
from conftest import tiers
from instrument import in_a_fork

import eomc

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def test_a_failing_compiler_is_heard(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its own words, with the command; the old module stays, and nothing half-made."""
    before = marks(root / "simple_pendulum")
    failing = script(tmp_path / "failing", "echo 'out of cheese' >&2\nexit 3\n")
    monkeypatch.setenv("CC", failing)
    with pytest.raises(eomc.EomcError) as fault:
        eomc.build(scene, root)
    for words in ("simple_pendulum", "out of cheese", "status 3", failing, "simple_pendulum.c"):
        assert words in str(fault.value)
    assert marks(root / "simple_pendulum") == before
    assert leftovers(root) == []
    assert gravity(root) == built
    monkeypatch.delenv("CC")
    assert eomc.build(scene, root).fresh
    assert gravity(root) == 2 * built


def test_a_failing_linker_is_heard(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'case "$*" in *-shared*) echo "no such library"; exit 1;; esac\nexec cc "$@"\n'
    monkeypatch.setenv("CC", script(tmp_path / "no_linker", text))
    with pytest.raises(eomc.EomcError, match=r"(?s)-shared.*no such library"):
        eomc.build(scene, root)
    assert leftovers(root) == []
    assert gravity(root) == built


def test_no_compiler_is_left_running_after_a_failure(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both compilations are over when the error comes, whichever of them failed."""
    text = 'case "$*" in *binding.c*) exec sleep 3;; esac\necho "out of cheese"; exit 1\n'
    monkeypatch.setenv("CC", script(tmp_path / "failing", text))

    def build() -> bool:
        with pytest.raises(eomc.EomcError, match="out of cheese"):
            eomc.build(scene, root)
        try:
            os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return True
        return False

    assert in_a_fork(build, 20) == ("done", True), "a compiler is still running"


def test_a_compiler_that_is_ended_removes_its_temporary_files(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One compilation fails while the other has a file of its own, as gcc has."""
    own = tmp_path / "ccOwn.s"
    text = f"""case "$*" in *binding.c*)
        trap 'rm {own}; exit 1' TERM; touch {own}; sleep 20 & wait;; esac
    until [ -f {own} ]; do sleep 0.01; done; exit 1\n"""
    monkeypatch.setenv("CC", script(tmp_path / "failing", text))
    with pytest.raises(eomc.EomcError, match="status 1"):
        eomc.build(scene, root)
    assert not own.exists()


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Bytes and dates of the files below, by path."""
    files = (f for f in folder.rglob("*") if f.is_file() and f.suffix != ".pyc")
    return {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in files}


@pytest.mark.parametrize(
    ("fault", "links"),
    [
        (OSError(errno.EDQUOT, "no"), True),
        pytest.param(OSError(errno.EDQUOT, "no"), False, marks=pytest.mark.slow),
        pytest.param(KeyboardInterrupt(), True, marks=pytest.mark.slow),
        (KeyboardInterrupt(), False),
    ],
    ids=["full-links", "full-copies", "ctrl_c-links", "ctrl_c-copies"],
)
def test_a_build_that_cant_be_moved_leaves_all_as_it_was(
    fault: BaseException, links: bool, scene: Path, root: Path, built: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Header, C, Python's files and library, at whichever of them it fails."""
    folder, move, moved = root / "simple_pendulum", os.replace, list[str]()
    (folder / "_runtime" / "status.py").write_text("of another version", encoding="utf-8")
    (folder / "_runtime" / "inputs.py").unlink()  # which that had not yet
    before, last = contents(folder), ""

    def failing(old: Path, new: Path) -> None:
        if ".old" not in Path(old).parts:
            moved.append(str(Path(new).relative_to(folder)))
            if moved[-1] == last:
                raise fault
        move(old, new)

    def no_links(*_: Path) -> None:
        raise OSError(errno.EPERM, "not here")

    monkeypatch.setattr(os, "replace", failing)
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    for last in ("simple_pendulum.c", "_runtime/status.py", "__init__.py", "build.json"):
        with pytest.raises(eomc.EomcError if isinstance(fault, OSError) else KeyboardInterrupt):
            eomc.build(scene, root)
        assert contents(folder) == before and leftovers(root) == []
        assert moved[-1] == last and "simple_pendulum.h" in moved
    last = ""
    assert eomc.build(scene, root).fresh and leftovers(root) == []
    assert gravity(root) == 2 * built


@contextlib.contextmanager
def sleeping_compiler(folder: Path) -> Iterator[tuple[str, Path]]:
    """A compiler that sleeps, and the file where it tells its process ids.

    It tells them late: by then who has started it knows it too, and may be interrupted.
    """
    pids = folder / "pids"
    cc = script(folder / "sleeping", f"sleep 0.3\necho $$ >> {pids}\nexec sleep 60\n")
    try:
        yield cc, pids
    finally:
        for pid in pids.read_text().split() if pids.exists() else ():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)


def sleepers(pids: Path) -> list[int]:
    """Those of the compilers that are still there."""
    found = []
    for pid in map(int, pids.read_text().split()):
        with contextlib.suppress(OSError):
            if "sleep" in Path(f"/proc/{pid}/cmdline").read_text():
                found.append(pid)
    return found


def wait_for(file: Path, lines: int) -> None:
    for _ in range(500):
        if file.exists() and len(file.read_text().split()) >= lines:
            return
        time.sleep(0.02)
    raise AssertionError("the compiler was never called")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["SIGKILL", "SIGINT"])
def test_a_build_that_is_killed_leaves_the_old_module(
    scene: Path, root: Path, built: float, tmp_path: Path, how: signal.Signals
) -> None:
    """What SIGKILL leaves the next build clears away; Ctrl-C ends the compilers too.

    Even where they did not hear of it themselves.
    """
    with sleeping_compiler(tmp_path) as (cc, pids):
        process = started(scene, root, CC=cc)
        wait_for(pids, 2)
        assert process.pid is not None
        os.kill(process.pid, how)
        process.join(20)
        assert process.exitcode not in (0, None, FRESH - 1, FRESH)
        assert gravity(root) == built
        if how is signal.SIGINT:
            assert leftovers(root) == []
            for _ in range(50):
                if not sleepers(pids):
                    break
                time.sleep(0.1)
            assert sleepers(pids) == []
    if how is signal.SIGKILL:
        assert leftovers(root) != []
        assert eomc.build(scene, root).fresh
        assert leftovers(root) == []
        assert gravity(root) == 2 * built


@pytest.mark.parametrize("n", tiers([1, 2, 3], 2))
def test_ctrl_c_while_a_compiler_is_started_ends_it_too(
    n: int, scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the n-th, the linker at last, the process is there, but Popen not over."""

    class Popen(subprocess.Popen):  # type: ignore[type-arg]
        count = 0

        def __init__(self, *args: Any, **how: Any) -> None:
            super().__init__(*args, **how)
            Popen.count += 1
            if Popen.count == n:
                wait_for(pids, 2 if n == 2 else 1)
                os.kill(os.getpid(), signal.SIGINT)

    with sleeping_compiler(tmp_path) as (cc, pids):
        linker = f'case "$*" in *-shared*) exec {cc};; esac\nexec cc "$@"\n'
        monkeypatch.setenv("CC", cc if n < 3 else script(tmp_path / "linker", linker))
        monkeypatch.setattr(subprocess, "Popen", Popen)
        begun = time.monotonic()
        how, words = in_a_fork(lambda: eomc.build(scene, root).name, 20)
        assert (how, words) == ("raised", "KeyboardInterrupt: ")
        assert sleepers(pids) == [] and time.monotonic() - begun < 10
    assert leftovers(root) == [] and gravity(root) == built


def test_a_place_that_cannot_be_written(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(
        eomc.EomcError, match=r"file.*can't be written .*: choose another folder, root="
    ):
        eomc.build(scene, tmp_path / "file" / "build")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_place(scene: Path, root: Path) -> None:
    root.mkdir()
    root.chmod(0o500)
    with pytest.raises(eomc.EomcError, match=r"can't be written \(Permission denied\).*--build"):
        eomc.build(scene, root)


def test_a_faulty_scene_is_not_built(scene: Path, root: Path, found: None) -> None:
    before = marks(root / "simple_pendulum")
    scene.write_text(TEXT.replace('"m*g*y"', '"m*gg*y"'), encoding="utf-8")
    with pytest.raises(eomc.SceneError, match="'gg'"):
        eomc.build(scene, root)
    assert marks(root / "simple_pendulum") == before
