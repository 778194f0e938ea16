"""Readers of text are fuzzed for some seconds each; `make fuzz` continues without end."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("target", ["formula", "read", "scene", "urdf", "mjcf", "command"])
def test_readers_accept_or_refuse_with_a_message(target: str) -> None:
    """Any other exception, ten seconds for one input or a gigabyte is a finding: status 1."""
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed")
    command = [sys.executable, str(HERE / "readers.py"), target, "--seconds", "20"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr[-4000:] + ran.stdout
    count = int(ran.stdout.split(f"{target}: ")[1].split()[0])
    assert count > 500, ran.stdout
