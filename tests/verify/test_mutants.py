"""A sample of mutants of the C is noticed by the check; `python tests/mutants.py` has more."""

from __future__ import annotations

from pathlib import Path

import pytest
from changes import Mutant, of_c
from instrument import in_a_fork
from mutants import tried

SOURCE = """/* a + b */
int f(double a, double b);
#ifdef __GNUC__
#define F 1.0 + 2
#else
int g(int a)
{
    return a + 1;
}
#endif

int f(double a, double b)
{
    /* a * b */
    if (a <= b)
        return 0.5*a - x[1];
}
"""


def test_mutants_are_of_code_alone() -> None:
    found = {(SOURCE[m.at : m.end], m.new) for m in of_c(SOURCE)}
    assert found == {
        (" <= ", " > "), (" <= ", " < "), ("0.5", "0.75"), ("*", " + "), ("*", "/"),
        (" - ", " + "), ("1", "0"),
    }  # fmt: skip
    assert Mutant(0, 2, "x").of("abc") == "xc"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "furuta_pendulum"])
def test_a_sample_is_noticed(name: str, tmp_path: Path) -> None:
    """One survivor may be: what moves results by little more than rounding."""
    kind, value = in_a_fork(lambda: tried(name, 20, 11, tmp_path), 1200)
    assert kind == "done", value
    counts, survived = value  # type: ignore[misc]
    assert counts["killed"] >= 10
    assert len(survived) <= 1, survived
