"""Obstacles to a build, damaged builds and false compilers are reported, and no file is lost."""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.builds import gravity, leftovers, script
from support.forks import in_a_fork

import eomc
from eomc.toolchain import cache

pytestmark = pytest.mark.usefixtures("quickly_compiled")

# --- the lock -------------------------------------------------------------------------------------


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raise TimeoutError after some seconds, even out of a blocking system call."""

    def raise_timeout(*_: Any) -> None:
        raise TimeoutError(f"after {seconds} s")

    before = signal.signal(signal.SIGALRM, raise_timeout)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("what", ["link", "dangling link", "FIFO", "folder", "device", "socket"])
def test_lock_must_be_a_regular_file(
    what: str, scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A FIFO opened for writing would block until another process reads it."""
    root.mkdir()
    lock, precious = root / ".simple_pendulum.lock", tmp_path / "precious"
    precious.write_text("my thesis", encoding="utf-8")
    match what:
        case "link":
            lock.symlink_to(precious)
        case "dangling link":
            lock.symlink_to(tmp_path / "nowhere")
        case "FIFO":
            os.mkfifo(lock)
        case "folder":
            lock.mkdir()
        case "socket":
            import socket

            with socket.socket(socket.AF_UNIX) as unix_socket:
                monkeypatch.chdir(root)  # the path of a socket must be short
                unix_socket.bind(lock.name)
        case "device":
            try:
                os.mknod(lock, stat.S_IFCHR | 0o600, os.makedev(1, 3))
            except PermissionError:
                pytest.skip("only root makes devices")
    with at_most(20), pytest.raises(eomc.EomcError) as error:
        eomc.build(scene, root)
    words = str(error.value)
    assert words.startswith(f"{lock}: is no file, and builds") and "remove it" in words
    assert precious.read_text(encoding="utf-8") == "my thesis"
    assert not (tmp_path / "nowhere").exists() and not (root / "simple_pendulum").exists()


