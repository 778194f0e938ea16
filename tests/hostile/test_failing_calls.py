"""Some calls of builds, compilers and runs fail: words, old module or new, nothing behind."""

from __future__ import annotations

import subprocess
import sys

import failing_calls
import pytest
from conftest import needs


@pytest.mark.slow
def test_a_call_that_fails_loses_nothing() -> None:
    strace = needs("strace")
    trial = subprocess.run([strace, "-o", "/dev/null", "true"], capture_output=True, text=True)
    if trial.returncode:
        pytest.skip(f"strace can't watch here: {trial.stderr}")
    command = [sys.executable, failing_calls.__file__, "--every", "16", "--compilers", "2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "'old, raised': " in done.stdout and "'new, done': " in done.stdout
    assert done.stdout.count("\n") == 3
