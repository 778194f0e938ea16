"""A failed or interrupted build leaves the previous module and reports the reason."""

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
from support.builds import FRESH, TEXT, file_states, gravity, leftovers, script, start_build
from support.forks import in_a_fork
from support.session import tiers

import eomc

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def test_message_of_a_failing_compiler_is_printed(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the command; the old module remains, and no incomplete file."""
    before = file_states(root / "simple_pendulum")
    failing_compiler = script(tmp_path / "failing", "echo 'out of cheese' >&2\nexit 3\n")
    monkeypatch.setenv("CC", failing_compiler)
    with pytest.raises(eomc.EomcError) as error:
        eomc.build(scene, root)
    for words in (
        "simple_pendulum",
        "out of cheese",
        "status 3",
        failing_compiler,
        "simple_pendulum.c",
    ):
        assert words in str(error.value)
    assert file_states(root / "simple_pendulum") == before
    assert leftovers(root) == []
    assert gravity(root) == built
    monkeypatch.delenv("CC")
    assert eomc.build(scene, root).fresh
    assert gravity(root) == 2 * built


def test_message_of_a_failing_linker_is_printed(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'case "$*" in *-shared*) echo "no such library"; exit 1;; esac\nexec cc "$@"\n'
    monkeypatch.setenv("CC", script(tmp_path / "no_linker", text))
    with pytest.raises(eomc.EomcError, match=r"(?s)-shared.*no such library"):
        eomc.build(scene, root)
    assert leftovers(root) == []
    assert gravity(root) == built


def test_no_compiler_runs_after_a_failure(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both compilations have ended when the error is raised, whichever of them failed."""
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


def test_terminated_compiler_removes_its_temporary_files(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One compilation fails while the other has a temporary file, as gcc has."""
    own = tmp_path / "ccOwn.s"
    text = f"""case "$*" in *binding.c*)
        trap 'rm {own}; exit 1' TERM; touch {own}; sleep 20 & wait;; esac
    until [ -f {own} ]; do sleep 0.01; done; exit 1\n"""
    monkeypatch.setenv("CC", script(tmp_path / "failing", text))
    with pytest.raises(eomc.EomcError, match="status 1"):
        eomc.build(scene, root)
    assert not own.exists()


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Return contents and dates of the files below a folder, by path."""
    files = (f for f in folder.rglob("*") if f.is_file() and f.suffix != ".pyc")
    return {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in files}


@pytest.mark.parametrize(
    ("error", "links"),
    [
        (OSError(errno.EDQUOT, "no"), True),
        pytest.param(OSError(errno.EDQUOT, "no"), False, marks=pytest.mark.slow),
        pytest.param(KeyboardInterrupt(), True, marks=pytest.mark.slow),
        (KeyboardInterrupt(), False),
    ],
    ids=["full-links", "full-copies", "ctrl_c-links", "ctrl_c-copies"],
)
def test_build_that_cannot_be_moved_leaves_all_files_unchanged(
    error: BaseException, links: bool, scene: Path, root: Path, built: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Header, C, Python's files and library are unchanged, whichever of them the move fails at."""
    folder, move, moved_files = root / "simple_pendulum", os.replace, list[str]()
    (folder / "_runtime" / "status.py").write_text("of another version", encoding="utf-8")
    (folder / "_runtime" / "statics.py").unlink()  # the previous build had no such file
    before, last = contents(folder), ""

    def failing_replace(old: Path, new: Path) -> None:
        if ".old" not in Path(old).parts:
            moved_files.append(str(Path(new).relative_to(folder)))
            if moved_files[-1] == last:
                raise error
        move(old, new)

    def no_links(*_: Path) -> None:
        raise OSError(errno.EPERM, "not here")

    monkeypatch.setattr(os, "replace", failing_replace)
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    for last in ("simple_pendulum.c", "_runtime/status.py", "__init__.py", "build.json"):
        with pytest.raises(eomc.EomcError if isinstance(error, OSError) else KeyboardInterrupt):
            eomc.build(scene, root)
        assert contents(folder) == before and leftovers(root) == []
        assert moved_files[-1] == last and "simple_pendulum.h" in moved_files
    last = ""
    assert eomc.build(scene, root).fresh and leftovers(root) == []
    assert gravity(root) == 2 * built


@contextlib.contextmanager
def sleeping_compiler(folder: Path) -> Iterator[tuple[str, Path]]:
    """Write a compiler that sleeps, and the file with its process ids.

    It writes them after a delay, when the process that started it knows them and may be
    interrupted.
    """
    pids = folder / "pids"
    cc = script(folder / "sleeping", f"sleep 0.3\necho $$ >> {pids}\nexec sleep 60\n")
    try:
        yield cc, pids
    finally:
        for pid in pids.read_text().split() if pids.exists() else ():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)


def running_compilers(pids: Path) -> list[int]:
    """Return the ids of compilers that still run."""
    running = []
    for pid in map(int, pids.read_text().split()):
        with contextlib.suppress(OSError):
            if "sleep" in Path(f"/proc/{pid}/cmdline").read_text():
                running.append(pid)
    return running


def wait_for(file: Path, lines: int) -> None:
    for _ in range(500):
        if file.exists() and len(file.read_text().split()) >= lines:
            return
        time.sleep(0.02)
    raise AssertionError("the compiler was never called")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["SIGKILL", "SIGINT"])
