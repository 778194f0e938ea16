"""Output of the command that can't be written, or goes nowhere, ends it in a sentence."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

import click


class Group(click.Group):
    """Commands whose output may be closed, full, or of fewer letters than are printed."""

    def main(self, *args: Any, **how: Any) -> Any:
        """As click has it; status 2 where output can't be written, after `| head` status 1."""
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None:  # closed by the caller
                setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - kept
            elif hasattr(stream, "reconfigure") and stream.errors == "strict":
                stream.reconfigure(errors="backslashreplace")
        try:
            return super().main(*args, **how)
        except OSError as fault:
            # a full stdout keeps what it could not write, and would fail once more at the end
            _closed("stdout")
            try:
                where = fault.filename or "the output"
                click.echo(f"eomc: {where}: can't be written ({fault.strerror})", err=True)
            except OSError:
                _closed("stderr")
            sys.exit(2)


def _closed(name: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        getattr(sys, name).close()
    setattr(sys, name, None)
