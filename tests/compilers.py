"""C compilers as tests call them."""

from __future__ import annotations

import subprocess
from pathlib import Path

STRICT = """-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Wshadow
-Werror""".split()


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def compiled(*command: str, cwd: Path) -> None:
    """Without a word from the compiler."""
    done = run(*command, cwd=cwd)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
