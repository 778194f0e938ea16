"""Two scenes compiled in three ways each, and for another machine where its compiler and QEMU are
installed; tests/hostile/agreement.py prints the whole table."""

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
    others = len(list(agreement.elsewhere())[1:2])
    assert told.count(" same\n") == 4 * (3 + others)
