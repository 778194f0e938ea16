"""Read the TOML text of a scene into a tree, within limits that tomllib does not have."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eomc.base import texts
from eomc.base.errors import EomcError, Problem, SceneError
from eomc.scene import messages

MAX_BYTES = 1_000_000
MAX_KEY_PARTS = 8  # a.b.c has three; tomllib's memory grows with their square
MAX_TABLES = 10_000  # headers such as [table] or [[body]]; more take seconds to check

_HEADER = re.compile(r"^[ \t]*\[[^\],\n]*\]\]?[ \t]*(?:#.*)?$", re.MULTILINE)

_TEXTS = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'')
_PARTS = re.compile(rf"\s*[\w-]+(?:\s*\.\s*[\w-]+){{{MAX_KEY_PARTS},}}\s*", re.ASCII)


def loads(text: str) -> dict[str, Any]:
    """Parse TOML text and return its tree of dicts and lists.

    Raises ValueError if the text is not TOML, has a key with more than MAX_KEY_PARTS parts or is
    nested too deeply.
    """
    if long_key(text):
        raise ValueError("a key has too many parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("the TOML is nested too deeply") from None


def long_key(text: str) -> int:
    """Return the line, from 1, of a key with more than MAX_KEY_PARTS parts; 0 if there is none."""
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") >= MAX_KEY_PARTS:
            pieces = re.split(r"[\[\]{},=#]", _TEXTS.sub("x", line))
            if any(_PARTS.fullmatch(piece) for piece in pieces):
                return number
    return 0


def tree_and_digest(path: Path) -> tuple[dict[str, Any], str]:
    """Read a scene file; return its tree of dicts and lists, unchecked, and its SHA-256 digest.

    Raises OSError if the file can't be read, and ValueError if it is too large or not TOML.
    """
    with path.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError("the file is too large for a scene")
    return loads(data.decode("utf-8-sig")), hashlib.sha256(data).hexdigest()


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
            number = float.__repr__ if isinstance(value, float) else int.__repr__  # NumPy's too
            written = texts.toml(value) if isinstance(value, str) else number(value)
            lines.append(f"{texts.toml(str(key))} = {written}")
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
        hint = messages.toml_remedy(source)
        remedy = next((r for m, r in _TOML_REMEDIES.items() if m in message), "")
        remedy = f": {hint}" if hint else remedy
    return Problem(f"not TOML: {message}{remedy}", "", file, line, column, width, source)


_TOML_REMEDIES = {
    "Invalid value": ": formulas stand in quotes, numbers have digits on both sides of the point",
    "Expected newline": ": one entry a line, comments begin with '#', decimals are written 9.81",
    "Illegal character '\\n'": ": is a closing quote missing in this line?",
    "Unescaped '\\'": ": LaTeX is not read, write names without backslash (theta)",
    "Unclosed inline table": ": entries in { ... } are separated by commas and stand on one line",
}
