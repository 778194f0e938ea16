"""Builds killed at each rename and at some moments: old module or new one, and nothing behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import killed_builds
import pytest
from killed_builds import ALONE, RENAMES, Killed


@pytest.mark.slow
def test_a_killed_build_leaves_the_old_module_or_the_new(tmp_path: Path) -> None:
    killed = Killed(tmp_path)
    words = killed.everything(RENAMES, moments=8, seed=3)
    assert killed.outcomes["old"] > 0 and sum(killed.outcomes.values()) >= 10, words


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_module_and_nothing_else() -> None:
    """Out of bytes, and out of files."""
    trial = subprocess.run([*ALONE, "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True)
    if trial.returncode:
        pytest.skip(f"no file systems of one's own here: {trial.stderr.decode()}")
    command = [sys.executable, killed_builds.__file__, "--full", "4"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "'old': " in done.stdout and "'new': " in done.stdout
