"""Free text is data: every field is crossed with every payload, and none is executed or steers.

A payload that ran would make the file CANARY. Payloads come as a person, a robot file or a Python
caller would give them; `HIDDEN` ones are refused by the reader and shown escaped elsewhere.
"""

from __future__ import annotations

import ast
import json
import os
import pty
import re
import subprocess
import sys
import tomllib
import unicodedata
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import jinja2
import numpy as np
import pytest
import sympy
from click.testing import CliRunner
from conftest import needs
from markupsafe import Markup

import eomc
from eomc import context, mechanics, plot, program, render, report, scene, show, system, texts
from eomc.ccode import DOUBLE
from eomc.cli import main
from eomc.problems import EomcError, SceneError
from eomc.program import Program
from eomc.system import System
from eomc.target import Target

CANARY = Path(__file__).parent.parent / "build" / "tests" / "canary"
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
payloads = pytest.mark.parametrize("given", PAYLOADS.values(), ids=PAYLOADS)

RAW = re.compile(
    r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


@pytest.fixture(autouse=True)
def nothing_ran() -> Iterator[None]:
    CANARY.parent.mkdir(parents=True, exist_ok=True)
    CANARY.unlink(missing_ok=True)
    yield
    ran = CANARY.exists()
    CANARY.unlink(missing_ok=True)
    assert not ran, "a text was executed"


# --- the reader -----------------------------------------------------------------------------------

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
[[spring]]
note = "@"
coordinate = "x"
stiffness = "k"
[[damper]]
note = "@"
coordinate = "x"
damping = "1"
[run]
h = 0.01
duration = 0.1
"""


def quoted(text: str) -> str:
    """A text in TOML's quotes, nothing of it cleaned."""
    written = json.dumps(text, ensure_ascii=False).replace("\x7f", r"\u007f")
    return re.sub(r"[\ud800-\udfff]", lambda found: rf"\u{ord(found[0]):x}", written)


def fields() -> list[tuple[int, str]]:
    """Which @ of SCENE is which key."""
    where, found, counts = "", [], {"body": "cart", "spring": "1", "damper": "1"}
    for text in SCENE.splitlines():
        if text.startswith("["):
            where = text.strip("[]")
            where += "." + counts[where] if text.startswith("[[") else ""
        for key in re.findall(r'(\w+) = "@"', text):
            inside = text.split(" = {")[0] if "{" in text else ""
            found.append(".".join(part for part in (where, inside, key) if part))
    return list(enumerate(found))


def filled(given: dict[int, str]) -> str:
    """SCENE with texts in some of its fields."""
    k = iter(range(100))
    return re.sub('"@"', lambda _: quoted(given.get(next(k), "plain")), SCENE)


def hidden(text: str, lines: bool) -> bool:
    """Whether the reader should refuse a text, from the tables of Unicode."""
    strange = ("Cc", "Zl", "Zp", "Cs")
    marks = [unicodedata.lookup(f"{way} MARK") for way in ("LEFT-TO-RIGHT", "RIGHT-TO-LEFT")]
    return any(
        (unicodedata.category(c) in strange and not (lines and c in "\t\n"))
        or (unicodedata.bidirectional(c) in "LRE RLE PDF LRO RLO LRI RLI FSI PDI".split())
        or c in (*marks, unicodedata.lookup("ARABIC LETTER MARK"))
        for c in text
    )


@pytest.mark.parametrize(("which", "key"), fields(), ids=[key for _, key in fields()])
def test_the_reader_refuses_hidden_characters_and_names_line_and_key(which: int, key: str) -> None:
    for name, given in PAYLOADS.items():
        written = filled({which: given})
        try:
            scene.parse(written, "f.toml")
            refused = False
        except SceneError as fault:
            refused = True
            (problem,) = fault.problems
            if name == "half a character":  # which TOML itself has no way to write
                assert "not TOML" in problem.message
            else:
                assert problem.key == key
                assert re.search(r"U\+[0-9A-F]{4}|line break", problem.message)
                assert f"{key.split('.')[-1]} = " in written.splitlines()[problem.line - 1]
            assert not RAW.search(str(fault))
        assert refused == hidden(given, lines=key.endswith("note")), name


def test_ordinary_texts_and_notes_of_several_lines_pass() -> None:
    note = "first line\nsecond *line*,\n\n\tindented: θ"
    for which, key in fields():
        scene.parse(filled({which: ORDINARY}), "f.toml")
        if key.endswith("note"):
            scene.parse(filled({which: note}), "f.toml")
    made = system.from_scene(scene.parse(filled({1: note, 3: note}), "f.toml"))
    files = eomc.sources(made).files
    assert " * first line second *line*, indented: θ\n" in files["fields.h"]
    assert "/* plain, first line second *line*, indented: θ */" in files["fields.h"]
    assert "x: plain, first line second *line*, indented: θ\n" in files["__init__.py"]


# --- what is generated ----------------------------------------------------------------------------


@cache
def derived() -> Program:
    made = system.from_scene(scene.parse(SCENE.replace('"@"', '""'), "f.toml"))
    return program.build(mechanics.derive(made))


def with_texts(made: System, text: str, file: str | None = None) -> System:
    """The system with a text wherever one can be."""
    return replace(
        made,
        title=text,
        note=text,
        file=text if file is None else file,
        renamed=((text, "x"),),
        coordinates=tuple(replace(c, unit=text, note=text) for c in made.coordinates),
        parameters=tuple(replace(p, unit=text, note=text) for p in made.parameters),
        inputs=tuple(replace(i, unit=text, note=text) for i in made.inputs),
    )


def generated(text: str, file: str | None = None) -> dict[str, str]:
    whole = derived()
    made = replace(whole, system=with_texts(whole.system, text, file))
    return dict(render.render(made, "_extension").files)


def tokens(files: dict[str, str], folder: Path, *flags: str) -> str:
    """What a C compiler sees of the C files."""
    names = [name for name in files if name.endswith((".c", ".h"))]
    for name in names:
        (folder / name).write_text(files[name], encoding="utf-8")
    command = [needs("gcc"), "-E", "-P", "-Wcomment", "-Wtrigraphs", "-Werror", *flags, "-x", "c"]
    done = subprocess.run([*command, *names], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr
    return done.stdout


def code(face: str) -> str:
    """The Python of a face without its literals."""
    tree = ast.parse(face)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            node.value = ""
    return ast.dump(tree)


@cache
def plain_tokens(folder: Path, *flags: str) -> str:
    return tokens(generated("plain", "f.toml"), folder, *flags)


@payloads
def test_texts_change_no_code(given: str, tmp_path: Path, tmp_path_factory: Any) -> None:
    files, folder = generated(given), tmp_path_factory.getbasetemp()
    assert tokens(files, tmp_path, "-std=c99") == plain_tokens(folder, "-std=c99")
    face = files["__init__.py"]
    assert code(face) == code(generated("plain", "f.toml")["__init__.py"])
    assert repr(given) in face
    for name, text in files.items():
        assert not RAW.search(text), name
        assert not re.search(r"(\\|\?\?/)$", text, re.M) or name.endswith(".py"), name
    doc = ast.get_docstring(ast.parse(face), clean=False)
    assert doc is not None and doc.startswith(texts.line(given) + ": compiled equations")


def test_ordinary_text_stays_readable(tmp_path: Path) -> None:
    files = generated(ORDINARY, "Καρό.toml")
    tokens(files, tmp_path, "-std=c99")
    for name in ("fields.h", "fields.c", "main.c", "selftest.c", "__init__.py"):
        shown = ORDINARY.replace("\\", "\\\\") if name == "__init__.py" else ORDINARY
        assert shown in files[name], name
        assert "eomc build Καρό.toml" in files[name] or "'Καρό.toml'" in files[name]
    assert texts.line(ORDINARY) == ORDINARY and tomllib.loads(f"x = {texts.toml(ORDINARY)}") == {
        "x": ORDINARY
    }


def strings(value: Any) -> Iterator[str]:
    """All strings in what a template is given."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from strings(key)
            yield from strings(each)
    elif isinstance(value, (list, tuple, set)):
        for each in value:
            yield from strings(each)


def test_templates_are_given_free_text_only_as_free_text() -> None:
    whole = derived()
    marked = replace(whole, system=with_texts(whole.system, "MARKED"))
    given = context.values(Target(marked, DOUBLE))
    assert not [s for s in strings(given) if "MARKED" in s]


def test_free_text_is_not_printed_by_mistake() -> None:
    text = texts.FreeText("*/")
    for print_it in (str, "{}".format, lambda x: f"{x}", lambda x: "".join(map(str, [x]))):
        with pytest.raises(TypeError, match="free text"):
            print_it(text)
    environment = render.environment()
    for template in ("{{ x }}", "{{ 'a' ~ x }}", "{{ [x, x] | join }}"):
        with pytest.raises(TypeError, match="free text"):
            environment.from_string(template).render(x=text)
    assert "*/" not in environment.from_string("{{ [x] }}{{ {'a': x} }}").render(x=text)
    with pytest.raises(jinja2.UndefinedError):
        environment.from_string("{{ x.coment }}").render(x=text)


IMPORTED = """
import importlib, json, sys
m = importlib.import_module("fields")
m.simulate(steps=3)
print(json.dumps([m.title, m.units, m.__doc__]))
"""


def runs(made: System, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Build, import in another process, run; compile and run the C beside it too."""
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    built = eomc.build(made, folder)
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for file in ("main.c", "selftest.c"):
        command = [needs("gcc"), "-std=c99", "-Wall", "-Wextra", "-Werror", "-o", file[:-2]]
        subprocess.run([*command, file, "fields.c", "-lm"], cwd=built.folder, check=True)
        printed = subprocess.run([f"./{file[:-2]}"], cwd=built.folder, capture_output=True)
        assert printed.returncode == 0 and not RAW.search(printed.stdout.decode())
    told: list[Any] = json.loads(done.stdout)
    return told


def test_all_payloads_at_once_build_import_and_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = " ".join(PAYLOADS.values())
    made = replace(with_texts(derived().system, every), digest="0" * 64)
    title, units, doc = runs(made, tmp_path, monkeypatch)
    assert title == every and units == dict.fromkeys(("x", "m", "g", "u"), every)
    assert texts.line(every) in doc


@pytest.mark.slow
@payloads
def test_each_payload_builds_imports_and_runs(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = replace(with_texts(derived().system, given), digest="0" * 64)
    title, units, _ = runs(made, tmp_path, monkeypatch)
    assert title == given and units == dict.fromkeys(("x", "m", "g", "u"), given)


@payloads
def test_systems_made_in_python(given: str) -> None:
    x, m = sympy.Symbol(given), sympy.Symbol(given + "m")
    v = sympy.Symbol(f"{given}_dot")
    made = System.make(
        "made", {x: 1.0}, m * v**2 / 2, m * x**2, parameters={m: 1}, units={x: given, m: given},
        title=given,
    )  # fmt: skip
    for name, text in eomc.sources(made).files.items():
        assert not RAW.search(text), name
        if name.endswith(".py"):
            ast.parse(text)
    namespace: dict[str, Any] = {}
    exec(show.equations(made, "python"), namespace)
    assert namespace["__doc__"].startswith(texts.line(given) + ": D qdd")
    latex = show.equations(made, "latex")  # names only, and those are plain
    ours = {"begin", "end", "dot", "frac", "left", "right"}
    assert {*re.findall(r"\\([A-Za-z]+)", latex)} <= ours and not re.search("[$#%]", latex)
    for form in ("text", "latex"):
        assert not RAW.search(show.equations(made, form)) and not RAW.search(show.cost(made))


def test_titles_and_units_are_texts() -> None:
    x, v = sympy.symbols("x x_dot")

    class Odd(str):
        def __repr__(self) -> str:
            return f"__import__('os').system({TOUCH!r})"

    for wrong in (3, None, b"x", sympy.Symbol("x")):
        with pytest.raises(EomcError, match="a title or unit is a text"):
            System.make("made", [x], v**2, title="x", units={x: wrong})  # type: ignore[dict-item]
    made = System.make("made", [x], v**2, title=Odd("x"), units={x: Odd("y")})
    face = eomc.sources(made).files["__init__.py"]
    assert "system(" not in face and "title='x'" in face


# --- pages, figures -------------------------------------------------------------------------------


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.seen: list[Any] = []
        self.titles: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.seen.append((tag, attrs))

    def handle_data(self, data: str) -> None:
        if self.seen and self.seen[-1][0] in ("title", "h1"):
            self.titles.append(data)


@pytest.mark.slow
def test_the_page_of_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "_svg", lambda draw, size: Markup("<svg></svg>"))  # no texts
    measured = report.report(derived().system, tmp_path, longest=0.002, methods=("rk4", "dp8"))
    plain = Tags(report.page(replace(measured, title="plain"))).seen
    for name, given in PAYLOADS.items():
        page = report.page(replace(measured, title=given))
        assert not RAW.search(page), name
        read = Tags(page)
        assert read.seen == plain, name
        assert f"{texts.line(given)}: speed against error" in "".join(read.titles), name


def drawn(title: str, unit: str) -> Any:
    made = with_texts(derived().system, unit)
    t = np.linspace(0, 1, 11)
    q = np.cos(t)[:, None]
    return plot.figure(replace(made, title=title), t, q, q, 5 + 0 * t)


@pytest.mark.slow
@pytest.mark.parametrize("given", ["latex", "dollar", "dollar behind a backslash", "escape", "NUL"])
def test_figures(given: str, tmp_path: Path) -> None:
    text = PAYLOADS[given]
    drawn(text, text).savefig(tmp_path / "figure.svg")
    plot.draw(with_texts(derived().system, text), *drawing(), tmp_path / "drawn.svg", title=text)
    for file in ("figure.svg", "drawn.svg"):
        ElementTree.parse(tmp_path / file)


def drawing() -> tuple[Any, ...]:
    t = np.linspace(0, 1, 11)
    q = np.cos(t)[:, None]
    return t, q, q, 5 + 0 * t


def test_no_text_of_a_figure_is_mathematics_or_latex() -> None:
    import matplotlib
    from matplotlib.cbook import is_math_text

    every = " ".join(PAYLOADS.values())
    with matplotlib.rc_context({"text.usetex": True}):
        made = drawn(every, "m")
    found = [text for text in made.findobj(matplotlib.text.Text) if text.get_text()]
    assert found and not any(text.get_usetex() for text in found)
    for given in PAYLOADS.values():
        shown = texts.figure(given)
        assert not is_math_text(shown) and not RAW.search(shown)
        assert shown.replace(r"\$", "$") == texts.line(given)  # as matplotlib draws it
        assert is_math_text(f"$x$ ({shown})")  # and the name before a unit stays mathematics


# --- the command ----------------------------------------------------------------------------------


def said(*words: str, status: int = 0) -> str:
    """What the command prints, which never steers a terminal."""
    done = CliRunner().invoke(main, words)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == status, done.output
    assert not RAW.search(done.output), done.output
    return done.output


def file_name(given: str) -> str:
    """A payload as the name of a file."""
    return os.fsdecode(
        given.replace("/", "∕").replace("\0", "").replace("\ud800", "")
        .encode("utf-8", "surrogateescape")[:150].decode("utf-8", "surrogateescape")
        .encode("utf-8", "surrogateescape") + b"\xff"
    )  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path


def test_hostile_file_names(here: Path) -> None:
    for given in PAYLOADS.values():
        file = file_name(given) + ".toml"
        Path(file).write_text(filled({}), encoding="utf-8")
        made = eomc.read(file)
        assert made.file.isprintable() and not RAW.search(made.file)
        Path(file).write_text(filled({}).replace('"m"', '"mm"'), encoding="utf-8")
        assert "'mm' is not declared" in said("build", file, status=2)
        told = said("build", "no " + file, status=2)
        assert len(told.splitlines()) == 1 and "there is no such file" in told
        assert "one would replace" in said("build", file, str(here / file), status=2)
    assert len(said("list").splitlines()) == len(PAYLOADS)
    assert len(json.loads(said("list", "--json"))) == len(PAYLOADS)


@pytest.mark.slow
def test_the_commands_print_no_text_raw(here: Path) -> None:
    """A scene with all that the reader lets through, under a name that steers terminals."""
    every = " ".join(PLAIN.values())
    file = "f\x1b]0;owned\x07[red]\n'\".toml"
    Path(file).write_text(filled({k: every for k, _ in fields()}), encoding="utf-8")
    assert "built in" in said("build", file)
    out = said("run", file, "--out", "x.csv", "--plot", "x.svg", "--build", "b\x1b[31m")
    assert out.startswith(every)
    assert json.loads(said("run", file, "--json"))["scene"] == "fields"
    assert Path("x.csv").read_text().splitlines()[0] == "t,x,x_dot,energy"  # names only
    ElementTree.parse("x.svg")
    for form in ([], ["--cost"], ["--python"], ["--latex"]):
        said("show", file, *form)
    namespace: dict[str, Any] = {}
    exec(said("show", file, "--python"), namespace)
    said("check", file)
    said("dof", file)
    assert every in said("list") and json.loads(said("list", "--json"))[0]["title"] == every


TERMINAL = """
import time
from eomc import cli
with cli._status({given!r}, False):
    time.sleep(0.2)
times = iter(range(0, 1000, 10))
cli.time.monotonic = lambda: next(times)
with cli._progress({given!r}, False) as progress:
    progress(0, 2)
    progress(1, 2)
"""


@pytest.mark.parametrize("name", ["markup", "escape"])
def test_what_is_going_on_is_shown_as_it_is(name: str) -> None:
    """Rich's own markup and controls are its business; those of a file's name are text."""
    given = PAYLOADS[name][:40]
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "200"}
    script = TERMINAL.format(given=given)
    process = subprocess.Popen([sys.executable, "-c", script], stderr=theirs, env=environment)
    os.close(theirs)
    shown = b""
    while True:
        try:
            shown += os.read(ours, 65536)
        except OSError:
            break
    assert process.wait() == 0, shown
    assert shown.count(texts.line(given).encode()) >= 2
    assert b"\x1b]0" not in shown and b"\x1b]8" not in shown


# --- robot files ----------------------------------------------------------------------------------

URDF = """<robot name={0}>
<link name={0}/>
<link name={1}><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<joint name={1} type="revolute"><parent link={0}/><child link={1}/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<material name={0}/><sensor name={0}/>
</robot>
"""
MJCF = """<mujoco model={0}><worldbody><body name={0}>
<joint name={1} type="hinge" axis="0 0 1"/>
<geom name={0} type="sphere" size="0.1" mass="1"/><site name={0}/>
<body name={1}><joint name={0} type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1"
diaginertia="1 1 1"/></body></body></worldbody>
<actuator><motor name={0} joint={1}/></actuator>
<sensor><jointpos name={0} joint={1}/></sensor></mujoco>
"""


def attribute(text: str) -> str:
    return quoteattr(text, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})


