"""What is wrong with a user's input: the place, the fault and the remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

from eomc.base import texts


class EomcError(Exception):
    """An error that the user can correct. Its message is meant to be shown without a traceback."""

    def __str__(self) -> str:
        return texts.lines(super().__str__())

    def _render_traceback_(self) -> list[str]:
        """Show the message in IPython without the traceback inside the package."""
        return [f"{type(self).__name__}: {self}"]


class FolderError(EomcError):
    """Error for a build folder that can't be written.

    The message advises a caller in Python to choose another folder by the argument `root`. The
    command line instead shows the property `what`, followed by advice of its own.
    """

    def __str__(self) -> str:
        return f"{super().__str__()}: choose another folder, root=..."

    @property
    def what(self) -> str:
        """The message without the advice to choose another folder."""
        return super().__str__()


class NoCompilerError(EomcError):
    """Error for a build that needs a C compiler where none is found."""


@contextmanager
def writing(where: object) -> Iterator[None]:
    """Return a context manager that converts an OSError raised in its block to an EomcError.

    where: the file or folder that is written, for the message.
    """
    try:
        yield
    except OSError as fault:
        raise EomcError(f"{where}: can't be written ({fault.strerror or fault})") from None


@dataclass(frozen=True)
class Problem:
    """A fault in a user's input, or a warning or note on it; `str` formats it for the terminal.

    Attributes
    ----------
    message
        What is wrong, and the remedy.
    key
        Key of the faulty entry in the scene, such as "parameters.m", or argument of System.make.
    file, line, column
        Position of the fault in the file. `line` counts from 1 and is 0 if unknown; `column` counts
        from 0 and is -1 if unknown.
    width
        Number of characters to underline from `column`.
    source
        Text of the line to show; "" for none.
    severity
        "error", "warning" or "note".
    """

    MAX_WIDTH: ClassVar[int] = 100  # characters shown of a key and of a source line
    MAX_MESSAGE: ClassVar[int] = 1_000  # characters shown of a message

    message: str
    key: str = ""
    file: str = ""
    line: int = 0
    column: int = -1
    width: int = 1
    source: str = ""
    severity: str = "error"

    def __str__(self) -> str:
        place = self.file
        if self.line:
            place += f":{self.line}"
            if self.column >= 0:
                place += f":{self.column + 1}"
        parts = (
            place,
            self.severity,
            _shorten(self.key, self.MAX_WIDTH),
            _shorten(self.message, self.MAX_MESSAGE),
        )
        text = ": ".join(texts.line(part) for part in parts if part)
        if not self.source:
            return text
        # of a long line, the part around the fault
        most = self.MAX_WIDTH
        start = max(self.column - most // 2, 0) if len(self.source) > most else 0
        shown = _printable(self.source[start : start + most])
        before = "…" if start else ""
        after = "…" if len(self.source) > start + most else ""
        gutter = f"  {self.line} | " if self.line else "  | "
        text += f"\n{gutter}{before}{shown}{after}"
        if self.column >= 0:
            left = len(before) + self.column - start
            width = max(min(self.width, len(before) + len(shown) - left), 1)
            text += "\n" + " " * (len(gutter) - 2) + "| " + " " * left + "^" * width
        return text


def _shorten(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _printable(text: str) -> str:
    """Return `text` in one line, with one printable character for each of its own."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class SceneError(EomcError):
    """Error for an invalid scene.

    `problems` contains all problems that were found, sorted by line and column. The message shows
    the first 50.
    """

    MAX_SHOWN: ClassVar[int] = 50  # problems

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda p: (p.line, p.column)))
        shown = [str(p) for p in self.problems[: self.MAX_SHOWN]]
        if len(self.problems) > self.MAX_SHOWN:
            shown.append(f"... and {len(self.problems) - self.MAX_SHOWN} more")
        super().__init__("\n".join(shown))

    def __reduce__(self) -> tuple[type[SceneError], tuple[Sequence[Problem]]]:
        return type(self), (self.problems,)
