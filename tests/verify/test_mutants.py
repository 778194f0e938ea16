"""The check detects a sample of mutants of the C; `python tests/support/mutants.py` runs more."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.forks import in_a_fork
from support.mutants import tried


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "furuta_pendulum"])
def test_sample_of_mutants_is_detected(name: str, tmp_path: Path) -> None:
    """One survivor is allowed: a change of results by little more than rounding."""
    kind, value = in_a_fork(lambda: tried(name, 20, 11, tmp_path), 1200)
    assert kind == "done", value
    counts, survived = value  # type: ignore[misc]
    assert counts["killed"] >= 10
    assert len(survived) <= 1, survived
