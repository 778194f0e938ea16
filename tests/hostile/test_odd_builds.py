"""Concurrent builds, builds without HOME, with unusual umasks, dates and generators."""

from __future__ import annotations

from pathlib import Path

import pytest
from odd_builds import UnusualBuilds


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UnusualBuilds:
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    monkeypatch.delenv("CC", raising=False)
    return UnusualBuilds(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["at_once", "generators", "homes", "umasks", "clocks"])
def test_unusual_environments_lose_no_data(what: str, odd: UnusualBuilds) -> None:
    assert getattr(odd, what)()
