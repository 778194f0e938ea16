"""Compilers as processes: started in a folder, awaited, their words in an error where they fail."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from eomc.base.errors import EomcError


def run(name: str, folder: Path, *commands: Sequence[str]) -> None:
    """Compilers at work side by side, until all are done; none goes on where one fails.

    Raises EomcError with the words of the first that fails, or where one can't be run. name: the
    scene's.
    """
    running: list[subprocess.Popen[str]] = []
    try:
        for command in commands:
            with _undisturbed():
                running.append(_start(command, folder))
        for command, process in zip(commands, running, strict=True):
            _finish(name, command, process)
    finally:
        for process in running:
            _end(process)


def lay_out(files: Mapping[str, str], folder: Path) -> None:
    """Texts by name into a folder; the name of a scene's file in them may be no text."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8", errors="backslashreplace")


def try_out(
    name: str, command: Sequence[str], code: str, arguments: Sequence[str], remedy: str
) -> None:
    """Python code that loads what `command` has made, in a process of its own (some 10 ms).

    Raises EomcError with the remedy where it fails, or ends that process.
    """
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code, *arguments],
        stdin=subprocess.DEVNULL, capture_output=True, errors="backslashreplace",
    )  # fmt: skip
    if done.returncode:
        said = [f"status {done.returncode}", *done.stderr.strip().splitlines()][-1]
        raise EomcError(
            f"{name}: the C compiler {shlex.join(command)} returned 0, but what it made can't be "
            f"loaded: correct CC and EOMC_CFLAGS{remedy}\n  {said}"
        )


@contextmanager
def _undisturbed() -> Iterator[None]:
    """What Ctrl-C raises comes behind it: within Popen it would lose the process just begun.

    It is raised in the main thread alone, where there is a handler of Python's.
    """
    before, came = signal.getsignal(signal.SIGINT), list[tuple[int, FrameType | None]]()
    try:
        if callable(before):
            signal.signal(signal.SIGINT, lambda number, frame: came.append((number, frame)))
    except ValueError:  # another thread
        before = None
    try:
        yield
    finally:
        if callable(before):
            signal.signal(signal.SIGINT, before)
            for number, frame in came[:1]:
                before(number, frame)


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """A compiler at work. Raises EomcError where it can't be run."""
    try:
        return subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
    except OSError as fault:
        raise EomcError(f"{command[0]}: can't be run ({fault.strerror})") from None


def _finish(name: str, command: Sequence[str], process: subprocess.Popen[str]) -> None:
    """Wait for it. Raises EomcError with its words where it fails."""
    words, _ = process.communicate()
    if process.returncode:
        raise EomcError(
            f"{name}: the C compiler failed (status {process.returncode}):\n"
            f"  {shlex.join(command)}\n{words.rstrip()}"
        )


def _end(process: subprocess.Popen[str]) -> None:
    """End a compiler that may be at work, in time for it to remove its temporary files."""
    process.terminate()
    try:
        process.wait(1)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
