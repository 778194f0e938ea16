"""Write the files of commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eomc.base.errors import EomcError, writing
from eomc.cli.terminal import shown
from eomc.runtime.atomic_write import atomic_write, check_replaceable


def scene_path(name: str) -> Path:
    """Return the path of a new scene, in scenes/ if that folder exists."""
    return (Path("scenes") if Path("scenes").is_dir() else Path()) / f"{name}.toml"


def write_new(path: Path, text: str) -> None:
    """Write a file that must not exist yet."""
    incomplete = False
    try:
        with path.open("x", encoding="utf-8") as file:
            incomplete = True
            file.write(text)
        incomplete = False
    except FileExistsError:
        raise EomcError(f"{shown(path)}: is there already, and stays as it is") from None
    except OSError as fault:
        raise EomcError(f"{shown(path)}: can't be written ({fault.strerror})") from None
    finally:
        if incomplete:  # and not whole
            path.unlink(missing_ok=True)


def check_target(path: Path | None, endings: Sequence[str], option: str) -> None:
    """Raise EomcError if an option names a file with a wrong suffix or one not replaceable."""
    if path is None:
        return
    if path.suffix not in endings:
        raise EomcError(f"{option} {shown(path)}: give a name that ends in {' or '.join(endings)}")
    with writing(f"{option} {shown(path)}"):
        check_replaceable(path)


def write_text(path: Path, text: str) -> None:
    """Write a file, replacing an existing one once the new one is complete."""
    with writing(shown(path)), atomic_write(path) as new:
        new.write_text(text, encoding="utf-8")
