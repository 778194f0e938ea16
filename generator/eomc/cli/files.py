"""Write text files, such as new scenes and reports."""

from __future__ import annotations

from pathlib import Path

from eomc.base.errors import EomcError, writing
from eomc.cli.terminal import escape_line
from eomc.runtime.atomic_write import atomic_write


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
