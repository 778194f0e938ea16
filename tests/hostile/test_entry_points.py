"""Random bytes as arguments of every function of some headers, with sanitizers.

`python tests/hostile/entry_points.py --seconds 600` runs longer.
"""

from __future__ import annotations

import re
from pathlib import Path

import entry_points
import pytest
from entry_points import VARIANTS, Driver, run_driver
from support.session import needs

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("form", ["plain", "fast"])
@pytest.mark.parametrize("name", VARIANTS)
def test_no_argument_causes_errors(name: str, form: str, tmp_path: Path) -> None:
    needs("gcc")
    good, words = run_driver(name, form, 3, 1, tmp_path)
    assert good, words[-4000:]
    assert "CALLS" in words


FAULTS = {
    "an element too far": ("D[1] = ", "D[4] = "),
    "a result where there is none": ("BOUNCER_NOT_FINITE;", "BOUNCER_OK;"),
}


@pytest.mark.parametrize("what", FAULTS)
def test_errors_are_detected(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("gcc")
    right, wrong = FAULTS[what]
    plain = entry_points.eomc.sources

    def broken(*args: str) -> object:
        sources = plain(*args)
        assert right in sources.files["bouncer.c"]
        sources.files["bouncer.c"] = sources.files["bouncer.c"].replace(right, wrong)
        return sources

    monkeypatch.setattr(entry_points.eomc, "sources", broken)
    good, words = run_driver("bouncer", "plain", 5, 1, tmp_path)
    assert not good
    assert "heap-buffer-overflow" in words or "BROKEN PROMISE" in words, words[-2000:]


def test_every_function_of_a_header_is_called(tmp_path: Path) -> None:
    entry_points.built("bouncer", "plain", tmp_path)
    header = (tmp_path / "bouncer.h").read_text(encoding="utf-8")
    driver = Driver("bouncer", header)
    bare = re.sub(r"/\*.*?\*/|typedef [^{};]*;", "", header, flags=re.S)
    assert len(driver.functions) == bare.count(");") >= 30
    assert all(f"{f.name}(a_" in driver.text() for f in driver.functions)
