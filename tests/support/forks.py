"""Run work in a forked process, which leaves no processes behind."""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress


def in_a_fork(
    work: Callable[[], object], seconds: float, group: bool = False
) -> tuple[str, object]:
    """Return the result of `work`, passed as JSON from a process of its own.

    It is ("done", value), ("raised", message), ("killed", signal) or ("late", None). group: also
    end processes that it has started and left.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        if group:
            os.setpgid(0, 0)
        try:
            result: tuple[str, object] = ("done", work())
        except BaseException as fault:
            result = ("raised", f"{type(fault).__name__}: {fault}")
        with os.fdopen(writing, "w") as pipe:
            json.dump(result, pipe)
        _flush_and_leave()
    os.close(writing)
    try:
        return _receive(child, reading, seconds)
    finally:
        if group:
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)


def _flush_and_leave() -> None:
    sys.stdout.flush()
    os._exit(0)


def _receive(child: int, reading: int, seconds: float) -> tuple[str, object]:
    end, text = time.monotonic() + seconds, b""
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        while select.select([pipe], [], [], max(0.0, end - time.monotonic()))[0]:
            part = pipe.read(65536)
            if not part:
                break
            text += part
        else:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "late", None
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status) or not text:
        return "killed", os.WTERMSIG(status) if os.WIFSIGNALED(status) else status
    kind, value = json.loads(text)
    return str(kind), value
