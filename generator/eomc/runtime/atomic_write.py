"""Files that are written whole: what is there stays until the new one is complete.

A scene, or a file of another kind than its name says, is not replaced.
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

# the first bytes of a file of each kind, behind white space
_BEGINNINGS: Mapping[str, bytes | tuple[bytes, ...]] = {
    ".fmu": b"PK", ".npz": b"PK", ".whl": b"PK", ".png": b"\x89PNG", ".gif": b"GIF8",
    ".pdf": b"%PDF", ".svg": b"<", ".html": b"<", ".json": (b"{", b"["),
}  # fmt: skip
_SCENE = re.compile(rb"^\s*eomc\s*=\s*\d", re.MULTILINE)
_READ = 1 << 16  # bytes of an existing file that are looked at


def check_replaceable(file: File) -> None:
    """Raise FileExistsError where `file` is a scene, or no file of the kind that its name says.

    An empty file, a device or a pipe may be replaced or written.
    """
    path = Path(file)
    if not path.is_file():
        return
    with path.open("rb") as there:
        begin = there.read(_READ)
    beginnings = _BEGINNINGS.get(path.suffix.lower(), b"")
    what = ""
    if path.suffix != ".toml" and _SCENE.search(begin):
        what = "a scene"
    elif begin and not begin.lstrip().startswith(beginnings):
        what = f"no {path.suffix} file"
    if what:
        raise FileExistsError(
            errno.EEXIST, f"it is there already, is {what}, and stays: give another name",
            os.fspath(file),
        )  # fmt: skip


@contextmanager
def atomic_write(file: File, cached: bool = False) -> Iterator[Path]:
    """A name beside `file`, with its suffix, for what takes its place when all is written.

    Where that fails or is interrupted the file is as it was, and nothing is beside it. Of a link
    what it links to is replaced; a device or pipe is written itself. Raises OSError of `file`,
    FileExistsError where that is a scene or a file of another kind (`check_replaceable`). cached:
    whether it is a file that no user names, which is replaced whatever it is.
    """
    given = Path(file)
    if not cached:
        check_replaceable(given)
    if given.exists() and not given.is_file():
        yield given
        return
    path = Path(os.path.realpath(given))
    new = path.with_name(f".{os.getpid()}.{get_ident()}{path.suffix}")
    try:
        there = path.exists()
        if there and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(file))
        yield new
        if there:
            os.chmod(new, stat.S_IMODE(path.stat().st_mode))
        os.replace(new, path)
    except OSError as fault:
        if fault.filename is None:
            raise
        raise OSError(fault.errno, fault.strerror, os.fspath(file)) from None
    finally:
        with suppress(OSError):
            new.unlink()
