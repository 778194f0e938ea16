"""Files that commands write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eomc.base.errors import EomcError, writing
from eomc.cli.terminal import shown
from eomc.runtime.written import check_replaceable, replacing


def scene_path(name: str) -> Path:
    """Where a new scene goes: into scenes/ where there is one."""
    return (Path("scenes") if Path("scenes").is_dir() else Path()) / f"{name}.toml"


def write_new(path: Path, text: str) -> None:
    """Write a file that must not be there yet."""
    made = False
    try:
        with path.open("x", encoding="utf-8") as file:
            made = True
            file.write(text)
        made = False
    except FileExistsError:
        raise EomcError(f"{shown(path)}: is there already, and stays as it is") from None
    except OSError as fault:
        raise EomcError(f"{shown(path)}: can't be written ({fault.strerror})") from None
    finally:
        if made:  # and not whole
            path.unlink(missing_ok=True)


def check_target(path: Path | None, endings: Sequence[str], option: str) -> None:
    """Raise EomcError where an option names a file of another kind than the command writes."""
    if path is None:
        return
    if path.suffix not in endings:
        raise EomcError(f"{option} {shown(path)}: give a name that ends in {' or '.join(endings)}")
    with writing(f"{option} {shown(path)}"):
        check_replaceable(path)


def write_text(path: Path, text: str) -> None:
    """Write a file, whole, over what is there."""
    with writing(shown(path)), replacing(path) as new:
        new.write_text(text, encoding="utf-8")
