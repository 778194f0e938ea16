"""Run compilers as subprocesses, and report their messages if they fail."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from eomc.base.errors import EomcError


def run(name: str, folder: Path, *commands: Sequence[str]) -> None:
    """Run commands in parallel in `folder`, and wait until all have ended.

    If one command fails, or the user presses Ctrl-C, the others are terminated. name: the scene's
    name, for messages. commands: the words of each command. Raises EomcError with the output of the
    first command that fails, or if a command can't be started.
    """
    running: list[subprocess.Popen[str]] = []
    try:
        for command in commands:
            with _delayed_interrupt():
                running.append(_start(command, folder))
        for command, process in zip(commands, running, strict=True):
            _finish(name, command, process)
    finally:
        for process in running:
            _terminate(process)


def try_load(
    name: str, command: Sequence[str], code: str, arguments: Sequence[str], remedy: str
) -> None:
    """Test in a separate process that a compiled library can be loaded; this takes some 10 ms.

    Parameters
    ----------
    name
        The scene's name, for messages.
    command
        The compiler's command, for messages.
    code, arguments
        Python code that loads the library, and the command-line arguments of this code.
    remedy
        Text at the end of the error message, which says what the user can do.

    Raises
    ------
    EomcError
        If the code fails or crashes.
    """
    completed = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code, *arguments],
        stdin=subprocess.DEVNULL, capture_output=True, errors="backslashreplace",
    )  # fmt: skip
    if completed.returncode:
        last_line = [f"status {completed.returncode}", *completed.stderr.strip().splitlines()][-1]
        raise EomcError(
            f"{name}: the C compiler {shlex.join(command)} returned 0, but what it made can't be "
            f"loaded: correct CC and EOMC_CFLAGS{remedy}\n  {last_line}"
        )


@contextmanager
def _delayed_interrupt() -> Iterator[None]:
    """Delay KeyboardInterrupt until the block has ended, so that a started process is not lost.

    This applies to the main thread only, and only if Python handles the signal.
    """
    handler, pending = signal.getsignal(signal.SIGINT), list[tuple[int, FrameType | None]]()
    try:
        if callable(handler):
            signal.signal(signal.SIGINT, lambda number, frame: pending.append((number, frame)))
    except ValueError:  # another thread
        handler = None
    try:
        yield
    finally:
        if callable(handler):
            signal.signal(signal.SIGINT, handler)
            for number, frame in pending[:1]:
                handler(number, frame)


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """Start a compiler. Raises EomcError if it can't be started."""
    try:
        return subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
    except OSError as fault:
        raise EomcError(f"{command[0]}: can't be run ({fault.strerror})") from None


def _finish(name: str, command: Sequence[str], process: subprocess.Popen[str]) -> None:
    """Wait for a compiler. Raises EomcError with its output if it fails."""
    words, _ = process.communicate()
    if process.returncode:
        raise EomcError(
            f"{name}: the C compiler failed (status {process.returncode}):\n"
            f"  {shlex.join(command)}\n{words.rstrip()}"
        )


def _terminate(process: subprocess.Popen[str]) -> None:
    """Terminate a compiler that may still run, and give it time to remove its temporary files."""
    process.terminate()
    try:
        process.wait(1)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
