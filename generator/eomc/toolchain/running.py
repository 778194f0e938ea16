"""Compilers as processes: started in a folder, awaited, their words in an error where they fail."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Sequence
from pathlib import Path

from eomc.base.errors import EomcError


def start(command: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """A compiler at work. Raises EomcError where it can't be run."""
    try:
        return subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
    except OSError as fault:
        raise EomcError(f"{command[0]}: can't be run ({fault.strerror})") from None


def finish(name: str, command: Sequence[str], process: subprocess.Popen[str]) -> None:
    """Wait for it. Raises EomcError with its words where it fails. name: the scene's."""
    words, _ = process.communicate()
    if process.returncode:
        raise EomcError(
            f"{name}: the C compiler failed (status {process.returncode}):\n"
            f"  {shlex.join(command)}\n{words.rstrip()}"
        )


def end(process: subprocess.Popen[str]) -> None:
    """End a compiler that may be at work, in time for it to remove its temporary files."""
    process.terminate()
    try:
        process.wait(1)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def run(name: str, command: Sequence[str], folder: Path) -> None:
    """Start it, and wait for it. Raises EomcError as they do."""
    finish(name, command, start(command, folder))
