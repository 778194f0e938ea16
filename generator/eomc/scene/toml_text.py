"""The TOML text of a scene: its tree, within limits, and the lines and columns of its keys."""

from __future__ import annotations

import ast
import hashlib
import pathlib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eomc.base import texts
from eomc.base.errors import EomcError, Problem, SceneError
from eomc.scene import hints
from eomc.scene.formulas import FormulaError

MAX_BYTES = 1_000_000
MAX_KEY_PARTS = 8  # a.b.c has three; tomllib's memory grows with their square
MAX_TABLES = 10_000  # headers such as [table] or [[body]]; more take seconds to check

_HEADER = re.compile(r"^[ \t]*\[[^\],\n]*\]\]?[ \t]*(?:#.*)?$", re.MULTILINE)

_TEXTS = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'')
_PARTS = re.compile(rf"\s*[\w-]+(?:\s*\.\s*[\w-]+){{{MAX_KEY_PARTS},}}\s*", re.ASCII)


def long_key(text: str) -> int:
    """Return the line, from 1, of a key with more than MAX_KEY_PARTS parts; 0 if there is none."""
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") >= MAX_KEY_PARTS:
            pieces = re.split(r"[\[\]{},=#]", _TEXTS.sub("x", line))
            if any(_PARTS.fullmatch(piece) for piece in pieces):
                return number
    return 0


def tree_and_digest(path: pathlib.Path) -> tuple[dict[str, Any], str]:
    """Read a scene file; return its tree of dicts and lists, unchecked, and its SHA-256 digest.

    Raises OSError if the file can't be read, and EomcError if it is too large or not TOML.
    """
    with path.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    return text_and_tree(data, path.name)[1], hashlib.sha256(data).hexdigest()


def events_to_toml(definitions: Any, what: str) -> str:
    """Return the TOML text of [[event]] tables for events that are given in Python.

    definitions: by the name of the event, its formula or a dict with keys of [[event]]. what: the
    beginning of error messages. Raises EomcError if `definitions` is not of this form.
    """
    if not isinstance(definitions, Mapping):
        raise EomcError(
            f'{what}: give a dict, such as {{"section": "theta"}}, here {definitions!r}'
        )
    lines: list[str] = []
    for name, entry in definitions.items():
        table = {"name": name, **(entry if isinstance(entry, Mapping) else {"when": entry})}
        lines += ["", "[[event]]"]
        for key, value in table.items():
            if isinstance(value, bool) or not isinstance(value, (str, int, float)):
                remedy = 'give a formula, or a dict such as {"when": "y", "direction": "falling"}'
                raise EomcError(f"{what}: {name}: {key}: {remedy}, here {value!r}")
            lines.append(f"{texts.toml(str(key))} = {texts.toml(value)}")
    return "\n".join(["", *lines, ""])


def text_and_tree(data: bytes, file: str) -> tuple[str, dict[str, Any]]:
    """Decode and parse the contents of a scene file; return its text and its unchecked tree.

    file: name of the file in messages. Raises EomcError if it is too large, and SceneError with the
    place of the error if it is not a TOML text.
    """
    if len(data) > MAX_BYTES:
        shown = texts.line(file)
        raise EomcError(f"{shown}: it has more than the {MAX_BYTES} bytes a scene may have")
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as fault:
        raise SceneError([_encoding_problem(data, fault.start, file)]) from None
    if not text.strip():
        raise SceneError(
            [Problem("the file is empty: 'eomc new NAME' writes a scene to start from", file=file)]
        )
    if text.lstrip().startswith("<"):
        message = (
            f"this is XML and no scene: 'eomc import {texts.line(file)}' writes that of a robot"
        )
        raise SceneError([Problem(message, file=file)])
    if line := long_key(text):
        message = f"a key has more than {MAX_KEY_PARTS} parts: a scene's have three, a.b.c, at most"
        raise _line_error(message, text, line, file)
    headers = [match.start() for match in _HEADER.finditer(text)]
    if len(headers) > MAX_TABLES:
        message = (
            f"this is table {MAX_TABLES + 1:,} of {len(headers):,}, and a scene has "
            f'{MAX_TABLES:,} at most: write alike ones once, with repeat = "i = 1..n"'
        )
        raise _line_error(message, text, text.count("\n", 0, headers[MAX_TABLES]) + 1, file)
    try:
        tree = tomllib.loads(text)
    except ValueError as fault:
        raise SceneError([_toml_problem(fault, text, file)]) from None
    except RecursionError:
        raise SceneError([Problem("the TOML is nested too deeply", file=file)]) from None
    if _has_huge(tree):
        raise SceneError([_huge_problem(text, file)])
    return text, tree


def _line_error(message: str, text: str, line: int, file: str) -> SceneError:
    source = text.split("\n")[line - 1].rstrip()
    return SceneError([Problem(message, "", file, line, 0, len(source), source)])


def _encoding_problem(data: bytes, offset: int, file: str) -> Problem:
    start = data.rfind(b"\n", 0, offset) + 1
    source = data[start:].split(b"\n")[0].decode("utf-8", "replace").rstrip()
    column = len(data[start:offset].decode())
    line = data[:start].count(b"\n") + 1
    return Problem(
        "the file is not UTF-8 text: save it as UTF-8", "", file, line, column, source=source
    )


def _has_huge(tree: dict[str, Any]) -> bool:
    """True if the tree contains an integer too large for a double."""
    pending: list[Any] = [tree]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            pending += value.values()
        elif isinstance(value, list):
            pending += value
        elif isinstance(value, int) and value.bit_length() > 1024:
            return True
    return False


