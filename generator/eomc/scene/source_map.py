"""Where things stand in a TOML text: lines and columns for error messages."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eomc.base.errors import Problem
from eomc.scene.formulas import FormulaError

MAX_STATEMENT = 500  # lines
MAX_PARSED = 4_000_000  # characters given to tomllib, some seconds
MAX_SEARCHED = 20_000_000  # characters searched for the columns of faults; then lines do

# tables that may stand many times, in [[two brackets]]
ARRAYS = ("body", "point", "spring", "damper", "force", "loop", "event")

Path = tuple[str, ...]


class SourceMap:
    """Line numbers of keys, found by giving tomllib one statement at a time."""

    def __init__(self, text: str, file: str) -> None:
        self.lines = text.split("\n")
        self.file = file
        self._line: dict[Path, tuple[int, int]] = {}
        self._under: dict[Path, list[Path]] = {}  # the paths that begin with one or two keys
        self._key: dict[Path, str] = {}  # how the last key is written, where it is otherwise
        self._text: dict[str, str] = {}  # how a text is written, where it is otherwise
        self._from: dict[Path, Path] = {}  # what was repeated: the entry it came from
        self._tried = self._searched = 0
        prefix: Path = ()
        counts = dict.fromkeys(ARRAYS, 0)
        start = 0
        while start < len(self.lines):
            if self.lines[start].strip().startswith("#") or not self.lines[start].strip():
                start += 1
                continue
            end, tree = self._statement_end(start)
            if end == start:
                break  # hundreds of lines in one statement: no scene; the rest keeps no places
            header = self.lines[start].lstrip().startswith("[")
            if header and self.lines[start].lstrip().startswith("[["):
                for array in ARRAYS:
                    counts[array] += array in tree
            paths = list(_paths(tree))
            if header:
                paths = [_numbered(path, counts) for path in paths]
            for path in paths:
                self._store((() if header else prefix) + path, (start, end))
            if header:
                prefix = max(paths, key=len)
            start = end

    def _store(self, path: Path, place: tuple[int, int]) -> None:
        if path not in self._line:
            self._line[path] = place
            for length in (1, 2):
                if len(path) >= length:
                    self._under.setdefault(path[:length], []).append(path)

    def _statement_end(self, start: int) -> tuple[int, dict[str, Any]]:
        """The line after the statement that begins at `start`, and its tree.

        `start` itself where none is found.
        """
        for end in range(start + 1, min(start + MAX_STATEMENT, len(self.lines)) + 1):
            statement = "\n".join(self.lines[start:end])
            self._tried += len(statement)
            if end > start + 1 and self._tried > MAX_PARSED:
                break
            try:
                return end, tomllib.loads(statement)
            except ValueError:
                continue
        return start, {}

    def rename(self, written: Path, intended: Path) -> None:
        """Let `intended` and what is under it stand where the misspelt `written` stands."""
        for path in list(self._under.get(written[:2], ())):
            if path[: len(written)] == written:
                self._place_like(intended + path[len(written) :], path)

    def repeat(self, entry: Path, copies: Sequence[Path]) -> None:
        """Let each of `copies` and what is under it stand where the entry `entry` stands."""
        under = list(self._under.get(entry, ()))
        name_path = (*entry, "name")
        for path in (path for path in copies if path != entry):
            self._from[path] = entry
            if name_path in self._line and entry[0] in ARRAYS:
                self._place_like(
                    path, name_path
                )  # an entry of an array stands where its name stands
            for old in under:
                self._place_like(path + old[len(entry) :], old)

    def _place_like(self, new: Path, written: Path) -> None:
        self._store(new, self._line[written])
        self._key.setdefault(new, self._key.get(written, written[-1]))

    def rewrite(self, text: str, written: str) -> None:
        """Let a text made by repetition be looked for as it is written."""
        self._text.setdefault(text, written)

    def origin(self, path: Path) -> Path:
        """The entry as it is written that an entry comes from."""
        return self._from.get(path[:2], path[:2]) + path[2:]

    def source(self, path: Path) -> str:
        """The statement in which a key stands."""
        start, end = self._line.get(path, (0, 0))
        return "\n".join(self.lines[start:end])

    def problem(
        self,
        path: Path,
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
        key_written = self._key.get(known, known[-1])
        self._searched += len(source) + 20_000  # a thousand faults at most
        offset, width = -1, 1
        if self._searched < MAX_SEARCHED:
            offset, width = _find_fault(source, key_written, at, text, self._text.get(text or ""))
        line = self._line[known][0] + source.count("\n", 0, max(offset, 0))
        column = offset - source.rfind("\n", 0, offset) - 1 if offset >= 0 else -1
        return Problem(
            message, key, self.file, line + 1, column, width, self.lines[line].rstrip(), severity
        )


def _find_fault(
    source: str,
    key: str,
    at: FormulaError | ast.expr | None,
    text: str | None,
    before: str | None = None,
) -> tuple[int, int]:
    """Where in a statement the fault stands, and how wide it is; -1 where it can't be found.

    before: the text as it was before repetition.
    """
    text = (text or "").strip()
    column, width = 0, len(text) or 1
    if isinstance(at, FormulaError):
        column, width = at.column, at.width
    elif at is not None:
        column, width = at.col_offset, (at.end_col_offset or 0) - at.col_offset
    for written in (str, _escaped) if text else ():
        if quoted := _quoted(written(text), source):
            return quoted.start(2) + len(written(text[:column])), width
    if before and (quoted := _quoted(before.strip(), source)):
        return quoted.start(2), len(quoted[2])
    match = re.search(rf"(?<!\w){re.escape(key)}(?!\w)", source)
    return (match.start(), len(key)) if match else (-1, 1)


def _quoted(text: str, source: str) -> re.Match[str] | None:
    """The text in quotes; blanks may be line breaks, one for one, so that columns stay."""
    body = re.sub(r"\\\s", r"\\s", re.escape(text))
    return re.search(rf"""(["'])\s*({body})\s*\1""", source)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _paths(tree: Mapping[str, Any], depth: int = 3) -> Iterator[Path]:
    """The keys of a tree as deep as a scene goes: table, name, key; (array, "#1", key)."""
    for key, value in tree.items():
        yield (key,)
        if isinstance(value, list):
            inside = [v for v in value if isinstance(v, dict)]
            if key in ARRAYS and depth == 3:
                value = {f"#{k}": v for k, v in enumerate(inside, start=1)}
            else:
                value = next(iter(inside), None)
        if isinstance(value, dict) and depth > 1:
            for rest in _paths(value, depth - 1):
                yield (key, *rest)


def _numbered(path: Path, counts: Mapping[str, int]) -> Path:
    """A path of a header: [[body]] and [body.x] belong to the last body so far."""
    if path[0] not in counts or len(path) < 2 or not counts[path[0]]:
        return path
    keys = path[2:] if path[1].startswith("#") else path[1:]
    return (path[0], f"#{counts[path[0]]}", *keys)