def test_lock_file_is_not_truncated(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root.mkdir()
    lock = root / ".simple_pendulum.lock"
    lock.write_text("a hard link to something", encoding="utf-8")
    monkeypatch.setenv("CC", "false")  # called while the build has the lock
    with pytest.raises(eomc.EomcError, match="the C compiler failed"):
        eomc.build(scene, root)
    assert lock.read_text(encoding="utf-8") == "a hard link to something"


# --- what lies there ------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["file", "dangling link", "link to a file"])
def test_other_file_in_place_of_the_module_is_reported(what: str, scene: Path, root: Path) -> None:
    root.mkdir()
    if what == "file":
        (root / "simple_pendulum").write_text("mine", encoding="utf-8")
    else:
        target = root / "target"
        if what == "link to a file":
            target.write_text("mine", encoding="utf-8")
        (root / "simple_pendulum").symlink_to(target)
    with pytest.raises(eomc.EomcError, match=r"simple_pendulum: is in the way .*--build DIR"):
        eomc.build(scene, root)
    if what != "dangling link":
        assert (root / "simple_pendulum").read_text(encoding="utf-8") == "mine"


def test_foreign_package_is_not_replaced(scene: Path, root: Path) -> None:
    folder = root / "simple_pendulum"
    (folder / "_runtime").mkdir(parents=True)
    for file in ("__init__.py", "build.json"):  # a build has files of both names
        (folder / file).write_text("mine = 1", encoding="utf-8")
    with pytest.raises(eomc.EomcError, match="a package that eomc did not build"):
        eomc.build(scene, root)
    assert sorted(f.name for f in folder.iterdir()) == ["__init__.py", "_runtime", "build.json"]
    assert (folder / "__init__.py").read_text(encoding="utf-8") == "mine = 1"


def test_every_bit_of_a_build_is_verified(scene: Path, root: Path, existing_build: None) -> None:
    """A damaged extension of the right size would terminate the process that loads it."""
    folder = root / "simple_pendulum"
    files = [f for f in sorted(folder.rglob("*.*")) if f.suffix not in (".json", ".pyc")]
    assert {".so", ".py", ".c", ".h"} <= {f.suffix for f in files}
    assert {folder / "simple_pendulum.h", folder / "fast" / "simple_pendulum.h"} <= set(files)
    for file in files:
        original = file.read_bytes()
        for at in (0, len(original) // 2, len(original) - 1):
            damaged = bytearray(original)
            damaged[at] ^= 4
            file.write_bytes(bytes(damaged))
            assert not cache.is_built(folder, _key(folder)), file
        file.write_bytes(b"")
        assert not cache.is_built(folder, _key(folder)), file
        file.unlink()
        assert not cache.is_built(folder, _key(folder)), file
        file.write_bytes(original)
    assert cache.is_built(folder, _key(folder))
    assert not eomc.build(scene, root).fresh
    library = next(folder.glob("_simple_pendulum_*"))
    library.write_bytes(library.read_bytes()[:-1] + b"!")
    assert eomc.build(scene, root).fresh
    assert gravity(root) == pytest.approx(8.2548, abs=1e-3)


def _key(folder: Path) -> str:
    import json

    key: str = json.loads((folder / "build.json").read_text(encoding="utf-8"))["key"]
    return key


# --- compilers ------------------------------------------------------------------------------------

RUBBISH = {
    "text": 'echo rubbish > "$out"',
    "nothing": ":",
    "an empty file": ': > "$out"',
    "a program": 'case "$*" in *-shared*) printf "int main(void){return 0;}" > m.c; '
    'cc m.c -o "$out";; *) cc "$@";; esac',
    "half a library": 'cc "$@"; case "$*" in *-shared*) head -c 9000 "$out" > h; '
    'cp h "$out";; esac',
    "another library": 'case "$*" in *-shared*) printf "int f;" > m.c; '
    'cc -shared -fPIC m.c -o "$out";; *) cc "$@";; esac',
    "one that crashes": 'case "$*" in *-shared*) printf "__attribute__((constructor)) void f(void)'
    '{*(volatile int *)0 = 0;}" > m.c; cc -fPIC -c m.c; cc "$@" m.o;; *) cc "$@";; esac',
}


@pytest.mark.slow
@pytest.mark.parametrize("what", RUBBISH)
def test_compiler_with_invalid_output_is_reported(
    what: str, scene: Path, root: Path, built: float, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """It returns 0; its library is tested before it replaces the old module."""
    out = 'out=; for w in "$@"; do [ "$last" = -o ] && out="$w"; last="$w"; done\n'
    cc = script(tmp_path / "odd", out + RUBBISH[what] + "\nexit 0\n")
    monkeypatch.setenv("CC", cc)
    words = rf"{re.escape(cc)} returned 0, but what it made can't be loaded: correct CC"
    with pytest.raises(eomc.EomcError, match=words):
        eomc.load(scene, root)
    assert leftovers(root) == []
    assert gravity(root) == built
    monkeypatch.delenv("CC")
    assert eomc.build(scene, root).fresh
    assert gravity(root) == 2 * built


def test_compiler_messages_need_not_be_utf8(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "latin", "printf 'err\\351 \\377'; exit 1\n"))
    with pytest.raises(eomc.EomcError, match=r"(?s)C compiler failed \(status 1\).*err\\xe9 \\xff"):
        eomc.build(scene, root)


@pytest.mark.parametrize("variable", ["CC", "EOMC_CFLAGS"])
@pytest.mark.parametrize("value", ["gcc '-O1", 'gcc "-O1', "gcc -O1\\"])
def test_unbalanced_quote_in_a_variable_is_reported(
    variable: str, value: str, scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(eomc.EomcError, match=rf"^{variable}=.*: no .*: close it, or unset"):
        eomc.build(scene, root)


@pytest.mark.parametrize("value", ["{root}", "{root}/scene.toml", "  ", "\udcff"])
def test_program_that_is_no_compiler_is_reported(
    value: str, scene: Path, tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", value.format(root=tmp_path))
    with pytest.raises(eomc.EomcError, match="is not there: correct or unset CC"):
        eomc.build(scene, root)


def test_flags_that_are_not_utf8_are_accepted(
    scene: Path, root: Path, existing_build: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The build with other flags replaces the one without, once."""
    monkeypatch.setenv("EOMC_CFLAGS", "-O0 -DX=\udcff")
    assert eomc.build(scene, root).fresh
    assert not eomc.build(scene, root).fresh
    assert len(list((root / "simple_pendulum").glob("_simple_pendulum_*"))) == 1


def test_failed_rename_by_cffi_is_reported_with_its_cause(
    scene: Path, root: Path, built: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """cffi then removes a file that does not exist, which fails too."""

    def failing_rename(old: str, new: str) -> None:
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), old, None, new)

    monkeypatch.setenv("CC", "cc")  # otherwise the cached compilation is used
    monkeypatch.setattr(os, "rename", failing_rename)
    with pytest.raises(eomc.EomcError, match=r"binding\.c.*can't be written \(Disk quota exceeded"):
        eomc.build(scene, root)
    assert leftovers(root) == [] and gravity(root) == built


def test_full_device_leaves_the_old_module(scene: Path, root: Path, built: float) -> None:
    """`ulimit -f` simulates the full device."""

    def build() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
        eomc.build(scene, root)

    how, words = in_a_fork(build, 20)
    assert how == "raised" and "can't be written (File too large)" in str(words)
    assert leftovers(root) == [] and gravity(root) == built
