"""What can be known of Windows without one: names that it lacks, locks, what is linked with."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT

from eomc.base.errors import EomcError
from eomc.toolchain import cache, extension


@pytest.mark.slow
def test_nothing_is_called_that_windows_lacks() -> None:
    """As mypy reads the standard library there: fcntl, os.O_NOFOLLOW and the like are Linux's."""
    pytest.importorskip("mypy")
    words = ["-p", "eomc", "--platform", "win32", "--cache-dir", "build/mypy-win32"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Python there, as far as a lock asks for it; the locks that were taken, (mode, bytes)."""
    taken: list[tuple[int, int]] = []

    def locking(_: int, mode: int, count: int) -> None:
        taken.append((mode, count))
        if len(taken) == 1:  # ten seconds have gone by
            raise OSError(errno.EDEADLK, "Resource deadlock avoided")

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_LOCK=1))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "fcntl", None)  # type: ignore[arg-type]
    monkeypatch.setattr(sys, "platform", "win32")
    there = ("open", "close", "fstat", "O_RDWR", "O_CREAT")
    monkeypatch.setattr(cache, "os", SimpleNamespace(**{name: getattr(os, name) for name in there}))
    return taken


def test_a_lock_of_windows_is_waited_for(windows: list[tuple[int, int]], tmp_path: Path) -> None:
    with cache.hold_lock(tmp_path / "a.lock"):
        assert windows == [(1, 1), (1, 1)]
    assert (tmp_path / "a.lock").read_bytes() == b""
    (tmp_path / "folder").mkdir()
    with pytest.raises(EomcError, match="remove it"), cache.hold_lock(tmp_path / "folder"):
        pass


def test_a_lock_that_can_not_be_taken_is_an_error(
    windows: list[tuple[int, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: int) -> None:
        raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(sys.modules["msvcrt"], "locking", refused)
    with pytest.raises(OSError, match="denied"), cache.hold_lock(tmp_path / "a.lock"):
        pass


def test_extensions_of_windows_are_linked_with_pythons_library() -> None:
    version = f"{sys.version_info[0]}{sys.version_info[1]}"
    own = Path(extension.python_library(f"_x.cp{version}-win_amd64.pyd"))
    assert own.parts[-2:] == ("libs", f"python{version}.lib")
    assert Path(extension.python_library("_x.pyd")).name == "python3.lib"
