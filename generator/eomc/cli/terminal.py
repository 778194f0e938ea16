"""Terminal output: escaped text, progress, and errors of writing."""

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


class CommandGroup(click.Group):
    """A group of commands that handles closed or full output streams and missing encodings."""

    def main(self, *args: Any, **how: Any) -> Any:
        """Run a command as click does.

        Exit with status 2 if the output can't be written, and with status 1 if the program that
        reads the output has ended, as after `| head`.
        """
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
            _close("stdout")
            try:
                where = fault.filename or "the output"
                click.echo(f"eomc: {where}: can't be written ({fault.strerror})", err=True)
            except OSError:
                _close("stderr")
            sys.exit(2)


def _close(name: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        getattr(sys, name).close()
    setattr(sys, name, None)


def fail(message: str) -> NoReturn:
    """Print a message to stderr, and exit with status 2, which means bad input."""
    say(message, err=True)
    sys.exit(2)


def say(words: str = "", err: bool = False) -> None:
    """Print text to stdout, or to stderr if `err` is True. Control characters are escaped."""
    click.echo(texts.lines(words), err=err)


def escape_line(path: object) -> str:
    """Return the text of a path or another object on one line, with control characters escaped."""
    return texts.line(str(path))


def warn(problem: Problem) -> None:
    """Print a warning about a scene to stderr."""
    say(str(problem), err=True)


def _is_interactive(silent: bool) -> bool:
    return not silent and sys.stderr.isatty()


@contextmanager
def progress_bar(what: str, silent: bool, after: float = 1.0) -> Iterator[Callable[..., None]]:
    """Show a progress bar while the block of the with statement runs, if stderr is a terminal.

    The block receives a function, which it calls as update(completed, total) or, with another text
    in front of the bar, update(completed, total, text). what: text in front of the bar. silent:
    True to show no bar. after: time in s after which the bar appears.
    """
    if not _is_interactive(silent):
        yield lambda completed, total, text="": None
        return
    started_at = time.monotonic()
    bar: list[Any] = []

    def update(completed: int, total: int, text: str = what) -> None:
        if not bar and time.monotonic() - started_at >= after and completed < total:
            from rich.console import Console
            from rich.progress import Progress, TextColumn

            description = TextColumn("{task.description}", markup=False)
            columns = (description, *Progress.get_default_columns()[1:])
            progress = Progress(*columns, console=Console(stderr=True), transient=True)
            progress.start()
            bar.extend([progress, progress.add_task(escape_line(what), total=total)])
        if bar:
            bar[0].update(bar[1], completed=completed, description=escape_line(text))

    try:
        yield update
    finally:
        if bar:
            bar[0].stop()


@contextmanager
def status_line(what: str, silent: bool) -> Iterator[None]:
    """Show a line of text and a spinner while the block runs, if stderr is a terminal.

    what: the text. silent: True to show nothing.
    """
    if not _is_interactive(silent):
        yield
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(Text(f"{escape_line(what)} ...")):  # no str, which has markup
        yield
