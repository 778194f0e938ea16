"""Two scenes compiled in three ways each, and for another machine if its compiler and QEMU are
installed; tests/hostile/agreement.py prints the whole table.
"""

from __future__ import annotations

import agreement
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_pendulum", "four_bar"])
def test_results_agree_across_compilers_and_machines(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "")
    monkeypatch.setenv("EOMC_CFLAGS", "")
    status = agreement.main([name, "--brief"])
    output = capsys.readouterr().out
    assert status == 0, output
    others = len(list(agreement.cross_compiler_variants())[1:2])
    assert output.count(" same\n") == 4 * (3 + others)
