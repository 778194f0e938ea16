"""Builds as tests of the toolchain make them: a pendulum to change, a folder, shell scripts."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from cases import SCENES

import eomc

TEXT = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")
CHANGED = TEXT.replace('"m*g*y"', '"2*m*g*y"')


@pytest.fixture
def quickly_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Builds take no time of the compiler's that they need not."""
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    monkeypatch.delenv("CC", raising=False)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene file that a test may change."""
    file = tmp_path / "simple_pendulum.toml"
    file.write_text(TEXT, encoding="utf-8")
    return file


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "build"


@pytest.fixture
def built(scene: Path, root: Path) -> float:
    """A good build; its gravity. The scene is then changed, so that another build is due."""
    eomc.build(scene, root)
    before = gravity(root)
    scene.write_text(CHANGED, encoding="utf-8")
    return before


def script(file: Path, text: str) -> str:
    """An executable shell script; its path."""
    file.write_text("#!/bin/sh\n" + text, encoding="utf-8")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return str(file)


def gravity(root: Path) -> float:
    """g(1 rad) of the module that lies there, as a new process imports it."""
    done = subprocess.run(
        [sys.executable, "-c", "import simple_pendulum as m; print(m.g([1.0])[0])"],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


def leftovers(root: Path) -> list[str]:
    """Whatever stands beside the module and its lock."""
    expected = {"simple_pendulum", ".simple_pendulum.lock"}
    return sorted(f.name for f in root.iterdir() if f.name not in expected)