def _huge_problem(text: str, file: str) -> Problem:
    long = re.search(r"(?i)=[^\"'\n]*?\b(0x[\da-f_]{250}|[\d_]{300}|0o[\d_]{300})", text)
    line = text.count("\n", 0, long.start(1)) + 1 if long else 0
    return Problem(
        "a number has hundreds of digits, more than any double: shorten it", "", file, line
    )


def _toml_problem(fault: ValueError, text: str, file: str) -> Problem:
    """Return tomllib's message with its place and the likely remedy."""
    if not isinstance(fault, tomllib.TOMLDecodeError):  # an int beyond Python's 4,300 digits
        return _huge_problem(text, file)
    lines = text.split("\n")
    match = re.search(r" \(at line (\d+), column (\d+)\)", str(fault))
    line, column = (int(match[1]), int(match[2]) - 1) if match else (len(lines), -1)
    message = re.sub(r" \(at .*\)", "", str(fault))
    source = lines[line - 1].rstrip()
    key = re.match(r"\s*([^=\s]+)\s*=", source)
    width = 1
    if re.match(r"\s*[^\s\"'=#]*[^\x00-\x7f]", source):
        remedy = ": bare keys are ASCII, write Greek letters out (theta)"
    elif "overwrite" in message and key:
        remedy = f": '{key[1]}' stands here a second time, remove one of the two"
        column, width = key.start(1), len(key[1])
    elif "Cannot declare" in message:
        remedy = ": a [table] stands once, put its entries together"
        column, width = 0, len(source)
    elif "Invalid value" in message and (truth := re.match("True|False", source[column:])):
        remedy, width = f": write {truth[0].lower()}, in small letters", len(truth[0])
    else:
        hint = next((r for m, r in hints.TOML.items() if m in message), "")
        hint = hints.toml_remedy(source) or hint
        remedy = f": {hint}" if hint else ""
    return Problem(f"not TOML: {message}{remedy}", "", file, line, column, width, source)


# --- places of keys -------------------------------------------------------------------------------

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


# messages about TOML, in the words of Python
_IN_PYTHON = {
    "[parameters], [constants]": "parameters",
    'lines = [["cart", "tip"]]': '"lines": [["cart", "tip"]]',
    "[picture.points], such as tip = [": '"points", such as "tip": [',
    'a table, such as { tip = ["x", "l*cos(theta)"] }': (
        'a dict, such as {"tip": ["x", "l*cos(theta)"]}'
    ),
    "a list of tables with": "a list of dicts with",
    '[{ at = "cart", size = [0.4, 0.2] }]': '[{"at": "cart", "size": [0.4, 0.2]}]',
    '[{ at = "wheel", radius = 0.1 }]': '[{"at": "wheel", "radius": 0.1}]',
    'x = { unit = "m", start = 0.0 }': "x",
    'add action = "jump"': 'add "action": "jump"',
    "or a formula in quotes": "or a formula",
    "text in quotes": "text",
    "true or false": "True or False",
    "true, false": "True, False",
    ", here a table": ", here a dict",
    ", here true": ", here True",
    ", here false": ", here False",
    "[[event]]": "events",
    " or a [[loop]]": "",
    ' = "..."': "",
    "write formula = ": "give ",
}
_TABLE = re.compile(
    r"\benergy\.(?=\w)|\[(constraints|coordinates|definitions|energy|forces|inputs|outputs|parameters|run)\]"
)
# arguments of System.make that differ from the keys of a scene
_ARGUMENTS = (
    (r"run\.method", "methods"),
    (r"(?:run|energy)\.(\w+)", r"\1"),
    (r"\w+\.(\w+)\.unit", r"units.\1"),
    (r"coordinates\.(\w+)\.(friction|guess)", r"\2.\1"),
    (r"inputs\.(\w+)\.limits", r"limits.\1"),
    (r"(\w+\.\w+)\.(?:formula|value|signal)", r"\1"),
)


def in_python(message: str) -> str:
    """Return a message about TOML in the words of Python."""
    for toml, python in _IN_PYTHON.items():
        message = message.replace(toml, python)
    return _TABLE.sub(lambda match: match[1] or "", message)


class ArgumentMap(SourceMap):
    """The arguments of System.make as places of errors, in place of the lines of a scene.

    name: name of the system. events: names of its events. Messages about TOML are put in the words
    of Python, and keys become arguments.
    """

    def __init__(self, name: str, events: Sequence[str] = ()) -> None:
        super().__init__("", "")
        self.name = name
        self.events = {str(k): event for k, event in enumerate(events, start=1)}

    def problem(
        self,
        path: Path,
        message: str,
        at: FormulaError | ast.expr | None = None,
        text: str | None = None,
        severity: str = "error",
    ) -> Problem:
        """Return a problem with an argument, as `SourceMap.problem` does; it shows the formula."""
        if path[0] == "event":
            path = ("events", *(self.events.get(part, part) for part in path[1:]))
        key = ".".join(path)
        for pattern, argument in _ARGUMENTS:
            key = re.sub(f"^{pattern}$", argument, key)
        column, width = _part(at, text or "")
        return Problem(
            in_python(message), key, f"System {self.name}", 0, column if text else -1,
            width, text or "", severity,
        )  # fmt: skip


def _part(at: FormulaError | ast.expr | None, text: str) -> tuple[int, int]:
    """Return column and width of the faulty part of a text, by default the whole text."""
    if isinstance(at, FormulaError):
        return at.column, at.width
    if at is not None:
        return at.col_offset, (at.end_col_offset or 0) - at.col_offset
    return 0, len(text) or 1


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
    column, width = _part(at, text)
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
