"""Texts that would do harm if executed, and a scene to put them in, for tests of free text.

An executed payload would create the file CANARY. `HIDDEN` ones are refused by the reader and
escaped elsewhere; `PLAIN` ones are shown unchanged.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from eomc.derive import lagrange
from eomc.emit import render
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.program.program import Program
from eomc.scene.read import parse
from support.session import ROOT, needs

CANARY = ROOT / "build" / "tests" / f"canary{os.getpid()}"
TOUCH = f"touch {CANARY}"
BUILT = (
    "extern int system(const char *); __attribute__((constructor)) static void "
    f'b(void){{system("{TOUCH}");}}'
)

PLAIN = {
    "docstring": f'""";import os;os.system("{TOUCH}");"""',
    "docstring of three": f"''';import os;os.system('{TOUCH}');'''",
    "literal": f"' + __import__('os').system('{TOUCH}') + '",
    "quote at the end": 'ends in "',
    "quotes": "\"\"\"\" \" '''' '",
    "comment": f"*/ {BUILT} /*",
    "comment in a comment": "/* a /*/ b */* // c",
    "slash first": "/ and * last *",
    "backslash at the end": "ends in \\",
    "two of them": "ends in \\\\",
    "backslash before a blank": "a \\ b",
    "trigraph at the end": "why??/",
    "trigraphs": "*??/ / ??= ??( ???/",
    "x": r"\x",
    "N": r"\N and \N{BULLET} and \U0011ffff and \400",
    "percent": "%s %n %d {0} {title}",
    "template": "{{ 7*7 }} {% include 'x' %} {# a #}",
    "page": f"</title></script><script>{TOUCH}</script><img src=x onerror=alert(1)>&lt;&amp;",
    "attribute": "\" onload='alert(1)' x=\"",
    "latex": rf"$\input{{/etc/passwd}}$ \write18{{{TOUCH}}} \end{{document}}",
    "dollar": "5 $",
    "dollar behind a backslash": r"\$ $ \\$ $x^$ $\frac$",
    "markup": "[red]x[/red] [/] [/nothing] [link=http://x]y[/link] \\[",
    "cells": '=cmd|" /C touch x"!A1,+1,@SUM(1)',
    "shell": f"$({TOUCH}) `{TOUCH}`; {TOUCH}; '; {TOUCH}; '",
    "table": '" ] } [[body]] # x',
    "digraphs": "<: :> %: %:%: ??",
    "long word": "x" * 91 + "\\" + "y" * 91 + "*/" + "z" * 200,
}
HIDDEN = {
    "lines": f'a\n*/ {BUILT} /*\n"""',
    "spliced": f"*\\\n/ {BUILT} /*",
    "spliced by a trigraph": f"*??/\n/ {BUILT} /*",
    "spliced by a return": f"*\\\r\n/ {BUILT} /*",
    "directives": '\n#error x\n#include "/etc/passwd"\n',
    "lines of TOML": '"\nname = "other"\n[run]\n"""\nname = "other"',
    "NUL": "a\0b",
    "tab": "a\tb",
    "return": f"a\rimport os; os.system('{TOUCH}')",
    "escape": "\x1b]0;owned\x07 \x1b[31m \x1b]8;;http://x\x1b\\",
    "controls": "".join(map(chr, (*range(1, 9), *range(11, 32), *range(127, 160)))),
    "escape of one byte": "\x9b31m \x9d0;owned\x9c",
    "page feed": f"a\x0cimport os; os.system('{TOUCH}')",
    "direction": "a\u202e*/ b \u2066 c \u200f d \u061c",
    "next line": f"a\x85import os; os.system('{TOUCH}')",
    "line separator": f"a\u2028import os; os.system('{TOUCH}')\u2029*/",
    "half a character": "a\ud800b\udcff",
}
PAYLOADS = {**PLAIN, **HIDDEN}
ORDINARY = "Κάρρο-εκκρεμές, «é» 30° θ₁ ẋ – m/s² 力 🙂 a\u200db: 'x' \"y\" 50 % #1 C:\\x [m] {} ?"
# one of each kind
FEW = [
    PAYLOADS[name]
    for name in (
        "docstring", "comment", "backslash at the end", "trigraph at the end", "template", "N",
        "spliced", "lines", "controls", "NUL", "half a character",
    )
]  # fmt: skip
payloads = pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS)

RAW = re.compile(
    r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


@contextmanager
def nothing_ran() -> Iterator[None]:
    """No payload is executed during the test."""
    CANARY.parent.mkdir(parents=True, exist_ok=True)
    CANARY.unlink(missing_ok=True)
    try:
        yield
        ran = CANARY.exists()
    finally:
        CANARY.unlink(missing_ok=True)
    assert not ran, "a text was executed"


SCENE = """eomc = 1
name = "fields"
title = "@"
note = "@"
gravity = [0, "-g"]
[coordinates]
x = { unit = "@", start = 0.3, note = "@" }
[parameters]
m = { value = 1.0, unit = "@", note = "@" }
g = { value = 9.81 }
[constants]
k = { value = 2.0, unit = "@", note = "@" }
[inputs]
u = { unit = "@", note = "@" }
[forces]
x = "u"
[[body]]
name = "cart"
note = "@"
joint = "prismatic"
coordinates = "x"
axis = [1, 0]
mass = "m"
[[point]]
name = "tip"
note = "@"
body = "cart"
[[force]]
note = "@"
body = "cart"
force = [0.1, 0]
[[spring]]
note = "@"
coordinate = "x"
stiffness = "k"
[[damper]]
note = "@"
coordinate = "x"
damping = "1"
[[event]]
name = "middle"
note = "@"
when = "x"
[outputs]
y = { formula = "2*x", unit = "@", note = "@" }
[run]
tolerance = 1e-9
h = 0.01
duration = 0.1
"""


def quoted(text: str) -> str:
    """Return a text in TOML quotes, unchanged."""
    written = json.dumps(text, ensure_ascii=False).replace("\x7f", r"\u007f")
    return re.sub(r"[\ud800-\udfff]", lambda match: rf"\u{ord(match[0]):x}", written)


def fields() -> list[tuple[int, str]]:
    """Return the line and the key of each @ in SCENE."""
    where, result = "", []
    counts = {"body": "cart", "point": "tip", "force": "1"}
    counts |= {"spring": "1", "damper": "1", "event": "1"}
    for text in SCENE.splitlines():
        if text.startswith("["):
            where = text.strip("[]")
            where += "." + counts[where] if text.startswith("[[") else ""
        for key in re.findall(r'(\w+) = "@"', text):
            inside = text.split(" = {")[0] if "{" in text else ""
            result.append(".".join(part for part in (where, inside, key) if part))
    return list(enumerate(result))


def filled(texts: dict[int, str]) -> str:
    """Return SCENE with texts in some of its fields."""
    k = iter(range(100))
    return re.sub('"@"', lambda _: quoted(texts.get(next(k), "plain")), SCENE)


@cache
def derived() -> Program:
    system = from_scene(parse(SCENE.replace('"@"', '""'), "f.toml"))
    return program.build(lagrange.derive(system))


def with_texts(system: System, text: str, file: str | None = None) -> System:
    """Return the system with a text in every possible field."""
    return replace(
        system,
        title=text,
        note=text,
        file=text if file is None else file,
        renamed=((text, "x"),),
        coordinates=tuple(replace(c, unit=text, note=text) for c in system.coordinates),
        parameters=tuple(replace(p, unit=text, note=text) for p in system.parameters),
        inputs=tuple(replace(i, unit=text, note=text) for i in system.inputs),
        outputs=tuple(replace(o, unit=text, note=text) for o in system.outputs),
        events=tuple(replace(e, unit=text, note=text) for e in system.events),
    )


def generated(text: str, file: str | None = None) -> dict[str, str]:
    whole = derived()
    program_with_text = replace(whole, system=with_texts(whole.system, text, file))
    return dict(render.render(program_with_text, "_extension").files)


def tokens(files: dict[str, str], folder: Path) -> str:
    """Return the preprocessed C files."""
    names = [name for name in files if name.endswith((".c", ".h"))]
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(files[name], encoding="utf-8")
    command = [needs("gcc"), "-E", "-P", "-Wcomment", "-Wtrigraphs", "-Werror"]
    command += ["-std=c99", "-I.", "-x", "c"]
    process = subprocess.run([*command, *names], cwd=folder, capture_output=True, text=True)
    assert process.returncode == 0 and not process.stderr, process.stderr
    return process.stdout
