"""Half a minute of tests/hostile/endurance.py, and its detection of leaks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from endurance import LEAST, Sample, growth_messages, run_rounds, sample
from support.forks import in_a_fork

STEADY = Sample(
    memory=100 << 20, objects=500_000, heap=30 << 20, handles=6, threads=1, children=0, files=500
)


def test_growth_is_reported() -> None:
    warm = [replace(STEADY, memory=k << 20, files=5 * k) for k in range(50, 90)]
    assert growth_messages([*warm, *[STEADY] * 60]) == []
    steps = {"memory": LEAST // 10, "objects": 300, "heap": 20_000, "handles": 1, "threads": 1}
    for name, step in (steps | {"children": 1, "files": 1}).items():
        leak = [replace(STEADY, **{name: getattr(STEADY, name) + k * step}) for k in range(50)]
        (words,) = growth_messages(leak)
        assert words.startswith(f"{name}: ")


@pytest.mark.slow
def test_memory_in_use_is_measured_without_free_memory(tmp_path: Path) -> None:
    if not sample(tmp_path).heap:
        pytest.skip("this C library does not tell what it has given out")

    def measure() -> list[int]:
        before, blocks = sample(tmp_path), [bytearray(50_000) for _ in range(400)]
        in_use = sample(tmp_path)
        del blocks
        after = sample(tmp_path)
        return [
            getattr(now, name) - getattr(before, name)
            for now in (in_use, after)
            for name in ("memory", "heap")
        ]

    how, differences = in_a_fork(measure, 60)
    assert how == "done" and isinstance(differences, list)
    assert differences[:2] == pytest.approx([20e6, 20e6], rel=0.1), differences
    assert differences[2:] == pytest.approx([0, 0], abs=1e6), differences


@pytest.mark.slow
def test_nothing_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "cc")  # otherwise compiled files would be stored for other tests
    how, words = in_a_fork(lambda: growth_messages(run_rounds(tmp_path, 30)), 600)
    assert (how, words) == ("done", [])
