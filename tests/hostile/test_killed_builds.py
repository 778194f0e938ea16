"""Builds killed at each rename and at some moments: old module or new one, and nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from killed_builds import RENAMES, Killed


@pytest.mark.slow
def test_a_killed_build_leaves_the_old_module_or_the_new(tmp_path: Path) -> None:
    killed = Killed(tmp_path)
    words = killed.everything(RENAMES, moments=8, seed=3)
    assert killed.outcomes["old"] > 0 and sum(killed.outcomes.values()) >= 10, words
