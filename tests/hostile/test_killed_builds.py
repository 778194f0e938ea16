"""Builds killed at each rename and at some moments: old or new module, no other files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import killed_builds
import pytest
from killed_builds import ALONE, RENAMES, Killed


@pytest.mark.slow
def test_killed_build_leaves_the_old_or_the_new_module(tmp_path: Path) -> None:
    killed = Killed(tmp_path)
    words = killed.everything(RENAMES, moments=8, seed=3)
    assert killed.outcomes["old"] > 0 and sum(killed.outcomes.values()) >= 10, words


@pytest.mark.slow
def test_full_disk_leaves_the_old_module_and_no_other_files() -> None:
    """Out of bytes, and out of inodes."""
    trial = subprocess.run([*ALONE, "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True)
    if trial.returncode:
        pytest.skip(f"no file systems of one's own here: {trial.stderr.decode()}")
    command = [sys.executable, killed_builds.__file__, "--full", "4"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "'old': " in process.stdout and "'new': " in process.stdout