@pytest.mark.parametrize("kind", [URDF, MJCF], ids=["urdf", "mjcf"])
def test_robot_files_with_hostile_names(kind: str, here: Path) -> None:
    imported = 0
    for k, (name, given) in enumerate(PAYLOADS.items()):
        file = file_name(given) + ".xml"
        if re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]", given):  # which XML can't hold
            data = kind.format(attribute("\x01"), attribute("b"))
            Path(file).write_text(data, encoding="utf-8")
            assert "not XML" in said("import", file, status=2), name
            continue
        data = kind.format(attribute(given), attribute(given + "b"))
        Path(file).write_text(data, encoding="utf-8")
        told = said("import", file, "--out", f"s{k}.toml")
        assert "wrote" in told, name
        read = scene.read(f"s{k}.toml")
        assert read.title.startswith(texts.line(given)), name
        wrong = data.replace('type="revolute"', 'type="none"').replace('"hinge"', '"none"')
        Path(file).write_text(wrong, encoding="utf-8")
        said("import", file, status=2)
        imported += 1
    assert imported >= len(PLAIN) + 8


@pytest.mark.parametrize("kind", [URDF, MJCF], ids=["urdf", "mjcf"])
@pytest.mark.parametrize(
    "name", ["docstring", "comment", "lines", "spliced", "spliced by a trigraph"]
)
def test_imported_robots_run(kind: str, name: str, here: Path) -> None:
    given = PAYLOADS[name]
    Path("r.xml").write_text(kind.format(attribute(given), attribute("b")), encoding="utf-8")
    said("import", "r.xml", "--out", "r.toml")
    made = eomc.read("r.toml")
    files = eomc.sources(made).files
    bare = {name: text for name, text in files.items() if not name.endswith(".py")}
    assert "constructor" not in tokens(bare, here, "-std=c99")
    assert texts.line(given) in ast.literal_eval(files["__init__.py"].split("\n\nfrom")[0])
    if name == "spliced by a trigraph":
        said("run", "r.toml", "--duration", "0.01", "--build", str(here / "built"))
