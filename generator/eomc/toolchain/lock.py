"""File locks that separate builds of one scene: flock, or msvcrt on Windows."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eomc.base.errors import EomcError

_NO_LOCK = "{}: is no file, and builds of a scene lock one there: remove it"
_FLAGS = ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC")  # missing, and not needed, on Windows


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file `path` while the block of the with statement runs.

    Other processes that lock the same file wait until the block ends. If the file does not exist,
    an empty one is created. Raises EomcError if `path` is a symbolic link, a folder, a pipe or
    anything else that is not a regular file.
    """
    try:
        flags = os.O_RDWR | os.O_CREAT
        for name in _FLAGS:
            flags |= getattr(os, name, 0)
        lock = os.open(path, flags, 0o666)
    except OSError as fault:
        if fault.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV):
            raise
        raise EomcError(_NO_LOCK.format(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            raise EomcError(_NO_LOCK.format(path))
        _wait(lock)
        yield
    finally:
        os.close(lock)


def _wait(lock: int) -> None:
    """Wait for the exclusive lock; closing the file releases it."""
    if sys.platform == "win32":
        import msvcrt

        while True:
            try:
                msvcrt.locking(lock, msvcrt.LK_LOCK, 1)  # first byte, which need not exist
                return
            except OSError as fault:  # LK_LOCK gives up after ten seconds
                if fault.errno != errno.EDEADLK:
                    raise
    else:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX)
