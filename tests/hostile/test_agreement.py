"""Two scenes compiled in three ways each; tests/hostile/agreement.py prints the whole table."""

from __future__ import annotations

import agreement
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_pendulum", "four_bar"])
def test_numbers_are_the_same_everywhere(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "")
    monkeypatch.setenv("EOMC_CFLAGS", "")
    status = agreement.main([name, "--brief"])
    told = capsys.readouterr().out
    assert status == 0, told
    assert told.count(" same\n") == 12
