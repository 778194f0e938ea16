"""Random calls of modules from Python, some hostile; `python tests/hostile/calls.py` makes more."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

CALLS = Path(__file__).parent / "calls.py"


def run_calls(*words: str) -> str:
    ran = subprocess.run(
        [sys.executable, str(CALLS), *words], capture_output=True, text=True, timeout=280
    )
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-4000:]
    return ran.stdout


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "8"])
def test_calls_return_or_raise_with_a_message(threads: str) -> None:
    """One in a few hundred has 10**12 steps, and receives Ctrl-C."""
    words = run_calls("--count", "12000", "--threads", threads, "--seed", "5")
    assert "12000 calls" in words and " 0 finds" in words
    counts = {what: int(n) for n, what in re.findall(r"(\d+) ([\w ]+)[,;]", words)}
    assert counts["result"] > 5000 and counts["ValueError"] > 2000
    if threads == "1":
        assert counts["interrupted"] > 0 and counts["in a fork"] > 0


@pytest.mark.slow
def test_other_exceptions_are_findings(tmp_path: Path) -> None:
    """Use a module that raises an unexpected exception."""
    code = (
        f"import sys; sys.path.insert(0, {str(CALLS.parent)!r})\n"
        "import calls\n"
        "def broken(*args, **how): raise IndexError('list index out of range')\n"
        "plain = calls.module\n"
        "def module(name):\n"
        "    made = plain(name)\n"
        "    type(made).__setattr__ = object.__setattr__\n"
        "    made.__dict__['energy'] = broken\n"
        "    return made\n"
        "calls.module = module\n"
        "sys.exit(calls.main(['arm', '--count', '300']))\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert "IndexError: list index out of range" in ran.stdout and "1 finds" in ran.stdout