def test_killed_build_leaves_the_old_module(
    scene: Path, root: Path, built: float, tmp_path: Path, how: signal.Signals
) -> None:
    """The next build removes the files left by SIGKILL; Ctrl-C terminates the compilers as well.

    This holds even if the signal did not reach the compilers.
    """
    with sleeping_compiler(tmp_path) as (cc, pids):
        process = start_build(scene, root, CC=cc)
        wait_for(pids, 2)
        assert process.pid is not None
        os.kill(process.pid, how)
        process.join(20)
        assert process.exitcode not in (0, None, FRESH - 1, FRESH)
        assert gravity(root) == built
        if how is signal.SIGINT:
            assert leftovers(root) == []
            for _ in range(50):
                if not running_compilers(pids):
                    break
                time.sleep(0.1)
            assert running_compilers(pids) == []
    if how is signal.SIGKILL:
        assert leftovers(root) != []
        assert eomc.build(scene, root).fresh
        assert leftovers(root) == []
        assert gravity(root) == 2 * built


@pytest.mark.parametrize("n", tiers([1, 2, 3], 2))
def test_ctrl_c_during_the_start_of_a_compiler_terminates_it(
    n: int, scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The n-th process, at last the linker, has started, but Popen has not returned."""

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
        start = time.monotonic()
        how, words = in_a_fork(lambda: eomc.build(scene, root).name, 20)
        assert (how, words) == ("raised", "KeyboardInterrupt: ")
        assert running_compilers(pids) == [] and time.monotonic() - start < 10
    assert leftovers(root) == [] and gravity(root) == built


def test_unwritable_root_is_reported(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(
        eomc.EomcError, match=r"file.*can't be written .*: choose another folder, root="
    ):
        eomc.build(scene, tmp_path / "file" / "build")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_root_is_reported(scene: Path, root: Path) -> None:
    root.mkdir()
    root.chmod(0o500)
    with pytest.raises(eomc.EomcError, match=r"can't be written \(Permission denied\).*--build"):
        eomc.build(scene, root)


def test_invalid_scene_is_not_built(scene: Path, root: Path, existing_build: None) -> None:
    before = file_states(root / "simple_pendulum")
    scene.write_text(TEXT.replace('"m*g*y"', '"m*gg*y"'), encoding="utf-8")
    with pytest.raises(eomc.SceneError, match="'gg'"):
        eomc.build(scene, root)
    assert file_states(root / "simple_pendulum") == before
