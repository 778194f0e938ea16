"""Shared parts of the commands: options and arguments, checks of them, output to the terminal."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

import click

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.runtime.atomic_write import atomic_write, check_replaceable

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


PATH = click.Path(path_type=Path)
SCENE = click.argument("scene", type=PATH)
SCENES = click.argument("scenes", nargs=-1, required=True, type=PATH)
BUILD = click.option(
    "--build", "root", default="build", show_default=True, type=PATH,
    help="Folder of built modules.",
)  # fmt: skip
SET = click.option(
    "--set", "parameters", multiple=True, metavar="NAME=VALUE", help="Value of a parameter."
)
START = click.option(
    "--start", multiple=True, metavar="NAME=VALUE",
    help="Initial value of a coordinate, or of its velocity NAME_dot.",
)  # fmt: skip
QUIET = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def as_namespace(function: Callable[[SimpleNamespace], None]) -> Callable[..., None]:
    """Make a command of a function that takes all parsed arguments as attributes of one object.

    They have the names that the decorators of click give them. The attribute `silent` is true if no
    progress is shown.
    """

    @wraps(function)
    def command(**parsed: Any) -> None:
        silent = parsed.get("quiet") or parsed.get("as_json")
        function(SimpleNamespace(**parsed, silent=silent))

    return command


def parse_pairs(
    arguments: Sequence[str], option: str, known: Mapping[str, float]
) -> Iterator[tuple[str, float]]:
    """Parse the arguments NAME=VALUE of an option, and yield each as a pair (name, value).

    A value is a number, or a formula such as pi/3.

    arguments: the texts NAME=VALUE. option: name of the option, for messages. known: values of the
    names that formulas may use. Raises EomcError if an argument has another form, a name occurs
    twice, or a value is not a finite number.
    """
    import math

    from eomc.scene import formulas

    names: set[str] = set()
    for pair in arguments:
        name, equals, text = pair.partition("=")
        name = name.strip()
        if not equals:
            raise EomcError(f"{option} {pair}: write {option} NAME=VALUE")
        if name in names:
            raise EomcError(f"{option} {pair}: '{name}' has a value already: give it once")
        names.add(name)
        try:
            value = float(
                formulas.evaluate(formulas.parse(text), formulas.NUMERIC, known.__getitem__)
            )
        except KeyError as fault:
            raise EomcError(f"{option} {pair}: {fault} is not a number or parameter") from None
        except (ValueError, ArithmeticError, TypeError) as fault:
            raise EomcError(f"{option} {pair}: {fault}") from None
        if not math.isfinite(value):
            raise EomcError(f"{option} {pair}: not a finite number")
        yield name, value


def check_target(path: Path | None, endings: Sequence[str], option: str) -> None:
    """Check before a long computation that the file of an option can be written afterwards.

    path: the file; None if the option is not used. endings: the allowed suffixes, such as ".csv".
    option: name of the option, for messages. Raises EomcError if the file has another suffix, or if
    it exists and can't be replaced.
    """
    if path is None:
        return
    if path.suffix not in endings:
        raise EomcError(
            f"{option} {escape_line(path)}: give a name that ends in {' or '.join(endings)}"
        )
    with writing(f"{option} {escape_line(path)}"):
        check_replaceable(path)


def scene_path(name: str) -> Path:
    """Return the path of a new scene file, <name>.toml, in scenes/ if that folder exists."""
    return (Path("scenes") if Path("scenes").is_dir() else Path()) / f"{name}.toml"


def write_new(path: Path, text: str) -> None:
    """Write a text file. Raises EomcError if the file exists already, or can't be written."""
    incomplete = False
    try:
        with path.open("x", encoding="utf-8") as file:
            incomplete = True
            file.write(text)
        incomplete = False
    except FileExistsError:
        raise EomcError(f"{escape_line(path)}: is there already, and stays as it is") from None
    except OSError as fault:
        raise EomcError(f"{escape_line(path)}: can't be written ({fault.strerror})") from None
    finally:
        if incomplete:  # and not whole
            path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file; an existing file is replaced once the new one is complete.

    Raises EomcError if the file can't be written.
    """
    with writing(escape_line(path)), atomic_write(path) as new:
        new.write_text(text, encoding="utf-8")
