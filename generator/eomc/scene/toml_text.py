"""A scene file's TOML text to a plain tree, within bounds that tomllib lacks."""

from __future__ import annotations

import hashlib
import re
import tomllib
from pathlib import Path
from typing import Any

MAX_BYTES = 1_000_000
MOST_PARTS = 20  # of a key, a.b.c; tomllib takes memory by their square

_TEXTS = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'')
_PARTS = re.compile(rf"\s*[\w-]+(?:\s*\.\s*[\w-]+){{{MOST_PARTS},}}\s*", re.ASCII)


def loads(text: str) -> dict[str, Any]:
    """The tree of a text. Raises ValueError where there is none, or it is nested beyond bounds."""
    if long_key(text):
        raise ValueError("a key has too many parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("the TOML is nested too deeply") from None


def long_key(text: str) -> int:
    """The line, from 1, in which a key has more than MOST_PARTS parts; 0 where none has."""
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") >= MOST_PARTS:
            pieces = re.split(r"[\[\]{},=#]", _TEXTS.sub("x", line))
            if any(_PARTS.fullmatch(piece) for piece in pieces):
                return number
    return 0


def tree_and_digest(path: Path) -> tuple[dict[str, Any], str]:
    """A scene file's tree and the digest of its bytes, unchecked. Raises OSError and ValueError."""
    with path.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError("the file is too large for a scene")
    return loads(data.decode()), hashlib.sha256(data).hexdigest()
