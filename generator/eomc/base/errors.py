"""What is wrong with a user's input: the place, the fault and the remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from eomc.base import texts

WIDTH = 100  # characters of a source line shown, at most
LONGEST = 1_000  # characters of a message shown, at most
MOST = 50  # problems shown, at most


class EomcError(Exception):
    """An error that the user can correct; its text is complete without a traceback."""

    def __str__(self) -> str:
        return texts.lines(super().__str__())

    def _render_traceback_(self) -> list[str]:
        """Show the message in IPython without the traceback inside the package."""
        return [f"{type(self).__name__}: {self}"]


class FolderError(EomcError):
    """A folder of builds that can't be written; the remedy is Python's, the command has its own."""

    def __str__(self) -> str:
        return f"{super().__str__()}: choose another folder, root=..."

    @property
    def what(self) -> str:
        """The fault alone."""
        return super().__str__()


class NoCompilerError(EomcError):
    """There is no C compiler."""


@contextmanager
def writing(where: object) -> Iterator[None]:
    """Raise an EomcError that names `where` in place of an OSError."""
    try:
        yield
    except OSError as fault:
        raise EomcError(f"{where}: can't be written ({fault.strerror or fault})") from None


@dataclass(frozen=True)
class Problem:
    """One fault. `column` counts from 0; `line` from 1, 0 where there is no line to show."""

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
        parts = (place, self.severity, _cut(self.key, WIDTH), _cut(self.message, LONGEST))
        text = ": ".join(texts.line(part) for part in parts if part)
        if not self.source:
            return text
        # of a long line, the part around the fault
        start = max(self.column - WIDTH // 2, 0) if len(self.source) > WIDTH else 0
        shown = _shown(self.source[start : start + WIDTH])
        before = "…" if start else ""
        after = "…" if len(self.source) > start + WIDTH else ""
        gutter = f"  {self.line} | "
        text += f"\n{gutter}{before}{shown}{after}"
        if self.column >= 0:
            left = len(before) + self.column - start
            width = max(min(self.width, len(before) + len(shown) - left), 1)
            text += "\n" + " " * (len(gutter) - 2) + "| " + " " * left + "^" * width
        return text


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _shown(text: str) -> str:
    """Return `text` in one line, with one printable character for each of its own."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class SceneError(EomcError):
    """An invalid scene; `problems` are all problems found, in the order of the file."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda p: (p.line, p.column)))
        shown = [str(p) for p in self.problems[:MOST]]
        if len(self.problems) > MOST:
            shown.append(f"... and {len(self.problems) - MOST} more")
        super().__init__("\n".join(shown))

    def __reduce__(self) -> tuple[type[SceneError], tuple[Sequence[Problem]]]:
        return type(self), (self.problems,)
