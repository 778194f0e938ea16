"""Where things stand in a TOML text: lines and columns for error messages."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from eomc.formulas import FormulaError
from eomc.problems import Problem

MAX_STATEMENT = 500  # lines


class Places:
    """Line numbers of keys, found by giving tomllib one statement at a time."""

    def __init__(self, text: str, file: str) -> None:
        self.lines = text.split("\n")
        self.file = file
        self._line: dict[tuple[str, ...], tuple[int, int]] = {}
        prefix: tuple[str, ...] = ()
        start = 0
        while start < len(self.lines):
            if self.lines[start].strip().startswith("#") or not self.lines[start].strip():
                start += 1
                continue
            end = self._end(start)
            if end == start:
                break  # hundreds of lines in one statement: no scene; the rest keeps no places
            statement = "\n".join(self.lines[start:end])
            paths = list(_paths(tomllib.loads(statement)))
            header = statement.lstrip().startswith("[")
            for path in paths:
                self._line.setdefault((() if header else prefix) + path, (start, end))
            if header:
                prefix = max(paths, key=len)
            start = end

    def _end(self, start: int) -> int:
        """The line after the statement that begins at `start`; `start` where none is found."""
        for end in range(start + 1, min(start + MAX_STATEMENT, len(self.lines)) + 1):
            try:
                tomllib.loads("\n".join(self.lines[start:end]))
            except ValueError:
                continue
            return end
        return start

    def rename(self, given: tuple[str, ...], meant: tuple[str, ...]) -> None:
        """Let `meant` and what is under it stand where the misspelt `given` stands."""
        for path, place in list(self._line.items()):
            if path[: len(given)] == given:
                self._line.setdefault(meant + path[len(given) :], place)

    def source(self, path: tuple[str, ...]) -> str:
        """The statement in which a key stands."""
        start, end = self._line.get(path, (0, 0))
        return "\n".join(self.lines[start:end])

    def problem(
        self,
        path: tuple[str, ...],
        message: str,
        at: FormulaError | ast.expr | None = None,
        text: str | None = None,
        severity: str = "error",
    ) -> Problem:
        """A problem at a key; the fault `at` of its text is marked where it can be found."""
        if path[-1:] == ("value",) and path not in self._line:
            path = path[:-1]  # written short, m = 2.0
        key = ".".join(path)
        known = path
        while known and known not in self._line:
            known = known[:-1]
        if not known:
            return Problem(message, key, self.file, severity=severity)
        source = self.source(known)
        offset, width = _spot(source, known[-1], at, text)
        line = self._line[known][0] + source.count("\n", 0, max(offset, 0))
        column = offset - source.rfind("\n", 0, offset) - 1 if offset >= 0 else -1
        return Problem(
            message, key, self.file, line + 1, column, width, self.lines[line].rstrip(), severity
        )


def _spot(
    source: str, key: str, at: FormulaError | ast.expr | None, text: str | None
) -> tuple[int, int]:
    """Where in a statement the fault stands, and how wide it is; -1 where it can't be told."""
    text = (text or "").strip()
    column, width = 0, len(text) or 1
    if isinstance(at, FormulaError):
        column, width = at.column, at.width
    elif at is not None:
        column, width = at.col_offset, (at.end_col_offset or 0) - at.col_offset
    for written in (str, _escaped) if text else ():
        # blanks may be line breaks, one for one, so that columns stay
        body = re.sub(r"\\\s", r"\\s", re.escape(written(text)))
        quoted = re.search(rf"""(["'])\s*({body})\s*\1""", source)
        if quoted is not None:
            return quoted.start(2) + len(written(text[:column])), width
    named = re.search(rf"(?<!\w){re.escape(key)}(?!\w)", source)
    return (named.start(), len(key)) if named else (-1, 1)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _paths(tree: Mapping[str, Any], depth: int = 3) -> Iterator[tuple[str, ...]]:
    """The keys of a tree as deep as a scene goes: table, name, key."""
    for key, value in tree.items():
        yield (key,)
        if isinstance(value, list):
            value = next((v for v in value if isinstance(v, dict)), None)
        if isinstance(value, dict) and depth > 1:
            for rest in _paths(value, depth - 1):
                yield (key, *rest)
