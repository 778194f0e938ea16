"""A minute of tests/hostile/endurance.py, and what it would say of a leak."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from endurance import LEAST, Sample, grown, ran, sample
from forks import in_a_fork

STEADY = Sample(
    memory=100 << 20, objects=500_000, heap=30 << 20, handles=6, threads=1, children=0, files=500
)


def test_what_grows_is_told() -> None:
    warm = [replace(STEADY, memory=k << 20, files=5 * k) for k in range(50, 90)]
    assert grown([*warm, *[STEADY] * 60]) == []
    steps = {"memory": LEAST // 10, "objects": 300, "heap": 20_000, "handles": 1, "threads": 1}
    for name, step in (steps | {"children": 1, "files": 1}).items():
        leak = [replace(STEADY, **{name: getattr(STEADY, name) + k * step}) for k in range(50)]
        (words,) = grown(leak)
        assert words.startswith(f"{name}: ")


@pytest.mark.slow
def test_what_is_in_use_is_seen_and_what_is_free_is_not(tmp_path: Path) -> None:
    if not sample(tmp_path).heap:
        pytest.skip("this C library does not tell what it has given out")

    def seen() -> list[int]:
        before, kept = sample(tmp_path), [bytearray(50_000) for _ in range(400)]
        held = sample(tmp_path)
        del kept
        after = sample(tmp_path)
        return [
            getattr(now, name) - getattr(before, name)
            for now in (held, after)
            for name in ("memory", "heap")
        ]

    how, found = in_a_fork(seen, 60)
    assert how == "done" and isinstance(found, list)
    assert found[:2] == pytest.approx([20e6, 20e6], rel=0.1), found
    assert found[2:] == pytest.approx([0, 0], abs=1e6), found


@pytest.mark.slow
def test_nothing_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "cc")  # else what was compiled is kept, for other tests
    how, words = in_a_fork(lambda: grown(ran(tmp_path, 60)), 600)
    assert (how, words) == ("done", [])
