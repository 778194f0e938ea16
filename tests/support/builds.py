"""Builds in tests of the toolchain: a pendulum to change, a build folder, shell scripts."""

from __future__ import annotations

import importlib
import os
import shutil
import stat
import sys
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import eomc
from eomc import pipeline
from support.cases import SCENES
from support.forks import in_a_fork

if TYPE_CHECKING:
    from eomc.emit.render import Sources
    from eomc.model.system import System

# builds that tests copy, reused in later sessions
REUSED_BUILDS = SCENES.parent / "build" / "tests" / "kept"
TEXT = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")
FRESH = 10  # exit status of a process that builds; one less if the build exists already
CHANGED = TEXT.replace('"m*g*y"', '"2*m*g*y"')


@pytest.fixture(scope="module")
def unoptimised_file() -> Iterator[None]:
    """`quickly_compiled` for all tests and fixtures of a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        patch.delenv("CC", raising=False)
        yield


@pytest.fixture
def quickly_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile without optimisation modules that few tests use, because it would take longer.

    Not for scenes of other files in MODULES, which would be built alternately with different flags.
    """
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    monkeypatch.delenv("CC", raising=False)


_sources: dict[tuple[str, str, str], Sources] = {}


def _sources_once(system: System, extension: str, **how: Any) -> Sources:
    """Return the files of a pendulum, derived once for each text and extension."""
    key = (system.digest, Path(system.file).name, extension)
    if key not in _sources:
        _sources[key] = eomc.sources(system, extension, **how)
    return _sources[key]


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene file that a test may change; `eomc.build` derives each text once."""
    monkeypatch.setattr(pipeline, "sources", _sources_once)
    file = tmp_path / "simple_pendulum.toml"
    file.write_text(TEXT, encoding="utf-8")
    return file


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "build"


@pytest.fixture(scope="session")
def pendulum() -> tuple[Path, float]:
    """The folder of the scene's module, to be copied, and the module's gravity."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        patch.delenv("CC", raising=False)
        folder = eomc.build(SCENES / "simple_pendulum.toml", REUSED_BUILDS).folder
    return folder, gravity(REUSED_BUILDS)


@pytest.fixture
def existing_build(root: Path, pendulum: tuple[Path, float]) -> None:
    """A valid build of the scene exists."""
    shutil.copytree(pendulum[0], root / "simple_pendulum")


@pytest.fixture
def built(scene: Path, existing_build: None, pendulum: tuple[Path, float]) -> float:
    """A valid build and its gravity. The scene has changed since, so that a new build is needed."""
    scene.write_text(CHANGED, encoding="utf-8")
    return pendulum[1]


def script(file: Path, text: str) -> str:
    """Write an executable shell script; return its path."""
    file.write_text("#!/bin/sh\n" + text, encoding="utf-8")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return str(file)


def gravity(root: Path) -> float:
    """Return g(1 rad) of the module in the folder, imported by a new process."""

    def ask() -> float:
        sys.path.insert(0, str(root))
        for name in [m for m in sys.modules if m.split(".")[0] == "simple_pendulum"]:
            del sys.modules[name]
        importlib.invalidate_caches()  # the parent has listed it within the same tick of the clock
        return float(importlib.import_module("simple_pendulum").g([1.0])[0])

    how, value = in_a_fork(ask, 20)
    assert how == "done" and isinstance(value, float), value
    return value


def leftovers(root: Path) -> list[str]:
    """Return the files besides the module and its lock."""
    expected = {"simple_pendulum", ".simple_pendulum.lock"}
    return sorted(f.name for f in root.iterdir() if f.name not in expected)


def start_build(scene: Path, root: Path, **environment: str) -> ForkProcess:
    """Start a process that builds; SymPy is imported already."""

    def build() -> None:
        os.environ.update(environment)
        sys.exit(FRESH - 1 + eomc.build(scene, root).fresh)

    process = get_context("fork").Process(target=build)
    process.start()
    return process


def file_states(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return inode, modification time and size of each file by name, which show whether it
    changed.
    """
    return {
        f.name: (f.stat().st_ino, f.stat().st_mtime_ns, f.stat().st_size)
        for f in folder.iterdir()
        if f.name != "__pycache__"
    }
