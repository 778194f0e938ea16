"""Builds at once, without HOME, by odd umasks, dates, generators; by another Python a command."""

from __future__ import annotations

from pathlib import Path

import pytest
from odd_builds import Odd


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Odd:
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    monkeypatch.delenv("CC", raising=False)
    return Odd(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["at_once", "generators", "homes", "umasks", "clocks"])
def test_odd_surroundings_lose_nothing(what: str, odd: Odd) -> None:
    assert getattr(odd, what)()
