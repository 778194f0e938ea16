"""Options and arguments of commands, functions that parse and check them, and files to write."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

from eomc.base.errors import EomcError, writing
from eomc.cli.terminal import escape_line
from eomc.runtime.atomic_write import atomic_write, check_replaceable

Arguments = TypeVar("Arguments")

SCENE = click.argument("scene", type=click.Path(path_type=Path))
SCENES = click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
BUILD = click.option(
    "--build", "root", default="build", show_default=True, type=click.Path(path_type=Path),
    help="Where built modules lie.",
)  # fmt: skip
QUIET = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def parse_into(
    arguments: Callable[..., Arguments],
) -> Callable[[Callable[[Arguments], None]], Callable[..., None]]:
    """Return a decorator for a command that takes all of its parsed arguments as one object.

    arguments: class of the object. It is called with the parsed arguments as keywords, by the names
    that the decorators of click give them.
    """

    def decorate(function: Callable[[Arguments], None]) -> Callable[..., None]:
        @wraps(function)
        def command(**parsed: Any) -> None:
            function(arguments(**parsed))

        return command

    return decorate


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
