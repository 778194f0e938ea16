"""Lines and columns of keys in a TOML text, for error messages."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eomc.base.errors import Problem
from eomc.scene.formulas import FormulaError

# arrays of tables, [[name]]
ARRAYS = ("body", "point", "spring", "damper", "force", "loop", "event")

Path = tuple[str, ...]


class SourceMap:
    """The lines of all keys in the TOML text of a scene, to show errors at their places.

    A path is the tuple of keys that lead to an entry. The lines are found by parsing one TOML
    statement at a time.
    """

    MAX_STATEMENT = 500  # lines
    MAX_PARSED = 4_000_000  # characters given to tomllib, which takes some seconds
    # characters that are searched for columns of errors; beyond, only lines are given
    MAX_SEARCHED = 20_000_000

    def __init__(self, text: str, file: str) -> None:
        self.lines = text.split("\n")
        self.file = file
        self._line: dict[Path, tuple[int, int]] = {}
        self._under: dict[Path, list[Path]] = {}  # paths by their first key and first two keys
        self._key: dict[Path, str] = {}  # the last key as it is written, if it differs
        self._text: dict[str, str] = {}  # a text as it is written, if it differs
        self._from: dict[Path, Path] = {}  # original entry of each copy made by repetition
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
                paths = [_number_entry(path, counts) for path in paths]
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
        """Return the line after the statement that begins at `start`, and its tree.

        Returns `start` itself if no statement is found.
        """
        for end in range(start + 1, min(start + self.MAX_STATEMENT, len(self.lines)) + 1):
            statement = "\n".join(self.lines[start:end])
            self._tried += len(statement)
            if end > start + 1 and self._tried > self.MAX_PARSED:
                break
            try:
                return end, tomllib.loads(statement)
            except ValueError:
                continue
        return start, {}

    def rename(self, written: Path, intended: Path) -> None:
        """Record that a key was misspelt, so that errors at the intended key show its line.

        written: path of the misspelt key in the file. intended: path of the intended key. All keys
        below the misspelt one are included.
        """
        for path in list(self._under.get(written[:2], ())):
            if path[: len(written)] == written:
                self._place_like(intended + path[len(written) :], path)

    def repeat(self, entry: Path, copies: Sequence[Path]) -> None:
        """Record the copies of a repeated entry, so that errors in a copy show the entry's line.

        entry: path of the entry as written in the file. copies: paths of the entries into which it
        was expanded. All keys below the entry are included.
        """
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
        """Record the text in the file from which repetition made another text.

        text: a formula in a copy of a repeated entry. written: the formula in the file, before
        indices were inserted.
        """
        self._text.setdefault(text, written)

    def origin(self, path: Path) -> Path:
        """Return the path of the entry in the file of which an entry is a copy.

        path: path of an entry after repeated entries were expanded. It is returned unchanged if the
        entry is not a copy.
        """
        return self._from.get(path[:2], path[:2]) + path[2:]

    def source(self, path: Path) -> str:
        """Return the lines of the TOML statement that contains the key at `path`, or ""."""
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
        """Return a problem with the entry at `path`, with its line in the file.

        text: the faulty text. at: the faulty part of this text, which is marked in the line if it
        is found. severity: "error" or "warning".
        """
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
        if self._searched < self.MAX_SEARCHED:
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
    """Return the offset of an error in a statement, -1 if it can't be found, and its width.

    `before` is the text as it was before repetition.
    """
    text = (text or "").strip()
    column, width = 0, len(text) or 1
    if isinstance(at, FormulaError):
        column, width = at.column, at.width
    elif at is not None:
        column, width = at.col_offset, (at.end_col_offset or 0) - at.col_offset
    for written in (str, _escape) if text else ():
        if quoted := _find_quoted(written(text), source):
            return quoted.start(2) + len(written(text[:column])), width
    if before and (quoted := _find_quoted(before.strip(), source)):
        return quoted.start(2), len(quoted[2])
    match = re.search(rf"(?<!\w){re.escape(key)}(?!\w)", source)
    return (match.start(), len(key)) if match else (-1, 1)


def _find_quoted(text: str, source: str) -> re.Match[str] | None:
    """Match the text in quotes; a blank may be a line break, so that columns stay the same."""
    body = re.sub(r"\\\s", r"\\s", re.escape(text))
    return re.search(rf"""(["'])\s*({body})\s*\1""", source)


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _paths(tree: Mapping[str, Any], depth: int = 3) -> Iterator[Path]:
    """Yield the paths of all keys, three levels deep: (table, name, key) or (array, "#1", key)."""
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


def _number_entry(path: Path, counts: Mapping[str, int]) -> Path:
    """Return a header's path with its entry's number: [body.x] belongs to the last [[body]]."""
    if path[0] not in counts or len(path) < 2 or not counts[path[0]]:
        return path
    keys = path[2:] if path[1].startswith("#") else path[1:]
    return (path[0], f"#{counts[path[0]]}", *keys)
