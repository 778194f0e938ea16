"""Test for Windows without Windows: missing names, locks and linked libraries."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.session import ROOT

from eomc.base.errors import EomcError
from eomc.toolchain import cache, extension


@pytest.mark.slow
def test_no_name_missing_on_windows_is_used() -> None:
    """mypy knows the names that Windows lacks, such as fcntl and os.O_NOFOLLOW."""
    pytest.importorskip("mypy")
    words = ["-p", "eomc", "--platform", "win32", "--cache-dir", "build/mypy-win32"]
    process = subprocess.run(
        [sys.executable, "-m", "mypy", *words], cwd=ROOT, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Replace the functions of a lock by those of Windows; return the calls (mode, bytes)."""
    calls: list[tuple[int, int]] = []

    def locking(_: int, mode: int, count: int) -> None:
        calls.append((mode, count))
        if len(calls) == 1:  # ten seconds have passed
            raise OSError(errno.EDEADLK, "Resource deadlock avoided")

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_LOCK=1))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "fcntl", None)  # type: ignore[arg-type]
    monkeypatch.setattr(sys, "platform", "win32")
    names = ("open", "close", "fstat", "O_RDWR", "O_CREAT")
    monkeypatch.setattr(cache, "os", SimpleNamespace(**{name: getattr(os, name) for name in names}))
    return calls


def test_windows_lock_is_waited_for(windows: list[tuple[int, int]], tmp_path: Path) -> None:
    with cache.hold_lock(tmp_path / "a.lock"):
        assert windows == [(1, 1), (1, 1)]
    assert (tmp_path / "a.lock").read_bytes() == b""
    (tmp_path / "folder").mkdir()
    with pytest.raises(EomcError, match="remove it"), cache.hold_lock(tmp_path / "folder"):
        pass


def test_unavailable_lock_raises_an_error(
    windows: list[tuple[int, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_os_error(*_: int) -> None:
        raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(sys.modules["msvcrt"], "locking", raise_os_error)
    with pytest.raises(OSError, match="denied"), cache.hold_lock(tmp_path / "a.lock"):
        pass


def test_windows_extensions_are_linked_with_the_python_library() -> None:
    version = f"{sys.version_info[0]}{sys.version_info[1]}"
    own = Path(extension.python_library(f"_x.cp{version}-win_amd64.pyd"))
    assert own.parts[-2:] == ("libs", f"python{version}.lib")
    assert Path(extension.python_library("_x.pyd")).name == "python3.lib"
