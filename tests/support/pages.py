"""Code blocks of pages of the documentation, followed as a reader follows them.

A block is preceded by the name of a file in backquotes and a colon, which it is written to, or by a
comment `<!-- not run: reason -->`. Otherwise `sh` is run by a shell, `python` in one session of the
page, and `text` is the end of the output of the block above it. Lines of `python` that begin with
">>>", and commands that begin with "$ ", are followed by their output, in which "..." stands for
any text. `toml` is a scene, or a part of one.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import linecache
import os
import re
import subprocess
import sys
import tomllib
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import eomc
from eomc.scene.read import parse
from eomc.scene.schema import json_schema

_BLOCK = re.compile(
    r"(?:^`(?P<file>[\w./-]+)`:\n\n|^ *<!-- not run: (?P<reason>.*?) -->\n\n?)?"
    r"^ *```(?P<language>\w*)\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A code block. file: where it is written to; reason: why it is not run; or both empty."""

    language: str
    text: str
    file: str
    reason: str
    line: int


def blocks(page: str) -> Iterator[Block]:
    """Yield the code blocks of the text of a page, or of a part of it."""
    for match in _BLOCK.finditer(page):
        line = page.count("\n", 0, match.start("text")) + 1
        file, reason = match["file"] or "", match["reason"] or ""
        yield Block(match["language"], match["text"], file, reason, line)


def follow(page: str, folder: Path, setups: Mapping[str, Callable[[], Any]] | None = None) -> str:
    """Write the files of a page and run its blocks in a folder; return the output of commands.

    setups: functions that return the variables which a block of Python needs from elsewhere, by a
    text that occurs in the block. Raises AssertionError where a command fails, the output is not
    the one of the page, or a setup belongs to no block.
    """
    session: dict[str, Any] = {"eomc": eomc, "np": np}
    unused = dict(setups or {})
    output = whole = ""
    for block in blocks(page):
        if block.file:
            (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.file).write_text(block.text, encoding="utf-8")
        elif block.reason:
            continue
        elif block.text.startswith("$ "):
            check_console(block.text, folder)
        elif block.language == "sh":
            output = run_shell(block.text, folder)
            whole += output
        elif block.language == "python":
            with contextlib.chdir(folder), pytest.MonkeyPatch.context() as patch:
                patch.syspath_prepend(str(folder))
                for text in [text for text in unused if text in block.text]:
                    session.update(unused.pop(text)())
                output = run_python(block, session)
        elif block.language == "toml":
            check_scene(block.text)
        elif block.language == "text":
            assert _normal(output).endswith(_normal(block.text)), output
        else:
            assert not block.language, f"line {block.line}: {block.language} is not run"
    assert not unused, f"no block contains {[*unused]}"
    return whole


def run_python(block: Block, session: dict[str, Any]) -> str:
    """Run a block of Python with the variables of a session; return what it prints."""
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream):
        if ">>>" in block.text:
            name, options = f"line {block.line}", doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
            test = doctest.DocTestParser().get_doctest(block.text, session, name, None, 0)
            result = doctest.DocTestRunner(optionflags=options).run(test, clear_globs=False)
            assert not result.failed, stream.getvalue()
            session.update(test.globs)
        else:
            source, name = "\n" * (block.line - 1) + block.text, f"<page, line {block.line}>"
            linecache.cache[name] = len(source), None, source.splitlines(keepends=True), name
            exec(compile(source, name, "exec"), session)
    return stream.getvalue()


def check_console(text: str, folder: Path) -> None:
    """Run the commands of a session in a terminal, and compare their outputs."""
    for command, expected in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
        output = run_shell(f"({command}) 2>&1 || true", folder)
        pattern = re.escape(_normal(expected)).replace(r"\.\.\.", ".*")
        assert re.fullmatch(pattern, _normal(output), re.DOTALL), output


def _normal(text: str) -> str:
    """Return a text with composed accents, without carriage returns."""
    return unicodedata.normalize("NFC", text.replace("\r", ""))


def check_scene(text: str) -> None:
    """Check a scene, or the keys and values of a part of a scene. Raises AssertionError."""
    tree = tomllib.loads(text)
    if "eomc" in tree:
        parse(text, "page.toml")
        return
    jsonschema = pytest.importorskip("jsonschema")
    faults = jsonschema.Draft7Validator(json_schema()).iter_errors(tree)
    missing = [fault for fault in faults if fault.validator not in ("required", "minProperties")]
    assert not [fault.message for fault in missing if not _lacks_keys(fault)]


def _lacks_keys(fault: Any) -> bool:
    """Return whether a fault of a value with alternatives is only a missing key."""
    return any(each.validator == "required" for each in fault.context or ())


def run_shell(commands: str, folder: Path) -> str:
    """Run the commands in a folder, with the programs of this Python first; return the output."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    process = subprocess.run(
        ["sh", "-e", "-c", commands], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PATH": path}, stdin=subprocess.DEVNULL, timeout=500,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout
