"""Code blocks of pages of the documentation, followed as a reader follows them.

A block is preceded by the name of a file in backquotes and a colon, which it is written to, or by a
comment `<!-- not run: reason -->`. Otherwise `sh` is run by a shell, `python` in one session of the
page, and `text` is the end of the output of the block above it.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BLOCK = re.compile(
    r"(?:^`(?P<file>[\w./-]+)`:\n\n|^<!-- not run: (?P<reason>.*?) -->\n\n?)?"
    r"^```(?P<language>\w*)\n(?P<text>.*?)^```$",
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


def follow(page: str, folder: Path) -> str:
    """Write the files of a page and run its blocks in a folder; return the output of commands.

    Raises AssertionError where a command fails, or the output is not the one of the page.
    """
    session: dict[str, Any] = {}
    output = whole = ""
    for block in blocks(page):
        if block.file:
            (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.file).write_text(block.text, encoding="utf-8")
        elif block.reason:
            continue
        elif block.language == "sh":
            output = run_shell(block.text, folder)
            whole += output
        elif block.language == "python":
            stream = io.StringIO()
            code = compile("\n" * (block.line - 1) + block.text, "page", "exec")
            with contextlib.chdir(folder), contextlib.redirect_stdout(stream):
                exec(code, session)
            output = stream.getvalue()
        elif block.language == "text":
            assert output.replace("\r", "").endswith(block.text), output
        else:
            raise AssertionError(f"line {block.line}: a block of {block.language} is not run")
    return whole


def run_shell(commands: str, folder: Path) -> str:
    """Run the commands in a folder, with the programs of this Python first; return the output."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    process = subprocess.run(
        ["sh", "-e", "-c", commands], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PATH": path}, stdin=subprocess.DEVNULL, timeout=500,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout
