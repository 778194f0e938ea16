"""Some system calls of builds, compilers and runs fail: message, old or new module, no other
files.
"""

from __future__ import annotations

import subprocess
import sys

import failing_calls
import pytest
from support.session import needs


@pytest.mark.slow
def test_failing_call_loses_no_data() -> None:
    strace = needs("strace")
    trial = subprocess.run([strace, "-o", "/dev/null", "true"], capture_output=True, text=True)
    if trial.returncode:
        pytest.skip(f"strace can't watch here: {trial.stderr}")
    command = [sys.executable, failing_calls.__file__, "--every", "16", "--compilers", "2"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "'old, raised': " in process.stdout and "'new, done': " in process.stdout
    assert process.stdout.count("\n") == 3
