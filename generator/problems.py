"""What is wrong with a user's input: the place, the fault and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class EomcError(Exception):
    """An error that is the user's to mend; its text is meant to be read as it stands."""


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
        head = ": ".join(part for part in (place, self.severity, self.key, self.message) if part)
        if not self.source:
            return head
        gutter = f"  {self.line} | "
        text = head + "\n" + gutter + self.source
        if self.column >= 0:
            text += "\n" + " " * (len(gutter) - 2) + "| " + " " * self.column + "^" * self.width
        return text


class SceneError(EomcError):
    """A scene that can't be used; `problems` holds every fault found, in the file's order."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda p: (p.line, p.column)))
        super().__init__("\n".join(map(str, self.problems)))
