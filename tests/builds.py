"""Builds as tests of the toolchain make them: a pendulum to change, a folder, shell scripts."""

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
from cases import SCENES
from instrument import in_a_fork

import eomc
from eomc import pipeline

if TYPE_CHECKING:
    from eomc.emit.render import Sources
    from eomc.model.system import System

KEPT = SCENES.parent / "build" / "tests" / "kept"  # builds to be copied, from run to run
TEXT = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")
FRESH = 10  # what a process that builds returns, and one less where it was there already
CHANGED = TEXT.replace('"m*g*y"', '"2*m*g*y"')


@pytest.fixture(scope="module")
def unoptimised_file() -> Iterator[None]:
    """`quickly_compiled` for a whole file of tests, with what its own fixtures build."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        patch.delenv("CC", raising=False)
        yield


@pytest.fixture
def quickly_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """For modules that few tests use: optimising them would take longer than running them.

    Not for scenes of other files in MODULES, which would be built in turns with other flags.
    """
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    monkeypatch.delenv("CC", raising=False)


_made: dict[tuple[str, str, str], Sources] = {}


def _sources_once(system: System, extension: str, **how: Any) -> Sources:
    """The files of a pendulum: what tests of builds change is where they go, and its text."""
    key = (system.digest, Path(system.file).name, extension)
    if key not in _made:
        _made[key] = eomc.sources(system, extension, **how)
    return _made[key]


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene file that a test may change; of one text `eomc.build` derives the C once."""
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
        folder = eomc.build(SCENES / "simple_pendulum.toml", KEPT).folder
    return folder, gravity(KEPT)


@pytest.fixture
def found(root: Path, pendulum: tuple[Path, float]) -> None:
    """A good build of the scene is there already."""
    shutil.copytree(pendulum[0], root / "simple_pendulum")


@pytest.fixture
def built(scene: Path, found: None, pendulum: tuple[Path, float]) -> float:
    """A good build; its gravity. The scene is then changed, so that another build is due."""
    scene.write_text(CHANGED, encoding="utf-8")
    return pendulum[1]


def script(file: Path, text: str) -> str:
    """An executable shell script; its path."""
    file.write_text("#!/bin/sh\n" + text, encoding="utf-8")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return str(file)


def gravity(root: Path) -> float:
    """g(1 rad) of the module that lies there, as a process imports it that had none."""

    def ask() -> float:
        sys.path.insert(0, str(root))
        for name in [m for m in sys.modules if m.split(".")[0] == "simple_pendulum"]:
            del sys.modules[name]
        importlib.invalidate_caches()  # listed by the parent, in the same tick of the clock
        return float(importlib.import_module("simple_pendulum").g([1.0])[0])

    how, value = in_a_fork(ask, 20)
    assert how == "done" and isinstance(value, float), value
    return value


def leftovers(root: Path) -> list[str]:
    """Whatever stands beside the module and its lock."""
    expected = {"simple_pendulum", ".simple_pendulum.lock"}
    return sorted(f.name for f in root.iterdir() if f.name not in expected)


def started(scene: Path, root: Path, **environment: str) -> ForkProcess:
    """A process that builds, and has SymPy already."""

    def build() -> None:
        os.environ.update(environment)
        sys.exit(FRESH - 1 + eomc.build(scene, root).fresh)

    process = get_context("fork").Process(target=build)
    process.start()
    return process


def marks(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What tells whether a file was touched, by name."""
    return {
        f.name: (f.stat().st_ino, f.stat().st_mtime_ns, f.stat().st_size)
        for f in folder.iterdir()
        if f.name != "__pycache__"
    }
