"""What the command prints: cleaned text, progress, and what happens where it can't be written."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

import click

from eomc.base import texts

if TYPE_CHECKING:
    from eomc.base.errors import Problem


class Group(click.Group):
    """Commands whose output may be closed, full, or of fewer letters than are printed."""

    def main(self, *args: Any, **how: Any) -> Any:
        """As click has it; status 2 where output can't be written, after `| head` status 1."""
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None:  # closed by the caller
                setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - kept
            elif hasattr(stream, "reconfigure") and stream.errors == "strict":
                stream.reconfigure(errors="backslashreplace")
        try:
            return super().main(*args, **how)
        except OSError as fault:
            # a full stdout keeps what it could not write, and would fail once more at the end
            _closed("stdout")
            try:
                where = fault.filename or "the output"
                click.echo(f"eomc: {where}: can't be written ({fault.strerror})", err=True)
            except OSError:
                _closed("stderr")
            sys.exit(2)


def _closed(name: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        getattr(sys, name).close()
    setattr(sys, name, None)


def fail(message: str) -> NoReturn:
    """End with status 2, for bad input."""
    say(message, err=True)
    sys.exit(2)


def say(words: str = "", err: bool = False) -> None:
    """Print; what a terminal would take for a command is shown escaped."""
    click.echo(texts.lines(words), err=err)


def shown(path: object) -> str:
    """The name of a file in one line."""
    return texts.line(str(path))


def warn(problem: Problem) -> None:
    """Print a warning."""
    say(str(problem), err=True)


def _watched(silent: bool) -> bool:
    return not silent and sys.stderr.isatty()


@contextmanager
def progress_bar(
    what: str, silent: bool, after: float = 1.0
) -> Iterator[Callable[[int, int], None]]:
    """A bar for what takes longer than `after`, s, where a person is watching."""
    if not _watched(silent):
        yield lambda done, total: None
        return
    begun = time.monotonic()
    bar: list[Any] = []

    def update(done: int, total: int) -> None:
        if not bar and time.monotonic() - begun >= after and done < total:
            from rich.console import Console
            from rich.progress import Progress, TextColumn

            said = TextColumn("{task.description}", markup=False)
            columns = (said, *Progress.get_default_columns()[1:])
            progress = Progress(*columns, console=Console(stderr=True), transient=True)
            progress.start()
            bar.extend([progress, progress.add_task(shown(what), total=total)])
        if bar:
            bar[0].update(bar[1], completed=done)

    try:
        yield update
    finally:
        if bar:
            bar[0].stop()


@contextmanager
def status_line(what: str, silent: bool) -> Iterator[None]:
    """A line that says what is going on, where a person is watching."""
    if not _watched(silent):
        yield
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(Text(f"{shown(what)} ...")):  # no str, which has markup
        yield
