"""Files that are written whole: what is there stays until the new one is complete."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import get_ident

File = str | os.PathLike[str]


@contextmanager
def replacing(file: File) -> Iterator[Path]:
    """A name beside `file`, with its suffix, for what takes its place when all is written.

    Where that fails or is interrupted the file is as it was, and nothing is beside it. Of a link
    what it links to is replaced; a device or pipe is written itself. Raises OSError of `file`.
    """
    given = Path(file)
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
