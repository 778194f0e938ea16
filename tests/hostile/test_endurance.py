"""A minute of tests/hostile/endurance.py, and what it would say of a leak."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from endurance import LEAST, Sample, grown, ran
from forks import in_a_fork

STEADY = Sample(memory=100 << 20, handles=6, threads=1, children=0, files=500)


def test_what_grows_is_told() -> None:
    warm = [replace(STEADY, memory=k << 20, files=5 * k) for k in range(50, 90)]
    assert grown([*warm, *[STEADY] * 60]) == []
    for name, step in (("memory", LEAST // 10), ("handles", 1), ("threads", 1), ("files", 1)):
        leak = [replace(STEADY, **{name: getattr(STEADY, name) + k * step}) for k in range(50)]
        (words,) = grown(leak)
        assert words.startswith(f"{name}: ")


@pytest.mark.slow
def test_nothing_grows(tmp_path: Path) -> None:
    how, words = in_a_fork(lambda: grown(ran(tmp_path, 60)), 600)
    assert (how, words) == ("done", [])
