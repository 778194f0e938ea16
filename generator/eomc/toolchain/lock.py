"""A lock on a file, which keeps builds of one scene apart: by flock, on Windows by msvcrt."""

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
_FLAGS = ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC")  # which Windows has not, nor what they are for


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """A lock on a file that is made where it isn't there; nothing is written to it.

    Raises EomcError where something else lies there: no link is followed, no pipe waited for.
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
    """Until it is ours; closing the file gives it back."""
    if sys.platform == "win32":
        import msvcrt

        while True:
            try:
                msvcrt.locking(lock, msvcrt.LK_LOCK, 1)  # its first byte, which need not be there
                return
            except OSError as fault:  # it tries for ten seconds
                if fault.errno != errno.EDEADLK:
                    raise
    else:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX)
