"""Write files atomically: an existing file stays until the new one is complete.

A scene, or a file whose content does not match its suffix, is not replaced.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import get_ident

File = str | os.PathLike[str]

# the first bytes of a file of each kind, after white space
_BEGINNINGS: Mapping[str, bytes | tuple[bytes, ...]] = {
    ".fmu": b"PK", ".npz": b"PK", ".whl": b"PK", ".png": b"\x89PNG", ".gif": b"GIF8",
    ".pdf": b"%PDF", ".svg": b"<", ".html": b"<", ".json": (b"{", b"["),
}  # fmt: skip
_SCENE = re.compile(rb"^\s*eomc\s*=\s*\d", re.MULTILINE)
_READ = 1 << 16  # bytes of an existing file that are looked at


def check_replaceable(file: File) -> None:
    """Raise FileExistsError if `file` exists and must not be overwritten.

    A file must not be overwritten if it is a scene (a TOML file of eomc) without the suffix .toml,
    or if its first bytes do not match its suffix. A missing or empty file, a device or a pipe may
    be written.
    """
    path = Path(file)
    if not path.is_file():
        return
    with path.open("rb") as exists:
        head = exists.read(_READ)
    beginnings = _BEGINNINGS.get(path.suffix.lower(), b"")
    what = ""
    if path.suffix != ".toml" and _SCENE.search(head):
        what = "a scene"
    elif head and not head.lstrip().startswith(beginnings):
        what = f"no {path.suffix} file"
    if what:
        raise FileExistsError(
            errno.EEXIST, f"it is there already, is {what}, and stays: give another name",
            os.fspath(file),
        )  # fmt: skip


@contextmanager
def atomic_write(file: File, cached: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, which replaces `file` on exit.

    If writing fails or is interrupted, `file` is unchanged and the temporary file is removed. If
    `file` is a symbolic link, its target is replaced; a device or a pipe is written directly.

    Parameters
    ----------
    file : path
        File to write.
    cached : bool
        Skip `check_replaceable`, for files in the cache, whose names no user chooses.

    Raises
    ------
    OSError
        With the name of `file`, if it cannot be written.
    FileExistsError
        If `check_replaceable` does not permit to replace it.
    """
    target = Path(file)
    if not cached:
        check_replaceable(target)
    if target.exists() and not target.is_file():
        yield target
        return
    path = Path(os.path.realpath(target))
    new = path.with_name(f".{os.getpid()}.{get_ident()}{path.suffix}")
    try:
        exists = path.exists()
        if exists and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(file))
        yield new
        if exists:
            os.chmod(new, stat.S_IMODE(path.stat().st_mode))
        os.replace(new, path)
    except OSError as fault:
        if fault.filename is None:
            raise
        raise OSError(fault.errno, fault.strerror, os.fspath(file)) from None
    finally:
        with suppress(OSError):
            new.unlink()
