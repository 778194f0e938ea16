"""A sample of mutants of the C is noticed by the check; `python tests/mutants.py` has more."""

from __future__ import annotations

from pathlib import Path

import pytest
from instrument import in_a_fork
from mutants import tried


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "furuta_pendulum"])
def test_a_sample_is_noticed(name: str, tmp_path: Path) -> None:
    """One survivor may be: what moves results by little more than rounding."""
    kind, value = in_a_fork(lambda: tried(name, 20, 11, tmp_path), 1200)
    assert kind == "done", value
    counts, survived = value  # type: ignore[misc]
    assert counts["killed"] >= 10
    assert len(survived) <= 1, survived
