"""Calls of C compilers in tests."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

STRICT = """-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Wshadow
-Werror""".split()


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def compiled(*command: str, cwd: Path) -> None:
    """Run a compiler, which must issue no messages."""
    process = run(*command, cwd=cwd)
    assert (process.returncode, process.stdout + process.stderr) == (0, "")


def clang(cpp: bool = False) -> list[str]:
    """Return the command of clang, or of ziglang's; skip the test if neither is installed."""
    if path := shutil.which("clang++" if cpp else "clang"):
        return [path]
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("neither clang nor ziglang is installed")
    return [sys.executable, "-m", "ziglang", "c++" if cpp else "cc"]
